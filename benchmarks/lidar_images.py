"""LiDAR images and their keypoints on scans of W-LID: `python benchmarks/lidar_images.py`.

A LiDAR of 64 beams and 1024 columns that spins at 10 Hz, driven along a corridor; one thread. A sixth of the returns
are taken away in patches, as the sky and black cars do, so that there is something to paint over. Figures are
processor time. The other side is OpenCV alone on the same images: the same detector and descriptor, without
projection, in-painting, fusion or 3D points.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.operators.lidar.images.lidar_image import LidarImage, LidarImageConfig
from mapstream.operators.lidar.images.lidar_keypoints import LidarKeypoints, LidarKeypointsConfig
from mapstream.operators.lidar.images.lidar_tracks import LidarTracks, LidarTracksConfig
from mapstream.recordings.worlds.corridor import Corridor
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.recordings.worlds.ring import Ring
from mapstream.recordings.worlds.sensors import Lidar, LidarConfig
from mapstream.recordings.worlds.w_lid import T_BASE_LIDAR, WLidConfig, drive
from mapstream.streams.messages.sensors import LidarScan
from mapstream.streams.messages.vision import ImageFeatures

_NUM_SCANS = 12
_WARM_UP = 2
_PATCHES = 14
_PATCH_RAD = 0.13  # half of its sides


def _scans() -> list[LidarScan]:
    config = WLidConfig(length_m=40.0)
    ring, rng = Ring(config.length_m), np.random.default_rng(0)
    motion = drive(ring, config)
    caster = RayCaster(Corridor(ring, rng).mesh())
    lidar = Lidar(LidarConfig(beams=64, columns=1024), T_BASE_LIDAR, rng)
    first_ns = motion.start_ns + 4 * 10**9
    return [
        _with_holes(lidar.scan(caster, motion, first_ns + k * lidar.period_ns), rng)
        for k in range(_NUM_SCANS)
    ]


def _with_holes(scan: LidarScan, rng: np.random.Generator) -> LidarScan:
    x, y, z = scan.points.T
    seen = np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=1)
    middles = rng.uniform([-np.pi, -0.4], [np.pi, 0.4], (_PATCHES, 2))
    kept = np.asarray((np.abs(seen[:, None] - middles) > _PATCH_RAD).any(axis=2)).all(axis=1)
    assert scan.intensity is not None
    assert scan.ring is not None
    assert scan.offsets_ns is not None
    return replace(
        scan,
        points=scan.points[kept],
        intensity=scan.intensity[kept],
        ring=scan.ring[kept],
        offsets_ns=scan.offsets_ns[kept],
    )


def _hz(step: Callable[[int], object]) -> float:
    """Return how many steps one core does in a second."""
    times = []
    for i in range(_NUM_SCANS):
        started = time.process_time()
        step(i)
        times.append(time.process_time() - started)
    return float(1 / np.mean(times[_WARM_UP:]))


def _opencv(images: list[Any], kind: str) -> float:
    orb = cv2.ORB.create(2000, 1.2, 1, edgeThreshold=20, patchSize=20, fastThreshold=4)
    describer: Any = orb if kind == "orb" else getattr(cv2.xfeatures2d, kind.upper()).create()
    bordered = [cv2.copyMakeBorder(image, 40, 40, 40, 40, cv2.BORDER_WRAP) for image in images]
    return _hz(lambda i: describer.compute(bordered[i], orb.detect(bordered[i])))


def _of_kind(kind: str, scans: list[LidarScan], images: list[Any]) -> list[Row]:
    """Return how fast keypoints of a kind are found, and followed."""
    keypoints = LidarKeypoints(LidarKeypointsConfig.model_validate({"detector": kind}))
    tracks, found = LidarTracks(LidarTracksConfig()), list[ImageFeatures]()
    finding = _hz(lambda i: found.append(keypoints.detect(scans[i])))
    following = _hz(lambda i: tracks.track(found[i]))
    other = _opencv(images, kind)
    mean = np.mean([len(features) for features in found])
    return [
        Row(
            what=f"image and keypoints with 3D points: {kind}, {mean:.0f} a scan",
            ours=f"{finding:.0f} Hz",
            other=f"OpenCV alone {other:.0f} Hz",
            ratio=finding / other,
            bar="at least 10 Hz",
        ),
        Row(
            what=f"tracks of these without odometry: {kind}",
            ours=f"{following:.0f} Hz",
            other=f"OpenCV alone {other:.0f} Hz",
            ratio=following / other,
        ),
    ]


def run() -> Sequence[Row]:
    cv2.setNumThreads(1)
    scans = _scans()
    painter, images = LidarImage(LidarImageConfig()), list[Any]()
    rate = _hz(lambda i: images.append(painter.image(scans[i]).image))
    share = 1 - np.mean([len(scan.points) for scan in scans]) / (64 * 1024)
    brisk = _opencv(images, "brisk")
    image = Row(
        what=f"image of 64 x 1024, {100 * share:.0f} % painted over",
        ours=f"{rate:.0f} Hz",
        other=f"OpenCV's detector and brisk alone {brisk:.0f} Hz",
        ratio=rate / brisk,
        bar="at least 10 Hz",
    )
    return [
        image,
        *(row for kind in ("orb", "brisk", "freak") for row in _of_kind(kind, scans, images)),
    ]


if __name__ == "__main__":
    print(markdown(run()))
