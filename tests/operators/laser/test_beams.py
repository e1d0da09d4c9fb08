"""Beam ends: where they hit, without the motion of the sweep."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np
import pytest

from mapstream.operators.laser.beams import beam_ends
from mapstream.recordings.worlds.w_2d import W2dConfig, w_2d, w_2d_floor
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import LaserScan2D
from mapstream.streams.trajectory import Trajectory


def test_beams_out_of_range_are_left_out() -> None:
    scan = LaserScan2D(
        stamp_ns=0,
        ranges_m=np.array([1.0, np.nan, 0.01, np.inf, 2.0], np.float32),
        angle_min_rad=0.0,
        angle_step_rad=np.pi / 2,
        range_min_m=0.1,
        range_max_m=10.0,
        T_base_sensor=SE3.from_rotation(np.eye(3), [0.5, 0.0, 0.2]),
    )

    ends = beam_ends(scan)

    assert ends.beams.tolist() == [0, 4]
    np.testing.assert_allclose(ends.points, [[1.5, 0, 0.2], [2.5, 0, 0.2]], atol=1e-9)


def turning_scans() -> Iterator[tuple[LaserScan2D, Trajectory]]:
    """Yield scans of a robot on its way into a room, with its way."""
    config = W2dConfig.model_validate({"width_m": 14, "laps": 0.2, "wheels_hz": 1.0})
    records = list(islice(w_2d(config, 0).records, 1400))
    truth = [r.message for r in records if r.topic == "/truth"]
    way = Trajectory(
        stamps_ns=np.array([m.stamp_ns for m in truth]),
        poses=np.array([m.T_odom_base.matrix for m in truth]),  # type: ignore[attr-defined]  # of that topic
    )
    for record in records:
        if isinstance(record.message, LaserScan2D) and way.covers(record.message.end_ns):
            yield record.message, way


@pytest.mark.parametrize("is_moved", [True, False])
def test_points_lie_on_walls_if_the_motion_is_known(*, is_moved: bool) -> None:
    floor = w_2d_floor(W2dConfig(width_m=14), 0)
    shares = []
    for scan, way in islice(turning_scans(), 100, 220, 10):
        ends = beam_ends(scan, way if is_moved else None)
        T = way.pose_at(ends.stamp_ns)
        points, origin = T @ ends.points, T @ scan.T_base_sensor.t
        rays = (points - origin) / np.linalg.norm(points - origin, axis=1)[:, None]
        before, behind = (floor.is_solid((points + k * rays)[:, :2]) for k in (-0.035, 0.035))
        shares.append((~before & behind).mean())

    assert bool(np.mean(shares) > 0.95) is is_moved
