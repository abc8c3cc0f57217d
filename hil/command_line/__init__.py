"""The command `gough`: what each family of its commands takes, does and prints."""

import argparse
import os
import sys
from contextlib import suppress
from importlib.metadata import version
from typing import NoReturn

from hil.command_line import bench, calibration, fmu, fusion, kinematics, rigs, runs, tuning
from plant.errors import GoughError

REFUSED, INTERRUPTED = 2, 130
"""Exit statuses beside 0, and 1 for a run that ended before its time: bad input, with nothing done; Ctrl-C."""


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(REFUSED, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    options = _parser().parse_args(arguments)
    try:
        status: int = options.run(options)
        sys.stdout.flush()
    except GoughError as error:
        with suppress(OSError):
            print(f"gough: {error}", file=sys.stderr)
        return getattr(error, "exit_status", REFUSED)
    except OSError as error:
        # Whoever reads the output has gone, or its disk is full; nothing more is to be flushed there.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        with suppress(OSError):
            print(f"gough: the output cannot be written: {error.strerror}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("gough: interrupted", file=sys.stderr)
        return INTERRUPTED
    return status


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="gough", description="Pose control of parallel mechanisms from orientations.")
    parser.add_argument("--version", action="version", version=f"gough {version('gough')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    runs.add_simulate(commands)
    runs.add_run(commands)
    rigs.add_check_rig(commands)
    rigs.add_emulate(commands)
    rigs.add_inject(commands)
    rigs.add_faults(commands)
    rigs.add_stream_target(commands)
    runs.add_replay(commands)
    calibration.add_calibrate(commands)
    fusion.add_compare(commands)
    fusion.add_evaluate(commands)
    tuning.add_tune(commands)
    fusion.add_tune_fusion(commands)
    fmu.add_fmu(commands)
    bench.add_bench(commands)
    kinematics.add_classify(commands)
    kinematics.add_accuracy(commands)
    kinematics.add_classes(commands)
    kinematics.add_sensor_sets(commands)
    kinematics.add_planar(commands)
    fusion.add_broad(commands)
    return parser
