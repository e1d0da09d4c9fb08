"""Objects of real recordings: where they are and how large, against what others measured."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mapstream.operators.objects.landmarks.object_landmarks import object_landmarks
from mapstream.operators.objects.masks.object_masks import ObjectMasks, ObjectMasksConfig
from mapstream.recordings.datasets.object_boxes import read_boxes
from mapstream.recordings.maps.object_payload import object_payload
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import CameraFrame
from tests.data import shared
from tests.operators.objects.object_worlds import map_of, positions

_CAMERA = CameraCalibration(
    frame="camera", width_px=640, height_px=480, focal_px=np.array([535.4, 539.2]),
    center_px=np.array([320.1, 247.6]), distortion_parameters=np.zeros(0),
)  # fmt: skip


@pytest.mark.slow
def test_J4_a_real_cabinet_is_where_its_cuboid_is_and_as_large() -> None:
    """Its middle within 5 cm and its sides within 15 %, from every fourth image at the poses given."""
    folder = shared("tum_fr3_cabinet_rgbd")
    truth = np.loadtxt(folder / "truth_cam_poses.txt")
    numbers = range(0, len(truth), 4)
    poses = [SE3.from_quat_xyzw(truth[n, 4:8], truth[n, 1:4]).matrix for n in numbers]

    map_, report = object_landmarks(map_of(np.array(poses), [_seen(folder, n) for n in numbers]))

    *center, _, x, y, z = np.loadtxt(folder / "truth_objects.txt").tolist()  # half of its sides
    assert report.num_objects == 1
    assert np.linalg.norm(positions(map_)[0] - center) < 0.05
    extent_m = object_payload(map_.landmarks, 0)["extent_m"]
    np.testing.assert_allclose(extent_m, [2 * x, 2 * y, 2 * z], rtol=0.15)


def _seen(folder: Path, number: int) -> ObjectDetections:
    """Return the cabinet in one image, by the boxes of a network and the depth."""
    path = folder / f"depth_imgs/{number:04d}_depth_raw.png"
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    stamp_ns = 1_000_000_000 * (number + 1)
    depth = CameraFrame(
        stamp_ns=stamp_ns, image=image / np.float32(5000), encoding="32FC1", camera=_CAMERA
    )
    boxes = next((folder / "bbox_2d_yolov2").glob(f"{number:04d}_*.txt"))
    found = read_boxes(
        boxes.read_text(), boxes, stamp_ns, frame="camera", size_px=(640, 480), label="cabinet"
    )
    return ObjectMasks(ObjectMasksConfig()).with_masks(found, depth)
