"""Binary descriptors as a few numbers, in which near stays near."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.places.indices.index import Descriptors
from mapstream.recordings.maps.projections import DescriptorProjection
from mapstream.streams.arrays import Float32Array, FloatArray

_ITERATIONS = 30


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """A linear map of bits, less their mean."""

    matrix: Float32Array  # (bits, dimensions)
    offset: Float32Array  # (dimensions,)

    @classmethod
    def learnt(cls, projection: DescriptorProjection) -> Projection:
        """Return the projection that a map keeps."""
        return cls(projection.matrix, projection.mean @ projection.matrix)

    def __call__(self, descriptors: Descriptors) -> Float32Array:
        """Return the projections (N, dimensions) of descriptors (N, bytes)."""
        bits = np.unpackbits(descriptors, axis=1).astype(np.float32)
        projected: Float32Array = bits @ self.matrix - self.offset
        return projected


def learn_projection(descriptors: Descriptors, dimensions: int) -> Projection:
    """Return the projection onto the directions in which descriptors differ most (principal components).

    Each half of the directions gets as much of the variance, because each half has a codebook.
    """
    bits = np.unpackbits(descriptors, axis=1).astype(np.float32)
    mean = bits.mean(axis=0)
    covariance = (bits.T @ bits) / len(bits) - np.outer(mean, mean)
    directions = _largest(covariance.astype(np.float64), dimensions)
    order = np.r_[0:dimensions:2, 1:dimensions:2]
    matrix = directions[:, order].astype(np.float32)
    return Projection(matrix, mean @ matrix)


def _largest(covariance: FloatArray, count: int) -> FloatArray:
    """Return the directions (N, count) of the largest variance, by orthogonal iteration."""
    rng = np.random.default_rng(0)
    basis = rng.standard_normal((len(covariance), min(2 * count, len(covariance))))
    for _ in range(_ITERATIONS):
        basis = np.linalg.qr(covariance @ basis)[0]
    turns = np.linalg.eigh(basis.T @ covariance @ basis)[1]
    largest: FloatArray = (basis @ turns)[:, ::-1][:, :count]
    return largest
