"""Keep the returns of a LiDAR that lie between two ranges: the robot's own body and far noise go."""

from dataclasses import dataclass, replace

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from mapstream.operators.operator import Operator, OperatorConfig, pipeline, warn
from mapstream.streams import LidarScan, Receiver, Sender


class NearFieldConfig(OperatorConfig):
    """Options of `near_field`."""

    min_range_m: NonNegativeFloat = 1.0
    max_range_m: PositiveFloat = 60.0


@dataclass(frozen=True)
class Inputs:
    """What it reads."""

    scans: Receiver[LidarScan]


@dataclass(frozen=True)
class Outputs:
    """What it sends: the same scans, with fewer points."""

    scans: Sender[LidarScan]


class NearField(Operator[Inputs, Outputs]):
    """Keep the returns between two ranges."""

    def __init__(self, config: NearFieldConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        await pipeline(self.crop, inputs.scans, outputs.scans.send)

    def crop(self, scan: LidarScan) -> LidarScan:
        """Return the scan without the points that are too near or too far."""
        range_m = np.linalg.norm(scan.points, axis=1)
        keep = (range_m >= self._config.min_range_m) & (range_m <= self._config.max_range_m)
        if not keep.any():
            warn("near_field: a scan has no point in range")
        fields = ("points", "intensity", "ring", "offsets_ns")
        columns = {name: getattr(scan, name) for name in fields}
        return replace(scan, **{n: c[keep] for n, c in columns.items() if c is not None})
