"""A walk round two desks and back (TUM RGB-D freiburg3_long_office_household), with its real detections.

The poses are those of motion capture, the boxes those of YOLO on every image.
"""

from __future__ import annotations

import tarfile
from dataclasses import replace
from decimal import Decimal
from pathlib import Path, PurePath

import numpy as np

from mapstream.operators.objects.tracking.object_tracker import ObjectTracker, ObjectTrackerConfig
from mapstream.recordings.datasets.object_boxes import read_boxes
from mapstream.recordings.datasets.tum_cameras import FRAME, SIZE_PX
from mapstream.recordings.trajectory_files import read_tum
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.objects import ObjectDetections
from tests.operators.objects.loops.drifted_walk import Walk

CAMERA = CameraCalibration(
    frame=FRAME,
    width_px=SIZE_PX[0],
    height_px=SIZE_PX[1],
    focal_px=np.array([535.4, 539.2]),
    center_px=np.array([320.1, 247.6]),
    distortion_parameters=np.empty(0),
)
_PITCH_RAD = 0.52  # by which the camera looks down; x of the base is ahead, z up
_AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
T_BASE_CAMERA = SE3.from_rotation(so3_exp(np.array([0, _PITCH_RAD, 0])) @ _AHEAD, [0, 0, 0])


def walk(folder: Path, *, every: int = 3, step_m: float = 0.1, step_rad: float = 0.1) -> Walk:
    """Return the walk in a folder.

    Args:
        folder: Of the data set.
        every: One image in so many is used.
        step_m: Between two vertices.
        step_rad: The same, of the direction.
    """
    truth = read_tum(folder / "groundtruth.txt")
    tracker = ObjectTracker(ObjectTrackerConfig(min_score=0.4, max_age_s=0.3))
    seen: list[ObjectDetections] = []
    poses: list[SE3] = []
    for objects in _detections(folder)[::every]:
        tracked = tracker.track(replace(objects, camera=CAMERA, T_base_sensor=T_BASE_CAMERA))
        if not truth.stamps_ns[0] <= objects.stamp_ns <= truth.stamps_ns[-1]:
            continue
        pose = truth.pose_at(objects.stamp_ns) @ T_BASE_CAMERA.inverse()
        step = poses[-1].inverse() @ pose if poses else None
        if step is None or np.linalg.norm(step.t) >= step_m or step.angle_rad >= step_rad:
            poses.append(pose)
            seen.append(tracked)
    return Walk(np.array([pose.matrix for pose in poses]), seen)


def _detections(folder: Path) -> list[ObjectDetections]:
    found = []
    with tarfile.open(folder / "yolo_txts.tar.gz") as members:
        for member in members:
            place, data = PurePath(member.name), members.extractfile(member)
            if data is None or place.suffix != ".txt" or place.name.startswith("."):
                continue
            stamp_ns = int(Decimal(place.stem) * 10**9)
            text = data.read().decode()
            found.append(read_boxes(text, place, stamp_ns, frame=FRAME, size_px=SIZE_PX))
    return sorted(found, key=lambda objects: objects.stamp_ns)
