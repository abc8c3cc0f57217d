"""What docs/compare.md shows must run, and its figures must be those of the source."""

import contextlib
import json
import re
import shlex
from pathlib import Path

import pytest

from hil.runs.comparison import FIGURES
from tests.hil.commands import gough

PAGE = (Path(__file__).parent.parent / "docs" / "compare.md").read_text()
COMMANDS = [shlex.split(line)[1:] for line in re.findall(r"^gough [a-z].*$", PAGE, re.MULTILINE)]


def test_every_figure_is_in_the_table() -> None:
    shown = re.findall(r"^\|[^|]+\| `([\w.*]+)` \|", PAGE, re.MULTILINE)
    for name in FIGURES:
        assert name in shown or f"{name.partition('.')[0]}.*" in shown
    for name in shown:
        assert any(figure == name or figure.startswith(name.removesuffix("*")) for figure in FIGURES)


@pytest.mark.slow(seconds=30)
def test_the_commands_and_the_example_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert [words[0] for words in COMMANDS].count("compare") == 3
    for words in COMMANDS:
        finished = gough(*words, *(["--most-missed", "2000"] if words[0] == "run" else []), cwd=tmp_path)
        assert finished.returncode == 0, (words, finished.stderr)
    assert "what differs: fusion" in gough(*COMMANDS[2], cwd=tmp_path).stdout
    assert json.loads((tmp_path / "compare.json").read_text())["seconds"] == pytest.approx(1.0)
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    with contextlib.chdir(tmp_path):
        exec(compile(example, "docs/compare.md", "exec"), {})
    assert "[1000.0, 500.0]" in capsys.readouterr().out
