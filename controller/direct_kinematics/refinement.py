"""Refinement: Gauss-Newton steps on SE(3) that weigh leg directions and vectors by their variances.

The normal matrix is the inverse of the pose's covariance; the twist follows from the same matrix.
"""

from controller.inverse_kinematics import legs_at
from controller.least_squares import factor_cholesky, solve_cholesky
from plant.compiled import kernel
from plant.mechanism import LEGS
from plant.pose import Array, rotate_by_vector

_BEYOND_DOUBT = 1e30
"""Inverse variance of what is known."""


@kernel
def _across(direction: Array, x0: float, x1: float, x2: float) -> tuple[float, float, float]:
    """The part of a vector x that is across a unit vector, projected twice: where legs are nearly parallel, what rounding
    leaves along them would weigh more than what they measure.
    """
    d0, d1, d2 = direction[0], direction[1], direction[2]
    for _ in range(2):
        along = d0 * x0 + d1 * x1 + d2 * x2
        x0, x1, x2 = x0 - along * d0, x1 - along * d1, x2 - along * d2
    return x0, x1, x2


@kernel
def _add_leg(right: Array, measured: Array, direction: Array, arm: Array, scale: float) -> None:
    """Add `scale` J^T P `measured` to a right side (6,), P = I - d d^T and J = [I, -skew(arm)]."""
    a0, a1, a2 = arm[0], arm[1], arm[2]
    g0, g1, g2 = _across(direction, scale * measured[0], scale * measured[1], scale * measured[2])
    right[0] += g0
    right[1] += g1
    right[2] += g2
    right[3] += a1 * g2 - a2 * g1
    right[4] += a2 * g0 - a0 * g2
    right[5] += a0 * g1 - a1 * g0


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
        in_base, in_platform: (m, 3), vectors known in both frames; `vector_weights` (m,) are their inverse variances, and 0
            leaves one out.
        arms, predicted, lengths: the legs at the pose, written.
        information: (6, 6), lower triangle written; `correction` (6,) is the right side.
    """
    legs_at(base_joints, platform_joints, position, rotation, arms, predicted, lengths)
    for i in range(6):
        correction[i] = 0.0
        for j in range(6):
            information[i, j] = 0.0
    for k in range(LEGS):
        w = weights[k]
        if w == 0.0:
            continue
        d0, d1, d2 = predicted[k, 0], predicted[k, 1], predicted[k, 2]
        a0, a1, a2 = arms[k, 0], arms[k, 1], arms[k, 2]
        scale = w / lengths[k]
        # P = I - d d^T makes the derivative of a direction P / l; [I, -skew(a)] is that of the leg vector.
        w2 = scale / lengths[k]
        p00, p01, p02 = w2 * (1.0 - d0 * d0), -w2 * d0 * d1, -w2 * d0 * d2
        p11, p12, p22 = w2 * (1.0 - d1 * d1), -w2 * d1 * d2, w2 * (1.0 - d2 * d2)
        information[0, 0] += p00
        information[1, 0] += p01
        information[1, 1] += p11
        information[2, 0] += p02
        information[2, 1] += p12
        information[2, 2] += p22
        m00, m01, m02 = a1 * p02 - a2 * p01, a1 * p12 - a2 * p11, a1 * p22 - a2 * p12
        m10, m11, m12 = a2 * p00 - a0 * p02, a2 * p01 - a0 * p12, a2 * p02 - a0 * p22
        m20, m21, m22 = a0 * p01 - a1 * p00, a0 * p11 - a1 * p01, a0 * p12 - a1 * p02
        information[3, 0] += m00
        information[3, 1] += m01
        information[3, 2] += m02
        information[4, 0] += m10
        information[4, 1] += m11
        information[4, 2] += m12
        information[5, 0] += m20
        information[5, 1] += m21
        information[5, 2] += m22
        information[3, 3] += a1 * m02 - a2 * m01
        information[4, 3] += a1 * m12 - a2 * m11
        information[5, 3] += a1 * m22 - a2 * m21
        information[4, 4] += a2 * m10 - a0 * m12
        information[5, 4] += a2 * m20 - a0 * m22
        information[5, 5] += a0 * m21 - a1 * m20
        _add_leg(correction, directions[k], predicted[k], arms[k], scale)
    for k in range(vector_weights.shape[0]):
        w = vector_weights[k]
        if w == 0.0:
            continue
        v0 = rotation[0, 0] * in_platform[k, 0] + rotation[0, 1] * in_platform[k, 1] + rotation[0, 2] * in_platform[k, 2]
        v1 = rotation[1, 0] * in_platform[k, 0] + rotation[1, 1] * in_platform[k, 1] + rotation[1, 2] * in_platform[k, 2]
        v2 = rotation[2, 0] * in_platform[k, 0] + rotation[2, 1] * in_platform[k, 1] + rotation[2, 2] * in_platform[k, 2]
        b0, b1, b2 = in_base[k, 0], in_base[k, 1], in_base[k, 2]
        information[3, 3] += w * (1.0 - v0 * v0)
        information[4, 3] -= w * v0 * v1
        information[5, 3] -= w * v0 * v2
        information[4, 4] += w * (1.0 - v1 * v1)
        information[5, 4] -= w * v1 * v2
        information[5, 5] += w * (1.0 - v2 * v2)
        correction[3] += w * (v1 * b2 - v2 * b1)
        correction[4] += w * (v2 * b0 - v0 * b2)
        correction[5] += w * (v0 * b1 - v1 * b0)


@kernel
def stay_in_plane(information: Array, correction: Array) -> None:
    """Let normal equations move the pose in the xy-plane of {1} alone: beyond all doubt it does not leave it."""
    for i in range(2, 5):
        for j in range(6):
            information[i, j] = 0.0
            information[j, i] = 0.0
        information[i, i] = _BEYOND_DOUBT
        correction[i] = 0.0


@kernel
def solve_normal_equations(information: Array, correction: Array, factor: Array) -> bool:
    """Replace `correction` (6,) by the Gauss-Newton step; `factor` becomes the Cholesky factor of the information. False if
    that is singular.
    """
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
        angular_velocity: (3,) [rad/s] in {1}, which counts for the twist as the vectors do for the attitude.
    """
    for i in range(6):
        twist[i] = 0.0
    for k in range(LEGS):
        if weights[k] != 0.0:
            _add_leg(twist, rates[k], predicted[k], arms[k], weights[k] / lengths[k])
    o0, o1, o2 = angular_velocity[0], angular_velocity[1], angular_velocity[2]
    for k in range(vector_weights.shape[0]):
        w = vector_weights[k]
        if w == 0.0:
            continue
        v0 = rotation[0, 0] * in_platform[k, 0] + rotation[0, 1] * in_platform[k, 1] + rotation[0, 2] * in_platform[k, 2]
        v1 = rotation[1, 0] * in_platform[k, 0] + rotation[1, 1] * in_platform[k, 1] + rotation[1, 2] * in_platform[k, 2]
        v2 = rotation[2, 0] * in_platform[k, 0] + rotation[2, 1] * in_platform[k, 1] + rotation[2, 2] * in_platform[k, 2]
        along = v0 * o0 + v1 * o1 + v2 * o2
        twist[3] += w * (o0 - along * v0)
        twist[4] += w * (o1 - along * v1)
        twist[5] += w * (o2 - along * v2)
    solve_cholesky(factor, twist)
