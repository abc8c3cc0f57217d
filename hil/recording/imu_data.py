"""Readings of a single IMU from a file: a CSV file that was logged by hand, or a recording of a rig.

A CSV file has evenly spaced samples and the header time_s,wx,wy,wz,ax,ay,az, with or without mx,my,mz, or for magnetometers
time_s,mx,my,mz. A recording has all IMUs of a mechanism, so `number` says which.
"""

from pathlib import Path

import numpy as np

from hil.recording.mcap import read
from plant.csv import read_csv
from plant.errors import InputError
from plant.imu_wiring import BASE_IMU
from plant.pose import Array

COLUMNS = ("time_s", "wx", "wy", "wz", "ax", "ay", "az")
FIELD_COLUMNS = ("mx", "my", "mz")
_MOST_JITTER = 0.5
"""Allowed deviation of the time between samples from its median, relative to the median."""


def read_imu(path: Path, number: int) -> tuple[Array, Array, Array]:
    """Times (N,) [s], rates and forces (N, 3) [rad/s, m/s^2] of an IMU.

    Raises:
        InputError: the file cannot be read, is malformed, or its samples are not evenly spaced.
    """
    if path.suffix == ".mcap":
        records = read(path).records
        pair = records["angular_velocity"], records["specific_force"]
        rates, forces = np.moveaxis(records["base_imu"], 1, 0) if number == BASE_IMU else (each[:, number] for each in pair)
        return records["time_ns"] / 1e9, rates, forces
    table = _read_table(path, COLUMNS, (*COLUMNS, *FIELD_COLUMNS))
    return table[:, 0], table[:, 1:4], table[:, 4:7]


def read_field(path: Path, number: int) -> tuple[Array, Array | None]:
    """Fields (N, 3) [uT] and forces (N, 3) [m/s^2] of an IMU, None without an accelerometer; raises as `read_imu`."""
    if path.suffix == ".mcap":
        records = read(path).records
        return records["magnetic_field"][:, number], records["specific_force"][:, number]
    table = _read_table(path, (*COLUMNS, *FIELD_COLUMNS), (COLUMNS[0], *FIELD_COLUMNS))
    return table[:, -3:], table[:, 4:7] if table.shape[1] > 4 else None


def _read_table(path: Path, *headers: tuple[str, ...]) -> Array:
    _, table, lines = read_csv(path, *headers, note=" (rad/s, m/s2, uT)")
    if len(table) < 2:
        raise InputError(f"{path} has {len(table)} rows of numbers; it needs two or more")
    steps = np.diff(table[:, 0])
    usual = float(np.median(steps))
    uneven = np.flatnonzero(np.abs(steps - usual) > _MOST_JITTER * usual)
    if usual <= 0.0 or len(uneven):
        line = lines[int(uneven[0]) + 1] if len(uneven) else lines[0]
        raise InputError(
            f"{path}, line {line}: the samples must be evenly spaced, {usual:g} s as most are: fill the gap or cut there"
        )
    return table
