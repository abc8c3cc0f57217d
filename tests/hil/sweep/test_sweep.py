"""Sweeps: every point once, and on again after an end in the middle."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from hil.engine.engine import InOneProcess
from hil.sweep.function import UserFunction
from hil.sweep.store import Store
from hil.sweep.study import Factor, Study
from hil.sweep.sweep import SweepResult, estimate, run_study

CALLS: list[float] = []


def counted(x: float, y: float) -> dict[str, float]:
    CALLS.append(x)
    if x == y == 2.0:
        raise ValueError("two and two")
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
    assert result.first_reason == rows[3]["reason"] == "ValueError: two and two"


def test_nothing_is_done_twice(study: Study, tmp_path: Path) -> None:
    first = run(study, tmp_path)
    again = run(study, tmp_path)
    assert len(CALLS) == 6
    assert again.ran == 0
    assert again.table.equals(first.table)


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


def test_a_study_that_grows_runs_what_is_new(study: Study, tmp_path: Path) -> None:
    run(study, tmp_path)
    larger = Study((Factor("x", (1.0, 2.0, 3.0, 4.0)), Factor("y", (1.0, 2.0))), model=study.model)
    assert run(larger, tmp_path).ran == 2
    smaller = Study((Factor("x", (4.0,)), Factor("y", (2.0,))), model=study.model)
    result = run(smaller, tmp_path)
    assert (result.ran, result.table["product"].to_pylist()) == (0, [8.0])


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
