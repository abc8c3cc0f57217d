"""Limits of the fields by which compiled code counts and indexes: what comes from a file must keep them."""

from collections.abc import Mapping

import numpy as np

from plant.compiled.kernels import Record

MOST = int(np.iinfo(np.int64).max)
"""The greatest value of a field without an upper limit."""

Limits = Mapping[str, tuple[int, int]]
"""Least and greatest value of fields by their path, such as "rig.legs"."""


def out_of_limits(record: Record, limits: Limits) -> str | None:
    """The first field of a record, or of some, that compiled code cannot take, in words; None if it can take all."""
    for path, (least, most) in limits.items():
        values = record
        for name in path.split("."):
            values = values[name]
        values = np.ravel(values)
        wrong = values[(values < least) | (values > most)]
        if len(wrong):
            return f"{path} is {wrong[0]}, and must be at least {least:d}" + (f" and at most {most:d}" if most < MOST else "")
    return None
