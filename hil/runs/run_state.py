"""What the supervisor sees of a run while it goes on."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from controller.frames import ActiveFrames
from controller.safety.causes import Mode
from hil.loop.stage_times import Timing
from hil.recording.mcap import events_of, take
from plant.compiled import Record
from plant.pose import pose_errors, rotations_from_quaternions
from plant.truth import TRUTH_POSITION, TRUTH_QUATERNION, pose_known

_MOST_EVENTS = 100


def event_line(cycle: int, seconds: float, text: str) -> str:
    """An event with its cycle, and its time since the first cycle."""
    return f"cycle {cycle} ({seconds:.3f} s): {text}"


def told_in(records: Record, period: float) -> Iterator[tuple[int, float, str]]:
    """The events in these records: cycle, time since the first cycle [s], and words; the period is in seconds."""
    for eventful in records[records["event_count"] > 0]:
        cycle = int(eventful["cycle"])
        for text in events_of(eventful):
            yield cycle, cycle * period, text


def note_events(records: Record, period: float, noted: list[str]) -> None:
    """Add the events in these records to those that are noted, as lines; the period is in seconds."""
    for event in told_in(records, period):
        if len(noted) < _MOST_EVENTS:
            noted.append(event_line(*event))
        elif len(noted) == _MOST_EVENTS:
            noted.append("later events are not listed")


@dataclass(eq=False)
class RunState:
    """State and figures of a run until now.

    Attributes:
        period: of a cycle [s].
        latest: the last record of the loop, dtype `RECORD`.
        timing: the durations of its stages.
        missed: number of periods missed.
        late: number of exchanges without an answer in time.
        refused: what the machine refused of the measures for real time.
        refused_packets: number of packets that a rig on a bus refused.
        unseen: number of cycles that were overwritten before the supervisor saw them; no figure includes them.
        events: the loop's, as from `event_line`, and the supervisor's own.
        protection: the greatest protection level (2,) of the motion [m, rad]; NaN until there is one.
        frames: of the read-outs, if the run has any.
    """

    period: float
    latest: Record | None = None
    timing: Timing = field(default_factory=Timing)
    missed: int = 0
    late: int = 0
    refused: list[str] = field(default_factory=list)
    refused_packets: int = 0
    unseen: int = 0
    events: list[str] = field(default_factory=list)
    protection: NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.nan))
    frames: ActiveFrames | None = None
    _seen: int = 0
    _squares: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    _tool_squares: float = 0.0
    _tracking_squares: float = 0.0
    _counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(2, np.int64))

    def update(self, records: Record, link: NDArray[np.int64]) -> bool:
        """Add the cycles that the loop has recorded meanwhile; returns whether there are any."""
        records, self._seen, unseen = take(records, link, self._seen)
        self.unseen += unseen
        if len(records):
            self.add(records)
        return len(records) > 0

    def add(self, records: Record) -> None:
        """Add cycles (n,), dtype `RECORD`, one at least."""
        self.latest = records[-1]
        self.timing.add(records)
        self.missed += int(records["missed"].sum())
        self.late += int((records["silent"] > 0).sum())
        self.refused_packets = int(records["refused"][-1])
        note_events(records, self.period, self.events)
        moving = records["mode"] == Mode.RUNNING
        if moving.any():
            self.protection = np.fmax(self.protection, np.fmax.reduce(records["protection"][moving].astype(float)))
        # Before the rig is armed there may be cycles without a pose.
        posed = records[records["status"] == 0]
        known = posed[pose_known(posed["truth"])]
        errors = posed["lengths"] - posed["reference"][:, :, 0]
        self._tracking_squares += float((np.sum(errors**2, axis=1) / np.count_nonzero(posed["lengths"], axis=1)).sum())
        if len(known):
            rotations = rotations_from_quaternions(np.ascontiguousarray(known["truth"][:, TRUTH_QUATERNION]))
            off = pose_errors(known["position"], known["rotation"], known["truth"][:, TRUTH_POSITION], rotations)
            self._squares += np.sum(off.reshape(-1, 2, 3) ** 2, axis=(0, 2))
            if self.frames is not None:
                arms = (known["rotation"] - rotations) @ self.frames.tool.position
                self._tool_squares += float(np.sum((off[:, :3] + arms) ** 2))
        self._counts += (len(known), len(posed))

    def level(self) -> dict[str, float] | None:
        """The greatest protection level of the motion, `position` [m] and `rotation` [rad]; None if there was none."""
        position, rotation = self.protection.tolist()
        return None if np.isnan(position) else {"position": position, "rotation": rotation}

    def errors(self) -> dict[str, float]:
        """RMS errors [m]: `estimation` of the position against the truth, over the `known` cycles that have a truth; `tracking`
        of a leg's length against the reference; with frames also `tool`, as `estimation`, of the tool's position.
        """
        known, posed = np.maximum(self._counts, 1).tolist()
        of_tool = {} if self.frames is None else {"tool": sqrt(self._tool_squares / known)}
        tracking = sqrt(self._tracking_squares / posed)
        return {"estimation": sqrt(self._squares[0] / known), "tracking": tracking, **of_tool, "known": int(self._counts[0])}

    def rotation_errors(self) -> dict[str, float]:
        """RMS error [rad]: `estimation` of the rotation against the truth, over the cycles that have one."""
        return {"estimation": sqrt(self._squares[1] / max(self._counts[0], 1))}
