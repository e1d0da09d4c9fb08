"""Keypoints over their image: where each was in the images before, and where other cameras see it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import KEYPOINT, REFUSED, ramp_colors
from mapstream.graph.views.scene import Drawing, Entry, Scene, sensor_frame
from mapstream.operators.features.rows import rows_of
from mapstream.streams.arrays import Float32Array, IntArray
from mapstream.streams.messages.vision import NO_TRACK, ImageFeatures, NFrame

_TAIL = 12  # images that a tail reaches back
_SHORT, _LONG = -3, 30  # images at the ends of the colours; the ramp begins too dark to be seen
_SAME_MOMENT_NS = 1_000_000
_MATCH = 0xFFFFFF50
_ABOVE = 10.0  # the image, in draw order


@dataclass(slots=True)
class Trails:
    """Where the tracks of one camera and kind were."""

    length: dict[int, int] = field(default_factory=dict)  # images in which each was seen
    tails: dict[int, list[tuple[float, float]]] = field(default_factory=dict)

    def follow(self, ids: IntArray, px: Float32Array) -> list[tuple[float, float]]:
        """Add the tracks of the next image; return where those were last that ended."""
        now = set(ids.tolist())
        ended = [tail[-1] for track, tail in self.tails.items() if track not in now]
        self.length = {track: self.length.get(track, 0) + 1 for track in now}
        self.tails = {
            track: [*self.tails.get(track, [])[1 - _TAIL :], (x, y)]
            for track, (x, y) in zip(ids.tolist(), px.tolist(), strict=True)
        }
        return ended


def view_image_features(features: ImageFeatures, scene: Scene) -> Drawing:
    """Draw keypoints over their image; those with tracks with tails, coloured by how long they were followed.

    Grey lines lead to where another camera sees the same point; what ended in this image is red.
    Those with 3D points are drawn there, too.
    """
    if features.track_ids is None:
        return [Entry.of("", _keypoints(features)), *_in_space(features, KEYPOINT, scene)]
    has_track = features.track_ids != NO_TRACK
    loose = rows_of(features, ~has_track)
    ids, px = features.track_ids[has_track], features.keypoints_px[has_track]
    trails: Trails = scene.remember(f"trails {features.frame} {features.kind}", Trails())
    ended = trails.follow(ids, px)
    lengths = np.array([trails.length[track] for track in ids.tolist()], np.float64)
    colors: Any = ramp_colors(lengths, _SHORT, _LONG)
    strips = [np.array(trails.tails[track], np.float32) for track in ids.tolist()]
    matches = _matches(features, ids, px, scene)
    all_colors = np.full(len(features), KEYPOINT, np.uint32)
    all_colors[has_track] = colors
    return [
        *_in_space(features, all_colors, scene),
        Entry.of("", _keypoints(loose)),
        Entry.of("tracks", rr.Points2D(px, colors=colors, radii=_ui(2.5), draw_order=_ABOVE + 3)),
        Entry.of(
            "tails",
            rr.LineStrips2D(strips, colors=colors, radii=_ui(1.0), draw_order=_ABOVE + 2),
        ),
        Entry.of(
            "matches",
            rr.LineStrips2D(matches, colors=_MATCH, radii=_ui(0.5), draw_order=_ABOVE + 1),
        ),
        Entry.of(
            "ended", rr.Points2D(ended, colors=REFUSED, radii=_ui(2.0), draw_order=_ABOVE + 1)
        ),
        Entry.of("num_tracks", rr.Scalars([len(ids)])),
        Entry.of("mean_length", rr.Scalars([lengths.mean() if len(lengths) else 0.0])),
    ]


def view_n_frame(frame: NFrame, scene: Scene) -> Drawing:  # noqa: ARG001  # a view
    """Plot how many keypoints each camera has of each kind; the keypoints are drawn where they are found."""
    return [
        Entry.of(f"{f.frame}/{f.kind}".replace(" ", "_"), rr.Scalars([len(f)]))
        for f in frame.features
    ]


def _keypoints(features: ImageFeatures) -> rr.Points2D:
    """Return keypoints without tracks: the brighter, the better; their size where they have one."""
    scores, scales = features.scores, features.scales
    colors: Any = KEYPOINT
    if scores is not None and len(scores):
        colors = ramp_colors(scores, float(scores.min()), float(scores.max()), "viridis")
    radii: Any = _ui(2.5)
    if scales is not None and len(scales):
        radii = np.clip(scales / 8, 1.5, 12)  # the true diameter would hide the picture
    return rr.Points2D(features.keypoints_px, colors=colors, radii=radii, draw_order=_ABOVE)


def _in_space(features: ImageFeatures, colors: Any, scene: Scene) -> list[Entry]:  # noqa: ANN401  # one, or (N,)
    """Return the 3D points of keypoints, where the sensor sits."""
    if features.points_m is None:
        return []
    mount = scene.mount(features.frame, features.T_base_sensor)
    points = rr.Points3D(features.points_m, colors=colors, radii=_ui(3.0))
    return [*mount, *scene.within("points", sensor_frame(features.frame), points)]


def _matches(
    features: ImageFeatures, ids: IntArray, px: Float32Array, scene: Scene
) -> list[Float32Array]:
    """Return lines (2, 2) from where another camera sees a point to where this one does."""
    others = scene.tracked.setdefault(features.kind, {})
    lines: list[Float32Array] = []
    for frame, (stamp_ns, other_ids, other_px) in others.items():
        if frame != features.frame and abs(stamp_ns - features.stamp_ns) < _SAME_MOMENT_NS:
            _, a, b = np.intersect1d(other_ids, ids, return_indices=True)
            lines += list(np.stack([other_px[a], px[b]], axis=1))
    others[features.frame] = (features.stamp_ns, ids, px)
    return lines


def _ui(radius: float) -> Any:  # noqa: ANN401  # Rerun's own, which has no type
    return rr.Radius.ui_points(radius)
