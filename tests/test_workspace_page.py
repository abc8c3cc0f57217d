"""What docs/workspace.md shows must run, and its figures must be those of the command."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from tests.hil.commands import gough

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "workspace.md").read_text()


def rows_of(heading: str) -> dict[str, list[str]]:
    """The rows of a table of the page, by their first cell."""
    table = PAGE.split(f"| {heading} |", 1)[1].split("\n\n", 1)[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    return {row[0]: row[1:] for row in cells}


@pytest.mark.slow
def test_the_figures_are_those_of_the_command(tmp_path):
    (line,) = re.findall(r"^gough workspace .*--picture", PAGE, re.MULTILINE)
    arguments = shlex.split(line.replace("docs/", f"{ROOT / 'docs'}/"))[1:-1]
    done = gough(*arguments, "--points", "9", "--json", tmp_path / "figures.json")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "figures.json").read_text())["workspaces"]
    for names, cells in rows_of("travel along").items():
        for name in names.split(", "):
            for each, way, limit in zip(found, cells[::2], cells[1::2], strict=True):
                travelled = each["travels"][name]
                turn = name[1] == "r"
                value = np.degrees(travelled["angle"]) if turn else 1e3 * travelled["distance"]
                assert way == f"{value:.2f} {'deg' if turn else 'mm'}"
                assert travelled["limit"].startswith(limit)
    region = rows_of("region about home")
    for each, moves, turns in zip(found, region["straight moves reach"], region["turns in place reach"], strict=True):
        assert moves == f"{1e3 * each['reach']['volume']:.4g} dm3" and turns == f"{each['turns']['volume']:.4g} rad3"
    for name in ("box", "ellipsoid"):
        for each, sizes in zip(found, region[f"largest {name}, half sizes"], strict=True):
            half_sizes = 1e3 * np.array(each[name]["half_sizes"][:3])
            shown = [float(part) for part in sizes.removesuffix(" mm").split(" x ")]
            assert half_sizes.tolist() == pytest.approx(shown, abs=0.006)


def test_the_example_runs(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(example, "docs/workspace.md", "exec"), names)
    printed = capsys.readouterr().out
    assert "stroke of leg 0 0.06" in printed and "conditioning of direct kinematics" in printed
