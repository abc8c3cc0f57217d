"""The fault filter: what all readings say together about the error of the pose and the faults of the sensors.

The loop has a pose, whichever fusion found it. The truth is off by a small error m of the motion (18, as in
`whole_mechanism.readings`), and every axis of every sensor reads wrong by f (42). Both are estimated around the loop's pose, in
information form: Y x = y for x = (m, f), which begins with nothing known. Of a window of T seconds,

    carry    Y <- Phi^-T Y Phi^-1, y <- Phi^-T y + Y d      Phi: constant acceleration; d: how the loop's pose left the plan
    forget   Y <- Y - Z^T Z, y <- y - Z^T u                 white jerk, more if `parity` shows it; all fades with `MEMORY_S`
    update   Y <- Y + H^T R^-1 H, y <- y + H^T R^-1 z       z: mean reading less what the loop's pose predicts; H = (J, 1)

so that Y and y hold what the last half second says about f, and how much the pose depends on that. A window that a missed
period interrupts is dropped: Y and y are carried over it. In a gap drives hold their rates, and then catch up. So rates and
accelerations may have jumped, by as much as feedback has changed, and for some windows nothing is known of the jerk. No other
part of the loop uses this filter's estimate, so that no fault of its own can bend the pose. The work of a window is spread over
the cycles of the next one.
"""

import numpy as np

from controller.estimation.whole_mechanism.parameters import ripple_at
from controller.estimation.whole_mechanism.readings import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    MOTION_STATES,
    RATE,
    READINGS,
    READINGS_SCRATCH,
    VELOCITY,
    predict_readings,
)
from controller.inverse_kinematics import motion_of_legs
from controller.least_squares import factor_cholesky
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.dynamics.variables import IMU_COUNT
from plant.imu import ACCELEROMETER
from plant.mechanism import LEGS
from plant.pose import Array, rotate_by_vector

FAULTS = IMU_COUNT * READINGS
"""One for every axis of every sensor: angular velocity and specific force of IMU after IMU."""

UNKNOWNS = MOTION_STATES + FAULTS

_WINDOW_S = 0.01
MEMORY_S = 0.5
"""Time constant with which information fades [s]."""

_LEAST_SAMPLES = 2.5
"""An IMU counts in a window if it gives a sample at least every so many cycles: it may be half as fast as the loop."""

_UNEVEN = 0.2
"""A slower one counts if the mean place of its samples is so near the middle of the window, as a share of half of it."""

_STEADY_FEEDBACK = 0.5
"""Changes of the feedback up to this count as planned: the acceleration of a leg [m/s^2]."""

_TIMING_S = 3e-4
"""How far the times of samples may be off, as IMUs have clocks of their own [s]."""

_OF_UNPLANNED_CHANGE = 0.15
"""A mean force is off by this share of the change of the acceleration from one window to the next, as far as that was not
planned: the filter takes the acceleration to change evenly. For a platform that goes to and fro at 20 Hz this is twice the
error, and at 35 Hz the error.
"""

_BRIDGED_WINDOWS = 3
"""How much time between two windows may be lost by missed periods [windows]: a longer gap ends in a new beginning."""

_CATCHING_UP = 4
"""For so many windows after a missed period the drives may catch up: no plan has that jerk."""

_CATCHING_UP_STIFFNESS = 1e-6
"""How well the jerk is known then, as a share of what is known otherwise."""

_JUMPS = 5.0, 30.0
"""How far the platform's velocity and rate may jump over missed periods, as a multiple of the greatest change of a leg's
feedback [-, rad/m]: drives hold their rates, and then catch up by a step.
"""

_LEAST_JUMP = 1e-9
"""A smaller change of feedback is rounding [m/s]."""

_JERKS, _NEXT = 6, 3
_FAULT_STIFFNESS = 1e-4
"""How well the fault of an IMU that has been left out is known from the window before: the variance of a window's mean,
divided by the variance of the change between two windows.
"""

JOBS = _NEXT + IMU_COUNT
"""Jobs of a window: the readings, carrying, forgetting, and each IMU."""

PATH = record_dtype(
    position=(np.float64, 3),  # [m]
    rotation=(np.float64, (3, 3)),
    motion=(np.float64, (4, 3)),  # rows as in `readings`
)
"""Where the loop believed the platform to be in the middle of a window."""

PARAMETERS = record_dtype(
    active=np.int64,  # whether the filter runs
    window=np.int64,  # cycles
    duration=np.float64,  # of a window [s]
    keep=np.float64,  # what is left of the information after a window
    ripple=np.float64,  # error of a mean specific force for an acceleration of a leg: commands are steps
    variance=(np.float64, 2),  # of a sample's noise, angular velocity and specific force
    stiffness=(np.float64, 2),  # inverse variance of the jerk in a window, linear and angular
)
"""Constants of the filter."""

STATE = record_dtype(
    windows=np.int64,  # so many have been taken since the filter began
    job=np.int64,  # the next job of the last full window
    step=np.int64,  # cycles since that window was full
    collected=np.int64,  # cycles in the present window
    lost=np.int64,  # cycles since the last full window that are in no window
    unsettled=np.int64,  # windows to come in which drives still catch up with missed periods
    catching_up=np.int64,  # whether they did in the last full window
    between=np.float64,  # time between the middles of the last two full windows [s]
    follows=np.int64,  # whether the last full window directly follows the one before
    sum=(np.float64, (IMU_COUNT, READINGS)),  # of their samples
    trend_sum=(np.float64, (IMU_COUNT, 3)),  # of the forces, with weights from -1 to 1 over the window
    places=(np.int64, IMU_COUNT),  # of the samples around the middle of the window, sum, in half cycles
    feedback=(np.float64, LEGS),  # what feedback adds to the planned rate of each leg, sum [m/s]
    feedback_before=(np.float64, LEGS),  # its mean in the last full window [m/s]
    samples=(np.int64, IMU_COUNT),
    jumped=np.float64,  # greatest change of a leg's mean feedback since the window before [m/s]
    rate=(np.float64, LEGS),  # of the legs at the end of the last window
    acceleration=(np.float64, LEGS),  # and their acceleration
    next_path=PATH,  # in the middle of the present window
    arms=(np.float64, (LEGS, 3)),  # of the legs then, as their directions and lengths
    directions=(np.float64, (LEGS, 3)),
    lengths=(np.float64, LEGS),
    planned=(np.float64, (LEGS, 3)),  # lengths, rates and accelerations of the legs: sum over the window, at last the mean
    path=PATH,  # in the middle of the last full window
    mean=(np.float64, (IMU_COUNT, READINGS)),  # of that window's samples
    trend=(np.float64, (IMU_COUNT, 3)),  # of the forces about their mean, with those weights
    counted=(np.int64, IMU_COUNT),  # whether the IMU gave enough of them
    turning=np.float64,  # greatest angular acceleration of platform and legs that was planned for it [rad/s^2]
    rough=np.float64,  # standard deviation of a mean specific force by what is not known of the motion [m/s^2]
    unplanned_change=(np.float64, 2),  # by `parity`: mean squares of how much the acceleration that was not planned changes
    # between windows, where the platform's IMU is [m^2/s^4], and of the angular one [rad^2/s^4]
    weight=(np.float64, (IMU_COUNT, 2)),  # of the means, angular velocity and specific force
    information=(np.float64, (UNKNOWNS, UNKNOWNS)),
    vector=(np.float64, UNKNOWNS),
    turn=(np.float64, 3),  # from here on scratch
    shift=(np.float64, MOTION_STATES),
    predicted=(np.float64, (IMU_COUNT, READINGS)),
    jacobian=(np.float64, (IMU_COUNT, READINGS, MOTION_STATES)),
    root=(np.float64, (_JERKS, UNKNOWNS)),
    root_vector=(np.float64, _JERKS),
    factor=(np.float64, (_JERKS, _JERKS)),
    derivatives=(np.float64, (2, 6)),
    readings_scratch=READINGS_SCRATCH,
)
"""State of the filter."""


def fault_filter_parameters(fusion: FusionSettings, rate: float, active: bool) -> Record:
    """The constants of the filter (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    window = max(2, round(_WINDOW_S * rate))
    duration = window / rate
    noise = np.array([fusion.mechanism_gyroscope_noise, fusion.mechanism_accelerometer_noise])
    jerk = np.array([fusion.platform_jerk, fusion.platform_angular_jerk])
    return filled(
        PARAMETERS,
        active=active,
        window=window,
        duration=duration,
        keep=np.exp(-duration / MEMORY_S),
        ripple=ripple_at(rate),
        variance=noise**2 * rate / 2.0,
        stiffness=duration / jerk**2,
    )


@shared_kernel
def step_fault_filter(p: Record, s: Record, sensors: Record, imus: Record, pose: Record, legs: Array, commands: Array) -> bool:
    """Take the calibrated samples of a cycle from the IMUs that are healthy, and do the cycle's share of work.

    Args:
        p, s: dtypes `PARAMETERS` and `STATE`.
        sensors: dtype `SENSOR_GEOMETRY`.
        imus: samples and health; dtype `imu_health.STATE`.
        pose: of the loop; dtype `pose_estimator.STATE`.
        legs: (6, 3), length, rate and acceleration that each leg should have. The path takes its motion from them: noise in
            the estimated one would turn the directions of which nothing is known, and pretend to know something of them.
        commands: (6,), the rate of each leg that its drive was last told [m/s]: feedback moves the legs off the path.

    Returns:
        Whether a window has been taken with this cycle.
    """
    _collect(p, s, imus, pose, legs, commands)
    took = False
    if s.job < JOBS and s.windows > 0:
        s.step += 1
        due = min(JOBS, -(-JOBS * s.step // (p.window - 1)))
        while s.job < due:
            _do(p, s, sensors, imus.excluded, s.job)
            s.job += 1
        took = s.job == JOBS
    if s.collected == p.window:
        _close_window(p, s, imus.variance, imus.shaking, legs)
    return took


@kernel
def begin_anew(s: Record) -> None:
    """Forget all that was read."""
    s.windows = s.collected = s.lost = 0
    s.job = JOBS
    s.information[:] = 0.0
    s.vector[:] = 0.0


@kernel
def bridge_gap(p: Record, s: Record, missed: int) -> bool:
    """Leave out the window under way, as periods were missed; returns whether what was read before them still counts."""
    s.lost = s.lost + s.collected + missed if s.windows > 0 else missed
    s.collected = 0
    s.unsettled = _CATCHING_UP
    return bool(s.lost <= _BRIDGED_WINDOWS * p.window)


@kernel
def _collect(p: Record, s: Record, imus: Record, pose: Record, legs: Array, commands: Array) -> None:
    if s.collected == 0:
        s.sum[:] = 0.0
        s.trend_sum[:] = 0.0
        s.samples[:] = 0
        s.places[:] = 0
        s.feedback[:] = 0.0
        s.planned[:] = 0.0
    s.collected += 1
    for k in range(LEGS):
        s.feedback[k] += commands[k] - legs[k, 1]
        for i in range(3):
            s.planned[k, i] += legs[k, i]
    for k in range(IMU_COUNT):
        clipped = imus.shaking.clipped[0, k] != 0 or imus.shaking.clipped[1, k] != 0
        if imus.healthy[k] == 0 or imus.sample_age[k] != 0 or clipped:
            continue
        place = 2 * s.collected - p.window - 1
        s.samples[k] += 1
        s.places[k] += place
        for i in range(3):
            s.sum[k, i] += imus.sample[0, k, i]
            s.sum[k, 3 + i] += imus.sample[1, k, i]
            s.trend_sum[k, i] += place * imus.sample[1, k, i] / p.window
    if s.collected == (p.window + 1) // 2:
        at = s.next_path
        at.position[:] = pose.position
        at.rotation[:] = pose.rotation
        s.arms[:] = pose.arms
        s.directions[:] = pose.directions
        s.lengths[:] = pose.lengths


@kernel
def _find_motion(p: Record, s: Record, legs: Array) -> None:
    """Write the mean motion of the full window, as the readings are means. Where a plan that follows points jerks to and fro,
    the acceleration of its middle is off by 0.1 m/s^2, and the mean of a few accelerations by half of that. So the mean
    acceleration is the change of the rate since the window before, if that is known. Drives hold a command for a cycle, so a
    reading tells of the cycle before it, and this is the change over just these cycles.
    """
    follows = s.windows > 0 and s.lost == 0
    for k in range(LEGS):
        for i in range(3):
            s.planned[k, i] /= s.collected
        if follows:
            s.planned[k, 2] = (legs[k, 1] - s.rate[k]) / p.duration
        s.rate[k] = legs[k, 1]
    motion_of_legs(s.arms, s.directions, s.lengths, LEGS, s.planned, s.factor, s.derivatives)
    motion = s.next_path.motion
    for i in range(3):
        motion[VELOCITY, i] = s.derivatives[0, i]
        motion[RATE, i] = s.derivatives[0, 3 + i]
        motion[ACCELERATION, i] = s.derivatives[1, i]
        motion[ANGULAR_ACCELERATION, i] = s.derivatives[1, 3 + i]


@kernel
def _close_window(p: Record, s: Record, variance: Array, shaking: Record, legs: Array) -> None:
    """Keep the full window for its jobs, and find how far the loop's pose has left its path."""
    _find_motion(p, s, legs)
    fastest, change, turning, jumped = 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        turning += s.next_path.motion[ANGULAR_ACCELERATION, i] ** 2
    turning = np.sqrt(turning)
    for k in range(LEGS):
        fastest = max(fastest, abs(s.planned[k, 2]))
        turning = max(turning, abs(legs[k, 2]) / legs[k, 0])
        change = max(change, abs(legs[k, 2] - s.acceleration[k]))
        s.acceleration[k] = legs[k, 2]
        feedback = s.feedback[k] / s.collected
        jumped = max(jumped, abs(feedback - s.feedback_before[k]))
        s.feedback_before[k] = feedback
    s.turning = turning
    s.jumped = jumped
    corrected = max(jumped / p.duration - _STEADY_FEEDBACK, 0.0)
    s.rough = np.sqrt((p.ripple * fastest) ** 2 + (_TIMING_S / p.duration * change) ** 2)
    for k in range(IMU_COUNT):
        # Samples from one side of the window would not be its mean.
        even = abs(s.places[k]) <= _UNEVEN * s.samples[k] * s.collected
        s.counted[k] = _LEAST_SAMPLES * s.samples[k] >= s.collected or (s.samples[k] > 1 and even)
        if s.counted[k] == 0:
            continue
        unknown = s.rough**2 + corrected**2 + _OF_UNPLANNED_CHANGE**2 * s.unplanned_change[0]
        shaken = shaking.excess[ACCELEROMETER, k] + shaking.hidden[k] + shaking.mean[k]
        # What shakes an IMU beyond its noise makes its mean as uncertain.
        s.weight[k, 0] = s.samples[k] / (max(p.variance[0], variance[0, k]) + p.window * (_TIMING_S * turning) ** 2)
        s.weight[k, 1] = s.samples[k] / (max(p.variance[1], variance[1, k]) + p.window * (unknown + shaken))
        for i in range(READINGS):
            s.mean[k, i] = s.sum[k, i] / s.samples[k]
        place = s.places[k] / p.window
        for i in range(3):
            s.trend[k, i] = (s.trend_sum[k, i] - place * s.mean[k, 3 + i]) / s.samples[k]
    s.follows = s.windows > 0 and s.lost == 0
    s.between = p.duration * (1.0 + s.lost / p.window if s.windows > 0 else 1.0)
    s.lost = 0
    s.catching_up = s.unsettled > 0
    s.unsettled = max(s.unsettled - 1, 0)
    if s.windows > 0:
        _find_shift(s.between, s.path, s.next_path, s.turn, s.shift)
    s.path.position[:] = s.next_path.position
    s.path.rotation[:] = s.next_path.rotation
    s.path.motion[:] = s.next_path.motion
    s.windows += 1
    s.collected = s.job = s.step = 0


@kernel
def _find_shift(t: float, old: Record, new: Record, turn: Array, shift: Array) -> None:
    """Write by how much the old path, carried on as planned for a time `t`, is ahead of the new one (18,), and its turn (3,).

    Motion is as planned in both, so that it has no shift.
    """
    x, y, half = old.motion, new.motion, 0.5 * t
    shift[:] = 0.0
    for i in range(3):
        turn[i] = half * (x[RATE, i] + y[RATE, i])
        shift[i] = old.position[i] + half * (x[VELOCITY, i] + y[VELOCITY, i]) - new.position[i]
    rotate_by_vector(old.rotation, turn)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        angle = 0.0
        for m in range(3):
            angle += 0.5 * (old.rotation[k, m] * new.rotation[j, m] - old.rotation[j, m] * new.rotation[k, m])
        shift[3 + i] = angle


@kernel
def _do(p: Record, s: Record, sensors: Record, excluded: Array, job: int) -> None:
    if job == 0:
        at = s.path
        predict_readings(sensors, at.position, at.rotation, at.motion, True, s.predicted, s.jacobian, s.readings_scratch)
    elif job == 1:
        _carry(s.between, s.turn, s.shift, s.information, s.vector)
    elif job == 2:
        _forget(p, s, s.information, s.vector)
    else:
        k = job - _NEXT
        _update(p, s, k, excluded[k] != 0)


@kernel
def _carry(t: float, turn: Array, shift: Array, information: Array, vector: Array) -> None:
    """Y <- Phi^-T Y Phi^-1 and y <- Phi^-T y + Y d; the small turn's inverse is I - skew(turn)."""
    a, half = information, 0.5 * t * t
    t0, t1, t2 = turn[0], turn[1], turn[2]
    for j in range(UNKNOWNS):
        x0, x1, x2 = a[3, j], a[4, j], a[5, j]
        a[3, j] += t1 * x2 - t2 * x1
        a[4, j] += t2 * x0 - t0 * x2
        a[5, j] += t0 * x1 - t1 * x0
    for i in range(6):
        place, speed, change = a[i], a[6 + i], a[12 + i]
        for j in range(UNKNOWNS):
            change[j] += half * place[j] - t * speed[j]
            speed[j] -= t * place[j]
    for j in range(UNKNOWNS):
        row = a[j]
        x0, x1, x2 = row[3], row[4], row[5]
        row[3] += t1 * x2 - t2 * x1
        row[4] += t2 * x0 - t0 * x2
        row[5] += t0 * x1 - t1 * x0
        for i in range(6):
            row[12 + i] += half * row[i] - t * row[6 + i]
            row[6 + i] -= t * row[i]
        # Rounding must not make the matrix unsymmetric.
        for i in range(j):
            a[i, j] = row[i]
    x0, x1, x2 = vector[3], vector[4], vector[5]
    vector[3] += t1 * x2 - t2 * x1
    vector[4] += t2 * x0 - t0 * x2
    vector[5] += t0 * x1 - t1 * x0
    for i in range(6):
        vector[12 + i] += half * vector[i] - t * vector[6 + i]
        vector[6 + i] -= t * vector[i]
    for i in range(MOTION_STATES):
        ahead, row = shift[i], a[i]
        for j in range(UNKNOWNS):
            vector[j] += ahead * row[j]


@kernel
def _forget(p: Record, s: Record, information: Array, vector: Array) -> None:
    """Let jerk, constant between two windows and different each time, take away information, and let all of it fade."""
    t, a, z, u = s.between, information, s.root, s.root_vector
    by_place, by_speed = t * t * t / 6.0, 0.5 * t * t
    for n in range(_JERKS):
        row, place, speed, change = z[n], a[n], a[6 + n], a[12 + n]
        for j in range(UNKNOWNS):
            row[j] = by_place * place[j] + by_speed * speed[j] + t * change[j]
        u[n] = by_place * vector[n] + by_speed * vector[6 + n] + t * vector[12 + n]
    for n in range(_JERKS):
        for m in range(_JERKS):
            s.factor[n, m] = by_place * z[n, m] + by_speed * z[n, 6 + m] + t * z[n, 12 + m]
        stiffness = p.stiffness[n // 3]
        if s.catching_up != 0:
            stiffness *= _CATCHING_UP_STIFFNESS
        s.factor[n, n] += stiffness / (1.0 + stiffness * s.unplanned_change[n // 3] / (p.duration * p.duration))
    _take_away(s, information, vector, p.keep ** (t / p.duration))
    if s.follows == 0 and s.jumped > _LEAST_JUMP:
        for first, per in ((6, 1.0), (12, p.duration)):
            _take_rows(s, first, information, vector)
            for n in range(_JERKS):
                s.factor[n, n] += (per / (_JUMPS[n // 3] * s.jumped)) ** 2
            _take_away(s, information, vector, 1.0)


@kernel
def _forget_fault(p: Record, s: Record, k: int, information: Array, vector: Array) -> None:
    """Let what IMU `k` reads wrong change freely between windows."""
    _take_rows(s, MOTION_STATES + READINGS * k, information, vector)
    for n in range(READINGS):
        s.factor[n, n] += _FAULT_STIFFNESS * s.weight[k, n // 3]
    _take_away(s, information, vector, 1.0)


@kernel
def _take_rows(s: Record, first: int, information: Array, vector: Array) -> None:
    """Prepare to take away what is known of six unknowns from `first` on."""
    for n in range(_JERKS):
        s.root[n] = information[first + n]
        s.root_vector[n] = vector[first + n]
        for m in range(_JERKS):
            s.factor[n, m] = s.root[n, first + m]


@kernel
def _take_away(s: Record, information: Array, vector: Array, keep: float) -> None:
    """Y <- keep (Y - K^T M^-1 K) and y <- keep (y - K^T M^-1 u), for K, u and M in `root`, `root_vector` and `factor`."""
    a, z, u = information, s.root, s.root_vector
    if not factor_cholesky(s.factor):
        # Rounding has spoilt it: nothing is known any more.
        a[:] = 0.0
        vector[:] = 0.0
        return
    for n in range(_JERKS):
        row = z[n]
        for m in range(n):
            share, other = s.factor[n, m], z[m]
            u[n] -= share * u[m]
            for j in range(UNKNOWNS):
                row[j] -= share * other[j]
        inverse = 1.0 / s.factor[n, n]
        u[n] *= inverse
        for j in range(UNKNOWNS):
            row[j] *= inverse
    z0, z1, z2, z3, z4, z5 = z[0], z[1], z[2], z[3], z[4], z[5]
    for i in range(UNKNOWNS):
        row = a[i]
        x0, x1, x2, x3, x4, x5 = z0[i], z1[i], z2[i], z3[i], z4[i], z5[i]
        for j in range(UNKNOWNS):
            row[j] = keep * (row[j] - (x0 * z0[j] + x1 * z1[j] + x2 * z2[j] + x3 * z3[j] + x4 * z4[j] + x5 * z5[j]))
        vector[i] = keep * (vector[i] - (x0 * u[0] + x1 * u[1] + x2 * u[2] + x3 * u[3] + x4 * u[4] + x5 * u[5]))


@kernel
def _update(p: Record, s: Record, k: int, excluded: bool) -> None:
    """Take what IMU `k` has read on average; what one that has been left out reads wrong may be something else each time."""
    if excluded:
        _forget_fault(p, s, k, s.information, s.vector)
    if s.counted[k] == 0:
        return
    a, y, weight, h = s.information, s.vector, s.weight[k], s.jacobian[k]
    gyroscope, accelerometer = weight[0], weight[1]
    for i in range(MOTION_STATES):
        row = a[i]
        x0, x1, x2 = gyroscope * h[0, i], gyroscope * h[1, i], gyroscope * h[2, i]
        x3, x4, x5 = accelerometer * h[3, i], accelerometer * h[4, i], accelerometer * h[5, i]
        for j in range(MOTION_STATES):
            row[j] += x0 * h[0, j] + x1 * h[1, j] + x2 * h[2, j] + x3 * h[3, j] + x4 * h[4, j] + x5 * h[5, j]
    for m in range(READINGS):
        of_one, fault = weight[m // 3], MOTION_STATES + READINGS * k + m
        off = of_one * (s.mean[k, m] - s.predicted[k, m])
        for i in range(MOTION_STATES):
            share = of_one * h[m, i]
            a[i, fault] += share
            a[fault, i] += share
            y[i] += off * h[m, i]
        a[fault, fault] += of_one
        y[fault] += off
