"""The command `gough`: its commands by heading, each built only when it is called, so that nothing waits for the others."""

import argparse
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from hil.command_line.options import build, summary
from plant.errors import GoughError
from plant.extras import missing_extras_named

REFUSED, INTERRUPTED = 2, 130
"""Exit statuses beside 0, and 1 for a run that ended early: bad input, with nothing done; Ctrl-C."""

COMMANDS = {
    "run": ("simulate", "run", "replay", "stream-target"),
    "calibrate": ("calibrate",),
    "design": ("classify", "classes", "accuracy", "sensor-sets", "tune", "tune-fusion"),
    "rigs": ("check-rig", "emulate", "inject"),
    "plant": ("fmu",),
    "study": ("compare-fusion", "evaluate-fusion", "faults", "planar", "broad"),
    "measure": ("bench",),
}
"""The commands by heading. A heading names the module of its commands, where a function such as `add_tune` adds each."""


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(REFUSED, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    try:
        with missing_extras_named():
            status: int = options.run(options)
        sys.stdout.flush()
    except GoughError as error:
        with suppress(OSError):
            print(f"gough: {error}", file=sys.stderr)
        return getattr(error, "exit_status", REFUSED)
    except OSError as error:
        # The reader of the output has gone, or its disk is full; nothing more is flushed there.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        with suppress(OSError):
            print(f"gough: the output cannot be written: {error.strerror}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("gough: interrupted", file=sys.stderr)
        return INTERRUPTED
    return status


def parse(arguments: list[str]) -> argparse.Namespace:
    """The options of a command line; `run` is the function that carries it out."""
    homes = {name: heading for heading, names in COMMANDS.items() for name in names}
    chosen = next((each for each in arguments if not each.startswith("-")), None)
    parser = _Parser(
        prog="gough",
        usage="gough [-h] [--version] COMMAND ...",
        description="Pose control of parallel mechanisms from orientations.",
        epilog=None if chosen in homes else "\n\n".join(map(_section, COMMANDS)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    # Looking up the version takes longer than the rest.
    if arguments[:1] != [chosen]:
        from importlib.metadata import version

        parser.add_argument("--version", action="version", version=f"gough {version('gough')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", help=argparse.SUPPRESS, prog="gough")
    for name, heading in homes.items():
        command = commands.add_parser(name)
        if name == chosen:
            build(command, _adder(heading, name))
    return parser.parse_args(arguments)


def _adder(heading: str, name: str) -> Callable[[argparse.ArgumentParser], None]:
    """The function that adds the options of a command, imported only here."""
    module = import_module(f"hil.command_line.{heading}")
    adder: Callable[[argparse.ArgumentParser], None] = getattr(module, f"add_{name.replace('-', '_')}")
    return adder


def _section(heading: str) -> str:
    """The part of the help with the commands under a heading."""
    return "\n".join([f"{heading}:", *(f"  {name:15}  {summary(_adder(heading, name))}" for name in COMMANDS[heading])])
