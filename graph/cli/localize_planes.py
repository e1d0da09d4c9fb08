"""The graph that localises a depth camera in a map of planes."""

from __future__ import annotations

from pathlib import Path

from mapstream.graph.cli.localize_graphs import POSES
from mapstream.graph.fit import topics_for
from mapstream.graph.trajectory_sources import TRUTH
from mapstream.recordings.maps import load_map
from mapstream.recordings.recording import Recording
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage

_GRAPH = """\
version: 1
name: localize
params:
  recording: {{type: path}}
operators:
  sensors: {{use: mcap, config: {{path: $recording, topics: {{{topics}}}}}}}
  depth: {{use: image_decode, in: {{images: sensors.depth}}, config: {{mode: depth}}}}
{odometry}  planes: {{use: plane_segmentation, in: {{frames: depth.frames}}, config: {{period_s: 0.5}}}}
  localize:
    use: localize_planes
    in: {{planes: planes.planes, odometry: {moves}}}
    config: {{map: "{map}"}}
  poses:
    use: mcap_sink
    in: {{poses: localize.poses}}
    config: {{path: "OUT", schemas: mapstream, topics: {{poses: {poses}}}}}
"""
_DENSE = """\
  color: {use: image_decode, in: {images: sensors.color}}
  registered: {use: depth_registration, in: {depth: depth.frames, frames: color.frames}}
  dense: {use: dense_visual_odometry, in: {frames: color.frames, depth: registered.depth}}
"""


def is_for_planes(map_: Path, recording: Recording) -> bool:
    """Return whether a map has planes and no other landmarks, and a recording depth images."""
    kinds = set(load_map(map_, tables=["landmarks"]).landmarks.kind.tolist())
    return kinds == {"plane"} and bool(_images(recording)[1])


def planes_graph(map_: Path, recording: Recording, moves: str | None) -> str:
    """Return the graph as YAML; it moves by the topic `moves`, or by dense visual odometry.

    Raises:
        ConfigError: If the recording has no such odometry, and no colour images instead.
    """
    color, depth = _images(recording)
    there = [topic.name for topic in topics_for(Odometry, recording) if topic.name != TRUTH]
    if moves is not None and moves not in there:
        raise ConfigError(
            f"{recording.path}: no odometry on {moves}; there is {', '.join(there) or 'none'}"
        )
    if moves is None and not color:
        raise ConfigError(
            f"{recording.path}: depth images without colour; name a topic with --odometry"
        )
    own = f"odometry: {moves}" if moves is not None else f"color: {color[0]}"
    return _GRAPH.format(
        topics=f"depth: {depth[0]}, {own}",
        odometry="" if moves is not None else _DENSE,
        moves="sensors.odometry" if moves is not None else "dense.odometry",
        map=map_.absolute(),
        poses=POSES,
    )


def _images(recording: Recording) -> tuple[list[str], list[str]]:
    """Return the topics with colour and with depth images; the latter say so in their names."""
    names = sorted(
        {
            topic.name
            for kind in (EncodedImage, CameraFrame)
            for topic in topics_for(kind, recording)
        }
    )
    return [n for n in names if "depth" not in n], [n for n in names if "depth" in n]
