"""The documentation is true: its commands run, its snippets work, its tables name tests that exist."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.load import load_graph
from mapstream.graph.plan import plan
from tests.command_line import command_line
from tests.installed import look_installed

ROOT = Path(__file__).parent.parent
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "examples").rglob("*.md")),
]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?!https?://)([^)#]+)")
TEST_NAME = re.compile(r"`(tests/[\w/]+\.py)(?:::(\w+))?`")
OWN_OPERATOR = ROOT / "examples" / "03_own_operator"


def blocks(page: Path, language: str) -> list[str]:
    return [body for kind, body in FENCE.findall(page.read_text()) if kind == language]


def pages_with(language: str) -> list[Path]:
    return [page for page in PAGES if blocks(page, language)]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture
def installed_examples(tmp_path: Path) -> Path:
    """A folder that, on Python's path, makes the packages of the examples look installed."""
    return look_installed(tmp_path / "site", (ROOT / "examples").rglob("pyproject.toml"))


@pytest.mark.slow
@pytest.mark.parametrize("page", pages_with("console"), ids=name_of)
def test_commands_on_the_page_succeed(page: Path, tmp_path: Path, installed_examples: Path) -> None:
    """Lines `$ mapstream ...` run in order in one folder; `# exits N` names another exit code than 0."""
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "examples").symlink_to(ROOT / "examples")
    environment = {**os.environ, "PYTHONPATH": str(installed_examples), "COLUMNS": "200"}
    with command_line(folder, environment) as run:
        for line in "\n".join(blocks(page, "console")).splitlines():
            if not line.startswith("$ mapstream "):
                continue  # output, or an installation that the fixture stands for
            command, _, remark = line.removeprefix("$ mapstream ").partition("# exits ")

            ended = run(shlex.split(command))

            assert ended.code == int(remark or 0), f"{line}\n{ended.output}"


@pytest.mark.parametrize("page", pages_with("python"), ids=name_of)
def test_python_on_the_page_compiles(page: Path) -> None:
    for body in blocks(page, "python"):
        compile(body, str(page), "exec")


def test_Q1_snippets_of_the_own_operator_run(installed_examples: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(installed_examples)}
    body = "\n".join(blocks(OWN_OPERATOR / "README.md", "python"))

    done = subprocess.run(
        [sys.executable, "-c", body], env=environment, capture_output=True, text=True, check=False
    )

    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", pages_with("yaml"), ids=name_of)
def test_graphs_on_the_page_can_be_planned(page: Path, tmp_path: Path) -> None:
    for index, body in enumerate(blocks(page, "yaml")):
        if "version:" not in body:
            continue
        file = tmp_path / f"{index}.yaml"
        file.write_text(body)
        recording = {"recording": "drive.mcap"} if "recording: {type: path, help" in body else {}

        plan(load_graph(file, params=recording), Catalogue())


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    missing = [link for link in LINK.findall(page.read_text()) if not (page.parent / link).exists()]

    assert not missing


def test_features_name_tests_that_exist() -> None:
    missing = []
    for file, function in TEST_NAME.findall((ROOT / "docs" / "features.md").read_text()):
        path = ROOT / file
        if not path.exists() or (function and f"def {function}(" not in path.read_text()):
            missing.append(f"{file}::{function}")

    assert not missing


def test_features_that_are_done_say_what_shows_it() -> None:
    rows = [
        line.split("|")
        for line in (ROOT / "docs" / "features.md").read_text().splitlines()
        if line.startswith("| ")
    ]

    bare = [
        cells[1].strip()
        for cells in rows
        if cells[3].strip() in ("done", "partly") and not cells[4].strip()
    ]

    assert not bare


def test_the_readme_and_ci_run_the_same_test_command() -> None:
    command = "python3 -m venv .venv && .venv/bin/pip install -q -e '.[test]' && .venv/bin/pytest -n 2 --dist loadfile"

    assert command in (ROOT / "README.md").read_text()
    assert command in (ROOT / ".ci" / "run").read_text().splitlines()


def test_the_pages_of_operators_are_those_of_the_code() -> None:
    """`python docs/build_operator_pages.py` makes them."""
    folder = ROOT / "docs" / "operators"
    written = {page.name: page.read_text() for page in folder.glob("*.md")}

    assert written == runpy.run_path(str(ROOT / "docs" / "build_operator_pages.py"))["pages"]()
