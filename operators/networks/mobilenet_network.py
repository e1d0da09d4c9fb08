"""MobileNetV2: what an image shows, as a vector or as a map of vectors.

Source: Sandler et al., MobileNetV2: Inverted Residuals and Linear Bottlenecks, CVPR 2018, table 2.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.networks.checkpoints import Weights
from mapstream.operators.networks.layers import batch_norm, normalized_rows
from mapstream.operators.networks.onnx_graph import Graph, Value

CELL_PX = 32
"""Width and height of images are multiples of it."""
_MEAN = np.array([0.485, 0.456, 0.406], np.float32) * 255  # of ImageNet, red first
_STD = np.array([0.229, 0.224, 0.225], np.float32) * 255
_BOTTLENECKS = (  # expansion, how many, stride of the first
    (1, 1, 1),
    (6, 2, 2),
    (6, 3, 2),
    (6, 4, 2),
    (6, 3, 1),
    (6, 3, 2),
    (6, 1, 1),
)
_AT_16 = (
    4  # the bottlenecks after which the map has a sixteenth of the image's size, and 96 channels
)
CHANNELS_AT_16 = 96
CHANNELS = 1280


def feature_map_model(weights: Weights) -> bytes:
    """Return the network as an ONNX file that gives a map of an image.

    Input: image (1, 3, H, W) RGB, 0 to 255. Output: s16 (1, 96, H/16, W/16).
    """
    graph = Graph("mobilenet_v2")
    image = graph.input("image", np.float32, [1, 3, "height", "width"])
    at_16, _ = _maps(graph, weights, image, up_to=_AT_16)
    graph.output("s16", at_16, np.float32, [1, CHANNELS_AT_16, "height16", "width16"])
    return graph.serialize()


def embedding_model(weights: Weights) -> bytes:
    """Return the network as an ONNX file that gives one vector for each image.

    Input: image (N, 3, H, W) RGB, 0 to 255. Output: embedding (N, 1280) of unit length.
    """
    graph = Graph("mobilenet_v2")
    image = graph.input("image", np.float32, ["count", 3, "height", "width"])
    final, channels = _maps(graph, weights, image, up_to=len(_BOTTLENECKS) - 1)
    last = _convolution(graph, weights, final, f"features.{channels}", "0", "1")
    pooled = graph.add("ReduceMean", _clipped(graph, last), axes=[2, 3], keepdims=0)
    graph.output("embedding", normalized_rows(graph, pooled), np.float32, ["count", CHANNELS])
    return graph.serialize()


def _maps(graph: Graph, weights: Weights, image: Value, up_to: int) -> tuple[Value, int]:
    """Return the map behind so many groups of bottlenecks, and the number of the next layer."""
    shifted = graph.add("Sub", image, _MEAN.reshape(1, 3, 1, 1))
    x = graph.add("Div", shifted, _STD.reshape(1, 3, 1, 1))
    x = _clipped(graph, _convolution(graph, weights, x, "features.0", "0", "1", stride=2))
    layer = 1
    for expansion, count, first_stride in _BOTTLENECKS[: up_to + 1]:
        for i in range(count):
            stride = first_stride if i == 0 else 1
            bent = _bottleneck(graph, weights, x, f"features.{layer}.conv", expansion, stride)
            x = graph.add("Add", x, bent) if i > 0 else bent
            layer += 1
    return x, layer


def _bottleneck(
    graph: Graph, weights: Weights, x: Value, name: str, expansion: int, stride: int
) -> Value:
    """Widen, filter each channel, narrow."""
    depthwise = 0
    if expansion > 1:
        x = _clipped(graph, _convolution(graph, weights, x, name, "0", "1"))
        depthwise = 3
    filters, norm = str(depthwise), str(depthwise + 1)
    x = _clipped(graph, _convolution(graph, weights, x, name, filters, norm, stride=stride))
    return _convolution(graph, weights, x, name, str(depthwise + 3), str(depthwise + 4))


def _convolution(  # noqa: PLR0913  # the two names of a pair of layers
    graph: Graph, weights: Weights, x: Value, name: str, layer: str, norm: str, *, stride: int = 1
) -> Value:
    """Return a convolution without bias and its batch normalisation, in one."""
    factor, offset = batch_norm(weights, f"{name}.{norm}")
    kernels = weights[f"{name}.{layer}.weight"] * factor[:, None, None, None]
    channels, per_group, size, _ = kernels.shape
    return graph.add(
        "Conv",
        x,
        kernels,
        offset,
        kernel_shape=[size, size],
        strides=[stride, stride],
        pads=[size // 2] * 4,
        group=channels if per_group == 1 else 1,
    )


def _clipped(graph: Graph, x: Value) -> Value:
    return graph.add("Clip", x, np.array(0, np.float32), np.array(6, np.float32))
