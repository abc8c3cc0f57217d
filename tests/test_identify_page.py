"""What docs/identify.md shows must be understood, and its names must be those of the program."""

import re
import shlex
from pathlib import Path

from controller.design.identification import PARAMETERS
from hil.command_line import parse

PAGE = (Path(__file__).parent.parent / "docs" / "identify.md").read_text()


def test_every_command_is_one() -> None:
    commands = [shlex.split(line, comments=True)[1:] for line in re.findall(r"^gough .*$", PAGE, re.MULTILINE)]
    assert [words[0] for words in commands] == ["identify", "identify", "identify", "tune"]
    for words in commands:
        parse(words)


def test_every_parameter_is_named() -> None:
    table = PAGE.split("| name | what it does | of |", 1)[1].split("\n\n", 1)[0]
    assert {*re.findall(r"`([\w.]+)`", "\n".join(row.split("|")[1] for row in table.splitlines()[2:]))} == {*PARAMETERS}
