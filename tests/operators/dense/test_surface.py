"""Depth and clouds of a ball, fused, become a closed ball of its size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.dense.cloud_integration import CloudIntegration, integrate_cloud
from mapstream.operators.dense.depth_integration import integrate_depth
from mapstream.operators.dense.surface import is_closed, surface_of
from mapstream.operators.dense.volume import PLACES, SIDE, VOXELS, TsdfVolume
from mapstream.operators.dense.volume_files import load_volume, save_volume
from mapstream.recordings.mesh_files import SurfaceMesh, read_mesh, with_normals, write_mesh
from mapstream.streams.errors import MapError, MapFormatError, RecordingError
from tests.operators.dense.balls import CENTER, RADIUS_M, ball_cloud, ball_view, eyes

VOXEL_M = 0.04
MB = 10**6


@pytest.fixture(scope="module")
def ball() -> TsdfVolume:
    volume = TsdfVolume(VOXEL_M, 4 * VOXEL_M, 100 * MB, has_colors=True)
    for eye in eyes():
        integrate_depth(volume, ball_view(eye, rgb=(200, 100, 20)))
    return volume


def test_O3_depth_images_all_around_a_ball_give_its_surface(ball: TsdfVolume) -> None:
    """RMS error below a tenth of a voxel, colours as seen."""
    mesh = surface_of(ball)

    away_m = np.linalg.norm(mesh.vertices - CENTER, axis=1) - RADIUS_M
    assert np.sqrt((away_m**2).mean()) < 0.1 * VOXEL_M
    assert mesh.rgb is not None
    assert np.abs(mesh.rgb.astype(int) - (200, 100, 20)).max() <= 1


def test_O4_the_mesh_of_a_ball_is_watertight_and_of_its_radius(ball: TsdfVolume) -> None:
    """Closed over the borders of blocks, less than half a voxel off, triangles face outwards."""
    mesh = surface_of(ball)

    away_m = np.linalg.norm(mesh.vertices - CENTER, axis=1) - RADIUS_M
    assert is_closed(mesh)
    assert np.abs(away_m).max() < VOXEL_M / 2
    assert mesh.normals is not None
    outwards = (mesh.vertices - CENTER) / RADIUS_M
    assert (mesh.normals * outwards).sum(axis=1).min() > 0.9


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_O4_any_distances_inside_a_frame_give_a_closed_surface(seed: int) -> None:
    """Also where a face between two cells is ambiguous."""
    volume = TsdfVolume(1.0, 4.0, 10 * MB)
    rows = volume.allocate(np.array([[x, y, z] for x in (-1, 0) for y in (0, 1) for z in (2, 3)]))
    voxels = volume.blocks[rows][:, None, :] * SIDE + PLACES
    rng = np.random.default_rng(seed)
    volume.weight[:] = 1
    low, high = voxels.min(axis=(0, 1)), voxels.max(axis=(0, 1))
    is_border = ((voxels == low) | (voxels == high)).any(axis=2)
    volume.distance_m[:] = np.where(is_border, 1.0, rng.normal(size=(len(rows), VOXELS)))

    assert is_closed(surface_of(volume))


@pytest.mark.parametrize("uses_normals", [True, False])
def test_O3_clouds_all_around_a_ball_give_its_surface(uses_normals: bool) -> None:  # noqa: FBT001
    """Along normals the error is below a tenth of a voxel, along rays below a third."""
    volume = TsdfVolume(VOXEL_M, 4 * VOXEL_M, 100 * MB)
    how = CloudIntegration(uses_normals=uses_normals)
    for seed, eye in enumerate(eyes()[6:]):
        integrate_cloud(volume, ball_cloud(eye, 6000, seed), how)

    mesh = surface_of(volume, min_part_faces=20)

    away_m = np.linalg.norm(mesh.vertices - CENTER, axis=1) - RADIUS_M
    assert np.sqrt((away_m**2).mean()) < (0.1 if uses_normals else 1 / 3) * VOXEL_M
    assert len(mesh.faces) > 3000


def test_O3_what_one_sees_through_is_carved_out(ball: TsdfVolume) -> None:
    """A wall that was there once, in front of the ball, goes when the ball is seen again and again."""
    volume = TsdfVolume(VOXEL_M, 4 * VOXEL_M, 100 * MB)
    eye = eyes()[0]
    seen = ball_view(eye)
    wall = np.where(np.isnan(seen.depth_m), np.nan, 0.5).astype(np.float32)
    integrate_depth(volume, type(seen)(depth_m=wall, pinhole=seen.pinhole))
    assert np.linalg.norm(surface_of(volume).vertices - CENTER, axis=1).min() > 0.8

    for _ in range(12):
        integrate_depth(volume, seen)

    away_m = np.linalg.norm(surface_of(volume, min_part_faces=50).vertices - CENTER, axis=1)
    assert away_m.max() < RADIUS_M + VOXEL_M


def test_a_volume_that_outgrows_its_memory_says_what_to_do() -> None:
    volume = TsdfVolume(0.005, 0.02, MB)

    with pytest.raises(MapError, match=r"more than the 1 MB .* use larger voxels"):
        integrate_depth(volume, ball_view(eyes()[0]))

    assert len(volume) == 0
    assert volume.num_bytes <= MB


def test_a_volume_without_a_surface_is_an_error() -> None:
    with pytest.raises(MapError, match="holds no surface"):
        surface_of(TsdfVolume(0.1, 0.4, MB))


def test_points_beyond_the_reach_of_the_numbers_are_refused() -> None:
    volume = TsdfVolume(0.01, 0.04, MB)

    with pytest.raises(MapError, match="use larger voxels"):
        volume.blocks_at(np.array([[1e5, 0, 0]]))


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_O4_meshes_survive_their_files(ball: TsdfVolume, tmp_path: Path, suffix: str) -> None:
    """With colours and normals."""
    mesh = surface_of(ball)
    write_mesh(tmp_path / f"ball{suffix}", mesh)

    found = read_mesh(tmp_path / f"ball{suffix}")

    np.testing.assert_allclose(found.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    kept = with_normals(found).normals
    assert kept is not None
    assert mesh.normals is not None
    np.testing.assert_allclose(kept, mesh.normals, atol=1e-3)
    np.testing.assert_array_equal(found.rgb, mesh.rgb)


def test_a_mesh_file_of_no_known_format_is_refused(tmp_path: Path) -> None:
    mesh = SurfaceMesh(vertices=np.eye(3, dtype=np.float32), faces=np.array([[0, 1, 2]], np.int32))

    with pytest.raises(RecordingError, match=r"unknown format '\.obj' of a mesh"):
        write_mesh(tmp_path / "a.obj", mesh)
    (tmp_path / "a.ply").write_bytes(b"ply\n")
    with pytest.raises(RecordingError, match=r"a\.ply"):
        read_mesh(tmp_path / "a.ply")


def test_volumes_survive_their_files(ball: TsdfVolume, tmp_path: Path) -> None:
    save_volume(tmp_path / "ball.npz", ball)

    found = load_volume(tmp_path / "ball.npz")

    np.testing.assert_array_equal(found.blocks, ball.blocks)
    np.testing.assert_array_equal(found.distance_m, ball.distance_m)
    np.testing.assert_array_equal(found.weight, ball.weight)
    (tmp_path / "other.npz").write_bytes(b"no zip")
    with pytest.raises(MapFormatError, match=r"other\.npz"):
        load_volume(tmp_path / "other.npz")
