"""Verbs that set by hand what edges are worth and where missions and vertices are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.map.choosing import MissionArgument, MissionOption, pose_of
from mapstream.graph.cli.options import ConfigT, KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json
from mapstream.operators.maps import anchor as anchors
from mapstream.operators.maps import edit as tools
from mapstream.operators.maps.missions import find_mission
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.history import change_map
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import ConfigError

edit = typer.Typer(help="Edit the pose graph by hand.", no_args_is_help=True, rich_markup_mode=None)
KindOption = Annotated[str | None, typer.Option(help="Edges of this kind.")]
SourceOption = Annotated[str | None, typer.Option(help="Edges of this source.")]
EdgeList = Annotated[
    list[int] | None, typer.Option("--edge", help="The edge of this number; may be repeated.")
]


def _add_verb(
    name: str,
    config_type: type[ConfigT],
    tool: Callable[[Map, IntArray, ConfigT], Map],
    meaning: str,
) -> None:
    """Make the verb that sets something on chosen edges."""

    @edit.command(name, help=meaning)
    def command(  # noqa: PLR0913  # one for each option of the command
        context: typer.Context,
        *,
        kind: KindOption = None,
        source: SourceOption = None,
        mission: MissionOption = None,
        edge: EdgeList = None,
        set_: KeySetList = None,
        json: JsonFlag = False,
    ) -> None:
        config = config_from(config_type, set_)
        _edit_edges(
            context.obj,
            f"edit {name}",
            {"kind": kind, "source": source, "mission": mission, "edge": edge},
            config.model_dump(exclude_defaults=True),
            lambda map_, rows: tool(map_, rows, config),
            json=json,
        )


_add_verb(
    "uncertainty",
    tools.Uncertainty,
    tools.set_uncertainty,
    "Set how uncertain edges are: rotation_sigma_rad, translation_sigma_m, factor.",
)
_add_verb(
    "switch",
    tools.Switch,
    tools.set_switch,
    "Set switches of edges: value (0 false, 1 true), variance, is_switchable.",
)


def _edit_edges(
    folder: Path,
    operation: str,
    chosen: dict[str, object],
    settings: dict[str, object],
    tool: Callable[[Map, IntArray], Map],
    *,
    json: bool,
) -> None:
    """Let a tool edit the chosen edges of the map in a folder, and tell how many they were."""
    if not settings:
        raise ConfigError(f"{operation}: nothing to set; give --set KEY=VALUE")

    def edited(map_: Map) -> tuple[Map, int]:
        mission, rows = chosen["mission"], chosen["edge"]
        edges = tools.Chosen.model_validate(
            {
                "kind": chosen["kind"],
                "source": chosen["source"],
                "mission_row": None if mission is None else find_mission(map_, str(mission)),
                "rows": rows,
            }
        )
        found = tools.chosen_edges(map_, edges)
        return tool(map_, found), len(found)

    num_edges = change_map(folder, operation, edited, **chosen, **settings)
    if json:
        say_json({"path": folder, "num_edges": num_edges})
    else:
        say(f"{in_place(folder)}: {num_edges} edges edited")


@edit.command()
def disturb(
    context: typer.Context,
    *,
    mission: MissionOption = None,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Move vertices by seeded noise: rotation_sigma_rad, translation_sigma_m, seed."""
    folder: Path = context.obj
    config = config_from(tools.Disturbance, set_)

    def disturbed(map_: Map) -> tuple[Map, int]:
        row = None if mission is None else find_mission(map_, mission)
        num = len(map_.vertices) if row is None else len(map_.vertices_of(row))
        return tools.disturb(map_, config, row), num

    num_vertices = change_map(
        folder, "edit disturb", disturbed, mission=mission, **config.model_dump()
    )
    if json:
        say_json({"path": folder, "num_vertices": num_vertices})
    else:
        say(f"{in_place(folder)}: {num_vertices} vertices moved, but the first of each mission")


def anchor(
    context: typer.Context,
    mission: MissionArgument,
    *,
    at: Annotated[
        str | None,
        typer.Option(help="T_map_mission: x,y,z or x,y,z,qx,qy,qz,qw; its guess without."),
    ] = None,
    unknown: Annotated[bool, typer.Option("--unknown", help="Only a guess from now on.")] = False,
    json: JsonFlag = False,
) -> None:
    """Say that the place of a mission is known, and where; or that it is only a guess."""
    folder: Path = context.obj
    if unknown and at is not None:
        raise ConfigError("anchor: --at says where it is, --unknown that nobody knows; give one")
    T_map_mission = None if at is None else pose_of(at)

    def anchored(map_: Map) -> tuple[Map, str]:
        row = find_mission(map_, mission)
        changed = (
            anchors.release(map_, row) if unknown else anchors.anchor(map_, row, T_map_mission)
        )
        return changed, map_.mission_id(row)

    mission_id = change_map(
        folder, "anchor", anchored, mission=mission, at=at, is_known=not unknown
    )
    if json:
        say_json({"path": folder, "mission_id": mission_id, "is_known": not unknown})
    else:
        state = "only a guess" if unknown else "known"
        say(f"{in_place(folder)}: the place of mission {mission_id} is {state}")
