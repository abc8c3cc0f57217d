"""The executive: a loop on the clock in a process of its own, a recorder in another, and a supervisor that looks on.

    supervisor --fork--> loop       plant or rig, compiled cycle, SCHED_FIFO; writes into shared memory and never waits
               --fork--> recorder   takes the records to an MCAP file

The three share two arrays, `records` and `link` (see `hil.loop.records`). Whoever else dies, the recorder completes its file;
when the recorder dies, another takes over with a file of its own; when the supervisor dies, the loop comes to a controlled
stop.
"""

import contextlib
import errno
import fcntl
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.inverse_kinematics import leg_lengths
from controller.planning.stream import DONE as STREAM_DONE
from controller.planning.stream import STREAM
from controller.planning.stream_planner import StreamPlanner
from controller.safety.arming import describe_obstacle
from controller.safety.causes import Cause, Reaction
from hil.loop.driver import Loop, prevent_compilation, stop_quickly
from hil.loop.records import LINK_SIZE, RECORD, UDP_RIG, Link, StopRequest, shared_array
from hil.loop.timing import Timing, over_budget
from hil.realtime.clock import REAL, new_clock
from hil.realtime.scheduling import RealTimeSettings, real_time, since_process_start, usage
from hil.recording.mcap import events_of, record, repair, take
from hil.recording.replay_rig import ReplayRig
from hil.rigs import Rig
from hil.rigs.by_name import check_legs, python_rig
from hil.rigs.udp.link import DEFAULT_ADDRESS, parse_address
from hil.rigs.udp.rig import UdpRig
from hil.runs.config import PYTHON_RIG, SimulationConfig
from hil.runs.prepare import prepared_loop
from hil.runs.target_stream import HOST, PORT, open_socket, receive
from plant.compiled import Record
from plant.errors import GoughError, InputError
from plant.mechanism import load_in_space, load_spatial
from plant.truth import TRUTH_POSITION

_BUFFER_S = 8.0
_LEAST_RECORDS = 1024
_LOOK_S = 0.1
_PATIENCE_S = 10.0
_LEAST_FREE = 8 * 2**20
_MOST_RECORDERS = 10
_MOST_EVENTS = 100
_BLOCKED = (
    signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU,
)  # fmt: skip
_FORK = multiprocessing.get_context("fork")


class RunStoppedError(GoughError, RuntimeError):
    """A run ended on the brakes before its time; `summary` has what was found until then, if the loop could still say."""

    exit_status = 1

    def __init__(self, message: str, summary: dict[str, Any] | None = None) -> None:
        super().__init__(message)
        self.summary = summary


@dataclass(eq=False)
class Progress:
    """What the supervisor sees of a run, ten times a second.

    Attributes:
        latest: the last record, of dtype `RECORD`; None before the first.
        timing: of all cycles so far.
        squares: sums of the squared errors of the estimated position [m^2] and of the lengths against the reference [m^2], and
            how many cycles they are of.
        missed: periods missed so far.
        refused: what the machine refuses of real time.
        unseen: cycles that were overwritten before they could be looked at, and are in none of these figures.
        events: what has happened, by cycle, and what the supervisor has to tell, such as a recorder that died.
        late: exchanges that brought no answer in time.
        known: cycles of which the truth is known.
        refused_packets: by a rig on a bus.
    """

    latest: Record | None = None
    timing: Timing = field(default_factory=Timing)
    squares: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    missed: int = 0
    refused: list[str] = field(default_factory=list)
    unseen: int = 0
    events: list[str] = field(default_factory=list)
    late: int = 0
    known: int = 0
    refused_packets: int = 0

    def add(self, records: Record) -> None:
        """Take note of records (n,)."""
        if not len(records):
            return
        self.latest = records[-1]
        self.timing.add(records)
        self.missed += int(records["missed"].sum())
        self.late += int((records["silent"] > 0).sum())
        for eventful in records[records["event_count"] > 0]:
            for text in events_of(eventful):
                self._note(int(eventful["cycle"]), text)
        # Before anything is armed there may be cycles without a pose.
        posed = records[records["status"] == 0]
        known = posed[np.isfinite(posed["truth"][:, 0])]
        self.squares[0] += np.sum((known["position"] - known["truth"][:, TRUTH_POSITION]) ** 2)
        errors = posed["lengths"] - posed["reference"][:, :, 0]
        self.squares[1] += (np.sum(errors**2, axis=1) / np.count_nonzero(posed["lengths"], axis=1)).sum()
        self.squares[2] += len(posed)
        self.known += len(known)
        self.refused_packets = int(records["refused"][-1])

    def _note(self, cycle: int, text: str) -> None:
        if len(self.events) < _MOST_EVENTS:
            self.events.append(f"cycle {cycle}: {text}")
        elif len(self.events) == _MOST_EVENTS:
            self.events.append("what happened then is told by the recording only")

    def errors(self) -> dict[str, float]:
        """RMS errors [m]: `estimation` of the position against the truth, in the cycles for which it is `known`; `tracking`
        of a leg's length.
        """
        position, lengths, count = self.squares
        return {
            "estimation": float(np.sqrt(position / max(self.known, 1))),
            "tracking": float(np.sqrt(lengths / max(count, 1))),
            "known": self.known,
        }


def run(
    config: SimulationConfig,
    settings: RealTimeSettings,
    recording: Path | None = None,
    show: Callable[[Progress], None] = lambda progress: None,
    rig: Callable[[Loop], Rig] | None = None,
) -> dict[str, Any]:
    """Run the closed loop on the machine's clock, to the end of its motion or until it is asked to stop.

    SIGINT, SIGTERM and SIGHUP ask for a controlled stop, SIGQUIT for an emergency stop. Must be called from the main
    thread, with no other running.

    Args:
        config: what to run.
        settings: how.
        recording: the MCAP file to write; None for none.
        show: called ten times a second.
        rig: makes a rig in Python, in the loop's process, for a loop in Python; without it, the FMU plant is driven by the
            compiled loop. Threads that it starts must have ended when it returns.

    Returns:
        The summary: `cause` of the stop, `cycles`, missed periods by cause, `timing_us` and what of it is `over_budget`,
        `errors_m`, cycles `unseen` by these three, `usage` of the loop's thread, `start_up_s`, `recording` (files, cycles
        lost), `refused`, `events`, `config`, `version`; of a rig on a bus `identity`, `late` exchanges, `refused_packets` and
        `round_trip_bars`; and of a dry run the `obstacle` to arming, "" if there is none.

    Raises:
        GoughError: something in the configuration or the settings cannot be used; nothing has run then.
        RunStoppedError: the run ended on the brakes before its time, or its process died.
    """
    if config.fusion == "filterpy":
        raise InputError("the filters of filterpy are too slow for the clock: use them with 'gough simulate'")
    records = shared_array(max(_LEAST_RECORDS, round(_BUFFER_S * config.rate)), RECORD)
    link: NDArray[np.int64] = shared_array(LINK_SIZE, np.dtype(np.int64))
    link[Link.SUPERVISOR] = os.getpid()
    progress = Progress()
    ours, theirs = _FORK.Pipe()
    recorders = _Recorders(recording, records, link, ours, progress.events)
    with _asked_to_stop(link), _claimed(recording), _told(progress, recorders), contextlib.ExitStack() as at_end:
        at_end.callback(recorders.finish)
        stream = at_end.enter_context(_receiver(config)) if config.streamed else None
        loop = _FORK.Process(target=_loop_process, args=(theirs, ours, link, config, settings, rig, records, stream))
        loop.start()
        theirs.close()
        leftovers: list[Path | None] = []
        at_end.callback(_end, loop, link, leftovers)
        leftovers.append(_prepared(ours, loop, link, show, progress))
        header, progress.refused = _prepared(ours, loop, link, show, progress)
        recorders.start(header)
        with contextlib.suppress(BrokenPipeError):
            ours.send("go")
        tail, answered = 0, time.monotonic()
        while not ours.poll(_LOOK_S) and loop.is_alive():
            taken, tail, unseen = take(records, link, tail)
            progress.add(taken)
            progress.unseen += unseen
            recorders.watch()
            show(progress)
            if len(taken) or not link[Link.STOP]:
                answered = time.monotonic()
            elif time.monotonic() - answered > _PATIENCE_S:
                progress.events.append(
                    f"the loop has not answered for {_PATIENCE_S:g} s and was killed: the rig brakes by itself"
                )
                loop.kill()
        outcome = _received(ours, loop)
        taken, tail, unseen = take(records, link, tail)
        progress.add(taken)
        progress.unseen += unseen
    summary = _summary(config, progress, outcome, recorders)
    if outcome["stop"] not in (Cause.END_OF_MOTION, Cause.STOP_REQUESTED):
        quickly = Cause(outcome["stop"]).reaction >= Reaction.QUICK_STOP
        how = "stopped on the brakes" if quickly else "stopped before its time"
        raise RunStoppedError(f"{how} at cycle {outcome['cycle']}: {outcome['reason']}", summary)
    return summary


@contextmanager
def _claimed(path: Path | None) -> Iterator[None]:
    """Keep a recording's file for this run, after checking that it can be written."""
    if path is None:
        yield
        return
    if path.exists() and not path.is_file():
        raise InputError(f"{path} is no file: name another for the recording")
    fresh = not path.exists()
    try:
        file = path.open("ab")
    except OSError as error:
        raise InputError(f"cannot record to {path}: {error.strerror}: name another file") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{path} is being recorded to by another run: name another file") from None
        free = shutil.disk_usage(path.resolve().parent).free
        try:
            if free < _LEAST_FREE:
                raise InputError(
                    f"cannot record to {path}: {free / 2**20:.3g} MiB are free there, and {_LEAST_FREE / 2**20:g} MiB are "
                    "needed to begin: make room, or name another file"
                )
            yield
        finally:
            if fresh and not path.stat().st_size:
                path.unlink()


@contextmanager
def _told(progress: Progress, recorders: "_Recorders") -> Iterator[None]:
    """When the loop's process has died, tell with it what else is known of the run."""
    try:
        yield
    except RunStoppedError as error:
        files = [f"recorded in {', '.join(map(str, recorders.files))}"] if recorders.files else []
        raise RunStoppedError("; ".join([str(error), *progress.events, *files])) from None


@contextmanager
def _asked_to_stop(link: NDArray[np.int64]) -> Iterator[None]:
    """Let the signals that would end this process ask for a controlled stop, and SIGQUIT for an emergency stop."""

    def ask(number: int, frame: object) -> None:
        del frame
        link[Link.STOP] = max(int(link[Link.STOP]), StopRequest.QUICK if number == signal.SIGQUIT else StopRequest.CONTROLLED)

    numbers = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM)
    # What is ignored, as nohup has it, stays so.
    before = {each: signal.signal(each, ask) for each in numbers if signal.getsignal(each) != signal.SIG_IGN}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _receiver(config: SimulationConfig) -> Iterator[Record]:
    """A process that receives a streamed target and plans it; gives what it shares with the loop."""
    stream: Record = shared_array(1, STREAM).reshape(())
    host, port = parse_address(config.target.partition(":")[2] or f"{HOST}:{PORT}")
    mechanism = load_spatial(config.mechanism)
    start = mechanism.require_home()
    planner = StreamPlanner(mechanism, leg_lengths(mechanism, start.position, start.rotation))
    with open_socket(host, port) as listener:
        process = _FORK.Process(target=_receiver_process, args=(stream, planner, listener, 1.0 / config.rate))
        process.start()
        try:
            yield stream
        finally:
            stream["shared"][STREAM_DONE] = 1
            process.join(_PATIENCE_S)
            if process.is_alive():
                process.kill()
                process.join()


def _receiver_process(*what: Any) -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED)
    receive(*what)


def _prepared(
    ours: Connection, loop: BaseProcess, link: NDArray[np.int64], show: Callable[[Progress], None], progress: Progress
) -> Any:  # fmt: skip
    """What the loop's process sends while it prepares; nothing moves yet, so it need not be let finish."""
    while not ours.poll(_LOOK_S) and loop.is_alive():
        show(progress)
        if link[Link.STOP]:
            loop.kill()
            raise RunStoppedError("asked to stop before anything has moved")
    return _received(ours, loop)


def _received(ours: Connection, loop: BaseProcess) -> Any:
    """What the loop's process has sent; its error is raised here."""
    try:
        message = ours.recv()
    except (EOFError, ConnectionResetError):
        loop.join(_PATIENCE_S)
        raise RunStoppedError(f"the loop's process has died (exit code {loop.exitcode}); nothing commands the rig") from None
    if isinstance(message, GoughError):
        raise message
    return message


def _end(loop: BaseProcess, link: NDArray[np.int64], leftovers: list[Path | None]) -> None:
    """See the loop's process to its end, whatever has happened here, and remove what a crash has left."""
    link[Link.STOP] = max(int(link[Link.STOP]), StopRequest.CONTROLLED)
    loop.join(_PATIENCE_S)
    if loop.is_alive():
        loop.kill()
        loop.join()
    for folder in leftovers:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _loop_process(pipe: Connection, supervisors: Connection, link: NDArray[np.int64], *what: Any) -> None:
    """The loop's process. Signals that end others, blocked, are seen by the loop itself."""
    signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED)
    # Else the end of the supervisor would not show.
    supervisors.close()
    # Without a supervisor there is nobody to tell.
    with contextlib.suppress(EOFError, BrokenPipeError):
        try:
            _prepare_and_follow(pipe, link, *what)
        except GoughError as error:
            pipe.send(error)
        except Exception as error:
            how = "stopped on the brakes" if link[Link.HEAD] else "nothing has moved"
            pipe.send(RunStoppedError(f"{how}: {type(error).__name__}: {error}"))
            raise


def _prepare_and_follow(
    pipe: Connection,
    link: NDArray[np.int64],
    config: SimulationConfig,
    settings: RealTimeSettings,
    make_rig: Callable[[Loop], Rig] | None,
    records: Record,
    stream: Record | None,
) -> None:
    with prepared_loop(config, records) as loop, contextlib.ExitStack() as rigs:
        pipe.send(None if loop.plant is None else loop.plant.folder)
        loop.link, loop.most_missed, loop.stream = link, settings.most_missed, stream
        loop.clock = new_clock(REAL, round(1e9 / config.rate))
        run_id = f"{time.time_ns():x}-{os.getpid()}"
        header = {
            "config": {**asdict(config), "mechanism_name": loop.mechanism.name, "version": version("gough"), "run": run_id},
            "parameters": loop.parameters,
            "reference": loop.segments,
        }
        rig = make_rig(loop) if make_rig is not None else rig_of(config)
        compiled = rig is None or isinstance(rig, UdpRig)
        loop.load(python=not compiled)
        if rig is not None:
            rigs.callback(rig.close)
            rig.open()
            header["config"]["identity"] = asdict(rig.identify())
            rigs.callback(stop_quickly, rig)
            if config.arm:
                rig.arm()
            loop.parameters["load"]["command_delay"] = rig.command_delay
        if isinstance(rig, UdpRig):
            loop.kind, loop.udp = UDP_RIG, rig.link
        if threading.active_count() > 1:
            names = ", ".join(thread.name for thread in threading.enumerate()[1:])
            raise GoughError(f"the rig has left threads running ({names}), which delay the loop: end them when it is open")
        with prevent_compilation(), real_time(settings) as refused:
            pipe.send((header, refused))
            pipe.recv()
            before = usage()
            cause = loop.follow(loop.end, None if compiled else rig)
            used = usage().since(before)
        pipe.send(
            {
                "stop": cause,
                "identity": header["config"].get("identity"),
                "obstacle": None if config.arm else describe_obstacle(loop.state),
                "reason": ": ".join(filter(None, [loop.reason(), loop.failure or getattr(rig, "failure", "")])),
                "cycle": int(loop.state["safety"]["stop"]["cycle"]),
                "cycles": int(link[Link.HEAD]),
                "missed_late": int(loop.clock["missed_late"]),
                "missed_own": int(loop.clock["missed_own"]),
                "missed_host": int(loop.clock["missed_host"]),
                "usage": used,
                "first_cycle_ns": int(loop.clock["start"]),
            }
        )


def rig_of(config: SimulationConfig) -> Rig | None:
    """The rig that a configuration names; None for the plant's FMU.

    Raises:
        GoughError: it cannot be made, or has another number of legs than the mechanism.
    """
    mechanism = load_in_space(config.mechanism)
    check_legs(config.rig, mechanism)
    if config.rig == "udp":
        return UdpRig(config.rig_at or DEFAULT_ADDRESS, 1.0 / config.rate)
    if config.rig == "canopen":
        # Who does without a CAN bus does without its libraries.
        from hil.rigs.canopen.rig import CanopenRig
        from hil.rigs.canopen.settings import DEFAULT_FILE, canopen_settings

        return CanopenRig(canopen_settings(config.rig_at or DEFAULT_FILE), 1.0 / config.rate)
    if config.rig == "replay":
        if not config.rig_at:
            raise InputError("a replay needs its recording: name it with --rig-at FILE.mcap")
        return ReplayRig(config.rig_at.split(","), 1.0 / config.rate, mechanism)
    if config.rig.startswith(PYTHON_RIG):
        name = config.rig.removeprefix(PYTHON_RIG)
        return python_rig(name, mechanism, 1.0 / config.rate, config.rig_at)
    return None


class _Recorders:
    """The process that records, and its successors if it dies."""

    def __init__(
        self, path: Path | None, records: Record, link: NDArray[np.int64], supervisors: Connection, events: list[str]
    ) -> None:  # fmt: skip
        self.files: list[Path] = []
        self._path, self._records, self._link, self._supervisors, self._events = path, records, link, supervisors, events
        self._header: dict[str, Any] = {}
        self._process: BaseProcess | None = None

    @property
    def lost(self) -> int:
        """Cycles that are in no file."""
        return int(self._link[Link.HEAD] - self._link[Link.KEPT]) if self.files else 0

    def start(self, header: dict[str, Any]) -> None:
        """Start the first recorder."""
        self._header = header
        if self._path is not None:
            self._start(self._path)

    def _start(self, path: Path) -> None:
        self.files.append(path)
        arguments = (path, self._header, self._records, self._link, self._supervisors)
        self._process = _FORK.Process(target=_recorder_process, args=arguments)
        self._process.start()

    def watch(self) -> None:
        """Start a successor, with a file of its own, if the recorder has been killed; one that cannot write has none."""
        if self._path is None or self._process is None or self._process.is_alive():
            return
        if self._process.exitcode != 0:
            self._say_why()
        killed = (self._process.exitcode or 0) < 0
        self._process = None
        if killed and len(self.files) < _MOST_RECORDERS:
            numbers = range(len(self.files) + 1, 10_000)
            path = next(each for n in numbers if not (each := self._path.with_stem(f"{self._path.stem}-{n}")).exists())
            self._events.append(f"another recorder goes on in {path}")
            self._start(path)

    def _say_why(self) -> None:
        code = self._process.exitcode if self._process else 0
        if code is not None and code > 0:
            self._events.append(f"{self.files[-1]} cannot be written: {os.strerror(code)}: the rest is not recorded")
        else:
            self._events.append(f"the recorder died (exit code {code})")

    def finish(self) -> None:
        """Let the recorder write what is left, and complete the files of those that died."""
        self._link[Link.DONE] = 1
        if self._process is not None:
            self._process.join(_PATIENCE_S)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()
            if self._process.exitcode != 0:
                self._say_why()
        for path in self.files:
            try:
                if path.exists():
                    repair(path)
            except (GoughError, OSError) as error:
                self._events.append(f"{path} is incomplete: {error}")


def _recorder_process(
    path: Path, header: dict[str, Any], records: Record, link: NDArray[np.int64], supervisors: Connection
) -> None:  # fmt: skip
    signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED)
    supervisors.close()
    try:
        record(path, header, records, link)
    except OSError as error:
        # The writer would try again when it is collected.
        os._exit(error.errno or errno.EIO)


def _summary(
    config: SimulationConfig, progress: Progress, outcome: dict[str, Any], recorders: _Recorders
) -> dict[str, Any]:  # fmt: skip
    timing = progress.timing.figures()
    first = outcome["first_cycle_ns"] / 1e9 if outcome["first_cycle_ns"] else time.monotonic()
    return {
        "cause": outcome["reason"],
        **{name: outcome[name] for name in ("cycles", "missed_late", "missed_own", "missed_host", "usage")},
        "timing_us": timing,
        "over_budget": over_budget(timing),
        "errors_m": progress.errors(),
        "start_up_s": since_process_start() - (time.monotonic() - first),
        "unseen": progress.unseen,
        "recording": {"files": [str(path) for path in recorders.files], "lost": recorders.lost},
        "refused": progress.refused,
        "late": progress.late,
        "refused_packets": progress.refused_packets,
        "round_trip_bars": progress.timing.histograms["round trip"].bars(),
        "identity": outcome["identity"],
        "obstacle": outcome["obstacle"],
        "events": progress.events,
        "config": asdict(config),
        "version": version("gough"),
    }
