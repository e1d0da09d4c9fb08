"""Missions whose place is not known, found by what they see of those that are anchored.

Each frame that is recognised says where its mission lies; the poses on which most frames agree win.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-C; maplab's map anchoring, whose numbers are the defaults.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.maps.missions import find_mission
from mapstream.operators.places.agreement import largest_agreement, mean_pose
from mapstream.operators.places.database import PlaceDatabase
from mapstream.operators.places.recognition import RecognitionConfig, recognize, seed_of
from mapstream.operators.places.searching import landmark_positions
from mapstream.operators.places.views import VertexViews
from mapstream.recordings.maps.build import anchored
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.projections import projections_of
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, invert


class AnchoringConfig(RecognitionConfig):
    """When frames agree on where their mission lies."""

    max_turn_rad: PositiveFloat = 0.174
    """Between two frames that agree."""
    max_shift_m: PositiveFloat = 2.0
    """The same of the positions."""
    min_frames: PositiveInt = 10
    """That agree."""
    min_share: float = Field(default=0.2, ge=0.0, le=1.0)
    """Of the frames that were recognised, those that agree."""
    trials: PositiveInt = 3
    """Rounds over all missions; one that is anchored may carry others."""
    every: PositiveInt = 1
    """One vertex in so many is compared."""
    mission: str | None = None
    """First digits of an id, or a name: only this mission; null: all whose place is not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchoredMission:
    """What came of one mission, in its last trial."""

    mission_id: str
    num_compared: int  # frames
    num_recognised: int
    num_agreeing: int
    verdict: str  # "anchored", or why it is not


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchoringReport:
    """Which missions are anchored now."""

    missions: list[AnchoredMission]

    def lines(self) -> list[str]:
        """Return what to tell people."""
        return [
            f"mission {m.mission_id[:8]}: {m.verdict} ({m.num_recognised} of {m.num_compared} frames"
            f" recognised, {m.num_agreeing} agree)"
            for m in self.missions
        ] or ["every mission is anchored already"]

    @property
    def num_anchored(self) -> int:
        return sum(each.verdict == _ANCHORED for each in self.missions)


_ANCHORED = "anchored"


def anchor_missions(
    map_: Map, config: AnchoringConfig | None = None
) -> tuple[Map, AnchoringReport]:
    """Return the map with missions anchored to those that are known already; others stay unknown.

    Args:
        map_: The map; at least one mission is known.
        config: When frames agree.

    Raises:
        MapError: If there is no such mission as the config names.
    """
    config = config or AnchoringConfig()
    chosen = range(len(map_.missions))
    if config.mission is not None:
        chosen = range(row := find_mission(map_, config.mission), row + 1)
    reports: dict[int, AnchoredMission] = {}
    for _ in range(config.trials):
        is_known = map_.missions.is_base_frame_known
        before = map_
        for row in (row for row in chosen if not is_known[row]):
            map_, reports[row] = _anchor(map_, row, config)
        if map_ is before:
            break
    return map_, AnchoringReport(missions=[reports[row] for row in sorted(reports)])


def _anchor(map_: Map, mission_row: int, config: AnchoringConfig) -> tuple[Map, AnchoredMission]:
    rows = map_.vertices_of(mission_row)[:: config.every]
    places = _places_of_mission(map_, rows.tolist(), config)
    best = largest_agreement(places, config.max_turn_rad, config.max_shift_m)
    num = int(best.sum())
    verdict = _ANCHORED
    if num < config.min_frames:
        verdict = f"{num} frames agree, fewer than {config.min_frames}"
    elif num < config.min_share * len(places):
        verdict = f"{num} of {len(places)} frames agree, a smaller share than {config.min_share:g}"
    else:
        map_ = anchored(map_, mission_row, SE3(mean_pose(places[best])))
    return map_, AnchoredMission(
        mission_id=map_.mission_id(mission_row),
        num_compared=len(rows),
        num_recognised=len(places),
        num_agreeing=num,
        verdict=verdict,
    )


def _places_of_mission(map_: Map, vertices: list[int], config: AnchoringConfig) -> FloatArray:
    """Return T_map_mission (N, 4, 4) as each frame that is recognised says it."""
    views = VertexViews(map_, config.kinds)
    database = known_places(map_, config, views)
    landmarks_map = landmark_positions(map_)
    found = [np.empty((0, 4, 4))]
    for vertex in vertices:
        seed = seed_of(map_.vertices.id[vertex].tobytes())
        place = recognize(views.at(vertex), database, landmarks_map, config, seed=seed).found
        if place is not None:
            T_map_base = place.consensus.pose.T_map_base.matrix
            found.append(T_map_base[None] @ invert(map_.vertices.T_mission_base[vertex]))
    return np.concatenate(found)


def known_places(map_: Map, config: RecognitionConfig, views: VertexViews) -> PlaceDatabase:
    """Return a database of what missions with known places see."""
    database = PlaceDatabase(config.look, projections_of(map_, "index"))
    for vertex in np.flatnonzero(map_.missions.is_base_frame_known[map_.vertices.mission]).tolist():
        database.add(map_, vertex, views.at(vertex))
    return database
