"""A panel that is attached to a run: it watches as an observer, and gives orders for one browser at a time.

    browser --websocket--> callbacks, in order --queue--> worker --channel--> run

A button that is held sends a sign of life twenty times a second, and the worker one of its own to the run. A page that is
closed while it jogs, or this process if it dies, is an operator who goes away: the run ends by a controlled stop. A button that
is released, and a page that freezes, let the platform come to rest.
"""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from math import radians
from typing import Any

import viser

from hil.panel.gui import set_text, set_theme, tell_not_done
from hil.panel.margins import MARGINS_S, MarginTable
from hil.panel.readings import Readings, event_list
from hil.panel.scene import Machine, Scene
from hil.runs.operator import BEAT_S, Operator, RequestRefusedError
from hil.runs.operator_messages import RUN_ENDED, ChannelError
from plant.errors import GoughError

HOLD_HZ = 20.0
"""Signs of life while a button is held."""

RELEASED_S = 0.5
"""A button counts as released when the browser, which is there, has sent no sign of life for so long."""

_DEADMAN_S = 1.0
"""How long a jog goes on without a sign of life from this process: on a busy machine it may wait for its turn."""

_AXES = ("x", "y", "z", "rx", "ry", "rz")
_EVENTS = 8
_LISTEN_S = 0.05
_SLIDER_MM, _SLIDER_DEG = 50.0, 15.0


class _NoControlError(GoughError):
    """A browser that does not have control gives an order."""


class LivePanel:
    """The page of a run.

    Args:
        server: of the page.
        address, token: of the run's channel.

    Raises:
        ChannelError: no run answers, or it refuses.
    """

    def __init__(self, server: viser.ViserServer, address: str, token: str | None) -> None:
        self._server, self._address, self._token = server, address, token
        self._watching = Operator(address, token, role="observer", name="gough panel")
        self._run = self._watching.run
        # What a run before it has left.
        server.gui.reset()
        server.scene.reset()
        self.machine = Machine.of_message(self._run["machine"])
        self._scene = Scene(server, self.machine)
        self._orders = _Orders(server, address, token, self._show_operator)
        self._events: deque[str] = deque(maxlen=_EVENTS)
        self._measured = 0.0
        self._build()

    def leave(self, client: viser.ClientHandle) -> None:
        """The browser has gone."""
        self._orders.leave(client)

    def run(self, over: threading.Event) -> str:
        """Show the run until it ends or `over` is set; the picture of its last state stays. Returns how it ended, in words."""
        self._watching.watch()
        running = True
        while running and not over.is_set():
            try:
                self._watching.listen(_LISTEN_S, newest=True)
                self._look_at_margins()
            except ChannelError:
                print("the run has ended; Ctrl-C closes the panel", flush=True)
                running = False
            self._take_events()
            if self._watching.telemetry:
                self._show(self._watching.telemetry, last=not running)
        events = event_list([event for event in self._events if event != RUN_ENDED])
        return f"{self._status.content}\n\n**The run has ended.**\n\n{events}\n\n"

    def close(self) -> None:
        """Leave the run."""
        self._orders.close()
        self._watching.close()

    # --------------------------------------------------------------------------------------------------------------- page

    def _build(self) -> None:
        gui = self._server.gui
        set_theme(gui)
        self._status = gui.add_markdown("preparing")
        gui.add_markdown(f"{self.machine.name} follows {self._run['target']}")
        if self._run["operated"]:
            self._operating = gui.add_markdown("nobody operates from this panel")
            self._control = self._button("Take control", lambda client: self._orders.take(client), color="blue")
            self._button("Stop the motion", self._ordered(lambda operator: operator.stop()), color="orange")
            self._button("Pause", self._ordered(lambda operator: operator.pause()))
            self._button("Go on", self._ordered(lambda operator: operator.resume(wait=False)))
        with gui.add_folder("End the run"):
            self._end_button("Controlled stop", lambda operator: operator.end(), "orange")
            self._end_button("Software quick stop (no emergency stop)", lambda operator: operator.emergency(), "red")
        tabs = gui.add_tab_group()
        if self._run["operated"]:
            for label, build in (("Jog", self._build_jog), ("Go to", self._build_moves), ("Sliders", self._build_sliders)):
                with tabs.add_tab(label):
                    build()
        with tabs.add_tab("Readings"):
            self._readings = Readings(self._server, self.machine, self._scene, self._run["frames"], self._status)
        with tabs.add_tab("Limits"):
            self._margins = MarginTable(self._server)

    @property
    def _free(self) -> tuple[int, ...]:
        """The numbers of the axes along and about which the platform moves."""
        return (0, 1, 5) if self.machine.planar else tuple(range(len(_AXES)))

    def _build_jog(self) -> None:
        gui = self._server.gui
        axis = gui.add_dropdown("Axis", tuple(_AXES[number] for number in self._free))
        frame = gui.add_dropdown("Along", ("work frame", *self._run["frames"]["names"]))
        step = gui.add_number("Step [mm, deg]", 1.0, min=0.001, max=100.0, step=0.001)
        speed = gui.add_number("Speed, held [mm/s, deg/s]", 5.0, min=0.01, max=100.0, step=0.01)

        def along(size: float) -> tuple[list[float], list[float], str | None]:
            place, turn = [0.0] * 3, [0.0] * 3
            at = _AXES.index(axis.value)
            if at < 3:
                place[at] = 1e-3 * size
            else:
                turn[at - 3] = radians(size)
            return place, turn, None if frame.value == "work frame" else frame.value

        self._button("Step +", self._ordered(lambda operator: operator.step(*along(step.value), wait=False)))
        self._button("Step -", self._ordered(lambda operator: operator.step(*along(-step.value), wait=False)))
        for sign, label in ((1.0, "+"), (-1.0, "-")):
            held = gui.add_button(f"Hold to jog {label}", color="teal")

            async def hold(event: Any, sign: float = sign) -> None:
                place, turn, axes = along(sign * speed.value)
                self._orders.hold(event.client, {"velocity": place, "turn_velocity": turn, "axes": axes})

            async def release(event: Any) -> None:
                self._orders.release(event.client)

            held.on_hold(hold, callback_hz=HOLD_HZ)
            held.on_click(release)

    def _build_moves(self) -> None:
        gui = self._server.gui
        point = gui.add_dropdown("Point", tuple(self._run["points"]))
        self._button("Go to the point", self._ordered(lambda operator: operator.move(point.value, wait=False)))
        place = gui.add_vector3("Place from home [mm]", (0.0, 0.0, 0.0), step=0.1)
        turn = gui.add_vector3("Turn [deg]", (0.0, 0.0, 0.0), step=0.1)

        def go(operator: Operator) -> None:
            position, rotation = [1e-3 * each for each in place.value], [radians(each) for each in turn.value]
            operator.move({"position": position, "rotation": rotation}, wait=False)

        self._button("Go to the place", self._ordered(go))

    def _build_sliders(self) -> None:
        """The platform follows the sliders."""
        gui = self._server.gui
        gui.add_markdown("The platform follows the sliders, displacements from home, while this browser has control.")
        sliders = {}
        for number in self._free:
            most, unit = (_SLIDER_MM, "mm") if number < 3 else (_SLIDER_DEG, "deg")
            sliders[number] = gui.add_slider(f"{_AXES[number]} [{unit}]", -most, most, 0.1, 0.0)

        async def moved(event: Any) -> None:
            if event.client is not None:
                values = [sliders[number].value if number in sliders else 0.0 for number in range(len(_AXES))]
                place = {"position": [1e-3 * each for each in values[:3]], "rotation": [radians(each) for each in values[3:]]}
                self._orders.follow(event.client, place)

        for slider in sliders.values():
            slider.on_update(moved)

    def _button(self, label: str, do: Callable[[Any], None], color: Any = None) -> Any:
        button = self._server.gui.add_button(label, color=color)

        async def clicked(event: Any) -> None:
            do(event.client)

        button.on_click(clicked)
        return button

    def _end_button(self, label: str, do: Callable[[Operator], Any], color: Any) -> None:
        # A plain function waits in a thread of the library, beside all other orders.
        self._server.gui.add_button(label, color=color).on_click(lambda event: self._orders.end(event.client, do))

    def _ordered(self, do: Callable[[Operator], Any]) -> Callable[[Any], None]:
        return lambda client: self._orders.give(client, do)

    # ---------------------------------------------------------------------------------------------------------- telemetry

    def _look_at_margins(self) -> None:
        if time.monotonic() - self._measured > MARGINS_S:
            self._measured = time.monotonic()
            with suppress(RequestRefusedError):
                self._margins.show(self._watching.margins())

    def _take_events(self) -> None:
        events = self._watching.events
        while events:
            event = events.popleft()
            self._events.append(f"cycle {event['cycle']}: {event['event']}" if "cycle" in event else str(event["event"]))

    def _show(self, state: dict[str, Any], last: bool) -> None:
        with self._server.atomic():
            self._scene.show(state)
            self._readings.show(state, self._events, at_once=last)

    def _show_operator(self, who: int | None) -> None:
        text = "nobody operates from this panel" if who is None else f"browser {who} operates the run"
        self._control.label = "Take control" if who is None else f"Give up control (browser {who})"
        set_text(self._operating, text)


class _Orders:
    """The orders of the browser that has control, given to the run in their order by a thread of its own.

    Any browser may end the run.
    """

    def __init__(
        self, server: viser.ViserServer, address: str, token: str | None, shown: Callable[[int | None], None]
    ) -> None:  # fmt: skip
        self._server, self._channel, self._shown = server, (address, token), shown
        self._operator: Operator | None = None
        self._who: int | None = None
        self._held_at = self._beaten = 0.0
        self._client: Any = None
        self._jogging = False
        self._place: dict[str, Any] | None = None
        self._lock = threading.Lock()
        self._queue: queue.SimpleQueue[tuple[Any, Callable[[Any], Any]] | None] = queue.SimpleQueue()
        threading.Thread(target=self._work, daemon=True).start()

    def take(self, client: Any) -> None:
        """Take control for a browser, or give it up if it has it."""
        self._queue.put((client, self._take))

    def give(self, client: Any, do: Callable[[Operator], Any]) -> None:
        """Give an order for a browser that has control."""
        self._place = None
        self._queue.put((client, lambda client: do(self._operator_of(client))))

    def end(self, client: Any, do: Callable[[Operator], Any]) -> None:
        """End the run at once, whoever operates it; returns when it has answered."""
        try:
            with Operator(*self._channel, role="observer", name="gough panel") as observer:
                do(observer)
        except ChannelError as error:
            tell_not_done(self._server, client, str(error))

    def hold(self, client: Any, jog: dict[str, Any]) -> None:
        """A sign of life of a button that is held; the first one begins the jog."""
        self._place = None
        self._queue.put((client, lambda client: self._hold(client, jog)))

    def release(self, client: Any) -> None:
        """The button is no longer held."""
        self._queue.put((client, self._release))

    def follow(self, client: Any, place: dict[str, Any]) -> None:
        """Go to a place; of those that wait for their turn, the newest counts."""
        self._place = place
        self._queue.put((client, self._follow))

    def leave(self, client: Any) -> None:
        """The browser has gone: the run sees it at once, and ends by a controlled stop if it jogged."""
        if client.client_id == self._who:
            self._drop()

    def close(self) -> None:
        """Give up control, and end the thread."""
        self._drop()
        self._queue.put(None)

    def _work(self) -> None:
        while True:
            with suppress(queue.Empty):
                if (order := self._queue.get(timeout=BEAT_S)) is None:
                    return
                self._do(*order)
            if self._jogging:
                self._do(self._client, self._beat)

    def _do(self, client: Any, do: Callable[[Any], Any]) -> None:
        try:
            do(client)
        except RequestRefusedError as error:
            tell_not_done(self._server, client, str(error))
        except (ChannelError, _NoControlError) as error:
            tell_not_done(self._server, client, str(error))
            if isinstance(error, ChannelError):
                self.leave(client)

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
        self._operator, self._who = Operator(*self._channel, name="gough panel"), client.client_id
        self._shown(self._who)
        if client.client_id not in self._server.get_clients():
            self._drop()

    def _hold(self, client: Any, jog: dict[str, Any]) -> None:
        operator, now = self._operator_of(client), time.monotonic()
        begins = now - self._held_at > RELEASED_S
        self._held_at = now
        if begins:
            operator.ask("jog", **jog, deadman=_DEADMAN_S)
            self._client, self._jogging = client, True

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

    def _follow(self, client: Any) -> None:
        operator, place = self._operator_of(client), self._place
        self._place = None
        if place is not None:
            operator.follow(place)

    def _drop(self) -> None:
        with self._lock:
            operator, self._operator, self._who = self._operator, None, None
        self._jogging, self._held_at, self._place = False, 0.0, None
        if operator is not None:
            operator.close()
            self._shown(None)
