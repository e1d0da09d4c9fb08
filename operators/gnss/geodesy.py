"""The one door to pyproj: between the WGS84 ellipsoid and planes with axes in metres.

A plane is `enu` (x east, y north, z up, touching the ellipsoid's normal at the origin), or a projection by its
EPSG code, shifted to the origin. Projections stretch: UTM by 0.9996 to 1.0010, that is up to 1 m in a kilometre.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.constraints import OuterFrame

_A, _E2 = 6_378_137.0, 6.694379990141317e-3  # WGS84: semi-major axis [m], squared eccentricity


@dataclass(frozen=True)
class GeodeticPlane:
    """A plane with metric axes and a zero on the ellipsoid."""

    crs: str  # enu, or EPSG:32632 ...
    origin_lla: tuple[float, float, float]  # latitude [deg], longitude [deg], height [m]

    @classmethod
    def at(cls, crs: str, origin_lla: npt.ArrayLike) -> GeodeticPlane:
        """Return a plane; `utm` stands for the zone of the origin.

        Raises:
            ConfigError: If there is no such projection, or the origin is no place on Earth.
        """
        latitude, longitude, height = np.asarray(origin_lla, dtype=np.float64).tolist()
        if not (abs(latitude) <= 90 and abs(longitude) <= 180 and np.isfinite(height)):
            raise ConfigError(
                f"an origin is latitude, longitude [deg] and height [m], not {[latitude, longitude, height]}"
            )
        plane = cls(
            utm_zone(latitude, longitude) if crs == "utm" else crs, (latitude, longitude, height)
        )
        plane.to_plane(np.array([plane.origin_lla]))  # a bad name is found here
        return plane

    @classmethod
    def of_frame(cls, crs: str, origin_lla: FloatArray) -> GeodeticPlane:
        """Return the plane behind an outer frame of a map.

        Raises:
            ConfigError: If the frame has no place on Earth.
        """
        if not crs or not np.isfinite(origin_lla).all():
            raise ConfigError(
                "this outer frame has no geodetic origin; only satellite fixes give one"
            )
        return cls.at(crs, origin_lla)

    def outer_frame(self, name: str, **known: Any) -> OuterFrame:  # noqa: ANN401  # T_map_frame
        """Return the frame that measurements in this plane speak in."""
        return OuterFrame(name=name, crs=self.crs, origin_lla=np.array(self.origin_lla), **known)

    @cached_property
    def _transformer(self) -> Any:  # noqa: ANN401  # pyproj's
        import pyproj  # noqa: PLC0415  # takes half a second to import

        if self.crs == "enu":
            latitude, longitude, height = self.origin_lla
            return pyproj.Transformer.from_pipeline(
                "+proj=pipeline +step +proj=axisswap +order=2,1 +step +proj=unitconvert +xy_in=deg +xy_out=rad"
                " +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84"
                f" +lat_0={latitude!r} +lon_0={longitude!r} +h_0={height!r}"
            )
        try:
            crs = pyproj.CRS.from_user_input(self.crs)
            if not crs.is_projected:
                raise ConfigError(f"{self.crs} ({crs.name}) has no axes in metres; try utm or enu")
            return pyproj.Transformer.from_crs("EPSG:4979", crs.to_3d())
        except pyproj.exceptions.ProjError as error:
            raise ConfigError(
                f"no projection {self.crs!r}: {error}; try enu, utm or EPSG:32632"
            ) from error

    @cached_property
    def _zero(self) -> FloatArray:
        return np.zeros(3) if self.crs == "enu" else self._projected(np.array([self.origin_lla]))[0]

    def _projected(self, lla: FloatArray) -> FloatArray:
        return np.column_stack(self._transformer.transform(*lla.T))

    def to_plane(self, lla: FloatArray) -> FloatArray:
        """Return places (N, 3) [m] of latitudes, longitudes [deg] and heights [m] (N, 3)."""
        return self._projected(lla) - self._zero

    def coordinates(self, lla: FloatArray) -> FloatArray:
        """Return the projection's own coordinates (N, 3) [m], which do not count from the origin."""
        return self._projected(lla)

    def wkt(self) -> str:
        """Return the projection in the words of OGC; empty for a plane that is none.

        Heights are above the ellipsoid.
        """
        import pyproj  # noqa: PLC0415  # takes half a second to import

        return (
            "" if self.crs == "enu" else str(pyproj.CRS.from_user_input(self.crs).to_3d().to_wkt())
        )

    def to_lla(self, places: FloatArray) -> FloatArray:
        """Return latitudes, longitudes [deg] and heights [m] (N, 3) of places (N, 3) [m]."""
        moved = np.asarray(places, dtype=np.float64) + self._zero
        return np.column_stack(self._transformer.transform(*moved.T, direction="INVERSE"))

    def axes_at(self, lla: FloatArray) -> FloatArray:
        """Return (3, 3): a metre east, north and up at a place (3,), as columns in the plane.

        In a projection north is turned by the meridian's convergence, and a metre is stretched.
        """
        sine = np.sin(np.radians(lla[0]))
        across = _A / np.sqrt(1 - _E2 * sine**2)  # radii of curvature
        along = across * (1 - _E2) / (1 - _E2 * sine**2)
        east_deg = np.degrees(1 / ((across + lla[2]) * np.cos(np.radians(lla[0]))))
        north_deg = np.degrees(1 / (along + lla[2]))
        steps = np.array([[0.0, east_deg, 0.0], [north_deg, 0.0, 0.0], [0.0, 0.0, 1.0]])
        ends = self.to_plane(np.vstack([lla + steps, lla - steps]))
        axes: FloatArray = ((ends[:3] - ends[3:]) / 2).T
        return axes


def utm_zone(latitude: float, longitude: float) -> str:
    """Return the EPSG code of the zone of a place [deg], with the exceptions of Norway and Svalbard."""
    zone = int((longitude + 180) // 6) % 60 + 1
    if 56 <= latitude < 64 and 3 <= longitude < 12:
        zone = 32
    elif latitude >= 72 and 0 <= longitude < 42:
        zone = 31 + 2 * int((longitude + 3) // 12)
    return f"EPSG:{326 if latitude >= 0 else 327}{zone:02d}"
