"""The processes of a sweep, started as a user starts them, and killed."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

PATIENCE_S = 120.0


def wait_until(holds: Callable[[], object], what: str, patience: float = PATIENCE_S) -> None:
    """Wait until something holds."""
    last = time.monotonic() + patience
    while not holds():
        if time.monotonic() > last:
            raise AssertionError(f"{what}: not within {patience:g} s")
        time.sleep(0.02)


@dataclass
class Process:
    """A process in a session of its own, with all that it starts."""

    popen: "subprocess.Popen[bytes]"
    errors: Path

    @property
    def running(self) -> bool:
        return self.popen.poll() is None

    @property
    def text(self) -> str:
        """What it has written on standard error."""
        return self.errors.read_text()

    def family(self) -> list[psutil.Process]:
        """The process and all its children."""
        try:
            top = psutil.Process(self.popen.pid)
            return [top, *top.children(recursive=True)]
        except psutil.NoSuchProcess:
            return []

    def workers(self) -> list[psutil.Process]:
        """The children that work."""
        found = []
        for each in self.family()[1:]:
            with suppress(psutil.Error):
                if any("spawn_main" in part for part in each.cmdline()):
                    found.append(each)
        return found

    def kill(self) -> None:
        """Kill it, and see that no process of it stays."""
        family = self.family()
        self.popen.kill()
        self.popen.wait()
        # What a worker has called, such as a compiler, may still end its work.
        wait_until(lambda: not any(map(_alive, family)), f"{family} have ended", 30.0)

    def interrupt(self) -> None:
        """Press Ctrl-C: all processes of its session get the signal."""
        os.killpg(self.popen.pid, signal.SIGINT)

    def wait(self) -> int:
        """Its exit status."""
        return self.popen.wait(PATIENCE_S)


def _alive(process: psutil.Process) -> bool:
    with suppress(psutil.Error):
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    return False


@contextmanager
def started(
    arguments: Sequence[object], folder: Path, environment: Mapping[str, str] | None = None, prefix: Sequence[str] = ()
) -> Iterator[Process]:
    """A Python module with arguments as a process; in the end nothing of it is left."""
    number = len(list(folder.glob("errors*")))
    errors = folder / f"errors{number}"
    command = [*prefix, sys.executable, "-m", *map(str, arguments)]
    with errors.open("wb") as file:
        popen = subprocess.Popen(
            command, cwd=folder, stdout=file, stderr=file, start_new_session=True, env=os.environ | (environment or {})
        )
    process = Process(popen, errors)
    try:
        yield process
    finally:
        for each in reversed(process.family()):
            with suppress(psutil.Error):
                each.kill()
        popen.wait()


def gough_sweep(*arguments: object) -> list[object]:
    """The arguments of `started` for a sweep."""
    return ["hil.command_line", "sweep", *arguments]


@contextmanager
def dask_scheduler(folder: Path) -> Iterator[tuple[Process, str]]:
    """A scheduler, and its address."""
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    with started(
        ["dask", "scheduler", "--host", "127.0.0.1", "--port", 0, "--scheduler-file", file, "--no-dashboard"], folder
    ) as process:
        wait_until(lambda: file.exists() and file.read_text().endswith("}"), "the scheduler listens")
        yield process, json.loads(file.read_text())["address"]


def dask_worker(address: str, *options: object) -> list[object]:
    """The arguments of `started` for a worker."""
    return ["dask", "worker", address, "--nthreads", 1, "--no-dashboard", *options]
