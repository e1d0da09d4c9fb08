"""Occupancy grids as files of ROS' map_server: a grey image, and a YAML file that says where it lies.

Written: a PGM of three values (mode trinary). Read: any image that OpenCV reads, in the modes trinary, scale and raw.
Source: https://github.com/ros-navigation/navigation2, nav2_map_server/src/map_io.cpp.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from mapstream.recordings.maps.folder import write_whole
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.grids import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_WHITE, _GREY, _BLACK = 254, 205, 0  # free, unknown, occupied
_OCCUPIED_FROM: Final = 0.65
_FREE_TO: Final = 0.196  # grey is less free than that
_MAX_TILT = 1e-3  # of what is written as lying flat [rad]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]


class _Described(BaseModel):
    """What the YAML file says."""

    model_config = ConfigDict(frozen=True)  # other programs add keys

    image: str
    resolution: PositiveFloat
    origin: tuple[float, float, float]  # x, y [m] and yaw [rad] of the lower left corner
    negate: bool = False
    occupied_thresh: _Share = _OCCUPIED_FROM
    free_thresh: _Share = _FREE_TO
    mode: Literal["trinary", "scale", "raw"] = "trinary"


def write_grid(path: Path, grid: OccupancyGrid) -> tuple[Path, Path]:
    """Write a grid as `NAME.yaml` and `NAME.pgm` beside it, each whole or not at all; return both.

    Args:
        path: The YAML file.
        grid: It must lie flat; its height is not written.

    Raises:
        RecordingError: If the grid is tilted, the file has another suffix, or the disk refuses.
    """
    if path.suffix not in (".yaml", ".yml"):
        raise RecordingError(f"{path}: a grid is written as .yaml, with its image beside it")
    R, t = grid.T_map_grid.R, grid.T_map_grid.t
    if np.arccos(np.clip(R[2, 2], -1, 1)) > _MAX_TILT:
        raise RecordingError(f"{path}: the grid is tilted; only x, y and yaw can be written")
    image = path.with_suffix(".pgm")
    is_free = (grid.cells >= FREE) & (grid.cells <= 100 * _FREE_TO)
    is_occupied = grid.cells >= 100 * _OCCUPIED_FROM
    grey = np.select([is_free, is_occupied], [_WHITE, _BLACK], _GREY).astype(np.uint8)
    rows, columns = grey.shape
    header = f"P5\n{columns} {rows}\n255\n".encode()
    described = {
        "image": image.name,
        "mode": "trinary",
        "resolution": grid.resolution_m,
        "origin": [float(t[0]), float(t[1]), float(np.arctan2(R[1, 0], R[0, 0]))],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_FROM,
        "free_thresh": _FREE_TO,
    }
    try:
        write_whole(image, header + np.ascontiguousarray(grey[::-1]).tobytes())
        write_whole(path, _as_yaml(described))
    except OSError as error:
        raise RecordingError(f"{path}: the grid could not be written: {error}") from error
    return path, image


def read_grid(path: Path, stamp_ns: int = 0) -> OccupancyGrid:
    """Read a grid from its YAML file; it lies at height 0, flat.

    Args:
        path: The YAML file.
        stamp_ns: The files know no time.

    Raises:
        RecordingError: If one of the two files is not there or is not what it should be.
    """
    described = _described(path)
    image = path.parent / described.image
    grey = _grey(image)[::-1]
    x, y, yaw = described.origin
    return OccupancyGrid(
        stamp_ns=stamp_ns,
        cells=_cells(grey, described),
        resolution_m=described.resolution,
        T_map_grid=SE3.from_rotation(so3_exp([0.0, 0.0, yaw]), [x, y, 0.0]),
    )


def is_grid_file(path: Path) -> bool:
    """Return whether a path names a grid rather than a map's folder."""
    return path.suffix in (".yaml", ".yml")


def _as_yaml(described: dict[str, Any]) -> bytes:
    """Return a line per key; lists in brackets, as map_server writes them."""
    text = io.BytesIO()
    yaml = YAML(typ="safe")
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # ruamel's stub says None
    yaml.dump(described, text)
    return text.getvalue()


def _described(path: Path) -> _Described:
    try:
        return _Described.model_validate(YAML(typ="safe").load(path.read_text()))
    except OSError as error:
        raise RecordingError(f"{path}: no grid can be read there: {error}") from error
    except (YAMLError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: not YAML: {error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise RecordingError(f"{path}: not a grid of map_server: {key}: {first['msg']}") from error


def _grey(path: Path) -> npt.NDArray[Any]:
    """Return the pixels (H, W) or (H, W, 2), grey and opacity, of 8 bits."""
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise RecordingError(f"{path}: the image of the grid cannot be read: {error}") from error
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if image is None or image.dtype != np.uint8:
        raise RecordingError(f"{path}: not an image of 8 bits per channel")
    if image.ndim == 2:
        return image
    grey = image[..., :3].mean(axis=-1)
    if image.shape[-1] == 4:
        return np.stack([grey, image[..., 3]], axis=-1)
    return np.asarray(grey)


def _cells(grey: npt.NDArray[Any], described: _Described) -> npt.NDArray[np.int8]:
    """Return percents, -1 unknown, of grey values; what is seen through is unknown."""
    is_clear = grey[..., 1] < 255 if grey.ndim == 3 else np.zeros(grey.shape, bool)
    grey = grey[..., 0] if grey.ndim == 3 else grey
    if described.mode == "raw":
        return np.where(grey <= OCCUPIED, grey.astype(np.int16), UNKNOWN).astype(np.int8)
    share = grey / 255 if described.negate else (255 - grey) / 255.0
    is_occupied, is_free = share > described.occupied_thresh, share < described.free_thresh
    between = np.full(share.shape, float(UNKNOWN))
    if described.mode == "scale":
        span = described.occupied_thresh - described.free_thresh
        between = 1 + 98 * (share - described.free_thresh) / max(span, 1e-9)
    cells = np.select([is_occupied, is_free], [OCCUPIED, FREE], np.rint(between))
    if described.mode == "scale":
        cells = np.where(is_clear, UNKNOWN, cells)
    return cells.astype(np.int8)
