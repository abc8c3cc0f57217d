"""A second derivation of the mechanism, body by body and by finite differences, that the plant must agree with.

Every body has a mass, a place, an attitude and an inertia tensor; the leg frames are built from the angles of their
universal joints. Velocities and accelerations are differences along a path of the platform on a base that may move, both seen
from the earth, and the equations of motion are d'Alembert's principle with virtual displacements that are differences too.
Nothing is shared with `plant.dynamics.spatial`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from plant.pose import Array

Path = Callable[[float], tuple[Array, Array]]
"""Position (3,) and rotation (3, 3) of the platform in {1}, or of the base on the earth, against time [s]."""


def at_rest(_: float) -> tuple[Array, Array]:
    """The path of a base that stands still and upright."""
    return np.zeros(3), np.eye(3)


FIRST = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60.0
SECOND = np.array([2.0, -27.0, 270.0, -490.0, 270.0, -27.0, 2.0]) / 180.0
"""Central differences of sixth order over seven samples."""


def derivatives(samples: Array, step: float) -> tuple[Array, Array]:
    """First and second derivative at the middle of seven samples (7, ...)."""
    return np.tensordot(FIRST, samples, 1) / step, np.tensordot(SECOND, samples, 1) / step**2


def vector_of(skew: Array) -> Array:
    """The vectors (..., 3) of the skew-symmetric parts of matrices (..., 3, 3)."""
    s = (skew - np.swapaxes(skew, -1, -2)) / 2.0
    return np.stack([s[..., 2, 1], s[..., 0, 2], s[..., 1, 0]], axis=-1)


def leg_vectors(parameters: Mapping[str, Array], position: Array, rotation: Array) -> Array:
    """(6, 3): from the second axes of the base joints, which lie beyond the first ones, to the platform joints."""
    vectors = position + parameters["platform_joints"] @ rotation.T - parameters["base_joints"]
    axes = parameters["base_joint_axes"]
    square = vectors - np.sum(vectors * axes, axis=1, keepdims=True) * axes
    beyond: Array = vectors - parameters["base_joint_offset"][:, None] * square / np.linalg.norm(square, axis=1, keepdims=True)
    return beyond


def second_axes(parameters: Mapping[str, Array], position: Array, rotation: Array) -> Array:
    """(6, 3): places of the second axes of the base joints in {1}."""
    places: Array = position + parameters["platform_joints"] @ rotation.T - leg_vectors(parameters, position, rotation)
    return places


def leg_frames(parameters: Mapping[str, Array], position: Array, rotation: Array) -> Array:
    """(6, 3, 3): R_joint Rx(a) Ry(b), with the angles a and b that put the z axis on the leg."""
    frames = []
    for axis, leg in zip(parameters["base_joint_axes"], leg_vectors(parameters, position, rotation), strict=True):
        # Any joint frame with x along the first axis gives the same leg frame.
        across = np.cross(axis, [0.36, -0.48, 0.8])
        across /= np.linalg.norm(across)
        joint = np.column_stack([axis, across, np.cross(axis, across)])
        x, y, z = joint.T @ leg / np.linalg.norm(leg)
        frames.append(joint @ Rotation.from_euler("XY", [np.arctan2(-y, z), np.arcsin(x)]).as_matrix())
    return np.array(frames)


def jacobian(parameters: Mapping[str, Array], position: Array, rotation: Array) -> Array:
    """(6, 6): from the platform's twist to the rates of the lengths."""
    directions = leg_vectors(parameters, position, rotation)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.hstack([directions, np.cross(parameters["platform_joints"] @ rotation.T, directions)])


@dataclass(frozen=True)
class Bodies:
    """Platform, payload, six lower parts and six rods: places (14, 3), attitudes (14, 3, 3); and leg lengths (6,)."""

    places: Array
    attitudes: Array
    lengths: Array


def masses(p: Mapping[str, Array]) -> Array:
    return np.hstack([p["platform.mass"], p["payload.mass"], np.full(6, p["leg.lower.mass"]), np.full(6, p["leg.upper.mass"])])


def inertias(p: Mapping[str, Array]) -> Array:
    """(14, 3, 3), each body's about its centre in its own frame."""
    parts = [
        np.diag([p[f"leg.{part}.inertia"], p[f"leg.{part}.inertia"], p[f"leg.{part}.axial_inertia"]])
        for part in ("lower", "upper")
    ]
    return np.array([p["platform.inertia"], p["payload.inertia"], *[parts[0]] * 6, *[parts[1]] * 6])


def bodies_at(p: Mapping[str, Array], position: Array, rotation: Array) -> Bodies:
    legs, origins = leg_vectors(p, position, rotation), second_axes(p, position, rotation)
    lengths = np.linalg.norm(legs, axis=1)
    frames = leg_frames(p, position, rotation)
    along = frames[:, :, 2]
    places = [
        [position + rotation @ p["platform.center_of_mass"], position + rotation @ p["payload.center_of_mass"]],
        origins + p["leg.lower.center"] * along,
        origins + legs - p["leg.upper.center"] * along,
    ]
    return Bodies(np.vstack(places), np.concatenate([[rotation, rotation], frames, frames]), lengths)


@dataclass(frozen=True)
class Motion:
    """First and second derivatives of the bodies: velocity, acceleration, angular velocity and acceleration (14, 3) on the
    earth, and rates and accelerations of the leg lengths (6,).
    """

    velocity: Array
    acceleration: Array
    angular_velocity: Array
    angular_acceleration: Array
    length_rate: Array
    length_acceleration: Array


def on_earth(bodies: Bodies, place: Array, turn: Array) -> Bodies:
    """Bodies in {1}, seen from the earth."""
    return Bodies(place + bodies.places @ turn.T, turn @ bodies.attitudes, bodies.lengths)


def motion_along(p: Mapping[str, Array], path: Path, base: Path = at_rest, step: float = 2e-3) -> Motion:
    """The motion of all bodies at time 0 of a path of the platform."""
    samples = [on_earth(bodies_at(p, *path(i * step)), *base(i * step)) for i in range(-3, 4)]
    velocity, acceleration = derivatives(np.array([b.places for b in samples]), step)
    rate, rate_change = derivatives(np.array([b.attitudes for b in samples]), step)
    back = np.swapaxes(samples[3].attitudes, 1, 2)
    length_rate, length_acceleration = derivatives(np.array([b.lengths for b in samples]), step)
    # R'' R^T = skew(alpha) + skew(omega)^2, and the square is symmetric.
    return Motion(
        velocity, acceleration, vector_of(rate @ back), vector_of(rate_change @ back), length_rate, length_acceleration
    )


def path_of(position: Array, rotation: Array, twist: Array) -> Path:
    """The path through a pose with a constant twist (6,)."""
    return bent_path(position, rotation, twist, np.zeros(6))


def bent_path(position: Array, rotation: Array, twist: Array, acceleration: Array) -> Path:
    """The path through a pose with a twist (6,) and an acceleration (6,) at time 0."""

    def path(t: float) -> tuple[Array, Array]:
        moved = twist * t + acceleration * t**2 / 2.0
        return position + moved[:3], Rotation.from_rotvec(moved[3:]).as_matrix() @ rotation

    return path


def random_base(random: Generator, size: float) -> dict[str, Array]:
    """A motion of the base as the plant's inputs; of size 1, as lively as that of a platform."""
    spread = {"rotation": 1.0, "angular_velocity": 3.0, "angular_acceleration": 30.0, "acceleration": 10.0}
    return {f"base_motion.{name}": size * random.normal(0.0, each, 3) for name, each in spread.items()}


def base_path(inputs: Mapping[str, Array]) -> Path:
    """A path of the base with the plant's inputs at time 0, which are seen in {1}; it starts without velocity."""
    turn, omega, alpha, acceleration = (
        inputs[f"base_motion.{name}"] for name in ("rotation", "angular_velocity", "angular_acceleration", "acceleration")
    )
    attitude = Rotation.from_rotvec(turn).as_matrix()
    return bent_path(
        np.zeros(3),
        attitude,
        np.hstack([np.zeros(3), attitude @ omega]),
        np.hstack([attitude @ acceleration, attitude @ alpha]),
    )


def rotor_mass(p: Mapping[str, Array]) -> float:
    """Inertia of rotor and screw, as a mass that moves along the leg."""
    return float(p["motor.rotor_inertia"] * (2.0 * pi / p["motor.screw_lead"]) ** 2)


def play(p: Mapping[str, Array]) -> Array:
    """The play of each leg between its motor and its rod [m]."""
    width: Array = p["screw.backlash"] + p["joint.clearance"]
    return width


def reflected_mass(p: Mapping[str, Array]) -> Array:
    """The mass of the rotor of each leg that moves with its length, as those do that have no play."""
    return np.where(play(p) > 0.0, 0.0, rotor_mass(p))


def flanks(p: Mapping[str, Array], ahead: Array, speed: Array) -> Array:
    """The forces of the screws' flanks on the rods [N], zero where there is no play."""
    forces = []
    for width, z, v in zip(play(p), ahead, speed, strict=True):
        depth = abs(z) - width / 2.0
        pressing = max(1.0 + float(p["screw.damping"]) * v * np.sign(z), 0.0)
        forces.append(np.sign(z) * p["screw.stiffness"] * depth * pressing if width > 0.0 < depth else 0.0)
    return np.array(forces)


def _world_inertias(p: Mapping[str, Array], position: Array, rotation: Array, base: Path = at_rest) -> Array:
    attitudes = on_earth(bodies_at(p, position, rotation), *base(0.0)).attitudes
    return attitudes @ inertias(p) @ np.swapaxes(attitudes, 1, 2)


def virtual_motions(p: Mapping[str, Array], position: Array, rotation: Array, base: Path = at_rest) -> list[Motion]:
    """The motions that belong to the six unit twists of the platform on a base that is held."""
    return [motion_along(p, path_of(position, rotation, unit), lambda _: base(0.0)) for unit in np.eye(6)]


def inertia_matrix(p: Mapping[str, Array], position: Array, rotation: Array) -> Array:
    """(6, 6): twice the kinetic energy as a form in the twist."""
    tensors = _world_inertias(p, position, rotation)
    motions = virtual_motions(p, position, rotation)
    velocity = np.array([m.velocity for m in motions])
    spin = np.array([m.angular_velocity for m in motions])
    rate = np.array([m.length_rate for m in motions])
    return (
        np.einsum("aki,k,bki->ab", velocity, masses(p), velocity)
        + np.einsum("aki,kij,bkj->ab", spin, tensors, spin)
        + (reflected_mass(p) * rate) @ rate.T
    )


def bias_force(p: Mapping[str, Array], position: Array, rotation: Array, twist: Array, base: Path = at_rest) -> Array:
    """The generalised force (6,) that gravity, the base and a constant twist take, on the platform's origin."""
    motion = motion_along(p, path_of(position, rotation, twist), base)
    tensors = _world_inertias(p, position, rotation, base)
    spin = np.einsum("kij,kj->ki", tensors, motion.angular_velocity)
    torque = np.einsum("kij,kj->ki", tensors, motion.angular_acceleration) + np.cross(motion.angular_velocity, spin)
    force = masses(p)[:, None] * (motion.acceleration - p["gravity"])
    return np.array(
        [
            np.sum(force * virtual.velocity)
            + np.sum(torque * virtual.angular_velocity)
            + (reflected_mass(p) * motion.length_acceleration) @ virtual.length_rate
            for virtual in virtual_motions(p, position, rotation, base)
        ]
    )


def energies(
    p: Mapping[str, Array],
    position: Array,
    rotation: Array,
    twist: Array,
    base: Path = at_rest,
    acceleration: Array | float = 0.0,
) -> tuple[float, float]:
    """Kinetic energy, and potential energy less the base's acceleration (3,) on the earth [J]."""
    motion = motion_along(p, path_of(position, rotation, twist), base)
    tensors = _world_inertias(p, position, rotation, base)
    kinetic = (
        masses(p) @ np.sum(motion.velocity**2, axis=1)
        + np.einsum("ki,kij,kj->", motion.angular_velocity, tensors, motion.angular_velocity)
        + reflected_mass(p) @ motion.length_rate**2
    ) / 2.0
    places = on_earth(bodies_at(p, position, rotation), *base(0.0)).places
    return float(kinetic), float(-masses(p) @ places @ (p["gravity"] - acceleration))


def static_forces(p: Mapping[str, Array], position: Array, rotation: Array) -> Array:
    """Forces (6,) [N] that the legs must push with to hold all weights, by the equilibrium of each body.

    A leg bears its parts' weight across on the base joint and the platform joint like a beam on two supports, and the rod
    slides on it, so that its weight along the leg comes on the platform.
    """
    legs = leg_vectors(p, position, rotation)
    lengths = np.linalg.norm(legs, axis=1, keepdims=True)
    along = legs / lengths
    arms = p["platform_joints"] @ rotation.T
    gravity_along = (along @ p["gravity"])[:, None] * along
    lever = p["leg.lower.mass"] * p["leg.lower.center"] + p["leg.upper.mass"] * (lengths - p["leg.upper.center"])
    on_joints = p["leg.upper.mass"] * gravity_along + lever / lengths * (p["gravity"] - gravity_along)
    force, torque = on_joints.sum(axis=0), np.cross(arms, on_joints).sum(axis=0)
    for body in ("platform", "payload"):
        weight = p[f"{body}.mass"] * p["gravity"]
        force = force + weight
        torque = torque + np.cross(rotation @ p[f"{body}.center_of_mass"], weight)
    return -np.linalg.solve(jacobian(p, position, rotation).T, np.hstack([force, torque]))
