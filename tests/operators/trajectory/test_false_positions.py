"""Positions of which some are false, on a drive that only an IMU leads along."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.backend.live_map import LiveMap
from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.outliers.fix_judge import FixJudge, without_false_fixes
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.constraints import Constraint, OuterFrame
from mapstream.streams.messages.estimates import Submap
from mapstream.streams.messages.sensors import ImuBatch
from tests.operators.trajectory.drives import MS

pytestmark = [pytest.mark.anyio, pytest.mark.slow]

SECONDS, SIGMA_M, SHIFT_M = 40, 0.1, 20.0
R_GPS = so3_exp([0.0, 0.0, 2.0])  # the robot does not head along the frame
_T_S = np.arange(0.0, SECONDS + 1.0, 0.02)
_YAW = 0.8 * np.sin(0.3 * _T_S) + 0.1 * _T_S
_SPEED_MPS = 3.0 + 1.5 * np.sin(0.5 * _T_S)
_PATH_M = np.cumsum(
    0.02 * _SPEED_MPS[:, None] * np.column_stack([np.cos(_YAW), np.sin(_YAW), 0 * _YAW]), axis=0
)


def imu(first: int) -> ImuBatch:
    """Return ten samples of a car that speeds up and turns."""
    part, step = slice(first, first + 10), 0.02
    turn, force = np.gradient(_YAW, step)[part], np.gradient(_SPEED_MPS, step)[part]
    rest = np.zeros(len(turn))
    return ImuBatch(
        stamps_ns=np.round(_T_S[part] * 1e9).astype(np.int64),
        gyro_radps=np.column_stack([rest, rest, turn]),
        accel_mps2=np.column_stack([force, turn * _SPEED_MPS[part], rest + 9.81]),
    )


def at(stamps_ns: FloatArray | IntArray | int) -> FloatArray:
    """Return where the car is (N, 3), in the frame of the positions."""
    stamps_s = np.atleast_1d(stamps_ns) / 1e9
    found = [np.interp(stamps_s, _T_S, _PATH_M[:, axis]) for axis in range(3)]
    return np.column_stack(found) @ R_GPS.T


def position(second: int, shift: FloatArray | None = None) -> Constraint:
    noise = np.random.default_rng(second).normal(scale=SIGMA_M, size=3)
    p = at(second * 1000 * MS)[0] + noise + (0 if shift is None else shift)
    return Constraint(
        stamp_ns=second * 1000 * MS,
        kind="position",
        T_a_b=SE3.from_rotation(np.eye(3), p),
        covariance=np.diag([np.inf] * 3 + [SIGMA_M**2] * 3),
        outer=OuterFrame(name="gps"),
        source="gps",
    )


async def submaps(false: dict[int, FloatArray]) -> list[Submap]:
    """Return a drive whose positions at these seconds are shifted."""
    config = TrajectoryConfig.model_validate(
        {"imu": {"gyro_density": 1e-3, "accel_density": 0.02}, "constraints": {"positions": {}}}
        | {"submap_s": 5.0}
    )
    sent = await run_operator(
        Trajectory(config),
        config=config,
        imu=[imu(first) for first in range(0, len(_T_S) - 10, 10)],
        positions=[position(s, false.get(s)) for s in range(1, SECONDS)],
    )
    found: list[Submap] = sent["submaps"]
    return found


def mapped(drive: list[Submap], *, rejects: bool) -> LiveMap:
    live = LiveMap(OptimizeConfig(underconstrained="prior", reject_absolute=rejects))
    for submap in drive:
        live.append(submap)
    return live


def left_out(map_: Map) -> set[int]:
    """Return the seconds of the positions that are switched off."""
    rows = map_.edges_of("position")
    off = rows[map_.edges.switch[rows] < 0.5]
    seconds: list[int] = (map_.vertices.stamp_ns[map_.edges.vertex_a[off]] // (1000 * MS)).tolist()
    return set(seconds)


def error_m(map_: Map) -> float:
    rows = map_.vertices_of(0)
    T_gps_base = np.linalg.inv(map_.frames.T_map_frame[0]) @ map_.T_map_base(rows)
    truth = at(map_.vertices.stamp_ns[rows])
    return float(np.sqrt(((T_gps_base[:, :3, 3] - truth) ** 2).sum(axis=1).mean()))


def any_way(rng: np.random.Generator) -> FloatArray:
    angle = rng.uniform(0, 2 * np.pi)
    return SHIFT_M * np.array([np.cos(angle), np.sin(angle), 0.0])


async def test_K9_no_position_is_judged_unless_that_was_asked_for() -> None:
    live = mapped(await submaps({3: np.array([0.0, SHIFT_M, 0.0])}), rejects=False)
    assert left_out(live.map) == set()
    live.finish()
    assert left_out(live.map) == set()


async def test_K9_false_positions_one_after_another_do_not_lock_out_those_after_them() -> None:
    shift = np.array([SHIFT_M, 0.0, 0.0])
    false = {1: -shift, 2: shift} | dict.fromkeys(range(14, 22), shift)
    live = mapped(await submaps(false), rejects=True)

    report = live.finish()

    assert left_out(live.map) == set(false)
    assert len(report.rejected_absolute) == len(false)
    assert error_m(live.map) < 0.3


async def test_K9_a_position_that_is_not_yet_confirmed_stays_out_of_the_live_map() -> None:
    drive = await submaps({second: np.array([0.0, SHIFT_M, 0.0]) for second in (28, 29)})
    live = mapped(drive[:6], rejects=True)  # up to 30 s

    assert {28, 29} <= left_out(live.map)
    before_m = error_m(live.map)
    for submap in drive[6:]:
        live.append(submap)
    live.finish()
    assert left_out(live.map) == {28, 29}
    assert before_m < 1.0
    assert error_m(live.map) < 0.3


async def test_K9_verdicts_on_a_stored_map_do_not_depend_on_what_was_false() -> None:
    clean = mapped(await submaps({}), rejects=True)
    clean.finish()
    assert left_out(clean.map) == set()
    rows = clean.map.edges_of("position")
    for seed in range(3):
        rng = np.random.default_rng(seed)
        chosen = rng.choice(rows, round(0.3 * len(rows)), replace=False)
        T_a_b = clean.map.edges.T_a_b.copy()
        T_a_b[chosen, :3, 3] += [any_way(rng) for _ in chosen]
        lying = replace(clean.map, edges=replace(clean.map.edges, T_a_b=T_a_b))

        judged, rejection = without_false_fixes(lying)
        solved, report = optimize_map(
            lying, OptimizeConfig(underconstrained="prior", reject_absolute=True)
        )

        assert rejection.rejected == sorted(chosen.tolist()) == report.rejected_absolute
        assert rejection.num_fixes == len(rows)
        np.testing.assert_array_equal(judged.edges.switch, solved.edges.switch)
        assert error_m(solved) < 0.3


async def test_K9_what_comes_late_is_judged_as_if_it_had_been_in_time() -> None:
    drive = await submaps({12: np.array([SHIFT_M, 0.0, 0.0])})
    live = mapped(drive, rejects=True)
    whole, rows = live.map, live.map.edges_of("position")
    late = rows[whole.vertices.stamp_ns[whole.edges.vertex_a[rows]] == 20_000 * MS]
    kind = whole.edges.kind.copy()
    kind[late] = "unknown"
    judge = FixJudge()

    before = judge.verdicts(replace(whole, edges=replace(whole.edges, kind=kind)), is_whole=True)

    assert len(before) == len(rows) - 1
    assert judge.verdicts(whole) == FixJudge().verdicts(whole)
    assert judge.verdicts(whole, is_whole=True).keys() == set(rows.tolist())
