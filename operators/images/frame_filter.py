"""What all stages share that make one image of one image."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from mapstream.operators.operator import Operator, pipeline
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.sensors import CameraFrame

COLORS = ("bgr8", "rgb8")
DEPTHS = ("16UC1", "32FC1")


@dataclass(frozen=True)
class Inputs:
    frames: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    frames: Sender[CameraFrame]


class FrameFilter(Operator[Inputs, Outputs], ABC):
    """Change images one by one; several workers may do so at a time, for OpenCV frees the interpreter."""

    placement = "thread"

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        await pipeline(self.changed, inputs.frames, outputs.frames.send)

    @abstractmethod
    def changed(self, frame: CameraFrame) -> CameraFrame:
        """Return a new frame, with the calibration that belongs to it.

        Raises:
            OperatorError: If it is of a kind that this stage does not know.
        """


def require_encoding(frame: CameraFrame, stage: str, known: tuple[str, ...]) -> None:
    """Refuse an image that a stage cannot work on.

    Raises:
        OperatorError: With what the stage takes.
    """
    if frame.encoding not in known:
        raise OperatorError(
            f"{stage}: images of {frame.frame} are {frame.encoding}; it takes {', '.join(known)}"
        )
