"""XFeat's keypoints (Potje et al., XFeat: Accelerated Features for Lightweight Image Matching, CVPR 2024)."""

from __future__ import annotations

import numpy as np

from mapstream.operators.features.gray import GrayImage
from mapstream.operators.networks.installed import weights_of
from mapstream.operators.networks.keypoints import FittedImage, Keypoints, in_cells
from mapstream.operators.networks.learned_features import LearnedConfig, LearnedFeatures
from mapstream.operators.networks.sessions import Session
from mapstream.operators.networks.xfeat_network import CELL_PX, xfeat_model


class XFeatConfig(LearnedConfig):
    """Options of `xfeat`."""


class XFeat(LearnedFeatures):
    """Find keypoints with XFeat, and describe each by 64 numbers; about 40 ms per VGA image.

    Its weights come with `mapstream models install xfeat`.
    """

    def __init__(self, config: XFeatConfig) -> None:
        super().__init__(config)
        self._config = config

    def open(self) -> XFeatKeypoints:
        return XFeatKeypoints(self._config)


class XFeatKeypoints:
    """XFeat with installed weights.

    Raises:
        ConfigError: If they are not installed.
    """

    kind = "xfeat"

    def __init__(self, options: LearnedConfig) -> None:
        self._options = options
        self._session = Session(xfeat_model(weights_of("xfeat")), "xfeat")

    def find(self, image: GrayImage) -> Keypoints:
        """Return the keypoints of an image (H, W)."""
        height, width = (in_cells(n * self._options.image_scale, CELL_PX) for n in image.shape)
        fitted = FittedImage.of(image, (width, height))
        top_k = np.array([self._options.max_features])
        found = self._session.run({"image": fitted.image[None, None], "top_k": top_k})
        px = fitted.places(found["keypoints"])
        return Keypoints(px=px, scores=found["scores"], descriptors=found["descriptors"])
