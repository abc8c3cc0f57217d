"""Options of configurations: their units, flags and defaults on the command line."""

from argparse import ArgumentParser
from dataclasses import dataclass

import pytest

from hil.command_line.cli import config_of, options_of
from hil.option import integers, option
from plant.errors import InputError


@dataclass(frozen=True)
class Config:
    """A configuration with an option of every form."""

    length: float = option(2.5e-3, "a length", unit="mm")
    wait: float = option(0.04, "a time", unit="ms")
    rate: float = option(100.0, "a rate", unit="Hz")
    count: int = option(3, "a count")
    names: tuple[str, ...] = option((), "names", parse=str, several=True, flag="--name")
    legs: tuple[int, ...] = option((4, 1), "legs", parse=integers)
    quiet: bool = option(False, "says less")
    color: bool = option(True, "no color")
    file: str | None = option(None, "a file")
    other: float = 7.0

    def __post_init__(self) -> None:
        """Nothing to check."""


def parsed(*arguments, **changes):
    parser = ArgumentParser()
    options_of(Config, **changes)(parser)
    return config_of(parser.parse_args(arguments), Config), parser.format_help()


def test_without_options_a_configuration_has_its_defaults_and_the_help_shows_them_in_their_units():
    config, text = parsed()
    assert config == Config()
    words = " ".join(text.split())
    for part in (
        "a length [mm] (default: 2.5)", "a time [ms] (default: 40)", "a rate [Hz] (default: 100)", "a count (default: 3)",
        "legs (default: 4,1)", "--quiet says less", "--no-color no color",
    ):  # fmt: skip
        assert part in words
    assert "--other" not in text and "None" not in text


def test_options_come_in_si_units():
    config, _ = parsed("--length", "0.5", "--wait", "8", "--rate", "50", "--count", "-2", "--legs", "5,0", "--file", "x")
    assert (config.length, config.wait) == pytest.approx((5e-4, 8e-3), rel=1e-15)
    assert (config.rate, config.count, config.legs, config.file, config.other) == (50.0, -2, (5, 0), "x", 7.0)


def test_flags_turn_on_or_off_and_what_can_come_several_times_is_kept_in_order():
    config, _ = parsed("--quiet", "--no-color", "--name", "b", "--name", "a")
    assert (config.quiet, config.color, config.names) == (True, False, ("b", "a"))
    assert parsed("--name", "c")[0].names == ("c",)
    assert Config().names == ()


def test_a_command_may_have_another_default():
    config, text = parsed(length={"default": 1e-3, "text": "another length"})
    assert config.length == 1e-3
    assert "another length [mm] (default: 1)" in " ".join(text.split()) and "--rate" not in text


def test_other_fields_are_given_beside_the_options():
    parser = ArgumentParser()
    options_of(Config, "rate")(parser)
    assert config_of(parser.parse_args(["--rate", "7"]), Config, other=8.0) == Config(rate=7.0, other=8.0)


@pytest.mark.parametrize("text", ["", "1,,2", "1.5", "one", "1;2"])
def test_what_is_no_list_of_numbers_is_refused(text):
    with pytest.raises(InputError, match="is no list of numbers such as 0,1,2"):
        integers(text)


def test_numbers_keep_their_order():
    assert integers("3,-1, 2,3") == (3, -1, 2, 3)
