"""Checks of numbers that several configurations share, and foreign texts and wrong names as messages show them."""

from collections.abc import Iterable
from numbers import Integral

from plant.errors import InputError

RATE_RANGE_HZ = (50.0, 4000.0)

LEAST_TIME_SCALE, MOST_TIME_SCALE = 0.01, 1000.0
"""Factors on the times of a target, as in a motion file."""


def check_rate(rate: float) -> None:
    """Check a rate [Hz] of the cycle: 50 to 4000 Hz, or an `InputError`."""
    if not RATE_RANGE_HZ[0] <= rate <= RATE_RANGE_HZ[1]:
        raise InputError(f"the rate is {rate:g} Hz; it must be {RATE_RANGE_HZ[0]:g} to {RATE_RANGE_HZ[1]:g} Hz")


LONGEST_S = 1e6
"""The longest duration of a motion [s]."""


def check_duration(duration: float) -> None:
    """Check a motion's duration [s]: positive and at most `LONGEST_S`, or an `InputError`."""
    if not 0.0 < duration <= LONGEST_S:
        raise InputError(f"the duration is {duration:g} s; it must be positive, and at most {LONGEST_S:,.0f} s")


def check_time_scale(factor: float) -> None:
    """Check a factor on the times of a target, or raise an `InputError`."""
    if not LEAST_TIME_SCALE <= factor <= MOST_TIME_SCALE:
        raise InputError(
            f"the time scale is {factor:g}; it must be {LEAST_TIME_SCALE:g} to {MOST_TIME_SCALE:g}: 2 is half as fast"
        )


def checked_seed(seed: int) -> int:
    """A seed of random numbers: not negative and of 63 bits at most, or an `InputError`."""
    if not isinstance(seed, Integral) or not 0 <= seed < 2**63:
        raise InputError(f"the seed is {seed}; it must be a whole number between 0 and 2^63 - 1")
    return seed


def printable(text: str) -> str:
    """A foreign text as it may be shown: what would act on a terminal, such as control characters, is escaped."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def nearest(text: str, names: Iterable[str]) -> str:
    """A question for the name that a mistyped text may mean; "" if none is near."""
    from difflib import get_close_matches

    names = [*names]
    near = [name for name in names if len(text) > 2 and name.startswith(text)] or get_close_matches(text, names, 1)
    return f"; did you mean {near[0]!r}?" if near else ""
