"""What sensors see while odometry says where the robot is, measured in the order of stamps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar

from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapstream.operators.feedback import Feedback
from mapstream.operators.operator import OperatorConfig, Ports, offload, report_loss
from mapstream.operators.period import Period
from mapstream.operators.planes.whereabouts import Whereabouts
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Sender
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.estimates import MapCorrection, Odometry
from mapstream.streams.messages.sensors import Message
from mapstream.streams.sync import merge

SeenT = TypeVar("SeenT", bound=Message)


class AlongOdometryOptions(OperatorConfig):
    """Inputs beside `odometry`, and which of their messages count."""

    inputs: tuple[str, ...] = ()
    """Names of the inputs that get what is seen, one for each sensor."""
    feedback_s: PositiveFloat | None = Field(
        default=None,
        description="with it there is an input `corrections`; each counts so long after its stamp, so that a "
        "replay gives the same landmarks. It is longer than the submaps of the trajectory, which makes poses "
        "all the time (period_s)",
    )
    period_s: NonNegativeFloat = 0.0
    """Of each sensor one message in so long is used; 0: all are."""

    def ports(self, seen: type[Any]) -> dict[str, Any]:
        """Return the inputs with the types of their messages."""
        ports: dict[str, Any] = dict.fromkeys(self.inputs, seen)
        ports["odometry"] = Odometry
        if self.feedback_s is not None:
            ports["corrections"] = MapCorrection
        return ports


class Known(Protocol):
    """What a robot knows around it."""

    def move(self, T_frame_base_at: Callable[[int], FloatArray]) -> None:
        """Follow the robot's poses (4, 4) at stamps, as they are known now."""


class AlongOdometry(Generic[SeenT]):
    """Measures what was seen between two messages of odometry; what is known follows the optimizer's corrections.

    Args:
        options: See there.
        known: What the measurements are of.
        measure: From what was seen, T_mission_base (4, 4) and the way so far [m] to measurements.
        lost_m: Way that counts for a step without odometry.
        what: It is, for people: planes.
    """

    def __init__(
        self,
        options: AlongOdometryOptions,
        known: Known,
        measure: Callable[[SeenT, FloatArray, float], list[Constraint]],
        *,
        lost_m: float,
        what: str,
    ) -> None:
        self._options, self._known, self._measure = options, known, measure
        self._late = f"{what} seen before or after all odometry"
        self._where = Whereabouts(lost_m=lost_m)
        self._periods = [Period(options.period_s) for _ in options.inputs]
        self._waiting: list[SeenT] = []  # for the odometry of their time
        self._feedback = Feedback(options.feedback_s) if options.feedback_s else None

    async def run(self, inputs: Ports, constraints: Sender[Constraint]) -> None:
        """Send measurements until the inputs end."""
        sensors = [inputs[name] for name in self._options.inputs]
        async for port, message in merge(*sensors, inputs["odometry"]):
            if not isinstance(message, Odometry):
                if self._periods[port].begins(message.stamp_ns):
                    self._waiting.append(message)
                continue
            if self._feedback is not None:
                corrections = inputs["corrections"]
                for correction in await self._feedback.counting(corrections, message.stamp_ns):
                    self._where.correct(correction)
                    self._known.move(self._where.at)
            for constraint in await offload(self._follow, message):
                await constraints.send(constraint)
            constraints.advance(message.stamp_ns)
        for _ in self._waiting:
            report_loss(self._late)

    def _follow(self, odometry: Odometry) -> list[Constraint]:
        """Return the measurements up to a message of odometry."""
        self._where.follow(odometry)
        waiting, self._waiting = self._waiting, []
        made: list[Constraint] = []
        for seen in waiting:
            T_mission_base = self._where.note(seen.stamp_ns)
            if T_mission_base is None:
                report_loss(self._late)
            else:
                made += self._measure(seen, T_mission_base, self._where.path_m)
        return made
