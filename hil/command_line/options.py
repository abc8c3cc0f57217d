"""Options that several commands have, and what is made of them."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.runs.config import SimulationConfig


def add_mechanism(command: argparse.ArgumentParser) -> None:
    """Add which mechanism it is."""
    command.add_argument("--mechanism", default="hexapod", help="preset, or a TOML file")


def add_imu(command: argparse.ArgumentParser, default: str = "mpu9150-calibrated") -> None:
    """Add which model of IMU is simulated."""
    command.add_argument("--imu", default=default, help="ideal, mpu9150, mpu9150-calibrated or icm42688")


def add_calibration(command: argparse.ArgumentParser) -> None:
    """Add the calibration that is used."""
    command.add_argument("--calibration", metavar="FILE.toml", help="the IMUs' constants, as 'gough calibrate' writes them")


def add_plant(command: argparse.ArgumentParser) -> None:
    """Add the FMU that is used, and its binding."""
    command.add_argument("--plant", metavar="FILE.fmu", help="Co-Simulation FMU (FMI 2.0 or 3.0) instead of the built one")
    add_binding(command)


def add_binding(command: argparse.ArgumentParser) -> None:
    """Add the binding of the FMU that is used."""
    command.add_argument(
        "--binding", metavar="FILE.toml", help="which of its variables are which, if they have other names (docs/fmu.md)"
    )  # fmt: skip


def add_joint_error(command: argparse.ArgumentParser) -> None:
    """Add by how much the joints are off their places."""
    command.add_argument(
        "--joint-error",
        type=float,
        default=0.0,
        help="simulated: standard deviation of each coordinate of the joints from their places [mm]",
    )


def add_rig(command: argparse.ArgumentParser, **rig: Any) -> None:
    """Add which rig is driven, and where it is; `rig` is what else `add_argument` is told of the former."""
    command.add_argument(
        "--rig", metavar="RIG", **rig, help="what is driven: fmu, the plant; udp or canopen, a rig on a bus; replay, a "
        "recording; or python:MODULE:CLASS, a rig of your own, as hil/rigs/template.py is one",
    )  # fmt: skip
    command.add_argument(
        "--rig-at", metavar="ADDRESS|FILE", help="where the rig is: HOST:PORT for udp (default: 127.0.0.1:47100), settings of "
        "the bus for canopen, the recording (files of one run with commas in between) for replay",
    )  # fmt: skip


def add_json(command: argparse.ArgumentParser) -> None:
    """Add the file for the figures."""
    command.add_argument("--json", type=Path, metavar="FILE", help="write the figures in SI units")


def chosen(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the options of these names, without those that are not given and have no default."""
    return {name: getattr(options, name) for name in names if hasattr(options, name)}


def simulation_config(options: argparse.Namespace, *names: str) -> "SimulationConfig":
    """Return the simulation that the options of these names and `--joint-error` describe.

    Raises:
        InputError: an option is out of its range, or no setting.
    """
    from hil.runs.config import SimulationConfig
    from plant.fmu.settings import Setting

    values = chosen(options, *names)
    if "settings" in values:
        values["settings"] = tuple(map(Setting.parse, values["settings"]))
    return SimulationConfig(**values, joint_error=1e-3 * options.joint_error)
