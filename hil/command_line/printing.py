"""Tables and progress on the terminal."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import degrees
from typing import Any


def mm(metres: float, digits: int = 3) -> str:
    """Return a length [m] in millimetres, with so many digits after the point."""
    return f"{1e3 * metres:.{digits}f}"


def deg(angle: float, digits: int = 3) -> str:
    """Return an angle [rad] in degrees, with so many digits after the point."""
    return f"{degrees(angle):.{digits}f}"


def new_table(*columns: str) -> Any:
    """Return an empty table with these columns; all but the first are of numbers, at the right of their column."""
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(escape(column), justify="right" if i else "left")
    return table


def print_table(table: Any) -> None:
    """Print a table, as wide as the terminal, or else 100 characters."""
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 100).print(table)


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[..., None]]:
    """A progress bar on the terminal, which pulses while things are prepared and goes when the work is done; it is called with
    the share that is done, and a new label if that changes.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    terminal = sys.stderr.isatty()
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not terminal) as bar:
        task = bar.add_task(label, total=None)
        yield lambda share, now=None: bar.update(task, total=1.0, completed=share, description=now)
