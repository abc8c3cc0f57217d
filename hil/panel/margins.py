"""How far the pose is from everything that limits it, as a table: of each kind of limit the one that is closest."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser

from hil.panel.gui import set_text

MARGINS_S = 0.3
"""Time between two looks at the margins."""

_SHOWN = {"m": ("mm", 1e3), "rad": ("deg", float(np.degrees(1.0))), "1": ("", 1.0)}
_CLOSE = 0.1
"""Share of the greatest margin below which a limit stands out."""


class MarginTable:
    """The part of a page with the margins."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._text = server.gui.add_markdown("no pose")

    def show(self, margins: Sequence[Mapping[str, Any]]) -> None:
        """Show margins, as `margins_message` has them."""
        set_text(self._text, margin_table(margins))


def margin_table(margins: Sequence[Mapping[str, Any]]) -> str:
    """The closest limit of each kind: its value, what that may be, and the margin left as a share of the greatest one."""
    if not margins:
        return "no pose"
    text = "| closest limit | is | limit | margin left |\n|---|--:|--:|--:|\n"
    for each in margins:
        unit, scale = _SHOWN.get(each["unit"], (each["unit"], 1.0))
        value, bound, share = scale * each["value"], scale * each["bound"], each["share"]
        left = f"{share:.0%}" if share >= _CLOSE else f"**{share:.0%}**"
        text += f"| {each['limit']} | {value:.4g} | {bound:.4g} {unit} | {left} |\n"
    return text
