"""Planes on the ellipsoid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.gnss.geodesy import GeodeticPlane, utm_zone
from mapstream.streams.errors import ConfigError

KARLSRUHE = (49.009, 8.437, 116.0)


@settings(max_examples=25, deadline=None)
@given(
    st.floats(-79, 79),
    st.floats(-179.9, 179.9),
    st.floats(-400, 8000),
    st.lists(st.floats(-3000, 3000), min_size=3, max_size=3),
    st.sampled_from(["enu", "utm"]),
)
def test_F9_there_and_back(
    latitude: float, longitude: float, height: float, place: list[float], crs: str
) -> None:
    plane = GeodeticPlane.at(crs, (latitude, longitude, height))

    back = plane.to_plane(plane.to_lla(np.array([place])))[0]

    np.testing.assert_allclose(back, place, atol=1e-6)
    np.testing.assert_allclose(plane.to_plane(np.array([plane.origin_lla]))[0], 0, atol=1e-9)


def test_F9_the_axes_are_east_north_up() -> None:
    plane = GeodeticPlane.at("enu", KARLSRUHE)
    a = np.array(KARLSRUHE)

    east, north, up = plane.to_plane(a + np.array([[0, 1e-5, 0], [1e-5, 0, 0], [0, 0, 1.0]]))

    assert east[0] == pytest.approx(0.7317, abs=1e-3)
    assert north[1] == pytest.approx(1.1121, abs=1e-3)
    assert up[2] == pytest.approx(1.0)
    np.testing.assert_allclose(plane.axes_at(a), np.eye(3), atol=1e-6)


def test_F9_a_projection_turns_north_and_stretches() -> None:
    """pyproj's own factors of UTM zone 32 at this place."""
    import pyproj  # noqa: PLC0415

    plane = GeodeticPlane.at("utm", KARLSRUHE)
    factors = pyproj.Proj("EPSG:32632").get_factors(KARLSRUHE[1], KARLSRUHE[0])

    axes = plane.axes_at(np.array([*KARLSRUHE[:2], 0.0]))

    assert plane.crs == "EPSG:32632"
    assert np.linalg.norm(axes[:, 1]) == pytest.approx(factors.meridional_scale, abs=1e-7)
    turned = np.degrees(np.arctan2(axes[0, 1], axes[1, 1]))
    assert abs(turned) == pytest.approx(abs(factors.meridian_convergence), abs=1e-5)
    assert plane.to_plane(np.array([[49.01, 8.438, 116.0]]))[0, 0] > 0


@pytest.mark.parametrize(
    ("place", "code"),
    [((49.0, 8.4), "EPSG:32632"), ((-33.9, 151.2), "EPSG:32756"), ((60.4, 5.3), "EPSG:32632"), ((78.2, 15.6), "EPSG:32633"), ((0.0, 180.0), "EPSG:32601")],
)  # fmt: skip
def test_F9_zones(place: tuple[float, float], code: str) -> None:
    assert utm_zone(*place) == code


@pytest.mark.parametrize("crs", ["mars", "EPSG:4326", "EPSG:999999"])
def test_F9_what_is_no_plane_is_refused(crs: str) -> None:
    with pytest.raises(ConfigError, match="try"):
        GeodeticPlane.at(crs, KARLSRUHE)


def test_F9_what_is_nowhere_is_refused() -> None:
    with pytest.raises(ConfigError, match="an origin is latitude"):
        GeodeticPlane.at("enu", (100.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="no geodetic origin"):
        GeodeticPlane.of_frame("enu", np.full(3, np.nan))
