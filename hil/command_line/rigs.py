"""The commands for rigs: check-rig, emulate, inject."""

from argparse import Namespace
from contextlib import nullcontext
from dataclasses import asdict
from typing import Any

from hil.command_line import cli
from hil.realtime.scheduling import RealTimeSettings, keep_to_one_thread, real_time
from hil.runs.config import EmulatorConfig, SimulationConfig
from hil.table import Cell, Table
from plant.errors import InputError


@cli.command(
    cli.options_of(
        SimulationConfig,
        rig={"required": True},
        rig_at={},
        mechanism={},
        imu={},
        lengths={"text": "encoders that the rig has: none, incremental or absolute"},
        base_imu={"text": "the rig has an IMU on its base"},
        rate={"default": 200.0, "text": "exchanges per second, 50 to 4000"},
    ),
    cli.flag(
        "--move",
        "enable the drives, move all legs by 0.2 mm and each by 2 mm, at 5 mm/s at most, and compare signs and units",
    ),
    cli.argument(
        "--beyond",
        type=float,
        metavar="SPEED",
        help="with --move, a command beyond the limits to try [m/s]: for emulated rigs only, never for hardware",
    ),
    cli.JSON,
)
def gough_check_rig(options: Namespace) -> int:
    """Check that a rig does what the loop relies on.

    The rig is put through its contract, clause by clause. Nothing moves without --move. With it, bring the platform near home
    first: the signs and units of commands, gyroscopes and accelerometers are compared with each other, with gravity, and with
    what the mechanism's file expects of small motions there. The exit status is 1 if anything is found.
    """
    from importlib.metadata import version

    keep_to_one_thread()
    from hil.rigs.clauses import CLAUSES
    from hil.rigs.contract import examine_rig
    from hil.runs.prepare import rig_of
    from plant.imu import aliasing_remark, load_imu
    from plant.mechanism import load_in_space

    if options.beyond is not None and not options.move:
        raise InputError("--beyond is a command to the drives: it needs --move")
    config = cli.config_of(options, SimulationConfig)

    def made() -> Any:
        rig = rig_of(config)
        if rig is None:
            raise InputError("the FMU plant is no rig of its own: choose udp, canopen, replay or python:MODULE:CLASS")
        return rig

    # A recording moves as it was recorded.
    mechanism = None if options.rig == "replay" else load_in_space(config.mechanism)
    # A machine that is busy elsewhere would let the drives go on.
    with real_time(RealTimeSettings()) if options.move else nullcontext():
        examination = examine_rig(made, 1.0 / options.rate, options.move, options.beyond, mechanism=mechanism)
    table = Table("clause", "outcome", "what it asks for", left=(0, 2))
    for clause, findings in examination.findings.items():
        table.add(clause, Cell(f"{len(findings)} found" if findings else "ok", alarm=bool(findings)), CLAUSES[clause])
    table.print()
    found = examination.all_findings()
    for text in found:
        print(text)
    if examination.exchange_us:
        p50, p99, most, count = (examination.exchange_us[name] for name in ("p50", "p99", "max", "n"))
        print(f"exchange p50/p99/max {p50:.0f}/{p99:.0f}/{most:.0f} us of {1e6 / options.rate:g}, {count:g} exchanges")
    moved = "and the drives moved" if options.move else "and nothing was moved"
    if "commands" in examination.findings:
        print(
            f"compared: the accelerometers with gravity at home in {config.mechanism}; the commands and the gyroscopes with "
            "how the accelerometers tilt when a leg moves"
        )
    if remark := aliasing_remark(load_imu(config.imu), config.rate):
        print(remark)
    print(f"{len(examination.findings)} clauses checked, {len(found)} findings, {moved}")
    asked = {"rig": options.rig, "rig_at": options.rig_at, "rate": options.rate, "moved": options.move}
    cli.write_json(options.json, {**asked, **asdict(examination), "version": version("gough")})
    return int(bool(found))


@cli.command(
    cli.options_of(EmulatorConfig),
    cli.options_of(
        SimulationConfig,
        "mechanism",
        "imu",
        "lengths",
        "base_imu",
        "plant",
        "binding",
        "joint_error",
        target={"text": "the platform starts at the first pose of this target"},
        rate={"text": "rate of the IMUs' samples on canopen; on udp the run sets it"},
        seed={"text": "seed of the IMUs' imperfections and of the faults"},
    ),
    cli.options_of(RealTimeSettings, cpu={"default": 0, "shown": None}, priority={"default": 79}),
)
def gough_emulate(options: Namespace) -> None:
    """Emulate a rig on a bus, for 'gough run' in another process.

    The FMU plant, drives and IMUs run on a clock of their own, behind a bus, until Ctrl-C.
    """
    keep_to_one_thread()
    from hil.runs.emulator_process import emulate

    config = cli.config_of(options, EmulatorConfig, simulated=cli.config_of(options, SimulationConfig))
    emulate(config, cli.config_of(options, RealTimeSettings), lambda text: print(text, flush=True))


@cli.command(
    cli.argument("fault", nargs="?", metavar="KIND[:N][,WORD=VALUE]", help="the fault, from now on"),
    cli.flag("--list", "list the kinds of faults"),
    cli.flag("--clear", "take all faults away"),
    cli.argument(
        "--to", metavar="HOST:PORT", help="the emulator's control channel; needed unless one emulator of this user runs here"
    ),
)
def gough_inject(options: Namespace) -> None:
    """Inject a fault into an emulated rig that is running, or ask for its state."""
    from hil.rigs.emulation import FaultKind
    from hil.runs.emulator_process import ask, own_control
    from plant.dynamics.base_course import BaseMotionKind
    from plant.encoders import EncoderFaultKind
    from plant.imu_disturbances import WORDS, DisturbanceKind

    if options.list:
        table = Table("fault", "number", "size by default", "")
        for kind in FaultKind:
            table.add(kind.label, f"0 to {kind.count - 1}" if kind.count else "", f"{kind.default:g}", kind.text)
        table.print()
        table = Table("disturbance", "size", "where", "")
        for each in DisturbanceKind:
            table.add(each.label, ", ".join(each.sizes), ", ".join(("imus", *each.places)), each.text)
        for motion in BaseMotionKind:
            table.add(motion.label, ", ".join(motion.sizes), "axis", motion.text)
        for broken in EncoderFaultKind:
            table.add(broken.label, broken.size, "legs", broken.text)
        table.print()
        table = Table("word", "")
        for word, meaning in WORDS.items():
            table.add(word, meaning)
        table.print()
        return
    question = "clear" if options.clear else f"fault {options.fault}" if options.fault else "state"
    for name, value in ask(options.to or own_control(), question).items():
        print(f"{name}: {value}")
