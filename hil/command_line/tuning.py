"""The command tune."""

import argparse
from typing import Any

from hil.command_line.options import add_json, add_mechanism
from hil.command_line.outputs import check_outputs, write_json
from hil.command_line.printing import new_table, print_table


def add_tune(commands: Any) -> None:
    """Add `gough tune`."""
    command = commands.add_parser(
        "tune",
        help="design the PID gains and show the margins",
        description="Design the gains from the linearised plant and filters, and print them with their margins.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add_mechanism(command)
    command.add_argument("--rate", type=float, default=1000.0, help="cycles per second [Hz]")
    add_json(command)
    command.set_defaults(run=_tune)


def _tune(options: argparse.Namespace) -> int:
    from controller.design.tuning import tune
    from plant.mechanism import load_spatial

    check_outputs(options.json)
    design = tune(load_spatial(options.mechanism), options.rate)
    write_json(options.json, design.summary())
    table = new_table("", "value", "unit")
    for label, value, unit in design.rows():
        table.add_row(label, value, unit)
    print_table(table)
    return 0
