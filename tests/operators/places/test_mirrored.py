"""Poses that a part of one plane fits as well as the true one does."""

import numpy as np
import pytest

from mapstream.operators.places.geometry.consensus import Consensus, ConsensusConfig, find_pose
from mapstream.operators.places.geometry.mirrored import mirrored
from mapstream.operators.places.geometry.refinement import Noise, errors
from mapstream.operators.places.geometry.sightings import Sightings
from mapstream.operators.places.recognition import RecognitionConfig, refuse_ambiguous
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from tests.operators.places import scenes

TRUTH = SE3.identity()
NOISE = Noise(sigma_px=2.0, sigma_m=0.05)
CONFIG = RecognitionConfig()


def _poster(size_m: tuple[float, float], count: int = 60) -> FloatArray:
    """Points of a picture 4.5 m ahead, on a wall that is turned by 30 degrees."""
    rng = np.random.default_rng(3)
    flat = np.zeros((count, 3))
    flat[:, 1:] = rng.uniform(-0.5, 0.5, (count, 2)) * size_m
    turn = [0, 0, np.deg2rad(30), 0, 0, 0]
    return SE3.from_rotation(SE3.exp(turn).R, [4.5, 0.3, 0.2]) @ flat


def _seen(size_m: tuple[float, float]) -> tuple[Sightings, Consensus]:
    points = _poster(size_m)
    sightings = scenes.look((scenes.camera(),), TRUTH, points, sigma_px=0.7, seed=4)
    consensus = find_pose(sightings, ConsensusConfig(), seed=5)
    return sightings.take(consensus.is_inlier), consensus


def test_U1_a_small_picture_fits_a_pose_metres_off_and_is_refused() -> None:
    inliers, consensus = _seen((0.8, 0.5))

    with pytest.raises(EstimationError, match=r"of the inliers fit a pose 4\.\d m off as well"):
        refuse_ambiguous(inliers, consensus, CONFIG)
    refuse_ambiguous(inliers, consensus, CONFIG.model_copy(update={"max_mirrored_share": 1.0}))


def test_a_whole_wall_fits_one_pose() -> None:
    inliers, consensus = _seen((4.0, 2.5))

    refuse_ambiguous(inliers, consensus, CONFIG)

    assert np.linalg.norm(consensus.pose.T_map_base.t) < 0.05


def test_points_of_a_plane_keep_their_middle_and_lean_the_other_way() -> None:
    inliers, _ = _seen((0.8, 0.5))
    rival = mirrored(inliers, TRUTH.matrix)

    assert np.mean(errors(inliers, rival, NOISE) <= 3) > 0.9
    np.testing.assert_allclose(mirrored(inliers, rival), TRUTH.matrix, atol=1e-9)
