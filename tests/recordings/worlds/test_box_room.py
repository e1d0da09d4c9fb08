"""The box room, in which tests of operators drive."""

import subprocess
import sys

import numpy as np

from mapstream.recordings.worlds.box_room import box_room, drive_through
from mapstream.recordings.worlds.mesh import box
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.streams.geometry import SE3


def test_rays_meet_a_box_where_geometry_says() -> None:
    """From the centre of a 2 x 4 x 6 box, rays along the axes reach its faces; outside they miss."""
    caster = RayCaster(box(SE3.identity(), [2, 4, 6], 0.5))
    rays = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1]])
    origins = np.full((3, 3), 0.01)

    hits = caster.cast(origins, rays)
    np.testing.assert_allclose(hits.ranges_m, [0.99, 2.01, 2.99])
    away = caster.cast(origins + np.array([10, 0, 0]), rays)
    assert np.isinf(away.ranges_m).all()
    assert (away.faces == -1).all()


def test_a_caster_that_is_moved_about_sees_what_one_tree_of_all_faces_shows() -> None:
    """What is gathered around one place is no excuse at another; rays reach across a hall of 90 m."""
    mesh, rng = box_room(2, size_m=90.0), np.random.default_rng(3)
    moved = RayCaster(mesh)

    for x in (-40.0, -39.0, 0.0, 40.0):
        origins = np.array([x, 0.0, 1.0]) + rng.uniform(-0.5, 0.5, (400, 3))
        directions = rng.normal(size=(400, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        hits = moved.cast(origins, directions)
        ranges_m, faces = moved._all.cast(origins, directions)
        np.testing.assert_array_equal(hits.ranges_m, ranges_m)
        np.testing.assert_array_equal(hits.faces, faces)
        assert np.isfinite(hits.ranges_m).all()
        assert hits.ranges_m.max() > 25.0


def test_a_drive_ends_where_it_should() -> None:
    """Ten sweeps at 1 m/s end 1 m ahead; on a quarter circle of 2 m radius at its end."""
    straight = drive_through(box_room(1), num_scans=10)
    curved = drive_through(box_room(1), num_scans=10, speed_mps=np.pi, turn_radps=np.pi / 2)

    end_ns = straight.scans[0].stamp_ns + 10**9
    np.testing.assert_allclose(straight.truth.pose_at(end_ns).t, [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(curved.truth.pose_at(end_ns).t, [2, 2, 0], atol=1e-4)
    assert all(len(scan.points) > 4000 for scan in straight.scans)


def test_a_drive_repeats_itself() -> None:
    """Equal arguments give equal scans."""
    first, second = (drive_through(box_room(5), num_scans=2).scans[1] for _ in range(2))

    np.testing.assert_array_equal(first.points, second.points)


def test_the_ray_caster_does_not_load_copyleft_modules() -> None:
    """libigl's wheel carries GPL bindings; a fresh interpreter with the ray caster has none of them."""
    code = (
        "import sys, mapstream.recordings.worlds.ray_caster;"
        "print([m for m in sys.modules if m.startswith('igl.')])"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, text=True
    )

    assert "copyleft" not in loaded.stdout
