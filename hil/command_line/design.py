"""The commands about mechanisms, sensors and gains: from classify to optimise."""

from argparse import ArgumentTypeError, Namespace
from collections.abc import Sequence
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from hil.command_line import cli
from hil.command_line.terminal import deg, engine_at_work, mm, progress_bar, say
from hil.engine.settings import EngineSettings
from hil.runs.config import POSITION_DRIVES, SimulationConfig
from hil.studies.config import TuningConfig
from hil.studies.detectability.uncertainty import Uncertainty
from hil.table import Table
from plant.errors import InputError
from plant.extras import check_installed
from plant.files import write_whole

if TYPE_CHECKING:
    from controller.design.tuning import Design
    from hil.studies.workspace import Workspace
    from hil.sweep.optimisation import OptimisationResult, Trial
    from hil.sweep.trials import Comparison
    from plant.pose import Array


def _numbers(name: str, metavar: str, count: int, text: str) -> cli.Argument:
    """An option of so many numbers with commas between them."""

    def read(given: str) -> tuple[float, ...]:
        try:
            found = tuple(float(part) for part in given.split(","))
        except ValueError:
            found = ()
        if len(found) != count or not all(map(isfinite, found)):
            raise ArgumentTypeError(f"{given!r} is no {metavar}: give {count} numbers with commas between them")
        return found

    return cli.argument(name, type=read, metavar=metavar, help=text)


@cli.command(
    cli.argument("mechanism", metavar="PRESET|FILE.toml", help="preset, or a TOML file"),
    cli.report("write a report with drawings"),
    cli.JSON,
)
def gough_classify(options: Namespace) -> None:
    """Show the class of a mechanism, and the sensors that it needs.

    For each method of direct kinematics: the sensors that it needs, whether its pose is unique, and its conditioning (1 is
    best, 0 singular) at home and at worst. Then how many absolute encoders determine the pose beside how many leg IMUs, if it
    is found from a first guess.
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
    lengths = Table("beside leg IMUs, the platform's", "leg IMUs", "encoders", "wherever they are")
    for each in description.lengths:
        always = "-" if each.any_choice is None else f"{each.any_choice}"
        lengths.add(each.platform, f"{each.legs}", f"{each.fewest}", always)
    if lengths.rows:
        lengths.print()


@cli.command(
    cli.setting("--mechanisms", 20, "number of random mechanisms of each class"),
    cli.options_of(SimulationConfig, seed={"text": "seed of mechanisms, poses and noise"}),
    cli.markdown("docs/classes.md"),
    cli.engine_options(),
    cli.JSON,
)
def gough_classes(options: Namespace) -> None:
    """Show what every class of mechanism needs, and its errors.

    For each of the 60 spatial and 4 planar classes: what the paper needs, what gough needs, and the median errors of each over
    random mechanisms and poses, for the noise of 'gough accuracy'.
    """
    from importlib.metadata import version

    from hil.studies.accuracy import class_table, evaluate_classes

    with engine_at_work(cli.engine_of(options), "classes") as (engine, progress):
        rows = evaluate_classes(options.seed, engine, progress, options.mechanisms)
    about = {"mechanisms": options.mechanisms, "seed": options.seed, "version": version("gough")}
    cli.write_json(options.json, about | {"classes": [asdict(row) for row in rows]})
    class_table(rows).print(options.markdown)


@cli.command(
    cli.options_of(SimulationConfig, "mechanism"),
    cli.setting("--poses", 2000, "number of random poses"),
    cli.options_of(SimulationConfig, seed={"text": "seed of poses and noise"}),
    cli.engine_options(few="it takes seconds"),
    cli.JSON,
)
def gough_accuracy(options: Namespace) -> None:
    """Find the errors of direct kinematics at a given noise.

    Errors of the paper's algorithms and of all legs together, at random poses about home (50 mm, 15 deg on hexapod), for noise
    of 0.05 deg on legs, roll and pitch, and 1.5 deg on a magnetic yaw.
    """
    from hil.studies.accuracy import evaluate_accuracy
    from plant.mechanism import load_spatial

    with engine_at_work(cli.engine_of(options), "methods") as (engine, _):
        accuracy = evaluate_accuracy(load_spatial(options.mechanism), options.poses, options.seed, engine)
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
    cli.options_of(SimulationConfig, "mechanism", "imus", "magnetometer"),
    cli.argument(
        "--set",
        action="append",
        default=[],
        metavar="ENTRY=VALUE",
        help="also with another entry of the mechanism's file, in SI units, such as limits.stroke=[-0.05,0.05], "
        "joints.base_swing=0.6, bodies.leg_diameter=0.03 or geometry.platform_radius=0.15; several change it together",
    ),
    _numbers("--at", "X,Y,Z", 3, "where it begins: the platform's position in the base frame [mm] (default: home)"),
    _numbers("--turned", "RX,RY,RZ", 3, "and its rotation vector from home, in the base frame [deg] (default: 0,0,0)"),
    _numbers("--twist", "VX,VY,VZ,WX,WY,WZ", 6, "velocity that the platform must make everywhere [mm/s, deg/s]"),
    _numbers("--load", "FX,FY,FZ,MX,MY,MZ", 6, "force and moment that act on it besides all weights [N, Nm]"),
    _numbers("--box", "X,Y,Z,RX,RY,RZ", 6, "ratios of the largest box and ellipsoid [mm, deg] (default: 1,1,1,0,0,0)"),
    cli.flag("--geometry", "strokes, swings and clearances alone, without forces and conditioning"),
    cli.setting("--points", 81, "points of a slice along an edge"),
    cli.output("--picture", "FILE.svg", "draw the slices"),
    cli.report("write a report with tables and slices"),
    cli.JSON,
)
def gough_workspace(options: Namespace) -> None:
    """Find where a mechanism can go, and what limits it there.

    From home or another pose: the margin of every limit, how far the platform gets along each axis and what ends it, the volume
    that straight moves reach, the largest box and ellipsoid in which every pose is reached, and slices. What limits: strokes;
    swings of the joints and clearances between legs and plates, if the mechanism's file has them (docs/workspace.md); motors,
    which hold all weights; and the conditioning of the Jacobian, and of direct kinematics with the IMUs that there are.

    With --set, all figures also for the mechanism with that change.
    """
    import numpy as np

    from controller.workspace import Demands
    from hil.studies import workspace

    if not 3 <= options.points <= 1001:
        raise InputError(f"a slice has {options.points} points along an edge; it can have 3 to 1001")
    units = np.repeat([1e-3, np.radians(1.0)], 3)
    move = np.append(np.zeros(3), np.radians(options.turned or np.zeros(3)))
    demands = Demands(
        twist=None if options.twist is None else units * options.twist,
        load=np.zeros(6) if options.load is None else np.array(options.load),
        forces=not options.geometry,
        conditioning=not options.geometry,
        imus=options.imus,
        magnetometer=options.magnetometer,
    )
    shape = workspace.shape_from(options.box or (1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
    cases = [("as it is", []), *([("changed", options.set)] if options.set else [])]
    mechanisms = [(label, workspace.changed_mechanism(options.mechanism, changes)) for label, changes in cases]
    found = []
    with progress_bar("the workspace") as progress:
        for number, (label, mechanism) in enumerate(mechanisms):
            progress(number / len(mechanisms))
            at = None if options.at is None else 1e-3 * np.array(options.at)
            found.append(workspace.explore(mechanism, label, move, shape, demands, options.points, at))
    cli.write_json(options.json, workspace.summary(found, demands))
    tables = workspace_tables(found)
    if options.picture is not None:
        from hil.reports.workspace_picture import write_picture

        write_picture(found, options.picture)
    cli.write_report(options, "workspace", found, tables)
    for _, table in tables:
        table.print()
    if options.set:
        print(f"changed: {' '.join(options.set)}")


def workspace_tables(found: "Sequence[Workspace]") -> list[tuple[str, Table]]:
    """The figures of workspaces, side by side, as titled tables."""
    from controller.workspace import KINDS
    from hil.studies.workspace import by_kind

    headings = [heading for each in found for heading in ((each.label, "margin"), (each.label, "least"))]
    at_pose = Table("at the pose", *headings)
    for kind in KINDS:
        least = [each.least(kind) for each in found]
        if any(text for _, text in least):
            at_pose.add(kind, *(cell for value, text in least for cell in (_in_unit(value, kind), text or "no limit")))
    headings = [heading for each in found for heading in ((each.label, "way"), (each.label, "ended by"))]
    travels = Table("travel along", *headings)
    for name in found[0].travels:
        cells = []
        for each in found:
            one = each.travels[name]
            way = f"{deg(one.angle, 2)} deg" if name[1] == "r" else f"{mm(one.distance, 2)} mm"
            cells += [way, one.limit.text if one.limit else "a full turn"]
        travels.add(name, *cells)
    regions = Table("region about the pose", *(each.label for each in found))
    flat = found[0].mechanism.planar
    unit, scale = ("cm2", 1e4) if flat else ("dm3", 1e3)
    regions.add("straight moves reach", *(f"{scale * each.reach.volume:.4g} {unit}" for each in found))
    unit = "rad" if flat else "rad3"
    regions.add("turns in place reach", *(f"{each.turns.volume:.4g} {unit}" for each in found))
    for name in ("box", "ellipsoid"):
        regions.add(f"largest {name}, half sizes", *(_sizes(getattr(each, name).half_sizes) for each in found))
        touched = [getattr(each, name).limit for each in found]
        regions.add(f"largest {name} touches", *(limit.text if limit else "a full turn" for limit in touched))
    binds = Table("ends this share of straight moves [%]", *(each.label for each in found))
    shares = [by_kind(each.reach.shares) for each in found]
    for kind in dict.fromkeys(kind for each in shares for kind in each):
        binds.add(kind, *(f"{100.0 * each.get(kind, 0.0):.1f}" for each in shares))
    titles = ("Margins at the pose", "Travel", "Region", "What ends straight moves")
    return list(zip(titles, (at_pose, travels, regions, binds), strict=True))


def _in_unit(value: float, kind: str) -> str:
    """A margin in the unit in which it is shown."""
    if value == float("inf"):
        return "-"
    if kind.endswith("swing"):
        return f"{deg(value, 2)} deg"
    if kind == "force":
        return f"{value:.1f} N"
    if kind == "speed":
        return f"{mm(value, 1)} mm/s"
    return f"{value:.3g}" if kind in ("Jacobian", "direct kinematics") else f"{mm(value, 2)} mm"


def _sizes(half_sizes: "Array") -> str:
    """Half sizes along the axes that vary, in mm and deg."""
    lengths, angles = half_sizes[:3], half_sizes[3:]
    parts = [" x ".join(mm(each, 2) for each in lengths if each > 0.0)] if lengths.any() else []
    texts = [f"{parts[0]} mm"] if parts else []
    if angles.any():
        texts.append(f"{' x '.join(deg(each, 2) for each in angles if each > 0.0)} deg")
    return ", ".join(texts)


@cli.command(
    cli.argument("--mechanism", nargs="+", metavar="NAME", help="presets or TOML files (default: one of each type)"),
    cli.options_of(SimulationConfig, "seed", duration={"text": "duration of each motion"}),
    cli.flag("--bounds", "run nothing, and print what each set is worth at best, and when one sensor of it fails"),
    cli.markdown("docs/sensor_sets.md"),
    cli.engine_options(),
    cli.JSON,
)
def gough_sensor_sets(options: Namespace) -> None:
    """Run the closed loop with fewer sensors, on every type of mechanism.

    It follows the target sines with every set of sensors, from the paper's least to all: legs alone, with the platform's roll
    and pitch, with its whole orientation (a magnetometer), by leg and platform filters and by the whole-mechanism filter.
    Prints the errors of the estimate, and the worst conditioning of direct kinematics.

    With --bounds: the bound of 'gough bounds' after 1 s at rest, without lengths, with incremental and with absolute encoders
    [mm / deg]; and that without the IMU, or the encoder, whose loss is worst. A dash stands for a pose that is not determined.
    """
    from importlib.metadata import version

    from hil.studies.sensor_sets import MECHANISMS, SETS, evaluate_sensor_sets, reasons, table

    if options.bounds:
        from hil.studies.pose_bound import sets

        with engine_at_work(cli.engine_of(options), "sets of sensors") as (engine, progress):
            worths = sets.evaluate_worth(options.mechanism or MECHANISMS, engine=engine, progress=progress)
        cli.write_json(options.json, {"version": version("gough"), "sets": [asdict(worth) for worth in worths]})
        sets.table(worths).print(options.markdown)
        return
    with engine_at_work(cli.engine_of(options), "sets of sensors") as (engine, progress):
        names = options.mechanism or MECHANISMS
        outcomes = evaluate_sensor_sets(names, SETS, options.duration, options.seed, engine, progress)
    about = {"duration": options.duration, "seed": options.seed, "version": version("gough")}
    cli.write_json(options.json, about | {"sets": [asdict(outcome) for outcome in outcomes]})
    if options.markdown:
        print(f"{table(outcomes).markdown()}\n")
    else:
        for mechanism in dict.fromkeys(outcome.mechanism for outcome in outcomes):
            table(outcomes, mechanism).print()
    for reason in reasons(outcomes):
        print(f"{'- ' if options.markdown else ''}{reason}")


@cli.command(
    cli.options_of(
        SimulationConfig,
        "mechanism",
        target={"default": "hold"},
        duration={"default": 5.0},
        rate={},
        imu={},
        imus={},
        magnetometer={},
        lengths={},
        base_imu={},
        faults={
            "text": "with --base-imu: how the base moves, as for 'gough simulate', such as "
            "base-tilt,axis=x,size_deg=3,sine_hz=0.125; can be given several times"
        },
        calibration={"text": "the covariance of a calibration instead of the errors that the kind of IMU has"},
        joint_error={"text": "standard deviation of each coordinate of the joints from their places"},
        fusion={"default": "whole", "text": "with --measured: how the loop fuses the IMUs, as for 'gough simulate'"},
    ),
    cli.flag("--measured", "run the closed loop, too, and print its errors over the bound"),
    cli.setting("--seeds", 20, "with --measured: runs, each with other imperfections of the sensors"),
    cli.argument("--since", type=float, metavar="SECONDS", help="also over the motion from this time of it on [s]"),
    cli.markdown("docs/pose_bound.md"),
    cli.engine_options(),
    cli.JSON,
)
def gough_bounds(options: Namespace) -> None:
    """Compute how well any estimate can know the pose with a set of sensors.

    This is the Bayesian Cramer-Rao bound along a target, at rest by default: the least RMS errors of position and rotation that
    the readings allow, if the errors of IMUs and encoders are drawn as their kinds say and nothing is known of the pose before.
    It shares no code with the loop's filters. A dash stands for a pose that the sensors do not determine.

    With --base-imu the base may move, and how it does is not known either.

    With --measured, the closed loop's errors over seeds stand beside it.
    """
    from hil.studies.pose_bound.bound import check_since, find_bound, measure, summary, table

    config = cli.config_of(options, SimulationConfig)
    check_since(config, options.since)
    with engine_at_work(cli.engine_of(options), "seeds") as (engine, progress):
        bound = find_bound(config)
        measured = measure(config, options.seeds, engine, progress) if options.measured else None
    cli.write_json(options.json, summary(config, bound, measured, options.since))
    table(bound, measured, options.since).print(options.markdown)
    for reason in dict.fromkeys(measured.stopped if measured else ()):
        say(f"a run ended early: {reason}")


@cli.command(
    cli.argument(
        "rows", nargs="*", metavar="TEXT", help="rows of gough faults with this in their names or kinds (default: all)"
    ),
    cli.options_of(SimulationConfig, "mechanism", "target", "duration", "rate", "imu", only_given=True),
    cli.options_of(
        SimulationConfig, faults={"text": "instead of rows: what happens, as for 'gough simulate'; several act together"}
    ),
    cli.seed_options("how often each row is drawn: its IMUs, signs and times"),
    cli.source("--measured", "FILE.json", "figures of 'gough faults --json', to compare"),
    cli.options_of(Uncertainty),
    cli.markdown("docs/detectability.md"),
    cli.engine_options(),
    cli.JSON,
)
def gough_detectability(options: Namespace) -> int:
    """Compute how far off a pose can be before any test could tell.

    For each row of the disturbances of gough faults, this is the likelihood-ratio test of the fault against none. It has the
    data of the loop: accelerometers, gyroscopes and the drives' model. It gives less than one false alarm in 100 h.

    The table has: when the test tells the fault with a probability of 99.9 % [s], and how much of the fault is there then; the
    error of the pose until then [mm / deg], of which 99.9 % of all errors are below, and the part that the fault alone
    contributes; 1.5 times this error; the limit, which is that or, if greater, 3 mm and 0.7 deg for faults of few IMUs and
    5 mm and 1 deg for shared ones; the least share of the fault that would be told in the run, and the error by it; the least
    protection level that covers the error in 99.9 % of the cycles, and how many times the RMS error of a sound estimate it is.

    A row that is drawn anew by each seed has a line for each. With --measured, the exit status is 1 if an error until
    something was told is beyond the limit. Nothing is simulated.
    """
    from hil.faults.bounds import bounds_of_rows, left_out, read_figures, summary, table
    from hil.faults.rows import SOUND, Row, all_rows

    seeds = cli.seeds_of(options)
    texts = options.rows or [""]
    asked = [row for row in all_rows() if any(text in row.name or text in row.kind for text in texts)]
    rows = [row for row in asked if row.kind != SOUND]
    if options.faults:
        rows = [Row(" ".join(options.faults), "own", tuple(options.faults))]
    if not rows:
        called = " or ".join(map(repr, texts))
        if asked:
            raise InputError(
                f"in the rows with {called} in their names or kinds nothing is disturbed, so there is nothing to detect: "
                "choose others ('gough faults --list' has all), or see what the loop tells in these: "
                f"gough faults --only {SOUND}"
            )
        raise InputError(f"no row has {called} in its name: 'gough faults --list' has all")
    given = {
        name: getattr(options, name) for name in ("mechanism", "target", "duration", "rate", "imu") if hasattr(options, name)
    }
    measured = read_figures(options.measured) if options.measured else None
    uncertainty = cli.config_of(options, Uncertainty)
    with engine_at_work(cli.engine_of(options), "rows") as (engine, progress):
        found = bounds_of_rows([row.with_entries(given) for row in rows], seeds, uncertainty, engine, progress)
    table(found, measured).print(options.markdown)
    cli.write_json(options.json, summary(found, uncertainty, measured))
    for line in left_out(found):
        say(f"no bound for {line}")
    return int(measured is not None and any(row.beyond(measured) for row in found))


@cli.command(
    cli.options_of(SimulationConfig, "mechanism", "rate", "drives"),
    cli.options_of(SimulationConfig, imu={"default": "ideal", "text": "kind of IMU, whose low-passes and delay the loop has"}),
    cli.setting("--delay", 0.0, "from a sample to when the drives take the command computed from it, as of a bus [ms]"),
    cli.argument("--crossover", type=float, metavar="HZ", help="of the fastest leg at home [Hz] (default: the highest)"),
    cli.setting("--sensitivity", 2.0, "greatest peak of the sensitivity at home, all loops closed; 1.5 times that elsewhere"),
    cli.setting("--phase-margin", 65.0, "least phase margin of a leg at home; half of that elsewhere [deg]"),
    cli.setting("--gain-margin", 12.0, "least gain margin of a leg at home; half of that elsewhere [dB]"),
    cli.setting("--poses", 40, "number of random poses of the workspace; 0 for home alone"),
    cli.options_of(SimulationConfig, seed={"text": "seed of the poses"}),
    cli.output("--write", "FILE.toml", "write the mechanism with these gains, for --mechanism"),
    cli.report("write a report with Bode, Nyquist and step diagrams and maps of margins"),
    cli.JSON,
)
def gough_tune(options: Namespace) -> None:
    """Design the PID gains and show their margins.

    The gains follow from the linearised plant, drives, IMUs and filters, at home and at poses of the workspace: the highest, or
    those with the crossover that is asked for, with which sensitivity peak and margins are kept. Elsewhere half of the margins
    will do. Coulomb friction is left out, as it is constant for a leg that moves (docs/tuning.md).

    Margins are of each leg with the others closed; of all legs together, as when a bus is late; and of all legs at once, each
    with an error of its own (disk margins). All of them after 10 s, when the filters have settled.
    """
    from controller.design.linear_loop import Setup
    from controller.design.tuning import Rule, tune, tuned_text
    from hil.rigs.position_loops import BANDWIDTH
    from plant.imu import load_imu
    from plant.mechanism import load_in_space

    imu = load_imu(options.imu)
    setup = Setup(
        options.rate,
        1e-3 * options.delay,
        None if imu.name == "ideal" else imu,
        BANDWIDTH if options.drives == POSITION_DRIVES else None,
    )
    rule = Rule(options.crossover, options.sensitivity, options.phase_margin, options.gain_margin)
    with progress_bar(f"gains of {options.mechanism}") as progress:
        design = tune(load_in_space(options.mechanism), setup, rule, options.poses, options.seed, progress)
    if options.write is not None:
        write_whole(options.write, tuned_text(options.mechanism, design).encode())
    cli.write_json(options.json, design.summary())
    tables = tuning_tables(design)
    cli.write_report(options, "tuning", design, tables)
    for _, table in tables:
        table.print()
    print(design.remark)
    if options.write is not None:
        hold = "" if design.longer_hold is None else f", and hold = {design.longer_hold:g}"
        print(f"written to {options.write}: these gains{hold}")


def tuning_tables(design: "Design") -> list[tuple[str, Table]]:
    """The figures of a design, as titled tables."""
    at_home = Table("", "value", "unit")
    for label, value, unit in design.rows():
        at_home.add(label, value, unit)
    found = [("Gains, and margins at home", at_home)]
    if design.workspace:
        poses = f"{len(design.workspace)} poses of the workspace"
        everywhere = Table(poses, "at home", "worst", "at x, y, z [mm]", "turned by rx, ry, rz [deg]")
        for row in design.workspace_rows():
            everywhere.add(*row)
        found.append(("Margins in the workspace", everywhere))
    worst = " (worst)" if design.workspace else ""
    names = "gain margin [dB]", "phase margin [deg]", "delay margin [ms]", "crossover [Hz]"
    legs = Table(f"a leg, the others closed, at home{worst}", *names)
    for cells in design.leg_rows():
        legs.add(*cells)
    return [*found, ("Margins by leg", legs)]


@cli.command(
    cli.output("output", "FILE.toml", "the mechanism to write, for --mechanism"),
    cli.options_of(TuningConfig),
    cli.engine_options(),
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
    with engine_at_work(cli.engine_of(options), f"noise of {config.mechanism} with {config.imu}") as (engine, progress):
        figures = tune_fusion(config, engine, progress)
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


@cli.command(
    cli.source("design", "DESIGN.toml", "what is run, what varies, what is better and what is allowed (docs/optimisation.md)"),
    cli.argument("--results", type=Path, metavar="FOLDER", help="where the results are kept (default: DESIGN.results)"),
    cli.setting("--choose", "knee", "a trial of the front: its number, knee, or first for the best in the first objective"),
    cli.output("--write", "FILE.toml", "write the chosen mechanism, for 'gough simulate --mechanism'"),
    cli.options_of(EngineSettings),
    cli.report("write a report with the front and all trials"),
    cli.JSON,
)
def gough_optimise(options: Namespace) -> None:
    """Look for the best geometry, IMUs and gains, within bounds.

    The design's file says what varies, which figures should be small or large, and which must stay within bounds. An
    optimisation that was interrupted goes on where it stopped. Prints the Pareto front: the trials that no other beats in
    all objectives; the knee is the one nearest to the best of all. If the file has a check, the chosen trial is compared with
    the design as it is, on seeds that the search did not use.
    """
    check_installed("optuna")
    check_installed("pyarrow")
    from hil.sweep.design import read_design
    from hil.sweep.optimisation import check, mechanism_of, optimise

    cli.check_outputs(options, [options.design])
    design, settings = read_design(options.design), cli.config_of(options, EngineSettings)
    if options.write is not None and design.study.model is not None:
        raise InputError("a model has no mechanism that could be written: leave --write out")
    if options.choose not in ("knee", "first") and not options.choose.isdecimal():
        raise InputError(f"--choose {options.choose} is no trial: give its number, knee, or first")
    folder = options.results or options.design.with_suffix(".results")
    with engine_at_work(settings, design.study.name) as (engine, progress):
        result = optimise(design, folder, engine, progress)
        # A search may have found nothing to choose.
        cli.write_json(options.json, result.summary())
        trial = result.chosen(options.choose)
        comparisons = check(result, trial, engine, progress)
    if options.write is not None:
        write_whole(options.write, mechanism_of(result, trial).encode())
    about = {"chosen": trial.number, "check": [asdict(each) for each in comparisons]}
    cli.write_json(options.json, result.summary() | about)
    cli.write_report(options, "optimisation", result, trial, comparisons)
    _print_front(result, trial)
    if comparisons:
        _print_check(design.search.seeds, comparisons)
    if options.write is not None:
        print(f"trial {trial.number} is written to {options.write}")


_MOST_COLUMNS = 8


def _print_front(result: "OptimisationResult", chosen: "Trial") -> None:
    from hil.sweep.units import headed, label_of, unit_of_factor, unit_of_figure

    study, marks = result.design.study, {chosen.number: " *"}
    units = {name: unit_of_figure(name) for name in result.design.pools}
    table = Table("trial", *(headed(_broken(name), unit) for name, (unit, _) in units.items()))
    rows = [("as it was", result.start)] if result.start else []
    rows += [(f"{trial.number}{marks.get(trial.number, '')}", trial.figures) for trial in result.front]
    for label, figures in rows:
        table.add(label, *(f"{scale * figures[name]:.4g}" for name, (_, scale) in units.items()))
    table.print()
    if len(chosen.point) <= _MOST_COLUMNS:
        units = {name: unit_of_factor(study, name) for name in chosen.point}
        table = Table("trial", *(headed(_broken(name), unit) for name, (unit, _) in units.items()))
        for trial in result.front:
            cells = (label_of(value, units[name][1]) for name, value in trial.point.items())
            table.add(f"{trial.number}{marks.get(trial.number, '')}", *cells)
        table.print()
    count = result.summary()["trials"]
    print(
        f"{len(result.trials)} trials, {result.ran} new runs; {count['run']} within all bounds, {count['refused']} not, "
        f"{count['given up']} given up early; * is chosen; in {result.folder}"
    )


def _print_check(first: int, comparisons: "Sequence[Comparison]") -> None:
    from hil.sweep.units import headed, label_of, unit_of_figure

    table = Table(f"check, {comparisons[0].seeds} seeds from {first} on", "as it was", "chosen", "change", "better at")
    for each in comparisons:
        unit, scale = unit_of_figure(each.figure)
        where = f" ({', '.join(map(label_of, each.values.values()))})" if each.values else ""
        change = f"{100.0 * (each.chosen / each.start - 1.0):+.1f} %" if each.start else ""
        better = "" if each.better is None else f"{each.better} of {each.seeds} seeds"
        cells = (f"{scale * each.start:.4g}", f"{scale * each.chosen:.4g}", change, better)
        table.add(f"{headed(each.figure, unit)}{where}", *cells)
    table.print()


def _broken(name: str) -> str:
    """A name that breaks into short lines."""
    return name.replace(".", ". ").replace("_", " ")
