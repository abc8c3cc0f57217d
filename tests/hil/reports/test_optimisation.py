"""The report of an optimisation: what its page draws, for one objective and for several."""

import gc

import numpy as np
import pytest

from hil.engine.engine import InOneProcess
from hil.reports.optimisation import write_report
from hil.sweep.design import Constraint, Design, Objective, Search
from hil.sweep.function import UserFunction
from hil.sweep.optimisation import RUN, optimise
from hil.sweep.study import Factor, Study
from hil.sweep.trials import Comparison
from tests.hil.pages import draw_in_browser, figures_in, numbers, traces_of


def model(x: float, y: float, kind: str) -> dict[str, float]:
    if x > 3.5:
        raise ValueError("too far")
    bonus = 0.1 if kind == "good" else 0.0
    return {"a": x**2 + y**2 - bonus, "b": -((x - 2.0) ** 2) - y**2, "c": x, "d": -x}


def result_of(objectives, tmp_path):
    factors = (Factor("x", low=-4.0, high=4.0), Factor("y", low=-1.0, high=1.0), Factor("kind", ("good", "bad")))
    study = Study(factors, model=UserFunction("model", "the text", "here", model))
    design = Design(study, objectives, (Constraint("c", least=-3.0),), Search(trials=60, batch=12))
    return optimise(design, tmp_path / "results", InOneProcess())


@pytest.mark.slow
@pytest.mark.parametrize(
    "objectives",
    [
        pytest.param((Objective("a"),), marks=pytest.mark.slow),
        (Objective("a"), Objective("b", "maximise")),
        pytest.param((Objective("a"), Objective("b", "maximise"), Objective("c")), marks=pytest.mark.slow),
        pytest.param((Objective("a"), Objective("b", "maximise"), Objective("c"), Objective("d")), marks=pytest.mark.slow),
    ],
    ids=len,
)
def test_every_figure_is_there(objectives, tmp_path, recwarn):
    # Files that earlier tests left open are told when they are collected.
    gc.collect()
    recwarn.clear()
    result = result_of(objectives, tmp_path)
    path = tmp_path / "page" / "report.html"
    path.parent.mkdir()
    comparison = Comparison("a", {"run.target": "circle"}, 2.0, 1.0, 3, 4)
    write_report(result, result.knee, [comparison], path)
    assert [str(each.message) for each in recwarn] == []
    page = path.read_text()
    assert figures_in(page) == ["front", "trials", "history", *(f"importance{n}" for n in range(len(objectives)))]
    assert "3 of 4" in page and "least -3.0" in page
    draw_in_browser(path, 3 + len(objectives))


def test_the_front_is_drawn_with_the_chosen_one(tmp_path):
    result = result_of((Objective("a"), Objective("b", "maximise")), tmp_path)
    path = tmp_path / "report.html"
    write_report(result, result.knee, [], path)
    traces = traces_of(path.read_text(), "front")

    def drawn(trace):
        points = [numbers(at) if isinstance(at, dict) else np.array(at, float) for at in (trace["x"], trace["y"])]
        return sorted(np.stack(points, axis=1).tolist())

    kept = [trial for trial in result.trials if trial.state == RUN and trial not in result.front]
    expected = [sorted(result.objectives_of(trials).tolist()) for trials in (kept, result.front, [result.knee])]
    assert [drawn(trace) for trace in traces] == expected
