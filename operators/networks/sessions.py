"""The one door to onnxruntime: sessions that keep to one thread, and say what is wrong with a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.streams.errors import ConfigError, OperatorError

_ELEMENTS = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
    "tensor(int32)": np.int32,
    "tensor(int64)": np.int64,
}
Shapes = dict[str, tuple[int | str | None, ...]]
"""Of inputs or outputs by name; sizes that are known at run time only are names or None."""


class Session:
    """A network that is ready to run.

    It uses the thread that calls it and no other: operators share the cores, and onnxruntime's own threads
    spin while they wait.

    Args:
        model: A file, or the bytes of one.
        name: What errors call it.

    Raises:
        ConfigError: If it is not there, or not a network that onnxruntime reads.
    """

    def __init__(self, model: Path | bytes, name: str) -> None:
        import onnxruntime  # noqa: PLC0415  # heavy, and few graphs have a network

        if isinstance(model, Path) and not model.is_file():
            raise ConfigError(f"{name}: no network in {model}; expected an ONNX file")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3  # errors, which are raised as well
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        source = str(model) if isinstance(model, Path) else model
        try:
            self._session = onnxruntime.InferenceSession(
                source, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime has a class of its own per reason
            raise ConfigError(f"{name}: not a network that can be run: {error}") from error
        self.name = name
        self.inputs: Shapes = {i.name: tuple(i.shape) for i in self._session.get_inputs()}
        self._dtypes = {
            i.name: np.dtype(_ELEMENTS.get(i.type, np.float32)) for i in self._session.get_inputs()
        }
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)
        self.outputs: Shapes = {o.name: tuple(o.shape) for o in self._session.get_outputs()}

    def run(self, feeds: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
        """Return all outputs for these inputs, which are converted to the types that the network wants.

        Raises:
            OperatorError: If the network cannot be run on them.
        """
        typed = {name: np.ascontiguousarray(a, self._dtypes[name]) for name, a in feeds.items()}
        try:
            values = self._session.run(None, typed)
        except Exception as error:  # as above
            shapes = {name: a.shape for name, a in typed.items()}
            raise OperatorError(f"{self.name}: cannot be run on {shapes}: {error}") from error
        return dict(zip(self.outputs, map(np.asarray, values), strict=True))
