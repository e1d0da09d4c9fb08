"""XFeat: keypoints and 64 numbers for each, fast on a CPU.

Source: Potje et al., XFeat: Accelerated Features for Lightweight Image Matching, CVPR 2024, section 3;
the order of its layers as in the authors' published weights.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.networks.checkpoints import Weights
from mapstream.operators.networks.layers import batch_norm, convolution, normalized_rows
from mapstream.operators.networks.onnx_graph import Graph, Value

CELL_PX = 32
"""Width and height of images are multiples of it."""
_MIN_HEAT = 0.05  # of a keypoint
_CELL = 8  # pixels of a cell of the feature map, along each axis
_BACKBONE = {  # strides of the layers of each block
    "block1": (1, 2, 1, 2),
    "block2": (1, 1),
    "block3": (2, 1, 1),
    "block4": (2, 1, 1),
    "block5": (2, 1, 1, 1),
    "block_fusion": (1, 1),
    "heatmap_head": (1, 1),
    "keypoint_head": (1, 1, 1),
}


def xfeat_model(weights: Weights) -> bytes:
    """Return the network as an ONNX file.

    Inputs: image (1, 1, H, W) grey of any scale, top_k (1,).
    Outputs: keypoints (K, 2) x, y [px], scores (K,), descriptors (K, 64) of unit length; the best come first.
    """
    graph = Graph("xfeat")
    image = graph.input("image", np.float32, [1, 1, "height", "width"])
    top_k = graph.input("top_k", np.int64, [1])
    gray = graph.add(
        "InstanceNormalization", image, np.ones(1, np.float32), np.zeros(1, np.float32)
    )
    features, heat, reliability = _maps(graph, weights, gray)
    _keypoints(graph, features, heat, reliability, top_k)
    return graph.serialize()


def _maps(graph: Graph, weights: Weights, gray: Value) -> tuple[Value, Value, Value]:
    """Return descriptors (1, 64, H/8, W/8), heat (1, 1, H, W) and reliability (1, 1, H/8, W/8)."""
    pooled = graph.add("AveragePool", gray, kernel_shape=[4, 4], strides=[4, 4])
    skipped = convolution(graph, pooled, weights["skip1.1.weight"], weights["skip1.1.bias"])
    quarter = graph.add("Add", _block(graph, weights, "block1", gray), skipped)
    at_8 = _block(graph, weights, "block3", _block(graph, weights, "block2", quarter))
    at_16 = _block(graph, weights, "block4", at_8)
    at_32 = _block(graph, weights, "block5", at_16)
    pyramid = graph.add("Sum", at_8, _enlarged(graph, at_16, 2), _enlarged(graph, at_32, 4))
    fused = _block(graph, weights, "block_fusion", pyramid)
    features = convolution(
        graph, fused, weights["block_fusion.2.weight"], weights["block_fusion.2.bias"]
    )
    reliable = _block(graph, weights, "heatmap_head", features)
    reliable = convolution(
        graph, reliable, weights["heatmap_head.2.weight"], weights["heatmap_head.2.bias"]
    )
    cells = _block(
        graph, weights, "keypoint_head", graph.add("SpaceToDepth", gray, blocksize=_CELL)
    )
    logits = convolution(
        graph, cells, weights["keypoint_head.3.weight"], weights["keypoint_head.3.bias"]
    )
    shares = graph.add("Softmax", logits, axis=1)
    here, _ = graph.add_many("Split", 2, shares, np.array([_CELL**2, 1]), axis=1)  # last: nowhere
    heat = graph.add("DepthToSpace", here, blocksize=_CELL, mode="DCR")
    return normalized_rows(graph, features, axis=1), heat, graph.add("Sigmoid", reliable)


def _keypoints(graph: Graph, features: Value, heat: Value, reliability: Value, k: Value) -> None:
    """Declare the outputs: the best local maxima of heat times reliability, and the features there."""
    highest = graph.add("MaxPool", heat, kernel_shape=[5, 5], strides=[1, 1], pads=[2] * 4)
    is_peak = graph.add(
        "And",
        graph.add("Equal", heat, highest),
        graph.add("Greater", heat, np.array(_MIN_HEAT, np.float32)),
    )
    places = graph.add("Transpose", graph.add("NonZero", is_peak), perm=[1, 0])  # (N, 4)
    rows_columns = graph.add(
        "Slice", places, np.array([2]), np.array([4]), np.array([1])
    )  # of the image
    yx = graph.add("Cast", rows_columns, to=1)
    size = graph.add("Shape", heat, start=2, end=4)
    last = graph.add(
        "Sub", graph.add("Cast", size, to=1), np.ones(1, np.float32)
    )  # of rows and columns
    # the network was trained with positions scaled so
    scaled = graph.add(
        "Sub",
        graph.add("Mul", graph.add("Div", yx, last), np.array(2, np.float32)),
        np.ones(1, np.float32),
    )
    xy = graph.add("Gather", scaled, np.array([1, 0]), axis=1)
    grid = graph.add("Unsqueeze", xy, np.array([0, 1]))  # (1, 1, N, 2)
    trust = graph.add("GridSample", reliability, grid, mode="bilinear")
    scores = graph.add(
        "Mul",
        graph.add("GatherND", heat, places),
        graph.add("Reshape", trust, np.array([-1])),
    )
    count = graph.add("Min", k, graph.add("Shape", scores))
    best, order = graph.add_many("TopK", 2, scores, count)
    sampled = graph.add(
        "GridSample", features, graph.add("Gather", grid, order, axis=2), mode="bicubic"
    )  # (1, 64, 1, K)
    rows = graph.add("Transpose", graph.add("Squeeze", sampled, np.array([0, 2])), perm=[1, 0])
    points = graph.add("Gather", graph.add("Gather", yx, np.array([1, 0]), axis=1), order, axis=0)
    graph.output("keypoints", points, np.float32, ["count", 2])
    graph.output("scores", best, np.float32, ["count"])
    graph.output("descriptors", normalized_rows(graph, rows), np.float32, ["count", 64])


def _block(graph: Graph, weights: Weights, name: str, image: Value) -> Value:
    """Return convolutions with batch normalisation, folded into them, and rectification."""
    for i, stride in enumerate(_BACKBONE[name]):
        factor, offset = batch_norm(weights, f"{name}.{i}.layer.1")
        kernels = weights[f"{name}.{i}.layer.0.weight"] * factor[:, None, None, None]
        image = graph.add("Relu", convolution(graph, image, kernels, offset, stride))
    return image


def _enlarged(graph: Graph, image: Value, factor: int) -> Value:
    scales = np.array([1, 1, factor, factor], np.float32)
    return graph.add("Resize", image, "", scales, mode="linear")
