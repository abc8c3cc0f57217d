"""Random mechanisms whose legs lean, on bases of any tilt, with joint axes of every kind; without the code under test."""

import numpy as np

from plant.errors import InputError
from plant.mechanism import Mechanism
from plant.pose import Pose, quaternion_from_rotation
from tests.controller.leg_geometry import UP, rotation_of, unit

AXES = ("default", "radial", "across", "any", "below")
"""Kinds of joint axes: e_z x leg, away from the base's centre, across the leg, any, and level below the leg."""

MOST_LEAN_DEG = 80.0
_MOST_LENGTH_M = 1.2


def leaning(hexapod, seed):
    """A mechanism, and the kind of its axes; None instead of it where its joints are singular at home."""
    random = np.random.default_rng(seed)
    lean, azimuth = np.radians(random.uniform(0.0, MOST_LEAN_DEG)), random.uniform(0.0, 2.0 * np.pi)
    length = min(random.uniform(0.2, 0.5) / np.cos(lean), _MOST_LENGTH_M)
    level = [np.sin(lean) * np.cos(azimuth), np.sin(lean) * np.sin(azimuth)]
    home = Pose(length * np.array([*level, np.cos(lean)]), rotation_of(random.uniform(-0.3, 0.3, 3)))
    tilt = rotation_of(np.radians(random.choice([0.0, 20.0, 60.0, 180.0])) * random.uniform(-1.0, 1.0, 3))
    up, base, platform = tilt @ UP, hexapod.base_joints, hexapod.platform_joints
    if random.random() < 0.5:
        base, platform = base + random.uniform(-0.08, 0.08, (6, 3)), platform + random.uniform(-0.05, 0.05, (6, 3))
    directions, kind = unit(home.position + platform @ home.rotation.T - base), random.choice(AXES)
    axes = {
        "default": lambda: None,
        "radial": lambda: unit(base * [1.0, 1.0, 0.0]),
        "across": lambda: unit(np.cross(directions, random.normal(size=(6, 3)))),
        "any": lambda: unit(random.normal(size=(6, 3))),
        "below": lambda: unit(directions - np.outer(directions @ up, up)),
    }[kind]()
    plant = {**hexapod.plant, "gravity": -9.81 * up, "magnetic_field": tilt @ hexapod.plant["magnetic_field"]}
    try:
        return made(base, platform, home, up, axes, plant), str(kind)
    except InputError:
        return None, str(kind)


def made(base, platform, home, up, axes, plant, stroke=(-0.06, 0.06)):
    """A mechanism from its parts."""
    return Mechanism.from_legs(
        base, platform, name="leaning", up_in_base=up, base_joint_axes=axes, home=home, limits={"stroke": stroke}, plant=plant
    )


def with_axis(mechanism, leg, axis):
    """The same mechanism with another first axis of a leg's joint."""
    axes = mechanism.base_joint_axes.copy()
    axes[leg] = unit(axis)
    parts = mechanism.base_joints, mechanism.platform_joints, mechanism.home, mechanism.up_in_base
    return made(*parts, axes, mechanism.plant, mechanism.limits.stroke)


def document(mechanism):
    """A mechanism's file that is based on the hexapod."""
    w, x, y, z = quaternion_from_rotation(mechanism.home.rotation)
    field = mechanism.plant["magnetic_field"].tolist()
    return f"""
based_on = "hexapod"
name = "leaning"
[geometry]
base_joints = {mechanism.base_joints.tolist()}
platform_joints = {mechanism.platform_joints.tolist()}
base_joint_axes = {mechanism.base_joint_axes.tolist()}
up_in_base = {mechanism.up_in_base.tolist()}
[home]
position = {mechanism.home.position.tolist()}
quaternion = [{w}, {x}, {y}, {z}]
[plant]
gravity = {mechanism.plant["gravity"].tolist()}
magnetic_field = {field}
"""
