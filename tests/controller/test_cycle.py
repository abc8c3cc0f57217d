"""The cycle: from raw IMU data to commands, with every set of IMUs that it accepts, bit by bit the same again."""

import re
from itertools import combinations

import numba
import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys
from scipy.spatial.transform import Rotation

from controller import cycle as compiled
from controller.calibration.file import Calibration
from controller.cycle import STATE, cycle_parameters, evidence_remark
from controller.direct_kinematics import solve
from controller.imu_set import check_imus
from controller.inverse_kinematics import leg_lengths, sample_workspace
from controller.safety.causes import Cause, Mode
from controller.settings import ControlSettings, FusionSettings, SafetySettings, control_settings, fusion_settings
from plant.dynamics.variables import PLATFORM_IMU
from plant.errors import InputError
from plant.imu import ACCELEROMETER, GYROSCOPE, MAGNETOMETER, imu_state, load_imu, measure
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import Mechanism, load_in_space
from plant.pose import Pose
from tests.controller.cycles import cycle, follow_at_once, refine
from tests.controller.leg_geometry import (
    angle_between,
    leg_directions,
    leg_vectors,
    rotation_of,
    static_signals,
    unit,
)
from tests.controller.leg_motion import observe_mechanism

RATE_HZ = 1000.0
UNWATCHED = SafetySettings(
    following=1e3, drive_deviation=1e3, saturation=1e3, velocity_margin=1e3, arming_distance=1e3, watch_imus=0.0
)
"""For signals that do not follow the commands."""
PERIOD_S = 1.0 / RATE_HZ
LEG_IMUS = (0, 1, 2, 3, 4, 5)
DEGREE = np.pi / 180.0


def parameters_of(mechanism, imus=ALL_IMUS, rate=RATE_HZ, **control):
    settings = control_settings(mechanism, **control), fusion_settings(mechanism)
    return follow_at_once(cycle_parameters(mechanism, rate, *settings, imus, safety=UNWATCHED))


def resting(lengths):
    """Segments of a reference that stays at lengths (6,)."""
    segments = np.zeros((6, 1, 5))
    segments[:, 0, 1] = lengths
    return segments


def run(parameters, signals, segments, count, state=None):
    """Cycles on measurements (3, 7, 3) that stay, or are made by a function of the cycle; all must be well."""
    state = np.zeros((), STATE) if state is None else state
    for k in range(count):
        measurement = signals(k) if callable(signals) else signals
        assert cycle(parameters, state, measurement, segments) == Cause.NONE
    return state


def variant(mechanism, up_in_base=(0.0, 0.0, 1.0), **plant):
    """The same mechanism with its base inclined, and with other data of the plant."""
    up = unit(up_in_base)
    return Mechanism.from_legs(
        mechanism.base_joints,
        mechanism.platform_joints,
        up_in_base=up,
        home=mechanism.home,
        limits={"stroke": mechanism.limits.stroke},
        plant={**mechanism.plant, "gravity": -9.81 * up, **plant},
        settings=mechanism.settings,
    )


def wavy(mechanism, seed):
    """A noisy measurement of a platform that sways, as a function of the cycle."""
    random = np.random.default_rng(seed)
    imu = imu_state(load_imu("mpu9150-calibrated"), seed, PERIOD_S)
    signals = static_signals(mechanism, mechanism.home.position, mechanism.home.rotation)
    frequencies = random.uniform(1.0, 6.0, signals.shape)
    measurement = np.zeros((3, 7, 3))

    def at(k):
        sway = np.sin(frequencies * k * PERIOD_S) * np.array([0.02, 0.1, 0.0])[:, None, None]
        measure(imu, signals + sway, measurement)
        return measurement

    return at


# ------------------------------------------------------------------------------------------------------------ which IMUs


@pytest.mark.parametrize(
    "imus",
    [
        ALL_IMUS,
        LEG_IMUS,
        *((*legs, PLATFORM_IMU) for legs in combinations(range(6), 5)),
        (0, 1, 2, 3, PLATFORM_IMU),
        (1, 2, 4, 5, PLATFORM_IMU),
        (0, 1, 2, PLATFORM_IMU),
        (PLATFORM_IMU, 5, 0, 3),
    ],
)
def test_ideal_signals_at_rest_give_the_exact_pose(hexapod, imus):
    parameters = parameters_of(hexapod, imus)
    for position, rotation in zip(*sample_workspace(hexapod, 10, seed=1), strict=True):
        signals = static_signals(hexapod, position, rotation)
        for missing in set(ALL_IMUS) - set(imus):
            signals[:, missing] = np.nan
        lengths = leg_lengths(hexapod, position, rotation)
        state = run(parameters, signals, resting(lengths), 20)
        assert np.linalg.norm(state["pose"]["position"] - position) < 1e-9
        assert angle_between(state["pose"]["rotation"], rotation) < 1e-9
        np.testing.assert_allclose(state["pose"]["lengths"], lengths, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(state["pid"]["error"], 0.0, atol=1e-9)
        np.testing.assert_allclose(state["pose"]["twist"], 0.0, atol=1e-9)


@pytest.mark.parametrize("count", [3, 4, 5])
@pytest.mark.parametrize("platform", [(), (PLATFORM_IMU,)])
def test_every_subset_is_either_refused_or_gives_the_pose(hexapod, count, platform):
    position, rotation = np.array([0.01, -0.02, 0.36]), rotation_of([0.05, -0.08, 0.1])
    signals, segments = static_signals(hexapod, position, rotation), resting(np.full(6, 0.4))
    accepted = 0
    for legs in combinations(range(6), count):
        try:
            parameters = parameters_of(hexapod, (*legs, *platform))
        except InputError as refusal:
            assert ", ".join(str(leg) for leg in legs) in str(refusal)
            continue
        accepted += 1
        state = run(parameters, signals, segments, 5)
        assert np.linalg.norm(state["pose"]["position"] - position) < 1e-9
        assert angle_between(state["pose"]["rotation"], rotation) < 1e-9
    assert accepted >= {3: 10, 4: 15, 5: 6}[count] if platform else accepted == {3: 0, 4: 15, 5: 6}[count]


@pytest.mark.parametrize(
    "imus", [(), (PLATFORM_IMU,), (0, 1, PLATFORM_IMU), (2,), (0, 1, 2), (7,), (-1, *ALL_IMUS), (0, 1, 2, 3, 4, 5, 6, 70)]
)
def test_imus_that_cannot_be_or_do_not_suffice_are_refused(hexapod, imus):
    with pytest.raises(InputError, match="IMU"):
        check_imus(hexapod, imus)
    with pytest.raises(InputError, match="IMU"):
        parameters_of(hexapod, imus)


def test_legs_alone_do_for_platform_joints_off_a_plane_too(hexapod):
    bent = hexapod.platform_joints + [[0.0, 0.0, z] for z in (0.03, -0.03, 0.03, -0.03, 0.03, -0.03)]
    mechanism = Mechanism.from_legs(hexapod.base_joints, bent, home=hexapod.home, limits={"stroke": (-0.06, 0.06)})
    for imus in (LEG_IMUS, ALL_IMUS, (0, 1, 3, 4)):
        check_imus(mechanism, imus)


@pytest.mark.parametrize("rate", [0.0, -1.0, 49.0, 4001.0, np.nan, np.inf])
def test_a_rate_out_of_range_is_refused(hexapod, rate):
    with pytest.raises(InputError, match="rate"):
        parameters_of(hexapod, rate=rate)


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (15.0, 0.0), (-10.0, 20.0)])
def test_an_inclined_base_makes_no_difference_to_the_estimate(hexapod, tilt_deg):
    mechanism = variant(hexapod, rotation_of([*np.radians(tilt_deg), 0.0])[:, 2])
    for imus in (ALL_IMUS, LEG_IMUS, (0, 2, 3, 5, PLATFORM_IMU)):
        parameters = parameters_of(mechanism, imus)
        for position, rotation in zip(*sample_workspace(mechanism, 10, seed=2), strict=True):
            state = run(parameters, static_signals(mechanism, position, rotation), resting(np.full(6, 0.4)), 5)
            assert np.linalg.norm(state["pose"]["position"] - position) < 1e-9
            assert angle_between(state["pose"]["rotation"], rotation) < 1e-9


# ------------------------------------------------------------------------------------------------------------- the estimate


def test_from_an_unknown_pose_the_estimate_is_right_within_fifty_milliseconds(hexapod):
    """100 poses anywhere in the workspace, each with calibrated MPU-9150s of its own; no first guess."""
    parameters, model = parameters_of(hexapod), load_imu("mpu9150-calibrated")
    measurement, errors = np.zeros((3, 7, 3)), []
    for seed, (position, rotation) in enumerate(zip(*sample_workspace(hexapod, 100, seed=3), strict=True)):
        imu, signals = imu_state(model, seed, PERIOD_S), static_signals(hexapod, position, rotation)

        def read(k, imu=imu, signals=signals):
            measure(imu, signals, measurement)
            return measurement

        state = run(parameters, read, resting(np.full(6, 0.4)), 50)
        errors.append(
            [np.linalg.norm(state["pose"]["position"] - position), angle_between(state["pose"]["rotation"], rotation)]
        )
    worst = np.max(errors, axis=0)
    assert worst[0] < 2e-3
    assert worst[1] < 0.5 * DEGREE
    # The imperfections were there: a 1 mg bias alone is 0.06 deg.
    assert np.median(errors, axis=0)[0] > 0.1e-3


def swaying(mechanism, seed):
    """Poses about home as a function of time: at rest, then within a second sines of 15 mm and 5 deg, up to 1.5 Hz."""
    random = np.random.default_rng(seed)
    frequencies, phases = 2.0 * np.pi * random.uniform(0.3, 1.5, 6), random.uniform(0.0, 2.0 * np.pi, 6)
    sizes = np.array([0.015, 0.015, 0.01, 5.0 * DEGREE, 5.0 * DEGREE, 5.0 * DEGREE])

    def pose_at(times):
        x = np.clip(np.asarray(times)[:, None] - 0.3, 0.0, 1.0)
        waves = x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3) * sizes * np.sin(frequencies * times[:, None] + phases)
        return mechanism.home.position + waves[:, :3], Rotation.from_rotvec(waves[:, 3:]).as_matrix()

    return pose_at


def misled_tilt(mechanism, signals, rotations):
    """RMS angle between the platform's vertical and its accelerometer's reading taken for it."""
    forces = unit(signals[:, ACCELEROMETER, PLATFORM_IMU])
    verticals = rotations.transpose(0, 2, 1) @ mechanism.up_in_base
    return np.sqrt(np.mean(np.sum(np.cross(forces, verticals) ** 2, axis=1)))


@pytest.mark.slow
@pytest.mark.parametrize("imus", [ALL_IMUS, LEG_IMUS, (0, 2, 3, 5, PLATFORM_IMU)])
def test_a_moving_platform_is_followed_by_ideal_imus_wherever_they_sit(hexapod, imus):
    """Its own acceleration, up to 2 m/s^2 and that of the turns, is not taken for gravity; nor are the legs'."""
    places = hexapod.plant["leg_imu_position"] + np.random.default_rng(0).uniform(-0.03, 0.03, (6, 3))
    mechanism = variant(hexapod, platform_imu_position=(0.10, -0.15, 0.12), leg_imu_position=places)
    pose_at, times = swaying(mechanism, 0), PERIOD_S * np.arange(3000)
    positions, rotations = pose_at(times)
    (ahead, turned_ahead), (behind, turned_behind) = pose_at(times + 1e-5), pose_at(times - 1e-5)
    turning = Rotation.from_matrix(turned_ahead @ turned_behind.transpose(0, 2, 1)).as_rotvec()
    twists = np.hstack([ahead - behind, turning]) / 2e-5
    signals = observe_mechanism(mechanism, pose_at, times)
    parameters, state, errors = parameters_of(mechanism, imus), np.zeros((), STATE), []
    for k in range(3000):
        run(parameters, signals[k], resting(np.full(6, 0.394)), 1, state)
        tilt = np.linalg.norm(np.cross(state["pose"]["vectors"][0], rotations[k].T @ mechanism.up_in_base))
        off = state["pose"]["twist"] - twists[k]
        apart = np.linalg.norm(state["pose"]["position"] - positions[k]), angle_between(state["pose"]["rotation"], rotations[k])
        errors.append([*apart, tilt * (PLATFORM_IMU in imus), np.linalg.norm(off[:3]), np.linalg.norm(off[3:])])
    position, rotation, tilt, velocity, turning = np.sqrt(np.mean(np.square(errors[500:]), axis=0))
    if PLATFORM_IMU not in imus:
        # The legs' model knows every acceleration.
        assert position < 1e-6
        assert rotation < 1e-3 * DEGREE
        assert velocity < 1e-5
    else:
        # The platform's acceleration is known 20 ms late, a fifth of it at 1.5 Hz.
        assert tilt < misled_tilt(mechanism, signals, rotations) / 10.0
        assert tilt < 0.4 * DEGREE
        assert position < 0.2e-3
        assert velocity < 1e-3
        assert turning < 0.01


@pytest.mark.parametrize("imus", [ALL_IMUS, LEG_IMUS, (0, 1, 3, 4, PLATFORM_IMU)])
def test_the_estimate_is_the_public_solvers_for_the_same_directions(hexapod, imus):
    """Two Gauss-Newton steps against as many as it takes, over noisy data; and the information against its covariance.

    The solver doubts nothing.
    """
    parameters, fusion = parameters_of(hexapod, imus), FusionSettings()
    at, segments, state = wavy(hexapod, 4), resting(np.full(6, 0.394)), np.zeros((), STATE)
    for _ in range(10):
        run(parameters, at, segments, 20, state)
        directions = np.where(np.isin(np.arange(6), imus)[:, None], state["legs"]["directions"], np.nan)
        extra = {"up_in_platform": state["pose"]["vectors"][0], "tilt_sigma": fusion.tilt_sigma} if PLATFORM_IMU in imus else {}
        solution = solve(hexapod, directions, leg_sigma=fusion.leg_sigma, **extra)
        state["pose"]["doubts"] = 0.0
        assert refine(parameters, state)
        # A thousandth of what the noise leaves uncertain.
        assert np.linalg.norm(state["pose"]["position"] - solution.position) < 1e-6
        assert angle_between(state["pose"]["rotation"], solution.rotation) < 1e-6
        information = np.tril(state["pose"]["information"]) + np.tril(state["pose"]["information"], -1).T
        root = np.linalg.cholesky(solution.covariance)
        np.testing.assert_allclose(root.T @ information @ root, np.eye(6), atol=1e-3)


def weigh(state, imus):
    """Use these IMUs, all alike."""
    state["legs"]["used"] = state["legs"]["weights"] = [float(leg in imus) for leg in range(6)]
    state["platform"]["used"] = state["pose"]["vector_weights"][0] = float(PLATFORM_IMU in imus)


@pytest.mark.parametrize("imus", [ALL_IMUS, LEG_IMUS, (0, 1, 2, 3, 4, PLATFORM_IMU)])
def test_the_twist_is_the_motion_behind_the_rates_of_the_directions(hexapod, imus):
    random = np.random.default_rng(5)
    parameters = parameters_of(hexapod, imus)
    for position, rotation in zip(*sample_workspace(hexapod, 20, seed=5), strict=True):
        velocity, omega = random.uniform(-0.2, 0.2, 3), random.uniform(-1.0, 1.0, 3)
        state, h = np.zeros((), STATE), 1e-6
        ahead, behind = (
            leg_directions(hexapod, position + sign * h * velocity, rotation_of(sign * h * omega) @ rotation)
            for sign in (1, -1)
        )
        legs, pose = state["legs"], state["pose"]
        legs["directions"], legs["rates"] = leg_directions(hexapod, position, rotation), (ahead - behind) / (2.0 * h)
        pose["vectors"][0], state["platform"]["rate"] = rotation.T @ hexapod.up_in_base, rotation.T @ omega
        pose["position"], pose["rotation"] = position, rotation
        weigh(state, imus)
        assert refine(parameters, state)
        np.testing.assert_allclose(state["pose"]["twist"], [*velocity, *omega], rtol=0.0, atol=1e-7)
        np.testing.assert_allclose(state["pose"]["position"], position, rtol=0.0, atol=1e-12)


def test_the_acceleration_is_the_derivative_of_the_twist_with_its_time_constant(hexapod):
    parameters, tau = parameters_of(hexapod), FusionSettings().acceleration_time
    position, rotation, acceleration = hexapod.home.position, np.eye(3), np.array([0.5, -0.3, 0.2])
    state = np.zeros((), STATE)
    state["legs"]["directions"], state["pose"]["vectors"][0] = leg_directions(hexapod, position, rotation), hexapod.up_in_base
    weigh(state, ALL_IMUS)
    found = []
    for k in range(200):
        velocity, h = acceleration * k * PERIOD_S, 1e-6
        ahead, behind = (leg_directions(hexapod, position + sign * h * velocity, rotation) for sign in (1.0, -1.0))
        state["legs"]["rates"] = (ahead - behind) / (2.0 * h)
        state["pose"]["position"], state["pose"]["rotation"] = position, rotation
        assert refine(parameters, state)
        state["time"]["cycle"] += 1
        found.append(state["pose"]["unplanned"].copy())
    found = np.array(found)
    np.testing.assert_allclose(found[-1], [*acceleration, 0.0, 0.0, 0.0], atol=2e-3)
    share = found[round(tau / PERIOD_S)][:3] / acceleration
    np.testing.assert_allclose(share, 1.0 - np.exp(-1.0), atol=0.05)


@pytest.mark.parametrize(("rate", "missed"), [(50.0, 0), (70.0, 0), (100.0, 0), (400.0, 7)])
def test_with_periods_longer_than_that_time_the_acceleration_is_the_change_of_the_twist(hexapod, rate, missed):
    parameters, state, h = parameters_of(hexapod, rate=rate), np.zeros((), STATE), 1e-6
    position, acceleration, period = hexapod.home.position, np.array([0.5, -0.3, 0.2]), (1 + missed) / rate
    state["legs"]["directions"], state["pose"]["vectors"][0] = leg_directions(hexapod, position, np.eye(3)), hexapod.up_in_base
    state["time"]["missed"] = missed
    weigh(state, ALL_IMUS)
    for k in range(5):
        velocity = acceleration * k * period
        ahead, behind = (leg_directions(hexapod, position + sign * h * velocity, np.eye(3)) for sign in (1.0, -1.0))
        state["legs"]["rates"] = (ahead - behind) / (2.0 * h)
        state["pose"]["position"], state["pose"]["rotation"] = position, np.eye(3)
        assert refine(parameters, state)
        state["time"]["cycle"] += 1
    np.testing.assert_allclose(state["pose"]["unplanned"], [*acceleration, 0.0, 0.0, 0.0], atol=1e-6)


# ---------------------------------------------------------------------------------------------------------------- the state


def test_a_copied_state_goes_on_bit_by_bit_as_the_original(hexapod):
    parameters, segments = parameters_of(hexapod), resting(np.full(6, 0.396))
    at = wavy(hexapod, 6)
    measurements = [at(k).copy() for k in range(600)]
    state = run(parameters, measurements.__getitem__, segments, 350)
    snapshot = state.copy()
    run(parameters, lambda k: measurements[350 + k], segments, 250, state)
    run(parameters, lambda k: measurements[350 + k], segments, 250, snapshot)
    assert state.tobytes() == snapshot.tobytes()
    whole = run(parameters, measurements.__getitem__, segments, 600)
    assert state.tobytes() == whole.tobytes()
    assert np.abs(whole["pid"]["command"]).max() > 0.0


def test_cycles_allocate_nothing(hexapod):
    @numba.njit
    def repeat(parameters, state, measurement, segments, marks, count):
        status = 0
        for _ in range(count):
            status |= compiled.cycle(parameters, state, measurement, segments, marks)
        return status

    marks = np.zeros((), compiled.MARKS)[()]
    parameters, state = parameters_of(hexapod), np.zeros((), STATE)
    measurement, segments = wavy(hexapod, 7)(0), resting(np.full(6, 0.394))
    assert repeat(parameters, state, measurement, segments, marks, 1) == Cause.NONE
    _nrt_python.memsys_enable_stats()
    allocated = []
    for count in (1, 1000):
        before = rtsys.get_allocation_stats()
        assert repeat(parameters, state, measurement, segments, marks, count) == Cause.NONE
        allocated.append(rtsys.get_allocation_stats().alloc - before.alloc)
    _nrt_python.memsys_disable_stats()
    # What remains belongs to the call from Python.
    assert allocated[0] == allocated[1] > 0


def used(state):
    """The IMUs that the pose rests on."""
    return [k for k in range(6) if state["legs"]["used"][k]] + [PLATFORM_IMU] * bool(state["platform"]["used"])


@pytest.mark.parametrize("kind", [GYROSCOPE, ACCELEROMETER])
@pytest.mark.parametrize("imu", ALL_IMUS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_imu_whose_reading_is_no_number_is_left_out_at_once_and_taken_back(hexapod, kind, imu, bad):
    parameters, segments = parameters_of(hexapod), resting(np.full(6, 0.394))
    at = wavy(hexapod, 8)
    for cycles in (0, 5, 250):
        for axis in range(3):
            state = run(parameters, at, segments, cycles)
            before = state["pose"]["position"].copy()
            measurement = at(cycles).copy()
            measurement[kind, imu, axis] = bad
            assert cycle(parameters, state, measurement, segments) == Cause.NONE
            assert used(state) == sorted(set(ALL_IMUS) - {imu})
            # These readings sway without regard to each other, so every set of IMUs has a pose of its own.
            assert cycles < 250 or np.linalg.norm(state["pose"]["position"] - before) < 1e-2
            run(parameters, lambda k, first=cycles + 1: at(first + k), segments, 125, state)
            assert used(state) == list(ALL_IMUS)


@pytest.mark.parametrize("imu", ALL_IMUS)
def test_an_imu_that_stands_still_is_left_out_within_10_ms(hexapod, imu):
    parameters, segments = parameters_of(hexapod), resting(np.full(6, 0.394))
    at = wavy(hexapod, 8)
    state = run(parameters, at, segments, 250)
    frozen = at(250).copy()[:, imu]

    def stuck(k):
        measurement = at(251 + k)
        measurement[:, imu] = frozen
        return measurement

    run(parameters, stuck, segments, 10, state)
    assert used(state) == list(ALL_IMUS)
    run(parameters, lambda k: stuck(10 + k), segments, 1, state)
    assert used(state) == sorted(set(ALL_IMUS) - {imu})


@pytest.mark.parametrize(("kind", "reach"), [(GYROSCOPE, 250.0 * DEGREE), (ACCELEROMETER, 4.0 * 9.80665)])
def test_an_imu_that_stays_at_the_end_of_its_range_is_left_out(hexapod, kind, reach):
    """The others bridge it for 50 ms; a gyroscope that jumps there alone is noisy at once."""
    parameters, segments = parameters_of(hexapod), resting(np.full(6, 0.394))
    at = wavy(hexapod, 8)
    for sign in (1.0, -1.0):
        state = run(parameters, at, segments, 250)
        for k in range(51):
            if kind == ACCELEROMETER:
                assert used(state) == list(ALL_IMUS)
            measurement = at(250 + k).copy()
            measurement[kind, 3, 1] = sign * reach
            assert cycle(parameters, state, measurement, segments) == Cause.NONE
        assert used(state) == [0, 1, 2, 4, 5, 6]


def test_imus_that_all_stand_still_are_trusted(hexapod):
    """Ideal ones at rest do."""
    signals = static_signals(hexapod, hexapod.home.position, hexapod.home.rotation)
    assert used(run(parameters_of(hexapod), signals, resting(np.full(6, 0.4)), 100)) == list(ALL_IMUS)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_too_few_sound_imus_stop_the_cycle(hexapod, bad):
    parameters, segments = parameters_of(hexapod), resting(np.full(6, 0.394))
    at = wavy(hexapod, 8)
    state = run(parameters, at, segments, 250)
    measurement = at(250).copy()
    measurement[ACCELEROMETER, [0, 1, 2, 3]] = bad
    assert cycle(parameters, state, measurement, segments) == Cause.POSE_LOST


def test_a_reading_that_is_not_used_may_be_no_number(hexapod):
    position, rotation = hexapod.home.position, hexapod.home.rotation
    signals = static_signals(hexapod, position, rotation)
    signals[MAGNETOMETER] = np.nan
    run(parameters_of(hexapod), signals, resting(np.full(6, 0.4)), 300)
    signals[:, PLATFORM_IMU] = np.nan
    run(parameters_of(hexapod, LEG_IMUS), signals, resting(np.full(6, 0.4)), 300)


def test_a_reference_that_is_no_number_is_not_armed_and_stops_the_cycle_in_motion(hexapod):
    parameters, signals = parameters_of(hexapod), static_signals(hexapod, hexapod.home.position, np.eye(3))
    lengths = leg_lengths(hexapod, hexapod.home.position, hexapod.home.rotation)
    state = run(parameters, signals, resting(np.full(6, np.nan)), 250)
    assert state["safety"]["mode"] == Mode.IDLE
    assert (state["pid"]["command"] == 0.0).all()
    state = run(parameters, signals, resting(lengths), 250)
    assert state["safety"]["mode"] == Mode.RUNNING
    assert cycle(parameters, state, signals, resting(np.full(6, np.nan))) == Cause.NOT_FINITE
    assert (np.isfinite(state["pid"]["command"])).all()


def test_directions_that_no_longer_determine_a_pose_are_reported(hexapod):
    """All legs read as if they stood upright: their lines are parallel."""
    parameters, state = parameters_of(hexapod), np.zeros((), STATE)
    signals = static_signals(hexapod, hexapod.home.position, np.eye(3))
    signals[ACCELEROMETER, :6] = [0.0, 0.0, 9.81]
    assert cycle(parameters, state, signals, resting(np.full(6, 0.4))) == Cause.POSE_LOST


# -------------------------------------------------------------------------------------------------------------- the control


def test_during_the_hold_all_commands_are_zero_and_nothing_winds_up(hexapod):
    parameters = parameters_of(hexapod, hold=0.05)
    signals = static_signals(hexapod, hexapod.home.position, np.eye(3))
    home = leg_lengths(hexapod, hexapod.home.position, np.eye(3))
    segments, state = resting(home + 0.001), np.zeros((), STATE)
    for _ in range(50):
        run(parameters, signals, segments, 1, state)
        np.testing.assert_array_equal(state["pid"]["command"], 0.0)
        np.testing.assert_array_equal(state["pid"]["integral"], 0.0)
        np.testing.assert_allclose(state["pid"]["error"], 0.001, atol=1e-9)
    run(parameters, signals, segments, 1, state)
    assert (state["pid"]["command"] > 0.0).all()


@pytest.mark.parametrize(
    ("rate", "hold", "cycles"), [(1000.0, 0.2, 200), (250.0, 0.2, 50), (300.0, 0.011, 4), (4000.0, 1e-5, 1)]
)
def test_the_hold_lasts_as_long_as_it_should_at_every_rate(hexapod, rate, hold, cycles):
    parameters = parameters_of(hexapod, rate=rate, hold=hold)
    signals = static_signals(hexapod, hexapod.home.position, np.eye(3))
    state, moving = np.zeros((), STATE), []
    for _ in range(cycles + 5):
        run(parameters, signals, resting(np.full(6, 0.396)), 1, state)
        moving.append(np.abs(state["pid"]["command"]).max() > 0.0)
    assert moving == [False] * cycles + [True] * 5


def test_the_references_time_begins_where_the_hold_ends(hexapod):
    parameters = parameters_of(hexapod, hold=0.05)
    signals = static_signals(hexapod, hexapod.home.position, np.eye(3))
    segments = resting(np.full(6, 0.394))
    segments[:, 0, 2] = 0.01
    state = np.zeros((), STATE)
    for k in range(80):
        run(parameters, signals, segments, 1, state)
        np.testing.assert_allclose(state["reference"]["motion"][:, 0], 0.394 + 0.01 * PERIOD_S * max(k - 50, 0), rtol=1e-13)
        np.testing.assert_allclose(state["reference"]["motion"][:, 1:], [[0.01, 0.0]] * 6)


def test_a_derivative_is_not_kicked_by_an_error_that_was_there_during_the_hold(hexapod):
    signals = static_signals(hexapod, hexapod.home.position, np.eye(3))
    home = leg_lengths(hexapod, hexapod.home.position, np.eye(3))
    commands = []
    for derivative in (0.0, 1.0):
        parameters = parameters_of(hexapod, hold=0.05, derivative=derivative)
        commands.append(run(parameters, signals, resting(home + 1e-4), 51)["pid"]["command"].copy())
    np.testing.assert_allclose(commands[1], commands[0], rtol=0.0, atol=1e-9)


def test_a_command_drives_each_leg_towards_its_reference_within_the_limit(hexapod):
    signals = static_signals(hexapod, hexapod.home.position, np.eye(3))
    home = leg_lengths(hexapod, hexapod.home.position, np.eye(3))
    control = control_settings(hexapod)
    off = np.array([1e-3, -1e-3, 2e-3, -2e-3, 0.05, -0.05])
    balanced = run(parameters_of(hexapod), signals, resting(home), 201)["pid"]["command"].copy()
    state = run(parameters_of(hexapod), signals, resting(home + off), 201)
    np.testing.assert_allclose((state["pid"]["command"] - balanced)[:4], control.proportional * off[:4], rtol=1e-6)
    limit = control.command_reserve * hexapod.limits.velocity
    np.testing.assert_allclose(state["pid"]["command"][4:], [limit, -limit], rtol=1e-12)


def potential_energy(mechanism, position, rotation):
    """Of every body's centre of mass in the field of gravity."""
    plant, vectors = mechanism.plant, leg_vectors(mechanism, position, rotation)
    directions = unit(vectors)
    joints = mechanism.base_joints + vectors
    bodies = [
        (plant["platform.mass"], [position + rotation @ plant["platform.center_of_mass"]]),
        (plant["payload.mass"], [position + rotation @ plant["payload.center_of_mass"]]),
        (plant["leg.lower.mass"], mechanism.base_joints + plant["leg.lower.center"] * directions),
        (plant["leg.upper.mass"], joints - plant["leg.upper.center"] * directions),
    ]
    return -sum(mass * center @ plant["gravity"] for mass, centers in bodies for center in centers)


def holding_forces(mechanism, position, rotation):
    """Leg forces that hold the mechanism, by virtual work: the slope of the energy over the slope of the lengths."""
    h = 1e-5
    energy, lengths = np.zeros(6), np.zeros((6, 6))
    for i, step in enumerate(h * np.eye(6)):
        for sign in (1.0, -1.0):
            pose = position + sign * step[:3], rotation_of(sign * step[3:]) @ rotation
            energy[i] += sign * potential_energy(mechanism, *pose) / (2.0 * h)
            lengths[:, i] += sign * leg_lengths(mechanism, *pose) / (2.0 * h)
    return np.linalg.solve(lengths.T, energy)


@pytest.mark.parametrize("case", ["as it is", "inclined base", "eccentric payload", "no payload"])
def test_the_load_feed_forward_is_that_of_virtual_work(hexapod, case):
    changes = {
        "as it is": {},
        "inclined base": {"up_in_base": (0.2, -0.1, 0.9)},
        "eccentric payload": {"payload.center_of_mass": (0.05, -0.04, 0.15), "platform.center_of_mass": (0.0, 0.01, -0.02)},
        "no payload": {"payload.mass": 0.0},
    }[case]
    mechanism = variant(hexapod, **changes)
    plant, parameters = mechanism.plant, parameters_of(mechanism, hold=1e-3)
    # A drive at rest: R i = n k u + kappa R i with the force n k i, n = 2 pi / lead.
    turns = 2.0 * np.pi / plant["motor.screw_lead"]
    force_constant = turns * plant["motor.torque_constant"]
    speed_per_force = (1.0 - plant["drive.compensation"]) * plant["drive.nominal_resistance"] / force_constant**2
    for position, rotation in zip(*sample_workspace(mechanism, 15, seed=9), strict=True):
        forces = holding_forces(mechanism, position, rotation)
        lengths = leg_lengths(mechanism, position, rotation)
        state = run(parameters, static_signals(mechanism, position, rotation), resting(lengths), 3)
        np.testing.assert_allclose(
            state["load"]["feed_forward"], speed_per_force * forces, rtol=0.0, atol=1e-7 * speed_per_force * 200.0
        )
        np.testing.assert_allclose(state["pid"]["command"], state["load"]["feed_forward"], rtol=0.0, atol=1e-8)
        assert np.abs(forces).max() > 5.0


def test_the_feed_forward_adds_the_references_speed_and_the_inertia_of_its_acceleration(hexapod):
    plant, parameters = hexapod.plant, parameters_of(hexapod, hold=1e-3)
    position = hexapod.home.position
    signals, lengths = static_signals(hexapod, position, np.eye(3)), leg_lengths(hexapod, position, np.eye(3))
    still = run(parameters, signals, resting(lengths), 2)["load"]
    segments = resting(lengths)
    segments[:, 0, 2], segments[:, 0, 3] = np.linspace(-0.1, 0.1, 6), np.linspace(1.0, -2.0, 6)
    moving = run(parameters, signals, segments, 2)["load"]
    turns = 2.0 * np.pi / plant["motor.screw_lead"]
    sliding = plant["leg.upper.mass"] + plant["motor.rotor_inertia"] * turns**2
    speed_per_force = (1.0 - plant["drive.compensation"]) * plant["drive.nominal_resistance"]
    speed_per_force /= (turns * plant["motor.torque_constant"]) ** 2
    speed = segments[:, 0, 2]
    friction = (
        plant["friction.coulomb"] * speed / np.hypot(speed, plant["friction.velocity"]) + plant["friction.viscous"] * speed
    )
    inertia = sliding * segments[:, 0, 3] + moving["force"] - still["force"]
    extra = speed + speed_per_force * (inertia + friction)
    # The planned acceleration moves the estimate, and with it the rods' own weights, by a little.
    np.testing.assert_allclose(moving["feed_forward"] - still["feed_forward"], extra, rtol=0.0, atol=1e-9)


def test_settings_reach_the_cycle(hexapod):
    control = ControlSettings(proportional=11.0, integral=22.0, derivative=0.3, derivative_bandwidth=44.0, command_reserve=1.2)
    parameters = cycle_parameters(hexapod, 500.0, control, FusionSettings(leg_sigma=2e-3), LEG_IMUS)
    np.testing.assert_allclose(parameters["pid"]["gains"], [11.0, 22.0, 0.3, 44.0])
    np.testing.assert_allclose(parameters["pid"]["limit"], 1.2 * hexapod.limits.velocity)
    np.testing.assert_allclose(parameters["legs"]["weight"], 1.0 / 2e-3**2)
    assert parameters["imus"]["present"].tolist() == [1, 1, 1, 1, 1, 1, 0]
    assert parameters["rig"]["period"] == 1.0 / 500.0
    # A white density d over samples at a rate f has the variance d^2 f / 2.
    np.testing.assert_allclose(parameters["legs"]["rate_variance"], FusionSettings().gyroscope_noise ** 2 * 250.0)


def test_calibration_and_choices_reach_the_stages(hexapod):
    settings = control_settings(hexapod), fusion_settings(hexapod)
    known = np.diag(np.arange(1.0, 148.0))
    calibration = Calibration(tilt=np.array([0.02, -0.03]), covariance=known, floor=np.array([3e-3, 6e-3]))
    choices = {"magnetometer": True, "section_5": True, "command_delay": 0.003, "whole": "alignments"}
    found = cycle_parameters(hexapod, RATE_HZ, *settings, calibration=calibration, **choices)
    up = rotation_of([0.02, -0.03, 0.0]) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(found["rig"]["vectors_in_base"][0], up, atol=1e-12)
    np.testing.assert_allclose(found["rig"]["sensors"]["up_in_base"][0], up, atol=1e-12)
    filtered = found["mechanism"]["filter"]
    others = np.arange(147) % 21 > 5
    np.testing.assert_array_equal(filtered["prior"][:147, :147][others][:, others], known[others][:, others])
    # Axes, which are not estimated, count as biases of the accelerometers; they act on two of them.
    assert set(np.flatnonzero(np.diag(filtered["prior"])[:147] > np.diag(known)) % 21) == {3, 4}
    np.testing.assert_allclose(filtered["floor"], [3e-6, 12e-6], rtol=1e-12)
    assert (int(filtered["errors"]), int(filtered["heading"]), float(found["load"]["command_delay"])) == (15, 1, 0.003)
    assert (int(found["heading"]["active"]), int(found["pose"]["section_5"])) == (1, 1)
    plain = cycle_parameters(hexapod, RATE_HZ, *settings)
    assert (int(plain["mechanism"]["filter"]["errors"]), int(plain["mechanism"]["filter"]["heading"])) == (0, 0)
    assert (int(plain["heading"]["active"]), int(plain["pose"]["section_5"]), float(plain["load"]["command_delay"])) == (
        0,
        0,
        0.0,
    )
    planar = load_in_space("planar-3rpr")
    found = cycle_parameters(planar, RATE_HZ, control_settings(planar), fusion_settings(planar))
    assert found["imus"]["present"].tolist() == [1, 1, 1, 0, 0, 0, 1]


@pytest.mark.parametrize(("gravity", "told"), [(0.101, False), (0.099, True)])
def test_too_little_gravity_is_refused(hexapod, gravity, told):
    mechanism = variant(hexapod, gravity=np.array([0.0, 0.0, -gravity]))
    if not told:
        assert parameters_of(mechanism)["rig"]["sensors"]["gravity"] == pytest.approx(gravity)
        return
    with pytest.raises(
        InputError, match=re.escape("gravity is 0.099 m/s2; the accelerometers need at least 0.1 to tell a direction")
    ):
        parameters_of(mechanism)


# ------------------------------------------------------------------------------------------------------- around the cycle


def test_a_limit_of_the_protection_level_needs_one(hexapod):
    settings, limited = (control_settings(hexapod), fusion_settings(hexapod)), SafetySettings(protection_rotation=0.01)
    for rate, active in ((124.0, 0), (125.0, 1)):
        assert cycle_parameters(hexapod, rate, *settings)["integrity"]["filter"]["active"] == active
        assert evidence_remark(hexapod, rate).startswith("below 125 Hz an error that the IMUs share is told late") != active
    assert evidence_remark(hexapod, 1000.0, section_5=True).startswith("with the paper's section 5 an error")
    assert evidence_remark(load_in_space("planar-3rpr"), 1000.0).startswith("in a plane an error")
    cycle_parameters(hexapod, 125.0, *settings, safety=limited)
    with pytest.raises(InputError, match=r"from 125 Hz on \(this is 124 Hz\).*leave out protection_position"):
        cycle_parameters(hexapod, 124.0, *settings, safety=limited)
    # Raw IMUs are not watched, as whoever runs them says.
    cycle_parameters(hexapod, 124.0, *settings, safety=limited.for_raw_imus())


def test_missed_periods_are_counted_and_forgotten_with_the_next_cycle():
    state = np.zeros((), STATE)
    state["time"]["cycle"] = 7
    for missed, cycle_number in ((3, 10), (0, 10), (2, 12)):
        compiled.skip_periods(state, missed)
        assert (int(state["time"]["cycle"]), int(state["time"]["missed"])) == (cycle_number, missed)


def test_every_stage_that_runs_is_timed_and_no_other(hexapod):
    parameters, signals = parameters_of(hexapod), static_signals(hexapod, hexapod.home.position, np.eye(3))
    state, marks, stages = np.zeros((), STATE), np.zeros((), compiled.MARKS)[()], compiled.CycleStage
    for first, last, timed in (
        (stages.SCREENING, stages.LEGS, [0]),
        (stages.LEGS, stages.POSE, [1, 3]),
        (stages.POSE, stages.REFINEMENT, [4]),
        (stages.REFINEMENT, stages.CONTROL, [5, 6, 7]),
        (stages.CONTROL, stages.WATCH, [8]),
        (stages.WATCH, stages.END, [9]),
    ):
        marks["ns"] = -1
        assert state["time"]["cycle"] == 0
        compiled.run_stages(parameters, state, signals, resting(np.full(6, 0.394)), marks, int(first), int(last))
        assert np.flatnonzero(marks["ns"] >= 0).tolist() == timed
    # After the last stage, the cycle is over.
    assert state["time"]["cycle"] == 1


def test_without_a_pose_the_cycle_is_counted_and_only_a_run_that_moves_fails(hexapod):
    signals = static_signals(hexapod, hexapod.home.position, np.eye(3))
    lengths = leg_lengths(hexapod, hexapod.home.position, np.eye(3))
    blind = np.full((3, 7, 3), np.nan)
    parameters, state = parameters_of(hexapod, hold=0.02), np.zeros((), STATE)
    for k in range(3):
        assert cycle(parameters, state, blind, resting(lengths)) == Cause.POSE_LOST
        assert (int(state["time"]["cycle"]), state["safety"]["mode"]) == (k + 1, Mode.IDLE)
    # The filters settle first.
    for _ in range(160):
        cycle(parameters, state, signals, resting(lengths))
    run(parameters, signals, resting(lengths), 100, state)
    assert state["safety"]["mode"] == Mode.RUNNING
    assert cycle(parameters, state, blind, resting(lengths)) == Cause.POSE_LOST
    assert (int(state["time"]["cycle"]), state["safety"]["mode"]) == (264, Mode.FAULT)
    assert state["safety"]["stop"]["cause"] == Cause.POSE_LOST
    # From here on nothing is measured: the commands come to rest, and no cause is told again.
    state["pid"]["command"], pose = [0.01, -0.01, 0.001, -0.001, 0.0, 0.02], state["pose"].copy()
    assert cycle(parameters, state, signals, resting(lengths)) == Cause.NONE
    step = hexapod.limits.acceleration * PERIOD_S
    expected = [0.01 - step, step - 0.01, 0.0, 0.0, 0.0, 0.02 - step]
    np.testing.assert_allclose(state["pid"]["command"], expected, rtol=0.0, atol=1e-15)
    assert state["pose"].tobytes() == pose.tobytes()
    assert state["time"]["cycle"] == 265


def test_the_next_reference_is_prepared_after_a_cycle_unless_it_has_failed(hexapod):
    parameters, signals = parameters_of(hexapod, hold=0.02), static_signals(hexapod, hexapod.home.position, np.eye(3))
    segments = resting(leg_lengths(hexapod, hexapod.home.position, np.eye(3)))
    segments[:, 0, 2] = 0.01
    state, alone = np.zeros((), STATE), np.zeros((), STATE)
    for _ in range(100):
        run(parameters, signals, segments, 1, alone)
        run(parameters, signals, segments, 1, state)
        # Prepared or not, a cycle has the same reference.
        np.testing.assert_array_equal(state["reference"]["motion"], alone["reference"]["motion"])
        np.testing.assert_array_equal(state["pid"]["command"], alone["pid"]["command"])
        before = state["reference"]["motion"].copy()
        compiled.prepare_next(parameters, state, segments)
        assert state["safety"]["events"]["count"] == 0
        assert state["reference"]["due_cycle"] == state["time"]["cycle"] + 1
    assert state["safety"]["mode"] == Mode.RUNNING
    np.testing.assert_allclose(state["reference"]["motion"][:, 0] - before[:, 0], 0.01 * PERIOD_S, rtol=1e-9)
    state["safety"]["mode"], before = Mode.FAULT, state["reference"].copy()
    state["safety"]["events"]["count"] = 3
    state["time"]["cycle"] += 10
    compiled.prepare_next(parameters, state, segments)
    assert state["reference"].tobytes() == before.tobytes()
    assert state["safety"]["events"]["count"] == 0


def test_a_turn_of_the_whole_world_about_the_vertical_turns_the_estimate_with_it(hexapod):
    """Gravity does not tell north: joints turned about the vertical, readings unchanged, and the pose turns along."""
    turn = rotation_of([0.0, 0.0, 0.7])
    turned = Mechanism.from_legs(
        hexapod.base_joints @ turn.T,
        hexapod.platform_joints,
        home=Pose(hexapod.home.position, turn),
        limits={"stroke": (-0.06, 0.06)},
        plant=hexapod.plant,
    )
    at = wavy(hexapod, 10)
    measurements = [at(k).copy() for k in range(100)]
    states = [run(parameters_of(m), measurements.__getitem__, resting(np.full(6, 0.394)), 100) for m in (hexapod, turned)]
    np.testing.assert_allclose(states[1]["pose"]["position"], turn @ states[0]["pose"]["position"], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(states[1]["pose"]["rotation"], turn @ states[0]["pose"]["rotation"], rtol=0.0, atol=1e-10)
    assert Rotation.from_matrix(states[0]["pose"]["rotation"]).magnitude() > 1e-4
