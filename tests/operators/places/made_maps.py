"""Maps of a room whose points have descriptors, flown through on a circle, with drift."""

import zlib
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.places.geometry.sightings import Sensor
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.arrays import FloatArray
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import SE3, se3_exp, so3_exp
from mapstream.streams.messages.estimates import Keyframe, Odometry, RelativePose, Submap
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.places import descriptors as made
from tests.operators.places import scenes

KIND = "brisk"
PERIOD_NS = 10**9
LAP = 16  # keyframes
_RADIUS_M = 2.0
_DRIFT = np.array([0.0, 0.0, 0.004, 0.02, 0.0, 0.01])  # of each step, on the right


@dataclass(frozen=True)
class Room:
    """Points that look like something."""

    points: FloatArray  # (N, 3)
    looks: npt.NDArray[np.uint8] | npt.NDArray[np.float32]

    def again(self, rows: npt.NDArray[np.int64], seed: int) -> npt.NDArray[np.uint8 | np.float32]:
        """What some points look like at another moment."""
        looks = self.looks[rows]
        if looks.dtype == np.uint8:
            return made.with_flipped_bits(looks.astype(np.uint8), 0.06, seed)
        return made.with_noise(looks.astype(np.float32), 0.05, seed)


def room(seed: int = 0, count: int = 700, *, of_numbers: bool = False) -> Room:
    looks = made.numbers(count, seed) if of_numbers else made.binary(count, seed)
    return Room(scenes.room_points(count, seed), looks)


def circle(keyframes: int, *, first: int = 0) -> list[SE3]:
    """Poses on a circle, looking ahead; a lap has `LAP` of them."""
    poses = []
    for k in range(first, first + keyframes):
        angle = 2 * np.pi * k / LAP
        t = [_RADIUS_M * np.sin(angle), -_RADIUS_M * np.cos(angle), 0.1 * np.sin(3 * angle)]
        poses.append(SE3.from_rotation(so3_exp([0, 0, angle]), t))
    return poses


def see(
    place: Room,
    T_map_base: SE3,
    sensor: Sensor,
    *,
    frame: str = "camera",
    stamp_ns: int = 0,
    track: int = 0,
    kind: str = KIND,
    seed: int = 0,
    sigma_px: float = 0.5,
) -> ImageFeatures:
    """What a camera sees of the room; its tracks are the points' numbers and `track`."""
    assert sensor.calibration is not None
    rng = np.random.default_rng(seed)
    px, is_seen = project(
        sensor.calibration, (T_map_base @ sensor.T_base_sensor).inverse() @ place.points
    )
    rows = np.flatnonzero(is_seen & (px >= 0).all(axis=1) & (px < [752, 480]).all(axis=1))
    return ImageFeatures(
        stamp_ns=stamp_ns,
        kind=kind,
        frame=frame,
        keypoints_px=(px[rows] + rng.normal(0, sigma_px, (len(rows), 2))).astype(np.float32),
        descriptors=place.again(rows, seed),
        track_ids=rows + track,
        T_base_sensor=sensor.T_base_sensor,
        camera=sensor.calibration,
    )


def drifted(truth: list[SE3], scale: float = 1.0) -> list[SE3]:
    """The same motion as an odometry measures it, from the same start."""
    poses = [truth[0]]
    for a, b in pairwise(truth):
        poses.append(poses[-1] @ a.inverse() @ b @ SE3(se3_exp(scale * _DRIFT)))
    return poses


def flight(
    place: Room,
    mission: str,
    truth: list[SE3],
    sensors: dict[str, Sensor],
    *,
    from_origin: bool = False,
    drift: float = 1.0,
    kinds: tuple[tuple[str, Room], ...] = (),
) -> Submap:
    """A mission along these poses; points get new tracks with each lap.

    `from_origin`: its frame is that of its first pose, as an odometry's is; otherwise it is the room's.
    """
    poses = drifted(truth, drift)
    if from_origin:
        poses = [truth[0].inverse() @ pose for pose in poses]
    keyframes, edges = [], []
    for k, (pose, true) in enumerate(zip(poses, truth, strict=True)):
        stamp_ns = k * PERIOD_NS
        features = [
            see(
                each,
                true,
                sensor,
                frame=name,
                stamp_ns=stamp_ns,
                track=100_000 * (k // LAP),
                kind=kind,
                seed=_seed(mission, k, name),
            )
            for kind, each in ((KIND, place), *kinds)
            for name, sensor in sensors.items()
        ]
        odometry = Odometry(stamp_ns=stamp_ns, T_odom_base=pose)
        keyframes.append(Keyframe(stamp_ns=stamp_ns, odometry=odometry, features=tuple(features)))
        if k:
            edges.append(
                RelativePose(
                    kind="odometry",
                    mission_a=mission,
                    stamp_a_ns=stamp_ns - PERIOD_NS,
                    mission_b=mission,
                    stamp_b_ns=stamp_ns,
                    T_a_b=poses[k - 1].inverse() @ pose,
                    covariance=np.diag([1e-4] * 3 + [1e-3] * 3),
                )
            )
    return Submap(mission_id=mission, index=0, keyframes=tuple(keyframes), edges=tuple(edges))


def flown(map_: Map, *args: Any, **options: Any) -> Map:  # noqa: ANN401  # those of `flight`
    """Add a mission to a map, with its landmarks."""
    return create_landmarks(append_submap(map_, flight(*args, **options)))[0]


def in_parts(submap: Submap, size: int) -> list[Submap]:
    """The same mission as submaps of so many keyframes, each beginning with the last one of that before."""
    parts: list[Submap] = []
    for first in range(0, len(submap.keyframes) - 1, size):
        keyframes = submap.keyframes[first : first + size + 1]
        edges = submap.edges[first : first + size]
        parts.append(replace(submap, index=len(parts), keyframes=keyframes, edges=edges))
    return parts


def _seed(mission: str, k: int, name: str) -> int:
    return zlib.crc32(f"{mission} {k} {name}".encode())
