"""The reference of each cycle: when the time of a motion begins, what missed periods do, and when a stop takes over."""

import numpy as np
import pytest

from controller.cycle import STATE, cycle_parameters, prepare_next, skip_periods
from controller.inverse_kinematics import leg_lengths
from controller.safety.causes import Cause, Mode, Request
from controller.settings import SafetySettings, control_settings, fusion_settings
from tests.controller.cycles import cycle, follow_at_once
from tests.controller.leg_geometry import static_signals

RATE_HZ, PERIOD_S, HOLD = 500.0, 2e-3, 10
SPEEDS = np.array([0.01, -0.02, 0.03, -0.04, 0.05, -0.06])
UNWATCHED = SafetySettings(
    following=1e3, drive_deviation=1e3, saturation=1e3, velocity_margin=1e3, arming_distance=1e3, watch_imus=0.0
)


def moving(starts, speeds):
    """Segments (6, 1, 5) of legs that move evenly."""
    segments = np.zeros((6, 1, 5))
    segments[:, 0, 1], segments[:, 0, 2] = starts, speeds
    return segments


@pytest.fixture
def parameters(hexapod):
    settings = control_settings(hexapod, hold=HOLD * PERIOD_S), fusion_settings(hexapod)
    return follow_at_once(cycle_parameters(hexapod, RATE_HZ, *settings, safety=UNWATCHED))


def state_at(cycle_number, mode, delay=0, request=Request.ENABLED):
    state = np.zeros((), STATE)
    state["time"]["cycle"] = cycle_number
    state["safety"]["mode"], state["safety"]["request"], state["safety"]["arming"]["delay"] = mode, request, delay
    return state


@pytest.mark.parametrize(
    ("number", "mode", "delay", "passed"),
    [
        (5, Mode.RUNNING, 0, 0), (10, Mode.RUNNING, 0, 0), (11, Mode.RUNNING, 0, 1), (60, Mode.RUNNING, 0, 50),
        (60, Mode.RUNNING, 7, 43), (17, Mode.RUNNING, 7, 0), (18, Mode.RUNNING, 7, 1), (60, Mode.STOPPING, 7, 43),
        (60, Mode.IDLE, 0, 0), (60, Mode.ARMED, 0, 0),
    ],
)  # fmt: skip
def test_the_time_of_a_motion_begins_when_the_hold_and_the_delay_of_the_arming_are_over(
    parameters, number, mode, delay, passed
):
    state = state_at(number, mode, delay)
    prepare_next(parameters, state, moving(0.4, SPEEDS))
    motion = state["reference"]["motion"]
    np.testing.assert_allclose(motion[:, 0], 0.4 + SPEEDS * PERIOD_S * passed, rtol=1e-14)
    np.testing.assert_array_equal(motion[:, 1:], np.column_stack([SPEEDS, np.zeros(6)]))
    assert state["reference"]["due_cycle"] == number + 1


@pytest.mark.parametrize("request_", [Request.ENABLED, Request.BRAKED, Request.QUICK_STOP])
def test_a_stop_takes_over_from_the_cycle_in_which_it_began_while_the_drives_follow(parameters, request_):
    state, motion = state_at(60, Mode.STOPPING, 7, request_), moving(0.4, SPEEDS)
    stop = state["safety"]["stop"]
    stop["cause"], stop["cycle"], stop["segments"] = Cause.STOP_REQUESTED, 55, moving(0.5, -SPEEDS)
    stop["segments"][:, 1:, 0] = np.inf
    prepare_next(parameters, state, motion)
    expected = 0.5 - SPEEDS * PERIOD_S * 5 if request_ == Request.ENABLED else 0.4 + SPEEDS * PERIOD_S * 43
    np.testing.assert_allclose(state["reference"]["motion"][:, 0], expected, rtol=1e-14)


@pytest.mark.parametrize("missed", [0, 1, 3])
def test_a_reference_that_was_prepared_is_not_used_after_missed_periods(hexapod, parameters, missed):
    """It is the motion's at the time of the cycle, whether that comes when it was due or later."""
    home = leg_lengths(hexapod, hexapod.home.position, hexapod.home.rotation)
    segments, state = moving(home, SPEEDS), np.zeros((), STATE)
    signals = static_signals(hexapod, hexapod.home.position, hexapod.home.rotation)
    for number in range(HOLD + 5):
        # IMUs that repeat their readings while the legs move are frozen.
        signals[0, :, 0] = 1e-9 * (-1.0) ** number
        assert cycle(parameters, state, signals, segments) == Cause.NONE
        prepare_next(parameters, state, segments)
    if missed:
        skip_periods(state, missed)
    number = int(state["time"]["cycle"])
    assert number == HOLD + 5 + missed
    assert cycle(parameters, state, signals, segments) == Cause.NONE
    expected = home + SPEEDS * PERIOD_S * (5 + missed)
    np.testing.assert_allclose(state["reference"]["motion"][:, 0], expected, rtol=1e-14)
    np.testing.assert_allclose(state["pid"]["error"], expected - state["pose"]["lengths"], rtol=0.0, atol=1e-15)
