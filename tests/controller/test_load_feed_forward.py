"""The load feed-forward: its constants by hand, the delay of the rig, planar mechanisms, and where no forces hold the load."""

import numpy as np
import pytest

from controller.cycle import PARAMETERS as CYCLE_PARAMETERS
from controller.cycle import STATE, cycle_parameters
from controller.inverse_kinematics import inverse_kinematics, leg_lengths
from controller.load_feed_forward import find_feed_forward, load_parameters
from controller.rig import rig_parameters
from controller.safety.causes import Cause
from controller.settings import control_settings, fusion_settings
from plant.mechanism import Mechanism, load_in_space
from plant.pose import Pose
from tests.controller.cycles import cycle, follow_at_once
from tests.controller.leg_geometry import rotation_of, static_signals

PLANT = {
    "gravity": [0.0, 0.0, -9.7], "platform.mass": 3.0, "platform.center_of_mass": [0.01, 0.02, 0.03], "payload.mass": 5.0,
    "payload.center_of_mass": [-0.04, 0.05, 0.06], "leg.lower.mass": 0.7, "leg.lower.center": 0.11, "leg.upper.mass": 0.3,
    "leg.upper.center": 0.13, "motor.screw_lead": 0.004, "motor.torque_constant": 0.05, "motor.rotor_inertia": 2e-6,
    "motor.resistance": 9.0, "drive.nominal_resistance": 2.0, "drive.compensation": 0.25, "friction.coulomb": 11.0,
    "friction.viscous": 40.0, "friction.velocity": 2e-3,
}  # fmt: skip


@pytest.fixture(scope="module")
def mechanism(hexapod):
    return Mechanism.from_legs(
        hexapod.base_joints, hexapod.platform_joints, home=hexapod.home, plant={**hexapod.plant, **PLANT},
        limits={"stroke": (-0.06, 0.06), "velocity": 0.2, "acceleration": 3.0, "jerk": 50.0},
    )  # fmt: skip


def test_the_constants_by_hand(mechanism):
    load = load_parameters(mechanism, 0.006)
    turns = 2.0 * np.pi / 0.004
    assert load["command_delay"] == 0.006
    # i = F / (n k) makes the voltage R i fall short by what is not compensated; per speed, n k.
    assert load["droop"] == pytest.approx(2.0 * 0.75 / (turns * 0.05) ** 2, rel=1e-14)
    assert load["sliding_mass"] == pytest.approx(0.3 + 2e-6 * turns**2, rel=1e-14)
    assert load["mass"] == 8.0
    np.testing.assert_allclose(load["first_moment"], [0.03 - 0.2, 0.06 + 0.25, 0.09 + 0.30], rtol=1e-13)
    assert load["lower_moment"] == pytest.approx(0.077, rel=1e-14)
    assert (load["rod_mass"], load["rod_center"]) == (0.3, 0.13)


def test_the_constants_of_a_planar_mechanism():
    load, turns = load_parameters(load_in_space("planar-3rpr"), 0.0), 2.0 * np.pi / 0.002
    assert load["sliding_mass"] == pytest.approx(0.06 + 4e-7 * turns**2, rel=1e-13)
    assert load["inertia"][2, 2] == pytest.approx(2 * 0.0003 + 0.25 * 0.05**2 + 0.5 * (0.05**2 + 0.02**2), rel=1e-13)
    np.testing.assert_allclose(load["first_moment"], [0.25 * 0.05 + 0.5 * 0.05, 0.5 * 0.02, 0.0], rtol=1e-13)


def moving(lengths, speeds, accelerations):
    segments = np.zeros((6, 1, 5))
    segments[: len(lengths), 0, 1:4] = np.column_stack([lengths, speeds, accelerations])
    return segments


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.02])
def test_the_reference_is_sent_ahead_by_the_rigs_delay(mechanism, delay):
    """What the drives are told is the speed that the reference has when they hear it; the rest makes up for droop."""
    lengths = leg_lengths(mechanism, mechanism.home.position, mechanism.home.rotation)
    signals = static_signals(mechanism, mechanism.home.position, mechanism.home.rotation)
    settings = control_settings(mechanism, hold=1e-3), fusion_settings(mechanism)
    parameters = follow_at_once(cycle_parameters(mechanism, 1000.0, *settings, command_delay=delay))
    speeds, accelerations = np.linspace(-0.05, 0.05, 6), np.array([1.0, -2.0, 0.5, -0.5, 2.0, 0.0])
    found = []
    for motion in (np.zeros((6, 2)), np.column_stack([speeds, accelerations])):
        state = np.zeros((), STATE)
        for _ in range(2):
            assert cycle(parameters, state, signals, moving(lengths, *motion.T)) == Cause.NONE
        found.append([state["load"]["feed_forward"].copy(), state["load"]["drive"].copy()])
    ahead, drive = np.subtract(*found[::-1])
    friction = 11.0 * speeds / np.hypot(speeds, 2e-3) + 40.0 * speeds
    expected = speeds + delay * accelerations + 1.5 / (2.0 * np.pi / 0.004 * 0.05) ** 2 * (drive + friction)
    np.testing.assert_allclose(ahead, expected, rtol=1e-9, atol=1e-12)


def feed_forward(mechanism, arms, directions, lengths, rotation, planned=0.0):
    """Of legs in this pose, whose platform moves as planned (2, 6), by the compiled stage, and the droop [m/s/N]."""
    parameters, state = np.zeros((), CYCLE_PARAMETERS), np.zeros((), STATE)
    parameters["rig"], parameters["load"] = rig_parameters(mechanism, 1000.0, 0.2, np.zeros(2)), load_parameters(mechanism, 0.0)
    pose, p, s = state["pose"], parameters[()], state[()]
    pose["arms"], pose["directions"], pose["lengths"], pose["rotation"] = arms, directions, lengths, rotation
    pose["planned"] = planned
    sensors = p["rig"]["sensors"]
    up, gravity = tuple(sensors["up_in_base"][0].tolist()), float(sensors["gravity"])
    find_feed_forward(p["load"], s["load"], p["rig"], s["pose"], s["reference"], up, gravity)
    return state["load"]["feed_forward"], float(p["load"]["droop"])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_where_no_leg_forces_hold_the_load_each_leg_still_carries_its_rod(mechanism, sign):
    """Parallel legs, upright or hanging: of the weight only each rod's own is along its leg."""
    found, droop = feed_forward(mechanism, mechanism.platform_joints, [0.0, 0.0, sign], 0.4, np.eye(3))
    np.testing.assert_allclose(found, sign * droop * 0.3 * 9.7, rtol=1e-12)


@pytest.mark.parametrize("moving", [0.0, 1.0])
def test_forces_on_the_platform_and_the_legs_balance(mechanism, moving):
    """By Newton and Euler, body by body: the legs' forces hold platform, payload, and every leg's own weight, and change the
    momentum and angular momentum of platform and payload, which are differentiated.
    """
    velocity, turn = moving * np.array([0.2, -0.1, 0.3]), moving * np.array([0.8, -0.5, 0.6])
    acceleration, turning = moving * np.array([2.0, 1.0, -1.5]), moving * np.array([5.0, -8.0, 6.0])
    position, rotation = mechanism.home.position + [0.02, -0.01, 0.01], rotation_of([0.1, -0.15, 0.2])
    legs, arms = inverse_kinematics(mechanism, Pose(position, rotation)), mechanism.platform_joints @ rotation.T
    planned = [[*velocity, *turn], [*acceleration, *turning]]
    found, droop = feed_forward(mechanism, arms, legs.directions, legs.lengths, rotation, planned)
    drives = found / droop
    gravity = np.array([0.0, 0.0, -9.7])
    force, moment = np.zeros(3), np.zeros(3)
    for mass, center, own_inertia in (
        (3.0, [0.01, 0.02, 0.03], mechanism.plant["platform.inertia"]),
        (5.0, [-0.04, 0.05, 0.06], mechanism.plant["payload.inertia"]),
    ):
        force += mass * gravity
        moment += np.cross(rotation @ center, mass * gravity)

        def momenta(t, mass=mass, center=center, own=own_inertia):
            """Momentum and angular momentum about where the origin of {2} is at first."""
            turned, rate = rotation_of(t * turn + 0.5 * t**2 * turning) @ rotation, turn + t * turning
            place = t * velocity + 0.5 * t**2 * acceleration + turned @ center
            linear = mass * (velocity + t * acceleration + np.cross(rate, turned @ center))
            return np.concatenate([linear, np.cross(place, linear) + turned @ own @ turned.T @ rate])

        change = (momenta(1e-5) - momenta(-1e-5)) / 2e-5
        force -= change[:3]
        moment -= change[3:]
    for k in range(6):
        r, length = legs.directions[k], legs.lengths[k]
        # The drive pushes the rod along the leg. Across it, the moments about the base joint tell what the platform bears.
        own = 0.7 * 0.11 * gravity + 0.3 * (length - 0.13) * gravity
        borne = (own - (own @ r) * r) / length + (drives[k] + 0.3 * gravity @ r) * r
        force += borne
        moment += np.cross(arms[k], borne)
    np.testing.assert_allclose(force, 0.0, atol=1e-7)
    np.testing.assert_allclose(moment, 0.0, atol=1e-7)
