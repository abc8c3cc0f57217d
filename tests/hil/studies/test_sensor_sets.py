"""The closed loop with fewer sensors: every type of mechanism follows a motion with the paper's least and with all."""

import json
from pathlib import Path

import numpy as np
import pytest

from hil.command_line import main
from hil.studies.sensor_sets import MECHANISMS, SETS, Outcome, choose_imus, evaluate_sensor_sets, paper_set, reasons, table
from plant.dynamics.variables import PLATFORM_IMU
from plant.mechanism import load_spatial
from plant.mechanism.classification import classify

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "sensor_sets.md"
BOUNDS, SECTION_5_BOUNDS = (1.0, 0.3), (6.0, 1.5)
"""RMS of estimate and tracking [mm, deg]; section 5 has the heading's degree more, times the lever of the legs."""


FEW = [name if name in ("hexapod", "6-3-I") else pytest.param(name, marks=pytest.mark.slow) for name in MECHANISMS]
"""All of them, most of them slow."""


def least_of(name):
    return next(sensors for sensors in SETS if sensors.label == paper_set(classify(load_spatial(name))))


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW)
def test_every_type_follows_sines_with_the_least_sensors_and_with_all(name):
    least, everything = evaluate_sensor_sets([name], (least_of(name), SETS[-1]), duration=3.0)
    assert least.paper and not everything.paper
    for outcome in (least, everything):
        bounds = SECTION_5_BOUNDS if "section-5" in outcome.runs else BOUNDS
        assert outcome.runs
        for fusion, run in outcome.runs.items():
            for group in ("estimation", "tracking"):
                errors = 1e3 * run[group]["position_rms"], np.degrees(run[group]["rotation_rms"])
                assert (np.array(errors) < bounds).all(), (outcome.sensors, fusion, group, errors)


def test_the_papers_least_sensors_are_those_of_its_sections():
    least = {name: least_of(name) for name in MECHANISMS}
    assert (least["6-3-I"].legs, least["6-3-I"].platform) == (6, False)
    for name in ("6-3-II", "6-4-I", "6-4-II", "6-5"):
        assert (least[name].legs, least[name].platform, least[name].magnetometer) == (4, True, False)
        mechanism = load_spatial(name)
        *legs, platform = choose_imus(mechanism, least[name], paper=True)[0]
        assert platform == PLATFORM_IMU and len(legs) == 4
        # Two legs meet on the platform, which is where its plane is known to be.
        assert len(np.unique(mechanism.platform_joints[legs].round(6), axis=0)) == 3
    for name in ("hexapod", "genhexkins"):
        assert (least[name].legs, least[name].magnetometer, least[name].fusions) == (2, True, ("section-5",))


@pytest.mark.slow
def test_two_legs_that_meet_need_the_heading_in_the_whole_mechanism_filter():
    """They do not tell the yaw: without its magnetometer the filter is 1.6 deg off after 10 s, by the gyroscope's bias."""
    two = next(sensors for sensors in SETS if sensors.label == "2 legs + yaw")
    (outcome,) = evaluate_sensor_sets(["6-3-I"], (two,), duration=10.0)
    joints = load_spatial("6-3-I").platform_joints[list(outcome.imus[:2])]
    np.testing.assert_allclose(joints[0], joints[1], atol=1e-9)
    assert np.degrees(outcome.runs["whole"]["estimation"]["rotation_rms"]) < 0.8


def documented():
    lines = DOCUMENT.read_text(encoding="utf-8").splitlines()
    rows = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines if line.startswith("| ")]
    return [row for row in rows if len(row) == len(table([]).headings) and row[0] in MECHANISMS], lines


def test_the_documented_table_has_every_set():
    rows, _ = documented()
    assert [(row[0], row[1].removesuffix(" *")) for row in rows] == [(name, each.label) for name in MECHANISMS for each in SETS]


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW)
def test_the_documented_sets_have_their_imus_and_conditioning(name):
    mechanism = load_spatial(name)
    least = paper_set(classify(mechanism))
    for row, sensors in zip((row for row in documented()[0] if row[0] == name), SETS, strict=True):
        imus, conditioning, refused = choose_imus(mechanism, sensors, sensors.label == least)
        assert row[1].endswith("*") == (sensors.label == least)
        assert row[2] == ("refused" if refused else "".join(map(str, imus)))
        assert row[3] == ("" if refused else f"{conditioning:.2f}")
        assert "stopped" not in row


@pytest.mark.slow
def test_the_documented_errors_are_what_the_command_prints(tmp_path, capsys):
    path = tmp_path / "sets.json"
    sets = ["sensor-sets", "--mechanism", "6-3-II", "--duration", "10", "--markdown", "--json", str(path)]
    assert main(sets) == 0
    rows, lines = documented()
    printed = capsys.readouterr().out.splitlines()
    assert [line for line in printed if line.startswith("- ")] == [line for line in lines if line.startswith("- 6-3-II,")]
    expected = [row for row in rows if row[0] == "6-3-II"]
    for line, row in zip(printed[2:], expected, strict=False):
        for cell, value in zip(line.strip("|").split("|")[4:], row[4:], strict=True):
            figures = [[float(part) for part in text.split("/") if part.strip()] for text in (cell, value)]
            np.testing.assert_allclose(*figures, rtol=0.05, atol=0.011)
    saved = json.loads(path.read_text())["sets"]
    assert [each["sensors"] for each in saved] == [each.label for each in SETS]
    assert saved[0]["refused"] and not saved[0]["runs"]


def test_a_refused_set_says_why():
    (outcome,) = evaluate_sensor_sets(["6-3-II"], SETS[:1])
    assert table([outcome]).rows[0][2].text == "refused" and "do not determine the pose" in outcome.refused


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["sensor-sets", "--duration", "0"], "the duration is 0 s"),
        (["sensor-sets", "--mechanism", "none"], "none"),
        (["sensor-sets", "--seed", "-1", "--mechanism", "hexapod"], "seed"),
        (["simulate", "--imus", "0,3,6"], "add legs, or its magnetometer (--magnetometer)"),
        (["simulate", "--fusion", "section-5"], "add its magnetometer (--magnetometer)"),
        (["simulate", "--imus", "legs", "--magnetometer"], "add IMU 6"),
    ],
)
def test_bad_input_is_refused_in_a_line(arguments, complaint, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert complaint in error and error.count("\n") == 1


def errors(number):
    names = ("position_rms", "position_max", "rotation_rms", "rotation_max")
    values = number * np.array([1e-3, 2e-3, np.radians(3.0), np.radians(4.0)])
    return dict(zip(names, values.tolist(), strict=True))


def test_the_table_shows_the_errors_of_the_estimate_and_the_star_of_the_paper():
    runs = {
        "compiled": {"estimation": errors(1.0), "tracking": errors(9.0)},
        "whole": {"estimation": errors(0.5), "tracking": errors(9.0)},
    }
    outcomes = [
        Outcome("a", "4 legs", True, (0, 2, 3, 5), 0.126, "", runs),
        Outcome("b", "6 legs", False, (0, 1), 0.5, "", {"compiled": {"stopped": "why"}, "whole": runs["whole"]}),
        Outcome("b", "2 legs", False, (), 0.0, "too few", {}),
    ]
    rows = [[cell.text for cell in row] for row in table(outcomes).rows]
    whole = ["0.50 / 1.50", "1.00 / 2.00"]
    assert rows == [
        ["a", "4 legs *", "0235", "0.13", "1.00 / 3.00", "2.00 / 4.00", *whole],
        ["b", "6 legs", "01", "0.50", "stopped", "", *whole],
        ["b", "2 legs", "refused", "", "", "", "", ""],
    ]
    assert [row[0].text for row in table(outcomes, "b").rows] == ["6 legs", "2 legs"]
    assert reasons(outcomes) == ["b, 2 legs: too few", "b, 6 legs, compiled: why"]
