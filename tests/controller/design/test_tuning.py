"""The design of the gains: its margins against those of a loop that is written down as a transfer function."""

import control
import numpy as np
import pytest

from controller.design.tuning import Linear, frequency_response, margins
from controller.settings import ControlSettings

RATE_HZ = 500.0
PERIOD_S = 1.0 / RATE_HZ
SPEEDS = np.array([1.0, 0.9, 1.1, 1.0, 0.8, 1.2])
"""What each drive makes of its command."""


def integrators():
    """Six drives that integrate the command of the cycle before."""
    zero, speeds, one = np.zeros((6, 6)), np.diag(SPEEDS), np.eye(6)
    return Linear(np.block([[one, PERIOD_S * speeds], [zero, zero]]), np.vstack([zero, one]), np.hstack([one, zero]), zero)


def open_loop(gains, speed):
    """One drive with its controller."""
    z = control.TransferFunction([1.0, 0.0], [1.0], PERIOD_S)
    drive = control.TransferFunction([PERIOD_S * speed], [1.0, -1.0, 0.0], PERIOD_S)
    controller = gains.proportional + gains.integral * PERIOD_S / (z - 1.0) + gains.derivative * RATE_HZ * (z - 1.0) / z
    return control.minreal(drive * controller, verbose=False)


@pytest.mark.parametrize(
    "values", [(60.0, 200.0, 0.0), (20.0, 0.0, 0.0), (60.0, 200.0, 0.4), (60.0, 200.0, 0.05), (40.0, 100.0, 0.1)]
)
def test_the_margins_are_those_of_the_transfer_functions(values):
    gains = ControlSettings(proportional=values[0], integral=values[1], derivative=values[2])
    loop = integrators()
    found = margins(loop, frequency_response(loop, RATE_HZ), gains, RATE_HZ)
    loops = [open_loop(gains, speed) for speed in SPEEDS]
    gain, phase, _, _, crossover, _ = np.transpose([control.stability_margins(each) for each in loops])
    assert found.gain_db == pytest.approx(20.0 * np.log10(gain.min()), abs=0.1)
    assert found.phase_deg == pytest.approx(phase.min(), abs=0.1)
    assert found.crossover_hz == pytest.approx(crossover.max() / (2.0 * np.pi), rel=1e-3)
    points = np.exp(2j * np.pi * np.geomspace(0.05, 0.499, 20_000))
    peak = max(np.abs(1.0 / (1.0 + each(points))).max() for each in loops)
    assert found.sensitivity_peak == pytest.approx(peak, rel=2e-3)
    assert found.stable


@pytest.mark.parametrize("values", [(60.0, 200.0, 0.0), (60.0, 200.0, 0.4), (0.5, 0.0, 0.3)])
def test_a_loop_is_stable_up_to_its_gain_margin(values):
    loop = integrators()
    response = frequency_response(loop, RATE_HZ)

    def scaled(factor):
        gains = ControlSettings(*(factor * value for value in values))
        return margins(loop, response, gains, RATE_HZ)

    most = 10.0 ** (scaled(1.0).gain_db / 20.0)
    assert scaled(0.98 * most).stable
    assert not scaled(1.02 * most).stable
