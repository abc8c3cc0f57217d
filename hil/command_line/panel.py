"""The command that shows a run or a recording in the browser, panel."""

import signal
import subprocess
import sys
import threading
import time
import webbrowser
from argparse import REMAINDER, Namespace
from collections.abc import Iterator
from contextlib import contextmanager

from hil.command_line import cli
from hil.realtime.processes import signals_handled
from hil.runs.config import OPERATOR_CHANNEL
from plant.errors import GoughError, InputError

_START_S = 180.0
"""How long a run may take to begin: the first one compiles."""


class _NotBegunError(GoughError, RuntimeError):
    """The run that a panel has started has ended before it began."""

    exit_status = 1


@cli.command(
    cli.source("recording", "FILE.mcap", "a recording to play, in place of a run", nargs="?"),
    cli.setting("--at", OPERATOR_CHANNEL, "the channel of the run", metavar="HOST:PORT"),
    cli.argument("--token-file", metavar="FILE", help="the token of the run, if it needs one; also the variable GOUGH_TOKEN"),
    cli.setting("--listen", "127.0.0.1:8080", "where the page is; beyond this machine it needs a token", metavar="HOST:PORT"),
    cli.argument("--page-token-file", metavar="FILE", help="the token that a browser must give"),
    cli.argument("--mechanism", metavar="NAME", help="with a recording: the mechanism, if its file has moved"),
    cli.flag("--no-browser", "do not open a browser"),
    cli.argument(
        "--start", nargs=REMAINDER, metavar="OPTION",
        help="start a run with these options of 'gough run', and end it with the panel; it comes last",
    ),
)  # fmt: skip
def gough_panel(options: Namespace) -> None:
    """Show a run in the browser, live, and operate it; or play a recording.

    A run that was started with 'gough run --target operator' is shown as it is estimated, with ghosts of where it should be
    and, in simulation, of where it is. One browser at a time may take control: jog, go to points and places, stop. A browser
    that goes away while it jogs ends the run by a controlled stop. The page stays on this machine unless --listen says
    otherwise. Its quick stop is software, and no emergency stop.
    """
    from hil.panel.access import close_server, open_server, panel_address
    from hil.runs.operator_messages import load_token

    if options.recording is not None and options.start is not None:
        raise InputError("play a recording, or start a run with --start, and not both")
    token = None if options.page_token_file is None else load_token(options.page_token_file)
    host, port = panel_address(options.listen, token)
    over = threading.Event()
    with signals_handled((signal.SIGINT, signal.SIGTERM), lambda number, frame: over.set()):
        if options.recording is not None:
            from hil.panel.playback import Playback
            from hil.runs.recorded_run import recorded_run

            run = recorded_run([options.recording], options.mechanism)
            server = open_server(host, port, token)
            _announce(options, host, port, token)
            Playback(server, run).run(over)
            close_server(server)
            return
        from hil.panel.live import LivePanel

        with _started_run(options, over):
            server = open_server(host, port, token)
            panel = LivePanel(server, options.at, load_token(options.token_file))
            try:
                _announce(options, host, port, token)
                panel.run(over)
            finally:
                panel.close()
                close_server(server)


def _announce(options: Namespace, host: str, port: int, token: str | None) -> None:
    shown = "127.0.0.1" if host == "0.0.0.0" else host
    address = f"http://{shown}:{port}/" + ("" if token is None else f"?token={token}")
    print(f"the panel is at {address}", flush=True)
    if token is not None:
        print("nothing is encrypted: whoever can read the network can read the token, and move the platform", file=sys.stderr)
    if not options.no_browser and sys.stdout.isatty():
        webbrowser.open(address)


@contextmanager
def _started_run(options: Namespace, over: threading.Event) -> Iterator[None]:
    """A run of the panel's own, if one is asked for; it ends by a controlled stop."""
    if options.start is None:
        yield
        return
    from hil.runs.operator import Operator
    from hil.runs.operator_messages import ChannelError, load_token

    command = [sys.executable, "-m", "hil.command_line", "run", "--target", f"operator:{options.at}", "--duration", "36000"]
    # Ctrl-C is for the panel, which ends the run.
    run = subprocess.Popen([*command, *options.start], start_new_session=True)
    try:
        until = time.monotonic() + _START_S
        while not over.is_set():
            if run.poll() is not None:
                raise _NotBegunError(f"the run ended with status {run.returncode} before it began: its last lines say why")
            try:
                Operator(options.at, load_token(options.token_file), role="observer").close()
                break
            except ChannelError:
                if time.monotonic() > until:
                    raise
            time.sleep(0.2)
        yield
    finally:
        run.terminate()
        run.wait()
