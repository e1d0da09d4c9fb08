"""ROS messages of detected objects: vision_msgs as of ROS 2 Humble and later, and as of ROS 1.

They do not say how large the image is, which is 0 x 0 here. A detection in 3D has no box in the image, which is NaN.
Pixels of vision_msgs count from the image's corner, as networks do.
Source: github.com/ros-perception/vision_msgs, branches `ros2` and `noetic-devel`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from hashlib import blake2b

import numpy as np

from mapstream.recordings.decoding.cursor import CdrCursor, Ros1Cursor
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import NO_TRACK

_UNKNOWN = np.full(3, np.nan)
_NO_BOX = np.full(4, np.nan)


@dataclass(frozen=True, slots=True)
class _Found:
    """One detection."""

    label: str
    score: float
    pose: FloatArray | None  # (7,) translation [m] and quaternion x, y, z, w
    box_px: FloatArray  # (4,)
    extent_m: FloatArray  # (3,)
    track: str


def detections_2d(cursor: CdrCursor) -> ObjectDetections:
    """Read a vision_msgs/Detection2DArray; an object's pose is its centre if it is not all zeros."""
    return _detections(cursor, _detection_2d)


def detections_3d(cursor: CdrCursor) -> ObjectDetections:
    """Read a vision_msgs/Detection3DArray, whose boxes in space are in the frame of the header."""
    return _detections(cursor, _detection_3d)


def _detections(cursor: CdrCursor, read: Callable[[CdrCursor], _Found]) -> ObjectDetections:
    stamp_ns, frame = cursor.header()
    found = [read(cursor) for _ in range(cursor.u32())]
    cursor.end()
    poses = [one.pose for one in found]
    tracks = np.array([_number(one.track) for one in found], np.int64)
    boxes_px = np.array([one.box_px for one in found]).reshape(-1, 4)
    extents_m = np.array([one.extent_m for one in found]).reshape(-1, 3)
    is_placed = any(pose is not None for pose in poses)
    return ObjectDetections(
        stamp_ns=stamp_ns,
        frame=frame.lstrip("/") or "camera",
        width_px=0,
        height_px=0,
        boxes_px=boxes_px.astype(np.float32),
        labels=tuple(one.label for one in found),
        scores=np.array([one.score for one in found], np.float32),
        centers_m=_stacked([_UNKNOWN if p is None else p[:3] for p in poses])
        if is_placed
        else None,
        quats_camera_object_xyzw=np.array([_direction(p) for p in poses]) if is_placed else None,
        extents_m=_stacked(list(extents_m)) if np.isfinite(extents_m).any() else None,
        track_ids=tracks if (tracks != NO_TRACK).any() else None,
    )


def _stacked(rows: list[FloatArray]) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return np.array(rows, np.float32).reshape(-1, 3)


def _detection_2d(cursor: CdrCursor) -> _Found:
    label, score, pose = _best_hypothesis(cursor)
    x, y, angle, width, height = cursor.array("<f8", 5).tolist()
    cosine, sine = abs(np.cos(angle)), abs(np.sin(angle))
    half = np.array([cosine * width + sine * height, sine * width + cosine * height]) / 2
    middle = np.array([x, y]) - 0.5
    track = _rest(cursor, _skip_image)
    box_px = np.concatenate([middle - half, middle + half])
    return _Found(label, score, pose if pose[:3].any() else None, box_px, _UNKNOWN, track)


def _detection_3d(cursor: CdrCursor) -> _Found:
    label, score, _ = _best_hypothesis(cursor)
    pose, extent_m = cursor.array("<f8", 7), cursor.array("<f8", 3)
    track = _rest(cursor, _skip_cloud)
    known_m = extent_m if (extent_m > 0).all() else _UNKNOWN
    return _Found(label, score, pose, _NO_BOX, known_m, track)


def _best_hypothesis(cursor: CdrCursor) -> tuple[str, float, FloatArray]:
    """Read a detection's header and hypotheses; return class, score and pose (7,) of the most likely."""
    cursor.header()
    best = "", 0.0, np.zeros(7)
    for _ in range(cursor.u32()):
        label = str(cursor.i64()) if isinstance(cursor, Ros1Cursor) else cursor.text()
        score, pose = cursor.f64(), cursor.array("<f8", 7)
        cursor.array("<f8", 36)  # the covariance of the pose
        if score > best[1] or not best[0]:
            best = label, score, pose
    return best


def _rest(cursor: CdrCursor, skip_source: Callable[[CdrCursor], None]) -> str:
    """Read what follows the box: in ROS 1 what it was found in, in ROS 2 what it is followed by."""
    if not isinstance(cursor, Ros1Cursor):
        return cursor.text()
    skip_source(cursor)
    return ""


def _skip_image(cursor: CdrCursor) -> None:
    cursor.header()
    cursor.u32(), cursor.u32(), cursor.text(), cursor.u8(), cursor.u32()
    cursor.sequence("u1")


def _skip_cloud(cursor: CdrCursor) -> None:
    cursor.header()
    cursor.u32(), cursor.u32()
    for _ in range(cursor.u32()):
        cursor.text(), cursor.u32(), cursor.u8(), cursor.u32()
    cursor.u8(), cursor.u32(), cursor.u32()
    cursor.sequence("u1")
    cursor.u8()


def _direction(pose: FloatArray | None) -> FloatArray:
    """Return the quaternion (4,) of a pose (7,); NaN if nobody filled it in."""
    length = 0.0 if pose is None else float(np.linalg.norm(pose[3:]))
    return np.full(4, np.nan) if pose is None or not length > 0 else pose[3:] / length


def _number(track: str) -> int:
    """Return a track's number: its name if that is one, or else what stands for it."""
    if not track:
        return NO_TRACK
    if track.isdecimal() and int(track) < 2**62:
        return int(track)
    return int.from_bytes(blake2b(track.encode(), digest_size=8).digest()) >> 2
