"""Motion models where nothing was measured: how little they change, and how well they guess."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.order import in_canonical_order
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.ring import Ring
from mapstream.recordings.worlds.w_lid import WLidConfig, drive
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, invert, se3_exp
from mapstream.streams.messages.constraints import Constraint, OuterFrame
from mapstream.streams.messages.estimates import Odometry

pytestmark = pytest.mark.anyio

SECOND = 1_000_000_000
ICP_SIGMAS = np.array([5e-4] * 3 + [2e-3] * 3)  # [rad, m] of one registration
ABSOLUTE_SIGMAS = np.array([5e-4] * 3 + [1e-3] * 3)
FAILED = 25


@cache
def motion() -> Motion:
    return drive(Ring(150.0), WLidConfig(length_m=150.0))


async def mapped(config: dict[str, Any], **inputs: Any) -> Map:  # noqa: ANN401  # lists of messages
    """Return the map that the operator makes, not optimised."""
    checked = TrajectoryConfig.model_validate(config)
    map_ = Map.empty()
    sent = await run_operator(Trajectory(checked), config=checked, **inputs)
    for submap in sent["submaps"]:
        map_ = append_submap(map_, submap)
    return in_canonical_order(map_)


def registrations(poses: FloatArray, rng: np.random.Generator) -> list[Odometry]:
    """Return odometry at 2 Hz, summed up from noisy steps along poses (N, 4, 4)."""
    steps = (
        invert(poses[:-1]) @ poses[1:] @ se3_exp(rng.normal(size=(len(poses) - 1, 6)) * ICP_SIGMAS)
    )
    T_odom_base, messages = SE3.identity(), []
    for at, step in enumerate([np.eye(4), *steps]):
        T_odom_base = T_odom_base @ SE3(step)
        stamp_ns = at * SECOND // 2
        covariance = np.diag(ICP_SIGMAS**2)
        messages.append(Odometry(stamp_ns=stamp_ns, T_odom_base=T_odom_base, covariance=covariance))
    return messages


async def test_C4_a_registration_that_failed_moves_the_other_poses_by_less_than_a_millimetre() -> (
    None
):
    """Of 50 registrations one is missing; the null model links its poses, and pulls at nothing."""
    rng = np.random.default_rng(4)
    stamps_ns = np.arange(101, dtype=np.int64) * SECOND // 2
    poses = motion().poses(motion().start_ns + stamps_ns)
    icp = registrations(poses, rng)
    measured = [
        Constraint(
            stamp_ns=int(stamp_ns), kind="absolute", outer=OuterFrame(name="room"),
            T_a_b=SE3(pose) @ SE3.exp(rng.normal(size=6) * ABSOLUTE_SIGMAS),
            covariance=np.diag(ABSOLUTE_SIGMAS**2),
        )
        for stamp_ns, pose in zip(stamps_ns[::2], poses[::2], strict=True)
    ]  # fmt: skip
    config = {
        "sources": {"icp": {"kind": "odometry", "max_gap_s": 0.6}},
        "constraints": {"absolute": {}},
    }

    whole = await mapped(config, icp=icp, absolute=measured)
    gap = [m for m in icp if m.stamp_ns != FAILED * SECOND + SECOND // 2]
    bridged = await mapped(config, icp=gap, absolute=measured)

    kinds = bridged.edges.kind.tolist()
    assert (kinds.count("odometry"), kinds.count("motion_model")) == (49, 1)
    solved = [
        optimize_map(m, OptimizeConfig())[0].vertices.T_mission_base for m in (whole, bridged)
    ]
    moved_m = np.linalg.norm(solved[0][:, :3, 3] - solved[1][:, :3, 3], axis=1)
    assert 0 < moved_m.max() < 1e-3


async def bridged_error_m(bridge: str, start_s: int) -> float:
    """Return how far the pose behind an outage of a second lies from the truth, seen from before it."""
    first_ns = motion().start_ns
    stamps_ns = (np.arange((start_s - 2) * 10, (start_s + 3) * 10 + 1) * SECOND // 10).astype(
        np.int64
    )
    poses = motion().poses(first_ns + stamps_ns)
    known = [
        Odometry(stamp_ns=int(stamp_ns), T_odom_base=SE3(pose))
        for stamp_ns, pose in zip(stamps_ns, poses, strict=True)
        if not start_s * SECOND < stamp_ns < (start_s + 1) * SECOND
    ]
    config = {"sources": {"odometry": {"kind": "odometry", "max_gap_s": 0.5}}, "bridge": bridge}
    map_ = await mapped(config, odometry=known)
    rows = [map_.vertices.stamp_ns.tolist().index((start_s + k) * SECOND) for k in (0, 1)]
    before, after = map_.vertices.T_mission_base[rows]
    found = (invert(before) @ after)[:3, 3]
    start, end = motion().poses(np.array([start_s, start_s + 1]) * SECOND + first_ns)
    return float(np.linalg.norm(found - (invert(start) @ end)[:3, 3]))


async def test_C5_constant_velocity_bridges_a_second_better_than_standing_still() -> None:
    for start_s in (10, 25, 40):
        still = await bridged_error_m("still", start_s)
        moving = await bridged_error_m("constant_velocity", start_s)
        assert moving < still / 2
