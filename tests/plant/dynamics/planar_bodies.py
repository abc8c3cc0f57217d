"""A second derivation of planar mechanisms, body by body, that the planar plant and its control must agree with.

Bodies with a place and an angle each, in the plane; their Jacobians by complex steps, and Lagrange's equations from the
inertia matrix by differences; on a base that moves, the same bodies in space. Nothing is shared with `plant.dynamics.planar`.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from plant.pose import Array
from tests.plant.dynamics.explicit_bodies import Path, derivatives, reflected_mass, vector_of

Values = dict[str, Array]
LEGS = 3


def coordinates(p: Values, q: Array) -> Array:
    """(8, 3): x, y and angle of platform, payload, lower parts and rods at a pose (3,); and (3,) lengths, all in one."""
    cosine, sine = np.cos(q[2]), np.sin(q[2])
    turn = np.array([[cosine, -sine], [sine, cosine]])
    legs = q[:2] + p["platform_joints"] @ turn.T - p["base_joints"]
    lengths = np.sqrt(np.sum(legs * legs, axis=1))
    along = legs / lengths[:, None]
    # An angle whose derivative is exact for complex steps, too.
    angles = np.arctan(legs[:, 1] / legs[:, 0])
    bodies = [np.append(q[:2] + turn @ p[f"{body}.center_of_mass"], q[2]) for body in ("platform", "payload")]
    bodies += [np.append(p["base_joints"][k] + p["leg.lower.center"] * along[k], angles[k]) for k in range(LEGS)]
    bodies += [np.append(p["base_joints"][k] + legs[k] - p["leg.upper.center"] * along[k], angles[k]) for k in range(LEGS)]
    return np.concatenate([*bodies, lengths])


def jacobian(p: Values, q: Array) -> Array:
    """(27, 3), of `coordinates`, exact to rounding."""
    step = 1e-30
    return np.array([coordinates(p, q + 1j * step * unit).imag / step for unit in np.eye(3)]).T


def weights(p: Values) -> Array:
    """(27,), the mass or inertia of each coordinate."""
    parts = [(p[f"{body}.mass"], p[f"{body}.inertia"]) for body in ("platform", "payload")]
    parts += [(p[f"leg.{part}.mass"], p[f"leg.{part}.inertia"]) for part in ("lower", "upper") for _ in range(LEGS)]
    return np.concatenate([[m, m, i] for m, i in parts] + [reflected_mass(p)])


def inertia_matrix(p: Values, q: Array) -> Array:
    j = jacobian(p, q)
    return j.T @ (weights(p)[:, None] * j)


def weight_force(p: Values, q: Array) -> Array:
    """The generalised force (3,) of gravity."""
    pull = np.concatenate([np.tile(np.append(p["gravity"][:2], 0.0), 8), np.zeros(LEGS)])
    return jacobian(p, q).T @ (np.where(pull != 0.0, weights(p), 0.0) * pull)


def bias_force(p: Values, q: Array, rate: Array) -> Array:
    """`M' q' - d/dq (q' M q' / 2)`, by central differences of sixth order."""
    step = 1e-3
    along = derivatives(np.array([inertia_matrix(p, q + i * step * rate) for i in range(-3, 4)]), step)[0]
    slopes = [
        derivatives(np.array([rate @ inertia_matrix(p, q + i * step * unit) @ rate for i in range(-3, 4)]), step)[0]
        for unit in np.eye(3)
    ]
    return along @ rate - 0.5 * np.array(slopes)


def force_in_space(p: Values, q: Array, rate: Array, acceleration: Array, base: Path) -> Array:
    """The generalised force (3,) that a motion of the platform takes on a base that moves, by d'Alembert's principle in space.

    Platform and payload are thin plates, legs thin rods.
    """
    step, count = 5e-4, len(weights(p)) // LEGS - 1
    shares = weights(p)[:-LEGS].reshape(count, 3)
    plates, rods = np.array([0.5, 0.5, 1.0]), np.array([0.0, 1.0, 1.0])
    tensors = shares[:, 2, None, None] * np.array([np.diag(plates)] * 2 + [np.diag(rods)] * (count - 2))

    def seen(t: float) -> tuple[Array, Array, Array]:
        """Places and attitudes of the bodies on the earth, and lengths."""
        values = coordinates(p, q + rate * t + acceleration * t**2 / 2.0)
        x, y, angle = values[:-LEGS].reshape(count, 3).T
        place, turn = base(t)
        places = place + np.column_stack([x, y, np.zeros(count)]) @ turn.T
        return places, turn @ Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0])).as_matrix(), values[-LEGS:]

    samples = [np.array(values) for values in zip(*(seen(i * step) for i in range(-3, 4)), strict=True)]
    moved, spun, grown = (derivatives(values, step) for values in samples)
    attitudes = samples[1][3]
    back = np.swapaxes(attitudes, 1, 2)
    omega, alpha = vector_of(spun[0] @ back), vector_of(spun[1] @ back)
    turned = attitudes @ tensors @ back
    torque = np.einsum("kij,kj->ki", turned, alpha) + np.cross(omega, np.einsum("kij,kj->ki", turned, omega))
    force = shares[:, 0, None] * (moved[1] - p["gravity"])
    slopes, turn = jacobian(p, q), base(0.0)[1]
    bodies = slopes[:-LEGS].reshape(count, 3, 3)
    pushed = np.einsum("kx,xi,kij->j", force, turn[:, :2], bodies[:, :2]) + np.einsum(
        "kx,x,kj->j", torque, turn[:, 2], bodies[:, 2]
    )
    return pushed + slopes[-LEGS:].T @ (reflected_mass(p) * grown[1])


def frames_at(p: Values, position: Array, angle: float) -> tuple[Array, Array]:
    """Attitudes (4, 3, 3) and places (4, 3) of the IMUs: a leg's x axis is the plane's normal, its z axis the leg."""
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    base = np.pad(p["base_joints"], ((0, 0), (0, 1)))
    along = np.append(position, 0.0) + np.pad(p["platform_joints"], ((0, 0), (0, 1))) @ turn.T - base
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.tile([0.0, 0.0, 1.0], (LEGS, 1))
    frames = np.stack([normal, np.cross(along, normal), along], axis=2)
    places = base + np.einsum("kij,kj->ki", frames, p["leg_imu_position"])
    return np.concatenate([frames, turn[None]]), np.vstack(
        [places, np.append(position, 0.0) + turn @ p["platform_imu_position"]]
    )
