"""Dense maps on real depth images: `python benchmarks/dense.py`.

30 frames of RedKitchen (7-Scenes), 640 x 480 px, voxels of 2 cm, depth up to 4 m, truncated at 8 cm, at the given
poses. The other side is Open3D's VoxelBlockGrid on the same frames where `open3d` is installed (it is no dependency),
else OpenCV's HashTSDF, which has no colours. Figures are processor time, so that other work on the machine changes
them little. The first three frames are for warming up.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.operators.dense.depth_integration import integrate_depth
from mapstream.operators.dense.depth_views import ColorView, DepthView, Pinhole
from mapstream.operators.dense.surface import surface_of
from mapstream.operators.dense.volume import TsdfVolume
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert

_DATA = Path(os.environ.get("MAPSTREAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
_FRAMES = range(0, 150, 5)
_K = np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]])
_VOXEL_M, _TRUNCATION_M, _MOST_M = 0.02, 0.08, 4.0
_INVALID = 65535
_MB = 1e6


@dataclass(frozen=True)
class Frame:
    depth_mm: npt.NDArray[np.uint16]
    rgb: npt.NDArray[np.uint8]
    T_map_camera: FloatArray


@dataclass(frozen=True)
class Figures:
    frame_s: float  # processor time, median
    size_bytes: float
    mesh_s: float


def _frames(folder: Path) -> list[Frame]:
    found = []
    for number in _FRAMES:
        name = folder / f"frame-{number:06d}"
        depth = np.asarray(cv2.imread(f"{name}.depth.png", cv2.IMREAD_UNCHANGED), np.uint16)
        color = np.asarray(cv2.imread(f"{name}.color.jpg"), np.uint8)
        found.append(
            Frame(
                np.where(depth == _INVALID, 0, depth).astype(np.uint16),
                np.ascontiguousarray(color[:, :, ::-1]),
                np.loadtxt(f"{name}.pose.txt"),
            )
        )
    return found


def _seconds(step: Callable[[Frame], object], frames: Sequence[Frame]) -> float:
    times = []
    for frame in frames:
        started = time.process_time()
        step(frame)
        times.append(time.process_time() - started)
    return float(np.median(times[3:]))


def _timed(step: Callable[[], object]) -> float:
    started = time.process_time()
    step()
    return time.process_time() - started


def _ours(frames: Sequence[Frame], *, has_colors: bool) -> Figures:
    volume = TsdfVolume(_VOXEL_M, _TRUNCATION_M, 2 * 10**9, has_colors=has_colors)

    def step(frame: Frame) -> None:
        pinhole = Pinhole(camera_matrix=_K, T_map_camera=frame.T_map_camera)
        depth_m = frame.depth_mm.astype(np.float32) / np.float32(1000)
        depth_m[(depth_m == 0) | (depth_m > _MOST_M)] = np.nan
        view = DepthView(depth_m=depth_m, pinhole=pinhole)
        color = ColorView(rgb=frame.rgb, pinhole=pinhole)
        integrate_depth(volume, replace(view, color=color) if has_colors else view)

    frame_s = _seconds(step, frames)
    return Figures(frame_s, volume.num_bytes, _timed(lambda: surface_of(volume)))


def _open3d(frames: Sequence[Frame], *, has_colors: bool) -> Figures:
    import open3d as o3d  # type: ignore[import-not-found,unused-ignore]  # noqa: PLC0415

    names, channels = ["tsdf", "weight"], [1, 1]
    if has_colors:
        names, channels = [*names, "color"], [1, 1, 3]
    types = [o3d.core.float32] * len(names)
    device = o3d.core.Device("CPU:0")
    grid = o3d.t.geometry.VoxelBlockGrid(names, types, channels, _VOXEL_M, 16, 4000, device)
    K, ratio = o3d.core.Tensor(_K), _TRUNCATION_M / _VOXEL_M

    def step(frame: Frame) -> None:
        depth = o3d.t.geometry.Image(o3d.core.Tensor(frame.depth_mm))
        color = o3d.t.geometry.Image(o3d.core.Tensor(frame.rgb))
        place = o3d.core.Tensor(invert(frame.T_map_camera))
        limits = (1000.0, _MOST_M, ratio)
        blocks = grid.compute_unique_block_coordinates(depth, K, place, *limits)
        if has_colors:
            grid.integrate(blocks, depth, color, K, K, place, *limits)
        else:
            grid.integrate(blocks, depth, K, place, *limits)

    frame_s = _seconds(step, frames)
    size_bytes = grid.hashmap().size() * 16**3 * 4 * sum(channels)
    return Figures(frame_s, size_bytes, _timed(grid.extract_triangle_mesh))


def _opencv(frames: Sequence[Frame]) -> float:
    library: Any = cv2
    settings = library.VolumeSettings(library.VolumeType_HashTSDF)
    settings.setCameraIntegrateIntrinsics(_K.astype(np.float32))
    settings.setDepthFactor(1.0)
    settings.setVoxelSize(_VOXEL_M)
    settings.setTsdfTruncateDistance(_TRUNCATION_M)
    settings.setMaxDepth(_MOST_M)
    volume = library.Volume(library.VolumeType_HashTSDF, settings)
    return _seconds(
        lambda f: volume.integrate((f.depth_mm / 1000).astype(np.float32), f.T_map_camera), frames
    )


def _compared(what: str, ours: Figures, theirs: Figures) -> list[Row]:
    return [
        Row(
            what=f"TSDF integration, {what}",
            ours=f"{1 / ours.frame_s:.0f} Hz, {ours.size_bytes / _MB:.0f} MB",
            other=f"Open3D {1 / theirs.frame_s:.0f} Hz, {theirs.size_bytes / _MB:.0f} MB",
            ratio=theirs.frame_s / ours.frame_s,
            bar="at least 5 Hz",
        ),
        Row(
            what=f"mesh of the volume, {what}",
            ours=f"{ours.mesh_s:.2f} s",
            other=f"Open3D {theirs.mesh_s:.2f} s",
            ratio=theirs.mesh_s / ours.mesh_s,
        ),
    ]


def run() -> Sequence[Row]:
    folder = _DATA / "redkitchen_rgbd"
    if not folder.is_dir():
        print("dense: no redkitchen_rgbd among the shared data (set MAPSTREAM_DATA)")
        return []
    cv2.setNumThreads(1)
    frames = _frames(folder)
    plain = _ours(frames, has_colors=False)
    if find_spec("open3d") is None:
        print("dense: open3d is not installed, so OpenCV's HashTSDF stands in for it")
        other_s = _opencv(frames)
        return [
            Row(
                what="TSDF integration, depth",
                ours=f"{1 / plain.frame_s:.0f} Hz, {plain.size_bytes / _MB:.0f} MB",
                other=f"OpenCV {1 / other_s:.0f} Hz",
                ratio=other_s / plain.frame_s,
                bar="at least 5 Hz",
            )
        ]
    colored = _ours(frames, has_colors=True)
    return [
        *_compared("depth", plain, _open3d(frames, has_colors=False)),
        *_compared("depth and colours", colored, _open3d(frames, has_colors=True)),
    ]


if __name__ == "__main__":
    print(markdown(run()))
