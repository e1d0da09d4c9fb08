"""Where frames lie in each other over time: a tree of static, sampled and computed transforms.

As `/tf` and `/tf_static` say it: every frame has one parent. Between samples the tree interpolates;
before the first and after the last it refuses, since a guess would pass for a measurement.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Container
from dataclasses import dataclass, field

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import TransformError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import TransformBatch


@dataclass(slots=True)
class _Static:
    T_parent_child: SE3

    def at(self, stamp_ns: int) -> SE3:  # noqa: ARG002  # the same for ever
        return self.T_parent_child


@dataclass(slots=True)
class _Computed:
    at: Callable[[int], SE3]


@dataclass(slots=True)
class _Sampled:
    stamps_ns: list[int] = field(default_factory=list)  # increasing
    matrices: list[FloatArray] = field(default_factory=list)  # (4, 4) T_parent_child

    def add(self, stamp_ns: int, matrix: FloatArray) -> None:
        at = bisect_left(self.stamps_ns, stamp_ns)
        if at < len(self.stamps_ns) and self.stamps_ns[at] == stamp_ns:
            self.matrices[at] = matrix  # the newer word counts
        else:
            self.stamps_ns.insert(at, stamp_ns)
            self.matrices.insert(at, matrix)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop samples that no look-up from `stamp_ns` on can need."""
        count = bisect_right(self.stamps_ns, stamp_ns) - 1
        if count > 0:
            del self.stamps_ns[:count], self.matrices[:count]

    def at(self, stamp_ns: int) -> SE3:
        stamps_ns = self.stamps_ns
        right = bisect_left(stamps_ns, stamp_ns)
        if right < len(stamps_ns) and stamps_ns[right] == stamp_ns:
            return SE3(self.matrices[right])
        if 0 < right < len(stamps_ns):
            start_ns, end_ns = stamps_ns[right - 1], stamps_ns[right]
            fraction = (stamp_ns - start_ns) / (end_ns - start_ns)
            return SE3(self.matrices[right - 1]).interpolate(SE3(self.matrices[right]), fraction)
        side, nearest_ns = ("before", stamps_ns[0]) if right == 0 else ("after", stamps_ns[-1])
        gap_s = abs(stamp_ns - nearest_ns) / 1e9
        raise TransformError(
            f"{stamp_ns} ns is {gap_s:.3f} s {side} what is known, "
            f"{stamps_ns[0]} to {stamps_ns[-1]} ns in {len(stamps_ns)} samples"
        )


_Edge = _Static | _Sampled | _Computed


class TransformTree:
    """Frames and their parents."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._edges: dict[str, _Edge] = {}  # by child

    @property
    def frames(self) -> list[str]:
        """All frames, sorted."""
        return sorted({*self._parents, *self._parents.values()})

    def parent_of(self, frame: str) -> str | None:
        """Return the frame that this one hangs on; None for a root."""
        return self._parents.get(frame)

    def add_static(self, parent: str, child: str, T_parent_child: SE3) -> None:
        """Say where a frame lies for ever; saying the same again does no harm.

        Raises:
            TransformError: If the child hangs elsewhere or otherwise already, or a cycle would close.
        """
        known = self._edges.get(child)
        if isinstance(known, _Static) and self._parents[child] == parent:
            if not np.allclose(known.T_parent_child.matrix, T_parent_child.matrix, atol=1e-6):
                raise TransformError(
                    f"{child} in {parent}: was static at {known.T_parent_child}, is now {T_parent_child}"
                )
            return
        self._attach(parent, child, _Static(T_parent_child))

    def add_sample(self, parent: str, child: str, stamp_ns: int, T_parent_child: SE3) -> None:
        """Say where a frame lay at one time.

        Raises:
            TransformError: If the child hangs elsewhere or otherwise already, or a cycle would close.
        """
        self._sampled(parent, child).add(stamp_ns, T_parent_child.matrix)

    def add_function(self, parent: str, child: str, T_parent_child: Callable[[int], SE3]) -> None:
        """Have a function asked for each stamp [ns]: an encoder, a model of a joint.

        Raises:
            TransformError: If the child hangs elsewhere or otherwise already, or a cycle would close.
        """
        self._attach(parent, child, _Computed(T_parent_child))

    def add(self, batch: TransformBatch, *, except_children: Container[str] = ()) -> None:
        """Take the transforms of a message from `/tf` or `/tf_static`, but not those of some children.

        Raises:
            TransformError: As `add_static` and `add_sample`.
        """
        transforms = zip(
            batch.parents,
            batch.children,
            batch.stamps_ns.tolist(),
            batch.T_parent_child,
            strict=True,
        )
        for parent, child, stamp_ns, matrix in transforms:
            if child in except_children:
                continue
            if batch.is_static:
                self.add_static(parent, child, SE3(matrix))
            else:
                self.add_sample(parent, child, stamp_ns, SE3(matrix))

    def forget_before(self, stamp_ns: int) -> None:
        """Drop samples that no look-up from `stamp_ns` on can need."""
        for edge in self._edges.values():
            if isinstance(edge, _Sampled):
                edge.forget_before(stamp_ns)

    def look_up(self, a: str, b: str, stamp_ns: int) -> SE3:
        """Return T_a_b at a time.

        Raises:
            TransformError: If a frame is unknown, the two are not connected, or a transform between
                them is not known at that time; the message names the frames and what is known.
        """
        path_a, path_b = self._path(a), self._path(b)
        if path_a[-1] != path_b[-1]:
            raise TransformError(
                f"{a} and {b} are not connected: {a} hangs on {path_a[-1]}, {b} on {path_b[-1]}"
            )
        while len(path_a) > 1 and len(path_b) > 1 and path_a[-2] == path_b[-2]:
            path_a.pop()
            path_b.pop()
        T_top_a, T_top_b = self._down(path_a, stamp_ns), self._down(path_b, stamp_ns)
        return T_top_a.inverse() @ T_top_b

    def _path(self, frame: str) -> list[str]:
        """Return a frame, its parent, and so on up to its root."""
        if frame not in self._parents and frame not in self._parents.values():
            raise TransformError(
                f"no frame {frame!r}; known: {', '.join(self.frames) or 'none at all'}"
            )
        path = [frame]
        while path[-1] in self._parents:
            path.append(self._parents[path[-1]])
        return path

    def _down(self, path: list[str], stamp_ns: int) -> SE3:
        """Return the transform from the path's last frame to its first."""
        T = SE3.identity()
        for child in reversed(path[:-1]):
            try:
                T = T @ self._edges[child].at(stamp_ns)
            except TransformError as error:
                raise TransformError(f"{child} in {self._parents[child]}: {error}") from None
        return T

    def _sampled(self, parent: str, child: str) -> _Sampled:
        edge = self._edges.get(child)
        if not isinstance(edge, _Sampled) or self._parents[child] != parent:
            edge = _Sampled()
            self._attach(parent, child, edge)
        return edge

    def _attach(self, parent: str, child: str, edge: _Edge) -> None:
        known = self._parents.get(child)
        if known is not None and known != parent:
            raise TransformError(f"{child} hangs on {known} and cannot hang on {parent} too")
        if known is not None:
            kind = type(self._edges[child]).__name__.strip("_").lower()
            raise TransformError(f"{child} in {parent} is {kind} already; it cannot be both")
        at: str | None = parent
        while at is not None:
            if at == child:
                raise TransformError(f"{child} in {parent}: {parent} itself hangs on {child}")
            at = self._parents.get(at)
        self._parents[child] = parent
        self._edges[child] = edge
