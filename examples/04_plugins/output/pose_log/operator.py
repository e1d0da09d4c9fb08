"""An output: the poses of every map that the optimizer sends, as tables for a spreadsheet."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.operators.operator import NoPorts, Operator, OperatorConfig, offload, report_written
from mapstream.recordings.maps.model import Map
from mapstream.streams import Receiver


class PoseLogConfig(OperatorConfig):
    folder: Path = Path("poses")


@dataclass(frozen=True)
class Inputs:
    maps: Receiver[Map]


class PoseLog(Operator[Inputs, NoPorts]):
    """Write one CSV file per map: 000.csv, 001.csv ..."""

    placement = "thread"

    def __init__(self, config: PoseLogConfig) -> None:
        self._folder = config.folder

    async def run(self, inputs: Inputs, outputs: NoPorts) -> None:  # noqa: ARG002  # a sink
        number = 0
        async for map_ in inputs.maps:
            file = self._folder / f"{number:03d}.csv"
            await offload(self.write, map_, file)
            report_written(file)
            number += 1

    def write(self, map_: Map, file: Path) -> None:
        """Write the stamp and the position of each vertex in the map frame."""
        positions = map_.T_map_base(np.arange(len(map_.vertices)))[:, :3, 3]
        rows = zip(map_.vertices.stamp_ns, positions, strict=True)
        lines = [f"{stamp_ns},{x:.6f},{y:.6f},{z:.6f}\n" for stamp_ns, (x, y, z) in rows]
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("stamp_ns,x_m,y_m,z_m\n" + "".join(lines))
