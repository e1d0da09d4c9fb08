"""Paint for the surfaces of worlds: grey or coloured pictures, random and repeatable, with detail at every scale.

Pictures are of dead leaves: shapes of all sizes that lie on each other, which have the statistics of natural
images and corners at all distances. Source: Lee, Mumford, Huang: Occlusion Models for Natural Images,
IJCV 2001.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import Float32Array, FloatArray

Picture = npt.NDArray[np.uint8]  # (H, W) or (H, W, 3) blue, green, red

_MAX_CORNERS = 6
_BITS = 4  # of a fraction of a pixel, in what OpenCV draws


class Painter:
    """Paints with one source of chance, in grey or in colour, at a number of pixels per metre."""

    def __init__(self, rng: np.random.Generator, texel_m: float, *, is_colored: bool) -> None:
        self.rng = rng
        self.texel_m = texel_m
        self._channels = 3 if is_colored else 1

    def color(self, level: float, spread: float) -> list[float]:
        """Return a colour whose channels differ by up to `spread` from a level."""
        color: list[float] = np.clip(level + self._shades(1, spread)[0], 0, 255).tolist()
        return color

    def blank(self, size_m: tuple[float, float], color: list[float]) -> Picture:
        """Return a picture of one colour."""
        width, height = (max(4, round(side / self.texel_m)) for side in size_m)
        picture = np.empty((height, width, self._channels), np.uint8)
        picture[:] = color
        return picture[..., 0] if self._channels == 1 else picture

    def plaster(self, picture: Picture, amplitude: float) -> None:
        """Add noise of all sizes, from 2 texels to a metre."""
        height, width = picture.shape[:2]
        relief = np.zeros((height, width), np.float32)
        size = 2.0
        while size * self.texel_m < 1.0:
            cells = (int(height / size) + 2, int(width / size) + 2)
            noise = self.rng.standard_normal(cells, dtype=np.float32)
            relief += cv2.resize(noise, (width, height), interpolation=cv2.INTER_LINEAR)
            size *= 3.0
        _add(picture, relief * np.float32(amplitude / 2))

    def leaves(self, picture: Picture, count: int, sizes_m: tuple[float, float]) -> None:
        """Lay shapes on a picture, the smallest last; their number falls with the cube of the size."""
        height, width = picture.shape[:2]
        low, high = (size / self.texel_m for size in sizes_m)
        u = self.rng.uniform(0, 1, count)
        radii = np.sort(((1 - u) * low**-2 + u * high**-2) ** -0.5)[::-1] / 2
        centres = self.rng.uniform(0, [width, height], (count, 2))
        num_corners = self.rng.integers(3, _MAX_CORNERS + 1, count)
        angles = 2 * np.pi * np.arange(_MAX_CORNERS) / num_corners[:, None]
        angles += self.rng.uniform(-0.3, 0.3, angles.shape)
        angles += self.rng.uniform(0, 2 * np.pi, (count, 1))
        around = np.stack([np.cos(angles), np.sin(angles)], axis=2)
        polygons = _drawn(centres[:, None] + radii[:, None, None] * around)
        colors = self.rng.uniform(20, 235, (count, 1)) + self._shades(count, 40)
        for polygon, corners, color in zip(polygons, num_corners, colors.tolist(), strict=True):
            cv2.fillConvexPoly(picture, polygon[:corners], color, cv2.LINE_AA, _BITS)

    def posters(self, picture: Picture, count: int, sizes_m: tuple[float, float]) -> None:
        """Hang framed pictures that do not overlap."""
        height, width = picture.shape[:2]
        taken = np.zeros((height // 8 + 1, width // 8 + 1), bool)
        for _ in range(count):
            w, h = (int(side / self.texel_m) for side in self.rng.uniform(*sizes_m, 2))
            if w >= width or h >= height:
                continue
            x, y = int(self.rng.integers(0, width - w)), int(self.rng.integers(0, height - h))
            place = (slice(y // 8, (y + h) // 8 + 1), slice(x // 8, (x + w) // 8 + 1))
            if taken[place].any():
                continue
            taken[place] = True
            self._poster(picture[y : y + h, x : x + w])

    def _poster(self, part: Picture) -> None:
        part[:] = self.color(self.rng.uniform(15, 90), 15)
        frame = max(1, round(0.02 / self.texel_m))
        inner = part[frame:-frame, frame:-frame]
        inner[:] = self.color(self.rng.uniform(120, 240), 30)
        area_m2 = inner.shape[0] * inner.shape[1] * self.texel_m**2
        self.leaves(inner, round(220 * area_m2) + 12, (0.03, 0.5))

    def tiles(self, picture: Picture, size_m: float, spread: float, joint: float) -> None:
        """Make a picture a floor or ceiling of square tiles, each with its own brightness."""
        height, width = picture.shape[:2]
        step = size_m / self.texel_m
        rows, columns = (np.arange(n) / step for n in (height, width))
        cells = self.rng.normal(0, spread, (int(rows[-1]) + 1, int(columns[-1]) + 1))
        shade = np.repeat(cells.astype(np.float32), np.bincount(rows.astype(int)), axis=0)
        shade = np.repeat(shade, np.bincount(columns.astype(int)), axis=1)
        gap = 1.5 / step
        shade[rows % 1 < gap] = joint
        shade[:, columns % 1 < gap] = joint
        _add(picture, shade)

    def lamps(self, picture: Picture, every_m: float, size_m: tuple[float, float]) -> None:
        """Set bright panels into a ceiling, each a little off its place."""
        height, width = picture.shape[:2]
        step, size = every_m / self.texel_m, np.array(size_m) / self.texel_m
        for y in np.arange(step / 2, height, step):
            for x in np.arange(step / 2, width, step):
                centre = np.array([x, y]) + self.rng.uniform(-0.15, 0.15, 2) * step
                corners = centre + size / 2 * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
                cv2.fillConvexPoly(picture, _drawn(corners), self.color(245, 5), cv2.LINE_8, _BITS)

    def _shades(self, count: int, spread: float) -> FloatArray:
        return self.rng.uniform(-spread, spread, (count, self._channels))


def _drawn(corners: FloatArray) -> npt.NDArray[np.int32]:
    """Return pixels as OpenCV draws them, in fractions; what it cannot show it clips."""
    return np.rint(corners * (1 << _BITS)).astype(np.int32)


def _add(picture: Picture, shade: Float32Array) -> None:
    """Add to all channels, in place."""
    step = 1 << 20  # a part fits into the processor's cache
    rows = max(1, step // shade.shape[1])
    for row in range(0, len(shade), rows):
        part, more = picture[row : row + rows], shade[row : row + rows]
        shifted = part + (more if picture.ndim == 2 else more[..., None])
        part[:] = np.clip(shifted, 0, 255, out=shifted)
