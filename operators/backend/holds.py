"""What holds the variables of a map while it grows, besides its edges."""

from __future__ import annotations

from collections.abc import Collection

from mapstream.operators.estimation.gauge import gauge_factors
from mapstream.operators.estimation.noise import Factor
from mapstream.operators.estimation.priors import prior_factors
from mapstream.operators.estimation.starts.inertial_start import first_velocity_prior
from mapstream.recordings.maps.model import Map


def all_holds(map_: Map, factors: dict[int, Factor]) -> dict[bytes, Factor]:
    """Return by name what holds a problem that begins with these factors, which are given by row."""
    missions = range(len(map_.missions))
    priors = prior_factors(map_, factors).values()
    return _named([*gauge_factors(map_, factors), *_velocities(map_, missions), *priors])


def new_holds(
    map_: Map, factors: dict[int, Factor], missions: Collection[int], keys: Collection[int]
) -> dict[bytes, Factor]:
    """Return by name what holds missions that begin, and weak priors on variables of other kinds that are new.

    Args:
        map_: With all of them.
        factors: That are new, by row.
        missions: That begin; their rows.
        keys: The variables that are new.
    """
    firsts = {int(map_.vertices_of(mission)[0]) for mission in missions}
    gauge = gauge_factors(map_, factors) if firsts else []
    priors = prior_factors(map_, factors).items()
    return _named(
        [
            *(factor for factor in gauge if factor.keys()[0] in firsts),
            *_velocities(map_, missions),
            *(factor for key, factor in priors if key in keys),
        ]
    )


def _velocities(map_: Map, missions: Collection[int]) -> list[Factor]:
    """Return weak priors on the first velocity of those missions that have an IMU."""
    firsts = {int(map_.vertices_of(mission)[0]) for mission in missions}
    inertial = set(map_.edges.vertex_a[map_.edges_of("imu")].tolist())
    return [first_velocity_prior(map_, vertex) for vertex in sorted(firsts & inertial)]


def _named(factors: list[Factor]) -> dict[bytes, Factor]:
    return {b"hold%d" % factor.keys()[0]: factor for factor in factors}
