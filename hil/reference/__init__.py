"""The reference of commands and files in Markdown, from the tables of the code itself: what the pages in docs/ have in place of
a comment such as `<!-- reference: commands -->`.
"""

from collections.abc import Callable
from functools import partial

from hil.reference.commands import commands
from hil.reference.files import FILES, disturbances, tables_of, units_of_signals

PARTS: dict[str, Callable[[], str]] = {
    "commands": commands,
    "disturbances": disturbances,
    "units_of_signals": units_of_signals,
    **{name: partial(lambda of: tables_of(of()), of) for name, of in FILES.items()},
}
"""The parts by the names that the pages use."""
