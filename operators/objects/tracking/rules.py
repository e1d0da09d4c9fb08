"""When a detection counts, and when a track: for all classes, and for single ones."""

from __future__ import annotations

from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.objects.tracking.box_filter import BoxNoise
from mapstream.operators.operator import OperatorConfig


class ClassRules(OperatorConfig):
    """What is different for a class."""

    min_score: float | None = Field(default=None, ge=0.0, le=1.0)
    num_hits: PositiveInt | None = None
    max_age_s: PositiveFloat | None = None
    max_appearance: PositiveFloat | None = None


class TrackRules(OperatorConfig):
    """Options of `object_tracker`."""

    min_score: float = Field(default=0.8, ge=0.0, le=1.0)
    """Detections that their detector is less sure of are dropped."""
    num_hits: PositiveInt = 3
    """So many images in a row must show an object before its track counts."""
    max_age_s: PositiveFloat = 1.5
    """A track that was not seen for longer ends."""
    max_appearance: PositiveFloat = 0.55
    """Cosine distance of a detection from the most alike that its track ever looked; as fits `object_descriptors`."""
    classes: dict[str, ClassRules] = Field(default_factory=dict)
    """What is different for some classes, by their names."""
    motion_weight: float = Field(default=0.3, ge=0.0, le=1.0)
    """How much the place counts in the choice among detections that are possible; the rest is appearance."""
    gate: PositiveFloat = 9.4877
    """Squared Mahalanobis distance within which a detection is possible; by default 95 % of true ones are."""
    min_overlap: float = Field(default=0.2, gt=0.0, le=1.0)
    """Intersection over union with which a box goes on that motion and appearance do not explain."""
    max_overlap: float = Field(default=0.8, gt=0.0, le=1.0)
    """Of two detections of one class that overlap by more, the one with the lower score is dropped."""
    gallery_size: PositiveInt = 100
    """Descriptors that are kept of a track."""
    noise: BoxNoise = Field(default_factory=BoxNoise)
    """How well boxes are detected, and how they move."""

    def of(self, label: str) -> TrackRules:
        """Return the rules for a class."""
        special = self.classes.get(label)
        if special is None:
            return self
        return self.model_copy(update=special.model_dump(exclude_none=True))
