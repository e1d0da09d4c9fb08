"""IMU samples between two poses as one factor, with the biases of both as variables.

Between samples the rates are their mean, and over such a step the motion is exact: the increments live in the
group of Galilean transforms. Source: Fornasier et al., Equivariant symmetries for inertial navigation systems,
2024; Forster et al., On-manifold preintegration, T-RO 2017, for how biases correct an integral afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from mapstream.operators.estimation.factors.edge_ends import edge_name, require_ends
from mapstream.operators.estimation.factors.mounts import sensors_of
from mapstream.operators.estimation.factors.payloads import pose_from_numbers
from mapstream.operators.estimation.keys import key_of
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.operators.imu.parameters import ImuParameters
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError

_SATURATED = 100.0  # times the noise of a sample that hit its limit
_MAX_GAP_NS = 1_000_000_000  # without a sample; whoever makes edges may ask for less
_INTEGRATION_M = 1e-4  # [m/sqrt(s)] of the integration itself


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Consecutive samples in the axes of the IMU."""

    stamps_ns: IntArray  # (N,) not decreasing
    gyro_radps: FloatArray  # (N, 3)
    accel_mps2: FloatArray  # (N, 3) specific force


@dataclass(frozen=True, slots=True, eq=False)
class Bias:
    """Of gyroscope and accelerometer, (3,) each."""

    gyro_radps: FloatArray
    accel_mps2: FloatArray

    @property
    def constant(self) -> Any:  # noqa: ANN401  # gtsam's
        return gtsam.imuBias.ConstantBias(self.accel_mps2, self.gyro_radps)


def imu(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:  # noqa: ARG001
    """Return factors on two consecutive vertices of one mission: their poses, velocities and biases.

    Raises:
        EstimationError: If the vertices are not consecutive, samples are missing, or the IMU's description
            is not one.
    """
    _require_consecutive(map_, rows)
    samples = _samples(map_, rows)
    missions = map_.vertices.mission[map_.edges.vertex_a[rows]]
    parameters = {m: parameters_of(map_, m) for m in np.unique(missions).tolist()}
    factors = {}
    for row, mission in zip(rows.tolist(), missions.tolist(), strict=True):
        a, b = int(map_.edges.vertex_a[row]), int(map_.edges.vertex_b[row])
        start_ns, end_ns = map_.vertices.stamp_ns[[a, b]].tolist()
        try:
            integral = preintegrated(
                samples[row], (start_ns, end_ns), parameters[mission], bias_of(map_, a)
            )
        except EstimationError as error:
            raise EstimationError(f"{edge_name(map_, row)}: {error}") from error
        v_a, v_b, b_a, b_b = (
            *(key_of("velocity", vertex) for vertex in (a, b)),
            *(key_of("bias", vertex) for vertex in (a, b)),
        )
        factors[row] = gtsam.GalileanCombinedImuFactor(a, v_a, b, v_b, b_a, b_b, integral)
    return factors


def parameters_of(map_: Map, mission_row: int) -> ImuParameters:
    """Return the parameters of a mission's IMU, where it has none those of a middling one.

    Raises:
        EstimationError: If the mission's description of it is not one.
    """
    description = sensors_of(map_, mission_row).get("imu", {})
    try:
        return ImuParameters.from_description(description)
    except ValueError as error:
        mission = map_.mission_id(mission_row)
        raise EstimationError(f"mission {mission}: its sensors' imu: {error}") from error


def bias_of(map_: Map, vertex: int) -> Bias:
    """Return the biases of a vertex; those that are not known are zero."""
    vertices = map_.vertices
    return Bias(
        np.nan_to_num(vertices.gyro_bias_radps[vertex]),
        np.nan_to_num(vertices.accel_bias_mps2[vertex]),
    )


def preintegrated(
    samples: Samples, span_ns: tuple[int, int], parameters: ImuParameters, bias: Bias
) -> Any:  # noqa: ANN401  # gtsam's
    """Return the motion of the base over a span, free of where it begins (gtsam's preintegration).

    The samples need not lie at the ends of the span: between two they are interpolated, and beyond the first
    and the last one they are held for a short while.

    Raises:
        EstimationError: If a gap between samples, or at an end, is too long.
    """
    knots_ns, gyro, accel = _at_knots(samples, span_ns)
    T_base_sensor = pose_from_numbers(list(parameters.T_base_sensor))
    hit = parameters.is_saturated(samples.gyro_radps, samples.accel_mps2).astype(np.float64)
    is_hit = np.interp(knots_ns, samples.stamps_ns, hit) > 0
    accel = _at_base(knots_ns, gyro - bias.gyro_radps, accel, T_base_sensor)
    settings = _Settings(parameters, T_base_sensor)
    integral = gtsam.PreintegratedCombinedMeasurementsG(settings.params, bias.constant)
    steps_s = np.diff(knots_ns) / 1e9
    mean_gyro, mean_accel = (gyro[1:] + gyro[:-1]) / 2, (accel[1:] + accel[:-1]) / 2
    hits = is_hit[1:] | is_hit[:-1]
    for step_s, rate, force, saturated in zip(steps_s, mean_gyro, mean_accel, hits, strict=True):
        settings.use(saturated=bool(saturated))
        integral.integrateMeasurement(force, rate, step_s)
    settings.use(saturated=False)
    return integral


class _Settings:
    """gtsam's parameters, whose noise can be raised for single samples."""

    def __init__(self, parameters: ImuParameters, T_base_sensor: FloatArray) -> None:
        self.params = gtsam.PreintegrationCombinedParams.MakeSharedU(parameters.gravity_mps2)
        self.params.setIntegrationCovariance(np.eye(3) * _INTEGRATION_M**2)
        self.params.setBiasAccCovariance(np.eye(3) * parameters.accel_random_walk**2)
        self.params.setBiasOmegaCovariance(np.eye(3) * parameters.gyro_random_walk**2)
        if not np.array_equal(T_base_sensor[:3, :3], np.eye(3)):
            # gtsam's own lever arm forgets turns that speed up; `_at_base` takes it out instead
            turned = gtsam.Pose3(gtsam.Rot3(T_base_sensor[:3, :3]), np.zeros(3))
            self.params.setBodyPSensor(turned)
        self._densities = (parameters.gyro_density, parameters.accel_density)
        self._is_raised: bool | None = None
        self.use(saturated=False)

    def use(self, *, saturated: bool) -> None:
        if saturated == self._is_raised:
            return
        self._is_raised = saturated
        gyro, accel = np.square(self._densities) * (_SATURATED**2 if saturated else 1.0)
        self.params.setGyroscopeCovariance(np.eye(3) * gyro)
        self.params.setAccelerometerCovariance(np.eye(3) * accel)


def _at_knots(
    samples: Samples, span_ns: tuple[int, int]
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the span's ends and the stamps between them, with the interpolated samples there."""
    start_ns, end_ns = span_ns
    stamps_ns, first = np.unique(samples.stamps_ns, return_index=True)
    inside = stamps_ns[(stamps_ns > start_ns) & (stamps_ns < end_ns)]
    knots_ns = np.array([start_ns, *inside, end_ns], dtype=np.int64)
    before = max(int(np.searchsorted(stamps_ns, start_ns, side="right")) - 1, 0)
    around = stamps_ns[before : int(np.searchsorted(stamps_ns, end_ns)) + 1]
    reach_ns = np.array([min(start_ns, *around[:1]), *around, max(end_ns, *around[-1:])])
    gap_ns = int(np.diff(reach_ns).max(initial=0)) if len(around) else end_ns - start_ns
    if not len(around) or gap_ns > _MAX_GAP_NS:
        raise EstimationError(
            f"IMU samples leave a gap of {gap_ns / 1e6:g} ms between {start_ns} and {end_ns} ns;"
            f" at most {_MAX_GAP_NS / 1e6:g} ms can be bridged"
        )
    since_s = (stamps_ns - start_ns) / 1e9
    at_s = (knots_ns - start_ns) / 1e9
    gyro, accel = (
        np.column_stack([np.interp(at_s, since_s, each[first, axis]) for axis in range(3)])
        for each in (samples.gyro_radps, samples.accel_mps2)
    )
    return knots_ns, gyro, accel


def _at_base(
    knots_ns: IntArray, gyro: FloatArray, accel: FloatArray, T_base_sensor: FloatArray
) -> FloatArray:
    """Return the specific force that an IMU in the base would feel, in the axes of the real one.

    The turn's own acceleration comes from differences of rates: over an interval it sums up to the
    difference of the rates at its ends, so that noise between them does no harm.
    """
    lever = T_base_sensor[:3, :3].T @ T_base_sensor[:3, 3]  # from base to IMU, in the IMU's axes
    if not lever.any():
        return accel
    turn_rate = np.gradient(gyro, knots_ns / 1e9 - knots_ns[0] / 1e9, axis=0)
    centripetal = np.cross(gyro, np.cross(gyro, lever))
    felt: FloatArray = accel - centripetal - np.cross(turn_rate, lever)
    return felt


def _samples(map_: Map, rows: IntArray) -> dict[int, Samples]:
    """Return the samples of each edge.

    Raises:
        EstimationError: If an edge has none.
    """
    table = map_.imu
    chosen = np.flatnonzero(np.isin(table.edge, rows))
    chosen = chosen[np.lexsort((table.stamp_ns[chosen], table.edge[chosen]))]
    edges = table.edge[chosen]
    starts, ends = np.searchsorted(edges, rows), np.searchsorted(edges, rows, side="right")
    found = {}
    for row, start, end in zip(rows.tolist(), starts.tolist(), ends.tolist(), strict=True):
        if start == end:
            raise EstimationError(f"{edge_name(map_, row)} has no samples in the table imu")
        own = chosen[start:end]
        found[row] = Samples(table.stamp_ns[own], table.gyro_radps[own], table.accel_mps2[own])
    return found


def _require_consecutive(map_: Map, rows: IntArray) -> None:
    """Check that no vertex lies between the two of an edge.

    Raises:
        EstimationError: If one does, or the ends are of two missions, or in the wrong order.
    """
    require_ends(map_, rows, "vertex_a", "vertex_b")
    vertices, edges = map_.vertices, map_.edges
    order = np.lexsort((vertices.stamp_ns, vertices.mission))
    following = np.full(len(order), -1)
    same = vertices.mission[order[1:]] == vertices.mission[order[:-1]]
    following[order[:-1][same]] = order[1:][same]
    wrong = rows[following[edges.vertex_a[rows]] != edges.vertex_b[rows]]
    if len(wrong):
        row = int(wrong[0])
        ends = vertices.stamp_ns[[edges.vertex_a[row], edges.vertex_b[row]]].tolist()
        raise EstimationError(
            f"{edge_name(map_, row)}: an IMU links consecutive vertices of one mission only, but"
            f" {ends[0]} and {ends[1]} ns are not; split the edge where the vertices between them are"
        )


def outdated(
    map_: Map,
    factors: Mapping[int, Factor],
    *,
    gyro_radps: float = 2e-3,
    accel_mps2: float = 0.1,
) -> list[int]:
    """Return the rows of IMU factors whose bias has moved so far that the samples should be integrated anew.

    A preintegration holds for the bias it was made with, and to first order around it.

    Args:
        map_: With the biases of now.
        factors: By row of edges; those of other kinds are passed over.
        gyro_radps: How far the gyroscope's bias may move.
        accel_mps2: How far the accelerometer's may.
    """
    rows = []
    for row, factor in factors.items():
        if isinstance(factor, gtsam.GalileanCombinedImuFactor):
            made_with = factor.preintegratedMeasurements().biasHat()
            now = bias_of(map_, int(map_.edges.vertex_a[row]))
            moved_gyro = np.linalg.norm(made_with.gyroscope() - now.gyro_radps)
            moved_accel = np.linalg.norm(made_with.accelerometer() - now.accel_mps2)
            if moved_gyro > gyro_radps or moved_accel > accel_mps2:
                rows.append(row)
    return rows
