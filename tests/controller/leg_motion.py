"""What IMUs on moving bodies read: by differences of where they are, without a formula of the filters under test."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tests.controller.leg_geometry import leg_frames

# Central differences of eighth order; at 1 ms they are exact to 1e-9 of any motion here.
STEP_S = 1e-3
FIRST = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0.0, 4 / 5, -1 / 5, 4 / 105, -1 / 280]) / STEP_S
SECOND = np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560]) / STEP_S**2


@dataclass(frozen=True)
class LegMotion:
    """Angles (N, 2) with their rates and accelerations, and the ideal readings (N, 3) [rad/s, m/s^2] in the leg frame."""

    angles: np.ndarray
    rates: np.ndarray
    accelerations: np.ndarray
    gyroscope: np.ndarray
    accelerometer: np.ndarray

    @property
    def states(self):
        """What the filter should find (N, 9), without a bias of the gyroscope."""
        zeros = np.zeros((len(self.angles), 3))
        return np.hstack([self.angles, self.rates, self.accelerations, zeros])


def joint_to_leg(angles):
    """Rotations (..., 3, 3) of the leg frame in the joint frame for angles (..., 2)."""
    flat = np.reshape(angles, (-1, 2))
    turned = Rotation.from_rotvec(flat[:, :1] * [1.0, 0.0, 0.0]) * Rotation.from_rotvec(flat[:, 1:] * [0.0, 1.0, 0.0])
    return turned.as_matrix().reshape(*np.shape(angles)[:-1], 3, 3)


def readings(rotations, places, up, gravity):
    """Ideal gyroscope and accelerometer (N, 3) of an IMU that has been seen at `around(times)`.

    Args:
        rotations: (N, 9, 3, 3), from the IMU's frame to one at rest.
        places: (N, 9, 3) [m], of the IMU in the frame at rest.
        up: (3,), the vertical in the frame at rest.
        gravity: [m/s^2].
    """
    here = rotations[:, 4]
    turning = np.einsum("nji,w,nwjk->nik", here, FIRST, rotations)
    acceleration = np.einsum("w,nwi->ni", SECOND, places) + gravity * np.asarray(up)
    gyroscope = np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=1)
    return gyroscope, np.einsum("nji,nj->ni", here, acceleration)


def around(times):
    """The instants (N, 9) that differences at times (N,) need."""
    return np.asarray(times)[:, None] + STEP_S * np.arange(-4, 5)


def observe(angles_at, times, up_in_joint, imu_position, gravity):
    """The motion of a leg whose angles (..., 2) at times (...) are given by a function."""
    angles = angles_at(around(times))
    rotations = joint_to_leg(angles)
    gyroscope, accelerometer = readings(rotations, rotations @ imu_position, up_in_joint, gravity)
    return LegMotion(
        angles=angles[:, 4],
        rates=np.einsum("w,nwi->ni", FIRST, angles),
        accelerations=np.einsum("w,nwi->ni", SECOND, angles),
        gyroscope=gyroscope,
        accelerometer=accelerometer,
    )


def observe_mechanism(mechanism, pose_at, times):
    """What the seven ideal IMUs (N, 3, 7, 3) read on a platform that moves as `pose_at` says.

    Args:
        pose_at: positions (N, 3) and rotations (N, 3, 3) at times (N,).
    """
    instants = around(times)
    positions, rotations = pose_at(instants.ravel())
    positions, rotations = positions.reshape(*instants.shape, 3), rotations.reshape(*instants.shape, 3, 3)
    gravity = np.linalg.norm(mechanism.plant["gravity"])
    signals = np.zeros((len(instants), 3, 7, 3))
    for leg in range(6):
        vectors = positions + rotations @ mechanism.platform_joints[leg] - mechanism.base_joints[leg]
        frames = leg_frames(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), mechanism.base_joint_axes[leg])
        places = frames @ mechanism.plant["leg_imu_position"][leg]
        signals[:, 0, leg], signals[:, 1, leg] = readings(frames, places, mechanism.up_in_base, gravity)
    places = positions + rotations @ mechanism.plant["platform_imu_position"]
    signals[:, 0, 6], signals[:, 1, 6] = readings(rotations, places, mechanism.up_in_base, gravity)
    return signals


def sines(random, size=0.12, slowest=0.3, fastest=2.0):
    """A motion of three sines about each axis, for `observe`."""
    frequencies = 2.0 * np.pi * random.uniform(slowest, fastest, (3, 2))
    phases, sizes = random.uniform(0.0, 2.0 * np.pi, (3, 2)), random.uniform(0.3, 1.0, (3, 2)) * size / 2.0
    return lambda times: np.sum(sizes * np.sin(frequencies * np.asarray(times)[..., None, None] + phases), axis=-2)
