"""When to act: always, at most so often, or after so much motion.

Source: OmniMapper (Trevor et al., ICRA 2014), where each measurement plugin asks such a functor.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from mapstream.streams.geometry import SE3


class Trigger(ABC):
    """Asked for each pose in the order of stamps; remembers when it fired."""

    @abstractmethod
    def fires(self, stamp_ns: int, T_reference_body: SE3) -> bool:
        """Return whether to act at this pose."""


class Always(Trigger):
    """Fires every time."""

    def fires(self, stamp_ns: int, T_reference_body: SE3) -> bool:  # noqa: ARG002  # as declared
        return True


class Periodic(Trigger):
    """Fires at the first pose, and then not before a period has passed."""

    def __init__(self, period_ns: int) -> None:
        if period_ns <= 0:
            raise ValueError(f"a period is positive, not {period_ns} ns")
        self._period_ns = period_ns
        self._fired_ns: int | None = None

    def fires(self, stamp_ns: int, T_reference_body: SE3) -> bool:  # noqa: ARG002  # as declared
        if self._fired_ns is not None and stamp_ns - self._fired_ns < self._period_ns:
            return False
        self._fired_ns = stamp_ns
        return True


class OnMotion(Trigger):
    """Fires at the first pose, and then when the body has moved or turned far enough since."""

    def __init__(self, distance_m: float, angle_rad: float) -> None:
        if not (distance_m > 0 and angle_rad > 0):
            raise ValueError(f"motion is positive, not {distance_m} m and {angle_rad} rad")
        self._distance_m = distance_m
        self._angle_rad = angle_rad
        self._T_reference_fired: SE3 | None = None

    def fires(self, stamp_ns: int, T_reference_body: SE3) -> bool:  # noqa: ARG002  # as declared
        if self._T_reference_fired is not None:
            step = self._T_reference_fired.inverse() @ T_reference_body
            is_far = float(step.t @ step.t) >= self._distance_m**2
            if not is_far and step.angle_rad < self._angle_rad:
                return False
        self._T_reference_fired = T_reference_body
        return True
