"""What the README shows must run."""

import re
from pathlib import Path

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_the_python_of_the_readme_runs():
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    solution = names["solve"](names["hexapod"], names["directions"])
    assert abs(solution.position - names["pose"].position).max() < 1e-12


def test_the_options_of_the_readme_exist():
    from hil.command_line import COMMANDS, parse

    commands = {name for helps in COMMANDS.values() for name in helps}
    for command in re.findall(r"`gough ([\w-]+)", README):
        assert command in commands
    lines = re.findall(r"^gough simulate(.*?)(?:#.*)?$", README, re.MULTILINE)
    assert len(lines) >= 5
    for line in lines:
        parse(["simulate", *line.split()])
