"""Graphs that we write are files that onnxruntime reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.networks.onnx_graph import Graph
from mapstream.operators.networks.sessions import Session
from mapstream.streams.errors import ConfigError, OperatorError


def _affine() -> bytes:
    """Return a network that gives 2 x + (1, 10, 100), and x from the last to the first, clipped."""
    graph = Graph("affine")
    x = graph.input("x", np.float32, ["count", 3])
    doubled = graph.add("Mul", x, np.array(2, np.float32))
    graph.output(
        "y", graph.add("Add", doubled, np.array([1, 10, 100], np.float32)), "float32", ["count", 3]
    )
    turned = graph.add("Slice", x, np.array([-1]), np.array([-4]), np.array([1]), np.array([-1]))
    graph.output("z", graph.add("LeakyRelu", turned, alpha=0.25), np.float32, ["count", 3])
    return graph.serialize()


def test_a_graph_computes_what_it_says(tmp_path: Path) -> None:
    file = tmp_path / "affine.onnx"
    file.write_bytes(_affine())
    x = np.array([[1, 2, -4], [0, 0, 0]])
    for model in (file, _affine()):
        session = Session(model, "affine")

        found = session.run({"x": x})  # float64: converted

        assert session.inputs == {"x": ("count", 3)}
        np.testing.assert_array_equal(found["y"], x * 2 + [1, 10, 100])
        np.testing.assert_array_equal(found["z"], [[-1, 2, 1], [0, 0, 0]])


def test_a_file_that_is_no_network_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"slot: no network in .*none\.onnx"):
        Session(tmp_path / "none.onnx", "slot")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(ConfigError, match="slot: not a network that can be run"):
        Session(tmp_path / "text.onnx", "slot")


def test_inputs_of_another_shape_are_an_error_with_the_shapes() -> None:
    with pytest.raises(OperatorError, match=r"affine: cannot be run on {'x': \(2, 5\)}"):
        Session(_affine(), "affine").run({"x": np.zeros((2, 5))})


def test_there_are_no_tensors_of_text() -> None:
    with pytest.raises(ValueError, match="no tensors of complex128"):
        Graph("none").add("Neg", np.zeros(1, np.complex128))
