"""Vibration, shocks and clipped readings: how uncertain each sensor's reading is in this cycle, for all filters.

The filters know what a sensor should read: an accelerometer gravity and the motion that the gyroscopes show, a leg's gyroscope
the motion so far. If it reads more than noise and the filter's own uncertainty explain, that is vibration, a shock or a fault.
The square of this excess is added to the variance of the reading. So the filters go on with the other sensors for as long as it
lasts, whatever its frequency is.

Some readings of a vibration happen to be near what is expected, and have no excess. They are not better for that, so the mean
square of such readings counts as well. Between shocks it is small. Mean forces of some samples that are no motion of all
gyroscopes (`integrity.parity`) count, too: a vibration that aliases to a slow one, or an error that accelerometers share.

A reading at the end of its sensor's range is clipped. It says nothing, and the others bridge it.
"""

import numpy as np

from controller.estimation.excess import faded_excess
from controller.safety.causes import Cause, report_event
from plant.compiled import Record, kernel, record_dtype
from plant.imu import ACCELEROMETER, GYROSCOPE
from plant.imu_wiring import IMU_COUNT
from plant.pose import Array

MEMORY_S = 0.002
"""Time constant with which the excess of a reading fades, as a shock does in the sensors' low-passes [s]."""

AVERAGE_S = 0.3
"""Time constant of the mean square that is told [s]."""

CALM_S = 1.0
"""For how long nothing may shake before that is told [s]."""

_BRIDGED_S = 0.05
"""For how long readings may be clipped before the IMU is left out; as long without restores it [s]."""

SAYS_NOTHING = 1e4
"""Variance of a clipped reading [m^2/s^4, rad^2/s^2]: so much more than that of any other that it does not count."""

SHAKEN = 0.25
"""Mean square from which on an accelerometer is shaken for its gyroscope [m^2/s^4]."""

_CALM_SHARE = 0.5
"""Below this share of the limit the IMUs count as calm."""

PARAMETERS = record_dtype(
    limit=np.float64,  # of vibration, RMS, from which on it is told [m/s^2]
    bridged_cycles=np.int64,
    calm_cycles=np.int64,
    smoothing=np.float64,  # share of a new excess in the mean
)
"""Constants."""

STATE = record_dtype(
    clipped=(np.int64, (2, IMU_COUNT)),  # whether the reading is at the end of its range
    clipped_for=(np.int64, IMU_COUNT),  # cycles with clipped readings, less those without
    excess=(np.float64, (2, IMU_COUNT)),  # of each reading's square over what is explained, faded [rad^2/s^2, m^2/s^4]
    mean=(np.float64, IMU_COUNT),  # of the accelerometers', averaged [m^2/s^4]
    passed=(np.float64, IMU_COUNT),  # square of the readings without an excess, averaged [m^2/s^4]
    hidden=(np.float64, IMU_COUNT),  # by how much that is more than what is explained [m^2/s^4]
    no_motion=(np.float64, IMU_COUNT),  # variance of a reading for the mean force that is no motion [m^2/s^4]
    told=np.int64,  # whether it has been told that IMUs are shaken
    bridging=np.int64,  # the same of clipped readings
    calm_for=np.int64,  # for how many cycles nothing has shaken them
)
"""State."""


def shaking_parameters(limit: float, rate: float) -> Record:
    """The constants (dtype `PARAMETERS`) in cycles of this rate [Hz]; `limit` is that of vibration [m/s^2]."""
    made: Record = np.zeros((), PARAMETERS)
    made["limit"] = limit
    made["bridged_cycles"] = max(2, round(_BRIDGED_S * rate))
    made["calm_cycles"] = round(CALM_S * rate)
    made["smoothing"] = 1.0 / (AVERAGE_S * rate)
    return made


@kernel
def note_force(s: Record, k: int, squared: float, explained: float, period: float) -> None:
    """Note by how much the accelerometer of IMU `k` reads what is not explained.

    Args:
        squared: square of the difference of reading and expectation [m^2/s^4].
        explained: mean of it by noise and the filter's uncertainty.
        period: since the sample before [s].
    """
    s.excess[ACCELEROMETER, k] = faded_excess(s.excess[ACCELEROMETER, k], squared, explained, period, MEMORY_S)
    if s.excess[ACCELEROMETER, k] == 0.0:
        s.passed[k] += min(1.0, period / AVERAGE_S) * (squared - s.passed[k])
    s.hidden[k] = max(s.passed[k] - explained, 0.0)


@kernel
def note_rate(s: Record, k: int, squared: float, explained: float, period: float) -> None:
    """Note by how much the gyroscope of IMU `k` reads what is not explained [rad^2/s^2], as `note_force`.

    While its accelerometer is shaken, the estimated motion is less certain than the gyroscope, which keeps its weight.
    """
    if s.mean[k] > SHAKEN:
        s.excess[GYROSCOPE, k] = 0.0
    else:
        s.excess[GYROSCOPE, k] = faded_excess(s.excess[GYROSCOPE, k], squared, explained, period, MEMORY_S)


@kernel
def variance_of(s: Record, sensor: int, k: int, nominal: float) -> float:
    """The variance of a sensor's reading in this cycle, of which `nominal` is noise."""
    clipped = SAYS_NOTHING if s.clipped[sensor, k] != 0 else 0.0
    beyond = s.hidden[k] + s.no_motion[k] if sensor == ACCELEROMETER else 0.0
    return float(nominal + clipped + s.excess[sensor, k] + beyond)


@kernel
def worth_of(s: Record, sensor: int, k: int, nominal: float) -> float:
    """The weight of a sensor's reading in this cycle, as a share of that of one with its noise alone."""
    return float(nominal / variance_of(s, sensor, k, nominal))


@kernel
def bridges(p: Record, s: Record, k: int, healthy: int, missed: int) -> bool:
    """Whether IMU `k` is healthy although its readings may be clipped: it was, and they have not been for long."""
    if s.clipped[0, k] == 0 and s.clipped[1, k] == 0:
        s.clipped_for[k] = max(s.clipped_for[k] - 1 - missed, 0)
        return True
    s.clipped_for[k] = min(s.clipped_for[k] + 1 + missed, p.bridged_cycles + 1)
    return bool(healthy != 0 and s.clipped_for[k] <= p.bridged_cycles)


@kernel
def tell_shaking(p: Record, s: Record, used: Array, missed: int, events: Record) -> None:
    """Report once that IMUs are shaken and that readings at the end of their range are bridged, and when all is calm again."""
    worst, most, clipped = 0, 0.0, -1
    share = min(1.0, (1 + missed) * p.smoothing)
    for k in range(IMU_COUNT):
        if used[k] == 0:
            s.excess[GYROSCOPE, k] = s.excess[ACCELEROMETER, k] = s.hidden[k] = s.no_motion[k] = 0.0
        elif s.clipped[0, k] != 0 or s.clipped[1, k] != 0:
            clipped = k
        s.mean[k] += share * (s.excess[ACCELEROMETER, k] - s.mean[k])
        beyond = s.mean[k] + s.no_motion[k]
        if beyond > most:
            worst, most = k, beyond
    if s.told == 0 and most > p.limit**2:
        s.told = 1
        report_event(events, Cause.SHAKEN, worst, np.sqrt(most), p.limit)
    if s.bridging == 0 and clipped >= 0:
        s.bridging = 1
        report_event(events, Cause.BRIDGED, clipped, np.nan, np.nan)
    calm = clipped < 0 and most < (_CALM_SHARE * p.limit) ** 2
    s.calm_for = s.calm_for + 1 + missed if calm else 0
    if s.calm_for > p.calm_cycles and (s.told != 0 or s.bridging != 0):
        s.told = s.bridging = 0
        report_event(events, Cause.CALM, -1, np.nan, np.nan)


@kernel
def is_clipped(s: Record, sensor: int, k: int) -> bool:
    """Whether a sensor's reading is at the end of its range."""
    return bool(s.clipped[sensor, k] != 0)
