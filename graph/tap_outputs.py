"""Which outputs of a run are drawn, and which of them moves the robot."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from mapstream.graph.plan import Edge, Plan
from mapstream.streams.messages.estimates import Keyframe, Odometry, Submap
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage, WheelOdometry


@dataclass(frozen=True, slots=True)
class Output:
    """One output that is drawn; `edge` is the one of its edges that the tap listens to."""

    edge: Edge
    message_type: Any  # `Any` where only the run will tell

    @property
    def path(self) -> str:
        """The entity that its drawings lie in."""
        return f"{self.edge.from_node}/{self.edge.from_port}"

    def sends(self, *types: type) -> bool:
        return isinstance(self.message_type, type) and issubclass(self.message_type, types)


def drawn_outputs(plan: Plan) -> list[Output]:
    """Return the outputs that `log.rerun` names, each once.

    Where a picture is drawn as it was recorded, it is not drawn again after decoding.
    """
    rules = plan.log.rerun
    outputs: dict[str, Output] = {}
    for edge in plan.edges:
        name = f"{edge.from_node}.{edge.from_port}"
        is_asked = any(fnmatchcase(name, pattern) for pattern in rules.edges)
        if is_asked and not any(fnmatchcase(name, pattern) for pattern in rules.except_):
            outputs.setdefault(name, Output(edge, _type_of(plan, edge)))
    found = list(outputs.values())
    return [output for output in found if not _is_drawn_before(plan, output, found)]


def main_odometry(plan: Plan, outputs: list[Output]) -> Output | None:
    """Return the output that the map is built from, else the first that tells motion."""
    builders = {o.edge.from_node for o in outputs if o.sends(Keyframe, Submap)}
    candidates = [o for o in outputs if o.sends(Odometry)]
    candidates += [o for o in outputs if o.sends(WheelOdometry)]
    for output in candidates:
        source = output.edge.from_node, output.edge.from_port
        readers = {e.to_node for e in plan.edges if (e.from_node, e.from_port) == source}
        if readers & builders:
            return output
    return candidates[0] if candidates else None


def _type_of(plan: Plan, edge: Edge) -> Any:  # noqa: ANN401  # a type, or `Any`
    port = plan.nodes[edge.from_node].signature.outputs.get(edge.from_port)
    known = port.message_type if port is not None else Any
    return known if isinstance(known, type) else edge.message_type


def _is_drawn_before(plan: Plan, output: Output, outputs: list[Output]) -> bool:
    if not output.sends(CameraFrame):
        return False
    sources = {(e.from_node, e.from_port) for e in plan.edges if e.to_node == output.edge.from_node}
    recorded = {(o.edge.from_node, o.edge.from_port) for o in outputs if o.sends(EncodedImage)}
    return bool(sources & recorded)
