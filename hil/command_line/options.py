"""Options of the command line, made from the fields of configurations (see `hil.option`).

A function that adds the options of a command describes it to the user by its docstring.
"""

import argparse
import inspect
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

from hil.option import Option
from plant.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    C = TypeVar("C", bound=DataclassInstance)

_SCALES = {"mm": 1e-3, "ms": 1e-3}
"""Factors to SI units."""


def build(command: argparse.ArgumentParser, add: Callable[[argparse.ArgumentParser], None]) -> None:
    """Give a parser the docstring of `add` for its description, and the options that `add` adds."""
    command.description = inspect.getdoc(add)
    add(command)


def summary(add: Callable[[argparse.ArgumentParser], None]) -> str:
    """The first sentence of the docstring of `add`, as the help of its command."""
    text = (inspect.getdoc(add) or "").partition("\n")[0]
    return text[:1].lower() + text[1:].rstrip(".")


def add_actions(command: argparse.ArgumentParser, **actions: Callable[[argparse.ArgumentParser], None]) -> None:
    """Add actions to a command, by name with the function that adds their options."""
    parsers = command.add_subparsers(required=True, metavar="ACTION")
    for name, add in actions.items():
        build(parsers.add_parser(name, help=summary(add)), add)


def options_of(config: "type[C]", *without: str) -> list[str]:
    """The names of a configuration's fields that are options, without some."""
    return [each.name for each in fields(config) if "option" in each.metadata and each.name not in without]


def add_options(command: argparse.ArgumentParser, config: "type[C]", *names: str, **changes: Mapping[str, Any]) -> None:
    """Add options for fields of a configuration.

    Args:
        command: the parser to add to.
        config: the configuration's dataclass.
        names: the fields whose options are as declared; without names or changes, all that are options.
        changes: by name of a field, what is different in this command: `default`, or attributes of `Option`.
    """
    declared = {each.name: each for each in fields(config)}
    for name in (*names, *changes) or options_of(config):
        form = dict(changes.get(name, {}))
        default = form.pop("default", declared[name].default)
        _add_option(command, name, default, replace(declared[name].metadata["option"], **form))


def _add_option(command: argparse.ArgumentParser, name: str, default: Any, option: Option) -> None:
    flag = option.flag or f"--{'no-' if default is True else ''}{name.replace('_', '-')}"
    if isinstance(default, bool):
        command.add_argument(flag, dest=name, action="store_false" if default else "store_true", help=option.text)
        return
    scale = _SCALES.get(option.unit, 1.0)
    parse = option.parse or (type(default) if isinstance(default, int | float) else str)
    shown = None if option.required else option.shown or _shown(default, scale)
    command.add_argument(
        flag,
        dest=name,
        default=list(default) if option.several else default,
        type=_reader(parse, scale),
        action="append" if option.several else "store",
        required=option.required,
        metavar=option.metavar,
        choices=option.choices,
        help=option.text + (f" [{option.unit}]" if option.unit else "") + (f" (default: {shown})" if shown else ""),
    )


def _shown(default: Any, scale: float) -> str:
    """A default as the help shows it, "" for none."""
    if isinstance(default, tuple):
        return ",".join(map(str, default))
    if isinstance(default, float):
        return f"{default / scale:g}"
    return "" if default is None else str(default)


def _reader(parse: Callable[[str], Any], scale: float) -> Callable[[str], Any]:
    """What argparse calls to parse an option, and names in its errors."""

    def read(text: str) -> Any:
        try:
            value = parse(text)
        except InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        return value if scale == 1.0 else scale * value

    read.__name__ = parse.__name__
    return read


def config_of(options: argparse.Namespace, config: "type[C]", **others: Any) -> "C":
    """The configuration that the options describe; `others` are fields that are not options.

    Raises:
        InputError: an option is out of its range.
    """
    values = {each.name: getattr(options, each.name) for each in fields(config) if hasattr(options, each.name)}
    return config(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()} | others)
