"""Margins of a linear loop: against loops that are written down as transfer functions, and against python-control."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.design.stability import (
    Response,
    closed_poles,
    controller,
    is_stable,
    loci,
    loop_margins,
    margins,
    sensitivity,
    single_loops,
    step_responses,
)
from controller.pid import PARAMETERS, STATE, pid_parameters, step_pid
from controller.settings import ControlSettings

RATE_HZ = 500.0
PERIOD_S = 1.0 / RATE_HZ
SPEEDS = np.array([1.0, 0.9, 1.1, 1.0, 0.8, 1.2])
"""What each drive makes of its command."""

GAINS = [(60.0, 200.0, 0.0), (20.0, 0.0, 0.0), (60.0, 200.0, 0.4), (60.0, 200.0, 0.05), (40.0, 100.0, 0.1)]


def integrators(coupling=0.0):
    """Six drives that integrate the command of the cycle before; a part of each command goes to the next drive, too."""
    zero, one = np.zeros((6, 6)), np.eye(6)
    speeds = np.diag(SPEEDS) @ (one + coupling * np.roll(one, 1, axis=0))
    a, b = np.block([[one, PERIOD_S * speeds], [zero, zero]]), np.vstack([zero, one])
    return Response.of(control.ss(a, b, np.hstack([one, zero]), zero, PERIOD_S))


def settings(values):
    return ControlSettings(proportional=values[0], integral=values[1], derivative=values[2])


def transfer_functions(gains):
    """The loop of each drive with its controller, the derivative low-passed."""
    z = control.TransferFunction([1.0, 0.0], [1.0], PERIOD_S)
    smoothing = PERIOD_S * gains.derivative_bandwidth / (1.0 + PERIOD_S * gains.derivative_bandwidth)
    slope = gains.derivative * RATE_HZ * smoothing * (z - 1.0) / (z - (1.0 - smoothing))
    pid = gains.proportional + gains.integral * PERIOD_S / (z - 1.0) + slope
    drives = [control.TransferFunction([PERIOD_S * speed], [1.0, -1.0, 0.0], PERIOD_S) for speed in SPEEDS]
    return [control.minreal(drive * pid, verbose=False) for drive in drives]


@pytest.mark.slow
@pytest.mark.parametrize("values", GAINS)
def test_the_margins_are_those_of_the_transfer_functions(values):
    found = margins(integrators(), settings(values))
    loops = transfer_functions(settings(values))
    for leg, each in zip(found.legs, loops, strict=True):
        gain, phase, _, _, crossover, _ = control.stability_margins(each)
        assert leg.gain_db == pytest.approx(20.0 * np.log10(gain), abs=0.1)
        assert leg.phase_deg == pytest.approx(phase, abs=0.1)
        assert leg.crossover_hz == pytest.approx(crossover / (2.0 * np.pi), rel=1e-3)
        assert leg.delay == pytest.approx(np.radians(phase) / crossover, rel=2e-3)
    # Without coupling the loci are these loops.
    assert found.together.gain_db == pytest.approx(found.gain_db, abs=0.01)
    assert found.together.delay == pytest.approx(found.delay, rel=1e-3)
    points = np.exp(2j * np.pi * np.geomspace(1e-4, 0.499, 20_000))
    peak = max(np.abs(1.0 / (1.0 + each(points))).max() for each in loops)
    assert found.sensitivity_peak == pytest.approx(peak, rel=2e-3)
    assert found.complementary_peak == pytest.approx(
        max(np.abs(1.0 - 1.0 / (1.0 + each(points))).max() for each in loops), rel=2e-3
    )
    disk = min(control.disk_margins(each, 2.0 * np.pi * np.geomspace(0.05, 249.0, 2000))[0] for each in loops)
    assert found.disk == pytest.approx(disk, rel=0.01)
    assert found.stable


def test_a_disk_margin_is_told_as_gain_and_phase_as_python_control_has_it():
    (one, *_) = transfer_functions(settings(GAINS[0]))
    disk, gain, phase = control.disk_margins(one, 2.0 * np.pi * np.geomspace(0.05, 249.0, 2000))
    found = margins(integrators(), settings(GAINS[0]))
    same = type(found)(found.legs, found.together, 1.0, 1.0, float(disk), 1.0, 1.0, True)
    assert same.disk_gain_db == pytest.approx(gain)
    assert same.disk_phase_deg == pytest.approx(phase)
    assert type(found)(found.legs, found.together, 1.0, 1.0, 2.5, 1.0, 1.0, True).disk_gain_db == np.inf


@given(
    st.lists(st.floats(0.3, 3.0), min_size=3, max_size=3), st.floats(1.0, 150.0), st.floats(0.1, 3.0), st.floats(0.0, 0.03)
)  # fmt: skip
def test_scalar_margins_are_those_of_python_control(corners, gain, integral_time, delay):
    """Loops of a controller, an integrator, low-passes and a delay."""
    frequencies = np.geomspace(0.05, 249.0, 600)
    s = 2j * np.pi * frequencies
    loop = gain * (1.0 + 1.0 / (integral_time * s)) / s * np.exp(-s * delay)
    for corner in corners:
        loop = loop / (1.0 + s / (2.0 * np.pi * 30.0 * corner))
    (found,) = loop_margins(frequencies, loop[:, None])
    gains, phases, _, at_gain, at_phase, _ = control.stability_margins(
        control.FRD(loop, 2.0 * np.pi * frequencies), returnall=True
    )
    raised = gains[gains > 1.0]
    if len(raised):
        assert found.gain_db == pytest.approx(20.0 * np.log10(raised.min()), abs=0.15)
    assert len(at_phase) > 0 and len(at_gain) >= 0
    assert found.phase_deg == pytest.approx(np.abs((phases + 180.0) % 360.0 - 180.0).min(), abs=0.5)
    assert found.crossover_hz == pytest.approx(at_phase.max() / (2.0 * np.pi), rel=2e-3)


@pytest.mark.parametrize("values", [(60.0, 200.0, 0.0), (60.0, 200.0, 0.4), (0.5, 0.0, 0.3)])
@pytest.mark.parametrize("coupling", [0.0, 0.5, -0.7])
def test_a_loop_is_stable_up_to_its_gain_margin(values, coupling):
    response = integrators(coupling)

    def stable(factor, leg=None):
        each = [settings([factor * v if leg in (None, k) else v for v in values]) for k in range(6)]
        return is_stable(closed_poles(response.loop, each))

    found = margins(response, settings(values))
    most = 10.0 ** (found.together.gain_db / 20.0)
    assert stable(0.98 * most) and not stable(1.02 * most)
    for leg in (0, 3):
        most = 10.0 ** (found.legs[leg].gain_db / 20.0)
        assert stable(0.98 * most, leg) and not stable(1.02 * most, leg)


@pytest.mark.parametrize("coupling", [0.0, 0.5])
def test_a_loop_is_stable_up_to_its_delay_margin(coupling):
    response, gains = integrators(coupling), settings((60.0, 200.0, 0.0))
    most = margins(response, gains).together.delay * RATE_HZ

    def stable(cycles):
        z = control.ss(np.eye(cycles, k=-1), np.eye(cycles, 1), np.eye(1, cycles, cycles - 1), [[0.0]], PERIOD_S)
        return is_stable(closed_poles(response.loop * control.append(*[z] * 6), gains))

    assert stable(int(most)) and not stable(int(most) + 1)


def test_loci_are_the_eigenvalues_along_continuous_lines():
    gain, _ = sensitivity(integrators(0.5), settings(GAINS[0]))
    values = loci(gain)
    assert np.abs(np.log(values[1:] / values[:-1])).max() < 0.1
    np.testing.assert_allclose(values.sum(axis=1), np.trace(gain, axis1=1, axis2=2), rtol=1e-9)
    np.testing.assert_allclose(values.prod(axis=1), np.linalg.det(gain), rtol=1e-9)


def test_a_leg_with_the_others_closed_is_the_loop_that_it_sees():
    """For two drives: by closing the other one by hand."""
    gain, inverse = sensitivity(integrators(0.5), settings(GAINS[0]))
    for k in (0, 4):
        others = [i for i in range(6) if i != k]
        rest = np.linalg.inv(np.eye(5) + gain[:, others][:, :, others])
        seen = gain[:, k, k] - np.einsum("fi,fij,fj->f", gain[:, k, others], rest, gain[:, others, k])
        np.testing.assert_allclose(single_loops(inverse)[:, k], seen, rtol=1e-6)


@pytest.mark.parametrize("values", GAINS)
def test_the_controller_is_the_one_of_the_cycle(values):
    gains = settings(values)
    p, s = pid_parameters(gains, 1e6), np.zeros((), STATE)
    assert p.dtype == PARAMETERS
    system, errors = controller(gains, PERIOD_S), np.random.default_rng(0).standard_normal(60)
    states, expected, found = np.zeros((len(system.A), 1)), [], []
    for error in errors:
        expected.append((system.C @ states + system.D * error).item())
        states = system.A @ states + system.B * error
        s["error"][:] = error
        step_pid(p[()], s[()], np.zeros(6), PERIOD_S)
        found.append(s["command"][0])
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_step_response_begins_at_zero_ends_at_the_reference_and_is_that_of_the_transfer_function():
    gains = settings(GAINS[0])
    times, lengths = step_responses(integrators(), gains, 1.0)
    expected = control.step_response(control.feedback(transfer_functions(gains)[0], 1), times).outputs
    np.testing.assert_allclose(lengths[:, 0], expected, atol=1e-6)
    assert lengths[0, 0] == 0.0 and lengths[-1, 0] == pytest.approx(1.0, abs=0.02)
