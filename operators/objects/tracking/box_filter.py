"""Where boxes are and how fast they move: a Kalman filter for all boxes of a camera at once.

The state of a box is its middle, its width over its height, its height, and how fast each changes (Wojke et al., Simple
Online and Realtime Tracking with a Deep Association Metric, ICIP 2017, section 2.1). Nothing in the model ties these
four to each other, so that the filter of eight states is four filters of two, one beside the other in arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
from pydantic import PositiveFloat

from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import FloatArray, IntArray

_LEAST_PX = 1.0
_LEAST_ASPECT = 0.01


class BoxNoise(OperatorConfig):
    """What is expected of boxes and of how they move."""

    edge_sigma: PositiveFloat = 0.1
    """Of an edge of a detected box, as a share of the box's size; a pixel at least."""
    speed: PositiveFloat = 1.0
    """Of a box that is seen for the first time, in widths of the image per second (standard deviation)."""
    speed_change: PositiveFloat = 0.3
    """By how much that changes within a second; a camera in the hand moves all boxes."""
    growth: PositiveFloat = 0.5
    """The same two for the size and the shape of a box, as shares of them."""
    growth_change: PositiveFloat = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class BoxStates:
    """T boxes: x and y of the middle [px], width over height, height [px]; and their rates [1/s]."""

    mean: FloatArray  # (T, 4)
    rate: FloatArray  # (T, 4)
    variance: FloatArray  # (T, 4) of `mean`
    covariance: FloatArray  # (T, 4) of each with its rate
    rate_variance: FloatArray  # (T, 4)

    def __len__(self) -> int:
        return len(self.mean)

    def rows(self, rows: npt.NDArray[np.integer | np.bool_]) -> BoxStates:
        """Return some of the boxes."""
        return BoxStates(*(getattr(self, field.name)[rows] for field in fields(self)))

    def and_(self, others: BoxStates) -> BoxStates:
        """Return these boxes and others behind them."""
        names = [field.name for field in fields(self)]
        return BoxStates(
            *(np.concatenate([getattr(self, name), getattr(others, name)]) for name in names)
        )


class BoxFilter:
    """The filter for the boxes of one camera."""

    def __init__(self, noise: BoxNoise, width_px: int) -> None:
        self._noise, self._width_px = noise, width_px

    def begun(self, boxes: FloatArray) -> BoxStates:
        """Return the states of boxes (N, 4) that were seen once, as `shapes_of` gives them."""
        noise = self._noise
        rate = self._scaled(boxes, noise.speed, noise.growth)
        nothing = np.zeros_like(boxes)
        return BoxStates(boxes, nothing, self._variances(boxes), nothing, rate**2)

    def predicted(self, states: BoxStates, dt_s: float) -> BoxStates:
        """Return where boxes are after a time [s], if their speed changes by chance alone."""
        noise = self._noise
        walk = self._scaled(states.mean, noise.speed_change, noise.growth_change) ** 2
        mean = states.mean + dt_s * states.rate
        mean[:, 2:] = np.maximum(mean[:, 2:], [_LEAST_ASPECT, _LEAST_PX])
        tied = states.covariance + dt_s * states.rate_variance
        return BoxStates(
            mean,
            states.rate,
            states.variance + dt_s * (states.covariance + tied) + walk * dt_s**3 / 3,
            tied + walk * dt_s**2 / 2,
            states.rate_variance + walk * dt_s,
        )

    def distances(self, states: BoxStates, boxes: FloatArray) -> FloatArray:
        """Return the squared Mahalanobis distances (T, N) of boxes (N, 4) from where they are expected."""
        spread = states.variance + self._variances(states.mean)
        away = boxes - states.mean[:, None]
        distances: FloatArray = np.einsum("tnk,tk->tn", away**2, 1 / spread)
        return distances

    def corrected(self, states: BoxStates, rows: IntArray, boxes: FloatArray) -> BoxStates:
        """Return the states, of which some (K,) were seen as boxes (K, 4)."""
        seen = states.rows(rows)
        spread = seen.variance + self._variances(seen.mean)
        gain, rate_gain = seen.variance / spread, seen.covariance / spread
        away = boxes - seen.mean
        better = BoxStates(
            seen.mean + gain * away,
            seen.rate + rate_gain * away,
            seen.variance * (1 - gain),
            seen.covariance * (1 - gain),
            seen.rate_variance - rate_gain * seen.covariance,
        )
        return _replaced(states, rows, better)

    def _variances(self, boxes: FloatArray) -> FloatArray:
        """Return the variances (N, 4) of detected boxes whose four edges err alike."""
        aspect, height = boxes[:, 2], boxes[:, 3]
        edge = np.maximum(self._noise.edge_sigma * height * np.sqrt(aspect), _LEAST_PX) ** 2
        shape = 2 * edge / height**2 * (1 + aspect**2)
        return np.stack([edge / 2, edge / 2, shape, 2 * edge], axis=1)

    def _scaled(self, boxes: FloatArray, of_width: float, of_size: float) -> FloatArray:
        """Return rates (N, 4) as shares of the image's width, and of the size of the boxes."""
        place = np.full((len(boxes), 2), of_width * self._width_px)
        return np.concatenate([place, of_size * boxes[:, 2:]], axis=1)


def shapes_of(boxes_px: npt.NDArray[np.floating]) -> FloatArray:
    """Return middle, width over height, and height (N, 4) of boxes x_min, y_min, x_max, y_max (N, 4)."""
    low, high = boxes_px[:, :2].astype(np.float64), boxes_px[:, 2:].astype(np.float64)
    sides = high - low
    return np.column_stack([(low + high) / 2, sides[:, 0] / sides[:, 1], sides[:, 1]])


def corners_of(shapes: FloatArray) -> FloatArray:
    """Return x_min, y_min, x_max, y_max (N, 4) of boxes; the inverse of `shapes_of`."""
    half = shapes[:, 3:] / 2 * np.column_stack([shapes[:, 2], np.ones(len(shapes))])
    return np.concatenate([shapes[:, :2] - half, shapes[:, :2] + half], axis=1)


def _replaced(states: BoxStates, rows: IntArray, by: BoxStates) -> BoxStates:
    changed = []
    for field in fields(states):
        values = getattr(states, field.name).copy()
        values[rows] = getattr(by, field.name)
        changed.append(values)
    return BoxStates(*changed)
