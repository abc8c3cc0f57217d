"""Rows of disturbances against the best test: figures, verdicts, and the command."""

import json
from dataclasses import replace
from math import inf, radians

import numpy as np
import pytest

from hil.command_line import main
from hil.faults.bounds import FACTOR, LIMITS, Errors, RowBounds, bounds_of_rows, left_out, summary, table
from hil.faults.rows import SOUND, Row, all_rows
from hil.studies.detectability.bounds import Bound
from hil.studies.detectability.uncertainty import Uncertainty
from plant.errors import InputError

QUIET = ("--workers", "1", "--markdown")
TILT = "the base tilts by 0.5 deg about y within 1 s"


def row_of(name):
    return next(row for row in all_rows() if row.name == name)


def bound_of(position, rotation, told=0.5):
    own = position, rotation
    return Bound(told, 0.1, *own, 0.5 * position, 0.5 * rotation, 0.05, *own, 3.0 * position, 3.0 * rotation, *own)


def figures(row, *errors):
    """As `gough faults --json` writes them."""
    fusions = ("compiled", "whole")
    return {
        "disturbances": [
            {"row": row.name, "fusion": fusion, "position_before": position, "rotation_before": rotation}
            for fusion, (position, rotation) in zip(fusions, errors, strict=True)
        ]
    }


@pytest.fixture(scope="module")
def found():
    """The bounds of two rows of the table and one without a signature."""
    rows = [row_of(TILT), row_of("a leg's IMU turns by 3 deg about x at once"), row_of("wind of 30 N")]
    return bounds_of_rows(rows, range(2))


def test_rows_have_bounds_far_below_the_limits_or_a_reason(found):
    tilt, turn, wind = found
    assert (tilt.single, turn.single) == (False, True)
    for each in (tilt, turn):
        assert len(each.bounds) == 2 and all(0.0 < bound.told_after < 2.0 for bound in each.bounds)
        assert each.errors("fault_").within(each.errors()) and each.errors().within(LIMITS[each.single])
    assert not wind.bounds and left_out(found) == ["wind of 30 N: no sensor reads anything else on average"]


def test_seeds_draw_other_legs_and_times_and_repeat_to_the_bit(found):
    turn = found[1]
    again = bounds_of_rows([turn.row], range(2))[0]
    assert again == turn and turn.bounds[0] != turn.bounds[1]


@pytest.mark.parametrize(
    ("error", "verdict"),
    [
        ((1.4e-3, 0.001), "yes"), ((1.6e-3, 0.001), "limit"), ((1e-3, radians(0.69)), "limit"), ((3.1e-3, 0.001), "no"),
        ((inf, 0.0), "no"),
    ],
)  # fmt: skip
def test_the_verdict_compares_with_the_factor_and_with_the_limit(error, verdict):
    found = RowBounds(row_of(TILT), True, (bound_of(1e-3, 0.002), bound_of(0.5e-3, 0.001)))
    assert found.strict == Errors(FACTOR * 1e-3, FACTOR * 0.002) and found.limit == LIMITS[True]
    assert found.verdict(Errors(*error)) == verdict


def test_a_fault_that_hides_well_may_do_more_than_the_limit():
    found = RowBounds(row_of(TILT), False, (bound_of(10e-3, 0.001),))
    assert found.limit == Errors(FACTOR * 10e-3, LIMITS[False].rotation)
    assert found.verdict(Errors(14e-3, 0.01)) == "limit" and found.verdict(Errors(16e-3, 0.0)) == "no"


def test_figures_of_runs_stand_beside_the_bounds(found):
    tilt = found[0]
    measured = figures(tilt.row, (0.5e-3, 0.001), (None, 0.002))
    assert tilt.before(measured) == {"compiled": Errors(0.5e-3, 0.001), "whole": Errors(inf, 0.002)}
    assert tilt.beyond(measured) and not tilt.beyond({"disturbances": []})
    cells = [cell.text for cell in table(found, measured).rows[0]]
    assert cells[0] == TILT and cells[-1] == "yes / no" and cells[-2].startswith("0.50/0.06; inf/")
    written = summary(found, Uncertainty(), measured)["rows"][0]["measured"]
    assert written["compiled"]["within"] == "yes" and written["whole"]["within"] == "no"
    for wrong in ({"disturbances": [{"row": TILT}]}, {"disturbances": [3]}):
        with pytest.raises(InputError, match="gough faults --json"):
            tilt.before(wrong)


def test_a_row_that_is_never_told_says_so():
    row = Row("slow", "own", ("imu-offset:all,axis=x,size_deg_per_s=1e-4,ramp_s=4,at=1",), duration=3.0)
    found = bounds_of_rows([row], [0])
    assert found[0].bounds[0].told_after is None and found[0].bounds[0].least > 1.0
    assert table(found).rows[0][1].text == "never"


def test_the_level_and_how_many_times_the_error_it_is_end_the_line():
    row = RowBounds(row_of(TILT), False, (bound_of(1e-3, 0.01), bound_of(2e-3, 0.005)))
    assert [cell.text for cell in table([row]).rows[0]][-2:] == ["6.00/1.72", "3.0/3.0"]


def test_the_command_prints_writes_and_judges(tmp_path, capsys):
    row = row_of(TILT)
    path, runs = tmp_path / "bounds.json", tmp_path / "faults.json"
    runs.write_text(json.dumps(figures(row, (1e-3, 0.001), (20e-3, 0.001))))
    status = main(["detectability", TILT, "--seeds", "1", "--json", str(path), "--measured", str(runs), *QUIET])
    printed = capsys.readouterr()
    assert status == 1 and "yes / no" in printed.out
    written = json.loads(path.read_text())
    assert [each["row"] for each in written["rows"]] == [TILT]
    assert written["rows"][0]["seeds"][0]["told_after"] > 0.0 and written["uncertainty"]["accelerometer_bias"] == 0.015


def test_the_command_takes_a_fault_of_one_s_own_and_other_uncertainties(capsys):
    fault = "imu-offset:2,axis=y,size_m_per_s2=1,at=1,ramp_s=2"
    sizes = []
    for worse in ([], ["--accelerometer-wander", "0.05"]):
        options = ["--fault", fault, "--duration", "4", "--seeds", "1", *QUIET, *worse]
        assert main(["detectability", *options]) == 0
        cells = capsys.readouterr().out.splitlines()[2].split(" | ")
        sizes.append(float(cells[7].rstrip(" %")))
    assert sizes[1] > 1.5 * sizes[0] > 0.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["no such row"], "no row has 'no such row' in its name"),
        (["sound"], "nothing is disturbed, so there is nothing to detect"),
        (["nothing is wrong, 6-5", "nothing is wrong, 6-4"], "or see what the loop tells in these: gough faults --only sound"),
        (["--seeds", "0"], "at least 1 is needed"),
        (["--fault", "imu-offset:9,axis=y,size_m_per_s2=1"], "imus = '9'"),
        (["--fault", "base-tilt,axis=x,size_deg=1", "--jerk", "0"], "it must be positive and finite"),
        (["wind", "--measured", __file__], "is no JSON"),
        (["wind", "--measured", "nowhere.json"], "nowhere.json"),
    ],
)
def test_bad_input_gets_one_line(options, message, capsys):
    assert main(["detectability", *options, *QUIET]) == 2
    errors = capsys.readouterr().err.strip().splitlines()
    assert message in errors[-1] and not any("Traceback" in line for line in errors)


def test_each_seed_of_a_row_that_is_drawn_anew_has_bounds_of_its_own_beside_its_own_errors():
    row, seeds = row_of("drawn: the base tilts").with_entries({"duration": 6.0, "mechanism": "hexapod"}), range(3, 5)
    found = bounds_of_rows([row], seeds)
    assert [each.name for each in found] == [f"{row.name}, seed {seed}" for seed in seeds]
    assert [len(each.bounds) for each in found] == [1, 1] and found[0].bounds != found[1].bounds
    measured = figures(row, (0.5e-3, 0.001), (0.5e-3, 0.001))
    for each in measured["disturbances"]:
        each["seeds"] = [{"seed": seeds[0], "position_before": 50e-3, "rotation_before": None}]
    assert found[0].before(measured) == dict.fromkeys(("compiled", "whole"), Errors(50e-3, inf))
    assert found[0].beyond(measured) and not found[1].before(measured) and not found[1].beyond(measured)
    assert [row[0].text for row in table(found, measured).rows] == [each.name for each in found]
    written = summary(found, Uncertainty(), measured)["rows"]
    assert [(each["row"], each["seed"]) for each in written] == [(row.name, seed) for seed in seeds]
    with pytest.raises(InputError, match="as this version writes them"):
        found[0].before(figures(row, (0.5e-3, 0.001), (0.5e-3, 0.001)))


def test_a_row_with_other_entries_draws_the_same_otherwise():
    row = row_of("drawn: the base tilts")
    other = row.with_entries({"rate": 500.0})
    for seed in range(5):
        own, changed = row.drawn(seed, "whole"), other.drawn(seed, "whole")
        assert changed.config == replace(own.config, rate=500.0) and changed.faults == own.faults


@pytest.mark.endurance
def test_only_shocks_and_joints_that_are_off_come_near_the_limits_before_they_are_told():
    """All other rows are told before the error exceeds two thirds of the limit."""
    found = [each for each in bounds_of_rows([row for row in all_rows() if row.kind != SOUND], range(2)) if each.bounds]
    assert len(found) > 100
    share = [max(np.divide(each.errors(), LIMITS[each.single])) for each in found]
    beyond = {each.row.kind for each, size in zip(found, share, strict=True) if size > 2.0 / 3.0}
    assert beyond <= {"vibration", "mechanism", "base", "other-rates", "other-imus"}
