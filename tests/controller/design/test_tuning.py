"""The design of the gains: its margins against those of a loop that is written down as a transfer function."""

import json
from dataclasses import asdict, replace

import control
import numpy as np
import pytest

from controller.design import tuning
from controller.design.tuning import Design, Linear, Margins, frequency_response, linear_plant, margins, tune
from controller.inverse_kinematics import inverse_kinematics
from controller.settings import ControlSettings
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism import Mechanism
from tests.controller.leg_geometry import static_signals

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


def margins_of(**changes):
    usual = {"gain_db": 12.0, "phase_deg": 65.0, "crossover_hz": 3.0, "sensitivity_peak": 2.0, "stable": True}
    return Margins(**(usual | changes))


@pytest.mark.parametrize(
    ("changes", "sound"),
    [
        ({}, True), ({"gain_db": 11.99}, False), ({"phase_deg": 64.99}, False), ({"sensitivity_peak": 2.01}, False),
        ({"stable": False}, False), ({"gain_db": np.inf, "phase_deg": 90.0, "sensitivity_peak": 1.0}, True),
    ],
)  # fmt: skip
def test_the_rule_asks_for_every_margin(changes, sound):
    assert margins_of(**changes).sound is sound


def test_the_figures_of_a_design_are_told_by_name_with_their_units():
    gains, preset = ControlSettings(41.26, 137.5, 0.25), ControlSettings(20.0, 66.7)
    first, second = margins_of(gain_db=13.57, phase_deg=70.24, crossover_hz=4.321), margins_of(gain_db=np.inf, stable=False)
    design = Design(RATE_HZ, gains, first, preset, second)
    assert design.rows() == [
        ("designed: proportional", "41.3", "1/s"),
        ("designed: integral", "137.5", "1/s2"),
        ("designed: derivative", "0.25", "-"),
        ("designed: gain margin", "13.6", "dB"),
        ("designed: phase margin", "70.2", "deg"),
        ("designed: crossover", "4.32", "Hz"),
        ("designed: sensitivity peak, all loops", "2.00", "-"),
        ("preset: proportional", "20.0", "1/s"),
        ("preset: integral", "66.7", "1/s2"),
        ("preset: derivative", "0", "-"),
        ("preset: gain margin", "inf", "dB"),
        ("preset: phase margin", "65.0", "deg"),
        ("preset: crossover", "3.00", "Hz"),
        ("preset: sensitivity peak, all loops", "2.00", "-"),
    ]
    summary = json.loads(json.dumps(design.summary(), allow_nan=False))
    assert summary["rate"] == RATE_HZ
    assert (summary["gains"]["proportional"], summary["preset"]["proportional"]) == (41.26, 20.0)
    assert (summary["margins"]["gain_db"], summary["preset_margins"]["gain_db"]) == (13.57, None)
    assert (summary["margins"]["stable"], summary["preset_margins"]["stable"]) == (True, False)


def within(monkeypatch, least, most):
    """Let the rule hold for proportional gains from `least` to `most` alone."""

    def told(loop, response, gains, rate):
        assert rate == RATE_HZ
        return margins_of(stable=least <= gains.proportional <= most, crossover_hz=gains.proportional + gains.integral)

    monkeypatch.setattr(tuning, "open_loop", lambda mechanism, rate: integrators())
    monkeypatch.setattr(tuning, "margins", told)


@pytest.mark.parametrize("most", [37.43, 5.57, 249.0])
def test_the_design_is_the_largest_gain_that_the_rule_allows(hexapod, monkeypatch, most):
    within(monkeypatch, 0.7 * most, most)
    preset = ControlSettings(proportional=33.0, integral=50.0, derivative=0.2, hold=0.4)
    mechanism = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints, settings={"control": asdict(preset)})
    design = tune(mechanism, RATE_HZ)
    found = design.gains
    assert design.rate == RATE_HZ
    # Rounded down, as the rule does not hold above.
    assert 0.0 <= most - found.proportional < 0.002 * most + 0.1
    assert found.proportional == pytest.approx(round(found.proportional, 1), abs=1e-12)
    # The integral time is 0.3 s, there is no derivative, and all else is the preset's.
    expected = replace(preset, proportional=found.proportional, integral=found.integral, derivative=0.0)
    assert asdict(found) == pytest.approx(asdict(expected), rel=1e-12)
    assert 0.0 <= found.proportional / 0.3 - found.integral < 0.1
    assert found.integral == pytest.approx(round(found.integral, 1), abs=1e-12)
    assert design.preset == preset
    assert design.margins.crossover_hz == pytest.approx(found.proportional + found.integral, rel=1e-12)
    assert design.preset_margins.crossover_hz == 83.0


def test_a_loop_without_such_gains_is_refused_with_the_rate(hexapod, monkeypatch):
    within(monkeypatch, 1.0, 0.0)
    with pytest.raises(SingularConfigurationError, match="no gains have these margins at 500 Hz: raise the rate"):
        tune(hexapod, RATE_HZ)
    with pytest.raises(InputError, match="rate"):
        tune(hexapod, 0.0)


def test_the_open_loop_integrates_the_commands_into_the_estimated_lengths(hexapod):
    """A small step of one command after the other: when the filters have settled, each estimated leg moves at that speed."""
    loop = tuning.open_loop(hexapod, RATE_HZ)
    states, lengths = np.zeros((len(loop.a), 6)), []
    for _ in range(round(1.0 * RATE_HZ)):
        lengths.append(loop.c @ states)
        states = loop.a @ states + loop.b
    speeds = (lengths[-1] - lengths[-round(0.4 * RATE_HZ)]) / (0.4 - PERIOD_S)
    np.testing.assert_allclose(speeds, np.eye(6), rtol=0.0, atol=0.05)


def test_the_linear_plants_imus_read_gravity_at_home_and_the_turning_of_the_legs(hexapod):
    plant, at_rest = linear_plant(hexapod, RATE_HZ)
    rates, forces = at_rest.reshape(2, 7, 3)
    np.testing.assert_allclose(rates, 0.0, atol=1e-12)
    np.testing.assert_allclose(forces, static_signals(hexapod, hexapod.home.position, hexapod.home.rotation)[1], atol=1e-6)
    # After half a second at even speed the platform's gyroscope reads the turn that the inverse Jacobian tells.
    states = np.zeros((len(plant.a), 6))
    for _ in range(round(0.5 * RATE_HZ)):
        states = plant.a @ states + plant.b
    turning = (plant.c @ states).reshape(2, 7, 3, 6)[0, 6]
    expected = np.linalg.inv(inverse_kinematics(hexapod, hexapod.home).jacobian)[3:]
    np.testing.assert_allclose(turning, hexapod.home.rotation.T @ expected, rtol=0.0, atol=0.05 * np.abs(expected).max())
