"""The tracks of all objects that one camera sees.

Source: Wojke, Bewley and Paulus, Simple Online and Realtime Tracking with a Deep Association Metric, ICIP 2017, from the
paper's text. Ages are times here, and so are not tied to a rate; and classes never mix.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapstream.operators.objects.detectors.suppression import distinct
from mapstream.operators.objects.tracking.box_filter import (
    BoxFilter,
    BoxStates,
    corners_of,
    shapes_of,
)
from mapstream.operators.objects.tracking.gallery import Gallery
from mapstream.operators.objects.tracking.matching import assigned, cascaded, overlaps
from mapstream.operators.objects.tracking.rules import TrackRules
from mapstream.operators.operator import warn
from mapstream.operators.tracking.track_ids import TrackNumbers
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import NO_TRACK


@dataclass(slots=True, eq=False)
class _Tracks:
    """T tracks, in the order of their beginnings."""

    states: BoxStates
    ids: IntArray  # (T,) NO_TRACK until confirmed
    classes: IntArray  # (T,)
    hits: IntArray  # (T,) how often each was seen
    seen_ns: IntArray  # (T,) when last
    galleries: list[Gallery]

    def __len__(self) -> int:
        return len(self.ids)

    def keep(self, chosen: BoolArray) -> None:
        """Forget all but some."""
        if chosen.all():
            return
        self.states = self.states.rows(chosen)
        self.ids, self.classes = self.ids[chosen], self.classes[chosen]
        self.hits, self.seen_ns = self.hits[chosen], self.seen_ns[chosen]
        self.galleries = [self.galleries[row] for row in np.flatnonzero(chosen).tolist()]

    def begin(self, states: BoxStates, classes: IntArray, stamp_ns: int, gallery_size: int) -> None:
        """Add new ones."""
        n = len(states)
        if n == 0:
            return
        self.states = self.states.and_(states)
        self.ids = np.append(self.ids, np.full(n, NO_TRACK))
        self.classes = np.append(self.classes, classes)
        self.hits = np.append(self.hits, np.zeros(n, np.int64))
        self.seen_ns = np.append(self.seen_ns, np.full(n, stamp_ns))
        self.galleries += [Gallery(gallery_size) for _ in range(n)]


class CameraTracks:
    """The tracks of one camera."""

    def __init__(self, rules: TrackRules, frame: str, width_px: int) -> None:
        self._rules = rules
        self._filter = BoxFilter(rules.noise, width_px)
        self._numbers = TrackNumbers(frame)
        nothing = np.empty(0, np.int64)
        states = self._filter.begun(np.empty((0, 4)))
        self._tracks = _Tracks(states, nothing, nothing, nothing, nothing, [])
        self._of_class: dict[str, TrackRules] = {}  # in the order in which classes appear
        self._stamp_ns = 0  # of the last image
        self._looks = ("", 0)  # kind and length of descriptors

    def follow(self, objects: ObjectDetections) -> IntArray:
        """Return the track ids (N,) of the objects in the next image; NO_TRACK for those that are dropped."""
        classes = self._classes_of(objects)
        counted = self._counted(objects, classes)
        shapes = shapes_of(objects.boxes_px[counted])
        looks = self._looks_of(objects)[counted]
        matches = self._matched(objects.stamp_ns, classes[counted], shapes, looks)
        self._see(matches, objects.stamp_ns, shapes, looks)
        ids = np.full(len(objects), NO_TRACK)
        ids[counted[matches[:, 1]]] = self._tracks.ids[matches[:, 0]]
        return ids

    def _classes_of(self, objects: ObjectDetections) -> IntArray:
        for label in objects.labels:
            self._of_class.setdefault(label, self._rules.of(label))
        numbers = {label: number for number, label in enumerate(self._of_class)}
        return np.array([numbers[label] for label in objects.labels], np.int64)

    def _counted(self, objects: ObjectDetections, classes: IntArray) -> IntArray:
        """Return the rows of detections that count: with a box, sure enough, and not one object twice."""
        boxes = objects.boxes_px.astype(np.float64)
        is_box = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
        for _ in range(int((~is_box).sum())):
            warn(f"objects of {objects.frame} whose box has no area were dropped")
        rows = np.flatnonzero(is_box & (objects.scores >= self._each("min_score")[classes]))
        same = classes[rows, None] == classes[rows]
        limit = self._rules.max_overlap
        if np.triu(same & (overlaps(boxes[rows], boxes[rows]) > limit), 1).any():
            found = objects.boxes_px[rows], objects.scores[rows], classes[rows]
            rows = np.sort(rows[distinct(*found, max_overlap=limit, max_class_overlap=1.0)])
        return rows

    def _looks_of(self, objects: ObjectDetections) -> Float32Array:
        """Return the descriptors (N, D) of unit length; NaN where there is none."""
        given = objects.descriptors
        if given is None or not np.isfinite(given[:, :1]).any():
            return np.full((len(objects), max(self._looks[1], 1)), np.nan, np.float32)
        looks = (objects.descriptor_kind, given.shape[1])
        if looks != self._looks:
            if self._looks[1]:
                warn(f"descriptors of {objects.frame} changed from {self._looks} to {looks}")
            self._looks = looks
            self._tracks.galleries = [
                Gallery(self._rules.gallery_size) for _ in self._tracks.galleries
            ]
        return given

    def _each(self, rule: str) -> FloatArray:
        """Return a rule for each class (C,)."""
        return np.array([getattr(rules, rule) for rules in self._of_class.values()], np.float64)

    def _matched(
        self, stamp_ns: int, classes: IntArray, shapes: FloatArray, looks: Float32Array
    ) -> IntArray:
        """Return the pairs (N, 2) of tracks and detections, after old tracks ended and new ones began."""
        tracks = self._tracks
        tracks.states = self._filter.predicted(tracks.states, (stamp_ns - self._stamp_ns) / 1e9)
        tracks.keep((stamp_ns - tracks.seen_ns) / 1e9 <= self._each("max_age_s")[tracks.classes])
        possible = tracks.classes[:, None] == classes
        is_sure = tracks.ids != NO_TRACK
        costs = self._costs(possible & is_sure[:, None], shapes, looks)
        pairs = cascaded(costs, tracks.seen_ns)
        possible[pairs[:, 0]] = False
        possible[:, pairs[:, 1]] = False
        possible[tracks.seen_ns < self._stamp_ns] = False  # what was just seen moved little
        if possible.any():
            overlap = overlaps(corners_of(tracks.states.mean), corners_of(shapes))
            possible &= overlap >= self._rules.min_overlap
            pairs = np.concatenate([pairs, assigned(np.where(possible, 1 - overlap, np.inf))])
        self._stamp_ns = stamp_ns
        return self._with_new(pairs, stamp_ns, classes, shapes)

    def _costs(self, possible: BoolArray, shapes: FloatArray, looks: Float32Array) -> FloatArray:
        """Return what pairs (T, N) cost, from 0 to 1; infinite where they cannot be."""
        rules, tracks = self._rules, self._tracks
        motion = self._filter.distances(tracks.states, shapes) / rules.gate
        possible = possible & (motion <= 1)
        appearance = self._appearance(possible, looks)
        possible &= ~(appearance > 1)
        both = rules.motion_weight * motion + (1 - rules.motion_weight) * appearance
        return np.where(possible, np.where(np.isnan(appearance), motion, both), np.inf)

    def _appearance(self, possible: BoolArray, looks: Float32Array) -> FloatArray:
        """Return cosine distances (T, N) as parts of their limits, for pairs that may be; NaN if not known.

        Where a track and a detection have no other choice, it is enough that the track looked so when it was seen last.
        """
        tracks = self._tracks
        found = np.full(possible.shape, np.nan)
        rows, columns = np.nonzero(possible & np.isfinite(looks[:, 0]))
        limits = self._each("max_appearance")[tracks.classes]
        has_rivals = possible.sum(axis=0) > 1
        ends = np.searchsorted(rows, np.arange(len(tracks)), side="right").tolist()
        for row, (start, end) in enumerate(pairwise([0, *ends])):
            of_row, gallery = columns[start:end], tracks.galleries[row]
            if end - start == 1 and not has_rivals[of_row[0]]:
                distance = gallery.last_distance(looks[of_row[0]])
                if distance <= limits[row]:
                    found[row, of_row] = distance / limits[row]
                    continue
            if start < end:
                found[row, of_row] = gallery.distances(looks[of_row]) / limits[row]
        return found

    def _with_new(
        self, pairs: IntArray, stamp_ns: int, classes: IntArray, shapes: FloatArray
    ) -> IntArray:
        """Return the pairs, after unsure tracks without a match ended and each detection without one began one."""
        tracks = self._tracks
        stays = tracks.ids != NO_TRACK
        stays[pairs[:, 0]] = True
        tracks.keep(stays)
        pairs = np.column_stack([np.cumsum(stays)[pairs[:, 0]] - 1, pairs[:, 1]])
        is_new = np.ones(len(shapes), np.bool_)
        is_new[pairs[:, 1]] = False
        new = np.flatnonzero(is_new)
        begun = np.column_stack([len(tracks) + np.arange(len(new)), new])
        tracks.begin(
            self._filter.begun(shapes[new]), classes[new], stamp_ns, self._rules.gallery_size
        )
        return np.concatenate([pairs, begun])

    def _see(self, pairs: IntArray, stamp_ns: int, shapes: FloatArray, looks: Float32Array) -> None:
        """Let tracks know that they were seen, and confirm those that were seen often enough."""
        tracks, (rows, columns) = self._tracks, pairs.T
        is_old = tracks.hits[rows] > 0
        tracks.states = self._filter.corrected(tracks.states, rows[is_old], shapes[columns[is_old]])
        tracks.hits[rows] += 1
        tracks.seen_ns[rows] = stamp_ns
        for row, column in pairs.tolist():
            tracks.galleries[row].add(looks[column])
        is_enough = tracks.hits >= self._each("num_hits")[tracks.classes]
        confirmed = np.flatnonzero(is_enough & (tracks.ids == NO_TRACK))
        tracks.ids[confirmed] = self._numbers.take(len(confirmed))
