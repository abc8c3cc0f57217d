"""Direct kinematics of planar mechanisms: from the angles of three legs to the assembly modes, in closed form.

A leg at the angle t_k gives one equation, `n_k . (p + R a_k - b_k) = 0` with `n_k = (-sin t_k, cos t_k)`, linear in p and
in the cosine and sine of the platform's angle. The paper's section 6 also measures that angle, the roll (30), and then two
legs give p (31); here all measured legs do, by least squares. From the legs alone (34)-(36), the weights
`w_k = sin(t_i - t_j)`, with k, j, i in cyclic order, sum the equations up to one without p, because `sum w_k n_k = 0`:

    c cos(angle) + s sin(angle) = d.

Its two roots are the assembly modes. They merge where the perpendiculars to the legs in the platform joints meet in one
point: the platform can then turn a little about that point without turning a leg.

The loop measures the roll: `pose_from_roll` is its compiled form of (30) and (31).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from controller.direct_kinematics.solver import LEAST_CONDITIONING
from controller.direct_kinematics.spatial import LEG_SIGMA, TILT_SIGMA
from controller.least_squares import RANK_TOLERANCE
from plant.compiled import Record, kernel
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism import LEGS
from plant.mechanism.planar import PLANAR_LEGS, PlanarMechanism
from plant.pose import Array, checked_array


@dataclass(frozen=True, eq=False)
class AssemblyMode:
    """A pose at which the legs have the measured angles.

    Attributes:
        position: (2,) [m], origin of {2} in {1}.
        angle: of {2} against {1}, counter-clockwise, in (-pi, pi] [rad].
        lengths: (3,) [m], along the measured direction and so possibly negative; for a leg that was not measured, the
            distance between its joints.
        within_stroke: whether every length is positive and, if the mechanism has a stroke, inside it.
        double_root: whether the two modes have merged. If noise has made the angles contradict each other, no pose has all of
            them, and this one comes closest.
        conditioning: reciprocal condition of the pose's equations, with lengths in units of the joints' spread. Near 0, small
            changes of the leg angles are large changes of the pose.
        covariance: (3, 3) of x, y [m] and angle [rad] to first order; infinite for a double root.
    """

    position: Array
    angle: float
    lengths: Array
    within_stroke: bool
    double_root: bool
    conditioning: float
    covariance: Array


def solve_planar(
    mechanism: PlanarMechanism,
    leg_angles: ArrayLike,
    *,
    roll: float | None = None,
    angle_sigma: float = LEG_SIGMA,
    roll_sigma: float = TILT_SIGMA,
) -> tuple[AssemblyMode, ...]:
    """The poses that the angles of the legs allow: two, or one if they merge or the platform's roll is measured.

    Poses within the stroke come first; among them, the pose whose angle is nearest to 0 comes first.

    Args:
        mechanism: its joints suffice; no home, limits or plant are needed.
        leg_angles: (3,) [rad], from the x axis of {1} to the leg from base to platform joint; NaN is a leg not measured.
        roll: measured angle of the platform [rad] (the paper's section 6); without it all three legs are needed.
        angle_sigma: standard deviation of each leg angle [rad], for the covariance.
        roll_sigma: standard deviation of the roll [rad].

    Raises:
        InputError: wrong shape, infinite, or a sigma that is not positive.
        SingularConfigurationError: the measurements do not determine the pose up to its assembly modes.
    """
    if not isinstance(mechanism, PlanarMechanism):
        raise InputError(f"the mechanism must be a PlanarMechanism of three legs, not a {type(mechanism).__name__}")
    angles = checked_array(leg_angles, (PLANAR_LEGS,), "leg_angles", allow_nan=True)
    for name, sigma in (("angle_sigma", angle_sigma), ("roll_sigma", roll_sigma)):
        if not checked_array(sigma, (), name) > 0.0:
            raise InputError(f"{name} is {sigma}; it must be positive and finite [rad]")
    if roll is not None:
        mode = _mode(mechanism, angles, float(wrapped(checked_array(roll, (), "roll"))), angle_sigma, roll_sigma, False)
        if mode.conditioning < LEAST_CONDITIONING:
            raise SingularConfigurationError(
                f"legs at {_degrees(angles)} do not give the position of {mechanism.name!r}, which takes two that are not "
                f"parallel (conditioning {mode.conditioning:.2g}, at least {LEAST_CONDITIONING:g}): measure another leg"
            )
        return (mode,)
    if np.isnan(angles).any():
        raise SingularConfigurationError(
            f"{np.count_nonzero(~np.isnan(angles))} leg angles do not give the pose of {mechanism.name!r}, which takes "
            f"{PLANAR_LEGS}: measure every leg, or the roll"
        )
    turns = np.unique(closing_angles(mechanism, angles))
    modes = [_mode(mechanism, angles, float(turn), angle_sigma, None, len(turns) == 1) for turn in turns]
    return tuple(sorted(modes, key=lambda mode: (not mode.within_stroke, abs(mode.angle))))


def closing_angles(mechanism: PlanarMechanism, leg_angles: Array) -> Array:
    """Both angles (..., 2) [rad] of the platform, in (-pi, pi], at which three legs at angles (..., 3) [rad] meet its joints;
    equal for a double root. A `SingularConfigurationError` if the legs leave the angle open.
    """
    # As complex numbers, leg k gives im(conj(u) (p + turn a - b)) = 0, and the weights close a triangle: sum w u = 0.
    base, platform = mechanism.base_joints @ (1.0, 1.0j), mechanism.platform_joints @ (1.0, 1.0j)
    weights = np.sin(np.roll(leg_angles, -2, axis=-1) - np.roll(leg_angles, -1, axis=-1))
    sides = weights * np.exp(-1.0j * leg_angles)
    factor, right = sides @ platform, (sides @ base).imag
    size = np.abs(factor)
    conditioning = size / _spread(mechanism)
    if np.min(conditioning) < LEAST_CONDITIONING:
        worst = np.reshape(leg_angles, (-1, PLANAR_LEGS))[np.argmin(conditioning)]
        raise SingularConfigurationError(
            f"legs at {_degrees(worst)} leave the angle of {mechanism.name!r} open: they are parallel or close at any "
            f"angle (conditioning {np.min(conditioning):.2g}, at least {LEAST_CONDITIONING:g}): measure the roll, or move away"
        )
    opening = np.arccos(np.minimum(np.abs(right) / size, 1.0))
    opening = np.where(opening < LEAST_CONDITIONING, 0.0, opening)
    middle = np.copysign(0.5 * np.pi, right) - np.angle(factor)
    return wrapped(middle[..., None] + opening[..., None] * (1.0, -1.0))


def closing_positions(mechanism: PlanarMechanism, leg_angles: Array, angles: Array | float) -> Array:
    """Positions (..., 2) [m] with the least sum of squared distances from the platform joints to the legs at angles (..., 3)
    [rad], for a platform at `angles` (...) [rad]. A leg at NaN is left out (the paper's (25)-(28) and (31), planar).
    """
    normals = _normals(leg_angles)
    arms = mechanism.base_joints - mechanism.joints_at(np.zeros(2), angles)
    positions: Array = (np.linalg.pinv(normals) @ np.sum(normals * arms, axis=-1)[..., None])[..., 0]
    return positions


def wrapped(angle: Array | float) -> Array:
    """The same angles [rad] in (-pi, pi]."""
    turned = np.angle(np.exp(1.0j * np.asarray(angle)))
    return np.where(turned > -np.pi, turned, np.pi)


def _degrees(angles: Array) -> str:
    return f"{', '.join(f'{angle:.4g}' for angle in np.degrees(angles))} deg"


def _normals(leg_angles: Array) -> Array:
    """Unit vectors (..., 3, 2) across the legs; zero for a leg at NaN."""
    normals: Array = np.nan_to_num(np.stack([-np.sin(leg_angles), np.cos(leg_angles)], axis=-1))
    return normals


def _spread(mechanism: PlanarMechanism) -> float:
    """Root mean square distance of the platform joints from their centre [m]."""
    return float(np.sqrt(mechanism.platform_joints.var(axis=0).sum()))


def _mode(
    mechanism: PlanarMechanism, leg_angles: Array, angle: float, angle_sigma: float, roll_sigma: float | None, double_root: bool
) -> AssemblyMode:
    """The mode at `angle` [rad], which was measured with `roll_sigma`, or follows from the legs if `roll_sigma` is None."""
    position = closing_positions(mechanism, leg_angles, angle)
    joints = mechanism.joints_at(position, angle)
    legs = joints - mechanism.base_joints
    normals = _normals(leg_angles)
    directions = normals @ [[0.0, -1.0], [1.0, 0.0]]
    along = np.sum(directions * legs, axis=1)
    lengths = np.where(np.isnan(leg_angles), np.linalg.norm(legs, axis=1), along)
    least, greatest = (0.0, np.inf) if mechanism.stroke is None else mechanism.stroke.T
    # The equations change by normals @ dp + turning dangle - along dt.
    turning = np.sum(directions * (joints - position), axis=1)
    errors = angle_sigma * np.diag(along)
    if roll_sigma is not None:
        equations, inverse = normals, np.linalg.pinv(normals)
        gain = np.block([[inverse @ errors, -roll_sigma * (inverse @ turning)[:, None]], [np.zeros(3), roll_sigma]])
    else:
        centered = np.sum(directions * (joints - joints.mean(axis=0)), axis=1)
        equations = np.column_stack([normals, centered / _spread(mechanism)])
        gain = np.eye(3) if double_root else np.linalg.solve(np.column_stack([normals, turning]), errors)
    return AssemblyMode(
        position=position,
        angle=angle,
        lengths=lengths,
        within_stroke=bool(((least <= lengths) & (lengths <= greatest)).all()),
        double_root=double_root,
        conditioning=float(1.0 / np.linalg.cond(equations)),
        covariance=np.full((3, 3), np.inf) if double_root else gain @ gain.T,
    )


@kernel
def pose_from_roll(
    geometry: Record, directions: Array, measured: Array, in_base: Array, in_platform: Array, position: Array, rotation: Array
) -> float:
    """Pose of a planar mechanism in the xy-plane of {1} from its roll and two or more legs (the paper's section 6).

    The roll is the angle between the parts in the plane of one vector that is known in {1} and in {2}; it replaces (30). The
    position is that of least squares over all legs (31). Returns the conditioning of the position, which is what can fail.
    """
    b0, b1, v0, v1 = in_base[0], in_base[1], in_platform[0], in_platform[1]
    cosine, sine = b0 * v0 + b1 * v1, b1 * v0 - b0 * v1
    size = np.sqrt(cosine * cosine + sine * sine)
    if not size > RANK_TOLERANCE:
        return 0.0
    cosine, sine = cosine / size, sine / size
    n00 = n01 = n11 = r0 = r1 = 0.0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        n0, n1 = -directions[k, 1], directions[k, 0]
        a0, a1 = geometry.platform_joints[k, 0], geometry.platform_joints[k, 1]
        off = n0 * (geometry.base_joints[k, 0] - cosine * a0 + sine * a1)
        off += n1 * (geometry.base_joints[k, 1] - sine * a0 - cosine * a1)
        n00, n01, n11 = n00 + n0 * n0, n01 + n0 * n1, n11 + n1 * n1
        r0, r1 = r0 + n0 * off, r1 + n1 * off
    middle, swing = 0.5 * (n00 + n11), np.sqrt(0.25 * (n00 - n11) ** 2 + n01 * n01)
    if not middle - swing > RANK_TOLERANCE**2 * middle:
        return 0.0
    determinant = n00 * n11 - n01 * n01
    position[0], position[1], position[2] = (n11 * r0 - n01 * r1) / determinant, (n00 * r1 - n01 * r0) / determinant, 0.0
    rotation[:] = 0.0
    rotation[0, 0], rotation[0, 1], rotation[1, 0], rotation[1, 1] = cosine, -sine, sine, cosine
    rotation[2, 2] = 1.0
    return float(np.sqrt((middle - swing) / (middle + swing)))
