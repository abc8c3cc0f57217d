"""How long work reports its progress."""

from collections.abc import Callable, Collection, Iterator
from typing import TypeVar

Progress = Callable[[float], None]
"""Called now and then with the share of the work that is done, 0 to 1."""

Item = TypeVar("Item")


def no_progress(share: float) -> None:
    """Report nothing."""


def part_of(progress: Progress, start: float, share: float) -> Progress:
    """The progress of a part that begins at `start` and makes up `share` of the whole work."""
    return lambda done: progress(start + share * done)


def in_parts(items: Collection[Item], progress: Progress) -> Iterator[tuple[Item, Progress]]:
    """The items one after another, each with the progress of its part of the work; all parts are equal."""
    for i, item in enumerate(items):
        yield item, part_of(progress, i / len(items), 1.0 / len(items))
        progress((i + 1) / len(items))
