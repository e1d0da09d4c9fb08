"""The front end for cameras on images of W-VI: `python benchmarks/vision.py`.

Two seconds of flight with a stereo pair of 640 x 480 px, 20 Hz, and an IMU of 200 Hz; one thread of OpenCV and one of
ours. Figures are processor time, so that other work on the machine changes them little. The other side is
OpenCV alone on the same images: the same detector and descriptor with brute-force matching, and optical flow there and
back for as many points, without checks, upkeep or messages.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.operators.decode.image import ImageDecode, ImageDecodeConfig
from mapstream.operators.features.detectors import DetectorKind
from mapstream.operators.features.features import Features, FeaturesConfig
from mapstream.operators.tracking.feature_tracker import FeatureTracker, FeatureTrackerConfig
from mapstream.operators.tracking.klt_tracker import KltConfig, KltTracker
from mapstream.operators.tracking.turning import camera_turn
from mapstream.recordings.worlds.figure_eight import FlightConfig
from mapstream.recordings.worlds.w_vi import WViConfig, w_vi
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage, ImuBatch

_FLOW: dict[str, Any] = {"winSize": (21, 21), "criteria": (3, 20, 0.01)}


@dataclass(frozen=True)
class Flight:
    """What the sensors saw."""

    left: list[CameraFrame]
    right: list[CameraFrame]
    turns: list[FloatArray | None]  # of the left camera since the image before


def _flight() -> Flight:
    config = WViConfig(
        cameras=("front_left", "front_right"),
        flight=FlightConfig(duration_s=2.0, start="moving"),
        texel_m=0.01,
    )
    world, decode = w_vi(config, seed=0), ImageDecode(ImageDecodeConfig(mode="gray"))
    frames: dict[str, list[CameraFrame]] = {name: [] for name in config.cameras}
    imu: list[ImuBatch] = []
    for record in world.records:
        if isinstance(record.message, EncodedImage):
            image = decode.decode(record.message)
            camera = config.camera.calibration(record.message.frame)  # type: ignore[arg-type]  # one of the names
            assert isinstance(image, CameraFrame)
            frames[image.frame].append(replace(image, camera=camera))
        elif isinstance(record.message, ImuBatch):
            imu.append(record.message)
    left = frames["front_left"]
    turns: list[FloatArray | None] = [None]
    for before, now in pairwise(left):
        turns.append(camera_turn(imu, before.stamp_ns, now.stamp_ns, now.T_base_sensor))
    return Flight(left, frames["front_right"], turns)


def _hz(step: Callable[[int], object], count: int) -> float:
    """Return how many steps one core does in a second; the first two are for warming up."""
    times = []
    for i in range(count):
        started = time.process_time()
        step(i)
        times.append(time.process_time() - started)
    return float(1 / np.mean(times[2:]))


def _ours(flight: Flight, kind: DetectorKind, **options: float) -> tuple[float, float]:
    """Return the rate of detecting, describing and matching, and the mean number of matches."""
    detector = Features(FeaturesConfig.model_validate({"kind": kind, **options}))
    tracker = FeatureTracker(FeatureTrackerConfig())
    found = []

    def step(i: int) -> None:
        found.append(tracker.track(detector.detect(flight.left[i]), flight.turns[i]))

    rate = _hz(step, len(flight.left))
    shared = [
        len(np.intersect1d(np.array(a.track_ids), np.array(b.track_ids)))
        for a, b in pairwise(found)
    ]
    return rate, float(np.mean(shared))


def _opencv(flight: Flight, kind: DetectorKind) -> float:
    """Return the rate of OpenCV's own detector, descriptor and matcher."""
    orb = cv2.ORB.create(700, 1.2, 1, edgeThreshold=20, patchSize=20)
    describer: Any = orb
    if kind in ("brisk", "freak"):
        describer = getattr(cv2.xfeatures2d, kind.upper()).create()
    sift: Any = cv2.SIFT.create(700)
    matcher = cv2.BFMatcher(cv2.NORM_L2 if kind == "sift" else cv2.NORM_HAMMING, crossCheck=True)
    before: list[Any] = []

    def step(i: int) -> None:
        image = flight.left[i].image
        if kind == "sift":
            _, descriptors = sift.detectAndCompute(image, None)
        else:
            _, descriptors = describer.compute(image, orb.detect(image))
        if before:
            matcher.match(before[-1], descriptors)
        before.append(descriptors)

    return _hz(step, len(flight.left))


def _klt(flight: Flight, *, is_stereo: bool) -> float:
    tracker = KltTracker(KltConfig())

    def step(i: int) -> None:
        tracker.track(flight.left[i], flight.turns[i])
        if is_stereo:
            tracker.track_right(flight.left[i], flight.right[i])

    return _hz(step, len(flight.left))


def _flow_alone(flight: Flight, *, is_stereo: bool) -> float:
    points = [
        np.asarray(cv2.goodFeaturesToTrack(f.image, 250, 0.005, 15), np.float32)
        for f in flight.left
    ]

    def there_and_back(a: Any, b: Any, px: Any) -> None:  # noqa: ANN401  # images
        found, _, _ = cv2.calcOpticalFlowPyrLK(a, b, px, px.copy(), maxLevel=3, **_FLOW)
        cv2.calcOpticalFlowPyrLK(b, a, found, px.copy(), maxLevel=3, **_FLOW)

    def step(i: int) -> None:
        there_and_back(flight.left[max(0, i - 1)].image, flight.left[i].image, points[i - 1])
        if is_stereo:
            there_and_back(flight.left[i].image, flight.right[i].image, points[i])

    return _hz(step, len(flight.left))


def run() -> Sequence[Row]:
    cv2.setNumThreads(1)
    flight = _flight()
    rows = []
    kinds: tuple[tuple[DetectorKind, dict[str, float], str], ...] = (
        ("orb", {}, "at least 20 Hz"),
        ("brisk", {}, "at least 20 Hz"),
        ("freak", {}, "at least 20 Hz"),
        ("sift", {}, ""),
        ("sift", {"image_scale": 0.5}, ""),
    )
    for kind, options, bar in kinds:
        (rate, matches), other = _ours(flight, kind, **options), _opencv(flight, kind)
        name = kind + "".join(f", {option} {value:g}" for option, value in options.items())
        rows.append(
            Row(
                what=f"detect, describe and match with the gyroscope: {name}",
                ours=f"{rate:.0f} Hz, {matches:.0f} matches",
                other=f"OpenCV, brute force {other:.0f} Hz",
                ratio=rate / other,
                bar=bar,
            )
        )
    for is_stereo, bar in ((False, ""), (True, "at least 40 Hz")):
        rate, other = _klt(flight, is_stereo=is_stereo), _flow_alone(flight, is_stereo=is_stereo)
        rows.append(
            Row(
                what=f"klt, 250 tracks, {'stereo' if is_stereo else 'one camera'}",
                ours=f"{rate:.0f} Hz",
                other=f"OpenCV's optical flow {other:.0f} Hz",
                ratio=rate / other,
                bar=bar,
            )
        )
    return rows


if __name__ == "__main__":
    print(markdown(run()))
