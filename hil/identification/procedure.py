"""Identification of a machine's actuators: a multisine is planned, run and recorded, and the actuators are fitted to it.

The loop is closed while the machine moves, so that it stays where the plan wants it. What is fitted is what the drives did with
the commands that they were really given.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np
import tomlkit

from controller.calibration.file import Calibration, calibration_for
from controller.design.identification import (
    DELAY,
    USUAL,
    Doubts,
    Identified,
    Measured,
    check_parameters,
    identify_actuators,
)
from controller.design.predicted_readings import Commands, Readings
from controller.rig import tilt_rotation
from controller.safety.causes import Request
from hil.calibration.guided import Machine
from hil.calibration.procedure import complete
from hil.identification.excitation import Excitation, multisine
from hil.recording.mcap import Recording, RecordingError, read
from hil.runs.config import POSITION_DRIVES, SimulationConfig
from hil.runs.names import name_of
from hil.runs.prepare import closes_position
from plant.compiled import Record
from plant.errors import InputError
from plant.imu import load_imu
from plant.mechanism import Mechanism, load_in_space, mechanism_text
from plant.mechanism.documents import set_entry
from plant.pose import Array

HOLD_S = 1.0
"""How long the brakes hold first, which tells the IMUs' noise at rest [s]."""

_LEAST_MOTION_S = 2.0
_MOVING = 1e-6
"""Rate of a leg that moves [m/s]."""

_LEAST_REST = 50
"""Samples of a noise at rest."""

_SAME_TIME_S = 1e-6
_DIGITS = 6


@dataclass(frozen=True, eq=False)
class Plan:
    """What an identification will do."""

    mechanism: Mechanism
    config: SimulationConfig
    excitation: Excitation
    names: Sequence[str]

    @property
    def text(self) -> str:
        """What will happen, in words."""
        uses = ", ".join(f"{100.0 * use:.0f} % of the {name}" for name, use in self.excitation.uses.items())
        lines = self.excitation.lines
        return (
            f"{self.mechanism.name} follows a multisine for {self.config.duration:.3g} s, on all axes at once, with the loop "
            f"closed: {len(lines)} lines from {lines[0]:.2g} to {lines[-1]:.2g} Hz, which use {uses}"
        )


def plan_identification(config: SimulationConfig, duration: float, share: float, names: Sequence[str] = USUAL) -> Plan:
    """Plan the multisine, before anything is read or moved.

    Args:
        config: machine, IMUs and rate; target, duration and hold do not matter.
        duration, share: of `multisine`.
        names: what to fit, of `controller.design.identification.PARAMETERS`.

    Raises:
        GoughError: the mechanism or the configuration cannot be used for that.
    """
    check_parameters(names)
    _check_drives(closes_position(config))
    mechanism = load_in_space(config.mechanism)
    excitation = multisine(mechanism, config.rate, duration, share)
    driven = replace(config, target=name_of("target", excitation.motion), duration=excitation.planned.duration, hold=HOLD_S)
    return Plan(mechanism, driven, excitation, names)


@dataclass(frozen=True, eq=False)
class Identification:
    """The actuators that were found in a recording of the mechanism of that name, a preset or a file."""

    mechanism: str
    recording: Path
    found: Identified

    @property
    def text(self) -> str:
        """The TOML text of the mechanism with its fitted actuators, and no other change; comments at its top tell of the fit.

        Raises:
            GoughError: no such mechanism, or its file cannot be read.
        """
        document, found = tomlkit.parse(mechanism_text(self.mechanism)), self.found
        for name, value in found.parameters().items():
            rounded = [float(f"{each:.{_DIGITS}g}") for each in np.ravel(value)]
            set_entry(document, f"plant.{name}", rounded if np.ndim(value) else rounded[0])
        date = datetime.now(UTC).isoformat(timespec="seconds")
        lines = [f"# Actuators identified by gough {version('gough')} on {date}, with half the width of their 95 % intervals:"]
        lines += [f"# {each.label}: {each.value:.6g} +- {each.half:.2g}" for each in found.values if each.name != DELAY]
        lines += [
            f"# delay of the commands, which no entry tells: {1e3 * each.value:.4f} +- {1e3 * each.half:.4f} ms"
            for each in found.values
            if each.name == DELAY
        ]
        return "\n".join(lines) + "\n" + tomlkit.dumps(document)


def identify(plan: Plan, machine: Machine, recording: Path) -> Identification:
    """Run the multisine on a machine, keep its recording in a file, and fit the actuators.

    Raises:
        CalibrationError: the run or the fit has failed.
        GoughError: something in the configuration cannot be used; nothing has moved.
    """
    machine.run(plan.config, recording)
    return identify_recording(recording, plan.names)


def identify_recording(path: Path, names: Sequence[str] = USUAL) -> Identification:
    """Fit the actuators to a recording of a motion that begins at rest at home.

    Raises:
        RecordingError: no recording, or not of such a motion.
        CalibrationError: the fit does not converge.
    """
    check_parameters(names)
    recording = complete(path, read(path))
    config = recording.config
    _check_drives(config.get("drives") == POSITION_DRIVES)
    if config.get("open_loop"):
        raise RecordingError(f"{path} is of a run with the loop open, before a calibration: record one with the loop closed")
    nominal, imu = load_in_space(config["mechanism"]), load_imu(config["imu"])
    file = config.get("calibration")
    calibration = Calibration() if file is None else calibration_for(file, nominal, config["imu"])
    measured = measured_in(recording, calibration)
    doubts = Doubts.of(imu) if file is None else Doubts()
    found = identify_actuators(_calibrated(nominal, calibration), imu, measured, names, doubts)
    return Identification(config["mechanism"], path, found)


def _check_drives(position: bool) -> None:
    if position:
        raise InputError(
            "drives that close a position loop hide load, friction and lag of their motors: identify them with drives that "
            "follow velocities"
        )


def _calibrated(nominal: Mechanism, calibration: Calibration) -> Mechanism:
    """The mechanism with the joints and the vertical that a calibration has found."""
    mechanism = nominal.moved_joints(calibration.joints[:, : nominal.legs])
    gravity = mechanism.plant_parameters()["gravity"]
    return replace(mechanism, plant={**mechanism.plant, "gravity": tilt_rotation(calibration.tilt) @ gravity})


def measured_in(recording: Recording, calibration: Calibration) -> Measured:
    """The commands and calibrated readings in a recording, from where its motion begins to where it ends.

    Raises:
        RecordingError: nothing moves in it.
    """
    records = recording.records
    enabled = records["request"] == Request.ENABLED
    moving = np.flatnonzero(enabled & (np.abs(records["reference"][:, :, 1]).max(axis=1) > _MOVING))
    if not len(moving):
        raise RecordingError(f"nothing moves in {recording.path}: record a motion")
    before, during, enabled = records[: moving[0]], records[moving[0] :], enabled[moving[0] :]
    # A motion ends on the brakes.
    during = during if enabled.all() else during[: int(enabled.argmin())]
    if len(during) < _LEAST_MOTION_S * recording.config["rate"]:
        raise RecordingError(
            f"the drives follow a motion for {len(during) / recording.config['rate']:.3g} s in {recording.path}, and at least "
            f"{_LEAST_MOTION_S:g} s are needed: record a longer one"
        )
    times = _exchanges(during, on_its_clock=recording.config["rig"] != "fmu")
    kept = np.diff(times, prepend=-np.inf) > 0.0
    during, times = during[kept], times[kept]
    legs = load_in_space(recording.config["mechanism"]).legs
    fresh = (during["sample_age"] == 0) & (during["silent"] == 0)[:, None]
    ages = times[:, None] - 1e-9 * during["sample_ns"]
    ages = np.where(fresh & (ages > _SAME_TIME_S), ages, 0.0)
    lengths = np.where((during["silent"] == 0)[:, None], during["length"], np.nan)
    return Measured(
        Commands(times - times[0], np.ascontiguousarray(during["command"][:, :legs])),
        Readings(_calibrated_readings(during, calibration), lengths),
        fresh,
        ages,
        1.0 / recording.config["rate"],
        _noise_at_rest(before, calibration),
    )


def _exchanges(records: Record, on_its_clock: bool) -> Array:
    """When the loop exchanged data with its machine (N,) [s].

    A rig on a clock of its own takes samples and commands at one time: that of the latest sample.
    """
    woke: Array = 1e-9 * records["time_ns"].astype(float)
    if not on_its_clock:
        return woke
    answered = (records["silent"] == 0) & (records["sample_age"] == 0).any(axis=1)
    if answered.sum() < 2:
        raise RecordingError("the rig has hardly answered in this recording: see what 'gough check-rig' says of the bus")
    latest = np.where(records["sample_age"] == 0, 1e-9 * records["sample_ns"], -np.inf).max(axis=1)
    ahead = latest[answered] - woke[answered]
    found: Array = woke + np.interp(woke, woke[answered], ahead)
    return found


def _calibrated_readings(records: Record, calibration: Calibration) -> Array:
    raw = np.stack([records[name] for name in ("angular_velocity", "specific_force", "magnetic_field")], axis=1)
    calibrated: Array = calibration.apply(raw)[:, :2]
    return calibrated


def _noise_at_rest(records: Record, calibration: Calibration) -> Array:
    """Standard deviations (2, 7, 3) of the readings while the brakes held; NaN if they did not for long."""
    rest = records[(records["request"] == Request.BRAKED) & (records["silent"] == 0)]
    if len(rest) < _LEAST_REST:
        return np.full((2, *records["angular_velocity"].shape[1:]), np.nan)
    deviations: Array = np.std(_calibrated_readings(rest, calibration), axis=0)
    return deviations
