"""What the cloud sink leaves on disk."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.operator import Context
from mapstream.operators.sinks.cloud import CloudSink, CloudSinkConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.cloud_files import read_pcd, read_ply
from mapstream.recordings.maps.build import with_poses
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.worlds.box_room import box_room, drive_through
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import (
    Keyframe,
    Odometry,
    PointCloud,
    RelativePose,
    Submap,
)
from tests.recordings.made_maps import MISSION, files_under, line_map, submaps

pytestmark = pytest.mark.anyio


async def write(path: Path, maps: list[Map], parts: list[Submap], **config: float | str) -> Context:
    ran = Context(name="cloud")
    sink = CloudSink(CloudSinkConfig.model_validate({"path": path, **config}))
    await run_operator(sink, run_context=ran, maps=maps, submaps=parts)
    return ran


def room_submap(drift_m: float) -> tuple[Submap, np.ndarray]:
    """Keyframes in the box room whose odometry drifts to the side, and their true poses (N, 4, 4)."""
    drive = drive_through(box_room(3, num_boxes=0), num_scans=6, speed_mps=0.0)
    keyframes = []
    for index, scan in enumerate(drive.scans):
        T = SE3.from_rotation(np.eye(3), [0, index * drift_m, 0])
        cloud = PointCloud(stamp_ns=scan.stamp_ns, points=scan.points, intensity=scan.intensity)
        odometry = Odometry(stamp_ns=scan.stamp_ns, T_odom_base=T)
        keyframes.append(Keyframe(stamp_ns=scan.stamp_ns, odometry=odometry, cloud=cloud))
    edges = tuple(
        RelativePose(
            kind="odometry",
            mission_a=MISSION,
            stamp_a_ns=a.stamp_ns,
            mission_b=MISSION,
            stamp_b_ns=b.stamp_ns,
            T_a_b=a.odometry.T_odom_base.inverse() @ b.odometry.T_odom_base,
            covariance=np.eye(6),
        )
        for a, b in pairwise(keyframes)
    )
    submap = Submap(mission_id=MISSION, index=0, keyframes=tuple(keyframes), edges=edges)
    return submap, drive.truth.at([keyframe.stamp_ns for keyframe in keyframes])


def wall_thickness(points: np.ndarray) -> float:
    """Standard deviation about the room's wall at y = 6 m."""
    near = points[(points[:, 1] > 4) & (np.abs(points[:, 0]) < 4) & (np.abs(points[:, 2]) < 0.4)]
    assert len(near) > 50
    return float(np.std(near[:, 1] - 6))


async def test_O2_walls_are_thin_where_the_optimised_poses_put_them(tmp_path: Path) -> None:
    """Odometry that drifts 0.2 m a keyframe smears a wall; the corrected map makes it 1 cm thin."""
    submap, true_poses = room_submap(0.2)
    drifted = append_submap(Map.empty(), submap)
    corrected = with_poses(drifted, np.arange(6), true_poses)

    await write(tmp_path / "drifted.ply", [drifted], [submap], voxel_size_m=0.05)
    await write(tmp_path / "corrected.ply", [drifted, corrected], [submap], voxel_size_m=0.05)

    assert wall_thickness(read_ply(tmp_path / "drifted.ply").points) > 0.2
    assert wall_thickness(read_ply(tmp_path / "corrected.ply").points) < 0.03


async def test_a_shared_keyframe_counts_once_and_little_memory_is_enough(tmp_path: Path) -> None:
    """Nine keyframes of 50 points in voxels too small to join any; clouds come back from disk."""
    parts = submaps([3, 6, 8], with_clouds=True)

    await write(tmp_path / "c.pcd", [line_map(9)], parts, voxel_size_m=1e-4, max_bytes=1)

    cloud = read_pcd(tmp_path / "c.pcd")
    assert len(cloud.points) == 9 * 50
    assert cloud.intensity is not None


async def test_the_format_may_differ_from_the_name(tmp_path: Path) -> None:
    """`format` wins over the suffix."""
    await write(tmp_path / "c.xyz", [line_map(3)], submaps([3], with_clouds=True), format="pcd")

    assert len(read_pcd(tmp_path / "c.xyz").points) > 0


@pytest.mark.parametrize("missing", ["map", "cloud"])
async def test_a_run_without_maps_or_clouds_says_so(tmp_path: Path, missing: str) -> None:
    """No file, and a warning that names what is missing."""
    parts = submaps([3], with_clouds=missing == "map")

    ran = await write(tmp_path / "c.ply", [] if missing == "map" else [line_map(3)], parts)

    assert list(ran.activity.warnings) == [
        f"no {missing} came, so {tmp_path / 'c.ply'} was not written"
    ]
    assert not files_under(tmp_path)
