"""What limits a pose, written anew in NumPy and slowly; and mechanisms with every kind of limit."""

import numpy as np
from scipy.spatial.transform import Rotation

from controller.workspace import KINDS, LIMITS
from plant.mechanism import Mechanism, PlanarMechanism
from plant.mechanism.documents import mechanism_from_text

LIMITED = {
    "hexapod": "",
    "6-3-I": "leg_ends = [0.0, 0.05]\n",
    "6-3-II": "",
    "6-4-I": "",
    "6-5": "clearance = 0.004\n",
    "genhexkins": "leg_ends = [0.06, 0.02]\n",
    "planar-3rpr": "",
}
"""Presets, and what is different about their bodies."""

_GRAVITY_STEP = 1e-5


def limited(name: str) -> Mechanism:
    """A preset with swings, bodies and plates of its own size."""
    bare = mechanism_from_text(f'based_on = "{name}"\n', "twin")
    size = float(np.linalg.norm(bare.platform_joints, axis=1).max())
    planar = isinstance(bare, PlanarMechanism)
    base, platform = (
        (f"center = [0.1, {-0.2 * size}]\nnormal = [0.0, 1.0]", f"center = [0.05, {0.3 * size}]\nnormal = [0.0, 1.0]")
        if planar
        else (
            f"center = [0.0, 0.0, {bare.base_joints[:, 2].mean() - 0.12 * size}]",
            f"center = [0.0, 0.0, {bare.platform_joints[:, 2].mean() + 0.12 * size}]",
        )
    )
    text = (
        f'based_on = "{name}"\n[joints]\nbase_swing = 0.3\nplatform_swing = 0.35\n'
        f"[bodies]\nleg_diameter = {0.1 * size}\n{LIMITED[name]}"
        f"[bodies.base_plate]\n{base}\nradius = {1.2 * size}\nthickness = {0.02 * size}\n"
        f"[bodies.platform_plate]\n{platform}\nradius = {0.8 * size}\n"
    )
    mechanism = mechanism_from_text(text, "twin")
    return Mechanism.from_planar(mechanism) if isinstance(mechanism, PlanarMechanism) else mechanism


def draw(mechanism: Mechanism, count: int, seed: int = 0, reach: float = 0.9, tilt: float = 0.5):
    """Poses about home, most of them near the limits or beyond: positions and rotations."""
    random, home = np.random.default_rng(seed), mechanism.home
    span = float(np.ptp(mechanism.limits.stroke, axis=1).max())
    shares = random.random((count, 1))
    moves = shares * random.uniform(-reach * span, reach * span, (count, 3))
    turns = shares * random.uniform(-tilt, tilt, (count, 3))
    if mechanism.planar:
        moves[:, 2], turns[:, :2] = 0.0, 0.0
    return home.position + moves, Rotation.from_rotvec(turns).as_matrix() @ home.rotation


def slow_margins(mechanism: Mechanism, positions, rotations, twist=None, load=None, forces=True, conditioning=True):
    """The margins (N, 59) but for direct kinematics."""
    n, count = mechanism.legs, len(positions)
    joints = positions[:, None] + np.einsum("nij,kj->nki", rotations, mechanism.platform_joints)
    legs = joints - mechanism.base_joints
    lengths = np.sqrt((legs**2).sum(axis=2))
    along = legs / lengths[..., None]
    found = {kind: np.full((count, sum(limit.kind == kind for limit in LIMITS)), np.inf) for kind in KINDS}
    least, greatest = mechanism.limits.stroke.T
    found["stroke"][:, :n] = np.minimum(lengths - least, greatest - lengths)
    swings = mechanism.joints
    if swings is not None:
        found["base swing"][:, :n] = swings.base_swing - angles(along, swings.base_axes)
        axes = np.einsum("nij,kj->nki", rotations, swings.platform_axes)
        found["platform swing"][:, :n] = swings.platform_swing - angles(along, axes)
    if mechanism.bodies is not None:
        add_clearances(mechanism, positions, rotations, joints, along, found)
    moving = [0, 1, 5] if mechanism.planar else [*range(6)]
    arms = joints - positions[:, None]
    jacobian = np.concatenate([along, np.cross(arms, along)], axis=2)
    if twist is not None:
        found["speed"][:, :n] = mechanism.limits.velocity - np.abs(jacobian @ twist)
    if forces:
        plant = mechanism.plant_parameters()
        lifted = np.empty((count, 6))
        for axis in range(6):
            step = np.zeros(6)
            step[axis] = _GRAVITY_STEP
            ends = [energy(mechanism, plant, positions, rotations, sign * step) for sign in (1.0, -1.0)]
            lifted[:, axis] = (ends[0] - ends[1]) / (2.0 * _GRAVITY_STEP)
        wrench = lifted - (0.0 if load is None else np.asarray(load))
        pushed = np.linalg.solve(np.swapaxes(jacobian[:, :, moving], 1, 2), wrench[:, moving, None])[..., 0]
        motor = 2.0 * np.pi / plant["motor.screw_lead"] * plant["motor.torque_constant"] * plant["drive.current_limit"]
        found["force"][:, :n] = motor - np.abs(pushed)
    if conditioning:
        centered = mechanism.platform_joints - mechanism.platform_joints.mean(axis=0)
        scaled = jacobian / np.array([1.0] * 3 + [np.linalg.norm(centered, axis=1).max()] * 3)
        values = np.linalg.svd(scaled[:, :, moving], compute_uv=False)
        home = mechanism.home.rotation @ mechanism.platform_joints.T
        at_home = mechanism.home.position + home.T - mechanism.base_joints
        unit = at_home / np.linalg.norm(at_home, axis=1)[:, None]
        side = np.linalg.slogdet(np.hstack([unit, np.cross(home.T, unit)])[:, moving])[0]
        sign = side * np.linalg.slogdet(scaled[:, :, moving])[0]
        found["Jacobian"][:, 0] = sign * values[:, -1] / values[:, 0] - 1e-3
    return np.hstack([found[kind] for kind in KINDS])


def angles(directions, axes):
    return np.arctan2(np.linalg.norm(np.cross(directions, axes), axis=-1), np.sum(directions * axes, axis=-1))


def add_clearances(mechanism, positions, rotations, joints, along, found):
    bodies, n = mechanism.bodies, mechanism.legs
    starts = mechanism.base_joints + bodies.leg_ends[0] * along
    tips = joints - bodies.leg_ends[1] * along
    radii = 0.5 * bodies.leg_diameter
    pairs = [limit.legs for limit in LIMITS if limit.kind == "legs"]
    for column, (i, j) in enumerate(pairs):
        if j >= n:
            continue
        shared = [
            np.linalg.norm(side[i] - side[j]) < 1e-9 and end == 0.0
            for side, end in zip((mechanism.base_joints, mechanism.platform_joints), bodies.leg_ends, strict=True)
        ]
        if not any(shared):
            apart = between_segments(starts[:, i], tips[:, i], starts[:, j], tips[:, j])
            found["legs"][:, column] = apart - radii[i] - radii[j] - bodies.clearance
    for kind, plate in (("base plate", bodies.base_plate), ("platform plate", bodies.platform_plate)):
        if plate is None:
            continue
        center, normal = np.tile(plate.center, (len(positions), 1)), np.tile(plate.normal, (len(positions), 1))
        if kind == "platform plate":
            center = positions + np.einsum("nij,j->ni", rotations, plate.center)
            normal = np.einsum("nij,j->ni", rotations, plate.normal)
        for k in range(n):
            apart = to_disc(starts[:, k], tips[:, k], center, normal, plate.radius)
            found[kind][:, k] = apart - radii[k] - 0.5 * plate.thickness - bodies.clearance


def between_segments(a, b, c, d):
    """The least of the distances of the ends from the other segment, and of the lines if they come closest within both."""
    least = np.minimum.reduce([to_segment(a, c, d), to_segment(b, c, d), to_segment(c, a, b), to_segment(d, a, b)])
    u, v, w = b - a, d - c, c - a
    normal = np.cross(u, v)
    square = np.sum(normal**2, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        s, t = np.sum(np.cross(w, v) * normal, axis=1) / square, np.sum(np.cross(w, u) * normal, axis=1) / square
        lines = np.abs(np.sum(w * normal, axis=1)) / np.sqrt(square)
    inside = (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0)
    return np.where(inside, np.minimum(least, lines), least)


def to_segment(point, start, end):
    way = end - start
    share = np.clip(np.sum((point - start) * way, axis=1) / np.sum(way**2, axis=1), 0.0, 1.0)
    return np.linalg.norm(point - start - share[:, None] * way, axis=1)


def to_disc(start, end, center, normal, radius):
    """By the golden section, as the distance is convex along the segment."""

    def distance(share):
        point = start + share[:, None] * (end - start) - center
        height = np.sum(point * normal, axis=1)
        flat = point - height[:, None] * normal
        size = np.linalg.norm(flat, axis=1)
        nearest = flat * np.minimum(1.0, radius / np.maximum(size, 1e-300))[:, None]
        return np.linalg.norm(point - nearest, axis=1)

    low, high, ratio = np.zeros(len(start)), np.ones(len(start)), 0.5 * (np.sqrt(5.0) - 1.0)
    for _ in range(60):
        first, second = high - ratio * (high - low), low + ratio * (high - low)
        left = distance(first) < distance(second)
        low, high = np.where(left, low, first), np.where(left, second, high)
    return np.minimum.reduce([distance(share) for share in (low, high, 0.0 * low, 0.0 * low + 1.0)])


def energy(mechanism, plant, positions, rotations, step):
    """The potential energy of all bodies after a small step of the platform (6,)."""
    turned = Rotation.from_rotvec(step[3:]).as_matrix() @ rotations
    moved = positions + step[:3]
    bodies = []
    for body in ("platform", "payload"):
        center = np.pad(plant[f"{body}.center_of_mass"], (0, 3 - plant[f"{body}.center_of_mass"].size))
        bodies.append((plant[f"{body}.mass"], moved + turned @ center))
    joints = moved[:, None] + np.einsum("nij,kj->nki", turned, mechanism.platform_joints)
    along = joints - mechanism.base_joints
    along = along / np.linalg.norm(along, axis=2, keepdims=True)
    for k in range(mechanism.legs):
        bodies.append((plant["leg.lower.mass"], mechanism.base_joints[k] + plant["leg.lower.center"] * along[:, k]))
        bodies.append((plant["leg.upper.mass"], joints[:, k] - plant["leg.upper.center"] * along[:, k]))
    return -sum(mass * center @ plant["gravity"] for mass, center in bodies)
