"""A graph for a recording: what its topics allow, written as a person would."""

from __future__ import annotations

import json
import re
from typing import Any

from mapstream.graph.fit import topics_for
from mapstream.recordings.recording import Recording
from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage, ImuBatch, LidarScan

_PORTS: dict[str, type[Any]] = {  # of the source, and what each takes
    "scans": LidarScan,
    "imu": ImuBatch,
    "odometry": Odometry,
    "images": EncodedImage,
    "frames": CameraFrame,
}
_HEAD = """\
# yaml-language-server: $schema=mapstream.schema.json
version: 1
name: {name}
params:
  recording: {{type: path, default: {path}, help: the recording to map}}
  map: {{type: path, default: {name}_map, help: the folder of the map}}
operators:
  sensors:
    use: mcap
    config:
      path: $recording
      topics:
"""
_KISS = """\
  odometry:  # gicp_odometry suits uneven ground and sparse scans
    use: kiss_odometry
    in: {scans: sensors.scans}
    config: {cloud_voxel_size_m: 0.25}
"""
_GICP = """\
  odometry:  # kiss_odometry is faster, and needs no IMU
    use: gicp_odometry
    in: {scans: sensors.scans, imu: sensors.imu}
    config: {cloud_voxel_size_m: 0.25}
"""
_LIDAR_MAP = """\
  keyframes: {use: keyframes, in: {odometry: odometry.odometry, clouds: odometry.clouds}}
  submaps: {use: submap_builder, in: {keyframes: keyframes.keyframes}}
  loops:
    use: lidar_loops
    in:
      submaps: submaps.submaps
      corrections: {from: optimizer.corrections, feedback: true}
"""
_KEYFRAME_LINKS = """\
    config: {links: [1, 2]}  # GICP between keyframes takes out what KISS-ICP drifts
"""
_LIDAR_OPTIMIZER = """\
  optimizer: {use: optimizer, in: {submaps: submaps.submaps, loops: loops.loops}}
"""
_ODOMETRY_MAP = """\
  keyframes: {use: keyframes, in: {odometry: sensors.odometry}}
  submaps: {use: submap_builder, in: {keyframes: keyframes.keyframes}}
  optimizer: {use: optimizer, in: {submaps: submaps.submaps}}
"""
_SINKS = """\
  store:
    use: map_store
    in: {maps: optimizer.maps, submaps: submaps.submaps}
    config: {path: $map}
  trajectory: {use: trajectory_sink, in: {maps: optimizer.maps}, config: {path: "${map}.tum"}}
"""
_DECODE = """\
  frames: {use: image_decode, in: {images: sensors.images}}
"""
_FEATURES = """\
  features: {{use: orb, in: {{frames: {frames}}}}}
"""


def propose_graph(recording: Recording) -> str:
    """Return the text of a graph file that maps a recording.

    Raises:
        RecordingError: If nothing in it can be mapped.
    """
    topics = {}
    for port, kind in _PORTS.items():
        found = topics_for(kind, recording)
        if found:
            topics[port] = found
    if "scans" not in topics and "odometry" not in topics:
        kinds = ", ".join(sorted({t.schema_name for t in recording.topics.values()})) or "nothing"
        raise RecordingError(
            f"{recording.path}: no LiDAR and no odometry that can be read, so there is nothing to"
            f" map; it holds {kinds}"
        )
    if "scans" in topics:
        topics.pop("odometry", None)
    if "images" in topics:
        topics.pop("frames", None)
    name = re.sub(r"\W+", "_", recording.path.stem).strip("_") or "recording"
    lines = [_HEAD.format(name=name, path=json.dumps(str(recording.path)))]
    for port, (first, *others) in topics.items():
        also = "  # also: " + ", ".join(topic.name for topic in others) if others else ""
        lines.append(f"        {port}: {_quoted(first.name)}{also}\n")
    if "scans" in topics:
        odometry, links = (_GICP, "") if "imu" in topics else (_KISS, _KEYFRAME_LINKS)
        lines += [odometry, _LIDAR_MAP, links, _LIDAR_OPTIMIZER, _SINKS]
    else:
        lines += [_ODOMETRY_MAP, _SINKS]
    if "images" in topics:
        lines += [_DECODE, _FEATURES.format(frames="frames.frames")]
    elif "frames" in topics:
        lines.append(_FEATURES.format(frames="sensors.frames"))
    return "".join(lines)


def _quoted(topic: str) -> str:
    return topic if re.fullmatch(r"[\w/.-]+", topic) else json.dumps(topic)
