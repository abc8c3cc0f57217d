"""The report of a workspace: travels, volume, what binds, and slices, as it is and changed."""

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from hil.reports.page import figure_html, write_page
from hil.reports.workspace_picture import picture_svg
from hil.studies.workspace import Workspace
from hil.table import Table


def write_report(found: Sequence[Workspace], tables: Sequence[tuple[str, Table]], path: Path) -> None:
    """Write workspaces as one HTML file, with the tables that the command prints.

    Raises:
        InputError: the file cannot be written.
    """
    body = "".join(f"<h2>{title}</h2>\n{table.html()}\n" for title, table in tables)
    caption = "Moves from the pose along two axes, all else as it is there; rotation vectors in the base frame."
    for number, each in enumerate(found):
        body += figure_html(f"slices-{number}", f"Slices, {each.label}", caption, picture_svg([each]))
    names = " · ".join(dict.fromkeys(each.label for each in found))
    write_page(path, f"gough: where {found[0].mechanism.name} can go", f"{names} · gough {version('gough')}", body)
