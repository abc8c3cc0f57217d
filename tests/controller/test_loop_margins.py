"""The quick sensitivity peak, against CasADi's linear plant and the whole linearised loop of `gough tune`."""

from dataclasses import replace

import numpy as np
import pytest

from controller.design.linear_loop import Setup, linear_plant, open_loop
from controller.design.stability import Response, margins
from controller.inverse_kinematics import inverse_kinematics
from controller.loop_margins import margin_remark, sensitivity_peak
from controller.settings import ControlSettings, FusionSettings, control_settings
from plant.mechanism import load_in_space, load_spatial

FUSION = FusionSettings()
PRESETS = ["hexapod", "6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "genhexkins", "planar-3rpr"]
LEG_IMUS = range(6)


def laden(name, factor):
    """A preset with so many times its payload."""
    mechanism = load_spatial(name)
    more = {part: factor * mechanism.plant[part] for part in ("payload.mass", "payload.inertia")}
    return replace(mechanism, plant=mechanism.plant | more)


def times(gains, factor):
    return replace(gains, proportional=factor * gains.proportional, integral=factor * gains.integral)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "load", "rate", "gains"),
    [("hexapod", 1.0, 1000.0, (60.0, 200.0, 0.0)), ("genhexkins", 5.0, 250.0, (90.0, 300.0, 0.05))],
)
def test_with_exact_lengths_it_is_the_peak_of_the_linearised_plant(name, load, rate, gains):
    """Without the platform's IMU the quick model takes the lengths for exact."""
    mechanism, gains = laden(name, load), ControlSettings(*gains)
    plant, _ = linear_plant(mechanism, Setup(rate), mechanism.home)
    jacobian = inverse_kinematics(mechanism, mechanism.home).jacobian
    lengths = np.hstack([jacobian[:, :3], np.zeros((6, 12)), jacobian[:, 3:]])
    peak = 0.0
    for frequency in np.geomspace(0.05, 0.499 * rate, 1000):
        z = np.exp(2j * np.pi * frequency / rate)
        response = lengths @ np.linalg.solve(z * np.eye(len(plant.A)) - plant.A, plant.B)
        pid = gains.proportional + gains.integral / rate / (z - 1.0) + gains.derivative * rate * (1.0 - 1.0 / z)
        peak = max(peak, np.linalg.norm(np.linalg.inv(np.eye(6) + pid * response), 2))
    assert sensitivity_peak(mechanism, gains, FUSION, rate, LEG_IMUS) == pytest.approx(peak, rel=0.02)
    # The estimate of the tilt adds to it.
    assert sensitivity_peak(mechanism, gains, FUSION, rate) > 1.1 * peak


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "load", "rate"),
    [
        ("hexapod", 1.0, 1000.0),
        ("hexapod", 10.0, 1000.0),
        ("6-3-II", 1.0, 1000.0),
        ("hexapod", 1.0, 4000.0),
        ("hexapod", 1.0, 250.0),
    ],
)
def test_it_is_about_the_peak_that_tune_finds(name, load, rate):
    mechanism = laden(name, load)
    response = Response.of(open_loop(mechanism, Setup(rate)))
    for factor in (0.5, 1.0, 1.5):
        gains = times(control_settings(mechanism), factor)
        whole = margins(response, gains).sensitivity_peak
        quick = sensitivity_peak(mechanism, gains, FUSION, rate)
        assert quick == pytest.approx(whole, rel=0.1 if rate >= 1000.0 else 0.3)


@pytest.mark.parametrize("rate", [250.0, 1000.0, 4000.0])
@pytest.mark.parametrize("name", PRESETS)
def test_the_gains_of_every_preset_suit_it(name, rate):
    mechanism = load_in_space(name)
    assert margin_remark(mechanism, control_settings(mechanism), FUSION, rate) == ""


def test_gains_that_do_not_suit_are_told_with_their_peak_and_the_remedy():
    mechanism = load_spatial("hexapod")
    gains = times(control_settings(mechanism), 2.0)
    peak = sensitivity_peak(mechanism, gains, FUSION, 1000.0)
    assert margin_remark(mechanism, gains, FUSION, 1000.0) == (
        f"the gains in [control] do not suit 'hexapod' at 1000 Hz: they have a sensitivity peak of about {peak:.1f}, and tuned "
        "ones at most 2; design them with 'gough tune'"
    )
    assert peak == pytest.approx(4.0, rel=0.1)
    oscillating = times(gains, 20.0)
    assert "1000 Hz: they oscillate; design them with 'gough tune'" in margin_remark(mechanism, oscillating, FUSION, 1000.0)


def test_a_loop_is_unstable_from_the_gain_on_at_which_its_poles_leave_the_unit_circle():
    """Exact lengths, so that the poles are those of CasADi's plant with its controllers."""
    mechanism, rate = load_spatial("hexapod"), 1000.0
    plant, _ = linear_plant(mechanism, Setup(rate), mechanism.home)
    jacobian = inverse_kinematics(mechanism, mechanism.home).jacobian
    lengths = np.hstack([jacobian[:, :3], np.zeros((6, 12)), jacobian[:, 3:]])

    def stable(gains):
        closed = np.block([
            [plant.A - gains.proportional * plant.B @ lengths, gains.integral * plant.B], [-lengths / rate, np.eye(6)]
        ])  # fmt: skip
        return np.abs(np.linalg.eigvals(closed)).max() < 1.0

    preset = control_settings(mechanism)
    factors = np.geomspace(1.0, 50.0, 120)
    poles = [stable(times(preset, factor)) for factor in factors]
    quick = [np.isfinite(sensitivity_peak(mechanism, times(preset, factor), FUSION, rate, LEG_IMUS)) for factor in factors]
    assert poles[0] and not poles[-1]
    assert abs(poles.index(False) - quick.index(False)) <= 2 and not any(quick[quick.index(False) :])


def test_a_heading_changes_the_peak_little_and_two_legs_have_one_with_it():
    mechanism = load_spatial("hexapod")
    gains = control_settings(mechanism)
    usual = sensitivity_peak(mechanism, gains, FUSION, 1000.0)
    assert sensitivity_peak(mechanism, gains, FUSION, 1000.0, magnetometer=True) == pytest.approx(usual, rel=0.1)
    assert 1.0 < sensitivity_peak(mechanism, gains, FUSION, 1000.0, (0, 5, 6), magnetometer=True) < 10.0


def test_a_singular_home_has_no_peak():
    hexapod = load_spatial("hexapod")
    upright = replace(hexapod, platform_joints=hexapod.base_joints)
    assert sensitivity_peak(upright, control_settings(hexapod), FUSION, 1000.0) == 0.0
