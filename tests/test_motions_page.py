"""What docs/motions.md shows must be read and must run, and its tables must have every entry."""

import json
import re
import shlex
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import pytest

from controller.planning.motions import (
    Motion,
    Place,
    SplinePoint,
    ToolLimits,
    Washout,
    load_washout,
    motion_from_text,
    plan_motion,
)
from controller.planning.motions.elements import KINDS
from controller.planning.motions.waves import SHAPES
from hil.command_line import main, parse
from plant.mechanism import Mechanism

PAGE = (Path(__file__).parent.parent / "docs" / "motions.md").read_text()


def rows_under(heading: str) -> dict[str, list[str]]:
    """The cells of the tables under a heading, by the entry."""
    section = PAGE.split(f"\n### {heading}\n", 1)[1].split("\n#", 1)[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line.startswith("| `")]
    return {row[0].strip("`"): row for row in rows}


def check_fields(rows: dict[str, list[str]], kind: Any, *without: str) -> None:
    for each in fields(kind):
        if each.name not in without:
            required = each.default is MISSING and each.default_factory is MISSING
            assert (rows[each.name][3] == "must be given") == required, each.name
            if isinstance(each.default, float) and each.default not in (float("inf"),):
                assert float(rows[each.name][3]) == pytest.approx(each.default, rel=1e-4)


def test_every_entry_is_in_a_table() -> None:
    check_fields(rows_under("The file"), Motion)
    check_fields(rows_under("Limits of the tool"), ToolLimits)
    check_fields(rows_under("Places"), Place)
    assert {f'`kind = "{name}"`' for name in KINDS} == set(re.findall(r"^### (`kind.*`)$", PAGE, re.MULTILINE))
    for name, kind in KINDS.items():
        check_fields(rows_under(f'`kind = "{name}"`'), kind, "limits")
    check_fields(rows_under('`kind = "spline"`'), SplinePoint, "place")


def test_every_shape_has_all_its_entries() -> None:
    section = PAGE.split('\n### `kind = "wave"`\n', 1)[1].split("\n#", 1)[0]
    shown: dict[str, set[str]] = {}
    shape = ""
    for line in section.splitlines():
        if found := re.match(r"\| (`([\w-]+)`)? ?\| `(\w+)` \|", line):
            shape = found[2] or shape
            shown.setdefault(shape, set()).add(found[3])
    assert shown == {name: {each.name for each in fields(kind)} for name, kind in SHAPES.items()}


def test_a_drive_is_made_and_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As the page shows it, with the figures that it names."""
    monkeypatch.chdir(tmp_path)
    (file,) = [text for text in re.findall("```toml\n(.*?)```", PAGE, re.DOTALL) if text.startswith("# drive.toml")]
    Path("drive.toml").write_text(file)
    Path("washout.toml").touch()
    made, shown, simulated, *_ = [
        shlex.split(line, comments=True)[1:]
        for line in re.findall(r"^gough .*$", PAGE.split("\n## Motion cueing\n")[1], re.MULTILINE)
    ]
    assert main(made) == 0 and main([*shown, "--json", "figures.json"]) == 0
    assert "is clipped" in capsys.readouterr().out
    figures = json.loads(Path("figures.json").read_text())
    (element,) = figures["elements"]
    gains = [f"{100.0 * gain:.0f} %" for gain in element["cue"]["onset_gain"]]
    assert f"onset gain is {gains[0]} ahead, {gains[1]} to the side and {gains[2]} upwards" in " ".join(PAGE.split())
    assert simulated[-2:] == ["--duration", f"{figures['duration']:.0f}"]
    assert load_washout("washout.toml") == Washout()


def test_the_commands_are_parsed_and_the_examples_run(hexapod: Mechanism) -> None:
    commands = [shlex.split(line, comments=True)[1:] for line in re.findall(r"^gough .*$", PAGE, re.MULTILINE)]
    targets = ["motion", "motion", "simulate", "run", "stream-target"]
    assert [words[0] for words in commands] == [*targets, "vehicle", "motion", "simulate", "stream-target", "stream-target"]
    for words in commands:
        parse(words)
    toml, python = (re.findall(f"```{language}\n(.*?)```", PAGE, re.DOTALL) for language in ("toml", "python"))
    planned = plan_motion(motion_from_text(toml[0], "the page"), hexapod)
    assert planned.name == "inspection" and 10.0 < planned.duration < 30.0
    names: dict[str, Any] = {}
    exec(compile(python[0], "docs/motions.md", "exec"), names)
    assert 5.63 < names["planned"].duration < 5.64
    assert names["planned"].parts[0].binding.name == "speed of the tool"
    assert motion_from_text(names["text"], "again") == names["motion"]
