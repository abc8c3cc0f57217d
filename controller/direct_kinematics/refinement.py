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
def _force(measured: Vector, direction: Vector, weight: float) -> Vector:
    """`weight` P `measured`, P = I - d d^T: with the torque arm x force it is what a leg adds to a right side (6,)."""
    force = scale(weight, measured)
    # Where legs are nearly parallel, the rounding that one projection leaves along them would outweigh the measurement.
    for _ in range(2):
        force = subtract(force, scale(dot(direction, force), direction))
    return force


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
    right_side_at(
        directions, weights, in_base, in_platform, vector_weights, rotation, arms, predicted, lengths, correction
    )  # fmt: skip
    information_at(weights, in_platform, vector_weights, rotation, arms, predicted, lengths, information)


@kernel
def right_side_at(
    directions: Array, weights: Array, in_base: Array, in_platform: Array, vector_weights: Array, rotation: Array, arms: Array,
    predicted: Array, lengths: Array, correction: Array,
) -> None:  # fmt: skip
    """Write the right side of `normal_equations` from the legs at the pose."""
    f0 = f1 = f2 = t0 = t1 = t2 = 0.0
    for k in range(LEGS):
        if weights[k] != 0.0:
            arm = vector(arms[k])
            force = _force(vector(directions[k]), vector(predicted[k]), weights[k] / lengths[k])
            torque = cross(arm, force)
            f0, f1, f2 = f0 + force[0], f1 + force[1], f2 + force[2]
            t0, t1, t2 = t0 + torque[0], t1 + torque[1], t2 + torque[2]
    for k in range(vector_weights.shape[0]):
        w = vector_weights[k]
        if w != 0.0:
            turn = cross(rotate(rotation, vector(in_platform[k])), vector(in_base[k]))
            t0, t1, t2 = t0 + w * turn[0], t1 + w * turn[1], t2 + w * turn[2]
    correction[0], correction[1], correction[2], correction[3], correction[4], correction[5] = f0, f1, f2, t0, t1, t2


@kernel
def information_at(
    weights: Array, in_platform: Array, vector_weights: Array, rotation: Array, arms: Array, predicted: Array, lengths: Array,
    information: Array,
) -> None:  # fmt: skip
    """Write the lower triangle of the matrix (6, 6) of `normal_equations` from the legs at the pose.

    A leg along d with the arm a counts J^T P J, where P = I - d d^T over the square of its length makes the derivative of a
    direction, and J = [I, -skew(a)] that of the leg vector. With c = a x d it is

        [I, -skew(a); skew(a), a^2 I - a a^T] - [d; c] [d; c]^T
    """
    i00 = i10 = i11 = i20 = i21 = i22 = 0.0
    i30 = i31 = i32 = i40 = i41 = i42 = i50 = i51 = i52 = 0.0
    i33 = i43 = i44 = i53 = i54 = i55 = 0.0
    for k in range(LEGS):
        if weights[k] == 0.0:
            continue
        w = weights[k] / (lengths[k] * lengths[k])
        d0, d1, d2 = vector(predicted[k])
        a0, a1, a2 = vector(arms[k])
        c0, c1, c2 = cross((a0, a1, a2), (d0, d1, d2))
        w0, w1, w2 = w * d0, w * d1, w * d2
        i00, i11, i22 = i00 + (w - w0 * d0), i11 + (w - w1 * d1), i22 + (w - w2 * d2)
        i10, i20, i21 = i10 - w1 * d0, i20 - w2 * d0, i21 - w2 * d1
        i30, i31, i32 = i30 - w0 * c0, i31 - (w * a2 + w1 * c0), i32 + (w * a1 - w2 * c0)
        i40, i41, i42 = i40 + (w * a2 - w0 * c1), i41 - w1 * c1, i42 - (w * a0 + w2 * c1)
        i50, i51, i52 = i50 - (w * a1 + w0 * c2), i51 + (w * a0 - w1 * c2), i52 - w2 * c2
        i33 += w * (a1 * a1 + a2 * a2 - c0 * c0)
        i44 += w * (a0 * a0 + a2 * a2 - c1 * c1)
        i55 += w * (a0 * a0 + a1 * a1 - c2 * c2)
        i43, i53, i54 = i43 - w * (a1 * a0 + c1 * c0), i53 - w * (a2 * a0 + c2 * c0), i54 - w * (a2 * a1 + c2 * c1)
    for k in range(vector_weights.shape[0]):
        w = vector_weights[k]
        if w != 0.0:
            v0, v1, v2 = rotate(rotation, vector(in_platform[k]))
            i33, i44, i55 = i33 + w * (1.0 - v0 * v0), i44 + w * (1.0 - v1 * v1), i55 + w * (1.0 - v2 * v2)
            i43, i53, i54 = i43 - w * v1 * v0, i53 - w * v2 * v0, i54 - w * v2 * v1
    information[0, 0], information[1, 0], information[1, 1] = i00, i10, i11
    information[2, 0], information[2, 1], information[2, 2] = i20, i21, i22
    information[3, 0], information[3, 1], information[3, 2] = i30, i31, i32
    information[4, 0], information[4, 1], information[4, 2] = i40, i41, i42
    information[5, 0], information[5, 1], information[5, 2] = i50, i51, i52
    information[3, 3], information[4, 3], information[4, 4] = i33, i43, i44
    information[5, 3], information[5, 4], information[5, 5] = i53, i54, i55


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
            force = _force(vector(rates[k]), vector(predicted[k]), weights[k] / lengths[k])
            torque = cross(vector(arms[k]), force)
            for i in range(3):
                twist[i] += force[i]
                twist[3 + i] += torque[i]
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
