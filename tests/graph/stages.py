"""Small operators for tests of graphs: numbers from a list, doubled, added, collected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import PositiveInt

from mapstream.operators.operator import (
    DynamicPorts,
    NoPorts,
    Operator,
    OperatorConfig,
    Ports,
)
from mapstream.streams.channel import Receiver, Sender


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    stamp_ns: int
    value: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Word:
    stamp_ns: int
    text: str


class CountConfig(OperatorConfig):
    limit: PositiveInt = 3
    path: str = ""


@dataclass(frozen=True)
class Numbers:
    numbers: Sender[Number]


class Count(Operator[NoPorts, Numbers]):
    """Count from zero."""

    def __init__(self, config: CountConfig) -> None:
        self._config = config

    async def run(self, inputs: NoPorts, outputs: Numbers) -> None:
        for i in range(self._config.limit):
            await outputs.numbers.send(Number(stamp_ns=i, value=i))


@dataclass(frozen=True)
class DoubleInputs:
    numbers: Receiver[Number]
    hints: Receiver[Word] | None = None


class DoubleConfig(OperatorConfig):
    factor: int = 2


class Double(Operator[DoubleInputs, Numbers]):
    """Multiply each number."""

    placement = "thread"

    def __init__(self, config: DoubleConfig) -> None:
        self._factor = config.factor

    async def run(self, inputs: DoubleInputs, outputs: Numbers) -> None:
        async for number in inputs.numbers:
            product = number.value * self._factor
            await outputs.numbers.send(Number(stamp_ns=number.stamp_ns, value=product))


@dataclass(frozen=True)
class Words:
    words: Sender[Word]


class Spell(Operator[NoPorts, Words]):
    """Send no words."""

    async def run(self, inputs: NoPorts, outputs: Words) -> None:
        return


@dataclass(frozen=True)
class CollectInputs:
    numbers: Receiver[Number] | None = None
    words: Receiver[Word] | None = None


class Collect(Operator[CollectInputs, NoPorts]):
    """Read and forget."""

    async def run(self, inputs: CollectInputs, outputs: NoPorts) -> None:
        if inputs.numbers is not None:
            async for _ in inputs.numbers:
                pass


class AnyConfig(OperatorConfig):
    ports: tuple[str, ...] = ()


class AnySource(Operator[NoPorts, Ports], DynamicPorts):
    """Send on the ports that its config names, of no known type."""

    def __init__(self, config: AnyConfig) -> None:
        self._config = config

    @classmethod
    def ports_for(cls, config: AnyConfig) -> tuple[dict[str, Any], dict[str, Any]]:
        return {}, dict.fromkeys(config.ports, Any)

    async def run(self, inputs: NoPorts, outputs: Ports) -> None:
        return


STAGES: dict[str, type[Operator[Any, Any]]] = {
    "count": Count,
    "double": Double,
    "spell": Spell,
    "collect": Collect,
    "any_source": AnySource,
}
