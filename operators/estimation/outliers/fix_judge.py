"""Which position fixes are false on missions that only an IMU leads along.

No rigid trajectory says where a fix should be, as `absolute_outliers.py` needs it: so the fixes of a mission in one
frame are judged along the drive, by `hypotheses.py`. The frame must be upright, as those of satellites are.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mapstream.operators.estimation.factors.inertial import parameters_of
from mapstream.operators.estimation.factors.mounts import MountOf
from mapstream.operators.estimation.factors.payloads import payloads
from mapstream.operators.estimation.kinds import make_factors
from mapstream.operators.estimation.noise import NoiseModels
from mapstream.operators.estimation.outliers.absolute_outliers import (
    RejectAbsoluteConfig,
    RejectAbsoluteReport,
    reject_absolute,
)
from mapstream.operators.estimation.outliers.hypotheses import Fix, FixHypotheses
from mapstream.operators.estimation.outliers.inertial_steps import InertialStep, inertial_step
from mapstream.operators.estimation.outliers.lonely_fixes import lonely_fixes
from mapstream.operators.estimation.starts.first_fixes import inertial_missions
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_UNMEASURED_M = 1e4  # the sigma of a direction that a fix says nothing of
Verdicts = dict[int, bool]
"""Whether a fix is true, by its row in the edges; those that are not sure yet are missing."""


class FixJudge:
    """Judges the fixes of a map that grows; later fixes may overturn a verdict of some fixes ago."""

    def __init__(self) -> None:
        self._drives: dict[tuple[int, int], _Drive] = {}

    def verdicts(self, map_: Map, *, is_whole: bool = False) -> Verdicts:
        """Return the verdicts on all such fixes.

        Args:
            map_: It may have grown since the last time; what came late into its past is judged anew.
            is_whole: Nothing will come, so the likelier verdict has to do where none is sure.
        """
        found: Verdicts = {}
        for group, rows in _groups(map_).items():
            drive = self._drives.setdefault(group, _Drive())
            if not drive.begins(map_, rows):
                drive = self._drives[group] = _Drive()
            drive.follow(map_, rows)
            for row, is_true, is_sure in zip(rows.tolist(), *drive.verdicts(), strict=True):
                if is_sure or is_whole:
                    found[row] = is_true
        return found


def without_false_fixes(
    map_: Map, config: RejectAbsoluteConfig | None = None
) -> tuple[Map, RejectAbsoluteReport]:
    """Return the map with absolute measurements switched as all of them together say, and which are false.

    Where odometry leads along a mission, its trajectory says which they are; where only an IMU does, hypotheses.

    Args:
        map_: Whose missions with odometry have trajectories that are rigid over a window of fixes.
        config: What counts as a contradiction to such a trajectory.
    """
    linked = set(range(len(map_.missions))) - inertial_missions(map_)
    map_, report = reject_absolute(map_, config, missions=linked)
    verdicts = FixJudge().verdicts(map_, is_whole=True)
    false = [row for row, is_true in verdicts.items() if not is_true]
    return with_verdicts(map_, verdicts), replace(
        report,
        num_fixes=report.num_fixes + len(verdicts),
        rejected=sorted(report.rejected + false),
    )


def with_verdicts(map_: Map, verdicts: Verdicts) -> Map:
    """Return the map with the switch 1 on such fixes as are known to be true, and 0 on all others."""
    switch = map_.edges.switch.copy()
    switch[lonely_fixes(map_)] = 0.0
    switch[[row for row, is_true in verdicts.items() if is_true]] = 1.0
    return replace(map_, edges=replace(map_.edges, switch=switch))


def _groups(map_: Map) -> dict[tuple[int, int], IntArray]:
    """Return the fixes of each mission and frame, in the order of time."""
    groups: dict[tuple[int, int], list[int]] = {}
    for row in lonely_fixes(map_).tolist():
        mission = int(map_.vertices.mission[map_.edges.vertex_a[row]])
        groups.setdefault((mission, int(map_.edges.frame[row])), []).append(row)
    return {group: np.array(rows, dtype=np.int64) for group, rows in groups.items()}


@dataclass(slots=True)
class _Drive:
    """One mission, and its fixes in one frame."""

    stamps_ns: list[int] = field(default_factory=list)  # of the vertices that lie behind
    ids: list[bytes] = field(default_factory=list)  # of the fixes there
    before: list[bool] = field(default_factory=list)  # verdicts from before the IMU's last gap
    hypotheses: FixHypotheses | None = None

    def begins(self, map_: Map, fixes: IntArray) -> bool:
        """Return whether the map still is what it was as far as the drive went."""
        mission = int(map_.vertices.mission[map_.edges.vertex_a[fixes[0]]])
        stamps_ns = map_.vertices.stamp_ns[map_.vertices_of(mission)[: len(self.stamps_ns)]]
        at_ns = map_.vertices.stamp_ns[map_.edges.vertex_a[fixes]]
        behind = fixes[at_ns <= self.stamps_ns[-1]] if self.stamps_ns else fixes[:0]
        ids = [map_.edges.id[row].tobytes() for row in behind.tolist()]
        return stamps_ns.tolist() == self.stamps_ns and ids == self.ids

    def follow(self, map_: Map, fixes: IntArray) -> None:
        """Go on to the end of the map."""
        mission = int(map_.vertices.mission[map_.edges.vertex_a[fixes[0]]])
        vertices = map_.vertices_of(mission)[len(self.stamps_ns) :]
        steps = _steps(map_, mission, vertices)
        measured = _measured(map_, fixes[np.isin(map_.edges.vertex_a[fixes], vertices)])
        for vertex in vertices.tolist():
            self._move(steps.get(vertex))
            for row, fix in measured.get(vertex, {}).items():
                if self.hypotheses is None:
                    R = map_.T_map_base(np.array([vertex]))[0, :3, :3]
                    self.hypotheses = FixHypotheses(R, fix)
                self.hypotheses.judge(fix)
                self.ids.append(map_.edges.id[row].tobytes())
            self.stamps_ns.append(int(map_.vertices.stamp_ns[vertex]))

    def _move(self, step: InertialStep | None) -> None:
        if self.hypotheses is None:
            return
        if step is None:
            self.before += self.hypotheses.likeliest()
            self.hypotheses = None
        else:
            self.hypotheses.move(step)

    def verdicts(self) -> tuple[list[bool], list[bool]]:
        """Return of each fix whether it is true, and whether that is sure."""
        if self.hypotheses is None:
            return self.before, [True] * len(self.before)
        sure = [True] * len(self.before) + self.hypotheses.are_sure()
        return [*self.before, *self.hypotheses.likeliest()], sure


def _steps(map_: Map, mission: int, vertices: IntArray) -> dict[int, InertialStep]:
    """Return what the IMU says of the way to each of these vertices."""
    edges, gravity_mps2 = map_.edges, parameters_of(map_, mission).gravity_mps2
    rows = map_.edges_of("imu")
    factors = make_factors(map_, rows[np.isin(edges.vertex_b[rows], vertices)], NoiseModels())
    return {int(edges.vertex_b[r]): inertial_step(f, gravity_mps2) for r, f in factors.items()}


def _measured(map_: Map, rows: IntArray) -> dict[int, dict[int, Fix]]:
    """Return the fixes by vertex and row, upright: in the map if their frame is known, else in their frame."""
    edges, mount_of = map_.edges, MountOf(map_)
    found: dict[int, dict[int, Fix]] = {}
    for row, payload in payloads(map_, rows).items():
        vertex, frame = int(edges.vertex_a[row]), int(edges.frame[row])
        is_known = frame >= 0 and bool(map_.frames.is_known[frame])
        T = map_.frames.T_map_frame[frame] if is_known else np.eye(4)
        lever = mount_of(vertex, payload)[0][:3, 3]
        p = (T @ edges.T_a_b[row])[:3, 3]
        covariance = T[:3, :3] @ _covariance(map_, row) @ T[:3, :3].T
        found.setdefault(vertex, {})[row] = Fix(p=p, covariance=covariance, lever=lever)
    return found


def _covariance(map_: Map, row: int) -> FloatArray:
    """Return the covariance (3, 3) in the axes of the frame; a sphere where those are the sensor's."""
    measured = map_.edges.covariance[row, 3:, 3:]
    is_open: BoolArray = ~np.isfinite(np.diagonal(measured))
    covariance = np.where(is_open[:, None] | is_open, np.eye(3) * _UNMEASURED_M**2, measured)
    if map_.edges.kind[row] == "absolute":
        covariance = np.eye(3) * np.diagonal(covariance).max()
    return covariance
