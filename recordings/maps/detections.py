"""Objects that were detected, as rows of a map, and back."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from mapstream.recordings.maps.columns import BytesArray
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.semantic_tables import Detections
from mapstream.streams.arrays import BoolArray, Float32Array
from mapstream.streams.errors import MapFormatError
from mapstream.streams.messages.objects import ObjectDetections, window


def rows_of(objects: ObjectDetections, first_observation: int) -> Detections:
    """Return the rows of detections whose observations follow each other from a row on."""
    n = len(objects)
    known: dict[str, object] = {
        "mask": _bytes([pack(mask) for mask in objects.masks]) if objects.masks else None,
        "mask_source": np.array(objects.mask_sources, object) if objects.mask_sources else None,
        "points": _bytes([p.astype("<f4").tobytes() for p in objects.points_m])
        if objects.points_m
        else None,
        "quat_camera_object_xyzw": objects.quats_camera_object_xyzw,
        "extent_m": objects.extents_m,
        "text": np.array(objects.texts, object) if objects.texts else None,
    }
    return Detections(
        observation=first_observation + np.arange(n),
        box_px=objects.boxes_px,
        image_px=np.tile([objects.width_px, objects.height_px], (n, 1)),
        **{name: value for name, value in known.items() if value is not None},  # type: ignore[arg-type]  # by name
    )


def pack(mask: BoolArray) -> bytes:
    """Return the bytes of a mask (h, w)."""
    return zlib.compress(np.packbits(mask).tobytes())


def mask_of(map_: Map, row: int) -> tuple[tuple[slice, slice], BoolArray]:
    """Return the rows and columns of the image that a detection touches, and which of their pixels are its own.

    Without a mask all of the box is.

    Raises:
        MapFormatError: If the mask is damaged.
    """
    table = map_.detections
    width_px, height_px = table.image_px[row].tolist()
    area = window(table.box_px[row], width_px, height_px)
    shape = tuple(part.stop - part.start for part in area)
    data = table.mask[row]
    if not data:
        return area, np.ones(shape, np.bool_)
    count = shape[0] * shape[1]
    try:
        bits = zlib.decompressobj().decompress(data, (count + 7) // 8)
        mask = np.unpackbits(np.frombuffer(bits, np.uint8), count=count).astype(np.bool_)
    except (zlib.error, ValueError) as error:
        raise MapFormatError(f"detections row {row}: its mask is damaged: {error}") from error
    return area, mask.reshape(shape)


def points_of(map_: Map, row: int) -> Float32Array:
    """Return points (K, 3) in the camera's frame [m] that lie on a detected object.

    Raises:
        MapFormatError: If they are damaged.
    """
    data = map_.detections.points[row]
    if len(data) % 12:
        raise MapFormatError(
            f"detections row {row}: {len(data)} bytes are no whole number of points"
        )
    return np.frombuffer(data, "<f4").reshape(-1, 3)


def _bytes(parts: Sequence[bytes]) -> BytesArray:
    blocks = np.empty(len(parts), dtype=object)
    blocks[:] = parts
    return blocks
