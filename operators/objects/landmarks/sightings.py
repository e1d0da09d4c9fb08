"""What detections of a map say of the things that they show: where, how large, in which image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.landmarks.sensors import numbered
from mapstream.operators.landmarks.views import Views, views_of
from mapstream.operators.objects.box_areas import area_px2, shared_px2
from mapstream.recordings.maps.columns import TextArray
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray

_BORDER_PX = 2.0  # a box so near to the border may go on beyond it


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """The detections of a map, by mission, track and time."""

    detections: IntArray  # (N,) rows
    views: Views  # of their observations: rays and points in the map frame
    stamps_ns: IntArray  # (N,)
    images: IntArray  # (N,) numbers of images
    missions: IntArray  # (N,) rows
    tracks: IntArray  # (N,) -1: none
    landmarks: IntArray  # (N,) rows, -1: none yet
    boxes_px: Float32Array  # (N, 4)
    sides_rad: FloatArray  # (N, 2) how wide and high a box looks
    is_cut: BoolArray  # (N,) by the border of the image
    labels: TextArray  # (N,)
    texts: TextArray  # (N,)

    def __len__(self) -> int:
        return len(self.detections)


def sightings_of(map_: Map) -> Sightings:
    """Return what the detections of a map say."""
    seen, table = map_.observations, map_.detections
    rows = table.observation
    missions = map_.vertices.mission[seen.vertex[rows]]
    stamps_ns = map_.vertices.stamp_ns[seen.vertex[rows]] + seen.offset_ns[rows]
    order = np.lexsort((rows, stamps_ns, seen.track[rows], missions))
    rows = rows[order]
    views = views_of(map_, rows)
    sensors, _ = numbered(seen.sensor[rows])
    moments = np.stack([missions[order], stamps_ns[order], sensors])
    boxes_px = table.box_px[order]
    rad_per_px = views.ray_sigmas_rad / seen.sigma[rows]
    return Sightings(
        detections=order,
        views=views,
        stamps_ns=stamps_ns[order],
        images=np.unique(moments, axis=1, return_inverse=True)[1].ravel().astype(np.int64),
        missions=missions[order],
        tracks=seen.track[rows],
        landmarks=seen.landmark[rows],
        boxes_px=boxes_px,
        sides_rad=(boxes_px[:, 2:] - boxes_px[:, :2]) * rad_per_px[:, None],
        is_cut=_is_cut(boxes_px, table.image_px[order]),
        labels=seen.label[rows],
        texts=table.text[order],
    )


def _is_cut(boxes_px: Float32Array, image_px: IntArray) -> BoolArray:
    low = boxes_px[:, :2] < _BORDER_PX - 0.5
    high = boxes_px[:, 2:] > image_px - 0.5 - _BORDER_PX
    is_cut: BoolArray = np.asarray((low | high).any(axis=1))
    return is_cut


def overlap(boxes_a: Float32Array, boxes_b: Float32Array) -> FloatArray:
    """Return the share (N, M) of the smaller of two boxes, of (N, 4) and (M, 4), that the other covers."""
    a, b = boxes_a.T[:, :, None].astype(np.float64), boxes_b.T[:, None].astype(np.float64)
    smaller = np.minimum(area_px2(a), area_px2(b)).clip(min=1e-12)
    covered: FloatArray = shared_px2(a, b) / smaller
    return covered
