"""`gough frames`: what it changes in a file, what it shows, and what it refuses."""

import json

import numpy as np
import pytest

from controller.frames import load_frames
from hil.command_line import main

CELL = """
work = "table"

[frames.table]
parent = "base"
position = [0.02, -0.01, 0.3]
angles_deg = [0.0, 0.0, 90.0]

[frames.corner]
parent = "table"
position = [0.1, 0.0, 0.0]

[frames.needle]
parent = "platform"
position = [0.0, 0.0, 0.11]
"""


@pytest.fixture
def cell(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(CELL)
    return path


def frames(capsys, *line):
    """Exit status, output and errors of a command."""
    status = main(["frames", *map(str, line)])
    return (status, *capsys.readouterr())


def refused(capsys, cell, *line):
    before = cell.read_text()
    status, _, said = frames(capsys, *line)
    assert status == 2 and said.count("\n") == 1 and cell.read_text() == before
    return said


def test_a_file_is_made_and_changed_from_the_command_line(tmp_path, capsys):
    path = tmp_path / "new.toml"
    assert frames(capsys, "set", path, "table", "--parent", "base", "--position", "0,0,0.3", "--angles", "0,0,90")[0] == 0
    assert frames(capsys, "set", path, "tip", "--parent", "platform", "--position", "0,0,0.1", "--note", "of the pen")[0] == 0
    assert frames(capsys, "set", path, "table", "--quaternion", "1,0,0,0")[0] == 0
    assert frames(capsys, "enable", path, "table")[1] == "a target is platform in table\n"
    assert frames(capsys, "enable", path, "tip")[1] == "a target is tip in table\n"
    assert frames(capsys, "set", path, "pivot", "--parent", "tip", "--position", "0,0,0.01")[0] == 0
    made = load_frames(path)
    np.testing.assert_array_equal(made.place("table").rotation, np.eye(3))
    np.testing.assert_array_equal(made.place("table").position, [0.0, 0.0, 0.3])
    assert (made.work, made.tool, made.pivot.parent, made.frames["tip"].note) == ("table", "tip", "tip", "of the pen")
    status, shown, _ = frames(capsys, "list", path)
    assert status == 0 and "turns are about the pivot, 0, 0, 10 mm in tip" in shown and "a target is tip in table" in shown
    assert frames(capsys, "remove", path, "pivot")[0] == 0
    assert "about the origin of tip" in frames(capsys, "list", path)[1]


def test_the_list_has_every_frame_with_what_depends_on_it(cell, capsys):
    _, shown, _ = frames(capsys, "list", cell)
    lines = {line.split()[0]: line for line in shown.splitlines() if line.strip()}
    assert {"base", "table", "corner", "level", "platform", "needle"} < set(lines)
    assert "work, enabled" in lines["table"] and "corner" in lines["table"] and "20, -10, 300" in lines["table"]
    assert "tool, enabled" in lines["platform"] and "needle" in lines["platform"]


def test_a_frame_is_shown_in_each_that_it_stands_on_and_now(cell, tmp_path, capsys):
    path = tmp_path / "needle.json"
    status, shown, _ = frames(capsys, "show", cell, "needle", "--pose", "0,0,0.35", "--json", path)
    assert status == 0 and "needle on platform; a tool frame; depends on it: nothing" in shown
    poses = json.loads(path.read_text())["poses"]
    np.testing.assert_allclose(poses["now in base"]["position"], [0.0, 0.0, 0.46])
    np.testing.assert_allclose(poses["now in table"]["position"], [0.01, 0.02, 0.16], atol=1e-15)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(poses["now in table"]["quaternion"], [half, 0.0, 0.0, -half], atol=1e-15)
    turned = frames(capsys, "show", cell, "corner", "--json", path)[1]
    assert "corner on table on base" in turned
    np.testing.assert_allclose(json.loads(path.read_text())["poses"]["in base"]["position"], [0.02, 0.09, 0.3])


def test_here_is_zero(cell, capsys):
    said = frames(capsys, "zero", cell, "here", "--parent", "table", "--home", "hexapod")[1]
    assert said == "here is at 10, 20, 50 mm in table, turned by 0, 0, -90 deg\n"
    assert frames(capsys, "enable", cell, "here")[0] == 0
    assert frames(capsys, "zero", cell, "needle", "--pose", "0,0,0.4,1,0,0,0", "--keep-axes")[0] == 0
    np.testing.assert_allclose(load_frames(cell).place("needle").position, [0.0, 0.0, -0.05], atol=1e-15)


def test_a_level_frame_is_measured_with_the_attitude_of_the_base(cell, capsys):
    half = np.sqrt(0.5)
    line = ["zero", cell, "deck", "--parent", "level", "--pose", "0,0,0.4", "--attitude", f"{half},{half},0,0"]
    assert frames(capsys, *line)[1] == "deck is at 0, -400, 0 mm in level, turned by 90, 0, 0 deg\n"
    shown = frames(capsys, "show", cell, "deck", "--pose", "0,0,0.4", "--attitude", f"{half},{half},0,0")[1]
    assert "0, 0, 400" in shown


def test_a_frame_is_linked_with_its_numbers_or_in_its_place(cell, capsys):
    assert frames(capsys, "link", cell, "corner", "base", "--keep-place")[0] == 0
    np.testing.assert_allclose(load_frames(cell).place("corner").position, [0.02, 0.09, 0.3])
    assert frames(capsys, "link", cell, "corner", "table")[0] == 0
    np.testing.assert_allclose(load_frames(cell).place("corner").position, [-0.07, 0.01, 0.6], atol=1e-15)
    assert frames(capsys, "remove", cell, "corner")[0] == 0


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (["link", "table", "corner"], "'table' cannot stand on 'corner', which stands on 'table': link 'corner' to another"),
        (["link", "corner", "tabel"], "no frame 'tabel'; there are base, level, platform, table, corner, needle; did you mean"),
        (["remove", "table"], "'table' cannot be removed: corner stands on it, it is enabled; change that first"),
        (["enable", "neddle"], "no frame 'neddle'"),
        (["set", "base", "--position", "0,0,1"], "'base' is always there and cannot be changed"),
        (["set", "base", "--parent", "level"], "'base' is always there and cannot be changed"),
        (["set", "new", "--position", "0,0,1"], "there is no frame 'new' yet: say what it stands on with --parent"),
        (["set", "table", "--position", "0,0"], "--position must have shape (3,), got (2,)"),
        (["set", "table", "--position", "0,zero,0"], "--position is '0,zero,0'; it must be 3 numbers with commas in between"),
        (["set", "table", "--position", "0,0,300"], "at most 10 m will do: give metres"),
        (["set", "table", "--angles", "0,0,1", "--quaternion", "1,0,0,0"], "--angles and --quaternion both turn the frame"),
        (["set", "pivot", "--angles", "0,0,1"], "the pivot is a point: give --parent and --position alone"),
        (["set", "pivot", "--parent", "level"], "the pivot stands on level, and the work frame 'table' on base"),
        (["zero", "table"], "where is the platform? say it with --recording FILE.mcap, --home MECHANISM or --pose X,Y,Z"),
        (["zero", "table", "--home", "hexapod", "--pose", "0,0,0"], "--home and --pose both say where the platform is"),
        (["zero", "table", "--home", "hexapod", "--at", "3"], "--at is a time of a recording"),
        (["zero", "table", "--recording", "none.mcap"], "there is no recording at none.mcap"),
        (["zero", "new", "--home", "hexapod"], "no frame 'new'"),
        (["zero", "table", "--pose", "0,0,0,1"], "--pose must have shape (7,), got (4,)"),
        (["zero", "table", "--pose", "0,0,0,1,1,0,0"], "the quaternion of --pose has length 1.41421"),
        (["zero", "table", "--parent", "level", "--home", "hexapod"], "lies the attitude of the base: give it"),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_line_and_changes_nothing(cell, capsys, line, message):
    action, *rest = line
    assert message in refused(capsys, cell, action, cell, *rest)
