"""People and furniture that was carried away leave no ghosts; what stands stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.dense.moving import MovingConfig, remove_moving
from mapstream.recordings.cloud_store import CloudStore, read_cloud
from mapstream.recordings.maps import Map, check_map
from mapstream.recordings.maps.build import add_resources, with_poses
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.worlds.orbit import orbit
from mapstream.recordings.worlds.people import PERSON
from mapstream.recordings.worlds.rgbd_camera import RgbdCameraConfig
from mapstream.recordings.worlds.w_rgbd import START_NS, T_BASE_CAMERA, WRgbdConfig, rgbd_world
from mapstream.streams.arrays import BoolArray
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import PointCloud
from tests.recordings.made_maps import MISSION, OTHER_MISSION, line_map

_CAMERA = RgbdCameraConfig(width_px=100, height_px=75)
_DURATION_S = 30.0
_CRATE, _TABLE = "crate", "table"


def _recorded(
    folder: Path, mission: str, world_config: WRgbdConfig, names: tuple[str, ...], num: int
) -> tuple[Map, list[BoolArray]]:
    """Return a map of what a camera saw at true poses, and which points are of surfaces with these names."""
    world = rgbd_world(world_config, seed=0)
    wanted = {row for row, s in enumerate(world.room.surfaces) if s.name in names}
    wanted |= {PERSON, PERSON - 1} if "person" in names else set()
    stamps_ns = np.linspace(START_NS + 10**9, START_NS + 29 * 10**9, num).astype(np.int64)
    poses = orbit(_DURATION_S, START_NS).poses(stamps_ns) @ T_BASE_CAMERA.matrix
    labels = []
    x, y = np.meshgrid(np.arange(100) - 49.5, np.arange(75) - 37)
    rays = np.stack([x, y, np.full(x.shape, 100 * 525 / 640)], axis=-1) / (100 * 525 / 640)
    with CloudStore(folder / "clouds") as store:
        for row, (stamp_ns, pose) in enumerate(zip(stamps_ns.tolist(), poses, strict=True)):
            depth_m = world.camera.take(row, stamp_ns, pose)[1].image / 1000.0
            what = world.camera.ideal_at(stamp_ns, pose).surfaces
            seen = depth_m > 0
            points = (rays * depth_m[..., None])[seen].astype(np.float32)
            store.put(f"{mission[:4]}{row}", PointCloud(stamp_ns=row, points=points))
            labels.append(np.isin(what[seen], list(wanted)))
    map_ = with_poses(line_map(num, mission), np.arange(num), poses)
    vertices = replace(map_.vertices, stamp_ns=stamps_ns + (0 if mission == MISSION else 10**12))
    paths = [f"clouds/{mission[:4]}{row}.arrow" for row in range(num)]
    made = replace(map_, vertices=vertices)
    return add_resources(made, vertex_rows=np.arange(num), kind="cloud", paths=paths), labels


def _taken_out(before: Map, after: Map, folder: Path) -> list[BoolArray]:
    """Return which points of each cloud of a map are not in that of the other."""
    taken = []
    for row in range(len(before.resources)):
        if before.resources.kind[row] != "cloud":
            continue
        same = (after.resources.vertex == before.resources.vertex[row]) & (
            after.resources.kind == "cloud"
        )
        [new] = np.flatnonzero(same)
        old, kept = (
            read_cloud(folder / map_.resources.path[at]).points
            for map_, at in ((before, row), (after, new))
        )
        left = {point.tobytes() for point in kept}
        taken.append(np.array([point.tobytes() not in left for point in old]))
    return taken


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("moving")


@pytest.mark.slow
def test_U9_people_are_taken_out_and_the_room_stays(folder: Path) -> None:
    config = WRgbdConfig(people=2, duration_s=_DURATION_S, camera=_CAMERA, texel_m=0.02)
    map_, people = _recorded(folder, MISSION, config, ("person",), 28)

    cleaned, report = remove_moving(map_, folder, MovingConfig())

    taken = np.concatenate(_taken_out(map_, cleaned, folder))
    truth = np.concatenate(people)
    assert truth.mean() > 0.05
    assert (taken & truth).sum() / taken.sum() >= 0.95  # precision
    assert (taken & truth).sum() / truth.sum() >= 0.90  # recall
    assert report.num_moving == taken.sum()
    assert check_map(cleaned) == check_map(map_)


@pytest.mark.slow
def test_U9_furniture_that_a_later_mission_does_not_see_is_gone_and_new_furniture_stays(
    folder: Path,
) -> None:
    plain = WRgbdConfig(duration_s=_DURATION_S, camera=_CAMERA, texel_m=0.02)
    before, crates = _recorded(
        folder, MISSION, plain.model_copy(update={"without": (_TABLE,)}), (_CRATE,), 20
    )
    after, tables = _recorded(
        folder, OTHER_MISSION, plain.model_copy(update={"without": (_CRATE,)}), (_TABLE,), 20
    )
    both = merge_maps([before, after])
    known = replace(both.missions, is_base_frame_known=np.array([True, True]))
    both = replace(both, missions=known)

    cleaned, _ = remove_moving(both, folder, MovingConfig())

    taken = _taken_out(both, cleaned, folder)
    old, new = np.concatenate(taken[:20]), np.concatenate(taken[20:])
    crate, table = np.concatenate(crates), np.concatenate(tables)
    assert crate.sum() > 1000
    assert table.sum() > 1000
    assert old[crate].mean() > 0.9
    assert old[~crate].mean() < 0.01
    assert new[table].mean() < 0.01


def test_a_map_without_clouds_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="the map has no clouds; see depth-clouds"):
        remove_moving(line_map(3), tmp_path, MovingConfig())
