"""Position loops of drives against their closed form, and targets that are integrated for them."""

import numpy as np
import pytest

from hil.rigs import BRAKED, ENABLED, QUICK_STOP
from hil.rigs.position_loops import (
    BANDWIDTH,
    ENCODER_LOST,
    FOLLOWING_ERROR,
    FOLLOWING_WINDOW,
    POSITION_LOOPS,
    are_closed,
    close_loops,
    follow_goal,
    hold_goal,
    loop_fault,
    take_motors,
    take_readings,
)
from hil.rigs.position_targets import PositionTargets

STEP_S = 1e-4


@pytest.fixture
def loops():
    """Position loops of six drives at rest at zero."""
    made = np.zeros((), POSITION_LOOPS)
    close_loops(made, True)
    assert are_closed(made[()]) and not are_closed(np.zeros((), POSITION_LOOPS)[()])
    return made


def followed(loops, rates, load=0.0):
    """Places of drive 3, whose motor moves by `load` [m/s] slower than it is told, at rates of its goal [m/s]."""
    inner, motors, places = loops[()], np.zeros(6), []
    for rate in rates:
        take_motors(inner, motors)
        motors[3] += (follow_goal(inner, 3, rate, STEP_S, np.inf, STEP_S) - load) * STEP_S
        places.append(motors[3])
    return np.array(places)


def test_an_error_decays_as_the_closed_form_says(loops):
    loops["goal"][3] = 1e-3
    times = np.arange(1, 2001) * STEP_S
    half = 0.5 * BANDWIDTH * times
    np.testing.assert_allclose(1e-3 - followed(loops, np.zeros(2000)), 1e-3 * (1.0 - half) * np.exp(-half), atol=5e-6)


def test_a_load_moves_a_drive_off_its_goal_for_a_while_only(loops):
    """A droop v of a velocity is off by `v t exp(-w t / 2)`, at most `2 v / (e w)`."""
    off = np.cumsum(np.full(5000, 0.05)) * STEP_S - followed(loops, np.full(5000, 0.05), load=4e-3)
    times = np.arange(1, 5001) * STEP_S
    np.testing.assert_allclose(off, 4e-3 * times * np.exp(-0.5 * BANDWIDTH * times), atol=1e-6)


def test_a_velocity_that_is_limited_winds_nothing_up(loops):
    inner = loops[()]
    inner["goal"][3] = 1.0
    assert follow_goal(inner, 3, 0.1, STEP_S, 0.3, STEP_S) == 0.3 and inner["integral"][3] == 0.0
    assert inner["goal"][3] == pytest.approx(1.0 + 0.1 * STEP_S)


def test_a_goal_is_held_where_the_drive_is(loops):
    inner = loops[()]
    followed(loops, np.full(200, 0.1), load=0.05)
    take_motors(inner, np.full(6, 0.7))
    hold_goal(inner, 3)
    assert (inner["goal"][3], inner["integral"][3], inner["beyond_for"][3]) == (0.7, 0.0, 0.0)


def test_between_samples_an_encoder_keeps_its_error(loops):
    inner, readings = loops[()], np.array([1.0, np.nan, 1.0, 1.0, 1.0, 1.0])
    take_readings(inner, np.full(6, 0.9), readings)
    take_motors(inner, np.full(6, 0.95))
    np.testing.assert_allclose(inner["place"], [1.05, 0.95, 1.05, 1.05, 1.05, 1.05], rtol=1e-14)
    for _ in range(10):
        assert loop_fault(inner, 1) == 0
        take_readings(inner, np.full(6, 0.9), readings)
    assert [loop_fault(inner, k) for k in range(6)] == [0, ENCODER_LOST, 0, 0, 0, 0]
    take_readings(inner, np.full(6, 0.9), np.ones(6))
    assert loop_fault(inner, 1) == 0


@pytest.mark.parametrize(("error", "fault"), [(0.99 * FOLLOWING_WINDOW, 0), (-1.01 * FOLLOWING_WINDOW, FOLLOWING_ERROR)])
def test_a_following_error_is_a_fault_after_a_while(loops, error, fault):
    inner = loops[()]
    inner["goal"][0] = error
    for _ in range(9):
        follow_goal(inner, 0, 0.0, 1e-3, 0.0, 1e-3)
    assert loop_fault(inner, 0) == 0
    for _ in range(2):
        follow_goal(inner, 0, 0.0, 1e-3, 0.0, 1e-3)
    assert loop_fault(inner, 0) == fault


# ----------------------------------------------------------------------------------------------------------------- the targets


def test_a_target_is_the_integral_of_the_commands_from_where_the_drive_was():
    random, targets = np.random.default_rng(5), PositionTargets(0.002, 0.3)
    assert np.isnan(targets.targets).all()
    start = random.normal(0.0, 1.0, 6)
    targets.advance(np.zeros(6), BRAKED, [False] * 6, start)
    commands = random.normal(0.0, 0.3, (500, 6))
    for command in commands:
        # What the encoders read later makes no difference.
        targets.advance(command, ENABLED, [True] * 6, random.normal(0.0, 1.0, 6))
    np.testing.assert_allclose(targets.targets, start + 0.002 * np.clip(commands, -0.3, 0.3).sum(axis=0), rtol=1e-12)


@pytest.mark.parametrize("request_", [BRAKED, QUICK_STOP, ENABLED])
def test_the_target_of_a_drive_that_does_not_follow_is_where_it_is(request_):
    targets, following = PositionTargets(0.002, 0.3), [True, False] * 3
    targets.advance(np.zeros(6), BRAKED, following, np.ones(6))
    found = targets.advance(np.full(6, 0.1), request_, following, np.array([2.0, 2.0, 2.0, np.nan, 2.0, 2.0]))
    on = 1.0002 if request_ == ENABLED else 2.0
    np.testing.assert_allclose(found, [on, 2.0, on, 1.0, on, 2.0], rtol=1e-14)


def test_no_command_moves_no_target():
    targets = PositionTargets(0.002, 0.3)
    targets.advance(np.zeros(6), BRAKED, [True] * 6, np.ones(6))
    np.testing.assert_array_equal(targets.advance(np.full(6, np.nan), ENABLED, [True] * 6, np.zeros(6)), 1.0)
