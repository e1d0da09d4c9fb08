"""A robot with a LiDAR that spins in a ring of corridors (W-LID), whose motion and walls are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from mapstream.operators.lidar.images.lidar_keypoints import LidarKeypoints, LidarKeypointsConfig
from mapstream.operators.lidar.images.lidar_tracks import LidarTracks, LidarTracksConfig
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.worlds.corridor import Corridor
from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.recordings.worlds.ring import Ring
from mapstream.recordings.worlds.sensors import Lidar, LidarConfig
from mapstream.recordings.worlds.w_lid import T_BASE_LIDAR, WLidConfig, drive
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Keyframe, Odometry, RelativePose, Submap
from mapstream.streams.messages.sensors import LidarScan
from mapstream.streams.messages.vision import ImageFeatures

MISSION = "0" * 31 + "1"
_START_S = 7.3  # amid the drive the spin changes from one side to the other
_PERIOD_NS = 10**8


@dataclass(frozen=True)
class Drive:
    """What the LiDAR saw, and where it was."""

    caster: RayCaster
    motion: Motion
    scans: list[LidarScan]

    def poses(self) -> list[SE3]:
        """Where the base was at the end of each scan."""
        ends = np.array([scan.end_ns for scan in self.scans])
        return [SE3(T) for T in self.motion.poses(ends)]


def spin(num_scans: int) -> Drive:
    """Scans from within a turn at 90 deg/s, at 3 m/s."""
    config = WLidConfig(length_m=40.0, aggressive=True)
    motion = drive(Ring(config.length_m), config)
    first_ns = motion.start_ns + round(_START_S * 1e9)
    return _seen(config, motion, [first_ns + k * _PERIOD_NS for k in range(num_scans)], 1024)


def pass_twice(num_scans: int) -> Drive:
    """Scans from one stretch of the corridors, and as many from the next time round."""
    config = WLidConfig(length_m=36.0, overlap_fraction=0.4)
    motion = drive(Ring(config.length_m), config)
    first_ns = motion.start_ns + 5 * 10**9
    later = np.arange(first_ns + 6 * 10**9, motion.end_ns - 2 * 10**9, 10**7)
    place = motion.poses(np.array([first_ns]))[0, :3, 3]
    nearest = np.argmin(np.linalg.norm(motion.poses(later)[:, :3, 3] - place, axis=1))
    starts = [
        start + k * _PERIOD_NS
        for start in (first_ns, int(later[nearest]))
        for k in range(num_scans)
    ]
    return _seen(config, motion, starts, 512)


def _seen(config: WLidConfig, motion: Motion, starts_ns: list[int], columns: int) -> Drive:
    rng = np.random.default_rng(3)
    caster = RayCaster(Corridor(Ring(config.length_m), rng).mesh())
    lidar = Lidar(LidarConfig(beams=64, columns=columns), T_BASE_LIDAR, rng)
    return Drive(caster, motion, [lidar.scan(caster, motion, start) for start in starts_ns])


def tracked(seen: Drive, poses: list[SE3] | None = None) -> list[ImageFeatures]:
    """The keypoints of all scans, followed by the true motion or another one."""
    keypoints, tracks = LidarKeypoints(LidarKeypointsConfig()), LidarTracks(LidarTracksConfig())
    return [
        tracks.track(keypoints.detect(scan), pose)
        for scan, pose in zip(seen.scans, poses or seen.poses(), strict=True)
    ]


def mapped(
    seen: Drive, features: Sequence[Sequence[ImageFeatures]], poses: list[SE3] | None = None
) -> Map:
    """A map with one vertex at the end of each scan, where the base truly was or is said to be."""
    stamps_ns = [scan.end_ns for scan in seen.scans]
    poses = poses or seen.poses()
    keyframes = tuple(
        Keyframe(
            stamp_ns=stamp_ns,
            odometry=Odometry(stamp_ns=stamp_ns, T_odom_base=pose),
            features=tuple(each),
        )
        for stamp_ns, pose, each in zip(stamps_ns, poses, features, strict=True)
    )
    edges = tuple(
        RelativePose(
            kind="odometry",
            mission_a=MISSION,
            stamp_a_ns=a.stamp_ns,
            mission_b=MISSION,
            stamp_b_ns=b.stamp_ns,
            T_a_b=a.odometry.T_odom_base.inverse() @ b.odometry.T_odom_base,
            covariance=np.diag([1e-6] * 3 + [1e-4] * 3),
        )
        for a, b in pairwise(keyframes)
    )
    submap = Submap(mission_id=MISSION, index=0, keyframes=keyframes, edges=edges)
    return append_submap(Map.empty(), submap)


def without_times(map_: Map) -> Map:
    """The same map, if every keypoint were of its vertex's moment."""
    return replace(
        map_,
        observations=replace(
            map_.observations, offset_ns=np.zeros(len(map_.observations), np.int64)
        ),
    )


def off_walls_m(seen: Drive, points: FloatArray) -> FloatArray:
    """How far points (N, 3) are from the walls, across them, as the LiDAR sees them amid the drive; NaN if on none."""
    middle = seen.motion.poses(np.array([seen.scans[len(seen.scans) // 2].stamp_ns]))[0]
    origin = (SE3(middle) @ T_BASE_LIDAR).t
    away = points - origin
    distance_m = np.linalg.norm(away, axis=1)
    directions = away / distance_m[:, None]
    hits = seen.caster.cast(np.tile(origin, (len(points), 1)), directions)
    normals = seen.caster.normals[hits.faces]
    across = (distance_m - hits.ranges_m) * np.einsum("ni,ni->n", directions, normals)
    off: FloatArray = np.where(np.abs(normals[:, 2]) < 0.2, across, np.nan)
    return off
