"""What the trajectory sink leaves on disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.operator import Context
from mapstream.operators.sinks.trajectory import TrajectorySink, TrajectorySinkConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps.build import with_poses
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.maps.model import Map
from mapstream.recordings.trajectory_files import read_euroc, read_kitti, read_tum
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from tests.recordings.made_maps import MISSION, OTHER_MISSION, files_under, keyframe, line_map

pytestmark = pytest.mark.anyio

ODOMETRY = [keyframe(index).odometry for index in range(4)]


async def write(
    path: Path,
    *,
    maps: list[Map] | None = None,
    odometry: list[Odometry] | None = None,
    **config: str,
) -> Context:
    ran = Context(name="trajectory")
    sink = TrajectorySink(TrajectorySinkConfig.model_validate({"path": path, **config}))
    await run_operator(sink, run_context=ran, maps=maps or [], odometry=odometry or [])
    return ran


async def test_the_newest_map_is_written(tmp_path: Path) -> None:
    """Poses of the last map, as they are after optimisation; odometry only where there is no map."""
    map_ = line_map(5)
    moved = with_poses(
        map_, np.arange(5), SE3.exp([0, 0, 1, 2, 3, 4]).matrix @ map_.vertices.T_mission_base
    )

    await write(tmp_path / "new" / "t.tum", maps=[map_, moved], odometry=ODOMETRY)

    found = read_tum(tmp_path / "new" / "t.tum")
    np.testing.assert_array_equal(found.stamps_ns, map_.vertices.stamp_ns)
    np.testing.assert_allclose(found.poses, moved.vertices.T_mission_base, atol=1e-9)


async def test_odometry_without_a_map(tmp_path: Path) -> None:
    """The odometry's poses; one whose stamp does not increase is left out and counted."""
    late = replace(ODOMETRY[1], T_odom_base=SE3.identity())

    ran = await write(tmp_path / "t.tum", odometry=[*ODOMETRY[:3], late, ODOMETRY[3]])

    found = read_tum(tmp_path / "t.tum")
    expected = [message.T_odom_base.matrix for message in ODOMETRY]
    np.testing.assert_allclose(found.poses, expected, atol=1e-9)
    assert sum(ran.activity.warnings.values()) == 1


@pytest.mark.parametrize(("format_", "read"), [("kitti", read_kitti), ("euroc", read_euroc)])
async def test_other_formats(tmp_path: Path, format_: str, read: object) -> None:
    """The format is a word in the config."""
    await write(tmp_path / "t.txt", odometry=ODOMETRY, format=format_)

    assert callable(read)
    assert len(read(tmp_path / "t.txt")) == 4


async def test_one_file_per_mission(tmp_path: Path) -> None:
    """Their names begin with the file's and end with the mission's."""
    both = merge_maps([line_map(4, MISSION), line_map(3, OTHER_MISSION)])

    await write(tmp_path / "t.tum", maps=[both])

    found = {name: len(read_tum(tmp_path / name)) for name in files_under(tmp_path)}
    assert found == {f"t-{MISSION[:8]}.tum": 4, f"t-{OTHER_MISSION[:8]}.tum": 3}


async def test_a_run_without_poses_says_so(tmp_path: Path) -> None:
    """No file, and a warning that names it."""
    ran = await write(tmp_path / "t.tum")

    assert list(ran.activity.warnings) == [f"no pose came, so {tmp_path / 't.tum'} was not written"]
    assert not files_under(tmp_path)
