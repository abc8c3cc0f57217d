"""The page of a panel: a run as long as there is one at the channel, and between runs the choice of another."""

import threading
from collections.abc import Sequence

import viser

from hil.panel.gui import tell_not_done
from hil.panel.live import LivePanel
from hil.panel.starting import RunForm, StartedRun
from hil.runs.operator_messages import ChannelError
from plant.errors import GoughError, InputError

_LOOK_S = 0.3
"""Time between two looks for a run."""

_REFUSALS = ("token", "version")


class NotBegunError(GoughError, RuntimeError):
    """The run that a panel was told to start has ended before it began."""

    exit_status = 1


class Page:
    """What a server shows.

    Args:
        server: of the page.
        address, token: of the channel of runs.
        token_file: of that token, for runs that the page starts.
    """

    def __init__(self, server: viser.ViserServer, address: str, token: str | None, token_file: str | None = None) -> None:
        self._server, self._address, self._token = server, address, token
        self._channel = ["--channel", address, *([] if token_file is None else ["--token-file", token_file])]
        self._form: RunForm | None = None
        self._note = f"**No run** answers at {address}."
        self._wanted: list[str] | None = None
        self._chosen: list[str] = []
        self._started: StartedRun | None = None
        self._live: LivePanel | None = None
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._leave)

    def run(self, over: threading.Event, options: Sequence[str] | None = None) -> None:
        """Show runs, one after the other, until `over` is set; a run that the page has started ends with it.

        Args:
            options: of a run that is started at once; None for none.

        Raises:
            ChannelError: a run refuses the panel.
            InputError: a run is there already, and another one should be started at once.
            NotBegunError: the run that was started at once has ended before it began.
        """
        self._wanted, must_begin = None if options is None else list(options), options is not None
        try:
            while not over.is_set():
                if (live := self._attached()) is not None:
                    if self._wanted is not None:
                        self._give_up_wish(live, must_begin)
                    self._form, must_begin = None, False
                    if self._started is not None and self._started.status is not None:
                        # This is another one.
                        self._started = None
                    self._show(live, over)
                    continue
                self._watch_started(must_begin)
                over.wait(_LOOK_S)
        finally:
            if self._started is not None:
                self._started.end()

    def start(self, options: list[str]) -> None:
        """Want a run.

        Raises:
            InputError: one is being started, or runs.
        """
        if self._wanted is not None or (self._started is not None and self._started.status is None):
            raise InputError("a run is being started: wait until it is here")
        self._wanted = self._chosen = options

    def _attached(self) -> LivePanel | None:
        try:
            return LivePanel(self._server, self._address, self._token)
        except ChannelError as error:
            if error.kind in _REFUSALS:
                raise
            return None

    def _give_up_wish(self, live: LivePanel, must_begin: bool) -> None:
        """Another run has come before the one that is wanted."""
        answers = f"a run answers at {self._address} already"
        if must_begin:
            live.close()
            raise InputError(f"{answers}: leave --start out, or name another --at")
        self._wanted = None
        for client in self._server.get_clients().values():
            tell_not_done(self._server, client, f"{answers}: no other one was started")

    def _show(self, live: LivePanel, over: threading.Event) -> None:
        """Show a run until it ends."""
        self._live = live
        try:
            for client in self._server.get_clients().values():
                live.welcome(client)
            self._note = live.run(over)
        finally:
            self._live = None
            live.close()

    async def _welcome(self, client: viser.ClientHandle) -> None:
        if (live := self._live) is not None:
            live.welcome(client)

    async def _leave(self, client: viser.ClientHandle) -> None:
        if (live := self._live) is not None:
            live.leave(client)

    def _watch_started(self, must_begin: bool) -> None:
        """Start the run that is wanted, and tell what has become of it as long as it does not answer."""
        started, note = self._started, self._note
        if started is not None and started.status is not None:
            if must_begin:
                raise NotBegunError(f"the run ended with status {started.status} before it began: its last lines say why")
            if started.status:
                note += f" It ended with status {started.status}:\n\n" + "\n".join(f"    {line}" for line in started.words)
        elif started is not None:
            note = "The run begins, or ends."
        if self._wanted is not None:
            self._started, self._wanted = StartedRun([*self._wanted, *self._channel]), None
        if self._form is None:
            self._server.gui.reset()
            self._form = RunForm(self._server, self.start, self._chosen)
        self._form.say(note)
