"""Plane segments as a message."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.planes import PlaneSegments


def _segments(hulls: tuple[FloatArray, ...]) -> PlaneSegments:
    n = 2
    return PlaneSegments(
        stamp_ns=7,
        T_base_plane=np.tile(np.eye(4), (n, 1, 1)),
        covariances=np.tile(np.diag([np.inf, 1.0, np.inf, np.inf, np.inf, 0.1]), (n, 1, 1)),
        hulls_m=hulls,
        num_points=np.array([10, 20]),
        rmse_m=np.array([0.01, 0.02]),
    )


def test_hulls_cannot_be_written_and_belong_to_planes() -> None:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    segments = _segments((square, square))
    with pytest.raises(ValueError, match="read-only"):
        segments.hulls_m[0][0, 0] = 3.0
    with pytest.raises(ValueError, match="2 planes with 1 hulls"):
        _segments((square,))
