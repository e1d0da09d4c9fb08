"""Weights that are installed: a file of plain arrays per network, in the user's cache."""

from __future__ import annotations

import os
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from mapstream.operators.networks.catalogue import NETWORKS, Network
from mapstream.operators.networks.checkpoints import Weights
from mapstream.recordings.cache import cache_folder
from mapstream.streams.errors import ConfigError, RecordingError

FOLDER_VARIABLE = "MAPSTREAM_MODELS"
"""The environment variable that puts weights elsewhere, for robots that share them or have no home."""


def models_folder() -> Path:
    """Return where weights are kept."""
    given = os.environ.get(FOLDER_VARIABLE, "")
    return Path(given) if given else cache_folder() / "models"


def weights_file(network: Network) -> Path:
    """Return where the weights of a network are, or would be; other weights are another file."""
    return models_folder() / f"{network.name}-{network.sha256[:12]}.npz"


def keep_weights(network: Network, weights: Weights, licence: str) -> Path:
    """Write weights and the text of their licence; the file takes its place in one step.

    Raises:
        RecordingError: If they cannot be written.
    """
    file = weights_file(network)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="installing-", dir=file.parent) as work:
            made = Path(work) / file.name
            with zipfile.ZipFile(made, "w") as archive:
                for name, array in weights.items():
                    with archive.open(f"{name}.npy", "w") as member:
                        np.lib.format.write_array(member, array, allow_pickle=False)
            file.with_suffix(".LICENSE").write_text(licence)
            made.replace(file)
    except OSError as error:
        where = f"set {FOLDER_VARIABLE} or XDG_CACHE_HOME"
        raise RecordingError(f"{file.parent}: cannot be written: {error}; {where}") from error
    return file


def weights_of(name: str) -> Weights:
    """Return the weights of an installed network by the names of its checkpoint.

    Raises:
        ConfigError: If it is not installed, or its file is damaged.
    """
    file = weights_file(NETWORKS[name])
    remedy = f"`mapstream models install {name}`"
    if not file.is_file():
        raise ConfigError(f"network {name} is not installed: no {file}; {remedy}")
    try:
        with np.load(file, allow_pickle=False) as archive:
            return dict(archive)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigError(f"network {name}: {file} is damaged: {error}; {remedy}") from error
