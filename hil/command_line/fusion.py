"""The commands about the fusion of the IMUs: compare-fusion, evaluate-fusion, tune-fusion, broad."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil.command_line.options import add_calibration, add_imu, add_json, add_mechanism, chosen
from hil.command_line.outputs import check_outputs, write_json
from hil.command_line.printing import deg, mm, new_table, print_table, progress_bar
from plant.files import write_whole


def _seeds(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers such as 0,1,2") from None


def add_compare(commands: Any) -> None:
    """Add `gough compare-fusion`."""
    command = commands.add_parser(
        "compare-fusion",
        help="every way to fuse the IMUs on one motion",
        description="Move the platform as prescribed, 30 mm and 10 deg along and about every axis, and compare every way to "
        "fuse the IMUs: errors after the first 20 s, NEES (6 is consistent) and microseconds of a cycle.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add_mechanism(command)
    command.add_argument("--motion", default="1", help="static, mixed (0.1 to 1 Hz), or a frequency [Hz]")
    command.add_argument("--duration", type=float, default=40.0, help="of which the first 20 s do not count [s]")
    command.add_argument("--rate", type=float, default=1000.0, help="samples per second [Hz]")
    add_imu(command)
    add_calibration(command)
    command.add_argument(
        "--seeds", type=_seeds, default="0,1,2,3,4,5", help="of the IMUs' imperfections, errors pooled over them"
    )
    add_json(command)
    command.set_defaults(run=_compare)


def _compare(options: argparse.Namespace) -> int:
    from hil.studies.config import ComparisonConfig
    from hil.studies.fusion_comparison import compare

    check_outputs(options.json)
    config = ComparisonConfig(**chosen(options, "mechanism", "motion", "duration", "rate", "imu", "calibration", "seeds"))
    with progress_bar("every way to fuse") as progress:
        figures = compare(config, progress)
    write_json(options.json, figures)
    table = new_table(f"{config.imu}, {config.motion}", "position RMS [mm]", "rotation RMS [deg]", "NEES", "us", "seeds")
    for name, method in figures["methods"].items():
        nees = "" if method["nees"] is None else f"{method['nees']:.1f}"
        us = "" if method["us"] is None else f"{method['us']:.1f}"
        table.add_row(name, mm(method["position_rms"]), deg(method["rotation_rms"]), nees, us, f"{method['seeds']}")
    print_table(table)
    return 0


def add_evaluate(commands: Any) -> None:
    """Add `gough evaluate-fusion`."""
    command = commands.add_parser(
        "evaluate-fusion",
        help="what the whole-mechanism filter is worth after self-calibration",
        description="Calibrate the raw IMUs of several rigs on themselves, then move their platforms as prescribed, 30 mm and "
        "10 deg along and about every axis at 0.5, 1, 2 and 0.1 to 1 Hz, and still: errors after the first 20 s with exact and "
        "with wrong joints, with a dead IMU, of starts in the middle of a motion, over minutes of standing still, in the "
        "closed loop, and what a cycle costs. The leg filters with the refined pose stand beside it. Ten minutes in all.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add_mechanism(command)
    add_imu(command, default="mpu9150")
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
    add_json(command)
    command.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    from hil.studies.config import SECTIONS, EvaluationConfig
    from hil.studies.fusion_evaluation import evaluate

    check_outputs(options.json)
    config = EvaluationConfig(
        **chosen(options, "mechanism", "imu", "fusion", "rate", "seeds", "starts", "still", "target"),
        joint_error=1e-3 * options.joint_error,
        only=tuple(options.only or SECTIONS),
    )
    with progress_bar("calibration") as progress:
        figures = evaluate(config, lambda label, share: progress(share, label))
    write_json(options.json, figures)
    for section, show in _EVALUATED.items():
        if section in figures:
            show(figures[section])
    return 0


def _joints(error: str) -> str:
    return "exact joints" if error == "0" else f"joints {1e3 * float(error):g} mm off"


def _print_calibrations(figures: dict[str, Any]) -> None:
    table = new_table("calibration, RMS [mm, deg]", "before", "after", "predicted", "least improvement")
    for error, each in figures.items():
        cells = (
            f"{mm(each[name]['position_rms'])}, {deg(each[name]['rotation_rms'])}" for name in ("before", "after", "predicted")
        )
        table.add_row(_joints(error), *cells, f"{each['least_improvement']:.0f} times")
    print_table(table)


def _print_motions(figures: dict[str, Any]) -> None:
    for error, motions in figures.items():
        table = new_table(f"{_joints(error)}, RMS [mm, deg]", "legs, refined", "NEES", "whole mechanism", "worst seed", "NEES")
        for kind, each in motions.items():
            refined, whole = each["refined"], each["whole"]
            table.add_row(
                kind if kind.isalpha() else f"{kind} Hz",
                f"{mm(refined['position_rms'])}, {deg(refined['rotation_rms'])}",
                f"{refined['nees']:.1f}",
                f"{mm(whole['position_rms'])}, {deg(whole['rotation_rms'])}",
                f"{mm(whole['worst_position_rms'])}, {deg(whole['worst_rotation_rms'])}",
                f"{whole['nees']:.1f}",
            )
        print_table(table)


def _print_faults(figures: dict[str, Any]) -> None:
    table = new_table("IMU dead at 1 Hz", "position RMS [mm]", "times", "rotation RMS [deg]", "times")
    for name, each in figures.items():
        times = (f"{each[f'{key}_ratio']:.2f}" if name != "none" else "" for key in ("position_rms", "rotation_rms"))
        table.add_row(name, mm(each["position_rms"]), next(times), deg(each["rotation_rms"]), next(times))
    print_table(table)


def _print_starts(figures: dict[str, Any]) -> None:
    print(
        f"starts in motion up to 2 Hz: {figures['succeeded']} of {figures['starts']} within 1.5 s; largest error from then on "
        f"{mm(figures['position_max'])} mm, {deg(figures['rotation_max'])} deg"
    )


def _print_drift(figures: dict[str, Any]) -> None:
    table = new_table("standing still", "position RMS [mm]", "rotation RMS [deg]", "NEES")
    for minute, each in enumerate(figures["minutes"], start=1):
        table.add_row(f"minute {minute}", mm(each["position_rms"]), deg(each["rotation_rms"]), f"{each['nees']:.1f}")
    print_table(table)


def _print_following(figures: dict[str, Any]) -> None:
    print(
        f"closed loop, {figures['imu']}, {figures['fusion']}, {figures['target']}: RMS {mm(figures['position_rms'])} mm, "
        f"{deg(figures['rotation_rms'])} deg, worst seed {mm(figures['worst_position_rms'])} mm, "
        f"{deg(figures['worst_rotation_rms'])} deg, NEES {figures['nees']:.1f}"
    )


def _print_cost(figures: dict[str, Any]) -> None:
    table = new_table("microseconds of a cycle", "mean", "most")
    for name, each in figures.items():
        table.add_row(name, f"{each['mean_us']:.1f}", f"{each['max_us']:.1f}")
    print_table(table)


_EVALUATED: dict[str, Callable[[dict[str, Any]], None]] = {
    "calibration": _print_calibrations,
    "motions": _print_motions,
    "faults": _print_faults,
    "start": _print_starts,
    "drift": _print_drift,
    "follow": _print_following,
    "cost": _print_cost,
}


def add_tune_fusion(commands: Any) -> None:
    """Add `gough tune-fusion`."""
    command = commands.add_parser(
        "tune-fusion",
        help="find the noise that the fusion should assume",
        description="Tune the noise that filters and refinement assume, by consistency: on simulated motions (at rest, mixed, "
        "1 Hz) their errors shall be as large as their covariances say, which is a NEES of 2 for a leg's angles and the "
        "platform's tilt, and of 6 for a pose. Writes the mechanism with the table [fusion] that was found.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("output", type=Path, metavar="FILE.toml", help="the mechanism to write, for --mechanism")
    add_mechanism(command)
    add_imu(command)
    command.add_argument("--seeds", type=_seeds, default="0,1,2,3,4,5", help="of the IMUs' imperfections and the motions")
    command.add_argument("--rate", type=float, default=1000.0, help="samples per second [Hz]")
    add_json(command)
    command.set_defaults(run=_tune_fusion)


def _tune_fusion(options: argparse.Namespace) -> int:
    from hil.studies.config import TuningConfig
    from hil.studies.fusion_tuning import tune_fusion, tuned_text

    check_outputs(options.output, options.json)
    config = TuningConfig(**chosen(options, "mechanism", "imu", "seeds", "rate"))
    with progress_bar(f"noise of {config.mechanism} with {config.imu}") as progress:
        figures = tune_fusion(config, progress)
    found = {name: values["after"] for name, values in figures["settings"].items()}
    write_whole(options.output, tuned_text(config.mechanism, found).encode())
    write_json(options.json, figures)
    table = new_table("setting", "before", "after")
    for name, values in figures["settings"].items():
        table.add_row(name, f"{values['before']:.4g}", f"{values['after']:.4g}")
    print_table(table)
    outside = []
    table = new_table(f"{len(config.seeds)} seeds", "NEES before", "after", "95 % bounds", "RMS before", "after")
    for name, estimator in figures["estimators"].items():
        before, after = estimator["before"], estimator["after"]
        least, greatest = estimator["bounds"]
        units = ((deg, "deg"),) if len(before["rms"]) == 1 else ((mm, "mm"), (deg, "deg"))
        errors = (
            ", ".join(f"{text(value)} {unit}" for (text, unit), value in zip(units, each["rms"], strict=True))
            for each in (before, after)
        )
        table.add_row(name, f"{before['nees']:.2f}", f"{after['nees']:.2f}", f"{least:.2f} to {greatest:.2f}", *errors)
        if not least <= after["nees"] <= greatest:
            outside.append(name)
    print_table(table)
    for name in outside:
        print(f"{name}: NEES stays outside its bounds, as beyond this its errors would grow by more than 2 %")
    print(f"written to {options.output}")
    return 0


def add_broad(commands: Any) -> None:
    """Add `gough broad`."""
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
    add_json(command)
    command.set_defaults(run=_broad)


def _broad(options: argparse.Namespace) -> int:
    from controller.settings import FusionSettings
    from hil.studies.broad import evaluate

    check_outputs(options.json)
    fusion = FusionSettings(platform_accelerometer_noise=options.accelerometer_noise, bias_walk=options.bias_walk)
    figures = evaluate(options.folder, fusion)
    write_json(options.json, figures)
    table = new_table("inclination RMS", "filter [deg]", "vqf [deg]", "filter [us]", "vqf [us]", "samples")
    for name, trial in figures["trials"].items():
        methods = trial["filter"], trial["vqf"]
        errors, times = (deg(method["inclination_rms"]) for method in methods), (f"{method['us']:.2f}" for method in methods)
        table.add_row(name, *errors, *times, f"{trial['samples']}")
    print_table(table)
    return 0
