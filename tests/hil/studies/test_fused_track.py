"""Errors of tracks of poses: their root mean squares, their consistency, and what is pooled."""

import numpy as np
import pytest

from hil.studies.fused_track import PoseTrack, pooled
from plant.pose import rotation_from_vector


@pytest.fixture
def truth():
    random = np.random.default_rng(0)
    rotations = np.array([rotation_from_vector(vector) for vector in random.normal(scale=0.3, size=(2000, 3))])
    return PoseTrack(random.normal(size=(2000, 3)), rotations)


def disturbed(truth, root, seed):
    """The true poses with errors of the covariance `root @ root.T`."""
    errors = np.random.default_rng(seed).normal(size=(len(truth.positions), 6)) @ root.T
    turns = np.array([rotation_from_vector(vector) for vector in errors[:, 3:]])
    return truth.positions + errors[:, :3], turns @ truth.rotations


def test_errors_of_the_stated_covariance_are_consistent(truth):
    root = np.random.default_rng(1).normal(scale=1e-3, size=(6, 6))
    covariances = np.broadcast_to(root @ root.T, (2000, 6, 6))
    poses = disturbed(truth, root, 2)
    for stated in ({"covariances": covariances}, {"information": np.linalg.inv(covariances)}):
        track = PoseTrack(*poses, **stated)
        assert track.nees(track.errors(truth)) == pytest.approx(6.0, rel=0.05)
        early = PoseTrack(*(each[:10] for each in poses), **{name: each[:10] for name, each in stated.items()})
        assert early.nees(track.errors(truth)[:10]) == pytest.approx(6.0, rel=0.8)
    assert PoseTrack(*poses).nees(track.errors(truth)) is None


def test_pooled_errors_count_each_track_the_same_and_know_the_worst(truth):
    tracks = [
        PoseTrack(*disturbed(truth, np.diag([size] * 3 + [2.0 * size] * 3), seed), us=8.0)
        for seed, size in enumerate((1e-3, 3e-3))
    ]
    figures = [track.figures(truth) for track in tracks]
    expected = np.sqrt(3.0 * (1e-6 + 9e-6) / 2.0)
    assert pooled(figures)["position_rms"] == pytest.approx(expected, rel=0.03)
    assert pooled(figures)["rotation_rms"] == pytest.approx(2.0 * expected, rel=0.03)
    assert pooled(figures)["nees"] is None and figures[0]["us"] == 8.0
    assert set(pooled(figures)) == {"position_rms", "rotation_rms", "nees"}
    assert pooled(figures, worst=True)["worst_position_rms"] == pytest.approx(np.sqrt(27.0) * 1e-3, rel=0.03)


def test_the_pooled_consistency_is_the_mean_where_it_is_known():
    rms = {"position_rms": 1e-3, "rotation_rms": 2e-3}
    assert pooled([rms | {"nees": 3.0}, rms | {"nees": 8.0}])["nees"] == 5.5
    assert pooled([rms, rms]) == pytest.approx(rms)
