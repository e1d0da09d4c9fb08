"""What all cameras of a robot saw at one moment, as one message (maplab 2.0, section III-A: n-frames)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import Field, NonNegativeFloat, model_validator

from mapstream.operators.operator import DynamicPorts, Operator, OperatorConfig, Ports, warn
from mapstream.streams.channel import Sender
from mapstream.streams.messages.vision import ImageFeatures, NFrame
from mapstream.streams.moments import moments


class NFramesConfig(OperatorConfig):
    """Options of `n_frames`: each name is an input of `ImageFeatures`."""

    inputs: tuple[str, ...] = Field(default=("features",), min_length=1)
    """One for each camera and kind of features; the n-frame holds them in this order."""
    slower: tuple[str, ...] = ()
    """Those of them that do not see at every moment; that one is missing is no warning."""
    tolerance_s: NonNegativeFloat = 0.0005
    """How far the images of one n-frame may be apart."""

    @model_validator(mode="after")
    def _check_slower(self) -> NFramesConfig:
        if unknown := sorted(set(self.slower) - set(self.inputs)):
            raise ValueError(f"slower: no input {unknown[0]}; there are {', '.join(self.inputs)}")
        return self


@dataclass(frozen=True)
class Outputs:
    """One n-frame for each moment at which an image was taken."""

    n_frames: Sender[NFrame]


class NFrames(DynamicPorts, Operator[Ports, Outputs]):
    """Gather the features of images that were taken together.

    A moment at which a camera gave no image still makes an n-frame of the others, and is counted.
    """

    def __init__(self, config: NFramesConfig) -> None:
        self._config = config
        self._tolerance_ns = round(config.tolerance_s * 1e9)

    @classmethod
    def ports_for(cls, config: NFramesConfig) -> tuple[dict[str, Any], dict[str, Any]]:
        return dict.fromkeys(config.inputs, ImageFeatures), {}

    async def run(self, inputs: Ports, outputs: Outputs) -> None:
        names = self._config.inputs
        receivers = [inputs[name] for name in names]
        async for gathered in moments(receivers, self._tolerance_ns):
            await outputs.n_frames.send(self._joined(gathered))

    def _joined(self, gathered: dict[int, ImageFeatures]) -> NFrame:
        names = self._config.inputs
        for number in set(range(len(names))) - gathered.keys():
            if names[number] in self._config.slower:
                continue
            warn(f"n-frames without {names[number]}: none within {self._config.tolerance_s:g} s")
        features = tuple(gathered[number] for number in sorted(gathered))
        return NFrame(stamp_ns=min(f.stamp_ns for f in features), features=features)
