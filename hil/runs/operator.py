"""A client of a run's channel: an operator, or an observer (`operator_messages`). Only a run with an operator can be moved.

with Operator() as operator:
operator.move("home")
operator.step(translation=(0.005, 0.0, 0.0))
"""

import select
import socket
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Any, Self

from hil.runs.config import OPERATOR_CHANNEL
from hil.runs.operator_messages import MOST_LINE, VERSION, ChannelError, channel_address, decode, encode, is_finite
from plant.errors import InputError

BEAT_S = 0.05
"""Time between the signs of an operator who jogs."""

_PATIENCE_S = 10.0


class RequestRefusedError(ChannelError):
    """The run does not do what it was asked to. `nearest` has `position` [m] and `rotation` [rad] of the nearest pose that it
    could reach, or is None.
    """

    exit_status = 2

    def __init__(self, message: str, kind: str, nearest: Mapping[str, Any] | None) -> None:
        super().__init__(message, kind)
        self.nearest = nearest


class Operator:
    """A connection to a run.

    Args:
        address: of the channel.
        token: of the run; needed where it asks for one.
        role: `operator` gives orders, `observer` watches, and may end the run.
        name: that others are told.
        patience: how long an answer may take [s].

    Attributes:
        run: what the run says of itself: `mechanism`, `frames`, `points`, `home`, usual speeds, `deadman` [s]; and to
            clients on its own machine the `processor` that its loop keeps, which they should leave to it.
        telemetry: what came last after `watch`; {} before.
        events: that came after `watch`, each a mapping with `event` and perhaps `cycle`.

    Raises:
        ChannelError: nobody answers, or the run refuses.
    """

    def __init__(
        self,
        address: str = OPERATOR_CHANNEL,
        token: str | None = None,
        role: str = "operator",
        name: str = "gough",
        patience: float = _PATIENCE_S,
    ) -> None:
        # An address beyond this machine does without a token here, as the run asks for it.
        host, port = channel_address(address, token or "")
        self._patience, self._number, self._rest = patience, 0, b""
        self.telemetry: dict[str, Any] = {}
        self.events: deque[dict[str, Any]] = deque(maxlen=1000)
        try:
            self._socket = socket.create_connection((host, port), timeout=patience)
        except OSError as error:
            raise ChannelError(
                f"no run answers at {address}: {error.strerror or error}: start one with 'gough run', or name another --at"
            ) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            self._send({"gough": VERSION, "role": role, "name": name, **({} if token is None else {"token": token})})
            self.run = self._line(time.monotonic() + patience)
            if not self.run.get("ok"):
                raise ChannelError(str(self.run.get("error", "the run refuses")), str(self.run.get("kind", "")))
        except BaseException:
            self._socket.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Leave the run; a move goes on to its end. A request of another thread ends by a `ChannelError`."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def ask(self, do: str, **what: Any) -> dict[str, Any]:
        """Make a request, and return its answer.

        Raises:
            InputError: a number is not finite.
            RequestRefusedError: the run does not do it.
            ChannelError: the run has gone.
        """
        request = {name: value for name, value in what.items() if value is not None}
        for name, value in request.items():
            if not is_finite(value):
                raise InputError(f"{name} is {value}; it must be finite")
        self._number += 1
        self._send({"id": self._number, "do": do, **request})
        until = time.monotonic() + self._patience
        while (message := self._line(until)).get("id") != self._number:
            self._keep(message)
        if not message.get("ok"):
            raise RequestRefusedError(str(message.get("error")), str(message.get("kind")), message.get("nearest"))
        return message

    def move(
        self, to: str | Mapping[str, Any], frame: str | None = None, tool: str | None = None, speed: float | None = None,
        turn_speed: float | None = None, wait: bool = True,
    ) -> dict[str, Any]:  # fmt: skip
        """Go straight to a named point, or to a place: `position` [m] and `rotation` [rad] as a target in the frame has them,
        or one of them, and `relative`.

        Args:
            to: the name of a point, or a place as in a motion file.
            frame, tool: in which it is; by default those of the run.
            speed, turn_speed: at most [m/s, rad/s].
            wait: until it has arrived.

        Returns:
            The telemetry at its end, or the answer.

        Raises:
            RequestRefusedError: it would exceed a limit; `nearest` would not.
            ChannelError: the run has gone, or has stopped meanwhile.
        """
        answer = self.ask("move", to=to, frame=frame, tool=tool, speed=speed, turn_speed=turn_speed)
        return self.wait(answer["duration"]) if wait else answer

    def follow(self, to: str | Mapping[str, Any], frame: str | None = None, tool: str | None = None) -> dict[str, Any]:
        """Go to a point or a place as `move` has it, and to the next one at once when it is asked for, without a rest; returns
        the answer.
        """
        return self.ask("follow", to=to, frame=frame, tool=tool)

    def step(
        self, translation: Sequence[float] = (0.0, 0.0, 0.0), rotation: Sequence[float] = (0.0, 0.0, 0.0),
        axes: str | None = None, speed: float | None = None, turn_speed: float | None = None, wait: bool = True,
    ) -> dict[str, Any]:  # fmt: skip
        """Move from where the platform is, by a translation [m] and a rotation vector [rad] along a frame's axes; as `move`."""
        answer = self.ask(
            "step", translation=list(translation), rotation=list(rotation), axes=axes, speed=speed, turn_speed=turn_speed
        )
        return self.wait(answer["duration"]) if wait else answer

    def wait(self, duration: float) -> dict[str, Any]:
        """Wait until the platform rests, after a move of this duration [s]; returns the telemetry.

        Raises:
            ChannelError: the run has stopped, or it takes too long.
        """
        until = time.monotonic() + duration + self._patience
        while True:
            telemetry: dict[str, Any] = self.ask("state")["telemetry"]
            if telemetry.get("stop"):
                raise ChannelError(f"the run stops: {telemetry['stop']}", "stopped")
            if not telemetry["moving"]:
                return telemetry
            if time.monotonic() > until:
                raise ChannelError(f"the move has not ended {self._patience:g} s after its time: look at the run")
            time.sleep(0.02)

    def jog(
        self, velocity: Sequence[float] = (0.0, 0.0, 0.0), turn_velocity: Sequence[float] = (0.0, 0.0, 0.0),
        axes: str | None = None, seconds: float = float("inf"),
    ) -> Iterator[dict[str, Any]]:  # fmt: skip
        """Move at a velocity [m/s] and a rate of turn [rad/s] along the axes of a frame, as long as the iterator is asked for
        more, and for `seconds` at most; then the platform stops on its way. A limit ends it, too. It yields the answers to the
        signs of life.
        """
        self.ask("jog", velocity=list(velocity), turn_velocity=list(turn_velocity), axes=axes)
        until = time.monotonic() + seconds
        try:
            while time.monotonic() < until and (beat := self.ask("beat"))["jogging"]:
                yield beat
                time.sleep(BEAT_S)
        finally:
            self.ask("stop")

    def watch(self, rate: float | None = None) -> None:
        """Ask for telemetry at a rate [Hz], by default 30, and for events; `listen` takes them in."""
        self.ask("watch", rate=rate)

    def listen(self, seconds: float, newest: bool = False) -> None:
        """Take in telemetry and events for a time, with `newest` only until telemetry has come and none that is newer waits.

        Raises:
            ChannelError: the run has gone.
        """
        until = time.monotonic() + seconds
        while line := self._line(until, lenient=True):
            self._keep(line)
            if newest and "telemetry" in line:
                until = 0.0

    def margins(self) -> list[dict[str, Any]]:
        """How the platform stands to everything that limits it (`hil.runs.telemetry.margins_message`); [] without a pose."""
        found: list[dict[str, Any]] = self.ask("margins")["margins"]
        return found

    def stop(self) -> None:
        """Let the platform come to rest on its way."""
        self.ask("stop")

    def pause(self) -> None:
        """Let the platform come to rest on its way, from where `resume` goes on; a jog stops."""
        self.ask("pause")

    def resume(self, wait: bool = True) -> dict[str, Any]:
        """Go on to where the platform went when it was paused; as `move`."""
        answer = self.ask("resume")
        return self.wait(answer["duration"]) if wait else answer

    def end(self) -> None:
        """End the run by a controlled stop."""
        self.ask("end")

    def emergency(self) -> None:
        """End the run by an emergency stop: the drives stop by themselves."""
        self.ask("emergency")

    def _keep(self, message: dict[str, Any]) -> None:
        if "telemetry" in message:
            self.telemetry = message["telemetry"]
        elif "event" in message:
            self.events.append(message)

    def _send(self, message: Mapping[str, Any]) -> None:
        try:
            self._socket.sendall(encode(message))
        except OSError:
            raise ChannelError("the run has ended, or closed the channel", "closed") from None

    def _line(self, until: float, lenient: bool = False) -> dict[str, Any]:
        """The next message; {} if none comes in time and that is no error."""
        while b"\n" not in self._rest:
            left = max(until - time.monotonic(), 0.0)
            try:
                ready = bool(select.select([self._socket], [], [], left)[0])
                received = self._socket.recv(MOST_LINE) if ready else None
            except (OSError, ValueError):
                # ValueError: another thread has closed it.
                received = b""
            if received is None:
                if lenient:
                    return {}
                raise ChannelError(f"the run has not answered for {self._patience:g} s", "silent")
            if not received:
                raise ChannelError("the run has ended, or closed the channel", "closed")
            self._rest += received
        line, _, self._rest = self._rest.partition(b"\n")
        return decode(line)
