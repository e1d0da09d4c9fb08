"""Linear maps of descriptors, and where a map keeps them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Projections
from mapstream.streams.arrays import Float32Array
from mapstream.streams.errors import MapError

Use = Literal["compression", "index"]
_LITTLE = np.dtype("<f4")


@dataclass(frozen=True, slots=True, eq=False)
class DescriptorProjection:
    """Descriptors, as numbers or bits, less a mean, times a matrix."""

    kind: str
    use: Use
    mean: Float32Array  # (D,)
    matrix: Float32Array  # (D, d)

    def __call__(self, descriptors: npt.NDArray[Any]) -> Float32Array:
        """Return the projections (N, d) of descriptors (N, ...).

        Raises:
            MapError: If they are of another length.
        """
        numbers = as_numbers(descriptors)
        if numbers.shape[1] != len(self.mean):
            expected = f"{len(self.mean)} numbers or bits"
            raise MapError(
                f"the {self.use} of {self.kind} takes {expected}, not {numbers.shape[1]}"
            )
        projected = (numbers - self.mean) @ self.matrix
        return projected.astype(np.float32, copy=False)


def as_numbers(descriptors: npt.NDArray[Any]) -> Float32Array:
    """Return descriptors (N, D) as numbers; those of bytes have one for each bit."""
    if descriptors.dtype == np.uint8:
        return np.unpackbits(descriptors, axis=1).astype(np.float32)
    return descriptors.astype(np.float32, copy=False)


def with_projection(map_: Map, projection: DescriptorProjection) -> Map:
    """Return the map with a projection, in place of one of the same kind and use."""
    known = map_.projections
    is_other = (known.kind != projection.kind) | (known.use != projection.use)
    mean = projection.mean.astype(_LITTLE).tobytes()
    matrix = projection.matrix.astype(_LITTLE).tobytes()
    added = Projections(
        id=id_array([derived_id(projection.kind, projection.use, mean, matrix)]),
        kind=np.array([projection.kind], dtype=object),
        use=np.array([projection.use], dtype=object),
        num_inputs=np.array([projection.matrix.shape[0]]),
        num_outputs=np.array([projection.matrix.shape[1]]),
        mean=np.array([mean], dtype=object),
        matrix=np.array([matrix], dtype=object),
    )
    map_ = map_.select(projections=is_other)
    return replace(map_, projections=concatenate([map_.projections, added]))


def projections_of(map_: Map, use: Use) -> dict[str, DescriptorProjection]:
    """Return the projections for one use by kind of feature.

    Raises:
        MapError: If one is not whole, or a kind has two, as after a merge of maps that learnt apart.
    """
    table = map_.projections
    found: dict[str, DescriptorProjection] = {}
    for row in np.flatnonzero(table.use == use).tolist():
        kind, shape = table.kind[row], (int(table.num_inputs[row]), int(table.num_outputs[row]))
        if kind in found:
            raise MapError(f"two projections of {kind} for {use}; learn one anew from this map")
        try:
            matrix = np.frombuffer(table.matrix[row], _LITTLE).reshape(shape)
            mean = np.frombuffer(table.mean[row], _LITTLE).reshape(shape[0])
        except ValueError as error:
            raise MapError(f"the projection of {kind} for {use} is not whole: {error}") from error
        found[kind] = DescriptorProjection(kind, use, mean, matrix)
    return found
