"""Localisation in a map whose truth is known."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.places.drift import Drift, DriftConfig, Fix
from mapstream.operators.places.localize import Localize, LocalizeConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import Map, load_map, save_map
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose, Odometry
from mapstream.streams.messages.vision import NFrame
from tests.operators.places import made_maps, scenes

pytestmark = pytest.mark.anyio
A = "a" * 32
RIG = {"front": scenes.camera(), "rear": scenes.camera(180)}
STEP_NS = made_maps.PERIOD_NS // 4
COVARIANCE = np.diag([1e-4] * 3 + [1e-3] * 3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of one lap, whose odometry did not drift."""
    path = tmp_path_factory.mktemp("places") / "map"
    truth = made_maps.circle(made_maps.LAP)
    save_map(made_maps.flown(Map.empty(), made_maps.room(), A, truth, RIG, drift=0), path)
    return path


def _drive(num: int) -> list[SE3]:
    """Another drive through the room, a little beside the first, four poses a second."""
    poses = made_maps.circle(num // 4 + 2, first=3)
    aside = SE3.from_rotation(np.eye(3), [0.2, -0.1, 0.05])
    return [poses[k // 4].interpolate(poses[k // 4 + 1], (k % 4) / 4) @ aside for k in range(num)]


def _frame(truth: SE3, k: int) -> NFrame:
    features = tuple(
        made_maps.see(
            made_maps.room(), truth, sensor, frame=name, stamp_ns=k * STEP_NS, seed=1000 + k
        )
        for name, sensor in RIG.items()
    )
    return NFrame(stamp_ns=k * STEP_NS, features=features)


def _odometry(poses: list[SE3]) -> list[Odometry]:
    return [Odometry(stamp_ns=k * STEP_NS, T_odom_base=pose) for k, pose in enumerate(poses)]


def _error_m(pose: MapPose, truth: SE3) -> float:
    assert pose.T_map_base is not None
    return float(np.linalg.norm(pose.T_map_base.t - truth.t))


@pytest.mark.slow
async def test_H12_frames_alone_are_found_in_the_map(folder: Path) -> None:
    truth = _drive(24)
    frames = [_frame(pose, k) for k, pose in enumerate(truth)]

    out = await run_operator(Localize(LocalizeConfig(map=folder, period_s=0)), n_frames=frames)

    poses = out["poses"]
    errors = [_error_m(p, t) for p, t in zip(poses, truth, strict=True) if p.T_map_base is not None]
    assert len(errors) >= 0.9 * len(truth)
    assert np.median(errors) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(("late_s", "first", "most_m"), [(0.0, 5, 0.12), (0.6, 7, 0.18)])
async def test_H13_odometry_that_drifts_is_held_in_the_map(
    folder: Path, late_s: float, first: int, most_m: float
) -> None:
    """Frames that come later leave as much more drift: 0.1 m/s."""
    truth = _drive(40)
    odometry = _odometry(made_maps.drifted([truth[0].inverse() @ pose for pose in truth]))
    frames = [_frame(pose, k) for k, pose in enumerate(truth)]

    out = await run_operator(
        Localize(LocalizeConfig(map=folder, late_s=late_s)), odometry=odometry, n_frames=frames
    )

    poses: list[MapPose] = out["poses"]
    found = [k for k, pose in enumerate(poses) if pose.T_map_base is not None]
    assert [pose.stamp_ns for pose in poses] == [o.stamp_ns for o in odometry]
    assert found[0] <= first  # the third fix, half a second apart
    assert found == list(range(found[0], 40))
    assert {pose.state for pose in poses[found[0] :]} == {"tracking"}
    errors = [_error_m(poses[k], truth[k]) for k in found]
    assert max(errors) < most_m  # the odometry drifts by a metre
    last = poses[-1]
    assert last.covariance is not None
    assert 0 < np.sqrt(last.covariance[3, 3]) < 0.1
    assert len(out["odometry"]) == len(found)


@pytest.mark.slow
async def test_U1_a_robot_that_was_carried_elsewhere_is_recovered(folder: Path) -> None:
    truth = [*_drive(60)[:16], *_drive(60)[40:60]]
    frames = [_frame(pose, k) for k, pose in enumerate(truth)]
    steps = [a.inverse() @ b for a, b in pairwise(truth)]
    steps[15] = SE3.identity()  # the odometry did not notice
    poses_odom = [SE3.identity()]
    for step in steps:
        poses_odom.append(poses_odom[-1] @ step)

    out = await run_operator(
        Localize(LocalizeConfig(map=folder)), odometry=_odometry(poses_odom), n_frames=frames
    )

    states = [pose.state for pose in out["poses"]]
    back = states.index("recovered")
    assert states.count("recovered") == 1
    assert 16 < back <= 16 + 8  # two seconds
    assert "lost" in states[16:back]
    assert all(
        _error_m(p, t) < 0.12 for p, t in zip(out["poses"][back:], truth[back:], strict=True)
    )


async def test_U1_a_robot_elsewhere_stays_lost_with_a_reason(folder: Path) -> None:
    other = made_maps.room(seed=9)
    truth = _drive(8)
    frames = [
        NFrame(stamp_ns=k * STEP_NS, features=(made_maps.see(other, pose, RIG["front"], seed=k),))
        for k, pose in enumerate(truth)
    ]

    out = await run_operator(
        Localize(LocalizeConfig(map=folder)), odometry=_odometry(truth), n_frames=frames
    )

    assert {pose.state for pose in out["poses"]} == {"lost"}
    assert all(pose.T_map_base is None for pose in out["poses"])
    assert any("no place" in pose.verdict or "fewer" in pose.verdict for pose in out["poses"])
    assert out["odometry"] == []


async def test_localising_leaves_the_map_as_it_is(folder: Path) -> None:
    before = load_map(folder).digest()

    await run_operator(Localize(LocalizeConfig(map=folder)), n_frames=[_frame(_drive(1)[0], 0)])

    assert load_map(folder).digest() == before


@pytest.mark.slow
def test_H13_the_first_frame_does_not_wait_for_imports(folder: Path) -> None:
    script = f"""
import sys
from pathlib import Path
from mapstream.operators.places.map_places import MapPlaces
from mapstream.operators.places.recognition import RecognitionConfig
from mapstream.recordings.maps import load_map
MapPlaces(load_map(Path({str(folder)!r})), RecognitionConfig())
print("scipy.stats" in sys.modules, "scipy.sparse.csgraph" in sys.modules)
"""

    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )

    assert done.stdout.split() == ["True", "True"]


async def test_a_map_without_descriptors_is_refused(tmp_path: Path) -> None:
    save_map(Map.empty(), tmp_path / "map")

    with pytest.raises(MapError, match="no landmark with a descriptor"):
        await run_operator(Localize(LocalizeConfig(map=tmp_path / "map")), n_frames=[])


def _fix(T_map_base: SE3, T_odom_base: SE3) -> Fix:
    return Fix(0, T_map_base, COVARIANCE, T_odom_base)


def test_H13_a_smooth_pose_never_jumps_and_arrives() -> None:
    """The odometry's frame moves by no more than asked for, until it is where the fixes say."""
    drift = Drift(DriftConfig(smooth_mps=0.2, num_agreeing=1))
    drift.move(SE3.identity())
    drift.correct(_fix(SE3.identity(), SE3.identity()))
    drift.T_map_odom(0)
    aside = SE3.from_rotation(np.eye(3), [0.1, 0, 0])
    shown = []
    for k in range(1, 21):
        drift.move(SE3.identity())
        drift.correct(_fix(aside, SE3.identity()))
        T = drift.T_map_odom(k * 10**8)
        assert T is not None
        shown.append(float(T.t[0]))

    assert np.diff([0.0, *shown]).max() <= 0.2 * 0.1 + 1e-9
    assert shown[-1] > 0.06


def test_H13_uncertainty_grows_along_the_way_and_shrinks_with_a_fix() -> None:
    drift = Drift(DriftConfig(num_agreeing=1))
    drift.move(SE3.identity())
    drift.correct(_fix(SE3.identity(), SE3.identity()))
    at_first = drift.covariance[3, 3]
    ahead = SE3.from_rotation(np.eye(3), [5.0, 0, 0])
    drift.move(ahead)
    after_a_way = drift.covariance[3, 3]
    drift.correct(_fix(ahead, ahead))

    assert at_first < after_a_way
    assert drift.covariance[3, 3] < after_a_way


def test_U1_a_robot_that_recognises_nothing_for_long_is_lost() -> None:
    drift = Drift(DriftConfig(num_agreeing=1, lost_sigma_m=0.5))
    drift.move(SE3.identity())
    drift.correct(_fix(SE3.identity(), SE3.identity()))
    for k in range(400):
        drift.move(SE3.from_rotation(np.eye(3), [float(k), 0, 0]))

    assert drift.is_lost
    assert drift.T_map_odom(0) is None


def test_one_false_fix_is_not_believed() -> None:
    drift = Drift(DriftConfig(num_agreeing=2))
    drift.move(SE3.identity())
    for _ in range(2):
        drift.correct(_fix(SE3.identity(), SE3.identity()))
    drift.correct(_fix(SE3.from_rotation(np.eye(3), [3.0, 0, 0]), SE3.identity()))
    drift.correct(_fix(SE3.identity(), SE3.identity()))

    T = drift.T_map_odom(0)
    assert T is not None
    assert np.linalg.norm(T.t) < 1e-9
    assert not drift.is_lost
