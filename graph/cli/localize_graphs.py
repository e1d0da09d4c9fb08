"""The graphs that localise a recording in a map: by cameras, or by a LiDAR."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mapstream.graph.fit import topics_for
from mapstream.graph.trajectory_sources import TRUTH
from mapstream.recordings.maps import load_map
from mapstream.recordings.recording import Recording
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import EncodedImage, LidarScan

OPERATOR = "localize"  # that takes the options of the command
POSES = "/map_poses"
_DETECTED = ("orb", "brisk", "freak", "sift")  # kinds of the operator `features`
_HEAD = """\
version: 1
name: localize
params:
  recording: {type: path}
operators:
"""
_SOURCE = "  sensors: {{use: mcap, config: {{path: $recording, topics: {topics}}}}}\n"
_CAMERA = """\
  decode_{n}: {{use: image_decode, in: {{images: sensors.camera_{n}}}, config: {{mode: gray}}}}
"""
_DETECTOR = """\
  {kind}_{n}: {{use: features, in: {{frames: decode_{n}.frames}}, config: {{kind: {kind}}}}}
"""
_KISS = "  kiss: {use: kiss_odometry, in: {scans: sensors.scans}}\n"
_LOCALIZE = '  localize: {{use: {use}, in: {{{ports}}}, config: {{map: "{folder}"}}}}\n'
_SINK = (
    '  poses: {use: mcap_sink, in: {poses: localize.poses}, config: {path: "OUT",'
    f" schemas: mapstream, topics: {{poses: {POSES}}}}}}}\n"
)


def is_for_lidar(folder: Path, recording: Recording) -> bool:
    """Return whether a map has clouds and nothing that is detected in images, and a recording scans."""
    return is_of_clouds(folder) and bool(topics_for(LidarScan, recording))


def is_of_clouds(folder: Path) -> bool:
    """Return whether a map has clouds and nothing that is detected in images."""
    has_clouds = "cloud" in load_map(folder, tables=["resources"]).resources.kind.tolist()
    return has_clouds and not _kinds(folder)[0]


def lidar_graph(folder: Path, recording: Recording, lidar: str | None, odometry: str | None) -> str:
    """Return the graph that localises a recording by its scans, as YAML; without odometry, by KISS-ICP's.

    Raises:
        ConfigError: If the recording has no such topics.
    """
    there = [topic.name for topic in topics_for(LidarScan, recording)]
    chosen = lidar or next(iter(there), "")
    _require(recording, [chosen], there, odometry, "with scans")
    topics = {"scans": chosen} | ({"odometry": odometry} if odometry is not None else {})
    moves = "kiss.odometry" if odometry is None else "sensors.odometry"
    ports = f"clouds: kiss.clouds, odometry: {moves}"
    localize = _LOCALIZE.format(use="localize_lidar", ports=ports, folder=folder.absolute())
    return "".join([_HEAD, _SOURCE.format(topics=_flow(topics)), _KISS, localize, _SINK])


def camera_graph(
    folder: Path, recording: Recording, cameras: Sequence[str] | None, odometry: str | None
) -> str:
    """Return the graph that localises a recording by its images, as YAML.

    Raises:
        ConfigError: If the recording has no such topics, or the map no features that are detected here.
    """
    kinds, there_are = _kinds(folder)
    if not kinds:
        raise ConfigError(
            f"{folder}: its landmarks are of the kinds {', '.join(there_are) or 'none'}, and this command detects"
            f" {', '.join(_DETECTED)}; write a graph with your detectors and the operator localize"
        )
    there = [topic.name for topic in topics_for(EncodedImage, recording)]
    chosen = list(cameras or sorted(there))
    _require(recording, chosen, there, odometry, "with images")
    topics = {f"camera_{n}": topic for n, topic in enumerate(chosen)}
    topics |= {"odometry": odometry} if odometry is not None else {}
    streams = {f"{kind}_{n}": f"{kind}_{n}.features" for n in range(len(chosen)) for kind in kinds}
    ports = "n_frames: n_frames.n_frames" + (", odometry: sensors.odometry" if odometry else "")
    lines = [_HEAD, _SOURCE.format(topics=_flow(topics))]
    for n in range(len(chosen)):
        lines.append(_CAMERA.format(n=n))
        lines += [_DETECTOR.format(n=n, kind=kind) for kind in kinds]
    lines.append(
        f"  n_frames: {{use: n_frames, in: {_flow(streams)}, config: {{inputs: [{', '.join(streams)}]}}}}\n"
    )
    localize = _LOCALIZE.format(use="localize", ports=ports, folder=folder.absolute())
    return "".join([*lines, localize, _SINK])


def _require(
    recording: Recording,
    chosen: Sequence[str],
    there: Sequence[str],
    odometry: str | None,
    what: str,
) -> None:
    """Refuse topics that are not there, and to do without any."""
    with_poses = [topic.name for topic in topics_for(Odometry, recording) if topic.name != TRUTH]
    missing = [topic for topic in chosen if topic and topic not in there]
    missing += [odometry] if odometry is not None and odometry not in with_poses else []
    if missing or not any(chosen):
        known = ", ".join([*there, *with_poses]) or "none"
        raise ConfigError(f"{recording.path}: no topic {missing or what}; there are {known}")


def _kinds(folder: Path) -> tuple[list[str], list[str]]:
    """Return the kinds of a map's landmarks that are detected here, and all of them."""
    kinds = sorted(set(load_map(folder, tables=["landmarks"]).landmarks.kind.tolist()))
    return [kind for kind in kinds if kind in _DETECTED], kinds


def _flow(items: dict[str, str]) -> str:
    return "{" + ", ".join(f"{name}: {value}" for name, value in items.items()) + "}"
