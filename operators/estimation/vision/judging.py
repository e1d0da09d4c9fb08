"""What became of observations: how well they fit before and after, and which of them are false."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.operators.estimation.report import KindReport
from mapstream.operators.estimation.states import Values
from mapstream.operators.estimation.vision.bundle import Bundle
from mapstream.operators.estimation.vision.bundle_solver import refreshed
from mapstream.operators.estimation.vision.bundle_state import (
    all_errors,
    chi2_by_family,
    counts_by_family,
    plausible,
    rows_left_out,
    state_of,
)
from mapstream.recordings.maps.model import Map


def judged(bundle: Bundle, before: Values, after: Values) -> tuple[dict[str, KindReport], int]:
    """Return reports by family on the observations that take part at the end, and how many do not."""
    state = state_of(bundle, after)
    now = refreshed(bundle, after, state)
    found = all_errors(now, state)
    used = plausible(now, found)
    chi2_after = chi2_by_family(now, found, used)
    chi2_before = chi2_by_family(bundle, all_errors(bundle, state_of(bundle, before)), used)
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
    rows = rows_left_out(now, plausible(now, all_errors(now, state)))
    if not len(rows):
        return map_
    landmark = map_.observations.landmark.copy()
    landmark[rows] = -1
    return replace(map_, observations=replace(map_.observations, landmark=landmark))


def rms_px(bundle: Bundle, values: Values) -> dict[tuple[int, str], float]:
    """Return the root mean square of the reprojection errors of each camera, by mission and name [px]."""
    found = all_errors(bundle, state_of(bundle, values))
    used = plausible(bundle, found)
    rms: dict[tuple[int, str], float] = {}
    for seen, each, mask in zip(bundle.sightings, found, used, strict=True):
        if seen.family == "keypoints":
            sensor = bundle.sensors[seen.sensor]
            away_px = (each * seen.sigmas[:, None])[mask]
            rms[sensor.mission, sensor.name] = float(np.sqrt((away_px**2).sum(axis=1).mean()))
    return rms
