"""What `gough classify` tells of a mechanism, and its report."""

import json

import numpy as np
import pytest

from controller.direct_kinematics import solve
from hil.command_line import main
from hil.reports.classification import write_report
from hil.studies.classification import describe
from plant.errors import InputError
from plant.mechanism import load_mechanism
from plant.mechanism.classification import draw_mechanism, planar_classes, spatial_classes
from plant.mechanism.planar import PlanarMechanism
from tests.controller.leg_geometry import leg_directions
from tests.hil.pages import figures_in

PRESETS = {
    "hexapod": "n-6", "6-3-I": "n-3-I", "6-3-II": "n-3-II", "6-4-I": "n-4-I", "6-4-II": "n-4-II", "6-5": "n-5",
    "genhexkins": "n-6", "planar-3rpr": "n-3",
}  # fmt: skip


@pytest.mark.parametrize(("name", "group"), PRESETS.items())
def test_every_preset_is_of_its_class(name, group):
    description = describe(load_mechanism(name))
    assert description.mechanism_class.group == group
    methods = {need.requirement.method: need for need in description.needs}
    assert ("section-3.1.1" in methods) == (group == "n-3-I")
    assert ("section-4" in methods) == (group in ("n-3-I", "n-3-II", "n-4-I", "n-4-II", "n-5"))
    for need in description.needs:
        assert 0.0 < need.worst <= np.median(need.conditionings) <= 1.0
        assert need.worst <= need.home <= 1.0
    if name == "planar-3rpr":
        assert [need.modes for need in description.needs] == [2, 1]
    else:
        assert {methods[name].requirement.fewest for name in ("up", "normal")} == {3}
        assert methods["section-5"].requirement.fewest == 2


def test_choices_of_legs_do_what_is_claimed():
    mechanism = load_mechanism("6-4-II")
    position, rotation = mechanism.home.position + [0.01, -0.02, 0.005], np.eye(3)
    directions = leg_directions(mechanism, position, rotation)
    needs = {need.requirement.method: need.requirement for need in describe(mechanism).needs}
    for legs in needs["legs"].choices:
        kept = np.full((6, 3), np.nan)
        kept[list(legs)] = directions[list(legs)]
        np.testing.assert_allclose(solve(mechanism, kept).position, position, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("mechanism_class", planar_classes(), ids=str)
def test_every_planar_class_is_described(mechanism_class):
    from plant.mechanism.classification import draw_planar_mechanism

    description = describe(draw_planar_mechanism(mechanism_class, np.random.default_rng(1)))
    assert description.mechanism_class == mechanism_class
    assert {need.requirement.fewest for need in description.needs} == {2, 3}


def test_a_mechanism_without_home_is_described_about_one():
    description = describe(draw_mechanism(spatial_classes()[20], np.random.default_rng(2)))
    assert description.mechanism_class == spatial_classes()[20]
    assert "about home" in description.where


def test_the_command_prints_writes_and_draws(tmp_path, capsys):
    report, figures = tmp_path / "report.html", tmp_path / "figures.json"
    assert main(["classify", "6-3-I", "--report", str(report), "--json", str(figures)]) == 0
    printed = capsys.readouterr().out
    assert "n-3-I.1" in printed
    assert "; its legs, from base joints below to platform joints above:" in printed
    assert "6 legs" in printed
    summary = json.loads(figures.read_text())
    assert summary["class"] == "n-3-I.1"
    assert [method["method"] for method in summary["methods"] if method["section"] == "3.1.1"] == ["section-3.1.1"]
    page = report.read_text(encoding="utf-8")
    assert figures_in(page) == ["graph", "mechanism", "conditioning"]


@pytest.mark.slow
def test_the_report_of_a_planar_mechanism_is_drawn(tmp_path):
    write_report(describe(load_mechanism("planar-3rpr")), tmp_path / "report.html")
    assert "2 assembly modes" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_what_is_in_no_class_is_refused():
    star = PlanarMechanism.from_legs([[0, 0], [1, 0], [0, 1]], [[0, 0], [0.1, 0], [0, 0.1]])
    assert describe(star).mechanism_class.label == "planar n-3.1"
    with pytest.raises(InputError, match="legs"):
        from plant.mechanism import Mechanism

        base = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
        platform = 0.1 * np.array([[1, 0, 0], [2, 0, 0], [3, 1, 0], [4, 1, 0], [5, 2, 0], [6, 0, 0.0]])
        describe(Mechanism.from_legs(base, platform))
