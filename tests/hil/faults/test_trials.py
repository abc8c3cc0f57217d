"""Trials: repeatable on every link, kept in a table, and gone on with after a kill."""

import json
from dataclasses import replace

import numpy as np
import pytest

from controller.safety.causes import Cause, Mode
from hil.command_line import main
from hil.engine.engine import InOneProcess
from hil.faults import trials
from hil.faults.links import run
from hil.faults.reactions import CASES
from hil.faults.rows import MOST_LATE, Row, all_rows
from hil.faults.trials import Trial, figures_of, outcomes_of, run_trials, trials_of
from hil.sweep.store import Store
from plant.errors import GoughError
from tests.hil.processes import started, wait_until

NOISY = Row("noisy", "a", ("imu-noise:{k},axis=all,size_deg_per_s=2",), target="hold", duration=5.5, rate=250.0)


@pytest.mark.slow
@pytest.mark.parametrize("link", ["fmu", "udp", "canopen"])
def test_a_disturbance_begins_when_it_is_due_on_every_link_and_comes_out_the_same_again(link):
    drawn = replace(NOISY, link=link).drawn(2, "compiled")
    records, begin, cause = run(drawn)
    (imu,) = drawn.guilty
    rates = records["angular_velocity"][:, imu]
    spread = [np.std(rates[begin + first : begin + last]) for first, last in ((-40, -2), (2, 40))]
    assert spread[1] > 10.0 * spread[0] > 0.0
    assert cause == Cause.END_OF_MOTION and (records["mode"][begin:-40] == Mode.RUNNING).mean() > 0.9
    again, *_ = run(drawn)
    for name in ("angular_velocity", "position", "truth", "event_cause", "sample_ns", "drive"):
        assert records[name].tobytes() == again[name].tobytes()


@pytest.mark.parametrize("link", ["fmu", *(pytest.param(link, marks=pytest.mark.slow) for link in ("udp", "canopen"))])
def test_a_share_of_the_cycles_is_late_on_every_link_and_the_same_ones_again(link):
    row = replace(NOISY, link=link, late_percent=3.0, faults=())
    records, _, cause = run(row.drawn(2, "compiled"))
    assert cause == Cause.END_OF_MOTION
    gaps = records["missed"][records["missed"] > 0]
    # Of some 1,400 cycles; two late ones in a row make one gap.
    assert 20 < len(gaps) < 65 and 1 <= gaps.min() < MOST_LATE <= gaps.max()
    np.testing.assert_array_equal(run(row.drawn(2, "compiled"))[0]["missed"], records["missed"])
    assert (run(row.drawn(3, "compiled"))[0]["missed"] > 0).tolist() != (records["missed"] > 0).tolist()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fusion", "seed"),
    [("whole", 0), *(pytest.param(*each, marks=pytest.mark.slow) for each in (("compiled", 0), ("whole", 1)))],
)
def test_a_fault_is_told_on_a_machine_that_misses_periods(fusion, seed):
    name = "a leg's IMU turns by 3 deg about x at once, 6 % of the cycles late"
    (row,) = (row for row in all_rows() if row.name == name)
    figures = figures_of(Trial(row, seed, fusion))
    assert figures["told_s"] < 1.0 and not figures["forbidden"] and not figures["alarms"] and not figures["sound_left_out"]
    assert figures["position_before"] < 5e-3 and figures["covered"] >= 0.999 * figures["cycles"]


def test_bent_plates_and_loose_screws_are_in_the_plant():
    """Nothing but the mechanism is off, and the estimate shows it."""
    errors = []
    for row in (Row("sound", "m"), Row("bent", "m", base_bend_mm=4.0), Row("loose", "m", settings=("screw.backlash=2e-3",))):
        short = replace(row, target="hold", duration=1.0, imu="ideal")
        figures = figures_of(Trial(short, 1, "compiled"))
        assert figures["cycles"] > 1000 and not figures["told"] and figures["what"].endswith("on hexapod, hold, ideal, 1000 Hz")
        errors.append((figures["position_before"], figures["deviation"]))
    assert errors[0][0] < 0.05e-3 < 0.5e-3 < errors[1][0]
    assert errors[2][1] > 2.0 * errors[0][1]


def test_figures_of_cases_are_those_of_their_outcome():
    case = next(case for case in CASES if case.name == "an emergency stop is asked for")
    (outcome,) = outcomes_of([case], run_trials(trials_of([case], range(2))))
    assert (outcome.reactions, outcome.cycles, outcome.findings) == ({"quick stop": 2}, [0, 0], [])
    assert len(outcome.peak_m) == len(outcome.travel_m) == 2


def test_a_key_is_of_all_that_determines_the_figures(monkeypatch):
    row, other = Row("a", "b"), Row("a", "b", ("imu-dead:1",))
    keys = {Trial(what, seed, fusion).key for what in (row, other) for seed in (0, 1) for fusion in ("whole", "compiled")}
    keys |= {Trial(CASES[0], 0, "compiled").key, Trial(CASES[1], 0, "compiled").key}
    assert len(keys) == 10
    assert Trial(Row("a", "b"), 0, "whole").key in keys
    monkeypatch.setattr(trials, "fingerprint", lambda: "another source")
    assert Trial(row, 0, "whole").key not in keys


def test_a_table_keeps_what_has_run(tmp_path, monkeypatch):
    calls = []

    def counted(trial):
        calls.append(trial)
        return {"told": "nothing", "told_s": None, "forbidden": False}

    monkeypatch.setattr(trials, "figures_of", counted)
    few, more = (trials_of([Row("a", "b")], range(seeds)) for seeds in (2, 3))
    first = run_trials(few, InOneProcess(), folder=tmp_path)
    assert [(row["row"], row["fusion"], row["seed"]) for row in first] == [
        ("a", fusion, seed) for fusion in ("compiled", "whole") for seed in (0, 1)
    ]
    shares = []
    again = run_trials(more, InOneProcess(), lambda share, text: shares.append((share, text)), tmp_path)
    assert len(calls) == 6 and len(again) == 6 and [row["seed"] for row in again] == [0, 1, 2] * 2
    assert shares[-1][0] == 1.0 and shares[-1][1].startswith("6 of 6 runs")


def test_the_seeds_after_the_first_ones_are_the_same_trials(tmp_path):
    what = ("faults", "--only", "emergency stop", "--seeds", "1", "--workers", "1", "--json", str(tmp_path / "faults.json"))
    summaries = []
    for first in ("0", "1"):
        assert main([*what, "--first-seed", first]) == 0
        summaries.append(json.loads((tmp_path / "faults.json").read_text()))
    assert [each["first_seed"] for each in summaries] == [0, 1] and summaries[0]["cases"] != summaries[1]["cases"]
    assert main([*what, "--first-seed", "-1"]) == 2


def test_a_trial_that_fails_is_named(tmp_path, monkeypatch):
    wrong = trials_of([Row("wrong", "b", ("imu-dead:{k}",), link="fmu")], [0], ("whole",))
    with pytest.raises(GoughError, match="there is no disturbance 'dead'"):
        run_trials(wrong)
    with pytest.raises(GoughError, match="1 of 1 runs failed; the first one, 'wrong', fusion whole, seed 0: there is no"):
        run_trials(wrong, folder=tmp_path)


@pytest.mark.slow
def test_after_a_kill_the_command_goes_on_and_the_table_is_the_same(tmp_path):
    """A real process is killed while it works; the next one runs what is missing, and no run twice."""
    what = ("faults", "--only", "an axis of the platform's gyroscope is stuck", "emergency", "--seeds", "6")
    command = ("hil.command_line", *what, "--fusion", "compiled", "--workers", "1", "--results", "kept")
    kept = tmp_path / "kept"
    with started(command, tmp_path) as killed:
        wait_until(lambda: list(kept.glob("new/*.parquet")), "the first rows are there")
        killed.kill()
    before = Store(kept).table().to_pylist()
    assert 0 < len(before) < 12
    with started((*command, "--json", "kept.json"), tmp_path) as again:
        assert again.wait() == 0, again.text
    after = {row["key"]: row for row in Store(kept).table().to_pylist()}
    assert len(after) == 12
    assert all(after[row["key"]] == {name: row.get(name) for name in after[row["key"]]} for row in before)
    assert {path.name for path in kept.iterdir()} == {"runs.parquet", "new", "lock"}
    summary = json.loads((tmp_path / "kept.json").read_text())
    assert [each["runs"] for each in summary["disturbances"]] == [6]
    fresh = run_trials(
        [trial for trial in trials_of(all_rows(), [0], ("compiled",)) if "platform's gyroscope is stuck" in trial.what.name]
    )
    (same,) = [row for row in after.values() if row["row"] == fresh[0]["row"] and row["seed"] == 0]
    assert {name: same.get(name) for name in fresh[0]} == fresh[0]


def test_the_command_lists_and_selects(capsys):
    assert main(["faults", "--list", "--only", "vibration", "emergency", "--markdown"]) == 0
    listed = capsys.readouterr().out
    assert "| vibration | 1 g at 999.9 Hz along z on all | fmu | 1000 | 15 |" in listed
    assert "| reactions | an emergency stop is asked for |" in listed and "loosening" not in listed
    assert main(["faults", "--fusion", "none-such", "--list"]) == 2
    assert "no fusion 'none-such'" in capsys.readouterr().err


def test_the_command_prints_disturbances_and_says_what_is_forbidden(capsys, tmp_path, monkeypatch):
    base = {
        "what": "a swing", "position_before": 2e-3, "rotation_before": 0.01, "position_after": 9e-3, "rotation_after": 0.02,
        "position_then": 9e-3, "rotation_then": 0.02, "deviation": 1e-3, "told": "the base turns", "told_s": 1.0,
        "told_imu": -1, "alarms": 0, "ended": "end of the motion", "sound_left_out": "6", "forbidden": True,
    }  # fmt: skip
    monkeypatch.setattr(trials, "figures_of", lambda trial: base)
    only = ("faults", "--only", "the base swings by 2 deg about x", "--seeds", "3", "--workers", "1", "--markdown")
    assert main([*only, "--json", str(tmp_path / "x.json")]) == 1
    printed = capsys.readouterr()
    assert "| the base swings by 2 deg about x, period 4 s | 2.0 / 2.0 | 0.57 / 0.57 | 9.0 / 9.0 |" in printed.out
    assert "in 6 of 6 runs with compiled, whole" in printed.err
    base["forbidden"] = False
    assert main(only) == 0
