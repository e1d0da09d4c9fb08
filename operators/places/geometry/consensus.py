"""The pose on which most sightings of a frame agree, over all cameras and 3D sensors together (RANSAC).

Three rays of one camera give poses by P3P, three 3D points of whichever sensors by alignment; the poses compete
for the sightings of all. Sources: Fischler and Bolles, CACM 1981; Torr and Zisserman, MLESAC, CVIU 2000 (the score);
Kneip et al., OpenGV, ICRA 2014 (cameras as one); Cramariuc et al., maplab 2.0, RA-L 2023, section III-A2 (3D points).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from mapstream.operators.operator import OperatorConfig
from mapstream.operators.places.geometry.minimal import aligned, p3p
from mapstream.operators.places.geometry.refinement import Noise, RefinedPose, errors, refine
from mapstream.operators.places.geometry.sightings import Sightings
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import invert

_ROUNDS = 5  # of refining and asking again who agrees


class ConsensusConfig(OperatorConfig):
    """When sightings agree on a pose."""

    iterations: PositiveInt = 100
    """Triples that are tried."""
    sigma_px: PositiveFloat = 2.0
    """Of keypoints against the map, whose points are not exact."""
    sigma_m: PositiveFloat = 0.05
    """Of 3D points against the map, where a sensor claims less."""
    max_sigmas: PositiveFloat = 3.0
    """What is farther off disagrees."""
    min_inliers: PositiveInt = 10
    """Sightings that must agree."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Consensus:
    """A pose, and the sightings that agree with it."""

    pose: RefinedPose
    is_inlier: BoolArray  # (N,)

    @property
    def num_inliers(self) -> int:
        return int(self.is_inlier.sum())


def find_pose(sightings: Sightings, config: ConsensusConfig, seed: int) -> Consensus:
    """Return the pose of the base in the map on which most sightings agree.

    Args:
        sightings: Of one frame; many may be false.
        config: When they agree.
        seed: Of the triples; the frame's id, so that a run repeats.

    Raises:
        EstimationError: If too few agree on any pose; the message is short enough for a report.
    """
    if len(sightings) < max(config.min_inliers, 3):
        raise EstimationError(f"{len(sightings)} matches, fewer than {max(config.min_inliers, 3)}")
    noise = Noise(sigma_px=config.sigma_px, sigma_m=config.sigma_m)
    poses = _hypotheses(sightings, config, np.random.default_rng(seed))
    if not len(poses):
        raise EstimationError("no three matches give a pose")
    best = poses[int(np.argmin(_costs(sightings, poses, config)))]
    is_inlier = errors(sightings, best, noise) <= config.max_sigmas
    pose: RefinedPose | None = None
    for _ in range(_ROUNDS):
        if is_inlier.sum() < 3:
            break
        pose = refine(sightings.take(is_inlier), best, noise)
        best = pose.T_map_base.matrix
        agree = errors(sightings, best, noise) <= config.max_sigmas
        if np.array_equal(agree, is_inlier):
            break
        is_inlier = agree
    if pose is None or is_inlier.sum() < config.min_inliers:
        raise EstimationError(f"{is_inlier.sum()} inliers, fewer than {config.min_inliers}")
    return Consensus(pose=pose, is_inlier=is_inlier)


def _hypotheses(
    sightings: Sightings, config: ConsensusConfig, rng: np.random.Generator
) -> FloatArray:
    """Return poses T_map_base (M, 4, 4) of triples, shared out by how much each camera sees."""
    groups = [group for group in _groups(sightings) if len(group[1]) >= 3]
    if not groups:
        return np.empty((0, 4, 4))
    sizes = np.array([len(rows) for _, rows in groups])
    chosen = rng.choice(len(groups), config.iterations, p=sizes / sizes.sum())
    poses = []
    for number, (camera, rows) in enumerate(groups):
        count = int((chosen == number).sum())
        triples = rows[np.argsort(rng.random((count, len(rows))), axis=1)[:, :3]]
        points_map = sightings.points_map[triples]
        if camera is None:
            poses.append(aligned(points_map, sightings.points_base()[triples]))
        else:
            T_base_sensor = sightings.sensors[camera].T_base_sensor
            found = p3p(sightings.rays[triples], points_map).T_sensor_map
            poses.append(invert(T_base_sensor.matrix @ found))
    return np.concatenate(poses)


def _groups(sightings: Sightings) -> list[tuple[int | None, IntArray]]:
    """Return the rows that are judged alike: 3D points, and the rays of each camera by its number."""
    has_ray = sightings.has_ray
    rays = [
        (number, np.flatnonzero(has_ray & (sightings.sensor == number)))
        for number in range(len(sightings.sensors))
    ]
    return [(None, np.flatnonzero(sightings.has_point)), *rays]


def _costs(sightings: Sightings, poses: FloatArray, config: ConsensusConfig) -> FloatArray:
    """Return the sums (M,) of squared errors in standard deviations, each at most that of an outlier.

    Rays are compared by their angle, as if pixels were small, so that all poses are judged at once.
    """
    most = config.max_sigmas**2
    costs = np.full(len(poses), most * len(sightings))
    T_base_map = invert(poses)
    for camera, rows in _groups(sightings):
        points = sightings.points_map[rows] @ np.swapaxes(T_base_map[:, :3, :3], 1, 2)
        points += T_base_map[:, None, :3, 3]
        if camera is None:
            sigmas = np.fmax(sightings.sigmas_m[rows], config.sigma_m)
            off = np.linalg.norm(points - sightings.points_base()[rows], axis=2) / sigmas
        else:
            T_sensor_base = sightings.sensors[camera].T_base_sensor.inverse()
            directions = points @ T_sensor_base.R.T + T_sensor_base.t
            directions /= np.maximum(np.linalg.norm(directions, axis=2, keepdims=True), 1e-12)
            turned = np.linalg.norm(directions - sightings.rays[rows], axis=2)
            off = turned / (sightings.rad_per_px[rows] * config.sigma_px)
        costs -= np.maximum(most - off**2, 0).sum(axis=1)
    return costs
