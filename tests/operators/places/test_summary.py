"""Small maps for localisation."""

from pathlib import Path

import numpy as np
import pytest

from mapstream.graph.cli import main
from mapstream.operators.places.map_places import MapPlaces
from mapstream.operators.places.recognition import RecognitionConfig
from mapstream.operators.places.summary import SummaryConfig, summarize
from mapstream.operators.places.views import view_of
from mapstream.recordings.maps import Map, check_map, load_map, save_map
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from tests.operators.places import made_maps, scenes

A = "a" * 32
RIG = {"front": scenes.camera()}


@pytest.fixture(scope="module")
def lap() -> Map:
    truth = made_maps.circle(made_maps.LAP)
    return made_maps.flown(Map.empty(), made_maps.room(), A, truth, RIG, drift=0)


def test_M16_a_summary_is_a_small_valid_map_in_which_frames_are_found(lap: Map) -> None:
    small, report = summarize(lap)

    assert check_map(small) == []
    assert report.num_landmarks < 0.6 * len(lap.landmarks)
    assert report.num_descriptors == len(small.observations) < 0.7 * len(lap.observations)
    assert len(small.imu) == len(small.resources) == 0
    places = MapPlaces(small, RecognitionConfig())
    errors = []
    for k, pose in enumerate(made_maps.circle(8, first=2)):
        truth = pose @ SE3.from_rotation(np.eye(3), [0.05, 0.1, 0.0])
        seen = made_maps.see(made_maps.room(), truth, RIG["front"], seed=k)
        found = places.recognize([view_of(seen)], seed=k).found
        if found is not None:
            errors.append(np.linalg.norm(found.consensus.pose.T_map_base.t - truth.t))
    assert len(errors) >= 7
    assert np.median(errors) < 0.05


def test_M16_every_landmark_keeps_at_most_so_many_descriptors(lap: Map) -> None:
    config = SummaryConfig(keyframing=None, sparsify=None, max_observers=2)

    small, _ = summarize(lap, config)

    counts = np.bincount(small.observations.landmark)
    assert counts.max() == 2
    assert len(small.vertices) == len(lap.vertices)
    assert len(small.landmarks) == len(lap.landmarks)


def test_a_map_without_landmarks_has_no_summary() -> None:
    with pytest.raises(MapError, match="create-landmarks"):
        summarize(Map.empty())


def test_M16_one_command_writes_the_summary(lap: Map, tmp_path: Path) -> None:
    save_map(lap, tmp_path / "map")

    with pytest.raises(SystemExit) as left:
        main(["map", str(tmp_path / "map"), "summarize", str(tmp_path / "small")])

    assert left.value.code == 0

    small = load_map(tmp_path / "small")
    assert 0 < len(small.landmarks) < len(lap.landmarks)
    assert small.journal.operation.tolist()[-1] == "summarize"
    assert len(load_map(tmp_path / "map").landmarks) == len(lap.landmarks)
