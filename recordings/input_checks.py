"""Why a message of another program would be rejected, or used other than its writer thought."""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

import numpy as np

from mapstream.recordings.detection_checks import object_faults
from mapstream.recordings.feature_checks import feature_faults, width_fault
from mapstream.recordings.stamp_checks import Finding
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.constraints import Constraint, LoopClosure
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import ImageFeatures

_SYMMETRY = 1e-6  # of a covariance: what rounding to single precision leaves
_MAX_STEP_M = 20.0  # between two messages of odometry


class InputChecks:
    """Looks at each message of a topic, and counts what is wrong by reason."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._reasons: Counter[str] = Counter()
        self._first: dict[str, int] = {}  # stamp
        self._previous: Odometry | None = None
        self._features: dict[str, ImageFeatures] = {}  # the last of each kind

    def see(self, message: Any) -> None:  # noqa: ANN401  # of any type; those without rules pass
        """Take note of one message."""
        found = []
        if isinstance(message, Odometry):
            found = odometry_faults(message, self._previous)
            self._previous = message
        elif isinstance(message, Constraint):
            found = constraint_faults(message)
        elif isinstance(message, LoopClosure):
            found = loop_faults(message)
        elif isinstance(message, ImageFeatures):
            found = self._feature_faults(message)
        elif isinstance(message, ObjectDetections):
            found = list(object_faults(message))
        for reason in found:
            self._reasons[reason] += 1
            self._first.setdefault(reason, message.stamp_ns)

    def _feature_faults(self, message: ImageFeatures) -> list[str]:
        before = self._features.get(message.kind)
        change = width_fault(message, before) if before is not None else ""
        if len(message) and not change:
            self._features[message.kind] = message
        return [*feature_faults(message), *([change] if change else [])]

    def findings(self) -> list[Finding]:
        """Return one finding for each reason."""
        return [
            Finding(
                name="rejected_input",
                topic=self._topic,
                text=f"{count} messages: {reason}; the first at {self._first[reason]} ns",
            )
            for reason, count in self._reasons.items()
        ]


def odometry_faults(message: Odometry, previous: Odometry | None) -> list[str]:
    """Return what is wrong with a pose of odometry."""
    found = []
    if message.covariance is not None:
        found += _covariance_faults(message.covariance, may_be_open=True)
    for name in ("velocity_mps", "gyro_bias_radps", "accel_bias_mps2"):
        value = getattr(message, name)
        if value is not None and not np.isfinite(value).all():
            found.append(f"{name} is not finite; leave it out where it is not known")
    if previous is not None:
        step_m = float(np.linalg.norm(message.T_odom_base.t - previous.T_odom_base.t))
        if step_m > _MAX_STEP_M:
            found.append(f"the pose moves by more than {_MAX_STEP_M:g} m in one message")
    return found


def constraint_faults(message: Constraint) -> list[str]:
    """Return what is wrong with a measurement on a pose."""
    found = _covariance_faults(message.covariance, may_be_open=True)
    if message.kind in ("position", "absolute"):
        measured = np.isfinite(np.diagonal(message.covariance))
        wanted = measured[3:] if message.kind == "position" else measured
        if not wanted.any():
            found.append(f"a {message.kind} whose covariance says that nothing was measured")
    if message.kind in ("landmark", "plane") and message.landmark is None:
        found.append(f"a {message.kind} without `landmark`, which tells measurements of one thing")
    if message.payload:
        try:
            json.loads(message.payload)
        except ValueError as error:
            found.append(f"its payload is no JSON: {error}")
    return found


def loop_faults(message: LoopClosure) -> list[str]:
    """Return what is wrong with a loop closure."""
    found = _covariance_faults(message.covariance, may_be_open=False)
    if np.isnan(message.quality):
        found.append("its quality is nan")
    if min(message.stamp_a_ns, message.stamp_b_ns) <= 0:
        found.append("a stamp is zero or below")
    if (message.robot_a, message.stamp_a_ns) == (message.robot_b, message.stamp_b_ns):
        found.append("both its ends are one instant")
    return found


def _covariance_faults(covariance: FloatArray, *, may_be_open: bool) -> list[str]:
    """Say what keeps a matrix (6, 6) from being a covariance; infinite variances are open directions."""
    variances = np.diagonal(covariance)
    is_open = np.isposinf(variances)
    if is_open.any() and not may_be_open:
        return ["its covariance is infinite, but a loop measures all six directions"]
    closed = covariance[np.ix_(~is_open, ~is_open)]
    if not np.isfinite(closed).all():
        return [
            "its covariance is not finite; infinity belongs on the diagonal, where nothing was measured"
        ]
    if not np.allclose(
        closed, closed.T, rtol=_SYMMETRY, atol=_SYMMETRY * np.abs(closed).max(initial=0)
    ):
        return ["its covariance is not symmetric"]
    if closed.size and not np.linalg.eigvalsh(closed)[0] > 0:
        return ["its covariance is not positive definite; zeros would mean exact knowledge"]
    return []
