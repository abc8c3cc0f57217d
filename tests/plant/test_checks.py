"""Checks of numbers that several configurations share: each limit, from both sides; texts and names in messages."""

from math import inf, nan

import pytest

from plant.checks import check_duration, check_rate, checked_seed, nearest, printable
from plant.errors import InputError


@pytest.mark.parametrize("rate", [50.0, 4000.0])
def test_the_least_and_the_greatest_rate_are_allowed(rate):
    check_rate(rate)


@pytest.mark.parametrize("rate", [49.9, 4000.1, -1000.0, 0.0, nan, inf])
def test_a_rate_beyond_them_is_refused(rate):
    with pytest.raises(InputError, match=f"the rate is {rate:g} Hz; it must be 50 to 4000 Hz"):
        check_rate(rate)


@pytest.mark.parametrize("duration", [0.0, -1.0, 1.001e6, nan, inf])
def test_a_duration_that_never_ends_or_begins_is_refused(duration):
    check_duration(1e-3)
    check_duration(1e6)
    with pytest.raises(InputError) as refused:
        check_duration(duration)
    assert str(refused.value) == f"the duration is {duration:g} s; it must be positive, and at most 1,000,000 s"


def test_a_seed_is_returned_and_has_63_bits():
    assert [checked_seed(seed) for seed in (0, 7, 2**63 - 1)] == [0, 7, 2**63 - 1]
    for seed in (-1, 2**63, 1.5):
        with pytest.raises(InputError, match=f"the seed is {seed}; it must be a whole number between 0 and"):
            checked_seed(seed)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Motor 1, Größe µm 漢", "Motor 1, Größe µm 漢"),
        ("\x1b[2Jred", "\\x1b[2Jred"),
        ("a\x9b31mb\x85", "a\\x9b31mb\\x85"),
        ("\u202eabc\x7f\n", "\\u202eabc\\x7f\\n"),
    ],
)
def test_a_foreign_text_does_nothing_to_a_terminal(text, shown):
    assert printable(text) == shown and printable(text).isprintable()


def test_the_nearest_name_is_asked_for():
    assert nearest("hexapot", ("6-5", "hexapod")) == "; did you mean 'hexapod'?"
    assert nearest("xyz", ("6-5", "hexapod")) == ""
    # The beginning of a name is near it, however short.
    assert nearest("sim", ("fmu", "simulate")) == "; did you mean 'simulate'?"
    assert nearest("s", ("fmu", "simulate")) == ""
