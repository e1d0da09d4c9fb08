"""A map without a viewer: a picture from above as PNG, and a page to turn it in any browser as HTML.

Both need no display, no network and no graphics driver, so a report or a continuous integration can have them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, PositiveInt

from mapstream.graph.views.ceiling import is_below_ceiling
from mapstream.graph.views.colors import mission_color, photographed, ramp_colors
from mapstream.operators.maps.aggregate import AggregateConfig, aggregate_cloud
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.folder import write_whole
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.errors import ConfigError, MapError

Colors = npt.NDArray[np.uint8]
_BACKGROUND, _INK = (24, 20, 18), (235, 235, 235)  # blue, green, red
_MARGIN = 0.04  # of the longer side, around the map
_LOOP = (80, 200, 80)
_FLAT_M, _FLAT_COLOR = 0.05, 0xC8D2DCFF
_NICE = (1.0, 2.0, 5.0)  # lengths that a scale may have, times a power of ten


class PictureConfig(AggregateConfig):
    """Options of a picture."""

    width_px: PositiveInt = Field(default=1600, le=16_000)
    """Of a PNG: its longer side."""
    max_points: PositiveInt = 1_000_000
    """Of an HTML page: the cloud is thinned evenly to so many."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Drawn:
    """What of a map is drawn, in its frame."""

    points: Float32Array  # (N, 3)
    colors_rgb: Colors  # (N, 3)
    paths: tuple[FloatArray, ...]  # (K, 3) of each mission
    loops: FloatArray  # (L, 2, 3)


def write_picture(map_: Map, folder: Path, path: Path, config: PictureConfig) -> list[str]:
    """Write a map as `.png` or `.html`, and return what is missing from it.

    Raises:
        ConfigError: If the suffix is another one.
        MapError: If the map has neither poses nor clouds, or the file cannot be written.
    """
    writers = {".png": _png, ".html": _html}
    write = writers.get(path.suffix.lower())
    if write is None:
        raise ConfigError(f"{path}: a picture is a .png or an .html, not {path.suffix!r}")
    drawn, notes = _drawn(map_, folder, config)
    if not drawn.paths and not len(drawn.points):
        raise MapError(f"{folder}: the map has nothing to draw")
    try:
        write_whole(path, write(drawn, config))
    except OSError as error:
        raise MapError(f"{path}: cannot be written: {error}") from error
    return notes


def _drawn(map_: Map, folder: Path, config: PictureConfig) -> tuple[_Drawn, list[str]]:
    place = map_.T_map_base(np.arange(len(map_.vertices)))[:, :3, 3]
    rows = [map_.vertices_of(mission) for mission in range(len(map_.missions))]
    edges = map_.edges
    loops = np.flatnonzero((edges.kind == "loop") & (edges.vertex_b >= 0) & (edges.switch > 0.5))
    points, colors, notes = np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8), []
    try:
        cloud = aggregate_cloud(map_, folder, config)
        shown = is_below_ceiling(cloud.points, place)
        points = cloud.points[shown]
        low, high = np.percentile(points[:, 2], [2, 98])
        packed = ramp_colors(points[:, 2], low, high)
        if high - low < _FLAT_M:  # a planar laser's
            packed = np.full(len(points), _FLAT_COLOR, np.uint32)
        if cloud.colors_rgba is not None:
            packed = photographed(packed, cloud.colors_rgba[shown])
        shifts = np.array([24, 16, 8], np.uint32)
        colors = (packed[:, None] >> shifts & 0xFF).astype(np.uint8)
    except MapError as error:
        notes.append(f"drawn without clouds: {error}")
    drawn = _Drawn(
        points=points,
        colors_rgb=colors,
        paths=tuple(place[each] for each in rows if len(each)),
        loops=np.stack([place[edges.vertex_a[loops]], place[edges.vertex_b[loops]]], axis=1),
    )
    return drawn, notes


def _png(drawn: _Drawn, config: PictureConfig) -> bytes:
    """Return the view from above: x to the right, y up; the higher of two points hides the lower."""
    spots = np.concatenate([drawn.points[:, :2], *(path[:, :2] for path in drawn.paths)])
    low, high = spots.min(axis=0), spots.max(axis=0)
    extent_m = float(max((high - low).max(), 1e-3)) * (1 + 2 * _MARGIN)
    px_per_m = config.width_px / extent_m
    corner = low - _MARGIN * extent_m
    width, height = np.ceil((high + _MARGIN * extent_m - corner) * px_per_m).astype(int)
    image = np.full((height, width, 3), _BACKGROUND, np.uint8)

    def pixels(places: npt.NDArray[np.floating]) -> npt.NDArray[np.int32]:
        at = (places[..., :2] - corner) * px_per_m
        at[..., 1] = height - at[..., 1]
        rounded: npt.NDArray[np.int32] = np.round(at).astype(np.int32)
        return rounded

    order = np.argsort(drawn.points[:, 2], kind="stable")
    at = np.clip(pixels(drawn.points[order]), 0, [width - 1, height - 1])
    image[at[:, 1], at[:, 0]] = drawn.colors_rgb[order][:, ::-1]
    for ends in pixels(drawn.loops):
        cv2.line(image, ends[0].tolist(), ends[1].tolist(), _LOOP, 1, cv2.LINE_AA)
    for number, path in enumerate(drawn.paths):
        red, green, blue = (mission_color(number) >> shift & 0xFF for shift in (24, 16, 8))
        track = pixels(path)
        cv2.polylines(
            image,
            [track],
            isClosed=False,
            color=(blue, green, red),
            thickness=2,
            lineType=cv2.LINE_AA,
        )
        cv2.circle(image, track[0].tolist(), 5, _INK, -1, cv2.LINE_AA)
    _draw_scale(image, px_per_m)
    return cv2.imencode(".png", image)[1].tobytes()


def _draw_scale(image: Colors, px_per_m: float) -> None:
    """Draw a bar of a round length, a tenth to a quarter of the picture, into its lower left corner."""
    height, width = image.shape[:2]
    wanted_m = 0.25 * width / px_per_m
    power = 10.0 ** np.floor(np.log10(wanted_m))
    length_m = max(nice * power for nice in _NICE if nice * power <= wanted_m)
    left, bottom = width // 50, height - max(height // 50, 8)
    cv2.line(image, (left, bottom), (left + round(length_m * px_per_m), bottom), _INK, 3)
    cv2.putText(
        image,
        f"{length_m:g} m",
        (left, bottom - 8),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.6,
        _INK,
        1,
        cv2.LINE_AA,
    )


def _html(drawn: _Drawn, config: PictureConfig) -> bytes:
    """Return one page that holds everything it shows."""
    import trimesh  # noqa: PLC0415  # only where a page is written
    from trimesh.viewer.notebook import scene_to_html  # noqa: PLC0415

    scene = trimesh.Scene()
    step = max(1, -(-len(drawn.points) // config.max_points))
    if len(drawn.points):
        cloud: Any = trimesh.PointCloud
        scene.add_geometry(cloud(drawn.points[::step], drawn.colors_rgb[::step]))
    for path in (path for path in drawn.paths if len(path) > 1):
        scene.add_geometry(trimesh.load_path(path))
    if len(drawn.loops):
        scene.add_geometry(trimesh.load_path(drawn.loops))
    return str(scene_to_html(scene)).encode()
