"""Objects: over the image with class, track and mask, in space with their extents, and recognised."""

from __future__ import annotations

import colorsys
import zlib
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import ColorArray
from mapstream.graph.views.scene import BASE, Drawing, Entry, Scene, sensor_frame
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.detections import mask_of
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray
from mapstream.streams.geometry import quat_xyzw_from_rotation
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import NO_TRACK

_MASK_ORDER, _BOX_ORDER = 5.0, 20.0  # above the image; boxes above keypoints
_MASK_OPACITY = 0.45
_MOST_CLASSES = 255
_PLACE = rr.Radius.ui_points(5)
_LINE = rr.Radius.ui_points(1.5)


@cache
def class_color(label: str) -> int:
    """Return the colour of a class, 0xRRGGBBAA: the same in every run."""
    hue = zlib.crc32(label.encode()) / 2**32
    r, g, b = (round(255 * part) for part in colorsys.hsv_to_rgb(hue, 0.6, 1.0))
    return r << 24 | g << 16 | b << 8 | 0xFF


def class_colors(labels: Sequence[str]) -> ColorArray:
    """Return the colours (N,) of classes; of a list of three Rerun would make one."""
    return np.array([class_color(label) for label in labels], np.uint32)


def view_object_detections(detections: ObjectDetections, scene: Scene) -> Drawing:
    """Draw boxes with class, track and score over the image, masks as tints, and what is known of them in space."""
    colors = class_colors(detections.labels)
    boxes = _boxes(detections.boxes_px, detections.labels, _captions(detections))
    size_px = detections.width_px, detections.height_px
    masks = [
        (label, detections.window(row), mask)
        for row, (label, mask) in enumerate(zip(detections.labels, detections.masks, strict=False))
    ]
    return [
        Entry.of("", boxes),
        *(_tints(masks, size_px, scene) if masks else []),
        *_in_space(detections, colors, scene),
        Entry.of("num_objects", rr.Scalars([len(detections)])),
    ]


def view_recognised(constraint: Constraint, scene: Scene) -> Drawing:
    """Draw the things that were recognised at one moment, with their classes, around the robot."""
    seen: list[Constraint] = scene.of_moment("recognised", constraint.stamp_ns, constraint)
    known = [(each.landmark.label, each.landmark.name) for each in seen if each.landmark]
    points = rr.Points3D(
        [each.T_a_b.t for each in seen if each.landmark],
        colors=class_colors([label for label, _ in known]),
        radii=_PLACE,
        labels=[label or name for label, name in known],
    )
    return scene.within("", BASE, points)


def map_detections(map_: Map, sensor: str, vertex: int, scene: Scene) -> list[Entry]:
    """Return what was detected in one camera's picture at a vertex: boxes and masks, to lie over the picture."""
    seen, table = map_.observations, map_.detections
    is_here = (seen.vertex == vertex) & (seen.sensor == sensor)
    rows = np.flatnonzero(is_here[table.observation])
    if not len(rows):
        return []
    labels = seen.label[table.observation[rows]].tolist()
    tracks = seen.track[table.observation[rows]].tolist()
    captions = [
        label if track == NO_TRACK else f"{label} {_number(track)}"
        for label, track in zip(labels, tracks, strict=True)
    ]
    masks = [
        (label, *mask_of(map_, row))
        for label, row in zip(labels, rows.tolist(), strict=True)
        if table.mask[row]
    ]
    width_px, height_px = table.image_px[rows[0]].tolist()
    return [
        Entry.of("objects", _boxes(table.box_px[rows], labels, captions)),
        *(_tints(masks, (width_px, height_px), scene) if masks else []),
    ]


def extents(T: FloatArray, extents_m: FloatArray, colors: ColorArray) -> rr.Boxes3D:
    """Return boxes of these sizes (N, 3) at poses (N, 4, 4)."""
    return rr.Boxes3D(
        centers=T[:, :3, 3],
        half_sizes=extents_m / 2,
        quaternions=quat_xyzw_from_rotation(T[:, :3, :3]),
        colors=colors,
        radii=_LINE,
    )


def _boxes(boxes_px: Float32Array, labels: Sequence[str], captions: Sequence[str]) -> rr.Boxes2D:
    return rr.Boxes2D(
        array=boxes_px,
        array_format=rr.Box2DFormat.XYXY,
        colors=class_colors(labels),
        labels=list(captions),
        draw_order=_BOX_ORDER,
    )


def _captions(detections: ObjectDetections) -> list[str]:
    """Return what stands beside each box: class, track, text, score."""
    captions = []
    for row, label in enumerate(detections.labels):
        words = [label]
        if detections.track_ids is not None and detections.track_ids[row] != NO_TRACK:
            words.append(_number(int(detections.track_ids[row])))
        if detections.texts and detections.texts[row]:
            words.append(f'"{detections.texts[row]}"')
        captions.append(" ".join([*words, f"{detections.scores[row]:.2f}"]))
    return captions


def _number(track: int) -> str:
    """Return the last digits of a track's number: they tell it from those that one sees beside it."""
    return f"#{track % 10_000}"


def _tints(
    masks: Sequence[tuple[str, tuple[slice, slice], BoolArray]],
    size_px: tuple[int, int],
    scene: Scene,
) -> list[Entry]:
    """Return the masks as one image of classes, and the colours of classes that are new."""
    numbers: dict[str, int] = scene.remember("classes", {})
    num_before = len(numbers)
    width_px, height_px = size_px
    image = np.zeros((height_px, width_px), np.uint8)
    for label, window, mask in masks:
        number = numbers.setdefault(label, 1 + len(numbers) % _MOST_CLASSES)
        image[window][mask] = number
    tint = rr.SegmentationImage(image, opacity=_MASK_OPACITY, draw_order=_MASK_ORDER)
    if len(numbers) == num_before:
        return [Entry.of("masks", tint)]
    known = [(0, "", (0, 0, 0, 0)), *((n, name, _rgba(name)) for name, n in numbers.items())]
    return [
        Entry.of("masks", rr.AnnotationContext(known), is_static=True),
        Entry.of("masks", tint),
    ]


def _in_space(detections: ObjectDetections, colors: ColorArray, scene: Scene) -> list[Entry]:
    """Return points on objects, and their boxes where an extent is known, in the frame of the camera."""
    drawing = [*scene.mount(detections.frame, detections.T_base_sensor)]
    frame = sensor_frame(detections.frame)
    if detections.points_m:
        points = rr.Points3D(
            np.concatenate([np.empty((0, 3), np.float32), *detections.points_m]),
            colors=np.repeat(colors, [len(points) for points in detections.points_m]),
            radii=rr.Radius.ui_points(1.5),
        )
        drawing += scene.within("points", frame, points)
    if detections.centers_m is None:
        return drawing
    known = np.flatnonzero(np.isfinite(detections.centers_m).all(axis=1))
    marks = rr.Points3D(
        detections.centers_m[known],
        colors=colors[known],
        radii=_PLACE,
        labels=[detections.labels[row] for row in known],
    )
    drawing += scene.within("points/centers", frame, marks)
    if detections.extents_m is None:
        return drawing
    sized = known[np.isfinite(detections.extents_m[known]).all(axis=1)]
    boxes = rr.Boxes3D(
        centers=detections.centers_m[sized],
        half_sizes=detections.extents_m[sized] / 2,
        quaternions=_quaternions(detections)[sized],
        colors=colors[sized],
        radii=_LINE,
    )
    return [*drawing, *scene.within("points/extents", frame, boxes)]


def _quaternions(detections: ObjectDetections) -> FloatArray:
    """Return orientations (N, 4), those of the camera where there are none."""
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(detections), 1))
    given = detections.quats_camera_object_xyzw
    return upright if given is None else np.where(np.isfinite(given), given, upright)


def _rgba(label: str) -> Any:  # noqa: ANN401  # four numbers, as Rerun takes them
    color = class_color(label)
    return tuple(color >> shift & 0xFF for shift in (24, 16, 8, 0))
