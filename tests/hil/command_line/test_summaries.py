"""What commands print of their figures: every figure in its row and column, in the unit of the heading."""

from dataclasses import replace
from math import radians
from types import SimpleNamespace

import numpy as np
import pytest

from controller.direct_kinematics.solver import METHODS
from controller.safety.causes import Cause, Mode
from hil.command_line import calibrate, main, measure, run, study
from hil.command_line.terminal import _view, deg, mm, mm_deg
from hil.loop.records import LINK_SIZE, RECORD, Link
from hil.recording.replay import Replay
from hil.runs.run_state import RunState
from hil.table import Table
from plant.pose import rotation_from_vector
from tests.hil.planar_rig import write_two_poses


def cells_of(table):
    return [
        [" ".join(filter(None, heading)) for heading in table.headings],
        *([cell.text for cell in row] for row in table.rows),
    ]


@pytest.fixture
def tables(monkeypatch):
    """The tables that are printed: lists of rows of text, the headings first."""
    shown = []
    monkeypatch.setattr(Table, "print", lambda table, markdown=False: shown.append(cells_of(table)))
    return shown


def pose_figures(number, prefix=""):
    """Figures that differ from each other: `number` tells the group."""
    return {
        f"{prefix}position_rms": number * 1e-3,
        f"{prefix}position_max": number * 2e-3,
        f"{prefix}rotation_rms": radians(number * 3.0),
        f"{prefix}rotation_max": radians(number * 4.0),
    }


def shown_figures(number, digits=4):
    return [f"{number * factor:.{digits}f}" for factor in (1.0, 2.0, 3.0, 4.0)]


def test_lengths_and_angles_have_their_units():
    assert (mm(-0.0012345), mm(0.5, 1), deg(radians(-90.0)), deg(1.0, 1)) == ("-1.234", "500.0", "-90.000", "57.3")
    figures = pose_figures(1.0) | pose_figures(5.0, "worst_")
    assert (mm_deg(figures), mm_deg(figures, "worst_")) == ("1.000, 3.000", "5.000, 15.000")


# ------------------------------------------------------------------------------------------------------ simulate, run, replay


LEVELS = ("p50", "p99", "max")


def simulated(truth_known):
    target = pose_figures(4.0, "reference_") | (pose_figures(3.0) if truth_known else {})
    return {
        "truth_known": truth_known,
        "estimation": pose_figures(1.0) if truth_known else None,
        "tracking": pose_figures(2.0) if truth_known else None,
        "estimated_tracking": pose_figures(5.0),
        "target": target,
        "protection": {f"{name}_{at}": i * 1e-3 for i, name in enumerate(("position", "rotation"), 2) for at in LEVELS}
        | ({"covered": 0.99875} if truth_known else {}),
        "limits": {"violations": 7},
        "target_stretch": 1.0,
        "events": ["cycle 812 (0.812 s): IMU 3 is left out: it is frozen"],
        "real_time_factor": 12.34,
        "cycle_us": {"p50": 1.0, "p99": 2.0, "p999": 3.0},
    }


@pytest.mark.parametrize(
    ("truth_known", "rows"),
    [
        (
            True,
            {"estimate - truth": 1.0, "truth - reference": 2.0, "truth - target": 3.0, "reference - target": 4.0},
        ),
        (False, {"estimate - reference": 5.0, "reference - target": 4.0}),
    ],
)
def test_a_simulation_prints_its_errors(tables, capsys, truth_known, rows):
    run._print_simulation(simulated(truth_known))
    ((headings, *found),) = tables
    assert headings == ["", "position RMS [mm]", "max [mm]", "rotation RMS [deg]", "max [deg]"]
    assert found == [[label, *shown_figures(number)] for label, number in rows.items()]
    printed = capsys.readouterr().out
    assert ("the truth is not known" in printed) == (not truth_known)
    assert "protection level p50/p99/max 2.000/2.000/2.000 mm, 0.172/0.172/0.172 deg" in printed
    assert ("; it covers the error in 99.875 % of the cycles" in printed) == truth_known
    assert "cycle 812 (0.812 s): IMU 3 is left out: it is frozen\n" in printed
    assert "limits violated by the reference: 7; 12.3 times real time; cycle p50/p99/p99.9 1.0/2.0/3.0 us" in printed


FIGURES_US = {"p50": 1.0, "p99": 20.0, "p999": 300.0, "max": 4000.0, "n": 5}
RUN = {
    "cause": "end of the motion",
    "cycles": 1200,
    "missed_own": 1, "missed_late": 2, "missed_host": 3,
    "timing_us": {"wake": FIGURES_US, "round trip": {"p50": 11.0, "p99": 12.0, "p999": 13.0, "max": 14.0, "n": 9}},
    "over_budget": [],
    "errors_m": {"estimation": 0.25e-3, "tracking": 0.5e-3, "known": 1},
    "errors_rad": {"estimation": 0.002},
    "usage": {"major_faults": 4, "minor_faults": 5, "involuntary_switches": 6, "resident": 7},
    "start_up_s": 1.25,
    "unseen": 0,
    "refused": ["locked memory"],
    "late": 8,
    "refused_packets": 9,
    "events": ["cycle 3 (0.003 s): armed"],
    "recording": {"files": ["a.mcap", "b.mcap"], "lost": 200},
    "round_trip_bars": [[8.0, 9.5, 16.0], [3.0, 1.0, 2.0]],
    "identity": {"name": "rig", "parts": {"drive": "1", "IMU": "2"}},
    "config": {"fusion": "compiled"},
    "target_stretch": 1.0,
    "obstacle": None,
    "protection": {"position": 2.5e-3, "rotation": 0.01},
}  # fmt: skip


def test_a_run_prints_its_figures(tables, capsys, monkeypatch):
    monkeypatch.setattr("hil.loop.stage_times.budget", lambda fusion: {"wake": {"p50": 1.0, "p99": 19.0, "max": 5000.0}})
    run._print_run(RUN)
    ((headings, *rows),) = tables
    assert headings == ["us", "p50 / budget", "p99 / budget", "p99.9 / budget", "max / budget"]
    assert rows[0] == ["wake", "1.0 / 1", "20.0 / 19", "300.0 /  -", "4000.0 / 5000"]
    assert [run._timing_cell(us, 5.0).alarm for us in (5.0, 5.1)] == [False, True]
    lines = capsys.readouterr().out.splitlines()
    for line in (
        "cycle 3 (0.003 s): armed",
        "over budget, as the table shows: wake p99",
        "greatest protection level 2.500 mm, 0.573 deg",
        "without locked memory",
        "1200 cycles; periods missed: 1 by own work, 2 woken late, 3 held up by the host",
        "the loop's thread: 4 major and 5 minor page faults, 6 involuntary switches, 7 bytes of growth; first cycle 1.25 s "
        "after the start",
        "estimate - truth 0.250 mm, 0.115 deg RMS; reference - length 0.500 mm RMS",
        "round trip to the rig p50 11, p99 12, p99.9 13, max 14 us",
        "8 exchanges late, 9 packets refused",
        "1000 cycles recorded in a.mcap, b.mcap; 200 cycles lost",
        "rig: rig; drive 1, IMU 2",
        "the motion went to its end, and the brakes hold",
    ):
        assert line in lines
    assert not any("arming" in line or "supervisor came too late" in line for line in lines)


@pytest.mark.parametrize(
    ("changes", "line", "without"),
    [
        (
            {"timing_us": {"record": FIGURES_US, "compute": FIGURES_US}},
            "over budget, as the table shows: record p99, p999, max; compute p999, max",
            "within the timing budget",
        ),
        ({}, "within the timing budget (hil/loop/budget.toml)", "over budget"),
        ({"cause": "asked for"}, "stopped on the brakes: asked for", "went to its end"),
        (
            {"target_stretch": 10.25},
            "the target is too fast for the legs' limits, so the reference stays behind it: --time-scale 10.2500 lets "
            "it be followed",
            "rig: rig {",
        ),
        ({"identity": {"name": "template", "parts": {}}}, "rig: template", "rig: template;"),
        ({"errors_m": RUN["errors_m"] | {"known": 0}}, "the truth is not known; reference - length 0.500 mm RMS", "estimate -"),
        ({"timing_us": {"wake": FIGURES_US}}, "1000 cycles recorded in a.mcap, b.mcap; 200 cycles lost", "round trip"),
        ({"unseen": 17}, "17 cycles are in none of these figures: the supervisor came too late", "nothing was moved"),
        ({"obstacle": ""}, "nothing was moved; all is well for arming", "not armed"),
        ({"obstacle": "not armed: drive 1"}, "not armed: drive 1", "all is well"),
        ({"obstacle": ""}, "the dry run went to its end", "the motion went"),
        ({"recording": {"files": [], "lost": 0}}, "8 exchanges late, 9 packets refused", "recorded in"),
    ],
)
def test_a_run_prints_what_there_is(tables, capsys, changes, line, without):
    run._print_run(RUN | changes)
    printed = capsys.readouterr().out
    assert line in printed.splitlines() and without not in printed


def test_round_trips_are_counted_by_octaves():
    # 8 to 16 us has 3 + 1, 16 to 32 us has 2, and what is below 1 us is in the first octave.
    text = run._bars([[0.25, 1.5, 8.0, 15.9, 16.0], [1.0, 1.0, 60.0, 20.0, 1.0]]).splitlines()
    rows = [(line.partition(" us ")[0].split(), line.count("#"), line.split()[-1]) for line in text]
    assert rows == [(["1", "to", "2"], 1, "2"), (["8", "to", "16"], 40, "80"), (["16", "to", "32"], 1, "1")]


@pytest.mark.parametrize(
    ("changes", "status", "said"),
    [
        ({}, 0, ""),
        ({"obstacle": "not armed"}, 1, ""),
        ({"recording": {"files": ["x"], "lost": 3}}, 1, "the run went to its end, but 3 of 1200 cycles are not recorded"),
    ],
)
def test_the_status_of_a_run_says_whether_all_is_well(monkeypatch, tables, capsys, changes, status, said):
    summary = RUN | {"recording": {"files": ["x"], "lost": 0}} | changes
    monkeypatch.setattr("hil.runs.executive.run", lambda *arguments: summary)
    monkeypatch.setattr(run, "keep_to_one_thread", lambda: None)
    assert main(["run"]) == status
    assert said in capsys.readouterr().err


REPLAY = Replay(
    cycles=90, recorded=100, missing_after=None, different=None, fields={}, recorded_by="1", replayed_by="1", cut_short=()
)  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "same", "lines"),
    [
        ({}, True, ["90 of 100 cycles replayed, bit for bit"]),
        (
            {"missing_after": 89, "cut_short": ("a.mcap",)},
            False,
            [
                "a.mcap was cut short: what follows its last chunk is lost",
                "cycles are missing after cycle 89: what follows cannot be replayed",
                "90 of 100 cycles replayed, bit for bit",
            ],
        ),
        (
            {"different": 5, "fields": {"mode": ([2.0], [3.0])}},
            False,
            ["cycle 5 is the first that differs:", "  mode: recorded [2.0], replayed [3.0]", "90 of 100 cycles replayed"],
        ),
        (
            {"different": 5, "fields": {}, "replayed_by": "2"},
            False,
            ["cycle 5 is the first that differs:", "  (recorded by gough 1, replayed by 2)", "90 of 100 cycles replayed"],
        ),
    ],
)
def test_a_replay_says_how_it_came_out(monkeypatch, capsys, tmp_path, changes, same, lines):
    result = replace(REPLAY, **changes)
    assert result.same == same and result.summary()["same"] == same
    monkeypatch.setattr("hil.recording.replay.replay", lambda paths: result)
    assert main(["replay", str(tmp_path / "x.mcap")]) == int(not same)
    assert capsys.readouterr().out.splitlines() == lines


def test_the_view_of_a_run_shows_the_latest_cycle():
    records, link, state = np.zeros(5, RECORD), np.zeros(LINK_SIZE, np.int64), RunState(1e-3)
    assert "preparing" in _view("title", state, 0.0).rows[0][1].text
    roll, pitch, yaw = np.radians([10.0, -20.0, 30.0])
    turns = [rotation_from_vector(vector) for vector in ([0, 0, yaw], [0, pitch, 0], [roll, 0, 0])]
    records["cycle"] = np.arange(5)
    records["time_ns"][3], records["position"][3] = 2_500_000_000, (0.001, -0.002, 0.5)
    records["rotation"][3], records["truth"][:, 0] = turns[0] @ turns[1] @ turns[2], np.nan
    records["lengths"], records["reference"][:, :, 0] = 0.4, 0.4 - 0.002
    records["mode"][3], records["stop"][3] = Mode.STOPPING, Cause.STOP_REQUESTED
    records["missed"][1], records["silent"][2] = 4, 1
    records["late_ns"], records["stage_ns"] = 7000, 2000
    link[Link.HEAD] = 4
    state.update(records, link)
    state.refused, state.events = ["a"], ["b"]
    rows = {row[0].text: row[1].text for row in _view("title", state, 0.0).rows}
    assert rows["state"] == "stopping: asked for, 2.5 s"
    assert rows["position [mm]"].split() == ["1.000", "-2.000", "500.000"]
    assert rows["roll, pitch, yaw [deg]"].split() == ["10.000", "-20.000", "30.000"]
    assert rows["estimate - truth, RMS [mm]"] == "the truth is not known"
    assert rows["reference - length, RMS [mm]"] == "2.000"
    assert rows["woken late p50, p99.9, max [us]"].split() == ["7", "7", "7"]
    assert rows["computing p50, p99.9, max [us]"].split() == ["14", "14", "14"]
    assert rows["periods missed, exchanges late"] == "4, 1"
    assert (rows["without"], rows[""]) == ("a", "b")


# ------------------------------------------------------------------------------------------------------------------ calibrate


def test_constants_are_printed_in_their_units(tables):
    table = Table("IMU 3", "x", "y", "z")
    gain = np.arange(9.0).reshape(3, 3)
    calibrate._add_constants(table, "gyroscope: ", ("deg/s", 10.0), gain, np.array([0.1, -0.2, 0.3]), 0.01 * np.arange(12.0))
    table.print()
    assert tables[0][1:] == [
        ["gyroscope: offset [deg/s]", "1.000 +- 0.000", "-2.000 +- 0.100", "3.000 +- 0.200"],
        ["gyroscope: gain, row 1", "0.00000 +- 0.03000", "1.00000 +- 0.04000", "2.00000 +- 0.05000"],
        ["gyroscope: gain, row 2", "3.00000 +- 0.06000", "4.00000 +- 0.07000", "5.00000 +- 0.08000"],
        ["gyroscope: gain, row 3", "6.00000 +- 0.09000", "7.00000 +- 0.10000", "8.00000 +- 0.11000"],
    ]


def test_a_calibration_of_the_rig_prints_every_stage(tables, capsys):
    summary = {
        "rests": 28,
        "residual_mg": {"before": 9.0, "motion": 0.25},
        "validated": {"motion": {"left_out_mg": 0.5} | pose_figures(3.0)},
        "predicted": {"before": pose_figures(1.0), "motion": pose_figures(2.0)},
        "true": {"motion": pose_figures(4.0)},
        "weakest": "mostly along x",
        "untold": {"alignment x": [2, 5]},
        "least_told": {"name": "alignment y", "imu": 4, "share": 0.75},
    }
    calibrate._print_rig_calibration(summary)
    assert tables[0] == [
        ["28 poses at rest", "residual [mg]", "left out", "predicted [mm, deg]", "halves", "true"],
        ["as they are", "9.000", "", "1.000, 3.000", "", ""],
        ["and in motion", "0.250", "0.500", "2.000, 6.000", "3.000, 9.000", "4.000, 12.000"],
    ]
    printed = capsys.readouterr().out
    assert "the pose is known least mostly along x" in printed
    assert "the data hardly told alignment x of IMU 2, 5: more than 0.5 of its sigma before is left" in printed
    assert "the constant known least is alignment y of IMU 4: 0.75 of its sigma before is left" in printed


# -------------------------------------------------------------------------------------------------------------------- studies


def test_the_comparison_of_fusions_is_printed(monkeypatch, tables):
    methods = {
        "a": pose_figures(1.0) | {"nees": 6.25, "us": 12.5, "seeds": 6},
        "b": pose_figures(2.0) | {"nees": None, "us": 7.0, "seeds": 1},
    }
    monkeypatch.setattr("hil.studies.fusion_comparison.compare", lambda config, engine, progress: {"methods": methods})
    assert main(["compare-fusion"]) == 0
    assert tables == [[
        ["mpu9150-calibrated, 1", "position RMS [mm]", "rotation RMS [deg]", "NEES", "us", "seeds"],
        ["a", "1.000", "3.000", "6.2", "12.5", "6"],
        ["b", "2.000", "6.000", "", "7.0", "1"],
    ]]  # fmt: skip


def test_an_evaluation_of_the_fusion_is_printed(tables, capsys):
    worst = pose_figures(4.0, "worst_")
    study._print_calibrations({
        "0.0001": {"before": pose_figures(1.0), "after": pose_figures(2.0), "predicted": pose_figures(3.0),
                   "least_improvement": 12.0},
    })  # fmt: skip
    motion = {"refined": pose_figures(1.0) | {"nees": 5.0}, "whole": pose_figures(2.0) | worst | {"nees": 7.0}}
    study._print_motions({"0": {"mixed": motion, "0.5": motion}})
    dead = pose_figures(2.0) | {"position_rms_ratio": 1.5, "rotation_rms_ratio": 2.5}
    study._print_faults({"none": pose_figures(1.0), "leg": dead})
    study._print_drift({"minutes": [pose_figures(1.0) | {"nees": 3.0}, pose_figures(2.0) | {"nees": 4.0}]})
    study._print_cost({"whole": {"mean_us": 1.0, "max_us": 9.0}})
    calibrations, motions, faults, drift, cost = tables
    assert calibrations[1] == ["joints 0.1 mm off", "1.000, 3.000", "2.000, 6.000", "3.000, 9.000", "12 times"]
    assert motions[0] == ["exact joints, RMS [mm, deg]", "legs, refined", "NEES", "whole mechanism", "worst seed", "NEES"]
    cells = ["1.000, 3.000", "5.0", "2.000, 6.000", "4.000, 12.000", "7.0"]
    assert motions[1:] == [["mixed", *cells], ["0.5 Hz", *cells]]
    assert faults[0] == ["IMU dead at 1 Hz", "position RMS [mm]", "times", "rotation RMS [deg]", "times"]
    assert faults[1:] == [["none", "1.000", "", "3.000", ""], ["leg", "2.000", "1.50", "6.000", "2.50"]]
    assert drift[1:] == [["minute 1", "1.000", "3.000", "3.0"], ["minute 2", "2.000", "6.000", "4.0"]]
    assert cost == [["microseconds of a cycle", "mean", "most"], ["whole", "1.0", "9.0"]]
    study._print_starts({"succeeded": 3, "starts": 4, "position_max": 1e-3, "rotation_max": radians(2.0)})
    study._print_following({"imu": "i", "fusion": "f", "target": "t", "nees": 6.5} | pose_figures(1.0) | worst)
    assert capsys.readouterr().out.splitlines() == [
        "starts in motion up to 2 Hz: 3 of 4 within 1.5 s; largest error from then on 1.000 mm, 2.000 deg",
        "closed loop, i, f, t: RMS 1.000 mm, 3.000 deg, worst seed 4.000 mm, 12.000 deg, NEES 6.5",
    ]


def test_the_errors_of_a_planar_rig_are_printed(tables, tmp_path):
    write_two_poses(tmp_path)
    assert main(["planar", str(tmp_path)]) == 0
    ((headings, raw, kalman, _),) = tables
    assert headings[1:] == ["x [mm]", "y [mm]", "angle [deg]", "leg angles [deg]", "true pose is a mode"]
    assert raw == ["raw", "0.00", "0.00", "0.00", "0.00", "2 of 2 poses"]
    assert kalman[:4] == ["kalman", "2.00", "3.00", "4.00"] and kalman[5] == "2 of 2 poses"


def test_the_scores_of_trials_are_printed(monkeypatch, tables):
    methods = {name: {"inclination_rms": radians(k), "us": 10.0 * k} for k, name in enumerate(("filter", "vqf"), start=1)}
    figures = {"trials": {"t": methods | {"samples": 99}}, "simulated": {"s": methods | {"samples": 98}}}
    monkeypatch.setattr("hil.studies.broad.evaluate", lambda folder, fusion, seeds, engine: figures)
    assert main(["broad", "."]) == 0
    assert tables[0][1] == ["t", "1.000", "2.000", "10.00", "20.00", "99"]
    assert tables[0][2] == ["s", "1.000", "2.000", "10.00", "20.00", "98"]
    assert tables[0][0] == ["inclination RMS", "filter [deg]", "vqf [deg]", "filter [us]", "vqf [us]", "samples"]


# ------------------------------------------------------------------------------------------------------------------ the bench


def percentiles(number):
    return {"p50": number, "p99": 2.0 * number, "p999": 3.0 * number, "max": 4.0 * number, "n": 100 + number}


def test_a_condition_of_the_clock_is_printed(tables, capsys):
    figures = {f"{name}_us": percentiles(10**k) for k, name in enumerate(("compute", "bare", "latency", "wake", "cyclictest"))}
    usage = {"major_faults": 1, "minor_faults": 2, "involuntary_switches": 3, "resident": 4096}
    measured = figures | {
        "usage": usage,
        "missed_own": 5,
        "missed_host": 6,
        "overran": {"ours": 7, "bare": 8},
        "over_budget": [],
    }
    measure._print_condition("title", measured)
    measure._print_condition("title", measured | {"cyclictest_us": None, "over_budget": ["a", "b"]})
    assert tables[0] == [
        ["title", "p50", "p99", "p99.9", "max", "cycles"],
        ["computing", "1.0", "2.0", "3.0", "4.0", "101"],
        ["bare loop computing", "10.0", "20.0", "30.0", "40.0", "110"],
        ["wake-up to command", "100.0", "200.0", "300.0", "400.0", "200"],
        ["woken late", "1000.0", "2000.0", "3000.0", "4000.0", "1100"],
        ["cyclictest", "10000.0", "20000.0", "30000.0", "40000.0", "10100"],
    ]
    assert tables[1] == tables[0][:-1]
    assert capsys.readouterr().out.splitlines() == [
        "periods missed by own work 5, by the host 6; overran its period 7 times, the bare loop 8; page faults 1 major, "
        "2 minor; involuntary switches 3; growth 4096 bytes; woken late over cyclictest: p50 0.10, p99.9 0.10",
        "within the timing budget (hil/loop/budget.toml)",
        "periods missed by own work 5, by the host 6; overran its period 7 times, the bare loop 8; page faults 1 major, "
        "2 minor; involuntary switches 3; growth 4096 bytes",
        "over budget: a, b",
    ]


def test_plant_and_kinematics_are_printed_in_their_units(monkeypatch, tables, capsys):
    plant = {
        "calls_us": {"step": {"p50": 1.5, "p99": 2.5}},
        "step_us": {"FMI 3": {"p50": 9.0, "p99": 9.0}, "FMI 2": {"p50": 3.5, "p99": 4.5}},
        "cycle_us": 5.0, "fmpy_us": 50.0, "fmpy_slowdown": 10.0, "error_m": 2.5e-9, "substep": 5e-4, "duration": 10.0,
    }  # fmt: skip
    seconds = []
    monkeypatch.setattr("hil.benchmarks.plant.measure_plant", lambda duration, progress: seconds.append(duration) or plant)
    for duration in (60.0, 4.0):
        measure._plant(SimpleNamespace(duration=duration), {})
    assert seconds == [10.0, 4.0]
    assert tables[0][1:] == [["step", "1.500", "2.500"], ["step, FMI 2.0", "3.500", "4.500"]]
    assert capsys.readouterr().out.splitlines()[0] == (
        "all of them 5.00 us, through FMPy's methods 50.0 us, 10.0 times longer; off by 2.5 nm at most from substeps 16 times "
        "shorter than 0.5 ms, in 10 s of motion"
    )
    times = [{"legs": {"closed_form": us, "refined": 2.0 * us}} for us in (1.0, 3.0, 8.0)]
    kinematics = {
        "solve_us": {"n-6.1": times[0], "n-6.2": times[1], "n-6.3": times[2]},
        "hexapod_us": times[1],
        "call_us": 40.0,
        "batch_per_s": {"legs": 2e6},
        "newton": {"warm_us": 6.0, "ratios": {"legs": {"closed_form": 0.5, "refined": 1.0}}},
        "newton_in_c": {"warm_us": 2.0, "steps": 4.5, "ratios": {"n-6.1": times[2], "hexapod": times[1]}},
        "cold_starts": {"hexapod": {"wide": {"newton": {"success": 0.5, "wrong": 0.25},
                                             "directions": {"success": 1.0, "wrong": 0.0}}}},
    }  # fmt: skip
    monkeypatch.setattr("hil.benchmarks.kinematics.measure_kinematics", lambda progress: kinematics)
    measure._kinematics(SimpleNamespace(), {})
    assert tables[2][1:] == [["n-6", "3.00 / 6.00"], ["hexapod", "3.00 / 6.00"], ["over Newton", "0.50 / 1.00"]]
    assert tables[3] == [["over C", "legs"], ["n-6", "8.00 / 16.0"], ["hexapod", "3.00 / 6.00"]]
    assert tables[4][1:] == [["hexapod, wide", "50.0", "25.0", "100.0", "0.0"]]
    printed = capsys.readouterr().out
    assert "[thousands]: legs 2000; one call from Python 40 us" in printed and "warm: 6.00 us per pose" in printed
    assert "to 1e-9 m: 2.00 us, 4.5 steps" in printed


def test_the_table_of_kinematics_fits_100_columns(monkeypatch, capsys):
    times = {name: {"closed_form": 12.34, "refined": 23.45} for name in METHODS}
    kinematics = {
        "solve_us": {"n-4-II.1": times}, "hexapod_us": times, "call_us": 40.0, "batch_per_s": {}, "cold_starts": {},
        "newton": {"warm_us": 6.0, "ratios": times},
        "newton_in_c": {"warm_us": 2.0, "steps": 4.5, "ratios": {"n-4-II.1": times, "hexapod": times}},
    }  # fmt: skip
    monkeypatch.setattr("hil.benchmarks.kinematics.measure_kinematics", lambda progress: kinematics)
    measure._kinematics(SimpleNamespace(), {})
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines[:12])) <= 100
    assert any(all(name in line for name in METHODS) for line in lines)
    assert sum(line.count("12.3 / 23.4") == len(METHODS) for line in lines) == 5
