"""A map's surface in Rerun."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapstream.graph.tap_map import view_map
from mapstream.graph.tap_sinks import SinkSpec
from mapstream.recordings.mesh_files import SurfaceMesh
from tests.graph import made_messages as made
from tests.graph.rrd import read_rrd, strict, values_of


def test_P1_the_surface_of_a_map_is_an_entity_of_its_own(tmp_path: Path) -> None:
    """With its triangles and normals."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = SurfaceMesh(
        vertices=corners,
        faces=np.array([[0, 1, 2]], np.int32),
        rgb=np.full((3, 3), 100, np.uint8),
    )

    with strict():
        sink = SinkSpec.parse(f"save={tmp_path / 'map.rrd'}").open()
        view_map(made.made_map(), None, sink, mesh=mesh)

    entity = read_rrd(tmp_path / "map.rrd")["/map/mesh"]
    [triangles] = values_of(entity, "Mesh3D:triangle_indices")
    [normals] = values_of(entity, "Mesh3D:vertex_normals")
    assert np.array(triangles).tolist() == [[0, 1, 2]]
    assert np.array(normals).tolist() == [[0, 0, 1]] * 3
