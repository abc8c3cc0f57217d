"""The contract of a rig: what the loop relies on, clause by clause, checked on any rig from outside.

By default the drives are only asked to hold on their brakes. With `moving` they are enabled, all legs extend and retract at
1 mm/s for 0.2 s each, and the drives are stopped. With a mechanism, one leg after the other also extends by 2 mm at 5 mm/s, and
signs and units are compared (`hil.rigs.comparison`). The rig must have room for that.
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from hil.realtime.durations import percentiles
from hil.rigs import ANSWERED, FEEDBACK, SILENT, DriveState, Identity, Request, Rig, RigError, missing_members, new_feedback
from hil.rigs.clauses import FOLLOWED_WITHIN, Examination
from hil.rigs.comparison import SmallMotions
from hil.rigs.contents import missing_contents
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.errors import GoughError
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array
from plant.truth import TRUTH_LENGTHS

MakeRig = Callable[[], Rig]

SENT_WITHIN = 2
"""Exchanges within which the feedback must report a command as sent."""

SPEED, STROKE_S = 1e-3, 0.2
"""Speed of the moving legs [m/s], and duration of the motion each way [s]."""

LEG_SPEED, LEG_STROKE_S = 5e-3, 0.4
"""The same of a single leg, whose motion is compared with what the IMUs read."""

_SETTLED_S, _AVERAGED_S = 0.15, 0.3
"""Time after a motion for the rig to come to rest, and over which the rest is averaged [s]."""

_ROUNDING = 1e-5
_STANDSTILL_S = 0.5
_MOST_SILENT = 0.1
_STALE_S = 0.01
_CLOSED_WITHIN_S = 1.0
_LONG_PAUSE_S = 0.02
"""Drives may have stopped by themselves if nothing was exchanged for this time or longer [s]."""
_REQUESTS = ("to hold on their brakes", "to follow", "to stop quickly")
_DRIVES = tuple(state.name.lower().replace("_", " ") for state in DriveState)
_GUARD, _GUARD_BYTES = 0xA5, 64


def check_rig(
    make_rig: MakeRig, period: float, moving: bool = True, beyond: float | None = None, absent: MakeRig | None = None,
    mechanism: Mechanism | None = None,
) -> list[str]:  # fmt: skip
    """Check a rig against the contract; returns the findings, one sentence each (see `examine_rig`)."""
    return examine_rig(make_rig, period, moving, beyond, absent, mechanism).all_findings()


def examine_rig(
    make_rig: MakeRig, period: float, moving: bool = True, beyond: float | None = None, absent: MakeRig | None = None,
    mechanism: Mechanism | None = None,
) -> Examination:  # fmt: skip
    """Check a rig against the contract.

    Args:
        make_rig: makes a new rig at each call.
        period: of the exchanges [s].
        moving: whether the drives may be enabled and move by 0.2 mm.
        beyond: a command beyond the limits [m/s] that is tried for one exchange, with `moving` only: for emulated rigs, never
            for hardware.
        absent: makes a rig of the same kind that is not there.
        mechanism: what the rig drives, near its home; with `moving`, signs and units are compared with it.
    """
    return _Examiner(make_rig, period, moving, beyond, absent, mechanism).examine()


class _BrokenOffError(Exception):
    """The examination cannot go on; the reason is among the findings."""


class _Examiner:
    """One examination: it calls the rig clause by clause, and notes what it finds. The arguments are those of `examine_rig`."""

    def __init__(
        self, make_rig: MakeRig, period: float, moving: bool, beyond: float | None, absent: MakeRig | None,
        mechanism: Mechanism | None,
    ) -> None:  # fmt: skip
        self._make, self._period, self._moving, self._beyond, self._absent = make_rig, period, moving, beyond, absent
        self._motions = SmallMotions(mechanism) if moving and mechanism is not None and mechanism.legs == LEGS else None
        self._result = Examination()
        self._noted: set[tuple[str, str]] = set()
        self._rig: Rig = make_rig()
        self._memory = np.full(FEEDBACK.itemsize + 2 * _GUARD_BYTES, _GUARD, np.uint8)
        inner = self._memory[_GUARD_BYTES:-_GUARD_BYTES].view(FEEDBACK)
        inner[0] = new_feedback()
        self._feedback: Record = inner[0]
        self._before: Record = new_feedback()
        self._durations: list[int] = []
        self._due, self._exchanged, self._longest_pause = 0.0, np.inf, 0.0
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
        self._rest()
        lengths = [self._feedback["truth"][TRUTH_LENGTHS].copy()]
        for command in (up, -up):
            self._move(command, count)
            lengths.append(self._feedback["truth"][TRUTH_LENGTHS].copy())
        self._check_motion(lengths, count)
        self._compare()
        if self._beyond is not None:
            self._check_limit(self._beyond)
            self._exchange(np.full(LEGS, np.nan), Request.ENABLED)
        self._request(Request.QUICK_STOP, zero, (DriveState.QUICK_STOPPING, DriveState.READY))
        self._request(Request.BRAKED, zero, (DriveState.READY,))
        self._request(Request.ENABLED, zero, (DriveState.FOLLOWING,))
        self._exchange(up, Request.ENABLED)

    def _compare(self) -> None:
        """Move one leg after the other, and all of them back, and compare what the IMUs read with it."""
        if self._motions is None:
            return
        count, single = max(3, round(LEG_STROKE_S / self._period)), LEG_SPEED * np.eye(LEGS)
        self._rest()
        for command in (*single, -single.sum(axis=0)):
            self._move(command, count)
            self._rest()
        self._tell_motions()

    def _tell_motions(self) -> None:
        self._begin("gravity", "commands", "gyroscopes", "accelerometers", "encoders")
        for clause, text in self._motions.findings() if self._motions is not None else ():
            self._find(clause, text)
        self._find_pause("commands")

    def _move(self, command: Array, count: int) -> None:
        """Move with a command for some exchanges, unless the IMUs show a motion that it should not make."""
        for _ in range(count):
            self._exchange(command, Request.ENABLED)
            alarm = self._motions.add_motion(command, self._period, self._feedback) if self._motions is not None else ""
            if alarm:
                self._rest(Request.QUICK_STOP)
                self._tell_motions()
                self._find("commands", alarm)
                self._find_pause("commands")
                raise _BrokenOffError

    def _rest(self, request: int = Request.ENABLED) -> None:
        """Let the rig come to rest after a motion, and average what the IMUs read then, if they are compared."""
        if self._motions is None:
            return
        zero = np.zeros(LEGS)
        for _ in range(round(_SETTLED_S / self._period)):
            self._exchange(zero, request)
            if self._motions.begun:
                self._motions.add_motion(zero, self._period, self._feedback)
        for _ in range(max(2, round(_AVERAGED_S / self._period))):
            self._exchange(zero, request)
            self._motions.add_rest(self._feedback)

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
        self._find_pause("motion")

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
            self._find_pause("drives")
            raise _BrokenOffError

    def _find_pause(self, clause: str) -> None:
        """Note that this machine was busy elsewhere, if it was, as that may explain the findings of a clause."""
        if self._result.findings[clause] and self._longest_pause > max(_LONG_PAUSE_S, 2.0 * self._period):
            self._find(
                clause,
                f"That may be because this machine was busy elsewhere, for up to {1e3 * self._longest_pause:.0f} ms between "
                "two exchanges: drives go on meanwhile, or stop by their watchdog. End what else runs on it, and try again.",
                "pause",
            )

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
        now, began = time.monotonic(), time.perf_counter_ns()
        self._longest_pause, self._exchanged = max(self._longest_pause, now - self._exchanged), now
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
        self._begin("feedback")
        for text in missing_contents(self._feedback, self._present()):
            self._find("feedback", text)

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
