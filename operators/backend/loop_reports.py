"""Several searches for loop closures beside each other: their reports on a submap become one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import Field

from mapstream.operators.operator import DynamicPorts, Operator, OperatorConfig, Ports, warn
from mapstream.streams.channel import Sender
from mapstream.streams.messages.estimates import LoopReport


class LoopReportsConfig(OperatorConfig):
    """Options of `loop_reports`."""

    inputs: tuple[str, ...] = Field(default=("lidar", "visual"), min_length=1)
    """One for each search; edges and candidates of a report come in this order."""


@dataclass(frozen=True)
class Outputs:
    """One report for each submap."""

    loops: Sender[LoopReport]


class LoopReports(DynamicPorts, Operator[Ports, Outputs]):
    """Join what searches by LiDAR, by cameras and by objects found out about the same submaps.

    Each of them reports on every submap, in the order of the submaps. One that ends early is done without.
    """

    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: LoopReportsConfig) -> None:
        self._config = config

    @classmethod
    def ports_for(cls, config: LoopReportsConfig) -> tuple[dict[str, Any], dict[str, Any]]:
        return dict.fromkeys(config.inputs, LoopReport), {}

    async def run(self, inputs: Ports, outputs: Outputs) -> None:
        searches = {name: aiter(inputs[name]) for name in self._config.inputs}
        while True:
            reports: dict[str, LoopReport] = {}
            for name, search in searches.items():
                report = await anext(search, None)
                if report is not None:
                    reports[name] = report
            if not reports:
                return
            for name in searches.keys() - reports.keys():
                warn(f"{name} ended before the other searches for loops did")
            searches = {name: searches[name] for name in reports}
            if len({report.stamp_ns for report in reports.values()}) > 1:
                warn("reports of loops on different submaps were joined")
            await outputs.loops.send(
                LoopReport(
                    stamp_ns=max(report.stamp_ns for report in reports.values()),
                    edges=tuple(e for report in reports.values() for e in report.edges),
                    candidates=tuple(c for report in reports.values() for c in report.candidates),
                )
            )
