"""A made-up planar rig in files, for the tests of its evaluation and of its report."""

import tomllib
from importlib import resources

import numpy as np

from hil.studies.planar_rig import COLUMNS
from plant.mechanism.documents import mechanism_from_document

BASE, PLATFORM = np.array([[0.0, 0.0], [170.0, 0.0], [280.0, 0.0]]), np.array([[0.0, 0.0], [70.0, 0.0], [100.0, 0.0]])


def load_rig():
    text = (resources.files("plant.mechanism") / "presets" / "planar-3rpr.toml").read_text()
    return mechanism_from_document(tomllib.loads(text))


def joints_at(pose):
    """The platform joints [mm] at x, y [mm] and angle [deg]."""
    x, y, angle = pose
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[x + c * a - s * b, y + s * a + c * b] for a, b in PLATFORM])


def leg_degrees(pose):
    x, y = (joints_at(pose) - BASE).T
    return np.degrees(np.arctan2(y, x))


def write_pose(folder, number, pose, angles):
    """A file with samples (N, 9) of leg angles [deg]."""
    x, y, gamma = pose
    rows = [",".join(map(repr, row)) for row in np.asarray(angles).tolist()]
    text = [f"# true pose by image processing: x {x} mm, y {y} mm, gamma {gamma} deg", ",".join(COLUMNS), *rows]
    (folder / f"pose_{number:02}.csv").write_text("\n".join(text) + "\n")


def write_two_poses(folder):
    """Two poses: legs without error as the raw ones, those of a pose near by as Kalman's, noise as the complementary ones."""
    poses, offset = ((107.0, 192.0, -5.0), (84.0, 217.0, -20.0)), np.array([2.0, -3.0, 4.0])
    noise = np.random.default_rng(1).normal(0.0, 0.01, (40, 3))
    for number, pose in enumerate(poses, start=1):
        true, near = leg_degrees(pose), leg_degrees(pose + offset)
        write_pose(folder, number, pose, [[*true, *near, *(true + sample)] for sample in noise])
    return noise
