"""Depth of stereo pairs that a map refers to: semi-global matching after rectification.

The images are kept in the map's folder, as `depth/CAMERA/VERTEX.png`, 16 bits [mm], in the left camera turned
to its pair (`NAME_rectified` among the mission's cameras).
Source: maplab's `stereo_dense_reconstruction`; Hirschmueller, Stereo processing by semi-global matching and mutual
information, TPAMI 30(2), 2008.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.dense.recorded import record_rows_of, recorded_at
from mapstream.operators.dense.sights import DEPTH
from mapstream.operators.features.gray import gray
from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.rectify import Rectify, RectifyConfig
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.build import add_resources
from mapstream.recordings.maps.cameras import Camera, with_cameras
from mapstream.recordings.maps.folder import write_whole
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import Float32Array
from mapstream.streams.errors import MapError, OperatorError
from mapstream.streams.messages.sensors import CameraFrame

_MOST_MM = 65535
_SUBPIXELS = 16  # in which OpenCV gives disparities
_ROUND = 16  # numbers of disparities are multiples of it


class StereoDepthConfig(OperatorConfig):
    """Which cameras make a pair, and how their images are matched."""

    left: str = ""
    """Frame of the left camera; by default the two cameras of the vertices are taken, if there are two."""
    right: str = ""
    min_depth_m: PositiveFloat = 0.5
    max_depth_m: PositiveFloat = 20.0
    block_px: int = Field(default=5, ge=1, le=15)
    """Edge of what is compared; odd."""
    uniqueness: int = Field(default=10, ge=0, le=100)
    """By so many percent the best match must be better than the next."""
    max_speckle_px: PositiveInt = 100
    """Smaller patches of one depth are noise."""
    left_right_px: NonNegativeFloat = 1.0
    """So far matches from left to right and back may differ."""
    contrast: PositiveInt = 31
    """Limit of the derivative along rows before matching, as OpenCV's preFilterCap."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoDepthReport:
    """What was computed."""

    num_images: int
    num_incomplete: int  # vertices without both images
    mean_share: float  # of the pixels that have a depth


def stereo_depth(
    map_: Map,
    folder: Path,
    config: StereoDepthConfig,
    on_progress: Callable[[float], None] = lambda _: None,
) -> tuple[Map, StereoDepthReport]:
    """Return the map with depth images of its stereo pairs, in place of those of the same cameras.

    Raises:
        MapError: If no vertex refers to a pair, or the disk refuses.
        RecordingError: If a recording is not there.
        OperatorError: If a calibration is missing, or both cameras sit at one place.
    """
    matcher = StereoMatcher(config)
    cameras: dict[int, dict[str, Camera]] = {}  # by mission
    vertices: list[int] = []
    paths: list[str] = []
    shares: list[float] = []
    num_incomplete = 0
    for vertex, frames, done in _moments(map_):
        on_progress(done)
        pair = _pair(frames, config)
        if pair is None:
            num_incomplete += 1
            continue
        depth = matcher.depth(*pair)
        name = Path(DEPTH) / depth.frame / f"{map_.vertices.id[vertex].tobytes().hex()}.png"
        _write(folder / name, depth)
        cameras.setdefault(int(map_.vertices.mission[vertex]), {})[depth.frame] = Camera(
            calibration=require_camera(depth), T_base_sensor=depth.T_base_sensor
        )
        vertices.append(vertex)
        paths.append(str(name))
        shares.append(float((depth.image > 0).mean()))
    if not vertices:
        raise MapError(
            f"{folder}: no vertex refers to images of two cameras ({num_incomplete} to fewer); "
            "stereo maps do, name their frames by left and right"
        )
    for mission, found in cameras.items():
        map_ = with_cameras(map_, mission, found)
    is_old = (map_.resources.kind == DEPTH) & np.isin(map_.resources.path, paths)
    map_ = map_.select(resources=~is_old)
    map_ = add_resources(map_, vertex_rows=np.array(vertices, np.int64), kind=DEPTH, paths=paths)
    report = StereoDepthReport(
        num_images=len(paths), num_incomplete=num_incomplete, mean_share=float(np.mean(shares))
    )
    return map_, report


class StereoMatcher:
    """Computes depth of pairs."""

    def __init__(self, config: StereoDepthConfig) -> None:
        self._config = config
        self._rectify = Rectify(RectifyConfig())

    def depth(self, left: CameraFrame, right: CameraFrame) -> CameraFrame:
        """Return the depth (16UC1, mm; 0: none) of the left camera, turned to its pair.

        Raises:
            OperatorError: If a calibration is missing, or both cameras sit at one place.
        """
        left, right = self._rectify.rectified(left, right)
        camera = require_camera(left)
        baseline_m = float(np.linalg.norm(right.T_base_sensor.t - left.T_base_sensor.t))
        scale = float(camera.focal_px[0]) * baseline_m  # [px m]
        disparity_px = self._disparity_px(gray(left), gray(right), scale)
        with np.errstate(divide="ignore"):
            depth_m = np.where(disparity_px > 0, scale / disparity_px, np.inf)
        config = self._config
        is_in = (depth_m >= config.min_depth_m) & (depth_m <= config.max_depth_m)
        depth_mm = np.rint(1000 * np.where(is_in, depth_m, 0))
        name = f"{left.frame}_rectified"
        return replace(
            left,
            image=np.where(depth_mm <= _MOST_MM, depth_mm, 0).astype(np.uint16),
            encoding="16UC1",
            frame=name,
            camera=replace(camera, frame=name),
        )

    def _disparity_px(
        self, left: npt.NDArray[np.uint8], right: npt.NDArray[np.uint8], scale: float
    ) -> Float32Array:
        """Return disparities (H, W) [px]; negative where there is none."""
        config = self._config
        least = int(scale / config.max_depth_m)
        count = -(-(int(np.ceil(scale / config.min_depth_m)) - least + 1) // _ROUND) * _ROUND
        count = min(count, left.shape[1] // _ROUND * _ROUND)
        area = config.block_px**2
        matcher = cv2.StereoSGBM.create(
            minDisparity=least,
            numDisparities=count,
            blockSize=config.block_px,
            P1=8 * area,
            P2=32 * area,
            disp12MaxDiff=round(config.left_right_px),
            preFilterCap=config.contrast,
            uniquenessRatio=config.uniqueness,
            speckleWindowSize=config.max_speckle_px,
            speckleRange=1,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        # Beyond the left border there is nothing to match; without a margin those columns would stay empty.
        margin = [
            cv2.copyMakeBorder(i, 0, 0, count, 0, cv2.BORDER_REPLICATE) for i in (left, right)
        ]
        found = np.asarray(matcher.compute(*margin), np.float32)[:, count:] / _SUBPIXELS
        return np.where(found >= max(least, 1 / _SUBPIXELS), found, np.float32(-1))


def _moments(map_: Map) -> Iterator[tuple[int, list[CameraFrame], float]]:
    """Yield vertices with all images that they refer to, and which part of them is done."""
    rows = record_rows_of(map_, (CameraFrame,), np.arange(len(map_.vertices)))
    missing = np.bincount(map_.resources.vertex[rows], minlength=len(map_.vertices))
    frames: dict[int, list[CameraFrame]] = {}
    for number, found in enumerate(recorded_at(map_, rows), start=1):
        if isinstance(found.message, CameraFrame):
            frames.setdefault(found.vertex, []).append(found.message)
        missing[found.vertex] -= 1
        if not missing[found.vertex]:
            yield found.vertex, frames.pop(found.vertex, []), number / len(rows)


def _pair(
    frames: list[CameraFrame], config: StereoDepthConfig
) -> tuple[CameraFrame, CameraFrame] | None:
    """Return the left and the right image of a moment; None if there is no pair.

    Raises:
        OperatorError: If more than two cameras saw it, and the config does not choose.
    """
    by_name = {frame.frame: frame for frame in frames}
    if config.left or config.right:
        left, right = by_name.get(config.left), by_name.get(config.right)
        return (left, right) if left is not None and right is not None else None
    if len(by_name) < 2:
        return None
    if len(by_name) > 2:
        raise OperatorError(
            f"images of {', '.join(sorted(by_name))}: name the pair, left=FRAME and right=FRAME"
        )
    first, second = (by_name[name] for name in sorted(by_name))
    across = first.T_base_sensor.inverse() @ second.T_base_sensor.t
    return (first, second) if across[0] > 0 else (second, first)


def _write(path: Path, depth: CameraFrame) -> None:
    done, data = cv2.imencode(".png", depth.image)
    if not done:
        raise MapError(f"{path}: the depth image could not be encoded")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, data.tobytes(), is_durable=False)
    except OSError as error:
        raise MapError(f"{path}: the depth image could not be written: {error}") from error
