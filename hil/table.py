"""A table of text for the terminal, for docs/ in Markdown, and for reports in HTML."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table as RichTable

Heading = str | tuple[str, str]
"""A column's heading, or the heading of a group of columns and the column's own."""


@dataclass(frozen=True)
class Cell:
    """A cell that is more than plain text."""

    text: str
    note: str = ""  # a smaller line below it; HTML only
    code: bool = False  # set in the typeface of code; not on the terminal
    alarm: bool = False  # bold and red; terminal only


class Table:
    """Columns with headings, and rows of text; the first column names the row.

    `left` has the numbers of the columns that the terminal aligns left; it aligns all others right.
    """

    def __init__(self, *headings: Heading, left: Sequence[int] = (0,)) -> None:
        self.headings = [("", heading) if isinstance(heading, str) else heading for heading in headings]
        self.rows: list[list[Cell]] = []
        self._left = left

    def add(self, *cells: str | Cell) -> None:
        """Add a row."""
        self.rows.append([Cell(cell) if isinstance(cell, str) else cell for cell in cells])

    def print(self, markdown: bool = False) -> None:
        """Print the table, as wide as the terminal or, where there is none, 140 characters wide, or its Markdown."""
        if markdown:
            print(self.markdown())
            return
        from rich.console import Console

        Console(width=None if sys.stdout.isatty() else 140).print(self.rich())

    def rich(self) -> "RichTable":
        """The table as rich draws it."""
        from rich.box import SIMPLE_HEAD
        from rich.table import Table as RichTable
        from rich.text import Text

        shown = RichTable(box=SIMPLE_HEAD, pad_edge=False)
        for i, heading in enumerate(self._flat_headings()):
            shown.add_column(Text(heading), justify="left" if i in self._left else "right", overflow="fold")
        for row in self.rows:
            shown.add_row(*(Text(cell.text, "bold red" if cell.alarm else "") for cell in row))
        return shown

    def markdown(self) -> str:
        """The table in Markdown."""
        rows = [[_markdown(cell) for cell in row] for row in self.rows]
        lines = [self._flat_headings(), ["---"] * len(self.headings), *rows]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)

    def html(self) -> str:
        """The table in HTML, with the headings of groups in a row of their own."""
        grouped = any(group for group, _ in self.headings)
        span, upper, lower = ' rowspan="2"' if grouped else "", "", ""
        for group, columns in groupby(self.headings, itemgetter(0)):
            names = [_escape(name) for _, name in columns]
            if group:
                upper += f'<th colspan="{len(names)}">{_escape(group)}</th>'
                lower += "".join(f"<th>{name}</th>" for name in names)
            else:
                upper += "".join(f"<th{span}>{name}</th>" for name in names)
        heads = "".join(f"<tr>{row}</tr>\n" for row in (upper, lower) if row)
        rows = ""
        for head, *cells in self.rows:
            rows += f"<tr>{_html(head, 'th')}{''.join(_html(cell, 'td') for cell in cells)}</tr>\n"
        return f"<table>\n<thead>\n{heads}</thead>\n<tbody>\n{rows}</tbody>\n</table>"

    def _flat_headings(self) -> list[str]:
        return [f"{group} {name}".strip() for group, name in self.headings]


def _markdown(cell: Cell) -> str:
    text = cell.text.replace("|", "\\|")
    return f"`{text}`" if cell.code else text


def _html(cell: Cell, tag: str) -> str:
    text = f"<code>{_escape(cell.text)}</code>" if cell.code else _escape(cell.text)
    note = f"<small>{_escape(cell.note)}</small>" if cell.note else ""
    return f"<{tag}>{text}{note}</{tag}>"


def _escape(text: str) -> str:
    return escape(text, quote=False)
