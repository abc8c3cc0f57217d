"""What `gough workspace` finds, prints and draws, as it is and changed."""

import json

import numpy as np
import pytest

from hil.studies.workspace import changed_mechanism
from plant.errors import InputError
from plant.mechanism import load_spatial
from tests.hil.commands import gough

FEW = ("--points", "9", "--geometry")


def test_a_change_shows_beside_the_mechanism_as_it_is(tmp_path):
    figures, picture = tmp_path / "figures.json", tmp_path / "slices.svg"
    done = gough("workspace", *FEW, "--set", "limits.stroke=[-0.03,0.03]", "--json", figures, "--picture", picture)
    assert done.returncode == 0, done.stderr
    assert "changed: limits.stroke=[-0.03,0.03]" in done.stdout and "stroke of leg" in done.stdout
    before, after = json.loads(figures.read_text())["workspaces"]
    assert (before["label"], after["label"]) == ("as it is", "changed")
    assert before["travels"]["+z"]["distance"] == pytest.approx(0.0664, abs=1e-4)
    assert after["travels"]["+z"]["distance"] < 0.6 * before["travels"]["+z"]["distance"]
    assert after["reach"]["volume"] == pytest.approx(before["reach"]["volume"] / 8.0, rel=0.1)
    assert after["margins"]["stroke of leg 0"] == pytest.approx(0.03)
    assert len(before["slices"]) == 4 and np.shape(before["slices"][0]["reachable"]) == (9, 9)
    drawn = picture.read_text()
    assert drawn.startswith("<svg") and drawn.count("as it is") == 4 and drawn.count(">changed<") == 4


def test_a_planar_mechanism_has_one_slice_and_an_area(tmp_path):
    figures = tmp_path / "figures.json"
    done = gough("workspace", "--mechanism", "planar-3rpr", *FEW, "--box", "1,1,0,0,0,1", "--json", figures)
    assert done.returncode == 0, done.stderr
    assert "cm2" in done.stdout and "dm3" not in done.stdout
    (found,) = json.loads(figures.read_text())["workspaces"]
    assert list(found["travels"]) == ["+x", "-x", "+y", "-y", "+rz", "-rz"] and len(found["slices"]) == 1


def test_a_report_has_tables_and_slices(tmp_path):
    report = tmp_path / "report.html"
    done = gough("workspace", *FEW, "--at", "10,0,350", "--turned", "0,0,5", "--report", report)
    assert done.returncode == 0, done.stderr
    text = report.read_text()
    assert "What ends straight moves" in text and "<svg" in text and "where hexapod can go" in text


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--set", "limits.stroke"), "is no ENTRY=VALUE such as"),
        (("--set", "limits.reach=3"), r"[limits] has no entry 'reach'"),
        (("--at", "1,2"), "argument --at: '1,2' is no X,Y,Z: give 3 numbers"),
        (("--at", "0,0,500"), "stroke of leg"),
        (("--points", "1"), "a slice has 1 points"),
        (("--box", "0,0,0,0,0,0"), "give sizes of at least 0"),
        (("--mechanism", "hexapot"), "neither a preset"),
    ],
)
def test_what_cannot_be_looked_at_is_refused_in_a_line(options, said):
    done = gough("workspace", *FEW, *options) if options[0] != "--points" else gough("workspace", *options)
    assert done.returncode == 2 and said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_rings_of_joints_are_moved_by_their_numbers():
    smaller = changed_mechanism("hexapod", ["geometry.platform_radius=0.1", "plant.payload.mass=4"])
    np.testing.assert_allclose(smaller.platform_joints, 0.5 * load_spatial("hexapod").platform_joints, atol=1e-12)
    assert smaller.plant["payload.mass"] == 4.0
    with pytest.raises(InputError, match="a radius is -1 m"):
        changed_mechanism("hexapod", ["geometry.platform_radius=-1"])
