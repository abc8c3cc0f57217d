"""The design of the gains: the rule, what is found by it, what is told, and what is written."""

import json
import re
import tomllib
from dataclasses import asdict, replace

import control
import numpy as np
import pytest

from controller.design import tuning
from controller.design.linear_loop import Setup, open_loop
from controller.design.stability import LoopMargins, Margins, Response, closed_poles, is_stable, margins
from controller.design.tuning import (
    Design,
    PoseMargins,
    Rule,
    lowest_stable_rate,
    shortest_hold,
    tune,
    tuned_text,
    workspace_poses,
)
from controller.settings import ControlSettings, control_settings
from controller.workspace import margins as margins_of_poses
from plant.errors import InputError, SingularConfigurationError, UnknownNameError
from plant.mechanism import load_in_space
from plant.mechanism.documents import mechanism_from_text, mechanism_text
from plant.pose import Pose, rotation_from_vector

SETUP = Setup(500.0)


def leg(**changes):
    return LoopMargins(**({"gain_db": 12.0, "phase_deg": 65.0, "delay": 0.02, "crossover_hz": 3.0} | changes))


def found(peak=2.0, stable=True, **changes):
    each = leg(**changes)
    return Margins((each, leg(gain_db=40.0, phase_deg=80.0, crossover_hz=1.0)), each, peak, 1.2, 0.6, 0.5, 7.0, stable)


@pytest.mark.parametrize(
    ("peak", "changes", "told"),
    [
        (2.0, {}, ""), (2.01, {}, "a sensitivity peak of 2.01 at home, and 2 is allowed there"),
        (1.0, {"phase_deg": 64.9}, "a phase margin of 64.9 deg at home, and 65 deg are needed there"),
        (1.0, {"gain_db": 11.9}, "a gain margin of 11.9 dB at home, and 12 dB are needed there"),
        (1.0, {"gain_db": np.inf, "phase_deg": np.inf}, ""),
    ],
)  # fmt: skip
def test_the_rule_asks_for_every_margin(peak, changes, told):
    assert Rule().broken_by(peak, [leg(), leg(**changes)]) == told


def test_elsewhere_half_of_the_margins_will_do():
    assert Rule().broken_by(3.0, [leg(phase_deg=32.5, gain_db=6.0)], at_home=False) == ""
    for peak, changes in ((3.01, {}), (1.0, {"phase_deg": 32.4}), (1.0, {"gain_db": 5.9})):
        assert "in the workspace" in Rule().broken_by(peak, [leg(**changes)], at_home=False)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"crossover_hz": 0.0}, "the crossover is 0 Hz; it must be 0.05 to 500 Hz"),
        ({"crossover_hz": np.nan}, "the crossover is nan Hz"),
        ({"sensitivity": 1.0}, "the sensitivity is 1; it must be 1.05 to 10"),
        ({"phase_deg": 91.0}, "the phase margin is 91 deg; it must be 1 to 90 deg"),
        ({"gain_db": 0.0}, "the gain margin is 0 dB; it must be 0.5 to 60 dB"),
    ],
)
def test_a_rule_that_cannot_be_is_refused(values, text):
    with pytest.raises(InputError, match=re.escape(text)):
        Rule(**values)


@pytest.fixture(scope="module")
def design():
    return tune(load_in_space("planar-3rpr"), SETUP, poses=3)


def keeps(design, factor):
    gains = replace(
        design.gains, proportional=factor * design.gains.proportional, integral=factor * design.gains.integral
    )  # fmt: skip
    told = [
        design.rule.broken_by(each.sensitivity_peak, each.legs, at_home=number == 0) or (not each.stable and "unstable")
        for number, each in enumerate(margins(response, gains) for response in design.responses)
    ]
    return not any(told)


def test_the_design_is_the_largest_gain_that_the_rule_allows(design):
    assert keeps(design, 1.0)
    assert not keeps(design, 1.02)
    preset = control_settings(design.mechanism)
    assert design.preset == preset
    # Rounded down, with the shortest integral time that will do, no derivative, and all else as it was.
    gains = design.gains
    assert gains.proportional == pytest.approx(round(gains.proportional, 1), abs=1e-12)
    (time,) = (time for time in tuning.INTEGRAL_TIMES_S if 0.0 <= gains.proportional / time - gains.integral < 0.1 + 1e-9)
    assert time > tuning.INTEGRAL_TIMES_S[0]
    expected = replace(preset, proportional=gains.proportional, integral=gains.integral, derivative=0.0)
    assert gains == expected


def test_the_margins_are_those_of_the_loop_at_each_pose(design):
    assert len(design.workspace) == 3
    for each in (PoseMargins(design.home, design.margins), design.workspace[1]):
        again = margins(Response.of(open_loop(design.mechanism, SETUP, each.pose)), design.gains)
        assert again.sensitivity_peak == pytest.approx(each.margins.sensitivity_peak)
        assert again.stable and each.margins.stable
    peaks = [each.margins.sensitivity_peak for each in design.workspace]
    assert design.worst("sensitivity peak, all loops").margins.sensitivity_peak == max(peaks)
    assert design.worst("gain margin").margins.gain_db == min(each.margins.gain_db for each in design.workspace)


def test_everything_is_told_in_json(design):
    summary = json.loads(json.dumps(design.summary(), allow_nan=False))
    assert summary["rate"] == 500.0 and summary["delay"] == 0.0 and summary["lowest_rate"] == design.lowest_rate
    assert summary["gains"]["proportional"] == design.gains.proportional
    assert summary["margins"]["gain_db"] == pytest.approx(design.margins.gain_db)
    assert summary["preset_margins"]["crossover_hz"] == pytest.approx(design.preset_margins.crossover_hz)
    assert len(summary["margins"]["legs"]) == 3 and summary["margins"]["together"]["delay"] > 0.0
    worst = summary["worst"]["phase margin"]
    assert summary["workspace"][worst["pose"]]["phase_deg"] == pytest.approx(worst["value"])


def test_the_written_file_is_the_mechanism_with_its_gains(design):
    text = tuned_text("planar-3rpr", design)
    document, before = tomllib.loads(text), tomllib.loads(mechanism_text("planar-3rpr"))
    written = document.pop("control")
    assert document == {name: table for name, table in before.items() if name != "control"}
    names = "proportional", "integral", "derivative"
    assert written == {name: getattr(design.gains, name) for name in names}
    lines = [line for line in text.splitlines() if line.startswith(("proportional", "integral"))]
    assert "500 Hz, delay 0 ms" in lines[0] and f"crossover {design.margins.crossover_hz:.2f} Hz" in lines[0]
    assert "at worst of 3 poses gain margin" in lines[1]
    # It is read again, and a second design takes the place of the first one.
    again = mechanism_from_text(text, "tuned")
    assert control_settings(again) == design.gains
    assert "hold = 1.24" in tuned_text("planar-3rpr", replace(design, hold=1.2301))
    position = replace(design, setup=Setup(500.0, bandwidth=60.0))
    written = tomllib.loads(tuned_text("planar-3rpr", position))["control"]
    assert written == {f"position_{name}": getattr(design.gains, name) for name in names[:2]}
    with pytest.raises(UnknownNameError):
        tuned_text("none", design)


def test_a_second_design_takes_the_place_of_the_first_in_a_file(design, tmp_path):
    path = tmp_path / "tuned.toml"
    path.write_text(tuned_text("planar-3rpr", design))
    assert tuned_text(str(path), design) == path.read_text()


def test_a_crossover_that_is_asked_for_is_met_at_home(design):
    wanted = 0.9 * design.margins.crossover_hz
    slower = tuning._designed(design.responses, design.preset, Rule(wanted, phase_deg=50.0))
    assert margins(design.responses[0], slower).crossover_hz == pytest.approx(wanted, rel=0.02)
    with pytest.raises(SingularConfigurationError, match=r"a crossover of 20 Hz leaves .* (at home|in the workspace)"):
        tuning._designed(design.responses, design.preset, Rule(crossover_hz=20.0))
    faster = tuning._designed(
        design.responses, design.preset, Rule(1.5 * design.margins.crossover_hz, sensitivity=6.0, phase_deg=20.0, gain_db=3.0)
    )
    assert faster.proportional > design.gains.proportional


def test_without_gains_that_keep_the_rule_it_says_what_helps(design):
    with pytest.raises(SingularConfigurationError, match="no gains have these margins at 500 Hz: raise the rate"):
        tuning._designed(design.responses, design.preset, Rule(sensitivity=1.05, phase_deg=90.0))
    with pytest.raises(InputError, match="-1 poses"):
        tune(design.mechanism, SETUP, poses=-1)


def test_poses_of_the_workspace_exceed_no_limit(hexapod):
    poses = workspace_poses(hexapod, 20, seed=5)
    at = np.array([each.position for each in poses]), np.array([each.rotation for each in poses])
    assert margins_of_poses(hexapod, *at).reachable.all()
    assert workspace_poses(hexapod, 0, seed=5) == []
    same = workspace_poses(hexapod, 20, seed=5)
    np.testing.assert_array_equal([each.position for each in same], at[0])


def first_order(rate):
    """Three drives whose estimates are late by 12 ms of filter, and by a period."""
    period, one, zero = 1.0 / rate, np.eye(3), np.zeros((3, 3))
    filtered = control.sample_system(control.tf([1.0], [0.012, 1.0, 0.0]), period, method="zoh")
    return control.append(*[control.ss(filtered)] * 3) * control.ss(zero, one, one, zero, period)


def test_the_lowest_rate_is_where_the_poles_leave_the_unit_circle(monkeypatch):
    gains = ControlSettings(proportional=80.0, integral=100.0)
    monkeypatch.setattr(tuning, "open_loop", lambda mechanism, setup, pose: first_order(setup.rate))
    shares = []
    lowest = lowest_stable_rate(None, Setup(1000.0), gains, [None], shares.append)
    assert shares == sorted(shares) and 0.99 < shares[-1] <= 1.0 and len(set(shares)) > 8
    assert 50.0 < lowest < 500.0
    assert is_stable(closed_poles(first_order(lowest), gains))
    assert not is_stable(closed_poles(first_order(0.98 * lowest), gains))
    assert lowest_stable_rate(None, Setup(1000.0), replace(gains, proportional=10.0, integral=0.0), [None]) == 50.0


def test_the_hold_is_the_shortest_after_which_the_loop_is_stable_at_all_poses(monkeypatch):
    """The later a pose is stable, the longer the brakes hold; poses that are stable are not asked again."""
    asked = []

    def opened(mechanism, setup, pose, settled):
        asked.append((pose, settled))
        return first_order(1000.0 if settled >= pose else 60.0)

    gains = ControlSettings(proportional=80.0, integral=100.0, hold=0.2)
    assert not is_stable(closed_poles(first_order(60.0), gains))
    monkeypatch.setattr(tuning, "open_loop", opened)
    shares = []
    hold = shortest_hold(None, Setup(1000.0), gains, [0.0, 0.5, 0.3], shares.append)
    assert shares == sorted(shares) and shares[0] == pytest.approx(1.0 / 3.0) and shares[-1] == 1.0
    assert 0.5 <= hold < 0.5 * 1.25
    assert [pose for pose, _ in asked].count(0.0) == 1
    assert shortest_hold(None, Setup(1000.0), gains, [0.0]) == 0.2
    with pytest.raises(SingularConfigurationError, match="unstable 10 s after its start"):
        shortest_hold(None, Setup(1000.0), gains, [20.0])


def test_the_figures_of_a_design_are_told_by_name_with_their_units(hexapod):
    gains, preset = ControlSettings(41.26, 137.5, 0.25), ControlSettings(20.0, 66.7)
    at_home, other = found(gain_db=13.57, phase_deg=70.24, crossover_hz=4.321), found(gain_db=np.inf, stable=False)
    pose = Pose(hexapod.home.position + [0.012, -0.003, 0.0], rotation_from_vector([0.0, 0.0, -0.1]))
    worst = PoseMargins(pose, found(peak=2.4, gain_db=9.9, delay=0.0123))
    design = Design(hexapod, SETUP, Rule(), gains, at_home, (worst,), preset, other, 120.0, 0.2)
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
        ("preset: gain margin", "40.0", "dB"),
        ("preset: phase margin", "65.0", "deg"),
        ("preset: crossover", "3.00", "Hz"),
        ("preset: sensitivity peak, all loops", "2.00", "-"),
    ]
    rows = {row[0]: row[1:] for row in design.workspace_rows()}
    assert rows["gain margin [dB]"] == ("13.6", "9.9", "12, -3, 0", "0.0, 0.0, -5.7")
    assert rows["delay margin [ms]"][:2] == ("20.0", "12.3")
    assert rows["sensitivity peak, all loops [-]"][:2] == ("2.00", "2.40")
    assert design.leg_rows()[0] == ("leg 0", "13.6 (9.9)", "70.2 (65.0)", "20.0 (12.3)", "4.32 (3.00)")
    summary = json.loads(json.dumps(design.summary(), allow_nan=False))
    assert summary["preset_margins"]["legs"][0]["gain_db"] is None and not summary["preset_margins"]["stable"]
    assert asdict(design.rule) == summary["rule"]
