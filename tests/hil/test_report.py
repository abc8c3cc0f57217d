"""The report of a simulation: one file that opens offline and says what the summary says."""

import re
import shutil
import subprocess

import numpy as np
import pytest

from hil.report import write_report
from hil.simulation import SimulationConfig, simulate
from plant.errors import InputError


@pytest.fixture(scope="module")
def result():
    return simulate(SimulationConfig(duration=1.0))


@pytest.fixture(scope="module")
def page(result, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(result, path)
    assert [entry.name for entry in path.parent.iterdir()] == ["report.html"]
    return path


def test_nothing_is_loaded_from_elsewhere(page):
    text = page.read_text()
    assert not re.search(r"<(script|link|img|iframe)[^>]*\b(src|href)\s*=", text)
    assert len(text) < 8e6


def test_the_drawing_library_is_there_once(page):
    assert len(re.findall(r"plotly\.js v\d", page.read_text())) == 1


def test_the_figures_of_the_summary_are_shown(result, page):
    text = page.read_text()
    assert f"gough: {result.mechanism.name} follows {result.target.name}" in text
    summary = result.summary()
    for group in ("estimation", "tracking", "target"):
        assert f"{1e3 * summary[group]['position_rms']:.3f}" in text
        assert f"{np.degrees(summary[group]['rotation_rms']):.3f}" in text


def test_every_signal_has_its_axes(page):
    text = page.read_text()
    for label in ("position [mm]", "rotation vector [deg]", "command [mm", "motor current [A]", "speed [mm", "leg 5 [mm]"):
        assert label in text, label


def test_the_mechanism_moves(page):
    frames = re.search(r"addFrames\(\s*'[\w-]+',\s*\[(.*)", page.read_text())
    assert frames, "no animation frames"


def test_a_browser_draws_every_figure_without_an_error(page):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if not browser:
        pytest.skip("no browser here")
    flags = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-component-update"
    run = subprocess.run(
        [browser, *flags.split(), "--virtual-time-budget=10000", f"--user-data-dir={page.parent / 'profile'}", "--dump-dom",
         f"file://{page}"], capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    drawn = re.findall(r'class="[^"]*js-plotly-plot', run.stdout)
    assert len(drawn) >= 6, run.stderr[-2000:]
    assert "Uncaught" not in run.stderr


def test_a_file_that_cannot_be_written_is_named(result, tmp_path):
    with pytest.raises(InputError, match="missing"):
        write_report(result, tmp_path / "missing" / "report.html")
