"""Readings of IMUs at rest, and the poses that calibrated ones give."""

import numpy as np

from controller.calibration.at_rest import fit_pose
from controller.inverse_kinematics import sample_workspace
from controller.rig import sensor_geometry
from plant.imu import imu_state, load_imu, measure
from plant.pose import rotation_angle
from tests.controller.leg_geometry import static_signals

RAW = load_imu("mpu9150")


def read(imu, signals, count):
    """Mean of `count` readings (3, 7, 3) of signals that stay."""
    raw, total = np.zeros((3, 7, 3)), np.zeros((3, 7, 3))
    for _ in range(count):
        measure(imu, signals, raw)
        total += raw
    return total / count


def rests_of(mechanism, count, seed, model=RAW, poses=None):
    """Readings (count, 7, 6) at random poses, and these."""
    positions, rotations = sample_workspace(mechanism, count, seed=seed + 50) if poses is None else poses
    imu = imu_state(model, seed, 1e-3)
    readings = []
    for position, rotation in zip(positions, rotations, strict=True):
        read(imu, static_signals(mechanism, position, rotation), 20)
        mean = read(imu, static_signals(mechanism, position, rotation), 500)
        readings.append(np.concatenate([mean[0], mean[1]], axis=1))
    return np.array(readings), positions, rotations


def pose_errors(mechanism, calibration, tilt, readings, positions, rotations):
    """RMS error [mm, deg] of the poses that calibrated forces at rest give."""
    raw = np.zeros((len(readings), 3, 7, 3))
    raw[:, 1] = readings[:, :, 3:]
    forces = calibration.apply(raw)[:, 1]
    found = [fit_pose(sensor_geometry(mechanism, tilt), each, mechanism.home) for each in forces]
    distances = np.linalg.norm([position for position, _ in found] - positions, axis=1)
    angles = rotation_angle(np.array([rotation for _, rotation in found]), rotations)
    return 1e3 * np.sqrt(np.mean(distances**2)), np.degrees(np.sqrt(np.mean(angles**2)))
