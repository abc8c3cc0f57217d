"""The report of a design of gains: what its page draws."""

from dataclasses import replace

import control
import numpy as np
import pytest

from controller.design.linear_loop import Setup
from controller.design.stability import Response, margins
from controller.design.tuning import Design, PoseMargins, Rule, workspace_poses
from controller.settings import ControlSettings
from hil.command_line import main
from hil.command_line.design import tuning_tables
from hil.reports.tuning import write_report
from plant.mechanism import load_in_space
from tests.hil.pages import draw_in_browser, figures_in, numbers, traces_of

RATE_HZ = 500.0


def integrators(speed, count):
    """Drives that integrate the command of the cycle before."""
    zero, one = np.zeros((count, count)), np.eye(count)
    a, b = np.block([[one, speed / RATE_HZ * one], [zero, zero]]), np.vstack([zero, one])
    return Response.of(control.ss(a, b, np.hstack([one, zero]), zero, 1.0 / RATE_HZ))


def design_of(name, count):
    mechanism, gains = load_in_space(name), ControlSettings(40.0, 100.0)
    responses = [integrators(speed, mechanism.legs) for speed in np.linspace(1.0, 1.5, 1 + count)]
    at_home, *others = (margins(response, gains) for response in responses)
    poses = workspace_poses(mechanism, count, seed=0)
    workspace = tuple(PoseMargins(*each) for each in zip(poses, others, strict=True))
    return Design(
        mechanism, Setup(RATE_HZ), Rule(), gains, at_home, workspace, gains, at_home, 120.0, 0.2, tuple(responses)
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count"), [pytest.param("hexapod", 4, marks=pytest.mark.slow), ("planar-3rpr", 3), ("hexapod", 0)]
)
def test_every_figure_is_there(name, count, tmp_path, recwarn):
    design = design_of(name, count)
    path = tmp_path / "page" / "report.html"
    path.parent.mkdir()
    write_report(design, tuning_tables(design), path)
    assert not recwarn.list
    page = path.read_text()
    assert figures_in(page) == ["bode", "nyquist", "steps", *(["maps"] if count else [])]
    assert "Stable with rates down to 120 Hz" in page
    legs, shown = design.mechanism.legs, 2 if count else 1
    gains, phases = traces_of(page, "bode")[0], traces_of(page, "bode")[1]
    crossing = np.interp(0.0, -numbers(gains["y"]), numbers(gains["x"]))
    assert crossing == pytest.approx(design.margins.crossover_hz, rel=0.01)
    phase = np.interp(crossing, numbers(phases["x"]), numbers(phases["y"]))
    assert 180.0 + phase == pytest.approx(design.margins.phase_deg, abs=0.5)
    assert len(traces_of(page, "bode")) == 2 * legs * shown
    steps = numbers(traces_of(page, "steps")[0]["y"])
    assert steps[0] == 0.0 and steps[-1] == pytest.approx(1.0, abs=0.01) and 1.0 < steps.max() < 1.3
    if count:
        first = traces_of(page, "maps")[0]
        moves = [1e3 * each.where(design.home)[0][0] for each in design.workspace]
        assert numbers(first["x"]) == pytest.approx(moves, abs=0.01)
        peaks = [each.margins.sensitivity_peak for each in design.workspace]
        assert numbers(first["marker"]["color"]) == pytest.approx(peaks, abs=1e-3)
        assert len(traces_of(page, "maps")) == 3 * (3 if legs == 6 else 2)
        draw_in_browser(path, 4)


def test_the_remark_tells_a_hold_that_is_too_short():
    design = replace(design_of("planar-3rpr", 0), hold=0.412)
    assert design.remark == (
        "stable with rates down to 120 Hz, and 0.41 s after the filters have begun, which is more than the 0.2 s for which "
        "the brakes hold: it takes hold = 0.42, which --write writes with the gains"
    )
    slow = replace(design, setup=replace(design.setup, rate=125.0), hold=1.3)
    assert "more than the 1 s for which the brakes hold: it takes hold = 1.3," in slow.remark
    assert slow.longer_hold == 1.3 and replace(slow, hold=1.0).longer_hold is None
    assert "50 Hz, the lowest that there is" in replace(design, lowest_rate=50.0).remark


@pytest.mark.parametrize(("hold", "told"), [(0.412, ": these gains, and hold = 0.42"), (0.2, ": these gains")])
def test_the_command_tells_what_it_wrote(tmp_path, monkeypatch, capsys, hold, told):
    design, path = replace(design_of("planar-3rpr", 0), hold=hold), tmp_path / "tuned.toml"
    monkeypatch.setattr("controller.design.tuning.tune", lambda *_: design)
    assert main(["tune", "--mechanism", "planar-3rpr", "--write", str(path)]) == 0
    assert capsys.readouterr().out.endswith(f"written to {path}{told}\n")
    assert ("hold = 0.42" in path.read_text()) == ("hold" in told)
