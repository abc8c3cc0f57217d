"""The platform's heading filter: a Kalman filter for the horizontal part of the magnetic field, seen in {2}.

State (4): its unit vector n in {2}, across the vertical u, and what the platform filter leaves of the gyroscope's bias about u
[rad/s]. n turns with `n' = n x rate`, and the magnetometer measures it with the vertical taken out: that is its tilt
compensation. Errors (2) are the angle about u by which the true n is turned from the estimate, and that of the bias.
"""

import numpy as np

from controller.estimation.leg_filter import SETTLING_S
from controller.estimation.platform_filter import cut_innovation, extrapolate_direction, make_level, turn_direction
from controller.rig import MagneticField, elapsed
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.dynamics.variables import PLATFORM_IMU
from plant.imu import MAGNETOMETER
from plant.pose import Array
from plant.vectors import cross, dot, scale, subtract, vector

STATES = 4
ERRORS = 2

_FIELD_SHARE = 0.3
"""By how much of itself the magnetic field may differ from the earth's: beyond that something magnetic is near."""

_FROZEN_FIELDS = 10
"""How many samples in a row of a magnetometer may be the same while the rest of its IMU moves."""

PARAMETERS = record_dtype(
    active=np.int64,  # whether the magnetometer is used
    strength=np.float64,  # of the earth's field [uT]
    sample_cycles=np.int64,  # for how many cycles a sample stands
    variance=np.float64,  # of the heading of one sample [rad^2]
    floor=np.float64,  # least variance of any average [rad^2]
    rate_density=np.float64,  # this and the rest as for the platform's filter
    bias_walk=np.float64,
    bias_sigma=np.float64,
    delay=np.float64,
    settling_cycles=np.int64,
)
"""Constants of the filter."""

STATE = record_dtype(
    x=(np.float64, STATES),
    covariance=(np.float64, (ERRORS, ERRORS)),
    age=np.int64,  # for how many cycles the filter has run
    used=np.int64,  # whether the heading is used
    weight=np.float64,  # of the heading in the refinement
    north=(np.float64, 3),  # horizontal direction of the field in {2}, without the sensors' delay
    field=(np.float64, 3),  # last sample [uT]
    frozen_for=np.int64,  # how many cycles the sample has stood
    fresh=np.int64,  # whether the sample is to be taken
)
"""State of the filter."""


def heading_parameters(fusion: FusionSettings, rate: float, field: MagneticField, active: bool) -> Record:
    """The constants of the filter (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    return filled(
        PARAMETERS,
        active=active,
        strength=field.strength,
        sample_cycles=max(1, round(rate / fusion.magnetometer_rate)),
        variance=field.heading_variance(fusion, rate),
        floor=fusion.heading_sigma**2,
        rate_density=fusion.gyroscope_noise**2,
        bias_walk=fusion.bias_walk**2,
        bias_sigma=fusion.bias_sigma,
        delay=fusion.sensor_delay,
        settling_cycles=round(SETTLING_S * rate),
    )


@kernel
def step_heading_filter(p: Record, s: Record, rig: Record, time: Record, imus: Record, platform: Record) -> None:
    """Step the filter, if the magnetometer is used and healthy.

    The field must be about as strong as the earth's, and must not stand still while the rest of its IMU moves. A sample that
    stands until the next one is taken once.
    """
    if p.active == 0:
        return
    field = imus.sample[MAGNETOMETER, PLATFORM_IMU]
    if field[0] != s.field[0] or field[1] != s.field[1] or field[2] != s.field[2]:
        s.frozen_for = 0
    elif imus.unchanged[PLATFORM_IMU] == 0:
        s.frozen_for += 1
    s.field[:] = field
    # NaN is not below the limit either.
    strength = np.sqrt(dot(vector(field), vector(field)))
    healthy = (
        imus.used[PLATFORM_IMU] != 0
        and abs(strength - p.strength) < _FIELD_SHARE * p.strength
        and s.frozen_for < _FROZEN_FIELDS * p.sample_cycles
    )
    age = s.age
    s.age = age + 1 + time.missed if healthy else 0
    s.used = 1 if platform.used != 0 and s.age > min(time.cycle, p.settling_cycles) else 0
    s.fresh = 1 if healthy and s.frozen_for % p.sample_cycles == 0 else 0
    s.weight = 0.0
    if not healthy:
        return
    x, covariance, up = s.x, s.covariance, platform.x
    if age == 0:
        start_heading(x, covariance, field, up, p.variance, p.bias_sigma)
    else:
        predict_heading(x, covariance, up, platform.rate, elapsed(rig, time), p.rate_density, p.bias_walk)
        if s.fresh != 0:
            update_heading(x, covariance, field, up, p.variance)
    extrapolate_direction(x, platform.rate, p.delay, s.north)
    if s.used != 0:
        s.weight = 1.0 / (covariance[0, 0] + p.floor)


@kernel
def start_heading(x: Array, covariance: Array, field: Array, vertical: Array, variance: float, bias_sigma: float) -> None:
    """Start from the first sample of the field (3,) [uT] and the vertical (3,); `variance` is that of the angle [rad^2]."""
    for i in range(3):
        x[i] = field[i]
    x[3] = 0.0
    make_level(x, vector(vertical))
    covariance[0, 0], covariance[1, 1] = variance, bias_sigma**2
    covariance[0, 1] = covariance[1, 0] = 0.0


@kernel
def predict_heading(
    x: Array, covariance: Array, vertical: Array, rate: Array, period: float, rate_density: float, bias_walk: float
) -> None:
    """Carry the state on by `period` [s], in which the vertical (3,) has come to be what it is.

    Args:
        rate: (3,) [rad/s], less the bias that the platform filter knows.
        rate_density, bias_walk: spectral densities of the gyroscope's noise and of its bias.
    """
    t = period
    turn_direction(x, subtract(vector(rate), scale(x[3], vector(vertical))), t)
    make_level(x, vector(vertical))
    # Too large a bias turns n too far against the rate: the angle's error grows by that of the bias.
    mixed = covariance[0, 1] + t * covariance[1, 1]
    covariance[0, 0] += t * (covariance[0, 1] + mixed) + t * rate_density
    covariance[0, 1] = covariance[1, 0] = mixed
    covariance[1, 1] += t * bias_walk


@kernel
def update_heading(x: Array, covariance: Array, field: Array, vertical: Array, variance: float) -> None:
    """Take a sample of the field (3,) [uT], whose horizontal part has an angle of this variance [rad^2]."""
    north = vector(x)
    east = cross(vector(vertical), north)
    total = covariance[0, 0] + variance
    innovation = cut_innovation(np.arctan2(dot(east, vector(field)), dot(north, vector(field))), total)
    k0, k1 = covariance[0, 0] / total, covariance[0, 1] / total
    sine, cosine = np.sin(k0 * innovation), np.cos(k0 * innovation)
    for i in range(3):
        x[i] = cosine * north[i] + sine * east[i]
    x[3] += k1 * innovation
    covariance[1, 1] -= k1 * covariance[0, 1]
    covariance[0, 0] *= 1.0 - k0
    covariance[0, 1] *= 1.0 - k0
    covariance[1, 0] = covariance[0, 1]
