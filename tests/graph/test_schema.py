"""The JSON schema of graph files knows the operators that are installed, with their options."""

from __future__ import annotations

import json
from typing import Any

import pytest

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.schema import graph_schema
from tests.graph.stages import STAGES


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    return graph_schema(Catalogue(STAGES))


def options_of(schema: dict[str, Any], use: str) -> dict[str, Any]:
    rules = schema["$defs"]["OperatorSpec"]["allOf"]
    found = [r["then"] for r in rules if r["if"]["properties"]["use"]["const"] == use]
    assert len(found) == 1
    properties: dict[str, Any] = found[0]["properties"]
    return properties


def test_is_json(schema: dict[str, Any]) -> None:
    assert json.loads(json.dumps(schema)) == schema


def test_use_is_one_of_the_operators(schema: dict[str, Any]) -> None:
    names = schema["$defs"]["OperatorSpec"]["properties"]["use"]["enum"]

    assert {"count", "double", "kiss_odometry", "graph"} <= set(names)


def test_unknown_keys_are_refused_everywhere(schema: dict[str, Any]) -> None:
    assert schema["additionalProperties"] is False
    assert options_of(schema, "count")["config"]["additionalProperties"] is False


def test_options_have_defaults_and_take_parameters(schema: dict[str, Any]) -> None:
    limit = options_of(schema, "count")["config"]["properties"]["limit"]

    assert limit["default"] == 3
    assert {"exclusiveMinimum": 0, "type": "integer"} in limit["anyOf"]
    assert any(way.get("pattern", "").startswith(r"^\$") for way in limit["anyOf"])


def test_inputs_are_those_of_the_operator(schema: dict[str, Any]) -> None:
    assert options_of(schema, "double")["in"]["propertyNames"] == {"enum": ["numbers", "hints"]}


def test_short_forms_are_allowed(schema: dict[str, Any]) -> None:
    (wires,) = schema["$defs"]["OperatorSpec"]["properties"]["in"]["patternProperties"].values()
    run = schema["$defs"]["OperatorSpec"]["properties"]["run"]

    assert {"type": "string"} in wires["anyOf"]
    assert {"enum": ["inline", "thread", "process"], "type": "string"} in run["anyOf"]


def test_references_lead_somewhere(schema: dict[str, Any]) -> None:
    def references(part: object) -> set[str]:
        if isinstance(part, dict):
            own = {part["$ref"]} if isinstance(part.get("$ref"), str) else set()
            return own.union(*map(references, part.values()))
        if isinstance(part, list):
            return set().union(*map(references, part))
        return set()

    assert {r.removeprefix("#/$defs/") for r in references(schema)} <= set(schema["$defs"])
