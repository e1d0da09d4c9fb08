"""Poses of a motion capture as measurements on a trajectory, up to a solved map."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.absolute.poses import AbsolutePoses, AbsolutePosesConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from tests.operators.estimation.problems import (
    STEP_NS,
    Solved,
    cov,
    disturbed,
    position_errors_m,
    wander,
    with_constraints,
    with_mission,
)

pytestmark = pytest.mark.anyio
MARKER = SE3.exp([0.2, 0.1, -0.4, 0.1, 0.2, 0.5])
ROOM = SE3.exp([0.0, 0.1, 2.0, 3.0, -4.0, 1.0])


def numbers(T: SE3) -> tuple[float, ...]:
    return (*T.t.tolist(), *T.quat_xyzw.tolist())


@pytest.mark.parametrize("is_known", [True, False])
async def test_A12_F8_a_room_with_motion_capture(is_known: bool) -> None:  # noqa: FBT001
    """Known to lie somewhere, and found; the marker is not at the base."""
    rng = np.random.default_rng(2)
    truth = wander(12, rng)
    poses = [
        Odometry(
            stamp_ns=1 + at * STEP_NS,
            T_odom_base=ROOM.inverse() @ SE3(T) @ MARKER @ SE3.exp(rng.normal(0, 0.002, 6)),
            covariance=cov(0.002, 0.002) if at % 2 else None,
        )
        for at, T in enumerate(truth)
    ]
    config = AbsolutePosesConfig(
        T_map_frame=numbers(ROOM) if is_known else None, T_base_sensor=numbers(MARKER)
    )

    made = (await run_operator(AbsolutePoses(config), poses=poses))["constraints"]

    assert [c.covariance[0, 0] for c in made[:2]] == pytest.approx([1e-4, 4e-6])
    map_ = disturbed(with_constraints(with_mission(truth), made), rng, 0.1, 0.3)
    solved = Solved(map_, hold=() if is_known else (0,)).map
    assert position_errors_m(solved, truth).max() < (0.03 if is_known else 0.06)
    assert bool(solved.frames.is_known[0]) == is_known


async def test_A12_poses_that_were_not_measured_are_left_out() -> None:
    context = Context(name="absolute_poses")
    lost = Odometry(stamp_ns=1, T_odom_base=SE3.identity(), is_lost=True)

    made = await run_operator(
        AbsolutePoses(AbsolutePosesConfig(sensor="tracker")), run_context=context, poses=[lost]
    )

    assert made["constraints"] == []
    assert context.activity.losses == {"poses that were predicted, not measured": 1}
