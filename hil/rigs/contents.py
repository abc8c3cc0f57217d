"""What a rig's feedback must contain when the rig has been at rest for a while."""

from collections.abc import Iterator

import numpy as np

from hil.rigs import DriveState
from plant.compiled import Record
from plant.pose import Array

_REST_FORCE, _REST_RATE = (5.0, 15.0), 0.5
"""Norms of specific force [m/s^2] and angular velocity [rad/s] that an IMU at rest may read."""


def missing_contents(feedback: Record, present: Array) -> Iterator[str]:
    """What is wrong with the values of a feedback, one sentence each; `present` (7,) says which IMUs have given readings."""
    measurement = feedback["measurement"]
    if not present.any():
        yield "No IMU has given readings: the measurement is NaN."
    for imu in np.flatnonzero(present).tolist():
        if not np.isfinite(measurement[:2, imu]).all():
            yield f"IMU {imu} gives some axes that are not finite; NaN is for an IMU that is not there."
            continue
        rate, force = (float(np.linalg.norm(measurement[kind, imu])) for kind in range(2))
        if not _REST_FORCE[0] <= force <= _REST_FORCE[1]:
            yield f"IMU {imu} reads {force:.3g} m/s^2 at rest instead of gravity: check its unit."
        if not rate <= _REST_RATE:
            yield f"IMU {imu} reads {rate:.3g} rad/s at rest: check its unit."
        if not _is_whole(measurement[2, imu]):
            yield f"The magnetic field of IMU {imu} must be finite, or NaN on all axes."
        if feedback["sequence"][imu] < 0:
            yield f"IMU {imu} has readings, but its samples have no number."
    states = feedback["drive"].tolist()
    if not np.isin(states, range(len(DriveState))).all():
        yield f"The drives' states are {states}; they must be 0 to {len(DriveState) - 1}."
    if feedback["round_trip_ns"] < 0:
        yield f"The round trip is {feedback['round_trip_ns']} ns."
    if not _is_whole(feedback["truth"][:13]):
        yield "The truth must have position, quaternion and lengths, or be NaN where it is not known."


def _is_whole(values: Array) -> bool:
    """Whether all values are finite, or all are NaN."""
    return bool(np.isfinite(values).all() or np.isnan(values).all())
