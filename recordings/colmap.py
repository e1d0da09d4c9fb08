"""COLMAP's text models: cameras, images with their poses and keypoints, points with their tracks.

Format: https://colmap.github.io/format.html. The middle of the first pixel is (0.5, 0.5) there and (0, 0) here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration, Distortion
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3

FILES = ("cameras.txt", "images.txt", "points3D.txt")
_HALF_PIXEL = 0.5
_MODELS: dict[str, tuple[Distortion, int]] = {  # number of distortion parameters
    "PINHOLE": ("none", 0),
    "OPENCV": ("radtan", 4),
    "OPENCV_FISHEYE": ("equidistant", 4),
    "FOV": ("fov", 1),
    "FULL_OPENCV": ("rational_polynomial", 8),
}
_ONE_FOCAL_LENGTH = {"SIMPLE_PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2}  # radial parameters


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ColmapImage:
    """One image: where it was taken, and its keypoints."""

    name: str
    camera: int
    T_camera_world: SE3
    keypoints_px: FloatArray  # (N, 2) in our convention
    points: IntArray  # (N,) number of each keypoint's point, -1 without one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ColmapModel:
    """Cameras and images by number, and points."""

    cameras: dict[int, CameraCalibration] = field(default_factory=dict)
    images: dict[int, ColmapImage] = field(default_factory=dict)
    points: dict[int, FloatArray] = field(default_factory=dict)  # (3,) in the world [m]


def has_model(calibration: CameraCalibration) -> bool:
    """Return whether COLMAP has a model of this camera; it has none of mirrors."""
    return calibration.model == "pinhole"


def write_model(model: ColmapModel, folder: Path) -> tuple[Path, ...]:
    """Write `cameras.txt`, `images.txt` and `points3D.txt`.

    Raises:
        RecordingError: If a file cannot be written.
    """
    tracks: dict[int, list[str]] = {number: [] for number in model.points}
    for number, image in model.images.items():
        for at in np.flatnonzero(image.points >= 0).tolist():
            tracks[int(image.points[at])] += [str(number), str(at)]
    lines: tuple[Callable[[], Iterator[str]], ...] = (
        lambda: map(_camera_line, model.cameras, model.cameras.values()),
        lambda: (line for n, image in model.images.items() for line in _image_lines(n, image)),
        lambda: (
            f"{n} {_numbers(p)} 128 128 128 0 {' '.join(tracks[n])}"
            for n, p in model.points.items()
        ),
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, make in zip(FILES, lines, strict=True):
            (folder / name).write_text("".join(f"{line}\n" for line in make()))
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be written: {error}") from error
    return tuple(folder / name for name in FILES)


def read_model(folder: Path) -> ColmapModel:
    """Read a text model.

    Raises:
        RecordingError: If a file is missing or a line is not understood; the message has the line.
    """
    cameras = dict(_each_line(folder / FILES[0], 1, _camera))
    images = dict(_each_line(folder / FILES[1], 2, _image))
    points = dict(_each_line(folder / FILES[2], 1, _point))
    for image in images.values():
        if image.camera not in cameras:
            raise RecordingError(f"{folder}: image {image.name} is of camera {image.camera}")
        if missing := set(image.points[image.points >= 0].tolist()) - points.keys():
            raise RecordingError(f"{folder}: image {image.name} sees point {min(missing)}")
    return ColmapModel(cameras=cameras, images=images, points=points)


def _camera_line(number: int, c: CameraCalibration) -> str:
    model = next(name for name, (kind, _) in _MODELS.items() if kind == c.distortion)
    parameters = c.distortion_parameters
    if c.distortion == "radtan" and len(parameters) == 5:
        model, parameters = "FULL_OPENCV", np.append(parameters, np.zeros(3))
    intrinsics = [*c.focal_px, *(c.center_px + _HALF_PIXEL), *parameters]
    return f"{number} {model} {c.width_px} {c.height_px} {_numbers(intrinsics)}"


def _camera(words: Sequence[str], _: Sequence[str]) -> tuple[int, CameraCalibration]:
    number, model, width, height, *rest = words
    values = np.array(rest, dtype=np.float64)
    if model in _ONE_FOCAL_LENGTH:
        radial = np.pad(values[3:], (0, 4 - _ONE_FOCAL_LENGTH[model]))
        values = np.concatenate([values[[0, 0, 1, 2]], radial])
        model = "OPENCV"
    distortion, num_parameters = _MODELS[model]
    if len(values) != 4 + num_parameters:
        raise ValueError(f"{model} has {4 + num_parameters} parameters, not {len(values)}")
    return int(number), CameraCalibration(
        width_px=int(width),
        height_px=int(height),
        focal_px=values[:2],
        center_px=values[2:4] - _HALF_PIXEL,
        distortion=distortion,
        distortion_parameters=values[4:],
    )


def _image_lines(number: int, image: ColmapImage) -> Iterator[str]:
    T = image.T_camera_world
    x, y, z, w = T.quat_xyzw.tolist()
    yield f"{number} {_numbers([w, x, y, z, *T.t])} {image.camera} {image.name}"
    seen = zip(image.keypoints_px + _HALF_PIXEL, image.points.tolist(), strict=True)
    yield " ".join(f"{_numbers(px)} {point}" for px, point in seen)


def _image(words: Sequence[str], seen: Sequence[str]) -> tuple[int, ColmapImage]:
    w, x, y, z, *t = map(float, words[1:8])
    table = np.array(seen, dtype=np.float64).reshape(-1, 3)
    return int(words[0]), ColmapImage(
        name=" ".join(words[9:]),
        camera=int(words[8]),
        T_camera_world=SE3.from_quat_xyzw((x, y, z, w), t),
        keypoints_px=table[:, :2] - _HALF_PIXEL,
        points=table[:, 2].astype(np.int64),
    )


def _point(words: Sequence[str], _: Sequence[str]) -> tuple[int, FloatArray]:
    return int(words[0]), np.array(words[1:4], dtype=np.float64)


def _each_line(path: Path, num_lines: int, parse: Callable[..., tuple[int, object]]) -> Iterator:  # type: ignore[type-arg]  # of what parse gives
    """Yield what entries of one line, or of two, say."""
    try:
        with path.open(encoding="utf-8") as file:
            yield from _parsed(path, file, num_lines, parse)
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error


def _parsed(
    path: Path, file: TextIO, num_lines: int, parse: Callable[..., tuple[int, object]]
) -> Iterator[tuple[int, object]]:
    lines = enumerate(file, 1)
    for number, line in lines:
        if line.startswith("#") or not line.strip():
            continue
        second = next(lines, (0, ""))[1] if num_lines == 2 else ""
        try:
            yield parse(line.split(), second.split())
        except (ValueError, KeyError, IndexError) as error:
            raise RecordingError(
                f"{path}:{number}: not understood: {error!r}: {line[:80]!r}"
            ) from error


def _numbers(values: Sequence[float] | FloatArray) -> str:
    return " ".join(f"{value:.17g}" for value in values)
