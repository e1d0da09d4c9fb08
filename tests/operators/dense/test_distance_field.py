"""Distances around a ball, against the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.dense.depth_integration import DepthIntegration, integrate_depth
from mapstream.operators.dense.distance_field import (
    DistanceField,
    State,
    distance_field,
    load_field,
    save_field,
    write_picture,
)
from mapstream.operators.dense.volume import TsdfVolume
from mapstream.streams.errors import MapError, MapFormatError
from tests.operators.dense.balls import CENTER, RADIUS_M, ball_view, eyes

VOXEL_M = 0.05


@pytest.fixture(scope="module")
def field() -> DistanceField:
    volume = TsdfVolume(VOXEL_M, 4 * VOXEL_M, 10**9)
    for eye in eyes():
        integrate_depth(volume, ball_view(eye), DepthIntegration(fills_free_space=True))
    return distance_field(volume, max_distance_m=0.7)


def test_O5_distances_are_true_to_less_than_a_voxel(field: DistanceField) -> None:
    """Anywhere in the field, on both sides of the surface; the RMS error is below a quarter of a voxel."""
    rng = np.random.default_rng(0)
    points = CENTER + rng.uniform(-1, 1, (4000, 3)) * 0.9
    true_m = np.linalg.norm(points - CENTER, axis=1) - RADIUS_M
    points, true_m = points[true_m > -2 * VOXEL_M], true_m[true_m > -2 * VOXEL_M]

    found_m = field.distances(points)

    error_m = found_m - np.minimum(true_m, 0.7)
    assert np.abs(error_m).max() < VOXEL_M
    assert np.sqrt((error_m**2).mean()) < VOXEL_M / 4


def test_O5_space_is_free_occupied_or_unknown(field: DistanceField) -> None:
    """Free before the ball, occupied at it, unknown inside it and beyond the field."""
    along = np.array([0.0, 1.0, 0.0])
    points = [CENTER + r * along for r in (0.8, RADIUS_M - 0.01, 0.1)]
    outside = np.array([99.0, 0, 0])

    states = field.states(np.array([*points, outside]))

    assert states.tolist() == [State.FREE, State.OCCUPIED, State.UNKNOWN, State.UNKNOWN]
    assert np.isnan(field.distances([[99.0, 0, 0]])).all()


def test_O5_fields_and_their_pictures_survive_their_files(
    field: DistanceField, tmp_path: Path
) -> None:
    save_field(tmp_path / "field.npz", field)
    write_picture(tmp_path / "slice.png", field, 0.0)

    found = load_field(tmp_path / "field.npz")

    np.testing.assert_array_equal(found.distance_m, field.distance_m)
    np.testing.assert_array_equal(found.state, field.state)
    assert (tmp_path / "slice.png").stat().st_size > 500
    with pytest.raises(MapError, match="no slice at 50"):
        field.picture(50.0)
    (tmp_path / "field.npz").write_bytes(b"")
    with pytest.raises(MapFormatError, match=r"field\.npz"):
        load_field(tmp_path / "field.npz")


def test_a_field_that_outgrows_its_memory_says_what_to_do() -> None:
    volume = TsdfVolume(0.01, 0.04, 20 * 10**6)
    volume.allocate(np.array([[0, 0, 0], [30, 30, 30]]))

    with pytest.raises(MapError, match=r"a field of 248 x 248 x 248 voxels needs .* larger voxels"):
        distance_field(volume, max_distance_m=1.0)
