"""A JSON schema of graph files, with the ports and options of every operator that is installed.

An editor with a YAML language server completes and checks with it:

    # yaml-language-server: $schema=mapstream.schema.json
"""

from __future__ import annotations

from typing import Any

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.spec import SUBGRAPH, GraphSpec
from mapstream.operators.operator import DynamicPorts
from mapstream.operators.signature import Signature, signature_of
from mapstream.streams.errors import ConfigError

Schema = dict[str, Any]
_PARAM: Schema = {"type": "string", "pattern": r"^\$[A-Za-z{]", "description": "a parameter"}


def graph_schema(catalogue: Catalogue | None = None) -> Schema:
    """Return the JSON schema (draft 2020-12); operators that cannot be imported have no options in it."""
    catalogue = catalogue or Catalogue()
    schema = GraphSpec.model_json_schema(by_alias=True)
    definitions: Schema = schema["$defs"]
    operator = definitions["OperatorSpec"]
    operator["properties"]["use"] = {"enum": [*catalogue.names(), SUBGRAPH]}
    operator["properties"]["enabled"] = _or_param(operator["properties"]["enabled"])
    operator["allOf"] = [
        {"if": {"properties": {"use": {"const": name}}}, "then": _options(name, definitions, found)}
        for name in catalogue.names()
        if (found := _signature(catalogue, name)) is not None
    ]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _signature(catalogue: Catalogue, name: str) -> Signature | None:
    try:
        return signature_of(catalogue.get(name))
    except ConfigError:
        return None


def _options(name: str, definitions: Schema, signature: Signature) -> Schema:
    """Return what `use: name` asks of the other keys; nested models go into the definitions."""
    template = f"#/$defs/{name}.{{model}}"
    config = signature.config_type.model_json_schema(ref_template=template)
    for model, nested in config.pop("$defs", {}).items():
        definitions[f"{name}.{model}"] = _with_params(nested)
    documentation = (signature.operator_type.__doc__ or "").strip()
    properties: Schema = {"config": _with_params(config) | {"description": documentation}}
    if not issubclass(signature.operator_type, DynamicPorts):
        wires = dict.fromkeys(signature.inputs, True)
        properties["in"] = {"properties": wires, "propertyNames": {"enum": list(wires)}}
    return {"properties": properties}


def _with_params(schema: Schema) -> Schema:
    """Let `$name` stand for the value of each key."""
    changed = {key: _or_param(value) for key, value in schema.get("properties", {}).items()}
    return schema | ({"properties": changed} if changed else {})


def _or_param(schema: Schema) -> Schema:
    told: Schema = {
        key: schema[key] for key in ("default", "description", "title") if key in schema
    }
    return {**told, "anyOf": [{k: v for k, v in schema.items() if k not in told}, _PARAM]}
