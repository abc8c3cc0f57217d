"""The commands about mechanisms, sensors and gains: classify, classes, accuracy, sensor-sets, tune, tune-fusion."""

from argparse import Namespace
from dataclasses import asdict

from hil.command_line import cli
from hil.command_line.terminal import deg, mm, progress_bar
from hil.runs.config import SimulationConfig
from hil.studies.config import TuningConfig
from hil.table import Table
from plant.files import write_whole


@cli.command(
    cli.argument("mechanism", metavar="PRESET|FILE.toml", help="preset, or a TOML file"),
    cli.report("write a report with drawings"),
    cli.JSON,
)
def gough_classify(options: Namespace) -> None:
    """Show the class of a mechanism, and the sensors that it needs.

    For each method of direct kinematics: the sensors that it needs, whether its pose is unique, and its conditioning (1 is
    best, 0 singular) at home and at worst.
    """
    from hil.studies.classification import PAPER, describe
    from plant.mechanism import load_mechanism

    description = describe(load_mechanism(options.mechanism))
    cli.write_json(options.json, description.summary())
    cli.write_report(options, "classification", description)
    found = description.mechanism_class
    print(
        f"{description.mechanism.name}: class {found.label}, a {found.name}; its legs, from base joints below to platform "
        "joints above:"
    )
    print(f"  {found.drawing}")
    table = Table("method", "needs", "section", "poses", "conditioning: home", "worst")
    for need in description.needs:
        method, text = need.requirement.method, need.requirement.text
        modes = "unique" if need.modes == 1 else f"{need.modes} modes"
        table.add(method, text, PAPER.get(method, "beyond"), modes, f"{need.home:.2g}", f"{need.worst:.2g}")
    table.print()
    for need in description.needs:
        if need.requirement.choice_text:
            print(f"{need.requirement.method}: legs {need.requirement.choice_text}")
    print(f"Worst over {description.where}. Sections are the paper's.")


@cli.command(
    cli.options_of(SimulationConfig, seed={"text": "seed of mechanisms, poses and noise"}),
    cli.markdown("docs/classes.md"),
    cli.JSON,
)
def gough_classes(options: Namespace) -> None:
    """Show what every class of mechanism needs, and its errors.

    For each of the 60 spatial and 4 planar classes: what the paper needs, what gough needs, and the median errors of each over
    random mechanisms and poses, for the noise of 'gough accuracy'.
    """
    from importlib.metadata import version

    from hil.studies.accuracy import class_table, evaluate_classes

    with progress_bar("classes") as progress:
        rows = evaluate_classes(options.seed, progress)
    about = {"seed": options.seed, "version": version("gough")}
    cli.write_json(options.json, about | {"classes": [asdict(row) for row in rows]})
    class_table(rows).print(options.markdown)


@cli.command(
    cli.options_of(SimulationConfig, "mechanism"),
    cli.setting("--poses", 2000, "number of random poses"),
    cli.options_of(SimulationConfig, seed={"text": "seed of poses and noise"}),
    cli.JSON,
)
def gough_accuracy(options: Namespace) -> None:
    """Find the errors of direct kinematics at a given noise.

    Errors of the paper's algorithms and of all legs together, at random poses about home (50 mm, 15 deg on hexapod), for noise
    of 0.05 deg on legs, roll and pitch, and 1.5 deg on a magnetic yaw.
    """
    from hil.studies.accuracy import evaluate_accuracy
    from plant.mechanism import load_spatial

    accuracy = evaluate_accuracy(load_spatial(options.mechanism), options.poses, options.seed)
    cli.write_json(options.json, accuracy.summary())
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


@cli.command(
    cli.argument("--mechanism", nargs="+", metavar="NAME", help="presets or TOML files (default: one of each type)"),
    cli.options_of(SimulationConfig, "seed", duration={"text": "duration of each motion"}),
    cli.markdown("docs/sensor_sets.md"),
    cli.JSON,
)
def gough_sensor_sets(options: Namespace) -> None:
    """Run the closed loop with fewer sensors, on every type of mechanism.

    It follows the target sines with every set of sensors, from the paper's least to all: legs alone, with the platform's roll
    and pitch, with its whole orientation (a magnetometer), by leg and platform filters and by the whole-mechanism filter.
    Prints the errors of the estimate, and the worst conditioning of direct kinematics.
    """
    from importlib.metadata import version

    from hil.studies.sensor_sets import MECHANISMS, evaluate_sensor_sets, reasons, table

    with progress_bar("sets of sensors") as progress:
        outcomes = evaluate_sensor_sets(
            options.mechanism or MECHANISMS, duration=options.duration, seed=options.seed, progress=progress
        )
    about = {"duration": options.duration, "seed": options.seed, "version": version("gough")}
    cli.write_json(options.json, about | {"sets": [asdict(outcome) for outcome in outcomes]})
    if options.markdown:
        print(f"{table(outcomes).markdown()}\n")
    else:
        for mechanism in dict.fromkeys(outcome.mechanism for outcome in outcomes):
            table(outcomes, mechanism).print()
    for reason in reasons(outcomes):
        print(f"{'- ' if options.markdown else ''}{reason}")


@cli.command(cli.options_of(SimulationConfig, "mechanism", "rate"), cli.JSON)
def gough_tune(options: Namespace) -> None:
    """Design the PID gains and show their margins.

    The gains follow from the linearised plant and filters.
    """
    from controller.design.tuning import tune
    from plant.mechanism import load_spatial

    design = tune(load_spatial(options.mechanism), options.rate)
    cli.write_json(options.json, design.summary())
    table = Table("", "value", "unit")
    for label, value, unit in design.rows():
        table.add(label, value, unit)
    table.print()


@cli.command(
    cli.output("output", "FILE.toml", "the mechanism to write, for --mechanism"),
    cli.options_of(TuningConfig),
    cli.JSON,
)
def gough_tune_fusion(options: Namespace) -> None:
    """Find the noise that the fusion should assume.

    Filters and refinement are tuned by consistency: on simulated motions (at rest, mixed, 1 Hz) their errors shall be as large
    as their covariances say, which is a NEES of 2 for a leg's angles and the platform's tilt, and of 6 for a pose. Writes the
    mechanism with the table [fusion] that was found.
    """
    from hil.studies.fusion_tuning import tune_fusion, tuned_text

    config = cli.config_of(options, TuningConfig)
    with progress_bar(f"noise of {config.mechanism} with {config.imu}") as progress:
        figures = tune_fusion(config, progress)
    settings = figures["settings"]
    found = {name: values["after"] for name, values in settings.items()}
    write_whole(options.output, tuned_text(config.mechanism, found).encode())
    cli.write_json(options.json, figures)
    table = Table("setting", "before", "after")
    for name, values in settings.items():
        table.add(name, f"{values['before']:.4g}", f"{values['after']:.4g}")
    table.print()
    table = Table(f"{len(config.seeds)} seeds", "NEES before", "after", "95 % bounds", "RMS before", "after")
    outside = []
    for name, estimator in figures["estimators"].items():
        before, after, (least, greatest) = estimator["before"], estimator["after"], estimator["bounds"]
        bounds, errors = f"{least:.2f} to {greatest:.2f}", (_rms(before["rms"]), _rms(after["rms"]))
        table.add(name, f"{before['nees']:.2f}", f"{after['nees']:.2f}", bounds, *errors)
        if not least <= after["nees"] <= greatest:
            outside.append(name)
    table.print()
    for name in outside:
        print(f"{name}: NEES stays outside its bounds, as beyond this its errors would grow by more than 2 %")
    print(f"written to {options.output}")


def _rms(errors: list[float]) -> str:
    """The RMS error of an angle, or of a position and a rotation."""
    angle = f"{deg(errors[-1])} deg"
    return angle if len(errors) == 1 else f"{mm(errors[0])} mm, {angle}"
