"""A recording as a rig: the loop runs on the clock with recorded samples, and nothing moves."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from controller.safety.causes import Cause
from hil.loop.records import RECORD
from hil.recording.mcap import RecordingError, read_run
from hil.rigs import ANSWERED, SILENT, Identity, RigError
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import Mechanism
from plant.pose import Array

ENDED, FAILED = 2, 3
_FAILURES = {ENDED: "the recording has come to its end", FAILED: "it did so when it was recorded"}
"""Statuses of an exchange that fails, and why."""

_REPEATED = (
    "sample_ns", "length", "length_rate", "home", "base_imu", "base_imu_ns", "drive", "drive_code", "sent", "truth",
    "round_trip_ns", "refused",
)  # fmt: skip
"""What a record and the feedback have in common."""


class ReplayRig:
    """A recording as a rig. Each exchange returns the next recorded period; commands are ignored.

    In a period that was missed when it was recorded, the rig does not answer. If the target or the duration differs from the
    recorded one, the drives do not follow and the run stops; a run that does not arm continues.

    Args:
        path: the recording, or the consecutive files of one run.
        period: of the exchanges [s]; it must be the recording's.
        mechanism: it must be the recording's, too; None for any.
    """

    def __init__(self, path: Path | str | Sequence[Path | str], period: float, mechanism: Mechanism | None = None) -> None:
        self.command_delay = period  # [s]; when it is open, that of the recorded rig
        self.failure = ""
        self._paths = [path] if isinstance(path, str | Path) else list(path)
        self._period, self._mechanism = period, mechanism
        self._identity: Identity | None = None
        self._records = np.zeros(0, RECORD)
        self._numbers = np.zeros((0, IMU_COUNT), np.int64)
        self._base_imu_numbers = np.zeros(0, np.int64)
        self._cycle = self._row = 0

    def open(self) -> None:
        """Read the recording; a `RigError` if there is none, or its rate, mechanism or run is another."""
        try:
            (first, *_), records = read_run(self._paths)
        except RecordingError as error:
            raise RigError(str(error)) from None
        where, config = ", ".join(map(str, self._paths)), first.config
        rate = self._rate(config)
        if not abs(rate * self._period - 1.0) <= 1e-9:
            raise RigError(
                f"{where} was recorded at {rate:g} Hz and cannot be replayed at {1.0 / self._period:g} Hz: give its rate"
            )
        name = config.get("mechanism_name")
        if self._mechanism is not None and self._mechanism.name != name:
            raise RigError(f"{where} was recorded on the mechanism {name}, not on {self._mechanism.name}: give that")
        self._records = records
        self._numbers = np.cumsum(records["sample_age"] == 0, axis=0)
        self._base_imu_numbers = np.cumsum(records["base_imu_age"] == 0)
        self._cycle, self._row, self.failure = 0, 0, ""
        if "parameters" in first.arrays:
            self.command_delay = float(first.constant("load", "command_delay"))
        parts = {"rig": str(config.get("rig")), "run": str(config.get("run")), "recorded by": f"gough {first.version}"}
        self._identity = Identity(f"recording {where}", parts)

    def _rate(self, config: Mapping[str, Any]) -> float:
        try:
            return float(config["rate"])
        except (KeyError, TypeError, ValueError):
            raise RigError(f"{', '.join(map(str, self._paths))} does not say at what rate it was recorded") from None

    def identify(self) -> Identity:
        """The recorded run; a `RigError` if it is not open."""
        if self._identity is None:
            raise RigError("the recording is not open: open it first")
        return self._identity

    def arm(self) -> None:
        """Nothing: the drives are recorded."""

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """Return the recording of the next period, as `Rig` describes."""
        del command, request
        if self._row >= len(self._records):
            return self._fail(ENDED)
        record, measurement = self._records[self._row], feedback["measurement"]
        self._cycle += 1
        if record["cycle"] >= self._cycle:
            return SILENT
        row, self._row = self._row, self._row + 1
        measurement[0], measurement[1] = record["angular_velocity"], record["specific_force"]
        measurement[2] = record["magnetic_field"]
        feedback["sequence"], feedback["base_imu_sequence"] = self._numbers[row], self._base_imu_numbers[row]
        for name in _REPEATED:
            feedback[name] = record[name]
        if record["status"] == Cause.RIG_FAILED:
            return self._fail(FAILED)
        return SILENT if record["silent"] > 0 else ANSWERED

    def _fail(self, status: int) -> int:
        self.failure = _FAILURES[status]
        return status

    def quick_stop(self) -> None:
        """Nothing: nothing moves."""

    def close(self) -> None:
        """Release the recording."""
        self._identity, self._records = None, self._records[:0]
