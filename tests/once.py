"""What several of pytest's workers need, and one of them makes."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest


def made_once(folders: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that `make` has filled: in the first worker that asks for it, while others wait."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        make(folder := folders.mktemp(name))
        return folder
    folder = folders.getbasetemp().parent / name
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (done := folder / "done").exists():
            make(folder)
            done.touch()
    return folder
