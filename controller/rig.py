"""The rig as the controller knows it, which every stage of the cycle reads: geometry, sensors, magnetic field, and time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from controller.direct_kinematics.geometry import GEOMETRY, geometry_of
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype
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
    legs=np.int64,  # how many there are; of what is kept by leg, the first `legs` rows count
    planar=np.int64,  # whether the platform moves in a plane
    period=np.float64,  # of a cycle [s]
    hold_cycles=np.int64,  # how long the brakes hold before the motion
    geometry=GEOMETRY,  # for the closed forms
    sensors=SENSOR_GEOMETRY,
    vectors_in_base=(np.float64, (2, 3)),  # the vertical and the magnetic field's horizontal direction, unit, in {1}
)
"""Constants that several stages read."""

TIME = record_dtype(
    cycle=np.int64,  # number of the present cycle, in periods
    missed=np.int64,  # periods that were missed since the last cycle
    behind=np.int64,  # by how many of them the reference is behind
)
"""The time, in periods."""


def sensor_geometry(mechanism: Mechanism, tilt: ArrayLike = (0.0, 0.0)) -> Record:
    """What the readings depend on (dtype `SENSOR_GEOMETRY`); `tilt` (2,) [rad] turns the vertical about x, y of {1}."""
    plant = mechanism.plant_parameters()
    up = tilt_rotation(tilt) @ mechanism.up_in_base
    return filled(
        SENSOR_GEOMETRY,
        base_joints=six_rows(mechanism.base_joints),
        platform_joints=six_rows(mechanism.platform_joints),
        joint_rotations=six_rows(mechanism.joint_rotations),
        up_in_joint=six_rows(np.swapaxes(mechanism.joint_rotations, 1, 2) @ up),
        up_in_base=up,
        leg_imu_position=six_rows(plant["leg_imu_position"]),
        platform_imu_position=plant["platform_imu_position"],
        gravity=float(np.linalg.norm(plant["gravity"])),
    )


def tilt_rotation(tilt: ArrayLike) -> Array:
    """The rotation (3, 3) by which a tilt (2,) [rad] about the axes x and y of {1} turns what is fixed in the world."""
    return rotation_from_vector([*np.asarray(tilt), 0.0])


@dataclass(frozen=True, eq=False)
class MagneticField:
    """The magnetic field of the earth at a mechanism."""

    vectors: Array  # (2, 3), the vertical and the field's horizontal direction, unit, in {1}
    horizontal: float  # [uT]
    vertical: float  # positive upwards [uT]

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
    """The constants of a rig (dtype `RIG`) in cycles of this rate [Hz].

    Args:
        hold: how long the brakes hold before the motion [s].
        tilt: (2,) [rad], of the base about the axes x and y of {1}, as a calibration has found it.
    """
    return filled(
        RIG,
        legs=mechanism.legs,
        planar=mechanism.planar,
        period=1.0 / rate,
        hold_cycles=int(np.ceil(hold * rate - 1e-9)),
        geometry=geometry_of(mechanism),
        sensors=sensor_geometry(mechanism, tilt),
        vectors_in_base=field_of(mechanism, tilt).vectors,
    )


@kernel
def elapsed(rig: Record, time: Record) -> float:
    """Time since the last cycle [s]."""
    return float((1 + time.missed) * rig.period)
