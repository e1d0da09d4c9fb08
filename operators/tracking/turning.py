"""How a camera turned between two images, by the gyroscope, and where its keypoints are then.

The rotation tells most of where a keypoint goes; what is left is the parallax.
Source: maplab's gyro matcher (Schneider et al., RA-L 2018), whose windows lie around such predictions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapstream.operators.imu.samples import joined
from mapstream.operators.operator import warn
from mapstream.operators.tracking.rays import rays
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.channel import Receiver
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.sensors import CameraFrame, ImuBatch
from mapstream.streams.messages.vision import ImageFeatures
from mapstream.streams.sync import cut_imu, window

_MAX_GAP_S = 0.1  # between two samples; nobody knows what happens in a longer one


class GyroTurns:
    """The turn of each camera from its image before to this one; for a join of images or keypoints with an IMU."""

    def __init__(self, imu: Receiver[ImuBatch] | None) -> None:
        self.samples = window(imu, cut=cut_imu, optional=True)
        self._is_aided = imu is not None
        self._last_ns: dict[tuple[str, str], int] = {}  # by camera and kind of keypoints
        self._span = (0, 0)

    def interval(self, message: CameraFrame | ImageFeatures) -> tuple[int, int]:
        """Return the stamps that the samples must reach from and to, when the join asks for them."""
        key = (message.frame, message.kind if isinstance(message, ImageFeatures) else "")
        self._span = (self._last_ns.get(key, message.stamp_ns), message.stamp_ns)
        self._last_ns[key] = message.stamp_ns
        return self._span

    def turn(
        self, message: CameraFrame | ImageFeatures, batches: Sequence[ImuBatch] | None
    ) -> FloatArray | None:
        """Return R_now_before (3, 3) for the message that the join has just given; None if it is not known."""
        start_ns, end_ns = self._span
        if not self._is_aided or start_ns == end_ns:
            return None
        if message.camera is None:
            warn(f"{message.frame} has no calibration, so that the gyroscope cannot help")
            return None
        turn = camera_turn(batches, start_ns, end_ns, message.T_base_sensor)
        if turn is None:
            warn(
                f"images of {message.frame} without IMU samples since the image before (do their clocks "
                "agree?); tracks were looked for where they had been"
            )
        return turn


def camera_turn(
    batches: Sequence[ImuBatch] | None, start_ns: int, end_ns: int, T_base_sensor: SE3
) -> FloatArray | None:
    """Return R_end_start (3, 3) of a camera: it turns rays as seen at the start to how they are seen at the end.

    None if the samples do not reach from start to end, or have a gap.

    Args:
        batches: In order of time.
        start_ns: Stamp of the image before.
        end_ns: Stamp of the image.
        T_base_sensor: Where the camera sits.
    """
    if not batches:
        return None
    samples = joined(batches)
    stamps_ns = samples.stamps_ns
    if stamps_ns[0] > start_ns or stamps_ns[-1] < end_ns:
        return None
    inside = stamps_ns[(stamps_ns > start_ns) & (stamps_ns < end_ns)]
    knots_s = (np.concatenate([[start_ns], inside, [end_ns]]) - start_ns) / 1e9
    since_s = (stamps_ns - start_ns) / 1e9
    first = int(np.searchsorted(stamps_ns, start_ns, side="right")) - 1
    last = int(np.searchsorted(stamps_ns, end_ns, side="left"))
    if np.diff(since_s[first : last + 1]).max(initial=0) > _MAX_GAP_S:
        return None
    rates = np.stack([np.interp(knots_s, since_s, axis) for axis in samples.gyro_radps.T], axis=1)
    steps = so3_exp((rates[1:] + rates[:-1]) / 2 * np.diff(knots_s)[:, None])
    R_start_end = np.eye(3)
    for step in steps:
        R_start_end = R_start_end @ step
    R_imu_sensor = samples.T_base_sensor.R.T @ T_base_sensor.R
    turned: FloatArray = R_imu_sensor.T @ R_start_end.T @ R_imu_sensor
    return turned


def turned_px(
    camera: CameraCalibration | None, px: Float32Array, R_end_start: FloatArray | None
) -> Float32Array:
    """Return where far points (N, 2) are after a turn; where they were if it is not known, or leads out of view."""
    if camera is None or R_end_start is None or len(px) == 0:
        return px
    turned, is_seen = project(camera, rays(camera, px) @ R_end_start.T)
    return np.where(is_seen[:, None], turned, px).astype(np.float32)
