"""What came of an optimisation, for people and for programs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

from mapstream.recordings.maps.model import Map

_TOLD = 20  # switched off edges; programs get all


@dataclass(frozen=True, slots=True, kw_only=True)
class KindReport:
    """The edges of one kind that took part."""

    count: int
    chi2_before: float  # of edges that ended as true, at the start that was chosen
    chi2_after: float


@dataclass(frozen=True, slots=True, kw_only=True)
class DroppedEdge:
    """An edge that was found false."""

    row: int
    kind: str
    mission_a: str
    stamp_a_ns: int
    mission_b: str  # empty where the edge has one end
    stamp_b_ns: int
    chi2: float  # at the solution without it


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimizationReport:
    """What came of an optimisation."""

    num_vertices: int
    num_edges: dict[str, int]  # that took part, by kind
    ignored: dict[str, int]  # edges of kinds without a maker, or left out by the config
    error_before: float  # 0.5 chi2 of the map as it came, of edges that ended as true
    error_after: float
    iterations: int
    seconds: float
    start: str = "current"  # which start led to the solution
    solver: str = "lm"
    kinds: dict[str, KindReport] = field(default_factory=dict)
    num_outliers: int = (
        0  # observations that lost their landmark: too far off, or behind the camera
    )
    switched_off: list[int] = field(default_factory=list)  # rows of edges with a switch below 0.5
    dropped: list[DroppedEdge] = field(default_factory=list)  # the same, for people
    rejected_absolute: list[int] = field(
        default_factory=list
    )  # rows that `reject_absolute` dropped
    underconstrained: list[str] = field(default_factory=list)  # variables that a weak prior holds
    is_converged: bool = True  # or the cap on iterations or time was hit
    final_lambda: float = 1e-5  # the damping with which the next run may begin

    def lines(self) -> Iterator[str]:
        """Return what to tell people, line by line."""
        yield f"error {self.error_before:.6g} -> {self.error_after:.6g} from the {self.start} start"
        yield f"{self.iterations} iterations of {self.solver}, {self.seconds:.2f} s"
        if not self.is_converged:
            yield "not converged: the cap on iterations or time was hit"
        for name, kind in self.kinds.items():
            chi2 = f"chi2 {kind.chi2_before:.6g} -> {kind.chi2_after:.6g}"
            yield f"{kind.count} edges of kind {name}: {chi2}"
        if self.num_outliers:
            yield f"{self.num_outliers} observations are false and lost their landmark"
        yield f"{len(self.dropped)} switched off"
        for edge in sorted(self.dropped, key=lambda each: -each.chi2)[:_TOLD]:
            ends = f"{edge.mission_a[:8]} {edge.stamp_a_ns} ns"
            if edge.mission_b:
                ends += f" to {edge.mission_b[:8]} {edge.stamp_b_ns} ns"
            yield f"  {edge.kind} in row {edge.row}, {ends}, chi2 {edge.chi2:.3g}"
        if self.rejected_absolute:
            yield f"{len(self.rejected_absolute)} absolute measurements contradict the others"
        if len(self.dropped) > _TOLD:
            yield f"  and {len(self.dropped) - _TOLD} more"
        for name, count in self.ignored.items():
            yield f"ignored: {count} edges of kind {name}"
        for name in self.underconstrained:
            yield f"under-constrained, held by a weak prior: {name}"


def dropped_edges(map_: Map, chi2_of_row: Mapping[int, float]) -> list[DroppedEdge]:
    """Return the edges that were found false, with the ends as people know them."""
    edges, vertices = map_.edges, map_.vertices
    dropped = []
    for row, chi2 in chi2_of_row.items():
        a, b = int(edges.vertex_a[row]), int(edges.vertex_b[row])
        dropped.append(
            DroppedEdge(
                row=row,
                kind=str(edges.kind[row]),
                mission_a=map_.mission_id(int(vertices.mission[a])),
                stamp_a_ns=int(vertices.stamp_ns[a]),
                mission_b=map_.mission_id(int(vertices.mission[b])) if b >= 0 else "",
                stamp_b_ns=int(vertices.stamp_ns[b]) if b >= 0 else 0,
                chi2=chi2,
            )
        )
    return dropped


def as_one(first: OptimizationReport, second: OptimizationReport) -> OptimizationReport:
    """Return the report of two optimisations, of which the second went on where the first ended."""
    kinds = {
        name: replace(kind, chi2_before=first.kinds[name].chi2_before)
        for name, kind in second.kinds.items()
    }
    iterations = first.iterations + second.iterations
    error_before = first.error_before
    return replace(second, error_before=error_before, iterations=iterations, kinds=kinds)
