"""The tables of a map: each column with its type, shape, meaning and the table it refers to, said once.

Checks, selection, concatenation, files and the format's page all derive from these declarations.
Rows refer to rows of other tables by number; -1 refers to none, where a column allows it.
What exists beyond one map (missions, vertices, edges, landmarks, resources) has a 128-bit id, 16 bytes,
derived from its content (`ids.py`), so that maps that were made apart agree.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-A.
"""

# ruff: noqa: RUF009  # `column` makes a dataclass field, which the rule cannot see

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mapstream.recordings.maps.columns import BytesArray, IdArray, Table, TextArray, column
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray
from mapstream.streams.geometry import SE3

_NAN = float("nan")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Missions(Table):
    meaning: ClassVar[str] = "One row per continuous mapping session."

    id: IdArray = column("uint8", "from the recording's name and epoch", (16,))
    name: TextArray = column("text", "for people; need not be unique", fill="")
    T_map_mission: FloatArray = column(
        "float64", "where the mission's frame lies in the map", (4, 4), fill=np.eye(4)
    )
    is_base_frame_known: BoolArray = column(
        "bool", "whether `T_map_mission` is anchored, or only a guess", fill=False
    )
    sensors: TextArray = column("text", "JSON: the sensor set with its calibration", fill="{}")

    def T_map_mission_of(self, row: int) -> SE3:
        return SE3(self.T_map_mission[row])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frames(Table):
    meaning: ClassVar[str] = (
        "Outer reference frames in which absolute measurements speak: a geodetic plane, a motion capture room."
    )

    id: IdArray = column("uint8", "from the name", (16,))
    name: TextArray = column("text", "by which measurements name it: enu, vicon ...")
    T_map_frame: FloatArray = column(
        "float64", "where the frame lies in the map", (4, 4), fill=np.eye(4)
    )
    is_known: BoolArray = column(
        "bool", "whether `T_map_frame` is given; otherwise an optimizer finds it", fill=False
    )
    crs: TextArray = column(
        "text", "what its axes are: enu at the origin, or a projection as EPSG:32632", fill=""
    )
    origin_lla: FloatArray = column(
        "float64",
        "WGS84 latitude [deg], longitude [deg], height [m] of its zero; NaN: nowhere",
        (3,),
        fill=_NAN,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vertices(Table):
    meaning: ClassVar[str] = "The state of a robot at one time of one mission."

    id: IdArray = column("uint8", "from the mission's id and the stamp", (16,))
    mission: IntArray = column("int64", "the mission it belongs to", refers_to="missions")
    stamp_ns: IntArray = column("int64", "when the robot was there [ns]")
    T_mission_base: FloatArray = column("float64", "the robot's pose", (4, 4))
    velocity_mps: FloatArray = column(
        "float64", "of the base in the mission frame [m/s]; NaN: unknown", (3,), fill=_NAN
    )
    gyro_bias_radps: FloatArray = column("float64", "[rad/s]; NaN: unknown", (3,), fill=_NAN)
    accel_bias_mps2: FloatArray = column("float64", "[m/s^2]; NaN: unknown", (3,), fill=_NAN)

    def T_mission_base_of(self, row: int) -> SE3:
        return SE3(self.T_mission_base[row])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks(Table):
    meaning: ClassVar[str] = (
        "Anything with a place: a visual point, a LiDAR point, an object, a plane."
    )

    id: IdArray = column("uint8", "from the first observation", (16,))
    kind: TextArray = column("text", "visual, lidar, object ...; kinds never meet in matching")
    label: TextArray = column("text", "semantic class", fill="")
    vertex: IntArray = column("int64", "the vertex whose base it is fixed to", refers_to="vertices")
    p_base: FloatArray = column("float64", "position in that base [m]", (3,))
    quat_base_xyzw: FloatArray = column(
        "float64",
        "orientation in that base; z is the normal of a plane; NaN: it has none",
        (4,),
        fill=_NAN,
    )
    covariance: FloatArray = column("float64", "of `p_base` [m^2]; NaN: unknown", (3, 3), fill=_NAN)
    quality: TextArray = column("text", "unknown, bad or good", fill="unknown")
    payload: BytesArray = column(
        "bytes",
        "what a kind needs beyond this; of objects JSON: extent_m, text, and name, which people gave",
        fill=b"",
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edges(Table):
    meaning: ClassVar[str] = (
        "A constraint on vertices, landmarks and outer frames; the kind says on which."
    )

    id: IdArray = column(
        "uint8", "from kind, source, vertices, and how many such edges come before", (16,), fill=0
    )  # `build.append_edges` gives it
    kind: TextArray = column(
        "text", "odometry, loop, imu, absolute, fixed ...; unknown kinds are kept as they are"
    )
    vertex_a: IntArray = column(
        "int64",
        "the first vertex; -1 where landmarks alone are constrained",
        refers_to="vertices",
        is_optional=True,
        fill=-1,
    )
    vertex_b: IntArray = column(
        "int64",
        "the second; -1 where there is one only",
        refers_to="vertices",
        is_optional=True,
        fill=-1,
    )
    landmark_a: IntArray = column(
        "int64", "the first landmark", refers_to="landmarks", is_optional=True, fill=-1
    )
    landmark_b: IntArray = column(
        "int64", "the second landmark", refers_to="landmarks", is_optional=True, fill=-1
    )
    frame: IntArray = column(
        "int64",
        "the outer frame of an absolute measurement; -1: the map frame",
        refers_to="frames",
        is_optional=True,
        fill=-1,
    )
    T_a_b: FloatArray = column(
        "float64",
        "the measured transform: from the second vertex to the first, from the sensor to the outer frame,"
        " from the landmark to the base",
        (4, 4),
        fill=np.eye(4),
    )
    covariance: FloatArray = column(
        "float64",
        "rotation first [rad, m]; infinite on the diagonal where nothing was measured",
        (6, 6),
        fill=np.diag([np.inf] * 6),
    )
    is_switchable: BoolArray = column(
        "bool", "whether an optimizer may find that it is false", fill=False
    )
    switch: FloatArray = column("float64", "0 (false) to 1 (true)", fill=1.0)
    switch_variance: FloatArray = column("float64", "NaN: unknown", fill=_NAN)
    source: TextArray = column("text", "the operator that measured it", fill="")
    payload: BytesArray = column(
        "bytes", "what a kind needs beyond this; kinds of mapstream write JSON", fill=b""
    )

    def T_a_b_of(self, row: int) -> SE3:
        return SE3(self.T_a_b[row])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuSamples(Table):
    meaning: ClassVar[str] = "The raw samples behind the edges of kind `imu`."

    edge: IntArray = column("int64", "the edge that integrates it", refers_to="edges")
    stamp_ns: IntArray = column("int64", "[ns]")
    gyro_radps: FloatArray = column("float64", "[rad/s]", (3,))
    accel_mps2: FloatArray = column("float64", "specific force [m/s^2]", (3,))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureSets(Table):
    meaning: ClassVar[str] = (
        "What one detector found in one image: the descriptors of its keypoints, which are observations."
    )

    vertex: IntArray = column("int64", "the vertex it was seen from", refers_to="vertices")
    sensor: TextArray = column("text", "name of the camera in the mission's set")
    kind: TextArray = column("text", "orb, brisk, sift ...; kinds never meet in matching")
    offset_ns: IntArray = column("int64", "time of the image after the vertex [ns]", fill=0)
    dtype: TextArray = column("text", "of descriptors: uint8, compared by bits, or float32")
    width: IntArray = column("int64", "numbers in one descriptor; 0: there are none")
    descriptors: BytesArray = column("bytes", "one after another, little-endian", fill=b"")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observations(Table):
    meaning: ClassVar[str] = "What a sensor saw at a vertex, and of which landmark."

    vertex: IntArray = column("int64", "the vertex it was seen from", refers_to="vertices")
    landmark: IntArray = column(
        "int64", "what was seen; -1: not known yet", refers_to="landmarks", is_optional=True
    )
    sensor: TextArray = column("text", "name of the sensor in the mission's set")
    offset_ns: IntArray = column("int64", "time of the sensor after the vertex [ns]", fill=0)
    keypoint_px: Float32Array = column(
        "float32", "x, y [px]; NaN where there is no image", (2,), fill=_NAN
    )
    p_sensor: Float32Array = column(
        "float32",
        "3D point in the sensor's frame [m]; NaN where only a ray is known",
        (3,),
        fill=_NAN,
    )
    sigma: Float32Array = column(
        "float32",
        "standard deviation of the keypoint [px]; without one, of the 3D point [m]",
        fill=1.0,
    )
    sigma_m: Float32Array = column(
        "float32",
        "of the 3D point of a keypoint, along each axis [m]; NaN: there is none",
        fill=_NAN,
    )
    kind: TextArray = column(
        "text", "of the feature; landmarks and tracks are of one kind", fill=""
    )
    label: TextArray = column("text", "semantic class of what was seen", fill="")
    track: IntArray = column(
        "int64",
        "keypoints of a mission and kind with one track are of one point; -1: none",
        fill=-1,
    )
    feature_set: IntArray = column(
        "int64",
        "where its descriptor is; -1: it has none",
        refers_to="feature_sets",
        is_optional=True,
        fill=-1,
    )
    feature: IntArray = column("int64", "number of the descriptor in that set", fill=-1)
    score: Float32Array = column("float32", "as its detector rates it", fill=_NAN)
    scale: Float32Array = column("float32", "diameter [px]", fill=_NAN)
    orientation_rad: Float32Array = column("float32", "[rad]", fill=_NAN)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Resources(Table):
    meaning: ClassVar[str] = "Where clouds, images and raw measurements of a vertex lie."

    id: IdArray = column("uint8", "from the vertex's id and the place", (16,))
    vertex: IntArray = column("int64", "the vertex it belongs to", refers_to="vertices")
    kind: TextArray = column(
        "text", "cloud: a keyframe's points in the base frame; record: raw ..."
    )
    path: TextArray = column("text", "a file in the map's folder, or a recording")
    topic: TextArray = column("text", "in the recording; empty for a file", fill="")
    log_ns: IntArray = column("int64", "log time in the recording [ns]; 0 for a file", fill=0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Projections(Table):
    meaning: ClassVar[str] = "Linear maps of descriptors that were learnt from a map."

    id: IdArray = column("uint8", "from all that it says", (16,))
    kind: TextArray = column("text", "of the features")
    use: TextArray = column(
        "text", "compression: descriptors of the kind are its results; index: of a multi-index"
    )
    num_inputs: IntArray = column("int64", "numbers, or bits, of a descriptor")
    num_outputs: IntArray = column("int64", "numbers of its projection")
    mean: BytesArray = column("bytes", "float32 that are taken off first, little-endian")
    matrix: BytesArray = column("bytes", "float32, a row per input, little-endian")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Journal(Table):
    meaning: ClassVar[str] = (
        "What was done to the map, in order; without times, so that runs compare."
    )

    operation: TextArray = column("text", "name of the command")
    parameters: TextArray = column("text", "JSON, keys sorted", fill="{}")
