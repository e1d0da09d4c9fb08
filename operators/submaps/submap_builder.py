"""Cut a drive into submaps (Cramariuc et al., maplab 2.0, RA-L 2023, section III-C)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.odometry.uncertainty import bridged
from mapstream.operators.operator import Operator, OperatorConfig, warn
from mapstream.recordings.maps.ids import mission_id
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError
from mapstream.streams.messages.estimates import Keyframe, RelativePose, Submap


class SubmapBuilderConfig(OperatorConfig):
    """Options of `submap_builder`: a submap ends when one of its limits is reached."""

    length_m: PositiveFloat = 10.0
    """Path within a submap."""
    duration_s: PositiveFloat = 30.0
    num_keyframes: PositiveInt = Field(default=50, ge=2)
    mission: str = ""
    """Tells missions apart that begin at the same time; one robot needs none."""


@dataclass(frozen=True)
class Inputs:
    """Keyframes in the order of their stamps."""

    keyframes: Receiver[Keyframe]


@dataclass(frozen=True)
class Outputs:
    """Submaps, each as soon as it is full."""

    submaps: Sender[Submap]


class SubmapBuilder(Operator[Inputs, Outputs]):
    """Gather keyframes and the odometry between them into submaps.

    The last keyframe of a submap is the first of the next one, so that no edge is cut.
    A step that the odometry could not measure becomes an edge of kind `motion_model`.
    The mission's id comes from the first stamp, the epoch and `mission`: a replay gives it again.
    """

    def __init__(self, config: SubmapBuilderConfig) -> None:
        self._config = config
        self._gathered: list[Keyframe] = []
        self._index = 0
        self._mission_id = ""

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for keyframe in inputs.keyframes:
            if not self._mission_id:
                name = f"{self._config.mission}@{keyframe.stamp_ns}"
                self._mission_id = mission_id(name, inputs.keyframes.epoch)
            self._gathered.append(keyframe)
            if self.is_full():
                await outputs.submaps.send(self.cut())
        if len(self._gathered) > 1 or (self._gathered and self._index == 0):
            await outputs.submaps.send(self.cut())

    def is_full(self) -> bool:
        """Return whether a limit is reached; a submap has at least two keyframes."""
        frames, config = self._gathered, self._config
        if len(frames) < 2:
            return False
        path = np.array([frame.odometry.T_odom_base.t for frame in frames])
        length_m = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        duration_s = (frames[-1].stamp_ns - frames[0].stamp_ns) / 1e9
        is_long = length_m >= config.length_m or duration_s >= config.duration_s
        return bool(is_long or len(frames) >= config.num_keyframes)

    def cut(self) -> Submap:
        """Return what was gathered, and begin the next submap with its last keyframe."""
        frames = tuple(self._gathered)
        submap = Submap(
            mission_id=self._mission_id,
            index=self._index,
            keyframes=frames,
            edges=tuple(self._edge(a, b) for a, b in pairwise(frames)),
        )
        self._index += 1
        self._gathered = [frames[-1]]
        return submap

    def _edge(self, a: Keyframe, b: Keyframe) -> RelativePose:
        if b.odometry.covariance is None:
            raise EstimationError(
                f"the keyframe at {b.stamp_ns} ns has no covariance; it comes from `keyframes`"
            )
        if b.odometry.is_lost:
            warn("a step that no sensor measured is bridged by the motion model")
        return RelativePose(
            kind="motion_model" if b.odometry.is_lost else "odometry",
            mission_a=self._mission_id,
            stamp_a_ns=a.stamp_ns,
            mission_b=self._mission_id,
            stamp_b_ns=b.stamp_ns,
            T_a_b=a.odometry.T_odom_base.inverse() @ b.odometry.T_odom_base,
            covariance=bridged(b.odometry.covariance, (b.stamp_ns - a.stamp_ns) / 1e9),
            source="odometry",
        )
