"""Runs `gough` in this process, which saves a test the start of another one."""

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path

from hil.command_line import main


@dataclass(frozen=True)
class Finished:
    """As `subprocess.CompletedProcess` has it."""

    returncode: int
    stdout: str
    stderr: str


def gough(*arguments: object, cwd: Path | None = None) -> Finished:
    """Run a command in a folder; an exception that the command line does not catch fails the test."""
    output, errors = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(cwd or Path.cwd()),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(errors),
    ):
        try:
            status = main([str(each) for each in arguments])
        except SystemExit as exited:
            status = int(exited.code or 0)
    return Finished(status, output.getvalue(), errors.getvalue())
