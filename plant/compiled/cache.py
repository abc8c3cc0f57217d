"""Where gough keeps what it builds on demand: machine code and FMUs, each under a hash of its sources."""

import atexit
import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path

STALE_AFTER_S = 30 * 24 * 3600.0
"""Folders that were not used for so long are removed [s]."""


def user_cache() -> Path:
    """`$GOUGH_CACHE`, else `gough` in the user's cache folder."""
    if configured := os.environ.get("GOUGH_CACHE"):
        return Path(configured)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gough"


def hash_of_files(files: Iterable[Path], *extra: str) -> str:
    """Twenty hexadecimal digits for the content of files, and `extra`."""
    digest = hashlib.sha256("\0".join(extra).encode())
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:20]


def keyed_folder(kind: str, key: str) -> Path:
    """The cache folder of this kind and key; folders long unused are removed, once in a process.

    Without a cache that can be written, it lasts as long as the process.
    """
    try:
        folder = user_cache() / kind / key
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except (OSError, RuntimeError):
        # RuntimeError: there is no home folder.
        folder = _temporary_cache() / kind / key
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    _remove_stale(folder.parent)
    return folder


@cache
def _remove_stale(folders: Path) -> None:
    """Once in a process, as there may be thousands: a sweep keeps a folder for each of its mechanisms."""
    for each in folders.iterdir():
        with suppress(OSError):
            if time.time() - each.stat().st_mtime > STALE_AFTER_S:
                shutil.rmtree(each, ignore_errors=True)


@cache
def _temporary_cache() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="gough-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
