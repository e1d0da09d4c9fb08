"""Objects followed from image to image (Deep SORT: Wojke, Bewley and Paulus, ICIP 2017)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from mapstream.operators.objects.rows import rows_of
from mapstream.operators.objects.tracking.camera_tracks import CameraTracks
from mapstream.operators.objects.tracking.rules import TrackRules
from mapstream.operators.operator import Operator, Placement, offload, report_loss, warn
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import NO_TRACK


class ObjectTrackerConfig(TrackRules):
    """Options of `object_tracker`."""


@dataclass(frozen=True)
class Inputs:
    detections: Receiver[ObjectDetections]


@dataclass(frozen=True)
class Outputs:
    detections: Sender[ObjectDetections]


class ObjectTracker(Operator[Inputs, Outputs]):
    """Give objects the numbers of their tracks, by where they should be and by what they look like.

    What belongs to no confirmed track is dropped.
    An image in which nothing is left is sent all the same.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: ObjectTrackerConfig) -> None:
        self._config = config
        self._cameras: dict[str, CameraTracks] = {}
        self._last_ns: dict[str, int] = {}
        self._best_score = 0.0
        self._num_tracked = 0

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for objects in inputs.detections:
            if objects.stamp_ns <= self._last_ns.get(objects.frame, objects.stamp_ns - 1):
                report_loss(f"objects of {objects.frame} that came again, or after later ones")
                continue
            self._last_ns[objects.frame] = objects.stamp_ns
            await outputs.detections.send(await offload(self.track, objects))
        if self._best_score > 0 and not self._num_tracked:
            config = self._config
            limits = f"min_score {config.min_score:g}, num_hits {config.num_hits}, max_age_s {config.max_age_s:g}"
            warn(f"no object was tracked; the best score was {self._best_score:.2f} ({limits})")

    def track(self, objects: ObjectDetections) -> ObjectDetections:
        """Return the objects of confirmed tracks in the next image of a camera."""
        if objects.frame not in self._cameras:
            tracks = CameraTracks(self._config, objects.frame, objects.width_px)
            self._cameras[objects.frame] = tracks
        ids = self._cameras[objects.frame].follow(objects)
        self._best_score = max(self._best_score, float(objects.scores.max(initial=0)))
        self._num_tracked += int((ids != NO_TRACK).sum())
        return rows_of(replace(objects, track_ids=ids), ids != NO_TRACK)
