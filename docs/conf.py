"""The settings of Sphinx for the pages (`make docs`): they are built offline, and load nothing from outside."""

import re
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS.parent), str(DOCS / "_ext")]

from hil import reference  # noqa: E402
from hil.reference.fields import attributes, declared  # noqa: E402

project = "gough"
author = "the authors of gough"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "mathml"]
exclude_patterns = ["_*"]
# Docstrings name code in single backticks, as Markdown does.
default_role = "code"

myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
napoleon_use_ivar = True
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "gough"
html_math_renderer = "mathml"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["gough.css"]
html_show_copyright = False

linkcheck_timeout = 20
linkcheck_retries = 3

OWN_PACKAGES = ("plant", "controller", "hil")


def put_in_tables(_app: Sphinx, _page: str, source: list[str]) -> None:
    """Put what the code tells where a page has a comment such as `<!-- reference: commands -->`."""
    source[0] = re.sub(r"<!-- reference: (\w+) -->", lambda found: reference.PARTS[found[1]](), source[0])


def link_by_last_name(_app: Sphinx, env: BuildEnvironment, node: pending_xref, text: nodes.Element) -> nodes.Element | None:
    """Docstrings name a class without its module; names of other packages, whose pages are not here, are plain text."""
    domain: Any = env.domains.python_domain
    if node["refdomain"] != "py":
        return None
    name = node["reftarget"]
    if found := domain.find_obj(env, "", "", name.rpartition(".")[2], None, 1):
        return domain.resolve_xref(env, node["refdoc"], env.app.builder, node["reftype"], found[0][0], node, text)
    return None if name.partition(".")[0] in OWN_PACKAGES else text


def read_docstring(_app: Sphinx, what: str, _name: str, of: Any, _options: Any, lines: list[str]) -> None:
    """Docstrings are plain: an indented paragraph is code or a formula, and a field's meaning stands in a comment behind it."""
    found: list[str] = []
    for line in lines:
        before = next((each for each in reversed(found) if each.strip()), "")
        if line.startswith("    ") and found and not found[-1].strip() and before[:1] not in ("", " "):
            found += ["::", ""]
        found.append(line)
    if what == "class" and is_dataclass(of):
        texts, told = declared(of)[1], attributes("\n".join(found))
        described = [f"    {each.name}: {texts[each.name]}" for each in fields(of) if each.name in texts.keys() - told.keys()]
        if described and "Attributes:" not in found:
            found += ["Attributes:", ""]
        if described:
            place = found.index("Attributes:") + 1
            found[place:place] = described
    lines[:] = found


def shorten_defaults(_app: Sphinx, _what: str, _name: str, _of: Any, _options: Any, call: str | None, gives: str) -> Any:
    """Defaults such as `<factory>` are no Python, so that Sphinx could not read the types beside them."""
    return call and (re.sub(r"<(?:[^<>]|<[^<>]*>)+>", "...", call), gives)


def setup(app: Sphinx) -> None:
    """Connect the functions above; docstrings are read before napoleon reads their sections."""
    app.connect("source-read", put_in_tables)
    app.connect("missing-reference", link_by_last_name)
    app.connect("autodoc-process-signature", shorten_defaults)
    app.connect("autodoc-process-docstring", read_docstring, priority=400)
