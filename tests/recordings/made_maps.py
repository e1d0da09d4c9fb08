"""Maps and submaps made by hand, for tests of what maps can do."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.detections import rows_of
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.projections import DescriptorProjection, with_projection
from mapstream.recordings.maps.semantic_tables import Regions
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.maps.tables import (
    Edges,
    FeatureSets,
    Frames,
    ImuSamples,
    Landmarks,
    Observations,
)
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import (
    Keyframe,
    Odometry,
    PointCloud,
    RelativePose,
    Submap,
)
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import RecordRef

MISSION, OTHER_MISSION = "0f" * 16, "a0" * 16
STEP_NS = 500_000_000
STEP = SE3.exp([0.0, 0.01, 0.05, 1.0, 0.0, 0.02])
COVARIANCE = np.diag([1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2])


def keyframe(index: int, *, with_cloud: bool = False) -> Keyframe:
    """The index-th keyframe of a robot that goes on by the same step."""
    stamp_ns = 1_000 + index * STEP_NS
    pose = SE3(np.linalg.matrix_power(STEP.matrix, index))
    cloud = None
    if with_cloud:
        points = np.random.default_rng(index).normal(size=(50, 3)).astype(np.float32)
        cloud = PointCloud(stamp_ns=stamp_ns, points=points, intensity=points[:, 0])
    odometry = Odometry(
        stamp_ns=stamp_ns, T_odom_base=pose, velocity_mps=pose.R @ np.array([2.0, 0, 0])
    )
    record = RecordRef(path="drive.mcap", topic="/points", log_ns=stamp_ns + 5)
    return Keyframe(stamp_ns=stamp_ns, odometry=odometry, cloud=cloud, records=(record,))


def edge(a: Keyframe, b: Keyframe, mission: str = MISSION) -> RelativePose:
    return RelativePose(
        kind="odometry",
        mission_a=mission,
        stamp_a_ns=a.stamp_ns,
        mission_b=mission,
        stamp_b_ns=b.stamp_ns,
        T_a_b=a.odometry.T_odom_base.inverse() @ b.odometry.T_odom_base,
        covariance=COVARIANCE,
        source="odometry",
    )


def submaps(cuts: list[int], mission: str = MISSION, *, with_clouds: bool = False) -> list[Submap]:
    """Submaps that end at these keyframes; each but the first begins where the one before ends."""
    made = []
    for index, (start, end) in enumerate(zip([0, *cuts], cuts, strict=False)):
        frames = tuple(keyframe(i, with_cloud=with_clouds) for i in range(start, end + 1))
        edges = tuple(edge(a, b, mission) for a, b in pairwise(frames))
        made.append(Submap(mission_id=mission, index=index, keyframes=frames, edges=edges))
    return made


def line_map(num_vertices: int, mission: str = MISSION) -> Map:
    """A map of one mission with odometry edges between neighbours."""
    [submap] = submaps([num_vertices - 1], mission)
    return append_submap(Map.empty(), submap, mission_name="line")


def full_map() -> Map:
    """A clean map with something in every table but the journal."""
    map_ = line_map(6)
    imu_rows = np.arange(5)
    imu = Edges(
        kind=np.array(["imu"] * 5, dtype=object),
        vertex_a=imu_rows,
        vertex_b=imu_rows + 1,
    )
    map_ = append_edges(map_, imu)
    first_imu = len(map_.edges) - 5
    start_ns = map_.vertices.stamp_ns[imu_rows]
    samples = ImuSamples(
        edge=np.repeat(first_imu + imu_rows, 3),
        stamp_ns=(start_ns[:, None] + np.array([0, STEP_NS // 2, STEP_NS])).reshape(-1),
        gyro_radps=np.zeros((15, 3)),
        accel_mps2=np.tile([0.0, 0.0, 9.81], (15, 1)),
    )
    landmarks = Landmarks(
        id=id_array(derived_id("landmark", n) for n in range(4)),
        kind=np.array(["visual", "visual", "lidar", "object"], dtype=object),
        label=np.array(["", "", "", "chair"], dtype=object),
        vertex=np.array([0, 1, 1, 2]),
        p_base=np.arange(12.0).reshape(4, 3),
        covariance=np.tile(np.eye(3) * 0.01, (4, 1, 1)),
        payload=np.array([b"", b"", b"", b"\x00\xffhull"], dtype=object),
    )
    feature_sets = FeatureSets(
        vertex=np.array([0, 1]),
        sensor=np.array(["camera", "camera"], dtype=object),
        kind=np.array(["orb", "sift"], dtype=object),
        dtype=np.array(["uint8", "float32"], dtype=object),
        width=np.array([2, 1]),
        descriptors=np.array([b"\x01\x02", np.ones(2, np.float32).tobytes()], dtype=object),
    )
    observations = Observations(
        vertex=np.array([0, 1, 2, 3, 3]),
        landmark=np.array([0, 0, 2, 3, -1]),
        sensor=np.array(["camera", "camera", "lidar", "camera", "camera"], dtype=object),
        keypoint_px=np.ones((5, 2), dtype=np.float32),
        kind=np.array(["orb", "sift", "", "object", ""], dtype=object),
        label=np.array(["", "", "", "chair", ""], dtype=object),
        track=np.array([7, -1, -1, -1, -1]),
        feature_set=np.array([0, 1, -1, -1, -1]),
        feature=np.array([0, 1, -1, -1, -1]),
    )
    frames = Frames(
        id=id_array([derived_id("frame", "enu")]),
        name=np.array(["enu"], dtype=object),
        origin_lla=np.array([[47.3, 8.5, 410.0]]),
    )
    map_ = replace(
        map_,
        frames=frames,
        imu=samples,
        landmarks=landmarks,
        feature_sets=feature_sets,
        observations=observations,
    )
    objects = ObjectDetections(
        stamp_ns=0,
        frame="camera",
        width_px=64,
        height_px=48,
        boxes_px=np.array([[2.2, 3.0, 8.0, 9.5]], np.float32),
        labels=("chair",),
        scores=np.ones(1, np.float32),
        masks=(np.eye(7, 7, dtype=bool),),
        mask_sources=("depth",),
        points_m=(np.ones((5, 3), np.float32),),
    )
    regions = Regions(
        id=id_array([derived_id("region", "room", "hall")]),
        name=np.array(["hall"], dtype=object),
        vertex=np.array([1]),
        outline=np.array([np.zeros((3, 3)).tobytes()], dtype=object),
    )
    map_ = replace(map_, detections=rows_of(objects, 3), regions=regions)
    mean, matrix = np.zeros(2, np.float32), np.ones((2, 1), np.float32)
    map_ = with_projection(map_, DescriptorProjection("sift", "compression", mean, matrix))
    fix = Edges(
        kind=np.array(["absolute"], dtype=object), vertex_a=np.array([2]), frame=np.array([0])
    )
    return append_edges(map_, fix)


def files_under(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
