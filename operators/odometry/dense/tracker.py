"""A camera that is followed by whole images: each compared with a keyframe, which is replaced in time.

Source: Kerl, Sturm, Cremers: Dense Visual SLAM for RGB-D Cameras, IROS 2013, sections III-D and IV-B.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.odometry.dense.alignment import Alignment, Prior, align
from mapstream.operators.odometry.dense.views import Level
from mapstream.operators.odometry.uncertainty import chain, unmeasured
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, invert, se3_exp, se3_log, straightened


class DenseTrackerConfig(OperatorConfig):
    """When an image is believed, and when it becomes the keyframe."""

    max_accel_mps2: PositiveFloat = 5.0
    """The motion is expected to go on, within what this and `max_turn_accel_radps2` may change of it."""
    max_turn_accel_radps2: PositiveFloat = 15.0
    keyframe_growth: float = Field(default=1.4, gt=1)
    """A new keyframe where deviations (the mean of the six, by the entropy) are so many times those at the
    first image after the last one."""
    keyframe_overlap: float = Field(default=0.6, gt=0, lt=1)
    """A new keyframe where less of the last one is in view."""
    min_overlap: float = Field(default=0.25, gt=0, lt=1)
    """With less of the keyframe in view an image is lost."""
    min_correlation: float = Field(default=0.7, gt=0, lt=1)
    """Of its gray levels with those of the keyframe; with less an image is lost."""
    max_lost: int = Field(default=10, ge=1)
    """After so many lost images the next one is a new keyframe."""


@dataclass(frozen=True, eq=False)
class View:
    """An image at all its sizes, and where it was taken."""

    stamp_ns: int
    levels: list[Level]
    T_odom_camera: FloatArray  # (4, 4)


class DenseTracker:
    """Where a camera is, from its first view on."""

    def __init__(self, first: View, config: DenseTrackerConfig) -> None:
        self._config = config
        self._keyframe = self._last = first  # the last one that was found
        self._rate: FloatArray = np.zeros(6)  # of the camera, per second
        self._covariance: FloatArray = np.zeros((6, 6))  # of the last camera against the keyframe
        self._first_entropy: float | None = None  # of the first image after the keyframe
        self._num_lost = 0

    @property
    def T_odom_camera(self) -> FloatArray:
        """Return where the camera was last found (4, 4)."""
        return self._last.T_odom_camera

    def follow(self, stamp_ns: int, levels: list[Level]) -> FloatArray:
        """Take the next image in; return the covariance (6, 6) of the camera's step to it.

        Raises:
            EstimationError: If it fits neither the keyframe nor the last image that was found.
        """
        before = self._covariance
        try:
            found = self._aligned(self._keyframe, stamp_ns, levels)
        except EstimationError:
            if self._keyframe is self._last:
                raise
            self._take_keyframe(self._last)
            before = before if self._num_lost else self._covariance
            found = self._aligned(self._keyframe, stamp_ns, levels)
        T = straightened(self._keyframe.T_odom_camera @ found.T_reference_view)
        step = invert(self.T_odom_camera) @ T
        of_step = chain(before, SE3(straightened(step)), found.covariance)
        self._rate = se3_log(step) / ((stamp_ns - self._last.stamp_ns) / 1e9)
        self._covariance, self._num_lost = found.covariance, 0
        self._last = View(stamp_ns, levels, T)
        if self._tells_little(found):
            self._take_keyframe(self._last)
        return of_step

    def lose(self, stamp_ns: int, levels: list[Level], duration_s: float) -> FloatArray:
        """Stay where the last image was, and begin anew there after many; return the covariance (6, 6) of the step."""
        self._rate, self._num_lost = np.zeros(6), self._num_lost + 1
        # the next step undoes what this one missed
        of_step = self._covariance = unmeasured(duration_s)
        if self._num_lost >= self._config.max_lost:
            self._last, self._num_lost = View(stamp_ns, levels, self.T_odom_camera), 0
            self._take_keyframe(self._last)
        return of_step

    def _aligned(self, keyframe: View, stamp_ns: int, levels: list[Level]) -> Alignment:
        """Return where an image is: where the motion should have led, or near the last one if it stopped."""
        elapsed_s = (stamp_ns - self._last.stamp_ns) / 1e9
        sigma_rad = self._config.max_turn_accel_radps2 * elapsed_s**2
        sigma_m = self._config.max_accel_mps2 * elapsed_s**2
        information = np.diag([sigma_rad**-2.0] * 3 + [sigma_m**-2.0] * 3)
        T_keyframe_last = invert(keyframe.T_odom_camera) @ self.T_odom_camera
        try:
            expected = T_keyframe_last @ se3_exp(self._rate * elapsed_s)
            return self._checked(align(keyframe.levels, levels, Prior(expected, information)))
        except EstimationError:
            prior = Prior(T_keyframe_last, information)
            return self._checked(align(keyframe.levels, levels, prior))

    def _checked(self, found: Alignment) -> Alignment:
        if found.overlap < self._config.min_overlap:
            raise EstimationError("too little of the keyframe is in view")
        if not found.correlation > self._config.min_correlation:
            raise EstimationError("gray levels differ too much from those of the keyframe")
        return found

    def _tells_little(self, found: Alignment) -> bool:
        entropy = _entropy(found.covariance)
        if self._first_entropy is None:
            self._first_entropy = entropy
        growth = np.exp((entropy - self._first_entropy) / 6)
        is_far = found.overlap < self._config.keyframe_overlap
        return is_far or bool(growth > self._config.keyframe_growth)

    def _take_keyframe(self, view: View) -> None:
        self._keyframe, self._first_entropy = view, None
        self._covariance = np.zeros((6, 6))


def _entropy(covariance: FloatArray) -> float:
    """Return the differential entropy of a normal distribution, less what does not depend on it."""
    return float(np.linalg.slogdet(covariance)[1]) / 2
