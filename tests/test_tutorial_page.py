"""What docs/tutorial.md tells a newcomer to do must work, in its order."""

import re
import shlex
from pathlib import Path

import pytest

from hil.command_line import main, parse

PAGE = (Path(__file__).parent.parent / "docs" / "tutorial.md").read_text()
COMMANDS = [shlex.split(line)[1:] for line in re.findall(r"^gough .*$", PAGE, re.MULTILINE)]
OF_A_RUN = "run", "move", "jog"
"""Commands that wait for the machine's clock or for another process; other tests run them."""


def write_files(folder: Path) -> None:
    for text in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL):
        name = re.match(r"# (\w+\.toml)", text)
        assert name
        (folder / name[1]).write_text(text)


def test_all_kinds_of_command_are_there_and_parsed() -> None:
    kinds = [words[0] for words in COMMANDS]
    assert list(dict.fromkeys(kinds)) == [
        "classify", "workspace", "tune", "simulate", "frames", "motion", "run", "move", "jog",
    ]  # fmt: skip
    for words in COMMANDS:
        parse(words)


@pytest.mark.slow
def test_the_commands_work_in_their_order(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    write_files(tmp_path)
    for words in COMMANDS:
        if words[0] not in OF_A_RUN:
            assert main(words) == 0, words
    shown = capsys.readouterr().out
    assert "platform swing" in shown and "a target is needle in fixture" in shown
    assert "needle in fixture" in shown.rpartition("estimate - truth")[0].rpartition("gough")[2]
    assert (tmp_path / "tuned.toml").exists() and (tmp_path / "path.html").exists()
