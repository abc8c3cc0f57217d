"""IMU imperfections: from the ideal signals of a plant to the raw data of its IMUs."""

from plant.imu.aliasing import aliasing_remark, sampled_noise
from plant.imu.disturbed import DISTURBANCE, MOST_DISTURBANCES, disturbance_record
from plant.imu.model import MILLI_G, STANDARD_GRAVITY, ImuModel, SensorErrors
from plant.imu.presets import PRESETS, load_imu, text_of_imu
from plant.imu.random_numbers import philox
from plant.imu.readings import (
    ACCELEROMETER,
    GYROSCOPE,
    IMU_LIMITS,
    IMU_STATE,
    MAGNETOMETER,
    add_disturbances,
    imu_state,
    measure,
)
from plant.imu_wiring import Wiring

__all__ = [
    "ACCELEROMETER",
    "DISTURBANCE",
    "GYROSCOPE",
    "IMU_LIMITS",
    "IMU_STATE",
    "MAGNETOMETER",
    "MILLI_G",
    "MOST_DISTURBANCES",
    "PRESETS",
    "STANDARD_GRAVITY",
    "ImuModel",
    "SensorErrors",
    "Wiring",
    "add_disturbances",
    "aliasing_remark",
    "disturbance_record",
    "imu_state",
    "load_imu",
    "measure",
    "philox",
    "sampled_noise",
    "text_of_imu",
]
