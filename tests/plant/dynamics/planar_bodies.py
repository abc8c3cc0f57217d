"""A second derivation of planar mechanisms, body by body, that the planar plant and its control must agree with.

Bodies with a place and an angle each, in the plane; their Jacobians by complex steps, and Lagrange's equations from the
inertia matrix by differences. Nothing is shared with `plant.dynamics.planar`.
"""

import numpy as np

from plant.pose import Array
from tests.plant.dynamics.explicit_bodies import derivatives, reflected_mass

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
    return np.concatenate([[m, m, i] for m, i in parts] + [np.full(LEGS, reflected_mass(p))])


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
