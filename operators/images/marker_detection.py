"""Fiducial markers in an image: their numbers and corners.

Detection: OpenCV's (Garrido-Jurado et al., Pattern Recognition 47, 2014; families of Olson, AprilTag, ICRA 2011).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from mapstream.operators.features.gray import GrayImage
from mapstream.operators.images.marker_corners import refined_corners
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration

Family = Literal[
    "tag36h11", "tag25h9", "tag16h5", "aruco4x4", "aruco5x5", "aruco6x6", "aruco_original"
]
_DICTIONARIES = (
    cv2.aruco.DICT_APRILTAG_36h11,
    cv2.aruco.DICT_APRILTAG_25h9,
    cv2.aruco.DICT_APRILTAG_16h5,
    cv2.aruco.DICT_4X4_250,
    cv2.aruco.DICT_5X5_250,
    cv2.aruco.DICT_6X6_250,
    cv2.aruco.DICT_ARUCO_ORIGINAL,
)
_DICTIONARY_OF = dict(zip(get_args(Family), _DICTIONARIES, strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Marker:
    """A marker in an image."""

    number: int
    corners_px: (
        FloatArray  # (4, 2) left above, right above, right below, left below, as it was printed
    )

    @property
    def side_px(self) -> float:
        """Length of the shortest side."""
        sides = np.linalg.norm(self.corners_px - np.roll(self.corners_px, 1, axis=0), axis=1)
        return float(sides.min())


def detect_markers(image: GrayImage, camera: CameraCalibration, family: Family) -> list[Marker]:
    """Return the markers of an image, by their numbers, with their corners to a tenth of a pixel."""
    parameters = cv2.aruco.DetectorParameters()
    dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY_OF[family])
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)  # anew: workers must not share one
    corners, numbers, _ = detector.detectMarkers(image)
    if not corners:
        return []
    found = [
        Marker(int(number), refined_corners(image, camera, np.reshape(square, (4, 2))))
        for number, square in zip(np.ravel(numbers), np.asarray(corners, np.float64), strict=True)
    ]
    return sorted(found, key=lambda marker: marker.number)
