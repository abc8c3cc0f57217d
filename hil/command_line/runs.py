"""The commands that run the loop: simulate, run, replay."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.command_line.live_view import live_view
from hil.command_line.options import (
    add_calibration,
    add_imu,
    add_joint_error,
    add_json,
    add_mechanism,
    add_plant,
    add_rig,
    simulation_config,
)
from hil.command_line.outputs import OutputError, check_distinct, check_outputs, write_json
from hil.command_line.printing import deg, mm, new_table, print_table, progress_bar
from plant.errors import InputError

if TYPE_CHECKING:
    from hil.runs.config import SimulationConfig
    from hil.runs.snapshot import Snapshot


def add_simulate(commands: Any) -> None:
    """Add `gough simulate`."""
    command = commands.add_parser(
        "simulate",
        help="follow a target on the FMU plant, as fast as it goes",
        description="Simulate the closed loop: a mechanism follows a target motion on its FMU plant.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    _add_motion(command)
    command.add_argument("--report", type=Path, metavar="FILE.html", help="write a report with plots and a moving 3-D view")
    add_json(command)
    command.add_argument("--save-state", type=Path, metavar="FILE", help="write a snapshot, from which it can go on")
    command.add_argument(
        "--save-at", type=float, default=argparse.SUPPRESS, metavar="SECONDS", help="when, of the motion (default: at its end)"
    )
    command.add_argument(
        "--load-state", type=Path, metavar="FILE",
        help="go on from a snapshot, bit for bit as if there had been none; nothing but --duration can be changed",
    )  # fmt: skip
    command.set_defaults(run=_simulate)


def _add_motion(command: argparse.ArgumentParser) -> None:
    """What simulations and runs on the clock have in common."""
    add_mechanism(command)
    command.add_argument(
        "--target",
        default="circle",
        help="hold, circle, sines, steps, near-rests, rests, shaking, probing, or a CSV file of displacements from home "
        "(time_s,x_m,y_m,z_m,qw,qx,qy,qz); for 'gough run' also stream or stream:HOST:PORT, as 'gough stream-target' sends",
    )
    command.add_argument("--duration", type=float, default=argparse.SUPPRESS, help="of the motion [s] (default: 10.0)")
    command.add_argument("--rate", type=float, default=1000.0, help="cycles per second [Hz], 50 to 4000")
    add_imu(command)
    command.add_argument("--imus", type=_imus, default="all", help="which IMUs there are: all, legs, or a list such as 0,2,4,6")
    command.add_argument("--magnetometer", action="store_true", help="the platform's magnetometer gives its heading")
    command.add_argument("--seed", type=int, default=0, help="of the IMUs' imperfections")
    add_calibration(command)
    command.add_argument(
        "--fusion",
        default="compiled",
        help="compiled: leg and platform filters; whole, whole-gyroscopes, whole-alignments: all IMUs together, with biases "
        "of both sensors, of the gyroscopes, or with scales and alignments; section-5: the paper's, the orientation from the "
        "platform's IMU with --magnetometer, the position from the legs; filterpy: as compiled, but on filterpy (slow)",
    )
    add_plant(command)
    command.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="NAME=VALUE[@SECONDS]",
        help="a parameter or input of the FMU, from the start or from a time of the motion on, such as payload.mass=12@3.5 or "
        "gravity=0,0,-9.8; can be given several times",
    )  # fmt: skip
    add_joint_error(command)


_MOTION = (
    "mechanism",
    "target",
    "duration",
    "rate",
    "imu",
    "seed",
    "fusion",
    "calibration",
    "plant",
    "binding",
    "settings",
    "imus",
    "magnetometer",
)
"""What `_add_motion` adds, beside the joints' error."""


def _imus(text: str) -> tuple[int, ...]:
    named = {"all": (0, 1, 2, 3, 4, 5, 6), "legs": (0, 1, 2, 3, 4, 5)}
    if text in named:
        return named[text]
    try:
        return tuple(sorted({int(part) for part in text.split(",")}))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither all, legs, nor a list of numbers such as 0,2,4,6") from None


def _simulate(options: argparse.Namespace) -> int:
    from hil.runs.simulation import SimulationStoppedError, simulate
    from hil.runs.snapshot import read_snapshot, write_snapshot

    check_outputs(options.json, options.report, options.save_state)
    config, resumed = simulation_config(options, *_MOTION), None
    if options.load_state is not None:
        resumed = read_snapshot(options.load_state)
        config = _resumed_config(options, config, resumed)
    save_at = getattr(options, "save_at", config.duration) if options.save_state is not None else None
    if save_at is None and hasattr(options, "save_at"):
        raise InputError("--save-at says when to write a snapshot, but not where to: add --save-state FILE")
    stopped = None
    with progress_bar(f"{config.mechanism} follows {config.target}") as progress:
        try:
            result = simulate(config, progress, resumed, save_at)
        except SimulationStoppedError as error:
            stopped, result = error, error.result
    if result.snapshot is not None and options.save_state is not None:
        write_snapshot(result.snapshot, options.save_state)
    if stopped is None or result.moved:
        write_json(options.json, result.summary())
        if options.report:
            from hil.reports.run import write_report

            write_report(result, options.report)
        _print_simulation(result.summary())
    if stopped:
        raise stopped
    return 0


def _resumed_config(options: argparse.Namespace, config: "SimulationConfig", resumed: "Snapshot") -> "SimulationConfig":
    """The configuration of a snapshot, with another duration if one is given."""
    from hil.runs.config import SimulationConfig

    kept = SimulationConfig.from_plain(resumed.config)
    for name in (*_MOTION, "joint_error"):
        given, was = getattr(config, name), getattr(kept, name)
        if name != "duration" and given not in (was, getattr(SimulationConfig(), name)):
            raise InputError(f"the snapshot was taken with {name} {was}, and cannot go on with {given}: leave it out")
    return replace(kept, duration=getattr(options, "duration", kept.duration))


def _print_simulation(summary: dict[str, Any]) -> None:
    table = new_table("", "position RMS [mm]", "max [mm]", "rotation RMS [deg]", "max [deg]")
    rows = [("estimate - reference", "estimated_tracking", ""), ("reference - target", "target", "reference_")]
    if summary["truth_known"]:
        rows[:1] = [
            ("estimate - truth", "estimation", ""),
            ("truth - reference", "tracking", ""),
            ("truth - target", "target", ""),
        ]
    for label, group, prefix in rows:
        errors = summary[group]
        table.add_row(
            label,
            *(mm(errors[f"{prefix}position_{kind}"], 4) for kind in ("rms", "max")),
            *(deg(errors[f"{prefix}rotation_{kind}"], 4) for kind in ("rms", "max")),
        )
    print_table(table)
    if not summary["truth_known"]:
        print("the truth is not known: the plant does not tell its pose")
    cycle = summary["cycle_us"]
    print(
        f"limits violated by the reference: {summary['limits']['violations']}; "
        f"{summary['real_time_factor']:.1f} times real time; "
        f"cycle p50/p99/p99.9 {cycle['p50']:.1f}/{cycle['p99']:.1f}/{cycle['p999']:.1f} us"
    )


def add_run(commands: Any) -> None:
    """Add `gough run`."""
    command = commands.add_parser(
        "run",
        help="follow a target on the machine's clock",
        description="Run the closed loop on the machine's clock: compiled, in a process of its own, with real-time priority "
        "where the machine grants it. Ctrl-C or SIGTERM ends the motion by a controlled stop, Ctrl-\\ (SIGQUIT) by an "
        "emergency stop: the drives come to rest by themselves, whatever is measured.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add_rig(command, default="fmu")
    command.add_argument("--no-arm", dest="arm", action="store_false", help="read everything, and move nothing")
    _add_motion(command)
    command.add_argument("--record", type=Path, metavar="FILE.mcap", help="record every cycle")
    command.add_argument("--cpu", type=int, help="processor to stay on (default: the last one)")
    command.add_argument("--priority", type=int, default=80, help="of SCHED_FIFO, 1 to 98")
    command.add_argument("--strict", action="store_true", help="do not run if the machine refuses anything of real time")
    command.add_argument("--most-missed", type=int, default=10, help="periods missed in a row that end in a controlled stop")
    add_json(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from hil.realtime.scheduling import RealTimeSettings, keep_to_one_thread

    keep_to_one_thread()
    from hil.runs.executive import RunStoppedError, run

    check_outputs(options.json, options.record)
    config = simulation_config(options, *_MOTION, "rig", "rig_at", "arm")
    settings = RealTimeSettings(options.priority, options.cpu, options.strict, options.most_missed)
    stopped = None
    with live_view(config.mechanism, config.target, config.rate) as show:
        try:
            summary = run(config, settings, options.record, show)
        except RunStoppedError as error:
            stopped = error
            if error.summary is None:
                raise
            summary = error.summary
    trouble = None
    try:
        _print_run(summary)
    except OSError as error:
        trouble = error
    write_json(options.json, summary)
    if stopped:
        raise stopped
    if trouble:
        raise trouble
    if summary["obstacle"]:
        return 1
    lost = summary["recording"]["lost"]
    if lost:
        raise OutputError(f"the run went to its end, but {lost} of {summary['cycles']} cycles are not recorded")
    return 0


def _print_run(summary: dict[str, Any]) -> None:
    from hil.loop.timing import budget

    print_table(_timing_table(summary["timing_us"], budget()))
    for line in (*(f"over budget: {text}" for text in summary["over_budget"]), *summary["events"]):
        print(line)
    if not summary["over_budget"]:
        print("within the timing budget (hil/loop/budget.toml)")
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
    truth = f"estimate - truth {mm(errors['estimation'])} mm RMS" if errors["known"] else "the truth is not known"
    print(f"{truth}; reference - length {mm(errors['tracking'])} mm RMS")
    if trip := summary["timing_us"].get("round trip"):
        figures = ", ".join(f"{label} {trip[name]:.0f}" for label, name in _QUANTILES)
        print(f"round trip to the rig {figures} us")
        print(f"{summary['late']} exchanges late, {summary['refused_packets']} packets refused")
        print(_bars(summary["round_trip_bars"]))
    if summary["unseen"]:
        print(f"{summary['unseen']} cycles are in none of these figures: the supervisor came too late")
    if summary["recording"]["files"]:
        kept = summary["cycles"] - summary["recording"]["lost"]
        files = ", ".join(summary["recording"]["files"])
        print(f"{kept} cycles recorded in {files}; {summary['recording']['lost']} cycles lost")
    if summary["identity"]:
        print(f"rig: {summary['identity']['name']} {summary['identity']['parts']}")
    if summary["obstacle"] is not None:
        print(summary["obstacle"] or "nothing was moved; all is well for arming")
    print(f"stopped on the brakes: {summary['cause']}")


_QUANTILES = (("p50", "p50"), ("p99", "p99"), ("p99.9", "p999"), ("max", "max"))
"""How each quantile is printed, and its name in a summary."""


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


def _timing_table(timing: dict[str, dict[str, float]], budget: dict[str, dict[str, float]]) -> Any:
    """Microseconds of each stage, with its budget where it has one, and marked where it exceeds that."""
    table = new_table("us", *(f"{label} / budget" for label, _ in _QUANTILES))
    for stage, figures in timing.items():
        limits = budget.get(stage, {})
        cells = []
        for _, name in _QUANTILES:
            limit = limits.get(name)
            over = limit is not None and figures[name] > limit
            text = f"{figures[name]:.1f}" + (f" / {limit:g}" if limit is not None else " /  -")
            cells.append(f"[bold red]{text}[/]" if over else text)
        table.add_row(stage, *cells)
    return table


def add_replay(commands: Any) -> None:
    """Add `gough replay`."""
    command = commands.add_parser(
        "replay",
        help="feed a recording's raw IMU data through the cycle again",
        description="Feed the recorded raw IMU data through the same cycle and compare estimates and commands bit for bit.",
    )
    command.add_argument("files", type=Path, nargs="+", metavar="FILE.mcap", help="of one run, in their order")
    add_json(command)
    command.set_defaults(run=_replay)


def _replay(options: argparse.Namespace) -> int:
    from hil.recording.replay import replay

    check_distinct(options.json, *options.files)
    check_outputs(options.json)
    result = replay(options.files)
    write_json(options.json, result.summary())
    for line in result.lines():
        print(line)
    return 0 if result.same else 1
