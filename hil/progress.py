"""How long work reports its progress."""

from collections.abc import Callable

Progress = Callable[[float], None]
"""Called now and then with the share of the work that is done, 0 to 1."""


def no_progress(share: float) -> None:
    """Report nothing."""
