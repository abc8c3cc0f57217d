"""Files that are written whole or not at all, and temporary folders that no crash leaves behind for long."""

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from plant.errors import InputError

_LOCK = "gough.lock"


def check_writable(path: Path) -> None:
    """Check, before any work is done for it, that a file could be written at `path`, or raise an `InputError`."""
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
