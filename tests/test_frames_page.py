"""What docs/frames.md shows must be read and run, and its limits must be those of the source."""

import re
from pathlib import Path

import numpy as np

from controller.frames import load_frames, parse_frames
from controller.frames.tree import FARTHEST_M, MOST_FRAMES
from hil.command_line import main, parse

PAGE = (Path(__file__).parent.parent / "docs" / "frames.md").read_text()
(EXAMPLE,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
(PROGRAM,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
COMMANDS = [line.split("  #")[0].strip() for line in re.findall(r"^gough .*", PAGE, re.MULTILINE)]


def words(line):
    return [word.strip('"') for word in re.findall(r'"[^"]*"|\S+', line)[1:]]


def test_the_file_and_the_program_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("cell.toml").write_text(EXAMPLE)
    names = {}
    exec(compile(PROGRAM, "docs/frames.md", "exec"), names)
    np.testing.assert_allclose(names["platform"].position, names["home"].position, atol=1e-12)
    assert names["covariance"].shape == (6, 6) and names["way"].position.shape == (50, 3)


def test_the_commands_work_in_their_order(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert len(COMMANDS) > 7
    for line in COMMANDS:
        if line.startswith("gough frames"):
            assert main(words(line)) == 0
        else:
            parse(words(line))
    shown = capsys.readouterr().out
    assert "a target is needle in table" in shown
    made, example = load_frames("cell.toml"), parse_frames(EXAMPLE, "docs/frames.md")
    np.testing.assert_array_equal(made.place("table").position, example.place("table").position)


def test_the_limits_are_those_of_the_source():
    assert f"| {MOST_FRAMES} of them;" in PAGE
    assert PAGE.count(f"| {FARTHEST_M:g} along each axis |") == 2


def test_every_action_of_the_command_is_listed():
    from hil.command_line.frames import gough_frames

    for action in ("list", "show", "set", "link", "zero", "enable", "remove"):
        assert f"| `{action} FILE" in PAGE
    assert gough_frames.run is None
