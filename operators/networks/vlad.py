"""A picture as one vector: what its cells are like beyond the words of a vocabulary, summed.

Sources: Jegou et al., Aggregating local descriptors into a compact image representation, CVPR 2010;
Arandjelovic et al., NetVLAD, CVPR 2016, equation 1, for the soft assignment;
Perronnin et al., Improving the Fisher kernel, ECCV 2010, section 3.2, for the roots.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np

from mapstream.streams.arrays import Float32Array
from mapstream.streams.errors import ConfigError

_SHARPNESS = 20.0  # of the assignment to words
_TINY = np.float32(1e-9)
_SHIPPED = Path(__file__).with_name("vlad_mobilenet_v2.npz")


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """Words for the cells of a feature map, which are whitened and shortened first."""

    mean: Float32Array  # (C,)
    whitening: Float32Array  # (C, D)
    words: Float32Array  # (K, D)

    @property
    def width(self) -> int:
        """Return the numbers in a vector."""
        return int(self.words.size)

    def vector(self, cells: Float32Array) -> Float32Array:
        """Return the vector (K D,) of unit length of cells (N, C); all zeros if they say nothing."""
        points = self.points(cells)
        beyond = self._beyond(points, self._shares(points))
        vector: Float32Array = _unit(_unit(beyond).reshape(1, -1))[0]
        return vector

    def vectors(self, cells: Float32Array, weights: Float32Array) -> Float32Array:
        """Return the vectors (M, K D) of parts of an image, of unit length; all zeros where a part says nothing.

        In the vector of an image all words count the same. A part has few cells, and words that none of them is
        near would be noise; so its numbers become their roots instead, which keep their signs.

        Args:
            cells: (N, C).
            weights: (M, N) how much of each cell belongs to each part, from 0 to 1.
        """
        used = np.flatnonzero(weights.any(axis=0))
        points = self.points(cells[used])
        shares = self._shares(points)
        vectors = np.empty((len(weights), self.width), np.float32)
        for row, weight in enumerate(weights[:, used]):
            own = np.flatnonzero(weight)
            vectors[row] = self._beyond(points[own], weight[own, None] * shares[own]).reshape(-1)
        return _unit(np.sign(vectors) * np.sqrt(np.abs(vectors)))

    def _shares(self, points: Float32Array) -> Float32Array:
        """Return how much each point (N, D) belongs to each word (N, K)."""
        logits = np.float32(_SHARPNESS) * (2 * points @ self.words.T - (self.words**2).sum(axis=1))
        shares: Float32Array = np.exp(logits - logits.max(axis=1, keepdims=True))
        shares /= shares.sum(axis=1, keepdims=True)
        return shares

    def _beyond(self, points: Float32Array, shares: Float32Array) -> Float32Array:
        """Return the sum of what points (N, D) are beyond each word (K, D)."""
        beyond = shares.T @ points - shares.sum(axis=0)[:, None] * self.words
        sums: Float32Array = beyond.astype(np.float32)
        return sums

    def points(self, cells: Float32Array) -> Float32Array:
        """Return cells (N, C) whitened, shortened and of unit length (N, D)."""
        white = (cells - self.mean) @ self.whitening
        return _unit(white.astype(np.float32))

    def save(self, path: Path) -> None:
        """Write the vocabulary to a file of numpy arrays."""
        np.savez(path, **{field.name: getattr(self, field.name) for field in fields(self)})


def load_vocabulary(path: Path | None = None) -> Vocabulary:
    """Return a vocabulary, by default the one for MobileNetV2 that mapstream brings.

    Raises:
        ConfigError: If the file holds none.
    """
    path = path or _SHIPPED
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return Vocabulary(**{field.name: arrays[field.name] for field in fields(Vocabulary)})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{path}: no vocabulary: {error}") from error


def learn_vocabulary(cells: Float32Array, dimensions: int, num_words: int) -> Vocabulary:
    """Return a vocabulary for cells (N, C): principal components, and k-means of what is left."""
    mean = cells.mean(axis=0)
    variances, directions = np.linalg.eigh(np.cov((cells - mean).T))
    largest = np.argsort(-variances)[:dimensions]
    whitening = (directions[:, largest] / np.sqrt(variances[largest])).astype(np.float32)
    points: Float32Array = _unit((cells - mean) @ whitening)
    cv2.setRNGSeed(1)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    _, _, words = cv2.kmeans(points, num_words, np.empty(0), until, 3, cv2.KMEANS_PP_CENTERS)
    return Vocabulary(mean, whitening, np.asarray(words, np.float32))


def _unit(rows: Float32Array) -> Float32Array:
    unit: Float32Array = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), _TINY)
    return unit
