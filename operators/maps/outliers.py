"""Loops that contradict odometry, switched off without solving for the poses.

Source: the odometric consistency check of Mangelson et al., PCM, ICRA 2018, section V.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from mapstream.operators.estimation.outliers.consistency import chi2_gate, cycle_chi2
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.model import Map


class RejectLoopsConfig(OperatorConfig):
    """How loops are found to be false."""

    gate_probability: float = Field(default=0.9999, gt=0, lt=1)
    """A true loop closes its cycle with odometry below the chi2 that it stays below this often."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RejectLoopsReport:
    """Which loops are false."""

    num_loops: int
    num_untouched: int  # no odometry leads from one end to the other
    rejected: list[int]  # rows of edges


def reject_loops(
    map_: Map, config: RejectLoopsConfig | None = None
) -> tuple[Map, RejectLoopsReport]:
    """Return the map with the switch 0 on loops whose cycle with odometry closes far beyond its noise.

    The other loops that odometry can judge are switched on; those between missions stay as they are.
    """
    config = config or RejectLoopsConfig()
    rows = map_.edges_of("loop")
    chi2 = cycle_chi2(map_, rows)
    is_judged = np.isfinite(chi2)
    is_false = is_judged & (chi2 > chi2_gate(6, config.gate_probability))
    switch = map_.edges.switch.copy()
    switch[rows[is_judged]] = 1.0
    switch[rows[is_false]] = 0.0
    report = RejectLoopsReport(
        num_loops=len(rows),
        num_untouched=int((~is_judged).sum()),
        rejected=rows[is_false].tolist(),
    )
    return replace(map_, edges=replace(map_.edges, switch=switch)), report
