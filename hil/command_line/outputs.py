"""Files that commands write."""

import json
from pathlib import Path
from typing import Any

from plant.errors import GoughError, InputError
from plant.files import check_writable, write_whole


class OutputError(GoughError, OSError):
    """Something was done, but not all of what it gave could be written."""

    exit_status = 1


def check_outputs(*paths: Path | None) -> None:
    """Check that the files that are wanted can be written, and that no two are the same.

    Raises:
        InputError: one cannot be written, or two are the same.
    """
    check_distinct(*paths)
    for path in paths:
        if path is not None:
            check_writable(path)


def check_distinct(*paths: Path | None) -> None:
    """Check that no two of the files that are wanted are the same.

    Raises:
        InputError: two are.
    """
    named = [path.resolve() for path in paths if path is not None]
    for path in named:
        if named.count(path) > 1:
            raise InputError(f"{path} is named twice: give two files")


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Write figures, if a file for them is wanted."""
    if path is not None:
        write_whole(path, (json.dumps(content, indent=2) + "\n").encode())
