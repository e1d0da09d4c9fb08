"""Graphs inside graphs: `use: graph` becomes the operators of a file, named `outer/inner`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mapstream.graph.document import Positions
from mapstream.graph.problems import GraphError, KeyPath, Problem, did_you_mean
from mapstream.graph.spec import SUBGRAPH, GraphSpec, InputSpec, OperatorSpec

INPUTS = "inputs"  # the name by which the operators of a part know what surrounds it


@dataclass(frozen=True, slots=True)
class Part:
    """One graph file that was read, and where it lies."""

    spec: GraphSpec
    positions: Positions
    path: Path


ReadPart = Callable[[Path, Mapping[str, Any]], Part]


def expand(part: Part, read_part: ReadPart) -> GraphSpec:
    """Return the graph without sub-graphs; `part.positions` learns the places of what was inserted.

    Raises:
        GraphError: If a sub-graph contains itself, or is connected to ports that it has not.
    """
    problems: list[Problem] = []
    flat = _Level(part, read_part, (part.path,), problems).flatten()
    if problems:
        raise GraphError(problems)
    return flat


@dataclass(slots=True)
class _Level:
    """One file on the way down; `files` leads from the outermost to it."""

    part: Part
    read_part: ReadPart
    files: tuple[Path, ...]
    problems: list[Problem]
    operators: dict[str, OperatorSpec] = field(default_factory=dict)
    senders: dict[str, str] = field(default_factory=dict)  # `outer.port` -> `outer/inner.port`

    def flatten(self) -> GraphSpec:
        spec = self.part.spec
        for name, operator in spec.operators.items():
            if operator.use == SUBGRAPH:
                self._insert(name, operator)
            else:
                self.operators[name] = operator
        operators = {
            name: operator.model_copy(update={"in_": self._connected(name, operator)})
            for name, operator in self.operators.items()
        }
        outputs = {name: self.senders.get(sender, sender) for name, sender in spec.outputs.items()}
        return spec.model_copy(update={"operators": operators, "outputs": outputs})

    def _insert(self, outer: str, operator: OperatorSpec) -> None:
        inner = self._read(outer, operator)
        if inner is None:
            return
        for port in operator.in_:
            if port not in inner.spec.inputs:
                hint = did_you_mean(port, inner.spec.inputs)
                message = f"{inner.path.name} has no input {port!r}{hint}"
                self._problem(("operators", outer, "in", port), message)
        files = (*self.files, inner.path)
        flat = _Level(inner, self.read_part, files, self.problems).flatten()
        places = self.part.positions.places
        for rest, place in inner.positions.below(("operators",)):
            if rest:
                places["operators", f"{outer}/{rest[0]}", *rest[1:]] = place
        self.senders |= {f"{outer}.{name}": f"{outer}/{s}" for name, s in flat.outputs.items()}
        for name, inside in flat.operators.items():
            wires = _renamed(outer, operator, inside)
            enabled = operator.enabled and inside.enabled
            changed = inside.model_copy(update={"in_": wires, "enabled": enabled})
            self.operators[f"{outer}/{name}"] = changed

    def _read(self, outer: str, operator: OperatorSpec) -> Part | None:
        """Return the part to insert; None after noting why there is none."""
        path = ("operators", outer, "file")
        file = (self.part.path.parent / (operator.file or "")).resolve()
        if file in self.files:
            chain = " -> ".join(f.name for f in (*self.files[self.files.index(file) :], file))
            self._problem(path, f"a graph may not contain itself: {chain}")
        elif not file.is_file():
            self._problem(path, f"there is no file {str(operator.file)!r}")
        else:
            return self.read_part(file, operator.with_)
        return None

    def _connected(self, name: str, operator: OperatorSpec) -> dict[str, InputSpec]:
        """Return an operator's inputs with the outputs of sub-graphs replaced by those inside."""
        connected = {}
        for port, wire in operator.in_.items():
            outer, _, output = wire.from_.partition(".")
            declared = self.part.spec.operators.get(outer)
            is_subgraph = declared is not None and declared.use == SUBGRAPH
            if is_subgraph and wire.from_ not in self.senders:
                known = [s.partition(".")[2] for s in self.senders if s.startswith(f"{outer}.")]
                hint = did_you_mean(output, known)
                message = f"the graph {outer!r} has no output {output!r}{hint}"
                self._problem(("operators", name, "in", port), message)
            sender = self.senders.get(wire.from_, wire.from_)
            connected[port] = wire.model_copy(update={"from_": sender})
        return connected

    def _problem(self, path: KeyPath, message: str) -> None:
        self.problems.append(Problem(self.part.positions.of(path), path, message))


def _renamed(outer: str, operator: OperatorSpec, inside: OperatorSpec) -> dict[str, InputSpec]:
    """Return the inputs of an operator of a part as the surrounding graph names them."""
    wires = {}
    for port, wire in inside.in_.items():
        sender, _, name = wire.from_.partition(".")
        if sender != INPUTS:
            wires[port] = wire.model_copy(update={"from_": f"{outer}/{wire.from_}"})
        elif name in operator.in_:  # else nothing was connected, which planning judges
            given = operator.in_[name]
            limits = wire.over(given).model_dump()
            feedback = wire.feedback or given.feedback
            wires[port] = given.model_copy(update={**limits, "feedback": feedback})
    return wires
