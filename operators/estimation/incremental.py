"""The map's problem while it grows: iSAM2 (Kaess et al., IJRR 2012), factors added and removed by number.

All poses stay in the problem (square root smoothing), so that a loop moves the whole past.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from mapstream.operators.estimation.noise import Factor
from mapstream.operators.estimation.states import poses_from, values_from
from mapstream.streams.errors import EstimationError
from mapstream.streams.messages.sensors import FloatArray


class IncrementalProblem:
    """Poses under the keys 0, 1, 2 ... and factors under numbers of the caller's choice.

    iSAM2 with Cholesky fails on long chains of weak edges; then the problem is solved as a whole and
    iSAM2 starts anew from there, which `num_rebuilds` counts.
    """

    def __init__(self) -> None:
        self.num_rebuilds = 0
        self._factors: dict[int, Factor] = {}
        self._indices: dict[int, int] = {}  # of the factors inside iSAM2
        self._num_poses = 0
        self._isam = _new_isam()

    def __len__(self) -> int:
        return self._num_poses

    def update(
        self,
        *,
        poses: FloatArray,
        add: Mapping[int, Factor],
        remove: Sequence[int] = (),
    ) -> None:
        """Add poses (N, 4, 4) under the next keys, add and remove factors, and solve.

        Raises:
            EstimationError: If the poses are not determined even by the problem as a whole.
        """
        values = gtsam.Values()
        for offset, pose in enumerate(poses):
            values.insert(self._num_poses + offset, gtsam.Pose3(pose))
        gone = [self._indices.pop(number) for number in remove]
        for number in remove:
            del self._factors[number]
        graph = gtsam.NonlinearFactorGraph()
        for factor in add.values():
            graph.add(factor)
        self._factors.update(add)
        self._num_poses += len(poses)
        try:
            result = self._isam.update(graph, values, gone)
        except RuntimeError:
            self._rebuild(values)
        else:
            self._indices.update(zip(add, result.getNewFactorsIndices(), strict=True))

    def settle(self, tolerance_m: float = 1e-5, most: int = 20) -> None:
        """Go on until no pose moves further than the tolerance: a loop takes several steps to sink in."""
        old = self.poses()
        for _ in range(most):
            self._isam.update()
            new = self.poses()
            if np.abs(new - old).max(initial=0.0) < tolerance_m:
                return
            old = new

    def poses(self) -> FloatArray:
        """Return all poses (N, 4, 4) by key."""
        if not self._num_poses:
            return np.zeros((0, 4, 4))
        return poses_from(self._isam.calculateEstimate(), self._num_poses)

    def chi2(self) -> float:
        """Return the squared weighted error of all factors at the present estimate."""
        values = self._isam.calculateEstimate()
        return 2 * sum(float(factor.error(values)) for factor in self._factors.values())

    def reset(self, poses: FloatArray, factors: Mapping[int, Factor]) -> None:
        """Start anew with poses (N, 4, 4) and factors, for instance after a batch optimisation."""
        self._factors, self._num_poses = dict(factors), len(poses)
        self._start(values_from(poses))

    def _graph(self) -> Any:  # noqa: ANN401
        graph = gtsam.NonlinearFactorGraph()
        for factor in self._factors.values():
            graph.add(factor)
        return graph

    def _start(self, values: Any) -> None:  # noqa: ANN401
        self._isam = _new_isam()
        result = self._isam.update(self._graph(), values)
        self._indices = dict(zip(self._factors, result.getNewFactorsIndices(), strict=True))

    def _rebuild(self, added: Any) -> None:  # noqa: ANN401
        """Solve the whole, from where iSAM2 stood when it failed."""
        self.num_rebuilds += 1
        start = gtsam.Values(self._isam.getLinearizationPoint())
        for key in added.keys():  # noqa: SIM118  # gtsam's values are no mapping
            if not start.exists(key):
                start.insert(key, added.atPose3(key))
        try:
            self._start(gtsam.LevenbergMarquardtOptimizer(self._graph(), start).optimize())
        except RuntimeError as error:
            raise EstimationError(f"the poses are not determined: {str(error).strip()}") from error


def _new_isam() -> Any:  # noqa: ANN401
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(0.01)
    params.relinearizeSkip = 1
    return gtsam.ISAM2(params)
