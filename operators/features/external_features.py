"""Features and tracks that another program found: checked, and let in as they are.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-B (any number of types of features, found outside).
The messages are described in `docs/inputs.md`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.operator import Operator, OperatorConfig, report_loss, warn
from mapstream.operators.tracking.track_ids import first_number
from mapstream.recordings.feature_checks import feature_faults, width_fault
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.vision import NO_TRACK, ImageFeatures


class ExternalFeaturesConfig(OperatorConfig):
    """Options of `external_features`."""

    kinds: tuple[str, ...] = ()
    """Kinds that are let in, if not all."""
    ids_per_camera: bool = False
    """Each camera counts its tracks from zero: numbers are made to differ between cameras, for good."""


@dataclass(frozen=True)
class Inputs:
    """Of any kinds and cameras, also mixed."""

    features: Receiver[ImageFeatures]


@dataclass(frozen=True)
class Outputs:
    """The same messages, less those that cannot be used."""

    features: Sender[ImageFeatures]


class ExternalFeatures(Operator[Inputs, Outputs]):
    """Let in features and tracks of other programs. Track ids stay as they are.

    A message that cannot be used is left out, and counted by its reason; `mapstream doctor` gives the same reasons.
    """

    def __init__(self, config: ExternalFeaturesConfig) -> None:
        self._config = config
        self._last: dict[tuple[str, str], ImageFeatures] = {}  # by kind and camera, with keypoints

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for features in inputs.features:
            faults = self.faults(features)
            if faults:
                for fault in faults:
                    report_loss(f"features {features.kind} of {features.frame}: {fault}")
                outputs.features.advance(features.stamp_ns)
            elif self._config.kinds and features.kind not in self._config.kinds:
                warn(f"features {features.kind} of {features.frame} are not among `kinds`")
                outputs.features.advance(features.stamp_ns)
            else:
                await outputs.features.send(self.numbered(features))

    def faults(self, features: ImageFeatures) -> list[str]:
        """Return why a message cannot be used, by itself and after those before; nothing if it can."""
        key = (features.kind, features.frame)
        faults = feature_faults(features)
        before = self._last.get(key)
        change = width_fault(features, before) if before is not None else ""
        if change:
            faults.append(change)
        elif not faults and len(features):
            self._last[key] = features
        return faults

    def numbered(self, features: ImageFeatures) -> ImageFeatures:
        """Return the features with numbers of tracks that no other camera has, if that is wanted."""
        ids = features.track_ids
        if ids is None or not self._config.ids_per_camera:
            return features
        first = first_number(features.frame)
        return replace(features, track_ids=np.where(ids == NO_TRACK, NO_TRACK, ids + first))
