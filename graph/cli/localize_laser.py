"""The graph that localises a planar laser in a grid or a map."""

from __future__ import annotations

from pathlib import Path

from mapstream.graph.cli.localize_graphs import POSES, is_of_clouds
from mapstream.graph.fit import topics_for
from mapstream.graph.trajectory_sources import TRUTH
from mapstream.recordings.grid_files import is_grid_file
from mapstream.recordings.recording import Recording
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LaserScan2D, LidarScan, WheelOdometry

_GRAPH = """\
version: 1
name: localize
params:
  recording: {{type: path}}
operators:
  sensors: {{use: mcap, config: {{path: $recording, topics: {{{topics}}}}}}}
{odometry}  localize:
    use: grid_localization
    in: {{laser: sensors.laser, {moves}}}
    config: {{map: "{map}"}}
  poses:
    use: mcap_sink
    in: {{poses: localize.poses}}
    config: {{path: "OUT", schemas: mapstream, topics: {{poses: {poses}}}}}
"""
_MATCHED = "  odometry: {use: laser_odometry, in: {laser: sensors.laser}}\n"


def is_for_laser(map_: Path, recording: Recording) -> bool:
    """Return whether a map is a grid, or has clouds alone where a recording has planar scans alone."""
    if is_grid_file(map_):
        return True
    has_planar = bool(topics_for(LaserScan2D, recording)) and not topics_for(LidarScan, recording)
    return has_planar and is_of_clouds(map_)


def laser_graph(map_: Path, recording: Recording, moves: str | None) -> str:
    """Return the graph as YAML; it moves by the topic `moves`, by the only wheels, or by matching scans.

    Raises:
        ConfigError: If the recording has no planar laser, or no such odometry.
    """
    lasers, wheels, others = (
        [topic.name for topic in topics_for(kind, recording) if topic.name != TRUTH]
        for kind in (LaserScan2D, WheelOdometry, Odometry)
    )
    if not lasers:
        raise ConfigError(f"{recording.path}: no topic with scans of a planar laser")
    if moves is not None and moves not in wheels + others:
        raise ConfigError(
            f"{recording.path}: no odometry on {moves}; there is {', '.join(wheels + others) or 'none'}"
        )
    chosen = moves or (wheels[0] if len(wheels) == 1 else None)
    topics, odometry, port = f"laser: {lasers[0]}", "", "odometry: odometry.odometry"
    if chosen is None:
        odometry = _MATCHED
    else:
        name = "wheels" if chosen in wheels else "odometry"
        topics, port = f"{topics}, {name}: {chosen}", f"{name}: sensors.{name}"
    return _GRAPH.format(
        topics=topics, odometry=odometry, moves=port, map=map_.absolute(), poses=POSES
    )
