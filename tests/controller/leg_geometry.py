"""Geometry for the tests of the controller, written without the code under test: poses, random mechanisms, ideal IMUs."""

import numpy as np
from scipy.spatial.transform import Rotation

from plant.mechanism import Mechanism

UP = np.array([0.0, 0.0, 1.0])


def skew(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def unit(v):
    v = np.asarray(v, dtype=float)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def rotation_of(vector):
    """The rotation about `vector` by its length."""
    return Rotation.from_rotvec(vector).as_matrix()


def angle_between(first, second):
    """Angle between two rotations, exact down to rounding."""
    return float(np.linalg.norm(Rotation.from_matrix(first.T @ second).as_rotvec()))


def random_rotation(random):
    """Uniform over all rotations."""
    return Rotation.from_quat(random.normal(size=4)).as_matrix()


def leg_vectors(mechanism, position, rotation):
    """The paper's (1), leg by leg."""
    joints = zip(mechanism.platform_joints, mechanism.base_joints, strict=True)
    return np.array([position + rotation @ a - b for a, b in joints])


def leg_directions(mechanism, position, rotation):
    return unit(leg_vectors(mechanism, position, rotation))


def legs_between(base_count, platform_count, random):
    """Six different legs between so many joints, each joint used, none by more than three legs (the paper's section 2)."""
    every = [(b, p) for b in range(base_count) for p in range(platform_count)]
    while True:
        chosen = [every[i] for i in random.permutation(len(every))[:6]]
        for side, count in ((0, base_count), (1, platform_count)):
            used = np.bincount([leg[side] for leg in chosen], minlength=count)
            if used.min() < 1 or used.max() > 3:
                break
        else:
            return chosen


def random_mechanism(random, base_count=6, platform_count=6, *, coplanar=True, up_in_base=UP):
    """Joints about two rings, the base's lifted off any plane, the platform's in a tilted plane of {2} unless not coplanar."""
    legs = legs_between(base_count, platform_count, random)
    base_angles = 2.0 * np.pi * (np.arange(base_count) + random.uniform(-0.3, 0.3, base_count)) / base_count
    angles = 2.0 * np.pi * (np.arange(platform_count) + random.uniform(-0.3, 0.3, platform_count)) / platform_count
    base = np.column_stack([np.cos(base_angles), np.sin(base_angles), random.uniform(-0.2, 0.2, base_count)])
    platform = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(platform_count)])
    base *= random.uniform(0.25, 0.35, (base_count, 1))
    platform *= random.uniform(0.15, 0.25, (platform_count, 1))
    if not coplanar:
        platform[:, 2] += random.uniform(-0.05, 0.05, platform_count)
    platform = random.uniform(-0.05, 0.05, 3) + platform @ rotation_of(random.uniform(-0.5, 0.5, 3)).T
    return Mechanism.from_legs(base[[b for b, _ in legs]], platform[[p for _, p in legs]], up_in_base=up_in_base)


def leg_frames(directions, axes):
    """The frames (..., 3, 3) of legs on universal joints: z along the leg, y across the leg and the axis in the base."""
    seconds = unit(np.cross(directions, axes))
    return np.stack([np.cross(seconds, directions), seconds, directions], axis=-1)


def static_signals(mechanism, position, rotation):
    """What the seven ideal IMUs read (3, 7, 3) on a mechanism at rest: no rate, and the reaction to gravity."""
    gravity = mechanism.plant["gravity"]
    frames = [*leg_frames(leg_directions(mechanism, position, rotation), mechanism.base_joint_axes), rotation]
    signals = np.zeros((3, 7, 3))
    signals[1] = [frame.T @ -gravity for frame in frames]
    signals[2] = [frame.T @ mechanism.plant["magnetic_field"] for frame in frames]
    return signals
