"""Files that commands write."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hil.table import Table
from plant.errors import GoughError, InputError
from plant.extras import check_installed
from plant.files import check_writable, write_whole


class OutputError(GoughError, OSError):
    """A command did its work, but not all of the results could be written."""

    exit_status = 1


def add_json(command: argparse.ArgumentParser) -> None:
    """Add the option for the file with the figures."""
    command.add_argument("--json", type=Path, metavar="FILE", help="write the figures in SI units")


def add_markdown(command: argparse.ArgumentParser, page: str) -> None:
    """Add the option to print the table as a page of the documentation has it."""
    command.add_argument("--markdown", action="store_true", help=f"print the table in Markdown, as {page} has it")


def show_table(table: Table, markdown: bool) -> None:
    """Print a table, or its Markdown."""
    if markdown:
        print(table.markdown())
    else:
        table.print()


def check_outputs(*paths: Path | None, report: Path | None = None, inputs: Sequence[Path] = ()) -> None:
    """Check that the requested files can be written, and that no two of them and of the inputs are the same.

    Raises:
        InputError: one cannot be written, or two are the same.
        MissingPackageError: what makes reports is not installed.
    """
    if report is not None:
        check_installed("plotly")
    requested = [path for path in (*paths, report) if path is not None]
    named = [path.resolve() for path in (*requested, *inputs)]
    for path in named:
        if named.count(path) > 1:
            raise InputError(f"{path} is named twice: give two files")
    for path in requested:
        check_writable(path)


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Write figures, if a file for them is requested."""
    if path is not None:
        write_whole(path, (json.dumps(content, indent=2) + "\n").encode())
