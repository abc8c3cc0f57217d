"""The executive: a loop on the clock in a process of its own, a recorder in another, and a supervisor that watches both.

    supervisor --fork--> loop       plant or rig, compiled cycle, SCHED_FIFO; writes into shared memory and never waits
               --fork--> recorder   takes the records to an MCAP file
               --fork--> channel    tells clients what the records say (`hil.runs.channel_process`)

They share two arrays, `records` and `link`. Whichever other process dies, the recorder completes its file. If it dies
itself, another takes over with a file of its own. If the supervisor dies, the loop comes to a controlled stop.
"""

import contextlib
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.inverse_kinematics import leg_lengths
from controller.planning.pace import least_time_scale
from controller.planning.plan_handover import END_PLANNER, STREAM, fail_stream
from controller.planning.stream_planner import StreamPlanner
from controller.safety.arming import describe_obstacle
from controller.safety.causes import Cause, Reaction
from controller.workspace import PoseGuard
from hil.loop.driver import FmuRig, Loop, prevent_compilation, stop_quickly
from hil.loop.own_stages import Stages, ordered, replacements_of
from hil.loop.records import LINK_SIZE, RECORD, Link, StopRequest, shared_array
from hil.loop.stage_times import over_budget
from hil.progress import Say, say_nothing
from hil.realtime.clock import REAL, new_clock
from hil.realtime.processes import FORK, PATIENCE_S, join_or_kill, signals_handled, started
from hil.realtime.scheduling import RealTimeSettings, processor_left, real_time, since_process_start, usage
from hil.rigs import Rig
from hil.rigs.udp.link import parse_address
from hil.rigs.udp.rig import UdpRig
from hil.runs.channel_process import channel_process
from hil.runs.config import PYTHON_RIG, SimulationConfig
from hil.runs.prepare import PreparedLoop, demands_of, prepared_loop, rig_of
from hil.runs.recorders import Recorders, claimed
from hil.runs.run_state import RunState
from hil.runs.target_stream import HOST, PORT, open_socket, receive
from plant.compiled import Record
from plant.errors import GoughError, InputError
from plant.mechanism import load_spatial

_BUFFER_S = 8.0
_LEAST_RECORDS = 1024
_LOOK_S = 0.1
_MISSED_REMEDY = ": prepare the machine (docs/real_time.md), stop other programs, lower --rate, or raise --most-missed"
_STOPPING = (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)


class RunStoppedError(GoughError, RuntimeError):
    """A run ended early, on the brakes; `summary` has the figures until then, or None if the loop could not send them."""

    exit_status = 1

    def __init__(self, message: str, summary: dict[str, Any] | None = None) -> None:
        super().__init__(message)
        self.summary = summary


def run(
    config: SimulationConfig,
    settings: RealTimeSettings,
    recording: Path | None = None,
    show: Callable[[RunState], None] = lambda state: None,
    rig: Callable[[Loop], Rig] | None = None,
    say: Say = say_nothing,
    stages: Stages | None = None,
) -> dict[str, Any]:
    """Run the closed loop on the machine's clock, to the end of its motion or until it is asked to stop.

    SIGINT, SIGTERM and SIGHUP ask for a controlled stop, unless they are ignored (`ignored_signals`). SIGQUIT always asks for
    an emergency stop. Call it from the main thread, while no other thread runs.

    Args:
        config, settings: what to run, and how.
        recording: the MCAP file to write.
        show: called ten times a second.
        rig: makes a rig in Python, in the loop's process, instead of the configuration's. Its threads must have ended then.
        say: called with each remark before the loop runs.
        stages: functions in place of stages of the cycle. They run in the loop's process, within a period.

    Returns:
        The summary: `cause` of the stop, `cycles`, missed periods by cause and most in a row, `timing_us` and which of it is
        `over_budget`, `target_stretch` (`controller.planning.pace`), `errors_m` and `errors_rad`, the number of cycles `unseen`
        by these, `usage` of the loop's thread, `start_up_s`, `recording` (files, cycles lost), `remarks`, `refused`, `events`,
        `motion_s`, for how long the motion was followed, `stages`, `config`, `version`; of a rig on a bus `identity`, `late`
        exchanges, `refused_packets` and `round_trip_bars`; and of a dry run the `obstacle` to arming, "" if there is none.

    Raises:
        GoughError: something in the configuration or the settings cannot be used; nothing has run.
        RunStoppedError: the run ended early, on the brakes, or its process died.
    """
    if config.fusion == "filterpy":
        raise InputError("the filters of filterpy are too slow for the clock: use them with 'gough simulate'")
    stages = stages or Stages()
    records = shared_array(max(_LEAST_RECORDS, round(_BUFFER_S * config.rate)), RECORD)
    link: NDArray[np.int64] = shared_array(LINK_SIZE, np.dtype(np.int64))
    link[Link.SUPERVISOR] = os.getpid()
    state = RunState(1.0 / config.rate, frames=config.active_frames)
    allowed, kept = os.sched_getaffinity(0), settings.kept_processor
    with _asked_to_stop(link), claimed(recording), processor_left(kept), contextlib.ExitStack() as at_end:
        stream: Record | None = shared_array(1, STREAM).reshape(()) if config.streamed else None
        # Forked before there is a pipe, which they would keep open.
        remarks: list[str] = []
        channel = at_end.enter_context(channel_process(config, records, link, stream, remarks.append, kept))
        planner: BaseProcess | None = None
        if stream is not None:
            planner = channel if config.operated else at_end.enter_context(_receiver(config, stream))
        ours, theirs = FORK.Pipe()
        recorders = Recorders(recording, records, link, ours, state.events)
        at_end.enter_context(_reported(state, recorders))
        at_end.callback(recorders.finish)
        loop = started(_loop_process, allowed, theirs, ours, link, config, settings, rig, records, stream, stages)
        theirs.close()
        leftovers: list[Path | None] = []
        at_end.callback(_end, loop, link, leftovers)
        leftovers.append(_prepared(ours, loop, link, show, state))
        header, state.refused = _prepared(ours, loop, link, show, state)
        for remark in (*remarks, *header["config"]["remarks"]):
            say(remark)
        recorders.start(header)
        with contextlib.suppress(BrokenPipeError):
            ours.send("go")
        # A user's code in the loop may never return.
        in_python = bool(stages.names) or rig is not None or config.rig.startswith(PYTHON_RIG)
        answered = time.monotonic()
        while not ours.poll(_LOOK_S) and loop.is_alive():
            if state.update(records, link) or link[Link.DONE] or not (in_python or link[Link.STOP]):
                answered = time.monotonic()
            elif time.monotonic() - answered > PATIENCE_S:
                state.events.append(f"the loop has not answered for {PATIENCE_S:g} s and was killed: the rig brakes by itself")
                loop.kill()
            recorders.watch()
            if channel is not None and not config.operated and not channel.is_alive():
                state.events.append(f"the channel has died (exit code {channel.exitcode}): nobody can watch this run any more")
                channel = None
            if stream is not None and planner is not None and not planner.is_alive():
                # At rest nothing else would tell that nobody can move the platform any more.
                fail_stream(stream, Cause.TARGET_LOST, -1, np.nan, np.nan)
            show(state)
        cause, cycle, first_cycle_ns, figures = _received(ours, loop)
        state.update(records, link)
    summary = _summary(config, state, first_cycle_ns, figures, recorders)
    if cause not in (Cause.END_OF_MOTION, Cause.STOP_REQUESTED):
        quickly = Cause(cause).reaction >= Reaction.QUICK_STOP
        how = "stopped on the brakes" if quickly else "stopped before its time"
        remedy = _MISSED_REMEDY if cause == Cause.MISSED_PERIODS else ""
        raise RunStoppedError(f"{how} at cycle {cycle}: {summary['cause']}{remedy}", summary)
    return summary


@contextmanager
def _reported(state: RunState, recorders: Recorders) -> Iterator[None]:
    """Add the events and the files of the run to an early end without a summary."""
    try:
        yield
    except RunStoppedError as error:
        files = [f"recorded in {', '.join(map(str, recorders.files))}"] if recorders.files else []
        raise RunStoppedError("; ".join([str(error), *state.events, *files])) from None


def ignored_signals() -> list[str]:
    """The signals that cannot stop a run, because this process has been started to ignore them: as nohup asks for SIGHUP, and
    the shell of a script for SIGINT of what it starts in the background.
    """
    return [each.name for each in _STOPPING if signal.getsignal(each) == signal.SIG_IGN]


@contextmanager
def _asked_to_stop(link: NDArray[np.int64]) -> Iterator[None]:
    def ask(number: int, frame: object) -> None:
        del frame
        link[Link.STOP] = max(int(link[Link.STOP]), StopRequest.QUICK if number == signal.SIGQUIT else StopRequest.CONTROLLED)

    # What is to be ignored stays ignored, but an emergency stop is always heard.
    heard = (signal.SIGQUIT, *(each for each in _STOPPING if each.name not in ignored_signals()))
    with signals_handled(heard, ask):
        yield


@contextmanager
def _receiver(config: SimulationConfig, stream: Record) -> Iterator[BaseProcess]:
    """The process that receives a streamed target while the context lasts, and plans in the memory that the loop shares."""
    mechanism = load_spatial(config.mechanism)
    host, port = parse_address(config.target.partition(":")[2] or f"{HOST}:{PORT}")
    start = mechanism.require_home()
    lengths = leg_lengths(mechanism, start.position, start.rotation)
    guard = PoseGuard(mechanism, demands_of(config, mechanism))
    planner = StreamPlanner(mechanism, lengths, config.active_frames, guard)
    with open_socket(host, port) as listener:
        process = started(receive, stream, planner, listener, 1.0 / config.rate)
        try:
            yield process
        finally:
            stream["shared"][END_PLANNER] = 1
            join_or_kill(process)


def _prepared(
    ours: Connection, loop: BaseProcess, link: NDArray[np.int64], show: Callable[[RunState], None], state: RunState
) -> Any:  # fmt: skip
    """What the loop's process sends while it prepares. Nothing moves yet, so a stop kills it."""
    while not ours.poll(_LOOK_S) and loop.is_alive():
        show(state)
        if link[Link.STOP]:
            loop.kill()
            raise RunStoppedError("asked to stop before anything has moved")
    return _received(ours, loop)


def _received(ours: Connection, loop: BaseProcess) -> Any:
    try:
        message = ours.recv()
    except (EOFError, ConnectionResetError):
        loop.join(PATIENCE_S)
        raise RunStoppedError(f"the loop's process has died (exit code {loop.exitcode}); nothing commands the rig") from None
    if isinstance(message, GoughError):
        raise message
    return message


def _end(loop: BaseProcess, link: NDArray[np.int64], leftovers: list[Path | None]) -> None:
    """End the loop's process, and remove the folders that a crash has left."""
    link[Link.STOP] = max(int(link[Link.STOP]), StopRequest.CONTROLLED)
    join_or_kill(loop)
    for folder in filter(None, leftovers):
        shutil.rmtree(folder, ignore_errors=True)


def _loop_process(
    allowed: set[int], pipe: Connection, supervisors: Connection, link: NDArray[np.int64], *what: Any
) -> None:  # fmt: skip
    os.sched_setaffinity(0, allowed)
    # With this end open here, the loop would not see the supervisor's death.
    supervisors.close()
    # Without a supervisor, nobody reads the pipe.
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
    stages: Stages,
) -> None:
    with prepared_loop(config, records) as loop, contextlib.ExitStack() as rigs:
        pipe.send(None if loop.plant is None else loop.plant.folder)
        loop.link, loop.most_missed, loop.stream = link, settings.most_missed, stream
        loop.clock = new_clock(REAL, round(1e9 / config.rate))
        run_id = f"{time.time_ns():x}-{os.getpid()}"
        header = {
            "config": {
                **asdict(config),
                "mechanism_name": loop.mechanism.name,
                "version": version("gough"),
                "run": run_id,
                "remarks": list(loop.remarks),
                "stages": stages.names,
            },
            "parameters": loop.parameters,
            "reference": loop.segments,
        }
        if loop.frames is not None:
            # Their file may change later.
            header["config"]["frame_definitions"] = loop.frames.frames.text()
        rig = make_rig(loop) if make_rig is not None else rig_of(config)
        if rig is None and stages.names:
            rig = FmuRig(loop)
        compiled = (rig is None or isinstance(rig, UdpRig)) and not stages.names
        replacements = ordered(replacements_of(stages, loop.cycle, loop.parameters, loop.state))
        if isinstance(rig, UdpRig):
            loop.udp = rig.link
        loop.load(python=not compiled)
        if rig is not None:
            rigs.callback(rig.close)
            rig.open()
            header["config"]["identity"] = asdict(rig.identify())
            rigs.callback(stop_quickly, rig)
            if config.arm:
                rig.arm()
            loop.parameters["load"]["command_delay"] = rig.command_delay
        if threading.active_count() > 1:
            names = ", ".join(thread.name for thread in threading.enumerate()[1:])
            raise GoughError(f"the rig has left threads running ({names}), which delay the loop: end them when it is open")
        with prevent_compilation(), real_time(settings) as refused:
            pipe.send((header, refused))
            pipe.recv()
            before = usage()
            cause = loop.follow(loop.end, None if compiled else rig, replacements)
            used = usage().since(before)
        figures = {
            "cause": ": ".join(filter(None, [loop.reason(), loop.failure or getattr(rig, "failure", "")])),
            "cycles": int(link[Link.HEAD]),
            **{name: int(loop.clock[name]) for name in ("missed_late", "missed_own", "missed_host")},
            "missed_in_a_row": int(loop.clock["most_in_a_row"]),
            "remarks": list(loop.remarks),
            "stages": stages.names,
            "motion_s": _seconds_of_motion(loop, config.duration),
            "usage": used,
            "identity": header["config"].get("identity"),
            "target_stretch": 1.0 if config.streamed else least_time_scale(loop.mechanism, loop.target, 1.0),
            "obstacle": None if config.arm else describe_obstacle(loop.state),
        }
        pipe.send((cause, int(loop.state["safety"]["stop"]["cycle"]), int(loop.clock["start"]), figures))


def _seconds_of_motion(loop: PreparedLoop, duration: float) -> float:
    """For how long a run that has ended followed its motion [s]."""
    stop = loop.state["safety"]["stop"]
    seconds = (int(stop["cycle"]) - loop.cycle_at(0.0)) * float(loop.parameters["rig"]["period"])
    return min(max(seconds, 0.0), duration)


def _summary(
    config: SimulationConfig, state: RunState, first_cycle_ns: int, figures: dict[str, Any], recorders: Recorders
) -> dict[str, Any]:
    timing = state.timing.figures()
    first = first_cycle_ns / 1e9 if first_cycle_ns else time.monotonic()
    return {
        **figures,
        "timing_us": timing,
        "over_budget": over_budget(timing, config.fusion),
        "errors_m": state.errors(),
        "errors_rad": state.rotation_errors(),
        **({} if state.frames is None else {"frames": state.frames.described()}),
        "protection": state.level(),
        "start_up_s": since_process_start() - (time.monotonic() - first),
        **{name: getattr(state, name) for name in ("unseen", "refused", "late", "refused_packets", "events")},
        "recording": {"files": [str(path) for path in recorders.files], "lost": recorders.lost},
        "round_trip_bars": state.timing.histograms["round trip"].bars(),
        "config": asdict(config),
        "version": version("gough"),
    }
