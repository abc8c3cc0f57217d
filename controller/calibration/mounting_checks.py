"""Checks before a loop is closed: whether each IMU works, sits in its place, and has the right orientation and wiring.

The drives follow a plan with the loop open, and each IMU must read the motion of its place. For an IMU that does not, the check
tries the places of the others, and the 48 signed permutations of its axes: 24 rotations and 24 mirrored ones.
"""

from functools import cache
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.errors import CalibrationError
from plant.imu import ACCELEROMETER, STANDARD_GRAVITY
from plant.pose import Array, vector_from_rotation

# Another place or other axes are believed if they leave less than this share of what the right ones leave unexplained.
FAR_BETTER = 0.5
MOST_TILT = np.radians(15.0)  # of the mean force from the expected one [rad]; raw IMUs are off by 8 degrees
LEAST_MOTION = 0.2  # share of the expected motion that an IMU must read
LEAST_RATE = np.radians(1.0)  # RMS of the rate of some IMU in a motion [rad/s]
LEAST_SPREAD = np.radians(3.0)  # angle between verticals of some IMU over the rests [rad]
_FROZEN_S = 0.1
_SENSORS = ("gyroscope", "accelerometer")
_GRAVITY_RANGE = (0.7 * STANDARD_GRAVITY, 1.3 * STANDARD_GRAVITY)


def check_alive(samples: Array) -> None:
    """Check raw samples (N, 3, 7, 3) at rest: no IMU is frozen while others are not, and each reads gravity.

    Raises:
        CalibrationError: one does not; the message names it.
    """
    frozen = (samples[:, :2] == samples[0, :2]).all(axis=(0, 1, 3))
    for imu in range(IMU_COUNT):
        own = samples[:, :2, imu]
        if not np.isfinite(own).all():
            raise CalibrationError(f"IMU {imu} gives readings that are not finite: check its cable and its supply")
        if frozen[imu] and not frozen.all():
            raise CalibrationError(
                f"IMU {imu} is frozen: {len(own)} readings are the same, and others' are not: check its cable and its supply"
            )
        force = float(np.linalg.norm(own[:, ACCELEROMETER].mean(axis=0)))
        if not _GRAVITY_RANGE[0] <= force <= _GRAVITY_RANGE[1]:
            raise CalibrationError(
                f"the accelerometer of IMU {imu} reads {force:.3g} m/s2 at rest; gravity is {_GRAVITY_RANGE[0]:.3g} to "
                f"{_GRAVITY_RANGE[1]:.3g}: it is dead, or its range or unit is another"
            )


def check_gravity(forces: Array, expected: Array) -> float:
    """Check that gravity in raw mean forces (7, 3) at rest comes from where it does at home, `expected` (7, 3); returns the
    greatest angle between them [rad].

    Raises:
        CalibrationError: it does not; the message names each such IMU.
    """
    cosines = (forces * expected).sum(axis=1) / (np.linalg.norm(forces, axis=1) * np.linalg.norm(expected, axis=1))
    tilts = np.arccos(np.clip(cosines, -1.0, 1.0))
    if found := [f"IMU {imu} by {np.degrees(tilts[imu]):.3g} deg" for imu in np.flatnonzero(tilts > MOST_TILT)]:
        raise CalibrationError(
            f"gravity comes from elsewhere than at home: {', '.join(found)}; at most {np.degrees(MOST_TILT):g} deg are "
            "allowed: bring the platform near home, or check how these are mounted and in which order their axes are read"
        )
    return float(tilts.max())


def check_all_along(samples: Array, rate: float) -> None:
    """Check all samples (N, 3, 7, 3) at this rate [Hz]: every IMU gives finite readings, and none is frozen for a tenth of a
    second while others are not.

    Raises:
        CalibrationError: one is; the message names it, and when.
    """
    readings = samples[:, :2]
    lost = np.atleast_2d(~np.isfinite(readings).all(axis=(1, 3)))
    same = (readings[1:] == readings[:-1]).all(axis=(1, 3))
    same &= ~same.all(axis=1, keepdims=True)
    reach = max(round(_FROZEN_S * rate), 3)
    frozen = np.atleast_2d(sliding_window_view(same, min(reach, len(same)), axis=0).all(axis=2))
    faults = {"gives readings that are not finite": lost, "is frozen while others are not": frozen}
    for imu, (what, found) in product(range(IMU_COUNT), faults.items()):
        if found[:, imu].any():
            first, whole = found[:, imu].argmax() / rate, found[:, imu].sum() / rate
            raise CalibrationError(
                f"IMU {imu} {what} {first:.3g} s into a run, for {whole:.3g} s in all: check its cable and its supply"
            )


def spreads_of(forces: Array) -> Array:
    """The greatest angle (7,) [rad] between two of each IMU's mean forces (N, 7, 3)."""
    verticals = forces / np.linalg.norm(forces, axis=2, keepdims=True)
    cosines = np.einsum("nki,mki->knm", verticals, verticals).min(axis=(1, 2))
    angles: Array = np.arccos(np.clip(cosines, -1.0, 1.0))
    return angles


def check_spread(forces: Array) -> None:
    """Check by raw mean forces (N, 7, 3) that the rests differ enough, and that every leg takes part.

    Raises:
        CalibrationError: they do not, or one does not.
    """
    spreads = spreads_of(forces)
    if spreads.max() < LEAST_SPREAD:
        raise CalibrationError(
            f"the poses are too alike: between any two of {len(forces)} rests, no IMU turns by more than "
            f"{np.degrees(spreads.max()):.2g} deg; at least {np.degrees(LEAST_SPREAD):g} deg are needed: rest at wider poses"
        )
    least = LEAST_MOTION * float(np.median(spreads))
    for imu in np.flatnonzero(spreads < least).tolist():
        raise CalibrationError(
            f"IMU {imu} turns by {np.degrees(spreads[imu]):.2g} deg between rests, and the others by "
            f"{np.degrees(np.median(spreads)):.2g}; at least {np.degrees(least):.2g} are needed: {_idle(imu)}"
        )


def check_motion(rates: Array) -> None:
    """Check that rates (N, 7, 3) [rad/s], minus those at rest, show a motion.

    Raises:
        CalibrationError: they do not.
    """
    most = float(np.sqrt(np.square(rates).sum(axis=2).mean(axis=0)).max())
    if most < LEAST_RATE:
        raise CalibrationError(
            f"the rig hardly moves: no IMU turns at more than {np.degrees(most):.2g} deg/s RMS; at least "
            f"{np.degrees(LEAST_RATE):g} are needed: record 'shaking' for 20 s or longer"
        )


def check_places(readings: Array, expected: Array) -> None:
    """Check that each IMU roughly reads the motion of its place, along a planned motion: by raw readings (N, 7, 6), the rates
    minus those at rest, and those `expected` (N, 7, 6) of ideal IMUs.

    Raises:
        CalibrationError: one or more do not. The message names each, and its place, orientation or wiring if that explains its
            readings.
    """
    check_motion(expected[:, :, :3])
    fit, everywhere = _Fit(readings, expected), range(IMU_COUNT)
    left = np.array([[fit.left(imu, place) for place in everywhere] for imu in everywhere])
    best, found = left.argmin(axis=1).tolist(), []
    moved = np.flatnonzero(left.min(axis=1) < FAR_BETTER * np.diag(left))
    for imu, place in enumerate(best):
        if imu not in moved or min(fit.share(imu, sensor) for sensor in range(2)) < LEAST_MOTION:
            found += _explained(fit, imu)
        elif place in moved and best[place] == imu:
            found += [f"IMUs {imu} and {place} are swapped: exchange their cables or numbers"] if imu < place else []
        else:
            found.append(f"IMU {imu} sits where IMU {place} should: put each on its own place")
    if found:
        raise CalibrationError("; ".join(found))


def _idle(imu: int) -> str:
    return f"{'the platform' if imu == PLATFORM_IMU else f'leg {imu}'} does not move, or the IMU is not fixed to it"


def _explained(fit: "_Fit", imu: int) -> list[str]:
    """What is wrong with an IMU in its own place."""
    shares = [fit.share(imu, sensor) for sensor in range(2)]
    if max(shares) < LEAST_MOTION:
        return [
            f"IMU {imu} reads {max(shares):.2g} of the expected motion, and at least {LEAST_MOTION:g} is needed: {_idle(imu)}"
        ]
    misfits = np.array([[fit.misfit(imu, imu, sensor, each.matrix) for each in _axes()] for sensor in range(2)])
    least, left = misfits.min(axis=1), np.linalg.norm(misfits, axis=0)
    best, both = [_axes()[i] for i in misfits.argmin(axis=1)], _axes()[left.argmin()]
    wrong = least < FAR_BETTER * misfits[:, 0]
    alike = FAR_BETTER * left.min() < np.linalg.norm(least)
    # No mounting mirrors: mirrored axes of both sensors are believed only if each sensor alone needs other axes.
    if left.min() < FAR_BETTER * left[0] and alike and (wrong.all() or both.turned):
        return [f"IMU {imu} reads {both.text}: mount it as it should be, or change the axes of both its sensors"]
    told = []
    for sensor, name in enumerate(_SENSORS):
        if wrong[sensor]:
            told.append(f"the {name} of IMU {imu} reads {best[sensor].text}: change its axes")
        elif shares[sensor] < LEAST_MOTION:
            told.append(
                f"the {name} of IMU {imu} reads {shares[sensor]:.2g} of the expected changes, and at least "
                f"{LEAST_MOTION:g} is needed: it is dead, or its range or unit is another"
            )
    if not told and (tilt := fit.tilt(imu)) > MOST_TILT:
        told.append(
            f"gravity at IMU {imu} is {np.degrees(tilt):.3g} deg off the expected direction; at most {np.degrees(MOST_TILT):g} "
            "deg are allowed, and no axes explain it: check its mounting, and whether the rig begins at home"
        )
    return told


class _Fit:
    """How well the readings (N, 7, 6) expected of a place explain an IMU's readings (N, 7, 6), with right or other axes.

    Trends are left out: with the loop open, the platform sinks.
    """

    def __init__(self, readings: Array, expected: Array) -> None:
        trends = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, len(readings)), 3))[0]
        both = np.stack([readings, expected]).reshape(2, len(readings), -1)
        self._means = both.mean(axis=1).reshape(2, IMU_COUNT, 2, 3)
        self._changes = (both - trends @ (trends.T @ both)).reshape(2, -1, IMU_COUNT, 2, 3)

    def share(self, imu: int, sensor: int) -> float:
        """Size of the changes that a sensor reads, relative to the expected ones."""
        read, expected = (np.sqrt(np.square(each[:, imu, sensor]).mean()) for each in self._changes)
        return float(read / expected)

    def tilt(self, imu: int) -> float:
        """Angle between gravity and its expected direction [rad]."""
        read, expected = (each[imu, ACCELEROMETER] / np.linalg.norm(each[imu, ACCELEROMETER]) for each in self._means)
        return float(np.arccos(np.clip(read @ expected, -1.0, 1.0)))

    def misfit(self, imu: int, place: int, sensor: int, axes: Array) -> float:
        """What a place with these axes leaves unexplained: RMS of a sensor's changes relative to the expected ones, and for a
        force its mean relative to the allowed deviation.
        """
        read, expected = self._changes[0][:, imu, sensor], self._changes[1][:, place, sensor]
        changed = np.sqrt(np.square(read - expected @ axes.T).mean() / np.square(expected).mean())
        mean, expected_mean = (each[at, sensor] for each, at in zip(self._means, (imu, place), strict=True))
        off = np.linalg.norm(mean - axes @ expected_mean) / (MOST_TILT * STANDARD_GRAVITY) if sensor == ACCELEROMETER else 0.0
        return float(np.hypot(changed, off))

    def left(self, imu: int, place: int) -> float:
        """What a place with the right axes leaves unexplained of both sensors."""
        return float(np.linalg.norm([self.misfit(imu, place, sensor, np.eye(3)) for sensor in range(2)]))


class _Axes(NamedTuple):
    """The axes that an IMU reads as its x, y and z."""

    text: str
    matrix: Array  # (3, 3)
    turned: bool  # whether a mounting can cause this; it cannot mirror


@cache
def _axes() -> list[_Axes]:
    """All 48, the right ones first."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix: Array = np.array(signs)[:, None] * np.eye(3)[list(order)]
        name = "".join(f"{'-' if sign < 0.0 else '+'}{'xyz'[axis]}" for sign, axis in zip(signs, order, strict=True))
        turned = bool(np.linalg.det(matrix) > 0.0)
        found.append(_Axes(f"{name} for its x, y and z, {_words(matrix, turned)}", matrix, turned))
    return found


def _words(matrix: Array, turned: bool) -> str:
    if turned:
        # A turned IMU reads the world turned the other way.
        turn = vector_from_rotation(matrix.T)
        angle, about = np.degrees(np.linalg.norm(turn)), turn / np.abs(turn).max(initial=1e-9)
        names = "".join(f"{'-' if x < 0.0 else '+'}{name}" for name, x in zip("xyz", about, strict=True) if abs(x) > 0.5)
        return f"as if turned by {angle:.0f} deg about {names}"
    wrong = [name for name, value in zip("xyz", np.diag(matrix), strict=True) if value < 0.0]
    if np.count_nonzero(np.diag(matrix)) < 3:
        return "mirrored"
    return "all signs wrong" if len(wrong) == 3 else f"the sign of {wrong[0]} wrong"
