"""A panel that is attached to a run: it watches as an observer, and gives orders for one browser at a time (`orders`)."""

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import viser

from hil.panel.controls import Controls
from hil.panel.gui import set_text, set_theme
from hil.panel.margins import MARGINS_S, MarginTable
from hil.panel.orders import Orders
from hil.panel.readings import Readings, event_list
from hil.panel.scene import Machine, Scene
from hil.realtime.scheduling import processor_left
from hil.runs.operator import Operator, RequestRefusedError
from hil.runs.operator_messages import RUN_ENDED, ChannelError
from hil.runs.run_state import event_line

_EVENTS = 8
_LISTEN_S = 0.05


class LivePanel:
    """The page of a run.

    Args:
        server: of the page.
        address, token: of the run's channel.

    Raises:
        ChannelError: no run answers, or it refuses.
    """

    def __init__(self, server: viser.ViserServer, address: str, token: str | None) -> None:
        self._server = server
        self._watching = Operator(address, token, role="observer", name="gough panel")
        self._watching.watch()
        self._run = self._watching.run
        # What a run before it has left.
        server.gui.reset()
        server.scene.reset()
        self.machine = Machine.of_message(self._run["machine"])
        self._scene = Scene(server, self.machine)
        self._orders = Orders(server, address, token, self._show_operator, self._show_rest)
        self._controls: dict[int, Controls] = {}
        self._welcoming = threading.Lock()
        self._events: deque[str] = deque(maxlen=_EVENTS)
        self._measured = 0.0
        self._build()

    def welcome(self, client: viser.ClientHandle) -> None:
        """Show a browser the controls of its own."""
        with self._welcoming:
            if self._run["operated"] and client.client_id not in self._controls:
                # Above the readings.
                order = self._tabs.order - 0.5
                self._controls[client.client_id] = Controls(client, order, self._orders, self.machine, self._run)

    def leave(self, client: viser.ClientHandle) -> None:
        """The browser has gone."""
        self._orders.leave(client)
        with self._welcoming:
            self._controls.pop(client.client_id, None)

    def run(self, over: threading.Event) -> str:
        """Show the run until it ends or `over` is set; the picture of its last state stays. Returns how it ended, in words."""
        with processor_left(self._run.get("processor")):
            self._show_until(over)
        events = event_list([event for event in self._events if event != RUN_ENDED])
        return f"{self._status.content}\n\n**The run has ended.**\n\n{events}\n\n"

    def _show_until(self, over: threading.Event) -> None:
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

    def close(self) -> None:
        """Leave the run."""
        self._orders.close()
        self._watching.close()
        with self._welcoming:
            for controls in self._controls.values():
                controls.remove()
            self._controls.clear()

    # --------------------------------------------------------------------------------------------------------------- page

    def _build(self) -> None:
        gui = self._server.gui
        set_theme(gui)
        self._status = gui.add_markdown("preparing")
        gui.add_markdown(f"{self.machine.name} follows {self._run['target']}")
        if self._run["operated"]:
            self._operating = gui.add_markdown("nobody operates from this panel")
            self._control = self._button("Take control", self._orders.take, color="blue")
            self._button("Stop the motion", self._ordered(lambda operator: operator.stop()), color="orange")
            self._button("Pause", self._ordered(lambda operator: operator.pause()))
            self._button("Go on", self._ordered(lambda operator: operator.resume(wait=False)))
        with gui.add_folder("End the run"):
            gui.add_markdown("The quick stop is software, and no emergency stop.")
            self._end_button("Controlled stop", lambda operator: operator.end(), "orange")
            self._end_button("Software quick stop", lambda operator: operator.emergency(), "red")
        self._tabs = gui.add_tab_group()
        with self._tabs.add_tab("Readings"):
            self._readings = Readings(self._server, self.machine, self._scene, self._run["frames"], self._status)
        with self._tabs.add_tab("Limits"):
            self._margins = MarginTable(self._server)

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
            told = str(event["event"])
            self._events.append(event_line(event["cycle"], event["time"], told) if "time" in event else told)

    def _show(self, state: dict[str, Any], last: bool) -> None:
        with self._server.atomic():
            self._scene.show(state)
            self._readings.show(state, self._events, at_once=last)

    def _show_operator(self, who: int | None) -> None:
        text = "nobody operates from this panel" if who is None else f"browser {who} operates the run"
        self._control.label = "Take control" if who is None else f"Give up control (browser {who})"
        set_text(self._operating, text)

    def _show_rest(self, who: int, pose: Mapping[str, Any]) -> None:
        if (controls := self._controls.get(who)) is not None:
            controls.show_rest(pose)
