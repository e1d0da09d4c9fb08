"""The tables of a map: each column with its type, shape, meaning and the table it refers to, said once.

Checks, selection, concatenation, files and the format's page all derive from these declarations.
Rows refer to rows of other tables by number; -1 refers to none, where a column allows it.
What exists beyond one map (missions, vertices, edges, landmarks, resources) has a 128-bit id, 16 bytes,
derived from its content (`ids.py`), so that maps that were made apart agree.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-A.
"""

# ruff: noqa: RUF009  # `_column` makes a dataclass field, which the rule cannot see

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import Float32Array, FloatArray, IntArray, frozen
from mapstream.streams.geometry import SE3

IdArray = npt.NDArray[np.uint8]
BoolArray = npt.NDArray[np.bool_]
TextArray = npt.NDArray[np.object_]  # of str
BytesArray = npt.NDArray[np.object_]  # of bytes
_NAN = float("nan")


@dataclass(frozen=True, slots=True)
class Column:
    """What one column of a table holds."""

    name: str
    kind: str  # "text", "bytes", or the name of a numpy type
    shape: tuple[int, ...]  # of one row
    meaning: str
    refers_to: str | None  # the table whose rows these numbers are
    is_optional: bool  # a reference that may be -1
    fill: Any  # the value of every row where a table is made without this column; None: required

    @property
    def dtype(self) -> npt.DTypeLike:
        return np.dtype(object if self.kind in ("text", "bytes") else self.kind)


def _column(
    kind: str,
    meaning: str,
    shape: tuple[int, ...] = (),
    *,
    refers_to: str | None = None,
    is_optional: bool = False,
    fill: Any = None,  # noqa: ANN401  # a value of the column's type
) -> Any:  # noqa: ANN401  # stands for the annotated array
    declared = Column("", kind, shape, meaning, refers_to, is_optional, fill)
    return field(default=None, metadata={"column": declared})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Table:
    """Columns of equal length; read-only. A column that is not given gets its fill value."""

    meaning: ClassVar[str] = ""

    def __post_init__(self) -> None:
        columns = columns_of(type(self))
        given = [c.name for c in columns if getattr(self, c.name) is not None]
        num_rows = len(getattr(self, given[0])) if given else 0
        for column in columns:
            if getattr(self, column.name) is None:
                object.__setattr__(self, column.name, self._filled(column, num_rows))
            frozen(self, column.name, column.dtype, (num_rows, *column.shape))
            self._check_objects(column)

    def _filled(self, column: Column, num_rows: int) -> npt.NDArray[Any]:
        if column.fill is None and num_rows:
            raise ValueError(f"{type(self).__name__}: the column {column.name} is missing")
        fill = 0 if column.fill is None else column.fill
        return np.full((num_rows, *column.shape), fill, column.dtype)

    def _check_objects(self, column: Column) -> None:
        expected = {"text": str, "bytes": bytes}.get(column.kind)
        found = set(map(type, getattr(self, column.name))) if expected else set()
        if not found <= {expected}:
            names = sorted(kind.__name__ for kind in found)
            raise ValueError(
                f"{type(self).__name__}.{column.name}: expected {expected}, got {names}"
            )

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))


TableT = TypeVar("TableT", bound=Table)


_columns: dict[type, tuple[Column, ...]] = {}  # read once: every table that is made asks


def columns_of(table_type: type[Table]) -> tuple[Column, ...]:
    """Return the declared columns of a table type, in their order."""
    columns = _columns.get(table_type)
    if columns is None:
        columns = tuple(replace(f.metadata["column"], name=f.name) for f in fields(table_type))
        _columns[table_type] = columns
    return columns


def references_of(table_type: type[Table]) -> tuple[Column, ...]:
    """Return the columns of a table type that refer to rows of a table."""
    return tuple(column for column in columns_of(table_type) if column.refers_to is not None)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Missions(Table):
    meaning: ClassVar[str] = "One row per continuous mapping session."

    id: IdArray = _column("uint8", "from the recording's name and epoch", (16,))
    name: TextArray = _column("text", "for people; need not be unique", fill="")
    T_map_mission: FloatArray = _column(
        "float64", "where the mission's frame lies in the map", (4, 4), fill=np.eye(4)
    )
    is_base_frame_known: BoolArray = _column(
        "bool", "whether `T_map_mission` is anchored, or only a guess", fill=False
    )
    sensors: TextArray = _column("text", "JSON: the sensor set with its calibration", fill="{}")

    def T_map_mission_of(self, row: int) -> SE3:
        return SE3(self.T_map_mission[row])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frames(Table):
    meaning: ClassVar[str] = (
        "Outer reference frames in which absolute measurements speak: a geodetic plane, a motion capture room."
    )

    id: IdArray = _column("uint8", "from the name", (16,))
    name: TextArray = _column("text", "by which measurements name it: enu, vicon ...")
    T_map_frame: FloatArray = _column(
        "float64", "where the frame lies in the map", (4, 4), fill=np.eye(4)
    )
    is_known: BoolArray = _column(
        "bool", "whether `T_map_frame` is given; otherwise an optimizer finds it", fill=False
    )
    crs: TextArray = _column(
        "text", "what its axes are: enu at the origin, or a projection as EPSG:32632", fill=""
    )
    origin_lla: FloatArray = _column(
        "float64",
        "WGS84 latitude [deg], longitude [deg], height [m] of its zero; NaN: nowhere",
        (3,),
        fill=_NAN,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vertices(Table):
    meaning: ClassVar[str] = "The state of a robot at one time of one mission."

    id: IdArray = _column("uint8", "from the mission's id and the stamp", (16,))
    mission: IntArray = _column("int64", "the mission it belongs to", refers_to="missions")
    stamp_ns: IntArray = _column("int64", "when the robot was there [ns]")
    T_mission_base: FloatArray = _column("float64", "the robot's pose", (4, 4))
    velocity_mps: FloatArray = _column(
        "float64", "of the base in the mission frame [m/s]; NaN: unknown", (3,), fill=_NAN
    )
    gyro_bias_radps: FloatArray = _column("float64", "[rad/s]; NaN: unknown", (3,), fill=_NAN)
    accel_bias_mps2: FloatArray = _column("float64", "[m/s^2]; NaN: unknown", (3,), fill=_NAN)

    def T_mission_base_of(self, row: int) -> SE3:
        return SE3(self.T_mission_base[row])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks(Table):
    meaning: ClassVar[str] = (
        "Anything with a place: a visual point, a LiDAR point, an object, a plane."
    )

    id: IdArray = _column("uint8", "from the first observation", (16,))
    kind: TextArray = _column("text", "visual, lidar, object ...; kinds never meet in matching")
    label: TextArray = _column("text", "semantic class", fill="")
    vertex: IntArray = _column(
        "int64", "the vertex whose base it is fixed to", refers_to="vertices"
    )
    p_base: FloatArray = _column("float64", "position in that base [m]", (3,))
    quat_base_xyzw: FloatArray = _column(
        "float64",
        "orientation in that base; z is the normal of a plane; NaN: it has none",
        (4,),
        fill=_NAN,
    )
    covariance: FloatArray = _column(
        "float64", "of `p_base` [m^2]; NaN: unknown", (3, 3), fill=_NAN
    )
    quality: TextArray = _column("text", "unknown, bad or good", fill="unknown")
    payload: BytesArray = _column("bytes", "what a kind needs beyond this", fill=b"")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edges(Table):
    meaning: ClassVar[str] = (
        "A constraint on vertices, landmarks and outer frames; the kind says on which."
    )

    id: IdArray = _column(
        "uint8", "from kind, source, vertices, and how many such edges come before", (16,), fill=0
    )  # `build.append_edges` gives it
    kind: TextArray = _column(
        "text", "odometry, loop, imu, absolute, fixed ...; unknown kinds are kept as they are"
    )
    vertex_a: IntArray = _column(
        "int64",
        "the first vertex; -1 where landmarks alone are constrained",
        refers_to="vertices",
        is_optional=True,
        fill=-1,
    )
    vertex_b: IntArray = _column(
        "int64",
        "the second; -1 where there is one only",
        refers_to="vertices",
        is_optional=True,
        fill=-1,
    )
    landmark_a: IntArray = _column(
        "int64", "the first landmark", refers_to="landmarks", is_optional=True, fill=-1
    )
    landmark_b: IntArray = _column(
        "int64", "the second landmark", refers_to="landmarks", is_optional=True, fill=-1
    )
    frame: IntArray = _column(
        "int64",
        "the outer frame of an absolute measurement; -1: the map frame",
        refers_to="frames",
        is_optional=True,
        fill=-1,
    )
    T_a_b: FloatArray = _column(
        "float64",
        "the measured transform: from the second vertex to the first, from the sensor to the outer frame,"
        " from the landmark to the base",
        (4, 4),
        fill=np.eye(4),
    )
    covariance: FloatArray = _column(
        "float64",
        "rotation first [rad, m]; infinite on the diagonal where nothing was measured",
        (6, 6),
        fill=np.diag([np.inf] * 6),
    )
    is_switchable: BoolArray = _column(
        "bool", "whether an optimizer may find that it is false", fill=False
    )
    switch: FloatArray = _column("float64", "0 (false) to 1 (true)", fill=1.0)
    switch_variance: FloatArray = _column("float64", "NaN: unknown", fill=_NAN)
    source: TextArray = _column("text", "the operator that measured it", fill="")
    payload: BytesArray = _column(
        "bytes", "what a kind needs beyond this; kinds of mapstream write JSON", fill=b""
    )

    def T_a_b_of(self, row: int) -> SE3:
        return SE3(self.T_a_b[row])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuSamples(Table):
    meaning: ClassVar[str] = "The raw samples behind the edges of kind `imu`."

    edge: IntArray = _column("int64", "the edge that integrates it", refers_to="edges")
    stamp_ns: IntArray = _column("int64", "[ns]")
    gyro_radps: FloatArray = _column("float64", "[rad/s]", (3,))
    accel_mps2: FloatArray = _column("float64", "specific force [m/s^2]", (3,))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observations(Table):
    meaning: ClassVar[str] = "What a sensor saw at a vertex, and of which landmark."

    vertex: IntArray = _column("int64", "the vertex it was seen from", refers_to="vertices")
    landmark: IntArray = _column(
        "int64", "what was seen; -1: not known yet", refers_to="landmarks", is_optional=True
    )
    sensor: TextArray = _column("text", "name of the sensor in the mission's set")
    offset_ns: IntArray = _column("int64", "time of the sensor after the vertex [ns]", fill=0)
    keypoint_px: Float32Array = _column(
        "float32", "x, y [px]; NaN where there is no image", (2,), fill=_NAN
    )
    p_sensor: Float32Array = _column(
        "float32",
        "3D point in the sensor's frame [m]; NaN where only a ray is known",
        (3,),
        fill=_NAN,
    )
    sigma: Float32Array = _column("float32", "standard deviation [px], of 3D points [m]", fill=1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Resources(Table):
    meaning: ClassVar[str] = "Where clouds, images and raw measurements of a vertex lie."

    id: IdArray = _column("uint8", "from the vertex's id and the place", (16,))
    vertex: IntArray = _column("int64", "the vertex it belongs to", refers_to="vertices")
    kind: TextArray = _column(
        "text", "cloud: a keyframe's points in the base frame; record: raw ..."
    )
    path: TextArray = _column("text", "a file in the map's folder, or a recording")
    topic: TextArray = _column("text", "in the recording; empty for a file", fill="")
    log_ns: IntArray = _column("int64", "log time in the recording [ns]; 0 for a file", fill=0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Journal(Table):
    meaning: ClassVar[str] = (
        "What was done to the map, in order; without times, so that runs compare."
    )

    operation: TextArray = _column("text", "name of the command")
    parameters: TextArray = _column("text", "JSON, keys sorted", fill="{}")
