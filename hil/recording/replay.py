"""Replay: the cycle runs again on recorded raw IMU data. Estimates and commands must come out bit for bit."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from controller.cycle import MARKS, PARAMETERS, STATE, cycle, hear_rig, prepare_next, react, skip_periods
from controller.planning import STREAM_TARGET
from controller.safety.causes import Cause
from controller.safety.stop import ramp_down
from hil.loop.records import RECORD
from hil.recording.mcap import RecordingError, joined, read_run
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.pose import Array

COMPARED = ("position", "rotation", "lengths", "reference", "command", "conditioning", "mode", "stop")


@dataclass(frozen=True)
class Replay:
    """How a replay compares with its recording.

    Attributes:
        cycles: number of cycles that were replayed.
        recorded: number of cycles in the files.
        missing_after: the cycle before the first gap, at which the replay ends; None without a gap.
        different: the first cycle that differs, None if none does.
        fields: what differs in that cycle, by name: recorded and replayed.
        recorded_by, replayed_by: versions of gough.
        cut_short: files that were not closed.
    """

    cycles: int
    recorded: int
    missing_after: int | None
    different: int | None
    fields: dict[str, tuple[list[float], list[float]]]
    recorded_by: str
    replayed_by: str
    cut_short: tuple[str, ...]

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
        RecordingError: as `read_run`; a file's beginning is damaged; or another version recorded it, whose cycle has other
            parameters.
    """
    recordings = read_run(paths)
    for each in recordings:
        if {"parameters", "reference"} - set(each.arrays):
            raise RecordingError(f"{each.path} lacks what a replay needs: its beginning is damaged")
    first, records = recordings[0], joined(recordings)
    parameters, segments = first.arrays["parameters"], first.arrays["reference"]
    if parameters.dtype != PARAMETERS:
        raise RecordingError(
            f"{first.path} was recorded by gough {first.version}, whose cycle has other parameters than that of this gough "
            f"{version('gough')}: replay it with the version that recorded it; everything else reads it as it is"
        )
    # Aligned, as the loop had them; a file does not keep that.
    constants: Record = np.zeros((), PARAMETERS)
    constants[()] = parameters
    again = np.zeros(len(records), RECORD)
    streamed = str(first.config.get("target")).partition(":")[0] == STREAM_TARGET
    measurement = np.zeros((3, IMU_COUNT, 3))
    count = int(
        _replay(constants, np.zeros((), STATE), segments, records, again, measurement, np.zeros((), MARKS)[()], streamed)
    )
    differs = [np.any(_bits(records[name][:count]) != _bits(again[name][:count]), axis=1) for name in COMPARED]
    rows = np.flatnonzero(np.any(differs, axis=0))
    different, fields = None, {}
    if len(rows):
        row = int(rows[0])
        different = int(records["cycle"][row])
        for name, unequal in zip(COMPARED, differs, strict=True):
            if unequal[row]:
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


def _bits(values: Array) -> Any:
    """Values (n, ...) as integers (n, m): NaN equals NaN, and 0 differs from -0."""
    flat = np.ascontiguousarray(values).reshape(len(values), -1)
    return flat.view(np.int64) if flat.dtype == np.float64 else flat


@kernel
def _replay(
    parameters: Record, state: Record, segments: Array, records: Record, again: Record, measurement: Array, marks: Record,
    streamed: bool,
) -> int:  # fmt: skip
    """Run the cycle on the raw data of records (n,); returns the number of cycles before the first gap."""
    p, s = parameters[()], state[()]
    for k in range(records.shape[0]):
        recorded, found = records[k], again[k]
        if recorded.cycle != s.time.cycle + recorded.missed:
            return k
        skip_periods(state, recorded.missed)
        if streamed and s.safety.stop.cause == Cause.NONE:
            # The recorded reference replaces the stream's plans.
            s.reference.motion[:] = recorded.reference
            s.reference.due_cycle = s.time.cycle + 1
        if recorded.asked != Cause.NONE:
            if streamed:
                # The recorded reference contains how the stop dealt with missed periods.
                s.time.missed = 0
            react(parameters, state, recorded.asked, -1, np.nan, np.nan)
            s.time.missed = recorded.missed
        measurement[0] = recorded.angular_velocity
        measurement[1] = recorded.specific_force
        measurement[2] = recorded.magnetic_field
        if recorded.status == Cause.RIG_FAILED:
            react(parameters, state, Cause.RIG_FAILED, -1, np.nan, np.nan)
            ramp_down(p.safety.stop, p.rig, s.time, s.pid)
        else:
            hear_rig(parameters, state, recorded.sample_age, recorded.drive, recorded.silent)
            cycle(parameters, state, measurement, segments, marks)
        found.position[:] = s.pose.position
        found.rotation[:] = s.pose.rotation
        found.lengths[:] = s.pose.lengths
        found.reference[:] = s.reference.motion
        found.command[:] = s.pid.command
        found.conditioning = s.pose.conditioning
        found.mode, found.stop = s.safety.mode, s.safety.stop.cause
        prepare_next(parameters, state, segments)
    return len(records)
