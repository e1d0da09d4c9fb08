"""Arrays inside messages: checked once where they enter, read-only ever after."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

BoolArray = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]


def frozen(
    owner: object, field: str, dtype: npt.DTypeLike, shape: tuple[int | None, ...]
) -> npt.NDArray[Any]:
    """Make the array in `owner.field` of one dtype and shape, and read-only; None in a shape is any size.

    An array that fits already is not copied, so that messages can be views on a recording.

    Raises:
        ValueError: If the shape differs; the message names the class, the field and both shapes.
    """
    array = np.asarray(getattr(owner, field), dtype=dtype)
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        expected = tuple("N" if want is None else want for want in shape)
        name = f"{type(owner).__name__}.{field}"
        raise ValueError(f"{name}: expected shape {expected}, got {array.shape}")
    array = read_only(array)
    object.__setattr__(owner, field, array)
    return array


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a view that cannot be written; an array that cannot be is its own."""
    if array.flags.writeable:
        array = array.view()
        array.flags.writeable = False
    return array


def frozen_optional(
    owner: object, field: str, dtype: npt.DTypeLike, shape: tuple[int | None, ...]
) -> None:
    """Like `frozen`, for a field that may be None."""
    if getattr(owner, field) is not None:
        frozen(owner, field, dtype, shape)


def finite_rows(rows: npt.NDArray[np.floating]) -> BoolArray:
    """Tell which rows (N, ...) are finite."""
    finite = np.isfinite(rows)
    if finite.all():  # as a rule, and four times as fast as row by row
        return np.ones(len(rows), np.bool_)
    each: BoolArray = finite.all(axis=tuple(range(1, rows.ndim)))
    return each
