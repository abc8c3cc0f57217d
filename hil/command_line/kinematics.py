"""The commands about mechanisms and their sensors: classify, accuracy, classes, sensor-sets, planar."""

import argparse
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hil.command_line.options import add_json, add_mechanism
from hil.command_line.outputs import check_outputs, write_json
from hil.command_line.printing import deg, mm, new_table, print_table, progress_bar
from plant.errors import InputError


def add_classify(commands: Any) -> None:
    """Add `gough classify`."""
    command = commands.add_parser(
        "classify",
        help="what class a mechanism is of, and which sensors it needs",
        description="Tell the combinatorial class of a mechanism, and for each method of direct kinematics which sensors it "
        "needs, whether its pose is unique, and its conditioning (1 is best, 0 singular) at home and at worst.",
    )
    command.add_argument("mechanism", metavar="PRESET|FILE.toml", help="preset, or a TOML file")
    command.add_argument("--report", type=Path, metavar="FILE.html", help="write a report with drawings")
    add_json(command)
    command.set_defaults(run=_classify)


def _classify(options: argparse.Namespace) -> int:
    from hil.studies.classification import PAPER, describe
    from plant.mechanism import load_mechanism

    check_outputs(options.json, options.report)
    description = describe(load_mechanism(options.mechanism))
    write_json(options.json, description.summary())
    if options.report:
        from hil.reports.classification import write_report

        write_report(description, options.report)
    mechanism_class = description.mechanism_class
    print(f"{description.mechanism.name}: class {mechanism_class.label}, a {mechanism_class.name} with the graph")
    print(f"  {mechanism_class.drawing}")
    table = new_table("method", "needs", "section", "poses", "conditioning: home", "worst")
    for need in description.needs:
        method = need.requirement.method
        modes = "unique" if need.modes == 1 else f"{need.modes} modes"
        row = (need.requirement.text, PAPER.get(method, "beyond"), modes, f"{need.home:.2g}", f"{need.worst:.2g}")
        table.add_row(method, *row)
    print_table(table)
    for need in description.needs:
        if need.requirement.choice_text:
            print(f"{need.requirement.method}: legs {need.requirement.choice_text}")
    print(f"Worst over {description.where}. Sections are the paper's.")
    return 0


def add_accuracy(commands: Any) -> None:
    """Add `gough accuracy`."""
    command = commands.add_parser(
        "accuracy",
        help="errors of direct kinematics at a given noise",
        description="Errors of the paper's algorithms and of all legs together, at random poses about home (50 mm, 15 deg on "
        "hexapod), for noise of 0.05 deg on legs, roll and pitch, and 1.5 deg on a magnetic yaw.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add_mechanism(command)
    command.add_argument("--poses", type=int, default=2000, help="number of random poses")
    command.add_argument("--seed", type=int, default=0, help="of poses and noise")
    add_json(command)
    command.set_defaults(run=_accuracy)


def _accuracy(options: argparse.Namespace) -> int:
    from hil.studies.accuracy import evaluate_accuracy
    from plant.mechanism import load_spatial

    check_outputs(options.json)
    accuracy = evaluate_accuracy(load_spatial(options.mechanism), options.poses, options.seed)
    write_json(options.json, accuracy.summary())
    table = new_table("RMS errors", "position [mm]", "rotation [deg]", "over the bound", "NEES", "solved [%]")
    for estimator, errors in accuracy.errors.items():
        table.add_row(
            estimator.label,
            mm(errors.position_rms),
            deg(errors.rotation_rms),
            f"{errors.position_over_bound:.3f}, {errors.rotation_over_bound:.3f}",
            f"{errors.nees:.2f}" if estimator.refine else "-",
            f"{100.0 * errors.solved:.1f}",
        )
    print_table(table)
    least, greatest = accuracy.nees_bounds
    print(
        f"{accuracy.mechanism}, class {accuracy.mechanism_class.label}, {accuracy.poses} poses; the bound is Cramer and Rao's; "
        f"NEES is 6 on average, {least:.2f} to {greatest:.2f} in 99 % of such runs, if the covariance is right"
    )
    return 0


def add_classes(commands: Any) -> None:
    """Add `gough classes`."""
    command = commands.add_parser(
        "classes",
        help="what every class of mechanism needs, and the errors",
        description="For each of the 60 spatial and 4 planar classes: what the paper needs, what gough needs, and the median "
        "errors of each over random mechanisms and poses, for the noise of 'gough accuracy'.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--seed", type=int, default=0, help="of mechanisms, poses and noise")
    command.add_argument("--markdown", action="store_true", help="print the table in Markdown, as docs/classes.md has it")
    add_json(command)
    command.set_defaults(run=_classes)


def _classes(options: argparse.Namespace) -> int:
    from dataclasses import asdict

    from hil.studies.accuracy import class_table, evaluate_classes

    check_outputs(options.json)
    with progress_bar("classes") as progress:
        rows = evaluate_classes(options.seed, progress)
    write_json(options.json, {"seed": options.seed, "version": version("gough"), "classes": [asdict(row) for row in rows]})
    table = class_table(rows)
    if options.markdown:
        print(table.markdown())
    else:
        table.print()
    return 0


def add_sensor_sets(commands: Any) -> None:
    """Add `gough sensor-sets`."""
    command = commands.add_parser(
        "sensor-sets",
        help="the closed loop with fewer sensors, on every type of mechanism",
        description="Follow the target sines with every set of sensors, from the paper's least to all: legs alone, with the "
        "platform's roll and pitch, with its whole orientation (a magnetometer), by leg and platform filters and by the "
        "whole-mechanism filter. Prints the errors of the estimate, and of direct kinematics the worst conditioning.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--mechanism", nargs="+", metavar="NAME", help="presets or TOML files (default: one of each type)")
    command.add_argument("--duration", type=float, default=10.0, help="of each motion [s]")
    command.add_argument("--seed", type=int, default=0, help="of the IMUs' imperfections")
    command.add_argument("--markdown", action="store_true", help="print the table in Markdown, as docs/sensor_sets.md has it")
    add_json(command)
    command.set_defaults(run=_sensor_sets)


def _sensor_sets(options: argparse.Namespace) -> int:
    from dataclasses import asdict

    from hil.studies.sensor_sets import MECHANISMS, evaluate_sensor_sets, reasons, table

    check_outputs(options.json)
    with progress_bar("sets of sensors") as progress:
        outcomes = evaluate_sensor_sets(
            options.mechanism or MECHANISMS, duration=options.duration, seed=options.seed, progress=progress
        )
    figures = {"duration": options.duration, "seed": options.seed, "version": version("gough")}
    write_json(options.json, {**figures, "sets": [asdict(outcome) for outcome in outcomes]})
    if options.markdown:
        print("\n".join([table(outcomes).markdown(), "", *(f"- {reason}" for reason in reasons(outcomes))]))
        return 0
    for mechanism in dict.fromkeys(outcome.mechanism for outcome in outcomes):
        table(outcomes, mechanism).print()
    for reason in reasons(outcomes):
        print(reason)
    return 0


def add_planar(commands: Any) -> None:
    """Add `gough planar`."""
    command = commands.add_parser(
        "planar",
        help="poses of a real planar rig from its measured leg angles",
        description="Solve the measured leg angles of a planar rig at known static poses, given in files pose_*.csv with the "
        "true pose in the first line. Prints the errors of the assembly mode that is nearest to the true pose.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("folder", type=Path, metavar="FOLDER", help="with the files pose_*.csv")
    command.add_argument("--mechanism", default="planar-3rpr", help="preset, or a TOML file")
    command.add_argument("--report", type=Path, metavar="FILE.html", help="write a report with plots")
    add_json(command)
    command.set_defaults(run=_planar)


def _planar(options: argparse.Namespace) -> int:
    from hil.studies.planar_rig import evaluate
    from plant.mechanism import load_mechanism
    from plant.mechanism.planar import PlanarMechanism

    check_outputs(options.json, options.report)
    mechanism = load_mechanism(options.mechanism)
    if not isinstance(mechanism, PlanarMechanism):
        raise InputError(f"{options.mechanism} has six legs in space; this needs three in the plane: choose another mechanism")
    result = evaluate(options.folder, mechanism)
    summary = result.summary()
    write_json(options.json, summary)
    if options.report:
        from hil.reports.planar_rig import write_report

        write_report(result, options.report)
    table = new_table(
        "RMS of the poses' mean errors", "x [mm]", "y [mm]", "angle [deg]", "leg angles [deg]", "true pose is a mode"
    )
    for source, figures in summary["sources"].items():
        rms = figures["rms"]
        table.add_row(
            source,
            mm(rms["x"], 2),
            mm(rms["y"], 2),
            deg(rms["angle"], 2),
            deg(figures["leg_angles"]["constant_error"], 2),
            f"{figures['true_mode']['poses']} of {len(result.poses)} poses",
        )
    print_table(table)
    return 0
