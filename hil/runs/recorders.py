"""The process that records a run, its successors if it dies, and the file that they write."""

import errno
import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.loop.records import Link
from hil.realtime.processes import join_or_kill, started
from hil.recording.mcap import record, repair
from plant.compiled import Record
from plant.errors import GoughError, InputError

_LEAST_FREE = 8 * 2**20
_MOST_RECORDERS = 10


@contextmanager
def claimed(path: Path | None) -> Iterator[None]:
    """Keep a recording's file for this run, after checking that it can be written.

    Raises:
        InputError: it cannot, another run records to it, or its disk is full.
    """
    if path is None:
        yield
        return
    if path.exists() and not path.is_file():
        raise InputError(f"{path} is no file: name another for the recording")
    fresh = not path.exists()
    try:
        file = path.open("ab")
    except OSError as error:
        raise InputError(f"cannot record to {path}: {error.strerror}: name another file") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{path} is being recorded to by another run: name another file") from None
        free = shutil.disk_usage(path.resolve().parent).free
        try:
            if free < _LEAST_FREE:
                raise InputError(
                    f"cannot record to {path}: {free / 2**20:.3g} MiB are free there, and {_LEAST_FREE / 2**20:g} MiB are "
                    "needed to begin: make room, or name another file"
                )
            yield
        finally:
            with suppress(OSError):
                if fresh and not path.stat().st_size:
                    path.unlink()


class Recorders:
    """The process that records, and its successors if it dies."""

    def __init__(
        self, path: Path | None, records: Record, link: NDArray[np.int64], supervisors: Connection, events: list[str]
    ) -> None:  # fmt: skip
        """Record to `path`, if there is one, and report deaths to `events`."""
        self.files: list[Path] = []
        self._path, self._records, self._link, self._supervisors, self._events = path, records, link, supervisors, events
        self._header: dict[str, Any] = {}
        self._process: BaseProcess | None = None
        self._started = 0  # recorders

    @property
    def lost(self) -> int:
        """Number of cycles that are in no file."""
        return int(self._link[Link.HEAD] - self._link[Link.KEPT]) if self._started else 0

    def start(self, header: dict[str, Any]) -> None:
        """Start the first recorder."""
        self._header = header
        if self._path is not None:
            self._started = 1
            self._start(self._path)

    def _start(self, path: Path) -> None:
        self.files.append(path)
        self._process = started(_recorder_process, path, self._header, self._records, self._link, self._supervisors)

    def watch(self) -> None:
        """If the recorder has been killed, or its file has gone, start a successor with a file of its own."""
        if self._process is not None and not self._process.is_alive():
            code = self._report_end(self._process)
            if code < 0 or code == errno.ESTALE:
                self._start_another()

    def _start_another(self) -> None:
        self._started += 1
        if self._path is None or self._started > _MOST_RECORDERS:
            return
        path, numbers = self._path, range(self._started, 10_000)
        another = next(each for n in numbers if not (each := path.with_stem(f"{path.stem}-{n}")).exists())
        self._events.append(f"another recorder goes on in {another}")
        self._start(another)

    def _report_end(self, recorder: BaseProcess) -> int:
        """Note why a recorder has ended, if it was not asked to; returns its exit code."""
        code, self._process = recorder.exitcode or 0, None
        if code == errno.ESTALE:
            # It is no file of this run any more, so nothing is read from it or mended in it.
            self._events.append(f"{self.files.pop()} was deleted, cut or replaced while it was recorded")
        elif code > 0:
            self._events.append(f"{self.files[-1]} cannot be written: {os.strerror(code)}: the rest is not recorded")
        elif code < 0:
            self._events.append(f"the recorder died (exit code {code})")
        return code

    def finish(self) -> None:
        """Let the recorder write what is left, and complete the files of those that died."""
        self._link[Link.DONE] = 1
        while self._process is not None:
            join_or_kill(self._process)
            if self._report_end(self._process) == errno.ESTALE:
                self._start_another()
        for path in self.files:
            try:
                if path.exists():
                    repair(path)
            except (GoughError, OSError) as error:
                self._events.append(f"{path} is incomplete: {error}")


def _recorder_process(
    path: Path, header: dict[str, Any], records: Record, link: NDArray[np.int64], supervisors: Connection
) -> None:  # fmt: skip
    supervisors.close()
    try:
        record(path, header, records, link)
    except OSError as error:
        # Skips the writer's collection, which would try to write again.
        os._exit(error.errno or errno.EIO)
