"""Fields of a table of a TOML file: name, type, unit, default, limit and meaning, as the code states them.

A dataclass says what a field means in the comment behind it, such as `# of the platform [m/s]`, under `Attributes:`, or in the
field's own metadata.
"""

import ast
import inspect
import io
import re
import tokenize
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields
from functools import cache
from textwrap import dedent
from typing import Any

from hil.table import Cell, Table

_TYPES = {
    "float": "number",
    "int": "whole number",
    "bool": "true or false",
    "str": "text",
    "Array": "numbers",
    "Numbers": "3 numbers",
    "tuple[float, float]": "2 numbers",
    "tuple[float, ...]": "numbers",
    "tuple[int, ...]": "whole numbers",
    "tuple[tuple[int, ...], ...]": "rows of whole numbers",
    "tuple[str, str]": "2 texts",
    "tuple[SplinePoint, ...]": "tables, or names of points",
    "tuple[AnyWave, ...]": "tables",
    "tuple[Element, ...]": "tables",
    "Place": "place",
    "ToolLimits": "table",
    "str | float": "text or number",
    "float | str": "number or text",
}
"""Types of fields, as a writer of a file thinks of them."""

REQUIRED = "must be given"


@dataclass(frozen=True)
class Entry:
    """An entry of a table; `limit` is as `0 to 10` or `positive` for numbers, and else in words."""

    name: str
    type: str
    unit: str = ""
    default: str = ""
    limit: str = ""
    text: str = ""


def entries_of(kind: Any, limits: Mapping[str, str] | None = None, without: Sequence[str] = (), **own: str) -> list[Entry]:
    """The entries that are the fields of a dataclass.

    Args:
        kind: the dataclass.
        limits: of fields, by name, where the code has them in no table.
        without: fields that a file does not have.
        own: meanings of fields, where the class itself says nothing of them.
    """
    types, texts = declared(kind)
    found = []
    for each in fields(kind):
        if each.name not in without:
            text, unit = _text_and_unit(texts.get(each.name, ""))
            limit = (limits or {}).get(each.name, "")
            meaning = text or own.get(each.name, "")
            found.append(Entry(each.name, types[each.name], unit, _default(each), limit, meaning))
    return found


def table_of(entries: Sequence[Entry]) -> str:
    """The table of some entries in Markdown."""
    table = Table("entry", "type", "unit", "default", "limit", "meaning")
    for each in entries:
        cells = (each.type, each.unit, each.default, each.limit, each.text)
        table.add(Cell(each.name, code=True), *map(plain, cells))
    return table.markdown()


def plain(text: str) -> str:
    """A text as Markdown that shows it as it is, but for what stands in backticks, and pages, which become links."""
    parts = re.split(r"(`[^`]*`|docs/\w+\.md)", text)
    return "".join(_plain_part(part) for part in parts)


def _plain_part(part: str) -> str:
    if part.startswith("`"):
        return part
    escaped = re.sub(r"([\\*<$])", r"\\\1", part)
    return f"[{escaped}]({part.removeprefix('docs/')})" if part.startswith("docs/") else escaped


@cache
def declared(kind: type) -> tuple[dict[str, str], dict[str, str]]:
    """The types of a dataclass's fields, and what the class and those that it inherits from say of them."""
    types: dict[str, str] = {}
    texts: dict[str, str] = {}
    for each in reversed(kind.__mro__[:-1]):
        texts |= attributes(each.__dict__.get("__doc__") or "")
        source = dedent(inspect.getsource(each))
        (body,) = ast.parse(source).body
        assert isinstance(body, ast.ClassDef)
        tokens = tokenize.generate_tokens(io.StringIO(source).readline)
        behind = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
        for node in body.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                name = ast.unparse(node.annotation).replace("'", "").removesuffix(" | None")
                types[node.target.id] = _TYPES.get(name, name)
                if node.end_lineno in behind:
                    texts[node.target.id] = behind[node.end_lineno]
    for field in fields(kind):
        if option := field.metadata.get("option"):
            texts[field.name] = option.text + (f" [{option.unit}]" if option.unit else "")
        elif "text" in field.metadata:
            texts[field.name] = field.metadata["text"]
    return types, texts


def attributes(doc: str) -> dict[str, str]:
    """What a docstring says under `Attributes:`."""
    _, _, section = inspect.cleandoc(doc).partition("Attributes:\n")
    section, _, _ = section.partition("\n\n")
    found: dict[str, str] = {}
    for each in re.split(r"\n(?=    \S)", section):
        names, colon, text = " ".join(each.split()).partition(": ")
        found |= dict.fromkeys(names.split(", "), text.removesuffix(".")) if colon else {}
    return found


def _text_and_unit(text: str) -> tuple[str, str]:
    units = re.findall(r"\[([^\]]+)\]", text)
    rest = re.sub(r" ?\[[^\]]+\]|^\(\w+,\)", "", text).strip(" ,;:")
    return rest, " or ".join(unit for unit in dict.fromkeys(units) if unit not in ("-", "1"))


def _default(each: Field[Any]) -> str:
    if each.default is MISSING:
        return REQUIRED if each.default_factory is MISSING else ""
    return shown(each.default)


def shown(value: Any) -> str:
    """A value as a file has it; "" for none."""
    if value is None:
        return ""
    if isinstance(value, tuple):
        return f"[{', '.join(map(shown, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.4g}" if isinstance(value, float) else str(value)
