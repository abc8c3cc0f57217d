"""Sweeps: every point once, and on again after an end in the middle."""

import errno
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.engine.batches import Failure, attempt, no_kind
from hil.engine.engine import InOneProcess
from hil.runs.config import SimulationConfig
from hil.sweep.case import SentFile, cases_of
from hil.sweep.function import UserFunction
from hil.sweep.store import Store
from hil.sweep.study import Factor, Study
from hil.sweep.sweep import SweepResult, estimate, run_study
from plant.errors import InputError, MissingPackageError, ToolchainError, UnreachableError

CALLS: list[float] = []


def counted(x: float, y: float) -> dict[str, float]:
    CALLS.append(x)
    if x == y == 2.0:
        raise UnreachableError("two and two")
    return {"sum": x + y, "product": x * y}


@pytest.fixture
def study() -> Iterator[Study]:
    CALLS.clear()
    function = UserFunction("counted", "the text", "here", counted)
    yield Study((Factor("x", (1.0, 2.0, 3.0)), Factor("y", (1.0, 2.0))), model=function)


def run(study: Study, folder: Path) -> SweepResult:
    return run_study(study, folder, InOneProcess())


def test_every_point_is_a_row_in_the_study_s_order(study: Study, tmp_path: Path) -> None:
    result = run(study, tmp_path / "results")
    rows = result.table.to_pylist()
    assert [(row["x"], row["y"]) for row in rows] == [(1, 1), (1, 2), (2, 1), (2, 2), (3, 1), (3, 2)]
    assert [row["sum"] for row in rows] == [2, 3, 3, None, 4, 5]
    assert (result.ran, result.failed) == (6, 1)
    assert [row["status"] for row in rows] == ["done"] * 3 + ["failed"] + ["done"] * 2
    assert result.first_reason == rows[3]["reason"] == "two and two"


def test_nothing_is_done_twice(study: Study, tmp_path: Path) -> None:
    first = run(study, tmp_path)
    again = run(study, tmp_path)
    assert len(CALLS) == 6
    assert again.ran == 0
    assert again.table.equals(first.table)


ERRORS: dict[float, Exception] = {}


def raising(x: float) -> float:
    CALLS.append(x)
    if x in ERRORS:
        raise ERRORS[x]
    return x


def test_what_a_run_says_is_kept_and_what_its_machine_lacks_is_tried_again(tmp_path: Path) -> None:
    CALLS.clear()
    errors = [
        UnreachableError("too far"), ModuleNotFoundError("no such module"), MemoryError(), OSError("no space left"),
        MissingPackageError("a package"), ToolchainError("no compiler"),
    ]  # fmt: skip
    ERRORS.update(enumerate(errors))
    study = Study((Factor("x", tuple(range(len(errors) + 1))),), model=UserFunction("raising", "the text", "here", raising))
    first = run(study, tmp_path)
    assert first.table["status"].to_pylist() == ["failed"] + ["error"] * (len(errors) - 1) + ["done"]
    assert estimate(replace(study, factors=(Factor("x", (6, 1)),)), tmp_path).known == 1
    ERRORS.clear()
    CALLS.clear()
    assert run(study, tmp_path).table["status"].to_pylist() == ["failed"] + ["done"] * len(errors)
    assert CALLS == [1, 2, 3, 4, 5]


def test_a_disk_that_is_full_for_a_file_is_no_fault_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "own.toml"
    own.write_text('based_on = "hexapod"\n')
    study = Study((Factor("run.seed", (0,)),), run=SimulationConfig(mechanism=str(own), target="hold", duration=0.1))
    (tmp_path / "cache" / "files").mkdir(parents=True)
    monkeypatch.setenv("GOUGH_CACHE", str(tmp_path / "cache"))
    (case,) = cases_of(study)
    (tmp_path / "cache" / "files" / case.files[0].digest).mkdir()
    for blocked in (True, False):
        with monkeypatch.context() as patch:
            if blocked:
                patch.setattr("plant.files.tempfile.NamedTemporaryFile", no_space)
            outcome = attempt(SentFile.local, case.files[0])
        assert isinstance(outcome, Failure) == blocked
        if isinstance(outcome, Failure):
            assert outcome.again and "No space left" in outcome.reason


def no_space(**_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_it_goes_on_where_it_was_interrupted(study: Study, tmp_path: Path) -> None:
    def interrupt(share: float, label: str) -> None:
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(study, tmp_path, InOneProcess(), interrupt)
    assert len(Store(tmp_path).table()) == 4
    result = run(study, tmp_path)
    assert len(CALLS) == 6
    assert (len(result.table), result.ran) == (6, 2)


def test_whoever_waits_is_told_that_runs_are_prepared(study: Study, tmp_path: Path) -> None:
    told: list[tuple[float, int]] = []
    run_study(study, tmp_path, InOneProcess(), lambda share, label: told.append((share, len(CALLS))))
    assert told[:6] == [(0.0, 0)] * 6
    assert told[-1] == (1.0, 6)


def test_a_study_that_grows_runs_what_is_new(study: Study, tmp_path: Path) -> None:
    run(study, tmp_path)
    larger = Study((Factor("x", (1.0, 2.0, 3.0, 4.0)), Factor("y", (1.0, 2.0))), model=study.model)
    assert run(larger, tmp_path).ran == 2
    smaller = Study((Factor("x", (4.0,)), Factor("y", (2.0,))), model=study.model)
    result = run(smaller, tmp_path)
    assert (result.ran, result.table["product"].to_pylist()) == (0, [8.0])


SHORT = SimulationConfig(target="sines", duration=0.1, rate=250.0)
SEEDS = Factor("run.seed", (0, 1))


def test_a_study_that_grows_by_a_factor_has_its_values_in_the_rows_that_are_there(tmp_path: Path) -> None:
    run(Study((SEEDS,), run=SHORT), tmp_path)
    larger = Study((SEEDS, Factor("run.imu", ("mpu9150-calibrated", "icm42688"))), run=SHORT)
    result = run(larger, tmp_path)
    assert result.ran == 2
    assert result.table["run.imu"].to_pylist() == ["mpu9150-calibrated", "icm42688"] * 2
    assert [level.runs for level in result.analysis.levels("estimation.position_rms", larger.factors[1])] == [2, 2]
    cube = result.dataset()["estimation.position_rms"]
    assert float(cube.sel({"run.seed": 0, "run.imu": "mpu9150-calibrated"})) == float(
        run(Study((SEEDS,), run=SHORT), tmp_path).table["estimation.position_rms"][0].as_py()
    )


@pytest.mark.slow
def test_factors_and_figures_of_other_studies_are_no_figures_of_this_one(tmp_path: Path) -> None:
    many = (
        SEEDS,
        Factor("run.imu", ("mpu9150-calibrated",)),
        Factor("run.rate", (250.0,)),
        Factor("plant.payload.mass", (10.0,)),
    )
    run(Study(many, run=SHORT, function=UserFunction.of(cycles)), tmp_path)
    run(Study((SEEDS,), run=SHORT, function=UserFunction.of(half)), tmp_path)
    few = Study(many[:1] + many[3:], run=SHORT, function=UserFunction.of(cycles))
    result = run(few, tmp_path)
    assert result.ran == 0
    assert result.figures() == ["cycles"]
    assert result.summary()["figures"].keys() == {"cycles"}
    assert {"run.imu", "run.rate", "half"}.isdisjoint(result.table.column_names)
    assert "geometry.reach" in run(replace(few, figures=("geometry.reach",)), tmp_path).analysis.names()


def cycles(result: Any) -> int:
    return len(result.records)


def half(result: Any) -> float:
    return len(result.records) / 2


def test_a_figure_has_no_name_of_a_factor(tmp_path: Path) -> None:
    study = Study((SEEDS,), run=SHORT, function=UserFunction("named", "the text", "here", lambda result: {"run.imu": 1.0}))
    assert "'run.imu' has the name of a factor" in run(study, tmp_path).first_reason


def test_a_factor_of_another_kind_is_told_before_anything_runs(study: Study, tmp_path: Path) -> None:
    run(study, tmp_path)
    CALLS.clear()
    with pytest.raises(InputError, match=r"x.*give another folder"):
        run(replace(study, factors=(Factor("x", ("a", "b")), Factor("y", (1.0, 2.0)))), tmp_path)
    assert CALLS == []
    assert run(study, tmp_path).ran == 0


def test_rows_that_come_slowly_are_written_as_they_come(study: Study, tmp_path: Path) -> None:
    class Two(InOneProcess):
        """Two long runs end at once."""

        def run(self, function, items, kind=no_kind):
            time.sleep(0.4)
            for number, outcome in super().run(function, items, kind):
                yield number, outcome
                written.append(len(Store(tmp_path).table()))

    written: list[int] = []
    run_study(replace(study, factors=(Factor("x", (1.0, 3.0)), Factor("y", (1.0,)))), tmp_path, Two())
    assert written == [1, 2]


def test_values_of_numpy_are_those_of_a_table(study: Study, tmp_path: Path) -> None:
    result = run(replace(study, factors=(Factor("x", np.linspace(3.0, 4.0, 2)), Factor("y", tuple(np.arange(2))))), tmp_path)
    assert result.table["sum"].to_pylist() == [3.0, 4.0, 4.0, 5.0]


def test_the_same_run_at_two_points_is_done_once(tmp_path: Path) -> None:
    study = Study((Factor("run.imus", ("all", "0,1,2,3,4,5,6")),))
    assert study.size == 2
    assert estimate(study, tmp_path).points == 1


def test_an_estimate_counts_what_is_there(study: Study, tmp_path: Path) -> None:
    before = estimate(study, tmp_path)
    assert (before.points, before.known) == (6, 0)
    assert before.seconds >= 0.0
    run(study, tmp_path)
    assert estimate(study, tmp_path).known == 6
    assert before.total(2) == 6 * before.seconds / 2


def test_the_table_is_for_pandas_and_xarray(study: Study, tmp_path: Path) -> None:
    result = run(study, tmp_path)
    frame = result.frame()
    assert frame["product"].sum() == 1 + 2 + 2 + 3 + 6
    cube = result.dataset()
    assert float(cube["sum"].sel(x=3.0, y=2.0)) == 5.0
    assert dict(cube.sizes) == {"x": 3, "y": 2}
