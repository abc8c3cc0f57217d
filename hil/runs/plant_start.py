"""Checks of a plant at its start: what another FMU gives at rest must fit the mechanism, before anything moves."""

from typing import NoReturn

import numpy as np

from controller.inverse_kinematics import leg_lengths
from plant.dynamics.variables import IMU_COUNT
from plant.errors import InputError
from plant.fmu.binding import SIGNAL_UNITS, UNITS
from plant.fmu.calls import read_imus, read_truth
from plant.fmu.plant import FmuPlant
from plant.imu import ACCELEROMETER
from plant.mechanism import Mechanism
from plant.pose import Array, Pose
from plant.truth import TRUTH_LENGTHS, TRUTH_POSITION

_NEAR_M = 0.1
_WEIGHT_RANGE = (0.3, 3.0)
"""How far from gravity a force at rest may be, as a plant may still settle on its brakes."""


def check_start(plant: FmuPlant, mechanism: Mechanism, start: Pose) -> None:
    """Check a plant that begins with values of its own, at rest at the pose `start`.

    Raises:
        InputError: its truth is far from there, or an accelerometer does not read gravity.
        FmuError: it cannot be read, or gives a value that is not finite.
    """
    if read_imus(plant.handle) | read_truth(plant.handle):
        raise plant.failure()
    lengths = leg_lengths(mechanism, start.position, start.rotation)
    for name, places, expected in (("position", TRUTH_POSITION, start.position), ("leg_length", TRUTH_LENGTHS, lengths)):
        given = plant.handle["truth"][places][: len(expected)]
        if np.isfinite(given).all() and np.abs(given - expected).max() > _NEAR_M:
            _refuse(plant, mechanism, name, name, given, expected)
    forces, size = plant.handle["imu"][ACCELEROMETER], float(np.linalg.norm(mechanism.plant["gravity"]))
    if size == 0.0:
        return
    directions = start.position + mechanism.platform_joints @ start.rotation.T - mechanism.base_joints
    upwards = directions / np.linalg.norm(directions, axis=1, keepdims=True) @ mechanism.up_in_base
    axes = {leg: upwards[leg] for leg in range(mechanism.legs)} | {IMU_COUNT - 1: start.rotation[:, 2] @ mechanism.up_in_base}
    least, most = (size * factor for factor in _WEIGHT_RANGE)
    for imu in plant.bound.imus:
        force, along = forces[imu], size * axes[imu]
        read = float(np.linalg.norm(force))
        if read > 0.0 and not least <= read <= most:
            what = f"the accelerometer of IMU {imu} at rest"
            _refuse(plant, mechanism, "imu_specific_force", what, np.array([read]), np.array([size]))
        if abs(along) > least and force[2] * along < -least * least:
            raise InputError(
                f"{plant.path.name}: the accelerometer of IMU {imu} reads {force[2]:.3g} m/s2 along its z axis at rest, where "
                f"{mechanism.name!r} has {along:.3g} m/s2: it is upside down, so turn the sign of [imu_specific_force] in the "
                "binding"
            )


def _refuse(plant: FmuPlant, mechanism: Mechanism, signal: str, what: str, given: Array, expected: Array) -> NoReturn:
    """Refuse values that do not fit; if they would fit in another unit, name it."""
    unit = SIGNAL_UNITS[signal]
    near = 0.2 * float(np.abs(expected).max())
    fitting = [name for name, factor in UNITS[unit].items() if name and np.abs(factor * given - expected).max() < near]
    hint = f"they would fit as {fitting[0]}" if fitting else "check their unit, sign and offset"
    raise InputError(
        f"{plant.path.name} begins with {what} {_shown(given)} {unit}, and {mechanism.name!r} with {_shown(expected)} {unit}: "
        f"{hint}, in [{signal}] of the binding"
    )


def _shown(values: Array) -> str:
    return ", ".join(f"{value:.4g}" for value in values)
