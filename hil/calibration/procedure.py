"""Calibration on the rig: it rests at wide poses and shakes, and the redundancy of its IMUs reveals their errors.

1. The brakes hold: the gyroscopes are zeroed.
2. The drives follow a small planned motion with the loop open: each IMU must read the motion of its place.
3. The rig rests at a few poses near home with the loop open: a first calibration.
4. With this it rests at twenty wide poses: a better one.
5. With that it shakes: the constants that rests alone leave open.

Between these runs the rig stands on its brakes. The motions keep to what the drives can do with all legs at once. If it fails,
the last run can be kept. Recordings can replace all runs.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from controller.calibration.at_rest import RestCalibration
from controller.calibration.file import Calibration, calibrated_rig, save_calibration
from controller.calibration.in_motion import calibrate_in_motion
from controller.estimation.whole_mechanism.parameters import ALL_ERRORS
from controller.planning.motions import REST_S
from controller.safety import watch_nothing
from hil.calibration.assessment import assess, constants, cross_validate
from hil.calibration.data import CalibrationData, Knowledge
from hil.calibration.drives import within_drives
from hil.calibration.known_poses import calibrate_by_known_poses
from hil.loop.records import Link
from hil.progress import Progress, no_progress, part_of
from hil.recording.mcap import Recorder, Recording, RecordingError, read
from hil.runs.config import SimulationConfig
from hil.runs.names import name_of
from hil.runs.prepare import prepared_loop
from hil.runs.simulation import SimulationResult, SimulationStoppedError, simulate
from plant.compiled import Record
from plant.encoders import NO_LENGTHS, load_encoder
from plant.errors import CalibrationError
from plant.mechanism import Mechanism, load_spatial

_NOTHING = Knowledge()
_ZEROING_S, _PROBING_S, _SHAKING_S = 1.0, 4.0, 40.0
_NEAR_S, _WIDE_S = 8 * REST_S, 20 * REST_S
_WHOLE_S = _NEAR_S + _WIDE_S + _SHAKING_S


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """Result of a calibration on the rig: its mechanism, the calibration of its IMUs, and the figures."""

    mechanism: Mechanism
    calibration: Calibration
    summary: dict[str, Any]


class FailedCalibrationError(CalibrationError):
    """A calibration on the rig has failed; `result` is its last run, if that was a simulation with the loop closed."""

    def __init__(self, message: str, result: SimulationResult | None = None) -> None:
        super().__init__(message)
        self.result = result


@dataclass(eq=False)
class SimulatedRig:
    """Drives a simulated rig, and keeps the last run: the configuration, its constants and reference, and its records."""

    header: dict[str, Any] = field(default_factory=dict)
    records: Record | None = None
    result: SimulationResult | None = None

    def run_open(self, config: SimulationConfig, blind: bool = False) -> Record:
        """The records of a run with the loop open: the IMUs do not matter, and the drives follow the planned speeds.

        If `blind`, there is no feed-forward for the load: the platform sinks by millimetres.
        """
        with prepared_loop(replace(config, open_loop=True)) as loop:
            watch_nothing(loop.parameters)
            if blind:
                loop.parameters["load"]["droop"] = 0.0
            loop.run(loop.end)
            records = loop.records[: int(loop.link[Link.HEAD])].copy()
            self._note(config, loop.mechanism, loop.parameters.copy(), loop.segments, records, None)
        return records

    def run_closed(self, config: SimulationConfig, progress: Progress) -> Record:
        """The records of a run with the loop closed."""
        stopped = None
        try:
            result = simulate(config, progress)
        except SimulationStoppedError as error:
            stopped, result = error, error.result
        self._note(config, result.mechanism, result.parameters, result.reference.segments, result.records, result)
        if stopped is not None:
            raise CalibrationError(f"the rig stopped at {config.target}: {stopped}: check the IMUs' errors and the drives")
        return result.records

    def _note(
        self, config: SimulationConfig, mechanism: Mechanism, parameters: Any, reference: Any, records: Record, result: Any
    ) -> None:
        about = {"mechanism_name": mechanism.name, "version": version("gough"), "run": f"{time.time_ns():x}"}
        self.header = {"config": {**asdict(config), **about}, "parameters": parameters, "reference": reference}
        self.records, self.result = records, result

    def keep(self, path: Path) -> str:
        """Record the last run, if there was one, in an MCAP file; returns words that say so."""
        if self.records is None:
            return ""
        recorder = Recorder(path, self.header, time.time_ns())
        recorder.write(self.records)
        recorder.close()
        return f"; its last run is recorded in {path}"


def calibrate_rig(
    config: SimulationConfig,
    knowledge: Knowledge = _NOTHING,
    progress: Progress = no_progress,
    validate: bool = True,
    failed: Path | None = None,
) -> RigCalibration:
    """Drive the rig and calibrate its IMUs.

    Args:
        config: mechanism, IMUs, seed, rate and plant; target and durations do not matter.
        knowledge: besides the samples.
        validate: whether to compare calibrations by parts of the data as well.
        failed: the MCAP file that keeps the last run if the calibration fails.

    Raises:
        FailedCalibrationError: an IMU is not as it should be, or the data do not give a calibration.
        GoughError: something in the configuration cannot be used.
    """
    rig = SimulatedRig()
    try:
        return _calibrate(rig, config, knowledge, progress, validate)
    except CalibrationError as error:
        kept = "" if failed is None else rig.keep(failed)
        raise FailedCalibrationError(f"{error}{kept}", rig.result) from None


def _calibrate(
    rig: SimulatedRig, config: SimulationConfig, knowledge: Knowledge, progress: Progress, validate: bool
) -> RigCalibration:
    mechanism = load_spatial(config.mechanism)
    data = CalibrationData(mechanism, config.imu, config.rate, knowledge, config.seed)
    if (driven := within_drives(mechanism)) is not mechanism:
        config = replace(config, mechanism=name_of("mechanism", driven))
    config = replace(config, raw_imus=True)
    probing = rig.run_open(replace(config, target="probing", duration=_PROBING_S, hold=_ZEROING_S), blind=True)
    data.begin(probing, round(_ZEROING_S * config.rate))
    data.check_places(probing)
    known = None
    with TemporaryDirectory(prefix="gough-calibration-") as folder:
        file = Path(folder) / "calibration.toml"
        config = replace(config, calibration=str(file))
        near = replace(config, target="near-rests", duration=_NEAR_S)
        wide = replace(config, target="rests", duration=_WIDE_S)
        shaking = replace(config, target="shaking", duration=_SHAKING_S)
        save_calibration(file, data.zeroed())
        if knowledge.known_poses:
            known = calibrate_by_known_poses(data, [rig.run_open(wide)])
        data.add_rests(rig.run_open(near))
        save_calibration(file, data.with_base(data.at_rest().calibration()))
        data.add_rests(rig.run_closed(wide, part_of(progress, _NEAR_S / _WHOLE_S, _WIDE_S / _WHOLE_S)))
        at_rest = data.at_rest()
        save_calibration(file, data.with_base(at_rest.calibration()))
        motion = rig.run_closed(shaking, part_of(progress, 1.0 - _SHAKING_S / _WHOLE_S, _SHAKING_S / _WHOLE_S))
    return finish(data, at_rest, [motion], known, validate)


def calibrate_recordings(paths: Sequence[Path], knowledge: Knowledge = _NOTHING) -> RigCalibration:
    """Calibrate the IMUs from recordings (MCAP) of one rig that rested at wide poses and shook.

    All rests count, and the longest motion that begins at rest. The first recording zeroes the gyroscopes.

    Raises:
        RecordingError: no recordings, or not of one rig.
        CalibrationError: as `calibrate_rig`.
    """
    recordings = [complete(path, read(path)) for path in paths]
    first = recordings[0].config
    for path, each in zip(paths, recordings, strict=True):
        for name in ("mechanism", "imu", "rate"):
            if each.config[name] != first[name]:
                raise RecordingError(
                    f"the {name} of {path} is {each.config[name]} and of {paths[0]} {first[name]}: give recordings of one rig"
                )
    if knowledge.encoder is not None and (recorded := load_encoder(first.get("lengths", NO_LENGTHS))) is not None:
        knowledge = replace(knowledge, encoder=recorded)
    data = CalibrationData(load_spatial(first["mechanism"]), first["imu"], first["rate"], knowledge, first["seed"])
    runs = [every_cycle(each.records) for each in recordings]
    data.begin(runs[0], int(recordings[0].constant("rig", "hold_cycles")))
    for records in runs:
        data.check_places(records)
        data.add_rests(records)
    known = calibrate_by_known_poses(data, runs) if knowledge.known_poses else None
    return finish(data, data.at_rest(), runs, known)


def complete(path: Path, recording: Recording) -> Recording:
    """A recording with the constants of its run, from the first cycle on, or a `RecordingError`."""
    if "parameters" not in recording.arrays or not len(recording.records):
        raise RecordingError(f"{path} holds no cycle, or lacks the constants of its run: it is damaged")
    if recording.records["cycle"][0] != 0:
        raise RecordingError(f"{path} does not begin with the first cycle of its run, in which the brakes hold: record it anew")
    return recording


def every_cycle(records: Record) -> Record:
    """Records in which the last one before stands for each missed one."""
    cycles = records["cycle"]
    filled: Record = records[np.searchsorted(cycles, np.arange(cycles[0], cycles[-1] + 1), side="right") - 1]
    return filled


def finish(
    data: CalibrationData, at_rest: RestCalibration, runs: Sequence[Record], known: Calibration | None, validate: bool = True
) -> RigCalibration:
    """Calibrate in the longest motion, and assess every stage; the result is `known` if it is given."""
    motion = data.longest_motion(runs, at_rest)
    calibration, covariance = calibrate_in_motion(data.mechanism, at_rest, motion, data.rate, data.fusion)
    before = np.diag(data.knowledge.prior.sigmas() ** 2)
    cases = {"before": (Calibration(), before)}
    if known is not None:
        cases["known"] = known, before.copy()
        cases["known"][1][:ALL_ERRORS, :ALL_ERRORS] = known.covariance
    cases |= {"rests": (at_rest.calibration(), at_rest.covariance), "motion": (calibration, covariance)}
    summary = assess(data, cases) | {
        "positions": at_rest.positions.tolist(),
        "validated": cross_validate(data, calibration, motion) if validate else {},
        **constants(calibration, data.knowledge.prior.error_sigmas()),
    }
    about = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "version": version("gough"),
        **calibrated_rig(data.mechanism, data.imu),
        **{f"residual_{name}_mg": round(value, 4) for name, value in summary["residual_mg"].items()},
    }
    result = data.with_base(calibration if known is None else known)
    return RigCalibration(data.mechanism, replace(result, about=about), summary)
