"""The state of a run on the terminal."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from math import asin, atan2, degrees
from typing import Any

from hil.command_line.printing import mm, new_table


@contextmanager
def live_view(mechanism: str, target: str, rate: float) -> Iterator[Callable[[Any], None]]:
    """The state of a run, ten times a second where there is a terminal."""
    from rich.console import Console
    from rich.live import Live

    if not sys.stderr.isatty():
        yield lambda progress: None
        return
    live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)

    def show(progress: Any) -> None:
        # A terminal that has gone is no reason to end a motion.
        with suppress(OSError):
            live.update(_view(mechanism, target, rate, progress), refresh=True)

    live.start()
    try:
        yield show
    finally:
        with suppress(OSError):
            live.stop()


def _view(mechanism: str, target: str, rate: float, progress: Any) -> Any:
    from rich.markup import escape

    from controller.safety.causes import Cause, Mode

    table = new_table(f"{mechanism} follows {target} at {rate:g} Hz", "")
    latest = progress.latest
    if latest is None:
        table.add_row("state", "preparing plan, plant and machine code, which the first time is compiled (under a minute)")
        return table
    position, r = 1e3 * latest["position"], latest["rotation"]
    angles = (atan2(r[2, 1], r[2, 2]), asin(max(-1.0, min(1.0, -r[2, 0]))), atan2(r[1, 0], r[0, 0]))
    wake, compute = progress.timing.histograms["wake"].figures(), progress.timing.histograms["compute"].figures()
    errors = progress.errors()
    state = Mode(int(latest["mode"])).name.lower() + (f": {Cause(int(latest['stop'])).text}" if latest["stop"] else "")
    rows = (
        ("state", f"{state}, {latest['time_ns'] / 1e9:.1f} s"),
        ("position [mm]", "  ".join(f"{value:9.3f}" for value in position)),
        ("roll, pitch, yaw [deg]", "  ".join(f"{degrees(angle):9.3f}" for angle in angles)),
        ("estimate - truth, RMS [mm]", mm(errors["estimation"]) if errors["known"] else "the truth is not known"),
        ("reference - length, RMS [mm]", mm(errors["tracking"])),
        ("woken late p50, p99.9, max [us]", "  ".join(f"{wake[name]:.0f}" for name in ("p50", "p999", "max"))),
        ("computing p50, p99.9, max [us]", "  ".join(f"{compute[name]:.0f}" for name in ("p50", "p999", "max"))),
        ("periods missed, exchanges late", f"{progress.missed}, {progress.late}"),
        *(("stop", "Ctrl-C: controlled; Ctrl-\\: emergency"),),
        *(("without", text) for text in progress.refused),
        *(("", text) for text in progress.events),
    )
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    return table
