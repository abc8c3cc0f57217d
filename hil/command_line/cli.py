"""The parts of a command: arguments, options of configurations, and output files."""

import inspect
import json
from argparse import SUPPRESS, Action, ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from hil.engine.settings import EngineSettings
from hil.option import Option
from plant.errors import GoughError, InputError
from plant.extras import check_installed
from plant.files import check_writable, write_whole

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    C = TypeVar("C", bound=DataclassInstance)

Argument = Callable[[ArgumentParser], object]
"""Adds one or several arguments to a parser."""

Handler = Callable[[Namespace], int | None]
"""Carries out a command, and returns its exit status; None is 0."""

_SCALES = {"mm": 1e-3, "ms": 1e-3}
"""Factors to SI units."""


class OutputError(GoughError, OSError):
    """A command did its work, but not all of the results could be written."""

    exit_status = 1


@dataclass(frozen=True)
class Command:
    """A command, or an action of one; the first line of its `text` is its help."""

    text: str
    arguments: Sequence[Argument]
    run: Handler | None = None

    @property
    def help(self) -> str:
        """One line on what it does."""
        line = self.text.partition("\n")[0]
        return line[:1].lower() + line[1:].rstrip(".")

    def build(self, parser: ArgumentParser) -> None:
        """Give a parser the description, the arguments, and the defaults `run` and `parser`."""
        parser.description = self.text
        for add in self.arguments:
            add(parser)
        parser.set_defaults(run=self.run, parser=parser)


def command(*arguments: Argument) -> Callable[[Handler], Command]:
    """Make the function below a command, which its docstring describes to the user."""
    return lambda run: Command(inspect.getdoc(run) or "", arguments, run)


def group(text: str, **actions: Command) -> Command:
    """A command of which the user names an action."""

    def add(parser: ArgumentParser) -> None:
        parsers = parser.add_subparsers(required=True, metavar="ACTION")
        for name, action in actions.items():
            action.build(parsers.add_parser(name, help=action.help))

    return Command(text, [add])


def argument(*names: str, **form: Any) -> Argument:
    """An argument, in the form of `ArgumentParser.add_argument`."""
    return lambda parser: parser.add_argument(*names, **form)


def flag(name: str, text: str) -> Argument:
    """An option without a value."""
    return argument(name, action="store_true", help=text)


def setting(name: str, default: float | str, text: str, **form: Any) -> Argument:
    """An option with a default, which the help shows, and whose type it has."""
    form = {"type": type(default), **form}
    return argument(name, default=default, help=f"{text} (default: {_shown(default)})", **form)


def source(name: str, metavar: str, text: str, **form: Any) -> Argument:
    """A file or folder that a command reads."""
    return argument(name, type=Path, metavar=metavar, help=text, **form)


def output(name: str, metavar: str, text: str) -> Argument:
    """A file that a command writes; `check_outputs` finds it."""

    def add(parser: ArgumentParser) -> None:
        added = parser.add_argument(name, type=Path, metavar=metavar, help=text)
        parser.set_defaults(to_write=[*(parser.get_default("to_write") or ()), added.dest])

    return add


def report(text: str) -> Argument:
    """The option for a report, which needs a package of its own."""
    return output("--report", "FILE.html", text)


JSON = output("--json", "FILE", "write the figures in SI units")


def markdown(page: str) -> Argument:
    """The option to print the table as a page of the documentation has it."""
    return flag("--markdown", f"print the table in Markdown, as {page} has it")


def names_of(config: "type[C]", *without: str) -> list[str]:
    """The names of a configuration's fields that are options, without some."""
    return [each.name for each in fields(config) if "option" in each.metadata and each.name not in without]


def options_of(config: "type[C]", *names: str, only_given: bool = False, **changes: Mapping[str, Any]) -> Argument:
    """The options of a configuration's fields; all of them without names or changes.

    `changes` has by field what is different in this command: `default`, or attributes of `Option`. With `only_given`, an option
    that is not given is no attribute of the parsed ones, and `config_of` takes the field's default.
    """

    def add(parser: ArgumentParser) -> None:
        declared = {each.name: each for each in fields(config)}
        for name in (*names, *changes) or names_of(config):
            form = dict(changes.get(name, {}))
            default = form.pop("default", declared[name].default)
            added = _add_option(parser, name, default, replace(declared[name].metadata["option"], **form))
            if only_given:
                added.default = SUPPRESS

    return add


def seed_options(text: str) -> Argument:
    """Options for how many seeds there are, and which is the first; `seeds_of` reads them."""
    both = setting("--seeds", 20, text), setting("--first-seed", 0, "the first seed; the others follow it")

    def add(parser: ArgumentParser) -> None:
        for each in both:
            each(parser)

    return add


def seeds_of(options: Namespace) -> range:
    """The seeds that the user asks for.

    Raises:
        InputError: there are none, or the first is negative.
    """
    if options.seeds < 1:
        raise InputError(f"there are {options.seeds} seeds; at least 1 is needed")
    if options.first_seed < 0:
        raise InputError(f"the first seed is {options.first_seed}; it is 0 or more")
    return range(options.first_seed, options.first_seed + options.seeds)


def engine_options(few: str = "") -> Argument:
    """The options of a study's engine; `few` says why it stays in one process unless they ask for more."""
    texts = {each.name: each.metadata["option"].text for each in fields(EngineSettings)}
    workers = {"shown": f"1, as {few}"} if few else {}
    where = {"text": f"{texts['scheduler']}; files that are named here have the same paths there"}

    def add(parser: ArgumentParser) -> None:
        options_of(EngineSettings, workers=workers, scheduler=where)(parser)
        options_of(EngineSettings, *names_of(EngineSettings, "workers", "scheduler"))(parser)
        parser.set_defaults(few=bool(few))

    return add


def engine_of(options: Namespace) -> EngineSettings:
    """The settings that `engine_options` ask for."""
    settings = config_of(options, EngineSettings)
    return replace(settings, workers=1) if options.few and settings == EngineSettings() else settings


def _add_option(parser: ArgumentParser, name: str, default: Any, option: Option) -> Action:
    flag = option.flag or f"--{'no-' if default is True else ''}{name.replace('_', '-')}"
    if isinstance(default, bool):
        action = "store_false" if default else "store_true"
        return parser.add_argument(flag, dest=name, action=action, help=option.text)
    scale = _SCALES.get(option.unit, 1.0)
    parse = option.parse or (type(default) if isinstance(default, int | float) else str)
    text = option.text + (f" [{option.unit}]" if option.unit else "")
    if not option.required and (shown := option.shown or _shown(default, scale)):
        text += f" (default: {shown})"
    return parser.add_argument(
        flag,
        dest=name,
        default=list(default) if option.several else default,
        type=_reader(parse, scale),
        action="append" if option.several else "store",
        required=option.required,
        metavar=option.metavar,
        choices=option.choices,
        help=text,
    )


def _shown(default: Any, scale: float = 1.0) -> str:
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
            raise ArgumentTypeError(str(error)) from None
        return value if scale == 1.0 else scale * value

    read.__name__ = parse.__name__
    return read


def config_of(options: Namespace, config: "type[C]", **others: Any) -> "C":
    """The configuration that the options describe; `others` are its other fields.

    Raises:
        InputError: an option is out of its range.
    """
    for each in fields(config):
        if hasattr(options, each.name):
            value = getattr(options, each.name)
            others.setdefault(each.name, tuple(value) if isinstance(value, list) else value)
    return config(**others)


def check_outputs(options: Namespace, inputs: Sequence[Path] = ()) -> None:
    """Check that the outputs can be written, and that no two of them and the inputs are one.

    Raises:
        InputError: one cannot be written, or two are the same.
        MissingPackageError: what makes reports is not installed.
    """
    paths = {name: getattr(options, name) for name in getattr(options, "to_write", ())}
    if paths.get("report") is not None:
        check_installed("plotly")
    requested = [path for path in paths.values() if path is not None]
    named = [path.resolve() for path in (*requested, *inputs)]
    for path in named:
        if named.count(path) > 1:
            raise InputError(f"{path} is named twice: give two files")
    for path in requested:
        check_writable(path)


def write_json(path: Path | None, content: Mapping[str, Any]) -> None:
    """Write figures, which may be NumPy arrays, if a file is given."""
    if path is not None:
        text = json.dumps(content, indent=2, default=lambda array: array.tolist())
        write_whole(path, f"{text}\n".encode())


def write_report(options: Namespace, kind: str, *results: Any) -> None:
    """Write the report of the module `kind` of `hil.reports`, if a file is given."""
    if options.report is not None:
        import_module(f"hil.reports.{kind}").write_report(*results, options.report)
