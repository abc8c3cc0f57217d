"""Pictures in SVG for documents and reports, legible on white and on dark ground."""

from collections.abc import Iterable
from html import escape

from hil.look import FONT, NEUTRAL


def document(width: float, height: float, body: Iterable[str], style: str = "") -> str:
    """The text of a picture of this size [px], with `style` in CSS."""
    look = f'font-family="{FONT}" font-size="12" fill="{NEUTRAL}"'
    css = f"<style>{style}</style>\n" if style else ""
    drawn = "\n".join(body)
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" {look}>\n{css}{drawn}\n</svg>'


def text(x: float, y: float, words: str, anchor: str = "start") -> str:
    """A line of text, which begins, ends or has its middle at a place [px]."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'


def upright_text(x: float, y: float, words: str) -> str:
    """A line of text that runs upwards, with its middle at a place [px]."""
    return f'<text transform="translate({x:.0f} {y:.0f}) rotate(-90)" text-anchor="middle">{escape(words)}</text>'
