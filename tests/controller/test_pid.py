"""The PID controllers: against transfer functions where they are linear, and against wind-up where they are not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from controller.pid import PARAMETERS, STATE, halve_gains, hold_still, pid_parameters, step_pid
from controller.settings import ControlSettings

PERIOD_S = 1e-3
LIMIT = 0.35
GAINS = np.array([60.0, 200.0, 0.0, 100.0])


class Controllers:
    """Six controllers with their state."""

    def __init__(self, gains=GAINS, limit=LIMIT):
        self.parameters, self.state = np.zeros((), PARAMETERS)[()], np.zeros((), STATE)[()]
        self.parameters["gains"], self.parameters["limit"] = gains, limit
        self.integral, self.command = self.state["integral"], self.state["command"]

    def step(self, error, feed_forward=0.0, period=PERIOD_S):
        self.state["error"] = error
        step_pid(self.parameters, self.state, np.array(np.broadcast_to(feed_forward, 6), dtype=float), period)
        return self.command.copy()


def transfer_function(gains):
    """Numerator and denominator in z^-1: P, a forward-Euler I, and a D with a backward-Euler low-pass."""
    proportional, integral, derivative, corner = gains
    share = PERIOD_S * corner / (1.0 + PERIOD_S * corner)
    integrator, low_pass = np.array([1.0, -1.0]), np.array([1.0, share - 1.0])
    numerator = proportional * np.convolve(integrator, low_pass)
    numerator += integral * PERIOD_S * np.convolve([0.0, 1.0], low_pass)
    numerator += derivative * share / PERIOD_S * np.convolve(integrator, integrator)
    return numerator, np.convolve(integrator, low_pass)


@settings(max_examples=50, deadline=None)
@given(
    st.tuples(st.floats(0.1, 200.0), st.floats(0.0, 1000.0), st.floats(0.0, 2.0), st.floats(1.0, 2000.0)),
    st.integers(0, 2**32 - 1),
)
def test_within_the_limit_the_command_is_that_of_the_transfer_function(gains, seed):
    random = np.random.default_rng(seed)
    errors = np.cumsum(random.normal(scale=1e-4, size=(400, 6)), axis=0)
    feeds = random.normal(scale=0.1, size=(400, 6))
    controllers = Controllers(gains, limit=1e9)
    commands = np.array([controllers.step(*pair) for pair in zip(errors, feeds, strict=True)])
    expected = feeds + signal.lfilter(*transfer_function(gains), errors, axis=0)
    np.testing.assert_allclose(commands, expected, rtol=0.0, atol=1e-10 * max(gains))


def test_a_step_on_an_integrating_drive_is_the_closed_loops_own_response():
    """Against SciPy's simulation of the closed loop, C P / (1 + C P) with P = T z^-1 / (1 - z^-1)."""
    numerator, denominator = transfer_function(GAINS)
    open_numerator = PERIOD_S * np.convolve(numerator, [0.0, 1.0])
    closed = np.convolve(denominator, [1.0, -1.0]) + open_numerator
    expected = signal.lfilter(open_numerator, closed, np.full(1500, 1e-3))

    controllers, length, lengths = Controllers(), np.zeros(6), []
    for _ in range(1500):
        lengths.append(length[0])
        length = length + PERIOD_S * controllers.step(1e-3 - length)
    np.testing.assert_allclose(lengths, expected, rtol=0.0, atol=1e-13)
    assert abs(lengths[-1] - 1e-3) < 1e-5


def test_the_integral_takes_out_a_constant_disturbance():
    controllers, length = Controllers(), np.zeros(6)
    disturbances = np.linspace(-0.02, 0.02, 6)
    for _ in range(6000):
        length = length + PERIOD_S * (controllers.step(-length) + disturbances)
    np.testing.assert_allclose(length, 0.0, atol=1e-6)
    np.testing.assert_allclose(controllers.command, -disturbances, atol=1e-6)


def pursue(targets, freeze=True, gains=(8.0, 60.0, 0.0, 100.0), limit=0.1):
    """Lengths and commands of one leg that pursues targets over time; without `freeze` the integral always runs."""
    controllers = Controllers(gains, limit)
    length, integral = 0.0, 0.0
    lengths, commands = [], []
    for target in targets:
        error = target - length
        if freeze:
            command = controllers.step(error)[0]
        else:
            command = np.clip(gains[0] * error + gains[1] * integral, -limit, limit)
            integral += PERIOD_S * error
        lengths.append(length)
        commands.append(command)
        length += PERIOD_S * command
    return np.array(lengths), np.array(commands)


def test_saturated_released_and_saturated_again_the_integral_does_not_wind_up():
    """Steps of 60 mm there, back and there again at 0.1 m/s: each saturates for half a second."""
    targets = np.repeat([0.06, 0.0, 0.06], 2000)
    lengths, commands = pursue(targets)
    for start, target in ((0, 0.06), (2000, 0.0), (4000, 0.06)):
        assert (np.abs(commands[start : start + 400]) == 0.1).all()
        beyond = (lengths - target)[start : start + 2000] * np.sign(target - 0.03)
        # What is left is the linear loop's own overshoot from where it leaves the limit, not the charge of half a second.
        assert beyond.max() < 0.004
        assert abs(lengths[start + 1999] - target) < 1e-4
    wound_up, _ = pursue(targets, freeze=False)
    assert (wound_up[:2000] - 0.06).max() > 0.02


def test_at_the_limit_the_integral_takes_only_errors_that_lead_away_from_it():
    controllers = Controllers([60.0, 200.0, 0.0, 100.0])
    pushed = 1.0
    for _ in range(100):
        assert controllers.step(pushed)[0] == LIMIT
    np.testing.assert_array_equal(controllers.integral, 0.0)
    # The feed-forward holds the command at its limit while the error asks for less: the integral must learn that.
    controllers = Controllers([1.0, 200.0, 0.0, 100.0])
    assert controllers.step(-0.01, feed_forward=1.0)[0] == LIMIT
    np.testing.assert_allclose(controllers.integral, -0.01 * PERIOD_S)
    controllers = Controllers([1.0, 200.0, 0.0, 100.0])
    assert controllers.step(-0.01, feed_forward=-1.0)[0] == -LIMIT
    np.testing.assert_array_equal(controllers.integral, 0.0)


def test_the_derivative_of_a_ramp_settles_at_its_slope_with_the_filters_time_constant():
    corner, slope = 50.0, 0.02
    controllers = Controllers([0.0, 0.0, 1.0, corner])
    commands = np.array([controllers.step(slope * PERIOD_S * (k + 1))[0] for k in range(600)])
    assert abs(commands[-1] - slope) < 1e-12
    at_time_constant = commands[round(1.0 / corner / PERIOD_S) - 1]
    assert abs(at_time_constant / slope - (1.0 - np.exp(-1.0))) < 0.02
    assert (np.diff(commands) >= 0.0).all()


def test_the_derivatives_low_pass_bounds_what_noise_becomes():
    """A corner c lets an error's jump through as c times it, whatever the period; unfiltered it would be 1000 times."""
    corner = 100.0
    controllers = Controllers([0.0, 0.0, 1.0, corner], limit=1e9)
    jump = controllers.step(1.0)[0]
    assert 0.85 * corner < jump < corner


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1.0))
def test_no_command_ever_exceeds_the_limit(seed, limit):
    random = np.random.default_rng(seed)
    controllers = Controllers([100.0, 500.0, 0.5, 300.0], limit)
    reached = 0.0
    for _ in range(200):
        command = controllers.step(random.standard_cauchy(6) * 0.01, random.normal(size=6))
        assert (np.abs(command) <= limit).all()
        reached = max(reached, np.abs(command).max())
    assert reached == limit


@pytest.mark.parametrize("leg", range(6))
def test_each_leg_has_a_controller_of_its_own(leg):
    controllers = Controllers([60.0, 200.0, 0.1, 100.0])
    error = np.zeros(6)
    error[leg] = 1e-4
    for _ in range(5):
        command = controllers.step(error)
    others = np.arange(6) != leg
    assert command[leg] > 0.0
    np.testing.assert_array_equal(command[others], 0.0)


def test_an_error_that_is_not_a_number_is_not_turned_into_a_command():
    controllers = Controllers()
    error = np.zeros(6)
    error[2] = np.nan
    command = controllers.step(error)
    assert np.isnan(command[2])
    np.testing.assert_array_equal(np.isfinite(command), np.arange(6) != 2)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_after_missed_periods_integral_and_derivative_count_the_whole_time(seed):
    """Errors that are straight in time, however unevenly the cycles come: the integral is the sum of error times the time after
    it, and the derivative settles at the slope as backward Euler with these steps does.
    """
    random = np.random.default_rng(seed)
    periods, slopes, corner = PERIOD_S * random.integers(1, 6, 60), random.uniform(-0.01, 0.01, 6), 40.0
    controllers = Controllers([0.0, 0.0, 0.0, corner], limit=1e9)
    integral, derivative, time = np.zeros(6), np.zeros(6), 0.0
    for period in periods:
        time += period
        controllers.step(slopes * time, period=period)
        integral += slopes * time * period
        derivative = slopes + (derivative - slopes) / (1.0 + corner * period)
        np.testing.assert_allclose(controllers.state["derivative"], derivative, rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(controllers.integral, integral, rtol=1e-12)


@pytest.mark.parametrize("end", [1.0, -1.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_at_either_end_of_the_limit_the_integral_takes_what_leads_away_from_it(end, sign):
    controllers = Controllers([1.0, 200.0, 0.0, 100.0])
    assert controllers.step(0.01 * sign, feed_forward=end)[0] == end * LIMIT
    np.testing.assert_allclose(controllers.integral, 0.01 * sign * PERIOD_S if sign != end else 0.0)
    # Within the limit it takes both, also by the last step before.
    controllers = Controllers([0.0, 200.0, 0.0, 100.0])
    controllers.step(0.01 * sign, feed_forward=end * LIMIT)
    np.testing.assert_allclose(controllers.integral, 0.01 * sign * PERIOD_S)


def test_the_gains_and_the_limit_are_those_of_the_settings():
    control = ControlSettings(11.0, 22.0, 0.3, derivative_bandwidth=44.0, command_reserve=1.5)
    parameters = pid_parameters(control, 0.08)
    assert parameters["gains"].tolist() == [11.0, 22.0, 0.3, 44.0]
    assert parameters["limit"] == pytest.approx(0.12, rel=1e-15)


@pytest.mark.parametrize("halvings", [1, 2])
def test_halved_gains_have_the_transfer_function_of_half_the_bandwidth_and_begin_without_a_jump(halvings):
    share = 0.5**halvings
    random = np.random.default_rng(8)
    errors = np.cumsum(random.normal(scale=1e-4, size=(400, 6)), axis=0)
    gains = np.array([60.0, 200.0, 0.5, 100.0])
    halved, lower = Controllers(gains, 1e9), Controllers(gains * [share, share**2, share, 1.0], 1e9)
    halved.state["halvings"] = halvings
    for error in errors:
        np.testing.assert_allclose(halved.step(error), lower.step(error), rtol=1e-12)

    held = Controllers([0.0, 200.0, 0.0, 100.0])
    for error in errors:
        held.step(error)
    before = held.step(0.0)
    for _ in range(halvings):
        halve_gains(held.state)
    np.testing.assert_allclose(held.step(0.0), before, rtol=1e-12)


@pytest.mark.parametrize("legs", [3, 6])
def test_while_it_holds_still_nothing_is_commanded_and_the_integral_stays(legs):
    controllers = Controllers([60.0, 200.0, 0.5, 100.0])
    controllers.step([1e-4, -2e-4, 3e-4, -4e-4, 5e-4, -6e-4])
    integral, before = controllers.integral.copy(), controllers.state["previous_error"].copy()
    assert np.all(controllers.command != 0.0) and np.all(integral != 0.0)
    command = controllers.command.copy()
    controllers.state["error"] = error = np.arange(1.0, 7.0)
    hold_still(controllers.state, legs)
    np.testing.assert_array_equal(controllers.command, np.where(np.arange(6) < legs, 0.0, command))
    np.testing.assert_array_equal(controllers.state["previous_error"], np.where(np.arange(6) < legs, error, before))
    np.testing.assert_array_equal(controllers.integral, integral)
