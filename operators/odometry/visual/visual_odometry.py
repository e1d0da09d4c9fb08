"""Odometry from stereo or RGB-D cameras, without an IMU."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.odometry.uncertainty import unmeasured
from mapstream.operators.odometry.visual.local_map import LocalMap
from mapstream.operators.odometry.visual.matching import DescriptorTracks
from mapstream.operators.odometry.visual.pose_fit import PoseFit, fit_pose, search_pose
from mapstream.operators.odometry.visual.rays import rays_of
from mapstream.operators.odometry.visual.sightings import Sightings
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, invert, straightened
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.vision import ImageFeatures, NFrame

_LEAST_SHARE = 0.5  # of the known points must agree with a pose that was predicted


class VisualOdometryConfig(OperatorConfig):
    """Options of `visual_odometry`."""

    sigma_px: PositiveFloat = 1.0
    """Of keypoints that do not say."""
    most_baselines: PositiveFloat = 35.0
    """A stereo pair measures distances up to so many times its baseline; of what is farther, the direction."""
    num_keyframes: int = Field(default=8, ge=3, le=30)
    """So many are refined together."""
    keyframe_overlap: float = Field(default=0.7, gt=0, le=1)
    """With a smaller share of the last keyframe's points in view a new keyframe is made."""
    min_points: int = Field(default=8, ge=4)
    """So many known points must agree, or the n-frame is lost."""
    max_lost: int = Field(default=5, ge=1)
    """After so many lost n-frames the local map starts anew at the predicted pose."""


@dataclass(frozen=True)
class Inputs:
    """Keypoints of a stereo pair under the same numbers, or with 3D points; with tracks, or with descriptors."""

    n_frames: Receiver[NFrame]


@dataclass(frozen=True)
class Outputs:
    """One per n-frame; the odom frame is the base at the first of them."""

    odometry: Sender[Odometry]


class VisualOdometry(Operator[Inputs, Outputs]):
    """Find the pose of a camera rig against the points of its last keyframes.

    Keypoints keep the numbers of their tracks; those without tracks are matched by their descriptors, which
    bridges low frame rates. Points count by their uncertainty, so that far ones tell the rotation alone. A
    keyframe refines the last poses and all their points. An n-frame that shows too few known points is lost:
    predicted by the last motion, and said so.
    """

    placement: ClassVar[Placement] = "process"  # numpy on small matrices holds the GIL

    def __init__(self, config: VisualOdometryConfig) -> None:
        self._config = config
        self._map = LocalMap(config.num_keyframes)
        self._matching = DescriptorTracks(config.num_keyframes)
        self._T: FloatArray = np.eye(4)  # T_odom_base of the last n-frame
        self._step: FloatArray = np.eye(4)  # the last motion
        self._covariance: FloatArray = np.zeros((6, 6))  # of the last pose, perturbed on the right
        self._last_ns: int | None = None
        self._num_known = 0  # points of the last keyframe
        self._described: list[ImageFeatures] = []  # keypoints of now that came without tracks
        self._num_lost = 0

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for frame in inputs.n_frames:
            odometry = await offload(self.track, frame)
            if odometry is not None:
                await outputs.odometry.send(odometry)

    def track(self, frame: NFrame) -> Odometry | None:
        """Return the odometry at an n-frame; None if it comes out of order."""
        if self._last_ns is not None and frame.stamp_ns <= self._last_ns:
            warn("n-frames whose stamp does not increase were left out")
            return None
        frame = self._numbered(frame)
        config = self._config
        sightings = Sightings.of(rays_of(frame, config.sigma_px), 0, np.eye(4))
        sightings = sightings.without_far_pairs(config.most_baselines)
        duration_s = 0.0 if self._last_ns is None else (frame.stamp_ns - self._last_ns) / 1e9
        self._last_ns = frame.stamp_ns
        if len(self._map.keys) == 0:
            return self._begin(frame.stamp_ns, sightings, duration_s)
        try:
            fit, known = self._located(sightings, frame.stamp_ns)
        except EstimationError as error:
            warn(f"n-frames without a pose: {error}")
            return self._lost(frame.stamp_ns, sightings, duration_s)
        covariance = self._follow(fit)
        if self._is_keyframe(fit):
            false = known.keys[~fit.is_inlier[np.unique(known.keys, return_inverse=True)[1]]]
            self._keep(sightings.chosen(~np.isin(sightings.keys, false)))
        return self._odometry(frame.stamp_ns, covariance)

    def _numbered(self, frame: NFrame) -> NFrame:
        """Return the n-frame with numbers on all its keypoints."""
        numbered = tuple(
            self._matching.numbered(each) if each.track_ids is None else each
            for each in frame.features
        )
        self._described = [n for n, e in zip(numbered, frame.features, strict=True) if n is not e]
        return replace(frame, features=numbered)

    def _located(self, sightings: Sightings, seed: int) -> tuple[PoseFit, Sightings]:
        """Return the pose against the local map, and the sightings of known points.

        Raises:
            EstimationError: If too few points agree.
        """
        rows = self._map.found(sightings.keys)
        known = sightings.chosen(rows >= 0)
        rows = self._map.found(np.unique(known.keys))
        least = self._config.min_points
        if len(rows) < least:
            raise EstimationError("too few known points are in view")
        points = self._map.positions[rows], self._map.roots[rows]
        fit = fit_pose(known, *points, self._T @ self._step)
        if fit.is_inlier.mean() < _LEAST_SHARE or fit.is_inlier.sum() < least:
            found = search_pose(known, *points, seed=seed)
            fit = max(fit, found, key=lambda each: int(each.is_inlier.sum()))
        if fit.is_inlier.sum() < least:
            raise EstimationError("too few known points agree with one pose")
        return fit, known

    def _follow(self, fit: PoseFit) -> FloatArray:
        """Take a pose over; return the covariance (6, 6) of the step to it."""
        step = SE3(straightened(invert(self._T) @ fit.T_world_base))
        local = SE3(straightened(invert(fit.T_world_base))).adjoint()
        covariance = local @ fit.covariance @ local.T
        carried = step.inverse().adjoint()
        total = carried @ self._covariance @ carried.T + covariance
        self._T, self._step, self._covariance = fit.T_world_base, step.matrix, covariance
        self._num_lost = 0
        return np.asarray(total)

    def _is_keyframe(self, fit: PoseFit) -> bool:
        return bool(fit.is_inlier.sum() < self._config.keyframe_overlap * self._num_known)

    def _keep(self, sightings: Sightings) -> None:
        self._map.add(sightings, self._T)
        refined = self._map.T_world_base
        self._step = self._step @ invert(self._T) @ refined
        self._T = refined
        self._num_known = int((self._map.found(np.unique(sightings.keys)) >= 0).sum())
        for features in self._described:
            self._matching.remember(features)

    def _begin(self, stamp_ns: int, sightings: Sightings, duration_s: float) -> Odometry:
        """Start a local map at the pose of now."""
        self._keep(sightings)
        is_lost = duration_s > 0
        covariance = unmeasured(duration_s) if is_lost else None
        return self._odometry(stamp_ns, covariance, is_lost=is_lost)

    def _lost(self, stamp_ns: int, sightings: Sightings, duration_s: float) -> Odometry:
        """Go on as before; after too long with a new local map."""
        self._num_lost += 1
        self._T = straightened(self._T @ self._step)
        if self._num_lost >= self._config.max_lost:
            self._map = LocalMap(self._config.num_keyframes)  # what is seen now has no tie to it
            self._step, self._num_lost = np.eye(4), 0
            self._keep(sightings)
        return self._odometry(stamp_ns, unmeasured(duration_s), is_lost=True)

    def _odometry(
        self, stamp_ns: int, covariance: FloatArray | None, *, is_lost: bool = False
    ) -> Odometry:
        return Odometry(
            stamp_ns=stamp_ns,
            T_odom_base=SE3(straightened(self._T)),
            covariance=covariance,
            is_lost=is_lost,
        )
