"""All commands with their arguments, from the parsers of the command line."""

import re
from argparse import SUPPRESS, Action, ArgumentParser, _SubParsersAction
from collections.abc import Iterator

from hil.command_line import COMMANDS, parser_of
from hil.reference.fields import plain
from hil.table import Cell, Table


def commands() -> str:
    """Sections in Markdown, one for each command under its heading in `gough --help`."""
    parts = []
    for heading, names in COMMANDS.items():
        parts.append(f"## {heading.capitalize()}")
        for name in names:
            parts += _sections(parser_of(name), "###")
    return "\n\n".join(parts)


def _sections(parser: ArgumentParser, level: str) -> Iterator[str]:
    """The sections of a command and of its actions."""
    yield f"{level} `{parser.prog}`"
    yield from (plain(" ".join(part.split())) for part in (parser.description or "").split("\n\n"))
    actions = [each for each in parser._actions if each.help != SUPPRESS and each.dest != "help"]
    plain_ones = [each for each in actions if not isinstance(each, _SubParsersAction)]
    if plain_ones:
        table = Table("argument", "unit", "default", "meaning")
        for each in plain_ones:
            text = parser._get_formatter()._expand_help(each) if each.help else ""
            table.add(Cell(_shown(each), code=True), *map(plain, _parted(text)))
        yield table.markdown()
    for each in actions:
        if isinstance(each, _SubParsersAction):
            for action in each.choices.values():
                yield from _sections(action, level + "#")


def _parted(text: str) -> tuple[str, str, str]:
    """Unit, default and meaning of a help text such as "duration of the motion [s] (default: 10)"."""
    found = re.fullmatch(r"(.*?)(?: \[([^\]]+)\])?(?: \(default: (.*)\))?", text, re.DOTALL)
    assert found
    return found[2] or "", found[3] or "", found[1]


def _shown(action: Action) -> str:
    """An argument with its value, as `--rate RATE`."""
    value = action.metavar or (f"{{{','.join(map(str, action.choices))}}}" if action.choices else action.dest.upper())
    value = " ".join(value) if isinstance(value, tuple) else value
    if not action.option_strings:
        return value
    several = f"{value} ..." if action.nargs in ("+", "*") else value
    return ", ".join(action.option_strings) + ("" if action.nargs == 0 else f" {several}")
