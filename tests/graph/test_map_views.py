"""What a stored map shows beside its trajectories, each as an entity that can be switched off."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapstream.graph.tap_map import view_map
from mapstream.graph.tap_sinks import SinkSpec
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.tables import Edges, Frames, Landmarks
from mapstream.streams.geometry import SE3
from tests.graph import made_messages as made
from tests.graph.rrd import read_rrd, strict, values_of


def test_P1_planes_objects_and_outer_frames_are_entities_of_their_own(tmp_path: Path) -> None:
    """A wall with its boundary, one without, a chair with axes, and a fix in a known frame."""
    wall = {"hull": [[0, 0], [2, 0], [2, 1], [1, 2], [0, 1]]}
    map_ = made.made_map()
    landmarks = Landmarks(
        id=id_array(derived_id("landmark", n) for n in range(3)),
        kind=np.array(["plane", "plane", "object"], dtype=object),
        label=np.array(["", "", "chair"], dtype=object),
        vertex=np.zeros(3, dtype=np.int64),
        p_base=np.array([[0.0, 0, 5], [0, 0, 7], [1, 2, 3]]),
        quat_base_xyzw=np.tile([0.0, 0, 0, 1], (3, 1)),
        payload=np.array([json.dumps(wall).encode(), b"\xff", b""], dtype=object),
    )
    frames = Frames(
        id=id_array([derived_id("frame", "enu")]),
        name=np.array(["enu"], dtype=object),
        T_map_frame=SE3.from_rotation(np.eye(3), [100, 0, 0]).matrix[None],
    )
    fix = Edges(
        kind=np.array(["position"], dtype=object),
        vertex_a=np.array([0]),
        frame=np.array([0]),
        T_a_b=SE3.from_rotation(np.eye(3), [-99, 0, 0]).matrix[None],
        payload=np.array([b'{"T_base_sensor": [0, 0, 0.5, 0, 0, 0, 1]}'], dtype=object),
    )

    map_ = append_edges(replace(map_, landmarks=landmarks, frames=frames), fix)
    with strict():
        view_map(map_, None, SinkSpec.parse(f"save={tmp_path / 'map.rrd'}").open())

    entities = read_rrd(tmp_path / "map.rrd")

    [strips] = values_of(entities["/map/landmarks/plane"], "LineStrips3D:strips")
    assert [len(strip) for strip in strips] == [6, 5]
    assert np.array(strips[0][1]).tolist() == [2, 0, 5]
    [triangles] = values_of(entities["/map/landmarks/plane/surface"], "Mesh3D:triangle_indices")
    assert len(triangles) == 3 + 2
    assert values_of(entities["/map/landmarks/object"], "Points3D:labels") == [["chair"]]
    [arrows] = values_of(entities["/map/landmarks/object/axes"], "Arrows3D:origins")
    assert np.array(arrows).tolist() == [[1, 2, 3]] * 3
    [ties] = values_of(entities["/map/edges/position"], "LineStrips3D:strips")
    assert np.array(ties[0]).tolist() == [[0, 0, 0.5], [1, 0, 0]]
    assert values_of(entities["/map/frames/enu/name"], "Points3D:labels") == [["enu (estimated)"]]
