"""The hypotheses: what may be wrong, as directions in the space of faults, and the evidence for each.

A fault is a reading that is off by (7, 6), angular velocity and specific force of each IMU. Each hypothesis has up to six
directions, of any sizes:

- a gyroscope, an accelerometer, or both of one IMU;
- the mounting of an IMU, turned by a small angle, which turns what it reads;
- an error that all gyroscopes or all accelerometers share, each in its own axes;
- a base that turns, which adds one angular velocity of the base frame to what all gyroscopes read;
- a base that tilts or accelerates, which adds one specific force of the base frame to what all accelerometers read.
"""

from enum import IntEnum

import numpy as np

from controller.estimation.integrity.fault_filter import FAULTS
from controller.estimation.whole_mechanism.readings import READINGS
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT
from plant.pose import Array
from plant.vectors import Vector, vector

MOST_DIRECTIONS = 6


class Kind(IntEnum):
    """What a hypothesis blames; the first four are about one IMU."""

    GYROSCOPE, ACCELEROMETER, IMU, MOUNTING, ALL_GYROSCOPES, ALL_ACCELEROMETERS, BASE_TURNS, BASE_FORCE = range(8)


OF_ONE_IMU = 4
HYPOTHESES = OF_ONE_IMU * IMU_COUNT + len(Kind) - OF_ONE_IMU
"""Numbers: kind by kind, and for those of one IMU, IMU by IMU."""

_NEGLIGIBLE = 1e-9
"""A direction counts as a combination of those before it if less than this share of what is known of it is its own."""

SCRATCH = record_dtype(
    frames=(np.float64, (IMU_COUNT, 3, 3)),  # axes of the IMUs in {1}, by rows
    directions=(np.float64, (MOST_DIRECTIONS, FAULTS)),
    weighted=(np.float64, (MOST_DIRECTIONS, FAULTS)),
    matrix=(np.float64, (MOST_DIRECTIONS, MOST_DIRECTIONS)),
    right=(np.float64, MOST_DIRECTIONS),
)


@kernel
def kind_of(hypothesis: int) -> int:
    """The `Kind` of a hypothesis."""
    first = OF_ONE_IMU * IMU_COUNT
    return int(hypothesis // IMU_COUNT if hypothesis < first else OF_ONE_IMU + hypothesis - first)


@kernel
def imu_of(hypothesis: int) -> int:
    """The IMU that a hypothesis blames; -1 if it is about all of them."""
    return int(hypothesis % IMU_COUNT if hypothesis < OF_ONE_IMU * IMU_COUNT else -1)


@kernel
def directions_of(hypothesis: int, frames: Array, predicted: Array, place: Array, directions: Array) -> int:
    """Write the directions (6, 42) of a hypothesis; returns how many it has.

    Args:
        hypothesis: its number.
        frames: as from `find_frames`.
        predicted: (7, 6), what the IMUs should read.
        place: (7,), of each IMU in the order of the faults.
    """
    directions[:] = 0.0
    kind, k = kind_of(hypothesis), imu_of(hypothesis)
    if kind == Kind.MOUNTING:
        at = READINGS * place[k]
        for sensor in range(0, READINGS, 3):
            _write_turn(vector(predicted[k, sensor:]), at + sensor, directions)
        return 3
    if k >= 0:
        first = 3 if kind == Kind.ACCELEROMETER else 0
        count = READINGS if kind == Kind.IMU else 3
        for i in range(count):
            directions[i, READINGS * place[k] + first + i] = 1.0
        return count
    first = 0 if kind in (Kind.ALL_GYROSCOPES, Kind.BASE_TURNS) else 3
    own = kind in (Kind.ALL_GYROSCOPES, Kind.ALL_ACCELEROMETERS)
    for imu in range(IMU_COUNT):
        at = READINGS * place[imu] + first
        for i in range(3):
            for j in range(3):
                directions[i, at + j] = (1.0 if i == j else 0.0) if own else frames[imu, j, i]
    return 3


@kernel
def span_of(hypothesis: int, place: Array) -> tuple[int, int]:
    """The first fault that a hypothesis is about, and the one after the last, in the order of `place` (7,)."""
    k = imu_of(hypothesis)
    return (0, FAULTS) if k < 0 else (READINGS * int(place[k]), READINGS * (int(place[k]) + 1))


@kernel
def _write_turn(reading: Vector, at: int, directions: Array) -> None:
    """The change of a reading when the sensor turns by small angles about its axes: reading x angle."""
    x, y, z = reading
    directions[0, at + 1], directions[0, at + 2] = z, -y
    directions[1, at], directions[1, at + 2] = -z, x
    directions[2, at], directions[2, at + 1] = y, -x


@kernel
def evidence_for(count: int, first: int, last: int, weight: Array, evidence: Array, t: Record) -> float:
    """Twice the logarithm of the likelihood ratio of a fault in the first `count` of the scratch's directions to none.

    Args:
        count: of directions.
        first, last: their span, outside which they are zero.
        weight, evidence: (42, 42) and (42,), W and w as in `evidence`.
        t: dtype `SCRATCH`, with the directions. The Cholesky factor of D^T W D is left in `matrix`, zero in columns of
            directions about which nothing is known, and its solution of D^T w in `right`.
    """
    found, size = 0.0, last - first
    for n in range(count):
        direction, weighted = t.directions[n, first:last], t.weighted[n, first:last]
        weighted[:] = 0.0
        right = 0.0
        for i in range(size):
            share = direction[i]
            if share != 0.0:
                right += share * evidence[first + i]
                row = weight[first + i, first:last]
                for j in range(size):
                    weighted[j] += share * row[j]
        for m in range(n + 1):
            other, value = t.directions[m, first:last], 0.0
            for i in range(size):
                value += other[i] * weighted[i]
            t.matrix[n, m] = value
        whole = t.matrix[n, n]
        for m in range(n):
            value = t.matrix[n, m]
            for i in range(m):
                value -= t.matrix[n, i] * t.matrix[m, i]
            value = value / t.matrix[m, m] if t.matrix[m, m] > 0.0 else 0.0
            t.matrix[n, m] = value
            t.matrix[n, n] -= value * value
            right -= value * t.right[m]
        if t.matrix[n, n] > _NEGLIGIBLE * whole and whole > 0.0:
            t.matrix[n, n] = np.sqrt(t.matrix[n, n])
            t.right[n] = right / t.matrix[n, n]
            found += t.right[n] * t.right[n]
        else:
            t.matrix[n, n] = t.right[n] = 0.0
    return found
