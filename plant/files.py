"""Files: TOML files that a user writes, files that are written whole or not at all, and temporary folders."""

import fcntl
import json
import os
import shutil
import tempfile
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from plant.checks import nearest
from plant.errors import InputError

_LOCK = "gough.lock"

_MOST_UNPACKED, _MOST_TIMES = 64 << 20, 100


def most_unpacked(packed: int) -> int:
    """The most bytes that a file of `packed` bytes may hold unpacked: real ones hold ten times as many at most, or few."""
    return _MOST_UNPACKED + _MOST_TIMES * packed


def read_text(path: Path | str) -> str:
    """The text of a file, or an `InputError`."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"cannot read {path}: it is not UTF-8 text: {error}") from None


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """The content of a TOML text, which messages call `name`, or an `InputError`."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name} is not valid TOML: {error}") from None


def read_toml(path: Path | str) -> dict[str, Any]:
    """The content of a TOML file, or an `InputError`."""
    return parse_toml(read_text(path), str(path))


def toml_entries(values: Mapping[str, Any]) -> list[str]:
    """The TOML lines of texts, switches, numbers, lists, arrays and inline tables of them; a number is read again as it was."""
    return [f"{name} = {_toml(value.tolist() if hasattr(value, 'tolist') else value)}" for name, value in values.items()]


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(toml_entries(value))}}}"
    return f"{value!r}".lower()


def unknown_entries(table: Mapping[str, Any], known: Iterable[str], title: str) -> list[str]:
    """A message for each entry that is not `known`, with the one that may be meant; `title` is what messages call the table."""
    names = list(known)
    has = f"it has {', '.join(names)}"
    return [f"{title} has no entry {entry!r}; {has}{nearest(entry, names)}" for entry in table if entry not in names]


def check_entries(table: Mapping[str, Any], known: Iterable[str], title: str) -> None:
    """Check that a table has only `known` entries, or raise an `InputError`."""
    for message in unknown_entries(table, known, title):
        raise InputError(message)


def check_writable(path: Path) -> None:
    """Check that a file could be written at `path`, or raise an `InputError`."""
    folder = path.resolve().parent
    if path.is_dir():
        raise InputError(f"cannot write {path}: it is a folder")
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InputError(f"cannot write {path}: {folder} is no folder that can be written")


def write_whole(path: Path, content: bytes) -> None:
    """Write a file, which appears only when it is complete. Links are followed, and a device is not replaced.

    Raises:
        InputError: the file cannot be written.
    """
    check_writable(path)
    part = None
    path = path.resolve()
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(content)
            return
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            part = Path(file.name)
            file.write(content)
        part.chmod(0o644)
        part.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    finally:
        if part is not None:
            part.unlink(missing_ok=True)


@contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """A temporary folder, removed at the end. If its process dies, the next call with this prefix removes it.

    The system releases the lock in the folder when the process ends.
    """
    _sweep(prefix)
    with tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True) as name:
        made = Path(name, f"{_LOCK}.new")
        with made.open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            # A lock of this name is always held.
            made.rename(made.with_name(_LOCK))
            yield made.parent


def _sweep(prefix: str) -> None:
    for lock in Path(tempfile.gettempdir()).glob(f"{prefix}*/{_LOCK}"):
        with suppress(OSError), lock.open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(lock.parent, ignore_errors=True)
