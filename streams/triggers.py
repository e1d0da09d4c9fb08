"""When to act: always, at most so often, or after so much motion.

Source: OmniMapper (Trevor et al., ICRA 2014), where each measurement plugin asks such a functor.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from mapstream.streams.geometry import SE3


class Trigger(ABC):
    """Asked for each pose in the order of stamps; remembers when it fired."""

    def fires(self, stamp_ns: int, T_reference_body: SE3) -> bool:
        """Return whether to act at this pose; from there on it counts anew."""
        is_due = self.is_due(stamp_ns, T_reference_body)
        if is_due:
            self.restart(stamp_ns, T_reference_body)
        return is_due

    @abstractmethod
    def is_due(self, stamp_ns: int, T_reference_body: SE3) -> bool:
        """Return whether enough happened up to this pose."""

    @abstractmethod
    def restart(self, stamp_ns: int, T_reference_body: SE3) -> None:
        """Count from this pose on."""


class Always(Trigger):
    """Fires every time."""

    def is_due(self, stamp_ns: int, T_reference_body: SE3) -> bool:  # noqa: ARG002  # as declared
        return True

    def restart(self, stamp_ns: int, T_reference_body: SE3) -> None:
        """Remember nothing."""


class Periodic(Trigger):
    """Fires at the first pose, and then not before a period has passed."""

    def __init__(self, period_ns: int) -> None:
        if period_ns <= 0:
            raise ValueError(f"a period is positive, not {period_ns} ns")
        self._period_ns = period_ns
        self._fired_ns: int | None = None

    def is_due(self, stamp_ns: int, T_reference_body: SE3) -> bool:  # noqa: ARG002  # as declared
        return self._fired_ns is None or stamp_ns - self._fired_ns >= self._period_ns

    def restart(self, stamp_ns: int, T_reference_body: SE3) -> None:  # noqa: ARG002  # as declared
        self._fired_ns = stamp_ns


class OnMotion(Trigger):
    """Fires at the first pose, and then when the body has moved or turned far enough since."""

    def __init__(self, distance_m: float, angle_rad: float) -> None:
        if not (distance_m > 0 and angle_rad > 0):
            raise ValueError(f"motion is positive, not {distance_m} m and {angle_rad} rad")
        self._distance_m = distance_m
        self._angle_rad = angle_rad
        self._T_reference_fired: SE3 | None = None

    def is_due(self, stamp_ns: int, T_reference_body: SE3) -> bool:  # noqa: ARG002  # as declared
        if self._T_reference_fired is None:
            return True
        step = self._T_reference_fired.inverse() @ T_reference_body
        is_far = float(step.t @ step.t) >= self._distance_m**2
        return is_far or step.angle_rad >= self._angle_rad

    def restart(self, stamp_ns: int, T_reference_body: SE3) -> None:  # noqa: ARG002  # as declared
        self._T_reference_fired = T_reference_body


class AnyOf(Trigger):
    """Fires when one of several triggers does, and all of them count from there on."""

    def __init__(self, triggers: Sequence[Trigger]) -> None:
        self._triggers = tuple(triggers)

    def is_due(self, stamp_ns: int, T_reference_body: SE3) -> bool:
        return any(trigger.is_due(stamp_ns, T_reference_body) for trigger in self._triggers)

    def restart(self, stamp_ns: int, T_reference_body: SE3) -> None:
        for trigger in self._triggers:
            trigger.restart(stamp_ns, T_reference_body)
