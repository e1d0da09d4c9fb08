"""Which markers are known, where they are and how large: written in the graph file, or in a file of their own.

    tags:
      - {id: 3, size_m: 0.5, T_frame_tag: [x, y, z, qx, qy, qz, qw]}

A tag's frame is in its middle, x to the right, y upwards and z towards who reads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, NonNegativeInt, PositiveFloat

from mapstream.operators.images.marker_poses import square_corners
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError
from mapstream.streams.fields import Fields
from mapstream.streams.geometry import SE3

_Seven = Annotated[tuple[float, ...], Field(min_length=7, max_length=7)]


class TagConfig(OperatorConfig):
    """One marker of which something is known."""

    id: NonNegativeInt
    size_m: PositiveFloat | None = None
    """Of the black square, if it is not that of all."""
    T_frame_tag: _Seven | None = None
    """Where it is: x, y, z [m] and the quaternion x, y, z, w; left out, the map finds it."""


@dataclass(frozen=True, slots=True, eq=False)
class Tags:
    """What is known of markers, by their numbers."""

    sizes_m: Mapping[int, float]
    places: Mapping[int, SE3]  # T_frame_tag of those whose place is known
    size_m: float | None  # of all others

    def size_of(self, number: int) -> float | None:
        """Return the side of the black square [m]; None if nobody said it."""
        return self.sizes_m.get(number, self.size_m)

    def corners_of(self, number: int) -> FloatArray:
        """Return the corners (4, 3) [m] of a marker in its frame.

        Raises:
            ConfigError: If nobody said how large it is.
        """
        size_m = self.size_of(number)
        if size_m is None:
            raise ConfigError(f"marker {number}: its size_m is not known")
        return square_corners(size_m)

    def corners_in_frame(self, number: int) -> FloatArray:
        """Return the corners (4, 3) [m] of a marker whose place is known."""
        T_frame_tag = self.places[number]
        return self.corners_of(number) @ T_frame_tag.R.T + T_frame_tag.t


def tags_of(given: tuple[TagConfig, ...], file: Path | None, size_m: float | None) -> Tags:
    """Join what the graph file and the file of tags say.

    Raises:
        ConfigError: If the file is wrong, or a tag is there twice.
    """
    tags = [*given, *(_read(file) if file is not None else [])]
    numbers = [tag.id for tag in tags]
    twice = sorted({number for number in numbers if numbers.count(number) > 1})
    if twice:
        raise ConfigError(f"tags: {', '.join(map(str, twice))}: described twice")
    return Tags(
        sizes_m={tag.id: tag.size_m for tag in tags if tag.size_m is not None},
        places={
            tag.id: SE3.from_quat_xyzw(tag.T_frame_tag[3:], tag.T_frame_tag[:3])
            for tag in tags
            if tag.T_frame_tag is not None
        },
        size_m=size_m,
    )


def _read(path: Path) -> list[TagConfig]:
    fields = Fields.of_file(path)
    return [_tag(tag) for tag in fields.items("tags")]


def _tag(fields: Fields) -> TagConfig:
    place = fields.matrix("T_frame_tag", (7,)) if "T_frame_tag" in fields else None
    return fields.build(
        "id",
        lambda: TagConfig(
            id=fields.integer("id"),
            size_m=fields.optional_number("size_m"),
            T_frame_tag=None if place is None else tuple(place.tolist()),
        ),
    )
