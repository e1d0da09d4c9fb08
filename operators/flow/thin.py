"""Fewer messages of a kind: one in a while."""

from __future__ import annotations

from typing import Any

from pydantic import PositiveFloat

from mapstream.operators.operator import DynamicPorts, Operator, OperatorConfig, Ports


class ThinConfig(OperatorConfig):
    """Options of `thin`."""

    period_s: PositiveFloat
    """One message of each period is kept: the first."""


class Thin(DynamicPorts, Operator[Ports, Ports]):
    """Keep the first message of each period, counted from the first of all; the rest goes out apart.

    What is left can judge what was made of the kept: satellite positions that a map did not use.
    """

    def __init__(self, config: ThinConfig) -> None:
        self._period_ns = round(config.period_s * 1e9)

    @classmethod
    def ports_for(cls, config: ThinConfig) -> tuple[dict[str, Any], dict[str, Any]]:  # noqa: ARG003
        return {"messages": Any}, {"kept": Any, "rest": Any}

    async def run(self, inputs: Ports, outputs: Ports) -> None:
        first_ns: int | None = None
        newest = -1  # the period of the last message kept
        async for message in inputs["messages"]:
            first_ns = message.stamp_ns if first_ns is None else first_ns
            period = (message.stamp_ns - first_ns) // self._period_ns
            port, other = ("kept", "rest") if period > newest else ("rest", "kept")
            newest = max(newest, period)
            await outputs[port].send(message)
            outputs[other].advance(message.stamp_ns)
