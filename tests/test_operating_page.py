"""What docs/operating.md shows must be read and must run."""

import re
import shlex
from pathlib import Path

import pytest

from controller.planning.points import load_points
from hil.command_line import main, parse
from hil.runs.operator import Operator
from hil.runs.operator_channel import _Channel
from tests.hil.runs.test_operated_run import operated, told

PAGE = (Path(__file__).parent.parent / "docs" / "operating.md").read_text()
COMMANDS = [shlex.split(line, comments=True)[1:] for line in re.findall(r"^gough [a-z].*$", PAGE, re.MULTILINE)]


def points(folder: Path) -> Path:
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    path = folder / "points.toml"
    path.write_text(text)
    return path


def test_the_commands_are_parsed_and_the_points_read(tmp_path: Path) -> None:
    assert [words[0] for words in COMMANDS] == ["motion"] * 3 + ["run"] + ["move"] * 5 + ["jog"] * 2 + [
        "move", "run", "move", "run", "run", "run",
    ]  # fmt: skip
    for words in COMMANDS:
        parse(words)
    assert [*load_points(points(tmp_path))] == ["park", "left"]


def test_every_request_is_in_the_table() -> None:
    table = PAGE.split("| `do` | with | does |\n", 1)[1].split("\n\n", 1)[0]
    shown = [name for cell in re.findall(r"^\| (`[a-z`, ]+`) \|", table, re.MULTILINE) for name in re.findall(r"`(\w+)`", cell)]
    source = Path(_Channel.__init__.__code__.co_filename).read_text()
    (doing,) = re.findall(r"self\._doing: .*?\{\n(.*?)\}", source, re.DOTALL)
    assert shown == re.findall(r'"(\w+)": self', doing)


def test_the_checks_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    rows = [f"{0.01 * k},0,0,{0.03 * (k / 300) ** 2 * (3 - k / 150):.9f},1,0,0,0" for k in range(301)]
    fast = [row.replace(f"{0.01 * k},", f"{0.0005 * k},", 1) for k, row in enumerate(rows)]
    Path("fast.csv").write_text("\n".join(["time_s,x_m,y_m,z_m,qw,qx,qy,qz", *fast]))
    assert [main(words) for words in COMMANDS[:3]] == [0, 1, 0]
    out = capsys.readouterr().out
    assert "the target fast.csv is too fast" in out and out.count("within all limits") == 2


@pytest.mark.slow(seconds=40)
def test_the_commands_and_the_example_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with operated(tmp_path, "--points", points(tmp_path)) as (run, address):
        for words in COMMANDS[4:11]:
            status, out, error = told(*words, "--at", address)
            assert status == 0, (words, out, error)
        status, _, error = told(*COMMANDS[11], "--at", address)
        assert status == 2 and "the nearest pose within all limits is" in error
        (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
        names: dict[str, object] = {}
        exec(compile(example.replace("Operator()", f"Operator({address!r})"), "docs/operating.md", "exec"), names)
        with Operator(address) as operator:
            operator.end()
        assert run.wait(60.0) == 0
