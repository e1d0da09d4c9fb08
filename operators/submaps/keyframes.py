"""Choose the moments that become vertices of the map."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.odometry.uncertainty import chain
from mapstream.operators.operator import Operator, OperatorConfig, report_loss, warn
from mapstream.operators.submaps.overlap import Overlap
from mapstream.operators.submaps.records import records_of
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError
from mapstream.streams.join import Join
from mapstream.streams.messages.estimates import Keyframe, Odometry, PointCloud
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import NFrame
from mapstream.streams.sync import anchored, exact, nearest
from mapstream.streams.takes import Take
from mapstream.streams.triggers import AnyOf, OnMotion, Periodic, Trigger


class KeyframesConfig(OperatorConfig):
    """Options of `keyframes`: what the robot must have done since the last keyframe, at least one of it."""

    distance_m: PositiveFloat = 1.0
    rotation_rad: PositiveFloat = 0.35
    period_s: PositiveFloat | None = None
    """Time since the last keyframe, also while the robot stands still."""
    overlap: float = Field(default=0.0, ge=0.0, lt=1.0)
    """The least share of the last keyframe's feature tracks that is still seen; 0: that does not matter."""
    odometry_sigma_rad: PositiveFloat = 0.002
    """Uncertainty of a step where the odometry says nothing."""
    odometry_sigma_m: PositiveFloat = 0.01
    images_apart_s: PositiveFloat = 0.02
    """So far an image, or a depth image, may be from the keyframe that refers to it."""


@dataclass(frozen=True)
class Inputs:
    """Odometry, and the clouds and n-frames that have its stamps; images near them, which the map refers to."""

    odometry: Receiver[Odometry]
    clouds: Receiver[PointCloud] | None
    n_frames: Receiver[NFrame] | None
    frames: Receiver[CameraFrame] | None
    depth: Receiver[CameraFrame] | None


@dataclass(frozen=True)
class Outputs:
    """Some of the moments of the odometry."""

    keyframes: Sender[Keyframe]


class Keyframes(Operator[Inputs, Outputs]):
    """Keep a moment when the robot has moved, turned or waited enough since the one before.

    The first and the last moment are always kept, so that the map spans the drive. It begins where the
    odometry first measured: before, nobody knows where the robot was.
    Uncertainty is gathered from keyframe to keyframe over all odometry between.
    """

    def __init__(self, config: KeyframesConfig) -> None:
        self._config = config
        sigmas = [config.odometry_sigma_rad] * 3 + [config.odometry_sigma_m] * 3
        self._default_covariance = np.diag(np.square(sigmas))
        self._trigger = _trigger(config)
        self._overlap = Overlap(config.overlap)
        self._previous: Odometry | None = None  # the last message
        self._covariance: FloatArray = np.zeros((6, 6))  # from the last keyframe to the previous
        self._was_lost = False

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        waiting: Keyframe | None = None  # the newest moment, not kept so far
        num_unknown = 0
        within_ns = round(self._config.images_apart_s * 1e9)
        async for odometry, cloud, n_frame, images in _moments(inputs, within_ns):
            if self._previous is None and odometry.is_lost:
                num_unknown += 1
                continue
            if self._previous is not None and odometry.stamp_ns <= self._previous.stamp_ns:
                report_loss("moments whose stamp does not increase")
                continue
            keyframe = self.moment(odometry, cloud, n_frame, images)
            waiting = keyframe
            pose = (odometry.stamp_ns, odometry.T_odom_base)
            if self._trigger.is_due(*pose) or self._overlap.is_lost(keyframe.features):
                self._trigger.restart(*pose)
                self._overlap.restart(keyframe.features)
                self._covariance, self._was_lost = np.zeros((6, 6)), False
                waiting = None
                await outputs.keyframes.send(keyframe)
        if waiting is not None:
            await outputs.keyframes.send(waiting)
        if num_unknown and self._previous is None:
            raise EstimationError(
                f"the odometry was lost at each of {num_unknown} moments, so there is nothing to map;"
                " its warnings say why"
            )

    def moment(
        self,
        odometry: Odometry,
        cloud: PointCloud | None,
        n_frame: NFrame | None = None,
        images: Sequence[CameraFrame] = (),
    ) -> Keyframe:
        """Return the keyframe that this moment would be."""
        if self._previous is None:
            covariance = None
        else:
            T_previous_now = self._previous.T_odom_base.inverse() @ odometry.T_odom_base
            step = odometry.covariance
            step = self._default_covariance if step is None else step
            self._covariance = chain(self._covariance, T_previous_now, step)
            self._was_lost |= odometry.is_lost
            covariance = self._covariance.copy()
        self._previous = odometry
        features = () if n_frame is None else n_frame.features
        since_kept = replace(odometry, covariance=covariance, is_lost=self._was_lost)
        return Keyframe(
            stamp_ns=odometry.stamp_ns,
            odometry=since_kept,
            cloud=cloud,
            records=records_of(cloud, features, images),
            features=features,
        )


def _trigger(config: KeyframesConfig) -> Trigger:
    triggers: list[Trigger] = [OnMotion(config.distance_m, config.rotation_rad)]
    if config.period_s is not None:
        triggers.append(Periodic(round(config.period_s * 1e9)))
    return AnyOf(triggers)


async def _moments(inputs: Inputs, within_ns: int) -> AsyncIterator[_Moment]:
    """Yield odometry with the cloud and the n-frame of its stamp and images near it, as far as they are connected."""
    with_stamp = [r for r in (inputs.clouds, inputs.n_frames) if r is not None]
    images = [nearest(r, within_ns, optional=True) for r in (inputs.frames, inputs.depth)]
    moments: Join[tuple[Any, ...]] = exact(inputs.odometry, *with_stamp)
    if inputs.frames is not None or inputs.depth is not None:
        at_stamp: list[Take[Any]] = [nearest(receiver, 0) for receiver in with_stamp]
        moments = anchored(inputs.odometry, *at_stamp, *images)
    num_seen = len(with_stamp)
    async for odometry, *found in moments:
        seen, near = found[:num_seen], found[num_seen:]
        yield _Moment(
            odometry,
            seen[0] if inputs.clouds is not None else None,
            seen[-1] if inputs.n_frames is not None else None,
            [image for image in near if image is not None],
        )
    if moments.stats.unmatched or moments.stats.absent:
        warn(moments.explain())


class _Moment(NamedTuple):
    odometry: Odometry
    cloud: PointCloud | None
    n_frame: NFrame | None
    images: list[CameraFrame]
