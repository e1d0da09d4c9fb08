"""How planes look: those of the moment, those recognised."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapstream.recordings.maps.hulls import hull_payload
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, LandmarkRef
from mapstream.streams.messages.planes import PlaneSegments
from tests.graph.rrd import values_of
from tests.graph.test_views import drawn

SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
WALL = SE3.from_rotation(np.eye(3), [0.0, 0.0, 2.0])


def test_P1_planes_and_wall_lines_are_drawn_within_their_outlines(tmp_path: Path) -> None:
    planes = PlaneSegments(
        stamp_ns=1,
        T_base_plane=np.array([WALL.matrix, np.eye(4)]),
        covariances=np.tile(np.eye(6), (2, 1, 1)),
        hulls_m=(SQUARE, np.array([[-1.0, 0.0], [1.0, 0.0]])),
        num_points=np.array([10, 20]),
        rmse_m=np.zeros(2),
    )
    nothing = PlaneSegments(
        stamp_ns=2,
        T_base_plane=np.empty((0, 4, 4)),
        covariances=np.empty((0, 6, 6)),
        hulls_m=(),
        num_points=np.empty(0, np.int64),
        rmse_m=np.empty(0),
    )

    entities = drawn(tmp_path, [planes, nothing])

    strips, none = values_of(entities["/op/port"], "LineStrips3D:strips")
    assert [len(strip) for strip in strips] == [5, 3]
    assert np.array(strips[0])[:, 2].tolist() == [2.0] * 5
    assert none == []
    triangles, _ = values_of(entities["/op/port/surface"], "Mesh3D:triangle_indices")
    assert len(triangles) == 2  # a line has no surface
    counts = values_of(entities["/op/port/num_planes"], "Scalars:scalars")
    assert np.ravel(counts).tolist() == [2.0, 0.0]


def test_three_planes_have_three_colours(tmp_path: Path) -> None:
    """Rerun takes a list of three numbers for red, green and blue."""
    planes = PlaneSegments(
        stamp_ns=1,
        T_base_plane=np.tile(WALL.matrix, (3, 1, 1)),
        covariances=np.tile(np.eye(6), (3, 1, 1)),
        hulls_m=(SQUARE,) * 3,
        num_points=np.full(3, 10),
        rmse_m=np.zeros(3),
    )

    entities = drawn(tmp_path, [planes])

    for path in ("/op/port", "/op/port/normals"):
        kind = "LineStrips3D" if path == "/op/port" else "Arrows3D"
        assert len(set(values_of(entities[path], f"{kind}:colors")[0])) == 3


def test_P1_a_plane_that_was_recognised_is_drawn_with_its_name(tmp_path: Path) -> None:
    seen = Constraint(
        stamp_ns=1,
        kind="plane",
        T_a_b=WALL,
        landmark=LandmarkRef(name="wall", kind="plane"),
        payload=hull_payload(SQUARE),
    )

    later = replace(seen, stamp_ns=2, landmark=LandmarkRef(name="floor", kind="plane"))
    at_once = replace(later, landmark=LandmarkRef(name="door", kind="plane"))

    entities = drawn(tmp_path, [seen, later, at_once])

    found = values_of(entities["/op/port"], "LineStrips3D:labels")
    assert found == [["wall"], ["floor"], ["floor", "door"]]
