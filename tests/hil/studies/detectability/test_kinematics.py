"""The signals of a motion against frames that are built without angles and differentiated numerically."""

from dataclasses import replace

import numpy as np
import pytest

from controller.planning.offline_planner import plan
from controller.planning.segments import evaluate_reference
from controller.planning.target import load_target
from hil.studies.detectability.kinematics import (
    JET,
    POSE,
    BaseMotion,
    Motion,
    base_motion_along,
    motion_along,
    sensitivity,
    signals,
)
from plant.dynamics.base_course import attitudes_of, base_motion_of_text
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


def differentiated(mechanism, poses, bases=None):
    """The data (48,) in the middle of five poses, by differences of frames and lengths; (54,) on a base with five poses."""
    imus = [list(frames(mechanism, *pose)) for pose in poses]
    if bases is not None:
        # On the earth; the last IMU is the base's.
        on_base = [(mechanism.plant["base_imu_position"], np.eye(3))]
        imus = [[(p + r @ place, r @ axes) for place, axes in each + on_base] for each, (p, r) in zip(imus, bases, strict=True)]
    data = np.empty((len(imus[0]), 6))
    for k in range(len(data)):
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


def base_motion_of(path, mechanism):
    """The motion of a base whose pose on the earth follows a path, at time 0."""
    on_earth = motion_of(path, 0.0)
    force = on_earth.acceleration - mechanism.plant["gravity"]
    return BaseMotion(
        *(each @ on_earth.rotation[0] for each in (on_earth.angular_velocity, on_earth.angular_acceleration, force))
    )


def with_base_imu(mechanism):
    """A mechanism whose base has its IMU beside the origin of {1}."""
    return replace(mechanism, plant={**mechanism.plant, "base_imu_position": np.array([0.2, -0.1, 0.05])})


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


@pytest.mark.parametrize("name", ["hexapod", "6-3-II"])
def test_signals_on_a_base_that_moves_are_those_of_frames_on_the_earth(name):
    mechanism = with_base_imu(load_spatial(name))
    for path, base in zip(paths(mechanism, 4, 4), paths(mechanism, 4, 5), strict=True):
        motion = replace(motion_of(path, 0.0), base=base_motion_of(base, mechanism))
        expected = differentiated(mechanism, poses_about(path, 0.0), poses_about(base, 0.0))
        np.testing.assert_allclose(signals(mechanism, motion).data()[0], expected, rtol=1e-6, atol=1e-5)


def test_the_sensitivity_to_a_base_is_that_of_a_base_with_an_error_that_changes():
    mechanism = with_base_imu(load_spatial("hexapod"))
    random, path, base = np.random.default_rng(6), next(paths(mechanism, 1, 7)), next(paths(mechanism, 1, 8))
    motion = replace(motion_of(path, 0.0), base=base_motion_of(base, mechanism))
    derivative = sensitivity(mechanism, motion)[0, :, JET:]
    turning, hurry, force = jet = random.normal(size=(3, 3))
    # A base that turns by exp(e) first: its angular acceleration changes by e'' less e' x omega.
    growing = hurry + np.cross(turning, motion.base.angular_velocity[0])

    def bent(size):
        moved = []
        for (p, r), n in zip(poses_about(base, 0.0), STEPS, strict=True):
            t, attitude = n * H, pose_at(base, 0.0)[1]
            turn = size * (turning * t + 0.5 * growing * t * t)
            moved.append((p + 0.5 * size * t * t * attitude @ force, r @ rotation_from_vector(turn)))
        return differentiated(mechanism, poses_about(path, 0.0), moved)

    np.testing.assert_allclose(derivative @ jet.ravel(), (bent(1e-4) - bent(-1e-4)) / 2e-4, rtol=2e-4, atol=2e-3)


def test_the_motion_of_a_base_is_that_of_its_attitude_and_acceleration():
    mechanism = load_spatial("hexapod")
    texts = (
        "base-tilt,axis=x,size_deg=20,sine_hz=0.7", "base-tilt,axis=z,size_deg=40,ramp_s=1",
        "base-acceleration,axis=y,size_m_per_s2=2,sine_hz=0.5",
    )  # fmt: skip
    motions = [base_motion_of_text(f"{text},at=0") for text in texts]
    for time in (0.3, 0.8):
        found = base_motion_along(motions, mechanism, np.array([time]))
        turns = attitudes_of(motions, time + H * np.array(STEPS))
        rates = [base_motion_along(motions, mechanism, np.array([time + n * H])).angular_velocity[0] for n in STEPS]
        spin = turns[2].T @ np.tensordot(FIRST, turns, 1)
        np.testing.assert_allclose(found.angular_velocity[0], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-8)
        np.testing.assert_allclose(found.angular_acceleration[0], FIRST @ np.array(rates), atol=1e-7)
        # After a tenth of a second a sine is there.
        accelerated = [0.0, 2.0 * np.sin(np.pi * time), 0.0]
        np.testing.assert_allclose(
            found.specific_force[0], accelerated - turns[2].T @ mechanism.plant["gravity"], atol=1e-9
        )  # fmt: skip


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


def test_between_held_poses_the_legs_move_as_the_loop_plans():
    mechanism = load_spatial("hexapod")
    target, times = load_target("steps", mechanism, 4.0), np.arange(-0.5, 4.0, 1e-3)
    found = signals(mechanism, motion_along(target, mechanism, times))
    planned, index, state = plan(mechanism, target, 4.0), np.zeros(6, np.int64), np.zeros((6, 3))
    rates = []
    for i, time in enumerate(times):
        evaluate_reference(planned.segments, max(time, 0.0), index, state)
        np.testing.assert_allclose(found.lengths[i], state[:, 0], atol=2e-7)
        rates.append(state[:, 1].copy())
    np.testing.assert_allclose(found.leg_rates, rates, atol=2e-4)
    assert np.abs(rates).max() > 0.05
