"""Layers that several networks have, with the weights of a checkpoint by their names."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.operators.networks.checkpoints import Weights
from mapstream.operators.networks.onnx_graph import Graph, Value

_EPSILON = 1e-5  # of normalisations, PyTorch's default


def convolution(
    graph: Graph, image: Value, weights: npt.NDArray[Any], bias: npt.NDArray[Any], stride: int = 1
) -> Value:
    """Return a convolution that keeps the size where the stride is 1.

    Args:
        graph: Where it is added.
        image: (1, C, H, W).
        weights: (C', C / groups, size, size).
        bias: (C',).
        stride: Of both axes.
    """
    size = weights.shape[2]
    return graph.add(
        "Conv",
        image,
        weights,
        bias,
        kernel_shape=[size, size],
        strides=[stride, stride],
        pads=[size // 2] * 4,
    )


def linear(graph: Graph, rows: Value, weights: npt.NDArray[Any], bias: npt.NDArray[Any]) -> Value:
    """Return rows (N, C) times weights (C', C) transposed, plus a bias (C',)."""
    return graph.add("Gemm", rows, weights, bias, transB=1)


def normalized_rows(graph: Graph, rows: Value, axis: int = -1) -> Value:
    """Return vectors along an axis scaled to unit length."""
    return graph.add("LpNormalization", rows, axis=axis, p=2)


def batch_norm(weights: Weights, name: str) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return factor and offset (C,) of a batch normalisation, which may be without learnt ones."""
    factor = 1 / np.sqrt(weights[f"{name}.running_var"] + _EPSILON)
    if f"{name}.weight" in weights:
        factor = factor * weights[f"{name}.weight"]
    offset = -weights[f"{name}.running_mean"] * factor
    if f"{name}.bias" in weights:
        offset = offset + weights[f"{name}.bias"]
    return factor.astype(np.float32), offset.astype(np.float32)
