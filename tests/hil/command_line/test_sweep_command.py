"""`gough sweep`: what it prints and writes, on real processes, and what it says when something is wrong."""

import json
import re
from pathlib import Path

import pytest

from tests.hil.commands import gough

ISHIGAMI = """
from math import sin

def ishigami(x1, x2, x3):
    return sin(x1) + 7.0 * sin(x2) ** 2 + 0.1 * x3**4 * sin(x1)
"""
FUNCTIONS = """
def raises(x):
    raise ValueError(f"{x} is bad\\nand a second line")

def text(x):
    return "fast"

def empty(x):
    return {}

def infinite(x):
    return float("inf")

def clashes(x):
    return {"x": 1.0}

def half(x):
    if x > 1.5:
        raise RuntimeError("too large")
    return {"position_rms": x, "slope": 2.0 * x}

def two(x, y):
    return 1.0
"""
RANGE = "{ from = -3.141592653589793, to = 3.141592653589793 }"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "functions.py").write_text(FUNCTIONS)
    (tmp_path / "ishigami.py").write_text(ISHIGAMI)
    return tmp_path


def sweep(folder: Path, text: str, *options: object, workers: int = 1):
    (folder / "study.toml").write_text(text)
    page = ("--dashboard", "127.0.0.1:0") if workers > 1 else ()
    return gough("sweep", "study.toml", "--workers", workers, *page, *options, cwd=folder)


def of_model(name: str, more: str = "") -> str:
    return f'model = "functions.py:{name}"\n[vary]\nx = [1.0, 2.0]\n{more}'


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_the_indices_of_ishigami_by_two_processes(folder: Path, seed: int) -> None:
    """First-order indices 0.314, 0.442 and 0, total ones 0.558, 0.442 and 0.244 (Ishigami and Homma 1990)."""
    ranges = "".join(f"x{number} = {RANGE}\n" for number in (1, 2, 3))
    sampling = f'[sampling]\nmethod = "saltelli"\ncount = 1024\nseed = {seed}\n'
    study = f'name = "Ishigami"\nmodel = "ishigami.py:ishigami"\n[vary]\n{ranges}{sampling}'
    finished = sweep(folder, study, "--json", "figures.json", workers=2)
    assert finished.returncode == 0, finished.stderr
    assert "5120 runs, 5120 of them new, in study.results/runs.parquet" in finished.stdout
    figures = json.loads((folder / "figures.json").read_text())
    indices = figures["figures"]["ishigami"]["sensitivities"]
    assert [each["factor"] for each in indices] == ["x1", "x2", "x3"]
    assert [each["first"]["value"] for each in indices] == pytest.approx([0.314, 0.442, 0.0], abs=0.03)
    assert [each["total"]["value"] for each in indices] == pytest.approx([0.558, 0.442, 0.244], abs=0.03)
    for each in indices:
        printed = rf"{each['factor']} +{each['first']['value']:.3f} +± \S+ +{each['total']['value']:.3f} +±"
        assert re.search(printed, finished.stdout)
    again = sweep(folder, study)
    assert "5120 runs, 0 of them new" in again.stdout
    assert again.stdout.partition("5120")[0] == finished.stdout.partition("5120")[0]


@pytest.mark.slow
def test_runs_are_printed_in_mm_and_deg_and_a_dry_run_counts_them(folder: Path) -> None:
    study = (
        '[run]\nduration = 0.5\n[vary]\nrun.imu = ["ideal", "mpu9150-calibrated"]\nrun.joint_error = [0.0, 1e-4]\n'
        "run.seed = { seeds = 2 }\n"
    )
    dry = sweep(folder, study, "--dry-run", "--json", "dry.json")
    assert re.match(
        r"8 runs, of which 0 are in study.results already; a run takes \S+ s on this machine: .* with 1 worker\n", dry.stdout
    )
    assert json.loads((folder / "dry.json").read_text()).keys() >= {"points", "known", "seconds", "total_seconds", "version"}
    outputs = ("--json", "out.json", "--report", "out.html", "--picture", "out.svg")
    finished = sweep(folder, study, *outputs)
    assert (finished.returncode, finished.stderr) == (0, "")
    figures = json.loads((folder / "out.json").read_text())
    assert (figures["runs"], figures["new"], figures["failed"]) == (8, 8, 0)
    position = figures["figures"]["estimation.position_rms"]
    half = position["all"]["quantiles"][0]["value"]
    assert re.search(rf"estimation\.position_rms \[mm\] +{1e3 * half:.3g} ", finished.stdout)
    ideal, real = position["by_factor"]["run.imu"]
    assert (ideal["value"], real["value"], ideal["runs"]) == ("ideal", "mpu9150-calibrated", 4)
    assert ideal["mean"]["value"] < real["mean"]["value"]
    assert sum(position["shares"].values()) == pytest.approx(1.0)
    assert "run.joint_error [mm]" in finished.stdout and re.search(r"^   ?0\.1 ", finished.stdout, re.MULTILINE)
    assert (folder / "out.svg").read_text().startswith("<svg")
    assert "gough: study" in (folder / "out.html").read_text()
    assert "8 runs, of which 8 are in" in sweep(folder, study, "--dry-run").stdout


def test_a_run_that_fails_is_a_row_and_status_1(folder: Path) -> None:
    finished = sweep(folder, of_model("half"))
    assert finished.returncode == 1
    assert finished.stderr == "1 of 2 runs failed; why the first one did: RuntimeError: too large\n"
    assert re.search(r"position_rms \[mm\] +1000 ", finished.stdout)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("raises", "ValueError: 1.0 is bad"),
        ("text", "text returned 'fast': it must return a number, or numbers by name"),
        ("empty", "empty returned {}: it must return"),
        ("clashes", "the figure 'x' has the name of a factor"),
    ],
)
def test_functions_that_give_no_figure_say_so_in_one_line(folder: Path, name: str, said: str) -> None:
    finished = sweep(folder, of_model(name), "--report", "failed.html", "--json", "failed.json")
    assert finished.returncode == 1
    assert finished.stderr.startswith(f"2 of 2 runs failed; why the first one did: {said}")
    assert finished.stderr.count("\n") == 1
    assert finished.stdout == "2 runs, 2 of them new, in study.results/runs.parquet\n"
    assert said in (folder / "failed.html").read_text().replace("&#x27;", "'")


def test_a_figure_without_a_finite_number_is_named(folder: Path) -> None:
    finished = sweep(folder, of_model("infinite"))
    assert (finished.returncode, finished.stderr) == (0, "")
    assert "infinite: no run has a finite number\n" in finished.stdout


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (of_model("half", '[measure]\nfigures = ["positon_rms"]\n'), "no run has the figure 'positon_rms'; did you mean"),
        (of_model("two"), "two does not take the factors x: missing a required argument: 'y'"),
        (of_model("nothing"), "functions.py has no function 'nothing'"),
        ('[run]\ntarget = "motion.csv"\n[vary]\nrun.seed = [1]\n', "no target 'motion.csv'"),
        ('[vary]\nrun.target = ["circle", "cirle"]\n', "did you mean 'circle'?"),
        ('[vary]\nrun.imu = ["mpu9151"]\n', "no IMU preset 'mpu9151'"),
        ('[vary]\nrun.calibration = ["rig.toml"]\n', "calibration = 'rig.toml': there is no such file"),
        ('[vary]\nrun.mechanism = ["octopod"]\n', "no mechanism 'octopod'"),
        ("[vary]\nmechanism.control.proportinal = [1.0]\n", "did you mean 'proportional'?"),
        ("[vary]\nmechanism.contrl.proportional = [1.0]\n", "did you mean 'control'?"),
        ("[vary]\nplant.payload.mas = [1.0]\n", "no parameter or input 'payload.mas'; did you mean 'payload.mass'?"),
        ("[mechanism.plant.payload]\nmas = 1.0\n[vary]\nrun.seed = [1]\n", "did you mean 'payload.mass'?"),
        ("[vary\n", "not valid TOML"),
    ],
)  # fmt: skip
def test_a_wrong_study_is_refused_in_one_line(folder: Path, text: str, said: str) -> None:
    finished = sweep(folder, text)
    assert finished.returncode == 2
    assert said in finished.stderr
    assert finished.stderr.startswith("gough: ") and finished.stderr.count("\n") == 1
    assert finished.stdout == ""


def test_a_study_that_is_not_there_and_outputs_that_cannot_be_written_are_refused(folder: Path) -> None:
    missing = gough("sweep", "nowhere.toml", cwd=folder)
    assert (missing.returncode, missing.stderr) == (2, "gough: cannot read nowhere.toml: No such file or directory\n")
    for option in ("--json", "--report", "--picture"):
        refused = sweep(folder, of_model("half"), option, "no/such.file")
        assert refused.returncode == 2 and "cannot write no/such.file" in refused.stderr
        assert not (folder / "study.results").exists()
    kept = sweep(folder, of_model("half"), "--json", "study.toml")
    assert kept.returncode == 2 and "study.toml is named twice" in kept.stderr
    assert (folder / "study.toml").read_text() == of_model("half")


def test_a_picture_of_too_many_values_is_refused_before_anything_runs(folder: Path) -> None:
    finished = sweep(folder, 'model = "functions.py:half"\n[vary]\nx = [0, 1, 2, 3, 4, 5, 6]\n', "--picture", "out.svg")
    assert finished.returncode == 2 and not (folder / "study.results").exists()
    assert "x has 7 values, and a picture shows at most 6: take a report" in finished.stderr


def test_a_dry_run_says_why_the_first_run_fails(folder: Path) -> None:
    finished = sweep(folder, of_model("raises"), "--dry-run")
    assert finished.returncode == 2
    assert finished.stderr == "gough: the first run fails: ValueError: 1.0 is bad\n"


def test_a_picture_of_nothing_is_refused(folder: Path) -> None:
    finished = sweep(folder, of_model("raises"), "--picture", "out.svg")
    assert finished.returncode == 2
    assert "a picture needs a figure of a run" in finished.stderr
