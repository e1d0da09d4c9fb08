"""A finished map that frames are compared with: made ready once, and never changed by what is seen."""

from __future__ import annotations

from collections.abc import Sequence

from mapstream.operators.places.anchoring import known_places
from mapstream.operators.places.recognition import Recognition, RecognitionConfig, recognize
from mapstream.operators.places.searching import landmark_positions
from mapstream.operators.places.views import VertexViews, View
from mapstream.recordings.maps.model import Map
from mapstream.streams.errors import MapError


class MapPlaces:
    """The landmarks of a map's anchored missions, by what they look like.

    Raises:
        MapError: If the map has none that can be recognised.
    """

    def __init__(self, map_: Map, config: RecognitionConfig) -> None:
        self._config = config
        self._landmarks_map = landmark_positions(map_)
        views = VertexViews(map_, config.kinds)
        self._database = known_places(map_, config, views)
        self.kinds = sorted(set(map_.landmarks.kind.tolist()))
        if not len(self._database):
            kinds = ", ".join(self.kinds) or "none"
            raise MapError(
                "the map has no landmark with a descriptor in an anchored mission, so nothing can be"
                f" recognised in it; kinds of its landmarks: {kinds}; `create_landmarks` makes them from tracks"
            )
        # The first look imports what takes a second: no frame of a robot that drives shall wait for it.
        self.recognize(views.at(next(iter(self._database.num_descriptors_of))), seed=0)

    def recognize(self, views: Sequence[View], seed: int) -> Recognition:
        """Return where a frame was taken, if the map tells."""
        return recognize(views, self._database, self._landmarks_map, self._config, seed=seed)
