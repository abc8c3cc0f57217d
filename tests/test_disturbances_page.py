"""What docs/disturbances.md shows must be read, its figures must be those of a run, and its table must have every row."""

import re
import shlex
import tomllib
from pathlib import Path

import numpy as np

from hil.command_line import parse
from hil.faults.rows import all_rows, rows_of
from hil.faults.tables import disturbance_table
from hil.faults.verdict import judge
from hil.loop.records import RECORD

PAGE = (Path(__file__).parent.parent / "docs" / "disturbances.md").read_text()


def test_every_command_is_one() -> None:
    commands = [shlex.split(line, comments=True)[1:] for line in re.findall(r"^gough .*$", PAGE, re.MULTILINE)]
    assert len(commands) > 3
    for words in commands:
        assert words[0] == "faults"
        parse(words)


def test_the_examples_are_read() -> None:
    tables = re.findall("```toml\n(.*?)```", PAGE, re.DOTALL)
    (first, second), (turned,) = (rows_of(tomllib.loads(each)) for each in tables)
    assert (first.name, second.name) == tuple(f"a leg's IMU turns by {size} deg about x within 15 s" for size in (1, 3))
    drawn = first.drawn(0, "whole")
    assert drawn.config.settings[0].at == drawn.begin + 1.0 and len(drawn.guilty) == 1
    assert 8.0 <= drawn.begin <= 10.0
    assert {turned.drawn(seed, "whole").config.rate for seed in range(9)} == {250, 1000}


def test_the_figures_are_those_of_a_run() -> None:
    records = np.zeros(3, RECORD)
    records["mode"], records["truth"][:, 3], records["rotation"] = 2, 1.0, np.eye(3)
    figures = judge(records, 0, frozenset(), 1, 1.0)
    named = {name for line in re.findall(r"^\| (`.*?) \|", PAGE, re.MULTILINE) for name in re.findall(r"`(\w+)`", line)}
    assert named | {"events"} == {"what", *figures}


def test_the_table_has_every_row() -> None:
    lines = PAGE.splitlines()
    rows = lines[lines.index(next(line for line in lines if line.startswith("| disturbance"))) :]
    heads = disturbance_table([]).markdown().splitlines()
    assert rows[0].startswith(heads[0].removesuffix("|")) and rows[1].startswith(heads[1].removesuffix("|"))
    names = [row.split(" | ")[0][2:] for row in rows[2:]]
    assert names == [row.name for row in all_rows()]
