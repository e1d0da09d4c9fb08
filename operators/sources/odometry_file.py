"""Odometry of any origin, from a text file."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from pathlib import Path

import anyio.to_thread

from mapstream.operators.operator import NoPorts, Operator, OperatorConfig, context
from mapstream.operators.sources.seeking import seek_target
from mapstream.recordings.odometry_files import read_odometry
from mapstream.streams.channel import Sender
from mapstream.streams.messages.estimates import Odometry


class OdometryFileConfig(OperatorConfig):
    """Options of `odometry_file`."""

    path: Path
    """TUM, KITTI, EuRoC, or CSV whose header names its columns; the file says which."""


@dataclass(frozen=True)
class Outputs:
    """The poses at their stamps, with velocity and biases where the file has them."""

    odometry: Sender[Odometry]


class OdometryFile(Operator[NoPorts, Outputs]):
    """Play the poses of a file, paced by the clock."""

    def __init__(self, config: OdometryFileConfig) -> None:
        self._path = config.path

    async def run(self, inputs: NoPorts, outputs: Outputs) -> None:  # noqa: ARG002
        poses = await anyio.to_thread.run_sync(read_odometry, self._path)
        clock, activity = context().clock, context().activity
        activity.span_ns = (poses[0].stamp_ns, poses[-1].stamp_ns)
        at = 0
        while at < len(poses):
            pose = poses[at]
            await clock.sleep_until(pose.stamp_ns)
            target_ns = seek_target(clock)
            if target_ns is not None:
                outputs.odometry.start_epoch()
                at = bisect_left(poses, target_ns, key=lambda each: each.stamp_ns)
                continue
            activity.position_ns = pose.stamp_ns
            await outputs.odometry.send(pose)
            at += 1
