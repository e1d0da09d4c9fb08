"""Descriptors made shorter by what was learnt from a map, so that both can be compared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from mapstream.operators.operator import Operator, OperatorConfig
from mapstream.recordings.maps import load_map
from mapstream.recordings.maps.projections import DescriptorProjection, projections_of
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.vision import ImageFeatures


class CompressDescriptorsConfig(OperatorConfig):
    """Options of `compress_descriptors`."""

    map: Path
    """A map whose descriptors `mapstream map DIR compress-descriptors` has compressed."""


@dataclass(frozen=True)
class Inputs:
    features: Receiver[ImageFeatures]


@dataclass(frozen=True)
class Outputs:
    features: Sender[ImageFeatures]  # kinds that the map has not compressed pass as they are


class CompressDescriptors(Operator[Inputs, Outputs]):
    """Compress descriptors as a map's were, so that they can be looked for in it."""

    def __init__(self, config: CompressDescriptorsConfig) -> None:
        self._path = config.map

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        projections = projections_of(load_map(self._path, tables=["projections"]), "compression")
        if not projections:
            remedy = f"`mapstream map {self._path} compress-descriptors --set kind=KIND`"
            raise ConfigError(f"{self._path}: nothing is compressed in this map; {remedy}")
        async for features in inputs.features:
            await outputs.features.send(compressed(features, projections))


def compressed(
    features: ImageFeatures, projections: dict[str, DescriptorProjection]
) -> ImageFeatures:
    """Return features with compressed descriptors, if there is a projection of their kind.

    Raises:
        MapError: If descriptors are not as long as those that were compressed.
    """
    projection = projections.get(features.kind)
    if projection is None:
        return features
    if len(features) == 0:
        return replace(features, descriptors=features.descriptors[:, :0])
    return replace(features, descriptors=projection(features.descriptors))
