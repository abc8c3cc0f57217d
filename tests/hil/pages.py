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


def draw_in_browser(report, count):
    """Draw so many figures without an error."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if not browser:
        pytest.skip("no browser here")
    flags = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-component-update"
    run = subprocess.run(
        [browser, *flags.split(), "--virtual-time-budget=10000", f"--user-data-dir={report.parent.parent / 'profile'}",
         "--dump-dom", f"file://{report}"], capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert len(re.findall(r'class="[^"]*js-plotly-plot', run.stdout)) >= count, run.stderr[-2000:]
    assert "Uncaught" not in run.stderr
