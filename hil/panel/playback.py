"""A panel that plays a recording."""

import threading
import time
from typing import Any

import viser

from hil.panel.gui import set_theme
from hil.panel.margins import MARGINS_S, MarginTable
from hil.panel.readings import Readings
from hil.panel.scene import Machine, Scene
from hil.runs.recorded_run import RecordedRun
from hil.runs.telemetry import frames_message, machine_message

_FRAME_S = 1.0 / 30.0
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5", "10")


class Playback:
    """The page of a recording."""

    def __init__(self, server: viser.ViserServer, run: RecordedRun) -> None:
        self._server, self._run = server, run
        machine = Machine.of_message(machine_message(run.mechanism))
        self._scene = Scene(server, machine)
        gui = server.gui
        set_theme(gui)
        status = gui.add_markdown("")
        self._time: Any = gui.add_slider("Time [s]", 0.0, max(run.duration, run.period), run.period, 0.0)
        self._playing = gui.add_checkbox("Play", True)
        self._speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1")
        self._readings = Readings(server, machine, self._scene, frames_message(run.frames), status)
        with gui.add_folder("Limits"):
            self._margins, self._measured = MarginTable(server), 0.0

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
        if time.monotonic() - self._measured > MARGINS_S:
            self._margins.show(self._run.margins(index))
            self._measured = time.monotonic()
