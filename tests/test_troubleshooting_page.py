"""docs/troubleshooting.md must have every cause with its reaction, and what it says of refused input must be what is said."""

import re
import shlex
from pathlib import Path

import pytest

from controller.safety.causes import Cause
from hil.command_line import main

PAGE = (Path(__file__).parent.parent / "docs" / "troubleshooting.md").read_text()
ROWS = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in PAGE.splitlines() if line.startswith("| ")]
REFUSED = [(row[0].strip("`"), row[1]) for row in ROWS if row[0].startswith("`gough ") and "..." not in row[0]]
FILES = {
    "millimetres.toml": 'based_on = "hexapod"\n[home]\nposition = [0, 0, 350]\n',
    "typo.toml": 'based_on = "hexapod"\n[limits]\nvelocty = 0.1\n',
    "far.csv": "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n5,0.3,0,0,1,0,0,0\n",
}


def test_every_cause_has_its_reaction_and_a_remedy() -> None:
    reactions = {"goes on", "controlled stop", "quick stop", "brakes at once"}
    of_page = [(row[0], row[1]) for row in ROWS if row[1] in reactions]
    causes = [(cause.text.format("k"), cause.reaction.text) for cause in Cause if cause is not Cause.NONE]
    assert sorted(of_page) == sorted(causes)
    assert all(len(row) == 3 and row[2].endswith(".") for row in ROWS if row[1] in reactions)


@pytest.mark.parametrize(("line", "message"), REFUSED, ids=[line for line, _ in REFUSED])
def test_input_is_refused_with_the_message_of_the_page(
    line: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    try:
        status = main(shlex.split(line)[1:])
    except SystemExit as error:
        status = error.code
    assert status == 2 and message in capsys.readouterr().err


def test_input_of_all_kinds_is_tried() -> None:
    assert len(REFUSED) > 12 and len(re.findall("`gough simulate", PAGE)) > 10
