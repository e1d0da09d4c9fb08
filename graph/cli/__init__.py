"""The command line: `mapstream VERB`, one module per verb.

Only the module of the verb that is asked for is imported, so that help and mistakes answer at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import typer

from mapstream.graph.cli.output import ExitCode, complain

_TRACEBACK = "MAPSTREAM_TRACEBACK"  # the environment variable
VERBS = {  # verb -> function or group of commands, and what a list of verbs says of it
    "run": ("run:run", "Run a graph on a recording, or on live sensors."),
    "demo": ("demo:demo", "Map a drive that every machine has, and say how good the map is."),
    "check": ("check:check", "Find all mistakes of a graph without running it."),
    "graph": ("show:graph", "Draw a graph."),
    "operators": ("operators:operators", "List the operators, or tell all about one."),
    "schema": ("schema:schema", "Write a JSON schema of graph files for the editor."),
    "init": ("init:init", "Propose a graph for a recording."),
    "info": ("info:info", "Tell what is in a recording or a map."),
    "doctor": ("doctor:doctor", "Tell what is wrong with a recording."),
    "convert": ("convert:convert", "Convert data sets and bags to MCAP."),
    "simulate": ("simulate:simulate", "Make a synthetic recording with its truth inside."),
    "map": ("map:app", "Import, export, check, edit, merge or optimise a map."),
    "batch": ("batch:batch", "Run map commands from a file, one after another."),
    "eval": ("evaluate:evaluate", "Compare a trajectory or map with a reference."),
    "compare": ("compare:compare", "Compare graphs, or choices in one, on a recording."),
    "models": ("models:app", "List and install trained networks."),
    "localize": ("localize:localize", "Find a robot in a map that was made before."),
    "check-plugin": ("plugins:check_plugin", "Check the operators of another package."),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb and leave: 0 complete, 1 failed, 2 bad graph or arguments, 3 finished with loss."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        command_line(words)(args=words, prog_name="mapstream")
    except Exception as error:
        if os.environ.get(_TRACEBACK):
            raise
        raise SystemExit(_explain(error)) from error


def _explain(error: Exception) -> ExitCode:
    """Say what went wrong, and return how to leave."""
    from mapstream.streams.errors import ConfigError, MappingError  # noqa: PLC0415  # brings numpy

    if isinstance(error, BrokenPipeError):  # `mapstream info x | head`
        return ExitCode.FAILED
    if isinstance(error, MappingError):
        complain(str(error))
        return ExitCode.UNUSABLE if isinstance(error, ConfigError) else ExitCode.FAILED
    complain(f"mapstream has a mistake of its own: {type(error).__name__}: {error}")
    complain(f"{_TRACEBACK}=1 shows where; please report it with what you did")
    return ExitCode.FAILED


def command_line(words: Sequence[str]) -> typer.Typer:
    """Return the command line for these arguments: all verbs by name, the one that they ask for loaded."""
    app = typer.Typer(
        name="mapstream",
        help="Sensor streams to maps: an asynchronous graph of typed operators, composed in YAML.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_no_options)
    wanted = next((word for word in words if not word.startswith("-")), None)
    for verb, (target, summary) in VERBS.items():
        found = _load(target) if verb == wanted else _no_options
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=verb)
        else:
            app.command(verb, short_help=summary)(found)
    return app


def _load(target: str) -> Any:  # noqa: ANN401  # a function, or a group of commands
    module, _, name = target.partition(":")
    return getattr(import_module(f"mapstream.graph.cli.{module}"), name)


def _no_options() -> None:
    """Stand for a verb that is only listed."""
