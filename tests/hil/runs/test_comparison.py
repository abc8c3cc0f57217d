"""Runs beside each other: the test computes the figures from the recordings by itself, and reads tables, JSON and report."""

import json
import re
import shutil
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from controller.safety.causes import Mode
from hil import compare
from hil.command_line.cli import write_json
from hil.look import SERIES
from hil.realtime.scheduling import RealTimeSettings
from hil.recording.mcap import RecordingError, read
from hil.runs.comparison import FIGURES
from hil.runs.config import SimulationConfig
from hil.runs.executive import run
from hil.runs.recorded_run import recorded_run
from hil.runs.simulation import simulate
from plant.errors import InputError
from plant.mechanism import load_mechanism
from plant.pose import rotation_from_vector, rotations_from_quaternions, vector_from_rotation
from tests.hil.commands import gough
from tests.hil.pages import draw_in_browser, figures_in, numbers, traces_of

SETTINGS = RealTimeSettings(most_missed=2000)
LONG = SimulationConfig(target="sines", duration=1.0, rate=250.0)
SHORT = SimulationConfig(target="circle", duration=0.6, rate=500.0, imu="ideal", seed=2, fusion="whole")
PLANE = SimulationConfig(mechanism="planar-3rpr", duration=0.5, rate=250.0)
pytestmark = pytest.mark.slow
NEEDS_PLOTLY = pytest.mark.skipif(find_spec("plotly") is None, reason="needs plotly")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With three recordings, and the figures of two of them and of two simulations."""
    made = tmp_path_factory.mktemp("compared")
    for name, config in (("long", LONG), ("short", SHORT), ("plane", PLANE)):
        write_json(made / f"{name}.json", run(config, SETTINGS, made / f"{name}.mcap"))
    for name, config in (("simulated", LONG), ("other", replace(LONG, seed=5, target="circle"))):
        write_json(made / f"{name}.json", simulate(config).summary())
    return made


@pytest.fixture
def compared(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return compare(["long.mcap", "short.mcap", "long.json", "simulated.json"])


def motion_of(path, config, seconds):
    """The records of a motion's first seconds, whose beginning is told by its end."""
    recording = read(path)
    (end,) = [cycle for cycle, text in recording.events if text == "controlled stop: end of the motion"]
    passed = (recording.records["cycle"] - (end - round(config.duration * config.rate))) / config.rate
    return recording.records[(passed > -1e-9) & (passed < seconds - 1e-9)]


def sizes_of(pose, other):
    """Distances [m] and angles [rad] between poses."""
    chord = np.linalg.norm(pose[1] - other[1], axis=(1, 2)) / np.sqrt(8.0)
    return np.linalg.norm(pose[0] - other[0], axis=1), 2.0 * np.arcsin(chord)


def planned_poses(mechanism, lengths):
    """The poses that have these lengths (N, 6), by Newton's method with differences, from the one before."""
    position, vector = np.array(mechanism.home.position), vector_from_rotation(mechanism.home.rotation)
    x, found = np.concatenate([position, vector]), []

    def off(x, target):
        joints = x[:3] + mechanism.platform_joints @ rotation_from_vector(x[3:]).T
        return np.linalg.norm(joints - mechanism.base_joints, axis=1) - target

    for target in lengths:
        for _ in range(4):
            slopes = np.stack([(off(x + step, target) - off(x - step, target)) / 2e-6 for step in 1e-6 * np.eye(6)], axis=1)
            x = x - np.linalg.solve(slopes, off(x, target))
        assert np.abs(off(x, target)).max() < 1e-12
        found.append((x[:3].copy(), rotation_from_vector(x[3:])))
    return tuple(np.array(each) for each in zip(*found, strict=True))


@pytest.mark.parametrize(("number", "config"), [(0, LONG), (1, SHORT)])
def test_the_figures_are_those_of_the_recording_over_the_shared_time(compared, folder, number, config):
    made = compared.runs[number]
    records = motion_of(folder / made.source, config, SHORT.duration)
    estimate = records["position"], records["rotation"]
    truth = records["truth"][:, :3], rotations_from_quaternions(np.ascontiguousarray(records["truth"][:, 3:7]))
    planned = planned_poses(load_mechanism("hexapod"), records["reference"][:, :, 0])
    expected = {}
    for group, poses in (("estimation", (estimate, truth)), ("tracking", (truth, planned))):
        for quantity, sizes in zip(("position", "rotation"), sizes_of(*poses), strict=True):
            expected |= {
                f"{group}.{quantity}_rms": np.sqrt(np.mean(sizes**2)),
                f"{group}.{quantity}_max": sizes.max(),
            }
    for k, quantity in enumerate(("position", "rotation")):
        level = records["protection"][:, k]
        expected |= {f"protection.{quantity}_max": np.nanmax(level), f"protection.{quantity}_p50": np.nanmedian(level)}
    compute = records["stage_ns"][:, 1:8].sum(axis=1)
    for group, times in (("compute", compute), ("late", records["late_ns"])):
        expected |= {f"{group}.{name}": np.quantile(times, share) / 1e9 for name, share in (("p50", 0.5), ("p999", 0.999))}
    expected["missed_periods"] = records["missed"].sum()
    for name, value in expected.items():
        assert made.figures[name] == pytest.approx(value, rel=1e-6, abs=1e-9), name
    assert made.seconds == compared.seconds == pytest.approx(0.6)
    assert len(made.course.times) == len(records) and made.course.times[0] == 0.0


def test_runs_that_differ_in_their_stages_alone_differ_in_these(folder, tmp_path):
    told = json.loads((folder / "simulated.json").read_text())
    own = told | {"stages": {"command": "mine.proportional"}}
    for name, content in (("goughs.json", told), ("mine.json", own)):
        (tmp_path / name).write_text(json.dumps(content))
    differing = compare([tmp_path / "goughs.json", tmp_path / "mine.json"]).differing()
    assert differing == {"stages": [{}, {"command": "mine.proportional"}]}


def test_a_json_of_an_older_version_lacks_some_figures_and_is_taken(folder, tmp_path):
    told = json.loads((folder / "long.json").read_text())
    older = {
        name: value for name, value in told.items() if name not in ("protection", "target_stretch", "errors_rad", "motion_s")
    }
    (tmp_path / "older.json").write_text(json.dumps(older))
    run = compare([folder / "long.json", tmp_path / "older.json"]).runs[1]
    assert "target_stretch" not in run.figures and "whole.rotation" not in run.figures
    assert run.figures["whole.estimation"] == told["errors_m"]["estimation"]


def test_in_the_level_frame_the_motion_begins_with_the_approach(folder):
    """There the base moves the reference, which never rests at the start."""
    run = recorded_run([folder / "long.mcap"])
    moved = run.records.copy()
    moved["reference"][:, :, 0] += 1e-4 * np.sin(0.01 * np.arange(len(moved)))[:, None]
    assert not len(replace(run, records=moved).motion)
    level = replace(run, records=moved, config={**run.config, "frame": "level"})
    running = np.flatnonzero(moved["mode"] == Mode.RUNNING)
    np.testing.assert_array_equal(level.motion, running)
    assert level.times[running[0]] == 0.0 and level.duration == run.duration


def test_what_was_written_of_a_run_is_taken_as_it_is(compared, folder):
    recorded, _, of_run, simulated = compared.runs
    told, summary = (json.loads((folder / name).read_text()) for name in ("long.json", "simulated.json"))
    for made in (recorded, of_run):
        assert made.figures["whole.estimation"] == pytest.approx(told["errors_m"]["estimation"], rel=1e-9)
        assert made.figures["whole.rotation"] == pytest.approx(told["errors_rad"]["estimation"], rel=1e-9)
        assert made.figures["whole.lengths"] == pytest.approx(told["errors_m"]["tracking"], rel=1e-9)
        assert made.figures["events"] == len(told["events"])
    assert of_run.figures["compute.p999"] == 1e-6 * told["timing_us"]["compute"]["p999"]
    assert of_run.figures["late.p50"] == 1e-6 * told["timing_us"]["wake"]["p50"]
    assert of_run.figures["missed_periods"] == sum(told[f"missed_{cause}"] for cause in ("own", "late", "host"))
    assert of_run.figures["protection.rotation_max"] == told["protection"]["rotation"]
    for group in ("estimation", "tracking"):
        for name, value in summary[group].items():
            assert simulated.figures[f"{group}.{name}"] == value
    assert simulated.figures["protection.position_p99"] == summary["protection"]["position_p99"]
    assert simulated.figures["target_stretch"] == summary["target_stretch"]
    assert (simulated.seconds, of_run.seconds) == (1.0, 1.0)
    assert of_run.course is None and simulated.course is None


def test_a_recording_without_a_missed_period_has_the_figures_of_its_simulation(folder):
    made = compare([folder / "long.mcap", folder / "simulated.json"])
    recorded, simulated = made.runs
    if recorded.figures["missed_periods"] or read(folder / "long.mcap").records["missed"].any():
        pytest.skip("the machine was too busy for the clock")
    for name in FIGURES:
        if name.startswith(("estimation", "tracking", "protection")):
            assert recorded.figures[name] == pytest.approx(simulated.figures[name], rel=1e-9), name


def test_what_differs_is_told_by_field(compared, folder):
    assert compared.differing() == {
        "target": ["sines", "circle", "sines", "sines"],
        "duration": [1.0, 0.6, 1.0, 1.0],
        "rate": [250.0, 500.0, 250.0, 250.0],
        "imu": ["mpu9150-calibrated", "ideal", "mpu9150-calibrated", "mpu9150-calibrated"],
        "seed": [0, 2, 0, 0],
        "fusion": ["compiled", "whole", "compiled", "compiled"],
    }
    older = json.loads((folder / "simulated.json").read_text())
    older["version"] = "0.1.0"
    del older["motion_s"], older["config"]["heave_period"]
    (folder / "older.json").write_text(json.dumps(older))
    made = compare([folder / "simulated.json", folder / "older.json"])
    assert [*made.differing()] == ["version"] and made.differing()["version"][1] == "0.1.0"
    assert made.difference(made.runs[1], "estimation.position_rms") == (0.0, 1.0)


def test_differences_and_ratios_are_to_the_reference(folder):
    made = compare([folder / "simulated.json", folder / "other.json"], folder / "other.json")
    reference, other = made.runs[1], made.runs[0]
    assert made.reference is reference and made.ordered == [reference, other]
    own, base = other.figures["estimation.position_max"], reference.figures["estimation.position_max"]
    assert made.difference(other, "estimation.position_max") == (own - base, own / base)
    assert made.difference(other, "late.p50") is None
    (row,) = [row for row in made.table().rows if row[0].text == "estimate - truth, position max [mm]"]
    assert [cell.text for cell in row[1:]] == [
        f"{1e3 * base:.4f}",
        f"{1e3 * own:.4f} ({1e3 * (own - base):+.4f}, x{own / base:.3g})",
    ]
    added = compare([folder / "simulated.json"], folder / "other.json")
    assert [each.source for each in added.runs] == [str(folder / "other.json"), str(folder / "simulated.json")]


def test_what_limits_the_comparison_is_said(compared, folder):
    # A busy machine may miss the last periods.
    told = re.fullmatch(
        r"recordings are compared over the (\S+) s of motion that all runs share; long\.mcap has (\S+) s", compared.remarks[0]
    )
    assert told and [*map(float, told.groups())] == pytest.approx([0.6, 1.0], abs=0.05)
    assert compared.remarks[1:] == (
        "the figures of long.json are of its whole motion of 1.000 s, and cannot be cut",
        "the figures of simulated.json are of its whole motion of 1.000 s, and cannot be cut",
        "the times, missed periods and protection level of long.json are of the whole run, with the hold",
    )
    mixed = compare([folder / "plane.mcap", folder / "short.mcap"])
    assert mixed.remarks[-1] == "the runs are of different mechanisms: the lengths of their legs are not compared"
    assert mixed.runs[0].course.lengths.shape[1] == 3
    for made in mixed.runs:
        for name in ("estimation.position_rms", "tracking.rotation_max"):
            assert 0.0 < made.figures[name] < 0.02


def test_the_joints_are_those_that_the_controller_assumed(folder):
    own, as_other = (compare([folder / "long.mcap", folder / "short.mcap"], None, name).runs[0] for name in (None, "6-3-I"))
    for name, value in own.figures.items():
        assert as_other.figures[name] == pytest.approx(value, rel=1e-6, abs=1e-10)
    with pytest.raises(InputError, match=r"long\.mcap is of a mechanism with 6 legs, and planar-3rpr has 3"):
        compare([folder / "long.mcap", folder / "short.mcap"], None, "planar-3rpr")


def test_the_files_of_one_recording_are_one_run(folder, tmp_path):
    shutil.copy(folder / "long.mcap", tmp_path / "again.mcap")
    whole = compare([folder / "long.mcap", folder / "short.mcap"])
    parts = compare([f"{folder / 'long.mcap'},{tmp_path / 'again.mcap'}", folder / "short.mcap"])
    assert parts.runs[0].figures == whole.runs[0].figures and parts.runs[0].events == whole.runs[0].events
    assert [run.name for run in parts.runs] == ["long.mcap", "short.mcap"]


def test_what_is_no_run_is_refused(folder, tmp_path):
    (tmp_path / "bench.json").write_text('{"version": "0.2.0", "stages_us": {}}')
    (tmp_path / "text.json").write_text("no JSON")
    (tmp_path / "list.json").write_text("[1, 2]")
    said = "is no run's: name what 'gough simulate --json' or 'gough run --json' has written, or a recording of 'gough run"
    for name in ("bench", "text", "list"):
        with pytest.raises(InputError, match=re.escape(f"{tmp_path / name}.json {said}")):
            compare([folder / "long.json", tmp_path / f"{name}.json"])
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    for path, words in (
        (tmp_path / "missing.mcap", "No such file"),
        (tmp_path, "Is a directory"),
        (tmp_path / "bytes", "not UTF-8"),
    ):
        with pytest.raises(InputError, match=re.escape(f"cannot read {path}: ") + f".*{words}"):
            compare([folder / "long.json", path])
    (tmp_path / "cut.mcap").write_bytes((folder / "long.mcap").read_bytes()[:100])
    with pytest.raises(RecordingError, match=r"cut\.mcap is no recording of gough"):
        compare([folder / "long.json", tmp_path / "cut.mcap"])


def test_one_run_alone_and_one_that_is_named_twice_are_refused(folder):
    with pytest.raises(InputError, match="needs two runs at least, and there is 1: name another file"):
        compare([folder / "long.json"])
    with pytest.raises(InputError, match=r"long\.json is named twice: name each run once"):
        compare([folder / "long.json", folder / "short.json", folder / "long.json"])


def test_a_run_that_has_not_moved_is_refused(folder, tmp_path):
    run(replace(LONG, arm=False, duration=0.1), SETTINGS, tmp_path / "dry.mcap")
    with pytest.raises(InputError, match=r"dry\.mcap has no motion: the run ended before it began; leave it out"):
        compare([folder / "long.json", tmp_path / "dry.mcap"])


def test_a_mechanism_s_file_may_have_moved(folder, tmp_path):
    mechanism = tmp_path / "mine.toml"
    mechanism.write_text('based_on = "hexapod"\n')
    run(replace(LONG, mechanism=str(mechanism), duration=0.2), SETTINGS, tmp_path / "mine.mcap")
    mechanism.unlink()
    with pytest.raises(InputError, match=r"the mechanism of the recording .*mine\.mcap: .*; name it with --mechanism"):
        compare([folder / "long.mcap", tmp_path / "mine.mcap"])
    assert compare([folder / "long.mcap", tmp_path / "mine.mcap"], None, "hexapod").seconds == pytest.approx(0.2)


@pytest.fixture(scope="module")
def commanded(folder, tmp_path_factory):
    made = tmp_path_factory.mktemp("page")
    outputs = ("--json", made / "out.json", "--report", made / "report.html")
    return gough("compare", "long.mcap", "short.mcap", "simulated.json", *outputs, cwd=folder), made


@NEEDS_PLOTLY
def test_the_command_prints_and_writes_what_was_found(commanded, compared, folder):
    finished, made = commanded
    assert finished.returncode == 0, finished.stderr
    written = json.loads((made / "out.json").read_text())
    expected = compare(["long.mcap", "short.mcap", "simulated.json"])
    assert written == json.loads(json.dumps(expected.summary()))
    assert written["runs"][1]["differences"]["estimation.position_rms"]["ratio"] == pytest.approx(
        written["runs"][1]["figures"]["estimation.position_rms"] / written["runs"][0]["figures"]["estimation.position_rms"]
    )
    for remark in expected.remarks:
        assert remark in finished.stdout
    assert "what differs: target, duration, rate, imu, seed, fusion\nall were run by gough" in finished.stdout
    assert f"{1e3 * expected.runs[0].figures['estimation.position_rms']:.4f}" in finished.stdout


@NEEDS_PLOTLY
def test_the_report_has_the_table_and_the_recordings_on_top_of_each_other(commanded, compared):
    page = (commanded[1] / "report.html").read_text()
    assert figures_in(page) == ["errors", "distribution", "times", "lengths"]
    body = page[page.index("<tbody>") : page.index("</tbody>")]
    for figure in FIGURES.values():
        assert f"<th>{figure.label}</th>" in body
    long, short = compared.runs[:2]
    for name, count in (("errors", 8), ("distribution", 8), ("times", 4)):
        assert [trace["name"] for trace in traces_of(page, name)] == ["long.mcap", "short.mcap"] * (count // 2)
    first, second = traces_of(page, "errors")[:2]
    assert (first["line"]["color"], second["line"]["color"]) == SERIES[:2]
    np.testing.assert_allclose(numbers(first["x"]), long.course.times, atol=1e-6)
    expected = 1e3 * np.linalg.norm(short.course.estimation[:, :3], axis=1)
    np.testing.assert_allclose(numbers(second["y"]), expected, rtol=1e-5, atol=1e-9)
    shares, below = numbers(traces_of(page, "distribution")[0]["x"]), numbers(traces_of(page, "distribution")[0]["y"])
    sizes = 1e3 * np.linalg.norm(long.course.estimation[:, :3], axis=1)
    assert np.interp(50.0, below, shares) == pytest.approx(np.median(sizes), rel=1e-3)
    legs = traces_of(page, "lengths")
    assert len(legs) == 18 and {trace["name"] for trace in legs} == {"reference", "long.mcap", "short.mcap"}
    np.testing.assert_allclose(numbers(legs[4]["y"]), 1e3 * long.course.lengths[:, 1], rtol=1e-6)


@NEEDS_PLOTLY
@pytest.mark.slow
def test_a_browser_draws_the_report_without_an_error(commanded):
    draw_in_browser(commanded[1] / "report.html", 4)


@NEEDS_PLOTLY
def test_figures_alone_and_two_mechanisms_have_fewer_plots(folder, tmp_path):
    page = tmp_path / "page.html"
    assert gough("compare", "simulated.json", "other.json", "--report", page, cwd=folder).returncode == 0
    assert figures_in(page.read_text()) == []
    assert "Figures alone have no course to draw" in page.read_text()
    assert gough("compare", "plane.mcap", "short.mcap", "--report", page, cwd=folder).returncode == 0
    assert figures_in(page.read_text()) == ["errors", "distribution", "times"]
    assert "The runs are of different mechanisms" in page.read_text()
    assert gough("compare", "plane.mcap", "plane.json", "--report", page, cwd=folder).returncode == 0
    assert len(traces_of(page.read_text(), "lengths")) == 6


def test_the_command_refuses_an_output_that_is_one_of_its_runs(folder, tmp_path):
    shutil.copy(folder / "simulated.json", tmp_path / "a.json")
    finished = gough("compare", "a.json", folder / "other.json", "--json", "a.json", cwd=tmp_path)
    assert finished.returncode == 2 and "named twice" in finished.stderr
    assert json.loads((tmp_path / "a.json").read_text())["truth_known"]
