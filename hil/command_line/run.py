"""The commands that run the loop, and what makes targets: simulate, run, motion, replay, compare, stream-target, vehicle."""

import sys
from argparse import SUPPRESS, ArgumentTypeError, Namespace
from dataclasses import fields, replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.command_line import cli
from hil.command_line.apart import go_on_apart
from hil.command_line.terminal import QUANTILES, deg, live_view, mm, number_text, progress_bar, say
from hil.realtime.scheduling import RealTimeSettings, keep_to_one_thread
from hil.runs.config import OF_RUNS, SimulationConfig
from hil.table import Cell, Table
from plant.errors import InputError
from plant.files import write_whole

if TYPE_CHECKING:
    from controller.planning.motions import PlannedMotion
    from controller.planning.motions.planned import Peak
    from controller.workspace import TargetCheck
    from hil.runs.snapshot import Snapshot

_NOTICED_STRETCH = 1.05


@cli.command(
    # A resumed run keeps what its snapshot was taken with, and must tell what is given from what is not.
    cli.options_of(SimulationConfig, *cli.names_of(SimulationConfig, *OF_RUNS), only_given=True),
    cli.report("write a report with plots and a moving 3-D view"),
    cli.output("--picture", "FILE.svg", "draw the mechanism in motion: a picture that moves without a script"),
    cli.JSON,
    cli.output("--save-state", "FILE", "write a snapshot, from which a run can go on"),
    cli.argument(
        "--save-at", type=float, metavar="SECONDS", help="time of the snapshot in the motion [s] (default: the motion's end)"
    ),
    cli.source(
        "--load-state",
        "FILE",
        "go on from a snapshot, bit for bit as if there had been none; nothing but --duration can be changed",
    ),
)
def gough_simulate(options: Namespace) -> None:
    """Follow a target on the FMU plant, as fast as the machine can."""
    plant = getattr(options, "plant", None) or (options.load_state and f"of the snapshot {options.load_state}")
    if options.own_process and plant:
        go_on_apart(f"the FMU {plant}")
    from hil.runs.simulation import SimulationStoppedError, simulate
    from hil.runs.snapshot import read_snapshot, write_snapshot

    config, resumed = cli.config_of(options, SimulationConfig), None
    if options.load_state is not None:
        resumed = read_snapshot(options.load_state)
        config = _resumed_config(options, config, resumed)
    if options.save_at is not None and options.save_state is None:
        raise InputError("--save-at says when to write a snapshot, but not where to: add --save-state FILE")
    save_at = config.duration if options.save_state is not None and options.save_at is None else options.save_at
    stopped = None
    with progress_bar(f"{config.mechanism} follows {config.target}") as progress:
        try:
            result = simulate(config, progress, resumed, save_at, say)
        except SimulationStoppedError as error:
            stopped, result = error, error.result
    if result.snapshot is not None and options.save_state is not None:
        write_snapshot(result.snapshot, options.save_state)
    if stopped is None or result.moved:
        cli.write_json(options.json, result.summary())
        cli.write_report(options, "run", result)
        if options.picture is not None:
            from hil.reports.moving_picture import write_picture

            write_picture(result, options.picture)
        _print_simulation(result.summary())
    if stopped:
        raise stopped


def _resumed_config(options: Namespace, config: SimulationConfig, resumed: "Snapshot") -> SimulationConfig:
    """The configuration of a snapshot, with another duration if one is given."""
    kept = SimulationConfig.from_plain(resumed.config)
    for field in fields(config):
        given, was = getattr(config, field.name), getattr(kept, field.name)
        if field.name != "duration" and hasattr(options, field.name) and given != was:
            raise InputError(f"the snapshot was taken with {field.name} {was}, and cannot go on with {given}: leave it out")
    return replace(kept, duration=getattr(options, "duration", kept.duration))


def _print_simulation(summary: dict[str, Any]) -> None:
    frames = summary.get("frames")
    errors = summary if frames is None else frames
    table = Table(
        "" if frames is None else f"{frames['tool']} in {frames['work']}",
        "position RMS [mm]",
        "max [mm]",
        "rotation RMS [deg]",
        "max [deg]",
    )
    rows = [("estimate - reference", "estimated_tracking", ""), ("reference - target", "target", "reference_")]
    if summary["truth_known"]:
        rows[:1] = [
            ("estimate - truth", "estimation", ""),
            ("truth - reference", "tracking", ""),
            ("truth - target", "target", ""),
        ]
    for label, group, prefix in rows:
        positions = (mm(errors[group][f"{prefix}position_{kind}"], 4) for kind in ("rms", "max"))
        rotations = (deg(errors[group][f"{prefix}rotation_{kind}"], 4) for kind in ("rms", "max"))
        table.add(label, *positions, *rotations)
    table.print()
    if not summary["truth_known"]:
        print("the truth is not known: the plant does not give its pose")
    if level := errors["protection"]:
        covered = f"; it covers the error in {100 * level['covered']:.3f} % of the cycles" if "covered" in level else ""
        print(
            "protection level p50/p99/max "
            + " mm, ".join(
                "/".join(unit(level[f"{name}_{label}"], 3) for label in ("p50", "p99", "max"))
                for name, unit in (("position", mm), ("rotation", deg))
            )
            + f" deg{covered}"
        )
    _print_pace(summary)
    for line in summary["events"]:
        print(line)
    cycle = summary["cycle_us"]
    print(
        f"limits violated by the reference: {summary['limits']['violations']}; "
        f"{summary['real_time_factor']:.1f} times real time; "
        f"cycle p50/p99/p99.9 {cycle['p50']:.1f}/{cycle['p99']:.1f}/{cycle['p999']:.1f} us"
    )


def _print_pace(summary: dict[str, Any]) -> None:
    """Say if the target is too fast."""
    if (stretch := summary["target_stretch"]) > _NOTICED_STRETCH:
        print(
            f"the target is too fast for the legs' limits, so the reference stays behind it: --time-scale {stretch:.4f} lets "
            "it be followed"
        )


@cli.command(
    cli.options_of(SimulationConfig),
    cli.output("--record", "FILE.mcap", "record every cycle"),
    cli.options_of(RealTimeSettings),
    cli.JSON,
)
def gough_run(options: Namespace) -> int:
    r"""Follow a target on the machine's clock.

    The closed loop runs compiled, in a process of its own, with real-time priority where the machine grants it. Ctrl-C or
    SIGTERM ends the motion by a controlled stop, Ctrl-\ (SIGQUIT) by an emergency stop: the drives come to rest by themselves,
    whatever is measured.
    """
    keep_to_one_thread()
    from hil.runs.executive import RunStoppedError, ignored_signals, run

    config, settings = cli.config_of(options, SimulationConfig), cli.config_of(options, RealTimeSettings)
    if ignored := ignored_signals():
        unheard = " and ".join(ignored)
        print(
            f"ignored, as what started this run asks: {unheard}; SIGTERM ends it by a controlled stop, SIGQUIT by an emergency "
            "stop",
            file=sys.stderr,
        )
    stopped: Exception | None = None
    with live_view(config.mechanism, config.target, config.rate) as show:
        try:
            summary = run(config, settings, options.record, show, None, say)
        except RunStoppedError as error:
            if error.summary is None:
                raise
            stopped, summary = error, error.summary
    try:
        _print_run(summary)
    except OSError as error:
        stopped = stopped or error
    cli.write_json(options.json, summary)
    if stopped:
        raise stopped
    if summary["obstacle"]:
        return 1
    if lost := summary["recording"]["lost"]:
        raise cli.OutputError(f"the run went to its end, but {lost} of {summary['cycles']} cycles are not recorded")
    return 0


def _print_run(summary: dict[str, Any]) -> None:
    from controller.safety.causes import Cause
    from hil.loop.stage_times import budget, exceeded

    fusion = summary["config"]["fusion"]
    table = Table("us", *(f"{label} / budget" for label in QUANTILES))
    for stage, figures in summary["timing_us"].items():
        limits = budget(fusion).get(stage, {})
        table.add(stage, *(_timing_cell(figures[name], limits.get(name, inf)) for name in QUANTILES.values()))
    table.print()
    for line in summary["events"]:
        print(line)
    over = "; ".join(f"{stage} {', '.join(names)}" for stage, names in exceeded(summary["timing_us"], fusion).items())
    print(f"over budget, as the table shows: {over}" if over else "within the timing budget (hil/loop/budget.toml)")
    for text in summary["refused"]:
        print(f"without {text}")
    used, errors = summary["usage"], summary["errors_m"]
    print(
        f"{summary['cycles']} cycles; periods missed: {summary['missed_own']} by own work, "
        f"{summary['missed_late']} woken late, {summary['missed_host']} held up by the host"
    )
    print(
        f"the loop's thread: {used['major_faults']} major and {used['minor_faults']} minor page faults, "
        f"{used['involuntary_switches']} involuntary switches, {used['resident']} bytes of growth; "
        f"first cycle {summary['start_up_s']:.2f} s after the start"
    )
    truth = "the truth is not known"
    if errors["known"]:
        truth = f"estimate - truth {mm(errors['estimation'])} mm, {deg(summary['errors_rad']['estimation'])} deg RMS"
    if errors["known"] and (frames := summary.get("frames")):
        truth += f"; of {frames['tool']} {mm(errors['tool'])} mm RMS"
    print(f"{truth}; reference - length {mm(errors['tracking'])} mm RMS")
    if level := summary["protection"]:
        print(f"greatest protection level {mm(level['position'])} mm, {deg(level['rotation'])} deg")
    _print_pace(summary)
    if trip := summary["timing_us"].get("round trip"):
        figures = ", ".join(f"{label} {trip[name]:.0f}" for label, name in QUANTILES.items())
        print(f"round trip to the rig {figures} us")
        print(f"{summary['late']} exchanges late, {summary['refused_packets']} packets refused")
        print(_bars(summary["round_trip_bars"]))
    if summary["unseen"]:
        print(f"{summary['unseen']} cycles are in none of these figures: the supervisor came too late")
    files, lost = summary["recording"]["files"], summary["recording"]["lost"]
    if files:
        print(f"{summary['cycles'] - lost} cycles recorded in {', '.join(files)}; {lost} cycles lost")
    if summary["identity"]:
        parts = ", ".join(f"{name} {value}" for name, value in summary["identity"]["parts"].items())
        print(f"rig: {summary['identity']['name']}; {parts}" if parts else f"rig: {summary['identity']['name']}")
    dry = summary["obstacle"] is not None
    if dry:
        print(summary["obstacle"] or "nothing was moved; all is well for arming")
    if summary["cause"] != Cause.END_OF_MOTION.text:
        print(f"stopped on the brakes: {summary['cause']}")
    else:
        print("the dry run went to its end" if dry else "the motion went to its end, and the brakes hold")


def _bars(bars: list[list[float]]) -> str:
    """A histogram as text: for each octave of microseconds, how many."""
    counts: dict[int, float] = {}
    for low, count in zip(*bars, strict=True):
        octave = int(low).bit_length() - 1 if low >= 1.0 else 0
        counts[octave] = counts.get(octave, 0) + count
    most = max(counts.values(), default=1)
    return "\n".join(
        f"  {2**octave:6d} to {2 ** (octave + 1):6d} us {'#' * max(1, round(40 * count / most)):40s} {count:.0f}"
        for octave, count in sorted(counts.items())
    )


def _timing_cell(us: float, limit: float) -> Cell:
    return Cell(f"{us:.1f} / {f'{limit:g}' if limit < inf else ' -'}", alarm=us > limit)


_MOST_ROWS = 60


@cli.command(
    cli.argument("target", metavar="FILE.toml|FILE.csv|NAME", help="a motion file, a CSV file, or a motion's name"),
    cli.options_of(
        SimulationConfig,
        "mechanism",
        "imus",
        "magnetometer",
        "frames",
        "frame",
        "tool",
        "time_scale",
        duration={"text": "how much of a CSV file or a named motion is checked"},
    ),
    cli.output("--csv", "FILE.csv", "write its poses, every 2 ms, as a CSV target has them: for other programs"),
    cli.JSON,
)
def gough_motion(options: Namespace) -> int:
    """Plan a motion, and hold it against every limit; nothing moves.

    Of a motion file it tells how long it takes, and which limits bind. Of any target: the first limit that a pose exceeds, the
    nearest pose that does not, how close it comes to each kind of limit (docs/workspace.md), the greatest speeds, accelerations
    and jerks, and the least time scale that would pass. The exit status is 1 if the target does not pass as it is.
    """
    # A named motion may be called as a file is.
    cli.check_outputs(options, inputs=[Path(options.target)])
    with progress_bar(options.target):
        from controller.planning.motions import load_motion
        from controller.planning.target import MOTION_SUFFIX, load_target, plan_in_frames, target_of_motion, text_of_target
        from controller.workspace import check_against_limits
        from hil.runs.prepare import demands_of
        from plant.mechanism import load_in_space

        # A work frame on the level frame needs an IMU on the base, which a plan does not read.
        config = cli.config_of(options, SimulationConfig, base_imu=True)
        mechanism, frames, planned = load_in_space(config.mechanism), config.active_frames, None
        if Path(config.target).suffix == MOTION_SUFFIX and Path(config.target).is_file():
            motion = load_motion(config.target)
            motion = replace(motion, time_scale=config.time_scale * motion.time_scale)
            planned = plan_in_frames(motion, mechanism, frames)
            target, duration = target_of_motion(planned, planned.duration), planned.duration
        else:
            target = load_target(config.target, mechanism, config.duration, frames, config.time_scale)
            duration = min(config.duration, float(target.times[-1]))
        checked = check_against_limits(mechanism, target, duration, demands_of(config, mechanism))
    if options.csv is not None:
        write_whole(options.csv, text_of_target(target, mechanism, frames).encode())
    summary = checked.summary()
    cli.write_json(options.json, {**summary, **({} if planned is None else planned.summary()), "check": summary})
    if planned is not None:
        _print_elements(planned)
        _print_cues(planned)
    _print_check(checked, [*checked.peaks] if planned is None else planned.peaks)
    for line in filter(None, [*target.remarks, checked.remark, checked.refusal(frames)]):
        print(line)
    if not checked.passes:
        return 1
    verb = "takes" if planned is not None else "was checked for"
    print(f"{target.name} {verb} {duration:.3f} s on {options.mechanism}, within all limits")
    return 0


def _print_elements(planned: "PlannedMotion") -> None:
    table = Table("element", "from [s]", "takes [s]", "limit that binds", "reached [%]", "at [s]", left=(0, 3))
    for part in planned.parts[:_MOST_ROWS]:
        label = f"{part.label}, rest" if part.binding is None else part.label
        peak = part.binding
        binds = ("", "", "") if peak is None else (peak.name, f"{100.0 * peak.share:.1f}", f"{peak.time:.3f}")
        table.add(label, f"{part.begin:.3f}", f"{part.duration:.3f}", *binds)
    table.print()
    if len(planned.parts) > _MOST_ROWS:
        print(f"and {len(planned.parts) - _MOST_ROWS} more")


def _print_check(checked: "TargetCheck", peaks: "list[Peak]") -> None:
    table = Table("greatest", "value", "limit", "reached [%]", "at [s]", "")
    for peak in peaks:
        limit = ("-", "-") if peak.most == inf else (number_text(peak.most), f"{100.0 * peak.share:.1f}")
        table.add(peak.name, number_text(peak.value), *limit, f"{peak.time:.3f}", peak.unit)
    table.print()
    table = Table("closest to a limit of the pose", "value", "limit", "at [s]", "")
    for excess in checked.closest:
        value, bound, unit = excess.shown
        table.add(excess.limit.text, number_text(value), number_text(bound), f"{excess.time:.3f}", unit)
    table.print()


def _print_cues(planned: "PlannedMotion") -> None:
    table = Table("cue", "axis", "asked RMS [m/s2]", "missing RMS [m/s2]", "at most [m/s2]", "onset gain [%]", left=(0, 1))
    for part in planned.parts:
        if part.cue is not None:
            rows = zip(part.cue.asked, part.cue.error, part.cue.worst_error, part.cue.onset_gain, strict=True)
            for axis, (asked, error, worst, gain) in zip("xyz", rows, strict=True):
                onset = "-" if gain != gain else f"{100.0 * gain:.0f}"
                table.add(part.label, axis, f"{asked:.3f}", f"{error:.3f}", f"{worst:.3f}", onset)
    if table.rows:
        table.print()


@cli.command(cli.source("files", "FILE.mcap", "files of one run, in their order", nargs="+"), cli.JSON)
def gough_replay(options: Namespace) -> int:
    """Feed a recording's raw IMU data through the cycle again.

    Estimates and commands must be those of the recording, bit for bit.
    """
    from hil.recording.replay import replay

    cli.check_outputs(options, inputs=options.files)
    result = replay(options.files)
    cli.write_json(options.json, result.summary())
    for line in result.lines():
        print(line)
    return int(not result.same)


@cli.command(
    cli.argument(
        "runs",
        nargs="+",
        metavar="FILE",
        help="what 'gough simulate --json' or 'gough run --json' has written, or a recording, its files with commas in between",
    ),
    cli.argument("--reference", metavar="FILE", help="the run that the others are compared with (default: the first)"),
    cli.argument("--mechanism", metavar="NAME", help="of the recordings, if its file has moved"),
    cli.report("write a report with the tables, and the recordings on top of each other"),
    cli.JSON,
)
def gough_compare(options: Namespace) -> None:
    """Compare runs: configurations, errors, times.

    Prints what differs in the configurations, and every figure that a run has, with its difference and ratio to the reference's
    (docs/compare.md). Recordings are compared over the time of motion that all runs share. Figures of JSON files are of their
    whole motion.
    """
    from hil.runs.comparison import compare

    sources = [*options.runs, *filter(None, [options.reference])]
    cli.check_outputs(options, inputs=[Path(part) for source in {*sources} for part in source.split(",")])
    comparison = compare(options.runs, options.reference, options.mechanism)
    cli.write_json(options.json, comparison.summary())
    cli.write_report(options, "comparison", comparison)
    comparison.table().print()
    for remark in comparison.remarks:
        print(remark)
    differing = comparison.differing()
    print(f"what differs: {', '.join(differing) or 'nothing'}")
    if "version" not in differing:
        print(f"all were run by gough {comparison.reference.version}")


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ArgumentTypeError(f"{text!r} is no address such as 127.0.0.1:47200")
    return host.strip("[]"), int(port)


@cli.command(
    cli.options_of(
        SimulationConfig,
        "mechanism",
        target={"text": "a motion's name, or a CSV file, as for 'gough run'"},
        duration={
            "text": "duration of the motion",
            "default": None,
            "parse": float,
            "shown": "10; with --cueing, as long as the vehicle's motion",
        },
        rate={"default": 100.0, "text": "poses per second, at most 10000"},
        frames={"text": "the frames of the run"},
        frame={},
        tool={},
    ),
    cli.argument(
        "--cueing",
        type=Path,
        metavar="FILE.toml",
        help="instead of a target, render a vehicle's motion by these settings (docs/motions.md)",
    ),
    cli.setting(
        "--vehicle",
        "-",
        "with --cueing, where that motion comes from: a CSV file, - for lines on standard input, or "
        "udp:HOST:PORT for lines in datagrams",
        metavar="SOURCE",
    ),
    cli.setting("--to", "127.0.0.1:47200", "where the run listens", type=_address, metavar="HOST:PORT"),
    *(
        cli.argument(f"--{name}-at", type=float, default=SUPPRESS, metavar="SECONDS", help=f"{text} from this time on [s]")
        for name, text in (("stop", "fall silent"), ("jump", "jump up by 5 cm"), ("nan", "send what is no number"))
    ),
    cli.JSON,
)
def gough_stream_target(options: Namespace) -> None:
    """Send a target pose by pose to a run that follows a stream.

    Each pose is one UDP datagram, in real time. With --cueing, the poses render a vehicle's motion as it comes. In the end the
    sender says so, and the run holds the last pose until its own end; a sender that falls silent without that is lost. The
    stream can also go wrong on purpose, to show that the run then stops as it should.
    """
    from controller.planning.target import load_target
    from hil.runs.cue_stream import send_cues, source_of
    from hil.runs.target_stream import Faults, send_target
    from plant.mechanism import load_spatial

    mechanism = load_spatial(options.mechanism)
    # Whether there is an IMU on the base is the run's affair.
    frames = SimulationConfig(frames=options.frames, frame=options.frame, tool=options.tool, base_imu=True).active_frames
    host, port = options.to
    faults, duration = cli.config_of(options, Faults), options.duration
    if options.cueing is not None:
        if faults != Faults():
            raise InputError("a cue has no faults on purpose: leave --stop-at, --jump-at and --nan-at out, or --cueing")
        source = source_of(options.vehicle)
        figures = send_cues(mechanism, options.cueing, source, options.rate, host, port, duration, frames)
        print(f"{figures['sent']} poses of {options.vehicle} sent to {host}:{port}")
        _print_kept(figures)
    else:
        duration = SimulationConfig.duration if duration is None else duration
        target = load_target(options.target, mechanism, duration, frames)
        figures = {"sent": send_target(mechanism, target, options.rate, host, port, duration, faults, frames)}
        print(f"{figures['sent']} poses of {target.name} sent to {host}:{port}")
    cli.write_json(options.json, figures)


def _print_kept(figures: dict[str, Any]) -> None:
    came, kept = figures["vehicle"], figures["kept"]
    samples = max(kept["samples"], 1)
    print(", ".join(f"{came[name]} {name}" for name in came) + " of the vehicle's motion")
    for name, text in (
        ("clipped", "had an acceleration or angular velocity that was clipped"),
        ("tilt_clipped", "would have tilted further"),
        ("tilt_slowed", "would have tilted faster"),
        ("stroke", f"would have left the strokes, by up to {mm(kept['excess'])} mm at leg {kept['leg']}"),
        ("slowed", f"would have been too fast, with a leg at up to {kept['speed']:.3f} m/s"),
    ):
        if kept[name]:
            print(f"{100.0 * kept[name] / samples:.1f} % of the poses {text}")


@cli.command(
    cli.argument(
        "manoeuvres", nargs="+", metavar="MANOEUVRE", help="what the car does, in this order: brake, lane-change, bumps"
    ),
    cli.output("--csv", "FILE.csv", "write its accelerations and angular velocities, as motion cueing reads them"),
    cli.setting("--speed", 14.0, "of the car [m/s]"),
    cli.setting("--strength", 1.0, "factor on braking, on the acceleration to the side, and on the height of bumps"),
    cli.JSON,
)
def gough_vehicle(options: Namespace) -> None:
    """Make the motion of a car, to try motion cueing with (docs/motions.md)."""
    from controller.planning.motions import drive, text_of_vehicle

    vehicle = drive(options.manoeuvres, options.speed, options.strength)
    if options.csv is not None:
        write_whole(options.csv, text_of_vehicle(vehicle).encode())
    forces, rates = (abs(values).max(axis=0).tolist() for values in (vehicle.forces, vehicle.rates))
    duration = float(vehicle.times[-1])
    cli.write_json(options.json, {"duration": duration, "greatest_acceleration": forces, "greatest_angular_velocity": rates})
    table = Table("axis", "acceleration [m/s2]", "angular velocity [deg/s]", left=(0,))
    for axis, force, rate in zip("xyz", forces, rates, strict=True):
        table.add(axis, f"{force:.3f}", deg(rate))
    table.print()
    print(f"{', '.join(options.manoeuvres)}: {duration:.2f} s")
