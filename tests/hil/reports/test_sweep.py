"""The report and the picture of a sweep: what a browser would draw is read back from the files."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html import escape

import numpy as np
import pytest

from hil.engine.engine import InOneProcess
from hil.reports.sweep import write_report
from hil.reports.sweep_picture import picture_svg, write_picture
from hil.sweep.function import UserFunction
from hil.sweep.study import Factor, Sampling, Study
from hil.sweep.sweep import SweepResult, run_study
from plant.errors import InputError
from tests.hil.pages import draw_in_browser, figures_in, json_after, numbers, traces_of

SEED = Factor("seed", tuple(range(6)))


def crossed_law(grade, rate, seed):
    """Positions [m] and rotations [rad]; one grade fails at one rate."""
    if grade == "bad" and rate == 500.0:
        raise ValueError("the <bad> one & its rate")
    random = np.random.default_rng(seed)
    size = {"good": 1e-4, "bad": 3e-4}[grade]
    return {"position_rms": size + 1e-5 * random.normal(), "rotation_rms": size * 1e3 / rate + 1e-2 * random.uniform()}


def failing(**factors):
    raise ValueError("nothing works")


def made(folder, law, *factors, figures=(), **sampling) -> SweepResult:
    study = Study(factors, model=UserFunction("law", law.__name__, "here", law), sampling=Sampling(**sampling), figures=figures)
    return run_study(replace(study, name="grade <1> & rate"), folder, InOneProcess())


@pytest.fixture(scope="module")
def crossed(tmp_path_factory):
    factors = (Factor("grade", ("good", "bad")), Factor("rate", (250.0, 500.0, 1000.0)), SEED)
    return made(tmp_path_factory.mktemp("crossed"), crossed_law, *factors)


@pytest.fixture(scope="module")
def sampled(tmp_path_factory):
    def law(kind, **at):
        return {
            "y": sum((n + 1.0) * value for n, value in enumerate(at.values())) * (2.0 if kind == "b" else 1.0),
            "z": at["p0"],
        }

    ranges = (Factor(f"p{number}", (), 1.0, 2.0, logarithmic=number == 3) for number in range(11))
    return made(tmp_path_factory.mktemp("sampled"), law, Factor("kind", ("a", "b")), *ranges, method="saltelli", count=16)


def written(result, folder):
    path = folder / "report.html"
    write_report(result, path)
    return path, path.read_text(encoding="utf-8")


@pytest.mark.slow
def test_every_part_is_there_once_and_drawn(crossed, tmp_path):
    path, page = written(crossed, tmp_path)
    assert figures_in(page) == ["distributions", "effects0", "effects1", "pairs"]
    assert path.stat().st_size < 8e6
    draw_in_browser(path, 4)


@pytest.mark.slow
def test_a_dozen_factors_are_drawn(sampled, tmp_path):
    path, page = written(sampled, tmp_path)
    assert figures_in(page) == ["distributions", "effects0", "effects1", "shares", "sobol0", "sobol1", "pairs"]
    assert len([trace for trace in traces_of(page, "effects0") if trace["mode"] == "markers+lines"]) == 11
    draw_in_browser(path, 7)


@pytest.mark.slow
def test_one_factor_is_enough_and_all_runs_may_fail(tmp_path):
    one = made(tmp_path / "one", lambda x: 2.0 * x, Factor("x", (1.0, 2.0)))
    path, page = written(one, tmp_path)
    assert figures_in(page) == ["distributions", "effects0"]
    draw_in_browser(path, 2)
    _, page = written(made(tmp_path / "seeds", lambda seed: float(seed), SEED), tmp_path)
    assert figures_in(page) == ["distributions"]
    _, page = written(made(tmp_path / "failed", failing, Factor("x", (1.0, 2.0))), tmp_path)
    assert figures_in(page) == []
    assert "ValueError: nothing works" in page and "2 of 2 runs have no figures" in page


def test_the_distributions_are_those_of_the_runs_in_mm_and_deg(crossed, tmp_path):
    _, page = written(crossed, tmp_path)
    frame = crossed.frame()
    for name, scale, axes in (("position_rms", 1e3, "x"), ("rotation_rms", np.degrees(1.0), "x2")):
        for trace in traces_of(page, "distributions"):
            if trace["xaxis"] == axes and trace["name"] in ("good", "bad"):
                values = np.sort(scale * frame[frame.grade == trace["name"]][name].dropna().to_numpy())
                np.testing.assert_allclose(numbers(trace["x"])[1:], values, rtol=1e-12)
                np.testing.assert_allclose(numbers(trace["y"]), np.arange(len(values) + 1) / len(values) * 100.0)
    assert page.count("position_rms [mm]") > 2 and page.count("rotation_rms [deg]") > 2


def test_one_choice_of_the_distributions_is_seen(crossed, tmp_path):
    _, page = written(crossed, tmp_path)
    traces = traces_of(page, "distributions")
    assert {trace["name"] for trace in traces if trace["visible"]} == {"good", "bad"}
    menu = json_after(page, '"updatemenus":')[0]
    assert [button["label"] for button in menu["buttons"]] == ["all runs", "grade", "rate"]
    for button, names in zip(menu["buttons"], ({"all runs"}, {"good", "bad"}, {"250", "500", "1000"}), strict=True):
        (visible,) = (args["visible"] for args in button["args"])
        assert {trace["name"] for trace, seen in zip(traces, visible, strict=True) if seen} == names


def test_means_and_their_differences_are_those_of_the_analysis(crossed, tmp_path):
    _, page = written(crossed, tmp_path)
    (means,) = (trace for trace in traces_of(page, "effects0") if trace.get("error_y") and trace["xaxis"] == "x2")
    levels = crossed.analysis.levels("position_rms", crossed.study.factors[1])
    assert means["y"] == pytest.approx([1e3 * level.mean.value for level in levels])
    halves = [1e3 * (level.difference.high - level.difference.value) for level in levels]
    assert means["error_y"]["array"] == pytest.approx(halves)
    assert means["x"] == [0.0, 1.0, 2.0]


def test_shares_and_indices_are_drawn(sampled, tmp_path):
    _, page = written(sampled, tmp_path)
    shares = sampled.analysis.shares("y")
    drawn = {
        trace["name"]: numbers(trace["x"])[0] if isinstance(trace["x"], dict) else trace["x"][0]
        for trace in traces_of(page, "shares")
    }
    assert {name: drawn[name] for name in shares} == pytest.approx({name: 100.0 * share for name, share in shares.items()})
    assert sum(drawn.values()) == pytest.approx(100.0)
    indices = sampled.analysis.sensitivities("y")
    first, total = (trace for trace in traces_of(page, "sobol0") if trace["xaxis"] == "x")
    assert (first["name"], total["name"]) == ("first order", "total")
    assert first["x"] == pytest.approx([each.first.value for each in indices[:11]])
    assert total["error_x"]["array"] == pytest.approx([each.total.high - each.total.value for each in indices[:11]])


def test_failures_are_listed_with_their_reason_and_first_point(crossed, tmp_path):
    _, page = written(crossed, tmp_path)
    assert re.search(r"<th>ValueError: the &lt;bad&gt; one &amp; its rate</th><td>6</td><td>error</td>", page)
    assert "grade = bad, rate = 500.0, seed = 0" in page
    assert f"<h1>gough: {escape('grade <1> & rate')}</h1>" in page


def test_indices_that_are_not_there_are_explained(tmp_path):
    def law(p):
        if p > 1.5:
            raise ValueError("too large")
        return p

    result = made(tmp_path / "results", law, Factor("p", (), 1.0, 2.0), method="saltelli", count=4)
    _, page = written(result, tmp_path)
    assert re.search(r"Sobol indices need law of all 12 runs, and \d+ lack it", page)


def marks(svg):
    """The dots of a picture, by colour."""
    found = {}
    for circle in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}circle"):
        if circle.get("r") == "4":
            found.setdefault(circle.get("fill"), []).append((float(circle.get("cx")), float(circle.get("cy"))))
    return found


def test_the_picture_has_the_medians_on_its_scale(crossed, tmp_path):
    path = tmp_path / "picture.svg"
    write_picture(crossed, path)
    svg = path.read_text()
    assert svg == f"{picture_svg(crossed)}\n"
    texts = [
        (float(each.get("y")), each.text)
        for each in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")
        if each.get("y")
    ]
    scale = [(y, float(text)) for y, text in texts if re.fullmatch(r"0(\.\d+)?", text)]
    height, unit = np.polyfit([value for _, value in scale if _ < 240], [y - 4.0 for y, _ in scale if y < 240], 1)
    good, bad = marks(svg).values()
    frame = crossed.frame()
    for rate, (_, y) in zip((250.0, 500.0, 1000.0), good[:3], strict=True):
        median = 1e3 * frame[(frame.grade == "good") & (frame.rate == rate)].position_rms.median()
        assert y == pytest.approx(height * median + unit, abs=0.2)
    assert (len(good), len(bad)) == (6, 4)
    assert "position_rms [mm]" in svg and "rotation_rms [deg]" in svg and "rate; dots" in svg


def test_a_third_factor_makes_columns_and_too_many_values_are_refused(sampled, tmp_path):
    assert len(marks(picture_svg(sampled))) == 2
    many = made(tmp_path / "many", lambda x: x, Factor("x", tuple(map(float, range(9)))))
    with pytest.raises(InputError, match="x has 9 values, and a picture shows at most 6"):
        picture_svg(many)
    failed = made(tmp_path / "failed", failing, Factor("x", (1.0, 2.0)))
    with pytest.raises(InputError, match="a picture needs a figure"):
        write_picture(failed, tmp_path / "picture.svg")
