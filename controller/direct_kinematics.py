"""Direct kinematics: from the directions of the legs to the pose, in closed form and without a first guess.

Every leg gives `skew(r) (p + R a - b) = 0`, of rank two; written here with two unit vectors across the leg, which is the
same least-squares problem with two rows a leg instead of three.

- Rotation known (the paper's section 5, (21)-(28)): linear in p.
- One vector known in both frames, `R v_platform = v_base`: the vertical seen by the platform's accelerometer, or the
  platform's normal of the paper's section 4. `R = Rot(v_base, yaw) R_0` with any R_0 that carries the one to the other,
  so the problem is linear in (p, cos yaw, sin yaw), for every class of mechanism.
- Legs alone, coplanar platform joints: linear in p and the two columns of R that span the joints' plane.

Each is followed by Gauss-Newton steps on SE(3) that weigh legs and vectors by their variances; the normal matrix gives
the covariance. Lengths give the pose by Newton's method, from a first guess.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from controller.inverse_kinematics import jacobian_at, legs_at
from controller.least_squares import RANK_TOLERANCE, factor_cholesky, solve_cholesky, solve_least_squares
from plant.compiled import kernel
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism import LEGS, Mechanism
from plant.pose import (
    UNIT_TOLERANCE,
    Array,
    Pose,
    checked_array,
    checked_rotation,
    checked_unit,
    rotate_by_vector,
    rotation_angle,
)

LEG_SIGMA = np.radians(0.05)
"""Standard deviation that `solve` assumes of each component of a leg's direction [rad]."""

TILT_SIGMA = np.radians(0.05)
"""Standard deviation that `solve` assumes of roll and pitch [rad]."""

YAW_SIGMA = np.radians(1.5)
"""Standard deviation that `solve` assumes of a yaw that was measured magnetically [rad]."""

LEAST_CONDITIONING = 1e-6
"""Conditioning below which `solve` calls the measurements singular."""

_COPLANAR = 1e-6
"""Platform joints count as coplanar if they leave their plane by less than this share of their spread."""

_MAX_REFINEMENTS = 10
_NEWTON_LIMIT = 50


@dataclass(frozen=True, eq=False)
class Solution:
    """A pose found from leg directions.

    Attributes:
        position: (3,) [m], origin of {2} in {1}.
        rotation: (3, 3), maps {2} to {1}.
        covariance: (6, 6) of position [m] and of a small rotation seen in {1} [rad].
        residuals: (6, 3), measured minus predicted direction of each leg; NaN where a leg was not measured.
        method: the closed form that it started from: "rotation", "up", "normal" or "legs".
        conditioning: reciprocal condition of that closed form, as the ratio of the diagonal of R in its QR.
    """

    position: Array
    rotation: Array
    covariance: Array
    residuals: Array
    method: str
    conditioning: float


@dataclass(frozen=True, eq=False)
class JointPlane:
    """The plane of the platform joints: `center` (3,) and `axes` (3, 3), whose columns span it and end with its normal;
    `flatness` is the joints' distance from it relative to their spread.
    """

    center: Array
    axes: Array
    flatness: float


def joint_plane(mechanism: Mechanism) -> JointPlane:
    """The plane through the platform joints of least squared distance."""
    center = mechanism.platform_joints.mean(axis=0)
    _, spread, axes = np.linalg.svd(mechanism.platform_joints - center)
    axes[2] *= np.sign(np.linalg.det(axes))
    return JointPlane(center, np.ascontiguousarray(axes.T), float(spread[2] / spread[0]))


def solve(
    mechanism: Mechanism,
    leg_directions: ArrayLike,
    *,
    rotation: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    up_in_platform: ArrayLike | None = None,
    leg_sigma: float = LEG_SIGMA,
    tilt_sigma: float = TILT_SIGMA,
    yaw_sigma: float = YAW_SIGMA,
) -> Solution:
    """The pose of the platform from the directions of its legs and what else is known of its attitude.

    Args:
        mechanism: two arrays of joints are enough.
        leg_directions: (6, 3), unit, from base to platform joint, seen in {1}; a row of NaN is a leg not measured.
        rotation: (3, 3), measured roll-pitch-yaw; maps {2} to {1} (the paper's section 5).
        normal: (3,), the z axis of {2} seen in {1} (the paper's section 4).
        up_in_platform: (3,), the vertical seen in {2}: what an accelerometer at rest measures.
        leg_sigma: standard deviation of each component of a direction [rad].
        tilt_sigma: of roll and pitch, as the vertical, the normal or the rotation give them [rad].
        yaw_sigma: of the yaw in `rotation` [rad].

    With several given, the closed form uses the first of rotation, vertical, normal; the refinement uses all. Measurements
    that contradict each other show in the residuals, which are to be compared with the sigmas.

    Raises:
        InputError: wrong shape, not finite, off unit length by more than 1e-3, a reflection, a sigma not positive.
        SingularConfigurationError: the measurements do not determine the pose.
    """
    directions, measured = _checked_directions(leg_directions)
    for name, sigma in (("leg_sigma", leg_sigma), ("tilt_sigma", tilt_sigma), ("yaw_sigma", yaw_sigma)):
        if not 0.0 < checked_array(sigma, (), name) < np.inf:
            raise InputError(f"{name} is {sigma}; it must be positive and finite [rad]")
    up = mechanism.up_in_base
    tilt, yaw = 1.0 / tilt_sigma**2, 1.0 / yaw_sigma**2
    observed: list[tuple[Array, Array, float]] = []
    known_rotation: Array | None = None
    if rotation is not None:
        known_rotation = checked_rotation(rotation, "rotation")
        across = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.8 else [0.0, 1.0, 0.0])
        level: Array = across / np.linalg.norm(across)
        # These weights add up to `yaw` about the vertical and to `tilt` about every level axis.
        axes = ((up, tilt - yaw / 2.0), (level, yaw / 2.0), (np.cross(up, level), yaw / 2.0))
        observed += [(axis, known_rotation.T @ axis, weight) for axis, weight in axes]
    if up_in_platform is not None:
        observed.append((up, checked_unit(up_in_platform, 3, "up_in_platform"), tilt))
    if normal is not None:
        observed.append((checked_unit(normal, 3, "normal"), np.array([0.0, 0.0, 1.0]), tilt))
    vectors = _vector_observations(observed)

    joints = (mechanism.base_joints, mechanism.platform_joints)
    work = Workspace()
    position: Array = np.zeros(3)
    found: Array = np.eye(3)
    if known_rotation is not None:
        method, found = "rotation", known_rotation.copy()
        conditioning = pose_from_rotation(*joints, directions, measured, found, position, *work.linear)
    elif observed:
        method = "up" if up_in_platform is not None else "normal"
        in_base, in_platform, _ = observed[0]
        conditioning = pose_from_vector(*joints, directions, measured, in_base, in_platform, position, found, *work.linear)
    else:
        method = "legs"
        plane = joint_plane(mechanism)
        if plane.flatness > _COPLANAR:
            raise SingularConfigurationError(
                f"the platform joints leave their plane by {plane.flatness:.2g} of their spread, and leg directions alone give "
                "a closed form for coplanar ones: measure up_in_platform too"
            )
        conditioning = pose_from_legs(*joints, directions, measured, plane.center, plane.axes, position, found, *work.linear)
    if conditioning < LEAST_CONDITIONING:
        raise SingularConfigurationError(
            f"{int(measured.sum())} leg directions{' and ' + method if observed else ''} do not give the pose of "
            f"{mechanism.name!r} in closed form here: measure more legs, up_in_platform or the rotation"
        )
    weights = measured / leg_sigma**2
    for _ in range(_MAX_REFINEMENTS):
        if not refine(*joints, directions, work.no_rates, weights, *vectors, work.no_rate, position, found, *work.refinement):
            raise SingularConfigurationError("the pose that fits the measurements is singular: measure more")
        if np.abs(work.correction).max() < 1e-14:
            break
    legs_at(*joints, position, found, work.arms, work.predicted, work.lengths)
    if (np.sum(work.predicted * directions, axis=1)[measured > 0.0] <= 0.0).any():
        raise SingularConfigurationError(
            "the pose that fits best has legs of negative length: the directions contradict each other, or point down the legs"
        )
    normal_equations(*joints, directions, work.no_rates, weights, *vectors, work.no_rate, position, found, *work.equations)
    covariance: Array = np.linalg.inv(work.information + np.tril(work.information, -1).T)
    residuals = np.where(measured[:, None] > 0.0, directions - work.predicted, np.nan)
    return Solution(position, found, covariance, residuals, method, conditioning)


def pose_from_lengths(mechanism: Mechanism, lengths: ArrayLike, guess: Pose | None = None) -> Pose:
    """The pose at which the legs have these lengths, by Newton's method on SE(3) from a first guess (default: home).

    Raises:
        InputError: wrong shape or not finite, or the guess is no pose.
        SingularConfigurationError: no pose near the guess has these lengths.
    """
    start = guess or mechanism.require_home()
    target = checked_array(lengths, (LEGS,), "lengths")
    position = checked_array(start.position, (3,), "guess.position").copy()
    rotation = checked_rotation(start.rotation, "guess.rotation").copy()
    work = Workspace()
    error = newton_from_lengths(mechanism.base_joints, mechanism.platform_joints, target, position, rotation, *work.newton)
    if not error < 1e-10:
        raise SingularConfigurationError(
            f"no pose near the guess has these lengths (they are missed by {1e3 * error:.3g} mm): they are not reachable, or "
            "the guess is too far"
        )
    return Pose(position, rotation)


class Workspace:
    """Scratch for the compiled functions of this file, named in the order in which they take it."""

    def __init__(self) -> None:
        self.matrix, self.right, self.unknowns = np.zeros((2 * LEGS, 9)), np.zeros(2 * LEGS), np.zeros(9)
        self.norms, self.order = np.zeros(9), np.zeros(9)
        self.arms, self.predicted, self.lengths = np.zeros((LEGS, 3)), np.zeros((LEGS, 3)), np.zeros(LEGS)
        self.information, self.correction, self.twist = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
        self.factor, self.jacobian = np.zeros((6, 6)), np.zeros((6, 6))
        self.no_rates, self.no_rate = np.zeros((LEGS, 3)), np.zeros(3)
        self.linear = (self.matrix, self.right, self.unknowns, self.norms, self.order)
        self.equations = (self.arms, self.predicted, self.lengths, self.information, self.correction, self.twist)
        self.refinement = (*self.equations, self.factor)
        self.newton = (self.arms, self.predicted, self.lengths, self.jacobian, self.correction, self.norms, self.order)


def _checked_directions(leg_directions: ArrayLike) -> tuple[Array, Array]:
    directions = checked_array(leg_directions, (LEGS, 3), "leg_directions", allow_nan=True).copy()
    measured = np.ones(LEGS)
    for leg, row in enumerate(directions):
        if np.isnan(row).all():
            measured[leg] = 0.0
            row[:] = (0.0, 0.0, 1.0)
            continue
        if np.isnan(row).any():
            raise InputError(f"leg_directions[{leg}] is partly NaN; a leg that is not measured has a row of NaN")
        norm = np.linalg.norm(row)
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise InputError(
                f"leg_directions[{leg}] has length {norm:.6g}; it must be 1 within {UNIT_TOLERANCE:g}: normalise it"
            )
        row /= norm
    return directions, measured


def _vector_observations(observed: list[tuple[Array, Array, float]]) -> tuple[Array, Array, Array]:
    in_base = np.array([base for base, _, _ in observed]).reshape(-1, 3)
    in_platform = np.array([platform for _, platform, _ in observed]).reshape(-1, 3)
    return in_base, in_platform, np.array([weight for _, _, weight in observed])


@kernel
def _across(direction: Array) -> tuple[float, float, float, float, float, float]:
    """Two unit vectors that span the plane across a unit vector (Duff et al. 2017, with the sign of z)."""
    x, y, z = direction[0], direction[1], direction[2]
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@kernel
def _spread(joints: Array, measured: Array) -> float:
    """Root mean square distance of the measured legs' joints (6, 3) from their centre [m]: the length in which columns for
    a rotation are counted, so that the conditioning does not depend on the size of the mechanism.
    """
    count = c0 = c1 = c2 = total = 0.0
    for k in range(LEGS):
        if measured[k] != 0.0:
            count += 1.0
            c0 += joints[k, 0]
            c1 += joints[k, 1]
            c2 += joints[k, 2]
            total += joints[k, 0] ** 2 + joints[k, 1] ** 2 + joints[k, 2] ** 2
    if count == 0.0:
        return 1.0
    variance = (total - (c0 * c0 + c1 * c1 + c2 * c2) / count) / count
    return np.sqrt(variance) if variance > 0.0 else 1.0


@kernel
def rotation_between(from_vector: Array, to_vector: Array, rotation: Array) -> None:
    """Write a rotation (3, 3) that carries one unit vector to another, opposite ones included."""
    flip = from_vector[0] * to_vector[0] + from_vector[1] * to_vector[1] + from_vector[2] * to_vector[2] < 0.0
    # Opposite vectors have no shortest way: half a turn about an axis across the first brings them together.
    t0, t1, t2, _, _, _ = _across(from_vector)
    f0, f1, f2 = from_vector[0], from_vector[1], from_vector[2]
    if flip:
        f0, f1, f2 = -f0, -f1, -f2
    v0, v1, v2 = (
        f1 * to_vector[2] - f2 * to_vector[1],
        f2 * to_vector[0] - f0 * to_vector[2],
        f0 * to_vector[1] - f1 * to_vector[0],
    )
    cosine = f0 * to_vector[0] + f1 * to_vector[1] + f2 * to_vector[2]
    k = 1.0 / (1.0 + cosine)
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = cosine + k * v0 * v0, k * v0 * v1 - v2, k * v0 * v2 + v1
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = k * v0 * v1 + v2, cosine + k * v1 * v1, k * v1 * v2 - v0
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = k * v0 * v2 - v1, k * v1 * v2 + v0, cosine + k * v2 * v2
    if flip:
        for i in range(3):
            dot = rotation[i, 0] * t0 + rotation[i, 1] * t1 + rotation[i, 2] * t2
            rotation[i, 0] = 2.0 * dot * t0 - rotation[i, 0]
            rotation[i, 1] = 2.0 * dot * t1 - rotation[i, 1]
            rotation[i, 2] = 2.0 * dot * t2 - rotation[i, 2]


@kernel
def pose_from_rotation(
    base_joints: Array, platform_joints: Array, directions: Array, measured: Array, rotation: Array, position: Array,
    matrix: Array, right: Array, unknowns: Array, norms: Array, order: Array,
) -> float:  # fmt: skip
    """Position from leg directions and the rotation (the paper's (25)-(28), by QR); returns the conditioning."""
    rows = 0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        t0, t1, t2, s0, s1, s2 = _across(directions[k])
        c0, c1, c2 = base_joints[k, 0], base_joints[k, 1], base_joints[k, 2]
        for j in range(3):
            c0 -= rotation[0, j] * platform_joints[k, j]
            c1 -= rotation[1, j] * platform_joints[k, j]
            c2 -= rotation[2, j] * platform_joints[k, j]
        matrix[rows, 0], matrix[rows, 1], matrix[rows, 2] = t0, t1, t2
        right[rows] = t0 * c0 + t1 * c1 + t2 * c2
        matrix[rows + 1, 0], matrix[rows + 1, 1], matrix[rows + 1, 2] = s0, s1, s2
        right[rows + 1] = s0 * c0 + s1 * c1 + s2 * c2
        rows += 2
    if rows < 3:
        return 0.0
    return solve_least_squares(matrix[:rows, :3], right[:rows], position, norms, order)


@kernel
def pose_from_vector(
    base_joints: Array, platform_joints: Array, directions: Array, measured: Array, in_base: Array, in_platform: Array,
    position: Array, rotation: Array, matrix: Array, right: Array, unknowns: Array, norms: Array, order: Array,
) -> float:  # fmt: skip
    """Pose from leg directions and one vector known in both frames; linear in (p, cos yaw, sin yaw).

    Returns the conditioning.
    """
    rotation_between(in_platform, in_base, rotation)
    scale = 1.0 / _spread(platform_joints, measured)
    u0, u1, u2 = in_base[0], in_base[1], in_base[2]
    rows = 0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        a0, a1, a2 = platform_joints[k, 0], platform_joints[k, 1], platform_joints[k, 2]
        q0 = rotation[0, 0] * a0 + rotation[0, 1] * a1 + rotation[0, 2] * a2
        q1 = rotation[1, 0] * a0 + rotation[1, 1] * a1 + rotation[1, 2] * a2
        q2 = rotation[2, 0] * a0 + rotation[2, 1] * a1 + rotation[2, 2] * a2
        along = u0 * q0 + u1 * q1 + u2 * q2
        x0, x1, x2 = q0 - along * u0, q1 - along * u1, q2 - along * u2
        y0, y1, y2 = u1 * q2 - u2 * q1, u2 * q0 - u0 * q2, u0 * q1 - u1 * q0
        c0 = base_joints[k, 0] - along * u0
        c1 = base_joints[k, 1] - along * u1
        c2 = base_joints[k, 2] - along * u2
        t0, t1, t2, s0, s1, s2 = _across(directions[k])
        for row, w0, w1, w2 in ((rows, t0, t1, t2), (rows + 1, s0, s1, s2)):
            matrix[row, 0], matrix[row, 1], matrix[row, 2] = w0, w1, w2
            matrix[row, 3] = scale * (w0 * x0 + w1 * x1 + w2 * x2)
            matrix[row, 4] = scale * (w0 * y0 + w1 * y1 + w2 * y2)
            right[row] = w0 * c0 + w1 * c1 + w2 * c2
        rows += 2
    if rows < 5:
        return 0.0
    conditioning = solve_least_squares(matrix[:rows, :5], right[:rows], unknowns[:5], norms, order)
    if conditioning < RANK_TOLERANCE:
        return conditioning
    # Cosine and sine come multiplied by the spread of the joints.
    size = np.sqrt(unknowns[3] * unknowns[3] + unknowns[4] * unknowns[4])
    if not size * scale > RANK_TOLERANCE:
        return 0.0
    cosine, sine = unknowns[3] / size, unknowns[4] / size
    for j in range(3):
        r0, r1, r2 = rotation[0, j], rotation[1, j], rotation[2, j]
        along = (1.0 - cosine) * (u0 * r0 + u1 * r1 + u2 * r2)
        rotation[0, j] = cosine * r0 + sine * (u1 * r2 - u2 * r1) + along * u0
        rotation[1, j] = cosine * r1 + sine * (u2 * r0 - u0 * r2) + along * u1
        rotation[2, j] = cosine * r2 + sine * (u0 * r1 - u1 * r0) + along * u2
    pose_from_rotation(
        base_joints, platform_joints, directions, measured, rotation, position, matrix, right, unknowns, norms, order
    )
    return conditioning


@kernel
def pose_from_legs(
    base_joints: Array, platform_joints: Array, directions: Array, measured: Array, center: Array, axes: Array,
    position: Array, rotation: Array, matrix: Array, right: Array, unknowns: Array, norms: Array, order: Array,
) -> float:  # fmt: skip
    """Pose from leg directions alone, for platform joints in the plane of `center` and `axes`; returns the conditioning.

    Linear in the plane's origin and the two columns of the rotation that span it; the nearest rotation follows, then
    the position again.
    """
    rows = 0
    scale = 1.0 / _spread(platform_joints, measured)
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        x = y = 0.0
        for j in range(3):
            x += scale * axes[j, 0] * (platform_joints[k, j] - center[j])
            y += scale * axes[j, 1] * (platform_joints[k, j] - center[j])
        t0, t1, t2, s0, s1, s2 = _across(directions[k])
        for row, w0, w1, w2 in ((rows, t0, t1, t2), (rows + 1, s0, s1, s2)):
            matrix[row, 0], matrix[row, 1], matrix[row, 2] = w0, w1, w2
            matrix[row, 3], matrix[row, 4], matrix[row, 5] = x * w0, x * w1, x * w2
            matrix[row, 6], matrix[row, 7], matrix[row, 8] = y * w0, y * w1, y * w2
            right[row] = w0 * base_joints[k, 0] + w1 * base_joints[k, 1] + w2 * base_joints[k, 2]
        rows += 2
    if rows < 9:
        return 0.0
    conditioning = solve_least_squares(matrix[:rows], right[:rows], unknowns, norms, order)
    if conditioning < RANK_TOLERANCE:
        return conditioning
    # The nearest pair of orthonormal columns is M (M^T M)^(-1/2), and the root of a 2 x 2 matrix is in closed form.
    p = q = r = 0.0
    for j in range(3, 6):
        p += unknowns[j] * unknowns[j]
        q += unknowns[j] * unknowns[j + 3]
        r += unknowns[j + 3] * unknowns[j + 3]
    root_det = np.sqrt(max(p * r - q * q, 0.0))
    if not root_det * scale * scale > RANK_TOLERANCE:
        return 0.0
    trace = np.sqrt(p + r + 2.0 * root_det)
    f = 1.0 / (root_det * trace)
    e00, e01, e11 = f * (r + root_det), -f * q, f * (p + root_det)
    x0 = e00 * unknowns[3] + e01 * unknowns[6]
    x1 = e00 * unknowns[4] + e01 * unknowns[7]
    x2 = e00 * unknowns[5] + e01 * unknowns[8]
    y0 = e01 * unknowns[3] + e11 * unknowns[6]
    y1 = e01 * unknowns[4] + e11 * unknowns[7]
    y2 = e01 * unknowns[5] + e11 * unknowns[8]
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    for j in range(3):
        rotation[0, j] = x0 * axes[j, 0] + y0 * axes[j, 1] + z0 * axes[j, 2]
        rotation[1, j] = x1 * axes[j, 0] + y1 * axes[j, 1] + z1 * axes[j, 2]
        rotation[2, j] = x2 * axes[j, 0] + y2 * axes[j, 1] + z2 * axes[j, 2]
    pose_from_rotation(
        base_joints, platform_joints, directions, measured, rotation, position, matrix, right, unknowns, norms, order
    )
    return conditioning


@kernel
def _add_leg(right: Array, measured: Array, direction: Array, arm: Array, scale: float) -> None:
    """Add `scale` J^T P `measured` to a right side (6,), P = I - d d^T and J = [I, -skew(arm)]."""
    d0, d1, d2 = direction[0], direction[1], direction[2]
    a0, a1, a2 = arm[0], arm[1], arm[2]
    along = d0 * measured[0] + d1 * measured[1] + d2 * measured[2]
    g0, g1, g2 = scale * (measured[0] - along * d0), scale * (measured[1] - along * d1), scale * (measured[2] - along * d2)
    right[0] += g0
    right[1] += g1
    right[2] += g2
    right[3] += a1 * g2 - a2 * g1
    right[4] += a2 * g0 - a0 * g2
    right[5] += a0 * g1 - a1 * g0


@kernel
def normal_equations(
    base_joints: Array, platform_joints: Array, directions: Array, rates: Array, weights: Array,
    in_base: Array, in_platform: Array, vector_weights: Array, angular_velocity: Array, position: Array, rotation: Array,
    arms: Array, predicted: Array, lengths: Array, information: Array, correction: Array, twist: Array,
) -> None:  # fmt: skip
    """Weighted normal equations at a pose, for its correction and for the twist, which share one matrix.

    Args:
        directions: (6, 3), measured; `rates` (6, 3) are their derivatives [1/s].
        weights: (6,), inverse variance of a component of a direction; 0 leaves a leg out.
        in_base, in_platform: (m, 3), vectors known in both frames; `vector_weights` (m,) are their inverse variances.
        angular_velocity: (3,) [rad/s] in {1}, which counts for the twist as the vectors do for the attitude.
        information: (6, 6), lower triangle written; `correction` and `twist` (6,) are the right sides.
    """
    legs_at(base_joints, platform_joints, position, rotation, arms, predicted, lengths)
    for i in range(6):
        correction[i] = 0.0
        twist[i] = 0.0
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
        _add_leg(twist, rates[k], predicted[k], arms[k], scale)
    o0, o1, o2 = angular_velocity[0], angular_velocity[1], angular_velocity[2]
    for k in range(vector_weights.shape[0]):
        w = vector_weights[k]
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
        along = v0 * o0 + v1 * o1 + v2 * o2
        twist[3] += w * (o0 - along * v0)
        twist[4] += w * (o1 - along * v1)
        twist[5] += w * (o2 - along * v2)


@kernel
def refine(
    base_joints: Array, platform_joints: Array, directions: Array, rates: Array, weights: Array,
    in_base: Array, in_platform: Array, vector_weights: Array, angular_velocity: Array, position: Array, rotation: Array,
    arms: Array, predicted: Array, lengths: Array, information: Array, correction: Array, twist: Array, factor: Array,
) -> bool:  # fmt: skip
    """One Gauss-Newton step on SE(3) for the pose, in place, and the least-squares twist; False if singular.

    The arguments are those of `normal_equations`; `correction` and `twist` hold the solutions afterwards.
    """
    normal_equations(
        base_joints, platform_joints, directions, rates, weights, in_base, in_platform, vector_weights, angular_velocity,
        position, rotation, arms, predicted, lengths, information, correction, twist,
    )  # fmt: skip
    for i in range(6):
        for j in range(i + 1):
            factor[i, j] = information[i, j]
    if not factor_cholesky(factor):
        return False
    solve_cholesky(factor, correction)
    solve_cholesky(factor, twist)
    for i in range(3):
        position[i] += correction[i]
    rotate_by_vector(rotation, correction[3:])
    return True


@kernel
def newton_from_lengths(
    base_joints: Array, platform_joints: Array, target: Array, position: Array, rotation: Array, arms: Array, directions: Array,
    lengths: Array, jacobian: Array, correction: Array, norms: Array, order: Array,
) -> float:  # fmt: skip
    """Move a pose, in place, to where the legs have the lengths `target` (6,) [m]; returns the largest error left [m]."""
    error = np.inf
    for _ in range(_NEWTON_LIMIT):
        legs_at(base_joints, platform_joints, position, rotation, arms, directions, lengths)
        before, error = error, 0.0
        for k in range(LEGS):
            lengths[k] = target[k] - lengths[k]
            error = max(error, abs(lengths[k]))
        if error < 1e-15 or (error < 1e-11 and error >= before):
            break
        jacobian_at(arms, directions, jacobian)
        if solve_least_squares(jacobian, lengths, correction, norms[:6], order[:6]) < RANK_TOLERANCE:
            return np.inf
        for i in range(3):
            position[i] += correction[i]
        rotate_by_vector(rotation, correction[3:])
    return error


@kernel
def _poses_from_lengths(
    base_joints: Array, platform_joints: Array, lengths: Array, position: Array, rotation: Array, positions: Array,
    rotations: Array, arms: Array, directions: Array, scratch: Array, jacobian: Array, correction: Array, norms: Array,
    order: Array,
) -> int:  # fmt: skip
    for i in range(lengths.shape[0]):
        error = newton_from_lengths(
            base_joints, platform_joints, lengths[i], position, rotation, arms, directions, scratch, jacobian, correction,
            norms, order,
        )  # fmt: skip
        if not error < 1e-10:
            return i
        positions[i] = position
        rotations[i] = rotation
    return -1


def poses_from_lengths(mechanism: Mechanism, lengths: Array, guess: Pose) -> tuple[Array, Array]:
    """Positions (N, 3) [m] and rotations (N, 3, 3) of a motion given by lengths (N, 6) [m], each found from the one
    before.

    Raises:
        SingularConfigurationError: the lengths of a row belong to no pose near the one before.
    """
    positions, rotations = np.empty((len(lengths), 3)), np.empty((len(lengths), 3, 3))
    work = Workspace()
    failed = _poses_from_lengths(
        mechanism.base_joints, mechanism.platform_joints, np.ascontiguousarray(lengths), guess.position.copy(),
        guess.rotation.copy(), positions, rotations, *work.newton,
    )  # fmt: skip
    if failed >= 0:
        raise SingularConfigurationError(f"no pose near the one before has the lengths of row {failed}")
    return positions, rotations


def pose_difference(first: Solution | Pose, second: Solution | Pose) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    distance = float(np.linalg.norm(first.position - second.position))
    return distance, float(rotation_angle(first.rotation, second.rotation))
