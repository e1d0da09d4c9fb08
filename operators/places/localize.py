"""Where a robot is in a map that was made before, while it drives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from pydantic import Field, NonNegativeFloat

from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.operators.period import Spacing
from mapstream.operators.places.drift import DriftConfig
from mapstream.operators.places.following import Following
from mapstream.operators.places.map_places import MapPlaces
from mapstream.operators.places.map_poses import send_pose
from mapstream.operators.places.recognition import Recognition, RecognitionConfig
from mapstream.operators.places.views import view_of
from mapstream.recordings.maps import load_map
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import MapPose, Odometry
from mapstream.streams.messages.vision import NFrame
from mapstream.streams.sync import merge


class LocalizeConfig(OperatorConfig):
    """Options of `localize`."""

    map: Path
    """The folder of the map, or of its summary."""
    period_s: NonNegativeFloat = 0.5
    """Between two frames that are compared with the map; 0: all are."""
    late_s: NonNegativeFloat = 0.5
    """So long after its stamp a frame corrects the pose: poses do not wait for what cameras take to be understood."""
    recognition: RecognitionConfig = Field(default_factory=RecognitionConfig)
    drift: DriftConfig = Field(default_factory=DriftConfig)


@dataclass(frozen=True)
class Inputs:
    """What cameras see, and how the robot moves between; without odometry each frame stands alone."""

    n_frames: Receiver[NFrame]
    odometry: Receiver[Odometry] | None = None


@dataclass(frozen=True)
class Outputs:
    """One pose for each odometry; without odometry, one for each frame that is compared."""

    poses: Sender[MapPose]
    odometry: Sender[Odometry]  # the poses in the map alone, where the robot is not lost


class Localize(Operator[Inputs, Outputs]):
    """Recognise places of a map, and hold the odometry there: poses do not drift, and the map does not grow.

    The robot is lost until some frames agree with each other on where it is, and again when it was carried
    elsewhere or has recognised nothing for too long. `recovered` is the first pose after that.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: LocalizeConfig) -> None:
        self._config = config
        self._places: MapPlaces | None = None
        self._late_ns = round(config.late_s * 1e9)
        self._following = Following(config.drift, self._late_ns)
        self._spacing = Spacing(config.period_s)
        self._waiting: list[NFrame] = []  # for the odometry of their time

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        self._places = await offload(self._opened)
        if inputs.odometry is None:
            async for frame in inputs.n_frames:
                if self._spacing.allows(frame.stamp_ns):
                    pose = await offload(self.locate, frame)
                    await send_pose(pose, outputs.poses, outputs.odometry)
            return
        async for _, message in merge(
            inputs.odometry, inputs.n_frames, delays_ns=(0, self._late_ns)
        ):
            if isinstance(message, Odometry):
                pose = await offload(self.follow, message)
                await send_pose(pose, outputs.poses, outputs.odometry)
            elif self._spacing.allows(message.stamp_ns):
                self._waiting.append(message)
        if not self._following.has_tracked:
            warn("the robot was never found in the map")

    def _opened(self) -> MapPlaces:
        return MapPlaces(load_map(self._config.map), self._config.recognition)

    def locate(self, frame: NFrame) -> MapPose:
        """Return where one frame was taken, by itself."""
        recognition = self._recognition(frame)
        found = recognition.found
        if found is None:
            return MapPose(stamp_ns=frame.stamp_ns, state="lost", verdict=recognition.reason)
        return MapPose(
            stamp_ns=frame.stamp_ns,
            state="tracking",
            T_map_base=found.consensus.pose.T_map_base,
            covariance=found.consensus.pose.covariance,
            num_inliers=len(found.inliers),
            verdict=recognition.reason,
        )

    def follow(self, odometry: Odometry) -> MapPose:
        """Return where the robot is at this moment of its odometry, after the frames until then."""
        self._following.move(odometry)
        num_inliers, verdict = 0, ""
        for frame in self._waiting:
            recognition = self._recognition(frame)
            verdict = recognition.reason
            if recognition.found is not None:
                num_inliers = len(recognition.found.inliers)
                pose = recognition.found.consensus.pose
                self._following.correct(frame.stamp_ns, pose.T_map_base, pose.covariance)
        self._waiting.clear()
        return self._following.pose(num_inliers, verdict)

    def _recognition(self, frame: NFrame) -> Recognition:
        places = self._places or self._opened()
        self._places = places
        views = [view_of(features) for features in frame.features if features.descriptors.size]
        return places.recognize(views, seed=frame.stamp_ns % 2**32)
