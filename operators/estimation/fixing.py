"""Variables that a solver must not move."""

from __future__ import annotations

import gtsam

from mapstream.operators.estimation.noise import Factor
from mapstream.streams.messages.sensors import FloatArray


def fixed(key: int, pose: FloatArray) -> Factor:
    """Return the factor that holds one pose where it is."""
    exactly = gtsam.noiseModel.Constrained.All(6)
    return gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), exactly)
