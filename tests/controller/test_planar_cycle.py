"""Planar mechanisms in the cycle: direct kinematics with the roll, refinement, kinematics and load in the plane."""

import re

import numpy as np
import pytest
from scipy.optimize import least_squares

from controller.cycle import STATE, cycle_parameters
from controller.direct_kinematics import poses_from_lengths
from controller.direct_kinematics.geometry import geometry_of
from controller.direct_kinematics.planar import pose_from_roll, solve_planar
from controller.imu_set import check_imus
from controller.inverse_kinematics import leg_lengths, sample_workspace
from controller.planning.target import load_target
from controller.settings import control_settings, fusion_settings
from plant.errors import InputError
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import Mechanism, load_in_space, load_mechanism
from plant.pose import rotation_from_vector
from tests.controller.cycles import cycle, find, refine
from tests.plant.dynamics.planar_bodies import coordinates, frames_at, jacobian, weight_force

RATE_HZ = 1000.0
PLATFORM = 6


@pytest.fixture(scope="module")
def planar():
    return load_mechanism("planar-3rpr")


@pytest.fixture(scope="module")
def rig():
    return load_in_space("planar-3rpr")


def turned(angle):
    return rotation_from_vector([0.0, 0.0, angle])


def directions_at(angles):
    """(6, 3) of legs at angles (3,)."""
    directions = np.zeros((6, 3))
    directions[:3, 0], directions[:3, 1] = np.cos(angles), np.sin(angles)
    return directions


def leg_angles(planar, position, angle):
    x, y = (planar.joints_at(np.asarray(position), angle) - planar.base_joints).T
    return np.arctan2(y, x)


def found_from_roll(rig, angles, roll, legs=(1.0, 1.0, 1.0), up=(0.0, 1.0, 0.0)):
    position, rotation = np.zeros(3), np.zeros((3, 3))
    conditioning = pose_from_roll(
        geometry_of(rig), directions_at(angles), np.array([*legs, 0.0, 0.0, 0.0]), np.array(up), np.array(up) @ turned(roll),
        position, rotation,
    )  # fmt: skip
    return conditioning, position, rotation


@pytest.mark.parametrize("legs", [(1, 1, 1), (1, 1, 0), (0, 1, 1)])
def test_the_roll_and_two_legs_give_the_pose_of_the_clear_solver(planar, rig, legs):
    random = np.random.default_rng(sum(legs))
    for _ in range(50):
        angle = random.uniform(-np.pi, np.pi)
        angles = leg_angles(planar, random.uniform((0.05, 0.1), (0.2, 0.3)), angle) + random.normal(0.0, 0.01, 3)
        known = np.where(np.array(legs, bool), angles, np.nan)
        (mode,) = solve_planar(planar, known, roll=angle)
        conditioning, position, rotation = found_from_roll(rig, angles, angle, legs, up=(0.6, 0.64, 0.48))
        np.testing.assert_allclose(position, [*mode.position, 0.0], rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(rotation, turned(angle), rtol=0.0, atol=1e-14)
        assert conditioning == pytest.approx(mode.conditioning, rel=1e-7)


def test_the_roll_tells_the_assembly_modes_apart(planar, rig):
    """The same leg angles belong to two poses; each is found with its own roll, and with no guess."""
    modes = solve_planar(planar, leg_angles(planar, (0.1, 0.205), -0.4))
    assert len(modes) == 2
    assert abs(modes[0].angle - modes[1].angle) > 0.5
    for mode in modes:
        _, position, rotation = found_from_roll(rig, leg_angles(planar, mode.position, mode.angle), mode.angle)
        np.testing.assert_allclose(position[:2], mode.position, atol=1e-12)
        np.testing.assert_allclose(rotation, turned(mode.angle), atol=1e-12)


@pytest.mark.parametrize(
    ("angles", "legs", "up"),
    [
        ([0.7, 0.7, 0.7 + np.pi], (1, 1, 1), (0.0, 1.0, 0.0)),
        ([0.7, 1.0, 1.3], (1, 0, 0), (0.0, 1.0, 0.0)),
        ([0.7, 1.0, 1.3], (1, 1, 1), (0.0, 0.0, 1.0)),
    ],
    ids=["parallel legs", "one leg", "no roll"],
)
def test_what_gives_no_pose_has_no_conditioning(rig, angles, legs, up):
    assert found_from_roll(rig, angles, 0.3, legs, up)[0] == 0.0


def parameters_of(rig, **settings):
    return cycle_parameters(rig, RATE_HZ, control_settings(rig), fusion_settings(rig), **settings)


def test_the_refined_pose_is_the_optimum_in_the_plane(planar, rig):
    """Against a solver of its own on the angles of legs and platform, weighted alike; and so is its covariance."""
    random = np.random.default_rng(3)
    parameters = parameters_of(rig)
    sigmas = 1.0 / np.sqrt([parameters["legs"]["weight"]] * 3 + [parameters["platform"]["weight"]])
    for _ in range(10):
        angle = random.uniform(-0.8, 0.2)
        angles = leg_angles(planar, random.uniform((0.08, 0.19), (0.12, 0.22)), angle) + 1e-3 * random.normal(size=3)
        roll = angle + 1e-3 * random.normal()
        state = np.zeros((), STATE)
        # The vertical seems to lean out of the plane, as a biased accelerometer has it, and the pose must not follow.
        pose = state["pose"]
        state["legs"]["directions"], pose["vectors"][0] = directions_at(angles), np.array([0.0, 1.0, 0.005]) @ turned(roll)
        state["legs"]["used"][:3], state["legs"]["weights"][:3] = 1.0, parameters["legs"]["weight"]
        state["platform"]["used"], state["pose"]["vector_weights"][0] = 1, parameters["platform"]["weight"]
        assert find(parameters, state) > 0.1
        assert refine(parameters, state)

        def residuals(q, angles=angles, roll=roll):
            return np.append(leg_angles(planar, q[:2], q[2]) - angles, q[2] - roll) / sigmas

        best = least_squares(residuals, [*pose["position"][:2], roll], x_scale=[1e-2, 1e-2, 0.1], xtol=1e-15, ftol=1e-15)
        found = np.append(pose["position"][:2], np.arctan2(pose["rotation"][1, 0], pose["rotation"][0, 0]))
        np.testing.assert_allclose(found, best.x, rtol=0.0, atol=1e-7)
        lower = state["pose"]["information"]
        information = np.tril(lower) + np.tril(lower, -1).T
        covariance = np.linalg.inv(information)[np.ix_([0, 1, 5], [0, 1, 5])]
        np.testing.assert_allclose(covariance, np.linalg.inv(best.jac.T @ best.jac), rtol=1e-2)
        assert state["pose"]["position"][2] == 0.0
        np.testing.assert_array_equal(state["pose"]["rotation"][2], [0.0, 0.0, 1.0])


def test_poses_in_the_plane_follow_from_three_lengths(rig):
    positions, rotations = sample_workspace(rig, 40, seed=1)
    assert not positions[:, 2].any() and (rotations[:, 2, 2] == 1.0).all()
    for position, rotation in zip(positions, rotations, strict=True):
        lengths = leg_lengths(rig, position, rotation)
        again, turn = poses_from_lengths(rig, [lengths], rig.home)
        np.testing.assert_allclose(again[0], position, atol=1e-11)
        np.testing.assert_allclose(turn[0], rotation, atol=1e-11)


def signals_at(rig, angle_of_home=0.0):
    """What ideal IMUs read at rest at home (3, 7, 3)."""
    p = rig.plant_parameters()
    home = np.arctan2(rig.home.rotation[1, 0], rig.home.rotation[0, 0])
    frames, _ = frames_at(p, rig.home.position[:2], home + angle_of_home)
    signals = np.zeros((3, 7, 3))
    signals[1, [0, 1, 2, PLATFORM]] = -np.swapaxes(frames, 1, 2) @ p["gravity"]
    return signals


def test_at_rest_the_commands_make_up_for_the_weight(rig):
    """The feed-forward is the droop times the force that virtual work demands, worked out from explicit bodies."""
    parameters, state = parameters_of(rig), np.zeros((), STATE)
    segments = np.zeros((6, 1, 5))
    segments[:3, 0, 1] = leg_lengths(rig, rig.home.position, rig.home.rotation)
    for _ in range(300):
        assert cycle(parameters, state, signals_at(rig), segments) == 0
    p = rig.plant_parameters()
    q = np.array([*rig.home.position[:2], np.arctan2(rig.home.rotation[1, 0], rig.home.rotation[0, 0])])
    forces = np.linalg.solve(jacobian(p, q)[-3:].T, -weight_force(p, q))
    np.testing.assert_allclose(state["load"]["feed_forward"][:3], parameters["load"]["droop"] * forces, rtol=1e-6)
    np.testing.assert_allclose(state["pose"]["lengths"][:3], coordinates(p, q)[-3:], atol=1e-8)
    for stage, name in (("pose", "lengths"), ("pid", "command"), ("load", "feed_forward"), ("pid", "error")):
        assert not state[stage][name][3:].any()


def variant(planar, **changes):
    """The same rig with another home and gravity."""
    made = type(planar).from_legs(
        planar.base_joints,
        planar.platform_joints,
        home=changes.pop("home", planar.home),
        limits={"stroke": [-0.02, 0.02]},
        plant={**planar.plant, **changes},
    )
    return Mechanism.from_planar(made)


def test_a_level_leg_is_no_worse_than_others(planar):
    """Gravity along a leg does not tell a second angle, which a joint in the plane has not."""
    home = type(planar.home)([0.25, 0.0], -1.5)
    rig = variant(planar, home=home)
    parameters, state = parameters_of(rig), np.zeros((), STATE)
    segments = np.zeros((6, 1, 5))
    random = np.random.default_rng(0)
    for _ in range(400):
        signals = signals_at(rig)
        signals[:2] += np.array([5e-4, 0.02])[:, None, None] * random.normal(size=(2, 7, 3))
        cycle(parameters, state, signals, segments)
    assert state["legs"]["directions"][0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-3)
    np.testing.assert_allclose(state["pose"]["position"], [0.25, 0.0, 0.0], atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "asked", "said"),
    [
        ({}, {"imus": (0, 1, 2)}, "the IMUs 0, 1, 2 determine the pose of 'custom' up to its two assembly modes at best"),
        ({}, {"imus": (0, 2)}, "which the loop cannot tell apart: add the platform's IMU (6), whose roll does"),
        ({}, {"imus": (1, 6)}, "the IMUs 1, 6 do not determine the pose of 'custom' everywhere in its workspace"),
        ({}, {"imus": (1, 6)}, "add legs"),
        ({}, {"magnetometer": True}, "'custom' is planar and has no heading"),
        ({"gravity": [0.0, 0.0, -9.81]}, {}, "of the vertical only 0 lies in it, and 0.2 is needed"),
    ],
)
def test_imus_that_cannot_do_are_refused(planar, changes, asked, said):
    with pytest.raises(InputError, match=re.escape(said)):
        check_imus(variant(planar, **changes), **{"imus": ALL_IMUS, **asked})


@pytest.mark.parametrize("name", ["hold", "circle", "sines", "steps", "rests", "shaking"])
def test_named_motions_stay_in_the_plane_and_the_stroke(rig, name):
    target = load_target(name, rig, 6.0)
    assert not target.positions[:, 2].any()
    np.testing.assert_array_equal(target.rotations[:, 2], np.tile([0.0, 0.0, 1.0], (len(target.times), 1)))
    rig.check_lengths(leg_lengths(rig, target.positions, target.rotations), name)
    moves = np.ptp(target.positions[:, :2], axis=0)
    turns = np.ptp(np.unwrap(np.arctan2(target.rotations[:, 1, 0], target.rotations[:, 0, 0])))
    assert name == "hold" or (moves.min() > 5e-3 and turns > np.radians(2.0))


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("0.0,0.0,0.003,1.0,0.0,0.0,0.0", "leaves the plane of 'planar-3rpr' at 0.5 s by 3 mm and 0 deg: give x, y and a turn"),
        ("0.0,0.0,0.0,0.9998477,0.0174524,0.0,0.0", "leaves the plane of 'planar-3rpr' at 0.5 s by 0 mm and 2 deg"),
    ],
)
def test_a_target_out_of_the_plane_is_refused(rig, tmp_path, row, said):
    path = tmp_path / "motion.csv"
    header = "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0.0,0.0,0.0,0.0,1.0,0.0,0.0,0.0\n"
    path.write_text(f"{header}0.5,{row}\n")
    with pytest.raises(InputError, match=re.escape(said)):
        load_target(path, rig, 1.0)
    path.write_text(f"{header}0.5,0.004,-0.002,0.0,0.9998477,0.0,0.0,0.0174524\n")
    np.testing.assert_allclose(load_target(path, rig, 1.0).positions[1], rig.home.position + [0.004, -0.002, 0.0], atol=1e-15)
