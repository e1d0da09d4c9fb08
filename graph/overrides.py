"""`--set odometry.voxel_size_m=0.5`: single options of a graph changed from the command line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from mapstream.graph.document import Positions, read_scalar
from mapstream.graph.problems import GraphError, KeyPath, Position, Problem, did_you_mean
from mapstream.graph.spec import GraphSpec, OperatorSpec
from mapstream.graph.validation import problems_of

_OWN_KEYS = {"run", "enabled", "in"}  # of the operator itself; all others belong to its config


def apply_sets(spec: GraphSpec, sets: Sequence[str], positions: Positions) -> GraphSpec:
    """Return the graph with options `OPERATOR.KEY[.KEY ...]=VALUE` set; values are typed as in YAML.

    KEY is a key of the operator's config, or `run`, `enabled` or `in`.

    Raises:
        GraphError: If an option is not written so, or names an operator that is not there.
    """
    operators = dict(spec.operators)
    problems: list[Problem] = []
    for text in sets:
        place = Position(f"--set {text}")
        target, equals, value_text = text.partition("=")
        name, *keys = target.split(".")
        if not equals or not keys or not all(keys):
            problems.append(Problem(place, (), "expected OPERATOR.KEY=VALUE"))
        elif name not in operators:
            hint = did_you_mean(name, operators)
            problems.append(Problem(place, (), f"no operator {name!r}{hint}"))
        else:
            path: KeyPath = tuple(keys if keys[0] in _OWN_KEYS else ["config", *keys])
            positions.places["operators", name, *path] = place
            try:
                raw = operators[name].model_dump(by_alias=True, exclude_unset=True)
                _put(raw, path, read_scalar(value_text))
                operators[name] = OperatorSpec.model_validate(raw)
            except ValidationError as error:
                problems += problems_of(error, OperatorSpec, ("operators", name), positions)
            except ValueError as error:
                problems.append(Problem(place, (), str(error)))
    if problems:
        raise GraphError(problems)
    return spec.model_copy(update={"operators": operators})


def _put(data: dict[str, Any], path: KeyPath, value: object) -> None:
    """Set one value inside of maps and lists; maps on the way are made.

    Raises:
        ValueError: If the path leads through something that holds no such key.
    """
    inside: Any = data
    for i, key in enumerate(path):
        is_last = i == len(path) - 1
        if isinstance(inside, list):
            if not str(key).isdigit() or int(key) >= len(inside):
                raise ValueError(f"the list has entries 0 to {len(inside) - 1}, not {key!r}")
            key = int(key)  # noqa: PLW2901  # a list is asked by number
        elif not isinstance(inside, dict):
            raise ValueError(f"{'.'.join(map(str, path[:i]))} holds no keys, so no {key!r}")  # noqa: TRY004  # a wrong option, not a wrong type
        if is_last:
            inside[key] = value
        elif isinstance(inside, dict):
            inside = inside.setdefault(key, {})
        else:
            inside = inside[int(key)]
