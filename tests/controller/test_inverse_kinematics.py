"""Inverse kinematics: the paper's (1) by hand, the Jacobian by finite differences, and the compiled twins."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from controller.inverse_kinematics import inverse_kinematics, jacobian_at, leg_lengths, legs_at, sample_workspace
from plant.errors import GoughError, InputError, SingularConfigurationError
from plant.mechanism import Mechanism, load_in_space
from plant.pose import Pose
from tests.controller.leg_geometry import leg_vectors, random_mechanism, random_rotation, rotation_of

TURNS = st.one_of(
    st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    st.sampled_from([(0.0, 0.0, 0.0), (1e-9, 0.0, 0.0), (np.pi, 0.0, 0.0), (0.0, 0.0, np.pi - 1e-9), (0.0, 2.0, -2.0)]),
)


def compiled_legs(mechanism, pose):
    arms, directions, lengths, jacobian = np.zeros((6, 3)), np.zeros((6, 3)), np.zeros(6), np.zeros((6, 6))
    legs_at(mechanism.base_joints, mechanism.platform_joints, pose.position, pose.rotation, arms, directions, lengths)
    jacobian_at(arms, directions, 6, jacobian)
    return arms, directions, lengths, jacobian


def test_a_leg_by_hand():
    # A quarter turn about z carries (0.1, 0.2, 0) to (-0.2, 0.1, 0): p + R a - b = (-0.1, 0.3, 0.6) - (0.2, -0.1, 0).
    base = [[0.2, -0.1, 0.0], [0.3, 0.3, 0.0], [-0.3, 0.2, 0.0], [-0.3, -0.2, 0.0], [0.0, -0.3, 0.0], [0.1, 0.3, 0.0]]
    platform = [[0.1, 0.2, 0.0], [0.2, 0.1, 0.0], [-0.1, 0.2, 0.0], [-0.2, 0.0, 0.0], [0.0, -0.2, 0.0], [0.2, 0.0, 0.0]]
    mechanism = Mechanism.from_legs(base, platform)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    legs = inverse_kinematics(mechanism, Pose(np.array([0.1, 0.2, 0.6]), quarter))
    np.testing.assert_allclose(legs.vectors[0], [-0.3, 0.4, 0.6], atol=1e-15)
    np.testing.assert_allclose(legs.lengths[0], np.sqrt(0.61), rtol=1e-15)
    np.testing.assert_allclose(legs.directions[0], np.array([-0.3, 0.4, 0.6]) / np.sqrt(0.61), rtol=1e-14)
    # The moment of the leg's direction about the platform's origin: (-0.2, 0.1, 0) x (-0.3, 0.4, 0.6).
    np.testing.assert_allclose(legs.jacobian[0, 3:], np.array([0.06, 0.12, -0.05]) / np.sqrt(0.61), rtol=1e-13)


@pytest.mark.slow
@settings(max_examples=80, deadline=None)
@given(TURNS, st.integers(0, 2**32 - 1), st.booleans())
def test_length_rates_are_the_jacobian_times_the_twist(turn, seed, anywhere):
    random = np.random.default_rng(seed)
    mechanism = random_mechanism(random, coplanar=False)
    rotation = random_rotation(random) if anywhere else rotation_of(turn)
    position = random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4]
    jacobian = inverse_kinematics(mechanism, Pose(position, rotation)).jacobian
    h = 1e-6
    numeric = np.zeros((6, 6))
    for i in range(6):
        step = h * np.eye(6)[i]
        ahead, behind = (
            leg_lengths(mechanism, position + sign * step[:3], rotation_of(sign * step[3:]) @ rotation) for sign in (1.0, -1.0)
        )
        numeric[:, i] = (ahead - behind) / (2.0 * h)
    np.testing.assert_allclose(jacobian, numeric, rtol=0.0, atol=2e-9)


@settings(max_examples=80, deadline=None)
@given(TURNS, st.integers(0, 2**32 - 1))
def test_public_compiled_and_batched_forms_agree(turn, seed):
    random = np.random.default_rng(seed)
    mechanism = random_mechanism(random, int(random.integers(3, 7)), int(random.integers(3, 7)))
    pose = Pose(random.uniform(-0.2, 0.2, 3) + [0.0, 0.0, 0.5], rotation_of(turn))
    legs = inverse_kinematics(mechanism, pose)
    arms, directions, lengths, jacobian = compiled_legs(mechanism, pose)
    np.testing.assert_allclose(arms, [pose.rotation @ a for a in mechanism.platform_joints], rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(directions, legs.directions, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(lengths, legs.lengths, rtol=1e-14)
    np.testing.assert_allclose(jacobian, legs.jacobian, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(legs.vectors, leg_vectors(mechanism, pose.position, pose.rotation), rtol=0.0, atol=1e-15)
    batch = leg_lengths(mechanism, np.array([[pose.position] * 2]), np.array([[pose.rotation] * 2]))
    assert batch.shape == (1, 2, 6)
    np.testing.assert_allclose(batch, np.broadcast_to(legs.lengths, (1, 2, 6)), rtol=1e-14)


@settings(max_examples=40, deadline=None)
@given(TURNS, st.integers(0, 2**32 - 1))
@example((0.0, 0.0, 0.0), 0)
def test_virtual_work_of_leg_forces_equals_that_of_their_wrench(turn, seed):
    random = np.random.default_rng(seed)
    mechanism = random_mechanism(random)
    position, rotation = np.array([0.02, -0.03, 0.4]), rotation_of(turn)
    legs = inverse_kinematics(mechanism, Pose(position, rotation))
    forces = random.normal(size=6)
    pulls = forces[:, None] * legs.directions
    joints = position + mechanism.platform_joints @ rotation.T
    wrench = np.concatenate([pulls.sum(axis=0), np.cross(joints - position, pulls).sum(axis=0)])
    np.testing.assert_allclose(legs.jacobian.T @ forces, wrench, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize(
    ("position", "rotation", "said"),
    [
        ([0.0, 0.0, np.nan], np.eye(3), "position"),
        ([0.0, 0.0, np.inf], np.eye(3), "position"),
        ([0.0, 0.4], np.eye(3), "shape"),
        ([0.0, 0.0, 0.4], np.diag([1.0, 1.0, -1.0]), "reflection"),
        ([0.0, 0.0, 0.4], 1.01 * np.eye(3), "orthogonal"),
        ([0.0, 0.0, 0.4], np.eye(2), "shape"),
    ],
)
def test_a_pose_that_is_none_is_refused(hexapod, position, rotation, said):
    with pytest.raises(InputError, match=said) as caught:
        inverse_kinematics(hexapod, Pose(np.array(position), np.array(rotation)))
    assert isinstance(caught.value, GoughError)
    assert isinstance(caught.value, ValueError)


def test_the_hexapod_has_the_home_length_of_its_design(hexapod):
    legs = inverse_kinematics(hexapod, hexapod.home)
    np.testing.assert_allclose(legs.lengths, np.full(6, 0.394), atol=5e-4)
    assert np.linalg.cond(legs.jacobian) < 100.0


def test_sampled_poses_are_inside_the_strokes_fill_them_and_can_be_drawn_again(hexapod):
    positions, rotations = sample_workspace(hexapod, 500, seed=3)
    lengths = leg_lengths(hexapod, positions, rotations)
    stroke = hexapod.limits.stroke
    assert (lengths > stroke[:, 0]).all()
    assert (lengths < stroke[:, 1]).all()
    # Every leg comes near both of its ends.
    reached = (np.stack([lengths.min(axis=0), lengths.max(axis=0)], axis=1) - stroke[:, :1]) / np.diff(stroke)
    assert (reached[:, 0] < 0.05).all()
    assert (reached[:, 1] > 0.95).all()
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (500, 3, 3)), atol=1e-14)
    again = sample_workspace(hexapod, 500, seed=3)
    np.testing.assert_array_equal(positions, again[0])
    np.testing.assert_array_equal(rotations, again[1])
    # A smaller sample is the beginning of a larger one, another seed another sample.
    np.testing.assert_array_equal(positions[:7], sample_workspace(hexapod, 7, seed=3)[0])
    assert np.abs(positions - sample_workspace(hexapod, 500, seed=4)[0]).min(axis=0).max() > 0.0


def test_a_workspace_wants_home_and_stroke(hexapod):
    without_home = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints)
    without_stroke = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints, home=hexapod.home)
    for mechanism, said in ((without_home, "home"), (without_stroke, "stroke")):
        with pytest.raises(InputError, match=said):
            sample_workspace(mechanism, 1, seed=0)


def test_a_home_far_outside_the_stroke_is_an_error_and_not_an_endless_search(hexapod):
    """In a process of its own, which can be ended: the stroke is in millimetres by mistake."""
    program = (
        "from controller.inverse_kinematics import sample_workspace\n"
        "from plant.mechanism import Mechanism, load_mechanism\n"
        "from plant.errors import InputError\n"
        "h = load_mechanism('hexapod')\n"
        "try:\n"
        "    limits = {'stroke': [[334.0, 454.0]] * 6}\n"
        "    m = Mechanism.from_legs(h.base_joints, h.platform_joints, home=h.home, limits=limits)\n"
        "    sample_workspace(m, 1, seed=0)\n"
        "except InputError:\n"
        "    print('refused')\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=False)
    assert run.stdout.strip() == "refused", run.stderr


def test_a_planar_mechanisms_jacobian_keeps_it_in_its_plane():
    """Its first rows are the slopes of three lengths, by finite differences; the others ask for what leaves the plane."""
    rig = load_in_space("planar-3rpr")
    arms, directions, lengths, jacobian = np.zeros((6, 3)), np.zeros((6, 3)), np.zeros(6), np.full((6, 6), np.nan)
    base, platform = (np.vstack([each, np.full((3, 3), 0.7)]) for each in (rig.base_joints, rig.platform_joints))
    base[3:] = 0.0
    position, rotation = rig.home.position + [0.01, -0.02, 0.0], rotation_of([0.0, 0.0, 0.3]) @ rig.home.rotation
    legs_at(base, platform, position, rotation, arms, directions, lengths)
    jacobian_at(arms, directions, 3, jacobian)
    h = 1e-6
    for i, step in enumerate(h * np.eye(6)):
        ahead, behind = (
            leg_lengths(rig, position + sign * step[:3], rotation_of(sign * step[3:]) @ rotation) for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(jacobian[:3, i], (ahead - behind) / (2.0 * h), rtol=0.0, atol=1e-8)
    # No translation along z, no turns about x and y.
    np.testing.assert_array_equal(jacobian[3:], np.eye(6)[2:5])


@pytest.mark.parametrize("leg", [0, 4])
def test_a_leg_without_a_length_is_named(hexapod, leg):
    position = hexapod.base_joints[leg] - hexapod.platform_joints[leg]
    with pytest.raises(SingularConfigurationError, match=f"leg {leg} has no length at this pose"):
        inverse_kinematics(hexapod, Pose(position, np.eye(3)))


def test_sampled_poses_keep_to_their_box_about_a_turned_home(hexapod):
    """Four fifths of the widest stroke's range to either side, and 0.35 rad about each axis of {1}."""
    home = Pose(hexapod.home.position, rotation_of([0.0, 0.0, 0.5]))
    lengths = inverse_kinematics(hexapod, home).lengths
    stroke = lengths[:, None] + np.array([[-0.06, 0.06]] * 5 + [[-0.05, 0.07]])
    mechanism = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints, home=home, limits={"stroke": stroke})
    positions, rotations = sample_workspace(mechanism, 1000, seed=5)
    away = np.abs(positions - home.position).max(axis=0)
    turns = np.array([Rotation.from_matrix(rotation @ home.rotation.T).as_rotvec() for rotation in rotations])
    assert 0.08 < away.max() <= 0.096
    assert 0.34 < np.abs(turns).max() <= 0.35
    # Either way alike.
    assert np.abs((positions - home.position).mean(axis=0)[:2]).max() < 0.01
