"""Which calibration belongs to the images of a topic: by the config, the rig, or a topic beside them.

A camera's calibration is taken once, from the first message that describes it.
"""

from __future__ import annotations

from collections import Counter
from itertools import islice
from pathlib import PurePosixPath

from mapstream.recordings.decoding import decoder_for, message_type_of
from mapstream.recordings.recording import Recording
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import DecodeError
from mapstream.streams.rig import Rig
from mapstream.streams.sensors import CameraSensor

_TRANSPORTS = ("compressed", "compressedDepth", "theora", "ffmpeg")  # ROS' image_transport
_MAX_TRIES = 10  # messages of a camera that may be undecodable, or not calibrated yet


class Cameras:
    """Calibrations of the cameras of one recording, each looked for once."""

    def __init__(self, recording: Recording, rig: Rig) -> None:
        self.notices: Counter[str] = Counter()
        self._recording = recording
        self._rig = rig
        self._topics = [
            name
            for name, topic in recording.topics.items()
            if message_type_of(topic.channel) is CameraCalibration
        ]
        self._first: dict[str, CameraCalibration | None] = {}  # by topic of calibrations
        self._found: dict[tuple[str, str], CameraCalibration | None] = {}

    def calibration(self, topic: str, frame: str) -> CameraCalibration | None:
        """Return what describes the camera whose images come on a topic; None where nothing does.

        A sensor file comes before topics. Among these the one in the images' namespace is meant; where
        that does not tell, the one with their frame.
        """
        key = (topic, frame)
        if key not in self._found:
            self._found[key] = self._of_rig(topic, frame) or self._beside(topic, frame)
        return self._found[key]

    def first(self, topic: str) -> CameraCalibration | None:
        """Return the first calibration of a topic that can be read; None if there is none.

        Raises:
            DecodeError: If the topic holds something else.
        """
        if topic not in self._first:
            self._first[topic] = self._read(topic)
        return self._first[topic]

    def _of_rig(self, topic: str, frame: str) -> CameraCalibration | None:
        sensor = self._rig.sensor_of_topic(topic)
        if not isinstance(sensor, CameraSensor):
            sensor = self._rig.camera_of_frame(frame)
        calibration = sensor.calibration if isinstance(sensor, CameraSensor) else None
        return calibration if isinstance(calibration, CameraCalibration) else None

    def _beside(self, topic: str, frame: str) -> CameraCalibration | None:
        beside = [name for name in self._topics if _namespace(name) == _namespace(topic)]
        found = [self.first(name) for name in beside or self._topics]
        is_meant = len(beside) == 1
        chosen = [camera for camera in found if camera and (is_meant or camera.frame == frame)]
        if not chosen:
            return None
        if "rect" in topic and chosen[0].distortion != "none":
            self.notices[
                f"{topic} seems to be rectified, but its calibration has a distortion ({chosen[0].distortion}):"
                " if so, describe the camera in a sensor file"
            ] += 1
        return chosen[0]

    def _read(self, topic: str) -> CameraCalibration | None:
        decode = decoder_for(self._recording.topics[topic].channel, CameraCalibration)
        for raw in islice(self._recording.messages([topic]), _MAX_TRIES):
            try:
                message = decode(raw)
            except DecodeError as error:
                self.notices[f"a calibration cannot be decoded: {error}"] += 1
                continue
            if isinstance(message, CameraCalibration):
                return message
        return None


def _namespace(topic: str) -> PurePosixPath:
    """Return what a topic of images shares with that of its camera's description."""
    path = PurePosixPath(topic)
    return path.parent.parent if path.name in _TRANSPORTS else path.parent
