"""Benchmarks of the loop on the clock: how late it wakes and how long it computes, idle and under load.

Short slices of three loops take turns, so that disturbances by the machine show in all: ours, cyclictest, and a bare compiled
loop that only computes, for as long as ours.
"""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.safety.arming import longest_delay
from controller.safety.causes import Cause, Reaction
from hil.loop.driver import prevent_compilation
from hil.loop.records import RECORD, Link, shared_array
from hil.loop.stage_times import Timing, over_budget
from hil.progress import Progress, no_progress, part_of
from hil.realtime.clock import REAL, finish, new_clock, start, wait
from hil.realtime.durations import Histogram
from hil.realtime.processes import FORK
from hil.realtime.scheduling import MEASURES, RealTimeSettings, real_time, usage
from hil.runs.config import SimulationConfig
from hil.runs.prepare import prepared_loop
from plant.compiled import Record, kernel
from plant.errors import GoughError
from plant.stopwatch import now

IDLE, LOAD, BUSY = "idle", "load", "busy_supervisor"
CONDITIONS = {IDLE: 1.0, LOAD: 1.0, BUSY: 0.25}
"""Shares of time: nothing else runs; stress-ng on every processor; a busy Python thread in the supervising process."""

_SLICE_S = 2.0
_BARE_SHARE = 1.0
_SURE = 1e-3
"""How likely it may be by chance that our loop overran so much more often than the bare one, to be told as an excess."""
_BURST_S = 0.05
"""Overruns that follow each other sooner count once: a pause of the host spoils many cycles [s]."""

_LONGEST_US = 20_000
_ENDLESS = np.iinfo(np.int64).max


def measure_real_time(seconds: dict[float, float], progress: Progress = no_progress) -> dict[str, Any]:
    """Time loops on the clock, for so many `seconds` by rate [Hz], idle and again under load.

    Returns:
        `rates`: by rate and condition, `compute_us`, `latency_us`, `wake_us`, `cyclictest_us` (None without it), and
        `bare_us` and `bare_wake_us` of the bare loop, each with p50, p99, p999, max and n; `stages_us`; `over_budget`;
        `missed_own` and `missed_host` periods; how often ours and the bare loop `overran` their period; `usage`;
        `histograms`. `refused`: measures for real time that the machine refuses. `missing`: programs that it lacks.

    Raises:
        GoughError: the loop stopped before the end of its slice.
    """
    settings = RealTimeSettings()
    missing = [name for name in ("cyclictest", "stress-ng") if shutil.which(name) is None]
    with real_time(settings) as refused:
        pass
    shares = {each: share for each, share in CONDITIONS.items() if each != LOAD or "stress-ng" not in missing}
    rates, whole, done = {}, sum(seconds.values()), 0.0
    for rate, duration in seconds.items():
        bench = _Bench(rate, settings, compare=True)
        _take_turns([bench], shares, duration, part_of(progress, done / whole, duration / whole))
        rates[f"{rate:g}"] = {condition: pool.figures() for condition, pool in bench.pools.items()}
        done += duration
    return {"rates": rates, "refused": refused, "missing": missing, "slice_s": _SLICE_S}


def measure_measures(seconds: float, progress: Progress = no_progress) -> dict[str, Any]:
    """The effect of each measure for real time: the loop at 1 kHz with all, without each, and without any.

    Returns:
        By the measure left out ("nothing" and "all" included) and condition: `wake_us`, `compute_us`, the periods
        `missed`, and `minor_faults` of the loop's thread.
    """
    cases = {"nothing": (), **{measure: (measure,) for measure in MEASURES}, "all": MEASURES}
    benches = {case: _Bench(1000.0, RealTimeSettings(without=left_out), compare=False) for case, left_out in cases.items()}
    conditions = [IDLE] if shutil.which("stress-ng") is None else [IDLE, LOAD]
    _take_turns(list(benches.values()), dict.fromkeys(conditions, 1.0), seconds, progress)
    return {
        case: {
            condition: {
                **{f"{name}_us": pool.timing.histograms[name].figures() for name in ("wake", "compute")},
                "missed": pool.counts["missed_own"] + pool.counts["missed_host"],
                "minor_faults": pool.counts["minor_faults"],
            }
            for condition, pool in bench.pools.items()
        }
        for case, bench in benches.items()
    }


def _take_turns(benches: list["_Bench"], shares: dict[str, float], seconds: float, progress: Progress) -> None:
    """Run slices of all benches in turn, as the machine changes with time, for shares of `seconds` by condition."""
    counts = {condition: max(1, round(seconds * share / _SLICE_S)) for condition, share in shares.items()}
    whole, done = len(benches) * sum(counts.values()), 0
    for condition, count in counts.items():
        with _circumstances(condition, len(benches) * count * _SLICE_S):
            for bench in benches * count:
                bench.add_slice(condition)
                done += 1
                progress(done / whole)


class _Pool:
    """The measurements of all slices of a condition; `counts` has missed periods and the thread's usage."""

    def __init__(self) -> None:
        self.timing, self.counts = Timing(), Counter[str]()
        self.cyclictest, self.bare, self.bare_wake = Histogram(), Histogram(), Histogram()
        self.overran = [0, 0]

    def figures(self) -> dict[str, Any]:
        timing, counts = self.timing.figures(), dict(self.counts)
        shown = {name: self.timing.histograms[name] for name in ("compute", "latency", "wake")}
        shown |= {"cyclictest": self.cyclictest, "bare": self.bare}
        return {
            "over_budget": over_budget(timing),
            **{f"{name}_us": timing.pop(name) for name in ("compute", "latency", "wake")},
            "cyclictest_us": self.cyclictest.figures() if self.cyclictest.longest else None,
            "bare_us": self.bare.figures(),
            "bare_wake_us": self.bare_wake.figures(),
            "stages_us": timing,
            **{name: counts.pop(name) for name in ("missed_own", "missed_host")},
            "overran": dict(zip(("ours", "bare"), self.overran, strict=True)),
            "usage": counts,
            "histograms": {name: histogram.bars() for name, histogram in shown.items()},
        }


class _Bench:
    """The loops of one rate, prepared once: ours, and the others if it is to `compare`. A slice has its own process."""

    def __init__(self, rate: float, settings: RealTimeSettings, compare: bool) -> None:
        self.pools = defaultdict[str, _Pool](_Pool)
        self._config = SimulationConfig(target="sines", duration=_SLICE_S, rate=rate)
        self._settings, self._compare = settings, compare
        self._cyclictest = compare and shutil.which("cyclictest") is not None
        with prepared_loop(self._config) as loop:
            self._records = shared_array(loop.end + longest_delay(loop.parameters), RECORD)
        _run_bare(new_clock(0, 1), 0, 0, np.zeros((1, 2), np.int64))

    def add_slice(self, condition: str) -> None:
        """Run our loop, and to compare with it cyclictest and the bare loop, one after the other."""
        pool = self.pools[condition]
        with _busy_thread() if condition == BUSY else nullcontext():
            count, counts = _in_a_process(self._ours)
        records, period = self._records[:count], 1e9 / self._config.rate
        pool.timing.add(records)
        pool.counts.update(counts)
        busy = np.minimum(records["stage_ns"].sum(axis=1), records["cpu_ns"])
        # After missed periods the simulated plant catches up, which no rig does.
        pool.overran[0] += count_bursts((busy > period) & (records["missed"] == 0), self._config.rate)
        if self._cyclictest:
            self._run_cyclictest(pool.cyclictest)
        if self._compare:
            work = round(1e3 * pool.timing.histograms["compute"].figures()["p50"])
            durations: Record = _in_a_process(self._bare, work)
            pool.bare_wake.add(durations[:, 0])
            pool.bare.add(durations[:, 1])
            pool.overran[1] += count_bursts(durations[:, 1] > period, self._config.rate)

    def _ours(self) -> tuple[int, dict[str, Any]]:
        with prepared_loop(self._config, self._records) as loop:
            loop.clock, loop.most_missed = self._clock(), _ENDLESS
            with prevent_compilation(), real_time(self._settings):
                before = usage()
                cause = loop.follow(loop.end)
                used = usage().since(before)
            if Cause(cause).reaction != Reaction.STOP:
                raise GoughError(f"the loop stopped in the benchmark: {loop.reason()}")
            own, late, host = (int(loop.clock[f"missed_{by}"]) for by in ("own", "late", "host"))
            return int(loop.link[Link.HEAD]), {"missed_own": own, "missed_host": late + host, **used}

    def _bare(self, work_ns: int) -> NDArray[np.int64]:
        durations = np.zeros((round(_BARE_SHARE * _SLICE_S * self._config.rate), 2), np.int64)
        clock = self._clock()
        turns = max(1, work_ns * 1000 // max(_time_bare(np.zeros(2, np.int64)), 1))
        with real_time(self._settings):
            _run_bare(clock, len(durations), turns, durations)
        return durations

    def _clock(self) -> Record:
        return new_clock(REAL, round(1e9 / self._config.rate))

    def _run_cyclictest(self, histogram: Histogram) -> None:
        """Run cyclictest and count its wake-ups; without privileges it does not run, nor is it tried again."""
        period_us, loops = round(1e6 / self._config.rate), round(_SLICE_S * self._config.rate)
        settings = self._settings
        command = ["cyclictest", "-q", "-m", "-t1", f"-a{settings.processor}", f"-p{settings.priority}", f"-i{period_us}"]
        output = subprocess.run(
            [*command, f"-l{loops}", f"-h{_LONGEST_US}"], capture_output=True, text=True, check=False, timeout=60.0
        )
        if output.returncode:
            self._cyclictest = False
            return
        counts, longest = np.zeros(_LONGEST_US + 1, np.int64), 0
        for line in output.stdout.splitlines():
            if line.startswith("# Histogram Overflows:"):
                counts[-1] += int(line.split(":")[1])
            elif line.startswith("# Max Latencies:"):
                longest = int(line.split(":")[1])
            elif line and not line.startswith("#"):
                us, count = line.split()
                counts[int(us)] += int(count)
        histogram.add(durations_of(counts))
        histogram.longest = max(histogram.longest, 1000 * longest)


def durations_of(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Durations [ns] for counts by whole microseconds, spread evenly over each."""
    parts = [1000 * us + 1000 * np.arange(count) // count for us, count in enumerate(counts.tolist()) if count]
    return np.concatenate(parts) if parts else np.zeros(0, np.int64)


def _in_a_process(target: Callable[..., Any], *arguments: Any) -> Any:
    """What a function returns in a process that shares the memory of this one."""

    def send() -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            theirs.send(target(*arguments))
        except GoughError as error:
            theirs.send(error)

    ours, theirs = FORK.Pipe()
    process = FORK.Process(target=send)
    process.start()
    theirs.close()
    try:
        result = ours.recv()
    except EOFError:
        raise GoughError("a loop's process has died in the benchmark") from None
    process.join()
    if isinstance(result, GoughError):
        raise result
    return result


@kernel
def _compute_bare(turns: int) -> float:
    """Compute without memory: a logistic map."""
    x = 0.3
    for _ in range(turns):
        x = 3.7 * x * (1.0 - x)
    return x


@kernel
def _time_bare(timespec: NDArray[np.int64]) -> int:
    """Nanoseconds of a thousand turns."""
    least, x = 1_000_000_000, 0.0
    for _ in range(20):
        began = now(timespec)
        x += _compute_bare(1000)
        least = min(least, now(timespec) - began)
    # The compiler would drop work without a result.
    return least if x > 0.0 else 0


@kernel
def _run_bare(clock: Record, cycles: int, turns: int, durations: NDArray[np.int64]) -> float:
    """The bare loop: write lateness and computing time of each cycle [ns]."""
    c, x = clock[()], 0.0
    script = np.zeros((1, 3), np.int64)
    if cycles > 0:
        start(clock)
    for i in range(cycles):
        wait(clock, script)
        began = now(c.timespec)
        x += _compute_bare(turns)
        durations[i, 1] = now(c.timespec) - began
        durations[i, 0] = c.late
        finish(clock, script, durations[i, 1])
    return x


@contextmanager
def _circumstances(condition: str, seconds: float) -> Iterator[None]:
    """The load, if this is the condition, for slices of so many seconds."""
    if condition != LOAD:
        yield
        return
    cores = str(os.cpu_count() or 1)
    command = ["stress-ng", "--cpu", cores, "--vm", "1", "--vm-bytes", "128M", "--hdd", "1", "--hdd-bytes", "16M", "--quiet"]
    # It ends some time even if this process is killed.
    command += ["--timeout", f"{60 + round(10.0 * seconds)}s"]
    with (
        tempfile.TemporaryDirectory(prefix="gough-load-") as folder,
        subprocess.Popen([*command, "--temp-path", folder]) as load,
    ):
        try:
            yield
        finally:
            load.terminate()


@contextmanager
def _busy_thread() -> Iterator[None]:
    """A busy Python thread, started after the fork of the measured process."""
    over = threading.Event()

    def turn() -> None:
        while not over.is_set():
            sum(range(1000))

    starter = threading.Timer(0.2, turn)
    starter.start()
    try:
        yield
    finally:
        over.set()
        starter.join()


def measure_start_up(cold: bool) -> dict[str, float | None]:
    """Seconds from the start of `gough run` to its first cycle: with caches and, if `cold`, without."""

    def first_cycle(**cache: str) -> float:
        with tempfile.TemporaryDirectory(prefix="gough-start-") as folder:
            path = Path(folder) / "run.json"
            # However long the host holds up the run, this measures its start.
            command = [sys.executable, "-m", "hil.command_line", "run", "--target", "hold", "--duration", "0.1"]
            command += ["--most-missed", "1000000", "--json", str(path)]
            run = subprocess.run(command, env={**os.environ, **cache}, check=False, capture_output=True, text=True)
            if run.returncode != 0:
                raise GoughError(f"{' '.join(command)} ended with status {run.returncode}:\n{run.stdout}{run.stderr}")
            return float(json.loads(path.read_text())["start_up_s"])

    figures: dict[str, float | None] = {"cold_s": None}
    if cold:
        with tempfile.TemporaryDirectory(prefix="gough-cold-") as cache:
            figures["cold_s"] = first_cycle(GOUGH_CACHE=cache)
    first_cycle()
    return {**figures, "cached_s": min(first_cycle() for _ in range(3))}


class GrossExcessError(GoughError, RuntimeError):
    """The loop on the clock is slower than any noise explains."""

    exit_status = 1


def gross_excess(figures: dict[str, Any]) -> list[str]:
    """Excesses beyond the noise of any machine, in words, for continuous integration."""
    found = []
    for rate, conditions in figures["rates"].items():
        for condition, measured in conditions.items():
            compute, faults = measured["compute_us"]["p50"], measured["usage"]["major_faults"]
            slow, overran = compute / max(measured["bare_us"]["p50"], 1.0), measured["overran"]
            checks = (
                (_own_overruns(measured), f"ours overran {overran['ours']} times, the bare loop {overran['bare']}"),
                (not figures["refused"] and faults, f"{faults:g} major page faults in the loop"),
                (condition == IDLE and compute > 100.0, f"computing takes {compute:.0f} us"),
                (slow > 10.0, f"computing takes {slow:.0f} times as long as a bare loop of the same work"),
            )
            found += [f"{rate} Hz, {condition}: {text}" for exceeded, text in checks if exceeded]
    return found


def count_bursts(overran: NDArray[np.bool_], rate: float) -> int:
    """How often cycles (N,) at this rate [Hz] overran their period, bursts counted once."""
    cycles = np.flatnonzero(overran)
    return int(len(cycles) > 0) + int((np.diff(cycles) > _BURST_S * rate).sum())


def _own_overruns(measured: dict[str, Any]) -> bool:
    """Whether our loop overran its period more often than chance explains beside the bare one, which only the machine holds up.

    A virtual machine's host takes time that counts as the thread's own, so single overruns tell nothing.
    """
    ours, bare = measured["overran"]["ours"], measured["overran"]["bare"]
    cycles = measured["compute_us"]["n"], measured["bare_us"]["n"]
    share, both = cycles[0] / sum(cycles), ours + bare
    by_chance: float = sum(math.comb(both, n) * share**n * (1.0 - share) ** (both - n) for n in range(ours, both + 1))
    return by_chance < _SURE
