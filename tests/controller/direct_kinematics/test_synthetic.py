"""Synthetic measurements have the noise that they should."""

import numpy as np
import pytest

from controller.direct_kinematics.synthetic import draw_measurements, draw_poses, measurements_of
from plant.mechanism import Mechanism, load_spatial
from plant.pose import Pose
from tests.controller.leg_geometry import rotation_of, unit


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


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_with_a_leaning_vertical_the_yaw_is_about_it_and_poses_are_about_a_turned_home(noise):
    hexapod, random, up = load_spatial("hexapod"), np.random.default_rng(2), unit([0.5, -0.3, 0.8])
    home = Pose(hexapod.home.position + [0.1, 0.2, 0.0], rotation_of([0.0, 0.0, 1.2]))
    mechanism = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints, up_in_base=up, home=home)
    positions, rotations = draw_poses(mechanism, 5000, random)
    np.testing.assert_allclose(np.abs(positions - home.position).max(axis=0), 0.05, rtol=0.01)
    # By xyz angles about the axes of {1}, before that home.
    turned = rotations @ home.rotation.T
    about_y = -np.arcsin(turned[:, 2, 0])
    angles = np.arctan2(turned[:, 2, 1], turned[:, 2, 2]), about_y, np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    np.testing.assert_allclose(np.degrees(np.abs(angles).max(axis=1)), 15.0, rtol=0.01)
    np.testing.assert_allclose(np.degrees(np.std(angles, axis=1)), 15.0 / np.sqrt(3.0), rtol=0.04)
    found = draw_measurements(mechanism, positions, rotations, random, noise)
    off = found["rotation"] @ np.swapaxes(rotations, 1, 2)
    turns = 0.5 * np.stack([off[:, 2, 1] - off[:, 1, 2], off[:, 0, 2] - off[:, 2, 0], off[:, 1, 0] - off[:, 0, 1]], axis=1)
    level = unit(np.cross(up, [1.0, 0.0, 0.0]))
    sizes = np.degrees((turns @ np.stack([up, level, np.cross(up, level)], axis=1)).std(axis=0))
    np.testing.assert_allclose(sizes, noise * np.array([1.5, 0.05, 0.05]), rtol=0.05)
    vertical = np.einsum("nij,nj->ni", rotations, found["up_in_platform"])
    assert np.degrees(np.sqrt(np.mean(np.sum((vertical - up) ** 2, axis=1)) / 2.0)) == pytest.approx(0.05 * noise, rel=0.05)


@pytest.mark.parametrize(
    ("method", "names"),
    [
        ("legs", []), ("section-3.1.1", []), ("up", ["up_in_platform"]), ("normal", ["normal"]), ("section-4", ["normal"]),
        ("section-5", ["rotation"]),
    ],
)  # fmt: skip
def test_a_method_gets_what_it_uses(method, names):
    everything = {name: np.zeros(3) for name in ("leg_directions", "up_in_platform", "normal", "rotation")}
    assert list(measurements_of(method, everything)) == ["leg_directions", *names]
