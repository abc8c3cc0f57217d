"""What is watched in motion: every limit, in both directions, as long as it lasts, and what the rig reports."""

import math

import numpy as np
import pytest

from controller.cycle import hear_rig
from controller.inverse_kinematics import leg_lengths
from controller.safety import watch_nothing
from controller.safety.causes import Cause, DriveState, Mode, Request
from controller.safety.stop import describe_end
from controller.safety.watch import (
    check_carried,
    check_drift,
    check_judgement,
    check_limits,
    check_misfit,
    check_oscillation,
    check_rest,
    watch_parameters,
)
from controller.settings import SafetySettings
from plant.mechanism import Limits
from plant.pose import rotation_from_vector
from tests.controller.safety.moving import PERIOD_S, moving, place, stop_of, told

FOLLOWING = np.full(6, DriveState.FOLLOWING, np.int64)
BUS_CYCLES = 8
"""0.02 s at 400 Hz."""


def check(parameters, state, trusted=0):
    """Hold the state against the limits; returns the cause of a fault."""
    p, s = parameters, state
    return check_limits(
        p["safety"][()], s["safety"][()], p["rig"][()], s["time"][()], p["imus"][()], s["imus"][()], s["pose"][()], trusted,
        s["reference"][()], float(p["pid"]["limit"]), s["pid"][()],
    )  # fmt: skip


def cycles_until_a_stop(parameters, state, most=200):
    for n in range(1, most):
        check(parameters, state)
        if state["safety"]["stop"]["cause"] != Cause.NONE:
            return n
    return None


def slide(state, speed):
    """Let all legs grow at a speed."""
    state["pose"]["arms"], state["pose"]["directions"] = 0.0, (0.0, 1.0, 0.0)
    state["pose"]["smooth_twist"][1] = speed
    state["pid"]["command"] = speed


# ------------------------------------------------------------------------------------------------------------- the constants


def test_limits_are_those_of_the_settings_with_their_margins():
    stroke = np.array([[0.30 + 0.01 * k, 0.40 + 0.02 * k] for k in range(6)])
    limits = Limits(stroke, velocity=0.3, acceleration=2.0, jerk=50.0)
    settings = SafetySettings(
        most_lost_imus=2.0, conditioning=0.01, stroke_margin=0.004, velocity_margin=1.5, following=0.02, saturation=0.3,
        drive_deviation=0.11, patience=0.06, bus_patience=0.05, carried=0.02, oscillation=0.02,
    )  # fmt: skip
    p = watch_parameters(settings, 200.0, limits)
    assert (p["most_lost_imus"], p["conditioning"], p["following"]) == (2, 0.01, 0.02)
    assert (p["saturation"], p["drive_deviation"], p["patience"], p["bus_cycles"]) == (0.3, 0.11, 0.06, 10)
    assert p["speed"] == pytest.approx(0.45) and p["carried"] == p["oscillation"] == pytest.approx(4e-4)
    np.testing.assert_allclose(p["lengths"], stroke + [-0.004, 0.004])
    # A quarter of the stroke's 100 to 150 mm.
    away = (0.1 + 0.01 * np.arange(6)) / 4.0
    np.testing.assert_allclose(p["plausible_lengths"], np.stack([stroke[:, 0] - away, stroke[:, 1] + away], axis=1))
    # At low rates, a deviation lasts for ten cycles and a bus is lost after three.
    slow = watch_parameters(SafetySettings(), 100.0, limits)
    assert (slow["patience"], slow["bus_cycles"]) == (0.1, 3)


@pytest.mark.parametrize("preset", ["hexapod", "planar-3rpr"])
def test_with_nothing_watched_nothing_stops(preset):
    mechanism, parameters, state = moving(preset)
    watch_nothing(parameters)
    random = np.random.default_rng(0)
    for _ in range(300):
        state["pose"]["lengths"][: mechanism.legs] = random.normal(0.0, 5.0, mechanism.legs)
        state["pose"]["conditioning"], state["imus"]["used"] = 0.0, 0
        state["pose"]["smooth_twist"], state["pid"]["error"] = random.normal(0.0, 9.0, 6), 10.0
        state["pid"]["command"] = parameters["pid"]["limit"]
        assert check(parameters, state) == Cause.NONE
    assert told(state) == []
    assert np.isinf(parameters["imus"]["noise"]).all() and np.isinf(parameters["safety"]["arming"]["distance"])
    assert parameters["safety"]["monitor"]["active"] == 0


# ---------------------------------------------------------------------------------------------------------------- the limits


@pytest.mark.parametrize("preset", ["hexapod", "planar-3rpr"])
@pytest.mark.parametrize("seed", range(3))
def test_the_speed_of_a_leg_is_the_derivative_of_its_length(preset, seed):
    mechanism, parameters, state = moving(preset)
    watch_nothing(parameters)
    random = np.random.default_rng(seed)
    move, twist = random.normal(0.0, [0.01, 0.01, 0.01, 0.1, 0.1, 0.1]), random.normal(0.0, 0.3, 6)
    if mechanism.planar:
        move[2:5] = twist[2:5] = 0.0
    position, rotation = mechanism.home.position + move[:3], rotation_from_vector(move[3:]) @ mechanism.home.rotation
    place(mechanism, state, position, rotation)
    state["pose"]["smooth_twist"] = twist
    check(parameters, state)
    h = 1e-6
    after, before = (
        leg_lengths(mechanism, position + t * twist[:3], rotation_from_vector(t * twist[3:]) @ rotation) for t in (h, -h)
    )
    speeds = state["safety"]["watch"]["speed"]
    np.testing.assert_allclose(speeds[: mechanism.legs], (after - before) / (2.0 * h), rtol=0.0, atol=1e-8)
    assert not speeds[mechanism.legs :].any()


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_leg_may_be_as_fast_as_its_margin_allows(sign):
    for speed, expected in ((0.49, Cause.NONE), (0.51, Cause.TOO_FAST)):
        _, parameters, state = moving()
        slide(state, sign * speed)
        assert check(parameters, state) == Cause.NONE
        assert stop_of(state)[0] == expected
    assert stop_of(state) == (Cause.TOO_FAST, 0, pytest.approx(0.51), 0.5)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("leg", [0, 5])
def test_a_drive_must_do_what_it_is_told_in_the_direction_in_which_it_is_told(leg, sign):
    _, parameters, state = moving()
    slide(state, 0.1 * sign)
    state["pid"]["command"][leg] = -0.04 * sign
    assert cycles_until_a_stop(parameters, state) is None
    # Only what lasts counts, without a break.
    state["pid"]["command"][leg] = -0.06 * sign
    for _ in range(3):
        assert cycles_until_a_stop(parameters, state, 18) is None
        state["pid"]["command"][leg] = 0.1 * sign
        check(parameters, state)
        state["pid"]["command"][leg] = -0.06 * sign
    # 0.05 s are 20 cycles.
    assert cycles_until_a_stop(parameters, state) in (20, 21)
    assert stop_of(state) == (Cause.DRIVE_DEVIATES, leg, pytest.approx(0.16), 0.15)
    assert (state["safety"]["mode"], state["safety"]["request"]) == (Mode.FAULT, Request.BRAKED)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("leg", [0, 5])
def test_a_leg_must_be_off_its_reference_for_a_while_without_a_break(leg, sign):
    _, parameters, state = moving()
    error = state["pid"]["error"]
    error[leg] = 0.0099 * sign
    assert cycles_until_a_stop(parameters, state) is None
    for _ in range(3):
        error[leg] = 0.0101 * sign
        assert cycles_until_a_stop(parameters, state, 18) is None
        error[leg] = 0.0
        check(parameters, state)
    error[leg] = 0.0101 * sign
    assert cycles_until_a_stop(parameters, state) in (20, 21)
    assert stop_of(state) == (Cause.FOLLOWING_ERROR, leg, pytest.approx(0.0101), 0.01)
    assert (state["safety"]["mode"], state["safety"]["request"]) == (Mode.STOPPING, Request.ENABLED)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_command_may_be_at_its_limit_for_a_while(sign):
    _, parameters, state = moving()
    parameters["safety"]["watch"]["drive_deviation"] = 1e3
    most = float(parameters["pid"]["limit"])
    assert most == pytest.approx(0.35)
    command = state["pid"]["command"]
    command[4] = np.nextafter(most, 0.0) * sign
    assert cycles_until_a_stop(parameters, state) is None
    command[4] = most * sign
    assert cycles_until_a_stop(parameters, state, 95) is None
    command[4] = 0.0
    check(parameters, state)
    command[4] = most * sign
    # 0.25 s are 100 cycles.
    assert cycles_until_a_stop(parameters, state) in (100, 101)
    assert stop_of(state) == (Cause.SATURATED, 4, pytest.approx(0.25, abs=0.0026), 0.25)


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize("leg", [0, 5])
def test_a_little_beyond_the_stroke_is_a_stop_and_far_beyond_it_a_fault(leg, end):
    out = 2.0 * end - 1.0
    for beyond, cause, limit, mode in (
        (0.0029, Cause.NONE, 0.0, Mode.RUNNING),
        (0.0031, Cause.BEYOND_STROKE, 0.003, Mode.STOPPING),
        (0.0299, Cause.BEYOND_STROKE, 0.003, Mode.STOPPING),
        (0.0301, Cause.IMPLAUSIBLE, 0.03, Mode.FAULT),
    ):
        mechanism, parameters, state = moving()
        edge = mechanism.limits.stroke[leg, end]
        state["pose"]["lengths"][leg] = edge + out * beyond
        assert check(parameters, state) == (cause if mode == Mode.FAULT else Cause.NONE)
        assert state["safety"]["mode"] == mode
        if cause != Cause.NONE:
            assert stop_of(state) == (cause, leg, pytest.approx(edge + out * beyond), pytest.approx(edge + out * limit))


@pytest.mark.parametrize("leg", [0, 5])
@pytest.mark.parametrize("stage", ["command", "lengths"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_a_fault(leg, stage, value):
    _, parameters, state = moving()
    state["pid" if stage == "command" else "pose"][stage][leg] = value
    assert check(parameters, state) == Cause.NOT_FINITE
    assert stop_of(state)[:2] == (Cause.NOT_FINITE, leg)
    assert (state["safety"]["mode"], state["safety"]["request"]) == (Mode.FAULT, Request.QUICK_STOP)
    assert np.isfinite(state["pid"]["command"]).all()


def test_a_badly_determined_pose_is_a_stop_unless_the_filter_is_trusted():
    for conditioning, trusted, cause in (
        (0.0051, 0, Cause.NONE), (0.0049, 0, Cause.ILL_CONDITIONED), (0.0049, 1, Cause.NONE), (0.0, 1, Cause.NONE),
    ):  # fmt: skip
        _, parameters, state = moving()
        state["pose"]["conditioning"] = conditioning
        assert check(parameters, state, trusted) == Cause.NONE
        assert stop_of(state)[0] == cause


@pytest.mark.parametrize("preset", ["hexapod", "planar-3rpr"])
def test_without_the_platforms_imu_it_goes_on_for_a_moment_only(preset):
    _, parameters, state = moving(preset)
    patience = round(float(parameters["safety"]["watch"]["patience"]) / PERIOD_S)
    for _ in range(3):
        # A break begins the time anew.
        state["imus"]["used"][6] = 0
        assert cycles_until_a_stop(parameters, state, patience) is None
        state["imus"]["used"][6] = 1
        check(parameters, state)
    state["imus"]["used"][6] = 0
    assert abs(cycles_until_a_stop(parameters, state) - patience) <= 1
    assert stop_of(state)[:2] == (Cause.PLATFORM_IMU_LOST, 6) and state["safety"]["mode"] == Mode.STOPPING
    assert "without IMU 6 nothing shows an error that the legs' IMUs share" in describe_end(state)


@pytest.mark.parametrize("allowed", [True, False])
def test_a_run_without_the_platforms_imu_goes_on_if_that_is_allowed_or_there_is_none(allowed):
    mechanism, parameters, state = moving()
    settings = SafetySettings(need_platform_imu=0.0 if allowed else 1.0)
    parameters["safety"]["watch"] = watch_parameters(settings, 1.0 / PERIOD_S, mechanism.limits)
    parameters["imus"]["present"][6] = allowed
    state["imus"]["used"][6] = 0
    assert cycles_until_a_stop(parameters, state, 1000) is None


@pytest.mark.parametrize("lost", [(0, 6), (4, 5), (6,), (0,)])
def test_more_lost_imus_than_may_be_are_a_stop_and_absent_ones_are_not_lost(lost):
    _, parameters, state = moving()
    state["imus"]["used"][list(lost)] = 0
    check(parameters, state)
    assert stop_of(state) == ((Cause.IMUS_LOST, -1, 2.0, 1.0) if len(lost) == 2 else (Cause.NONE, 0, 0.0, 0.0))
    _, parameters, state = moving()
    parameters["imus"]["present"][list(lost)] = state["imus"]["used"][list(lost)] = 0
    check(parameters, state)
    assert stop_of(state)[0] == Cause.NONE


@pytest.mark.parametrize(
    ("mode", "request_", "watched"),
    [
        (Mode.IDLE, Request.BRAKED, False),
        (Mode.ARMED, Request.ENABLED, False),
        (Mode.STOPPING, Request.BRAKED, False),
        (Mode.STOPPING, Request.ENABLED, True),
    ],
)
def test_it_is_watched_while_anything_may_move(mode, request_, watched):
    mechanism, parameters, state = moving(mode=mode, request=request_)
    state["pose"]["lengths"][2] = mechanism.limits.stroke[2, 1] + 0.05
    assert check(parameters, state) == (Cause.IMPLAUSIBLE if watched else Cause.NONE)
    assert state["safety"]["mode"] == (Mode.FAULT if watched else mode)


# ------------------------------------------------------------------------------------------------------------ the rig's report


CODES = 0x7500 + np.arange(6)


def hear(parameters, state, drive=FOLLOWING, silent=0, age=None):
    hear_rig(parameters, state, np.zeros(7, np.int64) if age is None else age, drive, CODES, silent)


def test_what_the_rig_reports_is_noted():
    _, parameters, state = moving()
    age, drive = np.arange(7) + 3, np.array([0, 0, 0, 0, 0, 0])
    hear(parameters, state, drive, 2, age)
    np.testing.assert_array_equal(state["imus"]["sample_age"], age)
    np.testing.assert_array_equal(state["safety"]["watch"]["drive"], drive)
    assert state["safety"]["watch"]["silent"] == 2


def test_each_lapse_of_the_rig_is_told_once():
    _, parameters, state = moving()
    lapses = []
    for silent in (0, 1, 2, 3, 0, 0, 1, 0):
        hear(parameters, state, silent=silent)
        lapses.append(told(state) == [Cause.ANSWER_LATE])
    assert lapses == [False, True, False, False, False, False, True, False]


def test_a_bus_is_lost_after_its_patience_and_not_before():
    for silent, cause in ((BUS_CYCLES - 1, Cause.NONE), (BUS_CYCLES, Cause.BUS_LOST)):
        _, parameters, state = moving()
        hear(parameters, state, silent=silent)
        assert stop_of(state)[0] == cause
    assert stop_of(state) == (Cause.BUS_LOST, -1, 8.0, 8.0)


def test_a_bus_is_lost_when_more_exchanges_fail_than_succeed():
    _, parameters, state = moving()
    # As many failures as successes are borne; early successes are no reserve.
    for _ in range(50):
        hear(parameters, state)
    for _ in range(50):
        hear(parameters, state, silent=1)
        hear(parameters, state)
    assert stop_of(state)[0] == Cause.NONE
    for _ in range(2 * BUS_CYCLES - 1):
        hear(parameters, state, silent=1)
    assert state["safety"]["mode"] == Mode.RUNNING
    hear(parameters, state, silent=1)
    assert stop_of(state) == (Cause.BUS_LOST, -1, 16.0, 8.0)


def test_before_the_drives_are_enabled_the_rig_may_report_what_it_will():
    _, parameters, state = moving(mode=Mode.IDLE, request=Request.BRAKED)
    hear(parameters, state, np.full(6, DriveState.FAULTY, np.int64), 100)
    assert stop_of(state)[0] == Cause.NONE and state["safety"]["mode"] == Mode.IDLE


@pytest.mark.parametrize("leg", [0, 5])
@pytest.mark.parametrize(
    ("mode", "drive", "cause"),
    [
        (Mode.ARMED, DriveState.READY, Cause.NONE),
        (Mode.ARMED, DriveState.NOT_READY, Cause.NONE),
        (Mode.ARMED, DriveState.FAULTY, Cause.DRIVE_FAULT),
        (Mode.RUNNING, DriveState.READY, Cause.DRIVE_OFF),
        (Mode.RUNNING, DriveState.FAULTY, Cause.DRIVE_FAULT),
        (Mode.STOPPING, DriveState.QUICK_STOPPING, Cause.DRIVE_OFF),
    ],
)
def test_a_drive_that_leaves_its_operation_is_named(mode, drive, cause, leg):
    _, parameters, state = moving(mode=mode)
    drives = FOLLOWING.copy()
    drives[leg] = drive
    hear(parameters, state, drives)
    assert stop_of(state)[:2] == ((cause, leg) if cause != Cause.NONE else (cause, 0))
    if cause == Cause.DRIVE_FAULT:
        assert describe_end(state) == f"drive {leg} reports a fault (code 0x750{leg})"


def test_drives_that_a_planar_mechanism_lacks_do_not_count():
    for leg, mode in ((2, Mode.FAULT), (3, Mode.RUNNING), (5, Mode.RUNNING)):
        _, parameters, state = moving("planar-3rpr")
        drives = FOLLOWING.copy()
        drives[leg] = DriveState.FAULTY
        hear(parameters, state, drives)
        assert state["safety"]["mode"] == mode


# ------------------------------------------------------------------------------------------------------------- shaken IMUs


def check_shaken(parameters, state):
    p, s = parameters["safety"][()], state
    check_carried(
        p, s["safety"][()], parameters["rig"][()], s["time"][()], s["imus"]["shaking"][()], s["legs"][()], s["mechanism"][()],
        s["reference"][()], s["pid"][()],
    )  # fmt: skip
    return s["safety"]["stop"]["cause"] != Cause.NONE


@pytest.mark.parametrize("sign", ["told", "bridging"])
def test_a_run_with_shaken_imus_ends_when_a_leg_is_known_no_better_than_the_limit(sign):
    _, parameters, state = moving()
    limit, legs = SafetySettings().carried, state["legs"]
    legs["used"][:5] = 1.0
    for k, share in ((2, 1.01), (5, 9.0)):
        legs["covariance"][k, 0, 0], legs["covariance"][k, 1, 1] = 0.3 * (share * limit) ** 2, 0.7 * (share * limit) ** 2
    # As long as nothing moves.
    state["imus"]["shaking"][sign] = 1
    state["safety"]["mode"] = Mode.ARMED
    assert not check_shaken(parameters, state)
    state["safety"]["mode"] = Mode.RUNNING
    legs["covariance"][2] *= 0.97
    assert not check_shaken(parameters, state)
    legs["covariance"][2] /= 0.97
    assert check_shaken(parameters, state)
    cause, leg, value, most = stop_of(state)
    assert (cause, leg, most) == (Cause.NOT_CARRIED, 2, pytest.approx(limit)) and value == pytest.approx(1.01 * limit)


def test_what_shaking_adds_to_the_uncertainty_of_before_counts():
    """A few IMUs know some directions no better than the limit at any time."""
    _, parameters, state = moving()
    limit, legs = SafetySettings().carried, state["legs"]
    legs["used"][:] = 1.0
    legs["covariance"][3, 0, 0] = (2.0 * limit) ** 2
    assert not check_shaken(parameters, state)
    state["imus"]["shaking"]["told"] = 1
    legs["covariance"][3, 0, 0] = 4.99 * limit**2
    assert not check_shaken(parameters, state)
    legs["covariance"][3, 0, 0] = 5.01 * limit**2
    assert check_shaken(parameters, state)
    assert stop_of(state)[3] == pytest.approx(np.sqrt(5.0) * limit)


def test_while_the_whole_mechanism_filter_is_trusted_its_rotation_counts():
    _, parameters, state = moving()
    limit, mechanism = SafetySettings().carried, state["mechanism"]
    state["imus"]["shaking"]["told"], mechanism["trusted"] = 1, 1
    state["legs"]["used"], state["legs"]["covariance"] = 1.0, 1.0
    mechanism["filter"]["published_covariance"][:3, :3] = 1.0
    mechanism["filter"]["published_covariance"][4, 4] = (0.99 * limit) ** 2
    assert not check_shaken(parameters, state)
    mechanism["filter"]["published_covariance"][4, 4] = (1.01 * limit) ** 2
    assert check_shaken(parameters, state)
    assert stop_of(state)[:2] == (Cause.NOT_CARRIED, -1)


# ------------------------------------------------------------------------------------------------------ commands that oscillate


def corrections_bear(seconds, amplitude, frequency, **run):
    """How a run ends whose commands go to and fro by so much [m/s] about their feed-forward; None if it does not."""
    state, after = oscillated(seconds, amplitude, frequency, **run)
    return None if state["safety"]["stop"]["cause"] == Cause.NONE else (stop_of(state), after)


def oscillated(seconds, amplitude, frequency, told=1, mode=Mode.RUNNING, steady=0.0, axis=4, sway=0.0):
    """The state after so long of such commands of all legs, or when they have ended the run, and how long that was [s]. The
    platform moves to and fro along or about an axis by so much [m/s, rad/s RMS].
    """
    _, parameters, state = moving()
    s, period = state["safety"], float(parameters["rig"]["period"])
    state["imus"]["shaking"]["told"], s["mode"], s["watch"]["sway"][axis] = told, mode, 0.3
    feed_forward, twist = np.linspace(-0.1, 0.1, 6), np.zeros(6)
    phases = np.arange(6.0)
    for cycle in range(round(seconds / period)):
        turn = 2.0 * np.pi * frequency * period * cycle
        state["pid"]["command"] = feed_forward + steady + amplitude * np.sin(turn + phases)
        twist[axis] = 0.3 + np.sqrt(2.0) * sway * np.sin(turn)
        check_oscillation(
            parameters["safety"][()], s[()], parameters["rig"][()], state["time"][()], state["imus"]["shaking"][()], twist,
            feed_forward, state["reference"][()], state["pid"][()],
        )  # fmt: skip
        if s["stop"]["cause"] != Cause.NONE:
            break
    return state, period * cycle


@pytest.mark.parametrize("frequency", [10.0, 18.0, 60.0])
def test_commands_that_oscillate_while_the_imus_are_shaken_end_a_run_after_a_second(frequency):
    limit = SafetySettings().oscillation
    assert corrections_bear(3.0, 0.95 * np.sqrt(2.0) * limit, frequency) is None
    (cause, leg, value, most), after = corrections_bear(3.0, 1.2 * np.sqrt(2.0) * limit, frequency)
    assert cause == Cause.OSCILLATES and 0 <= leg < 6 and limit < value < 1.25 * limit and most == pytest.approx(limit)
    assert 1.0 < after < 1.4


@pytest.mark.parametrize(("axis", "most", "told"), [(2, 0.011, 1), (4, np.radians(2.2), 0), (4, np.radians(2.2), 1)])
def test_a_platform_that_oscillates_has_its_gains_halved_twice_and_is_stopped_if_that_does_not_help(axis, most, told):
    limit, sways = SafetySettings().oscillation, {"axis": axis, "sway": 1.36 * most}
    for share, seconds, halvings in (
        (0.24, 3.0, 0), (0.3, 0.15, 0), (0.3, 0.5, 1), (0.48, 3.0, 1), (0.6, 0.08, 0), (0.6, 0.4, 1), (0.6, 0.9, 2),
        (0.95, 0.13, 1), (0.95, 3.0, 2),
    ):  # fmt: skip
        state, _ = oscillated(seconds, share * np.sqrt(2.0) * limit, 18.0, told, **sways)
        assert state["pid"]["halvings"] == halvings, (share, seconds)
        events = state["safety"]["events"]
        assert events["cause"][:halvings].tolist() == [Cause.GAINS_HALVED] * halvings and events["count"] == halvings
        np.testing.assert_allclose(events["limit"][:halvings], limit * np.array([0.25, 0.5])[:halvings])
        assert state["safety"]["mode"] == Mode.RUNNING
    state, after = oscillated(3.0, 1.2 * np.sqrt(2.0) * limit, 18.0, told, **sways)
    assert state["pid"]["halvings"] == 2 and stop_of(state)[0] == Cause.OSCILLATES and 1.2 < after < 1.5
    calm, _ = oscillated(3.0, 0.6 * np.sqrt(2.0) * limit, 18.0, told, axis=axis, sway=0.91 * most)
    assert calm["pid"]["halvings"] == 0


def test_a_platform_that_heaves_and_shakes_no_imu_keeps_its_gains():
    """It may follow a step."""
    state, _ = oscillated(3.0, 3.0 * SafetySettings().oscillation, 18.0, told=0, axis=2, sway=0.1)
    assert state["pid"]["halvings"] == 0 and state["safety"]["mode"] == Mode.RUNNING


@pytest.mark.parametrize(
    "bearing", [{"told": 0}, {"mode": Mode.STOPPING}, {"frequency": 0.2}, {"amplitude": 0.0, "steady": 0.2}]
)
def test_noise_of_the_estimate_a_stop_and_slow_corrections_are_no_oscillation(bearing):
    assert corrections_bear(**{"seconds": 3.0, "amplitude": 0.05, "frequency": 18.0, **bearing}) is None


# ------------------------------------------------------------------------------------------------------- no pose fits the IMUs


def cycles_until_unfit(parameters, state, misfits, moved=0.0):
    """After how many of these cycles a run ends, with misfits without the worst measurement; None if it does not.

    Args:
        moved: how far the estimate has moved otherwise than commanded [m].
    """
    s = state["safety"]
    for cycle, misfit in enumerate(misfits):
        state["pose"]["rest_misfit"] = misfit
        check_misfit(
            parameters["safety"][()], s[()], parameters["rig"][()], state["time"][()], state["pose"][()], moved,
            state["reference"][()], state["pid"][()],
        )  # fmt: skip
        if s["stop"]["cause"] != Cause.NONE:
            return cycle + 1
    return None


@pytest.mark.parametrize(("moved", "share"), [(1.2e-3, 1.0), (2.6e-3, 0.5), (6.5e-3, 0.2)])
def test_an_estimate_that_has_moved_otherwise_than_commanded_is_believed_with_a_smaller_misfit_only(moved, share):
    limit = share * SafetySettings().misfit
    _, parameters, state = moving()
    assert cycles_until_unfit(parameters, state, [(0.99 * limit) ** 2] * 1000, moved) is None
    assert cycles_until_unfit(parameters, state, [(1.01 * limit) ** 2] * 1000, moved) is not None
    assert stop_of(state) == (Cause.NO_POSE_FITS, -1, pytest.approx(1.01 * limit), pytest.approx(limit))


def test_an_estimate_of_which_it_is_not_known_how_it_has_moved_has_the_usual_limit():
    _, parameters, state = moving()
    limit = SafetySettings().misfit ** 2
    assert cycles_until_unfit(parameters, state, [0.99 * limit] * 1000, np.nan) is None
    assert cycles_until_unfit(parameters, state, [1.01 * limit] * 1000, np.nan) is not None


def test_a_run_ends_within_5_ms_when_no_pose_fits_the_imus():
    _, parameters, state = moving()
    limit, lasting = SafetySettings().misfit ** 2, math.ceil(0.005 / float(parameters["rig"]["period"]))
    assert cycles_until_unfit(parameters, state, [0.99 * limit] * 1000) is None
    # Not if a pose fits every now and then.
    assert cycles_until_unfit(parameters, state, ([9.0 * limit] * (lasting - 1) + [0.5 * limit]) * 50) is None
    state["safety"]["mode"] = Mode.STOPPING
    assert cycles_until_unfit(parameters, state, [9.0 * limit] * (lasting - 1)) is None
    state["safety"]["mode"] = Mode.RUNNING
    assert cycles_until_unfit(parameters, state, [4.0 * limit]) == 1
    assert stop_of(state) == (Cause.NO_POSE_FITS, -1, pytest.approx(2.0 * np.sqrt(limit)), pytest.approx(np.sqrt(limit)))


def test_whoever_ignores_the_imus_disagreement_ignores_their_misfit(hexapod):
    assert watch_parameters(SafetySettings(watch_imus=0.0), 1000.0, hexapod.limits)["misfit"] == np.inf


@pytest.mark.parametrize(
    ("both", "mode", "evidence", "stops"),
    [
        (2.1e-3, Mode.RUNNING, 6.0, True),
        (1.9e-3, Mode.RUNNING, 6.0, False),
        (2.1e-3, Mode.STOPPING, 6.0, False),
        (2.1e-3, Mode.RUNNING, np.inf, False),
    ],
)
def test_a_motion_at_rest_ends_a_run_that_is_judged(both, mode, evidence, stops):
    _, parameters, state = moving(mode=mode)
    p, s = parameters, state
    p["safety"]["watch"]["evidence"] = evidence
    rest = s["integrity"]["rest"]
    rest["both"], rest["limit"] = both, 2e-3
    check_rest(p["safety"][()], s["safety"][()], p["rig"][()], s["time"][()], rest[()], s["reference"][()], s["pid"][()])
    if stops:
        assert stop_of(state) == (Cause.MOVES_AT_REST, -1, both, 2e-3)
    else:
        assert state["safety"]["stop"]["cause"] == Cause.NONE


@pytest.mark.slow
@pytest.mark.parametrize("part", [0, 1])
@pytest.mark.parametrize(
    ("sigmas", "change", "stops"),
    [
        (3.1, "", True),
        (2.9, "", False),
        (3.1, "told", False),
        (3.1, "bridging", False),
        (3.1, "waits", False),
        (3.1, "set", False),
        (3.1, "age", False),
        (3.1, "evidence", False),
    ],
)
def test_a_pose_that_drifts_from_what_gravity_shows_for_a_second_ends_a_run(part, sigmas, change, stops):
    _, parameters, state = moving()
    p, s, integrity = parameters, state, state["integrity"]
    integrity["protection"]["closed"] = [1e-6, 4e-6]
    integrity["gravity"]["drifted"][part] = sigmas * (1e-3, 2e-3)[part]
    integrity["gravity"]["age"] = 9.9 if change == "age" else 10.1
    p["safety"]["watch"]["evidence"] = np.inf if change == "evidence" else 6.0
    if change in ("told", "bridging"):
        state["imus"]["shaking"][change] = 1
    if change == "waits":
        integrity["waits"] = 1
    used = state["imus"]["used"]
    s["safety"]["watch"]["used_imus"] = np.sum(used << np.arange(7))

    def cycles(seconds):
        for _ in range(round(seconds / PERIOD_S)):
            check_drift(
                p["safety"][()], s["safety"][()], p["rig"][()], s["time"][()], s["imus"][()], integrity[()],
                s["reference"][()], s["pid"][()],
            )  # fmt: skip

    cycles(0.99)
    assert state["safety"]["stop"]["cause"] == Cause.NONE
    used[2] = 0 if change == "set" else used[2]
    cycles(0.02)
    if stops:
        assert stop_of(state) == (Cause.DRIFTS, -1, pytest.approx(sigmas), 3.0)
        return
    assert state["safety"]["stop"]["cause"] == Cause.NONE
    if change in ("told", "bridging", "set"):
        # The filters need some seconds to forget what has shaken them, and the reference of the drift to follow other IMUs.
        if change != "set":
            state["imus"]["shaking"][change] = 0
        cycles(10.99 if change != "set" else 10.97)
        assert state["safety"]["stop"]["cause"] == Cause.NONE
        cycles(0.02)
        assert stop_of(state)[0] == Cause.DRIFTS


@pytest.mark.parametrize("limit", [np.inf, 0.05])
def test_where_no_evidence_can_be_taken_that_is_told_and_the_level_is_unknown(limit):
    _, parameters, state = moving()
    parameters["safety"]["watch"]["level"][0] = limit
    integrity = state["integrity"]
    integrity["evaluations"], integrity["protection"]["level"] = 7, 1e-3

    def check_it():
        p, s = parameters, state
        check_judgement(
            p["safety"][()], s["safety"][()], p["rig"][()], s["time"][()], integrity[()], s["reference"][()], s["pid"][()]
        )  # fmt: skip

    integrity["unjudged_for"] = 0.9
    check_it()
    assert told(state) == [] and stop_of(state)[0] == Cause.NONE
    integrity["unjudged_for"] = 1.1
    for _ in range(3):
        check_it()
    stopped = [Cause.POSITION_UNSURE] if limit < np.inf else []
    assert told(state) == [Cause.UNJUDGED, *stopped] and (integrity["protection"]["level"] == np.inf).all()
    assert stop_of(state)[0] == (Cause.POSITION_UNSURE if stopped else Cause.NONE)
