"""Places that look alike as a whole, by one vector for each image behind a map's vertices.

They propose where to look; keypoints and geometry decide as always (Arandjelovic et al., NetVLAD, CVPR 2016).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from pydantic import Field, PositiveInt

from mapstream.operators.decode.image import ImageDecode, ImageDecodeConfig
from mapstream.operators.networks.global_descriptors import (
    GlobalDescriptors,
    GlobalDescriptorsConfig,
    rgb,
)
from mapstream.operators.operator import OperatorConfig, OptionalPath
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.records import record_rows, recorded
from mapstream.streams.arrays import Float32Array, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage

_OF_LIGHT = ("mono8", "rgb8", "bgr8")  # 16 bits are depth or heat


class WholeImagesConfig(OperatorConfig):
    """Which places are proposed by what whole images look like."""

    model: OptionalPath = None
    """An ONNX file that makes a vector of an RGB image; without one, MobileNetV2 with VLAD."""
    long_side_px: int = Field(default=320, ge=64)
    """Of the image that the network sees, where the network leaves it open."""
    num_vertices: PositiveInt = 5
    """The most alike, whose landmarks are compared."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WholeImages:
    """What the images of vertices look like."""

    vertex: IntArray  # (N,) of each image
    vectors: Float32Array  # (N, D) of unit length

    def most_alike(self, vertex: int, among: Collection[int], count: int) -> list[int]:
        """Return the vertices whose images are most like those of one, the most alike first."""
        rows = np.flatnonzero(np.isin(self.vertex, list(among)))
        own = self.vectors[self.vertex == vertex]
        if not len(own):
            return []
        likeness = (self.vectors[rows] @ own.T).max(axis=1)
        ranked = self.vertex[rows[np.argsort(-likeness, kind="stable")]]
        return list(dict.fromkeys(ranked.tolist()))[:count]


def whole_images(map_: Map, config: WholeImagesConfig) -> WholeImages:
    """Return what the images behind a map look like, read from its recordings.

    Raises:
        MapError: If there are none.
        RecordingError: If a recording is not there.
        ConfigError: If the network is not installed.
    """
    options = config.model_dump(include={"model", "long_side_px"})
    describer = GlobalDescriptors(GlobalDescriptorsConfig(**options))
    embedding = describer.open()
    vertices, vectors = [], []
    for vertex, frame in _pictures(map_):
        image = rgb(frame)
        if image.min() < image.max():  # an image of one colour looks like nothing
            vertices.append(vertex)
            vectors.append(describer.describe(embedding, frame, image).vector)
    if not vectors:
        raise MapError(
            "no images of 8 bits lie behind the map's vertices, so nothing is alike as a whole;"
            " give candidates=local"
        )
    return WholeImages(vertex=np.array(vertices), vectors=np.stack(vectors))


def _pictures(map_: Map) -> Iterator[tuple[int, CameraFrame]]:
    """Yield the images behind a map, with their vertices; those that cannot be decoded are left out."""
    decoder = ImageDecode(ImageDecodeConfig())
    for mission in range(len(map_.missions)):
        for row, message in recorded(map_, record_rows(map_, mission)):
            if not isinstance(message, EncodedImage | CameraFrame):
                continue
            frame = decoder.decode(message)
            if isinstance(frame, CameraFrame) and frame.encoding in _OF_LIGHT:
                yield int(map_.resources.vertex[row]), frame
