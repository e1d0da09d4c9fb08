"""Fiducial markers become measurements: of the camera's place, or of their own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapstream.operators.images.fiducials import Fiducials, FiducialsConfig
from mapstream.operators.images.marker_detection import detect_markers
from mapstream.operators.images.marker_places import TagConfig, tags_of
from mapstream.operators.images.marker_poses import points_pose, square_corners, square_poses
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.camera_models import project, unproject
from mapstream.streams.errors import ConfigError, OperatorError
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.images.cameras import camera, frame

pytestmark = pytest.mark.anyio
_SIZE_M = 0.4
_FINE = 3  # rays along each side of a pixel
_LENS = camera(
    "radtan",
    width_px=240,
    height_px=180,
    focal_px=np.full(2, 190.0),
    center_px=np.array([118, 91.0]),
)
_ROOM_TAG = {  # T_room_tag
    3: SE3.from_rotation(so3_exp([0.3, 0.2, 0.1]), [1.0, 2.0, 0.5]),
    8: SE3.from_rotation(so3_exp([0.3, -0.9, 0.1]), [1.7, 2.1, 0.4]),
}
_T_BASE_CAMERA = SE3.exp([0.3, -0.2, 1.1, 0.2, 0.1, 0.4])
_FACING = SE3.from_rotation(np.diag([1.0, -1, -1]))  # the tag's z looks at the camera


def _numbers(T: SE3) -> tuple[float, ...]:
    return (*T.t.tolist(), *T.quat_xyzw.tolist())


def _known(*numbers: int) -> tuple[TagConfig, ...]:
    return tuple(TagConfig(id=n, T_frame_tag=_numbers(_ROOM_TAG[n])) for n in numbers)


@cache
def _rays() -> np.ndarray:
    """Return where the parts of each pixel look, row by row."""
    x, y = np.meshgrid(*(np.arange(n * _FINE) for n in (_LENS.width_px, _LENS.height_px)))
    return unproject(_LENS, (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5) / _FINE - 0.5)


def _picture(T_room_camera: SE3, *numbers: int, seed: int = 0) -> CameraFrame:
    """Return an image of markers on grey: each ray ends on the plane of each marker."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    values = np.full(len(_rays()), 120.0)
    for number in numbers:
        code = cv2.aruco.generateImageMarker(family, number, 8 * 20)
        paper = np.pad(code, 20, constant_values=255)
        T_tag_camera = _ROOM_TAG[number].inverse() @ T_room_camera
        directions = _rays() @ T_tag_camera.R.T
        hit = T_tag_camera.t - directions * (T_tag_camera.t[2] / directions[:, 2])[:, None]
        texel = np.round((hit[:, :2] * [1, -1] / _SIZE_M + 0.625) * 160 - 0.5)
        inside = ((texel >= 0) & (texel < 200)).all(axis=1) & (directions[:, 2] < 0)
        column, row = texel[inside].astype(int).T
        values[inside] = paper[row, column]
    shape = (_LENS.height_px, _FINE, _LENS.width_px, _FINE)
    image = values.reshape(shape).mean(axis=(1, 3))
    image += np.random.default_rng(seed).normal(0, 2, image.shape)
    return frame(np.clip(image, 0, 255).astype(np.uint8), "mono8", _LENS, _T_BASE_CAMERA)


def _view(distance_m: float = 2.0, tilt_rad: float = 0.5, number: int = 3) -> SE3:
    """Return T_room_camera that looks at a marker from the side."""
    tilted = SE3.from_rotation(so3_exp([0.1, tilt_rad, 0.2]))
    return (
        _ROOM_TAG[number]
        @ tilted
        @ _FACING
        @ SE3.from_rotation(np.eye(3), [0.1, 0.05, -distance_m])
    )


def test_corners_are_found_to_a_tenth_of_a_pixel() -> None:
    errors = []
    for seed, tilt in enumerate((0.1, 0.3, 0.5)):
        T_room_camera = _view(1.5 + 0.7 * seed, tilt)
        (marker,) = detect_markers(_picture(T_room_camera, 3, seed=seed).image, _LENS, "tag36h11")
        T_camera_tag = T_room_camera.inverse() @ _ROOM_TAG[3]
        truth = project(_LENS, square_corners(_SIZE_M) @ T_camera_tag.R.T + T_camera_tag.t)[0]
        errors.append(marker.corners_px - truth)
    assert np.sqrt(np.mean(np.square(errors))) < 0.06


async def test_A13_a_marker_of_known_place_says_where_the_camera_is() -> None:
    config = FiducialsConfig(size_m=_SIZE_M, tags=_known(3), frame="room")
    T_room_camera = _view()

    out = await run_operator(Fiducials(config), frames=[_picture(T_room_camera, 3)])

    (measured,) = out["constraints"]
    assert (measured.kind, measured.outer.name, measured.landmark) == ("absolute", "room", None)
    assert (measured.stamp_ns, measured.T_base_sensor) == (7, _T_BASE_CAMERA)
    error = (measured.T_a_b.inverse() @ T_room_camera).log()
    assert np.linalg.norm(error[3:]) < 0.01
    assert error @ np.linalg.solve(measured.covariance, error) < 16.8  # 99 % of chi2 with 6


async def test_A13_a_marker_of_unknown_place_is_a_landmark() -> None:
    config = FiducialsConfig(tags=(TagConfig(id=3, size_m=_SIZE_M),))
    T_room_camera = _view()

    (measured,) = (await run_operator(Fiducials(config), frames=[_picture(T_room_camera, 3)]))[
        "constraints"
    ]

    landmark = measured.landmark
    assert measured.kind == "landmark"
    assert (landmark.name, landmark.kind, landmark.label) == ("tag36h11:3", "pose", "fiducial")
    T_base_tag = _T_BASE_CAMERA @ T_room_camera.inverse() @ _ROOM_TAG[3]
    error = (measured.T_a_b.inverse() @ T_base_tag).log()
    assert np.linalg.norm(error[3:]) < 0.01
    assert error @ np.linalg.solve(measured.covariance, error) < 16.8


async def test_A13_all_known_markers_of_an_image_are_one_measurement() -> None:
    """Two markers apart say more than one, and a third that nobody placed is a landmark beside it."""
    T_room_camera = _view(2.5, 0.0)
    picture = _picture(T_room_camera, 3, 8)

    both = Fiducials(FiducialsConfig(size_m=_SIZE_M, tags=_known(3, 8)))
    one = Fiducials(FiducialsConfig(size_m=_SIZE_M, tags=_known(8)))

    (joint,) = both.measure(picture)
    alone = one.measure(picture)
    assert {c.kind for c in alone} == {"absolute", "landmark"}
    (absolute,) = (c for c in alone if c.kind == "absolute")
    assert np.linalg.det(joint.covariance) < 0.1 * np.linalg.det(absolute.covariance)
    assert np.linalg.norm((joint.T_a_b.inverse() @ T_room_camera).log()) < 0.01


async def test_markers_that_measure_nothing_are_named() -> None:
    near, far = _picture(_view(2.0), 3), _picture(_view(4.0, 0.4), 3)
    wrong = tuple(TagConfig(id=n, T_frame_tag=_numbers(_ROOM_TAG[11 - n])) for n in (3, 8))
    remarks = {
        "too small": (FiducialsConfig(size_m=_SIZE_M, least_side_px=60), near),
        "whose size nobody said": (FiducialsConfig(), near),
        "in two ways": (FiducialsConfig(size_m=_SIZE_M, sigma_px=0.5), far),
        "do not fit": (
            FiducialsConfig(size_m=_SIZE_M, tags=wrong),
            _picture(_view(2.5, 0.0), 3, 8),
        ),
    }
    for remark, (config, picture) in remarks.items():
        context = Context()
        out = await run_operator(Fiducials(config), run_context=context, frames=[picture])

        assert out["constraints"] == [], remark
        assert any(remark in warning for warning in context.activity.warnings), remark


async def test_images_without_markers_hold_nobody_up_and_without_calibration_are_refused() -> None:
    operator = Fiducials(FiducialsConfig(size_m=_SIZE_M))
    empty = frame(np.full((60, 80), 90, np.uint8), "mono8", _LENS)

    assert (await run_operator(operator, frames=[empty]))["constraints"] == []
    with pytest.raises(OperatorError, match="the camera cam has no calibration"):
        operator.measure(replace(_picture(_view(), 3), camera=None))


def test_the_covariance_is_that_of_the_errors() -> None:
    """Over many poses and noises, squared errors in units of it are six on average."""
    rng = np.random.default_rng(1)
    sigma_px, points = 0.1, square_corners(_SIZE_M)
    squares = []
    for _ in range(100):
        T = SE3.exp([*rng.normal(0, 0.2, 3), *rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 3])])
        T_camera_tag = T @ SE3.from_rotation(so3_exp([0, 0.6, 0])) @ _FACING
        px = project(_LENS, points @ T_camera_tag.R.T + T_camera_tag.t)[0]
        found = points_pose(_LENS, points, px + rng.normal(0, sigma_px, px.shape), T_camera_tag)
        error = (found.T_camera_points.inverse() @ T_camera_tag).log()
        squares.append(error @ np.linalg.solve(found.covariance * sigma_px**2, error))
    assert 4.8 < np.mean(squares) < 7.2


def test_a_square_seen_without_noise_is_where_it_is() -> None:
    T_camera_tag = _view().inverse() @ _ROOM_TAG[3]
    px = project(_LENS, square_corners(_SIZE_M) @ T_camera_tag.R.T + T_camera_tag.t)[0]

    best, other = square_poses(_LENS, square_corners(_SIZE_M), px)

    np.testing.assert_allclose(best.T_camera_points.matrix, T_camera_tag.matrix, atol=1e-6)
    assert best.rms_px < 1e-6 < other.rms_px


def test_tags_from_a_file_and_from_the_graph(tmp_path: Path) -> None:
    path = tmp_path / "tags.yaml"
    path.write_text(
        "tags:\n  - {id: 3, T_frame_tag: [1, 2, 3, 0, 0, 0, 1]}\n  - {id: 4, size_m: 0.2}\n"
    )

    tags = tags_of((TagConfig(id=5, size_m=0.3),), path, 0.5)

    assert [tags.size_of(n) for n in (3, 4, 5, 6)] == [0.5, 0.2, 0.3, 0.5]
    assert tags.places[3].t.tolist() == [1, 2, 3]
    with pytest.raises(ConfigError, match="tags: 4: described twice"):
        tags_of((TagConfig(id=4),), path, None)
    path.write_text("tags:\n  - {id: 3, T_frame_tag: [1, 2, 3]}\n")
    with pytest.raises(
        ConfigError, match=r"tags\.yaml:2: .*T_frame_tag: expected 7 numbers, got 3"
    ):
        tags_of((), path, None)
    path.write_text("tags:\n  - {id: 3, size_m: -1}\n")
    with pytest.raises(ConfigError, match=r"tags\.yaml:2"):
        tags_of((), path, None)
