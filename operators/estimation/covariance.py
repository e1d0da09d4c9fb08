"""How certain the states of a map are, on request."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from mapstream.operators.estimation.keys import Variable, key_of
from mapstream.operators.estimation.optimize_config import OptimizeConfig
from mapstream.operators.estimation.problem import describe_failure, make_problem
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError


def covariances(
    map_: Map,
    rows: Sequence[int],
    *,
    variable: Variable = "pose",
    config: OptimizeConfig | None = None,
) -> FloatArray:
    """Return the marginal covariances (N, D, D) of states at an optimised map.

    Those of poses are in the base frame, rotation first [rad, m], relative to what holds the map in place.
    Edges that were switched off take no part.

    Args:
        map_: An optimised map; elsewhere a covariance means nothing.
        rows: Of the table that the variable belongs to.
        variable: What kind of state.
        config: With which the map was optimised.

    Raises:
        EstimationError: If a state is not determined, or not in the problem.
    """
    config = (config or OptimizeConfig()).model_copy(update={"is_robust": False})
    problem = make_problem(map_, config)  # a switch of 0 leaves an edge out
    keys = [key_of(variable, row) for row in rows]
    unknown = [row for row, key in zip(rows, keys, strict=True) if not problem.values.exists(key)]
    if unknown:
        raise EstimationError(f"no edge constrains the {variable} in row {unknown[0]}")
    try:
        marginals = gtsam.Marginals(problem.whole_graph(), problem.values)
        return np.array([marginals.marginalCovariance(key) for key in keys])
    except RuntimeError as error:
        raise EstimationError(describe_failure(error, map_)) from error
