"""`mapstream schema`: a JSON schema of graph files for the editor."""

from __future__ import annotations

from mapstream.graph.cli.output import say_json
from mapstream.graph.schema import graph_schema


def schema() -> None:
    """Write a JSON schema of graph files, with all installed operators, for the editor.

    Save it with `mapstream schema > mapstream.schema.json`, and start a graph file with
    `# yaml-language-server: $schema=mapstream.schema.json`.
    """
    say_json(graph_schema())
