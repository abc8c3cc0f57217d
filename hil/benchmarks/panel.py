"""The benchmark of the panel: what it takes of a processor, and what the loop on the clock notices of it.

    operator --channel--> run <--channel-- panel <--websocket-- page

A page that takes what the panel sends and draws nothing stands for the browser: without a graphics card that would take a
processor of its own. In each round one run is measured without, with, and again without the panel: so it has the same memory
and processor in both, and what drifts cancels. What the panel costs shows in every round, and what the host does in some: so
the ratios are the medians over the rounds.

A hypervisor that stops the processor while the thread works may not tell, and then that time counts as the thread's own. Such
stalls come at any time: if the thread works for 4 % of the time, about 4 % of them hit it at work. The other 96 % are seen as
periods that the host missed. That tells how many cycles the stalls make too long at most.
"""

import json
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from hil.loop.records import COMPUTED, STAGES, shared_array
from hil.progress import Progress, no_progress
from hil.realtime.durations import Histogram, percentiles
from hil.realtime.processes import PATIENCE_S, join_or_kill, started
from hil.realtime.scheduling import processor_time, stolen_time
from hil.recording.mcap import read_run
from hil.runs.operator import Operator
from hil.runs.operator_messages import ChannelError
from plant.compiled import Record
from plant.errors import GoughError
from plant.extras import check_installed

LIMITS = {"p50": 1.05, "p999": 1.20, "missed_own": 0, "panel_cores": 0.25, "frames_hz": 27.0}
"""With the panel, by how much computing and lateness may be longer, how many periods own work may miss, how much of a processor
the panel may take, and how often the picture must change at least, of 30 times a second [Hz].
"""

RATIOS = ("compute", "wake"), ("p50", "p999")

FIELDS = ("cycle", "late_ns", "stage_ns", "cpu_ns", "missed")
"""What is kept of a record, which has 2 kB."""

_RATE = 1000.0
_ROUND_S = 10.0
_SETTLE_S = 1.0
"""What is left out after the panel has come or gone [s]."""

_STEP_M, _SPEED = 0.02, 0.02
_START_S, _POLL_S = 300.0, 0.02
_SPLITS, _SURE = 200, 0.95
_ESTABLISHED = "01"


@dataclass(frozen=True, eq=False)
class Slice:
    """A part of a run without or with the panel.

    Attributes:
        records: (N,), of its cycles, of dtype `RECORD` or with `FIELDS` of it.
        seconds: that it lasted.
        channel, panel: processor time that these processes took [s].
        stolen: time that a hypervisor kept the processors from running [s].
        frames, received: how often the picture changed, and bytes that the page received.
    """

    attached: bool
    records: Record
    seconds: float
    channel: float
    panel: float
    stolen: float
    frames: int
    received: int

    @cached_property
    def durations(self) -> dict[str, NDArray[np.int64]]:
        """Of computing and lateness, each (N,) [ns]."""
        return {"compute": self.records["stage_ns"][:, COMPUTED].sum(axis=1), "wake": self.records["late_ns"]}

    @cached_property
    def overran(self) -> NDArray[np.intp]:
        """Indices of the cycles whose own work missed periods."""
        return np.flatnonzero((self._busy[:-1] > 1e9 / _RATE) & (self.records["missed"][1:] > 0))

    @property
    def stalled(self) -> float:
        """How many of these are expected at most if the host stops the thread at any time, be it at work or not."""
        at_work = float(np.median(self._busy)) * _RATE * 1e-9
        return (np.count_nonzero(self.records["missed"]) - len(self.overran)) * at_work / (1.0 - at_work)

    @cached_property
    def _busy(self) -> NDArray[np.int64]:
        return np.asarray(np.minimum(self.records["stage_ns"].sum(axis=1), self.records["cpu_ns"]))

    @property
    def missed(self) -> tuple[int, int]:
        """Periods that were missed by own work, and by the host."""
        own = int(self.records["missed"][self.overran + 1].sum())
        return own, int(self.records["missed"].sum()) - own


def measure_panel(seconds: float, progress: Progress = no_progress) -> dict[str, Any]:
    """Time a run at 1 kHz for so many `seconds` without a panel, and as long with one; its platform moves to and fro.

    Returns:
        `without` and `with`: `compute_us` and `wake_us` (p50, p99, p999, max, n), `missed_own` and `missed_host` periods,
        `overran`: the cycles whose own work missed periods, with its processor time and that of each stage [us],
        `stalled`: how many of these the host's stalls explain at most, as some of them hit the thread at work,
        `channel_cores` and `panel_cores`, shares of a processor that these processes take, `stolen_cores` that a hypervisor
        took, `frames_hz` and `bytes_per_s` that the page receives, `histograms`.
        `ratios`: with over without, by `RATIOS`, median over the rounds. `noise`: within which factor of 1 such a median mostly
        stays for the two slices without a panel, one over the other, in an order that is drawn for each round.
        `refused`: measures for real time that the machine refuses.

    Raises:
        MissingPackageError: the panel's package is not installed.
        GoughError: the run or the panel ended early.
    """
    check_installed("viser")
    rounds = max(1, round(seconds / _ROUND_S))
    slices: list[Slice] = []
    refused: list[str] = []
    for done in range(rounds):
        measured, refused = _measure_round(seconds / rounds)
        slices += measured
        progress((done + 1) / rounds)
    return {"rate": _RATE, "rounds": rounds, "seconds": seconds, **figures_of(slices), "refused": refused}


def figures_of(slices: list[Slice]) -> dict[str, Any]:
    """The figures of slices, as `measure_panel` has them."""
    pools = {name: [each for each in slices if each.attached == (name == "with")] for name in ("without", "with")}
    figures: dict[str, Any] = {name: _figures(pool) for name, pool in pools.items()}
    rounds = [slices[first : first + 3] for first in range(0, len(slices), 3)]
    panels = np.array([_logarithms([attached], [before, after]) for before, attached, after in rounds])
    halves = np.array([_logarithms([before], [after]) for before, _, after in rounds])
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (_SPLITS, len(rounds), 1, 1))
    noise = np.quantile(np.abs(np.median(signs * halves, axis=1)), _SURE, axis=0)
    figures["ratios"], figures["noise"] = (_by_name(np.exp(each)) for each in (np.median(panels, axis=0), noise))
    return figures


def panel_excess(figures: dict[str, Any]) -> list[str]:
    """What is beyond the `LIMITS`, in words."""
    found = [
        f"{what} {which} {figures['ratios'][what][which]:.2f} times as long, limit {LIMITS[which]:g}"
        for what in RATIOS[0]
        for which in RATIOS[1]
        if figures["ratios"][what][which] > LIMITS[which]
    ]
    attached = figures["with"]
    if attached["missed_own"] > LIMITS["missed_own"]:
        found.append(
            f"missed_own {attached['missed_own']}, limit {LIMITS['missed_own']}: in {len(attached['overran'])} cycles, of "
            f"which the host's stalls explain {attached['stalled']:.1f} at most"
        )
    if attached["panel_cores"] > LIMITS["panel_cores"]:
        found.append(f"panel_cores {attached['panel_cores']:.3g}, limit {LIMITS['panel_cores']:g}")
    if attached["frames_hz"] < LIMITS["frames_hz"]:
        found.append(f"frames_hz {attached['frames_hz']:.3g}, at least {LIMITS['frames_hz']:g}")
    return [f"with a panel: {text}" for text in found]


def _logarithms(slices: list[Slice], others: list[Slice]) -> NDArray[np.float64]:
    """Of the durations of slices over those of others, an array by `RATIOS`."""
    over, under = (
        [percentiles(np.concatenate([each.durations[what] for each in pool]), RATIOS[1]) for what in RATIOS[0]]
        for pool in (slices, others)
    )
    return np.log([[of[which] / to[which] for which in RATIOS[1]] for of, to in zip(over, under, strict=True)])


def _by_name(figures: NDArray[np.float64]) -> dict[str, dict[str, float]]:
    return {what: dict(zip(RATIOS[1], row, strict=True)) for what, row in zip(RATIOS[0], figures.tolist(), strict=True)}


def _figures(slices: list[Slice]) -> dict[str, Any]:
    seconds = sum(each.seconds for each in slices)
    own, host = np.sum([each.missed for each in slices], axis=0).tolist()
    figures: dict[str, Any] = {"missed_own": own, "missed_host": host, "histograms": {}}
    for name in RATIOS[0]:
        durations, histogram = np.concatenate([each.durations[name] for each in slices]), Histogram()
        histogram.add(durations)
        figures[f"{name}_us"], figures["histograms"][name] = percentiles(durations), histogram.bars()
    for name, field in (
        ("channel_cores", "channel"), ("panel_cores", "panel"), ("stolen_cores", "stolen"),
        ("frames_hz", "frames"), ("bytes_per_s", "received"),
    ):  # fmt: skip
        figures[name] = sum(getattr(each, field) for each in slices) / seconds
    figures["stalled"] = sum(each.stalled for each in slices)
    figures["overran"] = [
        {
            "cycle": int(record["cycle"]),
            "cpu_us": float(record["cpu_ns"]) / 1e3,
            "stages_us": dict(zip(STAGES, (record["stage_ns"] / 1e3).tolist(), strict=True)),
        }
        for each in slices
        for record in each.records[each.overran]
    ]
    return figures


# ------------------------------------------------------------------------------------------------------------------- rounds


class _Sample(NamedTuple):
    """What has come together until now."""

    cycle: int
    time: float
    channel: float
    panel: float
    stolen: float
    frames: int
    received: int


class _Panel(NamedTuple):
    process: int
    counts: NDArray[np.int64]


def _measure_round(seconds: float) -> tuple[list[Slice], list[str]]:
    """The slices of a run: half of the time without a panel, all of it with one, and half without; and what it was refused."""
    with tempfile.TemporaryDirectory(prefix="gough-panel-") as folder:
        recording, summary = Path(folder) / "run.mcap", Path(folder) / "run.json"
        with _operated_run(recording, summary) as (operator, address):
            mover, channel = _Mover(operator), _process_at(address)

            def sampled(duration: float, panel: _Panel | None) -> tuple[_Sample, _Sample]:
                mover.move(_SETTLE_S)
                begin = _sample(operator, channel, panel)
                mover.move(duration)
                return begin, _sample(operator, channel, panel)

            samples = [(False, *sampled(seconds / 2.0, None))]
            with _attached_panel(address) as panel:
                samples.append((True, *sampled(seconds, panel)))
            samples.append((False, *sampled(seconds / 2.0, None)))
        records = repack_fields(read_run([recording])[1][list(FIELDS)])
        refused: list[str] = json.loads(summary.read_text())["refused"]
    slices = []
    for attached, begin, end in samples:
        within = (records["cycle"] >= begin.cycle) & (records["cycle"] < end.cycle)
        slices.append(
            Slice(
                attached, records[within], end.time - begin.time, end.channel - begin.channel, end.panel - begin.panel,
                end.stolen - begin.stolen, end.frames - begin.frames, end.received - begin.received,
            )
        )  # fmt: skip
    return slices, refused


def _sample(operator: Operator, channel: int, panel: _Panel | None) -> _Sample:
    cycle = operator.ask("state")["telemetry"]["cycle"]
    frames, received = (0, 0) if panel is None else panel.counts.tolist()
    own = 0.0 if panel is None else processor_time(panel.process)
    return _Sample(cycle, time.monotonic(), processor_time(channel), own, stolen_time(), frames, received)


class _Mover:
    """An operator who moves the platform to and fro, so that there is something to draw."""

    def __init__(self, operator: Operator) -> None:
        self._operator, self._arrives = operator, 0.0
        self._steps = cycle([(_STEP_M, 0.0, 0.0), (-_STEP_M, 0.0, 0.0)])

    def move(self, seconds: float) -> None:
        """Do so for a time."""
        until = time.monotonic() + seconds
        while (now := time.monotonic()) < until:
            if now >= self._arrives and not self._operator.ask("state")["telemetry"]["moving"]:
                self._arrives = now + self._operator.step(next(self._steps), speed=_SPEED, wait=False)["duration"]
            time.sleep(max(0.0, min(max(self._arrives - now, _POLL_S), until - now)))


@contextmanager
def _operated_run(recording: Path, summary: Path) -> Iterator[tuple[Operator, str]]:
    """A run that is under way; yields its operator and the address of its channel. It ends by a controlled stop."""
    address = f"127.0.0.1:{_free_port()}"
    # However long the host holds it up, it goes on; it ends some time even if this process is killed.
    options = ["--rate", f"{_RATE:g}", "--duration", "600", "--most-missed", "1000000"]
    files = ["--record", str(recording), "--json", str(summary)]
    with _command("run", "--target", f"operator:{address}", *options, *files) as run:
        _await(lambda: run.poll() is not None or _moves(address), "the run does not begin", _START_S)
        if run.poll() is not None:
            raise _ended(run)
        try:
            with Operator(address, name="gough bench") as operator:
                yield operator, address
                operator.end()
        except ChannelError as error:
            _await(lambda: run.poll() is not None, f"{error}, and the run does not end")
            raise _ended(run) from error
        _await(lambda: run.poll() is not None, "the run does not end")
        if run.returncode != 0:
            raise _ended(run)


def _moves(address: str) -> bool:
    with suppress(ChannelError), Operator(address, role="observer") as observer:
        return bool(observer.ask("state")["telemetry"]["time"] > 0.0)
    return False


@contextmanager
def _attached_panel(address: str) -> Iterator[_Panel]:
    """A panel that is attached to a run, and a page that has its picture."""
    host, port = "127.0.0.1", _free_port()
    with _command("panel", "--at", address, "--listen", f"{host}:{port}", "--no-browser") as panel:
        assert panel.stdout is not None
        if not panel.stdout.readline().startswith("the panel is at"):
            raise _ended(panel)
        counts: NDArray[np.int64] = shared_array(2, np.dtype(np.int64))
        page = started(_read_page, host, port, counts)
        try:
            _await(lambda: bool(counts[0]), "the panel draws nothing")
            yield _Panel(panel.pid, counts)
        finally:
            panel.terminate()
            join_or_kill(page)


def _read_page(host: str, port: int, counts: NDArray[np.int64]) -> None:
    """Take what a panel sends until it ends; counts how often the picture changed, and bytes. The body of a process."""
    import msgpack
    import zstandard
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    unpack, changes = zstandard.ZstdDecompressor().decompress, {"SceneNodeUpdateMessage", "SetPositionMessage"}
    speaks = [Subprotocol(f"viser-v{version('viser')}")]
    connection = socket.create_connection((host, port))
    with (
        suppress(ConnectionClosed),
        connect(f"ws://{host}:{port}", sock=connection, subprotocols=speaks, max_size=None) as page,
    ):
        for frame in page:
            assert isinstance(frame, bytes)
            size = int.from_bytes(frame[8:16], "little")
            told = msgpack.unpackb(unpack(frame[16 : 16 + size]))["messages"]
            counts += int(any(each["type"] in changes for each in told)), len(frame)


@contextmanager
def _command(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A command of gough in a process of its own, which ends with the context."""
    command = [sys.executable, "-m", "hil.command_line", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def _ended(process: subprocess.Popen[str]) -> GoughError:
    said, _ = process.communicate()
    return GoughError(f"a process of the benchmark ended with status {process.returncode}:\n{said}")


def _await(what: Callable[[], bool], otherwise: str, seconds: float = PATIENCE_S) -> None:
    """Wait until something is true.

    Raises:
        GoughError: it takes too long.
    """
    until = time.monotonic() + seconds
    while not what():
        if time.monotonic() > until:
            raise GoughError(f"{otherwise} within {seconds:g} s")
        time.sleep(_POLL_S)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _process_at(address: str) -> int:
    """The process that serves the connections to an address of this machine."""
    port = int(address.rpartition(":")[2])
    connections = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    served = {f"socket:[{each[9]}]" for each in connections if each[1].endswith(f":{port:04X}") and each[3] == _ESTABLISHED}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if any(str(file.readlink()) in served for file in (process / "fd").iterdir()):
                return int(process.name)
    raise GoughError(f"no process of this user serves {address}")
