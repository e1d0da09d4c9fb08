"""An operator that breaks in the middle of a run, in the ways that operators of other people do."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from typing import Literal

from mapstream.operators.operator import Operator, OperatorConfig
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import LidarScan


class BreaksConfig(OperatorConfig):
    after: int = 8  # scans
    how: Literal["raise", "die"] = "raise"


@dataclass(frozen=True)
class Inputs:
    scans: Receiver[LidarScan]


@dataclass(frozen=True)
class Outputs:
    scans: Sender[LidarScan]


class Breaks(Operator[Inputs, Outputs]):
    """Pass scans on until it breaks."""

    def __init__(self, config: BreaksConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        num_passed = 0
        async for scan in inputs.scans:
            if num_passed == self._config.after:
                self._break()
            await outputs.scans.send(scan)
            num_passed += 1

    def _break(self) -> None:
        if self._config.how == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        raise ZeroDivisionError("division by zero")
