"""States that a solver must not move, by kind; and kinds of edges from other packages."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.factors import planes
from mapstream.operators.estimation.fixing import Fixable
from mapstream.operators.estimation.kinds import make_factors, makers, register
from mapstream.operators.estimation.noise import NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, LandmarkRef, OuterFrame
from tests.installed import look_installed
from tests.operators.estimation.problems import (
    STEP_NS,
    cov,
    disturbed,
    wander,
    with_constraints,
    with_mission,
    with_relative,
)

EXAMPLE = Path(__file__).parent / "height_plugin"
NUM = 8
STATES: dict[str, Callable[[Map], FloatArray]] = {
    "poses": lambda m: m.vertices.T_mission_base,
    "frames": lambda m: m.frames.T_map_frame,
    "extrinsics": lambda m: np.array(json.loads(m.missions.sensors[0])["tracker"]["T_base_sensor"]),
}


def everything() -> tuple[Map, FloatArray]:
    """Poses with landmarks of each shape, and a tracker whose place and whose room are to be found."""
    rng = np.random.default_rng(1)
    truth = wander(NUM, rng)
    thought = SE3.exp([0.05, 0, 0, 0.1, 0, 0.2])
    place = [*thought.t.tolist(), *thought.quat_xyzw.tolist()]
    sensors = {"tracker": {"T_base_sensor": place, "is_extrinsics_estimated": True}}
    map_ = with_mission(truth, sensors=sensors)
    map_ = with_relative(
        map_, [(a, a + 1) for a in range(NUM - 1)], truth, cov(0.01, 0.02), rng=rng
    )
    made = []
    for at, pose in enumerate(truth):
        noisy = SE3(pose) @ SE3.exp(rng.normal(0, 0.01, 6))
        tracked = SE3.exp([0, 0, 1, 2, 3, 0]) @ noisy @ SE3.exp([0, 0, 0, 0.1, 0.05, 0.2])
        made.append(
            _seen(
                at,
                "absolute",
                tracked,
                payload=b'{"sensor": "tracker"}',
                outer=OuterFrame(name="room"),
            )
        )
        made.append(_seen(at, "absolute", noisy))
        for kind in ("point", "point2d", "pose", "plane"):
            where = SE3(np.linalg.inv(pose)) @ SE3.exp([0.2, 0.1, 0, 5.0, 2.0, 1.0 + len(kind)])
            if kind == "point2d":
                where = SE3.from_rotation(
                    np.eye(3), where.t - where.t[2] / pose[2, 2] * pose[2, :3]
                )
            ref = LandmarkRef(name=kind, kind=kind)
            seen = where @ SE3.exp(rng.normal(0, 0.01, 6))
            made.append(_seen(at, "plane" if kind == "plane" else "landmark", seen, landmark=ref))
    return disturbed(with_constraints(map_, made), rng, 0.02, 0.05), truth


def _seen(at: int, kind: str, T: SE3, **more: object) -> Constraint:
    stamp_ns = 1 + at * STEP_NS
    return Constraint(stamp_ns=stamp_ns, kind=kind, T_a_b=T, covariance=cov(0.01, 0.02), **more)  # type: ignore[arg-type]  # other fields


def landmarks_in_map(map_: Map) -> dict[str, FloatArray]:
    """What each shape has in the map: a line along z has no height, a point no axes."""
    places = dict(zip(map_.landmarks.kind, map_.T_map_landmark(np.arange(4)), strict=True))
    return {
        "point": places["point"][:3, 3],
        "point2d": places["point2d"][:2, 3],
        "pose": places["pose"],
        "plane": planes.coefficients(places["plane"]),
    }


@pytest.mark.parametrize("fix", ["poses", "landmarks", "frames", "extrinsics"])
def test_F11_what_is_fixed_keeps_its_bits_and_the_rest_moves(fix: Fixable) -> None:
    """Landmarks are kept where they are in the map; rounding is all that moves them, in their base."""
    map_, _ = everything()

    solved, report = optimize_map(map_, OptimizeConfig(fix=(fix,)))

    assert report.error_after < report.error_before
    for name, state in STATES.items():
        assert np.array_equal(state(solved), state(map_)) == (name == fix), name
    before, after = landmarks_in_map(map_), landmarks_in_map(solved)
    for shape, place in before.items():
        moved = np.abs(after[shape] - place).max()
        assert moved < 1e-9 if fix == "landmarks" else moved > 1e-6, shape


@pytest.mark.parametrize("half", ["extrinsics_rotation", "extrinsics_translation"])
def test_F11_half_of_the_extrinsics_stays(half: Fixable) -> None:
    map_, _ = everything()
    halves = {"extrinsics_rotation": slice(3, 7), "extrinsics_translation": slice(0, 3)}
    before = STATES["extrinsics"](map_)

    solved, _ = optimize_map(map_, OptimizeConfig(fix=(half,)))

    after = STATES["extrinsics"](solved)
    for name, part in halves.items():
        assert np.array_equal(after[part], before[part]) == (name == half), name


@pytest.mark.parametrize("fix", [(), ("base_frames",)])
def test_F11_a_guessed_base_frame_stays_if_it_is_fixed(fix: tuple[Fixable, ...]) -> None:
    map_, _ = everything()
    unknown = replace(map_.missions, is_base_frame_known=np.array([False]))
    map_ = replace(map_, missions=unknown)

    solved, _ = optimize_map(map_, OptimizeConfig(fix=fix))

    stayed = np.array_equal(solved.missions.T_map_mission, map_.missions.T_map_mission)
    assert stayed == bool(fix)
    np.testing.assert_allclose(
        solved.T_map_base(np.arange(NUM)),
        optimize_map(map_)[0].T_map_base(np.arange(NUM)),
        atol=1e-9,
    )


def test_F11_all_at_once_leaves_the_map_as_it_is() -> None:
    map_, _ = everything()

    solved, _ = optimize_map(map_, OptimizeConfig(fix=get_args(Fixable)))

    assert solved.digest() == map_.digest()


@pytest.mark.slow
def test_F18_a_package_adds_a_kind_of_edges(tmp_path: Path) -> None:
    """A height difference between poses at two times: a factor of the package's own, no line of the core."""
    site = look_installed(tmp_path / "site", [EXAMPLE / "pyproject.toml"])
    program = EXAMPLE / "solve.py"

    done = subprocess.run(
        [sys.executable, str(program)],
        env={"PYTHONPATH": f"{site}", "PATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    kinds, height_m = done.stdout.split()
    assert kinds == "height_difference:1"
    assert float(height_m) == pytest.approx(3.0, abs=1e-3)


def test_F18_a_kind_has_one_maker() -> None:
    with pytest.raises(ValueError, match="'loop' have a maker already"):
        register("loop", makers()["odometry"])


def test_kinds_that_nobody_knows_are_passed_over() -> None:
    map_ = with_mission(wander(2, np.random.default_rng(1)))
    map_ = with_relative(map_, [(0, 1)], map_.vertices.T_mission_base, cov(0.1, 0.1), kind="magic")

    assert make_factors(map_, [0], NoiseModels()) == {}
