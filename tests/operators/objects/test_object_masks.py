"""Masks of objects from depth and from a LiDAR, against scenes whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mapstream.operators.objects.masks.object_masks import ObjectMasks, ObjectMasksConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import unproject
from mapstream.streams.errors import OperatorError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.objects.object_worlds import looking

pytestmark = pytest.mark.anyio

CAMERA = CameraCalibration(
    frame="camera", width_px=320, height_px=240, focal_px=np.array([250.0, 250.0]),
    center_px=np.array([159.5, 119.5]), distortion_parameters=np.zeros(0),
)  # fmt: skip
STAMP_NS = 1_000_000_000
INDOORS = SE3(looking(np.array([-2.0, 0.3, 1.3]), np.array([0.0, 0.0, 0.3])))
STREET = SE3(looking(np.array([-12.0, 1.0, 1.7]), np.array([0.0, 0.0, 1.0])))


@dataclass(frozen=True)
class Scene:
    """A box on a floor, before a wall; all upright."""

    low: tuple[float, float, float] = (-0.15, -0.2, 0.0)
    high: tuple[float, float, float] = (0.15, 0.2, 0.4)
    wall_x: float = 1.0

    @property
    def center(self) -> FloatArray:
        return (np.array(self.low) + self.high) / 2

    def cast(self, eye: FloatArray, rays: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return how far (N,) along rays (N, 3) something is, and which of them hit the box."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(np.array(side) - eye) / rays for side in (self.low, self.high)])
            floor, wall = -eye[2] / rays[:, 2], (self.wall_x - eye[0]) / rays[:, 0]
        enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        is_box = (enter < leave) & (enter > 0)
        behind = np.minimum(np.where(floor > 0, floor, np.inf), np.where(wall > 0, wall, np.inf))
        return np.where(is_box, enter, behind), is_box


def camera_sees(scene: Scene, pose: SE3, noise_m: float = 0.0) -> tuple[CameraFrame, BoolArray]:
    """The depth image, and the true mask (H, W)."""
    x, y = np.meshgrid(np.arange(320), np.arange(240))
    rays = unproject(CAMERA, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64))
    rays /= rays[:, 2:]
    depth_m, is_box = scene.cast(pose.t, rays @ pose.R.T)
    depth_m += noise_m * np.random.default_rng(0).normal(size=depth_m.shape)
    image = depth_m.reshape(240, 320).astype(np.float32)
    frame = CameraFrame(stamp_ns=STAMP_NS, image=image, encoding="32FC1", frame="camera", camera=CAMERA)  # fmt: skip
    return frame, is_box.reshape(240, 320)


def lidar_sees(scene: Scene, pose: SE3) -> tuple[PointCloud, FloatArray]:
    """A cloud of beams 0.4 deg apart in a base that stands upright at the camera, and the points on the box."""
    azimuth, elevation = np.meshgrid(np.deg2rad(np.arange(-40, 40, 0.2)), np.deg2rad(np.arange(-20, 4, 0.4)))  # fmt: skip
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    rays = np.stack([x, y, np.sin(elevation)], axis=-1).reshape(-1, 3)
    range_m, is_box = scene.cast(pose.t, rays)
    seen = range_m < 40
    points = pose.t + rays[seen] * range_m[seen, None]
    base = points - pose.t
    return PointCloud(stamp_ns=STAMP_NS, points=base.astype(np.float32)), points[is_box[seen]]


def detected(*masks: BoolArray, grow_px: float = 3.0, **more: object) -> ObjectDetections:
    """Boxes around true masks, somewhat too large."""
    boxes = []
    for mask in masks:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        boxes.append([columns[0], rows[0], columns[-1], rows[-1]] + grow_px * np.array([-1, -1, 1, 1]))  # fmt: skip
    given = {
        "stamp_ns": STAMP_NS,
        "frame": "camera",
        "width_px": 320,
        "height_px": 240,
        "boxes_px": np.array(boxes, np.float32).reshape(-1, 4),
        "labels": ("box",) * len(boxes),
        "scores": np.ones(len(boxes), np.float32),
        "camera": CAMERA,
    }
    return ObjectDetections(**{**given, **more})  # type: ignore[arg-type]  # by name


def upright(objects: ObjectDetections) -> ObjectDetections:
    """The camera on a base that stands upright, as that of the clouds."""
    return replace(objects, T_base_sensor=SE3.from_rotation(STREET.R, [0.0, 0, 0]))


def masks_of(**config: float) -> ObjectMasks:
    return ObjectMasks(ObjectMasksConfig(**config))  # type: ignore[arg-type]  # of several types


def iou(a: BoolArray, b: BoolArray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_depth_gives_the_mask_of_the_object_without_floor_and_wall() -> None:
    """Of a box on a floor: 95 % of the pixels that either has, and all points on it."""
    frame, truth = camera_sees(Scene(), INDOORS, noise_m=0.002)

    found = masks_of().with_masks(detected(truth), frame)

    assert found.mask_sources == ("depth",)
    assert iou(found.full_mask(0), truth) > 0.95
    assert len(found.points_m[0]) == 300
    world = found.points_m[0] @ INDOORS.R.T + INDOORS.t
    off = np.maximum(np.array(Scene.low) - world, world - np.array(Scene.high)).max(axis=1)
    assert np.quantile(np.abs(off), 0.95) < 0.01


def test_the_centre_is_less_biased_than_the_mean_of_the_points() -> None:
    """And lies within two of its standard deviations of the true one."""
    scene = Scene()
    frame, truth = camera_sees(scene, INDOORS)

    found = masks_of().with_masks(detected(truth), frame)

    assert found.centers_m is not None
    assert found.center_sigmas_m is not None
    true = INDOORS.R.T @ (scene.center - INDOORS.t)
    off_m = np.linalg.norm(found.centers_m[0] - true)
    assert off_m < np.linalg.norm(found.points_m[0].mean(axis=0) - true)
    assert off_m < 2 * np.sqrt(3) * found.center_sigmas_m[0]


def test_a_flat_object_on_a_table_is_not_lost_with_the_table() -> None:
    """A book of 3 cm stays, and what is 2 mm high is taken with what it lies on."""
    book, sheet = (Scene(high=(0.15, 0.2, h)) for h in (0.03, 0.002))
    book_frame, book_truth = camera_sees(book, INDOORS)
    sheet_frame, sheet_truth = camera_sees(sheet, INDOORS)

    of_book = masks_of().with_masks(detected(book_truth), book_frame)
    of_sheet = masks_of().with_masks(detected(sheet_truth), sheet_frame)

    assert iou(of_book.full_mask(0), book_truth) > 0.85
    assert of_sheet.full_mask(0)[sheet_truth].mean() > 0.9


def test_a_mask_of_a_network_is_used_and_cleaned() -> None:
    """Pixels of the wall that it took in go; pixels without depth stay."""
    frame, truth = camera_sees(Scene(), INDOORS)
    box = detected(truth, grow_px=8.0)
    given = np.ones(tuple(part.stop - part.start for part in box.window(0)), np.bool_)
    given[-20:] = False  # the floor below
    image = frame.image.copy()
    unknown = np.zeros_like(truth)
    unknown[100:105, 150:155] = True
    image[unknown] = np.nan
    with_mask = replace(box, masks=(given,), mask_sources=("model",))

    found = masks_of().with_masks(with_mask, replace(frame, image=image))

    assert found.mask_sources == ("model",)
    full = found.full_mask(0)
    assert not (full & ~with_mask.full_mask(0)).any()
    assert full[unknown & truth].all()
    behind = with_mask.full_mask(0) & (frame.image > 3.0) & ~unknown
    assert behind.sum() > 100
    assert not full[behind].any()


def test_a_lidar_gives_the_points_of_a_car_without_road_and_house() -> None:
    """95 % of the points that it has on the car, and no others but 2 %."""
    car = Scene((-2.0, -0.9, 0.0), (2.0, 0.9, 1.5), wall_x=6.0)
    _, truth = camera_sees(car, STREET)
    cloud, on_car = lidar_sees(car, STREET)

    found = masks_of(max_points=10_000).with_masks(upright(detected(truth)), cloud=cloud)

    assert found.mask_sources == ("lidar",)
    world = found.points_m[0] @ STREET.R.T + STREET.t
    is_own = ((world > np.array(car.low) - 0.05) & (world < np.array(car.high) + 0.05)).all(axis=1)
    above = on_car[:, 2] > 0.25
    assert is_own.mean() > 0.98
    assert is_own.sum() > 0.95 * above.sum()
    assert iou(found.full_mask(0), truth) > 0.7


def test_a_cloud_of_another_time_is_moved_by_the_odometry() -> None:
    """The robot drives 0.5 m towards the car between cloud and image."""
    car = Scene((-2.0, -0.9, 0.0), (2.0, 0.9, 1.5), wall_x=6.0)
    _, truth = camera_sees(car, STREET)
    forward = SE3.from_rotation(np.eye(3), [0.5, 0, 0])
    cloud, _ = lidar_sees(car, SE3.from_rotation(STREET.R, STREET.t - [0.5, 0, 0]))
    early = replace(cloud, stamp_ns=STAMP_NS - 20_000_000)
    path = [
        Odometry(stamp_ns=early.stamp_ns, T_odom_base=SE3.identity()),
        Odometry(stamp_ns=STAMP_NS, T_odom_base=forward),
    ]

    moved = masks_of().with_masks(upright(detected(truth)), cloud=early, odometry=path)
    still = masks_of().with_masks(upright(detected(truth)), cloud=early)

    assert moved.centers_m is not None
    assert still.centers_m is not None
    assert still.centers_m[0, 2] - moved.centers_m[0, 2] == pytest.approx(0.5, abs=0.15)


@pytest.mark.parametrize("where", ["depth", "cloud", "nowhere"])
def test_what_has_no_points_keeps_its_box_and_is_counted(where: str) -> None:
    """No depth in the box, no beam in it, or neither at all; empty masks and no objects survive, too."""
    frame, truth = camera_sees(Scene(), INDOORS)
    blind = replace(frame, image=np.full_like(frame.image, np.nan))
    cloud = PointCloud(stamp_ns=STAMP_NS, points=np.zeros((0, 3), np.float32))
    inputs = {"depth": {"depth": blind}, "cloud": {"cloud": cloud}, "nowhere": {}}[where]
    box = detected(truth)
    empty = np.zeros(tuple(part.stop - part.start for part in box.window(0)), np.bool_)
    with_empty = replace(box, masks=(empty,), mask_sources=("model",))

    found = masks_of().with_masks(with_empty, **inputs)  # type: ignore[arg-type]  # by name
    none = masks_of().with_masks(detected(), **inputs)  # type: ignore[arg-type]

    assert found.mask_sources == ("box",)
    assert found.masks[0].all()
    assert len(found.points_m[0]) == 0
    assert found.centers_m is not None
    assert np.isnan(found.centers_m).all()
    assert len(none) == 0


async def test_the_operator_joins_by_stamp_and_says_what_has_no_depth() -> None:
    """The second image is 0.2 s after the depth."""
    frame, truth = camera_sees(Scene(), INDOORS)
    box = detected(truth)
    late = replace(box, stamp_ns=STAMP_NS + 200_000_000)
    told = Context()

    out = await run_operator(masks_of(), run_context=told, detections=[box, late], depth=[frame])

    assert [found.mask_sources for found in out["detections"]] == [("depth",), ("box",)]
    assert told.activity.warnings == {
        "objects of camera without depth within 60 ms": 1,
        "objects whose points were not found": 1,
    }


async def test_depth_of_other_pixels_and_a_camera_without_calibration_are_refused() -> None:
    """With what to do."""
    frame, truth = camera_sees(Scene(), INDOORS)
    small = replace(frame, image=frame.image[::2, ::2], camera=None)
    bare = replace(frame, camera=None)

    with pytest.raises(OperatorError, match="put depth_registration before object_masks"):
        masks_of().with_masks(detected(truth), small)
    with pytest.raises(OperatorError, match="needs its calibration"):
        masks_of().with_masks(detected(truth, camera=None), bare)
    with pytest.raises(OperatorError, match="one of depth and clouds"):
        await run_operator(masks_of(), detections=[detected(truth)])


def test_many_small_objects_in_an_image_are_taken() -> None:
    """Each with its own points."""
    frame, _ = camera_sees(Scene(), INDOORS)
    corners = np.random.default_rng(0).uniform([0, 0], [300, 220], (80, 2))
    boxes = np.column_stack([corners, corners + 12]).astype(np.float32)
    many = detected(boxes_px=boxes, labels=("box",) * 80, scores=np.ones(80, np.float32))

    found = masks_of().with_masks(many, frame)

    assert len(found) == 80
    assert all(found.points_m[row].shape[1] == 3 for row in range(80))
