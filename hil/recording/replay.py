"""Replay: recorded raw IMU data go through the cycle again, and estimates and commands must come out bit for bit."""

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
from hil.recording.mcap import RecordingError, read, total
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.pose import Array

COMPARED = ("position", "rotation", "lengths", "reference", "command", "conditioning", "mode", "stop")


@dataclass(frozen=True)
class Replay:
    """How a replay compares.

    Attributes:
        cycles: how many were replayed.
        recorded: how many there are in the files.
        missing_after: the cycle after which some are missing, so that the replay ends; None if none are.
        different: the first cycle that differs, None if none does.
        fields: what differs in it, by name: recorded and replayed.
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
        """Whether all that was recorded came out the same."""
        return self.different is None and self.missing_after is None

    def summary(self) -> dict[str, Any]:
        """Everything, for JSON."""
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
    """Replay the files of one run, in their order.

    Raises:
        RecordingError: not a recording, one of another version whose cycle has other parameters, or files of different runs.
    """
    recordings = [read(path) for path in paths]
    if len(recordings) > 1 and all(len(each.records) for each in recordings):
        order = sorted(range(len(recordings)), key=lambda i: int(recordings[i].records["cycle"][0]))
        paths, recordings = [paths[i] for i in order], [recordings[i] for i in order]
    first = recordings[0]
    for path, each in zip(paths, recordings, strict=True):
        if {"parameters", "reference"} - set(each.arrays):
            raise RecordingError(f"{path} lacks what a replay needs: its beginning is damaged")
    parameters, segments = first.arrays["parameters"], first.arrays["reference"]
    if parameters.dtype != PARAMETERS:
        raise RecordingError(
            f"{paths[0]} was recorded by gough {first.config['version']}, whose cycle has other parameters: replay it with that"
        )
    for path, other in zip(paths[1:], recordings[1:], strict=True):
        if other.arrays["parameters"].tobytes() != parameters.tobytes() or other.config != first.config:
            raise RecordingError(f"{path} is of another run than {paths[0]}")
    records = total(recordings)
    if not len(records):
        raise RecordingError(f"{paths[0]} holds no cycle: the run ended before its first one, or it is damaged")
    if records["cycle"][0] != 0:
        raise RecordingError(f"{paths[0]} does not begin with the first cycle of its run: name the files in their order")
    # As the loop had them: aligned, which a file does not say.
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
        recorded_by=first.config["version"],
        replayed_by=version("gough"),
        cut_short=tuple(str(path) for path, each in zip(paths, recordings, strict=True) if not each.complete),
    )


def _bits(values: Array) -> Any:
    """Values (n, ...) as integers (n, m), so that NaN equals NaN and 0 does not equal -0."""
    flat = np.ascontiguousarray(values).reshape(len(values), -1)
    return flat.view(np.int64) if flat.dtype == np.float64 else flat


@kernel
def _replay(
    parameters: Record, state: Record, segments: Array, records: Record, again: Record, measurement: Array, marks: Record,
    streamed: bool,
) -> int:  # fmt: skip
    """Run the cycle on the raw data of records (n,); returns how many it could, up to the first gap."""
    p, s = parameters[()], state[()]
    for k in range(records.shape[0]):
        recorded, found = records[k], again[k]
        if recorded.cycle != s.time.cycle + recorded.missed:
            return k
        skip_periods(state, recorded.missed)
        if streamed and s.safety.stop.cause == Cause.NONE:
            # What the stream's plans said is known from what was followed.
            s.reference.motion[:] = recorded.reference
            s.reference.due_cycle = s.time.cycle + 1
        if recorded.asked != Cause.NONE:
            if streamed:
                # What the stop made of missed periods is in the recorded reference.
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
