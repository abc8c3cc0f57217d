"""The commands about mechanisms, sensors and gains: classify, classes, accuracy, sensor-sets, tune, tune-fusion."""

import argparse
from dataclasses import asdict
from pathlib import Path

from hil.command_line.options import add_options, config_of
from hil.command_line.outputs import add_json, add_markdown, check_outputs, show_table, write_json
from hil.command_line.terminal import deg, mm, progress_bar
from hil.runs.config import SimulationConfig
from hil.studies.config import TuningConfig
from hil.table import Table
from plant.files import write_whole


def add_classify(command: argparse.ArgumentParser) -> None:
    """Show the class of a mechanism, and the sensors that it needs.

    For each method of direct kinematics: the sensors that it needs, whether its pose is unique, and its conditioning (1 is
    best, 0 singular) at home and at worst.
    """
    command.add_argument("mechanism", metavar="PRESET|FILE.toml", help="preset, or a TOML file")
    command.add_argument("--report", type=Path, metavar="FILE.html", help="write a report with drawings")
    add_json(command)
    command.set_defaults(run=_classify)


def _classify(options: argparse.Namespace) -> int:
    from hil.studies.classification import PAPER, describe
    from plant.mechanism import load_mechanism

    check_outputs(options.json, report=options.report)
    description = describe(load_mechanism(options.mechanism))
    write_json(options.json, description.summary())
    if options.report:
        from hil.reports.classification import write_report

        write_report(description, options.report)
    mechanism_class = description.mechanism_class
    print(f"{description.mechanism.name}: class {mechanism_class.label}, a {mechanism_class.name} with the graph")
    print(f"  {mechanism_class.drawing}")
    table = Table("method", "needs", "section", "poses", "conditioning: home", "worst")
    for need in description.needs:
        method = need.requirement.method
        modes = "unique" if need.modes == 1 else f"{need.modes} modes"
        row = (need.requirement.text, PAPER.get(method, "beyond"), modes, f"{need.home:.2g}", f"{need.worst:.2g}")
        table.add(method, *row)
    table.print()
    for need in description.needs:
        if need.requirement.choice_text:
            print(f"{need.requirement.method}: legs {need.requirement.choice_text}")
    print(f"Worst over {description.where}. Sections are the paper's.")
    return 0


def add_classes(command: argparse.ArgumentParser) -> None:
    """Show what every class of mechanism needs, and its errors.

    For each of the 60 spatial and 4 planar classes: what the paper needs, what gough needs, and the median errors of each over
    random mechanisms and poses, for the noise of 'gough accuracy'.
    """
    add_options(command, SimulationConfig, seed={"text": "seed of mechanisms, poses and noise"})
    add_markdown(command, "docs/classes.md")
    add_json(command)
    command.set_defaults(run=_classes)


def _classes(options: argparse.Namespace) -> int:
    from importlib.metadata import version

    from hil.studies.accuracy import class_table, evaluate_classes

    check_outputs(options.json)
    with progress_bar("classes") as progress:
        rows = evaluate_classes(options.seed, progress)
    write_json(options.json, {"seed": options.seed, "version": version("gough"), "classes": [asdict(row) for row in rows]})
    show_table(class_table(rows), options.markdown)
    return 0


def add_accuracy(command: argparse.ArgumentParser) -> None:
    """Find the errors of direct kinematics at a given noise.

    Errors of the paper's algorithms and of all legs together, at random poses about home (50 mm, 15 deg on hexapod), for noise
    of 0.05 deg on legs, roll and pitch, and 1.5 deg on a magnetic yaw.
    """
    add_options(command, SimulationConfig, "mechanism")
    command.add_argument("--poses", type=int, default=2000, help="number of random poses (default: %(default)s)")
    add_options(command, SimulationConfig, seed={"text": "seed of poses and noise"})
    add_json(command)
    command.set_defaults(run=_accuracy)


def _accuracy(options: argparse.Namespace) -> int:
    from hil.studies.accuracy import evaluate_accuracy
    from plant.mechanism import load_spatial

    check_outputs(options.json)
    accuracy = evaluate_accuracy(load_spatial(options.mechanism), options.poses, options.seed)
    write_json(options.json, accuracy.summary())
    table = Table("RMS errors", "position [mm]", "rotation [deg]", "over the bound", "NEES", "solved [%]")
    for estimator, errors in accuracy.errors.items():
        table.add(
            estimator.label,
            mm(errors.position_rms),
            deg(errors.rotation_rms),
            f"{errors.position_over_bound:.3f}, {errors.rotation_over_bound:.3f}",
            f"{errors.nees:.2f}" if estimator.refine else "-",
            f"{100.0 * errors.solved:.1f}",
        )
    table.print()
    least, greatest = accuracy.nees_bounds
    print(
        f"{accuracy.mechanism}, class {accuracy.mechanism_class.label}, {accuracy.poses} poses; the bound is Cramer and Rao's; "
        f"NEES is 6 on average, {least:.2f} to {greatest:.2f} in 99 % of such runs, if the covariance is right"
    )
    return 0


def add_sensor_sets(command: argparse.ArgumentParser) -> None:
    """Run the closed loop with fewer sensors, on every type of mechanism.

    It follows the target sines with every set of sensors, from the paper's least to all: legs alone, with the platform's roll
    and pitch, with its whole orientation (a magnetometer), by leg and platform filters and by the whole-mechanism filter.
    Prints the errors of the estimate, and the worst conditioning of direct kinematics.
    """
    command.add_argument("--mechanism", nargs="+", metavar="NAME", help="presets or TOML files (default: one of each type)")
    add_options(command, SimulationConfig, "seed", duration={"text": "duration of each motion"})
    add_markdown(command, "docs/sensor_sets.md")
    add_json(command)
    command.set_defaults(run=_sensor_sets)


def _sensor_sets(options: argparse.Namespace) -> int:
    from importlib.metadata import version

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


def add_tune(command: argparse.ArgumentParser) -> None:
    """Design the PID gains and show their margins.

    The gains follow from the linearised plant and filters.
    """
    add_options(command, SimulationConfig, "mechanism", "rate")
    add_json(command)
    command.set_defaults(run=_tune)


def _tune(options: argparse.Namespace) -> int:
    from controller.design.tuning import tune
    from plant.mechanism import load_spatial

    check_outputs(options.json)
    design = tune(load_spatial(options.mechanism), options.rate)
    write_json(options.json, design.summary())
    table = Table("", "value", "unit")
    for label, value, unit in design.rows():
        table.add(label, value, unit)
    table.print()
    return 0


def add_tune_fusion(command: argparse.ArgumentParser) -> None:
    """Find the noise that the fusion should assume.

    Filters and refinement are tuned by consistency: on simulated motions (at rest, mixed, 1 Hz) their errors shall be as large
    as their covariances say, which is a NEES of 2 for a leg's angles and the platform's tilt, and of 6 for a pose. Writes the
    mechanism with the table [fusion] that was found.
    """
    command.add_argument("output", type=Path, metavar="FILE.toml", help="the mechanism to write, for --mechanism")
    add_options(command, TuningConfig)
    add_json(command)
    command.set_defaults(run=_tune_fusion)


def _tune_fusion(options: argparse.Namespace) -> int:
    from hil.studies.fusion_tuning import tune_fusion, tuned_text

    check_outputs(options.output, options.json)
    config = config_of(options, TuningConfig)
    with progress_bar(f"noise of {config.mechanism} with {config.imu}") as progress:
        figures = tune_fusion(config, progress)
    found = {name: values["after"] for name, values in figures["settings"].items()}
    write_whole(options.output, tuned_text(config.mechanism, found).encode())
    write_json(options.json, figures)
    table = Table("setting", "before", "after")
    for name, values in figures["settings"].items():
        table.add(name, f"{values['before']:.4g}", f"{values['after']:.4g}")
    table.print()
    outside = []
    table = Table(f"{len(config.seeds)} seeds", "NEES before", "after", "95 % bounds", "RMS before", "after")
    for name, estimator in figures["estimators"].items():
        before, after = estimator["before"], estimator["after"]
        least, greatest = estimator["bounds"]
        units = ((deg, "deg"),) if len(before["rms"]) == 1 else ((mm, "mm"), (deg, "deg"))
        errors = (
            ", ".join(f"{text(value)} {unit}" for (text, unit), value in zip(units, each["rms"], strict=True))
            for each in (before, after)
        )
        table.add(name, f"{before['nees']:.2f}", f"{after['nees']:.2f}", f"{least:.2f} to {greatest:.2f}", *errors)
        if not least <= after["nees"] <= greatest:
            outside.append(name)
    table.print()
    for name in outside:
        print(f"{name}: NEES stays outside its bounds, as beyond this its errors would grow by more than 2 %")
    print(f"written to {options.output}")
    return 0
