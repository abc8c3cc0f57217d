"""What a thread needs to keep its rate: priority, a processor, no deep idle states, locked memory; and its usage of them.

A measure that the machine refuses is reported with a remedy, and can be an error. Everything is restored at the end.
"""

import ctypes
import errno
import gc
import os
import resource
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from hil.option import option
from plant.errors import GoughError, InputError, UnknownNameError

MEASURES = ("memory", "processor", "doze", "priority")
"""The measures for real time, in their order: lock memory, stay on a processor, forbid deep idle states, take a priority."""

PRIORITY_RANGE = (1, 98)
"""Priorities of SCHED_FIFO; 99 is for the kernel's own threads."""

_DMA_LATENCY = Path("/dev/cpu_dma_latency")
_MCL_CURRENT, _MCL_FUTURE = 1, 2


def keep_to_one_thread() -> None:
    """Keep OpenBLAS from starting threads, which the loop's process would have too. Call it before NumPy is loaded."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@dataclass(frozen=True)
class RealTimeSettings:
    """How a loop is run."""

    priority: int = option(80, "priority of SCHED_FIFO, 1 to 98")
    cpu: int | None = option(None, "processor to stay on", parse=int, shown="the last one that the process may use")
    strict: bool = option(False, "do not run if the machine refuses anything that real time needs")
    most_missed: int = option(10, "number of periods missed in a row that end in a controlled stop")
    without: tuple[str, ...] = ()  # the measures that are left out, to see what each gives

    def __post_init__(self) -> None:
        if not PRIORITY_RANGE[0] <= self.priority <= PRIORITY_RANGE[1]:
            raise InputError(f"the priority is {self.priority}; it must be {PRIORITY_RANGE[0]} to {PRIORITY_RANGE[1]}")
        if self.most_missed < 1:
            raise InputError(f"most_missed is {self.most_missed}; it must be 1 at least")
        for measure in self.without:
            if measure not in MEASURES:
                raise UnknownNameError(f"there is no measure {measure!r}; there are {', '.join(MEASURES)}")
        allowed = sorted(os.sched_getaffinity(0))
        if self.cpu is not None and self.cpu not in allowed:
            raise InputError(f"there is no processor {self.cpu} for this process; there are {', '.join(map(str, allowed))}")

    @property
    def processor(self) -> int:
        """The processor to stay on."""
        return max(os.sched_getaffinity(0)) if self.cpu is None else self.cpu

    @property
    def kept_processor(self) -> int | None:
        """The processor that others leave to the loop; None if it stays on none."""
        return None if "processor" in self.without else self.processor


class RefusedError(GoughError, PermissionError):
    """The machine refuses a measure, and the settings are strict."""


@contextmanager
def real_time(settings: RealTimeSettings) -> Iterator[list[str]]:
    """Make the calling thread a real-time thread while the context lasts; yields the measures that the machine refused.

    Raises:
        RefusedError: a measure was refused, and the settings are strict.
    """
    cpu, priority, refused = settings.processor, settings.priority, []
    raise_limit = "run as root, or raise the limit {!r} in /etc/security/limits.conf"
    measures = (
        ("memory", "locked memory", _lock_memory, raise_limit.format("memlock")),
        ("processor", f"staying on processor {cpu}", lambda: _stay_on(cpu), "choose another with --cpu"),
        ("doze", f"no deep idle states ({_DMA_LATENCY})", _stay_awake, "run as root, or let your group write to it"),
        ("priority", f"SCHED_FIFO at priority {priority}", lambda: _take_priority(priority), raise_limit.format("rtprio")),
    )
    with ExitStack() as restore:
        # Before the priority is taken, as another loop on this processor would wait for the collection.
        gc.collect()
        gc.disable()
        restore.callback(gc.enable)
        for measure, what, take, remedy in measures:
            if measure in settings.without:
                continue
            try:
                restore.callback(take())
            except OSError as error:
                refused.append(f"{what}: {os.strerror(error.errno or 0)}: {remedy}")
        if refused and settings.strict:
            raise RefusedError(f"this machine refuses {'; '.join(refused)}; or run without --strict")
        yield refused


@contextmanager
def processor_left(cpu: int | None) -> Iterator[None]:
    """Leave a processor to a loop while the context lasts, if there is another: all threads of this process stay away from it,
    and so do the threads and processes that they start. None leaves none.
    """
    before: dict[int, set[int]] = {}
    for thread in [int(each.name) for each in Path("/proc/self/task").iterdir()] if cpu is not None else []:
        # A thread may have ended.
        with suppress(OSError):
            allowed = os.sched_getaffinity(thread)
            if cpu in allowed and len(allowed) > 1:
                os.sched_setaffinity(thread, allowed - {cpu})
                before[thread] = allowed
    try:
        yield
    finally:
        for thread, allowed in before.items():
            with suppress(OSError):
                os.sched_setaffinity(thread, allowed)


@contextmanager
def before_others() -> Iterator[None]:
    """Let the calling thread, which plans for a loop, come before all that is not real-time while the context lasts, as far as
    the machine allows it.
    """
    with ExitStack() as restore:
        with suppress(OSError):
            restore.callback(_take_priority(PRIORITY_RANGE[0]))
        yield


def _lock_memory() -> Callable[[], Any]:
    library = ctypes.CDLL(None, use_errno=True)
    if library.mlockall(_MCL_CURRENT | _MCL_FUTURE):
        number = ctypes.get_errno()
        library.munlockall()
        raise OSError(errno.EPERM if number == errno.ENOMEM else number, "mlockall")
    return lambda: library.munlockall()


def _stay_on(cpu: int) -> Callable[[], Any]:
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {cpu})
    return lambda: os.sched_setaffinity(0, before)


def _stay_awake() -> Callable[[], Any]:
    descriptor = os.open(_DMA_LATENCY, os.O_WRONLY)
    os.write(descriptor, struct.pack("i", 0))
    return lambda: os.close(descriptor)


def _take_priority(priority: int) -> Callable[[], Any]:
    policy, before = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    return lambda: os.sched_setscheduler(0, policy, before)


class Usage(NamedTuple):
    """The usage of the calling thread, and of its process's memory."""

    major_faults: int  # pages that were read in
    minor_faults: int  # pages that were only mapped
    voluntary_switches: int  # how often the thread waited
    involuntary_switches: int  # how often it lost the processor
    resident: int  # memory of the process [bytes]
    cpu: float  # processor time [s]

    def since(self, before: "Usage") -> dict[str, float]:
        """The differences, by name."""
        return {name: getattr(self, name) - getattr(before, name) for name in self._fields}


def usage() -> Usage:
    """The calling thread's usage so far."""
    used = resource.getrusage(resource.RUSAGE_THREAD)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return Usage(
        used.ru_majflt, used.ru_minflt, used.ru_nvcsw, used.ru_nivcsw, pages * resource.getpagesize(),
        used.ru_utime + used.ru_stime,
    )  # fmt: skip


def since_process_start() -> float:
    """Time since the start of this process [s], to a hundredth."""
    started = int(_status("self")[19]) / os.sysconf("SC_CLK_TCK")
    return float(Path("/proc/uptime").read_text().split()[0]) - started


def processor_time(process: int) -> float:
    """Processor time that a process has taken so far [s], to a hundredth."""
    user, system = _status(process)[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def stolen_time() -> float:
    """Time that a hypervisor has kept this machine's processors, taken together, from work that they had so far [s], to a
    hundredth. 0 where there is no hypervisor, or where it does not tell.
    """
    total = Path("/proc/stat").read_text().partition("\n")[0].split()
    return int(total[8]) / os.sysconf("SC_CLK_TCK")


def _status(process: int | str) -> list[str]:
    """The fields of `/proc/PROCESS/stat` after the name, which may have blanks in it."""
    return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
