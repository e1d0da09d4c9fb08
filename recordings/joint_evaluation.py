"""How good a map of several robots is: one alignment for all, since their places to each other count.

A robot that is aligned for itself hides that the map put it in the wrong place.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, section V (multi-robot experiments).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mapstream.recordings.evaluation import PoseErrors, Statistics, ape, pose_errors
from mapstream.recordings.pose_pairs import Alignment, AlignmentMode, PosePairs, align
from mapstream.streams.errors import EstimationError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotErrors:
    """The errors of one robot."""

    joint: PoseErrors  # after the one alignment of all robots
    own: PoseErrors | None  # after its own; None where its positions do not determine one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointErrors:
    """The errors of several robots."""

    alignment: Alignment  # the one for all
    robots: dict[str, RobotErrors]

    @property
    def translation(self) -> Statistics:
        """Of all robots' poses, after the one alignment [m]."""
        return Statistics.of(np.concatenate([r.joint.translation_m for r in self.robots.values()]))

    @property
    def rotation_deg(self) -> Statistics:
        """Of all robots' poses, after the one alignment [deg]."""
        errors_rad = np.concatenate([r.joint.rotation_rad for r in self.robots.values()])
        return Statistics.of(np.rad2deg(errors_rad))


def joint_ape(pairs: Mapping[str, PosePairs], mode: AlignmentMode = "se3") -> JointErrors:
    """Return the absolute pose errors of robots, by name, after one alignment for all and after their own.

    Raises:
        EstimationError: If there are no robots, or the positions do not determine the joint alignment.
    """
    if not pairs:
        raise EstimationError("there is no robot to evaluate")
    together = PosePairs(
        stamps_ns=np.concatenate([p.stamps_ns for p in pairs.values()]),
        estimate=np.concatenate([p.estimate for p in pairs.values()]),
        reference=np.concatenate([p.reference for p in pairs.values()]),
    )
    alignment = align(together, mode)
    robots = {
        name: RobotErrors(joint=pose_errors(each, alignment), own=_own(each, mode))
        for name, each in pairs.items()
    }
    return JointErrors(alignment=alignment, robots=robots)


def _own(pairs: PosePairs, mode: AlignmentMode) -> PoseErrors | None:
    try:
        return ape(pairs, mode)
    except EstimationError:  # on one line, for instance
        return None
