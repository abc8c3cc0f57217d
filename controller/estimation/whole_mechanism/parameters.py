"""What the whole-mechanism filter estimates: its constants and its state."""

import numpy as np

from controller.estimation.whole_mechanism.imu_errors import ERRORS, error_gradient
from controller.estimation.whole_mechanism.readings import MOTION_STATES, READINGS, READINGS_SCRATCH, RIG_ERRORS
from controller.rig import MagneticField
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT
from plant.errors import UnknownNameError
from plant.mechanism import LEGS
from plant.pose import Array

BLOCKS = {"gyroscopes": 3, "accelerometers": 6, "alignments": 15, "axes": ERRORS}
"""How many of an IMU's errors are estimated."""

ALL_ERRORS = IMU_COUNT * ERRORS
LENGTH_ERRORS = 2 * LEGS
"""How many errors of the encoders can be estimated: the zeros (6) and what play does to the readings (6) [m]."""

BASE_ERRORS = 6
"""How many errors of the base's IMU can be estimated: the biases of its gyroscope [rad/s] and accelerometer [m/s^2]."""

MOST_STATES = MOTION_STATES + ALL_ERRORS + RIG_ERRORS + LENGTH_ERRORS + 2 * BASE_ERRORS + 1
ROWS = IMU_COUNT * READINGS
"""Scalars of one update that are the IMUs'."""

WINDOW_S = 0.005
_SMOOTHING_S = 0.03

_LASTING = 6.0
"""What the time of a sample is off, or a ripple, lasts for a whole acceleration, some thirty windows. So each counts as the
root of that number; chosen on steps with two kinds of IMUs.
"""

_RIPPLE_HZ = 150.0
"""At this rate of the loop [Hz], the steps of the commands make a sample of the acceleration as wrong as it is large."""

FILTER_PARAMETERS = record_dtype(
    window=np.int64,  # samples that are averaged
    errors=np.int64,  # estimated errors of each IMU, 0 for no filter
    rig=np.int64,  # estimated errors of the rig
    states=np.int64,  # all states
    smoothing=np.float64,  # time constant of the motion at which the Jacobian is taken; infinite if set from outside [s]
    start_share=np.float64,  # how much less well the first pose is known than with all IMUs, 1 or more
    jerk=(np.float64, 2),  # spectral densities of the platform's jerk, linear and angular
    bias_walk=(np.float64, 2),  # spectral densities of the biases' walks, gyroscope and accelerometer
    variance=(np.float64, 2),  # of one sample, rate [(rad/s)^2] and force [(m/s^2)^2]
    timing_variance=np.float64,  # of the time of a sample [s^2]
    ripple=np.float64,  # square of a specific force's error for an acceleration: commands are steps
    prior=(np.float64, (ALL_ERRORS + RIG_ERRORS, ALL_ERRORS + RIG_ERRORS)),  # covariance of the errors at the start
    floor=(np.float64, 2),  # variances of position and rotation that are left as the rig's errors are not estimated
    lengths=np.int64,  # estimated errors of the encoders; 0 without encoders
    length_variance=np.float64,  # of one reading of an encoder [m^2]
    length_prior=(np.float64, 2),  # variances of an encoder's zero at the start, and of what play does to its reading [m^2]
    base=np.int64,  # estimated biases of the base's IMU, which its noise follows among the states; 0 without one
    base_prior=(np.float64, 2),  # variances of its biases at the start
    base_variance=(np.float64, 2),  # of its noise in one sample, rate [(rad/s)^2] and force [(m/s^2)^2]
    heading=np.int64,  # whether there is one
    field_axes=(np.float64, (3, 3)),  # north, east, and the axis about which a small turn changes the heading, in {1}
    heading_variance=np.float64,  # of a sample's heading [rad^2]
    offset_variance=np.float64,  # of the heading's offset [rad^2]
)
"""Constants of the filter."""

FILTER_STATE = record_dtype(
    running=np.int64,
    time=np.float64,  # of the motion, since the first cycle [s]
    position=(np.float64, 3),
    rotation=(np.float64, (3, 3)),
    motion=(np.float64, (4, 3)),
    low_passed=(np.float64, (2, 4, 3)),  # the motion, once and twice
    smooth_motion=(np.float64, (4, 3)),  # at which the Jacobian is taken
    errors=(np.float64, (IMU_COUNT, ERRORS)),
    rig=(np.float64, RIG_ERRORS),  # by how much joints (2, 6, 3) and tilt (2) are off
    covariance=(np.float64, (MOST_STATES, MOST_STATES)),
    published_time=np.float64,  # what is published is what the last complete update has found
    published_position=(np.float64, 3),
    published_rotation=(np.float64, (3, 3)),
    published_motion=(np.float64, (4, 3)),
    published_covariance=(np.float64, (MOTION_STATES, MOTION_STATES)),
    sum=(np.float64, (IMU_COUNT, READINGS)),  # of the samples in the present window
    sum_time=np.float64,
    weight=(np.float64, (2, IMU_COUNT)),  # of them, by sensor
    collected=np.int64,
    field=(np.float64, 3),  # the magnetometer's last sample [uT]
    field_time=np.float64,
    field_used=np.int64,  # whether the field is still to be taken
    standing=np.int64,  # whether the platform is known to stand
    heading_offset=np.float64,  # [rad]
    base_errors=(np.float64, BASE_ERRORS),
    frames=(np.float64, (IMU_COUNT, 3, 3)),  # axes of the IMUs in {1}, by rows, at the pose before the update
    length_errors=(np.float64, (2, LEGS)),  # of the encoders: zeros, and what play does [m]
    length_sum=(np.float64, LEGS),  # of the readings in the present window, and their number and mean time
    length_count=(np.float64, LEGS),
    length_sum_time=(np.float64, LEGS),
    length=(np.float64, LEGS),  # mean of the last full window [m]
    length_passed=(np.int64, LEGS),  # whether the leg has passed its home switch, which is still to be taken
    length_switched=(np.float64, LEGS),  # what was read there more than the length [m], and its variance [m^2]
    length_switched_variance=(np.float64, LEGS),
    length_weight=(np.float64, LEGS),  # the number of its readings
    length_later=(np.float64, LEGS),  # their mean time after that of the motion [s]
    length_predicted=(np.float64, LEGS),  # at the pose before the update [m]
    length_gradient=(np.float64, (LEGS, 6)),  # there, by position and rotation
    sample=(np.float64, (IMU_COUNT, READINGS)),  # mean of the last full window
    sample_weight=(np.float64, (2, IMU_COUNT)),
    row=np.int64,  # next scalar of the sample to take, -1 when none is left
    update_step=np.int64,
    change=(np.float64, MOST_STATES),  # of the states, found so far by the update under way
    gain=(np.float64, MOST_STATES),
    turn=(np.float64, 3),
    predicted=(np.float64, (IMU_COUNT, READINGS)),
    smooth_predicted=(np.float64, (IMU_COUNT, READINGS)),
    smooth_predicted_before=(np.float64, (IMU_COUNT, READINGS)),  # of the update before
    predicted_time=np.float64,
    change_per_second=(np.float64, (IMU_COUNT, READINGS)),  # from there to here
    jacobian=(np.float64, (IMU_COUNT, READINGS, MOTION_STATES)),
    rig_jacobian=(np.float64, (IMU_COUNT, READINGS, 8)),  # by a leg's two joints and the tilt
    gradient=(np.float64, ERRORS),  # by an IMU's errors, and scratch
    readings_scratch=READINGS_SCRATCH,
)
"""State of the filter, whose update may be under way."""


def filter_parameters(
    fusion: FusionSettings, rate: float, errors: str | None, covariance: Array | None, floor: Array | None = None,
    field: MagneticField | None = None, inflation: float | None = None, ripple: float = 0.0, lengths: bool = False,
    base: bool = False, start_share: float = 1.0,
) -> Record:  # fmt: skip
    """Constants of the filter.

    Args:
        fusion: settings.
        rate: samples per second [Hz].
        errors: a key of `BLOCKS`; None for no filter.
        covariance: (147, 147), of the errors that a calibration has left, or (185, 185), of joints and tilt, too, which are
            estimated then; None for what the settings say.
        floor: (2,) [m, rad], standard deviations of position and rotation that joints and tilt leave; None if they are exact.
        field: of the earth, for the platform's magnetometer; None without one.
        inflation: times the noise and the jerk; None for 1 with a covariance, and what the settings say without.
        lengths: whether there are encoders.
        base: whether there is an IMU on the base, which makes half of the noise.
        start_share: how much less well the first pose is known than with all IMUs, 1 or more.
        ripple: `ripple_at` the loop's rate if drives are commanded at this rate.

    Raises:
        UnknownNameError: no such block of errors.
    """
    if errors is not None and errors not in BLOCKS:
        raise UnknownNameError(f"no block of errors {errors!r}; there are {', '.join(BLOCKS)}")
    sigmas = np.repeat(
        [
            fusion.bias_sigma, fusion.accelerometer_bias_sigma, fusion.scale_sigma, fusion.scale_sigma, fusion.alignment_sigma,
            fusion.axes_sigma, fusion.axes_sigma,
        ],
        3,
    )  # fmt: skip
    known = np.diag(np.tile(sigmas**2, IMU_COUNT)) if covariance is None else covariance
    prior = np.zeros((ALL_ERRORS + RIG_ERRORS,) * 2)
    prior[: len(known), : len(known)] = known
    estimated = 0 if errors is None else BLOCKS[errors]
    if inflation is None:
        inflation = 1.0 if covariance is not None else fusion.noise_inflation
    jerk = inflation * np.array([fusion.platform_jerk, fusion.platform_angular_jerk])
    noise = inflation * np.array([fusion.mechanism_gyroscope_noise, fusion.mechanism_accelerometer_noise])
    rest = MOTION_STATES + len(known) - ALL_ERRORS
    parameters = filled(
        FILTER_PARAMETERS,
        window=max(1, round(WINDOW_S * rate)),
        errors=estimated,
        rig=len(known) - ALL_ERRORS,
        states=rest + IMU_COUNT * estimated + lengths * LENGTH_ERRORS + base * 2 * BASE_ERRORS + (field is not None),
        smoothing=_SMOOTHING_S,
        start_share=start_share,
        jerk=jerk**2,
        bias_walk=(fusion.bias_walk**2, fusion.accelerometer_bias_walk**2),
        variance=noise**2 * rate / 2.0,
        timing_variance=(_LASTING * fusion.sensor_timing) ** 2,
        ripple=(_LASTING * ripple) ** 2,
        prior=prior,
        floor=np.zeros(2) if floor is None else floor**2 / 3.0,
        lengths=lengths * LENGTH_ERRORS,
        base=base * BASE_ERRORS,
        base_prior=(fusion.bias_sigma**2, fusion.accelerometer_bias_sigma**2),
        base_variance=base * noise**2 * rate / 4.0,
        length_variance=fusion.length_noise**2,
        length_prior=(fusion.length_zero**2, fusion.length_play**2),
    )
    if field is not None:
        up, north = field.vectors
        parameters["heading"] = 1
        parameters["field_axes"] = north, np.cross(up, north), up - field.vertical / field.horizontal * north
        parameters["heading_variance"] = field.heading_variance(fusion, rate)
        parameters["offset_variance"] = fusion.heading_sigma**2
    return parameters


def with_biases_for_the_rest(covariance: Array, errors: str, readings: Array) -> Array:
    """The covariance (147, 147) of the IMUs' errors for a filter that does not estimate all of them: its biases have, besides
    their own, what the other errors do to these readings (7, 6).

    What a calibration has left of a bias and of a scale cancels at the readings of its poses. Without the scale, the bias alone
    would be far less certain than their sum.
    """
    mixed, gradient, estimated = np.eye(ALL_ERRORS), np.zeros(ERRORS), BLOCKS[errors]
    for k in range(IMU_COUNT):
        for m in range(min(estimated, READINGS)):
            error_gradient(np.zeros(ERRORS), readings[k], m, gradient)
            mixed[ERRORS * k + m, ERRORS * k + estimated : ERRORS * (k + 1)] = gradient[estimated:]
    found: Array = mixed @ covariance @ mixed.T
    return found


def ripple_at(rate: float) -> float:
    """The error of a sample of the acceleration, as a share of it, by the steps of the commands at a rate of the loop [Hz]."""
    return min(1.0, (_RIPPLE_HZ / rate) ** 2)


@kernel
def rig_start(parameters: Record) -> int:
    """The place of the first error of the rig among the states."""
    return int(MOTION_STATES + IMU_COUNT * parameters.errors)


@kernel
def lengths_start(parameters: Record) -> int:
    """The place of the first error of the encoders among the states."""
    return int(rig_start(parameters) + parameters.rig)


@kernel
def base_start(parameters: Record) -> int:
    """The place of the first bias of the base's IMU among the states."""
    return int(lengths_start(parameters) + parameters.lengths)


@kernel
def rows_of(parameters: Record) -> int:
    """How many scalars an update has."""
    return ROWS + LEGS if parameters.lengths > 0 else ROWS
