"""Runs that a page starts: what it asks for, and their processes. They drive the simulated plant alone."""

import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import viser

from controller.calibration.file import load_calibration
from controller.frames import load_frames
from controller.planning import OPERATOR_TARGET
from controller.planning.motions import load_motion
from controller.planning.motions.built_in import NAMES
from controller.planning.target import MOTION_SUFFIX
from hil.panel.gui import set_text, tell_not_done
from hil.runs.config import FUSIONS
from plant.checks import check_duration, check_rate, checked_seed
from plant.errors import GoughError, InputError
from plant.imu import PRESETS
from plant.mechanism import load_in_space, preset_names

_NONE = "none"
_OFFERED_FUSIONS = tuple(name for name in FUSIONS if name not in ("filterpy", "section-5"))
"""The first is too slow for the clock, and the other one needs a magnetometer."""

_MOST_FILES = 50
_WORDS = 12
"""Of the last lines of a run."""

_PATIENT = ("--most-missed", "2000")
"""A browser on the same machine holds the loop up now and then, and nothing real moves."""


class StartedRun:
    """A run in a process of its own, which ends by a controlled stop with the panel.

    Args:
        options: of 'gough run'.

    Attributes:
        words: its last lines, which are printed, too.
    """

    def __init__(self, options: Sequence[str]) -> None:
        self.words: deque[str] = deque(maxlen=_WORDS)
        # Ctrl-C is for the panel, which ends the run.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "hil.command_line", "run", *options], start_new_session=True, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    @property
    def status(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._process.poll()

    def end(self) -> None:
        """Let it stop, and wait until it has."""
        if self.status is None:
            self._process.terminate()
        self._process.wait()
        self._listener.join()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            print(line, end="", flush=True)
            self.words.append(line.rstrip())


class RunForm:
    """The part of a page that asks for a run, where none is there.

    Args:
        server: of the page.
        start: is called with the options of 'gough run' when a browser wants one.
        before: the options of the last run that was wanted, which are chosen again.

    Attributes:
        choices: by option of 'gough run', the control and what it offers.
    """

    def __init__(
        self, server: viser.ViserServer, start: Callable[[list[str]], None], before: Sequence[str] = ()
    ) -> None:  # fmt: skip
        self._start = start
        last = dict(zip(before[::2], before[1::2], strict=True))
        gui = server.gui
        self._note = gui.add_markdown("")
        targets = [*_files(load_motion), *map(str, sorted(Path().glob("*.csv")))]
        self.choices: dict[str, tuple[Any, tuple[str, ...]]] = {}
        for flag, label, names in (
            ("--mechanism", "Mechanism", (*_first("hexapod", preset_names()), *_files(load_in_space))),
            ("--target", "Target", (OPERATOR_TARGET, *NAMES, *targets)),
            ("--frames", "Frames", (_NONE, *_files(load_frames))),
            ("--imu", "IMUs", _first("mpu9150-calibrated", PRESETS)),
            ("--calibration", "Calibration", (_NONE, *_files(load_calibration))),
            ("--fusion", "Fusion", _first("compiled", _OFFERED_FUSIONS)),
        ):
            chosen = last.get(flag, names[0])
            self.choices[flag] = gui.add_dropdown(label, names, initial_value=chosen if chosen in names else names[0]), names
        numbers = ("--duration", 60.0), ("--rate", 500.0), ("--seed", 0.0)
        duration, rate, seed = (float(last.get(flag, default)) for flag, default in numbers)
        # A browser need not have kept to the control's limits.
        self._duration = gui.add_number("Duration [s]", min(max(duration, 0.1), 36000.0), min=0.1, max=36000.0, step=0.1)
        self._rate = gui.add_number("Rate [Hz]", rate, min=50.0, max=4000.0, step=1.0)
        self._seed = gui.add_number("Seed of the IMUs", seed, min=0.0, step=1.0)
        button = gui.add_button("Start the run", color="blue")
        gui.add_markdown(
            "It drives the simulated plant. Runs on a rig begin elsewhere, with `gough run`; this page finds them."
        )

        async def clicked(event: Any) -> None:
            try:
                self._start(self.options())
            except GoughError as error:
                tell_not_done(server, event.client, str(error))

        button.on_click(clicked)

    def say(self, text: str) -> None:
        """Tell what has become of the last run."""
        set_text(self._note, text)

    def options(self) -> list[str]:
        """The options of the run that is asked for.

        Raises:
            InputError: a browser has sent what it was not offered, or a duration, a rate or a seed that no run can have.
        """
        options: list[str] = []
        for flag, (choice, names) in self.choices.items():
            if choice.value not in names:
                raise InputError(f"there is no {flag[2:]} {choice.value!r} to choose: reload the page")
            if choice.value != _NONE:
                options += [flag, choice.value]
        duration, rate = float(self._duration.value), float(self._rate.value)
        check_duration(duration)
        check_rate(rate)
        seed: Any = self._seed.value
        seed = checked_seed(int(seed) if float(seed).is_integer() else seed)
        return [*options, "--duration", f"{duration:g}", "--rate", f"{rate:g}", "--seed", f"{seed}", *_PATIENT]


def _first(name: str, names: Any) -> tuple[str, ...]:
    """The names, with one of them before the others."""
    return (name, *(each for each in names if each != name))


def _files(load: Callable[[str], Any]) -> list[str]:
    """The files of this folder that can be loaded."""
    found = []
    for path in sorted(Path().glob(f"*{MOTION_SUFFIX}"))[:_MOST_FILES]:
        try:
            load(str(path))
        except GoughError:
            continue
        found.append(str(path))
    return found
