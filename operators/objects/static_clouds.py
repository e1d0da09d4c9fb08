"""Clouds without the points of objects that move; what could move and stands stays.

An object moves if its middle went farther, in the time around a cloud, than it is unsure (`moving.py`).
Source: the project's own; the role of the semantic filters of maplab 2.0 for dynamic objects.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapstream.operators.objects.moving import MovingConfig, Path, is_moving
from mapstream.operators.operator import Operator, Placement, offload, warn
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import NO_TRACK
from mapstream.streams.sync import anchored, window
from mapstream.streams.trajectory import Trajectory

_SPACINGS = 2.0  # of the points that are kept of an object: so near are the others
_LEAST_SPACING_M = 0.03
_MOST_REACH_M = 0.6
_MAX_VOTERS = (
    5  # sightings that are asked which points are of the object: one of them may have a wrong mask
)
_MIN_VOTES = 0.4  # of them


class StaticCloudsConfig(MovingConfig):
    """Options of `static_clouds`."""

    window_s: PositiveFloat = 2.0
    """Before and after a cloud; clouds wait so long."""
    margin_m: NonNegativeFloat = 0.05
    """So far around the points of an object the cloud's points are its own."""
    classes: tuple[str, ...] = ()
    """Of objects that may move; none given: all."""
    always: tuple[str, ...] = ()
    """Classes that are taken out though they stand."""
    max_late_s: PositiveFloat = Field(default=0.5)
    """A moving object is taken out so long before it is first seen and after it is last seen."""


@dataclass(frozen=True)
class Inputs:
    """Clouds in the base frame, tracked objects with their points (`object_masks`, `object_tracker`), and the odometry."""

    clouds: Receiver[PointCloud]
    detections: Receiver[ObjectDetections]
    odometry: Receiver[Odometry]


@dataclass(frozen=True)
class Outputs:
    """The clouds, without what moves."""

    clouds: Sender[PointCloud]


class StaticClouds(Operator[Inputs, Outputs]):
    """Take the points of moving objects out of clouds.

    It looks at where each tracked object was before and after the cloud, so clouds are late by the window.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: StaticCloudsConfig) -> None:
        self._config = config
        self._known: dict[tuple[str, int], dict[int, _Sight]] = {}

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        reach_ns = round(self._config.window_s * 1e9)
        objects = window(inputs.detections, reach_ns, reach_ns, cover=False)
        poses = window(inputs.odometry, reach_ns, reach_ns, cover=False)
        async for cloud, seen, path in anchored(inputs.clouds, objects, poses):
            await outputs.clouds.send(await offload(self.static, cloud, seen, path))

    def static(
        self,
        cloud: PointCloud,
        detections: Sequence[ObjectDetections],
        odometry: Sequence[Odometry],
    ) -> PointCloud:
        """Return the cloud without the points of what moves around its time."""
        if len(odometry) < 2:
            warn("clouds without odometry around them are left as they are")
            return cloud
        base = Trajectory(
            stamps_ns=np.array([each.stamp_ns for each in odometry]),
            poses=np.array([each.T_odom_base.matrix for each in odometry]),
        )
        if not base.covers(cloud.stamp_ns):
            warn("clouds beyond the odometry are left as they are")
            return cloud
        T_odom_base = base.pose_at(cloud.stamp_ns)
        oldest_ns = min((objects.stamp_ns for objects in detections), default=0)
        self._known = {key: v for key, v in self._known.items() if key[1] >= oldest_ns}
        goes = np.zeros(len(cloud.points), np.bool_)
        sights = [self._placed(objects, base) for objects in detections]
        for label, path in _paths(sights):
            if self._goes(label, path):
                goes |= self._own(cloud, path, T_odom_base)
        return _without(cloud, goes) if goes.any() else cloud

    def _placed(self, objects: ObjectDetections, base: Trajectory) -> dict[int, _Sight]:
        """Return the objects of an image in the odometry's frame; the same image is asked for again and again."""
        key = objects.frame, objects.stamp_ns
        if key not in self._known and base.covers(objects.stamp_ns):
            self._known[key] = _sights(objects, base.pose_at(objects.stamp_ns))
        return self._known.get(key, {})

    def _goes(self, label: str, path: Path) -> bool:
        config = self._config
        if label in config.always:
            return True
        return (not config.classes or label in config.classes) and is_moving(path, config)

    def _own(self, cloud: PointCloud, path: Path, T_odom_base: SE3) -> BoolArray:
        """Return which points (N,) of a cloud are of an object: those near its own, moved to the time of the cloud."""
        from scipy.spatial import cKDTree  # noqa: PLC0415  # takes long to import

        own = np.zeros(len(cloud.points), np.bool_)
        away_ns = np.abs(path.stamps_ns - cloud.stamp_ns)
        is_usable = away_ns <= self._config.max_late_s * 1e9
        is_usable &= np.array([len(points) > 1 for points in path.points])
        order = np.argsort(away_ns, kind="stable")
        voters = order[is_usable[order]][:_MAX_VOTERS]
        if not len(voters):
            return own
        moved = path.center_at(cloud.stamp_ns) - path.centers
        shapes = [(path.points[n] + moved[n] - T_odom_base.t) @ T_odom_base.R for n in voters]
        every = np.concatenate(shapes)
        low, high = every.min(axis=0) - _MOST_REACH_M, every.max(axis=0) + _MOST_REACH_M
        near = np.flatnonzero(((cloud.points >= low) & (cloud.points <= high)).all(axis=1))
        votes = np.zeros(len(near), np.int64)
        for points in shapes:
            tree = cKDTree(points)
            spacing_m = float(np.median(tree.query(points, 2)[0][:, 1]))
            reach_m = _SPACINGS * max(spacing_m, _LEAST_SPACING_M) + self._config.margin_m
            reach_m = min(reach_m, _MOST_REACH_M)
            votes += tree.query(cloud.points[near], distance_upper_bound=reach_m)[0] <= reach_m
        own[near] = votes > _MIN_VOTES * len(voters)
        return own


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """A tracked object in one image, in the odometry's frame."""

    stamp_ns: int
    label: str
    center: FloatArray  # (3,)
    sigma_m: float
    eye: FloatArray  # (3,) the camera
    points: Float32Array  # (K, 3)


def _paths(sights: Sequence[dict[int, _Sight]]) -> Iterator[tuple[str, Path]]:
    """Yield each tracked object with its class and where it was."""
    seen: dict[int, list[_Sight]] = defaultdict(list)
    for image in sights:
        for track, sight in image.items():
            seen[track].append(sight)
    for track in sorted(seen):
        labels = [sight.label for sight in seen[track]]
        yield (
            max(sorted(set(labels)), key=labels.count),
            Path(
                np.array([sight.stamp_ns for sight in seen[track]]),
                np.array([sight.center for sight in seen[track]]),
                np.array([sight.sigma_m for sight in seen[track]]),
                np.array([sight.eye for sight in seen[track]]),
                tuple(sight.points for sight in seen[track]),
            ),
        )


def _sights(objects: ObjectDetections, T_odom_base: SE3) -> dict[int, _Sight]:
    """Return the tracked objects of an image whose places are known, by track."""
    tracks, centers_m = objects.track_ids, objects.centers_m
    if tracks is None or centers_m is None:
        return {}
    T_odom_camera = T_odom_base @ objects.T_base_sensor
    is_known = np.isfinite(centers_m).all(axis=1) & (tracks != NO_TRACK)
    return {
        int(tracks[row]): _sight(objects, row, T_odom_camera, centers_m[row])
        for row in np.flatnonzero(is_known).tolist()
    }


def _sight(
    objects: ObjectDetections, row: int, T_odom_camera: SE3, center_m: Float32Array
) -> _Sight:
    R, t = T_odom_camera.R, T_odom_camera.t
    sigmas_m = objects.center_sigmas_m
    points = objects.points_m[row] if objects.points_m else np.empty((0, 3), np.float32)
    return _Sight(
        stamp_ns=objects.stamp_ns,
        label=objects.labels[row],
        center=R @ center_m + t,
        sigma_m=0.0 if sigmas_m is None else float(np.nan_to_num(sigmas_m[row])),
        eye=t,
        points=(points @ R.T + t).astype(np.float32),
    )


def _without(cloud: PointCloud, goes: BoolArray) -> PointCloud:
    parts = {
        name: values[~goes]
        for name in ("points", "intensity", "colors_rgba")
        if (values := getattr(cloud, name)) is not None
    }
    return replace(cloud, **parts)
