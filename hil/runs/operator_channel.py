"""The server of a run's channel, which runs in a process of its own beside the loop's (`operator_messages`).

    client --TCP--> channel   tells what the loop's records say, and never waits for the loop
                              checks an operator's requests, plans, and writes the plans into shared memory
                    loop      takes them as they come, as those of a streamed target

Observers may watch, and end the run; one operator at a time gives all other orders. A run whose target is known beforehand
cannot be moved.
"""

import asyncio
import hmac
import os
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.frames import Move
from controller.planning.motions.document import place_of
from controller.planning.motions.elements import Place, ToolLimits
from controller.planning.motions.waves import checked_number
from controller.planning.points import HOME
from controller.safety.causes import Cause
from hil.loop.records import Link, StopRequest
from hil.realtime.scheduling import before_others
from hil.recording.mcap import take
from hil.runs.channel_process import MOST_CLIENTS
from hil.runs.operated_platform import DEADMAN_S, SPEED, TURN_SPEED, OperatedPlatform, RefusedError, Workplace
from hil.runs.operator_messages import MOST_LINE, RUN_ENDED, VERSION, decode, encode, pose_message
from hil.runs.run_state import told_in
from hil.runs.telemetry import (
    estimated_pose,
    frames_message,
    machine_message,
    margins_message,
    reference_pose,
    state_message,
    timing_message,
)
from plant.checks import printable
from plant.compiled import Record
from plant.errors import GoughError, InputError, PlanningError
from plant.pose import checked_array

TELEMETRY_HZ = 30.0

_STEP_S, _LOOK_S, _IDLE_S = 0.003, 0.01, 0.2
"""How often an operated platform goes on, the records are read for clients, and the end of a run is noticed that has none."""

_MARGINS_S = 0.1
"""Margins are not found anew for so long, however often they are asked for."""

_TIMING_S, _TIMED_S = 1.0, 0.2
"""Of how many seconds the timing is told, and how long a timing is told on: it reads as many records of the loop's memory."""

_FAREWELL_S = 1.0
"""How long clients may take to read what the run has said last."""

_HELLO_S = 5.0
"""How long a client may take to say who it is."""

_MOST_WAITING = 1 << 18
"""Bytes that wait for a client that reads too slowly; it gets no telemetry meanwhile."""

_MOST_WORDS = 1000
"""Characters of an error, which may repeat what a client has sent."""

_RESTING = {"time": 0.0, "moving": False, "jogging": False, "paused": False, "mode": "preparing"}

_FOR_ALL = ("state", "margins", "watch", "end", "emergency")
"""What an observer may ask for: who sees that something goes wrong may end the run."""

_ROLES = OPERATOR, OBSERVER = "operator", "observer"


def serve_channel(
    listener: socket.socket,
    token: str | None,
    workplace: Workplace,
    target: str,
    period: float,
    records: Record,
    link: NDArray[np.int64],
    stream: Record | None = None,
    processor: int | None = None,
) -> None:
    """Serve clients until the run is done or the parent process has ended; the body of a process.

    Args:
        listener: from `open_channel`.
        token: that each client must give; None if none is needed.
        workplace: the machine, its frames and its points.
        target: what the run follows.
        period: of a cycle [s].
        records, link: shared with the loop.
        stream: dtype `STREAM`, shared with the loop, where an operator moves the platform.
        processor: that the loop keeps; None if it keeps none.
    """
    platform = None if stream is None else OperatedPlatform(stream, workplace, period)
    channel = _Channel(platform, workplace, target, token, period, records, link, processor)
    with nullcontext() if platform is None else before_others():
        asyncio.run(channel.run(listener))


@dataclass(eq=False)
class _Client:
    writer: asyncio.StreamWriter
    name: str
    role: str
    period: float = np.inf  # of its telemetry [s]
    due: float = 0.0

    def send(self, line: bytes) -> None:
        """Send it an encoded message, unless much waits for it."""
        if self.writer.transport.get_write_buffer_size() <= _MOST_WAITING:
            self.writer.write(line)


class _Channel:
    def __init__(
        self, platform: OperatedPlatform | None, workplace: Workplace, target: str, token: str | None, period: float,
        records: Record, link: NDArray[np.int64], processor: int | None = None,
    ) -> None:  # fmt: skip
        self._platform, self._place, self._target, self._token, self._period = platform, workplace, target, token, period
        self._processor = processor
        self._records, self._link, self._seen = records, link, 0
        self._latest: Any = None
        self._timed = 0
        self._last_timing: Mapping[str, float] = {}
        self._clients: list[_Client] = []
        self._silent: list[asyncio.StreamWriter] = []
        self._measured, self._told_margins = -np.inf, list[dict[str, Any]]()
        self._doing: dict[str, Callable[[_Client, dict[str, Any]], dict[str, Any]]] = {
            "move": self._move, "follow": self._follow, "step": self._step_by, "jog": self._jog, "beat": self._beat,
            "stop": self._stop, "pause": self._pause, "resume": self._resume, "end": self._end,
            "emergency": self._emergency, "state": self._state, "margins": self._margins, "watch": self._watch,
        }  # fmt: skip

    async def run(self, listener: socket.socket) -> None:
        """Serve until the run ends."""
        # The parent may have died already.
        parent = int(self._link[Link.SUPERVISOR]) or os.getppid()
        server = await asyncio.start_server(self._serve, sock=listener, limit=MOST_LINE)
        clock = asyncio.get_running_loop()
        while not (self._link[Link.DONE] or os.getppid() != parent):
            if self._platform is not None and (ended := self._platform.step()):
                self._tell({"event": ended, "pose": pose_message(self._platform.pose)})
            self._look(clock.time())
            await asyncio.sleep(_STEP_S if self._platform is not None else _LOOK_S if self._clients else _IDLE_S)
        self._look(np.inf)
        self._tell({"event": RUN_ENDED})
        server.close()
        for silent in self._silent:
            silent.transport.abort()
        for client in self._clients:
            client.writer.close()
        # Their tasks end with their connections; one that is cut off prints a traceback.
        with suppress(TimeoutError):
            async with asyncio.timeout(_FAREWELL_S):
                while self._clients or self._silent:
                    await asyncio.sleep(_STEP_S)

    # ------------------------------------------------------------------------------------------------------------ clients

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = None
        try:
            client = await self._greeted(reader, writer)
            if client is not None:
                writer.write(encode({"gough": VERSION, "ok": True, **self._described(writer)}))
                await writer.drain()
                while line := await _line(reader):
                    writer.write(encode(self._answer(client, line)))
                    await writer.drain()
                    # Between two requests the platform goes on, however many wait.
                    await asyncio.sleep(0)
        except OSError:
            # It has gone.
            pass
        finally:
            if client is not None:
                self._clients.remove(client)
                if client.role == OPERATOR and self._platform is not None:
                    self._platform.lose_operator()
            writer.close()

    async def _greeted(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> _Client | None:
        """A client that may stay, which has its place from here on; another one is told why not."""
        line = await self._first_line(reader, writer)
        if not line:
            return None
        try:
            hello = decode(line)
            kind, error = self._refusal(hello)
        except GoughError as refusal:
            hello, kind, error = {}, "malformed", str(refusal)
        if error:
            writer.write(encode({"gough": VERSION, "ok": False, "kind": kind, "error": error}))
            return None
        client = _Client(writer, printable(str(hello.get("name", "")))[:80] or "somebody", str(hello["role"]))
        if client.role == OPERATOR:
            _watch_over(writer.get_extra_info("socket"))
        # Before anything else is waited for, so that there is one operator.
        self._clients.append(client)
        return client

    async def _first_line(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bytes:
        """What a client says first; b"" if it says nothing in time."""
        if len(self._silent) >= MOST_CLIENTS:
            # The one that has said nothing for the longest makes room: nobody is kept out by those who say nothing.
            self._silent.pop(0).transport.abort()
        self._silent.append(writer)
        try:
            return await asyncio.wait_for(_line(reader), _HELLO_S)
        except TimeoutError:
            return b""
        finally:
            if writer in self._silent:
                self._silent.remove(writer)

    def _refusal(self, hello: dict[str, Any]) -> tuple[str, str]:
        """Why a client may not stay: kind and words, "" if it may."""
        if hello.get("gough") != VERSION:
            return "version", f"this run speaks version {VERSION} of the channel, not {printable(str(hello.get('gough')))[:20]}"
        given = hello.get("token")
        if self._token is not None and not hmac.compare_digest(str(given or "").encode(), self._token.encode()):
            return "token", "the token is wrong: give that of the run, with --token-file FILE or in GOUGH_TOKEN"
        if hello.get("role") not in _ROLES:
            return "malformed", f"the role is {printable(str(hello.get('role')))[:20]!r}; it is {' or '.join(_ROLES)}"
        others = [each for each in self._clients if each.role == hello["role"]]
        if hello["role"] == OPERATOR and others:
            who = others[0].name
            return "busy", f"{who} operates this run, and only one may: wait until that has gone, or watch as an observer"
        if len(others) >= MOST_CLIENTS:
            return "busy", f"{len(others)} observers watch this run, and no more may: close one of them"
        return "", ""

    def _described(self, writer: asyncio.StreamWriter) -> dict[str, Any]:
        # None for who has gone already.
        peer, here = ((writer.get_extra_info(name) or [name])[0] for name in ("peername", "sockname"))
        return {
            "processor": self._processor if peer == here else None,
            "operated": self._platform is not None,
            "target": self._target,
            "mechanism": self._place.mechanism.name,
            "machine": machine_message(self._place.mechanism),
            "frames": frames_message(self._place.frames),
            "points": [HOME, *self._place.points],
            "home": pose_message(self._place.home),
            "speed": SPEED,
            "turn_speed": TURN_SPEED,
            "deadman": DEADMAN_S,
            "telemetry_rate": TELEMETRY_HZ,
        }

    # ----------------------------------------------------------------------------------------------------------- requests

    def _answer(self, client: _Client, line: bytes) -> dict[str, Any]:
        about: Any = None
        try:
            request = decode(line)
            about = request.get("id")
            if not (about is None or isinstance(about, int | str)):
                about = None
                raise InputError("id must be a number or a text")
            do = request.get("do")
            if not isinstance(do, str) or do not in self._doing:
                raise InputError(
                    f"there is nothing to do called {printable(str(do))[:40]!r}; there are {', '.join(self._doing)}"
                )
            if client.role != OPERATOR and do not in _FOR_ALL:
                raise RefusedError("an observer gives no orders but to end the run: connect as the operator")
            return {"id": about, "ok": True, **self._doing[do](client, request)}
        except RefusedError as refusal:
            near = None if refusal.nearest is None else pose_message(refusal.nearest)
            return {"id": about, "ok": False, "kind": "refused", "error": str(refusal)[:_MOST_WORDS], "nearest": near}
        except GoughError as error:
            return {"id": about, "ok": False, "kind": "malformed", "error": str(error)[:_MOST_WORDS]}

    @property
    def _moved(self) -> OperatedPlatform:
        """The platform, where an operator moves it."""
        if self._platform is None:
            raise RefusedError(f"this run follows {self._target}: only one with --target operator can be moved")
        return self._platform

    def _move(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client
        return {"duration": self._moved.go_to(*_goal_in(request), _limits_in(request))}

    def _follow(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client
        return {"duration": self._moved.follow(*_goal_in(request))}

    def _step_by(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client
        move = _move_in(request, "translation", "rotation")
        return {"duration": self._moved.move_by(move.translation, move.rotation_vector, move.axes, _limits_in(request))}

    def _jog(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client
        rate = _move_in(request, "velocity", "turn_velocity")
        deadman = checked_number(request.get("deadman", DEADMAN_S), "deadman")
        return {"duration": self._moved.jog(rate.translation, rate.rotation_vector, rate.axes, deadman)}

    def _beat(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client, request
        self._moved.beat()
        return {"jogging": self._moved.jogging}

    def _stop(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client, request
        self._moved.stop()
        return {}

    def _pause(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client, request
        self._moved.pause()
        return {}

    def _resume(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client, request
        return {"duration": self._moved.resume()}

    def _end(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client, request
        self._link[Link.STOP] = max(int(self._link[Link.STOP]), StopRequest.CONTROLLED)
        if self._platform is not None:
            # The loop comes to rest without it, too.
            with suppress(PlanningError):
                self._platform.stop()
        return {}

    def _emergency(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client, request
        self._link[Link.STOP] = StopRequest.QUICK
        return {}

    def _state(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client, request
        self._take()
        return {"telemetry": self._telemetry()}

    def _margins(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        del client, request
        now = time.monotonic()
        if now - self._measured > _MARGINS_S:
            self._take()
            pose = None if self._latest is None else estimated_pose(self._latest)
            place = self._place
            self._told_margins = [] if pose is None else margins_message(place.mechanism, pose, place.demands)
            self._measured = now
        return {"margins": self._told_margins}

    def _watch(self, client: _Client, request: dict[str, Any]) -> dict[str, Any]:
        rate = checked_number(request.get("rate", TELEMETRY_HZ), "rate", 0.0, TELEMETRY_HZ)
        client.period = np.inf if rate == 0.0 else 1.0 / rate
        return {"rate": rate}

    # ---------------------------------------------------------------------------------------------------------- telemetry

    def _tell(self, message: dict[str, Any]) -> None:
        line = encode(message)
        for client in self._clients:
            if client.period < np.inf:
                client.send(line)

    def _look(self, now: float) -> None:
        """Take the loop's new records, and send what is due."""
        if self._platform is None and not self._clients:
            # What nobody has seen is told to nobody.
            self._seen = max(int(self._link[Link.HEAD]) - 1, 0)
            return
        self._take()
        due = [each for each in self._clients if each.period < np.inf and now >= each.due]
        if due:
            line = encode({"telemetry": self._telemetry()})
            for client in due:
                client.due = now + client.period if client.due < now - client.period else client.due + client.period
                client.send(line)

    def _take(self) -> None:
        records, self._seen, _ = take(self._records, self._link, self._seen)
        if not len(records):
            return
        self._latest = records[-1].copy()
        if self._platform is not None and self._latest["stop"] != Cause.NONE:
            self._platform.end(Cause(int(self._latest["stop"])).short)
        for cycle, seconds, text in told_in(records, self._period):
            self._tell({"event": text, "cycle": cycle, "time": seconds})

    def _telemetry(self) -> dict[str, Any]:
        """What the run does now, in SI units."""
        latest, told = self._latest, dict(_RESTING)
        if latest is not None:
            told |= state_message(latest, self._place.frames) | {"timing": self._timing()}
        if (platform := self._platform) is not None:
            now = {"time": platform.now, "commanded": pose_message(platform.commanded)}
            return told | now | {name: getattr(platform, name) for name in ("moving", "jogging", "paused")}
        if latest is None:
            return told
        told |= {"time": int(latest["cycle"]) * self._period, "moving": bool(latest["reference"][:, 1].any())}
        reference = reference_pose(latest, self._place.mechanism)
        return told if reference is None else told | {"commanded": pose_message(reference)}

    def _timing(self) -> Mapping[str, float]:
        size, done = len(self._records), self._seen
        if done >= self._timed + _TIMED_S / self._period:
            count = min(round(_TIMING_S / self._period), done, size // 2)
            self._timed = done
            self._last_timing = timing_message(self._records, np.arange(done - count, done) % size, self._period)
        return self._last_timing


async def _line(reader: asyncio.StreamReader) -> bytes:
    """The next line of a client; b"" if it has gone, or its line has no end."""
    try:
        return await reader.readline()
    except (OSError, ValueError):
        return b""


def _watch_over(connection: socket.socket) -> None:
    """Let an operator's requests come at once, and its place become free if its machine goes without a word."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    for option, value in (("TCP_KEEPIDLE", 5), ("TCP_KEEPINTVL", 2), ("TCP_KEEPCNT", 3)):
        connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)


def _name_in(request: dict[str, Any], name: str) -> str | None:
    given = request.get(name)
    if not (given is None or isinstance(given, str)):
        raise InputError(f"{name} must be a text")
    return given


def _goal_in(request: dict[str, Any]) -> tuple[Place | str, str | None, str | None]:
    """A place or a point's name, and the frame and the tool."""
    to = request.get("to")
    return to if isinstance(to, str) else place_of(to, "to"), _name_in(request, "frame"), _name_in(request, "tool")


def _limits_in(request: dict[str, Any]) -> ToolLimits:
    """The limits of a move; speeds that are not given are the usual ones."""
    given = {name: request[name] for name in ToolLimits.__dataclass_fields__ if request.get(name) is not None}
    return ToolLimits(**{"speed": SPEED, "turn_speed": TURN_SPEED, **given})


def _move_in(request: dict[str, Any], *names: str) -> Move:
    straight, turn = (checked_array(request.get(name, (0.0, 0.0, 0.0)), (3,), name) for name in names)
    return Move(straight, turn, _name_in(request, "axes"))
