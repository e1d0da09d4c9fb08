"""Landmarks of the objects in a map, one for each: its class, place, orientation and extent.

Tracks become things (`placing.py`), things that are one become one (`same.py`), what was seen too rarely goes.
All is found anew from the observations and the poses of now, so that a second call changes nothing.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, section IV-D.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from mapstream.operators.landmarks.locating import REASONS
from mapstream.operators.objects.landmarks.movers import moves
from mapstream.operators.objects.landmarks.same import Matcher, SameConfig, Thing
from mapstream.operators.objects.landmarks.sightings import Sightings, sightings_of
from mapstream.operators.objects.landmarks.writing import KIND, written
from mapstream.operators.objects.moving import MovingConfig
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.object_payload import object_payload
from mapstream.streams.arrays import IntArray

_MAX_PASSES = 5
_MOVES = "moves"


class ObjectLandmarksConfig(SameConfig):
    """Options of `object_landmarks`."""

    moving: MovingConfig | None = MovingConfig()
    """When a tracked thing moves and is no landmark; null: never."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectLandmarksReport:
    """What became of the tracks of objects."""

    num_objects: int  # landmarks now
    num_joined: int  # tracks and landmarks that are part of another one now
    num_with_extent: int
    not_found: dict[str, int]  # tracks without a landmark, by reason


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Sightings that belong together, and the rows of landmarks that they have."""

    members: IntArray
    landmarks: tuple[int, ...] = ()


def object_landmarks(
    map_: Map, config: ObjectLandmarksConfig | None = None
) -> tuple[Map, ObjectLandmarksReport]:
    """Return the map with one landmark for each object that stands and that its detections determine.

    Landmarks that people named, and those that edges lead to, stay however rarely they were seen.
    So do those whose detections do not determine a place any more: they stay where they are.
    """
    config = config or ObjectLandmarksConfig()
    sightings = sightings_of(map_)
    begun = _with_landmarks(sightings)
    tracks = _tracks(sightings)
    movers = [
        each
        for each in _not_in(begun, tracks, len(sightings))
        if config.moving is not None and moves(map_, sightings, each.members, config.moving)
    ]
    standing = [each for each in tracks if each not in movers]
    found = _found(map_, sightings, begun, standing, config)
    kept = {row for group in found.groups for row in group.landmarks}
    goes = {row for group in begun for row in group.landmarks} - kept
    done, num_with_extent = written(map_, sightings, found.things, sorted(goes))
    reasons = found.reasons + Counter({_MOVES: len(movers)})
    return done, ObjectLandmarksReport(
        num_objects=int((done.landmarks.kind == KIND).sum()),
        num_joined=_num_joined([*standing, *begun], len(sightings), found.things),
        num_with_extent=num_with_extent,
        not_found={reason: count for reason, count in sorted(reasons.items()) if count},
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    things: list[Thing]
    groups: list[_Group]  # of these, and landmarks that have no place any more
    reasons: Counter[str]  # of tracks that are no thing


def _found(
    map_: Map,
    sightings: Sightings,
    begun: list[_Group],
    tracks: list[_Group],
    config: ObjectLandmarksConfig,
) -> _Found:
    """Return the things that landmarks and tracks are."""
    matcher = Matcher(sightings, config)
    found = _Found([], begun, Counter())
    for _ in range(_MAX_PASSES):  # what one pass finds may tell the next where a left-over belongs
        before = found.groups
        groups = [*before, *_not_in(before, tracks, len(sightings))]
        split = [thing for each in groups for thing in _things(matcher, each, config)]
        whole, parts = matcher.made_one(split)
        things = [t for t in whole if _is_held(map_, t) or _is_seen(sightings, t, config)]
        reasons = Counter(part.place.outcome for part in parts)
        reasons[REASONS[0]] += len(whole) - len(things)
        held = [part for part in parts if part.landmarks]
        now = [_Group(thing.members, thing.landmarks) for thing in [*things, *held]]
        found = _Found(things, now, reasons)
        if [g.members.tobytes() for g in now] == [g.members.tobytes() for g in before]:
            break
    return found


def _with_landmarks(sightings: Sightings) -> list[_Group]:
    rows: list[int] = np.unique(sightings.landmarks[sightings.landmarks >= 0]).tolist()
    return [_Group(np.flatnonzero(sightings.landmarks == row), (row,)) for row in rows]


def _tracks(sightings: Sightings) -> list[_Group]:
    """Return all tracks; what has a 3D point and no track is one of its own."""
    has_point = np.isfinite(sightings.views.points).all(axis=1)
    track = np.where(sightings.tracks >= 0, sightings.tracks, -1 - np.arange(len(sightings)))
    group = np.unique(np.stack([sightings.missions, track]), axis=1, return_inverse=True)[1].ravel()
    rows = np.flatnonzero((sightings.tracks >= 0) | has_point)
    rows = rows[np.argsort(group[rows], kind="stable")]
    cuts = np.flatnonzero(np.diff(group[rows])) + 1
    return [_Group(members) for members in np.split(rows, cuts) if len(members)]


def _not_in(groups: list[_Group], tracks: list[_Group], num_sightings: int) -> list[_Group]:
    """Return the tracks of which nothing is in a group."""
    is_in = np.zeros(num_sightings, np.bool_)
    for group in groups:
        is_in[group.members] = True
    return [track for track in tracks if not is_in[track.members].any()]


def _things(matcher: Matcher, group: _Group, config: SameConfig) -> list[Thing]:
    """Return the thing that a track shows, and another one if the tracker went over to it."""
    thing = matcher.thing(group.members, group.landmarks)
    rest = np.setdiff1d(group.members, thing.members)
    if len(rest) < config.min_observations:
        return [thing]
    return [thing, *_things(matcher, _Group(rest), config)]


def _is_seen(sightings: Sightings, thing: Thing, config: SameConfig) -> bool:
    """Return whether enough images show a thing."""
    return len(np.unique(sightings.images[thing.members])) >= config.min_observations


def _is_held(map_: Map, thing: Thing) -> bool:
    """Return whether a landmark that the thing has already must stay."""
    ends = np.concatenate([map_.edges.landmark_a, map_.edges.landmark_b])
    named = [object_payload(map_.landmarks, row).get("name") for row in thing.landmarks]
    return any(named) or bool(np.isin(thing.landmarks, ends).any())


def _num_joined(begun: list[_Group], num_sightings: int, things: list[Thing]) -> int:
    """Return how many of the groups that there were are part of a thing that another one began."""
    group = np.full(num_sightings, -1)
    for number, each in enumerate(begun):
        group[each.members] = number
    return sum(len(np.unique(group[thing.members])) - 1 for thing in things)
