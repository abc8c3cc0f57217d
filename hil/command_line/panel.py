"""The command that shows a run or a recording in the browser, panel."""

import signal
import sys
import threading
import webbrowser
from argparse import REMAINDER, Namespace

from controller.planning import OPERATOR_TARGET
from hil.command_line import cli
from hil.realtime.processes import signals_handled
from hil.runs.config import OPERATOR_CHANNEL
from plant.errors import InputError

_STARTED = ("--target", OPERATOR_TARGET, "--duration", "36000")
"""What a run of the panel's own does, unless its options say otherwise."""


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

    Any run of 'gough run' is shown as it is estimated, with ghosts of where it should be and, in simulation, of where it is.
    Where none runs, the page starts one. If it was started with --target operator, one browser at a time may take control: jog,
    go to points and places, stop, pause. A browser that goes away while it jogs ends the run by a controlled stop. The page
    stays on this machine unless --listen says otherwise. Its quick stop is software, and no emergency stop.
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
        from hil.panel.page import Page

        server = open_server(host, port, token)
        page = Page(server, options.at, load_token(options.token_file), options.token_file)
        _announce(options, host, port, token)
        try:
            page.run(over, None if options.start is None else [*_STARTED, *options.start])
        finally:
            close_server(server)


def _announce(options: Namespace, host: str, port: int, token: str | None) -> None:
    shown = "127.0.0.1" if host == "0.0.0.0" else host
    address = f"http://{shown}:{port}/" + ("" if token is None else f"?token={token}")
    print(f"the panel is at {address}", flush=True)
    if token is not None:
        print("nothing is encrypted: whoever can read the network can read the token, and move the platform", file=sys.stderr)
    if not options.no_browser and sys.stdout.isatty():
        webbrowser.open(address)
