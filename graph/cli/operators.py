"""`mapstream operators`: which operators there are, and what one of them wants."""

from __future__ import annotations

import inspect
import re
from typing import Annotated, Any

import typer
from pydantic import BaseModel

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.cli.output import JsonFlag, say, say_json, say_table
from mapstream.graph.document import describe as as_yaml
from mapstream.graph.wiring import type_name
from mapstream.operators.operator import DynamicPorts
from mapstream.operators.signature import signature_of
from mapstream.streams.errors import ConfigError


def operators(
    name: Annotated[str | None, typer.Argument(help="One operator, to be told in full.")] = None,
    *,
    json: JsonFlag = False,
) -> None:
    """List the operators that graphs can use, or tell all about one: ports, options, documentation."""
    catalogue = Catalogue()
    if name is None:
        _list(catalogue, json=json)
        return
    found = describe(catalogue, name)
    if json:
        say_json(found)
        return
    say(f"{name}  ({found['package']}, runs {found['placement']})")
    say(found["documentation"])
    for ends in ("inputs", "outputs"):
        if found[ends]:
            say(f"\n{ends}")
            say_table(
                ("port", "message", ""), [(p["name"], p["type"], p["note"]) for p in found[ends]]
            )
    if found["options"]:
        say("\nconfig")
        columns = ("name", "type", "default", "meaning")
        say_table(columns, [[option[c] for c in columns] for option in found["options"]])


def _list(catalogue: Catalogue, *, json: bool) -> None:

    rows = []
    for name in catalogue.names():
        try:
            kind = catalogue.get(name)
        except ConfigError as error:  # a broken plugin must not hide the others
            rows.append((name, "-", catalogue.origin(name), str(error)))
        else:
            summary = (kind.__doc__ or "").strip().partition("\n")[0]
            rows.append((name, kind.placement, catalogue.origin(name), summary))
    columns = ("name", "placement", "package", "summary")
    if json:
        say_json([dict(zip(columns, row, strict=True)) for row in rows])
    else:
        say_table(columns, rows)


def describe(catalogue: Catalogue, name: str) -> dict[str, Any]:
    """Return all that a graph's author wants to know of an operator."""
    kind = catalogue.get(name)
    signature = signature_of(kind)
    dynamic = issubclass(kind, DynamicPorts)
    return {
        "name": name,
        "package": catalogue.origin(name),
        "placement": kind.placement,
        "documentation": inspect.cleandoc(kind.__doc__ or ""),
        "has_ports_by_config": dynamic,
        "inputs": [
            {"name": p.name, "type": type_name(p.message_type), "note": "optional" * p.is_optional}
            for p in signature.inputs.values()
        ],
        "outputs": [
            {"name": p.name, "type": type_name(p.message_type), "note": ""}
            for p in signature.outputs.values()
        ],
        "options": [
            {
                "name": field.alias or key,
                "type": _annotation(field.annotation),
                "meaning": field.description or "",
                "default": "required"
                if field.is_required()
                else _shown(field.get_default(call_default_factory=True)),
            }
            for key, field in signature.config_type.model_fields.items()
        ],
    }


def _annotation(annotation: object) -> str:
    """Return a type without modules and limits: `float`, `tuple[str, ...]`."""
    name = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    return re.sub(r"Annotated\[([^,\[\]]+), [^\[\]]*\]", r"\1", re.sub(r"\w+\.(?=\w)", "", name))


def _shown(default: object) -> str:

    return as_yaml(default.model_dump(mode="json") if isinstance(default, BaseModel) else default)
