"""Readings of a single IMU from a file: a CSV file that was logged by hand, or a recording of a rig."""

from pathlib import Path

import numpy as np

from hil.recording.mcap import read
from plant.errors import InputError
from plant.pose import Array

COLUMNS = ("time_s", "wx", "wy", "wz", "ax", "ay", "az")
FIELD_COLUMNS = ("mx", "my", "mz")
_MOST_JITTER = 0.5
"""Of the time between samples, relative to its median."""


def read_imu(path: Path, number: int) -> tuple[Array, Array, Array]:
    """Times (N,) [s], rates and forces (N, 3) [rad/s, m/s^2] of an IMU.

    Args:
        path: a CSV file with the header time_s,wx,wy,wz,ax,ay,az, where mx,my,mz may follow, or an MCAP recording.
        number: which IMU of a recording.

    Raises:
        InputError: the file cannot be read, is malformed, or its samples are not evenly spaced.
    """
    if path.suffix == ".mcap":
        records = read(path).records
        return records["time_ns"] / 1e9, records["angular_velocity"][:, number], records["specific_force"][:, number]
    table = _read_table(path, COLUMNS, (*COLUMNS, *FIELD_COLUMNS))
    return table[:, 0], table[:, 1:4], table[:, 4:7]


def read_field(path: Path, number: int) -> tuple[Array, Array | None]:
    """Fields (N, 3) [uT] and forces (N, 3) [m/s^2] of an IMU; None without an accelerometer.

    Args:
        path: a CSV file with the header time_s,wx,wy,wz,ax,ay,az,mx,my,mz or time_s,mx,my,mz, or an MCAP recording.
        number: which IMU of a recording.

    Raises:
        InputError: the file cannot be read, is malformed, or its samples are not evenly spaced.
    """
    if path.suffix == ".mcap":
        records = read(path).records
        return records["magnetic_field"][:, number], records["specific_force"][:, number]
    table = _read_table(path, (*COLUMNS, *FIELD_COLUMNS), (COLUMNS[0], *FIELD_COLUMNS))
    return table[:, -3:], table[:, 4:7] if table.shape[1] > 4 else None


def _read_table(path: Path, *headers: tuple[str, ...]) -> Array:
    """The numbers of a CSV file with one of these headers."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            columns = tuple(name.strip() for name in file.readline().split(","))
            if columns not in headers:
                wanted = " or ".join(",".join(header) for header in headers)
                raise InputError(f"{path}, line 1: the header must be {wanted} (rad/s, m/s2, uT)")
            table = np.loadtxt(file, delimiter=",", ndmin=2)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (UnicodeDecodeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is no table of numbers: {error}") from None
    if table.shape[1:] != (len(columns),) or len(table) < 2:
        raise InputError(
            f"{path} has {len(table)} rows of {table.shape[-1]} numbers; it needs {len(columns)} in each of two or more"
        )
    if not np.isfinite(table).all():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(table))[0])
        raise InputError(f"{path}, line {row + 2}: {columns[column]} is {table[row, column]}; it must be finite")
    steps = np.diff(table[:, 0])
    usual = float(np.median(steps))
    uneven = np.flatnonzero(np.abs(steps - usual) > _MOST_JITTER * usual)
    if usual <= 0.0 or len(uneven):
        line = int(uneven[0]) + 3 if len(uneven) else 2
        raise InputError(
            f"{path}, line {line}: the samples must be evenly spaced, {usual:g} s as most are: fill the gap or cut there"
        )
    return table
