"""The health of each IMU: which of them can be used."""

from collections.abc import Collection

import numpy as np

from controller.estimation import shaking
from controller.estimation.imu_calibration import calibrate_samples
from controller.safety.causes import Cause, report_event
from controller.settings import FusionSettings, SafetySettings
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.dynamics.variables import IMU_COUNT
from plant.pose import Array

END_OF_RANGE = 0.999
"""From this share of its range on a reading is clipped: the largest one of 12 bits is a step short of the range, 5e-4 of it."""

_FROZEN_S = 0.01
"""How long an IMU may repeat its reading while others do not, or while the legs must have moved [s]."""

_ROUNDING = 1e-9
"""Smaller changes of a reading show nothing: no sensor resolves them, and a simulation at rest rounds so [rad/s, m/s^2]."""

_SURELY_MOVED_M = 1e-3
"""When the reference has moved a leg so far since the last change of any reading, some should have changed [m]."""

_HEALTHY_S = 0.02
"""How long an IMU that was left out must be healthy before it is used again [s]."""

_STALE_S = 0.01
"""How long a rig that answers may leave an IMU without a new sample [s]."""

_NOISE_S = 0.02
"""Time constant over which the noise of an IMU is averaged [s]."""

_SHAKEN_HZ = 400.0
"""Below this rate motion shows in second differences."""

_NOISIER = 3.0
"""How much noisier than the others an IMU must be: what shakes all of them is no fault of one."""

_REMEMBERED_S, _MOST_REMEMBERED = 5.0, 10.0
"""The noise of the others is remembered, as samples that beat with a vibration look quiet for a while: time constant [s], and
the most that is remembered, in limits.
"""

PARAMETERS = record_dtype(
    present=(np.int64, IMU_COUNT),  # which IMUs there are
    gain=(np.float64, (3, IMU_COUNT, 3, 3)),  # a calibrated reading is gain times the raw one plus offset
    offset=(np.float64, (3, IMU_COUNT, 3)),
    range=(np.float64, 2),  # of gyroscope and accelerometer; the end of which is invalid [rad/s, m/s^2]
    noise=(np.float64, 2),  # limits of gyroscope and accelerometer, RMS [rad/s, m/s^2]
    noise_smoothing=np.float64,  # share of a new sample in the average
    remembering=np.float64,  # what is left after a cycle of the noise of late
    frozen_cycles=np.int64,  # these three: the durations above
    healthy_cycles=np.int64,
    stale_cycles=np.int64,
    shaking=shaking.PARAMETERS,
)
"""Constants of the IMUs."""

STATE = record_dtype(
    raw=(np.float64, (3, IMU_COUNT, 3)),  # last reading [rad/s, m/s^2, uT]
    sample=(np.float64, (3, IMU_COUNT, 3)),  # last reading, calibrated
    sample_age=(np.int64, IMU_COUNT),  # how many cycles old the sample is, as the rig reports it
    stale_for=(np.int64, IMU_COUNT),  # how many answers of the rig in a row had no new sample of the IMU
    unchanged=(np.int64, IMU_COUNT),  # whether the IMU repeats its reading
    frozen_for=(np.int64, IMU_COUNT),  # for how many cycles it has done so although it must have changed
    moved_since=np.float64,  # how far the reference has moved a leg since the last change of any reading [m]
    healthy_for=(np.int64, IMU_COUNT),  # for how many cycles the IMU has been healthy
    healthy=(np.int64, IMU_COUNT),  # whether its readings are fit for use
    used=(np.int64, IMU_COUNT),  # whether the filters use it
    excluded=(np.int64, IMU_COUNT),  # whether it contradicts the others
    earlier=(np.float64, (2, 2, IMU_COUNT, 3)),  # the last two raw samples
    variance=(np.float64, (2, IMU_COUNT)),  # of each sensor's noise, averaged
    noise=(np.float64, IMU_COUNT),  # of each IMU over its limit
    recent_noise=(np.float64, IMU_COUNT),  # the greatest of late, fading
    shaking=shaking.STATE,
)
"""State of the IMUs."""


def imu_parameters(
    present: Collection[int], gain: Array, offset: Array, fusion: FusionSettings, safety: SafetySettings, rate: float
) -> Record:
    """The constants of the IMUs (dtype `PARAMETERS`) that are `present`, in cycles of this rate [Hz]; gain and offset are those
    of a calibration.
    """
    shaken = _SHAKEN_HZ / rate
    return filled(
        PARAMETERS,
        present=[imu in present for imu in range(IMU_COUNT)],
        gain=gain,
        offset=offset,
        range=(fusion.gyroscope_range, fusion.accelerometer_range),
        noise=np.array([safety.gyroscope_noise, safety.accelerometer_noise]) * max(1.0, shaken**2),
        noise_smoothing=min(0.05, 1.0 / (rate * _NOISE_S)),
        remembering=np.exp(-1.0 / (rate * _REMEMBERED_S)),
        frozen_cycles=max(3, round(_FROZEN_S * rate)),
        healthy_cycles=round(_HEALTHY_S * rate),
        stale_cycles=max(3, round(_STALE_S * rate)),
        shaking=shaking.shaking_parameters(safety.vibration, rate),
    )


@shared_kernel
def screen_imus(
    p: Record, s: Record, rig: Record, time: Record, silent: int, measurement: Array, motion: Array, events: Record
) -> None:
    """Calibrate a raw measurement (3, 7, 3), and find out which IMUs are healthy.

    An IMU is left out while its readings are not finite or noisy, at the end of their range for longer than others can bridge,
    or while the rig answers without a new sample of it. It is also left out while its readings are frozen although others
    change or the legs must have moved. It is used again when it has been healthy for a while, and no IMU is shaken. An IMU that
    contradicted the others stays out.

    Args:
        silent: for how many cycles the rig has not answered.
        measurement: raw [rad/s, m/s^2, uT].
        motion: (6, 3), the reference: length, rate [m/s] and acceleration of each leg.
        events: dtype `EVENTS`.
    """
    calibrate_samples(p.gain, p.offset, measurement, s.sample)
    changed, total_noise = 0, 0.0
    for k in range(IMU_COUNT):
        s.unchanged[k] = 1
        most = 0.0
        for kind in range(2):
            for i in range(3):
                raw = measurement[kind, k, i]
                if np.isfinite(raw) and raw != s.raw[kind, k, i]:
                    s.unchanged[k] = 0
                    most = max(most, abs(raw - s.raw[kind, k, i]))
        changed += p.present[k] != 0 and most > _ROUNDING
        _update_noise(p, s, time.cycle, measurement, k)
        s.recent_noise[k] = max(min(s.noise[k], _MOST_REMEMBERED), p.remembering * s.recent_noise[k])
        total_noise += s.recent_noise[k] if s.used[k] != 0 else 0.0
    fastest = 0.0
    for k in range(rig.legs):
        fastest = max(fastest, abs(motion[k, 1]))
    # A rig that does not answer repeats every reading.
    s.moved_since = 0.0 if changed > 0 or silent > 0 else s.moved_since + (1 + time.missed) * rig.period * fastest
    must_change = changed > 0 or s.moved_since > _SURELY_MOVED_M
    for k in range(IMU_COUNT):
        if s.unchanged[k] == 0:
            s.frozen_for[k] = 0
        elif must_change:
            s.frozen_for[k] += 1
        cause = Cause.NONE.value
        value, limit = np.nan, np.nan
        if s.sample_age[k] == 0:
            s.stale_for[k] = 0
        elif silent == 0:
            # Answers are counted, not periods: in a pause of the bus or of the loop, the samples of all IMUs grow old.
            s.stale_for[k] += 1
        if s.stale_for[k] >= p.stale_cycles:
            cause, value, limit = Cause.IMU_STALE.value, float(s.stale_for[k]), float(p.stale_cycles)
        elif s.frozen_for[k] >= p.frozen_cycles:
            cause, value, limit = Cause.IMU_FROZEN.value, float(s.frozen_for[k]), float(p.frozen_cycles)
        noise = s.noise[k]
        of_others = (total_noise - (s.recent_noise[k] if s.used[k] != 0 else 0.0)) / rig.legs
        if cause == Cause.NONE and noise > max(1.0, _NOISIER * of_others):
            cause, value, limit = Cause.IMU_NOISY.value, noise, 1.0
        finite, reached = True, 0.0
        for kind in range(3):
            most = 0.0
            for i in range(3):
                raw = measurement[kind, k, i]
                s.raw[kind, k, i] = raw
                if kind < 2:
                    finite = finite and bool(np.isfinite(raw))
                    most = max(most, abs(raw))
            if kind < 2:
                s.shaking.clipped[kind, k] = most >= END_OF_RANGE * p.range[kind]
                reached = max(reached, most / p.range[kind])
        if not finite:
            cause, value, limit = Cause.IMU_NOT_FINITE.value, np.nan, np.nan
        elif not shaking.bridges(p.shaking, s.shaking, k, s.healthy[k], time.missed):
            cause, value, limit = Cause.IMU_OUT_OF_RANGE.value, reached, END_OF_RANGE
        if p.present[k] == 0:
            continue
        before, healthy = s.healthy[k], cause == Cause.NONE
        s.healthy_for[k] = s.healthy_for[k] + 1 + time.missed if healthy else 0
        s.healthy[k] = 1 if healthy and (before != 0 or s.healthy_for[k] > min(time.cycle, p.healthy_cycles)) else 0
        used = s.used[k]
        # A filter would begin with a force that is not gravity.
        waits = used == 0 and s.shaking.told != 0
        s.used[k] = s.healthy[k] if s.excluded[k] == 0 and not waits else 0
        if not healthy and (used != 0 or time.cycle == 0):
            report_event(events, cause, k, value, limit)
        elif s.used[k] > used and time.cycle > 0:
            report_event(events, Cause.IMU_BACK, k, np.nan, np.nan)
    shaking.tell_shaking(p.shaking, s.shaking, s.used, time.missed, events)


@kernel
def _update_noise(p: Record, s: Record, cycle: int, measurement: Array, k: int) -> None:
    """The noise of IMU `k` over its limit, RMS.

    White noise of variance v has second differences of variance 6 v, and motion adds little to them.
    """
    worst = 0.0
    for kind in range(2):
        total = 0.0
        for i in range(3):
            raw = measurement[kind, k, i]
            change = raw - 2.0 * s.earlier[0, kind, k, i] + s.earlier[1, kind, k, i]
            total += change * change
            s.earlier[1, kind, k, i] = s.earlier[0, kind, k, i]
            s.earlier[0, kind, k, i] = raw
        if cycle < 2 or not np.isfinite(total):
            total = 0.0
        s.variance[kind, k] += p.noise_smoothing * (total / 18.0 - s.variance[kind, k])
        worst = max(worst, s.variance[kind, k] / p.noise[kind] ** 2)
    s.noise[k] = np.sqrt(worst)
