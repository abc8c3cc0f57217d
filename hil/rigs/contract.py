"""The contract of a rig: what the loop relies on, clause by clause, checked on any rig from outside.

By default the drives are only asked to hold on their brakes. With `moving` they are enabled, all legs extend and retract at
1 mm/s for 0.2 s each, and the drives are stopped; the rig must have room for that.
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hil.realtime.durations import percentiles
from hil.rigs import ANSWERED, FEEDBACK, SILENT, DriveState, Identity, Request, Rig, RigError, missing_members, new_feedback
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.errors import GoughError
from plant.mechanism import LEGS
from plant.pose import Array
from plant.truth import TRUTH_LENGTHS

MakeRig = Callable[[], Rig]

FOLLOWED_WITHIN = 20
"""Exchanges within which the drives must do what is requested."""

SENT_WITHIN = 2
"""Exchanges within which the feedback must report a command as sent."""

SPEED, STROKE_S = 1e-3, 0.2
"""Speed of the moving legs [m/s], and duration of the motion each way [s]."""

_ROUNDING = 1e-5
_STANDSTILL_S = 0.5
_MOST_SILENT = 0.1
_STALE_S = 0.01
_REST_FORCE, _REST_RATE = (5.0, 15.0), 0.5
_CLOSED_WITHIN_S = 1.0
_REQUESTS = ("to hold on their brakes", "to follow", "to stop quickly")
_DRIVES = tuple(state.name.lower().replace("_", " ") for state in DriveState)
_GUARD, _GUARD_BYTES = 0xA5, 64

CLAUSES = {
    "interface": "it has all methods, and its command_delay",
    "stops at any time": "quick_stop and close raise nothing: before open, twice, and after close",
    "opens": "it can be opened, or says in a RigError why not",
    "identifies": "identify returns its identity",
    "arms": "arm makes the drives ready and requests nothing else of them",
    "threads": "no thread runs beside the exchanges, and none is left",
    "exchanges": "exchange raises nothing and gives answers",
    "feedback": "the feedback keeps its layout, and every required value is there",
    "order in time": "sample numbers, sample times and the count of refused packets never go back",
    "sample age": "new samples arrive in time",
    "drives": f"the drives do what is requested within {FOLLOWED_WITHIN} exchanges",
    "sent": "what was sent is what was commanded, within limits",
    "motion": "the legs move as commanded, where the truth is known",
    "period": "an exchange returns within the period (p99)",
    "opens again": "after close it can be opened again",
    "absent": "a rig that is not there raises a RigError with a message",
}


@dataclass
class Examination:
    """The result of an examination."""

    findings: dict[str, list[str]] = field(default_factory=dict)  # by clause, of the clauses that were checked
    exchange_us: dict[str, float] = field(default_factory=dict)  # durations p50, p99 and max [us], and their number n
    identity: Identity | None = None

    def all_findings(self) -> list[str]:
        """The findings of all clauses."""
        return [text for each in self.findings.values() for text in each]


def check_rig(
    make_rig: MakeRig, period: float, moving: bool = True, beyond: float | None = None, absent: MakeRig | None = None
) -> list[str]:
    """Check a rig against the contract; returns the findings, one sentence each (see `examine_rig`)."""
    return examine_rig(make_rig, period, moving, beyond, absent).all_findings()


def examine_rig(
    make_rig: MakeRig, period: float, moving: bool = True, beyond: float | None = None, absent: MakeRig | None = None
) -> Examination:
    """Check a rig against the contract.

    Args:
        make_rig: makes a new rig at each call.
        period: of the exchanges [s].
        moving: whether the drives may be enabled and move by 0.2 mm.
        beyond: a command beyond the limits [m/s] that is tried for one exchange, with `moving` only: for emulated rigs, never
            for hardware.
        absent: makes a rig of the same kind that is not there.
    """
    return _Examiner(make_rig, period, moving, beyond, absent).examine()


class _BrokenOffError(Exception):
    """The examination cannot go on; the reason is among the findings."""


class _Examiner:
    """One examination: it calls the rig clause by clause, and notes what it finds. The arguments are those of `examine_rig`."""

    def __init__(self, make_rig: MakeRig, period: float, moving: bool, beyond: float | None, absent: MakeRig | None) -> None:
        self._make, self._period, self._moving, self._beyond, self._absent = make_rig, period, moving, beyond, absent
        self._result = Examination()
        self._noted: set[tuple[str, str]] = set()
        self._rig: Rig = make_rig()
        self._memory = np.full(FEEDBACK.itemsize + 2 * _GUARD_BYTES, _GUARD, np.uint8)
        inner = self._memory[_GUARD_BYTES:-_GUARD_BYTES].view(FEEDBACK)
        inner[0] = new_feedback()
        self._feedback: Record = inner[0]
        self._before: Record = new_feedback()
        self._durations: list[int] = []
        self._due = 0.0
        self._silent = 0
        self._commands: list[Array] = []
        self._age, self._stateless = np.zeros(IMU_COUNT, np.int64), np.zeros(LEGS, bool)

    def examine(self) -> Examination:
        """Check all clauses in order. In the end the drives are stopped and the rig is closed, whatever has happened."""
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
                self._request(Request.QUICK_STOP, np.zeros(LEGS), (DriveState.QUICK_STOPPING, DriveState.READY))
                self._request(Request.BRAKED, np.zeros(LEGS), (DriveState.READY,))
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

    # ------------------------------------------------------------------------------------------------------- findings

    def _begin(self, *clauses: str) -> None:
        for clause in clauses:
            self._result.findings.setdefault(clause, [])

    def _find(self, clause: str, text: str, kind: str = "") -> None:
        """Note a finding; of each kind only the first is kept."""
        self._begin(clause)
        if (clause, kind or text) not in self._noted:
            self._noted.add((clause, kind or text))
            self._result.findings[clause].append(text)

    def _expect(self, held: object, clause: str, text: str, kind: str = "") -> None:
        """Note a finding unless something held."""
        self._begin(clause)
        if not held:
            self._find(clause, text, kind)

    def _require(self, held: object, clause: str, text: str) -> None:
        """Note a finding and break off unless something held."""
        self._expect(held, clause, text)
        if not held:
            raise _BrokenOffError

    def _call(self, name: str, clause: str, when: str = "") -> Any:
        """Call a method of the rig. Any error is a finding, and ends the examination unless the method stops the rig."""
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

    # -------------------------------------------------------------------------------------------- before the exchanges

    def _check_interface(self) -> None:
        missing = missing_members(self._rig)
        self._require(not missing, "interface", f"It lacks {', '.join(missing)}.")
        delay = self._rig.command_delay
        plausible = isinstance(delay, int | float) and 0.0 <= delay <= 10.0 * self._period
        self._expect(plausible, "interface", f"Its command_delay is {delay!r}; it must be 0 to 10 periods [s], one on a bus.")

    def _identify(self) -> None:
        identity = self._call("identify", "identifies")
        named = isinstance(identity, Identity) and identity.name
        self._require(named, "identifies", f"identify returned {identity!r}; it must return an Identity with a name.")
        self._result.identity = identity
        texts = all(isinstance(each, str) for pair in identity.parts.items() for each in pair)
        self._expect(texts, "identifies", "The identity's parts must be texts by name, for they are recorded.")

    def _check_threads(self, before: set[threading.Thread], when: str, patience: float = 0.0) -> None:
        deadline = time.monotonic() + patience
        while (more := [each for each in threading.enumerate() if each not in before]) and time.monotonic() < deadline:
            time.sleep(0.01)
        names = ", ".join(each.name for each in more)
        self._expect(not more, "threads", f"Threads {when} ({names}); they delay the loop: end them.")

    # --------------------------------------------------------------------------------------------------- rest and motion

    def _check_at_rest(self) -> None:
        zero = np.zeros(LEGS)
        self._restart()
        count = max(FOLLOWED_WITHIN, round(_STANDSTILL_S / self._period))
        for i in range(count):
            self._exchange(zero, Request.BRAKED)
            if i == 0:
                self._stateless = self._feedback["drive"] == DriveState.FOLLOWING
            if self._moving and i >= FOLLOWED_WITHIN and not self._are((DriveState.READY,)):
                self._find_wrong_drives(Request.BRAKED, i + 1)
        self._check_contents()
        heard = self._silent <= _MOST_SILENT * count
        self._expect(heard, "exchanges", f"{self._silent} of {count} exchanges on the brakes brought no answer.")

    def _check_moving(self) -> None:
        zero, up = np.zeros(LEGS), np.full(LEGS, SPEED)
        count = max(3, round(STROKE_S / self._period))
        self._request(Request.ENABLED, zero, (DriveState.FOLLOWING,))
        lengths = [self._feedback["truth"][TRUTH_LENGTHS].copy()]
        for command in (up, -up):
            for _ in range(count):
                self._exchange(command, Request.ENABLED)
            lengths.append(self._feedback["truth"][TRUTH_LENGTHS].copy())
        self._check_motion(lengths, count)
        if self._beyond is not None:
            self._check_limit(self._beyond)
            self._exchange(np.full(LEGS, np.nan), Request.ENABLED)
        self._request(Request.QUICK_STOP, zero, (DriveState.QUICK_STOPPING, DriveState.READY))
        self._request(Request.BRAKED, zero, (DriveState.READY,))
        self._request(Request.ENABLED, zero, (DriveState.FOLLOWING,))
        self._exchange(up, Request.ENABLED)

    def _check_motion(self, lengths: list[Array], count: int) -> None:
        """Check the lengths at the motion's start, turn and end. The mean of both ways cancels a drive's sag under load."""
        start, turn, end = lengths
        moved = 0.5 * ((turn - start) - (end - turn))
        if not np.isfinite(moved).all():
            return
        self._begin("motion")
        due = count * self._period * SPEED
        for leg in np.flatnonzero(abs(moved - due) > 0.5 * due).tolist():
            text = f"Leg {leg} moved by {1e3 * moved[leg]:.3f} mm, commanded were {1e3 * due:.3f} mm: check its sign and scale."
            self._find("motion", text)

    def _check_limit(self, beyond: float) -> None:
        most = 0.0
        for command in (beyond, *[0.0] * SENT_WITHIN):
            self._exchange(np.full(LEGS, command), Request.ENABLED)
            most = max(most, float(abs(self._feedback["sent"]).max()))
        self._expect(most < abs(beyond), "sent", f"A command of {beyond:g} m/s was sent as it is: limit it.")

    def _request(self, request: int, command: Array, states: tuple[int, ...]) -> None:
        """Request something of the drives, for as many exchanges as they may take to do it."""
        self._begin("drives")
        for _ in range(FOLLOWED_WITHIN):
            self._exchange(command, request)
        if not self._are(states):
            self._find_wrong_drives(request, FOLLOWED_WITHIN)

    def _are(self, states: tuple[int, ...]) -> bool:
        """Whether the drives are in one of these states; a drive without states of its own always follows."""
        return bool((np.isin(self._feedback["drive"], states) | self._stateless).all())

    def _find_wrong_drives(self, request: int, count: int) -> None:
        drives = self._feedback["drive"]
        states = ", ".join(_DRIVES[state] if 0 <= state < len(_DRIVES) else str(state) for state in drives)
        codes = ", ".join(f"{int(code):#x}" for code in self._feedback["drive_code"])
        text = f"Asked {_REQUESTS[request]}, the drives are {states} after {count} exchanges (fault codes {codes})."
        self._find("drives", text, str(request))
        if (drives == DriveState.FAULTY).any():
            raise _BrokenOffError

    # ------------------------------------------------------------------------------------------------------ exchanges

    def _restart(self) -> None:
        """Let the next exchange be due one period from now."""
        self._due = time.monotonic() + self._period

    def _exchange(self, command: Array, request: int) -> None:
        """Run an exchange when it is due, and check what each exchange must keep."""
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
            self._find("exchanges", f"exchange raised {type(error).__name__}: {error}; it must report a failure by its status.")
            raise _BrokenOffError from None
        self._durations.append(time.perf_counter_ns() - began)
        sound = isinstance(status, int | np.integer) and not isinstance(status, bool) and status >= 0
        text = f"exchange returned {status!r}; it must return ANSWERED, SILENT, or a failure above."
        self._require(sound, "exchanges", text)
        self._silent += status == SILENT
        failure = getattr(self._rig, "failure", "")
        text = f"Exchange {len(self._durations)} failed with status {status}{f': {failure}' if failure else ''}."
        self._require(status <= SILENT, "exchanges", text)
        kept = np.array_equal(given, command, equal_nan=True)
        self._expect(kept, "exchanges", "exchange changed the commands; they belong to the loop.")
        self._commands = [*self._commands[-SENT_WITHIN:], command if request == Request.ENABLED else np.zeros(LEGS)]
        self._check_layout()
        self._check_order()
        if status == ANSWERED:
            self._check_sent()

    def _check_layout(self) -> None:
        self._require(self._feedback.dtype == FEEDBACK, "feedback", "exchange changed the feedback's dtype.")
        guards = np.append(self._memory[:_GUARD_BYTES], self._memory[-_GUARD_BYTES:])
        self._require((guards == _GUARD).all(), "feedback", "exchange wrote beyond the feedback into other memory.")

    def _check_order(self) -> None:
        now, before, nth = self._feedback, self._before, len(self._durations)
        for name, what in (("sequence", "number"), ("sample_ns", "time")):
            for imu in np.flatnonzero(now[name] < before[name]).tolist():
                values = f"{before[name][imu]}, {now[name][imu]}"
                self._find("order in time", f"The {what} of IMU {imu}'s samples went back in exchange {nth}: {values}.", name)
        fresh = now["sequence"] != before["sequence"]
        for imu in np.flatnonzero(fresh & (now["sample_ns"] == before["sample_ns"]) & (before["sequence"] >= 0)).tolist():
            self._find(
                "order in time", f"IMU {imu} has a new sample with the time of the last, in exchange {nth}.", "same time"
            )
        text = f"The count of refused packets went back in exchange {nth}."
        self._expect(now["refused"] >= before["refused"], "order in time", text, "refused")
        self._age = np.where(fresh, 0, self._age + 1)
        most = max(3, round(_STALE_S / self._period))
        for imu in np.flatnonzero((self._age > most) & self._present()).tolist():
            text = f"IMU {imu} has no new sample in {most + 1} exchanges: the loop would leave it out."
            self._find("sample age", text, f"{imu}")

    def _present(self) -> Any:
        """Which IMUs have given readings."""
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
            command, reported = recent[-1][drive], f"{sent[drive]:g} m/s is reported as sent, after {len(recent)} exchanges."
            same = abs(sent[drive] - command) <= _ROUNDING
            self._expect(same, "sent", f"Drive {drive} was commanded {command:g} m/s, and {reported}", f"{command}")

    def _check_contents(self) -> None:
        """Check the feedback's values after a while at rest."""
        feedback = self._feedback
        measurement, present = feedback["measurement"], self._present()
        self._expect(present.any(), "feedback", "No IMU has given readings: the measurement is NaN.")
        for imu in np.flatnonzero(present).tolist():
            if not np.isfinite(measurement[:2, imu]).all():
                self._find("feedback", f"IMU {imu} gives some axes that are not finite; NaN is for an IMU that is not there.")
                continue
            rate, force = (float(np.linalg.norm(measurement[kind, imu])) for kind in range(2))
            text = f"IMU {imu} reads {force:.3g} m/s^2 at rest instead of gravity: check its unit."
            self._expect(_REST_FORCE[0] <= force <= _REST_FORCE[1], "feedback", text)
            self._expect(rate <= _REST_RATE, "feedback", f"IMU {imu} reads {rate:.3g} rad/s at rest: check its unit.")
            text = f"The magnetic field of IMU {imu} must be finite, or NaN on all axes."
            self._expect(_is_whole(measurement[2, imu]), "feedback", text)
            text = f"IMU {imu} has readings, but its samples have no number."
            self._expect(feedback["sequence"][imu] >= 0, "feedback", text)
        states = feedback["drive"].tolist()
        text = f"The drives' states are {states}; they must be 0 to {len(_DRIVES) - 1}."
        self._expect(np.isin(states, range(len(_DRIVES))).all(), "feedback", text)
        self._expect(feedback["round_trip_ns"] >= 0, "feedback", f"The round trip is {feedback['round_trip_ns']} ns.")
        text = "The truth must have position, quaternion and lengths, or be NaN where it is not known."
        self._expect(_is_whole(feedback["truth"][:13]), "feedback", text)

    # ------------------------------------------------------------------------------------------------------------ end

    def _stop(self) -> None:
        """Call quick stop and close, each twice and in any order."""
        if missing_members(self._rig):
            return
        for name, when in (("quick_stop", ""), ("close", ""), ("close", "a second time "), ("quick_stop", "after close ")):
            self._call(name, "stops at any time", when)

    def _sum_up(self) -> None:
        if not self._durations:
            return
        durations = percentiles(np.array(self._durations), ("p50", "p99", "max", "n"))
        self._result.exchange_us, p99 = durations, durations["p99"]
        took = f"{p99 / 1e3:.3g} ms (p99 of {durations['n']})"
        text = f"An exchange takes {took}, longer than the period of {1e3 * self._period:g} ms."
        self._expect(p99 <= 1e6 * self._period, "period", text)

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
            self._expect(str(error), "absent", "A rig that is not there raises a RigError without a message.")
        except Exception as error:
            self._find("absent", f"A rig that is not there raises {type(error).__name__}: {error}; it must raise a RigError.")
        else:
            self._find("absent", "A rig that is not there is opened and identified as if it were.")
        finally:
            with suppress(Exception):
                rig.close()


def _is_whole(values: Array) -> bool:
    """Whether all values are finite, or all are NaN."""
    return bool(np.isfinite(values).all() or np.isnan(values).all())
