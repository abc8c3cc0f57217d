"""What docs/tuning.md shows must run, and its figures must be those of the loop on the FMU."""

import re
import shlex
from pathlib import Path

import pytest

from hil.command_line import parse

PAGE = (Path(__file__).parent.parent / "docs" / "tuning.md").read_text()


def test_the_commands_are_parsed() -> None:
    commands = [shlex.split(line, comments=True)[1:] for line in re.findall(r"^gough .*$", PAGE, re.MULTILINE)]
    assert [words[0] for words in commands] == ["tune", "simulate", *["tune"] * 5]
    for words in commands:
        parse(words)


@pytest.mark.slow
def test_the_example_runs(capsys) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(example, "docs/tuning.md", "exec"), {})
    proportional, delay, *_ = capsys.readouterr().out.split()
    assert float(proportional) > 1.0 and 0.01 < float(delay) < 0.2
