"""Straight lines in the ends of a laser's beams, by split and merge.

A stretch of neighbouring points is split where it is farthest from its chord, until what is left is straight;
neighbours that are straight together become one line again.
Source: Nguyen, Gaechter, Martinelli, Tomatis, Siegwart: A comparison of line extraction algorithms using 2D range
data for indoor mobile robotics, Autonomous Robots 23, 2007, section 3.1, with total least squares.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import FloatArray, IntArray

_AROUND = np.full(3, 1 / 3)  # one point alone, amid a line, does not split it
_Span = tuple[int, int]  # first point, and the one behind the last


class LineConfig(OperatorConfig):
    """What makes a line."""

    max_gap_m: PositiveFloat = 0.4
    """Between neighbouring points; behind a wider one begins another line."""
    max_off_m: PositiveFloat = 0.05
    """How far points may be from their line; three in a row count together."""
    min_length_m: PositiveFloat = 0.6
    min_points: int = Field(default=10, ge=3)
    sigma_range_m: PositiveFloat = 0.01
    """Of a range."""
    least_sigma_m: PositiveFloat = 0.003
    """Of a line's place: walls are not as even as many points make believe."""
    least_sigma_rad: PositiveFloat = 0.003
    """The same of its direction."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lines:
    """Straight pieces in a plane, seen from its origin."""

    middles: FloatArray  # (N, 2) [m] on the line, where its direction and its place are independent
    directions: FloatArray  # (N, 2) unit; the origin lies on their left side
    ends_m: FloatArray  # (N, 2) along the direction, from the middle
    sigmas_rad: FloatArray  # (N,) of the direction
    sigmas_m: FloatArray  # (N,) of the place, across
    num_points: IntArray  # (N,)
    rmse_m: FloatArray  # (N,)

    def __len__(self) -> int:
        return len(self.num_points)


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    middle: FloatArray  # (2,)
    direction: FloatArray  # (2,)
    along: FloatArray  # (K,) [m]
    across: FloatArray  # (K,) [m]


def find_lines(points: FloatArray, config: LineConfig) -> Lines:
    """Return the lines among points (N, 2) [m], seen from the origin in the order of their beams."""
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1) > config.max_gap_m
    cuts = [0, *(np.flatnonzero(gaps) + 1).tolist(), len(points)]
    found: list[FloatArray] = []
    for start, end in pairwise(cuts):
        for span in _merged(points, list(_straight(points, (start, end), config)), config):
            row = _measured(points[slice(*span)], config)
            if row[5] - row[4] >= config.min_length_m:
                found.append(row)
    table = np.array(found).reshape(-1, 10)
    return Lines(
        middles=table[:, :2],
        directions=table[:, 2:4],
        ends_m=table[:, 4:6],
        sigmas_rad=table[:, 6],
        sigmas_m=table[:, 7],
        num_points=table[:, 8].astype(np.int64),
        rmse_m=table[:, 9],
    )


def _straight(points: FloatArray, span: _Span, config: LineConfig) -> Iterator[_Span]:
    """Yield straight parts of a span, in order; those of too few points are left out."""
    waiting = [span]
    while waiting:
        start, end = waiting.pop()
        if end - start < config.min_points:
            continue
        part = points[start:end]
        if _is_straight(part, config):
            yield start, end
            continue
        chord = part[-1] - part[0]
        off = (part - part[0]) @ np.array([-chord[1], chord[0]])
        corner = start + int(np.clip(np.argmax(np.abs(off)), 1, len(part) - 2))
        waiting += [(corner, end), (start, corner + 1)]  # the last one is next


def _merged(points: FloatArray, spans: list[_Span], config: LineConfig) -> list[_Span]:
    """Return spans of which no two neighbours are straight together."""
    merged: list[_Span] = []
    for span in spans:
        while merged and span[0] - merged[-1][1] < config.min_points:
            joint = (merged[-1][0], span[1])
            if not _is_straight(points[slice(*joint)], config):
                break
            merged.pop()
            span = joint  # noqa: PLW2901  # it may take in the one before as well
        merged.append(span)
    return merged


def _is_straight(points: FloatArray, config: LineConfig) -> bool:
    off = _fitted(points).across
    return bool(np.abs(np.convolve(off, _AROUND, mode="same")).max() < config.max_off_m)


def _fitted(points: FloatArray, weights: FloatArray | None = None) -> _Line:
    """Return the line from which the squared distances of points (K, 2) are least."""
    middle = np.average(points, axis=0, weights=weights)
    offsets = points - middle
    scatter = (offsets * (1.0 if weights is None else weights[:, None])).T @ offsets
    angle = 0.5 * np.arctan2(2 * scatter[0, 1], scatter[0, 0] - scatter[1, 1])
    direction = np.array([np.cos(angle), np.sin(angle)])
    if direction[0] * middle[1] - direction[1] * middle[0] > 0:  # the origin is to the right
        direction = -direction
    across = offsets @ np.array([-direction[1], direction[0]])
    return _Line(middle, direction, offsets @ direction, across)


def _measured(points: FloatArray, config: LineConfig) -> FloatArray:
    """Return a row of `Lines` (10,); a range's noise counts as far as its beam is across the line."""
    first = _fitted(points)
    normal = np.array([-first.direction[1], first.direction[0]])
    across = np.abs(points @ normal) / np.linalg.norm(points, axis=1)
    sigmas = config.sigma_range_m * np.maximum(across, 0.1)
    line = _fitted(points, sigmas**-2)
    chi2 = max(1.0, float(np.mean((line.across / sigmas) ** 2)))
    sigma_m = np.sqrt(chi2 / (sigmas**-2).sum() + config.least_sigma_m**2)
    spread = (line.along**2 / sigmas**2).sum()
    sigma_rad = np.sqrt(chi2 / spread + config.least_sigma_rad**2)
    return np.array(
        [
            *line.middle,
            *line.direction,
            line.along.min(),
            line.along.max(),
            sigma_rad,
            sigma_m,
            len(points),
            np.sqrt(np.mean(line.across**2)),
        ]
    )
