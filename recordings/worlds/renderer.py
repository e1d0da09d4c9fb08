"""Pinhole images of painted plane surfaces, exact to a fraction of a pixel.

For a surface in a plane, [s, t, 1] / z is linear in a pixel [x, y, 1]. So one 3x3 matrix says where in the
picture a pixel looks, whether that is inside the polygon (each edge is a linear function too), and 1 / z,
for the depth test. Source: Blinn, Hyperbolic Interpolation, IEEE CG&A 1992.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import cv2
import numpy as np

from mapstream.recordings.worlds.paint import Picture
from mapstream.recordings.worlds.surfaces import Surface, pyramid
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray

A = TypeVar("A", Picture, Float32Array, IntArray)

_NEAR_M = 0.05
_TILE_M = 2.5  # a larger surface is drawn in parts, each with the level of detail of its distance


@dataclass(frozen=True, slots=True, eq=False)
class Pinhole:
    """A rectangle of pixels on the image plane of a camera without distortion."""

    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    size_px: tuple[int, int]  # width, height

    @property
    def matrix(self) -> FloatArray:
        (fx, fy), (cx, cy) = self.focal_px, self.center_px
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """What a pinhole sees."""

    image: Picture
    inverse_depths: Float32Array  # (H, W) [1/m] along z; 0 where nothing is
    surfaces: IntArray  # (H, W) row of the world's surfaces; -1 where nothing is


def occluding_edges(view: Rendering, gap_m: float) -> BoolArray:
    """Return the pixels (H, W) beside which something else lies farther away, by more than a gap."""
    with np.errstate(divide="ignore"):
        depths = np.where(view.inverse_depths > 0, 1 / view.inverse_depths, np.inf)
    edges = np.zeros(depths.shape, np.bool_)
    for near, far in (  # a pixel and its neighbour to each side
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[:-1], np.s_[1:]),
        (np.s_[1:], np.s_[:-1]),
    ):
        differs = view.surfaces[near] != view.surfaces[far]
        edges[near] |= differs & (depths[far] - depths[near] > gap_m)
    return edges


class Renderer:
    """Draws one world; safe to use from several threads."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self.surfaces = tuple(surfaces)
        self._levels = [pyramid(surface.picture) for surface in self.surfaces]
        tiles = [tile for row, surface in enumerate(self.surfaces) for tile in _tiles(row, surface)]
        self._tiles = sorted(tiles, key=lambda tile: not self._is_shell(tile))  # the shell first
        owners = [self.surfaces[tile.surface] for tile in self._tiles]
        self._corners = np.stack([tile.corners for tile in self._tiles])  # (N, 4, 3) [m]
        self._origins = np.stack([owner.origin for owner in owners])
        self._axes = np.stack([[owner.right, owner.down] for owner in owners])  # (N, 2, 3)
        self._normals = np.stack([owner.normal for owner in owners])
        self._texels_m = np.array([tile.texel_m for tile in self._tiles])

    def image(self, camera: Pinhole, T_world_camera: FloatArray) -> Picture:
        """Return what is seen from a pose (4, 4); black where nothing is."""
        image = self._blank(camera)
        depths = np.zeros(image.shape[:2], np.float32)
        for patch in self._patches(camera, T_world_camera):
            mask = patch.mask()
            if not self._is_shell(patch.tile):  # nothing was drawn before the shell
                patch.test_depth(mask, depths)
            patch.draw(mask, self._levels[patch.tile.surface], image)
        return image

    def rendering(self, camera: Pinhole, T_world_camera: FloatArray) -> Rendering:
        """Return what is seen from a pose (4, 4), how far away it is, and what it is."""
        image = self._blank(camera)
        depths = np.zeros(image.shape[:2], np.float32)
        surfaces = np.full(image.shape[:2], -1, np.int64)
        for patch in self._patches(camera, T_world_camera):
            mask = patch.mask()
            patch.test_depth(mask, depths)
            patch.draw(mask, self._levels[patch.tile.surface], image)
            patch.part(surfaces)[mask] = patch.tile.surface
        return Rendering(image, depths, surfaces)

    def _is_shell(self, tile: _Tile) -> bool:
        return self.surfaces[tile.surface].is_shell

    def _blank(self, camera: Pinhole) -> Picture:
        width, height = camera.size_px
        return np.zeros((height, width, *self.surfaces[0].picture.shape[2:]), np.uint8)

    def _patches(self, camera: Pinhole, T_world_camera: FloatArray) -> Iterator[_Patch]:
        """Yield the tiles in view, with all that is linear in the image."""
        R, center = T_world_camera[:3, :3], T_world_camera[:3, 3]
        faces = ((center - self._origins) * self._normals).sum(axis=1) > 1e-3
        rows = np.flatnonzero(faces)
        low, high = _bounds((self._corners[rows] - center) @ R, camera)
        in_view = (low < high).all(axis=1)
        rows, low, high = rows[in_view], low[in_view], high[in_view]
        in_camera = np.concatenate(
            [self._axes[rows] @ R, ((self._origins[rows] - center) @ R)[:, None]], axis=1
        )
        plane_by_px = np.linalg.inv(camera.matrix @ np.swapaxes(in_camera, 1, 2))  # [s, t, 1] / z
        levels = self._detail(rows, plane_by_px, (low + high) / 2)
        for at, row in enumerate(rows):
            yield _Patch(self._tiles[row], plane_by_px[at], low[at], high[at], levels[at])

    def _detail(self, rows: IntArray, plane_by_px: FloatArray, px: FloatArray) -> IntArray:
        """Return the levels of detail (N,) whose texels are about as large as pixels (N, 2)."""
        inverse_depth = (plane_by_px[:, 2, :2] * px).sum(axis=1) + plane_by_px[:, 2, 2]
        safe = np.maximum(inverse_depth, 1e-2)
        m2_per_px = np.abs(np.linalg.det(plane_by_px)) / safe**3
        texels_per_px = np.sqrt(m2_per_px) / self._texels_m[rows]
        levels: IntArray = np.rint(np.log2(np.maximum(texels_per_px, 1))).astype(np.int64)
        return levels


@dataclass(frozen=True, slots=True, eq=False)
class _Tile:
    surface: int
    corners: FloatArray  # (4, 3) [m] of its bounding rectangle
    edges: FloatArray  # (E, 3) of the surface's plane
    texel_m: float


def _tiles(row: int, surface: Surface) -> Iterator[_Tile]:
    """Cut a rectangle into parts; they share its picture, so that no seam is seen."""
    if not surface.is_rectangle:
        (width, height), edges = surface.size_m.tolist(), surface.edges()
        yield _Tile(row, surface.points(_rectangle(0, width, 0, height)), edges, surface.texel_m)
        return
    counts = np.maximum(1, np.ceil(surface.size_m / _TILE_M)).astype(int)
    s, t = (
        np.linspace(0, side, n + 1).tolist() for side, n in zip(surface.size_m, counts, strict=True)
    )
    for s0, s1 in pairwise(s):
        for t0, t1 in pairwise(t):
            edges = np.array([[1, 0, -s0], [-1, 0, s1], [0, 1, -t0], [0, -1, t1]])
            corners = surface.points(_rectangle(s0, s1, t0, t1))
            yield _Tile(row, corners, edges, surface.texel_m)


def _rectangle(s0: float, s1: float, t0: float, t1: float) -> FloatArray:
    return np.array([[s0, t0], [s1, t0], [s1, t1], [s0, t1]])


def _bounds(corners: FloatArray, camera: Pinhole) -> tuple[IntArray, IntArray]:
    """Return the first and one beyond the last pixel (N, 2) that quadrilaterals (N, 4, 3) may cover."""
    ahead, behind = corners, np.roll(corners, -1, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (_NEAR_M - ahead[..., 2]) / (behind[..., 2] - ahead[..., 2])
        cut = ahead + share[..., None] * (behind - ahead)
        cut[~((share > 0) & (share < 1))] = np.nan
        kept = np.where(corners[..., 2:] >= _NEAR_M, corners, np.nan)
        points = np.concatenate([kept, cut], axis=1)
        px = points[..., :2] / points[..., 2:] * camera.focal_px + camera.center_px
    unseen = np.isnan(px)
    low = np.where(unseen, np.inf, px).min(axis=1)
    high = np.where(unseen, -np.inf, px).max(axis=1)
    first = np.clip(np.ceil(low), 0, camera.size_px)
    last = np.clip(np.floor(high) + 1, 0, camera.size_px)
    return first.astype(np.int64), last.astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class _Patch:
    """The part of the image that one tile may cover."""

    tile: _Tile
    plane_by_px: FloatArray  # (3, 3)
    low: IntArray  # (2,) first pixel
    high: IntArray  # (2,) one beyond the last
    level: int

    def part(self, image: A) -> A:
        view: A = image[self.low[1] : self.high[1], self.low[0] : self.high[0]]
        return view

    def _linear(self, lines: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Return a x (E, 1, W) and b y + c (E, H, 1) of lines (E, 3) for the patch's pixels."""
        (x0, y0), (x1, y1) = self.low.tolist(), self.high.tolist()
        across = np.multiply.outer(lines[:, 0], np.arange(x0, x1)).astype(np.float32)
        along = np.multiply.outer(lines[:, 1], np.arange(y0, y1)) + lines[:, 2:]
        return across[:, None], along.astype(np.float32)[:, :, None]

    def mask(self) -> BoolArray:
        """Return the pixels whose middle looks at the tile."""
        across, along = self._linear(self.tile.edges @ self.plane_by_px)
        mask: BoolArray = np.logical_and.reduce(across >= -along)
        return mask

    def test_depth(self, mask: BoolArray, depths: Float32Array) -> None:
        """Take what is hidden from the mask, and write down the inverse depth of the rest."""
        across, along = self._linear(self.plane_by_px[2:])
        mine, part = (across + along)[0], self.part(depths)
        mask &= mine > part
        cv2.copyTo(mine, mask.view(np.uint8), part)

    def draw(self, mask: BoolArray, levels: Sequence[Picture], image: Picture) -> None:
        """Copy the tile's picture to the mask."""
        level = min(self.level, len(levels) - 1)
        texel_m = self.tile.texel_m * 2**level
        # The middle of the first texel of a level is at half a texel, and the first pixel at 0.
        texel_by_plane = np.array([[1 / texel_m, 0, -0.5], [0, 1 / texel_m, -0.5], [0, 0, 1]])
        px_by_patch = np.array([[1, 0, self.low[0]], [0, 1, self.low[1]], [0, 0, 1.0]])
        drawn = cv2.warpPerspective(
            levels[level],
            texel_by_plane @ self.plane_by_px @ px_by_patch,
            (self.high - self.low).tolist(),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        cv2.copyTo(drawn, mask.view(np.uint8), self.part(image))
