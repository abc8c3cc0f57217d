"""Formulas as MathML, by docutils' own converter: a browser draws them without a script or a font from elsewhere."""

import re

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.writers.html5 import HTML5Translator

_INDEX_BELOW = re.compile(
    r"<munderover>\s*(<mi>[^<]*</mi>)\s*(<mi>[^<]*</mi>|<mrow>.*?</mrow>)\s*"
    r'(<mo stretchy="false">[^<]*</mo>)\s*</munderover>',
    re.DOTALL,
)
"""A letter with its index below and its accent above, as docutils sets it; the index belongs beside the letter."""


def _formula(node: nodes.math | nodes.math_block, display: bool) -> str:
    try:
        made: str = tex2mathml(node.astext(), as_block=display)
        return _INDEX_BELOW.sub(r'<msub><mover accent="true">\1\3</mover>\2</msub>', made)
    except MathError as error:
        raise ExtensionError(f"{node.source}: the formula {node.astext()!r} cannot be drawn: {error}") from None


def _inline(writer: HTML5Translator, node: nodes.math) -> None:
    writer.body.append(_formula(node, display=False))
    raise nodes.SkipNode


def _block(writer: HTML5Translator, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="math">{_formula(node, display=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the renderer, which `html_math_renderer` names."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
