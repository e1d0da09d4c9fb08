"""For each object of a map the detections whose descriptors stand for all of it.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section IV-D, whose implementation keeps k medoids of each landmark.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field, PositiveInt

from mapstream.operators.objects.representatives import representatives
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.features import descriptors_of
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray

_KIND = "object"


class RepresentObjectsConfig(OperatorConfig):
    """Options of `represent-objects`."""

    max_per_object: PositiveInt = 8
    """Descriptors that stand for one object, at most."""
    min_silhouette: float = Field(default=0.15, ge=-1.0, le=1.0)
    """Of a division into clusters that counts; an object without one has a single descriptor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RepresentReport:
    """What stands for what."""

    num_objects: int  # with descriptors
    num_descriptors: int
    num_representatives: int


def represent_objects(
    map_: Map, config: RepresentObjectsConfig | None = None
) -> tuple[Map, RepresentReport]:
    """Return the map whose detections say which of them stand for their landmark.

    What was chosen before is forgotten, so that a second call changes nothing.

    Raises:
        MapError: If the descriptors of an object are not alike.
    """
    config = config or RepresentObjectsConfig()
    described = _described(map_)
    landmark = map_.observations.landmark[map_.detections.observation[described]]
    chosen = np.zeros(len(map_.detections), np.bool_)
    for number in np.unique(landmark):
        rows = described[landmark == number]
        descriptors = descriptors_of(map_, map_.detections.observation[rows])
        best = representatives(
            descriptors, max_count=config.max_per_object, min_silhouette=config.min_silhouette
        )
        chosen[rows[best]] = True
    report = RepresentReport(
        num_objects=len(np.unique(landmark[chosen[described]])),
        num_descriptors=len(described),
        num_representatives=int(chosen.sum()),
    )
    return replace(map_, detections=replace(map_.detections, is_representative=chosen)), report


def _described(map_: Map) -> IntArray:
    """Return the rows of detections of objects that have a landmark and a descriptor."""
    seen, observation = map_.observations, map_.detections.observation
    landmark, feature_set = seen.landmark[observation], seen.feature_set[observation]
    rows = np.flatnonzero((landmark >= 0) & (feature_set >= 0))
    is_object = map_.landmarks.kind[landmark[rows]] == _KIND
    described: IntArray = rows[is_object & (map_.feature_sets.width[feature_set[rows]] > 0)]
    return described
