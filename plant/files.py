"""Writing files so that they appear whole or not at all."""

import os
import tempfile
from pathlib import Path

from plant.errors import InputError


def check_writable(path: Path) -> None:
    """Check that a file could be written at `path`, before any work is done for it.

    Raises:
        InputError: the path is a folder, or its folder does not exist or cannot be written.
    """
    folder = path.resolve().parent
    if path.is_dir():
        raise InputError(f"cannot write {path}: it is a folder")
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InputError(f"cannot write {path}: {folder} is no folder that can be written")


def write_whole(path: Path, content: bytes) -> None:
    """Write `content` to `path`; the file takes its place only when it is complete. Links are followed, and what is no
    regular file, such as a device, is written to and not replaced.

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
