"""LightGlue, and its lighter kin for XFeat: which keypoints of two images are of the same points.

Source: Lindenberger et al., LightGlue: Local Feature Matching at Light Speed, ICCV 2023, section 3; without its early stop and pruning, which save little at some hundred keypoints.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.operators.networks.checkpoints import Weights
from mapstream.operators.networks.layers import linear
from mapstream.operators.networks.onnx_graph import Graph, Value


def lightglue_model(weights: Weights, num_heads: int) -> bytes:
    """Return the network as an ONNX file.

    Inputs: kpts0 (1, M, 2), kpts1 (1, N, 2) in [-1, 1] along the longer side of the image,
    desc0 (1, M, C), desc1 (1, N, C) of unit length; M and N are at least 1.
    Outputs: matches0 (M,) rows of the second image, -1 without a match; mscores0 (M,) 0 to 1.

    Args:
        weights: Names as in the authors' published weights.
        num_heads: Of the attention.
    """
    graph = Graph("lightglue")
    width = weights["input_proj.weight"].shape[1]
    kpts = [graph.input(f"kpts{i}", np.float32, [1, f"count{i}", 2]) for i in (0, 1)]
    desc = [graph.input(f"desc{i}", np.float32, [1, f"count{i}", width]) for i in (0, 1)]
    network = _Network(graph, weights, num_heads)
    encodings = [network.encoded(graph.add("Squeeze", k, np.array([0]))) for k in kpts]
    x = [network.linear("input_proj", graph.add("Squeeze", d, np.array([0]))) for d in desc]
    num_layers = len({name.split(".")[1] for name in weights if name.startswith("transformers.")})
    for layer in range(num_layers):
        name = f"transformers.{layer}"
        x = [
            network.self_attention(f"{name}.self_attn", xi, encoding)
            for xi, encoding in zip(x, encodings, strict=True)
        ]
        x = network.cross_attention(f"{name}.cross_attn", x)
    network.assignment(f"log_assignment.{num_layers - 1}", x)
    return graph.serialize()


def lighterglue_model(weights: Weights) -> bytes:
    """Return LightGlue as XFeat's authors trained it for their features: narrower, with one head."""
    prefix = "matcher."  # beside the extractor, in one checkpoint
    own = {k.removeprefix(prefix): v for k, v in weights.items() if k.startswith(prefix)}
    return lightglue_model(own, num_heads=1)


class _Network:
    """The layers of LightGlue; rows are keypoints."""

    def __init__(self, graph: Graph, weights: Weights, num_heads: int) -> None:
        self._graph = graph
        self._weights = weights
        self._num_heads = num_heads
        self._head_width = weights["input_proj.weight"].shape[0] // num_heads

    def linear(self, name: str, rows: Value, factor: float = 1.0) -> Value:
        """Return a linear layer, its result times a factor."""
        scale = np.float32(factor)
        weights, bias = self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]
        return linear(self._graph, rows, weights * scale, bias * scale)

    def encoded(self, kpts: Value) -> tuple[Value, Value]:
        """Return cosine and sine (1, N, head width / 2) by which pairs of numbers are turned."""
        add = self._graph.add
        angles = add("MatMul", kpts, self._weights["posenc.Wr.weight"].T)
        angles = add("Unsqueeze", angles, np.array([0]))
        return add("Cos", angles), add("Sin", angles)

    def self_attention(self, name: str, x: Value, encoding: tuple[Value, Value]) -> Value:
        add = self._graph.add
        weights, bias = self._split_projection(name)
        rows = linear(self._graph, x, weights, bias)
        q, k, v = self._graph.add_many("Split", 3, self._heads(rows, 3), axis=0)
        q, k = self._turned(q, encoding), self._turned(k, encoding)
        logits = add("MatMul", q, add("Transpose", k, perm=[0, 2, 1]))
        mixed = add("MatMul", add("Softmax", logits, axis=2), v)
        return self._with_message(name, x, self.linear(f"{name}.out_proj", self._joined(mixed)))

    def cross_attention(self, name: str, x: list[Value]) -> list[Value]:
        add = self._graph.add
        scale = self._head_width**-0.25
        a, b = (self._heads(self.linear(f"{name}.to_qk", xi, scale), 1) for xi in x)
        va, vb = (self._heads(self.linear(f"{name}.to_v", xi), 1) for xi in x)
        logits = add("MatMul", a, add("Transpose", b, perm=[0, 2, 1]))
        seen_by_a = add("MatMul", add("Softmax", logits, axis=2), vb)
        backwards = add("Transpose", logits, perm=[0, 2, 1])
        seen_by_b = add("MatMul", add("Softmax", backwards, axis=2), va)
        return [
            self._with_message(name, xi, self.linear(f"{name}.to_out", self._joined(seen)))
            for xi, seen in zip(x, (seen_by_a, seen_by_b), strict=True)
        ]

    def assignment(self, name: str, x: list[Value]) -> None:
        """Declare the outputs: pairs that are each other's best, and how sure they are."""
        add = self._graph.add
        width = self._weights[f"{name}.final_proj.weight"].shape[0]
        a, b = (self.linear(f"{name}.final_proj", xi, width**-0.25) for xi in x)
        similar = add("MatMul", a, add("Transpose", b, perm=[1, 0]))
        za, zb = (add("Sigmoid", self.linear(f"{name}.matchability", xi)) for xi in x)
        both = add("MatMul", za, add("Transpose", zb, perm=[1, 0]))
        shares = add("Mul", add("Softmax", similar, axis=0), add("Softmax", similar, axis=1))
        scores = add("Mul", shares, both)  # (M, N)
        best_b = add("ArgMax", scores, axis=1, keepdims=0)
        best_a = add("ArgMax", scores, axis=0, keepdims=0)
        back = add("Gather", best_a, best_b)
        count = add("Squeeze", add("Shape", best_b))
        itself = add("Range", np.array(0), count, np.array(1))
        is_mutual = add("Equal", back, itself)
        matches = add("Where", is_mutual, best_b, np.array(-1))
        highest = add("ReduceMax", scores, axes=[1], keepdims=0)
        sure = add("Where", is_mutual, highest, np.array(0, np.float32))
        self._graph.output("matches0", matches, np.int64, ["count0"])
        self._graph.output("mscores0", sure, np.float32, ["count0"])

    def _with_message(self, name: str, x: Value, message: Value) -> Value:
        """Return x plus what two layers make of it and a message."""
        add = self._graph.add
        both = self.linear(f"{name}.ffn.0", add("Concat", x, message, axis=1))
        normal = add(
            "LayerNormalization",
            both,
            self._weights[f"{name}.ffn.1.weight"],
            self._weights[f"{name}.ffn.1.bias"],
        )
        erf = add("Erf", add("Div", normal, np.array(np.sqrt(2), np.float32)))
        share = add("Mul", add("Add", erf, np.array(1, np.float32)), np.array(0.5, np.float32))
        return add("Add", x, self.linear(f"{name}.ffn.3", add("Mul", normal, share)))

    def _split_projection(self, name: str) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Return weights and bias that give queries, keys and values one after another.

        The checkpoint mixes the three, and turns neighbours as pairs; here the first half of a head
        is paired with its second half, which changes no product of a query with a key.
        """
        heads, width = self._num_heads, self._head_width
        weights, bias = (self._weights[f"{name}.Wqkv.{part}"] for part in ("weight", "bias"))
        rows = np.arange(heads * width * 3).reshape(heads, width, 3)
        paired = np.concatenate([rows[:, 0::2], rows[:, 1::2]], axis=1)
        order = np.concatenate([paired[..., 0], paired[..., 1], rows[..., 2]]).reshape(-1)
        factor = np.ones(len(order), np.float32)
        factor[: heads * width] = width**-0.5
        return weights[order] * factor[:, None], bias[order] * factor

    def _turned(self, x: Value, encoding: tuple[Value, Value]) -> Value:
        add = self._graph.add
        cos, sin = encoding
        first, second = self._graph.add_many("Split", 2, x, axis=2)
        return add(
            "Concat",
            add("Sub", add("Mul", first, cos), add("Mul", second, sin)),
            add("Add", add("Mul", second, cos), add("Mul", first, sin)),
            axis=2,
        )

    def _heads(self, rows: Value, parts: int) -> Value:
        """Return rows (N, parts x C) as (parts x heads, N, head width)."""
        shape = np.array([-1, parts * self._num_heads, self._head_width])
        return self._graph.add("Transpose", self._graph.add("Reshape", rows, shape), perm=[1, 0, 2])

    def _joined(self, heads: Value) -> Value:
        """Return heads (heads, N, head width) as rows (N, C)."""
        rows = self._graph.add("Transpose", heads, perm=[1, 0, 2])
        return self._graph.add("Reshape", rows, np.array([0, self._num_heads * self._head_width]))
