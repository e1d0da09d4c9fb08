"""Map tools in a graph, by name and with their options."""

from __future__ import annotations

import json

import pytest
from pydantic import ValidationError

from mapstream.operators.maps.steps import TOOLS, MapStep, MapSteps, MapStepsConfig, prepared
from mapstream.operators.testing import run_operator
from mapstream.streams.errors import MapError
from tests.recordings.made_maps import line_map

pytestmark = pytest.mark.anyio


async def test_L6_steps_are_done_in_order_and_the_journal_tells_them() -> None:
    steps = [
        {"tool": "fix_stationary", "config": {"max_distance_m": 50.0, "max_angle_rad": 3.0}},
        {"tool": "optimize", "config": {"max_iterations": 5}},
    ]
    config = MapStepsConfig.model_validate({"steps": steps})

    [made] = (await run_operator(MapSteps(config), maps=[line_map(6)]))["maps"]

    assert made.journal.operation.tolist() == ["fix_stationary", "optimize"]
    assert json.loads(made.journal.parameters[1]) == {"max_iterations": 5}
    assert "stationary" in made.edges.source.tolist()


@pytest.mark.parametrize("tool", TOOLS)
def test_every_tool_is_there_and_takes_a_map(tool: str) -> None:
    """A summary needs landmarks, and says so."""
    made = prepared(MapStep(tool=tool))
    if tool == "summarize":
        with pytest.raises(MapError, match="no landmark has a descriptor"):
            made(line_map(3))
        return
    map_, _ = made(line_map(3))

    assert len(map_.vertices) == 3


def test_a_wrong_step_is_refused_where_it_stands() -> None:
    with pytest.raises(ValidationError, match="no map tool 'optimise'; there are"):
        MapStep(tool="optimise")
    with pytest.raises(ValidationError, match="optimize: max_iteration: Extra inputs"):
        MapStep(tool="optimize", config={"max_iteration": 3})
    with pytest.raises(ValidationError, match="reset_quality: all: Extra inputs"):
        MapStep(tool="reset_quality", config={"all": True})
