"""The command fmu."""

import argparse
from pathlib import Path
from typing import Any

from hil.command_line.options import add_mechanism
from hil.command_line.outputs import check_outputs
from hil.command_line.printing import progress_bar


def add_fmu(commands: Any) -> None:
    """Add `gough fmu`."""
    command = commands.add_parser("fmu", help="the plant as an FMU", description="The plant as an FMU.")
    actions = command.add_subparsers(required=True, metavar="ACTION")
    build = actions.add_parser(
        "build",
        help="write the plant's FMU",
        description="Write a plant as an FMU, with its sources: FMI 3.0 for Co-Simulation and Model Exchange, or FMI 2.0 for "
        "Co-Simulation. The parameters of any mechanism of the same kind can be set in it.",
    )
    build.add_argument("--output", type=Path, metavar="FILE.fmu", help="default: in fmus/ in a checkout, else here")
    build.add_argument("--fmi", type=int, choices=(2, 3), default=3, help="version of FMI (default: 3)")
    add_mechanism(build)
    build.add_argument(
        "--platforms",
        type=lambda text: text.split(","),
        default=[],
        metavar="LIST",
        help="linux,windows,darwin: compiled by zig, 'pip install gough[cross]' (default: this machine's, by its C compiler)",
    )
    build.set_defaults(run=_build_fmu)


def _build_fmu(options: argparse.Namespace) -> int:
    from plant.export import build_in_subprocess, check_build, model_of
    from plant.mechanism import load_mechanism

    model = model_of(load_mechanism(options.mechanism))
    check_build(options.fmi, options.platforms)
    folder = Path("fmus") if Path("fmus/fmi3.c").is_file() else Path()
    path = options.output or folder / f"{model.identifier}{'_fmi2' if options.fmi == 2 else ''}.fmu"
    check_outputs(path)
    with progress_bar(f"compiling for {', '.join(options.platforms) or 'this machine'}"):
        build_in_subprocess(path, options.fmi, options.mechanism, options.platforms)
    print(path)
    return 0
