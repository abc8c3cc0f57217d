"""What the terminal shows: numbers, progress, and the state of a run."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from math import asin, atan2, degrees
from typing import TYPE_CHECKING, Any

from hil.table import Table

if TYPE_CHECKING:
    from hil.engine.engine import Engine
    from hil.engine.settings import EngineSettings
    from hil.runs.run_state import RunState

QUANTILES = {"p50": "p50", "p99": "p99", "p99.9": "p999", "max": "max"}
"""How each quantile is printed, and its name in the figures."""

_COMPILED_FUNCTIONS = 555
"""About how many functions numba compiles for the first simulation on a machine, in two processes."""

_QUIET_S = 10.0
"""Without a terminal, a line tells at most so often that work goes on [s]."""


def say(text: str) -> None:
    """Print a line that is no result."""
    print(text, file=sys.stderr)


def mm(metres: float, digits: int = 3) -> str:
    """A length [m] in millimetres."""
    return f"{1e3 * metres:.{digits}f}"


def deg(angle: float, digits: int = 3) -> str:
    """An angle [rad] in degrees."""
    return f"{degrees(angle):.{digits}f}"


def number_text(value: float) -> str:
    """A number with three digits, or all before the point."""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def duration(seconds: float) -> str:
    """A time [s] in the unit that suits it."""
    for unit, length in (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2.0 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.3g} s"


def mm_deg(errors: dict[str, float], prefix: str = "") -> str:
    """The RMS errors of a pose, in millimetres and degrees."""
    return f"{mm(errors[f'{prefix}position_rms'])}, {deg(errors[f'{prefix}rotation_rms'])}"


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[..., None]]:
    """A progress bar. It pulses until it is called with the share that is done, and may be a new label."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    terminal = sys.stderr.isatty()
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not terminal) as bar:
        task, tell = bar.add_task(label, total=None), _told_now_and_then()

        def compiling(functions: int) -> None:
            most = max(_COMPILED_FUNCTIONS, functions)
            text = f"compiling function {functions} of about {most} (once; the next start takes seconds)"
            if not terminal:
                tell(text)
            # A bar that has reached its end would stand still, and its clock, too.
            bar.update(task, total=max(_COMPILED_FUNCTIONS, functions + 1), completed=functions, description=text)

        def show(share: float, now: str = label) -> None:
            bar.update(task, total=1.0, completed=share, description=now)

        # Loads numba, so the bar is drawn first.
        from plant.compiled import compilation_reported

        with compilation_reported(compiling):
            yield show


def _told_now_and_then() -> Callable[[str], None]:
    """What prints a line if none was printed for a while."""
    last = -_QUIET_S

    def tell(text: str) -> None:
        nonlocal last
        if time.monotonic() - last >= _QUIET_S:
            print(text, file=sys.stderr, flush=True)
            last = time.monotonic()

    return tell


@contextmanager
def engine_at_work(settings: "EngineSettings", label: str) -> Iterator[tuple["Engine", Callable[..., None]]]:
    """The engine of a study, opened when there is work for it, and the bar of its progress."""
    with progress_bar(label) as progress:
        from hil.engine.engine import engine_when_needed

        def tell(opened: "Engine") -> None:
            if opened.dashboard:
                print(f"the workers at their work: {opened.dashboard}", file=sys.stderr)
            if opened.joined_at:
                files = "".join(f" --tls-{name} FILE.pem" for name in ("ca-file", "cert", "key")) if settings.tls else ""
                print(
                    "other machines join with: DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False dask worker "
                    f"{opened.joined_at} --nworkers -1 --nthreads 1 --dashboard-address 127.0.0.1:0{files}",
                    file=sys.stderr,
                )

        with engine_when_needed(settings, tell) as engine:
            yield engine, progress


@contextmanager
def live_view(mechanism: str, target: str, rate: float) -> Iterator[Callable[["RunState"], None]]:
    """A view of a run, updated whenever it is called; without a terminal, only a line now and then until it begins."""
    from rich.console import Console
    from rich.live import Live

    title, began = f"{mechanism} follows {target} at {rate:g} Hz", time.monotonic()
    if not sys.stderr.isatty():
        tell = _told_now_and_then()
        yield lambda state: tell(_preparing(began)) if state.latest is None and time.monotonic() - began > _QUIET_S else None
        return
    live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)

    def show(state: "RunState") -> None:
        # The motion goes on when the terminal has gone.
        with suppress(OSError):
            live.update(_view(title, state, began).rich(), refresh=True)

    live.start()
    try:
        yield show
    finally:
        with suppress(OSError):
            live.stop()


def _preparing(began: float) -> str:
    waited = time.monotonic() - began
    return f"preparing plan, plant and machine code (compiled once: the next start takes seconds), {waited:.0f} s"


def _view(title: str, state: "RunState", began: float) -> Table:
    from controller.frames import BASE
    from controller.safety.causes import Cause, Mode
    from plant.pose import Pose

    table = Table(title, "")
    latest: Any = state.latest
    if latest is None:
        table.add("state", _preparing(began))
        return table
    position, r, of = 1e3 * latest["position"], latest["rotation"], ""
    if state.frames is not None and state.frames.root == BASE:
        tool = state.frames.read(Pose(latest["position"], r))
        position, r, of = 1e3 * tool.position, tool.rotation, f" of {state.frames.text}"
    angles = (atan2(r[2, 1], r[2, 2]), asin(max(-1.0, min(1.0, -r[2, 0]))), atan2(r[1, 0], r[0, 0]))
    errors, histograms = state.errors(), state.timing.histograms
    mode = Mode(int(latest["mode"])).name.lower()
    if latest["stop"]:
        mode += f": {Cause(int(latest['stop'])).text}"
    table.add("state", f"{mode}, {latest['time_ns'] / 1e9:.1f} s")
    table.add(f"position{of} [mm]", "  ".join(f"{value:9.3f}" for value in position))
    table.add("roll, pitch, yaw [deg]", "  ".join(f"{degrees(angle):9.3f}" for angle in angles))
    table.add("estimate - truth, RMS [mm]", mm(errors["estimation"]) if errors["known"] else "the truth is not known")
    table.add("reference - length, RMS [mm]", mm(errors["tracking"]))
    for label, name in (("woken late", "wake"), ("computing", "compute")):
        figures = histograms[name].figures()
        table.add(f"{label} p50, p99.9, max [us]", "  ".join(f"{figures[key]:.0f}" for key in ("p50", "p999", "max")))
    table.add("periods missed, exchanges late", f"{state.missed}, {state.late}")
    table.add("stop", "Ctrl-C: controlled; Ctrl-\\: emergency")
    for text in state.refused:
        table.add("without", text)
    for text in state.events:
        table.add("", text)
    return table
