"""What operators with a network for keypoints have in common."""

from __future__ import annotations

from abc import abstractmethod

import anyio.to_thread
import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.features.finder import FeatureFinder, Inputs, Outputs
from mapstream.operators.features.gray import gray
from mapstream.operators.features.rows import features_in
from mapstream.operators.networks.keypoints import KeypointNetwork
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures


class LearnedConfig(OperatorConfig):
    """Options of all networks that find keypoints."""

    max_features: PositiveInt = 512
    """So many are kept, the best."""
    image_scale: float = Field(default=1.0, gt=0.1, le=1.0)
    """Of the image in which is searched; the time goes with its square."""
    sigma_px: PositiveFloat = 0.8
    """Uncertainty of a keypoint at scale 1."""


class LearnedFeatures(FeatureFinder):
    """Find keypoints with a network."""

    def __init__(self, config: LearnedConfig) -> None:
        self._sigma_px = config.sigma_px / config.image_scale
        self._network: KeypointNetwork | None = None

    @abstractmethod
    def open(self) -> KeypointNetwork:
        """Return the network, ready to run."""

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        self._network = await anyio.to_thread.run_sync(self.open)
        await super().run(inputs, outputs)

    def detect(self, frame: CameraFrame) -> ImageFeatures:
        """Find the keypoints of one image, the best first."""
        if self._network is None:
            self._network = self.open()
        network = self._network
        found = network.find(gray(frame))
        sigmas_px = np.full(len(found.px), self._sigma_px, np.float32)
        return features_in(
            frame,
            network.kind,
            found.px,
            descriptors=found.descriptors,
            scores=found.scores,
            sigmas_px=sigmas_px,
        )
