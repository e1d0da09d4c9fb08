"""The end of a mapping graph: one cloud, put together from the optimised poses, goes to a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, PositiveInt

from mapstream.operators.maps.aggregate import AggregateConfig, aggregate_cloud
from mapstream.operators.maps.passing_clouds import PassingClouds
from mapstream.operators.operator import NoPorts, Operator, offload, report_written, warn
from mapstream.recordings.cloud_files import write_pcd, write_ply
from mapstream.recordings.maps.model import Map
from mapstream.streams.channel import Receiver
from mapstream.streams.messages.estimates import Submap

Format = Literal["ply", "pcd"]
_WRITERS: dict[Format, Callable[..., None]] = {"ply": write_ply, "pcd": write_pcd}


class CloudSinkConfig(AggregateConfig):
    path: Path = Field(default=Path("cloud.ply"), description="the file, replaced if it exists")
    format: Format | None = Field(default=None, description="by default what the path ends with")
    max_bytes: PositiveInt = Field(
        default=256_000_000, description="of keyframe clouds in memory; all are on disk"
    )

    def chosen_format(self) -> Format:
        """Return the format; PLY where neither the key nor the path says."""
        return self.format or ("pcd" if self.path.suffix.lower() == ".pcd" else "ply")


@dataclass(frozen=True)
class Inputs:
    maps: Receiver[Map]
    submaps: Receiver[Submap]


class CloudSink(Operator[Inputs, NoPorts]):
    """Keep every keyframe's cloud on disk, and put them where the last map's poses say.

    So a loop closure at the end of the run moves the walls that were seen at its beginning.
    """

    placement = "thread"
    spans_epochs = True

    def __init__(self, config: CloudSinkConfig) -> None:
        self.config = config

    async def run(self, inputs: Inputs, outputs: NoPorts) -> None:  # noqa: ARG002  # a sink
        with PassingClouds(self.config.max_bytes) as clouds:
            newest = await clouds.gather(inputs.maps, inputs.submaps)
            if newest is None or not len(clouds):
                missing = "map" if newest is None else "cloud"
                warn(f"no {missing} came, so {self.config.path} was not written")
                return
            await offload(self._write, clouds.put_into(newest), clouds.folder)
            report_written(self.config.path)

    def _write(self, map_: Map, folder: Path) -> None:
        cloud = aggregate_cloud(map_, folder, self.config)
        write = _WRITERS[self.config.chosen_format()]
        write(self.config.path, cloud.points, cloud.intensity, cloud.colors_rgb)
