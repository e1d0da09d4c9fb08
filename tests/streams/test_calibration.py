"""Camera parameters: what fits together, and what is refused."""

from typing import Any

import numpy as np
import pytest

from mapstream.streams.calibration import CameraCalibration

GOOD: dict[str, Any] = {
    "width_px": 640,
    "height_px": 480,
    "focal_px": np.array([500.0, 501.0]),
    "center_px": np.array([320.0, 240.0]),
    "distortion_parameters": np.zeros(0),
}


def test_the_camera_matrix_holds_focal_lengths_and_center() -> None:
    K = CameraCalibration(**GOOD).camera_matrix

    np.testing.assert_array_equal(K, [[500, 0, 320], [0, 501, 240], [0, 0, 1]])


@pytest.mark.parametrize(
    ("distortion", "count"),
    [("radtan", 4), ("radtan", 5), ("equidistant", 4), ("fov", 1), ("rational_polynomial", 8)],
)
@pytest.mark.parametrize("model", ["pinhole", "unified"])
def test_every_model_goes_with_every_distortion(model: str, distortion: str, count: int) -> None:
    calibration = CameraCalibration(
        **GOOD
        | {"model": model, "xi": 0.9 if model == "unified" else None}
        | {"distortion": distortion, "distortion_parameters": np.full(count, 0.01)}
    )

    assert not calibration.distortion_parameters.flags.writeable


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width_px": 0}, "an image of 0 x 480 px"),
        ({"focal_px": np.array([500.0, -1.0])}, r"focal lengths are positive, not \[500.0, -1.0\]"),
        ({"focal_px": np.array([500.0])}, r"focal_px: expected shape \(2,\), got \(1,\)"),
        ({"distortion": "radtan"}, "radtan has 4 or 5 parameters, not 0"),
        ({"distortion": "barrel"}, "no model 'pinhole' with distortion 'barrel'"),
        ({"model": "unified"}, "xi belongs to the unified model"),
        ({"xi": 1.0}, "xi belongs to the unified model"),
    ],
)
def test_what_cannot_be_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CameraCalibration(**GOOD | change)
