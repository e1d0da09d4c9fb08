"""The page of the estimation problem: its snippet works, and it names every kind."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from mapstream.operators.estimation import kinds
from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.estimation.fixing import Fixable
from mapstream.operators.estimation.keys import Variable
from mapstream.operators.estimation.kinds import make_factors, makers, register
from mapstream.operators.estimation.noise import NoiseModels
from mapstream.operators.estimation.states import initial_values
from tests.operators.estimation.problems import (
    cov,
    jacobian_error,
    wander,
    with_edge,
    with_mission,
    with_relative,
)

PAGE = (Path(__file__).parents[3] / "docs" / "estimation.md").read_text()


def test_the_page_names_all_kinds_variables_and_what_can_be_fixed() -> None:
    named = set(re.findall(r"`(\w+)`", PAGE))

    assert set(makers()) <= named
    assert set(get_args(Fixable)) <= named
    assert all(f"| {variable} |" in PAGE for variable in get_args(Variable))


def test_F18_the_kind_on_the_page_is_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    (snippet,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    monkeypatch.setattr(kinds, "_registered", {})  # for this test alone
    made: dict[str, object] = {}
    exec(snippet, made)  # noqa: S102  # the page's own words
    register("height_of_the_page", made["heights"])  # type: ignore[arg-type]  # a function of the page
    map_ = with_mission(wander(2, np.random.default_rng(1)))
    flat = np.diag([1e-4] * 5 + [np.inf])
    map_ = with_relative(map_, [(0, 1)], np.tile(np.eye(4), (2, 1, 1)), flat, kind="wheel")
    ends = {"covariance": cov(1.0, 0.01), "payload": {"height_m": 3.0}}
    map_ = with_edge(map_, "height_of_the_page", vertex_a=1, **ends)

    solved, report = optimize_map(map_)

    assert report.num_edges["height_of_the_page"] == 1
    assert abs(solved.vertices.T_mission_base[1, 2, 3] - 3.0) < 1e-3
    (factor,) = make_factors(map_, [1], NoiseModels()).values()
    assert jacobian_error(factor, initial_values(map_, factor.keys())) < 1e-6
