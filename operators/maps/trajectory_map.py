"""Trajectories as maps, and what steps of imported ones are worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.build import append_edges, new_mission
from mapstream.recordings.maps.ids import mission_id
from mapstream.recordings.maps.model import Map, vertex_ids
from mapstream.recordings.maps.tables import Edges, Vertices
from mapstream.streams.geometry import invert
from mapstream.streams.trajectory import Trajectory


class ImportConfig(OperatorConfig):
    """What the edges of imported trajectories and pose graphs are worth."""

    rotation_sigma_rad: PositiveFloat = 0.01
    """Of one step of a trajectory."""
    translation_sigma_m: PositiveFloat = 0.05
    """Of one step of a trajectory."""
    are_loops_switchable: bool = True
    """Whether an optimizer may find loops within a mission of a g2o graph false."""


def trajectory_map(trajectory: Trajectory, name: str, config: ImportConfig) -> Map:
    """Return a map of one mission with a vertex per pose and an odometry edge per step."""
    mission, num_vertices = mission_id(name), len(trajectory)
    vertices = Vertices(
        id=vertex_ids(mission, trajectory.stamps_ns),
        mission=np.zeros(num_vertices, dtype=np.int64),
        stamp_ns=trajectory.stamps_ns,
        T_mission_base=trajectory.poses,
    )
    map_ = replace(new_mission(Map.empty(), mission, name=name), vertices=vertices)
    num_edges = max(num_vertices - 1, 0)
    variances = [config.rotation_sigma_rad**2] * 3 + [config.translation_sigma_m**2] * 3
    edges = Edges(
        kind=np.full(num_edges, "odometry", dtype=object),
        vertex_a=np.arange(num_edges),
        vertex_b=np.arange(num_edges) + 1,
        T_a_b=invert(trajectory.poses[:-1]) @ trajectory.poses[1:],
        covariance=np.tile(np.diag(variances), (num_edges, 1, 1)),
        source=np.full(num_edges, "import", dtype=object),
    )
    return append_edges(map_, edges)
