"""Images of 16 bits (thermal cameras) or floats as 8 bits, stretched over the values that matter."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.images.frame_filter import FrameFilter, require_encoding
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.messages.sensors import CameraFrame

_SAMPLED = 4  # every so many rows and columns tell the percentiles


class EightBitsConfig(OperatorConfig):
    """Options of `eight_bits`."""

    range: Literal["percentile", "min_max", "fixed"] = Field(
        default="percentile",
        description="of values that are told apart: all but the rarest, all of the image, or those given",
    )
    cut: float = Field(
        default=0.01, ge=0.0, lt=0.5, description="of `percentile`: the part cut off at either end"
    )
    least: float = Field(default=0.0, description="of `fixed`: the value that becomes black")
    most: float = Field(default=65535.0, description="of `fixed`: the value that becomes white")
    least_span: PositiveFloat = Field(
        default=16.0, description="a narrower range is noise, and is not stretched any further"
    )


class EightBits(FrameFilter):
    """Make mono8 of mono16 or 32FC1; mono8 passes as it is.

    A dead or burning pixel takes the whole range from `min_max`, and nothing from `percentile`.
    """

    def __init__(self, config: EightBitsConfig) -> None:
        self._config = config

    def changed(self, frame: CameraFrame) -> CameraFrame:
        require_encoding(frame, "eight_bits", ("mono8", "mono16", "16UC1", "32FC1"))
        if frame.encoding == "mono8":
            return frame
        image = np.nan_to_num(frame.image.astype(np.float32), copy=False)
        least, most = self._range(image)
        span = max(most - least, self._config.least_span)
        stretched = np.clip((image - least) * (255.0 / span), 0, 255)
        return replace(frame, image=np.round(stretched).astype(np.uint8), encoding="mono8")

    def _range(
        self, image: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    ) -> tuple[float, float]:
        config = self._config
        if config.range == "fixed":
            return config.least, config.most
        if config.range == "min_max":
            return float(image.min()), float(image.max())
        sampled = image[::_SAMPLED, ::_SAMPLED]
        least, most = np.quantile(sampled, [config.cut, 1.0 - config.cut])
        return float(least), float(most)
