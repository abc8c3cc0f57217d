"""The commands calibrate and identify."""

import sys
from argparse import Namespace
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import partial
from math import degrees, inf, isfinite, radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.command_line import cli
from hil.command_line.terminal import deg, duration, live_view, mm_deg, progress_bar, say
from hil.progress import no_progress
from hil.realtime.scheduling import RealTimeSettings, keep_to_one_thread
from hil.runs.config import SimulationConfig
from hil.table import Table
from plant.encoders import load_encoder
from plant.errors import InputError
from plant.files import write_whole
from plant.imu_wiring import ALL_IMUS, BASE_IMU, PLATFORM_IMU

if TYPE_CHECKING:
    from controller.calibration.file import Calibration
    from controller.design.identification import Identified
    from hil.calibration.data import Knowledge
    from hil.calibration.guided import Step
    from hil.calibration.procedure import RigCalibration
    from hil.identification.procedure import Identification

_DEFAULT_RIG = SimulationConfig(imu="mpu9150")
"""The rig that is driven without any option."""

_CLEAR = "  Clear the space around the platform, and keep a hand on the emergency stop. Ctrl-C stops gently."

_YES = cli.flag("--yes", "ask nothing before a step: the space is clear, and somebody holds the emergency stop")

_MOST_MISSED = 25
"""Periods missed in a row that are borne by default: a calibration leaves out what was not read, and a stop loses a run."""


@cli.command(
    cli.output("output", "FILE.toml", "the calibration to write"),
    cli.options_of(
        SimulationConfig, "mechanism", "rate", "seed", "joint_error", "plant", "binding", "rig", "rig_at", "base_imu",
        imu={"default": _DEFAULT_RIG.imu},
        lengths={"flag": "--encoders", "text": "encoders that the rig has: none, incremental, absolute, or a TOML file"},
    ),
    cli.argument(
        "--box", nargs=2, type=float, metavar=("MM", "DEG"),
        help="how far the planned motions may lead the platform from home (default: as far as the strokes allow)",
    ),
    cli.argument(
        "--speed", type=float, metavar="MM_PER_S", help="how fast the planned motions may move a leg (default: its limit)"
    ),
    cli.argument(
        "--force", type=float, metavar="N",
        help="which force the planned motions may need of a leg at home, by the plant data of the mechanism's file; it does "
        "not limit what a drive does when something is in the way: limit its current for that",
    ),
    _YES,
    cli.flag("--resume", "go on from the recordings that an earlier calibration has kept beside the output"),
    cli.flag("--home", "the rig stands exactly at home when it begins"),
    cli.setting("--tilt", 0.05, "by how much the base may be off level [deg]"),
    cli.setting(
        "--joints", 0.0, "by how much each coordinate of a joint may be off; if it is not 0, the joints are estimated, too [mm]"
    ),
    cli.source(
        "--recording",
        "FILE.mcap",
        "recordings of a rig that rested and shook, from which to take mechanism, IMUs, rate and data",
        nargs="+",
    ),
    cli.argument(
        "--length-changes", "--lengths",
        action="store_true",
        dest="changes_of_lengths",
        help="the rig measures by how much its lengths change: by its --encoders, or in a simulation without them to 50 um",
    ),
    cli.flag("--known-poses", "write the mounting alone, by comparing with the planned poses, as in the paper's section 7"),
    cli.options_of(RealTimeSettings, "priority", "cpu", "strict", most_missed={"default": _MOST_MISSED}),
    cli.report("write a report with plots"),
    cli.output("--picture", "FILE.svg", "draw the accuracy of each stage"),
    cli.JSON,
)  # fmt: skip
def gough_calibrate_rig(options: Namespace) -> None:
    """On the mechanism, from its redundancy.

    The mechanism rests at wide poses, which need not be known, and shakes for 40 s. Before that it finds out, with the loop
    open, whether each IMU works, and is mounted and wired correctly. Writes bias, scale, axes and mounting of every sensor,
    with their covariance. If it fails, the last run is recorded beside the output, and the report is that of this run.

    A rig (--rig udp, canopen or python:MODULE:CLASS) is led through six steps, from reading to shaking. Each is described
    before it begins, asks whether to go on, and leaves its recording beside the output; --resume goes on from these. With
    --box, --speed or --force and no --rig, the simulated plant rehearses the same.
    """
    keep_to_one_thread()
    from controller.calibration.at_rest import Prior
    from controller.calibration.file import save_calibration
    from hil.calibration.data import TO_50_UM, Knowledge
    from hil.calibration.procedure import FailedCalibrationError, calibrate_recordings, calibrate_rig

    if not 0.0 < options.tilt < 45.0:
        raise InputError(f"--tilt is {options.tilt:g} deg; it must be between 0 and 45")
    if not 0.0 <= options.joints <= 10.0:
        raise InputError(f"--joints is {options.joints:g} mm; it must be between 0 and 10")
    config = cli.config_of(options, SimulationConfig)
    guided = (
        config.rig != "fmu" or options.resume or any(each is not None for each in (options.box, options.speed, options.force))
    )
    if options.recording:
        _check_told_by_recording(options, _DEFAULT_RIG, "limits and --resume" if guided else "")
    prior = Prior(tilt=radians(options.tilt), joints=1e-3 * options.joints)
    encoder = load_encoder(config.lengths) or (TO_50_UM if options.changes_of_lengths else None)
    knowledge = Knowledge(prior, options.home, encoder, options.known_poses)
    if guided:
        result = _guided(options, config, knowledge)
    else:
        label = "recorded IMUs are calibrated" if options.recording else f"{config.mechanism} calibrates its IMUs"
        with progress_bar(label) as progress:
            if options.recording:
                result = calibrate_recordings(options.recording, knowledge)
            else:
                failed = options.output.with_suffix(".failed.mcap")
                try:
                    result = calibrate_rig(config, knowledge, progress, failed=failed)
                except FailedCalibrationError as error:
                    if error.result is not None:
                        cli.write_report(options, "run", error.result)
                    raise
    save_calibration(options.output, result.calibration)
    cli.write_json(options.json, result.summary)
    cli.write_report(options, "calibration", result)
    if options.picture:
        from hil.reports.calibration_picture import write_picture

        write_picture(result.summary, options.picture)
    _print_rig_calibration(result.summary)
    print(f"written to {options.output}")


def _check_told_by_recording(options: Namespace, default: SimulationConfig, also: str = "") -> None:
    """Check that no option, nor what is `also` given, says what a recording does."""
    defaults = asdict(default)
    given = [name for name, value in vars(options).items() if name in defaults and value not in (defaults[name], [])]
    if given or also:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in given) or also
        raise InputError(f"the recordings say what {names} would: leave it out with --recording")


def _guided(options: Namespace, config: SimulationConfig, knowledge: "Knowledge") -> "RigCalibration":
    """Lead through the calibration of a rig, or of the simulated plant."""
    from controller.planning.motions import Box
    from hil.calibration.excitation import MotionLimits
    from hil.calibration.guided import Guide, calibrate_guided, lost_accuracy, plan_calibration
    from hil.calibration.machines import machine_on_clock, simulated_machine

    simulated = config.rig == "fmu"
    if config.rig == "replay":
        raise InputError("a replay cannot be driven: give its recording with --recording")
    if options.known_poses:
        raise InputError("--known-poses is for the simulated rig without limits, and for recordings: leave it out")
    if not simulated:
        _check_terminal(options)
    box = Box() if options.box is None else Box(1e-3 * options.box[0], radians(options.box[1]))
    limits = MotionLimits(
        box, inf if options.speed is None else 1e-3 * options.speed, inf if options.force is None else options.force
    )
    plan = plan_calibration(config, limits)
    if plan.cut:
        say(f"the limits of the mechanism cut --box to {plan.cut}")
    if limits != MotionLimits():
        say(lost_accuracy(plan, knowledge))
    guide = Guide(partial(_announce, simulated, not options.yes), lambda text: say(f"  {text}"))
    with progress_bar("the plant rehearses") if simulated else nullcontext(no_progress) as progress:
        machine = (
            simulated_machine(progress)
            if simulated
            else machine_on_clock(
                cli.config_of(options, RealTimeSettings),
                lambda run: live_view(plan.mechanism.name, Path(run.target).stem, run.rate),
            )
        )
        return calibrate_guided(plan, knowledge, options.output, machine, guide, options.resume)


def _announce(simulated: bool, asks: bool, number: int, count: int, step: "Step") -> None:
    """Say what a step will do and what to do for it, and ask whether to go on."""
    say(f"step {number} of {count}, {step.name}, {duration(step.seconds)}. {step.text}.")
    if simulated:
        return
    if step.moves:
        say(_CLEAR)
    if asks and not _agreed():
        raise InputError(f"stopped before step {number}, and nothing moves: go on from here with --resume")


def _agreed() -> bool:
    """Ask whether to begin, and whether the answer is yes."""
    print("  Type yes to begin: ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _check_terminal(options: Namespace) -> None:
    """Check that somebody can be asked before a rig moves, or need not be."""
    if not (options.yes or sys.stdin.isatty()):
        raise InputError(
            "there is no terminal to ask at before the rig moves: run it in one, or add --yes if the space is clear and "
            "somebody holds the emergency stop"
        )


def _print_rig_calibration(summary: dict[str, Any]) -> None:
    from hil.calibration.assessment import STAGES, weak_words

    headings = ("residual [mg]", "left out", "predicted [mm, deg]", "halves", "true")
    table = Table(f"{summary['rests']} poses at rest", *headings)
    for name, residual in summary["residual_mg"].items():
        left_out = summary["validated"].get(name, {}).get("left_out_mg")
        errors = (summary[kind].get(name) for kind in ("predicted", "validated", "true"))
        accuracy = ("" if each is None else mm_deg(each) for each in errors)
        table.add(STAGES[name], f"{residual:.3f}", "" if left_out is None else f"{left_out:.3f}", *accuracy)
    table.print()
    if summary["validated"]:
        print("left out: residual at rests that the calibration had not seen; halves: by how much the poses differ that "
              "calibrations by disjoint halves of the data give")  # fmt: skip
    for line in weak_words(summary):
        print(line)


def _single(number: int, text: str, imus: Sequence[int]) -> list[cli.Argument]:
    """The arguments that single IMUs and magnetometers have in common."""
    return [
        cli.output("output", "FILE.toml", "the calibration to write, or to add this sensor to"),
        cli.setting("--number", number, text, choices=imus),
        cli.setting("--gravity", 9.80665, "gravity at the place [m/s2]"),
        cli.JSON,
    ]


@cli.command(
    cli.source("data", "FILE", "CSV with time_s,wx,wy,wz,ax,ay,az (rad/s, m/s2), or an MCAP recording"),
    *_single(0, "which IMU of the mechanism it is: 0-5 on the legs, 6 on the platform, 7 on the base", (*ALL_IMUS, BASE_IMU)),
)
def gough_calibrate_imu(options: Namespace) -> None:
    """A single IMU, turned by hand.

    Without equipment: it rests in ten or more orientations, every axis up and down among them, half a second or longer each,
    and is turned by hand from one to the next. Refuses data that do not determine the constants, and says which rest or turn is
    missing.
    """
    from controller.calibration.file import save_calibration
    from controller.calibration.single_imu import calibrate_imu
    from hil.recording.imu_data import read_imu
    from plant.imu import ACCELEROMETER, GYROSCOPE, STANDARD_GRAVITY

    calibration = _checked(options)
    found = calibrate_imu(*read_imu(options.data, options.number), options.gravity)
    for sensor in (GYROSCOPE, ACCELEROMETER):
        calibration.put(options.number, sensor, found.gain[sensor], found.offset[sensor])
    # The covariance of the remaining errors belongs to the constants that are replaced.
    save_calibration(options.output, calibration if options.number == BASE_IMU else replace(calibration, covariance=None))
    cli.write_json(options.json, vars(found))
    table = Table(f"IMU {options.number}", "x", "y", "z")
    rows = (("gyroscope: ", "deg/s", degrees(1.0)), ("accelerometer: ", "mg", 1e3 / STANDARD_GRAVITY))
    for sensor, (name, unit, scale) in enumerate(rows):
        _add_constants(table, name, (unit, scale), found.gain[sensor], found.offset[sensor], found.sigmas[sensor])
    table.print()
    print(
        f"{found.rests} rests; residuals: gravity {1e3 * found.force_residual / STANDARD_GRAVITY:.3f} mg, "
        f"turns {deg(found.turn_residual)} deg; written to {options.output}"
    )


def _checked(options: Namespace) -> "Calibration":
    """The calibration to add a sensor to, after checking what all sensors have in common."""
    from controller.calibration.file import Calibration, load_calibration

    if not 9.7 < options.gravity < 9.9:
        raise InputError(f"--gravity is {options.gravity:g} m/s2; on the earth it is between 9.7 and 9.9")
    return load_calibration(options.output) if options.output.exists() else Calibration()


def _add_constants(table: Table, name: str, unit: tuple[str, float], gain: Any, offset: Any, sigmas: Any) -> None:
    """Add the offset (3,) in `unit`, with its factor from SI, the gain (3, 3), and their `sigmas` (12,) to a table."""
    symbol, scale = unit
    cells = zip(offset, sigmas[:3], strict=True)
    table.add(f"{name}offset [{symbol}]", *(f"{scale * value:.3f} +- {scale * sigma:.3f}" for value, sigma in cells))
    for axis, (gains, deviations) in enumerate(zip(gain, sigmas[3:].reshape(3, 3), strict=True), start=1):
        cells = zip(gains, deviations, strict=True)
        table.add(f"{name}gain, row {axis}", *(f"{value:.5f} +- {sigma:.5f}" for value, sigma in cells))


@cli.command(
    cli.source(
        "data", "FILE", "CSV with time_s,wx,wy,wz,ax,ay,az,mx,my,mz or time_s,mx,my,mz (rad/s, m/s2, uT), or an MCAP recording"
    ),
    *_single(PLATFORM_IMU, "which IMU of the mechanism it is in", ALL_IMUS),
    cli.setting("--field", 49.4, "strength of the magnetic field at the place [uT]"),
)
def gough_calibrate_magnetometer(options: Namespace) -> None:
    """A single magnetometer, turned by hand: hard and soft iron.

    Without equipment: it is turned slowly every way round for half a minute or longer, away from iron. With a calibrated
    accelerometer beside it, its axes hold for both. Refuses data that do not determine the constants, and says what is missing.
    """
    from controller.calibration.file import save_calibration
    from controller.calibration.magnetometer import calibrate_magnetometer
    from hil.recording.imu_data import read_field
    from plant.imu import ACCELEROMETER, MAGNETOMETER

    calibration = _checked(options)
    if not 20.0 < options.field < 70.0:
        raise InputError(f"--field is {options.field:g} uT; on the earth it is between 20 and 70")
    fields, forces = read_field(options.data, options.number)
    if forces is not None:
        at = ACCELEROMETER, options.number
        forces = forces @ calibration.gain[at].T + calibration.offset[at]
    found = calibrate_magnetometer(fields, forces, options.field, options.gravity)
    at = MAGNETOMETER, options.number
    calibration.gain[at], calibration.offset[at] = found.gain, found.offset
    save_calibration(options.output, calibration)
    cli.write_json(options.json, vars(found))
    table = Table(f"magnetometer {options.number}", "x", "y", "z")
    _add_constants(table, "", ("uT", 1.0), found.gain, found.offset, found.sigmas)
    table.print()
    residuals = f"strength {found.field_residual:.3f} uT"
    if found.dip is not None and found.dip_residual is not None:
        residuals += f", dip {deg(found.dip_residual)} deg about {deg(found.dip)} deg"
    print(f"{found.samples} samples; residuals: {residuals}; written to {options.output}")


gough_calibrate = cli.group(
    "Find the IMUs' errors: on the mechanism, or of a single IMU or magnetometer.",
    rig=gough_calibrate_rig,
    imu=gough_calibrate_imu,
    magnetometer=gough_calibrate_magnetometer,
)


@cli.command(
    cli.output("output", "FILE.toml", "the mechanism to write, with the fitted actuators"),
    cli.options_of(
        SimulationConfig, "mechanism", "rate", "imu", "seed", "calibration", "imus", "lengths", "joint_error", "settings",
        "plant", "binding", "rig", "rig_at",
    ),
    cli.setting("--duration", 10.0, "duration of the multisine, 5 to 60 [s]"),
    cli.setting("--share", 0.8, "share of the limits of stroke, velocity, acceleration and jerk that it may use, up to 0.95"),
    cli.argument(
        "--fit", metavar="NAME,...",
        help="what to fit, by names of the mechanism's file: drive.gain, motor.resistance, friction.coulomb, "
        "motor.inductance, motor.rotor_inertia and delay, that of the commands (default: all these); and, which needs more "
        "knowledge of the others, friction.viscous and payload.mass",
    ),
    cli.source("--recording", "FILE.mcap", "a recording of a motion, from which to take mechanism, IMUs, rate and data"),
    _YES,
    cli.options_of(RealTimeSettings, "priority", "cpu", "strict", most_missed={"default": _MOST_MISSED}),
    cli.JSON,
)  # fmt: skip
def gough_identify(options: Namespace) -> None:
    """Fit the actuators to a motion: gain, delay, lag, droop and friction.

    The machine follows a multisine on all axes, inside the limits of all legs, with the loop closed. Its plant predicts what
    the IMUs should read along the commands that it was given, and with --lengths the encoders; the actuators are fitted to
    what they did read, with 95 % intervals. Writes the mechanism's file with the fitted values, for 'gough tune --mechanism'
    and all other commands, and keeps the recording beside it. Says what cannot be told apart, and what helps.

    Without --rig the simulated plant is the machine, whose actuators --set changes. A rig (--rig udp, canopen or
    python:MODULE:CLASS) must be calibrated; what it will do is described first, and it asks whether to begin.
    """
    keep_to_one_thread()
    from controller.design.identification import USUAL
    from hil.identification.procedure import identify_recording

    names = USUAL if options.fit is None else [name.strip() for name in options.fit.split(",")]
    if options.recording is not None:
        _check_told_by_recording(options, SimulationConfig())
        with progress_bar("the actuators are fitted"):
            result = identify_recording(options.recording, names)
    else:
        result = _identified(options, names)
    write_whole(options.output, result.text.encode())
    cli.write_json(options.json, result.found.summary())
    _print_actuators(result.found)
    print(f"written to {options.output}")


def _identified(options: Namespace, names: Sequence[str]) -> "Identification":
    """Drive the machine of the options, and fit its actuators."""
    from hil.calibration.machines import machine_on_clock, simulated_machine
    from hil.identification.procedure import identify, plan_identification

    config = cli.config_of(options, SimulationConfig)
    if config.rig == "replay":
        raise InputError("a replay cannot be driven: give its recording with --recording")
    simulated = config.rig == "fmu"
    if not simulated:
        _check_terminal(options)
    plan = plan_identification(config, options.duration, options.share, names)
    say(plan.text)
    recording = options.output.with_suffix(".mcap")
    if simulated:
        with progress_bar("the plant follows the multisine") as progress:
            return identify(plan, simulated_machine(progress), recording)
    say(_CLEAR)
    if not options.yes and not _agreed():
        raise InputError("stopped before anything has moved")
    machine = machine_on_clock(
        cli.config_of(options, RealTimeSettings), lambda run: live_view(plan.mechanism.name, "multisine", run.rate)
    )
    return identify(plan, machine, recording)


_ACTUATOR_UNITS = {
    "drive.gain": ("", 1.0),
    "motor.resistance": ("Ohm", 1.0),
    "friction.coulomb": ("N", 1.0),
    "friction.viscous": ("N.s/m", 1.0),
    "motor.inductance": ("mH", 1e3),
    "motor.rotor_inertia": ("g.cm2", 1e7),
    "payload.mass": ("kg", 1.0),
    "delay": ("ms", 1e3),
    "droop": ("mm/s/N", 1e3),
    "lag": ("ms", 1e3),
}
"""Units of what an actuator is known by, and factors from SI units."""


def _print_actuators(found: "Identified") -> None:
    from plant.imu import STANDARD_GRAVITY

    table = Table("", "value", "95 %", "unit")
    for each in (*found.values, *found.figures):
        unit, scale = _ACTUATOR_UNITS[each.name]
        table.add(each.label, f"{scale * each.value:.5g}", f"+- {scale * each.half:.2g}", unit)
    table.print()
    rate, force = found.residual
    print(
        f"what remains of the readings: {degrees(rate):.3f} deg/s and {1e3 * force / STANDARD_GRAVITY:.2f} mg RMS"
        + (f", {found.unexplained:.2f} times the noise at rest" if isfinite(found.unexplained) else "")
    )
    for remark in found.remarks:
        print(remark)
