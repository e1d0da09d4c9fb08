"""How far a map is from positions that it was not made of: satellite fixes that a graph left aside."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.graph.fit import topics_for
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.evaluation import Statistics
from mapstream.recordings.maps import Map
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import EstimationError
from mapstream.streams.messages.constraints import Constraint


@dataclass(frozen=True, slots=True)
class PositionErrors:
    """Distances between a trajectory and positions, without any alignment."""

    num_used: int  # positions that the map was made of, and that are not judged by
    distance_m: Statistics  # of the others
    length_m: float  # of the way along these


def unused_position_errors(map_: Map, recording: Path) -> PositionErrors:
    """Return the distances of a map's first mission from the positions in a recording that it did not use.

    Positions are carried into the map by the outer frame that the map has found for them.

    Raises:
        EstimationError: If all were used, or none lies within the time and the frames of the map.
    """
    T_map_of = dict(zip(map_.frames.name, map_.frames.T_map_frame, strict=True)) | {"": np.eye(4)}
    positions = [each for each in _positions(recording) if _frame(each) in T_map_of]
    trajectory = map_.trajectory(map_.mission_id(0))
    used_ns = set(map_.vertices.stamp_ns[map_.edges.vertex_a[map_.edges_of("position")]].tolist())
    judges = [p for p in positions if p.stamp_ns not in used_ns and trajectory.covers(p.stamp_ns)]
    if not judges:
        raise EstimationError(
            f"{recording}: no position is left to judge by: of {len(positions)} in frames of the map,"
            f" {len(used_ns)} are part of it"
        )
    measured = np.array([(T_map_of[_frame(p)] @ p.T_a_b.matrix)[:3, 3] for p in judges])
    poses = trajectory.at([position.stamp_ns for position in judges])
    estimated = (map_.missions.T_map_mission[0] @ poses)[:, :3, 3]
    return PositionErrors(
        num_used=sum(position.stamp_ns in used_ns for position in positions),
        distance_m=Statistics.of(np.linalg.norm(estimated - measured, axis=1)),
        length_m=float(np.linalg.norm(np.diff(measured, axis=0), axis=1).sum()),
    )


def _positions(path: Path) -> list[Constraint]:
    with open_recording(path) as recording:
        topics = [topic.name for topic in topics_for(Constraint, recording)]
        decoders = {topic: decoder_for(recording.topics[topic].channel) for topic in topics}
        messages = (decoders[raw.topic](raw) for raw in recording.messages(topics))
        return [m for m in messages if isinstance(m, Constraint) and m.kind == "position"]


def _frame(position: Constraint) -> str:
    return position.outer.name if position.outer is not None else ""
