"""Occupancy grids in the picture."""

from pathlib import Path

import numpy as np

from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.grids import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.graph.rrd import values_of
from tests.graph.test_views import drawn


def test_a_grid_lies_where_it_is_in_the_map(tmp_path: Path) -> None:
    """Its corners are those of the cells, and only what is known is seen."""
    cells = np.array([[FREE, OCCUPIED, UNKNOWN], [FREE, FREE, FREE]], np.int8)
    T = SE3.from_rotation(so3_exp([0, 0, np.pi / 2]), [10.0, 0, 0])
    grid = OccupancyGrid(stamp_ns=1, cells=cells, resolution_m=0.5, T_map_grid=T)

    entities = drawn(tmp_path, [grid])

    corners = np.array(values_of(entities["/op/port"], "Mesh3D:vertex_positions")[0])
    expected = np.array([[10, 0], [10, 1.5], [9, 1.5], [9, 0]])
    np.testing.assert_allclose(corners[:, :2], expected, atol=1e-5)
    assert "Mesh3D:albedo_texture_buffer" in {
        name for batch in entities["/op/port"] for name in batch.schema.names
    }
    assert values_of(entities["/op/port/free_m2"], "Scalars:scalars") == [[1.0]]
    assert values_of(entities["/op/port/occupied_m2"], "Scalars:scalars") == [[0.25]]
