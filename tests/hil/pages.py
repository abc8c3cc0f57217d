"""What a browser would draw, read back from the page of a report."""

import base64
import json
import re
import shutil
import subprocess

import numpy as np
import pytest


def json_after(page, start):
    text = page[page.rindex(start) + len(start) :].lstrip()
    return json.JSONDecoder().raw_decode(text)[0]


def traces_of(page, name):
    return json_after(page, f'"{name}",')


def numbers(packed):
    return np.frombuffer(base64.b64decode(packed["bdata"]), packed["dtype"]).astype(float)


def figures_in(page):
    """The names of the figures, in a page that needs nothing from outside."""
    assert page.count("* plotly.js v") == 1
    markup = re.sub(r"(<script\b[^>]*>).*?</script>", r"\1", page, flags=re.DOTALL)
    assert not re.search(r"<link\b|\b(src|href)\s*=|url\(|@import", markup)
    return re.findall(r'<div id="(\w+)" class="plotly-graph-div"', page)


def dumped(page, profile):
    """What a browser makes of a page, and its errors."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if not browser:
        pytest.skip("no browser here")
    flags = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-component-update"
    run = subprocess.run(
        [browser, *flags.split(), "--virtual-time-budget=3000", f"--user-data-dir={profile}", "--dump-dom", f"file://{page}"],
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    return run.stdout, run.stderr


def draw_in_browser(report, count):
    """Draw so many figures without an error."""
    drawn, errors = dumped(report, report.parent.parent / "profile")
    assert len(re.findall(r'class="[^"]*js-plotly-plot', drawn)) >= count, errors[-2000:]
    assert "Uncaught" not in errors


_TELL_WIDTHS = """<script>window.addEventListener("load", () => setTimeout(() => {
const { scrollWidth, clientWidth } = document.documentElement;
parent.postMessage(`${scrollWidth} ${clientWidth}`, "*"); }, 1000))</script></body>"""
_FRAME = """<body><iframe width="{}" height="900" style="border: 0" src="narrow.html"></iframe>
<script>addEventListener("message", event => document.body.dataset.widths = event.data)</script></body>"""


def widths_in_browser(report, width):
    """The width that a report takes in a window so narrow [px], and the one that it has."""
    head, _, tail = report.read_text(encoding="utf-8").rpartition("</body>")
    (report.parent / "narrow.html").write_text(head + _TELL_WIDTHS + tail, encoding="utf-8")
    frame = report.parent / "frame.html"
    frame.write_text(_FRAME.format(width), encoding="utf-8")
    drawn, errors = dumped(frame, report.parent.parent / "profile")
    found = re.search(r'data-widths="(\d+) (\d+)"', drawn)
    assert found, errors[-2000:]
    return int(found[1]), int(found[2])
