"""The command fmu."""

import argparse
from pathlib import Path
from typing import Any

from hil.command_line.outputs import check_outputs


def add_fmu(commands: Any) -> None:
    """Add `gough fmu`."""
    command = commands.add_parser("fmu", help="the plant as an FMU", description="The plant as an FMU.")
    actions = command.add_subparsers(required=True, metavar="ACTION")
    build = actions.add_parser(
        "build", help="write the plant's FMU", description="Write the plant as an FMI 3.0 Co-Simulation FMU."
    )
    build.add_argument("--output", type=Path, metavar="FILE.fmu", help="default: fmus/gough_plant.fmu in a checkout, else here")
    build.set_defaults(run=_build_fmu)


def _build_fmu(options: argparse.Namespace) -> int:
    from plant.export import MODEL, build_in_subprocess

    folder = Path("fmus") if Path("fmus/fmi3.c").is_file() else Path()
    path = options.output or folder / f"{MODEL}.fmu"
    check_outputs(path)
    build_in_subprocess(path)
    print(path)
    return 0
