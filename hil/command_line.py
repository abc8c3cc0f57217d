"""The command `gough`."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from plant.errors import GoughError, InputError
from plant.files import check_writable, write_whole

REFUSED, INTERRUPTED = 2, 130
"""Exit statuses beside 0, and 1 for a run that ended before its time: bad input, with nothing done; Ctrl-C."""


class OutputError(GoughError, OSError):
    """Something was done, but not all of what it gave could be written."""

    exit_status = 1


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(REFUSED, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    options = _parser().parse_args(arguments)
    try:
        status: int = options.run(options)
        sys.stdout.flush()
    except GoughError as error:
        with suppress(OSError):
            print(f"gough: {error}", file=sys.stderr)
        return getattr(error, "exit_status", REFUSED)
    except OSError as error:
        # Whoever reads the output has gone, or its disk is full; nothing more is to be flushed there.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        with suppress(OSError):
            print(f"gough: the output cannot be written: {error.strerror}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("gough: interrupted", file=sys.stderr)
        return INTERRUPTED
    return status


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="gough", description="Pose control of parallel mechanisms from orientations.")
    parser.add_argument("--version", action="version", version=f"gough {version('gough')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    _add_simulate(commands)
    _add_run(commands)
    _add_check_rig(commands)
    _add_emulate(commands)
    _add_inject(commands)
    _add_faults(commands)
    _add_stream_target(commands)
    _add_replay(commands)
    _add_calibrate(commands)
    _add_compare(commands)
    _add_evaluate(commands)
    _add_tune(commands)
    _add_tune_fusion(commands)
    _add_fmu(commands)
    _add_bench(commands)
    _add_classify(commands)
    _add_accuracy(commands)
    _add_classes(commands)
    _add_sensor_sets(commands)
    _add_planar(commands)
    _add_broad(commands)
    return parser


def _add_simulate(commands: Any) -> None:
    command = commands.add_parser(
        "simulate",
        help="follow a target on the FMU plant, as fast as it goes",
        description="Simulate the closed loop: a mechanism follows a target motion on its FMU plant.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    _add_motion(command)
    command.add_argument("--report", type=Path, metavar="FILE.html", help="write a report with plots and a moving 3-D view")
    _add_json(command)
    command.set_defaults(run=_simulate)


def _add_motion(command: argparse.ArgumentParser) -> None:
    """What simulations and runs on the clock have in common."""
    command.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")
    command.add_argument(
        "--target",
        default="circle",
        help="hold, circle, sines, steps, near-rests, rests, shaking, probing, or a CSV file of displacements from home "
        "(time_s,x_m,y_m,z_m,qw,qx,qy,qz); for 'gough run' also stream or stream:HOST:PORT, as 'gough stream-target' sends",
    )
    command.add_argument("--duration", type=float, default=10.0, help="of the motion [s]")
    command.add_argument("--rate", type=float, default=1000.0, help="cycles per second [Hz], 50 to 4000")
    command.add_argument("--imu", default="mpu9150-calibrated", help="ideal, mpu9150, mpu9150-calibrated or icm42688")
    command.add_argument("--imus", type=_imus, default="all", help="which IMUs there are: all, legs, or a list such as 0,2,4,6")
    command.add_argument("--magnetometer", action="store_true", help="the platform's magnetometer gives its heading")
    command.add_argument("--seed", type=int, default=0, help="of the IMUs' imperfections")
    command.add_argument("--calibration", metavar="FILE.toml", help="the IMUs' constants, as 'gough calibrate' writes them")
    command.add_argument(
        "--fusion",
        default="compiled",
        help="compiled: leg and platform filters; whole, whole-gyroscopes, whole-alignments: all IMUs together, with biases "
        "of both sensors, of the gyroscopes, or with scales and alignments; section-5: the paper's, the orientation from the "
        "platform's IMU with --magnetometer, the position from the legs; filterpy: as compiled, but on filterpy (slow)",
    )
    command.add_argument("--plant", metavar="FILE.fmu", help="FMI 3.0 Co-Simulation FMU to use instead of the built one")
    _add_joint_error(command)


def _add_joint_error(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--joint-error",
        type=float,
        default=0.0,
        help="simulated: standard deviation of each coordinate of the joints from their places [mm]",
    )


def _add_run(commands: Any) -> None:
    command = commands.add_parser(
        "run",
        help="follow a target on the machine's clock",
        description="Run the closed loop on the machine's clock: compiled, in a process of its own, with real-time priority "
        "where the machine grants it. Ctrl-C or SIGTERM ends the motion by a controlled stop, Ctrl-\\ (SIGQUIT) by an "
        "emergency stop: the drives come to rest by themselves, whatever is measured.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    _add_rig(command, default="fmu")
    command.add_argument("--no-arm", dest="arm", action="store_false", help="read everything, and move nothing")
    _add_motion(command)
    command.add_argument("--record", type=Path, metavar="FILE.mcap", help="record every cycle")
    command.add_argument("--cpu", type=int, help="processor to stay on (default: the last one)")
    command.add_argument("--priority", type=int, default=80, help="of SCHED_FIFO, 1 to 98")
    command.add_argument("--strict", action="store_true", help="do not run if the machine refuses anything of real time")
    command.add_argument("--most-missed", type=int, default=10, help="periods missed in a row that end in a controlled stop")
    _add_json(command)
    command.set_defaults(run=_run)


def _add_rig(command: argparse.ArgumentParser, **options: Any) -> None:
    command.add_argument(
        "--rig", metavar="RIG", **options, help="what is driven: fmu, the plant; udp or canopen, a rig on a bus; replay, a "
        "recording; or python:MODULE:CLASS, a rig of your own, as hil/rigs/template.py is one",
    )  # fmt: skip
    command.add_argument(
        "--rig-at", metavar="ADDRESS|FILE", help="where the rig is: HOST:PORT for udp (default: 127.0.0.1:47100), settings of "
        "the bus for canopen, the recording (files of one run with commas in between) for replay",
    )  # fmt: skip


def _add_check_rig(commands: Any) -> None:
    command = commands.add_parser(
        "check-rig",
        help="check that a rig does what the loop relies on",
        description="Put a rig through the contract that the loop relies on, clause by clause. Nothing moves without --move. "
        "Exit status 1 if anything is found.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    _add_rig(command, required=True)
    command.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")
    command.add_argument("--rate", type=float, default=200.0, help="exchanges per second [Hz], 50 to 4000")
    command.add_argument("--move", action="store_true", help="enable the drives, and move all legs by 0.2 mm at 1 mm/s")
    command.add_argument(
        "--beyond", type=float, metavar="SPEED", help="with --move, a command beyond the limits to try [m/s]: for emulated "
        "rigs only, never for hardware",
    )  # fmt: skip
    _add_json(command)
    command.set_defaults(run=_check_rig)


def _add_emulate(commands: Any) -> None:
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
    command.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")
    command.add_argument("--target", default="circle", help="at whose first pose the platform stands")
    command.add_argument("--imu", default="mpu9150-calibrated", help="ideal, mpu9150, mpu9150-calibrated or icm42688")
    command.add_argument("--watchdog", type=float, default=30.0, help="on udp: without a command for so long, drives stop [ms]")
    command.add_argument("--rate", type=float, default=1000.0, help="of the IMUs' samples on canopen; udp asks for it [Hz]")
    command.add_argument("--seed", type=int, default=0, help="of the IMUs' imperfections and the faults")
    command.add_argument("--plant", metavar="FILE.fmu", help="FMI 3.0 Co-Simulation FMU to use instead of the built one")
    _add_joint_error(command)
    command.add_argument("--cpu", type=int, default=0, help="processor to stay on")
    command.add_argument("--priority", type=int, default=79, help="of SCHED_FIFO, 1 to 98")
    command.set_defaults(run=_emulate)


def _add_inject(commands: Any) -> None:
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


def _add_faults(commands: Any) -> None:
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
    _add_json(command)
    command.set_defaults(run=_faults)


def _add_stream_target(commands: Any) -> None:
    command = commands.add_parser(
        "stream-target",
        help="send a target, pose by pose in real time, to a run that follows a stream",
        description="Send a motion as a stream of poses in real time, one UDP datagram each, to a run that follows a "
        "stream. It can also go wrong on purpose, to see that the run then stops as it should.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")
    command.add_argument("--target", default="circle", help="a motion's name, or a CSV file, as 'gough run' has them")
    command.add_argument("--duration", type=float, default=10.0, help="of the motion [s]")
    command.add_argument("--rate", type=float, default=100.0, help="poses per second [Hz], at most 10000")
    command.add_argument("--to", type=_address, default="127.0.0.1:47200", metavar="HOST:PORT", help="where the run listens")
    command.add_argument("--stop-at", type=float, metavar="SECONDS", help="fall silent at this time")
    command.add_argument("--jump-at", type=float, metavar="SECONDS", help="jump up by 5 cm at this time")
    command.add_argument("--nan-at", type=float, metavar="SECONDS", help="send what is no number from this time on")
    command.set_defaults(run=_stream_target)


def _add_replay(commands: Any) -> None:
    command = commands.add_parser(
        "replay",
        help="feed a recording's raw IMU data through the cycle again",
        description="Feed the recorded raw IMU data through the same cycle and compare estimates and commands bit for bit.",
    )
    command.add_argument("files", type=Path, nargs="+", metavar="FILE.mcap", help="of one run, in their order")
    _add_json(command)
    command.set_defaults(run=_replay)


def _add_calibrate(commands: Any) -> None:
    command = commands.add_parser("calibrate", help="find the IMUs' errors", description="Find the IMUs' errors.")
    actions = command.add_subparsers(required=True, metavar="ACTION", parser_class=_Parser)
    rig = actions.add_parser(
        "rig",
        help="on the mechanism, from its redundancy",
        description="Calibrate the IMUs on the mechanism: it rests at wide poses, which need not be known, and shakes for "
        "40 s. Before that it finds out, with the loop open, whether each IMU lives, and sits and is wired as it should be. "
        "Writes bias, scale, axes and mounting of every sensor, with their covariance.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    rig.add_argument("output", type=Path, metavar="FILE.toml", help="the calibration to write")
    rig.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")
    rig.add_argument("--rate", type=float, default=1000.0, help="cycles per second [Hz]")
    rig.add_argument("--imu", default="mpu9150", help="ideal, mpu9150, mpu9150-calibrated or icm42688")
    rig.add_argument("--seed", type=int, default=0, help="of the IMUs' imperfections")
    rig.add_argument("--home", action="store_true", help="the rig stands exactly at home when it begins")
    rig.add_argument("--tilt", type=float, default=0.05, help="by how much the base may be off level [deg]")
    rig.add_argument(
        "--joints", type=float, default=0.0, help="by how much each coordinate of a joint may be off, then sought, too [mm]"
    )
    _add_joint_error(rig)
    rig.add_argument(
        "--recording", type=Path, nargs="+", metavar="FILE.mcap",
        help="recordings of a rig that rested and shook, from which to take mechanism, IMUs, rate and data",
    )  # fmt: skip
    rig.add_argument("--lengths", action="store_true", help="the rig measures by how much its lengths change (to 50 um)")
    rig.add_argument(
        "--known-poses", action="store_true",
        help="write the mounting alone, by comparing with the planned poses, as the paper's section 7 has it",
    )  # fmt: skip
    rig.add_argument("--plant", metavar="FILE.fmu", help="FMI 3.0 Co-Simulation FMU to use instead of the built one")
    rig.add_argument("--report", type=Path, metavar="FILE.html", help="write a report with plots")
    rig.add_argument("--picture", type=Path, metavar="FILE.svg", help="draw the accuracy of each stage")
    _add_json(rig)
    rig.set_defaults(run=_calibrate_rig)
    _add_calibrate_imu(actions)
    _add_calibrate_magnetometer(actions)


def _add_calibrate_imu(actions: Any) -> None:
    imu = actions.add_parser(
        "imu",
        help="a single one, turned by hand",
        description="Calibrate a single IMU without equipment: it rests in ten or more orientations, every axis up and "
        "down among them, half a second or longer each, and is turned by hand from one to the next. Refuses data that do not "
        "tell the constants, and says which rest or turn is missing.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    imu.add_argument(
        "data", type=Path, metavar="FILE", help="CSV with time_s,wx,wy,wz,ax,ay,az (rad/s, m/s2), or an MCAP recording"
    )
    imu.add_argument("output", type=Path, metavar="FILE.toml", help="the calibration to write, or to add this IMU to")
    imu.add_argument("--number", type=int, default=0, choices=range(7), help="which IMU of the mechanism it is")
    imu.add_argument("--gravity", type=float, default=9.80665, help="at the place [m/s2]")
    _add_json(imu)
    imu.set_defaults(run=_calibrate_imu)


def _add_calibrate_magnetometer(actions: Any) -> None:
    magnetometer = actions.add_parser(
        "magnetometer",
        help="a single one, turned by hand: hard and soft iron",
        description="Calibrate a magnetometer without equipment: it is turned slowly every way round for half a minute or "
        "longer, away from iron. With a calibrated accelerometer beside it, its axes count for both. Refuses data that do "
        "not tell the constants, and says what is missing.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    magnetometer.add_argument(
        "data",
        type=Path,
        metavar="FILE",
        help="CSV with time_s,wx,wy,wz,ax,ay,az,mx,my,mz or time_s,mx,my,mz (rad/s, m/s2, uT), or an MCAP recording",
    )
    magnetometer.add_argument("output", type=Path, metavar="FILE.toml", help="the calibration to write, or to add this one to")
    magnetometer.add_argument("--number", type=int, default=6, choices=range(7), help="which IMU of the mechanism it is in")
    magnetometer.add_argument("--field", type=float, default=49.4, help="strength of the magnetic field at the place [uT]")
    magnetometer.add_argument("--gravity", type=float, default=9.80665, help="at the place [m/s2]")
    _add_json(magnetometer)
    magnetometer.set_defaults(run=_calibrate_magnetometer)


def _add_compare(commands: Any) -> None:
    command = commands.add_parser(
        "compare-fusion",
        help="every way to fuse the IMUs on one motion",
        description="Move the platform as prescribed, 30 mm and 10 deg along and about every axis, and compare every way to "
        "fuse the IMUs: errors after the first 20 s, NEES (6 is consistent) and microseconds of a cycle.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")
    command.add_argument("--motion", default="1", help="static, mixed (0.1 to 1 Hz), or a frequency [Hz]")
    command.add_argument("--duration", type=float, default=40.0, help="of which the first 20 s do not count [s]")
    command.add_argument("--rate", type=float, default=1000.0, help="samples per second [Hz]")
    command.add_argument("--imu", default="mpu9150-calibrated", help="ideal, mpu9150, mpu9150-calibrated or icm42688")
    command.add_argument("--calibration", metavar="FILE.toml", help="the IMUs' constants, as 'gough calibrate' writes them")
    command.add_argument(
        "--seeds", type=_seeds, default="0,1,2,3,4,5", help="of the IMUs' imperfections, errors pooled over them"
    )
    _add_json(command)
    command.set_defaults(run=_compare)


def _add_evaluate(commands: Any) -> None:
    command = commands.add_parser(
        "evaluate-fusion",
        help="what the whole-mechanism filter is worth after self-calibration",
        description="Calibrate the raw IMUs of several rigs on themselves, then move their platforms as prescribed, 30 mm and "
        "10 deg along and about every axis at 0.5, 1, 2 and 0.1 to 1 Hz, and still: errors after the first 20 s with exact and "
        "with wrong joints, with a dead IMU, of starts in the middle of a motion, over minutes of standing still, in the "
        "closed loop, and what a cycle costs. The leg filters with the refined pose stand beside it. Ten minutes in all.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")
    command.add_argument("--imu", default="mpu9150", help="ideal, mpu9150, mpu9150-calibrated or icm42688")
    command.add_argument("--fusion", default="whole-alignments", help="whole, whole-gyroscopes or whole-alignments")
    command.add_argument("--rate", type=float, default=1000.0, help="samples per second [Hz]")
    command.add_argument(
        "--joint-error", type=float, default=0.1, help="standard deviation of each coordinate of wrong joints [mm]"
    )
    command.add_argument("--seeds", type=_seeds, default="0,1,2,3,4,5", help="one for each rig")
    command.add_argument("--starts", type=int, default=100, help="number of starts in motion")
    command.add_argument("--still", type=float, default=600.0, help="how long the platform stands still [s]")
    command.add_argument("--target", default="sines", help="motion or CSV file for a minute in the closed loop")
    command.add_argument(
        "--only",
        choices=("motions", "faults", "start", "drift", "follow", "cost"),
        nargs="+",
        help="these sections instead of all",
    )
    _add_json(command)
    command.set_defaults(run=_evaluate)


def _add_tune(commands: Any) -> None:
    command = commands.add_parser(
        "tune",
        help="design the PID gains and show the margins",
        description="Design the gains from the linearised plant and filters, and print them with their margins.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")
    command.add_argument("--rate", type=float, default=1000.0, help="cycles per second [Hz]")
    _add_json(command)
    command.set_defaults(run=_tune)


def _add_tune_fusion(commands: Any) -> None:
    command = commands.add_parser(
        "tune-fusion",
        help="find the noise that the fusion should assume",
        description="Tune the noise that filters and refinement assume, by consistency: on simulated motions (at rest, mixed, "
        "1 Hz) their errors shall be as large as their covariances say, which is a NEES of 2 for a leg's angles and the "
        "platform's tilt, and of 6 for a pose. Writes the mechanism with the table [fusion] that was found.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("output", type=Path, metavar="FILE.toml", help="the mechanism to write, for --mechanism")
    command.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")
    command.add_argument("--imu", default="mpu9150-calibrated", help="ideal, mpu9150, mpu9150-calibrated or icm42688")
    command.add_argument("--seeds", type=_seeds, default="0,1,2,3,4,5", help="of the IMUs' imperfections and the motions")
    command.add_argument("--rate", type=float, default=1000.0, help="samples per second [Hz]")
    _add_json(command)
    command.set_defaults(run=_tune_fusion)


def _add_fmu(commands: Any) -> None:
    command = commands.add_parser("fmu", help="the plant as an FMU", description="The plant as an FMU.")
    actions = command.add_subparsers(required=True, metavar="ACTION", parser_class=_Parser)
    build = actions.add_parser(
        "build", help="write the plant's FMU", description="Write the plant as an FMI 3.0 Co-Simulation FMU."
    )
    build.add_argument("--output", type=Path, metavar="FILE.fmu", help="default: fmus/gough_plant.fmu in a checkout, else here")
    build.set_defaults(run=_build_fmu)


def _add_bench(commands: Any) -> None:
    command = commands.add_parser(
        "bench",
        help="measure speed",
        description="Measure the loop on the clock: how late it wakes, beside cyclictest, and how long it computes, idle, "
        "under load and with a busy supervisor; its speed against real time and the microseconds of each stage; and direct "
        "kinematics: microseconds per pose, against Newton's method from lengths, and whether both find the pose from cold.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--duration", type=float, default=60.0, help="of the simulated motion [s]")
    command.add_argument("--target", default="sines", help="motion or CSV file")
    command.add_argument("--only", choices=("loop", "kinematics", "clock"), help="one section instead of all")
    command.add_argument(
        "--clock", type=float, default=10.0, help="seconds on the clock at 1 kHz, idle and again under load; 4 kHz gets a third"
    )
    command.add_argument(
        "--measures", type=float, metavar="SECONDS", help="also try the loop without each measure for real time, for so long"
    )
    command.add_argument("--cold", action="store_true", help="measure the start without caches, too (a minute)")
    command.add_argument("--check", action="store_true", help="fail if the loop on the clock is off by more than any noise")
    command.add_argument("--report", type=Path, metavar="FILE.html", help="write histograms of the loop on the clock")
    command.add_argument(
        "--history", type=Path, nargs="+", default=[], metavar="FILE.json", help="earlier figures for the report"
    )
    _add_json(command)
    command.set_defaults(run=_bench)


def _add_classify(commands: Any) -> None:
    command = commands.add_parser(
        "classify",
        help="what class a mechanism is of, and which sensors it needs",
        description="Tell the combinatorial class of a mechanism, and for each method of direct kinematics which sensors it "
        "needs, whether its pose is unique, and its conditioning (1 is best, 0 singular) at home and at worst.",
    )
    command.add_argument("mechanism", metavar="PRESET|FILE.toml", help="preset, or a TOML file")
    command.add_argument("--report", type=Path, metavar="FILE.html", help="write a report with drawings")
    _add_json(command)
    command.set_defaults(run=_classify)


def _add_accuracy(commands: Any) -> None:
    command = commands.add_parser(
        "accuracy",
        help="errors of direct kinematics at a given noise",
        description="Errors of the paper's algorithms and of all legs together, at random poses about home (50 mm, 15 deg on "
        "hexapod), for noise of 0.05 deg on legs, roll and pitch, and 1.5 deg on a magnetic yaw.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")
    command.add_argument("--poses", type=int, default=2000, help="number of random poses")
    command.add_argument("--seed", type=int, default=0, help="of poses and noise")
    _add_json(command)
    command.set_defaults(run=_accuracy)


def _add_classes(commands: Any) -> None:
    command = commands.add_parser(
        "classes",
        help="what every class of mechanism needs, and the errors",
        description="For each of the 60 spatial and 4 planar classes: what the paper needs, what gough needs, and the median "
        "errors of each over random mechanisms and poses, for the noise of 'gough accuracy'.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--seed", type=int, default=0, help="of mechanisms, poses and noise")
    command.add_argument("--markdown", action="store_true", help="print the table in Markdown, as docs/classes.md has it")
    _add_json(command)
    command.set_defaults(run=_classes)


def _add_sensor_sets(commands: Any) -> None:
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
    _add_json(command)
    command.set_defaults(run=_sensor_sets)


def _add_planar(commands: Any) -> None:
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
    _add_json(command)
    command.set_defaults(run=_planar)


def _add_broad(commands: Any) -> None:
    command = commands.add_parser(
        "broad",
        help="the platform's filter by itself on real IMU data",
        description="Run the platform's filter, and the vqf package, on trials of the BROAD benchmark: an IMU moved by hand, "
        "with an optical reference. Prints the RMS of the inclination's error where the benchmark counts it.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("folder", type=Path, metavar="FOLDER", help="with the trials *.npz")
    command.add_argument(
        "--accelerometer-noise",
        type=float,
        default=0.25,
        help="that the filter assumes [m/s2/sqrt(Hz)]; on a mechanism the legs tell the platform's acceleration, which here is "
        "unknown and has to be taken for noise, far above the sensor's own",
    )
    command.add_argument(
        "--bias-walk",
        type=float,
        default=1e-4,
        help="random walk of the gyroscope's bias that the filter assumes [rad/s/sqrt(s)]",
    )
    _add_json(command)
    command.set_defaults(run=_broad)


def _add_json(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", type=Path, metavar="FILE", help="write the figures in SI units")


def _imus(text: str) -> tuple[int, ...]:
    named = {"all": (0, 1, 2, 3, 4, 5, 6), "legs": (0, 1, 2, 3, 4, 5)}
    if text in named:
        return named[text]
    try:
        return tuple(sorted({int(part) for part in text.split(",")}))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither all, legs, nor a list of numbers such as 0,2,4,6") from None


def _seeds(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers such as 0,1,2") from None


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise argparse.ArgumentTypeError(f"{text!r} is no address such as 127.0.0.1:47200")
    return host.strip("[]"), int(port)


_RIG_SIMULATED = {"mechanism": "hexapod", "rate": 1000.0, "imu": "mpu9150", "seed": 0, "joint_error": 0.0, "plant": None}
"""Options of the rig that is driven, with their defaults."""


def _calibrate_rig(options: argparse.Namespace) -> int:
    from math import radians

    from controller.calibration import save_calibration
    from controller.self_calibration import Prior
    from hil.rig_calibration import Knowledge, calibrate_recordings, calibrate_rig
    from hil.simulation import SimulationConfig

    _check_writable(options.output, options.json, options.report, options.picture)
    if not 0.0 < options.tilt < 45.0:
        raise InputError(f"--tilt is {options.tilt:g} deg; it must be between 0 and 45")
    if not 0.0 <= options.joints <= 10.0:
        raise InputError(f"--joints is {options.joints:g} mm; it must be between 0 and 10")
    if options.recording:
        given = [name for name in _RIG_SIMULATED if getattr(options, name) != _RIG_SIMULATED[name]]
        if given:
            names = ", ".join(f"--{name.replace('_', '-')}" for name in given)
            raise InputError(f"the recordings say what {names} would: leave it out with --recording")
    prior = Prior(tilt=radians(options.tilt), joints=1e-3 * options.joints)
    knowledge = Knowledge(prior, options.home, options.lengths, options.known_poses)
    config = SimulationConfig(
        **{name: getattr(options, name) for name in ("mechanism", "rate", "imu", "seed", "plant")},
        joint_error=1e-3 * options.joint_error,
    )
    with _progress(
        "recorded IMUs are calibrated" if options.recording else f"{config.mechanism} calibrates its IMUs"
    ) as progress:
        if options.recording:
            result = calibrate_recordings(options.recording, knowledge)
        else:
            result = calibrate_rig(config, knowledge, progress)
    save_calibration(options.output, result.calibration)
    _write_json(options.json, result.summary)
    if options.report:
        from hil.calibration_report import write_report

        write_report(result, options.report)
    if options.picture:
        from hil.calibration_picture import write_picture

        write_picture(result.summary, options.picture)
    _print_rig_calibration(result.summary)
    print(f"written to {options.output}")
    return 0


def _calibrate_imu(options: argparse.Namespace) -> int:
    from dataclasses import replace

    from controller.calibration import Calibration, load_calibration, save_calibration
    from controller.imu_calibration import calibrate_imu
    from hil.imu_data import read_imu

    _check_writable(options.output, options.json)
    _check_gravity(options.gravity)
    calibration = load_calibration(options.output) if options.output.exists() else Calibration()
    found = calibrate_imu(*read_imu(options.data, options.number), options.gravity)
    calibration.gain[:2, options.number], calibration.offset[:2, options.number] = found.gain, found.offset
    # What was known of the errors that are left was of other constants.
    save_calibration(options.output, replace(calibration, covariance=None))
    figures = {
        "rests": found.rests,
        "force_residual": found.force_residual,
        "turn_residual": found.turn_residual,
        "gain": found.gain.tolist(),
        "offset": found.offset.tolist(),
        "sigmas": found.sigmas.tolist(),
    }
    _write_json(options.json, figures)
    table = _table(f"IMU {options.number}", "x", "y", "z")
    rows = (("gyroscope", "offset [deg/s]", 57.29577951308232), ("accelerometer", "offset [mg]", 1e3 / 9.80665))
    for sensor, (name, label, scale) in enumerate(rows):
        offsets = zip(found.offset[sensor], found.sigmas[sensor, :3], strict=True)
        table.add_row(f"{name}: {label}", *(f"{scale * value:.3f} +- {scale * sigma:.3f}" for value, sigma in offsets))
        for axis, (gains, sigmas) in enumerate(zip(found.gain[sensor], found.sigmas[sensor, 3:].reshape(3, 3), strict=True)):
            cells = (f"{value:.5f} +- {sigma:.5f}" for value, sigma in zip(gains, sigmas, strict=True))
            table.add_row(f"{name}: gain, row {axis + 1}", *cells)
    _print(table)
    print(
        f"{found.rests} rests; residuals: gravity {1e3 * found.force_residual / 9.80665:.3f} mg, "
        f"turns {57.29577951308232 * found.turn_residual:.3f} deg; written to {options.output}"
    )
    return 0


def _check_gravity(gravity: float) -> None:
    if not 9.7 < gravity < 9.9:
        raise InputError(f"--gravity is {gravity:g} m/s2; on the earth it is between 9.7 and 9.9")


def _calibrate_magnetometer(options: argparse.Namespace) -> int:
    from controller.calibration import Calibration, load_calibration, save_calibration
    from controller.magnetometer_calibration import calibrate_magnetometer
    from hil.imu_data import read_field
    from plant.imu import ACCELEROMETER, MAGNETOMETER

    _check_writable(options.output, options.json)
    _check_gravity(options.gravity)
    if not 20.0 < options.field < 70.0:
        raise InputError(f"--field is {options.field:g} uT; on the earth it is between 20 and 70")
    calibration = load_calibration(options.output) if options.output.exists() else Calibration()
    fields, forces = read_field(options.data, options.number)
    if forces is not None:
        at = ACCELEROMETER, options.number
        forces = forces @ calibration.gain[at].T + calibration.offset[at]
    found = calibrate_magnetometer(fields, forces, options.field, options.gravity)
    at = MAGNETOMETER, options.number
    calibration.gain[at], calibration.offset[at] = found.gain, found.offset
    save_calibration(options.output, calibration)
    _write_json(
        options.json, {name: getattr(value, "tolist", lambda value=value: value)() for name, value in vars(found).items()}
    )
    table = _table(f"magnetometer {options.number}", "x", "y", "z")
    cells = zip(found.offset, found.sigmas[:3], strict=True)
    table.add_row("offset [uT]", *(f"{value:.3f} +- {sigma:.3f}" for value, sigma in cells))
    for axis, (gains, sigmas) in enumerate(zip(found.gain, found.sigmas[3:].reshape(3, 3), strict=True)):
        cells = zip(gains, sigmas, strict=True)
        table.add_row(f"gain, row {axis + 1}", *(f"{value:.5f} +- {sigma:.5f}" for value, sigma in cells))
    _print(table)
    residuals = f"strength {found.field_residual:.3f} uT"
    if found.dip is not None and found.dip_residual is not None:
        residuals += f", dip {_deg(found.dip_residual)} deg about {_deg(found.dip)} deg"
    print(f"{found.samples} samples; residuals: {residuals}; written to {options.output}")
    return 0


def _print_rig_calibration(summary: dict[str, Any]) -> None:
    from hil.rig_calibration import STAGES, weak_words

    columns = ("residual [mg]", "left out", "predicted [mm, deg]", "halves", "true")
    table = _table(f"{summary['rests']} poses at rest", *columns)
    for name, residual in summary["residual_mg"].items():
        left_out = summary["validated"].get(name, {}).get("left_out_mg")
        cells = [f"{residual:.3f}", "" if left_out is None else f"{left_out:.3f}"]
        for kind in ("predicted", "validated", "true"):
            errors = summary[kind].get(name)
            cells.append("" if errors is None else f"{_mm(errors['position_rms'])}, {_deg(errors['rotation_rms'])}")
        table.add_row(STAGES[name], *cells)
    _print(table)
    if summary["validated"]:
        print("left out: residual at rests that the calibration had not seen; halves: by how much the poses differ that "
              "calibrations by disjoint halves of the data give")  # fmt: skip
    for line in weak_words(summary):
        print(line)


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3f}"


def _deg(angle: float) -> str:
    return f"{57.29577951308232 * angle:.3f}"


def _compare(options: argparse.Namespace) -> int:
    from hil.fusion_comparison import ComparisonConfig, compare

    _check_writable(options.json)
    names = ("mechanism", "motion", "duration", "rate", "imu", "calibration", "seeds")
    config = ComparisonConfig(**{name: getattr(options, name) for name in names})
    with _progress("every way to fuse") as progress:
        figures = compare(config, progress)
    _write_json(options.json, figures)
    table = _table(f"{config.imu}, {config.motion}", "position RMS [mm]", "rotation RMS [deg]", "NEES", "us", "seeds")
    for name, method in figures["methods"].items():
        nees = "" if method["nees"] is None else f"{method['nees']:.1f}"
        us = "" if method["us"] is None else f"{method['us']:.1f}"
        table.add_row(name, _mm(method["position_rms"]), _deg(method["rotation_rms"]), nees, us, f"{method['seeds']}")
    _print(table)
    return 0


def _evaluate(options: argparse.Namespace) -> int:
    from hil.fusion_evaluation import SECTIONS, EvaluationConfig, evaluate

    _check_writable(options.json)
    names = ("mechanism", "imu", "fusion", "rate", "seeds", "starts", "still", "target")
    config = EvaluationConfig(
        **{name: getattr(options, name) for name in names},
        joint_error=1e-3 * options.joint_error,
        only=tuple(options.only or SECTIONS),
    )
    with _progress("calibration") as progress:
        figures = evaluate(config, lambda label, share: progress(share, label))
    _write_json(options.json, figures)
    for section, show in _EVALUATED.items():
        if section in figures:
            show(figures[section])
    return 0


def _joints(error: str) -> str:
    return "exact joints" if error == "0" else f"joints {1e3 * float(error):g} mm off"


def _print_calibrations(figures: dict[str, Any]) -> None:
    table = _table("calibration, RMS [mm, deg]", "before", "after", "predicted", "least improvement")
    for error, each in figures.items():
        cells = (
            f"{_mm(each[name]['position_rms'])}, {_deg(each[name]['rotation_rms'])}"
            for name in ("before", "after", "predicted")
        )
        table.add_row(_joints(error), *cells, f"{each['least_improvement']:.0f} times")
    _print(table)


def _print_motions(figures: dict[str, Any]) -> None:
    for error, motions in figures.items():
        table = _table(f"{_joints(error)}, RMS [mm, deg]", "legs, refined", "NEES", "whole mechanism", "worst seed", "NEES")
        for kind, each in motions.items():
            refined, whole = each["refined"], each["whole"]
            table.add_row(
                kind if kind.isalpha() else f"{kind} Hz",
                f"{_mm(refined['position_rms'])}, {_deg(refined['rotation_rms'])}",
                f"{refined['nees']:.1f}",
                f"{_mm(whole['position_rms'])}, {_deg(whole['rotation_rms'])}",
                f"{_mm(whole['worst_position_rms'])}, {_deg(whole['worst_rotation_rms'])}",
                f"{whole['nees']:.1f}",
            )
        _print(table)


def _print_faults(figures: dict[str, Any]) -> None:
    table = _table("IMU dead at 1 Hz", "position RMS [mm]", "times", "rotation RMS [deg]", "times")
    for name, each in figures.items():
        times = (f"{each[f'{key}_ratio']:.2f}" if name != "none" else "" for key in ("position_rms", "rotation_rms"))
        table.add_row(name, _mm(each["position_rms"]), next(times), _deg(each["rotation_rms"]), next(times))
    _print(table)


def _print_starts(figures: dict[str, Any]) -> None:
    print(
        f"starts in motion up to 2 Hz: {figures['succeeded']} of {figures['starts']} within 1.5 s; largest error from then on "
        f"{_mm(figures['position_max'])} mm, {_deg(figures['rotation_max'])} deg"
    )


def _print_drift(figures: dict[str, Any]) -> None:
    table = _table("standing still", "position RMS [mm]", "rotation RMS [deg]", "NEES")
    for minute, each in enumerate(figures["minutes"], start=1):
        table.add_row(f"minute {minute}", _mm(each["position_rms"]), _deg(each["rotation_rms"]), f"{each['nees']:.1f}")
    _print(table)


def _print_following(figures: dict[str, Any]) -> None:
    print(
        f"closed loop, {figures['imu']}, {figures['fusion']}, {figures['target']}: RMS {_mm(figures['position_rms'])} mm, "
        f"{_deg(figures['rotation_rms'])} deg, worst seed {_mm(figures['worst_position_rms'])} mm, "
        f"{_deg(figures['worst_rotation_rms'])} deg, NEES {figures['nees']:.1f}"
    )


def _print_cost(figures: dict[str, Any]) -> None:
    table = _table("microseconds of a cycle", "mean", "most")
    for name, each in figures.items():
        table.add_row(name, f"{each['mean_us']:.1f}", f"{each['max_us']:.1f}")
    _print(table)


_EVALUATED: dict[str, Callable[[dict[str, Any]], None]] = {
    "calibration": _print_calibrations,
    "motions": _print_motions,
    "faults": _print_faults,
    "start": _print_starts,
    "drift": _print_drift,
    "follow": _print_following,
    "cost": _print_cost,
}


def _simulate(options: argparse.Namespace) -> int:
    from hil.simulation import SimulationConfig, SimulationStoppedError, simulate

    _check_writable(options.json, options.report)
    names = ("mechanism", "target", "duration", "rate", "imu", "seed", "fusion", "calibration", "plant", "imus", "magnetometer")
    config = SimulationConfig(**{name: getattr(options, name) for name in names}, joint_error=1e-3 * options.joint_error)
    stopped = None
    with _progress(f"{config.mechanism} follows {config.target}") as progress:
        try:
            result = simulate(config, progress)
        except SimulationStoppedError as error:
            stopped, result = error, error.result
    if stopped is None or result.moved:
        _write_json(options.json, result.summary())
        if options.report:
            from hil.report import write_report

            write_report(result, options.report)
        _print_simulation(result.summary())
    if stopped:
        raise stopped
    return 0


def _print_simulation(summary: dict[str, Any]) -> None:
    table = _table("", "position RMS [mm]", "max [mm]", "rotation RMS [deg]", "max [deg]")
    for label, group, prefix in (
        ("estimate - truth", "estimation", ""),
        ("truth - reference", "tracking", ""),
        ("truth - target", "target", ""),
        ("reference - target", "target", "reference_"),
    ):
        errors = summary[group]
        table.add_row(
            label,
            *(f"{1e3 * errors[f'{prefix}position_{kind}']:.4f}" for kind in ("rms", "max")),
            *(f"{57.29577951308232 * errors[f'{prefix}rotation_{kind}']:.4f}" for kind in ("rms", "max")),
        )
    _print(table)
    cycle = summary["cycle_us"]
    print(
        f"limits violated by the reference: {summary['limits']['violations']}; "
        f"{summary['real_time_factor']:.1f} times real time; "
        f"cycle p50/p99/p99.9 {cycle['p50']:.1f}/{cycle['p99']:.1f}/{cycle['p999']:.1f} us"
    )


def _run(options: argparse.Namespace) -> int:
    # Before NumPy is loaded: its threads would live in the loop's process too.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from hil.executive import RunStoppedError, run
    from hil.realtime import RealTimeSettings
    from hil.simulation import SimulationConfig

    _check_writable(options.json, options.record)
    names = (
        "mechanism", "target", "duration", "rate", "imu", "seed", "fusion", "calibration", "plant", "imus", "magnetometer",
        "rig", "rig_at", "arm",
    )  # fmt: skip
    config = SimulationConfig(**{name: getattr(options, name) for name in names}, joint_error=1e-3 * options.joint_error)
    settings = RealTimeSettings(options.priority, options.cpu, options.strict, options.most_missed)
    stopped = None
    with _live_view(config.mechanism, config.target, config.rate) as show:
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
    _write_json(options.json, summary)
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
    from hil.timing import budget

    _print(_timing_table(summary["timing_us"], budget()))
    for line in (*(f"over budget: {text}" for text in summary["over_budget"]), *summary["events"]):
        print(line)
    if not summary["over_budget"]:
        print("within the timing budget (hil/budget.toml)")
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
    truth = f"estimate - truth {1e3 * errors['estimation']:.3f} mm RMS" if errors["known"] else "the truth is not known"
    print(f"{truth}; reference - length {1e3 * errors['tracking']:.3f} mm RMS")
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
    names = ("p50", "p99", "p999", "max")
    table = _table("us", *(f"{name} / budget" if name != "p999" else "p99.9 / budget" for name in names))
    for stage, figures in timing.items():
        limits = budget.get(stage, {})
        cells = []
        for name in names:
            limit = limits.get(name)
            over = limit is not None and figures[name] > limit
            text = f"{figures[name]:.1f}" + (f" / {limit:g}" if limit is not None else " /  -")
            cells.append(f"[bold red]{text}[/]" if over else text)
        table.add_row(stage, *cells)
    return table


@contextmanager
def _live_view(mechanism: str, target: str, rate: float) -> Iterator[Callable[[Any], None]]:
    """The state of a run, ten times a second where there is a terminal."""
    from rich.console import Console
    from rich.live import Live

    if not sys.stderr.isatty():
        yield lambda progress: None
        return
    live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)

    def show(progress: Any) -> None:
        # A terminal that has gone is no reason to end a motion.
        with suppress(OSError):
            live.update(_view(mechanism, target, rate, progress), refresh=True)

    live.start()
    try:
        yield show
    finally:
        with suppress(OSError):
            live.stop()


def _view(mechanism: str, target: str, rate: float, progress: Any) -> Any:
    from math import asin, atan2

    from rich.markup import escape

    from controller.safety import CAUSES, MODES

    table = _table(f"{mechanism} follows {target} at {rate:g} Hz", "")
    latest = progress.latest
    if latest is None:
        table.add_row("state", "preparing plan, plant and machine code, which the first time is compiled (under a minute)")
        return table
    position, r = 1e3 * latest["position"], latest["rotation"]
    angles = (atan2(r[2, 1], r[2, 2]), asin(max(-1.0, min(1.0, -r[2, 0]))), atan2(r[1, 0], r[0, 0]))
    wake, compute = progress.timing.histograms["wake"].figures(), progress.timing.histograms["compute"].figures()
    errors = progress.errors()
    state = MODES[int(latest["mode"])] + (f": {CAUSES[int(latest['stop'])].text}" if latest["stop"] else "")
    rows = (
        ("state", f"{state}, {latest['time_ns'] / 1e9:.1f} s"),
        ("position [mm]", "  ".join(f"{value:9.3f}" for value in position)),
        ("roll, pitch, yaw [deg]", "  ".join(f"{57.29577951308232 * angle:9.3f}" for angle in angles)),
        ("estimate - truth, RMS [mm]", f"{1e3 * errors['estimation']:.3f}"),
        ("reference - length, RMS [mm]", f"{1e3 * errors['tracking']:.3f}"),
        ("woken late p50, p99.9, max [us]", "  ".join(f"{wake[name]:.0f}" for name in ("p50", "p999", "max"))),
        ("computing p50, p99.9, max [us]", "  ".join(f"{compute[name]:.0f}" for name in ("p50", "p999", "max"))),
        ("periods missed, exchanges late", f"{progress.missed}, {progress.late}"),
        *(("stop", "Ctrl-C: controlled; Ctrl-\\: emergency"),),
        *(("without", text) for text in progress.refused),
        *(("", text) for text in progress.events),
    )
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    return table


def _check_rig(options: argparse.Namespace) -> int:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from dataclasses import asdict

    from hil.executive import rig_of
    from hil.rigs.contract import CLAUSES, examine_rig
    from hil.simulation import SimulationConfig

    _check_writable(options.json)
    if options.beyond is not None and not options.move:
        raise InputError("--beyond is a command to the drives: it needs --move")
    config = SimulationConfig(mechanism=options.mechanism, rate=options.rate, rig=options.rig, rig_at=options.rig_at)

    def made() -> Any:
        rig = rig_of(config)
        if rig is None:
            raise InputError("the FMU plant is no rig of its own: choose udp, canopen, replay or python:MODULE:CLASS")
        return rig

    examination = examine_rig(made, 1.0 / options.rate, options.move, options.beyond)
    table = _table("clause", "outcome", "what it asks for")
    for clause, findings in examination.findings.items():
        table.add_row(clause, f"[bold red]{len(findings)} found[/]" if findings else "ok", CLAUSES[clause])
    table.columns[2].justify = "left"
    _print(table)
    found = examination.all_findings()
    for text in found:
        print(text)
    if examination.exchange_us:
        p50, p99, most, count = (examination.exchange_us[name] for name in ("p50", "p99", "max", "n"))
        print(f"exchange p50/p99/max {p50:.0f}/{p99:.0f}/{most:.0f} us of {1e6 / options.rate:g}, {count:g} exchanges")
    moved = "and the drives moved" if options.move else "and nothing was moved"
    print(f"{len(examination.findings)} clauses checked, {len(found)} findings, {moved}")
    _write_json(
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


def _emulate(options: argparse.Namespace) -> int:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from hil.emulator import EmulatorConfig, emulate
    from hil.realtime import RealTimeSettings
    from hil.simulation import SimulationConfig

    names = ("mechanism", "target", "imu", "seed", "plant", "rate")
    simulated = SimulationConfig(**{name: getattr(options, name) for name in names}, joint_error=1e-3 * options.joint_error)
    config = EmulatorConfig(
        simulated, options.bus, options.at, options.control, tuple(options.fault), 1e-3 * options.watchdog
    )  # fmt: skip
    emulate(config, RealTimeSettings(options.priority, options.cpu), lambda text: print(text, flush=True))
    return 0


def _inject(options: argparse.Namespace) -> int:
    from rich.markup import escape

    from hil.emulator import ask
    from hil.rigs.faults import KINDS

    if options.list:
        table = _table("fault", "number", "size by default", "")
        for name, kind in KINDS.items():
            table.add_row(name, f"0 to {kind.count - 1}" if kind.count else "", f"{kind.default:g}", escape(kind.text))
        _print(table)
        return 0
    question = "clear" if options.clear else f"fault {options.fault}" if options.fault else "state"
    for name, value in ask(options.to, question).items():
        print(f"{name}: {value}")
    return 0


def _faults(options: argparse.Namespace) -> int:
    from hil.fault_matrix import CASES, HEADINGS, run_matrix, summary, table

    _check_writable(options.json)
    if options.seeds < 1:
        raise InputError(f"there are {options.seeds} seeds; at least 1 is needed")
    cases = tuple(case for case in CASES if options.only is None or options.only in case.name)
    if not cases:
        raise InputError(f"no case has {options.only!r} in its name")
    with _progress("faults") as progress:
        outcomes = run_matrix(options.seeds, cases, progress)
    rows = table(outcomes)
    if options.markdown:
        print("\n".join("| " + " | ".join(row) + " |" for row in (HEADINGS, ("---",) * len(HEADINGS), *rows)))
    else:
        shown = _table(*HEADINGS)
        for row in rows:
            shown.add_row(*row)
        _print(shown)
    _write_json(options.json, summary(outcomes, options.seeds))
    findings = [finding for outcome in outcomes for finding in outcome.findings]
    for finding in findings:
        print(finding, file=sys.stderr)
    return 1 if findings else 0


def _stream_target(options: argparse.Namespace) -> int:
    from controller.target import load_target
    from hil.target_stream import Faults, send_target
    from plant.mechanism import load_spatial

    mechanism = load_spatial(options.mechanism)
    target = load_target(options.target, mechanism, options.duration)
    given = {name: getattr(options, name) for name in ("stop_at", "jump_at", "nan_at") if getattr(options, name) is not None}
    host, port = options.to
    sent = send_target(mechanism, target, options.rate, host, port, options.duration, Faults(**given))
    print(f"{sent} poses of {target.name} sent to {host}:{port}")
    return 0


def _replay(options: argparse.Namespace) -> int:
    from hil.replay import replay

    _check_distinct(options.json, *options.files)
    _check_writable(options.json)
    result = replay(options.files)
    _write_json(options.json, result.summary())
    for line in result.lines():
        print(line)
    return 0 if result.same else 1


def _tune(options: argparse.Namespace) -> int:
    from controller.tuning import tune
    from plant.mechanism import load_spatial

    _check_writable(options.json)
    design = tune(load_spatial(options.mechanism), options.rate)
    _write_json(options.json, design.summary())
    table = _table("", "value", "unit")
    for label, value, unit in design.rows():
        table.add_row(label, value, unit)
    _print(table)
    return 0


def _tune_fusion(options: argparse.Namespace) -> int:
    from hil.fusion_tuning import TuningConfig, tune_fusion, tuned_text

    _check_writable(options.output, options.json)
    config = TuningConfig(**{name: getattr(options, name) for name in ("mechanism", "imu", "seeds", "rate")})
    with _progress(f"noise of {config.mechanism} with {config.imu}") as progress:
        figures = tune_fusion(config, progress)
    found = {name: values["after"] for name, values in figures["settings"].items()}
    write_whole(options.output, tuned_text(config.mechanism, found).encode())
    _write_json(options.json, figures)
    table = _table("setting", "before", "after")
    for name, values in figures["settings"].items():
        table.add_row(name, f"{values['before']:.4g}", f"{values['after']:.4g}")
    _print(table)
    outside = []
    table = _table(f"{len(config.seeds)} seeds", "NEES before", "after", "95 % bounds", "RMS before", "after")
    for name, estimator in figures["estimators"].items():
        before, after = estimator["before"], estimator["after"]
        least, greatest = estimator["bounds"]
        units = ((_deg, "deg"),) if len(before["rms"]) == 1 else ((_mm, "mm"), (_deg, "deg"))
        errors = (
            ", ".join(f"{text(value)} {unit}" for (text, unit), value in zip(units, each["rms"], strict=True))
            for each in (before, after)
        )
        table.add_row(name, f"{before['nees']:.2f}", f"{after['nees']:.2f}", f"{least:.2f} to {greatest:.2f}", *errors)
        if not least <= after["nees"] <= greatest:
            outside.append(name)
    _print(table)
    for name in outside:
        print(f"{name}: NEES stays outside its bounds, as beyond this its errors would grow by more than 2 %")
    print(f"written to {options.output}")
    return 0


def _build_fmu(options: argparse.Namespace) -> int:
    from plant.export import MODEL, build_in_subprocess

    folder = Path("fmus") if Path("fmus/fmi3.c").is_file() else Path()
    path = options.output or folder / f"{MODEL}.fmu"
    _check_writable(path)
    build_in_subprocess(path)
    print(path)
    return 0


def _bench(options: argparse.Namespace) -> int:
    from hil.bench import machine, measure_speed, read_earlier, write_report
    from hil.kinematics_bench import measure_kinematics
    from hil.real_time_bench import GrossExcessError, gross_excess, measure_measures, measure_real_time, measure_start_up

    _check_writable(options.json, options.report)
    for name, seconds in (("--clock", options.clock), ("--measures", options.measures)):
        if seconds is not None and not 0.0 < seconds < float("inf"):
            raise InputError(f"{name} is {seconds:g} s; it must be positive and finite")
    earlier = [read_earlier(path) for path in options.history]
    figures: dict[str, Any] = machine()
    if options.only in (None, "clock"):
        with _progress("the loop on the clock") as progress:
            figures["start_up"] = measure_start_up(options.cold)
            figures["real_time"] = measure_real_time({1000.0: options.clock, 4000.0: options.clock / 3.0}, progress)
        _print_real_time(figures["real_time"], figures["start_up"])
        if options.measures:
            with _progress("without each measure") as progress:
                figures["measures"] = measure_measures(options.measures, progress)
            _print_measures(figures["measures"])
    if options.only in (None, "loop"):
        with _progress("the loop") as progress:
            figures |= measure_speed(options.target, options.duration, progress)
        _print_speed(figures)
    if options.only in (None, "kinematics"):
        with _progress("direct kinematics") as progress:
            figures["kinematics"] = measure_kinematics(progress)
        _print_kinematics(figures["kinematics"])
    _write_json(options.json, figures)
    if options.report:
        write_report(figures, earlier, options.report)
    print(f"{figures['machine']}, {figures['date']}, gough {figures['version']}")
    if options.check and (excess := gross_excess(figures.get("real_time", {"rates": {}}))):
        raise GrossExcessError(f"in gross excess: {'; '.join(excess)}")
    return 0


def _print_real_time(figures: dict[str, Any], start_up: dict[str, Any]) -> None:
    rows = {
        "computing": "compute_us",
        "bare loop computing": "bare_us",
        "wake-up to command": "latency_us",
        "woken late": "wake_us",
        "cyclictest": "cyclictest_us",
    }
    for rate, conditions in figures["rates"].items():
        for condition, measured in conditions.items():
            table = _table(f"{rate} Hz, {condition.replace('_', ' ')} [us]", "p50", "p99", "p99.9", "max", "cycles")
            for label, name in rows.items():
                if measured[name]:
                    cells = [f"{measured[name][key]:.1f}" for key in ("p50", "p99", "p999", "max")]
                    table.add_row(label, *cells, f"{measured[name]['n']}")
            _print(table)
            used, text = measured["usage"], ""
            if measured["cyclictest_us"]:
                ratios = [measured["wake_us"][key] / measured["cyclictest_us"][key] for key in ("p50", "p999")]
                text = f"; woken late over cyclictest: p50 {ratios[0]:.2f}, p99.9 {ratios[1]:.2f}"
            print(
                f"periods missed by own work {measured['missed_own']}, by the host {measured['missed_host']}; page faults "
                f"{used['major_faults']:g} major, {used['minor_faults']:g} minor; involuntary switches "
                f"{used['involuntary_switches']:g}; growth {used['resident']:g} bytes{text}"
            )
            over = ", ".join(measured["over_budget"])
            print(f"over budget: {over}" if over else "within the timing budget (hil/budget.toml)")
        if "load" in conditions:
            idle, load = conditions["idle"], conditions["load"]
            ours, bare = ([load[name][key] / idle[name][key] for key in ("p50", "p999")] for name in ("compute_us", "bare_us"))
            print(
                f"load over idle at {rate} Hz: computing p50 {ours[0]:.2f}, p99.9 {ours[1]:.2f}; bare loop p50 {bare[0]:.2f}, "
                f"p99.9 {bare[1]:.2f}"
            )
    cold = "" if start_up["cold_s"] is None else f", {start_up['cold_s']:.1f} s without caches"
    print(f"first cycle {start_up['cached_s']:.2f} s after the start{cold}")
    for name in figures["missing"]:
        package = {"cyclictest": "rt-tests"}.get(name, name)
        print(f"{name} is not installed (Debian: apt install {package}): nothing to compare with")
    for text in figures["refused"]:
        print(f"without {text}")


def _print_measures(figures: dict[str, Any]) -> None:
    table = _table("1 kHz, left out", "condition", "woken late p50 [us]", "p99", "p99.9", "max", "missed", "minor faults")
    for case, conditions in figures.items():
        for condition, measured in conditions.items():
            late = [f"{measured['wake_us'][key]:.1f}" for key in ("p50", "p99", "p999", "max")]
            table.add_row(case, condition, *late, f"{measured['missed']}", f"{measured['minor_faults']:g}")
    _print(table)


def _print_speed(figures: dict[str, Any]) -> None:
    table = _table("stage", "p50 [us]", "p99 [us]", "p99.9 [us]")
    for label, percentiles in (*figures["stages_us"].items(), ("whole cycle", figures["cycle_us"])):
        table.add_row(label, *(f"{percentiles[key]:.2f}" for key in ("p50", "p99", "p999")))
    _print(table)
    factor = figures["real_time_factor"]
    print(
        f"{factor['median']:.1f} times real time ({factor['least']:.1f} to {factor['greatest']:.1f}); "
        f"with filterpy {figures['filterpy_real_time_factor']:.2f}, {figures['filterpy_slowdown']:.0f} times slower"
    )


def _print_kinematics(figures: dict[str, Any]) -> None:
    from statistics import median

    groups: dict[str, list[dict[str, Any]]] = {}
    for label, methods in figures["solve_us"].items():
        groups.setdefault(label.rpartition(".")[0], []).append(methods)
    groups["hexapod"] = [figures["hexapod_us"]]
    names = list(dict.fromkeys(name for methods in groups.values() for name in methods[0]))
    table = _table("us, closed / refined", *names)
    for group, measured in groups.items():
        cells = []
        for name in names:
            times = [methods[name] for methods in measured if name in methods]
            kinds = [[time[kind] for time in times] for kind in ("closed_form", "refined")]
            cells.append(" / ".join(f"{median(values):.2f}" for values in kinds) if times else "-")
        table.add_row(group, *cells)
    newton = figures["newton"]
    ratios = [newton["ratios"][name] for name in names if name in newton["ratios"]]
    known = [name for name in names if name in newton["ratios"]]
    over = dict(zip(known, (f"{ratio['closed_form']:.1f} / {ratio['refined']:.1f}" for ratio in ratios), strict=True))
    table.add_row("hexapod, over Newton", *(over.get(name, "-") for name in names))
    _print(table)
    rates = ", ".join(f"{name} {rate / 1e3:.0f}" for name, rate in figures["batch_per_s"].items())
    print(f"refined poses per second on all cores [thousands]: {rates}; one call from Python {figures['call_us']:.0f} us")
    print(f"Newton's method from lengths, warm: {newton['warm_us']:.2f} us per pose")
    table = _table("cold starts [%]", "found by Newton", "mistaken", "found from directions", "mistaken")
    for preset, ranges in figures["cold_starts"].items():
        for where, rates in ranges.items():
            shares = [rates[kind][key] for kind in ("newton", "directions") for key in ("success", "wrong")]
            table.add_row(f"{preset}, {where}", *(f"{100.0 * share:.1f}" for share in shares))
    _print(table)


def _classify(options: argparse.Namespace) -> int:
    from hil.classification import PAPER, describe, write_report
    from plant.mechanism import load_mechanism

    _check_writable(options.json, options.report)
    description = describe(load_mechanism(options.mechanism))
    _write_json(options.json, description.summary())
    if options.report:
        write_report(description, options.report)
    mechanism_class = description.mechanism_class
    print(f"{description.mechanism.name}: class {mechanism_class.label}, a {mechanism_class.name} with the graph")
    print(f"  {mechanism_class.drawing}")
    table = _table("method", "needs", "section", "poses", "conditioning: home", "worst")
    for need in description.needs:
        method = need.requirement.method
        modes = "unique" if need.modes == 1 else f"{need.modes} modes"
        row = (need.requirement.text, PAPER.get(method, "beyond"), modes, f"{need.home:.2g}", f"{need.worst:.2g}")
        table.add_row(method, *row)
    _print(table)
    for need in description.needs:
        if need.requirement.choice_text:
            print(f"{need.requirement.method}: legs {need.requirement.choice_text}")
    print(f"Worst over {description.where}. Sections are the paper's.")
    return 0


def _accuracy(options: argparse.Namespace) -> int:
    from hil.accuracy import evaluate_accuracy
    from plant.mechanism import load_spatial

    _check_writable(options.json)
    accuracy = evaluate_accuracy(load_spatial(options.mechanism), options.poses, options.seed)
    _write_json(options.json, accuracy.summary())
    table = _table("RMS errors", "position [mm]", "rotation [deg]", "over the bound", "NEES", "solved [%]")
    for estimator, errors in accuracy.errors.items():
        table.add_row(
            estimator.label,
            f"{1e3 * errors.position_rms:.3f}",
            f"{57.29577951308232 * errors.rotation_rms:.3f}",
            f"{errors.position_over_bound:.3f}, {errors.rotation_over_bound:.3f}",
            f"{errors.nees:.2f}" if estimator.refine else "-",
            f"{100.0 * errors.solved:.1f}",
        )
    _print(table)
    least, greatest = accuracy.nees_bounds
    print(
        f"{accuracy.mechanism}, class {accuracy.mechanism_class.label}, {accuracy.poses} poses; the bound is Cramer and Rao's; "
        f"NEES is 6 on average, {least:.2f} to {greatest:.2f} in 99 % of such runs, if the covariance is right"
    )
    return 0


def _classes(options: argparse.Namespace) -> int:
    from dataclasses import asdict

    from hil.accuracy import COLUMNS, cells, evaluate_classes, markdown

    _check_writable(options.json)
    with _progress("classes") as progress:
        rows = evaluate_classes(options.seed, progress)
    _write_json(options.json, {"seed": options.seed, "version": version("gough"), "classes": [asdict(row) for row in rows]})
    if options.markdown:
        print(markdown(rows))
        return 0
    table = _table(*COLUMNS)
    for row in rows:
        table.add_row(*cells(row))
    _print(table)
    return 0


def _sensor_sets(options: argparse.Namespace) -> int:
    from dataclasses import asdict
    from itertools import groupby

    from hil.sensor_sets import COLUMNS, MECHANISMS, cells, evaluate_sensor_sets, markdown, reasons

    _check_writable(options.json)
    with _progress("sets of sensors") as progress:
        outcomes = evaluate_sensor_sets(
            options.mechanism or MECHANISMS, duration=options.duration, seed=options.seed, progress=progress
        )
    figures = {"duration": options.duration, "seed": options.seed, "version": version("gough")}
    _write_json(options.json, {**figures, "sets": [asdict(outcome) for outcome in outcomes]})
    if options.markdown:
        print(markdown(outcomes))
        return 0
    for mechanism, group in groupby(outcomes, lambda outcome: outcome.mechanism):
        table = _table(mechanism, *COLUMNS[2:])
        for outcome in group:
            table.add_row(*cells(outcome)[1:])
        _print(table)
    for reason in reasons(outcomes):
        print(reason)
    return 0


def _planar(options: argparse.Namespace) -> int:
    from hil.planar_rig import evaluate, write_report
    from plant.mechanism import load_mechanism
    from plant.planar import PlanarMechanism

    _check_writable(options.json, options.report)
    mechanism = load_mechanism(options.mechanism)
    if not isinstance(mechanism, PlanarMechanism):
        raise InputError(f"{options.mechanism} has six legs in space; this needs three in the plane: choose another mechanism")
    result = evaluate(options.folder, mechanism)
    summary = result.summary()
    _write_json(options.json, summary)
    if options.report:
        write_report(result, options.report)
    table = _table(
        "RMS of the poses' mean errors", "x [mm]", "y [mm]", "angle [deg]", "leg angles [deg]", "true pose is a mode"
    )
    for source, figures in summary["sources"].items():
        rms = figures["rms"]
        table.add_row(
            source,
            f"{1e3 * rms['x']:.2f}",
            f"{1e3 * rms['y']:.2f}",
            f"{57.29577951308232 * rms['angle']:.2f}",
            f"{57.29577951308232 * figures['leg_angles']['constant_error']:.2f}",
            f"{figures['true_mode']['poses']} of {len(result.poses)} poses",
        )
    _print(table)
    return 0


def _broad(options: argparse.Namespace) -> int:
    from controller.settings import FusionSettings
    from hil.broad import evaluate

    _check_writable(options.json)
    fusion = FusionSettings(platform_accelerometer_noise=options.accelerometer_noise, bias_walk=options.bias_walk)
    figures = evaluate(options.folder, fusion)
    _write_json(options.json, figures)
    table = _table("inclination RMS", "filter [deg]", "vqf [deg]", "filter [us]", "vqf [us]", "samples")
    for name, trial in figures["trials"].items():
        methods = trial["filter"], trial["vqf"]
        errors, times = (_deg(method["inclination_rms"]) for method in methods), (f"{method['us']:.2f}" for method in methods)
        table.add_row(name, *errors, *times, f"{trial['samples']}")
    _print(table)
    return 0


def _table(*columns: str) -> Any:
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(escape(column), justify="right" if i else "left")
    return table


def _print(table: Any) -> None:
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 100).print(table)


@contextmanager
def _progress(label: str) -> Iterator[Callable[..., None]]:
    """A progress bar on the terminal, which pulses while things are prepared and goes when the work is done; it is called with
    the share that is done, and a new label if that changes.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    terminal = sys.stderr.isatty()
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not terminal) as bar:
        task = bar.add_task(label, total=None)
        yield lambda share, now=None: bar.update(task, total=1.0, completed=share, description=now)


def _check_writable(*paths: Path | None) -> None:
    _check_distinct(*paths)
    for path in paths:
        if path is not None:
            check_writable(path)


def _check_distinct(*paths: Path | None) -> None:
    named = [path.resolve() for path in paths if path is not None]
    for path in named:
        if named.count(path) > 1:
            raise InputError(f"{path} is named twice: give two files")


def _write_json(path: Path | None, content: dict[str, Any]) -> None:
    if path is not None:
        write_whole(path, (json.dumps(content, indent=2) + "\n").encode())


if __name__ == "__main__":
    sys.exit(main())
