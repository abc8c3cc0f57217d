"""A stop and a fault: where they begin, how long they last, and which of several causes counts."""

import numpy as np
import pytest

from controller.cycle import prepare_next, react, skip_periods
from controller.planning.plan_handover import rest
from controller.safety.causes import Cause, Mode, Request
from controller.safety.stop import STOP_SETTLING_S, describe_end, has_stopped, stop_parameters
from plant.mechanism import Limits
from tests.controller.cycles import cycle
from tests.controller.safety.moving import CYCLE, PERIOD_S, moving, stop_of, told

SETTLING = 40
"""0.1 s at 400 Hz."""

COMMANDS = np.array([0.1, -0.2, 0.3, -0.34, 0.0, 0.05])


def ask(parameters, state, cause, value=np.nan, limit=np.nan):
    react(parameters, state, cause, -1, value, limit)


def stopped(state):
    return has_stopped(state["safety"][()], state["time"][()])


def stopping_time(speed, limits):
    """From a speed without acceleration."""
    speed, a, j = abs(speed), limits.acceleration, limits.jerk
    return 2.0 * np.sqrt(speed / j) if speed <= a * a / j else speed / a + a / j


def test_the_limits_of_a_stop_are_those_of_the_actuators_and_it_settles_for_whole_cycles():
    stroke = np.tile([0.3, 0.4], (6, 1))
    p = stop_parameters(Limits(stroke, velocity=0.2, acceleration=2.0, jerk=50.0), 333.0)
    assert (p["velocity_limit"], p["acceleration_limit"], p["jerk_limit"]) == (0.2, 2.0, 50.0)
    assert p["settling_cycles"] == 34 and STOP_SETTLING_S == 0.1


@pytest.mark.parametrize("preset", ["hexapod", "planar-3rpr"])
@pytest.mark.parametrize("missed", [1, 4])
def test_after_missed_periods_a_stop_begins_where_the_last_commands_have_led(preset, missed):
    mechanism, parameters, state = moving(preset)
    limits, legs = mechanism.limits, mechanism.legs
    motion = np.random.default_rng(0).normal([0.4, 0.1, 0.5], 0.05, (6, 3))
    motion[legs:] = 0.0
    state["reference"]["motion"], state["pid"]["command"] = motion, COMMANDS
    state["reference"]["index"], state["reference"]["due_cycle"] = 3, CYCLE
    state["time"]["missed"] = state["time"]["behind"] = missed
    ask(parameters, state, Cause.STOP_REQUESTED)
    assert (state["safety"]["mode"], state["safety"]["request"]) == (Mode.STOPPING, Request.ENABLED)
    stop, segments = state["safety"]["stop"], state["safety"]["stop"]["segments"]
    speeds = np.clip(COMMANDS, -limits.velocity, limits.velocity)[:legs]
    starts = motion[:legs, 0] + missed * PERIOD_S * speeds
    times = np.array([stopping_time(speed, limits) for speed in speeds])
    np.testing.assert_allclose(segments[:legs, 0, :4], np.stack([0.0 * times, starts, speeds, 0.0 * times], axis=1), atol=1e-15)
    # The way to rest is that at half the speed, by symmetry.
    np.testing.assert_allclose(segments[:legs, 3, 0], times, atol=1e-12)
    np.testing.assert_allclose(segments[:legs, 3, 1], starts + speeds * times / 2.0, atol=1e-12)
    assert not segments[:, 3, 2:].any() and not segments[legs:, :, 1].any()
    assert stop["cycle"] == CYCLE
    assert stop["end_cycle"] == CYCLE + np.ceil(times.max() / PERIOD_S) + SETTLING
    # The reference is found anew.
    assert not state["reference"]["index"].any() and state["reference"]["due_cycle"] == 0


def test_without_missed_periods_a_stop_goes_on_from_the_reference():
    _, parameters, state = moving()
    motion = np.random.default_rng(1).normal([0.4, 0.1, 0.5], 0.05, (6, 3))
    state["reference"]["motion"], state["pid"]["command"] = motion, COMMANDS
    ask(parameters, state, Cause.END_OF_MOTION)
    np.testing.assert_array_equal(state["safety"]["stop"]["segments"][:, 0, 1:4], motion)
    # And a cycle later, it has gone one period along.
    state["time"]["cycle"] += 1
    prepare_next(parameters, state, np.zeros((6, 1, 5)))
    gone = motion[:, 0] + PERIOD_S * motion[:, 1] + PERIOD_S**2 / 2.0 * motion[:, 2]
    np.testing.assert_allclose(state["reference"]["motion"][:, 0], gone, rtol=0.0, atol=60.0 * PERIOD_S**3)


def test_when_the_reference_is_of_the_present_a_stop_goes_on_from_it_although_periods_were_missed():
    _, parameters, state = moving()
    state["pid"]["command"] = COMMANDS
    skip_periods(state, 3)
    # As every cycle does, unless a stop has begun before.
    prepare_next(parameters, state, rest(np.full(6, 0.4)))
    motion = state["reference"]["motion"].copy()
    ask(parameters, state, Cause.FOLLOWING_ERROR)
    np.testing.assert_array_equal(state["safety"]["stop"]["segments"][:, 0, 1:4], motion)


@pytest.mark.parametrize("mode", [Mode.IDLE, Mode.ARMED])
def test_before_the_motion_a_stop_is_the_brakes_at_once(mode):
    _, parameters, state = moving(mode=mode, request=Request.ENABLED if mode == Mode.ARMED else Request.BRAKED)
    state["time"]["missed"] = state["time"]["behind"] = 3
    state["pid"]["command"] = COMMANDS
    ask(parameters, state, Cause.STOP_REQUESTED)
    assert (state["safety"]["mode"], state["safety"]["request"]) == (Mode.STOPPING, Request.BRAKED)
    assert not state["reference"]["motion"].any()
    assert state["safety"]["stop"]["end_cycle"] == CYCLE
    assert stopped(state) and state["safety"]["mode"] == Mode.STOPPED


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("leg", [0, 5])
def test_a_quick_stop_lasts_as_the_fastest_command_needs(sign, leg):
    _, parameters, state = moving()
    commands = np.full(6, 0.02)
    commands[leg], commands[3] = 0.31 * sign, np.nan
    state["pid"]["command"] = commands
    ask(parameters, state, Cause.EMERGENCY_STOP)
    assert (state["safety"]["mode"], state["safety"]["request"]) == (Mode.FAULT, Request.QUICK_STOP)
    np.testing.assert_array_equal(state["pid"]["command"], np.nan_to_num(commands))
    # 0.31 m/s at 3 m/s^2 are 41.3 cycles of 2.5 ms.
    end = CYCLE + 42 + SETTLING
    assert state["safety"]["stop"]["end_cycle"] == end
    for now, over in ((CYCLE, False), (end - 1, False), (end, True)):
        state["time"]["cycle"] = now
        assert stopped(state) == over
        assert state["safety"]["request"] == (Request.BRAKED if over else Request.QUICK_STOP)
    assert state["safety"]["mode"] == Mode.FAULT


def test_brakes_at_once_take_the_commands_away_and_settle():
    _, parameters, state = moving()
    state["pid"]["command"] = COMMANDS
    ask(parameters, state, Cause.DRIVE_DEVIATES)
    assert (state["safety"]["mode"], state["safety"]["request"]) == (Mode.FAULT, Request.BRAKED)
    assert not state["pid"]["command"].any()
    assert state["safety"]["stop"]["end_cycle"] == CYCLE + SETTLING


def test_a_fault_on_the_brakes_is_over_at_once():
    _, parameters, state = moving(mode=Mode.IDLE, request=Request.BRAKED)
    ask(parameters, state, Cause.EMERGENCY_STOP)
    assert (state["safety"]["mode"], state["safety"]["request"]) == (Mode.FAULT, Request.BRAKED)
    assert state["safety"]["stop"]["end_cycle"] == CYCLE and stopped(state)


def test_the_first_stop_counts_and_a_fault_overrides_it_once():
    _, parameters, state = moving()
    state["pid"]["command"] = COMMANDS
    ask(parameters, state, Cause.ANSWER_LATE)
    assert state["safety"]["mode"] == Mode.RUNNING and stop_of(state)[0] == Cause.NONE
    ask(parameters, state, Cause.MISSED_PERIODS, 12.0, 10.0)
    state["time"]["cycle"] += 5
    ask(parameters, state, Cause.STOP_REQUESTED, 1.0, 2.0)
    assert stop_of(state) == (Cause.MISSED_PERIODS, -1, 12.0, 10.0)
    assert state["safety"]["stop"]["cycle"] == CYCLE
    assert describe_end(state) == "too many periods missed in a row (12 periods, the limit is 10 periods)"
    ask(parameters, state, Cause.BUS_LOST, 21.0, 20.0)
    state["time"]["cycle"] += 5
    ask(parameters, state, Cause.RIG_FAILED, 3.0)
    ask(parameters, state, Cause.STOP_REQUESTED)
    assert stop_of(state) == (Cause.BUS_LOST, -1, 21.0, 20.0)
    assert state["safety"]["stop"]["cycle"] == CYCLE + 5
    assert told(state) == [Cause.ANSWER_LATE, Cause.MISSED_PERIODS, Cause.BUS_LOST]
    first, second = "too many periods missed in a row", "the bus is lost: the rig does not answer"
    assert describe_end(state) == f"{first}, and then: {second} (21 cycles, the limit is 20 cycles)"


@pytest.mark.parametrize("missed", [0, 2])
def test_after_a_fault_commands_come_to_rest_by_the_periods_that_passed(missed):
    _, parameters, state = moving()
    state["pid"]["command"] = COMMANDS
    ask(parameters, state, Cause.EMERGENCY_STOP)
    left = COMMANDS.copy()
    for n in range(1, 50):
        skip_periods(state, missed)
        assert cycle(parameters, state, np.zeros((3, 7, 3)), np.zeros((6, 1, 5))) == Cause.NONE
        left = np.sign(left) * np.maximum(np.abs(left) - 3.0 * PERIOD_S * (1 + missed), 0.0)
        np.testing.assert_allclose(state["pid"]["command"], left, rtol=0.0, atol=1e-14)
        assert state["time"]["cycle"] == CYCLE + n * (1 + missed)
    assert not state["pid"]["command"].any()
