"""The linear loop at a pose: against the statics, the kinematics, the FMU's own derivatives, and delays that are known."""

import control
import numpy as np
import pytest

from controller.design.linear_loop import MOST_DELAY_PERIODS, Setup, linear_plant, open_loop
from controller.design.linearization import state_space
from controller.design.tuning import workspace_poses
from controller.inverse_kinematics import inverse_kinematics
from plant.dynamics.variables import VELOCITY
from plant.errors import InputError
from plant.fmu.build import default_fmu, model_of
from plant.fmu.calls import write_drive_mode
from plant.fmu.plant import FmuPlant
from plant.imu import load_imu
from plant.mechanism import load_in_space
from plant.pose import Pose, rotation_from_vector
from tests.controller.leg_geometry import static_signals

RATE_HZ = 500.0
SETUP = Setup(RATE_HZ)
POINTS = np.exp(2j * np.pi * np.array([0.5, 2.0, 5.0, 20.0]) / RATE_HZ)


def response(loop):
    return np.moveaxis(loop(POINTS), 2, 0)


def tilted(mechanism):
    return Pose(mechanism.home.position + [0.02, -0.01, 0.015], rotation_from_vector([0.1, -0.05, 0.15]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexapod", "6-3-II"])
def test_the_open_loop_integrates_the_commands_into_the_estimated_lengths(name):
    """A small step of one command after the other: when the filters have settled, each estimated leg moves at that speed."""
    mechanism = load_in_space(name)
    (pose,) = workspace_poses(mechanism, 1, seed=3)
    loop, n = open_loop(mechanism, SETUP, pose), mechanism.legs
    states, lengths = np.zeros((len(loop.A), n)), []
    for _ in range(round(1.0 * RATE_HZ)):
        lengths.append(loop.C @ states)
        states = loop.A @ states + loop.B
    speeds = (lengths[-1] - lengths[-round(0.4 * RATE_HZ)]) / (0.4 - 1.0 / RATE_HZ)
    np.testing.assert_allclose(speeds, np.eye(n), rtol=0.0, atol=0.05)


def test_the_linear_plants_imus_read_gravity_and_the_turning_of_the_legs(hexapod):
    for pose in (hexapod.home, tilted(hexapod)):
        plant, at_rest = linear_plant(hexapod, SETUP, pose)
        rates, forces = at_rest.reshape(2, 7, 3)
        np.testing.assert_allclose(rates, 0.0, atol=1e-12)
        np.testing.assert_allclose(forces, static_signals(hexapod, pose.position, pose.rotation)[1], atol=1e-6)
        # After half a second at even speed the platform's gyroscope reads the turn that the inverse Jacobian tells.
        states = np.zeros((len(plant.A), 6))
        for _ in range(round(0.5 * RATE_HZ)):
            states = plant.A @ states + plant.B
        turning = (plant.C @ states).reshape(2, 7, 3, 6)[0, 6]
        expected = np.linalg.inv(inverse_kinematics(hexapod, pose).jacobian)[3:]
        np.testing.assert_allclose(turning, pose.rotation.T @ expected, rtol=0.0, atol=0.05 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexapod", "planar-3rpr"])
def test_it_is_the_fmu_linearised_by_its_own_derivatives(name):
    """Driven, which it is not at its start; soon after that, before it has sunk. Below 2 Hz that little would count already."""
    mechanism = load_in_space(name)
    parameters = mechanism.plant_parameters() | {"friction.coulomb": np.zeros(mechanism.legs)}
    plant = FmuPlant(default_fmu(model_of(mechanism)), parameters, 1e-3)
    try:
        write_drive_mode(plant.handle, VELOCITY)
        for _ in range(5):
            plant.step(1e-3)
        linear = state_space(plant, outputs=("leg_length", "imu_angular_velocity"))
    finally:
        plant.close()
    ours, _ = linear_plant(mechanism, SETUP, mechanism.home)
    theirs = control.sample_system(linear, 1.0 / RATE_HZ, method="zoh")
    n, count = mechanism.legs, 3 * (mechanism.legs + 1)
    rows = [*range(3 * n), *range(18, 21)]
    found, expected = response(ours)[1:, rows], response(theirs)[1:, n : n + count]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=0.02 * np.abs(expected).max())


def test_a_delay_turns_the_phase_by_its_share_of_the_period_and_leaves_the_gain():
    mechanism = load_in_space("planar-3rpr")

    def turning(delay):
        plant, _ = linear_plant(mechanism, Setup(RATE_HZ, delay=delay), mechanism.home)
        return response(plant)[:, 20]

    plain = turning(0.0)
    for delay in (2e-3, 3.1e-3, 0.4e-3):
        late = turning(delay)
        np.testing.assert_allclose(np.angle(late / plain) / (np.angle(POINTS)[:, None] * RATE_HZ), -delay, rtol=0.01)
        np.testing.assert_allclose(np.abs(late), np.abs(plain), rtol=0.02)


def test_drives_with_position_loops_follow_and_do_not_droop(hexapod):
    """At even speed the platform turns as the inverse Jacobian tells, however the load changes; drives without them droop."""
    pose, off = tilted(hexapod), []
    expected = pose.rotation.T @ np.linalg.inv(inverse_kinematics(hexapod, pose).jacobian)[3:]
    for bandwidth in (60.0, None):
        plant, _ = linear_plant(hexapod, Setup(RATE_HZ, bandwidth=bandwidth), pose)
        states = np.zeros((len(plant.A), 6))
        for _ in range(round(1.5 * RATE_HZ)):
            states = plant.A @ states + plant.B
        turning = (plant.C @ states).reshape(2, 7, 3, 6)[0, 6]
        off.append(np.abs(turning - expected).max() / np.abs(expected).max())
    assert off[0] < 2e-3 < 0.02 < off[1]


def test_the_low_passes_of_an_imu_come_later_by_its_latency_than_the_filters_make_up_for():
    """The delay is known to the filters, which extrapolate: what is left is small beside it at low frequencies."""
    mechanism = load_in_space("6-3-I")
    imu = load_imu("icm42688-nominal")
    plain, late = (response(open_loop(mechanism, Setup(RATE_HZ, imu=each))) for each in (None, imu))
    phases = np.angle(late / plain)[:, 0, 0]
    assert np.abs(phases[:3]).max() < 0.3 * imu.latency * 2.0 * np.pi * 5.0
    assert np.abs(phases[3]) > 0.0


def test_what_cannot_be_is_refused_with_its_limit():
    with pytest.raises(
        InputError, match=f"delay is 65 ms; at 500 Hz it must be 0 to 64 ms, which is {MOST_DELAY_PERIODS} periods"
    ):
        Setup(RATE_HZ, delay=0.065)
    with pytest.raises(InputError, match="delay"):
        Setup(RATE_HZ, delay=-1e-3)
    with pytest.raises(InputError, match="delay is nan"):
        Setup(RATE_HZ, delay=np.nan)
    with pytest.raises(InputError, match="rate"):
        Setup(0.0)
