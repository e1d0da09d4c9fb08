"""What moves is taken out of clouds, and what stands stays, whichever side of it is seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mapstream.operators.objects.moving import MovingConfig, Path, is_moving
from mapstream.operators.objects.static_clouds import StaticClouds, StaticCloudsConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.objects import ObjectDetections
from tests.operators.objects.object_worlds import CAMERA, Thing, looking

pytestmark = pytest.mark.anyio

START_NS, STEP_NS = 1_000_000_000, 100_000_000
NUM = 40
CAR = (4.0, 1.8, 1.5)


@dataclass(frozen=True)
class Street:
    """A robot that drives along x, past a car that stands and behind one that goes at 3 m/s and then stops."""

    stamps_ns: tuple[int, ...] = tuple(START_NS + STEP_NS * n for n in range(NUM))
    stops_at: int = NUM

    def things(self, n: int) -> list[Thing]:
        return [
            Thing("car", (14.0, 4.0, 0.75), CAR),
            Thing("car", (9.0 + 0.3 * min(n, self.stops_at), 0.0, 0.75), CAR),
        ]

    def pose(self, n: int) -> FloatArray:
        eye = np.array([0.2 * n, 0.0, 1.5])
        return looking(eye, eye + np.array([1.0, 0, -0.05]))

    def seen(self, n: int, *, cut: bool = False) -> tuple[PointCloud, BoolArray, ObjectDetections]:
        """The cloud in the base frame, which is the camera's, which points are of the second car, and the objects."""
        rng = np.random.default_rng(n)
        pose, eye = SE3(self.pose(n)), self.pose(n)[:3, 3]
        cars = [thing.seen_points(rng, eye, 400) for thing in self.things(n)]
        road = np.column_stack([rng.uniform([-2, -6], [30, 8], (1500, 2)), np.zeros(1500)])
        world = np.concatenate([*cars, road]) + 0.01 * rng.normal(size=(2300, 3))
        local = ((world - pose.t) @ pose.R).astype(np.float32)
        is_second = np.zeros(len(local), np.bool_)
        is_second[400:800] = True
        parts = [local[:400][::2], local[400:800][::2]]
        if cut and n >= NUM // 2:  # only the rear of the first car is in the image any more
            parts[0] = parts[0][world[:400][::2, 0] < 12.8]
        found = ObjectDetections(
            stamp_ns=self.stamps_ns[n],
            frame="camera",
            width_px=640,
            height_px=480,
            boxes_px=np.zeros((2, 4), np.float32),
            labels=("car", "car"),
            scores=np.ones(2, np.float32),
            points_m=tuple(parts),
            centers_m=np.array([part.mean(axis=0) for part in parts]),
            center_sigmas_m=np.full(2, 0.15, np.float32),
            track_ids=np.array([1, 2]),
            camera=CAMERA,
        )
        return PointCloud(stamp_ns=self.stamps_ns[n], points=local), is_second, found

    def odometry(self) -> list[Odometry]:
        return [
            Odometry(stamp_ns=s, T_odom_base=SE3(self.pose(n)))
            for n, s in enumerate(self.stamps_ns)
        ]


def taken(before: PointCloud, after: PointCloud) -> BoolArray:
    left = {point.tobytes() for point in after.points}
    return np.array([point.tobytes() not in left for point in before.points])


async def test_U9_a_moving_car_is_taken_out_and_a_standing_one_stays() -> None:
    """95 % of what goes is of the moving car, and 90 % of it goes; the car that stands keeps all but the edge."""
    street = Street()
    seen = [street.seen(n, cut=True) for n in range(NUM)]

    out = await run_operator(
        StaticClouds(StaticCloudsConfig()),
        clouds=[cloud for cloud, _, _ in seen],
        detections=[found for _, _, found in seen],
        odometry=street.odometry(),
    )

    assert [cloud.stamp_ns for cloud in out["clouds"]] == list(street.stamps_ns)
    goes = np.concatenate([taken(s[0], after) for s, after in zip(seen, out["clouds"], strict=True)])  # fmt: skip
    truth = np.concatenate([is_second for _, is_second, _ in seen])
    assert (goes & truth).sum() >= 0.95 * goes.sum()
    assert (goes & truth).sum() >= 0.90 * truth.sum()


async def test_a_car_stays_in_the_clouds_once_it_stands() -> None:
    """From the window after its stop on."""
    street = Street(stops_at=8)
    seen = [street.seen(n) for n in range(NUM)]

    out = await run_operator(
        StaticClouds(StaticCloudsConfig()),
        clouds=[cloud for cloud, _, _ in seen],
        detections=[found for _, _, found in seen],
        odometry=street.odometry(),
    )

    goes = [int(taken(s[0], after).sum()) for s, after in zip(seen, out["clouds"], strict=True)]
    assert min(goes[:8]) > 350
    assert max(goes[29:]) == 0


def test_classes_limit_what_may_move_and_others_go_always() -> None:
    """By name."""
    street = Street()
    seen = [street.seen(n) for n in range(20)]
    cloud, is_second, _ = seen[10]
    found, path = [f for _, _, f in seen], street.odometry()[:20]

    people_only = StaticClouds(StaticCloudsConfig(classes=("person",))).static(cloud, found, path)
    no_cars = StaticClouds(StaticCloudsConfig(always=("car",))).static(cloud, found, path)

    assert people_only is cloud
    assert taken(cloud, no_cars).sum() > 1.9 * is_second.sum()


def test_a_cloud_without_odometry_is_left_as_it_is() -> None:
    """And that is counted."""
    cloud, _, found = Street().seen(3)
    clouds = StaticClouds(StaticCloudsConfig())

    assert clouds.static(cloud, [found], []) is cloud
    assert clouds.static(cloud, [found], Street().odometry()[10:]) is cloud


async def test_clouds_beyond_the_odometry_are_told() -> None:
    """Once a cloud."""
    street, told = Street(), Context()
    cloud, _, found = street.seen(3)

    await run_operator(
        StaticClouds(StaticCloudsConfig()),
        run_context=told,
        clouds=[cloud],
        detections=[found],
        odometry=street.odometry()[10:],
    )

    assert told.activity.warnings == {"clouds beyond the odometry are left as they are": 1}


def path_of(centers: FloatArray, extent: tuple[float, float, float] = (0.4, 0.4, 1.7)) -> Path:
    rng = np.random.default_rng(0)
    points = tuple(
        (center + rng.uniform(-0.5, 0.5, (200, 3)) * extent).astype(np.float32)
        for center in centers
    )
    stamps_ns = START_NS + STEP_NS * np.arange(len(centers))
    eyes = np.tile([0.5, -6.0, 1.0], (len(centers), 1))
    return Path(stamps_ns, centers, np.full(len(centers), 0.1), eyes, points)


def walk(num: int = 12, speed: float = 0.1) -> FloatArray:
    return np.outer(np.arange(num), [speed, 0.0, 0.0])


def test_who_walks_moves_and_one_wrong_mask_is_no_motion() -> None:
    """Also when the first sighting is wrong."""
    wrong = np.zeros((12, 3))
    wrong[0], wrong[7] = [2.0, 0, 0], [0, 3.0, 0]

    assert is_moving(path_of(walk()), MovingConfig())
    assert not is_moving(path_of(wrong), MovingConfig())


def test_a_tracker_that_goes_over_to_another_thing_makes_nothing_move() -> None:
    """Six sightings here, six sightings 2 m away."""
    centers = np.repeat([[0.0, 0, 0], [2.0, 0, 0]], 6, axis=0)

    assert not is_moving(path_of(centers), MovingConfig())


def test_what_shows_another_part_of_itself_stands() -> None:
    """The middle of what is seen of a long shelf goes 2 m, but its points come to lie where they lay."""
    shelf = path_of(walk(speed=0.2), (6.0, 0.3, 2.0))
    whole = np.random.default_rng(1).uniform(-0.5, 0.5, (900, 3)) * (9.0, 0.3, 2.0)
    parts = tuple(
        whole[np.abs(whole[:, 0] - center[0]) < 3].astype(np.float32) for center in shelf.centers
    )

    assert not is_moving(replace(shelf, points=parts), MovingConfig())


def test_what_is_seen_from_the_other_side_stands() -> None:
    """The camera goes round a cupboard, whose front and back have no point in common."""
    rng = np.random.default_rng(0)
    angles = np.linspace(0, np.pi, 12)
    eyes = np.column_stack([3 * np.cos(angles), 3 * np.sin(angles), np.ones(12)])
    sides = [np.column_stack([np.full(200, 0.3 * np.cos(a)), rng.uniform(-0.5, 0.5, 200), rng.uniform(0, 2, 200)]) for a in angles]  # fmt: skip
    centers = np.array([side.mean(axis=0) for side in sides])
    points = tuple(side.astype(np.float32) for side in sides)
    stamps_ns = START_NS + STEP_NS * np.arange(12)
    seen = Path(stamps_ns, centers, np.full(12, 0.05), eyes, points)
    still = replace(seen, eyes=eyes[:1].repeat(12, axis=0))

    assert not is_moving(seen, MovingConfig())
    assert is_moving(still, MovingConfig())
