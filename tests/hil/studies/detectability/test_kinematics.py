"""The signals of a motion against frames that are built without angles and differentiated numerically."""

import numpy as np
import pytest

from controller.planning.target import load_target
from hil.studies.detectability.kinematics import POSE, Motion, motion_along, sensitivity, signals
from plant.errors import InputError
from plant.mechanism import load_spatial
from plant.pose import rotation_from_vector

H = 1e-3
"""Between two times of a path [s]."""


def pose_at(path, time):
    """The pose of a path, whose first rows are its constant position and rotation vector, with polynomials in time."""
    position, turn = np.split(sum(row * time**i for i, row in enumerate(path)), 2)
    return position, rotation_from_vector(turn)


def frames(mechanism, position, rotation):
    """Origin and axes of every IMU in {1}, built by cross products: y across the first axis of the joint and the leg."""
    levers = mechanism.plant["leg_imu_position"], mechanism.plant["platform_imu_position"]
    for base, platform, axis, lever in zip(
        mechanism.base_joints, mechanism.platform_joints, mechanism.base_joint_axes, levers[0], strict=True
    ):
        leg = position + rotation @ platform - base
        z = leg / np.linalg.norm(leg)
        y = np.cross(z, axis)
        y /= np.linalg.norm(y)
        axes = np.column_stack([np.cross(y, z), y, z])
        yield base + axes @ lever, axes
    yield position + rotation @ levers[1], rotation


STEPS = (-2, -1, 0, 1, 2)
FIRST, SECOND = np.array([1, -8, 0, 8, -1]) / (12 * H), np.array([-1, 16, -30, 16, -1]) / (12 * H**2)
"""Five-point differences."""


def differentiated(mechanism, poses):
    """The data (48,) in the middle of five poses, by differences of frames and lengths."""
    imus = [list(frames(mechanism, *pose)) for pose in poses]
    data = np.empty((7, 6))
    for k in range(7):
        places, axes = (np.array([imu[k][i] for imu in imus]) for i in (0, 1))
        spin = axes[2].T @ np.tensordot(FIRST, axes, 1)
        data[k, :3] = spin[2, 1], spin[0, 2], spin[1, 0]
        data[k, 3:] = axes[2].T @ (SECOND @ places - mechanism.plant["gravity"])
    lengths = [np.linalg.norm(p + mechanism.platform_joints @ r.T - mechanism.base_joints, axis=1) for p, r in poses]
    return np.concatenate([data.ravel(), FIRST @ np.array(lengths)])


def poses_about(path, time):
    """Five poses of a path."""
    return [pose_at(path, time + n * H) for n in STEPS]


def motion_of(path, time):
    """The motion at a time, with its derivatives by differences of the poses."""
    places, turns = (np.array(each) for each in zip(*poses_about(path, time), strict=True))
    spin, hurry = (np.tensordot(by, turns, 1) @ turns[2].T for by in (FIRST, SECOND))
    # R'' R^T = [alpha]x + [omega]x [omega]x; the second is symmetric.
    velocity, omega, acceleration, alpha = (
        FIRST @ places, [spin[2, 1], spin[0, 2], spin[1, 0]], SECOND @ places,
        0.5 * np.array([hurry[2, 1] - hurry[1, 2], hurry[0, 2] - hurry[2, 0], hurry[1, 0] - hurry[0, 1]]),
    )  # fmt: skip
    return Motion(*(np.array(each)[None] for each in (places[2], turns[2], velocity, omega, acceleration, alpha)))


def paths(mechanism, count, seed):
    """Random smooth paths about home."""
    random = np.random.default_rng(seed)
    for _ in range(count):
        path = random.normal(size=(4, POSE)) * [[0.02] * 3 + [0.1] * 3, [0.1] * 3 + [0.5] * 3, [0.5] * 3 + [2.0] * 3, [1.0] * 6]
        path[0, :3] += mechanism.require_home().position
        yield path


@pytest.mark.parametrize("name", ["hexapod", "6-3-II", "genhexkins"])
def test_signals_are_those_of_frames_differentiated_numerically(name):
    mechanism = load_spatial(name)
    scale = np.linalg.norm(mechanism.base_joints, axis=1).max()
    for path in paths(mechanism, 5, 1):
        for time in (0.0, 0.05):
            found = signals(mechanism, motion_of(path, time)).data()[0]
            np.testing.assert_allclose(
                found, differentiated(mechanism, poses_about(path, time)), rtol=1e-6, atol=3e-6 * max(1.0, scale)
            )


def test_the_sensitivity_is_that_of_paths_with_an_error_that_changes():
    mechanism = load_spatial("hexapod")
    random = np.random.default_rng(2)
    for path in paths(mechanism, 3, 3):
        derivative = sensitivity(mechanism, motion_of(path, 0.0))[0]
        jet = random.normal(size=(3, POSE))

        def bent(size, path=path, jet=jet):
            # exp(error) rotation, with an error e + e' t + e'' t^2 / 2.
            errors = [size * (jet[0] + jet[1] * n * H + 0.5 * jet[2] * (n * H) ** 2) for n in STEPS]
            poses = zip(poses_about(path, 0.0), errors, strict=True)
            return differentiated(mechanism, [(p + e[:3], rotation_from_vector(e[3:]) @ r) for (p, r), e in poses])

        np.testing.assert_allclose(derivative @ jet.ravel(), (bent(1e-5) - bent(-1e-5)) / 2e-5, rtol=2e-4, atol=2e-3)


def test_a_motion_has_the_derivatives_of_its_target_and_stands_before_it_begins():
    mechanism = load_spatial("hexapod")
    target = load_target("sines", mechanism, 4.0)
    times = np.arange(-0.5, 4.0, 1e-3)
    motion = motion_along(target, mechanism, times)
    still, moving = times <= 0.0, slice(600, -10)
    np.testing.assert_allclose(motion.position[still], np.broadcast_to(target.start.position, (still.sum(), 3)), atol=1e-12)
    assert not np.any(motion.velocity[still]) and not np.any(motion.angular_acceleration[still])
    positions, rotations = target.at(times)
    np.testing.assert_allclose(motion.position, positions, atol=1e-5)
    np.testing.assert_allclose(motion.rotation, rotations, atol=1e-4)
    for value, rate in ((motion.position, motion.velocity), (motion.velocity, motion.acceleration)):
        np.testing.assert_allclose(np.gradient(value, times, axis=0)[moving], rate[moving], atol=2e-5)
    np.testing.assert_allclose(
        np.gradient(motion.angular_velocity, times, axis=0)[moving], motion.angular_acceleration[moving], atol=2e-4
    )
    spin = np.gradient(motion.rotation, times, axis=0) @ np.swapaxes(motion.rotation, 1, 2)
    np.testing.assert_allclose(spin[moving][:, [2, 0, 1], [1, 2, 0]], motion.angular_velocity[moving], atol=2e-6)


def test_a_target_that_jumps_is_refused():
    mechanism = load_spatial("hexapod")
    with pytest.raises(InputError, match="choose one that moves on"):
        motion_along(load_target("steps", mechanism, 4.0), mechanism, np.arange(3.0))
