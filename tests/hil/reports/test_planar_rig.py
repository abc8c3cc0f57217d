"""The report of a planar rig: what a browser would draw is read back from the file."""

import re

import numpy as np
import pytest

from hil.reports.planar_rig import write_report
from hil.studies.planar_rig import SOURCES, evaluate
from plant.errors import InputError
from tests.hil.pages import draw_in_browser, figures_in, numbers, traces_of
from tests.hil.planar_rig import BASE, joints_at, leg_degrees, load_rig, write_two_poses


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("poses")
    write_two_poses(folder)
    return evaluate(folder, load_rig())


@pytest.fixture
def report(result, tmp_path):
    path = tmp_path / "report" / "report.html"
    path.parent.mkdir()
    write_report(result, path)
    return path


def test_the_report_is_complete_in_itself_and_has_the_figures(report, result):
    page = report.read_text(encoding="utf-8")
    assert figures_in(page) == ["errors", "modes"]
    assert list(report.parent.iterdir()) == [report]
    assert "gough: planar-3rpr at 2 known poses" in page and "80 samples of each source" in page

    summary = result.summary()
    cells = re.findall(r"<td>(.*?)</td>", page[page.index("<tbody>") : page.index("</tbody>")])
    for row, figures in zip(np.reshape(cells, (3, 7)), summary["sources"].values(), strict=True):
        x, y, angle = figures["rms"].values()
        shown = [1e3 * x, 1e3 * y, *np.degrees([angle, *figures["leg_angles"].values()])]
        np.testing.assert_allclose(row[:5].astype(float), shown, atol=0.00501)
        assert row[5:].tolist() == ["2 of 2", "100.0 %"]


def test_the_report_draws_the_errors_and_both_modes(report, result):
    page = report.read_text(encoding="utf-8")
    errors = traces_of(page, "errors")
    assert [trace["name"] for trace in errors] == 3 * list(SOURCES)
    kalman, complementary = ([numbers(trace["y"]) for trace in errors if trace["name"] == name] for name in SOURCES[1:])
    np.testing.assert_allclose(kalman, [[2.0, 2.0], [-3.0, -3.0], [4.0, 4.0]], atol=1e-9)
    bars = [numbers(trace["error_y"]["array"]) for trace in errors if trace["name"] == "complementary"]
    deviations = [
        [figures["standard_deviation"][name] for name in ("x", "y", "angle")]
        for figures in result.summary()["sources"]["complementary"]["poses"].values()
    ]
    np.testing.assert_allclose(np.transpose(bars), deviations * np.array([1e3, 1e3, np.degrees(1.0)]), rtol=1e-6)
    assert np.shape(complementary) == (3, 2)

    modes = traces_of(page, "modes")
    assert [trace["name"] for trace in modes] == 2 * ["true pose", "mode nearest to it", "other mode"]
    for k, pose in enumerate(np.array([(107.0, 192.0, -5.0), (84.0, 217.0, -20.0)])):
        true, nearest, other = (
            np.column_stack([numbers(trace["x"]), numbers(trace["y"])]) for trace in modes[3 * k : 3 * k + 3]
        )
        for drawn, at in ((true, pose), (nearest, pose + [2.0, -3.0, 4.0])):
            np.testing.assert_allclose(drawn[[0, 3, 6]], BASE, atol=1e-9)
            np.testing.assert_allclose(drawn[[1, 4, 7]], joints_at(at), atol=1e-6)
            np.testing.assert_allclose(drawn[9:], joints_at(at)[[0, 1, 2, 0]], atol=1e-6)
        legs = other[[1, 4, 7]] - BASE
        np.testing.assert_allclose(np.degrees(np.arctan2(*legs.T[::-1])), leg_degrees(pose + [2.0, -3.0, 4.0]), atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(np.diff(other[9:], axis=0), axis=1), [70.0, 30.0, 100.0], atol=1e-6)
        assert np.linalg.norm(other[1] - nearest[1]) > 10.0


@pytest.mark.slow
def test_a_browser_draws_the_report_without_an_error(report):
    draw_in_browser(report, 2)


def test_a_report_that_cannot_be_written_is_refused(result, tmp_path):
    path = tmp_path / "missing" / "report.html"
    with pytest.raises(InputError, match=re.escape(str(path))):
        write_report(result, path)
