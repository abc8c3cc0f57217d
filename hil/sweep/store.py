"""The table of a study's results: Parquet files in a folder, to which rows are added as they come.

`runs.parquet` is the table. While a study runs, new rows stand in small files beside it; what a process that died has left
there is taken in by the next.
"""

import fcntl
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from plant.errors import InputError
from plant.files import write_whole

TABLE = "runs.parquet"
_PARTS = ".*.parquet.*"
"""What a process that died in the middle of `write_whole` has left."""
KEY, STATUS, REASON = "key", "status", "reason"
DONE, FAILED, ERROR, DIED = "done", "failed", "error", "died"
"""A row's status: figures are there, the run gave the reason, program or machine failed, the worker died."""
_SETTLED = (DONE, FAILED)
_ALWAYS = {KEY: str, STATUS: str, REASON: str}
"""Columns that every table has."""
_MOST_FILES = 1000
"""So many files of new rows are taken into the table, which costs as much as to write it whole."""


class Store:
    """The rows of a study, each key once: the last one that was added."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._new = folder / "new"
        self._number = 0
        self._schema = _schema([])

    @classmethod
    @contextmanager
    def opened(cls, folder: Path) -> Iterator["Store"]:
        """The store in a folder, which is made if it is not there, for this process alone.

        Raises:
            InputError: the folder cannot be written, or another process has it.
        """
        store = cls(folder)
        try:
            store._new.mkdir(parents=True, exist_ok=True)
            lock = (folder / "lock").open("w")
        except OSError as error:
            raise InputError(f"cannot write results to {folder}: {error.strerror}") from None
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise InputError(f"another process writes results to {folder}: wait for it, or give another folder") from None
            for part in (*folder.glob(_PARTS), *store._new.glob(_PARTS)):
                part.unlink()
            store.compact()
            store._schema = store.table().schema
            yield store
            store.compact()

    def table(self) -> pa.Table:
        """All rows."""
        # The table is read last, as another process may just be taking new rows into it.
        new = [_read(file) for file in sorted(self._new.glob("*.parquet"))]
        parts = [part for part in (_read(self.folder / TABLE), *new) if part is not None]
        table = pa.concat_tables([_schema([]).empty_table(), *parts], promote_options="permissive")
        last = {key: row for row, key in enumerate(table[KEY].to_pylist())}
        return table if len(last) == len(table) else table.take(sorted(last.values()))

    def as_table(self, rows: Sequence[Mapping[str, Any]]) -> pa.Table:
        """Rows, or parts of them, as they can be added.

        Raises:
            InputError: a column has values of several kinds, here or with those that are there.
        """
        stored = [{name: as_stored(value) for name, value in row.items()} for row in rows]
        try:
            table = pa.Table.from_pylist(stored, _schema(rows))
            self._schema = pa.unify_schemas([self._schema, table.schema], promote_options="permissive")
        except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError) as error:
            text, *_ = str(error).splitlines()
            raise InputError(
                f"a factor or figure has values of several kinds in {self.folder} ({text}): give another folder for these"
            ) from None
        return table

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Add rows, which are in a file when this returns; errors as for `as_table`."""
        if rows:
            self._write(self._new / f"{self._number:08d}.parquet", self.as_table(rows))
            self._number += 1
        if self._number >= _MOST_FILES:
            self.compact()

    def compact(self) -> None:
        """Take the new rows into the table."""
        files = sorted(self._new.glob("*.parquet"))
        if files:
            self._write(self.folder / TABLE, self.table())
            # A process that dies here leaves rows that are in the table already; a key counts once.
            for file in files:
                file.unlink()
        self._number = 0

    def _write(self, path: Path, table: pa.Table) -> None:
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink)
        write_whole(path, sink.getvalue().to_pybytes())


def rows_of(table: pa.Table, keys: Iterable[str]) -> pa.Table:
    """The rows with these keys, in their order."""
    place = {key: row for row, key in enumerate(table[KEY].to_pylist())}
    return table.take([place[key] for key in keys if key in place])


def settled(table: pa.Table) -> pa.Table:
    """The rows of runs that are not tried again."""
    return table.filter(pc.is_in(table[STATUS], pa.array(_SETTLED)))


def _read(file: Path) -> pa.Table | None:
    """The rows of a file; None if there is no such file."""
    try:
        return pq.read_table(file, partitioning=None)
    except FileNotFoundError:
        return None
    except (OSError, pa.ArrowInvalid) as error:
        raise InputError(f"cannot read {file}: {error}; move it away to run what it had again") from None


def as_stored(value: Any) -> Any:
    """A value as the table has it: a number, a switch or text; anything else as JSON."""
    return value if isinstance(value, str | bool | int | float | None) else json.dumps(value)


def _schema(rows: Sequence[Mapping[str, Any]]) -> pa.Schema:
    """All columns of some rows, as rows of failed runs lack figures."""
    kinds: dict[str, Any] = dict(_ALWAYS)
    for row in rows:
        for name, value in row.items():
            if kinds.get(name) is None and value is not None:
                kinds[name] = type(value)
            elif isinstance(value, float) and kinds[name] is int:
                kinds[name] = float
    arrow = {bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
    return pa.schema([(name, arrow.get(kind, pa.string())) for name, kind in kinds.items()])
