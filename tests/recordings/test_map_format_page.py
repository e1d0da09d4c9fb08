"""The page of the map format says what the code does."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from mapstream.recordings.maps import load_map, save_map
from mapstream.recordings.maps.columns import columns_of
from mapstream.recordings.maps.model import TABLES
from mapstream.recordings.maps.store import VERSION
from tests.recordings.made_maps import line_map

PAGE = (Path(__file__).parents[2] / "docs" / "map-format.md").read_text()


def described(name: str) -> str:
    """The section of a table, as the declared columns give it."""
    lines = [f"### {name}", "", TABLES[name].meaning, ""]
    lines += ["| column | type | of a row | refers to | meaning |", "|---|---|---|---|---|"]
    for c in columns_of(TABLES[name]):
        shape = "x".join(map(str, c.shape)) or "1"
        lines.append(f"| `{c.name}` | {c.kind} | {shape} | {c.refers_to or ''} | {c.meaning} |")
    return "\n".join([*lines, ""])


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_described_as_it_is_declared(name: str) -> None:
    assert described(name) in PAGE


def test_the_page_has_no_other_tables_and_the_version() -> None:
    assert re.findall(r"^### (\w+)$", PAGE, flags=re.MULTILINE) == list(TABLES)
    assert f"version {VERSION}" in PAGE.splitlines()[0]


def test_the_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_map(line_map(4), "drive_map")
    [example] = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)

    exec(compile(example, "map-format.md", "exec"), {})  # noqa: S102  # the page's own snippet

    assert (load_map("flat_map").vertices.T_mission_base[:, 2, 3] == 0).all()
