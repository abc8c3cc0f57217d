"""How long work reports its progress, and how a run says what its user should know before it begins."""

from collections.abc import Callable

Progress = Callable[[float], None]
"""Called now and then with the share of the work that is done, 0 to 1."""


Say = Callable[[str], None]
"""Called with one line."""


def say_nothing(text: str) -> None:
    """Keep it to oneself."""


def no_progress(share: float) -> None:
    """Report nothing."""


def part_of(progress: Progress, start: float, share: float) -> Progress:
    """The progress of a part that begins at `start` and makes up `share` of the whole work."""
    return lambda done: progress(start + share * done)
