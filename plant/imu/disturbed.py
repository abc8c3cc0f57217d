"""Disturbances in compiled code: what they make of an IMU's signals at a time."""

import numpy as np

from plant.compiled import Record, kernel, record_dtype
from plant.imu_disturbances import Course, Disturbance, DisturbanceKind
from plant.pose import rotate_by_vector
from plant.vectors import rotate, vector

MOST_DISTURBANCES = 48
"""The most that an IMU layer takes at a time."""

DISTURBANCE = record_dtype(
    kind=np.int64,  # DisturbanceKind; 0: none
    imus=np.int64,  # a bit for each
    sensor=np.int64,
    axis=(np.float64, 3),
    size=np.float64,
    course=np.int64,  # Course
    span=np.float64,
    every=np.float64,
    begin=np.float64,  # [s]
    end=np.float64,  # [s]
)
"""A `Disturbance`."""

EFFECT = record_dtype(
    signal=(np.float64, (3, 3)),  # sensor, axis: the true signal
    added=(np.float64, (3, 3)),  # to the reading
    scale=(np.float64, (3, 3)),  # error of the axis
    noise=(np.float64, (3, 3)),  # RMS, of each conversion
    noisy=np.int64,  # whether there is any
    normals=(np.float64, 6),  # scratch
    reach=(np.float64, 3),
    stuck=(np.int64, (3, 3)),
    warmer=np.float64,  # [K]
    supply=np.float64,  # above nominal [V]
    turn=(np.float64, (3, 3)),  # scratch
    vector=(np.float64, 3),  # scratch
)
"""What disturbs an IMU at a time."""


def disturbance_record(disturbance: Disturbance) -> Record:
    """The record (dtype `DISTURBANCE`) of a disturbance; one from the start begins at 0 s."""
    made: Record = np.zeros((), DISTURBANCE)
    begin = max(disturbance.begin, 0.0)
    made["kind"], made["sensor"], made["course"] = disturbance.kind, disturbance.sensor, disturbance.course
    made["imus"] = sum(1 << imu for imu in disturbance.imus)
    made["axis"], made["size"] = disturbance.axis, disturbance.size
    made["span"], made["every"] = disturbance.span, disturbance.every
    made["begin"], made["end"] = begin, begin + disturbance.duration
    return made


@kernel
def concerns(d: Record, imu: int, time: float) -> bool:
    """Whether a disturbance is there for an IMU at a time [s]."""
    return bool((d.imus >> imu) & 1 != 0 and d.begin <= time < d.end)


@kernel
def level(d: Record, time: float) -> float:
    """The size of a disturbance at a time [s] from its begin on."""
    passed = time - d.begin
    if d.course == Course.RAMP:
        return float(d.size * min(passed / d.span, 1.0))
    if d.course == Course.SETTLE:
        return float(-d.size * np.expm1(-passed / d.span))
    if d.course == Course.SINE:
        return float(d.size * np.sin(2.0 * np.pi * (passed / d.span)))
    if d.course == Course.PULSES:
        if passed >= d.every:
            passed -= np.floor(passed / d.every) * d.every
        return float(d.size * np.sin(np.pi * passed / d.span)) if passed < d.span else 0.0
    return float(d.size)


@kernel
def disturb(disturbances: Record, count: int, imu: int, time: float, effect: Record) -> None:
    """Apply those that are there for an IMU at a time [s] to its true signal, in their order, and note the rest."""
    e = effect
    for sensor in range(3):
        e.reach[sensor] = np.inf
        for axis in range(3):
            e.added[sensor, axis] = e.scale[sensor, axis] = e.noise[sensor, axis] = 0.0
            e.stuck[sensor, axis] = 0
    e.warmer = e.supply = 0.0
    e.noisy = 0
    for i in range(count):
        d = disturbances[i]
        if not concerns(d, imu, time):
            continue
        size = level(d, time)
        if d.kind == DisturbanceKind.TURN:
            _turn(e, d, size)
        elif d.kind == DisturbanceKind.TEMPERATURE:
            e.warmer += size
        elif d.kind == DisturbanceKind.SUPPLY:
            e.supply += size
        elif d.kind == DisturbanceKind.RANGE:
            e.reach[d.sensor] = min(e.reach[d.sensor], size)
        elif d.sensor >= 0:
            e.noisy = 1 if d.kind == DisturbanceKind.NOISE else e.noisy
            for axis in range(3):
                share = size * d.axis[axis]
                if d.kind == DisturbanceKind.OFFSET:
                    e.added[d.sensor, axis] += share
                elif d.kind == DisturbanceKind.SCALE:
                    e.scale[d.sensor, axis] += share
                elif d.kind == DisturbanceKind.NOISE:
                    e.noise[d.sensor, axis] = np.hypot(e.noise[d.sensor, axis], share)
                elif d.kind == DisturbanceKind.VIBRATION:
                    e.signal[d.sensor, axis] += share
                elif d.kind == DisturbanceKind.STUCK and d.axis[axis] != 0.0:
                    e.stuck[d.sensor, axis] = 1


@kernel
def _turn(e: Record, d: Record, angle: float) -> None:
    """Turn an IMU on its mounting; its readings turn the other way."""
    for i in range(3):
        for j in range(3):
            e.turn[i, j] = 1.0 if i == j else 0.0
        e.vector[i] = -angle * d.axis[i]
    rotate_by_vector(e.turn, e.vector)
    for sensor in range(3):
        signal = e.signal[sensor]
        signal[0], signal[1], signal[2] = rotate(e.turn, vector(signal))


@kernel
def shakes(disturbances: Record, count: int, imu: int, since: float, until: float) -> bool:
    """Whether vibration or shocks shake an IMU at some time from `since` to `until` [s]."""
    for i in range(count):
        d = disturbances[i]
        if d.kind == DisturbanceKind.VIBRATION and (d.imus >> imu) & 1 != 0 and d.begin <= until and since < d.end:
            return True
    return False


@kernel
def clock_of(disturbances: Record, count: int, imu: int, time: float) -> tuple[bool, float, float]:
    """Whether an IMU has got a clock of its own, by how much that is faster than nominal (relative), and its jitter [s]."""
    own, faster, jitter = False, 0.0, 0.0
    for i in range(count):
        d = disturbances[i]
        if d.kind == DisturbanceKind.CLOCK and concerns(d, imu, time):
            own, faster = True, faster + level(d, time)
        elif d.kind == DisturbanceKind.JITTER and concerns(d, imu, time):
            jitter += level(d, time)
    return own, faster, jitter
