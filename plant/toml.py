"""TOML files that a user writes: reading them, and refusing entries that nobody knows."""

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from plant.errors import InputError


def read_text(path: Path | str) -> str:
    """The text of a file, or an `InputError`."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"cannot read {path}: it is not UTF-8 text: {error}") from None


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """The content of a TOML text, which messages call `name`, or an `InputError`."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name} is not valid TOML: {error}") from None


def read_toml(path: Path | str) -> dict[str, Any]:
    """The content of a TOML file, or an `InputError`."""
    return parse_toml(read_text(path), str(path))


def unknown_entries(table: Mapping[str, Any], known: Iterable[str], title: str) -> list[str]:
    """A message for each entry of a table that is not `known`; `title` is what messages call the table."""
    names = list(known)
    return [f"{title} has no entry {entry!r}; it has {', '.join(names)}" for entry in table if entry not in names]


def check_entries(table: Mapping[str, Any], known: Iterable[str], title: str) -> None:
    """Check that a table has only `known` entries, or raise an `InputError`."""
    for message in unknown_entries(table, known, title):
        raise InputError(message)
