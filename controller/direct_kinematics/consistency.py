"""Consistency of what was measured: which IMU contradicts the others, and whether measured lengths agree with the pose."""

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from controller.direct_kinematics.lengths import pose_from_lengths
from controller.direct_kinematics.spatial import Solution, pose_difference, solve, solve_batch
from controller.inverse_kinematics import inverse_kinematics
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose, checked_array

FALSE_ALARM_RATE = 1e-4  # share of correct measurements that are called faulty
LENGTH_SIGMA = 1e-4  # standard deviation that `cross_check` assumes of a measured length [m]


@dataclass(frozen=True, eq=False)
class Integrity:
    """Whether the measurements of a pose agree, and the pose without the one that does not.

    Attributes:
        solution: the pose, without the faulty IMU if one is named. None if a fault was detected, no IMU can be named, and no
            pose fits.
        detected: whether the measurements contradict each other.
        faulty: the IMU without which the others agree, 0-5 on the legs and 6 on the platform; None if nothing is wrong, or
            if no single IMU explains the contradiction.
        chi_square: sum of squared residuals over variances, of all measurements; infinite if no pose fits them.
        threshold: limit that the sum of correct measurements exceeds at the false-alarm rate.
        degrees_of_freedom: of `chi_square`.
        chi_squares: (7,), the same sum without each IMU; NaN where the pose needs it or it was not measured.
    """

    solution: Solution | None
    detected: bool
    faulty: int | None
    chi_square: float
    threshold: float
    degrees_of_freedom: int
    chi_squares: Array


def integrity(
    mechanism: Mechanism,
    leg_directions: ArrayLike,
    *,
    rotation: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    up_in_platform: ArrayLike | None = None,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    **options: Any,
) -> Integrity:
    """Solve a pose, find out from the residuals whether a measurement is wrong, and solve without it.

    The squared residuals of correct measurements, over their variances, have a chi-square sum. The faulty IMU is the one
    without which the others agree best. Two faults at once are detected but not named.

    Args:
        mechanism, leg_directions, rotation, normal, up_in_platform: as for `solve`.
        false_alarm_rate: share of correct measurements that are called faulty, between 0 and 1.
        options: the `method` and the sigmas of `solve`; the threshold is relative to the sigmas.

    Raises:
        InputError: as `solve`; a rate out of range; or no more is measured than the pose needs.
        SingularConfigurationError: the measurements do not determine the pose.
    """
    attitude = {"rotation": rotation, "normal": normal, "up_in_platform": up_in_platform}
    given: dict[str, Any] = {name: value for name, value in attitude.items() if value is not None}
    fitted, no_pose = None, None
    try:
        fitted = solve(mechanism, leg_directions, **given, **options)
    except SingularConfigurationError as error:
        no_pose = error
    directions = np.array(leg_directions, np.float64)
    measured = [leg for leg in range(LEGS) if np.isfinite(directions[leg, 0])]
    freedom = 2 * len(measured) + sum({"rotation": 3}.get(name, 2) for name in given) - 6
    if freedom <= 0:
        raise InputError(
            f"{len(measured)} legs{''.join(f' and {name}' for name in given)} are no more than a pose needs, so nothing shows "
            "whether they are right: measure more"
        )
    threshold = chi_square_quantile(freedom, false_alarm_rate)
    leave_one_out = np.repeat(directions[None], len(measured), axis=0)
    leave_one_out[range(len(measured)), measured] = np.nan
    repeated: dict[str, Any] = {name: np.repeat([value], len(measured), axis=0) for name, value in given.items()}
    without = solve_batch(mechanism, leave_one_out, **repeated, **options, workers=1)
    alone = {leg: without[i] for i, leg in enumerate(measured) if without.solved[i]}
    if no_pose and not alone:
        raise no_pose
    if given and options.get("method", "auto") == "auto":
        with suppress(SingularConfigurationError):
            alone[PLATFORM_IMU] = solve(mechanism, directions, **options)
    chi_squares = np.full(IMU_COUNT, np.nan)
    for imu, solution in alone.items():
        chi_squares[imu] = solution.chi_square
    chi_square = fitted.chi_square if fitted else math.inf
    excess = {}
    for imu, solution in alone.items():
        degrees = solution.degrees_of_freedom
        if degrees > 0 and solution.chi_square <= chi_square_quantile(degrees, false_alarm_rate):
            excess[imu] = solution.chi_square - degrees
    faulty = min(excess, key=lambda imu: excess[imu]) if excess and chi_square > threshold else None
    best = fitted if faulty is None else alone[faulty]
    return Integrity(best, chi_square > threshold, faulty, chi_square, threshold, freedom, chi_squares)


@dataclass(frozen=True, eq=False)
class LengthCheck:
    """How measured lengths compare with those of a pose found from orientations.

    Attributes:
        errors: (6,) [m], measured minus predicted length; NaN where none was measured.
        deviations: (6,), the errors over their standard deviations.
        chi_square: sum of the squared errors over their covariance.
        threshold: limit that the sum exceeds at the false-alarm rate if lengths and orientations are correct.
        consistent: whether the sum is within the limit.
        pose: the pose at which the legs have these lengths, by Newton's method from the given one; None if a length was not
            measured or there is no such pose.
        distance, angle: between the two poses [m], [rad]; NaN without the second one.
    """

    errors: Array
    deviations: Array
    chi_square: float
    threshold: float
    consistent: bool
    pose: Pose | None
    distance: float
    angle: float


def cross_check(
    mechanism: Mechanism,
    solution: Solution,
    lengths: ArrayLike,
    *,
    length_sigma: float = LENGTH_SIGMA,
    false_alarm_rate: float = FALSE_ALARM_RATE,
) -> LengthCheck:
    """Compare a pose found from orientations with measured lengths, for rigs that have encoders.

    Args:
        solution: from `solve`, with its covariance, for this mechanism.
        lengths: (6,) [m]; NaN where none was measured.
        length_sigma: standard deviation of a measured length [m].
        false_alarm_rate: share of correct measurements that are called inconsistent, between 0 and 1.

    Raises:
        InputError: wrong shape, no length at all, a sigma not positive, or a rate out of range.
    """
    given = checked_array(lengths, (LEGS,), "lengths", allow_nan=True)
    measured = ~np.isnan(given)
    if not measured.any():
        raise InputError("no length was measured: give one at least")
    if not checked_array(length_sigma, (), "length_sigma") > 0.0:
        raise InputError(f"length_sigma is {length_sigma}; it must be positive [m]")
    threshold = chi_square_quantile(int(measured.sum()), false_alarm_rate)
    legs = inverse_kinematics(mechanism, Pose(solution.position, solution.rotation))
    errors = given - legs.lengths
    covariance = legs.jacobian @ solution.covariance @ legs.jacobian.T + length_sigma**2 * np.eye(LEGS)
    chosen = np.ix_(measured, measured)
    chi_square = float(errors[measured] @ np.linalg.solve(covariance[chosen], errors[measured]))
    pose, distance, angle = None, math.nan, math.nan
    if measured.all():
        with suppress(SingularConfigurationError):
            pose = pose_from_lengths(mechanism, given, Pose(solution.position, solution.rotation))
            distance, angle = pose_difference(pose, solution)
    return LengthCheck(
        errors, errors / np.sqrt(np.diag(covariance)), chi_square, threshold, chi_square <= threshold, pose, distance, angle
    )


def chi_square_quantile(degrees_of_freedom: int, rate: float) -> float:
    """The value that a chi-square sum exceeds at this rate; an `InputError` unless it is between 0 and 1."""
    # Imported here: a process that runs a loop imports this module, and SciPy takes long.
    from scipy.special import chdtri

    if not 0.0 < checked_array(rate, (), "the false-alarm rate", allow_nan=True) < 1.0:
        raise InputError(f"the false-alarm rate is {rate}; it must lie between 0 and 1")
    return float(chdtri(degrees_of_freedom, rate))
