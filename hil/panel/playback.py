"""A panel that plays a recording."""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import viser

from controller.direct_kinematics import poses_from_lengths
from controller.frames import ActiveFrames, Frames
from hil.panel.readings import Readings
from hil.panel.scene import Machine, Scene
from hil.recording.mcap import read_run
from hil.runs.operator_messages import pose_message
from hil.runs.telemetry import machine_message, state_message, timing_message
from plant.compiled import Record
from plant.errors import GoughError, InputError
from plant.mechanism import Mechanism, load_in_space
from plant.pose import Pose

_FRAME_S = 1.0 / 30.0
_EVENTS = 8
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5", "10")


@dataclass(frozen=True, eq=False)
class RecordedRun:
    """A run as its files have it.

    Attributes:
        records: (N,), dtype `RECORD`.
        period: of a cycle [s].
        events: cycle and text of each, by cycle.
    """

    mechanism: Mechanism
    records: Record
    period: float
    events: Sequence[tuple[int, str]]

    @property
    def duration(self) -> float:
        """From the first cycle to the last [s]."""
        return float(self.records["cycle"][-1] - self.records["cycle"][0]) * self.period

    def at(self, seconds: float) -> int:
        """The record at a time since the first cycle [s]."""
        cycle = self.records["cycle"][0] + seconds / self.period
        return int(np.clip(np.searchsorted(self.records["cycle"], cycle, side="right") - 1, 0, len(self.records) - 1))

    def state(self, index: int) -> dict[str, Any]:
        """The state at a record, as a run tells it; its reference is `commanded`."""
        record, frames = self.records[index], ActiveFrames(Frames())
        told = {"time": index * self.period, **state_message(record, frames)}
        recent = np.arange(max(index - round(1.0 / self.period), 0), index + 1)
        told["timing"] = timing_message(self.records, recent, self.period)
        reference = self._reference(record)
        return told if reference is None else told | {"commanded": pose_message(reference)}

    def told(self, index: int) -> list[str]:
        """The last events until a record."""
        cycle = int(self.records["cycle"][index])
        return [f"cycle {at}: {text}" for at, text in self.events if at <= cycle][-_EVENTS:]

    def _reference(self, record: Record) -> Pose | None:
        """The pose that the reference's lengths have."""
        near = Pose(record["position"], record["rotation"])
        if not (np.isfinite(near.position).all() and np.isfinite(near.rotation).all()):
            near = self.mechanism.require_home()
        lengths = record["reference"][None, : self.mechanism.legs, 0]
        if not np.isfinite(lengths).all():
            return None
        positions, rotations = poses_from_lengths(self.mechanism, lengths, near, partial=True)
        return Pose(positions[0], rotations[0]) if np.isfinite(positions[0]).all() else None


def recorded_run(path: Path, mechanism: str | None = None) -> RecordedRun:
    """Read a recording; `mechanism` takes the place of the recorded one, whose file may have moved.

    Raises:
        RecordingError: the file is no recording, or holds no cycle.
        InputError: the mechanism cannot be loaded.
    """
    (recording,), records = read_run([path])
    config = recording.config
    named = config["mechanism"] if mechanism is None else mechanism
    try:
        loaded = load_in_space(named)
    except GoughError as error:
        raise InputError(f"the mechanism of the recording: {error}; name it with --mechanism") from None
    return RecordedRun(loaded, records, 1.0 / float(config["rate"]), sorted(recording.events))


class Playback:
    """The page of a recording."""

    def __init__(self, server: viser.ViserServer, run: RecordedRun) -> None:
        self._server, self._run = server, run
        machine = Machine.of_message(machine_message(run.mechanism))
        self._scene = Scene(server, machine)
        gui = server.gui
        gui.configure_theme(control_layout="collapsible", control_width="medium", show_logo=False, show_share_button=False)
        status = gui.add_markdown("")
        self._time: Any = gui.add_slider("Time [s]", 0.0, max(run.duration, run.period), run.period, 0.0)
        self._playing = gui.add_checkbox("Play", True)
        self._speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1")
        self._readings = Readings(server, machine, self._scene, ActiveFrames(Frames()).described(), status)

    def run(self, over: threading.Event) -> None:
        """Play, again and again, until `over` is set."""
        before = time.monotonic()
        while not over.wait(_FRAME_S):
            now = time.monotonic()
            if self._playing.value and self._server.get_clients():
                passed = self._time.value + (now - before) * float(self._speed.value)
                self._time.value = passed if passed <= self._run.duration else 0.0
            before = now
            self._show(self._run.at(self._time.value))

    def _show(self, index: int) -> None:
        state = self._run.state(index)
        with self._server.atomic():
            self._scene.show(state)
            self._readings.show(state, self._run.told(index))
