"""Refinement: Gauss-Newton steps on SE(3) that weigh leg directions and vectors by their variances.

The normal matrix is the inverse of the pose's covariance. The twist follows from the same matrix.
"""

import numpy as np

from controller.inverse_kinematics import legs_at
from controller.least_squares import factor_cholesky, solve_cholesky
from plant.compiled import kernel
from plant.mechanism import LEGS
from plant.pose import Array, rotate_by_vector
from plant.vectors import Vector, cross, dot, rotate, scale, subtract, vector

_BEYOND_DOUBT = 1e30  # inverse variance of a known quantity
_LEAST_TO_DOUBT = 6  # measurements: without one of them, four are redundant
_USUAL, _OF_OTHERS = 9.0, 6.0
"""The misfit at which the weight of a measurement is halved, and how much the mean misfit of the others adds to it.

Both were chosen on `gough faults`, seeds 0 to 19 of turned IMUs, of gyroscopes' errors about z and of falling supplies.
"""


@kernel
def _add_leg(right: Array, measured: Vector, direction: Vector, arm: Vector, weight: float) -> None:
    """Add `weight` J^T P `measured` to a right side (6,), P = I - d d^T and J = [I, -skew(arm)]."""
    force = scale(weight, measured)
    # Where legs are nearly parallel, the rounding that one projection leaves along them would outweigh the measurement.
    for _ in range(2):
        force = subtract(force, scale(dot(direction, force), direction))
    torque = cross(arm, force)
    for i in range(3):
        right[i] += force[i]
        right[3 + i] += torque[i]


@kernel
def normal_equations(
    base_joints: Array, platform_joints: Array, directions: Array, weights: Array, in_base: Array, in_platform: Array,
    vector_weights: Array, position: Array, rotation: Array, arms: Array, predicted: Array, lengths: Array,
    information: Array, correction: Array,
) -> None:  # fmt: skip
    """Weighted normal equations for the correction of a pose.

    Args:
        directions: (6, 3), measured.
        weights: (6,), inverse variance of a component of a direction; 0 leaves a leg out.
        in_base, in_platform: (m, 3), vectors known in both frames.
        vector_weights: (m,), inverse variances of the vectors; 0 leaves a vector out.
        arms, predicted, lengths: the legs at the pose, written.
        information: (6, 6), lower triangle written.
        correction: (6,), the right side, written.
    """
    legs_at(base_joints, platform_joints, position, rotation, arms, predicted, lengths)
    correction[:] = 0.0
    information[:] = 0.0
    for k in range(LEGS):
        if weights[k] == 0.0:
            continue
        direction, arm = vector(predicted[k]), vector(arms[k])
        weight = weights[k] / lengths[k]
        # P = I - d d^T makes the derivative of a direction P / l; [I, -skew(a)] is that of the leg vector.
        w = weight / lengths[k]
        d0, d1, d2 = direction
        p = (
            (w * (1.0 - d0 * d0), -w * d0 * d1, -w * d0 * d2),
            (-w * d0 * d1, w * (1.0 - d1 * d1), -w * d1 * d2),
            (-w * d0 * d2, -w * d1 * d2, w * (1.0 - d2 * d2)),
        )
        c0, c1, c2 = cross(arm, p[0]), cross(arm, p[1]), cross(arm, p[2])
        for i in range(3):
            row = c0[i], c1[i], c2[i]
            turned = cross(arm, row)
            for j in range(3):
                information[3 + i, j] += row[j]
            for j in range(i + 1):
                information[i, j] += p[i][j]
                information[3 + i, 3 + j] += turned[j]
        _add_leg(correction, vector(directions[k]), direction, arm, weight)
    for k in range(vector_weights.shape[0]):
        w = vector_weights[k]
        if w == 0.0:
            continue
        v = rotate(rotation, vector(in_platform[k]))
        turn = cross(v, vector(in_base[k]))
        for i in range(3):
            correction[3 + i] += w * turn[i]
            information[3 + i, 3 + i] += w * (1.0 - v[i] * v[i])
            for j in range(i):
                information[3 + i, 3 + j] -= w * v[j] * v[i]


@kernel
def find_misfits(
    directions: Array, weights: Array, predicted: Array, in_base: Array, in_platform: Array, vector_weights: Array,
    rotation: Array, misfits: Array,
) -> float:  # fmt: skip
    """Write the weighted squares that a pose in space leaves of each measurement.

    Args: as for `normal_equations`; `predicted` are the legs' directions at the pose.
        misfits: (6 + m,), of the directions and the vectors, written; -1 for those that are left out.

    Returns:
        Their sum over the number of redundant measurements: 1 on average if the weights are right, 0 if nothing is redundant.
    """
    squares, freedom = 0.0, -6
    misfits[:] = -1.0
    for k in range(LEGS):
        if weights[k] != 0.0:
            off = subtract(vector(directions[k]), vector(predicted[k]))
            misfits[k] = weights[k] * dot(off, off)
            squares += misfits[k]
            freedom += 2
    for k in range(vector_weights.shape[0]):
        if vector_weights[k] != 0.0:
            off = subtract(vector(in_base[k]), rotate(rotation, vector(in_platform[k])))
            misfits[LEGS + k] = vector_weights[k] * dot(off, off)
            squares += misfits[LEGS + k]
            freedom += 2
    return squares / freedom if freedom > 0 else 0.0


@kernel
def find_doubts(misfits: Array, doubts: Array) -> float:
    """Doubt each measurement by how much less it agrees with the pose than the others: the weights are divided by 1 + doubt.

    That is Cauchy's M-estimator (P. J. Huber, *Robust Statistics*, 1981), with the mean of the others in its scale: errors that
    many measurements share are doubted little, as nothing tells which of them are wrong. With few measurements nothing is.

    Args:
        misfits: (n,), of `find_misfits`.
        doubts: (n,), written.

    Returns:
        The misfit per redundant measurement without the worst one; 0 with few measurements.
    """
    count, total, worst = 0, 0.0, 0.0
    for k in range(misfits.shape[0]):
        if misfits[k] >= 0.0:
            count += 1
            total += misfits[k]
            worst = max(worst, misfits[k])
    if count < _LEAST_TO_DOUBT:
        doubts[:] = 0.0
        return 0.0
    for k in range(misfits.shape[0]):
        doubt = misfits[k] / (_USUAL + _OF_OTHERS * (total - misfits[k]) / (count - 1))
        # Not for what is left out or not finite.
        doubts[k] = doubt if 0.0 <= doubt < np.inf else 0.0
    return (total - worst) / (2 * count - 8)


@kernel
def stay_in_plane(information: Array, correction: Array) -> None:
    """Let normal equations move the pose in the xy-plane of {1} alone: no measurement outweighs that it stays there."""
    for i in range(2, 5):
        for j in range(6):
            information[i, j] = 0.0
            information[j, i] = 0.0
        information[i, i] = _BEYOND_DOUBT
        correction[i] = 0.0


@kernel
def solve_normal_equations(information: Array, correction: Array, factor: Array) -> bool:
    """Replace `correction` (6,) by the Gauss-Newton step and write the information's Cholesky factor; False if singular."""
    for i in range(6):
        for j in range(i + 1):
            factor[i, j] = information[i, j]
    if not factor_cholesky(factor):
        return False
    solve_cholesky(factor, correction)
    return True


@kernel
def move_pose(step: Array, position: Array, rotation: Array) -> None:
    """Move a pose, in place, by a step (6,) on SE(3): translation [m], then rotation vector [rad], both seen in {1}."""
    for i in range(3):
        position[i] += step[i]
    rotate_by_vector(rotation, step[3:])


@kernel
def find_twist(
    rates: Array, weights: Array, in_platform: Array, vector_weights: Array, angular_velocity: Array, rotation: Array,
    arms: Array, predicted: Array, lengths: Array, factor: Array, twist: Array,
) -> None:  # fmt: skip
    """The twist (6,) of least squares, from the legs and the factor of `solve_normal_equations`.

    Args:
        rates: (6, 3), derivatives of the directions [1/s].
        angular_velocity: (3,) [rad/s] in {1}; it is to the twist what the vectors are to the attitude.
    """
    twist[:] = 0.0
    for k in range(LEGS):
        if weights[k] != 0.0:
            _add_leg(twist, vector(rates[k]), vector(predicted[k]), vector(arms[k]), weights[k] / lengths[k])
    o = vector(angular_velocity)
    for k in range(vector_weights.shape[0]):
        w = vector_weights[k]
        if w == 0.0:
            continue
        v = rotate(rotation, vector(in_platform[k]))
        across = subtract(o, scale(dot(v, o), v))
        for i in range(3):
            twist[3 + i] += w * across[i]
    solve_cholesky(factor, twist)
