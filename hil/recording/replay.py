"""Replay: the cycle runs again on recorded raw IMU data. Estimates and commands must come out bit for bit."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from controller.cycle import (
    MARKS,
    PARAMETER_LIMITS,
    PARAMETERS,
    STATE,
    cycle,
    hear_base_imu,
    hear_encoders,
    hear_rig,
    prepare_next,
    react,
    skip_periods,
)
from controller.planning import OPERATOR_TARGET, STREAM_TARGET
from controller.planning.segments import SEGMENT_SIZE
from controller.safety.causes import Cause
from controller.safety.stop import ramp_down
from hil.loop.compiled_loop import record_state
from hil.loop.records import RECORD, RECORD_LIMITS
from hil.recording.mcap import RecordingError, read_run
from plant.compiled import Record, kernel, out_of_limits
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS
from plant.pose import Array

COMPARED = ("position", "rotation", "lengths", "reference", "command", "conditioning", "mode", "stop")
"""What must come out the same, by its name in `RECORD`."""


@dataclass(frozen=True)
class Replay:
    """How a replay compares with its recording."""

    cycles: int  # that were replayed
    recorded: int  # cycles in the files
    missing_after: int | None  # the cycle before the first gap, where the replay ends
    different: int | None  # the first cycle that differs
    fields: dict[str, tuple[list[float], list[float]]]  # what differs in it, by name: recorded and replayed
    recorded_by: str  # version of gough
    replayed_by: str
    cut_short: tuple[str, ...]  # files that were not closed

    @property
    def same(self) -> bool:
        """Whether the whole recording came out the same."""
        return self.different is None and self.missing_after is None

    def summary(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return {**self.__dict__, "same": self.same}

    def lines(self) -> list[str]:
        """The outcome in words."""
        lines = [f"{name} was cut short: what follows its last chunk is lost" for name in self.cut_short]
        if self.different is not None:
            lines.append(f"cycle {self.different} is the first that differs:")
            lines += [f"  {name}: recorded {recorded}, replayed {again}" for name, (recorded, again) in self.fields.items()]
            if self.recorded_by != self.replayed_by:
                lines.append(f"  (recorded by gough {self.recorded_by}, replayed by {self.replayed_by})")
        if self.missing_after is not None:
            lines.append(f"cycles are missing after cycle {self.missing_after}: what follows cannot be replayed")
        lines.append(f"{self.cycles} of {self.recorded} cycles replayed{', bit for bit' if self.different is None else ''}")
        return lines


def replay(paths: Sequence[Path | str]) -> Replay:
    """Replay the files of one run.

    Raises:
        RecordingError: as `read_run`; a file's beginning is damaged; another version recorded it, whose cycle has other
            parameters; or what it holds is nothing that a cycle can take.
    """
    recordings, records = read_run(paths)
    for each in recordings:
        if {"parameters", "reference"} - set(each.arrays):
            raise RecordingError(f"{each.path} lacks what a replay needs: its beginning is damaged")
    first = recordings[0]
    parameters, segments = first.arrays["parameters"], first.arrays["reference"]
    if parameters.dtype != PARAMETERS:
        raise RecordingError(
            f"{first.path} was recorded by gough {first.version}, whose cycle has other parameters than that of this gough "
            f"{version('gough')}: replay it with the version that recorded it; everything else reads it as it is"
        )
    if own := first.config.get("stages"):
        raise RecordingError(
            f"{first.path} is of a run with stages of its own, {', '.join(own)}: nothing can replay what they computed; "
            "everything else reads it as it is"
        )
    broken = _broken(parameters, segments, records)
    if broken is not None:
        raise RecordingError(f"{first.path} cannot be replayed, as {broken}: it was forged or is damaged")
    # Aligned, as the loop had them; a file does not keep that.
    constants: Record = np.zeros((), PARAMETERS)
    constants[()] = parameters
    segments = np.ascontiguousarray(segments)
    again = np.zeros(len(records), RECORD)
    streamed = str(first.config.get("target")).partition(":")[0] in (STREAM_TARGET, OPERATOR_TARGET)
    count = int(_replay(constants, np.zeros((), STATE), segments, records, again, np.zeros((), MARKS)[()], streamed))
    differs = {name: np.any(_bits(records[name][:count]) != _bits(again[name][:count]), axis=1) for name in COMPARED}
    rows = np.flatnonzero(np.any([*differs.values()], axis=0))
    different, fields = None, {}
    if len(rows):
        row = int(rows[0])
        different = int(records["cycle"][row])
        for name in COMPARED:
            if differs[name][row]:
                fields[name] = (np.ravel(records[name][row]).tolist(), np.ravel(again[name][row]).tolist())
    return Replay(
        cycles=count,
        recorded=len(records),
        missing_after=int(records["cycle"][count - 1]) if count < len(records) else None,
        different=different,
        fields=fields,
        recorded_by=first.version,
        replayed_by=version("gough"),
        cut_short=tuple(str(each.path) for each in recordings if not each.complete),
    )


def _broken(parameters: Record, segments: Array, records: Record) -> str | None:
    """What compiled code could not take, in words; None if there is nothing."""
    if parameters.shape != ():
        return f"its parameters have the shape {parameters.shape}, and must have none"
    legs, count, width = segments.shape if segments.ndim == 3 else (0, 0, 0)
    if (legs, width) != (LEGS, SEGMENT_SIZE) or count < 1 or segments.dtype != np.float64:
        return f"its reference is {segments.dtype} {segments.shape}, and must be float64 ({LEGS}, n, {SEGMENT_SIZE})"
    return out_of_limits(parameters, PARAMETER_LIMITS) or out_of_limits(records, RECORD_LIMITS)


def _bits(values: Array) -> Any:
    """Values (n, ...) as integers (n, m): NaN equals NaN, and 0 differs from -0."""
    flat = np.ascontiguousarray(values).reshape(len(values), -1)
    return flat.view(np.int64) if flat.dtype == np.float64 else flat


@kernel
def _replay(
    parameters: Record, state: Record, segments: Array, records: Record, again: Record, marks: Record, streamed: bool
) -> int:
    """Run the cycle on the raw data of records (n,); returns the number of cycles before the first gap."""
    p, s, measurement, home = parameters[()], state[()], np.zeros((3, IMU_COUNT, 3)), np.zeros(LEGS, np.int64)
    for k in range(records.shape[0]):
        recorded = records[k]
        if recorded.cycle != s.time.cycle + recorded.missed:
            return k
        skip_periods(state, recorded.missed)
        if streamed and s.safety.stop.cause == Cause.NONE:
            # The recorded reference replaces the stream's plans; it contains how a stop dealt with missed periods.
            s.reference.motion[:] = recorded.reference
            s.reference.due_cycle = s.time.cycle + 1
            s.time.behind = 0
        if recorded.asked != Cause.NONE:
            react(parameters, state, recorded.asked, -1, np.nan, np.nan)
        measurement[0] = recorded.angular_velocity
        measurement[1] = recorded.specific_force
        measurement[2] = recorded.magnetic_field
        if recorded.status == Cause.RIG_FAILED:
            react(parameters, state, Cause.RIG_FAILED, -1, np.nan, np.nan)
            ramp_down(p.safety.stop, p.rig, s.time, s.pid)
        else:
            hear_rig(parameters, state, recorded.sample_age, recorded.drive, recorded.drive_code, recorded.silent)
            hear_base_imu(parameters, state, recorded.base_imu, recorded.base_imu_age)
            home[:] = recorded.home
            hear_encoders(parameters, state, recorded.silent, recorded.length, recorded.length_rate, home)
            cycle(parameters, state, measurement, segments, marks)
        record_state(state, again[k])
        prepare_next(parameters, state, segments)
    return len(records)
