"""The commands for what the loop is connected with: check-rig, emulate, inject, faults, stream-target."""

import argparse
import sys
from importlib.metadata import version
from typing import Any

from hil.command_line.options import add_imu, add_joint_error, add_json, add_mechanism, add_plant, add_rig, simulation_config
from hil.command_line.outputs import check_outputs, write_json
from hil.command_line.printing import new_table, print_table, progress_bar
from plant.errors import InputError


def add_check_rig(commands: Any) -> None:
    """Add `gough check-rig`."""
    command = commands.add_parser(
        "check-rig",
        help="check that a rig does what the loop relies on",
        description="Put a rig through the contract that the loop relies on, clause by clause. Nothing moves without --move. "
        "Exit status 1 if anything is found.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add_rig(command, required=True)
    add_mechanism(command)
    command.add_argument("--rate", type=float, default=200.0, help="exchanges per second [Hz], 50 to 4000")
    command.add_argument("--move", action="store_true", help="enable the drives, and move all legs by 0.2 mm at 1 mm/s")
    command.add_argument(
        "--beyond", type=float, metavar="SPEED", help="with --move, a command beyond the limits to try [m/s]: for emulated "
        "rigs only, never for hardware",
    )  # fmt: skip
    add_json(command)
    command.set_defaults(run=_check_rig)


def _check_rig(options: argparse.Namespace) -> int:
    from dataclasses import asdict

    from hil.realtime.scheduling import keep_to_one_thread

    keep_to_one_thread()
    from hil.rigs.contract import CLAUSES, examine_rig
    from hil.runs.config import SimulationConfig
    from hil.runs.executive import rig_of

    check_outputs(options.json)
    if options.beyond is not None and not options.move:
        raise InputError("--beyond is a command to the drives: it needs --move")
    config = SimulationConfig(mechanism=options.mechanism, rate=options.rate, rig=options.rig, rig_at=options.rig_at)

    def made() -> Any:
        rig = rig_of(config)
        if rig is None:
            raise InputError("the FMU plant is no rig of its own: choose udp, canopen, replay or python:MODULE:CLASS")
        return rig

    examination = examine_rig(made, 1.0 / options.rate, options.move, options.beyond)
    table = new_table("clause", "outcome", "what it asks for")
    for clause, findings in examination.findings.items():
        table.add_row(clause, f"[bold red]{len(findings)} found[/]" if findings else "ok", CLAUSES[clause])
    table.columns[2].justify = "left"
    print_table(table)
    found = examination.all_findings()
    for text in found:
        print(text)
    if examination.exchange_us:
        p50, p99, most, count = (examination.exchange_us[name] for name in ("p50", "p99", "max", "n"))
        print(f"exchange p50/p99/max {p50:.0f}/{p99:.0f}/{most:.0f} us of {1e6 / options.rate:g}, {count:g} exchanges")
    moved = "and the drives moved" if options.move else "and nothing was moved"
    print(f"{len(examination.findings)} clauses checked, {len(found)} findings, {moved}")
    write_json(
        options.json,
        {
            "rig": options.rig,
            "rig_at": options.rig_at,
            "rate": options.rate,
            "moved": options.move,
            **asdict(examination),
            "version": version("gough"),
        },
    )
    return 1 if found else 0


def add_emulate(commands: Any) -> None:
    """Add `gough emulate`."""
    command = commands.add_parser(
        "emulate",
        help="emulate a rig on a bus, for 'gough run' in another process",
        description="Emulate a rig: the FMU plant, drives and IMUs on a clock of their own, behind a bus, until Ctrl-C.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--bus", choices=("udp", "canopen"), default="udp", help="what it speaks")
    command.add_argument("--at", metavar="ADDRESS|FILE.toml", help="as 'gough run' has it for --rig-at")
    command.add_argument("--control", default="127.0.0.1:47101", metavar="HOST:PORT", help="where it takes faults")
    command.add_argument(
        "--fault", action="append", default=[], metavar="KIND[:N][,at=S][,for=S][,size=X]",
        help="a fault from the start, or at a time after the drives were first enabled [s]; 'gough inject --list' lists them",
    )  # fmt: skip
    add_mechanism(command)
    command.add_argument("--target", default="circle", help="at whose first pose the platform stands")
    add_imu(command)
    command.add_argument("--watchdog", type=float, default=30.0, help="on udp: without a command for so long, drives stop [ms]")
    command.add_argument("--rate", type=float, default=1000.0, help="of the IMUs' samples on canopen; udp asks for it [Hz]")
    command.add_argument("--seed", type=int, default=0, help="of the IMUs' imperfections and the faults")
    add_plant(command)
    add_joint_error(command)
    command.add_argument("--cpu", type=int, default=0, help="processor to stay on")
    command.add_argument("--priority", type=int, default=79, help="of SCHED_FIFO, 1 to 98")
    command.set_defaults(run=_emulate)


def _emulate(options: argparse.Namespace) -> int:
    from hil.realtime.scheduling import RealTimeSettings, keep_to_one_thread

    keep_to_one_thread()
    from hil.runs.config import EmulatorConfig
    from hil.runs.emulator import emulate

    simulated = simulation_config(options, "mechanism", "target", "imu", "seed", "plant", "binding", "rate")
    config = EmulatorConfig(
        simulated, options.bus, options.at, options.control, tuple(options.fault), 1e-3 * options.watchdog
    )  # fmt: skip
    emulate(config, RealTimeSettings(options.priority, options.cpu), lambda text: print(text, flush=True))
    return 0


def add_inject(commands: Any) -> None:
    """Add `gough inject`."""
    command = commands.add_parser(
        "inject",
        help="let something go wrong with an emulated rig",
        description="Inject a fault into an emulated rig that is running, or ask how it is.",
    )
    command.add_argument("fault", nargs="?", metavar="KIND[:N][,for=S][,size=X]", help="the fault, from now on")
    command.add_argument("--list", action="store_true", help="list the kinds of faults")
    command.add_argument("--clear", action="store_true", help="take all faults away")
    command.add_argument("--to", default="127.0.0.1:47101", metavar="HOST:PORT", help="the emulator's control channel")
    command.set_defaults(run=_inject)


def _inject(options: argparse.Namespace) -> int:
    from rich.markup import escape

    from hil.rigs.emulation.faults import FaultKind
    from hil.runs.emulator import ask

    if options.list:
        table = new_table("fault", "number", "size by default", "")
        for kind in FaultKind:
            table.add_row(kind.label, f"0 to {kind.count - 1}" if kind.count else "", f"{kind.default:g}", escape(kind.text))
        print_table(table)
        return 0
    question = "clear" if options.clear else f"fault {options.fault}" if options.fault else "state"
    for name, value in ask(options.to, question).items():
        print(f"{name}: {value}")
    return 0


def add_faults(commands: Any) -> None:
    """Add `gough faults`."""
    command = commands.add_parser(
        "faults",
        help="let everything go wrong, many times, and compare with the reaction that is specified",
        description="Run every case of the fault matrix on the emulated rig, on virtual time: what is told, how it ends, how "
        "soon, and how far a leg gets off its reference. The exit status is 1 if any reaction is another than specified.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--seeds", type=int, default=20, help="how often each case is tried")
    command.add_argument("--only", metavar="TEXT", help="cases whose name has this in it")
    command.add_argument("--markdown", action="store_true", help="print the table in Markdown, as docs/faults.md has it")
    add_json(command)
    command.set_defaults(run=_faults)


def _faults(options: argparse.Namespace) -> int:
    from hil.studies.fault_matrix import CASES, run_matrix, summary, table

    check_outputs(options.json)
    if options.seeds < 1:
        raise InputError(f"there are {options.seeds} seeds; at least 1 is needed")
    cases = tuple(case for case in CASES if options.only is None or options.only in case.name)
    if not cases:
        raise InputError(f"no case has {options.only!r} in its name")
    with progress_bar("faults") as progress:
        outcomes = run_matrix(options.seeds, cases, progress)
    if options.markdown:
        print(table(outcomes).markdown())
    else:
        table(outcomes).print()
    write_json(options.json, summary(outcomes, options.seeds))
    findings = [finding for outcome in outcomes for finding in outcome.findings]
    for finding in findings:
        print(finding, file=sys.stderr)
    return 1 if findings else 0


def add_stream_target(commands: Any) -> None:
    """Add `gough stream-target`."""
    command = commands.add_parser(
        "stream-target",
        help="send a target, pose by pose in real time, to a run that follows a stream",
        description="Send a motion as a stream of poses in real time, one UDP datagram each, to a run that follows a "
        "stream. It can also go wrong on purpose, to see that the run then stops as it should.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add_mechanism(command)
    command.add_argument("--target", default="circle", help="a motion's name, or a CSV file, as 'gough run' has them")
    command.add_argument("--duration", type=float, default=10.0, help="of the motion [s]")
    command.add_argument("--rate", type=float, default=100.0, help="poses per second [Hz], at most 10000")
    command.add_argument("--to", type=_address, default="127.0.0.1:47200", metavar="HOST:PORT", help="where the run listens")
    command.add_argument("--stop-at", type=float, metavar="SECONDS", help="fall silent at this time")
    command.add_argument("--jump-at", type=float, metavar="SECONDS", help="jump up by 5 cm at this time")
    command.add_argument("--nan-at", type=float, metavar="SECONDS", help="send what is no number from this time on")
    command.set_defaults(run=_stream_target)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise argparse.ArgumentTypeError(f"{text!r} is no address such as 127.0.0.1:47200")
    return host.strip("[]"), int(port)


def _stream_target(options: argparse.Namespace) -> int:
    from controller.planning.target import load_target
    from hil.runs.target_stream import Faults, send_target
    from plant.mechanism import load_spatial

    mechanism = load_spatial(options.mechanism)
    target = load_target(options.target, mechanism, options.duration)
    given = {name: getattr(options, name) for name in ("stop_at", "jump_at", "nan_at") if getattr(options, name) is not None}
    host, port = options.to
    sent = send_target(mechanism, target, options.rate, host, port, options.duration, Faults(**given))
    print(f"{sent} poses of {target.name} sent to {host}:{port}")
    return 0
