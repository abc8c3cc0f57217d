"""The studies: sweep, compare-fusion, evaluate-fusion, faults, planar, broad."""

import sys
from argparse import SUPPRESS, Namespace
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.command_line import cli
from hil.command_line.terminal import deg, duration, engine_at_work, mm, mm_deg, number_text, progress_bar
from hil.engine.settings import EngineSettings
from hil.runs.config import SimulationConfig
from hil.studies.config import SECTIONS, ComparisonConfig, EvaluationConfig
from hil.table import Table
from plant.encoders import NO_LENGTHS, load_encoder
from plant.errors import InputError
from plant.extras import check_installed

if TYPE_CHECKING:
    from hil.sweep.analysis import Quantile
    from hil.sweep.sweep import SweepResult


@cli.command(
    cli.source("study", "STUDY.toml", "what is run, what varies and what is measured (docs/sweeps.md)"),
    cli.argument("--results", type=Path, metavar="FOLDER", help="where the table is kept (default: STUDY.results)"),
    cli.flag("--dry-run", "say how many runs there are, and how long they take by a first one that is measured"),
    cli.options_of(EngineSettings),
    cli.report("write a report with distributions, main effects and sensitivities"),
    cli.output("--picture", "FILE.svg", "draw the figures over up to three factors"),
    cli.JSON,
)
def gough_sweep(options: Namespace) -> int:
    """Run a study with many runs, on all processors or on a cluster.

    The study's file says what varies, in SI units: fields of a run, entries of the mechanism's file, parameters of the plant.
    Every run is a row of a table in Parquet. A sweep that was interrupted goes on where it stopped. Prints the distribution of
    every figure, over all runs and at each value of the crossed factors, how much each factor explains, and Sobol indices if
    saltelli samples the ranges; position in mm, rotation in deg. The exit status is 1 if a run has failed; its row has the
    reason.
    """
    check_installed("pyarrow")
    from hil.reports.sweep_picture import drawn_factors, write_picture
    from hil.sweep.store import TABLE
    from hil.sweep.study import read_study
    from hil.sweep.sweep import estimate, run_study

    cli.check_outputs(options, [options.study])
    study, settings = read_study(options.study), cli.config_of(options, EngineSettings)
    if options.picture is not None:
        drawn_factors(study)
    folder = options.results or options.study.with_suffix(".results")
    if options.dry_run:
        with progress_bar("the first run"):
            found = estimate(study, folder)
        workers = 1 if settings.scheduler else max(1, settings.processes)
        total = found.total(workers)
        print(
            f"{found.points} runs, of which {found.known} are in {folder} already; a run takes {found.seconds:.3g} s on this "
            f"machine: {duration(total)} with {workers} worker{'s' * (workers > 1)}"
        )
        cli.write_json(options.json, {**asdict(found), "total_seconds": total, "version": version("gough")})
        return 0
    with engine_at_work(settings, study.name) as (engine, progress):
        result = run_study(study, folder, engine, progress)
    cli.write_json(options.json, result.summary())
    cli.write_report(options, "sweep", result)
    _print_sweep(result)
    print(f"{len(result.table)} runs, {result.ran} of them new, in {folder / TABLE}")
    if result.failed:
        reason, *_ = result.first_reason.partition("\n")
        print(f"{result.failed} of {len(result.table)} runs failed; why the first one did: {reason}", file=sys.stderr)
    if options.picture is not None:
        write_picture(result, options.picture)
    return int(result.failed > 0)


_MOST_PRINTED = 8
"""Figures that are printed by factor; JSON and the report have the others."""


def _print_sweep(result: "SweepResult") -> None:
    from hil.sweep.units import headed, unit_of_figure

    table = Table("over all runs", "median", "90 %", "95 % confidence", "99 %", "95 % confidence")
    known = [name for name in result.figures() if result.analysis.over_all(name)]
    for name in known:
        unit, scale = unit_of_figure(name)
        level = result.analysis.over_all(name)
        half, *cells = (text for each in level.quantiles for text in _with_interval(each, scale)) if level else [""] * 6
        table.add(headed(name, unit), half, *cells[1:])
    if known:
        table.print()
    for name in result.figures():
        if name not in known and result.failed < len(result.table):
            print(f"{name}: no run has a finite number")
    for name in known[:_MOST_PRINTED]:
        _print_by_factor(result, name)
    for name in known[:_MOST_PRINTED]:
        _print_sensitivities(result, name)
    if len(known) > _MOST_PRINTED:
        print(f"by factor, the first {_MOST_PRINTED} of {len(known)} figures: name others in [measure], or add --report")


def _print_by_factor(result: "SweepResult", name: str) -> None:
    from hil.sweep.analysis import INTERACTIONS
    from hil.sweep.units import headed, label_of, unit_of_factor, unit_of_figure

    unit, scale = unit_of_figure(name)
    table = Table(headed(name, unit), "runs", "median", "95 %", "90 %", "mean - all", "95 %", "share")
    shares = {factor: f"{100.0 * share:.1f} %" for factor, share in result.analysis.shares(name).items()}
    for factor in result.study.factors:
        factor_unit, factor_scale = unit_of_factor(result.study, factor.name)
        levels = [] if factor.is_seed or factor.sampled else result.analysis.levels(name, factor)
        if levels or factor.name in shares:
            table.add(headed(factor.name, factor_unit), *[""] * 6, shares.pop(factor.name, ""))
        for level in levels:
            half, most = _with_interval(level.quantiles[0], scale), number_text(scale * level.quantiles[1].value)
            change = level.difference
            effect = f"{scale * change.value:+.3g}", f"± {scale * (change.high - change.value):.2g}".replace("± inf", "?")
            table.add(f"  {label_of(level.value, factor_scale)}", f"{level.runs}", *half, most, *effect, "")
    for factor_name in [each for each in shares if each != INTERACTIONS] + [INTERACTIONS] * bool(shares):
        table.add(factor_name, *[""] * 6, shares[factor_name])
    if table.rows:
        table.print()


def _print_sensitivities(result: "SweepResult", name: str) -> None:
    from hil.sweep.units import headed, label_of, unit_of_factor

    if result.study.sampling.method != "saltelli":
        return
    if missing := result.analysis.no_sensitivities(name):
        print(missing)
        return
    table = Table(f"Sobol indices of {name}", "first order", "95 %", "total", "95 %")
    at = None
    for each in result.analysis.sensitivities(name):
        if each.at != at:
            at = each.at
            units = {factor: unit_of_factor(result.study, factor) for factor in at}
            if at:
                values = (f"{headed(factor, units[factor][0])} = {label_of(at[factor], units[factor][1])}" for factor in at)
                table.add(", ".join(values), *[""] * 4)
        cells = (
            text for index in (each.first, each.total) for text in (f"{index.value:.3f}", f"± {index.high - index.value:.2g}")
        )
        table.add(f"  {each.factor}" if at else each.factor, *cells)
    table.print()


def _with_interval(quantile: "Quantile", scale: float) -> tuple[str, str]:
    low, high = (number_text(scale * end) if isfinite(end) else "?" for end in (quantile.low, quantile.high))
    return number_text(scale * quantile.value), f"{low} to {high}"


@cli.command(cli.options_of(ComparisonConfig), cli.engine_options(few="several would slow each other's cycles"), cli.JSON)
def gough_compare_fusion(options: Namespace) -> None:
    """Compare every way to fuse the IMUs, on one motion.

    The platform moves as prescribed, 30 mm and 10 deg along and about every axis. Prints errors after the first 20 s, NEES (6
    is consistent) and microseconds of a cycle, which are those of a busy machine if there are several workers.
    """
    from hil.studies.fusion_comparison import compare

    config = cli.config_of(options, ComparisonConfig)
    with engine_at_work(cli.engine_of(options), "every way to fuse") as (engine, progress):
        figures = compare(config, engine, progress)
    cli.write_json(options.json, figures)
    table = Table(f"{config.imu}, {config.motion}", "position RMS [mm]", "rotation RMS [deg]", "NEES", "us", "seeds")
    for name, method in figures["methods"].items():
        known = ("" if method[figure] is None else f"{method[figure]:.1f}" for figure in ("nees", "us"))
        table.add(name, mm(method["position_rms"]), deg(method["rotation_rms"]), *known, f"{method['seeds']}")
    table.print()


@cli.command(
    cli.options_of(EvaluationConfig),
    cli.argument("--only", choices=SECTIONS, nargs="+", default=SUPPRESS, help="these sections instead of all"),
    cli.engine_options(),
    cli.JSON,
)
def gough_evaluate_fusion(options: Namespace) -> None:
    """Evaluate the whole-mechanism filter after a self-calibration.

    The raw IMUs of several rigs are calibrated on themselves; then their platforms move as prescribed, 30 mm and 10 deg along
    and about every axis at 0.5, 1, 2 and 0.1 to 1 Hz, and stand still. Prints errors after the first 20 s with exact and with
    wrong joints, with a dead IMU, of starts in the middle of a motion, over minutes of standing still, in the closed loop, and
    the cost of a cycle, beside the leg filters with the refined pose. The cost is measured first, in one process.
    Ten minutes of processor time in all. --only encoders calibrates every rig with its encoders, and follows the target in the
    closed loop with them, beside the least errors that any estimate can have: two minutes of processor time for each rig.
    """
    from hil.studies.fusion_evaluation import evaluate

    config = cli.config_of(options, EvaluationConfig)
    with engine_at_work(cli.engine_of(options), "calibration") as (engine, progress):
        figures = evaluate(config, engine, lambda label, share: progress(share, label))
    cli.write_json(options.json, figures)
    for section, show in _EVALUATED.items():
        if section in figures:
            show(figures[section])


def _joints(error: str) -> str:
    return "exact joints" if error == "0" else f"joints {1e3 * float(error):g} mm off"


def _print_calibrations(figures: dict[str, Any]) -> None:
    table = Table("calibration, RMS [mm, deg]", "before", "after", "predicted", "least improvement")
    for error, each in figures.items():
        cells = (mm_deg(each[name]) for name in ("before", "after", "predicted"))
        table.add(_joints(error), *cells, f"{each['least_improvement']:.0f} times")
    table.print()


def _print_motions(figures: dict[str, Any]) -> None:
    for error, motions in figures.items():
        table = Table(f"{_joints(error)}, RMS [mm, deg]", "legs, refined", "NEES", "whole mechanism", "worst seed", "NEES")
        for kind, each in motions.items():
            refined, whole = each["refined"], each["whole"]
            table.add(
                kind if kind.isalpha() else f"{kind} Hz",
                mm_deg(refined),
                f"{refined['nees']:.1f}",
                mm_deg(whole),
                mm_deg(whole, "worst_"),
                f"{whole['nees']:.1f}",
            )
        table.print()


def _print_faults(figures: dict[str, Any]) -> None:
    table = Table("IMU dead at 1 Hz", "position RMS [mm]", "times", "rotation RMS [deg]", "times")
    for name, each in figures.items():
        times = (f"{each[f'{key}_ratio']:.2f}" if name != "none" else "" for key in ("position_rms", "rotation_rms"))
        table.add(name, mm(each["position_rms"]), next(times), deg(each["rotation_rms"]), next(times))
    table.print()


def _print_starts(figures: dict[str, Any]) -> None:
    print(
        f"starts in motion up to 2 Hz: {figures['succeeded']} of {figures['starts']} within 1.5 s; largest error from then on "
        f"{mm(figures['position_max'])} mm, {deg(figures['rotation_max'])} deg"
    )


def _print_drift(figures: dict[str, Any]) -> None:
    table = Table("standing still", "position RMS [mm]", "rotation RMS [deg]", "NEES")
    for minute, each in enumerate(figures["minutes"], start=1):
        table.add(f"minute {minute}", mm(each["position_rms"]), deg(each["rotation_rms"]), f"{each['nees']:.1f}")
    table.print()


def _print_following(figures: dict[str, Any]) -> None:
    print(
        f"closed loop, {figures['imu']}, {figures['fusion']}, {figures['target']}: RMS {mm(figures['position_rms'])} mm, "
        f"{deg(figures['rotation_rms'])} deg, worst seed {mm(figures['worst_position_rms'])} mm, "
        f"{deg(figures['worst_rotation_rms'])} deg, NEES {figures['nees']:.1f}"
    )


def _print_encoders(figures: dict[str, Any]) -> None:
    print(f"closed loop with encoders, {figures['kind']}, {figures['fusion']}, {figures['target']}")
    headings = ("relative", "worst seed", "absolute", "worst seed", "bound", "over it", "NEES")
    table = Table("RMS [mm, deg]", *headings)
    for error, each in figures["joints"].items():
        cells = (mm_deg(each[name], which) for name in ("relative", "absolute") for which in ("", "worst_"))
        over = " / ".join(f"{each['over_bound'][key]:.2f}" for key in ("position_rms", "rotation_rms"))
        table.add(_joints(error), *cells, mm_deg(each["bound"]), over, f"{each['absolute']['nees']:.1f}")
    table.print()


def _print_cost(figures: dict[str, Any]) -> None:
    table = Table("microseconds of a cycle", "mean", "most")
    for name, each in figures.items():
        table.add(name, f"{each['mean_us']:.1f}", f"{each['max_us']:.1f}")
    table.print()


_EVALUATED: dict[str, Callable[[dict[str, Any]], None]] = {
    "calibration": _print_calibrations,
    "motions": _print_motions,
    "faults": _print_faults,
    "start": _print_starts,
    "drift": _print_drift,
    "follow": _print_following,
    "cost": _print_cost,
    "encoders": _print_encoders,
}


@cli.command(
    cli.seed_options("how often each case is tried"),
    cli.argument(
        "--only",
        metavar="TEXT",
        action="extend",
        nargs="+",
        help="only cases with one of these texts in their names or kinds, such as 'base' or vibration",
    ),
    cli.flag("--list", "print which cases there are, and run nothing"),
    cli.setting("--fusion", "compiled,whole", "ways to fuse the IMUs, as for 'gough simulate', with commas in between"),
    cli.argument(
        "--results",
        type=Path,
        metavar="FOLDER",
        help="keep every run in a table in Parquet in this folder; one that was interrupted goes on there",
    ),
    cli.argument(
        "--lengths",
        default=NO_LENGTHS,
        metavar="KIND",
        help="give the rig encoders, as for 'gough simulate', and try nothing but the faults with a specified reaction, with "
        "each fusion, after the zeros are known: the pose may then be 1 mm and 0.3 deg off until one is told",
    ),
    cli.flag("--worst", "sort the disturbances, the worst first"),
    cli.markdown("docs/faults.md"),
    cli.engine_options(),
    cli.JSON,
)
def gough_faults(options: Namespace) -> int:
    """Try every fault and disturbance many times.

    First come faults with a specified reaction, on the emulated rig: the reported cause, how the run ends, how soon, and how
    far a leg gets off its reference. Then come disturbances of IMUs, base, mechanism, loads and drives, with each way to fuse
    the IMUs: the greatest error of the pose until something was told, and afterwards; what was told, and when; and how often a
    sound IMU was left out and the error then exceeded 5 mm or 1 deg, which is forbidden. Last come runs in which nothing is
    wrong: how often anything was told, and the protection level beside the error. All runs are on virtual time. The exit status
    is 1 if a reaction differs from the specified one, or if there is a forbidden outcome.
    """
    from hil.faults.reactions import CASES, Case, pose_table, table, with_encoders
    from hil.faults.rows import Row, all_rows
    from hil.faults.tables import (
        disturbance_table,
        disturbances_of,
        encoder_table,
        list_table,
        sound_of,
        sound_table,
        summary,
        worst_first,
    )
    from hil.faults.trials import outcomes_of, run_trials, trials_of

    seeds = cli.seeds_of(options)
    fusions = tuple(options.fusion.split(","))
    for fusion in fusions:
        SimulationConfig(fusion=fusion, lengths=options.lengths)
    load_encoder(options.lengths)
    only: list[str] = options.only or [""]
    everything: list[Case | Row] = [*CASES, *all_rows()]
    if options.lengths != NO_LENGTHS:
        everything = [*with_encoders(CASES, options.lengths)]
    items = [item for item in everything if any(text in item.name or text in item.kind for text in only)]
    if not items:
        raise InputError(f"no case has {' or '.join(map(repr, only))} in its name or kind: 'gough faults --list' prints all")
    if options.list:
        list_table(items).print(options.markdown)
        return 0
    if options.results is not None:
        check_installed("pyarrow")
    with engine_at_work(cli.engine_of(options), "faults") as (engine, progress):
        trials = trials_of(items, seeds, fusions)
        found = run_trials(trials, engine, progress, options.results)
    cases = [item for item in items if isinstance(item, Case)]
    outcomes, disturbances = outcomes_of(cases, found), disturbances_of(found)
    if outcomes:
        (table if options.lengths == NO_LENGTHS else pose_table)(outcomes).print(options.markdown)
    if disturbances:
        disturbance_table(worst_first(disturbances) if options.worst else disturbances).print(options.markdown)
    encoders = encoder_table(disturbances)
    if encoders.rows:
        encoders.print(options.markdown)
    sound = sound_of(found)
    if sound:
        sound_table(sound).print(options.markdown)
    cli.write_json(options.json, summary(outcomes, disturbances, sound, seeds))
    findings = [finding for outcome in outcomes for finding in outcome.findings]
    for finding in findings:
        print(finding, file=sys.stderr)
    forbidden, runs = (sum(each[name] for each in disturbances) for name in ("forbidden", "runs"))
    if disturbances:
        print(
            f"a sound IMU was left out, and the error then exceeded 5 mm or 1 deg: in {forbidden} of {runs} runs "
            f"with {', '.join(fusions)}",
            file=sys.stderr if forbidden else sys.stdout,
        )
    return int(bool(findings) or forbidden > 0)


@cli.command(
    cli.source("folder", "FOLDER", "folder with the files pose_*.csv"),
    cli.options_of(SimulationConfig, mechanism={"default": "planar-3rpr"}),
    cli.report("write a report with plots"),
    cli.JSON,
)
def gough_planar(options: Namespace) -> None:
    """Find the poses of a real planar rig from its measured leg angles.

    The rig stands at known poses, given in files pose_*.csv with the true pose in the first line. Prints the errors of the
    assembly mode that is nearest to the true pose.
    """
    from hil.studies.planar_rig import evaluate
    from plant.mechanism import load_mechanism
    from plant.mechanism.planar import PlanarMechanism

    mechanism = load_mechanism(options.mechanism)
    if not isinstance(mechanism, PlanarMechanism):
        raise InputError(f"{options.mechanism} has six legs in space; this needs three in the plane: choose another mechanism")
    result = evaluate(options.folder, mechanism)
    summary = result.summary()
    cli.write_json(options.json, summary)
    cli.write_report(options, "planar_rig", result)
    table = Table("RMS of the poses' mean errors", "x [mm]", "y [mm]", "angle [deg]", "leg angles [deg]", "true pose is a mode")
    for source, figures in summary["sources"].items():
        rms, poses = figures["rms"], f"{figures['true_mode']['poses']} of {len(result.poses)} poses"
        angles = (deg(angle, 2) for angle in (rms["angle"], figures["leg_angles"]["constant_error"]))
        table.add(source, mm(rms["x"], 2), mm(rms["y"], 2), *angles, poses)
    table.print()


@cli.command(
    cli.source("folder", "FOLDER", "folder with the trials *.npz (default: only simulated motions)", nargs="?"),
    cli.setting("--seeds", 1, "simulated motions of each kind"),
    cli.argument(
        "--accelerometer-noise",
        type=float,
        help="noise of the accelerometer that the filter assumes [m/s2/sqrt(Hz)] (default: as in the closed loop); the filter "
        "adds by itself what it sees of the acceleration, which here is unknown",
    ),
    cli.argument(
        "--bias-walk",
        type=float,
        help="random walk of the gyroscope's bias that the filter assumes [rad/s/sqrt(s)] (default: as in the closed loop)",
    ),
    cli.engine_options(few="it takes seconds"),
    cli.JSON,
)
def gough_broad(options: Namespace) -> None:
    """Run the platform's filter alone, on real and on simulated IMU data.

    The filter, and the vqf package, run on trials of the BROAD benchmark, an IMU moved by hand with an optical reference, and
    on simulated motions of 10 m/s2 with several spectra. Prints the RMS of the inclination's error in motion, and microseconds
    of a sample, which are those of a busy machine if there are several workers.
    """
    from controller.settings import FusionSettings
    from hil.studies.broad import evaluate

    given = {"platform_accelerometer_noise": options.accelerometer_noise, "bias_walk": options.bias_walk}
    fusion = FusionSettings(**{name: value for name, value in given.items() if value is not None})
    with engine_at_work(cli.engine_of(options), "trials") as (engine, _):
        figures = evaluate(options.folder, fusion, options.seeds, engine)
    cli.write_json(options.json, figures)
    table = Table("inclination RMS", "filter [deg]", "vqf [deg]", "filter [us]", "vqf [us]", "samples")
    for name, trial in {**figures["trials"], **figures["simulated"]}.items():
        methods = trial["filter"], trial["vqf"]
        errors = (deg(method["inclination_rms"]) for method in methods)
        times = (f"{method['us']:.2f}" for method in methods)
        table.add(name, *errors, *times, f"{trial['samples']}")
    table.print()
