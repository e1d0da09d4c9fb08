"""The tables of a map that tell what things and places are; columns as in `tables.py`."""

# ruff: noqa: RUF009  # `column` makes a dataclass field, which the rule cannot see

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from mapstream.recordings.maps.columns import BytesArray, IdArray, Table, TextArray, column
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray

_NAN = float("nan")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detections(Table):
    meaning: ClassVar[str] = (
        "Objects that a detector found in images: each is an observation of kind `object`, with its mask and points."
    )

    observation: IntArray = column(
        "int64", "where it was seen, its class, track and descriptor", refers_to="observations"
    )
    box_px: Float32Array = column("float32", "x_min, y_min, x_max, y_max [px]", (4,))
    image_px: IntArray = column("int64", "width and height of the image", (2,))
    mask: BytesArray = column(
        "bytes",
        "bits over the pixels that the box touches, row by row, packed and deflated; empty: none",
        fill=b"",
    )
    mask_source: TextArray = column("text", "model, lidar, depth or box", fill="")
    points: BytesArray = column(
        "bytes",
        "float32 x, y, z in the camera's frame [m] of some points on it, little-endian",
        fill=b"",
    )
    quat_camera_object_xyzw: FloatArray = column(
        "float64", "orientation in the camera's frame; NaN: it has none", (4,), fill=_NAN
    )
    extent_m: Float32Array = column(
        "float32", "along its axes, about its centre [m]; NaN: unknown", (3,), fill=_NAN
    )
    text: TextArray = column("text", "what is written on it, or its tag: an identity", fill="")
    is_representative: BoolArray = column(
        "bool", "whether its descriptor stands for others of its landmark", fill=False
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regions(Table):
    meaning: ClassVar[str] = "Places and rooms with names, which move with the map."

    id: IdArray = column("uint8", "from name and kind", (16,))
    name: TextArray = column("text", "for people: kitchen, corridor ...")
    kind: TextArray = column("text", "room, place ...", fill="room")
    vertex: IntArray = column("int64", "the vertex whose base it is fixed to", refers_to="vertices")
    outline: BytesArray = column(
        "bytes",
        "float64 x, y, z in that base [m], corner by corner, little-endian; one corner: a place without outline",
    )
    height_m: FloatArray = column(
        "float64",
        "how far it reaches upwards from its outline; NaN: as far as one likes",
        fill=_NAN,
    )
