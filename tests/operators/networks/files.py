"""Small networks in files, with the ends of large ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapstream.operators.networks.onnx_graph import Graph


def superpoint_file(folder: Path, *, is_turned: bool = False) -> Path:
    """Write a network whose keypoints are the pixels brighter than half, described by one-hot columns.

    A pixel's score is its brightness, and its descriptor has a 2 at place x modulo 256.
    """
    graph = Graph("points")
    image = graph.input("image", np.float32, [1, 1, "height", "width"])
    bright = graph.add("Greater", image, np.array(0.5, np.float32))
    places = graph.add("Transpose", graph.add("NonZero", bright), perm=[1, 0])
    xy = graph.add("Gather", places, np.array([3, 2]), axis=1)
    column = graph.add("Mod", graph.add("Gather", places, np.array(3), axis=1), np.array(256))
    descriptors = graph.add("OneHot", column, np.array(256), np.array([0, 2], np.float32))
    if is_turned:  # as the authors' export has them, with a batch
        descriptors = graph.add("Transpose", descriptors, perm=[1, 0])
        descriptors = graph.add("Unsqueeze", descriptors, np.array([0]))
        xy = graph.add("Unsqueeze", xy, np.array([0]))
    lead: list[int | str] = [1] if is_turned else []
    width: list[int | str] = [256, "n"] if is_turned else ["n", 256]
    graph.output("keypoints", xy, np.int64, [*lead, "n", 2])
    graph.output("scores", graph.add("GatherND", image, places), np.float32, ["n"])
    graph.output("descriptors", descriptors, np.float32, [*lead, *width])
    file = folder / "superpoint.onnx"
    file.write_bytes(graph.serialize())
    return file


def matcher_file(folder: Path, layout: str) -> Path:
    """Write a network that matches each descriptor to the most similar one, as sure as they are similar.

    Args:
        folder: Where it is written.
        layout: `lightglue`, `pairs` (the same, with pairs of rows as matches) or `superglue`.
    """
    graph = Graph("nearest")
    desc = []
    for i in (0, 1):
        count = f"n{i}"
        if layout == "superglue":
            graph.input(f"keypoints{i}", np.float32, [1, count, 2])
            graph.input(f"scores{i}", np.float32, [1, count])
            given = graph.input(f"descriptors{i}", np.float32, [1, "width", count])
            given = graph.add("Transpose", given, perm=[0, 2, 1])
        else:
            graph.input(f"kpts{i}", np.float32, [1, count, 2])
            given = graph.input(f"desc{i}", np.float32, [1, count, "width"])
        desc.append(graph.add("Squeeze", given, np.array([0])))
    similar = graph.add("MatMul", desc[0], graph.add("Transpose", desc[1], perm=[1, 0]))
    best = graph.add("ArgMax", similar, axis=1, keepdims=0)
    scores = graph.add("ReduceMax", similar, axes=[1], keepdims=0)
    if layout == "pairs":
        rows = graph.add("Range", np.array(0), _count(graph, best), np.array(1))
        columns = [graph.add("Unsqueeze", value, np.array([1])) for value in (rows, best)]
        best = graph.add("Concat", *columns, axis=1)
    graph.output("matches0", best, np.int64, ["n0", 2] if layout == "pairs" else ["n0"])
    name = "matching_scores0" if layout == "superglue" else "mscores0"
    graph.output(name, scores, np.float32, ["n0"])
    file = folder / f"{layout}.onnx"
    file.write_bytes(graph.serialize())
    return file


def _count(graph: Graph, rows: str) -> str:
    return graph.add("Squeeze", graph.add("Shape", rows))
