"""Pinhole images of painted plane surfaces, exact to a fraction of a pixel.

For a surface in a plane, [s, t, 1] / z is linear in a pixel [x, y, 1]. So one 3x3 matrix says where in the
picture a pixel looks, whether that is inside the polygon (each edge is a linear function too), and 1 / z,
for the depth test. Source: Blinn, Hyperbolic Interpolation, IEEE CG&A 1992.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from mapstream.recordings.worlds.paint import Picture
from mapstream.recordings.worlds.surfaces import Surface, pyramid
from mapstream.recordings.worlds.tiles import tiles_of
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray

A = TypeVar("A", Picture, Float32Array, IntArray)

_DEPTH = 0  # the line that is 1 / z
_NEAR_M = 0.05


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
        tiles = [
            tile for row, surface in enumerate(self.surfaces) for tile in tiles_of(row, surface)
        ]
        tiles.sort(key=lambda tile: not self.surfaces[tile.surface].is_shell)  # that comes first
        owners = [self.surfaces[tile.surface] for tile in tiles]
        self._owners = np.array([tile.surface for tile in tiles])
        self._corners = np.stack([tile.corners for tile in tiles])  # (N, 4, 3) [m]
        self._origins = np.stack([owner.origin for owner in owners])
        self._axes = np.stack([[owner.right, owner.down] for owner in owners])  # (N, 2, 3)
        self._normals = np.stack([owner.normal for owner in owners])
        self._texels_m = np.array([owner.texel_m for owner in owners])
        self._top_levels = np.array([len(self._levels[row]) - 1 for row in self._owners])
        self._num_lines = np.array([1 + len(tile.edges) for tile in tiles])
        self._lines = np.zeros((len(tiles), self._num_lines.max(), 3))  # of [s, t, 1]
        self._lines[:, _DEPTH, 2] = 1
        for row, tile in enumerate(tiles):
            self._lines[row, 1 : 1 + len(tile.edges)] = tile.edges

    def image(self, camera: Pinhole, T_world_camera: FloatArray) -> Picture:
        """Return what is seen from a pose (4, 4); black where nothing is."""
        image = self._blank(camera)
        depths = np.zeros(image.shape[:2], np.float32)
        for patch in self._patches(camera, T_world_camera):
            mask = patch.mask()
            if not self.surfaces[patch.surface].is_shell:  # nothing was drawn before the shell
                patch.test_depth(mask, depths)
            patch.draw(mask, self._levels[patch.surface][patch.level], image)
        return image

    def rendering(self, camera: Pinhole, T_world_camera: FloatArray) -> Rendering:
        """Return what is seen from a pose (4, 4), how far away it is, and what it is."""
        image = self._blank(camera)
        depths = np.zeros(image.shape[:2], np.float32)
        surfaces = np.full(image.shape[:2], -1, np.int64)
        for patch in self._patches(camera, T_world_camera):
            mask = patch.mask()
            patch.test_depth(mask, depths)
            patch.draw(mask, self._levels[patch.surface][patch.level], image)
            patch.part(surfaces)[mask] = patch.surface
        return Rendering(image, depths, surfaces)

    def surfaces_seen(self, camera: Pinhole, T_world_camera: FloatArray) -> IntArray:
        """Return what is seen from a pose (4, 4), as in a `Rendering`, without drawing it."""
        width, height = camera.size_px
        depths = np.zeros((height, width), np.float32)
        surfaces = np.full((height, width), -1, np.int64)
        for patch in self._patches(camera, T_world_camera):
            mask = patch.mask()
            patch.test_depth(mask, depths)
            patch.part(surfaces)[mask] = patch.surface
        return surfaces

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
        texels_by_px = self._picture_by_px(rows, levels, plane_by_px, low)
        lines = self._lines[rows] @ plane_by_px  # (N, L, 3) of [x, y, 1]
        width, height = camera.size_px
        across = (lines[..., :1] * np.arange(width)).astype(np.float32)
        along = (lines[..., 1:2] * np.arange(height) + lines[..., 2:]).astype(np.float32)
        for at, row in enumerate(rows):
            (x0, y0), (x1, y1), num = low[at].tolist(), high[at].tolist(), self._num_lines[row]
            yield _Patch(
                int(self._owners[row]),
                int(levels[at]),
                texels_by_px[at],
                (slice(y0, y1), slice(x0, x1)),
                across[at, :num, None, x0:x1],
                along[at, :num, y0:y1, None],
            )

    def _detail(self, rows: IntArray, plane_by_px: FloatArray, px: FloatArray) -> IntArray:
        """Return the levels of detail (N,) whose texels are about as large as pixels (N, 2)."""
        inverse_depth = (plane_by_px[:, 2, :2] * px).sum(axis=1) + plane_by_px[:, 2, 2]
        safe = np.maximum(inverse_depth, 1e-2)
        m2_per_px = np.abs(np.linalg.det(plane_by_px)) / safe**3
        texels_per_px = np.sqrt(m2_per_px) / self._texels_m[rows]
        levels = np.rint(np.log2(np.maximum(texels_per_px, 1))).astype(np.int64)
        detail: IntArray = np.minimum(levels, self._top_levels[rows])
        return detail

    def _picture_by_px(
        self, rows: IntArray, levels: IntArray, plane_by_px: FloatArray, low: IntArray
    ) -> FloatArray:
        """Return matrices (N, 3, 3) from pixels of patches that begin at `low` to texels of the levels."""
        texels = plane_by_px.copy()
        texels[:, :2] /= (self._texels_m[rows] * 2.0**levels)[:, None, None]
        texels[:, :2] -= 0.5 * texels[:, 2:]  # the middle of the first texel is at half a texel
        texels[:, :, 2] += (texels[:, :, :2] * low[:, None]).sum(axis=2)
        return texels


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


@dataclass(slots=True, eq=False)
class _Patch:
    """The part of the image that one tile may cover."""

    surface: int
    level: int
    picture_by_px: FloatArray  # (3, 3) from the patch's pixels
    place: tuple[slice, slice]  # rows and columns of the image
    # Of lines a x + b y + c: the first is 1 / z, the others are the edges, positive inside.
    across: Float32Array  # (L, 1, W) a x
    along: Float32Array  # (L, H, 1) b y + c

    def part(self, image: A) -> A:
        view: A = image[self.place]
        return view

    def mask(self) -> BoolArray:
        """Return the pixels whose middle looks at the tile."""
        mask: BoolArray = np.logical_and.reduce(self.across[1:] >= -self.along[1:])
        return mask

    def test_depth(self, mask: BoolArray, depths: Float32Array) -> None:
        """Take what is hidden from the mask, and write down the inverse depth of the rest."""
        mine, part = self.across[_DEPTH] + self.along[_DEPTH], self.part(depths)
        mask &= mine > part
        cv2.copyTo(mine, mask.view(np.uint8), part)

    def draw(self, mask: BoolArray, picture: Picture, image: Picture) -> None:
        """Copy the picture to the mask."""
        if not mask.any():  # all of it is hidden
            return
        height, width = mask.shape
        drawn = cv2.warpPerspective(
            picture,
            self.picture_by_px,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        cv2.copyTo(drawn, mask.view(np.uint8), self.part(image))
