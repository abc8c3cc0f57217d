"""The contract of a rig: what the loop relies on, clause by clause, checked on any rig from outside.

By default nothing is asked of the drives but to hold on their brakes. With `moving` they are enabled, all legs go up and down
again at 1 mm/s for 0.2 s each, and they are stopped; there must be room for that.
"""

import importlib
import sys
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hil.rigs import (
    ANSWERED,
    BRAKED,
    ENABLED,
    FAULTY,
    FEEDBACK,
    FOLLOWING,
    QUICK_STOP,
    QUICK_STOPPING,
    READY,
    SILENT,
    Identity,
    Rig,
    RigError,
    new_feedback,
)  # fmt: skip
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.errors import GoughError, InputError, UnknownNameError
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array

CALLS = ("open", "identify", "arm", "exchange", "quick_stop", "close")
"""What can be called of a rig."""

FOLLOWED_WITHIN = 20
"""Exchanges within which the drives must be as they were asked to be."""

SENT_WITHIN = 2
"""Exchanges within which a command must be among what is said to have been sent."""

SPEED, STROKE_S = 1e-3, 0.2
"""Of the legs, when they move [m/s], and for how long each way [s]."""

_ROUNDING = 1e-5
_STANDSTILL_S = 0.5
_MOST_SILENT = 0.1
_STALE_S = 0.01
_REST_FORCE, _REST_RATE = (5.0, 15.0), 0.5
_CLOSED_WITHIN_S = 1.0
_DRIVES = ("following", "ready", "off", "stopping quickly", "faulty")
_GUARD = 64

CLAUSES = {
    "interface": "it has all calls, and its command_delay",
    "stops at any time": "quick_stop and close raise nothing: before open, twice, and after close",
    "opens": "it can be opened, else it says why in a RigError",
    "identifies": "identify tells what it is",
    "arms": "arm makes the drives ready and asks nothing of them",
    "threads": "no thread runs beside the exchanges, and none is left",
    "exchanges": "exchange raises nothing and gives answers",
    "feedback": "the feedback keeps its layout, and all that must be there is there",
    "order in time": "numbers and times of samples, and what was refused, never go back",
    "sample age": "samples are new in time",
    "drives": f"the drives do what is asked of them within {FOLLOWED_WITHIN} exchanges",
    "sent": "what was sent is what was commanded, within limits",
    "motion": "the legs go the way that is commanded, where the truth is known",
    "period": "an exchange returns within the period (p99)",
    "opens again": "after close it can be opened again",
    "absent": "a rig that is not there is told by a RigError with a message",
}


@dataclass
class Examination:
    """What was found of a rig.

    Attributes:
        findings: by clause, of those that were checked.
        exchange_us: how long exchanges last: p50, p99, max [us], and how many there were.
        identity: what it says that it is.
    """

    findings: dict[str, list[str]] = field(default_factory=dict)
    exchange_us: dict[str, float] = field(default_factory=dict)
    identity: Identity | None = None

    def all_findings(self) -> list[str]:
        """Of all clauses."""
        return [text for each in self.findings.values() for text in each]


def check_rig(
    make_rig: Callable[[], Rig],
    period: float,
    moving: bool = True,
    beyond: float | None = None,
    absent: Callable[[], Rig] | None = None,
) -> list[str]:
    """Put a rig through the contract; returns what was found, one sentence each (see `examine_rig`)."""
    return examine_rig(make_rig, period, moving, beyond, absent).all_findings()


def examine_rig(
    make_rig: Callable[[], Rig],
    period: float,
    moving: bool = True,
    beyond: float | None = None,
    absent: Callable[[], Rig] | None = None,
) -> Examination:
    """Put a rig through the contract.

    Args:
        make_rig: makes it, anew each time.
        period: of the exchanges [s].
        moving: whether the drives may be enabled and move by 0.2 mm.
        beyond: a command beyond the limits [m/s] that is tried for one exchange, with `moving` only: for emulated rigs, never
            for hardware.
        absent: makes a rig of the same kind that is not there.
    """
    return _Examiner(make_rig, period, moving, beyond, absent).examine()


class _BrokenOffError(Exception):
    """It is no use to go on; why is among the findings."""


class _Examiner:
    """One examination, call by call."""

    def __init__(
        self, make_rig: Callable[[], Rig], period: float, moving: bool, beyond: float | None, absent: Callable[[], Rig] | None
    ) -> None:  # fmt: skip
        self._make, self._period, self._moving, self._beyond, self._absent = make_rig, period, moving, beyond, absent
        self._result = Examination()
        self._told: set[tuple[str, str]] = set()
        self._rig: Rig = make_rig()
        memory = np.full(FEEDBACK.itemsize + 2 * _GUARD, 0xA5, np.uint8)
        self._memory, inner = memory, memory[_GUARD:-_GUARD].view(FEEDBACK)
        inner[0] = new_feedback()
        self._feedback: Record = inner[0]
        self._before: Record = new_feedback()
        self._durations: list[int] = []
        self._due = 0.0
        self._statuses: dict[int, int] = {}
        self._commands: list[Array] = []
        self._age, self._stateless = np.zeros(IMU_COUNT, np.int64), np.zeros(LEGS, bool)

    # ------------------------------------------------------------------------------------------------------- findings

    def _begin(self, *clauses: str) -> None:
        for clause in clauses:
            self._result.findings.setdefault(clause, [])

    def _find(self, clause: str, text: str, kind: str = "") -> None:
        """Note a finding; of each kind only the first is told."""
        self._begin(clause)
        if (clause, kind or text) not in self._told:
            self._told.add((clause, kind or text))
            self._result.findings[clause].append(text)

    def _call(self, name: str, clause: str, when: str = "") -> Any:
        """Call the rig; whatever it raises is a finding, and what may never raise is no reason to break off."""
        self._begin(clause)
        try:
            return getattr(self._rig, name)()
        except Exception as error:
            raised = f"{name} {when}raised {type(error).__name__}"
            if name in ("quick_stop", "close"):
                self._find(clause, f"{raised}: {error}; it must not raise anything.")
                return None
            if not isinstance(error, GoughError):
                self._find(clause, f"{raised}: {error}; it must raise a RigError with a message.")
            else:
                self._find(clause, f"{name} refused: {error}" if str(error) else f"{raised} without a message.")
            raise _BrokenOffError from None

    # ---------------------------------------------------------------------------------------------------- examination

    def examine(self) -> Examination:
        """All of it, in order; whatever happens, the drives are stopped and the rig is closed."""
        threads = set(threading.enumerate())
        try:
            self._check_interface()
            for name in ("quick_stop", "close"):
                self._call(name, "stops at any time", "before open ")
            self._call("open", "opens")
            self._identify()
            if self._moving:
                self._call("arm", "arms")
            self._check_threads(threads, "run when it is open")
            self._check_at_rest()
            if self._moving:
                self._check_moving()
                for _ in range(2):
                    self._call("quick_stop", "stops at any time", "while the drives are enabled ")
                self._ask(QUICK_STOP, np.zeros(LEGS), (QUICK_STOPPING, READY))
                self._ask(BRAKED, np.zeros(LEGS), (READY,))
        except _BrokenOffError:
            pass
        finally:
            self._stop()
        with suppress(_BrokenOffError):
            self._check_threads(threads, "are left when it is closed", _CLOSED_WITHIN_S)
            self._sum_up()
            if self._result.identity is not None:
                self._open_again()
            self._check_absent()
        return self._result

    def _check_interface(self) -> None:
        self._begin("interface")
        missing = missing_calls(self._rig)
        if missing:
            self._find("interface", f"It lacks {', '.join(missing)}.")
            raise _BrokenOffError
        delay = self._rig.command_delay
        if not (isinstance(delay, int | float) and 0.0 <= delay <= 10.0 * self._period):
            self._find("interface", f"Its command_delay is {delay!r}; it must be 0 to 10 periods [s], one on a bus.")

    def _identify(self) -> None:
        identity = self._call("identify", "identifies")
        if not isinstance(identity, Identity) or not identity.name:
            self._find("identifies", f"identify returned {identity!r}; it must return an Identity with a name.")
            raise _BrokenOffError
        self._result.identity = identity
        if not all(isinstance(each, str) for pair in identity.parts.items() for each in pair):
            self._find("identifies", "The identity's parts must be texts by name, for they are recorded.")

    def _check_threads(self, before: set[threading.Thread], when: str, patience: float = 0.0) -> None:
        self._begin("threads")
        deadline = time.monotonic() + patience
        while (more := [each for each in threading.enumerate() if each not in before]) and time.monotonic() < deadline:
            time.sleep(0.01)
        if more:
            self._find("threads", f"Threads {when} ({', '.join(each.name for each in more)}); they delay the loop: end them.")

    def _check_at_rest(self) -> None:
        zero = np.zeros(LEGS)
        self._restart()
        count = max(FOLLOWED_WITHIN, round(_STANDSTILL_S / self._period))
        for i in range(count):
            self._exchange(zero, BRAKED)
            if i == 0:
                self._stateless = self._feedback["drive"] == FOLLOWING
            if self._moving and i >= FOLLOWED_WITHIN and not self._are((READY,)):
                self._tell_drives(BRAKED, i + 1)
        self._check_contents()
        silent = self._statuses.get(SILENT, 0)
        if silent > _MOST_SILENT * count:
            self._find("exchanges", f"{silent} of {count} exchanges on the brakes brought no answer.")

    def _check_moving(self) -> None:
        zero, up = np.zeros(LEGS), np.full(LEGS, SPEED)
        count = max(3, round(STROKE_S / self._period))
        self._ask(ENABLED, zero, (FOLLOWING,))
        lengths = [self._feedback["truth"][7:13].copy()]
        for command in (up, -up):
            for _ in range(count):
                self._exchange(command, ENABLED)
            lengths.append(self._feedback["truth"][7:13].copy())
        self._check_motion(lengths, count)
        if self._beyond is not None:
            self._check_limit(self._beyond)
            self._exchange(np.full(LEGS, np.nan), ENABLED)
        self._ask(QUICK_STOP, zero, (QUICK_STOPPING, READY))
        self._ask(BRAKED, zero, (READY,))
        self._ask(ENABLED, zero, (FOLLOWING,))
        self._exchange(up, ENABLED)

    def _check_motion(self, lengths: list[Array], count: int) -> None:
        """From where the motion began, turned and ended; a drive that gives way to its load does so on both ways."""
        began, turned, ended = lengths
        moved = 0.5 * ((turned - began) - (ended - turned))
        if not np.isfinite(moved).all():
            return
        self._begin("motion")
        due = count * self._period * SPEED
        for leg in np.flatnonzero(abs(moved - due) > 0.5 * due).tolist():
            self._find(
                "motion",
                f"Leg {leg} moved by {1e3 * moved[leg]:.3f} mm, commanded were {1e3 * due:.3f} mm: check its sign and scale.",
            )

    def _check_limit(self, beyond: float) -> None:
        most = 0.0
        for command in (beyond, *[0.0] * SENT_WITHIN):
            self._exchange(np.full(LEGS, command), ENABLED)
            most = max(most, float(abs(self._feedback["sent"]).max()))
        if most >= abs(beyond):
            self._find("sent", f"A command of {beyond:g} m/s was sent as it is: limit it.")

    def _ask(self, request: int, command: Array, states: tuple[int, ...]) -> None:
        """Ask something of the drives, for as long as they may take."""
        self._begin("drives")
        for _ in range(FOLLOWED_WITHIN):
            self._exchange(command, request)
        if not self._are(states):
            self._tell_drives(request, FOLLOWED_WITHIN)

    def _are(self, states: tuple[int, ...]) -> bool:
        """Whether the drives are in one of these states; one without a state of its own always follows."""
        return bool((np.isin(self._feedback["drive"], states) | self._stateless).all())

    def _tell_drives(self, request: int, count: int) -> None:
        what = ("to hold on their brakes", "to follow", "to stop quickly")[request]
        states = ", ".join(_DRIVES[state] if 0 <= state < len(_DRIVES) else str(state) for state in self._feedback["drive"])
        codes = ", ".join(f"{int(code):#x}" for code in self._feedback["drive_code"])
        self._find(
            "drives", f"Asked {what}, the drives are {states} after {count} exchanges (fault codes {codes}).", str(request)
        )
        if (self._feedback["drive"] == FAULTY).any():
            raise _BrokenOffError

    # ------------------------------------------------------------------------------------------------------ exchanges

    def _restart(self) -> None:
        """Let the next exchange be due one period from now."""
        self._due = time.monotonic() + self._period

    def _exchange(self, command: Array, request: int) -> None:
        """An exchange at its time, and what can be seen of it."""
        self._begin("exchanges", "feedback", "order in time", "sample age", "sent")
        late = time.monotonic() - self._due
        if late < 0.0:
            time.sleep(-late)
        elif late > self._period:
            self._restart()
        self._due += self._period
        feedback, given = self._feedback, command.copy()
        self._before[()] = feedback
        began = time.perf_counter_ns()
        try:
            status = self._rig.exchange(given, request, feedback)
        except Exception as error:
            self._find("exchanges", f"exchange raised {type(error).__name__}: {error}; a failure is told by its status.")
            raise _BrokenOffError from None
        self._durations.append(time.perf_counter_ns() - began)
        if not isinstance(status, int | np.integer) or isinstance(status, bool) or status < 0:
            self._find("exchanges", f"exchange returned {status!r}; it must return ANSWERED, SILENT, or a failure above.")
            raise _BrokenOffError
        self._statuses[int(status)] = self._statuses.get(int(status), 0) + 1
        if status > SILENT:
            text = getattr(self._rig, "failure", "")
            at = len(self._durations)
            self._find("exchanges", f"Exchange {at} failed with status {status}{f': {text}' if text else ''}.")
            raise _BrokenOffError
        if not np.array_equal(given, command, equal_nan=True):
            self._find("exchanges", "exchange changed the commands that it was given; they are the loop's.")
        self._commands = [*self._commands[-SENT_WITHIN:], command if request == ENABLED else np.zeros(LEGS)]
        self._check_layout()
        self._check_order()
        if status == ANSWERED:
            self._check_sent()

    def _check_layout(self) -> None:
        feedback, guard = self._feedback, self._memory
        if feedback.dtype != FEEDBACK:
            self._find("feedback", "exchange changed the feedback's dtype.")
            raise _BrokenOffError
        if (guard[:_GUARD] != 0xA5).any() or (guard[-_GUARD:] != 0xA5).any():
            self._find("feedback", "exchange wrote beyond the feedback into other memory.")
            raise _BrokenOffError

    def _check_order(self) -> None:
        now, before, nth = self._feedback, self._before, len(self._durations)
        for name, what in (("sequence", "number"), ("sample_ns", "time")):
            for imu in np.flatnonzero(now[name] < before[name]).tolist():
                self._find(
                    "order in time",
                    f"The {what} of IMU {imu}'s samples went back in exchange {nth}: {before[name][imu]}, {now[name][imu]}.",
                    name,
                )
        fresh = now["sequence"] != before["sequence"]
        for imu in np.flatnonzero(fresh & (now["sample_ns"] == before["sample_ns"]) & (before["sequence"] >= 0)).tolist():
            self._find(
                "order in time", f"IMU {imu} has a new sample with the time of the one before, in exchange {nth}.", "standing"
            )
        if now["refused"] < before["refused"]:
            self._find("order in time", f"The count of what was refused went back in exchange {nth}.", "refused")
        self._age = np.where(fresh, 0, self._age + 1)
        most = max(3, round(_STALE_S / self._period))
        for imu in np.flatnonzero((self._age > most) & self._present()).tolist():
            self._find(
                "sample age", f"IMU {imu} has no new sample in {most + 1} exchanges: the loop would leave it out.", f"{imu}"
            )

    def _present(self) -> Any:
        """Which IMUs have said something."""
        return np.isfinite(self._feedback["measurement"][:2]).any(axis=(0, 2))

    def _check_sent(self) -> None:
        sent = self._feedback["sent"]
        if not np.isfinite(sent).all():
            self._find("sent", f"What was sent is not finite: {sent.tolist()}.", "finite")
            return
        recent = np.array(self._commands)
        steady = len(recent) > SENT_WITHIN and np.isfinite(recent).all() and np.ptp(recent, axis=0).max() == 0.0
        if steady and abs(recent).max() <= SPEED:
            drive = int(abs(sent - recent[-1]).argmax())
            if abs(sent[drive] - recent[-1][drive]) > _ROUNDING:
                self._find(
                    "sent", f"Drive {drive} was commanded {recent[-1][drive]:g} m/s, and {sent[drive]:g} m/s is said to have "
                    f"been sent, after {len(recent)} exchanges.", f"{recent[-1][drive]}",
                )  # fmt: skip

    def _check_contents(self) -> None:
        """What the feedback holds after a while at rest."""
        feedback = self._feedback
        measurement, present = feedback["measurement"], self._present()
        if not present.any():
            self._find("feedback", "No IMU has said anything: the measurement is NaN.")
        for imu in np.flatnonzero(present).tolist():
            if not np.isfinite(measurement[:2, imu]).all():
                self._find(
                    "feedback", f"IMU {imu} gives some axes that are not finite; NaN stands for an IMU that is not there."
                )
                continue
            rate, force = (float(np.linalg.norm(measurement[kind, imu])) for kind in range(2))
            if not _REST_FORCE[0] <= force <= _REST_FORCE[1]:
                self._find("feedback", f"IMU {imu} reads {force:.3g} m/s^2 at rest where gravity is due: check its unit.")
            if rate > _REST_RATE:
                self._find("feedback", f"IMU {imu} reads {rate:.3g} rad/s at rest: check its unit.")
            field = measurement[2, imu]
            if np.isinf(field).any() or np.isnan(field).any() != np.isnan(field).all():
                self._find("feedback", f"The magnetic field of IMU {imu} must be finite, or NaN on all axes.")
            if feedback["sequence"][imu] < 0:
                self._find("feedback", f"IMU {imu} has data, but its samples have no number.")
        if not np.isin(feedback["drive"], range(len(_DRIVES))).all():
            self._find(
                "feedback", f"The drives' states are {feedback['drive'].tolist()}; they must be 0 to {len(_DRIVES) - 1}."
            )
        if feedback["round_trip_ns"] < 0:
            self._find("feedback", f"The round trip is {feedback['round_trip_ns']} ns.")
        pose = feedback["truth"][:13]
        if np.isnan(pose).any() != np.isnan(pose).all() or np.isinf(pose).any():
            self._find("feedback", "The truth must have position, quaternion and lengths, or be NaN where it is not known.")

    # ------------------------------------------------------------------------------------------------------------ end

    def _stop(self) -> None:
        """Quick stop and close, each twice and in any order."""
        if missing_calls(self._rig):
            return
        for name, when in (("quick_stop", ""), ("close", ""), ("close", "a second time "), ("quick_stop", "after close ")):
            self._call(name, "stops at any time", when)

    def _sum_up(self) -> None:
        if not self._durations:
            return
        durations = np.array(self._durations) / 1e3
        p50, p99 = (float(np.percentile(durations, share)) for share in (50, 99))
        self._result.exchange_us = {"p50": p50, "p99": p99, "max": float(durations.max()), "n": len(durations)}
        self._begin("period")
        if p99 > 1e6 * self._period:
            self._find(
                "period", f"An exchange lasts {p99 / 1e3:.3g} ms (p99 of {len(durations)}), longer than the period of "
                f"{1e3 * self._period:g} ms.",
            )  # fmt: skip

    def _open_again(self) -> None:
        self._rig = self._make()
        try:
            self._call("open", "opens again")
            self._call("identify", "opens again")
        finally:
            self._stop()

    def _check_absent(self) -> None:
        if self._absent is None:
            return
        self._begin("absent")
        rig = self._absent()
        try:
            rig.open()
            rig.identify()
        except RigError as error:
            if not str(error):
                self._find("absent", "A rig that is not there raises a RigError without a message.")
        except Exception as error:
            self._find("absent", f"A rig that is not there raises {type(error).__name__}: {error}; a RigError is due.")
        else:
            self._find("absent", "A rig that is not there is opened and identified as if it were.")
        finally:
            with suppress(Exception):
                rig.close()


def missing_calls(rig: object) -> list[str]:
    """Calls and attributes of `hil.rigs.Rig` that an object lacks."""
    calls = [name for name in CALLS if not callable(getattr(rig, name, None))]
    return calls if isinstance(rig, type) or hasattr(rig, "command_delay") else [*calls, "command_delay"]


def check_legs(rig: str, mechanism: Mechanism) -> None:
    """Check that the rig of this name has as many legs as a mechanism; the buses of `udp` and `canopen` are laid out for six.

    Raises:
        InputError: it has not.
    """
    if rig in ("udp", "canopen") and mechanism.legs != LEGS:
        raise InputError(f"the rig {rig!r} has six legs, and {mechanism.name} has three: choose another rig")


def python_rig(name: str, mechanism: Mechanism, period: float, rig_at: str | None) -> Rig:
    """A rig of the user's own: its class, called with mechanism, period [s] and `rig_at`.

    Args:
        name: MODULE:CLASS, such as my_rig:MyRig; modules in the present folder are found, too.

    Raises:
        UnknownNameError: there is no such module or class.
        InputError: the module cannot be imported, or what it has is no rig.
    """
    module_name, _, class_name = name.partition(":")
    if not module_name or not class_name.isidentifier():
        raise InputError(f"{name!r} names no rig in Python: give module and class, such as python:my_rig:MyRig")
    try:
        with _present_folder():
            module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise InputError(f"module {module_name} cannot be imported: {error}") from None
        raise UnknownNameError(
            f"there is no module {error.name}: start gough in its folder, put that on PYTHONPATH, or install it"
        ) from None
    except Exception as error:
        raise InputError(f"module {module_name} cannot be imported: {type(error).__name__}: {error}") from None
    made: Any = getattr(module, class_name, None)
    if made is None:
        rigs = [key for key, value in vars(module).items() if isinstance(value, type) and not missing_calls(value)]
        there = f"; there is {', '.join(rigs)}" if rigs else ""
        raise UnknownNameError(f"module {module_name} has no class {class_name}{there}")
    if not isinstance(made, type):
        raise InputError(f"{class_name} of module {module_name} is no class")
    if missing := missing_calls(made):
        raise InputError(f"{class_name} of module {module_name} is no rig: it lacks {', '.join(missing)} (see hil.rigs.Rig)")
    try:
        rig: Any = made(mechanism, period, rig_at)
    except GoughError:
        raise
    except Exception as error:
        raise InputError(
            f"{class_name} of module {module_name} cannot be called with mechanism, period and rig_at: {type(error).__name__}: "
            f"{error}"
        ) from None
    if missing := missing_calls(rig):
        raise InputError(f"{class_name} of module {module_name} is no rig: it lacks {', '.join(missing)} (see hil.rigs.Rig)")
    made_rig: Rig = rig
    return made_rig


@contextmanager
def _present_folder() -> Any:
    """Let modules in the present folder be found."""
    folder = str(Path.cwd())
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        sys.path.remove(folder)
