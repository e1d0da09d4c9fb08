"""Fixes as measurements on poses, from the ellipsoid to a solved map."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mapstream.operators.gnss.geodesy import GeodeticPlane
from mapstream.operators.gnss.positions import Gnss, GnssConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.sensors import GnssFix
from tests.operators.estimation.problems import (
    STEP_NS,
    Solved,
    cov,
    disturbed,
    wander,
    with_constraints,
    with_mission,
    with_relative,
)

pytestmark = pytest.mark.anyio
ORIGIN = (49.009, 8.437, 116.0)
ANTENNA = SE3.from_rotation(np.eye(3), [0.3, 0.0, 0.4])  # half a metre off the base


def fix(lla: FloatArray | tuple[float, float, float], stamp_ns: int = 1, **more: object) -> GnssFix:
    latitude, longitude, altitude = np.asarray(lla).tolist()
    return GnssFix(
        stamp_ns=stamp_ns,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=altitude,
        **more,  # type: ignore[arg-type]  # other fields
    )


async def positions(fixes: list[GnssFix], **config: object) -> list[Constraint]:
    made = await run_operator(Gnss(GnssConfig.model_validate(config)), fixes=fixes)
    return made["constraints"]


@pytest.mark.parametrize("crs", ["enu", "utm"])
@pytest.mark.parametrize("seed", range(2))
async def test_F9_A11_satellites_of_2_cm_and_a_lever_arm(seed: int, crs: str) -> None:
    """Position on Earth within 3 cm rms, of a map whose frame the satellites do not know."""
    rng = np.random.default_rng(seed)
    truth = wander(30, rng)
    room = SE3.exp([0.0, 0.0, 2.0, 100.0, -50.0, 3.0])  # of the map in the plane
    plane = GeodeticPlane.at("enu", ORIGIN)
    fixes = []
    for at, pose in enumerate(truth):
        place = (room @ SE3(pose) @ ANTENNA).t + rng.normal(0, 0.02, 3)
        fixes.append(
            fix(
                plane.to_lla(place[None])[0],
                1 + at * STEP_NS,
                covariance_enu_m2=np.eye(3) * 0.02**2,
                T_base_sensor=ANTENNA,
            )
        )
    map_ = with_relative(
        with_mission(truth), [(a, a + 1) for a in range(29)], truth, cov(0.002, 0.01), rng=rng
    )
    map_ = with_constraints(map_, await positions(fixes, crs=crs))

    solved = Solved(disturbed(map_, rng, 0.05, 0.3)).map

    frames = solved.frames
    assert frames.name.tolist() == [crs]
    assert frames.crs.tolist() == ["enu" if crs == "enu" else "EPSG:32632"]
    first = fixes[0]
    origin = [first.latitude_deg, first.longitude_deg, first.altitude_m]
    np.testing.assert_array_equal(frames.origin_lla[0], origin)
    found = GeodeticPlane.of_frame(frames.crs[0], frames.origin_lla[0])
    in_frame = np.linalg.inv(frames.T_map_frame[0]) @ solved.T_map_base(np.arange(30))
    on_earth = found.to_lla(in_frame[:, :3, 3])
    errors_m = plane.to_plane(on_earth) - (room.matrix @ truth)[:, :3, 3]
    assert np.sqrt(np.mean(np.sum(errors_m**2, axis=1))) < 0.03


async def test_F9_the_origin_is_the_first_fix_or_given() -> None:
    fixes = [fix(ORIGIN), fix((49.010, 8.437, 116.0), 2)]

    first, second = await positions(fixes)
    (given, _) = await positions(
        fixes, origin_lla=(49.008, 8.437, 116.0), is_map_frame=True, frame="city"
    )

    np.testing.assert_allclose(first.T_a_b.t, 0, atol=1e-9)
    assert second.T_a_b.t[1] == pytest.approx(111.2, abs=0.1)
    assert given.T_a_b.t[1] == pytest.approx(111.2, abs=0.1)
    assert first.outer is not None
    assert first.outer.T_map_frame is None
    assert given.outer is not None
    assert given.outer.name == "city"
    assert given.outer.T_map_frame is not None
    np.testing.assert_array_equal(given.outer.T_map_frame.matrix, np.eye(4))


async def test_F5_F6_the_covariance_is_the_messages_or_the_constant() -> None:
    own = np.diag([0.04, 0.09, 0.25])
    bad = np.zeros((3, 3))
    fixes = [
        fix(ORIGIN),
        fix(ORIGIN, 2, covariance_enu_m2=own),
        fix(ORIGIN, 3, covariance_enu_m2=bad),
    ]

    constant, measured, fallen_back = await positions(
        fixes, sigma_horizontal_m=2, sigma_vertical_m=4
    )

    np.testing.assert_allclose(constant.covariance[3:, 3:], np.diag([4, 4, 16]), atol=1e-4)
    np.testing.assert_allclose(measured.covariance[3:, 3:], own, atol=1e-6)
    np.testing.assert_allclose(fallen_back.covariance[3:, 3:], np.diag([4, 4, 16]), atol=1e-4)
    assert np.isinf(np.diagonal(measured.covariance)[:3]).all()


async def test_F9_fixes_without_a_position_are_refused_and_counted() -> None:
    nan = float("nan")
    context = Context(name="gnss")
    fixes = [
        fix((nan, nan, nan)),
        fix((0.0, 0.0, 0.0), 2),
        fix((49.0, 8.0, nan), 3),
        fix(ORIGIN, 4),
    ]
    fixes += [fix((49.0, 8.437, nan), 5), fix((149.0, 8.0, 0.0), 6)]

    made = await run_operator(Gnss(GnssConfig()), run_context=context, fixes=fixes)

    assert [c.stamp_ns for c in made["constraints"]] == [4, 5]
    flat = made["constraints"][1]
    assert np.isinf(flat.covariance[5, 5])
    assert np.isfinite(flat.covariance[3:5, 3:5]).all()
    assert sum(context.activity.losses.values()) == 4
    assert len(context.activity.losses) == 4


async def test_F8_F9_the_antenna_is_found_where_a_graph_file_asks_for_it() -> None:
    """Thought at the base, it sits half a metre off; turns in all directions show it."""
    rng = np.random.default_rng(4)
    truth = wander(40, rng)
    plane = GeodeticPlane.at("enu", ORIGIN)
    fixes = [
        fix(
            plane.to_lla(((SE3(pose) @ ANTENNA).t + rng.normal(0, 0.02, 3))[None])[0],
            1 + at * STEP_NS,
            covariance_enu_m2=np.eye(3) * 0.02**2,
        )
        for at, pose in enumerate(truth)
    ]
    place = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    mounts = {"antenna": {"T_base_sensor": place, "extrinsics_sigma_m": 1.0}}
    trajectory = TrajectoryConfig.model_validate({"mounts": mounts})
    map_ = with_mission(truth, sensors=json.loads(trajectory.described(SE3.identity())))
    pairs = [(a, a + 1) for a in range(39)]
    map_ = with_relative(map_, pairs, truth, cov(0.002, 0.01), rng=rng)
    made = await positions(fixes, sensor="antenna", origin_lla=ORIGIN, is_map_frame=True)

    solved = Solved(disturbed(with_constraints(map_, made), rng, 0.02, 0.1), hold=()).map

    found = json.loads(solved.missions.sensors[0])["antenna"]["T_base_sensor"]
    np.testing.assert_allclose(found[:3], ANTENNA.t, atol=0.05)
