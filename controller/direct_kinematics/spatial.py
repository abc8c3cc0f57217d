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

from controller.direct_kinematics.closed_forms import pose_from_legs, pose_from_rotation, pose_from_vector
from controller.direct_kinematics.refinement import normal_equations, refine
from controller.inverse_kinematics import legs_at
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism import LEGS, Mechanism
from plant.pose import UNIT_TOLERANCE, Array, Pose, checked_array, checked_rotation, checked_unit, rotation_angle

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


def pose_difference(first: Solution | Pose, second: Solution | Pose) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    distance = float(np.linalg.norm(first.position - second.position))
    return distance, float(rotation_angle(first.rotation, second.rotation))
