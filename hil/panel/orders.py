"""The orders that browsers give a run: those of the browser that has control, in their order, and the end of the run at once.

    browser --websocket--> callbacks, in order --queue--> worker --channel, as the operator--> run
                           callback of an end ---------------------channel, as an observer---> run

A button that is held sends a sign of life twenty times a second, and the worker one of its own to the run. A page that is
closed while it jogs, or this process if it dies, is an operator who goes away: the run ends by a controlled stop. A button that
is released, and a page that freezes, let the platform come to rest.
"""

import queue
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import viser

from hil.panel.gui import tell_not_done
from hil.runs.operator import BEAT_S, Operator, RequestRefusedError
from hil.runs.operator_messages import ChannelError
from plant.errors import GoughError

HOLD_HZ = 20.0
"""Signs of life while a button is held."""

RELEASED_S = 0.5
"""A button counts as released when the browser, which is there, has sent no sign of life for so long."""

_DEADMAN_S = 1.0
"""How long a jog goes on without a sign of life from this process: on a busy machine it may wait for its turn."""


class _NoControlError(GoughError):
    """A browser that does not have control gives an order."""


class Orders:
    """What browsers order of a run.

    Args:
        server: of the page.
        address, token: of the run's channel.
        operates: is told which browser has control, by its number; None for none.
        rests: is told, in the server's event loop, which browser has control, and the pose (`pose_message`) in which the
            platform rests after the last order.
    """

    def __init__(
        self, server: viser.ViserServer, address: str, token: str | None, operates: Callable[[int | None], None],
        rests: Callable[[int, Mapping[str, Any]], None],
    ) -> None:  # fmt: skip
        self._server, self._channel, self._operates, self._rests = server, (address, token), operates, rests
        self._operator: Operator | None = None
        self._client: Any = None  # the browser that has control
        self._held_at = self._beaten = 0.0
        self._jogging = self._unsettled = False
        self._newest: dict[int, Mapping[str, Any]] = {}  # of the places that each browser would have followed
        self._given = 0
        self._told, self._told_at = (-1, ""), 0.0
        self._lock = threading.Lock()
        self._queue: queue.SimpleQueue[tuple[Any, Callable[[Any], Any]] | None] = queue.SimpleQueue()
        threading.Thread(target=self._work, daemon=True).start()

    def take(self, client: Any) -> None:
        """Take control for a browser, or give it up if it has it."""
        self._put(client, self._take)

    def give(self, client: Any, do: Callable[[Operator], Any]) -> None:
        """Give an order for a browser that has control."""
        self._newest.pop(client.client_id, None)
        self._put(client, lambda client: do(self._operator_of(client)))

    def hold(self, client: Any, jog: dict[str, Any]) -> None:
        """A sign of life of a button that is held; the first one begins the jog."""
        self._newest.pop(client.client_id, None)
        self._put(client, lambda client: self._hold(client, jog))

    def release(self, client: Any) -> None:
        """The button is no longer held."""
        self._put(client, self._release)

    def follow(self, client: Any, place: Mapping[str, Any]) -> None:
        """Go to a place; of those of a browser that wait for their turn, the newest counts."""
        self._newest[client.client_id] = place
        self._put(client, lambda client: self._follow(client, place))

    def end(self, client: Any, do: Callable[[Operator], Any]) -> None:
        """End the run at once, whoever operates it; returns when it has answered."""
        try:
            with Operator(*self._channel, role="observer", name="gough panel") as observer:
                do(observer)
        except ChannelError as error:
            tell_not_done(self._server, client, str(error))

    def leave(self, client: Any) -> None:
        """The browser has gone: the run sees it at once, and ends by a controlled stop if it jogged."""
        self._newest.pop(client.client_id, None)
        if client.client_id == self._who:
            self._drop()

    def close(self) -> None:
        """Give up control, and end the thread."""
        self._drop()
        self._queue.put(None)

    @property
    def _who(self) -> int | None:
        client = self._client
        return None if client is None else int(client.client_id)

    def _put(self, client: Any, do: Callable[[Any], Any]) -> None:
        self._given += 1
        self._queue.put((client, do))

    def _work(self) -> None:
        while True:
            with suppress(queue.Empty):
                if (order := self._queue.get(timeout=BEAT_S)) is None:
                    return
                self._unsettled = True
                self._do(*order)
            if (client := self._client) is None:
                continue
            if self._jogging:
                self._do(client, self._beat)
            elif self._unsettled and self._queue.empty():
                self._look_whether_it_rests(client.client_id)

    def _do(self, client: Any, do: Callable[[Any], Any]) -> None:
        try:
            do(client)
        except (ChannelError, _NoControlError) as error:
            self._tell(client, str(error))
            if isinstance(error, ChannelError) and not isinstance(error, RequestRefusedError):
                self.leave(client)

    def _tell(self, client: Any, why: str) -> None:
        """Tell why an order is not done: once while a button is held, which gives it twenty times a second."""
        told, at = (client.client_id, why), time.monotonic()
        if told != self._told or at - self._told_at > RELEASED_S:
            tell_not_done(self._server, client, why)
        self._told, self._told_at = told, at

    def _operator_of(self, client: Any) -> Operator:
        operator = self._operator
        if operator is None or client.client_id != self._who:
            who = "nobody" if self._who is None else f"browser {self._who}"
            raise _NoControlError(f"{who} operates the run: take control first")
        return operator

    def _take(self, client: Any) -> None:
        if self._who == client.client_id:
            self._drop()
            return
        if self._who is not None:
            raise _NoControlError(f"browser {self._who} operates the run, and only one may")
        operator = Operator(*self._channel, name="gough panel")
        with self._lock:
            self._operator, self._client = operator, client
        self._operates(client.client_id)
        if client.client_id not in self._server.get_clients():
            self._drop()

    def _hold(self, client: Any, jog: dict[str, Any]) -> None:
        operator, now = self._operator_of(client), time.monotonic()
        begins = now - self._held_at > RELEASED_S
        self._held_at = now
        if begins:
            operator.ask("jog", **jog, deadman=_DEADMAN_S)
            self._jogging = True

    def _beat(self, client: Any) -> None:
        """A sign of life to the run, as long as the browser sends some; one that is there and sends none has let go."""
        now = time.monotonic()
        if now - self._held_at > RELEASED_S:
            self._release(client)
        elif now - self._beaten > BEAT_S:
            self._beaten = now
            # It may have come to a limit; then it begins no other one before the button is released.
            self._jogging = self._operator_of(client).ask("beat")["jogging"]

    def _release(self, client: Any) -> None:
        operator = self._operator_of(client)
        self._held_at = 0.0
        if self._jogging:
            self._jogging = False
            operator.stop()

    def _follow(self, client: Any, place: Mapping[str, Any]) -> None:
        operator = self._operator_of(client)
        if self._newest.get(client.client_id) is place:
            operator.follow(place)

    def _look_whether_it_rests(self, who: int) -> None:
        given, operator, self._unsettled = self._given, self._operator, False
        # That the run has ended is seen by the page itself.
        with suppress(ChannelError):
            if operator is not None:
                state = operator.ask("state")["telemetry"]
                self._unsettled = state["moving"]
                if not state["moving"]:
                    self._server.get_event_loop().call_soon_threadsafe(self._tell_rest, given, who, state["commanded"])

    def _tell_rest(self, given: int, who: int, pose: Mapping[str, Any]) -> None:
        # An order that was given since then may move it.
        if given == self._given and who == self._who:
            self._rests(who, pose)

    def _drop(self) -> None:
        with self._lock:
            operator, self._operator, self._client = self._operator, None, None
        self._jogging, self._held_at = False, 0.0
        if operator is not None:
            operator.close()
            self._operates(None)
