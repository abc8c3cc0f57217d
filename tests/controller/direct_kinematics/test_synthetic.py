"""Synthetic measurements have the noise that they should."""

import numpy as np
import pytest

from controller.direct_kinematics.synthetic import draw_measurements, draw_poses
from plant.mechanism import load_spatial


def test_measurements_have_the_sigmas_that_are_stated():
    mechanism, random = load_spatial("hexapod"), np.random.default_rng(1)
    positions, rotations = draw_poses(mechanism, 20_000, random)
    exact = draw_measurements(mechanism, positions, rotations, random, 0.0)
    noisy = draw_measurements(mechanism, positions, rotations, random, 1.0)
    np.testing.assert_allclose(exact["normal"], rotations[:, :, 2], atol=1e-15)
    np.testing.assert_allclose(exact["rotation"], rotations, atol=1e-15)
    np.testing.assert_allclose(exact["up_in_platform"], rotations[:, 2], atol=1e-15)
    vectors = positions[:, None] + np.einsum("nij,kj->nki", rotations, mechanism.platform_joints) - mechanism.base_joints
    np.testing.assert_allclose(np.cross(exact["leg_directions"], vectors), 0.0, atol=1e-15)
    for name in ("leg_directions", "up_in_platform", "normal"):
        across = np.sum((noisy[name] - exact[name]) ** 2, axis=-1).mean() / 2.0
        np.testing.assert_allclose(np.degrees(np.sqrt(across)), 0.05, rtol=0.03, err_msg=name)
    turns = noisy["rotation"] @ np.swapaxes(rotations, 1, 2)
    sines = 0.5 * np.stack([turns[:, 2, 1] - turns[:, 1, 2], turns[:, 0, 2] - turns[:, 2, 0], turns[:, 1, 0] - turns[:, 0, 1]])
    np.testing.assert_allclose(np.degrees(sines.std(axis=1)), [0.05, 0.05, 1.5], rtol=0.03)
    assert np.abs(positions - mechanism.home.position).max() == pytest.approx(0.05, rel=0.01)
