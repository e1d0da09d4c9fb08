"""The landmarks of a map by what they look like: a shelf for each kind of feature, which grows vertex by vertex."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import numpy.typing as npt
from pydantic import Field, PositiveFloat

from mapstream.operators.places.growing import Growing
from mapstream.operators.places.indices.index import (
    DescriptorIndex,
    Descriptors,
    IndexConfig,
    make_index,
)
from mapstream.operators.places.views import View
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.projections import DescriptorProjection
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray


class LookConfig(IndexConfig):
    """When two descriptors look alike."""

    max_bits: float = Field(default=0.15, gt=0.0, lt=1.0)
    """The share of the bits in which two descriptors of one point may differ."""
    max_distance: PositiveFloat = 0.8
    """How far apart two descriptors that are numbers may be, as a share of their length."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """Keypoints of a frame, and landmarks that look like them. A keypoint may have several."""

    view: IntArray  # (N,) which view of the frame
    feature: IntArray  # (N,) which keypoint of it
    landmark: IntArray  # (N,) rows of the map
    vertex: IntArray  # (N,) from which the landmark looked so
    distance: Float32Array  # (N,) of the descriptors

    def __len__(self) -> int:
        return len(self.view)

    def take(self, rows: npt.NDArray[np.int64] | BoolArray) -> Matches:
        return Matches(**{each.name: getattr(self, each.name)[rows] for each in fields(self)})


_NONE = Matches(
    view=np.empty(0, np.int64),
    feature=np.empty(0, np.int64),
    landmark=np.empty(0, np.int64),
    vertex=np.empty(0, np.int64),
    distance=np.empty(0, np.float32),
)


@dataclass(slots=True, eq=False)
class _Shelf:
    """The descriptors of one kind."""

    index: DescriptorIndex
    landmark: Growing = field(default_factory=Growing)  # of each descriptor
    vertex: Growing = field(default_factory=Growing)
    blocks: dict[int, list[tuple[int, Descriptors]]] = field(default_factory=dict)
    """By vertex: its descriptors, each block with the row of the first."""


class PlaceDatabase:
    """Landmarks that frames can be compared with.

    Args:
        config: Of the indices, and when descriptors look alike.
        projections: By kind, of the multi-index, as `projections_of` reads them; learnt from the descriptors without.
    """

    def __init__(
        self, config: LookConfig, projections: Mapping[str, DescriptorProjection] | None = None
    ) -> None:
        self._config = config
        self._projections = projections or {}
        self._shelves: dict[str, _Shelf] = {}
        self._landmarks_of: dict[int, list[IntArray]] = {}  # by vertex
        self.num_descriptors_of: dict[int, int] = {}  # by vertex

    def __len__(self) -> int:
        return sum(self.num_descriptors_of.values())

    def add(self, map_: Map, vertex: int, views: Sequence[View]) -> None:
        """Take in the landmarks that a vertex sees; keypoints of none, or of a bad one, are left out."""
        for view in views:
            landmark = map_.observations.landmark[view.rows]
            keep = landmark >= 0
            keep[keep] &= map_.landmarks.quality[landmark[keep]] != "bad"
            if keep.any():
                self._put(view, keep, landmark[keep], vertex)

    def _put(self, view: View, keep: BoolArray, landmark: IntArray, vertex: int) -> None:
        descriptors = view.descriptors[keep]
        shelf = self._shelves.get(view.kind)
        if shelf is None:
            projection = self._projections.get(view.kind)
            index = make_index(descriptors.shape[1], descriptors.dtype, self._config, projection)
            shelf = self._shelves[view.kind] = _Shelf(index)
        shelf.blocks.setdefault(vertex, []).append((len(shelf.landmark), descriptors))
        shelf.index.add(descriptors)
        shelf.landmark.extend(landmark)
        shelf.vertex.extend(np.full(len(landmark), vertex))
        self._landmarks_of.setdefault(vertex, []).append(landmark)
        self.num_descriptors_of[vertex] = self.num_descriptors_of.get(vertex, 0) + len(landmark)

    def landmarks_of(self, vertex: int) -> IntArray:
        """Return the landmarks that a vertex sees."""
        return np.concatenate(self._landmarks_of[vertex])

    def match(self, views: Sequence[View], vertices: Sequence[int] | None = None) -> Matches:
        """Return which landmarks look like the keypoints of a frame.

        Args:
            views: Of the frame.
            vertices: Only landmarks as these saw them; any without.
        """
        found = [self._matches(number, view, vertices) for number, view in enumerate(views)]
        names = [each.name for each in fields(Matches)]
        return Matches(
            **{name: np.concatenate([getattr(m, name) for m in [_NONE, *found]]) for name in names}
        )

    def _matches(self, number: int, view: View, vertices: Sequence[int] | None) -> Matches:
        shelf = self._shelves.get(view.kind)
        if shelf is None or not len(view):
            return _NONE
        index, row_of = shelf.index, None
        if vertices is not None:
            index, row_of = self._part(shelf, view, vertices)
        if not len(index):
            return _NONE
        near = index.search(view.descriptors, self._config.neighbours_among(len(index)))
        limit = self._limit(view.descriptors)
        feature, rank = np.nonzero((near.rows >= 0) & (near.distances <= limit))
        rows = near.rows[feature, rank]
        rows = rows if row_of is None else row_of[rows]
        landmark = shelf.landmark.values[rows]
        # of the descriptors of one landmark, the nearest
        _, first = np.unique(np.stack([feature, landmark]), axis=1, return_index=True)
        first = np.sort(first)
        return Matches(
            view=np.full(len(first), number),
            feature=feature[first],
            landmark=landmark[first],
            vertex=shelf.vertex.values[rows[first]],
            distance=near.distances[feature, rank][first],
        )

    def _part(
        self, shelf: _Shelf, view: View, vertices: Sequence[int]
    ) -> tuple[DescriptorIndex, IntArray]:
        """Return an index of what some vertices saw, and the row on the shelf of each of its rows."""
        exact = self._config.model_copy(update={"binary": "exact", "numbers": "exact"})
        index = make_index(view.descriptors.shape[1], view.descriptors.dtype, exact)
        rows = [np.empty(0, np.int64)]
        for vertex in vertices:
            for first, descriptors in shelf.blocks.get(vertex, []):
                index.add(descriptors)
                rows.append(np.arange(first, first + len(descriptors)))
        return index, np.concatenate(rows)

    def _limit(self, descriptors: Descriptors) -> float:
        """Return how far apart descriptors of one point may be."""
        if descriptors.dtype == np.uint8:
            num_bits = 8 * int(descriptors.shape[1])
            return self._config.max_bits * num_bits
        lengths: FloatArray = np.linalg.norm(descriptors, axis=1)
        return self._config.max_distance * float(lengths.mean())
