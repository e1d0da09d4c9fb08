"""The calibration of cameras checked against what they saw: what changes, how sure that is, and what it explains.

What the data does not determine is refused: a number that comes from the prior alone is no finding.
Source: Rehder et al., Extending kalibr, ICRA 2016 (calibration as part of the estimation).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.estimation.optimize_config import OptimizeConfig, Refinable
from mapstream.operators.estimation.problem import make_problem
from mapstream.operators.estimation.solvers import Graph
from mapstream.operators.estimation.states import Values
from mapstream.operators.estimation.vision.bundle import Bundle, Sensor
from mapstream.operators.estimation.vision.judging import rms_px
from mapstream.operators.estimation.vision.normal_equations import reduced_normal
from mapstream.operators.estimation.vision.sightings import SensorState, intrinsics_of
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import invert, se3_log


class CalibrateConfig(OperatorConfig):
    """What is looked for, and how sure it must be."""

    refine: tuple[Refinable, ...] = Field(default=("extrinsics",), min_length=1)
    """extrinsics, intrinsics, time_offset."""
    cameras: tuple[str, ...] = ()
    """By name; without, all. Hold one where it is, if the motion does not show where the whole rig sits."""
    max_sigma_rad: PositiveFloat = 0.005
    """A place that stays less certain than this is not determined by the data."""
    max_sigma_m: PositiveFloat = 0.01
    max_sigma_px: PositiveFloat = 3.0
    """Of focal lengths and centres."""
    max_sigma_s: PositiveFloat = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFinding:
    """What was found of one camera."""

    mission: str
    camera: str
    turned_rad: float  # from the place that it was said to have
    moved_m: float
    sigma_rad: float  # the largest of three; NaN where it was not looked for
    sigma_m: float
    intrinsics_change: tuple[float, ...]  # fx fy cx cy [xi] distortion; empty where not looked for
    sigma_px: float  # the largest of fx fy cx cy
    time_offset_s: float
    sigma_s: float
    rms_before_px: (
        float  # of keypoints, with the calibration as it came and everything else at its best
    )
    rms_after_px: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationReport:
    """What was found of all cameras."""

    cameras: tuple[CameraFinding, ...]

    def lines(self) -> Iterator[str]:
        """Return what to tell people, line by line."""
        if not self.cameras:
            yield "no camera has seen a landmark: make landmarks from tracks first"
        for found in self.cameras:
            yield f"{found.camera} of mission {found.mission[:8]}: keypoints {found.rms_before_px:.3f} -> {found.rms_after_px:.3f} px"
            if np.isfinite(found.sigma_m):
                turned, sigma = np.rad2deg([found.turned_rad, found.sigma_rad]).tolist()
                yield f"  place: {1e3 * found.moved_m:.1f} +- {1e3 * found.sigma_m:.1f} mm, {turned:.3f} +- {sigma:.3f} deg"
            if found.intrinsics_change:
                change = " ".join(f"{value:.4g}" for value in found.intrinsics_change)
                yield f"  lens: {change}, +- {found.sigma_px:.2f} px"
            if np.isfinite(found.sigma_s):
                yield f"  clock: {1e3 * found.time_offset_s:.2f} +- {1e3 * found.sigma_s:.2f} ms late"


def calibrate(map_: Map, config: CalibrateConfig | None = None) -> tuple[Map, CalibrationReport]:
    """Return the map with the calibration of its cameras that explains it best, and what that changes.

    Raises:
        EstimationError: If the data does not determine what is looked for.
    """
    config = config or CalibrateConfig()
    best, _ = optimize_map(map_, OptimizeConfig())
    before = make_problem(best, OptimizeConfig())
    options = OptimizeConfig(refine=config.refine, refined_cameras=config.cameras)
    refined, _ = optimize_map(best, options)
    after = make_problem(refined, options)
    cameras = [s for s in after.bundle.sensors if s.keys]
    if not cameras:
        return map_, CalibrationReport(cameras=())
    sigmas = _sigmas(after.bundle, after.whole_graph(), after.values)
    errors_px = rms_px(before.bundle, before.values), rms_px(after.bundle, after.values)
    found = []
    for sensor in cameras:
        name = (sensor.mission, sensor.name)
        finding = _finding(refined, sensor, _named(before.bundle, name).state, sigmas)
        late_ns = _late_ns(best, refined, name)
        finding = replace(finding, time_offset_s=late_ns / 1e9)
        _require_determined(finding, config)
        found.append(replace(finding, rms_before_px=errors_px[0][name], rms_after_px=errors_px[1][name]))  # fmt: skip
    return refined, CalibrationReport(cameras=tuple(found))


def _finding(
    map_: Map, sensor: Sensor, before: SensorState, sigmas: dict[int, FloatArray]
) -> CameraFinding:
    """Return how far a camera's calibration moved, and how sure it is."""
    nan = np.full(6, np.nan)
    moved = se3_log(invert(before.T_base_sensor) @ sensor.state.T_base_sensor)
    place = sigmas.get(sensor.mount_key or -1, nan)
    lens = sigmas.get(sensor.intrinsics_key or -1, nan)
    change: tuple[float, ...] = ()
    if sensor.intrinsics_key is not None and sensor.state.calibration and before.calibration:
        lenses = intrinsics_of(sensor.state.calibration) - intrinsics_of(before.calibration)
        change = tuple(lenses.tolist())
    return CameraFinding(
        mission=map_.mission_id(sensor.mission),
        camera=sensor.name,
        turned_rad=float(np.linalg.norm(moved[:3])),
        moved_m=float(np.linalg.norm(moved[3:])),
        sigma_rad=float(place[:3].max()),
        sigma_m=float(place[3:].max()),
        intrinsics_change=change,
        sigma_px=float(lens[:4].max()),
        time_offset_s=0.0,
        sigma_s=float(sigmas.get(sensor.time_offset_key or -1, nan)[0]),
        rms_before_px=np.nan,
        rms_after_px=np.nan,
    )


def _late_ns(before: Map, after: Map, camera: tuple[int, str]) -> int:
    """Return by how much the times of a camera's observations moved."""
    own = (after.observations.sensor == camera[1]) & (
        after.vertices.mission[after.observations.vertex] == camera[0]
    )
    row = int(np.flatnonzero(own)[0])
    return int(after.observations.offset_ns[row] - before.observations.offset_ns[row])


def _named(bundle: Bundle, name: tuple[int, str]) -> Sensor:
    return next(s for s in bundle.sensors if (s.mission, s.name) == name)


def _sigmas(bundle: Bundle, graph: Graph, values: Values) -> dict[int, FloatArray]:
    """Return standard deviations of what is refined, by key, given all that the problem knows."""
    from scipy.sparse.linalg import splu  # noqa: PLC0415  # takes most of a second to import

    normal, columns = reduced_normal(bundle, graph, values)
    factors = splu(normal.tocsc())
    sigmas = {}
    for key in (key for sensor in bundle.sensors for key in sensor.keys):
        own = columns.of_graph([key])
        unit = np.zeros((columns.num, len(own)))
        unit[own, np.arange(len(own))] = 1
        variances = np.diagonal(factors.solve(unit)[own])
        sigmas[key] = np.sqrt(np.where(variances > 0, variances, np.inf))
    return sigmas


def _require_determined(found: CameraFinding, config: CalibrateConfig) -> None:
    limits = {
        "its orientation": (found.sigma_rad, config.max_sigma_rad, "rad"),
        "its position": (found.sigma_m, config.max_sigma_m, "m"),
        "its focal length or centre": (found.sigma_px, config.max_sigma_px, "px"),
        "its clock": (found.sigma_s, config.max_sigma_s, "s"),
    }
    for what, (sigma, limit, unit) in limits.items():
        if sigma > limit:
            raise EstimationError(
                f"camera {found.camera} of mission {found.mission}: {what} stays uncertain by {sigma:.3g} {unit},"
                f" above {limit:g} {unit}: the motion does not show it; record turns about all axes,"
                " or leave it out of refine"
            )
