"""CSV files of numbers."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from plant.errors import InputError
from plant.files import read_text
from plant.pose import Array


class CsvTable(NamedTuple):
    """The numbers of a CSV file: columns (m), rows (N, m), and the line (N) of each row."""

    columns: tuple[str, ...]
    rows: Array
    lines: list[int]


def read_csv(path: Path, *headers: tuple[str, ...], note: str = "", skipped: int = 0) -> CsvTable:
    """Read a CSV file of finite numbers, which has one of these headers after some skipped lines; blank lines do not count.

    Raises:
        InputError: the file cannot be read, has another header (`note` says more of it), or another row.
    """
    lines = [line.strip() for line in read_text(path).removeprefix("\ufeff").splitlines()][skipped:]
    columns = tuple(name.strip() for name in lines[0].split(",")) if lines else ()
    if columns not in headers:
        wanted = " or ".join(",".join(header) for header in headers)
        raise InputError(f"{path}, line {skipped + 1}: the header must be {wanted}{note}")
    rows: list[list[float]] = []
    numbers: list[int] = []
    for number, line in enumerate(lines[1:], start=skipped + 2):
        if not line:
            continue
        found, row = "", list[float]()
        try:
            row = [float(field) for field in line.split(",")]
            found = "" if len(row) == len(columns) else f": it has {len(row)} numbers"
        except ValueError as error:
            found = f": {error}"
        for name, value in zip(columns, row, strict=False):
            if not math.isfinite(value):
                found = f": {name} is {value}"
        if found:
            raise InputError(f"{path}, line {number}: {line!r} is not a row of {len(columns)} finite numbers{found}")
        rows.append(row)
        numbers.append(number)
    return CsvTable(columns, np.array(rows).reshape(-1, len(columns)), numbers)
