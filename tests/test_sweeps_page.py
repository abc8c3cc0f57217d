"""What docs/sweeps.md shows must run, and its tables must be those of the source."""

import contextlib
import re
import runpy
import shlex
from dataclasses import fields
from pathlib import Path

import pandas as pd
import pytest

from hil.command_line import parse
from hil.runs.config import SimulationConfig
from hil.sweep.names import run_fields
from hil.sweep.store import KEY, REASON, STATUS
from hil.sweep.study import METHODS, Sampling, read_study
from tests.hil.commands import gough

DOCS = Path(__file__).parent.parent / "docs"
PAGE = (DOCS / "sweeps.md").read_text()
EXAMPLES = dict(re.findall(r"<!-- example: (\S+) -->\n```\w+\n(.*?)```", PAGE, re.DOTALL))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the results of the example."""
    made = tmp_path_factory.mktemp("page")
    for name, text in EXAMPLES.items():
        (made / name).write_text(text)
    finished = gough("sweep", "study.toml", "--workers", 1, cwd=made)
    assert finished.returncode == 0, finished.stderr
    assert "24 runs, 24 of them new" in finished.stdout
    assert re.search(r"estimation\.position_rms \[mm\] +0\.\d+ ", finished.stdout) and re.search(
        r"^ peak ", finished.stdout, re.M
    )
    return made


@pytest.mark.slow
def test_the_example_reads_its_table_and_goes_on(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with contextlib.chdir(folder):
        runpy.run_path("read.py", run_name="__main__")
        assert "mpu9150-calibrated  0.5" in capsys.readouterr().out
        names = runpy.run_path("again.py", run_name="__main__")
    assert names["result"].ran == 0
    assert dict(names["cube"].sizes) == {"sample": 3, "run.imu": 2, "run.joint_error": 2, "run.seed": 2}
    assert names["cube"]["run.imu"].values.tolist() == ["mpu9150-calibrated", "icm42688"]
    assert set(names["cube"].coords) > {"mechanism.control.proportional", "plant.payload.mass"}
    point = names["cube"].isel({"sample": 2, "run.seed": 1, "run.imu": 0, "run.joint_error": 1})
    frame = names["result"].frame()
    row = frame[frame["plant.payload.mass"] == float(point["plant.payload.mass"])]
    row = row[(row["run.seed"] == 1) & (row["run.imu"] == "mpu9150-calibrated") & (row["run.joint_error"] == 2e-4)]
    assert row["peak"].tolist() == [float(point["peak"])]


@pytest.mark.slow
def test_the_columns_are_those_of_the_page(folder: Path) -> None:
    columns = pd.read_parquet(folder / "study.results" / "runs.parquet").columns
    section = PAGE[PAGE.index("| column |") : PAGE.index("In Python:")]
    for name in re.findall(r"^\| `([\w.]+)`", section, re.MULTILINE):
        assert name in columns
    assert {KEY, STATUS, REASON} <= set(re.findall(r"`(\w+)`", section))


def test_the_fields_of_a_run_and_their_defaults_are_those_of_the_source() -> None:
    section = PAGE[PAGE.index("| field |") : PAGE.index("A field that does not exist")]
    rows = dict(re.findall(r"^\| `(\w+)` \|.*\| (.*?) \|$", section, re.MULTILINE))
    assert rows.keys() == run_fields().keys()
    defaults = {each.name: each.default for each in fields(SimulationConfig)}
    for name, shown in rows.items():
        default = defaults[name]
        if default is None or default == ():
            assert shown in ("none", "the built one", "that of the mechanism")
        elif isinstance(default, bool | int | float):
            assert shown == f"{default:g}" or shown == str(default).lower()
        else:
            assert shown == ("`all`" if name == "imus" else f"`{default}`")


def test_the_keys_of_a_study_are_those_of_the_source() -> None:
    section = PAGE[PAGE.index("| key |") : PAGE.index("A factor in")]
    sampling = dict(re.findall(r"^\| `sampling\.(\w+)` \|.*\| (.*?) \|$", section, re.MULTILINE))
    assert {name: value.strip("`") for name, value in sampling.items()} == {
        each.name: str(each.default) for each in fields(Sampling)
    }
    assert all(f"`{method}`" in section for method in METHODS)


def test_the_commands_of_the_page_exist() -> None:
    commands = re.findall(r"^gough (.*?)(?: {2,}#.*)?$", PAGE, re.MULTILINE)
    assert len(commands) >= 3
    for command in commands:
        parse(shlex.split(command))


def test_the_study_of_imus_is_the_one_whose_figures_are_shown() -> None:
    study = read_study(DOCS / "studies" / "imu_grade.toml")
    assert f"{study.size} runs" in PAGE
    picture = (DOCS / "imu_grade.svg").read_text()
    for factor in study.factors[:3]:
        assert factor.name in PAGE and factor.name in picture
    for name in study.figures:
        assert name in PAGE and name in picture
