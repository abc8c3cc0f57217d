"""The report of a simulation: what a browser would draw is read back from the file."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from hil.look import REFERENCE_COLOR, TRUTH_COLOR
from hil.reports.run import write_report
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from plant.errors import InputError
from plant.pose import pose_errors, rotation_angle, rotation_from_vector
from plant.truth import TRUTH_CURRENTS, TRUTH_LENGTHS
from tests.hil.pages import draw_in_browser, figures_in, json_after, numbers, traces_of, widths_in_browser

CURVES = {"pose": 12, "errors": 12, "lengths": 12, "motion": 12, "drives": 18, "protection": 4}
FIGURES = ["mechanism", *CURVES]


@pytest.fixture(scope="module")
def result():
    return simulate(SimulationConfig(target="circle", duration=1.0, rate=4000.0))


@pytest.fixture(scope="module")
def report(result, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(result, path)
    return path


@pytest.fixture(scope="module")
def page(report):
    return report.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def traces(page):
    return {name: traces_of(page, name) for name in FIGURES}


def points(trace):
    return np.stack([numbers(trace[axis]) for axis in "xyz"], axis=1)


def curves(traces, name):
    return [(numbers(trace["x"]), numbers(trace["y"])) for trace in traces if trace["name"] == name]


def test_the_file_is_complete_in_itself_and_small(report, page):
    figures_in(page)
    assert report.stat().st_size < 8e6
    assert list(report.parent.iterdir()) == [report]


def test_every_figure_is_there_once(page, traces):
    assert figures_in(page) == FIGURES
    assert page.count("<figcaption>") == len(FIGURES)
    assert "poses in real time, or as fast as the browser draws them" in page
    assert {name: len(traces[name]) for name in CURVES} == CURVES


def test_the_header_says_what_was_simulated(page, result):
    header = page[page.index("<header>") : page.index("</header>")]
    version = result.summary()["version"]
    for part in ("gough: hexapod follows circle", "1 s", "4000 Hz", "mpu9150-calibrated", "seed 0", "compiled", version):
        assert part in header


def test_the_table_has_the_figures_of_the_summary(page, result):
    summary = result.summary()
    body = page[page.index("<tbody>") : page.index("</tbody>")]
    rows = (("estimation", ""), ("tracking", ""), ("target", ""), ("target", "reference_"))
    columns = (("position_rms", 1e3), ("position_max", 1e3), ("rotation_rms", 180 / np.pi), ("rotation_max", 180 / np.pi))
    expected = [[summary[group][prefix + key] * unit for key, unit in columns] for group, prefix in rows]
    table = np.array(re.findall(r"<td>(.*?)</td>", body), dtype=float).reshape(4, 4)
    np.testing.assert_allclose(table, expected, rtol=0.0, atol=0.501e-3)
    violations, factor, cycle = re.findall(r"<dd[^>]*>(.*?)</dd>", page)
    assert int(violations) == summary["limits"]["violations"]
    assert float(factor) == pytest.approx(summary["real_time_factor"], abs=0.0501)
    assert [float(value) for value in cycle.split("/")] == pytest.approx(list(summary["cycle_us"].values()), abs=0.0501)


def test_curves_are_thinned_but_keep_their_extremes(traces, result):
    records = result.records
    panels = (
        1e3 * (records["truth"][:, TRUTH_LENGTHS] - records["reference"][:, :, 0]),
        1e3 * records["command"],
        records["truth"][:, TRUTH_CURRENTS],
    )
    for leg in range(6):
        for (times, drawn), values in zip(curves(traces["drives"], f"leg {leg}"), panels, strict=True):
            assert len(drawn) <= 4000 < len(values)
            assert (np.diff(times) > 0.0).all()
            expected = values[np.searchsorted(result.times, times - 1e-5), leg]
            np.testing.assert_allclose(drawn, expected, rtol=1e-6, atol=1e-9)
            assert (drawn.min(), drawn.max()) == pytest.approx((values[:, leg].min(), values[:, leg].max()), rel=1e-6)


def test_the_pose_is_drawn_from_home_in_mm_and_deg(traces, result):
    home = result.mechanism.require_home()
    moment = len(result.times) - 500
    position, vector = np.transpose(
        [[np.interp(result.times[moment], *curve) for curve in curves(traces["pose"], axis)] for axis in "xyz"]
    )
    np.testing.assert_allclose(position, 1e3 * (result.true_positions[moment] - home.position), atol=1e-3)
    assert np.linalg.norm(vector) > 1.0
    drawn = rotation_from_vector(np.radians(vector)) @ home.rotation
    assert rotation_angle(drawn, result.true_rotations[moment]) < 1e-5


def test_the_errors_are_estimate_less_truth_and_truth_less_reference(traces, result):
    truth = (result.true_positions, result.true_rotations)
    estimate = (result.records["position"], result.records["rotation"])
    planned = (result.reference_positions, result.reference_rotations)
    for i, axis in enumerate("xyz"):
        panels = curves(traces["errors"], axis)
        for (times, drawn), part, unit, (poses, origins) in zip(
            panels,
            (0, 0, 3, 3),
            (1e3, 1e3, np.degrees(1.0), np.degrees(1.0)),
            [(estimate, truth), (truth, planned)] * 2,
            strict=True,
        ):
            moments = np.searchsorted(result.times, times - 1e-5)[::200]
            for moment, value in zip(moments, drawn[::200], strict=True):
                error = pose_errors(poses[0][moment], poses[1][moment], origins[0][moment], origins[1][moment])
                assert value == pytest.approx(unit * error[part + i], rel=1e-5, abs=1e-6)


@pytest.fixture(scope="module")
def frames(page):
    return json_after(page, "Plotly.addFrames('mechanism',")


def moments_of(result, frames):
    return np.linspace(np.argmax(result.times >= 0.0), len(result.times) - 1, len(frames)).astype(int)


def test_the_mechanism_moves_on_legs_of_the_estimated_length(traces, result, frames):
    assert 20 <= len(frames) <= 150
    for number, (frame, moment) in enumerate(zip(frames, moments_of(result, frames), strict=True)):
        assert frame["name"] == str(number)
        assert [part["type"] for part in frame["data"]] == [traces["mechanism"][k]["type"] for k in frame["traces"]]
        tubes, rods = points(frame["data"][2]), points(frame["data"][3])
        np.testing.assert_allclose(tubes[0::3], 1e3 * result.mechanism.base_joints, atol=1e-4)
        np.testing.assert_array_equal(tubes[1::3], rods[0::3])
        lengths = np.linalg.norm(rods[1::3] - tubes[0::3], axis=1)
        np.testing.assert_allclose(lengths, 1e3 * result.records["lengths"][moment], atol=1e-2)


def test_the_ghosts_are_the_reference_in_blue_and_the_truth_in_red(traces, result, frames):
    poses = {
        REFERENCE_COLOR: (result.reference_positions, result.reference_rotations),
        TRUTH_COLOR: (result.true_positions, result.true_rotations),
    }
    for frame, moment in zip(frames, moments_of(result, frames), strict=True):
        for number, (color, (positions, rotations)) in zip((5, 6), poses.items(), strict=True):
            assert traces["mechanism"][number]["line"]["color"] == color
            joints = 1e3 * (positions[moment] + result.mechanism.platform_joints @ rotations[moment].T)
            rim = points(frame["data"][number])
            assert len(rim) == 7
            assert all(np.abs(rim - joint).max(axis=1).min() < 1e-2 for joint in joints)


def test_the_legs_are_coloured_by_what_the_menu_names(page, traces, result, frames):
    tubes = [2, 7, 8]
    limits = result.mechanism.require_limits()
    for frame, moment in zip(frames, moments_of(result, frames), strict=True):
        record = result.records[moment]
        expected = (
            np.abs(2.0 * (record["lengths"] - limits.stroke[:, 0]) / np.ptp(limits.stroke, axis=1) - 1.0),
            np.abs(record["reference"][:, 1]) / limits.velocity,
            np.zeros(6),
        )
        for number, shares in zip(tubes, expected, strict=True):
            drawn = numbers(frame["data"][number]["line"]["color"])
            np.testing.assert_allclose(drawn, np.repeat(shares, 3), atol=1e-3)
            np.testing.assert_array_equal(points(frame["data"][number]), points(frame["data"][2]))
    assert [traces["mechanism"][number].get("visible", True) for number in tubes] == [True, False, False]
    buttons = {}
    for label, number in zip(("stroke", "speed", "IMUs"), tubes, strict=True):
        start = page.index(f'"label":"legs by {label}"')
        (text,) = re.findall(r'"args":(\[.*?\]\}?,\[[\d,]+\]\])', page[start - 200 : start + 20])[-1:]
        buttons[label] = json.loads(text)
        assert buttons[label] == [{"visible": [each == number for each in tubes]}, tubes]


@pytest.mark.slow
def test_a_browser_draws_every_figure_without_an_error(report):
    draw_in_browser(report, len(FIGURES))


@pytest.mark.slow
def test_names_are_escaped_and_a_stop_is_told(result, tmp_path):
    path = tmp_path / "report.html"
    config = replace(result.config, duration=2.0)
    write_report(replace(result, mechanism=replace(result.mechanism, name="<b>&"), config=config), path)
    header = re.search(r"<header>.*</header>", path.read_text(encoding="utf-8"))[0]
    assert "<h1>gough: &lt;b&gt;&amp; follows circle</h1>" in header
    assert "2 s, stopped after 1.000 s" in header


@pytest.mark.slow
def test_a_file_that_cannot_be_written_is_refused(result, tmp_path):
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "missing" / "report.html", tmp_path / "folder"):
        with pytest.raises(InputError, match=re.escape(str(path))):
            write_report(result, path)
    assert [file.name for file in tmp_path.iterdir()] == ["folder"]


@pytest.mark.slow
@pytest.mark.parametrize("width", [320, pytest.param(420, marks=pytest.mark.endurance)])
def test_in_a_narrow_window_nothing_is_beyond_its_edge(report, width):
    takes, has = widths_in_browser(report, width)
    assert takes <= has <= width
