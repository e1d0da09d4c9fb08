"""A map of true poses that refers to depth and colour of a small recording of W-RGBD."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from mapstream.recordings.maps import Map
from mapstream.recordings.maps.ids import mission_id
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.recording import open_recording
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.recordings.worlds.orbit import orbit
from mapstream.recordings.worlds.w_rgbd import START_NS
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Keyframe, Odometry, RelativePose, Submap
from mapstream.streams.messages.sensors import RecordRef

DURATION_S = 4.0
SIZE = {"width_px": 200, "height_px": 150}
TOPICS = ("/color/image", "/depth/image")


def write_recording(path: Path, *, rate_hz: float = 2.0) -> None:
    """Write the recording, with so many pictures of each kind in a second."""
    camera = {**SIZE, "rate_hz": rate_hz, "format": "png"}
    simulate("w_rgbd", path, seed=0, duration_s=DURATION_S, camera=camera, texel_m=0.03)


def true_map(path: Path) -> Map:
    """Return the map whose vertices are the moments of the images, its frame the room's."""
    records: dict[int, list[RecordRef]] = {}
    with open_recording(path) as recording:
        for raw in recording.messages(list(TOPICS)):
            reference = RecordRef(path=str(path), topic=raw.topic, log_ns=raw.log_ns)
            records.setdefault(raw.log_ns, []).append(reference)
    stamps_ns = np.array(sorted(records))
    poses = orbit(DURATION_S, START_NS).poses(stamps_ns)
    frames = [
        Keyframe(
            stamp_ns=int(stamp_ns),
            odometry=Odometry(stamp_ns=int(stamp_ns), T_odom_base=SE3(pose)),
            records=tuple(records[int(stamp_ns)]),
        )
        for stamp_ns, pose in zip(stamps_ns, poses, strict=True)
    ]
    return append_submap(Map.empty(), drive(frames), mission_name="room")


def drive(frames: list[Keyframe]) -> Submap:
    """Return keyframes as one submap, with odometry between them."""
    mission = mission_id("room", 0)
    edges = [
        RelativePose(
            kind="odometry",
            mission_a=mission,
            stamp_a_ns=a.stamp_ns,
            mission_b=mission,
            stamp_b_ns=b.stamp_ns,
            T_a_b=a.odometry.T_odom_base.inverse() @ b.odometry.T_odom_base,
            covariance=np.eye(6) * 1e-4,
        )
        for a, b in pairwise(frames)
    ]
    return Submap(mission_id=mission, index=0, keyframes=tuple(frames), edges=tuple(edges))
