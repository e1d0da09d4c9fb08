"""Images of a map's vertices with their poses, for other programs: by stamp, or as PMVS wants them.

PMVS (Furukawa and Ponce, Accurate, dense, and robust multi-view stereopsis, PAMI 32(8), 2010) reads
`visualize/NNNNNNNN.jpg` without distortion, `txt/NNNNNNNN.txt` with 3x4 projections, and `option.txt`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from mapstream.operators.dense.depth_views import Lenses
from mapstream.operators.dense.recorded import (
    DepthImage,
    Recorded,
    kind_of,
    record_rows_of,
    recorded_at,
)
from mapstream.operators.dense.sights import Poses
from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.folder import write_whole
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError, RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame

_SWAPPED = {"rgb8": cv2.COLOR_RGB2BGR}
_HEADER = "stamp_ns,camera,file,x,y,z,qx,qy,qz,qw"
_PMVS_OPTIONS = "level 1\ncsize 2\nthreshold 0.7\nwsize 7\nminImageNum 3\nCPU 4\nuseVisData 0\nsequence -1\ntimages -1 0 {count}\noimages 0\n"


class ImageExportConfig(OperatorConfig):
    """Which images, and in which form."""

    form: Literal["timestamped", "pmvs"] = "timestamped"
    """By camera and stamp with a table of poses; or the folders of PMVS."""
    undistort: bool = False
    """Of timestamped images; those for PMVS are always without distortion."""
    with_depth: bool = True
    """Also images of depth, of timestamped ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageExportReport:
    """What was written."""

    num_images: dict[str, int]  # by camera


@dataclass(frozen=True, slots=True, eq=False)
class _Posed:
    frame: CameraFrame
    T_map_camera: SE3


def export_images(
    map_: Map,
    out: Path,
    config: ImageExportConfig,
    on_progress: Callable[[float], None] = lambda _: None,
) -> ImageExportReport:
    """Write the images that the vertices refer to into a folder, with the poses of their cameras in the map.

    Raises:
        MapError: If no vertex refers to images, or the folder is not empty.
        RecordingError: If a recording is not there, or the disk refuses.
        OperatorError: If distortion is to be taken out of images of an unknown camera.
    """
    if out.exists() and any(out.iterdir()):
        raise MapError(f"{out}: the folder is not empty; choose another one")
    kinds: tuple[type, ...] = (CameraFrame,)
    if config.with_depth and config.form == "timestamped":
        kinds = (CameraFrame, DepthImage)
    rows = record_rows_of(map_, kinds, np.arange(len(map_.vertices)))
    if not len(rows):
        raise MapError("no vertex of the map refers to images in a recording")
    lenses, poses = Lenses(), Poses(map_)
    straightens = config.undistort or config.form == "pmvs"
    write = _write_pmvs if config.form == "pmvs" else _write_timestamped
    lines: list[str] = []
    num_images: dict[str, int] = {}
    try:
        for number, found in enumerate(recorded_at(map_, rows)):
            posed = _posed(found, poses, lenses if straightens else None)
            lines.append(write(out, number, posed))
            name = posed.frame.frame
            num_images[name] = num_images.get(name, 0) + 1
            on_progress((number + 1) / len(rows))
        _finish(out, lines, config)
    except OSError as error:
        raise RecordingError(f"{out}: images could not be written: {error}") from error
    return ImageExportReport(num_images=num_images)


def _posed(found: Recorded, poses: Poses, lenses: Lenses | None) -> _Posed:
    frame = found.message
    if not isinstance(frame, CameraFrame):
        raise MapError(f"a record that was an image is a {type(frame).__name__} now")
    if lenses is not None:
        frame = lenses.straight(frame)
    T_map_base = SE3(poses.at(found.vertex, frame.stamp_ns))
    return _Posed(frame, T_map_base @ frame.T_base_sensor)


def _write_timestamped(out: Path, number: int, posed: _Posed) -> str:  # noqa: ARG001  # as for PMVS
    """Write `CAMERA/STAMP.png` and return its line of the table."""
    frame = posed.frame
    file = Path(frame.frame) / f"{frame.stamp_ns}.png"
    _write_image(out / file, frame)
    pose = (*posed.T_map_camera.t.tolist(), *posed.T_map_camera.quat_xyzw.tolist())
    return f"{frame.stamp_ns},{frame.frame},{file.as_posix()}," + ",".join(f"{v:.9f}" for v in pose)


def _write_pmvs(out: Path, number: int, posed: _Posed) -> str:
    """Write an image and its projection."""
    _write_image(out / "visualize" / f"{number:08d}.jpg", posed.frame)
    camera = require_camera(posed.frame)
    projection = camera.camera_matrix @ posed.T_map_camera.inverse().matrix[:3]
    _write_text(out / "txt" / f"{number:08d}.txt", ["CONTOUR", *_rows(projection)])
    return ""


def _finish(out: Path, lines: Sequence[str], config: ImageExportConfig) -> None:
    if config.form == "pmvs":
        (out / "models").mkdir()
        _write_text(out / "option.txt", [_PMVS_OPTIONS.format(count=len(lines)).rstrip()])
    else:
        _write_text(out / "poses.csv", [_HEADER, *lines])


def _rows(matrix: FloatArray) -> list[str]:
    return [" ".join(f"{value:.12g}" for value in row) for row in matrix.tolist()]


def _write_image(path: Path, frame: CameraFrame) -> None:
    image = frame.image
    if kind_of(frame) is DepthImage and image.dtype != np.uint16:
        image = np.rint(np.nan_to_num(image * 1000).clip(0, 65535)).astype(np.uint16)
    if frame.encoding in _SWAPPED:
        image = cv2.cvtColor(image, _SWAPPED[frame.encoding])
    _, data = cv2.imencode(path.suffix, image)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, data.tobytes(), is_durable=False)


def _write_text(path: Path, lines: Sequence[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, ("\n".join(lines) + "\n").encode(), is_durable=False)
