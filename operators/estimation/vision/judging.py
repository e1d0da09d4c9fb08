"""What became of observations: how well they fit before and after, and which of them are false."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.operators.estimation.report import KindReport
from mapstream.operators.estimation.states import Values
from mapstream.operators.estimation.vision.bundle import Bundle
from mapstream.operators.estimation.vision.bundle_solver import refreshed
from mapstream.operators.estimation.vision.bundle_state import (
    chi2_by_family,
    counts_by_family,
    in_vertices,
    plausible,
    rows_left_out,
    state_of,
)
from mapstream.operators.estimation.vision.sightings import errors
from mapstream.recordings.maps.model import Map


def judged(bundle: Bundle, before: Values, after: Values) -> tuple[dict[str, KindReport], int]:
    """Return reports by family on the observations that take part at the end, and how many do not."""
    state = state_of(bundle, after)
    now = refreshed(bundle, after, state)
    used = plausible(now, state)
    chi2_after = chi2_by_family(now, state, used)
    chi2_before = chi2_by_family(bundle, state_of(bundle, before), used)
    counts = counts_by_family(now, used)
    reports = {
        family: KindReport(
            count=counts[family],
            chi2_before=chi2_before[family],
            chi2_after=chi2_after[family],
        )
        for family in counts
    }
    return reports, len(rows_left_out(now, used))


def without_outliers(map_: Map, bundle: Bundle, values: Values) -> Map:
    """Return the map in which observations that cannot be true have no landmark any more."""
    state = state_of(bundle, values)
    now = refreshed(bundle, values, state)
    rows = rows_left_out(now, plausible(now, state))
    if not len(rows):
        return map_
    landmark = map_.observations.landmark.copy()
    landmark[rows] = -1
    return replace(map_, observations=replace(map_.observations, landmark=landmark))


def rms_px(bundle: Bundle, values: Values) -> dict[tuple[int, str], float]:
    """Return the root mean square of the reprojection errors of each camera, by mission and name [px]."""
    state = state_of(bundle, values)
    used = plausible(bundle, state)
    _, p_vertex = in_vertices(bundle, state)
    sums: dict[tuple[int, str], float] = {}
    for seen, mask in zip(bundle.sightings, used, strict=True):
        if seen.family != "keypoints":
            continue
        sensor = bundle.sensors[seen.sensor]
        found = errors(seen, p_vertex[seen.pair], state.sensors[seen.sensor]) * seen.sigmas[:, None]
        sums[sensor.mission, sensor.name] = float(np.sqrt((found[mask] ** 2).sum(axis=1).mean()))
    return sums
