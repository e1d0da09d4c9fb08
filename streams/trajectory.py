"""A trajectory: poses over time, answered at any time between the first and the last."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray, IntArray, frozen
from mapstream.streams.geometry import SE3, interpolate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Poses at strictly increasing stamps."""

    stamps_ns: IntArray  # (N,)
    poses: FloatArray  # (N, 4, 4) T_reference_body

    def __post_init__(self) -> None:
        n = frozen(self, "stamps_ns", np.int64, (None,)).shape[0]
        frozen(self, "poses", np.float64, (n, 4, 4))
        backward = np.flatnonzero(np.diff(self.stamps_ns) <= 0)
        if backward.size:
            at = int(backward[0])
            raise ValueError(f"stamps must increase: {self.stamps_ns[at : at + 2].tolist()}")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def covers(self, stamp_ns: int) -> bool:
        return len(self) > 0 and int(self.stamps_ns[0]) <= stamp_ns <= int(self.stamps_ns[-1])

    def stamp_before(self, stamp_ns: int) -> int | None:
        """Return the last stamp before another, which need not be one of a pose; None at the start."""
        index = int(np.searchsorted(self.stamps_ns, stamp_ns, side="left"))
        return int(self.stamps_ns[index - 1]) if index else None

    def stamp_after(self, stamp_ns: int) -> int | None:
        """Return the first stamp after another, which need not be one of a pose; None at the end."""
        index = int(np.searchsorted(self.stamps_ns, stamp_ns, side="right"))
        return int(self.stamps_ns[index]) if index < len(self) else None

    def at(self, stamps_ns: npt.ArrayLike) -> FloatArray:
        """Return poses (M, 4, 4) at stamps (M,), interpolated between neighbours.

        Raises:
            ValueError: If a stamp lies before the first pose or after the last: nothing is extrapolated.
        """
        query = np.atleast_1d(np.asarray(stamps_ns, dtype=np.int64))
        if len(self) == 0:
            raise ValueError("an empty trajectory answers no stamp")
        outside = (query < self.stamps_ns[0]) | (query > self.stamps_ns[-1])
        if outside.any():
            span = f"{self.stamps_ns[0]} to {self.stamps_ns[-1]}"
            raise ValueError(f"stamp {query[outside][0]} lies outside the trajectory, {span}")
        if len(self) == 1:
            return np.repeat(self.poses, len(query), axis=0)
        right = np.clip(np.searchsorted(self.stamps_ns, query), 1, len(self) - 1)
        start, end = self.stamps_ns[right - 1], self.stamps_ns[right]
        fraction = (query - start) / (end - start)
        return interpolate(self.poses[right - 1], self.poses[right], fraction)

    def pose_at(self, stamp_ns: int) -> SE3:
        """Return the pose at one stamp.

        Raises:
            ValueError: As `at`.
        """
        return SE3(self.at(stamp_ns)[0])

    def between(self, start_ns: int, end_ns: int) -> SE3:
        """Return T_start_end, the motion over an interval (a continuous pose source's answer)."""
        return self.pose_at(start_ns).inverse() @ self.pose_at(end_ns)
