"""Reading a graph file: parameters, `--set` and sub-graphs put in, every problem with file and line."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from mapstream.graph.document import Document, Positions, read_document
from mapstream.graph.overrides import apply_sets
from mapstream.graph.params import Given, fill_in
from mapstream.graph.problems import GraphError, Position, Problem, did_you_mean
from mapstream.graph.spec import PROFILES, GraphSpec, ParamSpec, ProfileSpec
from mapstream.graph.subgraphs import Part, expand
from mapstream.graph.validation import problems_of
from mapstream.streams.errors import ConfigError

_MAX_FILE_BYTES = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Graph:
    """A graph file with everything put in, and where each key was written."""

    spec: GraphSpec
    profile: ProfileSpec
    profile_name: str
    positions: Positions


def preset_names() -> list[str]:
    """Return the names of the graphs that come with mapstream and run without a file."""
    folder = resources.files("mapstream.graph") / "presets"
    return sorted(
        f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name.endswith(".yaml")
    )


def load_graph(
    graph: str | Path,
    *,
    params: Mapping[str, str] | None = None,
    sets: Sequence[str] = (),
    profile: str = "replay",
    needs_values: bool = True,
) -> Graph:
    """Read a graph file, or a preset by its name.

    Args:
        graph: A file `*.yaml`, or the name of a preset.
        params: Values of the graph's parameters, as text.
        sets: Options of single operators, `OPERATOR.KEY=VALUE`.
        profile: One of the graph's profiles, or `replay` or `live`.
        needs_values: If False, parameters without a value get a stand-in: to look, not to run.

    Raises:
        ConfigError: If there is no such graph or profile.
        GraphError: If it has problems: all that were found, each with file, line and key.
    """
    path = Path(graph).expanduser()
    given = Given(params or {}, needs_values=needs_values)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        return _graph(_text(path), path, given, sets, profile)
    names = preset_names()
    if str(graph) not in names:
        hint = did_you_mean(str(graph), names)
        raise ConfigError(f"no graph file and no preset {str(graph)!r}{hint}")
    preset = resources.files("mapstream.graph") / "presets" / f"{graph}.yaml"
    with resources.as_file(preset) as file:
        return _graph(_text(file), file, given, sets, profile)


def parse_graph(
    text: str,
    path: Path = Path("graph.yaml"),
    *,
    params: Mapping[str, str] | None = None,
    sets: Sequence[str] = (),
    profile: str = "replay",
) -> Graph:
    """Read a graph from text, as `load_graph`; `path` names it in messages and leads to its sub-graphs.

    Raises:
        GraphError: If it has problems.
    """
    return _graph(text, path, Given(params or {}), sets, profile)


def _graph(text: str, path: Path, given: Given, sets: Sequence[str], profile: str) -> Graph:
    def read_part(file: Path, values: Mapping[str, Any]) -> Part:
        document = read_document(_text(file), _shown(file))
        return _part(document, file, dataclasses.replace(given, values=values))

    document = read_document(text, _shown(path))
    part = _part(document, path.resolve(), given)
    if part.spec.inputs:
        message = "is a part of other graphs (it has inputs); use it with `use: graph`"
        raise GraphError([Problem(part.positions.of(("inputs",)), (), message)])
    spec = apply_sets(expand(part, read_part), sets, part.positions)
    return Graph(
        spec=spec,
        profile=_profile(spec, profile),
        profile_name=profile,
        positions=part.positions,
    )


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise ConfigError(f"{path}: over {_MAX_FILE_BYTES} bytes: not a graph file")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None


def _shown(path: Path) -> str:
    """Return a path as messages show it: from the working directory if it lies there."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


class _Params(BaseModel):
    """The one part of a file that must be right before the rest can be looked at."""

    model_config = ConfigDict(extra="ignore")

    params: dict[str, ParamSpec] = {}


def _part(document: Document, path: Path, given: Given) -> Part:
    """Check one file and put its parameters in."""
    data, positions = document.data, document.positions
    if not isinstance(data, dict):
        raise GraphError([Problem(Position(positions.source, 1), (), "expected keys and values")])
    try:
        params = _Params.model_validate(data).params
    except ValidationError as error:
        raise GraphError(problems_of(error, GraphSpec, (), positions)) from None
    values, problems = given.values_of(params, document)
    filled, unknown = fill_in(document, values)
    problems += unknown
    try:
        spec = GraphSpec.model_validate(filled)
    except ValidationError as error:
        told = {problem.path for problem in unknown}
        problems += [p for p in problems_of(error, GraphSpec, (), positions) if p.path not in told]
        raise GraphError(problems) from None
    if problems:
        raise GraphError(problems)
    return Part(spec, positions, path)


def _profile(spec: GraphSpec, name: str) -> ProfileSpec:
    """Return a profile; what a file's own one leaves out is as in the built-in of that name, or `replay`."""
    own = spec.profiles.get(name)
    if own is None and name not in PROFILES:
        hint = did_you_mean(name, {*spec.profiles, *PROFILES})
        raise ConfigError(f"--profile {name}: no such profile{hint}")
    base = PROFILES.get(name, PROFILES["replay"])
    if own is None:
        return base
    clock = base.clock.model_copy(
        update={key: getattr(own.clock, key) for key in own.clock.model_fields_set}
    )
    return ProfileSpec(
        clock=clock, edges=own.edges.over(base.edges), sources=own.sources.over(base.sources)
    )
