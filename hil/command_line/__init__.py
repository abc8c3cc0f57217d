"""The command `gough`. Each of its commands is built only when it is called."""

import argparse
import os
import re
import sys
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from hil.command_line.cli import Command, check_outputs
from plant.checks import nearest, printable
from plant.errors import GoughError
from plant.extras import missing_extras_named

REFUSED, INTERRUPTED = 2, 130
"""Exit statuses for bad input and for Ctrl-C; 1 is for a run that ended early."""

COMMANDS = {
    "run": ("simulate", "run", "motion", "replay", "compare", "stream-target", "vehicle"),
    "calibrate": ("calibrate", "identify"),
    "design": (
        "classify",
        "classes",
        "accuracy",
        "workspace",
        "sensor-sets",
        "bounds",
        "detectability",
        "tune",
        "tune-fusion",
        "optimise",
    ),
    "operate": ("move", "jog", "panel", "frames"),
    "rigs": ("check-rig", "emulate", "inject", "fmu"),
    "study": ("sweep", "compare-fusion", "evaluate-fusion", "faults", "planar", "broad"),
    "measure": ("bench",),
}
"""The commands by heading, which is also their module; there `gough tune` is `gough_tune`."""


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(REFUSED, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Args:
        arguments: of a call from Python; by default those of this process, which is then the command's own.
    """
    options = parse(sys.argv[1:] if arguments is None else arguments)
    options.own_process = arguments is None
    try:
        check_outputs(options)
        with missing_extras_named():
            status: int = options.run(options) or 0
        sys.stdout.flush()
    except GoughError as error:
        with suppress(OSError):
            print(f"gough: {printable(str(error))}", file=sys.stderr)
        return getattr(error, "exit_status", REFUSED)
    except MemoryError as error:
        print(f"gough: there is not enough memory: {error}: choose a shorter duration, or a lower rate", file=sys.stderr)
        return 1
    except OSError as error:
        # The reader of the output has gone, or its disk is full; nothing more is flushed there.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        with suppress(OSError):
            print(f"gough: the output cannot be written: {error.strerror}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, ImportError) as error:
        # Ctrl-C while an extension module initialises itself is an error of the import.
        if not isinstance(error, KeyboardInterrupt) and not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        print("gough: interrupted", file=sys.stderr)
        return INTERRUPTED
    return status


def parse(arguments: list[str]) -> argparse.Namespace:
    """The options of a command line; `run` is the function that carries it out."""
    arguments = _joined(arguments)
    homes = {name: heading for heading, names in COMMANDS.items() for name in names}
    chosen = next((each for each in arguments if not each.startswith("-")), None)
    parser = _Parser(
        prog="gough",
        usage="gough [-h] [--version] COMMAND ...",
        description="Pose control of parallel mechanisms from orientations.",
        epilog=None if chosen in homes else "\n\n".join(map(_section, COMMANDS)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if chosen is None or arguments[0] != chosen:
        # Looking up the version takes longer than the rest.
        from importlib.metadata import version

        parser.add_argument("--version", action="version", version=f"gough {version('gough')}")
    elif chosen not in homes:
        parser.error(f"argument COMMAND: invalid choice: {chosen!r}{nearest(chosen, homes)}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", help=argparse.SUPPRESS, prog="gough")
    for name, heading in homes.items():
        command = commands.add_parser(name)
        if name == chosen:
            _command(heading, name).build(command)
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        flags = re.findall(r"(?<=[\[ ])[-+]{1,2}[a-z][\w-]*", options.parser.format_usage())
        options.parser.error(f"unrecognized arguments: {' '.join(unknown)}{nearest(unknown[0], flags)}")
    return options


def _joined(arguments: list[str]) -> list[str]:
    """The arguments, where numbers such as -10,0,5 stand in one with their option: argparse takes them for an option."""
    joined: list[str] = []
    for each in arguments:
        if joined and re.fullmatch(r"--[a-z][a-z-]*", joined[-1]) and re.fullmatch(r"-[\d.]+(e[-+]?\d+)?,.*", each):
            joined[-1] += f"={each}"
        else:
            joined.append(each)
    return joined


def parser_of(name: str) -> argparse.ArgumentParser:
    """The parser of a command by itself."""
    (heading,) = (each for each, names in COMMANDS.items() if name in names)
    parser = _Parser(prog=f"gough {name}")
    _command(heading, name).build(parser)
    return parser


def _command(heading: str, name: str) -> Command:
    """A command, imported only here."""
    module = import_module(f"hil.command_line.{heading}")
    found: Command = getattr(module, f"gough_{name.replace('-', '_')}")
    return found


def _section(heading: str) -> str:
    """The part of the help with the commands under a heading."""
    lines = (f"  {name:15}  {_command(heading, name).help}" for name in COMMANDS[heading])
    return "\n".join([f"{heading}:", *lines])
