"""The platform's heading: its filter against a Kalman filter on an angle, and what the cycle makes of the magnetometer."""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.cycle import STATE, cycle_parameters
from controller.direct_kinematics import solve
from controller.estimation.heading_filter import ERRORS, STATES, predict_heading, start_heading, update_heading
from controller.imu_set import check_imus
from controller.inverse_kinematics import leg_lengths, sample_workspace
from controller.safety.causes import Cause
from controller.settings import DriveSettings, FusionSettings, SafetySettings, control_settings, fusion_settings
from plant.dynamics.variables import PLATFORM_IMU
from plant.errors import InputError
from plant.imu import MAGNETOMETER, imu_state, load_imu, measure
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import Mechanism
from tests.controller.cycles import cycle
from tests.controller.leg_geometry import UP, angle_between, leg_directions, rotation_of, static_signals

PERIOD_S, EVERY = 1e-3, 10
FIELD = np.array([18.0, 0.0, -46.0])
FUSION = FusionSettings()
NOISE = (FUSION.gyroscope_noise**2, FUSION.bias_walk**2)
VARIANCE = FUSION.magnetometer_noise**2 * 50.0 / 18.0**2
TWO_LEGS = (0, 3, PLATFORM_IMU)
BIAS = np.radians(0.3)


def turning(count):
    """Rotations (N, 3, 3) of a platform that rolls, pitches and yaws up to 60 deg/s, and its rates (N, 3) over each step."""
    t = PERIOD_S * np.arange(count + 1)
    angles = np.column_stack([0.2 * np.sin(4.0 * t), 0.2 * np.sin(3.0 * t + 1.0), 0.5 * np.sin(2.0 * t)])
    rotations = Rotation.from_euler("xyz", angles)
    return rotations.as_matrix()[1:], (rotations[:-1].inv() * rotations[1:]).as_rotvec() / PERIOD_S


def follow(rotations, rates, random, noise=1.0):
    """Headings' errors [rad] and states after each step of the filter, with noise and a bias about the vertical."""
    x, covariance, errors, states = np.zeros(STATES), np.zeros((ERRORS, ERRORS)), [], []
    for k, (rotation, rate) in enumerate(zip(rotations, rates, strict=True)):
        up = rotation.T @ UP
        field = rotation.T @ FIELD + noise * random.normal(scale=FUSION.magnetometer_noise * np.sqrt(50.0), size=3)
        measured = rate + BIAS * up + noise * random.normal(scale=FUSION.gyroscope_noise / np.sqrt(2.0 * PERIOD_S), size=3)
        if k == 0:
            start_heading(x, covariance, field, up, VARIANCE, FUSION.bias_sigma)
        else:
            predict_heading(x, covariance, up, measured, PERIOD_S, *NOISE)
        if k % EVERY == 0 and k > 0:
            update_heading(x, covariance, field, up, VARIANCE)
        seen = rotation @ x[:3]
        errors.append(np.arctan2(seen[1], seen[0]))
        states.append([*x, *covariance.ravel()])
    return np.array(errors), np.array(states)


def test_on_a_level_platform_it_is_the_kalman_filter_of_an_angle_and_a_bias():
    random = np.random.default_rng(0)
    x, covariance = np.zeros(STATES), np.zeros((ERRORS, ERRORS))
    start_heading(x, covariance, FIELD, UP, VARIANCE, FUSION.bias_sigma)
    # The angle of n in {2} falls with the rate, less the bias.
    state, spread = np.zeros(2), np.diag([VARIANCE, FUSION.bias_sigma**2])
    forward = np.array([[1.0, PERIOD_S], [0.0, 1.0]])
    for k in range(1, 3001):
        rate = 1.2 * np.cos(0.002 * k) + random.normal(scale=0.1)
        predict_heading(x, covariance, UP, np.array([0.0, 0.0, rate]), PERIOD_S, *NOISE)
        state = forward @ state - [PERIOD_S * rate, 0.0]
        spread = forward @ spread @ forward.T + PERIOD_S * np.diag(NOISE)
        if k % EVERY == 0:
            measured = state[0] + random.normal(scale=np.sqrt(VARIANCE))
            update_heading(x, covariance, np.array([18.0 * np.cos(measured), 18.0 * np.sin(measured), 7.0]), UP, VARIANCE)
            innovation = np.sqrt(spread[0, 0] + VARIANCE)
            gain = spread[:, 0] / innovation**2
            state = state + gain * np.clip(measured - state[0], -3.0 * innovation, 3.0 * innovation)
            spread = spread - np.outer(gain, spread[0])
    np.testing.assert_allclose(x, [np.cos(state[0]), np.sin(state[0]), 0.0, state[1]], atol=1e-6)
    np.testing.assert_allclose(covariance, spread, rtol=1e-9)
    assert abs(state[0]) > 0.1


def test_tilt_is_compensated_and_the_bias_found():
    errors, states = follow(*turning(20_000), np.random.default_rng(1), noise=0.0)
    # The midpoint rule of the rates leaves this much.
    assert np.degrees(np.abs(errors[10_000:]).max()) < 0.01
    assert states[-1, 3] == pytest.approx(BIAS, rel=0.02)


@pytest.mark.slow
def test_the_covariance_is_that_of_the_errors():
    motion = turning(4000)
    runs = [follow(*motion, np.random.default_rng(seed)) for seed in range(40)]
    squares = [np.mean(errors[at] ** 2 / states[at, 4]) for errors, states in runs for at in (slice(1000, None, 500),)]
    assert 0.6 < np.mean(squares) < 1.5
    last = np.degrees(np.sqrt(np.mean([errors[-1] ** 2 for errors, _ in runs])))
    assert last < 0.3 < np.degrees(np.sqrt(VARIANCE))


# ------------------------------------------------------------------------------------------------------------ in the cycle


def parameters_of(mechanism, imus=ALL_IMUS, **choices):
    settings = control_settings(mechanism), fusion_settings(mechanism)
    unwatched = SafetySettings(following=1e3, drive_deviation=1e3, saturation=1e3)
    of_drives = DriveSettings(slack=np.inf)
    return cycle_parameters(mechanism, 1.0 / PERIOD_S, *settings, imus, safety=unwatched, drive_settings=of_drives, **choices)


def run(parameters, signals, count, state=None):
    """Cycles on measurements that stay, all of which must be well."""
    state, segments = np.zeros((), STATE) if state is None else state, np.zeros((6, 1, 5))
    segments[:, 0, 1] = 0.394
    for _ in range(count):
        assert cycle(parameters, state, signals, segments) == Cause.NONE
    return state


@pytest.mark.parametrize("section_5", [False, True])
@pytest.mark.parametrize("legs", [(0, 3), (1, 4), (0, 2, 4), range(6)])
def test_any_two_legs_and_the_whole_orientation_give_the_exact_pose(hexapod, legs, section_5):
    parameters = parameters_of(hexapod, (*legs, PLATFORM_IMU), magnetometer=True, section_5=section_5)
    for position, rotation in zip(*sample_workspace(hexapod, 10, seed=1), strict=True):
        signals = static_signals(hexapod, position, rotation)
        signals[:, [leg for leg in range(6) if leg not in legs]] = np.nan
        state = run(parameters, signals, 20)
        assert np.linalg.norm(state["pose"]["position"] - position) < 1e-9
        assert angle_between(state["pose"]["rotation"], rotation) < 1e-9
        np.testing.assert_allclose(state["pose"]["lengths"], leg_lengths(hexapod, position, rotation), rtol=0.0, atol=1e-9)


def noisy(mechanism, seed=0):
    """Readings at home, a new one each cycle: calls give a measurement (3, 7, 3)."""
    imu, measurement = imu_state(load_imu("mpu9150-calibrated"), seed, PERIOD_S), np.zeros((3, 7, 3))
    signals = static_signals(mechanism, mechanism.home.position, mechanism.home.rotation)

    def read():
        measure(imu, signals, measurement)
        return measurement

    return read


def test_section_5_is_the_public_solvers_for_the_same_measurements(hexapod):
    parameters, read, state = parameters_of(hexapod, magnetometer=True, section_5=True), noisy(hexapod), None
    for _ in range(300):
        state = run(parameters, read(), 1, state)
    up, north = state["pose"]["vectors"]
    aligned, _ = Rotation.align_vectors([UP, [1.0, 0.0, 0.0]], [up, north], weights=[np.inf, 1.0])
    rotation = aligned.as_matrix()
    solution = solve(hexapod, state["legs"]["directions"], rotation=rotation, method="section-5", refine=False)
    np.testing.assert_allclose(state["pose"]["rotation"], rotation, atol=1e-9)
    np.testing.assert_allclose(state["pose"]["position"], solution.position, atol=1e-9)
    np.testing.assert_array_equal(state["pose"]["information"], 0.0)


@pytest.mark.slow
def test_without_it_the_magnetometer_makes_no_difference(hexapod):
    read, states = noisy(hexapod), [np.zeros((), STATE), np.zeros((), STATE)]
    for _ in range(50):
        measurement = read().copy()
        run(parameters_of(hexapod), measurement, 1, states[0])
        measurement[MAGNETOMETER] = np.nan
        run(parameters_of(hexapod), measurement, 1, states[1])
    for name in ("position", "rotation", "information", "twist"):
        np.testing.assert_array_equal(states[0]["pose"][name], states[1]["pose"][name])
    np.testing.assert_array_equal(states[0]["pid"]["command"], states[1]["pid"]["command"])


@pytest.mark.parametrize("fault", ["lost", "disturbed", "frozen"])
def test_a_magnetometer_at_fault_is_left_out_and_taken_back(hexapod, fault):
    parameters, read = parameters_of(hexapod, magnetometer=True), noisy(hexapod)
    state, stuck = None, None
    for k in range(800):
        measurement = read().copy()
        if 300 <= k < 500:
            stuck = measurement[MAGNETOMETER].copy() if k == 300 else stuck
            measurement[MAGNETOMETER] = {"lost": np.nan, "disturbed": [60.0, 0.0, -46.0], "frozen": stuck}[fault]
        state = run(parameters, measurement, 1, state)
        if k in (299, 799) or 300 + 150 * (fault == "frozen") <= k < 500:
            assert state["heading"]["used"] == (not 300 <= k < 500), k
            assert (state["pose"]["vector_weights"][1] > 0.0) == (not 300 <= k < 500)
    assert angle_between(state["pose"]["rotation"], hexapod.home.rotation) < np.radians(0.3)


def test_a_set_that_needs_it_stops_without_it(hexapod):
    parameters = parameters_of(hexapod, TWO_LEGS, magnetometer=True)
    signals = static_signals(hexapod, hexapod.home.position, np.eye(3))
    state = run(parameters, signals, 10)
    signals[MAGNETOMETER, PLATFORM_IMU] = np.nan
    assert cycle(parameters, state, signals, np.zeros((6, 1, 5))) == Cause.POSE_LOST


def test_the_heading_counts_by_its_weight(hexapod):
    """Two legs and full orientation: the refined pose's information against numeric derivatives of what was measured."""
    parameters = parameters_of(hexapod, TWO_LEGS, magnetometer=True)
    position, rotation = np.array([0.01, -0.02, 0.36]), rotation_of([0.05, -0.08, 0.1])
    state = run(parameters, static_signals(hexapod, position, rotation), 20)

    def measured(step):
        turned = rotation_of(step[3:]) @ rotation
        legs = leg_directions(hexapod, position + step[:3], turned)[list(TWO_LEGS[:2])].ravel()
        return np.concatenate([legs, turned.T @ UP, turned.T @ [1.0, 0.0, 0.0]])

    jacobian = np.array([(measured(h) - measured(-h)) / 2e-6 for h in 1e-6 * np.eye(6)]).T
    weights = np.repeat([parameters["legs"]["weight"], *state["pose"]["vector_weights"]], [6, 3, 3])
    lower = np.tril(state["pose"]["information"])
    np.testing.assert_allclose(lower, np.tril(jacobian.T @ (weights[:, None] * jacobian)), rtol=1e-5, atol=1e-2)


@pytest.mark.parametrize("angle_deg", [2.0, -1.0])
def test_the_whole_mechanism_filter_finds_the_headings_offset_and_is_not_turned_by_it(hexapod, angle_deg):
    parameters = parameters_of(hexapod, magnetometer=True, whole="accelerometers")
    position, rotation = np.array([0.01, -0.02, 0.36]), rotation_of([0.15, -0.1, 0.2])
    signals = static_signals(hexapod, position, rotation)
    signals[MAGNETOMETER, PLATFORM_IMU] = rotation.T @ rotation_of([0.0, 0.0, np.radians(angle_deg)]) @ FIELD
    state = run(parameters, signals, 3000)
    assert state["mechanism"]["trusted"] == 1
    assert np.degrees(state["mechanism"]["filter"]["heading_offset"]) == pytest.approx(angle_deg, rel=0.1)
    assert angle_between(state["pose"]["rotation"], rotation) < np.radians(0.1)


def test_sets_that_do_not_do_are_refused_with_the_remedy(hexapod):
    for legs in combinations(range(6), 2):
        with pytest.raises(InputError, match=r"add legs, or its magnetometer \(--magnetometer\)"):
            check_imus(hexapod, (*legs, PLATFORM_IMU))
        assert check_imus(hexapod, (*legs, PLATFORM_IMU), magnetometer=True) > 1e-2
    with pytest.raises(InputError, match=r"the platform's IMU \(6\), or its magnetometer"):
        check_imus(hexapod, (0, 1, 2))
    with pytest.raises(InputError, match="part of the platform's IMU, which is not there: add IMU 6"):
        check_imus(hexapod, range(6), magnetometer=True)
    with pytest.raises(InputError, match="IMUs 0, 6 do not determine the pose"):
        check_imus(hexapod, (0, PLATFORM_IMU), magnetometer=True)
    with pytest.raises(InputError, match="section 5 needs the platform's heading"):
        check_imus(hexapod, ALL_IMUS, section_5=True)
    polar = Mechanism.from_legs(
        hexapod.base_joints,
        hexapod.platform_joints,
        home=hexapod.home,
        limits={"stroke": hexapod.limits.stroke},
        plant={**hexapod.plant, "magnetic_field": [1.0, 0.0, -60.0]},
    )
    with pytest.raises(InputError, match="the horizontal magnetic field is 1 uT; a heading needs at least 5"):
        check_imus(polar, ALL_IMUS, magnetometer=True)
