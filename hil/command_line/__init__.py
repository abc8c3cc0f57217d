"""The command `gough`: its commands by heading, each built only when it is called, so that the help does not wait."""

import argparse
import os
import sys
from contextlib import suppress
from importlib import import_module
from typing import Any, NoReturn

from plant.errors import GoughError

REFUSED, INTERRUPTED = 2, 130
"""Exit statuses beside 0, and 1 for a run that ended early: bad input, with nothing done; Ctrl-C."""

COMMANDS = {
    "run": {
        "simulate": "follow a target on the FMU plant, as fast as the machine can",
        "run": "follow a target on the machine's clock",
        "replay": "feed a recording's raw IMU data through the cycle again",
        "stream-target": "send a target pose by pose to a run that follows a stream",
    },
    "calibrate": {"calibrate": "find the IMUs' errors: on the mechanism, or of a single IMU or magnetometer"},
    "design": {
        "classify": "the class of a mechanism, and the sensors that it needs",
        "classes": "what every class of mechanism needs, and its errors",
        "accuracy": "errors of direct kinematics at a given noise",
        "sensor-sets": "the closed loop with fewer sensors, on every type of mechanism",
        "tune": "design the PID gains and show the margins",
        "tune-fusion": "find the noise that the fusion should assume",
    },
    "rigs": {
        "check-rig": "check that a rig does what the loop relies on",
        "emulate": "emulate a rig on a bus, for 'gough run' in another process",
        "inject": "inject a fault into an emulated rig",
    },
    "plant": {"fmu": "build, show, validate or linearise the plant's FMU"},
    "study": {
        "compare-fusion": "every way to fuse the IMUs, on one motion",
        "evaluate-fusion": "the whole-mechanism filter after a self-calibration",
        "faults": "every fault many times, compared with the reaction that is specified",
        "planar": "poses of a real planar rig from its measured leg angles",
        "broad": "the platform's filter alone, on real IMU data",
    },
    "measure": {"bench": "measure the loop, the plant and the kinematics: their speed and lateness"},
}
"""By heading, which is the name of the module, too: each command with its help."""


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(REFUSED, f"{self.prog}: {message} (see {self.prog} --help)\n")


class _Version(argparse.Action):
    """Prints the version, which is looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"gough {version('gough')}")
        parser.exit()


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    try:
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
    parser = _Parser(
        prog="gough",
        usage="gough [-h] [--version] COMMAND ...",
        description="Pose control of parallel mechanisms from orientations.",
        epilog="\n\n".join(map(_section, COMMANDS)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the program's version number and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", help=argparse.SUPPRESS, prog="gough")
    chosen = next((each for each in arguments if not each.startswith("-")), None)
    for heading, helps in COMMANDS.items():
        for name in helps:
            command = commands.add_parser(name)
            if name == chosen:
                add = getattr(import_module(f"hil.command_line.{heading}"), f"add_{name.replace('-', '_')}")
                add(command)
    return parser.parse_args(arguments)


def _section(heading: str) -> str:
    return "\n".join([f"{heading}:", *(f"  {name:15}  {text}" for name, text in COMMANDS[heading].items())])
