"""The page of every report: one HTML file that opens offline, and its look."""

from html import escape
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from plotly.io import to_html
from plotly.offline import get_plotlyjs

from hil.look import BAD, DARK, FAINT, FONT, GOOD, GRID, LIGHT, NEUTRAL, SERIES
from plant.files import write_whole


def write_page(path: Path, title: str, subtitle: str, body: str, script: str = "") -> None:
    """Write a page with the drawing library inside.

    Title and subtitle are plain text, the body is HTML, and the JavaScript `script` runs after the figures.

    Raises:
        InputError: the file cannot be written.
    """
    title, subtitle = escape(title), escape(subtitle)
    text = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>{_STYLE}</style>
<script>{get_plotlyjs()}</script>
</head>
<body>
<header><h1>{title}</h1><p>{subtitle}</p></header>
{body}
<script>{script}</script>
</body>
</html>
"""
    write_whole(path, text.encode())


def overview(text: str, figure: str) -> str:
    """The top of a page in HTML: text, and a figure beside it."""
    return f'<section class="overview">\n<div>\n{text}\n</div>\n{figure}</section>\n'


def place(number: int, columns: int) -> dict[str, int]:
    """The place of a subplot, counted row by row, as plotly's methods take it."""
    row, column = divmod(number, columns)
    return {"row": row + 1, "col": column + 1}


def figure_html(name: str, title: str, caption: str, figure: go.Figure | str, kind: str = "time") -> str:
    """A figure by plotly, or in HTML, with title and caption in plain text.

    Its id is `name`, and its class `kind`: "time" has the full width, "view" a part.
    """
    if isinstance(figure, str):
        drawn = f'<div id="{name}">{figure}</div>'
    else:
        config = {"displaylogo": False, "responsive": True, "doubleClick": "reset"}
        drawn = to_html(figure, config, auto_play=False, include_plotlyjs=False, full_html=False, div_id=name)
    text = f"<h2>{escape(title, quote=False)}</h2>\n{drawn}\n<figcaption>{escape(caption, quote=False)}</figcaption>"
    return f'<figure class="{kind}">{text}</figure>\n'


_AXIS = {"gridcolor": GRID, "zerolinecolor": GRID, "zerolinewidth": 2, "automargin": True}
LAYOUT: dict[str, Any] = {
    "template": go.layout.Template(layout={"xaxis": _AXIS, "yaxis": _AXIS, "colorway": SERIES}),
    "font": {"family": FONT, "size": 12, "color": NEUTRAL},
    "margin": {"l": 70, "r": 15, "t": 30, "b": 45},
    "paper_bgcolor": "rgba(0, 0, 0, 0)",
    "plot_bgcolor": "rgba(0, 0, 0, 0)",
    "modebar": {"bgcolor": "rgba(0, 0, 0, 0)", "color": FAINT, "activecolor": NEUTRAL},
}
LEGEND = {"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom"}
"""The look of all figures, on light and on dark pages, and of a legend above a plot."""


def _properties(colors: dict[str, str]) -> str:
    return " ".join(f"--{name}: {color};" for name, color in colors.items())


_STYLE = f"""
:root {{ color-scheme: light dark; --good: {GOOD}; --bad: {BAD}; {_properties(LIGHT)} }}
@media (prefers-color-scheme: dark) {{ :root {{ {_properties(DARK)} }} }}
body {{ font: 15px/1.45 {FONT}; }}
"""
_STYLE += """
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 28px 24px 48px; max-width: 1240px; color: var(--ink); background: var(--ground); }
header { border-bottom: 2px solid var(--accent); padding-bottom: 12px; margin-bottom: 20px; }
h1 { font-size: 26px; font-weight: 600; margin: 0; overflow-wrap: anywhere; }
header p { margin: 4px 0 0; color: var(--faint); overflow-wrap: anywhere; }
h2 { font-size: 18px; font-weight: 600; margin: 0 0 4px; }
.overview { display: grid; grid-template-columns: minmax(380px, 5fr) minmax(480px, 7fr); gap: 28px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th { font-weight: 500; text-align: right; padding: 3px 0 3px 10px; }
thead th { color: var(--faint); font-size: 13px; }
thead tr:first-child th:first-child, tbody th { text-align: left; padding-left: 0; }
tbody tr { border-top: 1px solid var(--line); }
th small, td small { display: block; color: var(--faint); font-weight: 400; }
td { text-align: right; padding: 8px 0 8px 10px; }
dl { display: grid; gap: 10px; margin: 22px 0 0; }
dl div { border-left: 3px solid var(--line); padding-left: 12px; }
dd { margin: 0; font-size: 22px; font-variant-numeric: tabular-nums; }
dd.good { color: var(--good); }
dd.bad { color: var(--bad); }
dt { color: var(--faint); font-size: 13px; }
figure { margin: 0; min-width: 0; }
figure.time { margin-top: 32px; border-top: 1px solid var(--line); padding-top: 18px; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(420px, 100%), 1fr)); gap: 28px; }
table + figure { margin-top: 22px; }
figcaption { color: var(--faint); font-size: 13px; }
.js-plotly-plot :is([class$="tick"] text, [class$="title"], .legendtext) { fill: var(--faint) !important; }
.js-plotly-plot .updatemenu-item-rect { fill: var(--ground) !important; stroke: var(--line) !important; }
.js-plotly-plot .updatemenu-item-text { fill: var(--ink) !important; }
@media (max-width: 960px) { .overview { grid-template-columns: minmax(0, 1fr); } }
@media (max-width: 600px) { body { padding: 16px 12px 32px; } table { display: block; overflow-x: auto; } }
"""
