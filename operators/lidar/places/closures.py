"""The recogniser of the package map-closures, which only this module imports: an extra, `pip install mapstream[closures]`.

Source: Gupta et al., Effectively detecting loop closures using point cloud density maps, ICRA 2024.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mapstream.operators.lidar.places.recognizers import Proposal
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError
from mapstream.streams.geometry import SE3

_QUERIES = 2**20  # numbers from here on are of local maps that were only compared


class MapClosuresPlaces:
    """Places in the package's own database; see `PlaceRecognizer`.

    The package takes in whatever it compares, so its memory grows with the comparisons.
    """

    def __init__(self, *, num_candidates: int = 5, min_inliers: int = 10, **options: float) -> None:
        """Make an empty database.

        Args:
            num_candidates: Places that are compared closely.
            min_inliers: Features that agree on the motion.
            options: Of the package's `MapClosuresConfig`, as `density_map_resolution`.

        Raises:
            ConfigError: If the package is not installed.
        """
        try:
            from map_closures.config import MapClosuresConfig  # noqa: PLC0415  # an extra
            from map_closures.map_closures import MapClosures  # noqa: PLC0415
        except ImportError as error:
            raise ConfigError(
                "the recogniser map_closures needs the package map-closures, which is not installed: pip install"
                " 'mapstream[closures]' (x86_64 only), or choose birds_eye, which needs nothing more"
            ) from error
        self._package: Any = MapClosures(MapClosuresConfig(**options))
        self._num_candidates, self._min_inliers = num_candidates, min_inliers
        self._keys: list[int] = []
        self._num_queries = 0

    def add(self, key: int, points: FloatArray) -> None:
        """Take in a place as `PlaceRecognizer.add` says."""
        self._package.get_top_k_closures(len(self._keys), np.array(points), 1)
        self._keys.append(key)

    def propose(self, points: FloatArray) -> list[Proposal]:
        """Return the likeliest places as `PlaceRecognizer.propose` says."""
        self._num_queries += 1
        number = _QUERIES + self._num_queries
        found = self._package.get_top_k_closures(number, np.array(points), self._num_candidates)
        proposals = [
            Proposal(
                key=self._keys[closure.source_id],
                T_place_query=SE3(np.array(closure.pose)).inverse(),
                num_inliers=int(closure.number_of_inliers),
            )
            for closure in found
            if 0 <= closure.source_id < len(self._keys)
            and closure.number_of_inliers >= self._min_inliers
        ]
        return sorted(proposals, key=lambda each: (-each.num_inliers, each.key))
