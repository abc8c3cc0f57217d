"""The rig as the controller knows it, which every stage of the cycle reads: geometry, sensors, magnetic field, and time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from controller.direct_kinematics.geometry import GEOMETRY, geometry_of
from controller.settings import FusionSettings
from plant.compiled import Record, kernel, record_dtype
from plant.mechanism import LEGS, Mechanism, six_rows
from plant.pose import Array, rotation_from_vector

_LEAST_HORIZONTAL = 1e-9

SENSOR_GEOMETRY = record_dtype(
    base_joints=(np.float64, (LEGS, 3)),
    platform_joints=(np.float64, (LEGS, 3)),
    joint_rotations=(np.float64, (LEGS, 3, 3)),
    up_in_joint=(np.float64, (LEGS, 3)),
    up_in_base=(np.float64, (1, 3)),
    leg_imu_position=(np.float64, (LEGS, 3)),
    platform_imu_position=(np.float64, 3),
    gravity=np.float64,
)
"""Where joints and IMUs are, and the vertical: what the readings depend on besides the motion."""

RIG = record_dtype(
    legs=np.int64,
    planar=np.int64,
    period=np.float64,
    hold_cycles=np.int64,
    geometry=GEOMETRY,
    sensors=SENSOR_GEOMETRY,
    vectors_in_base=(np.float64, (2, 3)),
)
"""Constants that several stages read.

Fields:
    legs: how many legs there are. Of what is kept by leg, the first `legs` rows count.
    planar: whether the platform moves in a plane.
    period: of a cycle [s].
    hold_cycles: how long the brakes hold before the motion.
    geometry, sensors: of the closed forms and of the IMUs.
    vectors_in_base: the vertical and the horizontal direction of the magnetic field, unit vectors in {1}.
"""

TIME = record_dtype(cycle=np.int64, missed=np.int64)
"""The number of the present cycle, in periods, and how many periods were missed since the last cycle."""


def sensor_geometry(mechanism: Mechanism, tilt: ArrayLike = (0.0, 0.0)) -> Record:
    """What the readings depend on, dtype `SENSOR_GEOMETRY`.

    Args:
        mechanism: with plant data.
        tilt: (2,) [rad], by which the vertical is turned about the axes x and y of {1}.
    """
    plant = mechanism.plant_parameters()
    up = tilt_rotation(tilt) @ mechanism.up_in_base
    values = {
        "base_joints": six_rows(mechanism.base_joints),
        "platform_joints": six_rows(mechanism.platform_joints),
        "joint_rotations": six_rows(mechanism.joint_rotations),
        "up_in_joint": six_rows(np.swapaxes(mechanism.joint_rotations, 1, 2) @ up),
        "up_in_base": up,
        "leg_imu_position": six_rows(plant["leg_imu_position"]),
        "platform_imu_position": plant["platform_imu_position"],
        "gravity": float(np.linalg.norm(plant["gravity"])),
    }
    geometry: Record = np.zeros((), SENSOR_GEOMETRY)
    for name, value in values.items():
        geometry[name] = value
    return geometry


def tilt_rotation(tilt: ArrayLike) -> Array:
    """The rotation (3, 3) by which a tilt (2,) [rad] about the axes x and y of {1} turns what is fixed in the world."""
    return rotation_from_vector([*np.asarray(tilt), 0.0])


@dataclass(frozen=True, eq=False)
class MagneticField:
    """The magnetic field of the earth at a mechanism.

    Attributes:
        vectors: (2, 3), the vertical and the field's horizontal direction, as unit vectors in {1}.
        horizontal, vertical: its components, the second positive upwards [uT].
    """

    vectors: Array
    horizontal: float
    vertical: float

    @property
    def strength(self) -> float:
        """[uT]."""
        return float(np.hypot(self.horizontal, self.vertical))

    def heading_variance(self, fusion: FusionSettings, rate: float) -> float:
        """Of the heading that a sample of the magnetometer tells, in cycles of this rate [Hz]; in rad^2."""
        return fusion.magnetometer_noise**2 * min(fusion.magnetometer_rate, rate) / 2.0 / self.horizontal**2


def field_of(mechanism: Mechanism, tilt: ArrayLike = (0.0, 0.0)) -> MagneticField:
    """The field in the plant data of a mechanism, next to none without; `tilt` (2,) [rad] turns it with the vertical."""
    up, field = mechanism.up_in_base, mechanism.plant.get("magnetic_field", np.zeros(3))
    vertical = float(field @ up)
    across = field - vertical * up
    horizontal = max(float(np.linalg.norm(across)), _LEAST_HORIZONTAL)
    vectors: Array = np.stack([up, across / horizontal]) @ tilt_rotation(tilt).T
    return MagneticField(vectors, horizontal, vertical)


def rig_parameters(mechanism: Mechanism, rate: float, hold: float, tilt: Array) -> Record:
    """The constants of a rig (dtype `RIG`).

    Args:
        mechanism: spatial or planar.
        rate: cycles per second [Hz].
        hold: how long the brakes hold before the motion [s].
        tilt: (2,) [rad], of the base about the axes x and y of {1}, as a calibration has found it.
    """
    rig: Record = np.zeros((), RIG)
    rig["legs"], rig["planar"], rig["period"] = mechanism.legs, mechanism.planar, 1.0 / rate
    rig["hold_cycles"] = int(np.ceil(hold * rate - 1e-9))
    rig["geometry"], rig["sensors"] = geometry_of(mechanism), sensor_geometry(mechanism, tilt)
    rig["vectors_in_base"] = field_of(mechanism, tilt).vectors
    return rig


@kernel
def elapsed(rig: Record, time: Record) -> float:
    """Time since the last cycle [s]."""
    return float((1 + time.missed) * rig.period)
