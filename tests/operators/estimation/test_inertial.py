"""Pre-integrated IMU: closed forms, lever arms, saturation, what it is made from, and real data."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.estimation.factors.inertial import Bias, Samples, outdated, preintegrated
from mapstream.operators.estimation.fixing import fixed_keys
from mapstream.operators.estimation.kinds import make_factors
from mapstream.operators.estimation.noise import NoiseModels
from mapstream.operators.estimation.states import initial_values, velocities_of_poses, with_solution
from mapstream.operators.imu.parameters import ImuParameters
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import ImuSamples
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, rotation_from_quat_xyzw, se3_exp, so3_exp, so3_log
from tests.data import shared
from tests.operators.estimation.problems import (
    Solved,
    cov,
    disturbed,
    factors_of,
    position_errors_m,
    with_edge,
    with_mission,
    with_relative,
)

G = np.array([0.0, 0.0, -9.81])
NONE = Bias(np.zeros(3), np.zeros(3))
PARAMETERS = ImuParameters(
    gyro_density=1e-4, accel_density=1e-3, gyro_random_walk=1e-6, accel_random_walk=1e-5
)


def constant(gyro: FloatArray, accel: FloatArray, stamps_ns: IntArray) -> Samples:
    ones = np.ones((len(stamps_ns), 1))
    return Samples(stamps_ns, ones * gyro, ones * accel)


def closed_form(gyro: FloatArray, accel: FloatArray, duration_s: float) -> FloatArray:
    """R, v, p of constant rate and force as one matrix (5, 5), by its exponential."""
    from scipy.linalg import expm  # noqa: PLC0415

    generator = np.zeros((5, 5))
    generator[:3, :3] = np.cross(np.eye(3), gyro)
    generator[:3, 3], generator[3, 4] = accel, 1
    return np.asarray(expm(generator * duration_s))


vectors = st.lists(st.floats(-2, 2), min_size=3, max_size=3).map(np.array)


@settings(max_examples=30, deadline=None)
@given(vectors, vectors, st.integers(1, 9_999_999), st.integers(100_000_000, 999_999_999))
def test_F2_constant_rate_and_force_have_a_closed_form(
    gyro: FloatArray, accel: FloatArray, start_ns: int, end_ns: int
) -> None:
    """Whatever instants the span begins and ends at, between samples at 100 Hz."""
    samples = constant(gyro, 5 * accel, np.arange(0, 1_010_000_000, 10_000_000, dtype=np.int64))

    integral = preintegrated(samples, (start_ns, end_ns), PARAMETERS, NONE)

    expected = closed_form(gyro, 5 * accel, (end_ns - start_ns) / 1e9)
    np.testing.assert_allclose(integral.deltaRij().matrix(), expected[:3, :3], atol=1e-6)
    np.testing.assert_allclose(integral.deltaVij(), expected[:3, 3], atol=1e-6)
    np.testing.assert_allclose(integral.deltaPij(), expected[:3, 4], atol=1e-6)
    assert integral.deltaTij() == pytest.approx((end_ns - start_ns) / 1e9, abs=1e-12)


def test_F2_two_parts_are_the_whole() -> None:
    """Rates that change, cut between two samples: nothing is counted twice or left out."""
    t = np.arange(0, 1_000_000_001, 10_000_000, dtype=np.int64)
    gyro = np.column_stack([np.sin(t / 2e8), np.cos(t / 3e8), t / 1e9])
    samples = Samples(t, gyro, gyro[:, ::-1] * 3)

    def rates(start_ns: int, end_ns: int) -> FloatArray:
        whole = preintegrated(samples, (start_ns, end_ns), PARAMETERS, NONE)
        T = np.eye(5)
        T[:3, :3], T[:3, 3], T[:3, 4] = (
            whole.deltaRij().matrix(),
            whole.deltaVij(),
            whole.deltaPij(),
        )
        T[3, 4] = whole.deltaTij()
        return T

    np.testing.assert_allclose(
        rates(0, 413_000_000) @ rates(413_000_000, 1_000_000_000),
        rates(0, 1_000_000_000),
        atol=1e-4,
    )


class Flight:
    """A base that turns and accelerates smoothly, and what an IMU anywhere on it feels."""

    def poses(self, t: FloatArray) -> FloatArray:
        T = np.tile(np.eye(4), (len(t), 1, 1))
        T[:, :3, :3] = so3_exp(
            np.column_stack([0.4 * np.sin(1.3 * t), 0.3 * np.cos(0.9 * t), 0.8 * np.sin(0.7 * t)])
        )
        T[:, :3, 3] = np.column_stack(
            [2 * np.sin(0.5 * t), 1.5 * np.cos(0.8 * t), 0.5 * np.sin(1.1 * t)]
        )
        return T

    def pose(self, t: float) -> FloatArray:
        return np.asarray(self.poses(np.array([t]))[0])

    def samples(self, stamps_ns: IntArray, mount: SE3, bias: Bias = NONE) -> Samples:
        h, t = 1e-4, stamps_ns / 1e9
        before, now, after = (self.poses(t + dt) @ mount.matrix for dt in (-h, 0, h))
        turn = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
        felt = (after - 2 * now + before)[:, :3, 3] / h**2 - G
        accel = np.einsum("nji,nj->ni", now[:, :3, :3], felt)
        return Samples(
            stamps_ns, so3_log(turn) / (2 * h) + bias.gyro_radps, accel + bias.accel_mps2
        )

    def velocity(self, t: float) -> FloatArray:
        return np.asarray((self.pose(t + 1e-5) - self.pose(t - 1e-5))[:3, 3] / 2e-5)


@pytest.mark.parametrize("lever_m", [0.0, 0.5])
def test_F2_the_place_of_the_imu_is_taken_into_account(lever_m: float) -> None:
    """Turned and half a metre away from the base, on a base whose turns speed up and slow down."""
    mount = SE3.from_rotation(so3_exp([0.5, -1.0, 2.0]), [lever_m, -lever_m, lever_m / 2])
    place = (*mount.t.tolist(), *mount.quat_xyzw.tolist())
    flight, bias = Flight(), Bias(np.array([0.02, -0.03, 0.05]), np.array([0.1, 0.2, -0.1]))
    stamps = np.arange(0, 1_020_000_000, 5_000_000, dtype=np.int64)
    samples = flight.samples(stamps, mount, bias)
    parameters = PARAMETERS.model_copy(update={"T_base_sensor": place})

    integral = preintegrated(samples, (1_000_000, 1_001_000_000), parameters, bias)

    start = gtsam.NavState(gtsam.Pose3(flight.pose(0.001)), flight.velocity(0.001))
    end = integral.predict(start, bias.constant)
    assert np.linalg.norm(end.position() - flight.pose(1.001)[:3, 3]) < 2e-4
    assert np.linalg.norm(end.velocity() - flight.velocity(1.001)) < 5e-4
    assert np.linalg.norm(so3_log(flight.pose(1.001)[:3, :3].T @ end.attitude().matrix())) < 1e-4


def test_A1_saturated_samples_hardly_count() -> None:
    stamps = np.arange(0, 500_000_001, 10_000_000, dtype=np.int64)
    samples = constant(np.array([0, 0, 1.0]), np.array([0, 0, 9.81]), stamps)
    samples.gyro_radps[20] = [0, 0, 4.0]
    limited = PARAMETERS.model_copy(update={"max_gyro_radps": 4.0})

    free = preintegrated(samples, (0, 500_000_000), PARAMETERS, NONE).preintMeasCov()
    hit = preintegrated(samples, (0, 500_000_000), limited, NONE).preintMeasCov()

    assert hit[2, 2] > 100 * free[2, 2]
    assert not PARAMETERS.is_saturated(samples.gyro_radps, samples.accel_mps2).any()
    assert np.flatnonzero(limited.is_saturated(samples.gyro_radps, samples.accel_mps2)) == [20]


@pytest.mark.parametrize(
    ("stamps_ms", "span_ms"),
    [
        ([0, 10, 20, 2000, 2010], (5, 2005)),
        ([2000, 2010, 2020], (5, 2015)),
        ([0, 10], (5, 3000)),
        ([3000], (0, 100)),
    ],
)
def test_F2_a_gap_without_samples_is_refused(
    stamps_ms: list[int], span_ms: tuple[int, int]
) -> None:
    samples = constant(np.zeros(3), -G, np.array(stamps_ms, np.int64) * 1_000_000)

    with pytest.raises(EstimationError, match="IMU samples leave a gap of"):
        preintegrated(samples, (span_ms[0] * 1_000_000, span_ms[1] * 1_000_000), PARAMETERS, NONE)


NUM, STEP_NS = 12, 400_000_000
BIAS = Bias(np.array([0.01, -0.02, 0.015]), np.array([0.1, -0.15, 0.2]))
MOUNT = SE3.from_rotation(so3_exp([0.1, 0.2, 1.5]), [0.2, 0.1, -0.1])


@cache
def flown() -> tuple[Map, FloatArray]:
    """Vertices along the flight, linked by the IMU, and held by odometry of 1 mm and 0.5 mrad."""
    flight = Flight()
    truth = np.array([flight.pose((1 + STEP_NS * at) / 1e9) for at in range(NUM)])
    description = PARAMETERS.model_copy(
        update={"T_base_sensor": (*MOUNT.t.tolist(), *MOUNT.quat_xyzw.tolist())}
    ).description()
    map_ = with_mission(truth, sensors={"imu": description}, step_ns=STEP_NS)
    tables = []
    for at in range(NUM - 1):
        map_ = with_edge(map_, "imu", vertex_a=at, vertex_b=at + 1)
        first_ns = at * STEP_NS - 5_000_000
        stamps = np.arange(first_ns, first_ns + STEP_NS + 15_000_000, 5_000_000, dtype=np.int64)
        made = flight.samples(stamps, MOUNT, BIAS)
        tables.append((np.full(len(stamps), at), stamps, made.gyro_radps, made.accel_mps2))
    edge, stamp_ns, gyro, accel = (np.concatenate(column) for column in zip(*tables, strict=True))
    samples = ImuSamples(edge=edge, stamp_ns=stamp_ns, gyro_radps=gyro, accel_mps2=accel)
    map_ = replace(map_, imu=samples)
    pairs = [(at, at + 1) for at in range(NUM - 1)]
    return with_relative(map_, pairs, truth, cov(5e-4, 1e-3)), truth


def test_F1_F2_velocities_and_biases_are_found() -> None:
    """From no knowledge of either; samples are integrated anew as long as the biases move."""
    map_, truth = flown()
    map_ = disturbed(map_, np.random.default_rng(1), 0.02, 0.05)

    for _ in range(3):
        map_ = Solved(map_).map

    assert position_errors_m(map_, truth).max() < 0.01
    velocities = [Flight().velocity((1 + STEP_NS * at) / 1e9) for at in range(NUM)]
    np.testing.assert_allclose(map_.vertices.velocity_mps, velocities, atol=0.02)
    np.testing.assert_allclose(map_.vertices.gyro_bias_radps - BIAS.gyro_radps, 0, atol=1e-3)
    np.testing.assert_allclose(map_.vertices.accel_bias_mps2 - BIAS.accel_mps2, 0, atol=0.02)


def test_F2_biases_that_moved_ask_for_a_new_integration() -> None:
    map_, _ = flown()
    factors = factors_of(map_)
    solved = Solved(map_)

    stale = outdated(solved.map, factors)

    assert outdated(map_, factors) == []
    assert stale == list(range(NUM - 1))
    assert outdated(solved.map, factors_of(solved.map)) == []
    again = make_factors(solved.map, stale, NoiseModels())
    values = initial_values(solved.map, solved.values.keys())
    before, after = (sum(f[row].error(values) for row in stale) for f in (factors, again))
    assert after != pytest.approx(before, rel=1e-9)


def test_F2_optimisation_integrates_anew_until_the_biases_rest() -> None:
    """Nothing is left to gain from the samples once more, though the search began without biases."""
    map_, truth = flown()
    map_ = disturbed(map_, np.random.default_rng(1), 0.02, 0.05)

    optimised, report = optimize_map(map_)
    again, second = optimize_map(optimised)

    assert outdated(optimised, factors_of(optimised)) == []
    assert report.error_before > 100
    assert second.error_before < report.error_after + 0.02  # the data are exact
    assert report.error_after < 1e-2
    np.testing.assert_allclose(
        again.vertices.gyro_bias_radps, optimised.vertices.gyro_bias_radps, atol=1e-5
    )
    np.testing.assert_allclose(optimised.vertices.gyro_bias_radps - BIAS.gyro_radps, 0, atol=1e-3)
    assert position_errors_m(optimised, truth).max() < 0.01


def test_A10_biases_from_the_odometry_are_where_the_search_begins() -> None:
    map_, _ = flown()
    vertices = replace(
        map_.vertices,
        gyro_bias_radps=np.tile(BIAS.gyro_radps, (NUM, 1)),
        accel_bias_mps2=np.tile(BIAS.accel_mps2, (NUM, 1)),
    )
    given_ = replace(map_, vertices=vertices)

    without, with_biases = Solved(map_), Solved(given_)

    starts = with_solution(given_, with_biases.start).vertices
    np.testing.assert_array_equal(starts.gyro_bias_radps, vertices.gyro_bias_radps)
    np.testing.assert_array_equal(starts.accel_bias_mps2, vertices.accel_bias_mps2)
    assert with_biases.iterations <= without.iterations


def test_F2_vertices_that_do_not_follow_each_other_are_refused() -> None:
    map_, _ = flown()

    for a, b in ((0, 2), (3, 2), (4, 4)):
        wrong = with_edge(map_, "imu", vertex_a=a, vertex_b=b)
        with pytest.raises(EstimationError, match="consecutive vertices of one mission only"):
            make_factors(wrong, [len(wrong.edges) - 1], NoiseModels())


def test_F1_without_an_imu_there_are_no_velocities_and_no_biases() -> None:
    map_, _ = flown()
    poses_only = map_.select(edges=map_.edges.kind != "imu")

    solved = Solved(poses_only)

    assert solved.values.keys() == list(range(NUM))
    assert np.isnan(solved.map.vertices.velocity_mps).all()
    assert np.isnan(solved.map.vertices.gyro_bias_radps).all()
    np.testing.assert_allclose(
        velocities_of_poses(poses_only)[3], Flight().velocity(3 * STEP_NS / 1e9), atol=0.1
    )


@pytest.mark.parametrize("fix", ["poses", "velocities", "biases"])
def test_F11_states_that_are_fixed_keep_their_bits(fix: str) -> None:
    map_, _ = flown()
    map_ = Solved(disturbed(map_, np.random.default_rng(2), 0.01, 0.02)).map
    vertices = map_.vertices
    off = replace(
        vertices,
        velocity_mps=vertices.velocity_mps + 0.1,
        gyro_bias_radps=vertices.gyro_bias_radps + 0.001,
        accel_bias_mps2=vertices.accel_bias_mps2 + 0.01,
        T_mission_base=vertices.T_mission_base @ se3_exp([0.001, 0, 0, 0.01, 0, 0]),
    )
    map_ = replace(map_, vertices=off)
    keys = {key for factor in factors_of(map_).values() for key in factor.keys()}  # noqa: SIM118

    solved = Solved(map_, hold=(), fixed_keys=fixed_keys(keys, [fix])).map.vertices  # type: ignore[list-item]  # one of them

    columns = {
        "poses": ["T_mission_base"],
        "velocities": ["velocity_mps"],
        "biases": ["gyro_bias_radps", "accel_bias_mps2"],
    }
    for name, held in columns.items():
        for column in held:
            moved = not np.array_equal(getattr(solved, column), getattr(off, column))
            assert moved == (name != fix), column


def test_A1_parameters_come_from_the_mission_and_have_defaults() -> None:
    map_, _ = flown()
    louder = json.loads(map_.missions.sensors[0])
    louder["imu"]["accel_density"] *= 10
    sensors = np.array([json.dumps(louder)], dtype=object)
    loud = replace(map_, missions=replace(map_.missions, sensors=sensors))
    wrong = replace(
        map_,
        missions=replace(
            map_.missions, sensors=np.array(['{"imu": {"gyro_density": -1}}'], object)
        ),
    )

    sigmas = [
        np.sqrt(factors_of(each)[0].preintegratedMeasurements().preintMeasCov()[6, 6])
        for each in (map_, loud)
    ]

    assert sigmas[1] > 5 * sigmas[0]
    with pytest.raises(EstimationError, match="sensors' imu"):
        factors_of(wrong)
    assert (
        ImuParameters.from_description({"topic": "/imu", "max_gyro_radps": None}) == ImuParameters()
    )


def euroc() -> tuple[Samples, IntArray, FloatArray]:
    """V1_02: samples, and the truth's stamps and poses (N, 4, 4)."""
    folder = shared("euroc_v102_imu")
    lines = [line.split(",") for line in (folder / "imu_V102.txt").read_text().splitlines()[1:]]
    numbers = np.array([line[1:] for line in lines], dtype=np.float64)
    stamps = np.array([int(line[0]) for line in lines])
    truth = [
        line.split()
        for line in (folder / "gt_imu_V1_02_medium.tum.txt").read_text().splitlines()[1:]
    ]
    poses = np.tile(np.eye(4), (len(truth), 1, 1))
    values = np.array([line[1:] for line in truth], dtype=np.float64)
    poses[:, :3, :3], poses[:, :3, 3] = rotation_from_quat_xyzw(values[:, 3:]), values[:, :3]
    truth_ns = np.array([round(float(line[0]) * 1e5) * 10_000 for line in truth])
    return Samples(stamps, numbers[:, :3], numbers[:, 3:]), truth_ns, poses


def test_F2_one_second_of_a_real_imu_leads_to_where_the_truth_is() -> None:
    """EuRoC V1_02 with its constant biases: below 0.035 m and 0.2 degrees rms, 1 s windows."""
    samples, truth_ns, poses = euroc()
    bias = Bias(np.array([-0.00216, 0.02075, 0.07577]), np.array([-0.0159, 0.1061, 0.0931]))
    p = poses[:, :3, 3]
    velocity = (p[8:] - p[:-8]) / ((truth_ns[8:] - truth_ns[:-8])[:, None] / 1e9)  # of rows 4 ...
    errors_m, errors_rad, errors_mps = [], [], []
    for first in range(200, len(poses) - 401, 200):
        last = first + 200
        span = (int(truth_ns[first]), int(truth_ns[last]))
        near = slice(*np.searchsorted(samples.stamps_ns, [span[0] - 10**7, span[1] + 10**7]))
        window = Samples(
            samples.stamps_ns[near], samples.gyro_radps[near], samples.accel_mps2[near]
        )
        start = gtsam.NavState(gtsam.Pose3(poses[first]), velocity[first - 4])

        end = preintegrated(window, span, PARAMETERS, bias).predict(start, bias.constant)

        errors_m.append(np.linalg.norm(end.position() - p[last]))
        errors_mps.append(np.linalg.norm(end.velocity() - velocity[last - 4]))
        turn = poses[last, :3, :3].T @ end.attitude().matrix()
        errors_rad.append(np.linalg.norm(so3_log(turn)))

    rms = [np.sqrt(np.mean(np.square(each))) for each in (errors_m, errors_rad, errors_mps)]
    assert len(errors_m) > 75
    assert rms[0] < 0.035  # 0.029 measured
    assert np.rad2deg(rms[1]) < 0.2  # 0.10 measured
    assert rms[2] < 0.07  # 0.055 measured
