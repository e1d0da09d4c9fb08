"""Recognisers of places behind one interface: local maps go in, and what looks like them comes out.

Built in: `birds_eye` (`birds_eye_places.py`) and `map_closures` (of the package map-closures, an extra).
Any other word is looked up among the installed entry points of the group `mapstream.place_recognizers`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, Protocol

from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError
from mapstream.streams.geometry import SE3

GROUP = "mapstream.place_recognizers"
BUILT_IN = ("birds_eye", "map_closures")


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """A place that looks like a local map, and how the two lie to each other by their looks."""

    key: int  # under which the place was added
    T_place_query: SE3
    num_inliers: int


class PlaceRecognizer(Protocol):
    """Places by their looks; it grows."""

    def add(self, key: int, points: FloatArray) -> None:
        """Take in a place: its local map (N, 3) in the frame of its base, z roughly up.

        Raises:
            EstimationError: If it cannot be looked at, as without ground.
        """

    def propose(self, points: FloatArray) -> list[Proposal]:
        """Return the places that look most like a local map (N, 3), the likeliest first.

        Raises:
            EstimationError: If it cannot be looked at.
        """
        ...


def make_recognizer(name: str, options: Mapping[str, Any]) -> PlaceRecognizer:
    """Return the recogniser that a config names, with its options.

    Raises:
        ConfigError: If there is none of this name, or its package is not installed.
        ValidationError: If an option is not one.
    """
    if name == "birds_eye":
        from mapstream.operators.lidar.places.birds_eye_places import (  # noqa: PLC0415  # OpenCV
            BirdsEyePlaces,
            BirdsEyePlacesConfig,
        )

        return BirdsEyePlaces(BirdsEyePlacesConfig.model_validate(options))
    if name == "map_closures":
        from mapstream.operators.lidar.places.closures import (  # noqa: PLC0415  # may be absent
            MapClosuresPlaces,
        )

        return MapClosuresPlaces(**options)
    installed = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in installed:
        known = ", ".join(sorted([*BUILT_IN, *installed]))
        raise ConfigError(f"unknown recogniser of places {name!r}; known: {known}")
    made: PlaceRecognizer = installed[name].load()(**options)
    return made
