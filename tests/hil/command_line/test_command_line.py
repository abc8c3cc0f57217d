"""The command `gough`: what it prints, writes and refuses."""

import json
import re
import subprocess
import sys
import zipfile
from argparse import Namespace
from pathlib import Path

import pytest

from hil import command_line
from tests.hil.commands import gough

HEADER = "time_s,x_m,y_m,z_m,qw,qx,qy,qz"
REST = "0,0,0,0,1,0,0,0"


def gough_as_users_run_it(*arguments, cwd=None):
    return subprocess.run(
        [sys.executable, "-m", "hil.command_line", *map(str, arguments)], capture_output=True, text=True, cwd=cwd, check=False
    )


def refused(run):
    """One clear line on the standard error, nothing on the output, status 2."""
    assert run.returncode == 2, run.stderr
    assert run.stdout == ""
    assert len(run.stderr.splitlines()) == 1
    assert "Traceback" not in run.stderr
    return run.stderr


@pytest.mark.parametrize(("option", "unit"), [("--speed", "mm/s"), ("--turn-speed", "deg/s")])
@pytest.mark.parametrize("value", ["nan", "inf", "-5", "0"])
def test_a_speed_that_is_none_is_refused_before_anything_moves(option, unit, value, capsys):
    assert command_line.main(["move", "home", option, value]) == 2
    assert f"{option} is {value} {unit}; it must be a positive number" in capsys.readouterr().err


@pytest.mark.slow
def test_a_motion_that_needs_more_memory_than_there_is_is_refused_in_a_line():
    limited = "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30)); "
    limited += "from hil.command_line import main; sys.exit(main(['simulate', '--duration', '1e6']))"
    run = subprocess.run([sys.executable, "-c", limited], capture_output=True, text=True, check=False)
    assert run.returncode == 1, run.stderr
    assert "choose a shorter duration, or a lower rate" in run.stderr and "Traceback" not in run.stderr


@pytest.mark.slow
def test_simulate_prints_a_summary_and_writes_its_figures(tmp_path):
    arguments = ("simulate", "--duration", 1, "--json", "figures.json", "--report", "report.html")
    run = gough_as_users_run_it(*arguments, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "RMS [mm]" in run.stdout and "times real time" in run.stdout
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["config"]["mechanism"] == "hexapod"
    assert figures["config"]["rate"] == 1000.0
    for group in ("estimation", "tracking", "target"):
        assert 0.0 < figures[group]["position_rms"] < 2e-3
        assert 0.0 < figures[group]["rotation_rms"] < 1e-2
    assert figures["limits"]["violations"] == 0
    assert figures["real_time_factor"] > 0.0
    assert set(figures["cycle_us"]) == {"p50", "p99", "p999"}
    assert figures["version"]
    assert "<html" in (tmp_path / "report.html").read_text()[:200].lower()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["figures.json", "report.html"]


def test_help_gives_units_and_defaults():
    text = gough("simulate", "--help").stdout
    for expected in ("[s]", "[Hz]", "default: 1000", "mpu9150-calibrated", "default: hexapod"):
        assert expected in text


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([REST, "1,0,0,0,1,0,0"], "line 3: .*not a row of 8 finite numbers: it has 7 numbers"),
        ([REST, "1,0,0,zero,1,0,0,0"], "line 3: .*not a row"),
        ([REST, "1,0,0,nan,1,0,0,0"], "line 3: .*not a row of 8 finite numbers: z_m is nan"),
        ([REST, "0,0,0,0,1,0,0,0"], "line 3: time 0 s does not come after 0 s"),
        ([REST, "1,0,0,0,1.01,0,0,0"], "line 3: the quaternion has length 1.01"),
        ([REST], "1 samples"),
        ([REST, "1,0.3,0,0,1,0,0,0"], r"stroke of leg \d would be .* mm at 0\.\d+ s, and must be at"),
    ],
)
def test_a_bad_target_is_one_clear_line(tmp_path, rows, said):
    path = tmp_path / "target.csv"
    path.write_text("\n".join([HEADER, *rows]))
    line = refused(gough("simulate", "--target", path, "--json", "figures.json", cwd=tmp_path))
    assert re.search(said, line), line
    assert [entry.name for entry in tmp_path.iterdir()] == ["target.csv"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--mechanism", "octopod"], "hexapod"),
        (["--target", "loop"], "circle"),
        (["--imu", "best"], "mpu9150"),
        (["--fusion", "best"], "filterpy"),
        (["--rate", "5"], "50 to 4000"),
        (["--rate", "fast"], "--rate"),
        (["--duration", "-1"], "-1"),
        (["--duration", "inf"], "inf"),
        (["--seed", "-1"], "-1"),
        (["--imus", "0,1"], "determine"),
        (["--imus", "some"], "some"),
        (["--plant", "missing.fmu"], "missing.fmu"),
        (["--json", "missing/figures.json"], "missing"),
        (["--report", "missing/report.html"], "missing"),
        (["--colour", "red"], "--colour"),
    ],
)
def test_bad_arguments_are_one_clear_line(tmp_path, arguments, said):
    assert said in refused(gough("simulate", *arguments, cwd=tmp_path))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name = [", "not valid TOML"),
        ("[geometry]\nbase_joints = [[1.0]]\nplatform_joints = [[1.0]]", "shape"),
        ("[geometry]\n", "base_joints"),
        ("[geometri]\n", "geometri"),
    ],
)
def test_a_bad_mechanism_is_one_clear_line(tmp_path, text, said):
    path = tmp_path / "mechanism.toml"
    path.write_text(text)
    assert said in refused(gough("simulate", "--mechanism", path))


def test_a_corrupt_fmu_and_one_that_lacks_a_variable_are_one_clear_line(tmp_path, fmu_path):
    corrupt = tmp_path / "corrupt.fmu"
    corrupt.write_bytes(fmu_path.read_bytes()[:2000])
    assert "corrupt.fmu" in refused(gough("simulate", "--plant", corrupt))
    poor = tmp_path / "poor.fmu"
    with zipfile.ZipFile(fmu_path) as whole, zipfile.ZipFile(poor, "w") as archive:
        for name in whole.namelist():
            data = whole.read(name)
            if name == "modelDescription.xml":
                data = data.replace(b'name="imu_specific_force"', b'name="imu_specific_forces"')
            archive.writestr(name, data)
    assert "has no variable 'imu_specific_force'; did you mean imu_specific_forces?" in refused(
        gough("simulate", "--plant", poor)
    )


@pytest.mark.slow
def test_fmu_build_writes_an_fmu_that_simulate_takes(tmp_path):
    run = gough("fmu", "build", "--output", "plant.fmu", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert Path(run.stdout.strip()).name == "plant.fmu"
    run = gough("simulate", "--plant", "plant.fmu", "--duration", "0.1", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "cannot write" in refused(gough("fmu", "build", "--output", "missing/plant.fmu", cwd=tmp_path))


@pytest.mark.slow
def test_tune_prints_gains_and_margins(tmp_path):
    outputs = ("--json", "gains.json", "--write", "tuned.toml", "--report", "tuned.html")
    run = gough("tune", "--poses", "3", "--delay", "1", "--crossover", "6", *outputs, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    for expected in (
        "proportional",
        "integral",
        "gain margin",
        "phase margin",
        "deg",
        "dB",
        "3 poses",
        "leg 5",
        "stable with rates",
    ):
        assert expected in run.stdout
    figures = json.loads((tmp_path / "gains.json").read_text())
    assert figures["margins"]["stable"]
    assert figures["margins"]["phase_deg"] >= 65.0
    assert figures["margins"]["crossover_hz"] == pytest.approx(6.0, rel=0.01)
    assert figures["delay"] == 1e-3 and len(figures["workspace"]) == 3
    assert "gains of hexapod" in (tmp_path / "tuned.html").read_text()
    run = gough("simulate", "--mechanism", "tuned.toml", "--duration", "0.1", "--json", "run.json", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    # With drives that follow exactly there is little to correct, and the gains are their own.
    run = gough(
        "tune", "--mechanism", "planar-3rpr", "--poses", "0", "--drives", "position", "--write", "tuned.toml", cwd=tmp_path
    )
    assert run.returncode == 0, run.stderr
    assert "position_proportional = " in (tmp_path / "tuned.toml").read_text()
    refused(gough("tune", "--rate", "0"))
    assert "at 1000 Hz it must be 0 to 32 ms" in refused(gough("tune", "--delay", "40"))
    assert "sensitivity is 0.5; it must be 1.05 to 10" in refused(gough("tune", "--sensitivity", "0.5"))


@pytest.mark.slow
def test_bench_prints_every_stage(tmp_path):
    run = gough("bench", "--only", "loop", "--duration", "0.5", "--json", "bench.json", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    figures = json.loads((tmp_path / "bench.json").read_text())
    for stage, percentiles in figures["stages_us"].items():
        assert stage in run.stdout
        assert 0.0 <= percentiles["p50"] <= percentiles["p99"] <= percentiles["p999"] <= percentiles["max"]
    assert figures["filterpy_slowdown"] > 1.0


def test_ctrl_c_while_an_extension_is_imported_is_an_interruption(monkeypatch, capsys):
    def interrupted(options):
        raise ImportError("initialization failed") from KeyboardInterrupt()

    monkeypatch.setattr(command_line, "parse", lambda arguments: Namespace(run=interrupted))
    assert command_line.main([]) == 130
    assert capsys.readouterr().err == "gough: interrupted\n"
