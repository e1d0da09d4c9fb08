"""What odometries from colour and depth share: each image comes with the depth of the same pixels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from mapstream.operators.operator import Operator, Placement, offload, warn
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.sync import anchored, nearest


@dataclass(frozen=True)
class Inputs:
    """Colour or gray images, and depth in the same camera (see `depth_registration`)."""

    frames: Receiver[CameraFrame]
    depth: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    """One per image with depth; the odom frame is the base at the first of them."""

    odometry: Sender[Odometry]


class PairedOdometry(Operator[Inputs, Outputs], ABC):
    """Odometry of one image with its depth after the other."""

    placement: ClassVar[Placement] = "process"  # numpy on small matrices holds the GIL

    def __init__(self, max_apart_s: float) -> None:
        self._max_apart_ns = round(max_apart_s * 1e9)

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        pairs = anchored(inputs.frames, nearest(inputs.depth, self._max_apart_ns))
        async for frame, depth in pairs:
            odometry = await offload(self.track, frame, depth)
            if odometry is not None:
                await outputs.odometry.send(odometry)
        if pairs.stats.unmatched:
            warn(pairs.explain())

    @abstractmethod
    def track(self, frame: CameraFrame, depth: CameraFrame) -> Odometry | None:
        """Return the odometry at an image; None if it comes out of order.

        Raises:
            OperatorError: If a calibration is missing or of no use, or depth is not as large as the image.
        """


def require_registered(frame: CameraFrame, depth: CameraFrame, user: str) -> None:
    """Refuse depth that is not of the image's pixels, by its size.

    Raises:
        OperatorError: If the sizes differ; the message says what helps.
    """
    if depth.image.shape != frame.image.shape[:2]:
        raise OperatorError(
            f"depth of {depth.frame} is {depth.image.shape}, images of {frame.frame} are "
            f"{frame.image.shape[:2]}; put depth_registration before {user}"
        )
