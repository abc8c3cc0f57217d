"""Safety: the states of a run, what is watched in every cycle, and how each cause ends or degrades it.

    idle --checks pass, drives are asked for--> armed --all drives are ready--> running
    running --> stopping --> stopped            a controlled stop, within the limits of the actuators
    any --> fault                               a quick stop without the estimate, or the brakes at once

Nothing is commanded before `RUNNING`. Every cause is told as an event: what, which leg or IMU, its value and the limit.
"""

from dataclasses import dataclass

import numpy as np

from controller.estimation.imu_monitor import MONITOR, contradiction, forget
from controller.planning.segments import plan_stop
from controller.settings import SafetySettings
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS, six_rows
from plant.mechanism.limits import Limits

IDLE, ARMED, RUNNING, STOPPING, STOPPED, FAULT = range(6)
MODES = ("idle", "armed", "running", "stopping", "stopped", "fault")

BRAKED, ENABLED, QUICK_STOP = range(3)
"""What is asked of the drives: to hold on their brakes; to follow the commands; to stop by themselves and then to hold."""

FOLLOWING, READY, OFF, QUICK_STOPPING, FAULTY = range(5)
"""What a drive says of itself: it follows the commands, as one without a state of its own always does; it holds, and can be
asked to follow; it has no power or is not ready; it stops by itself; it has a fault."""

GO_ON, STOP, STOP_QUICKLY, BRAKE_AT_ONCE = range(4)
REACTIONS = ("goes on", "controlled stop", "quick stop", "brakes at once")


_WORST = ", the worst is IMU {}"


@dataclass(frozen=True)
class Cause:
    """Why something happened: in words, with the number of a leg or an IMU; the reaction; the unit of its value and limit."""

    text: str
    reaction: int
    unit: str = ""


(
    NO_CAUSE, END_OF_MOTION, ASKED_TO_STOP, MISSED_PERIODS, SUPERVISOR_GONE, EMERGENCY_STOP, CLOCK_FAILED, RIG_FAILED,
    IMU_STALE, IMU_FROZEN, IMU_NOT_FINITE, IMU_OUT_OF_RANGE, IMU_NOISY, IMU_DISAGREES, IMU_BACK, IMUS_LOST, IMUS_DISAGREE,
    POSE_LOST, NOT_FINITE, IMPLAUSIBLE, ILL_CONDITIONED, BEYOND_STROKE, TOO_FAST, FOLLOWING_ERROR, SATURATED,
    ANSWER_LATE, BUS_LOST, DRIVE_FAULT, DRIVE_OFF, DRIVE_DEVIATES,
    ARMED_NOW, NO_SENSORS, NO_AGREEMENT, NO_WORKSPACE, NO_DRIVES, TARGET_LOST, TARGET_JUMPS, TARGET_NOT_FINITE,
) = range(38)  # fmt: skip

CAUSES = (
    Cause("none", GO_ON),
    Cause("end of the motion", STOP),
    Cause("asked for", STOP),
    Cause("too many periods missed in a row", STOP, "periods"),
    Cause("the supervising process has gone", STOP),
    Cause("emergency stop", STOP_QUICKLY),
    Cause("this machine's clock refuses to wake the loop", BRAKE_AT_ONCE),
    Cause("the rig reports failure", BRAKE_AT_ONCE),
    Cause("IMU {} is left out: its samples are stale", GO_ON, "cycles"),
    Cause("IMU {} is left out: it is frozen", GO_ON, "cycles"),
    Cause("IMU {} is left out: it gives what is not finite", GO_ON),
    Cause("IMU {} is left out: it is at the end of its range", GO_ON, "of the range"),
    Cause("IMU {} is left out: it is noisy", GO_ON, "of the limit"),
    Cause("IMU {} is left out: it disagrees with the others", GO_ON, "rad"),
    Cause("IMU {} is used again", GO_ON),
    Cause("too many IMUs are lost", STOP, "IMUs"),
    Cause(f"the IMUs contradict each other{_WORST}", STOP, "rad"),
    Cause("the IMUs that can be used no longer determine the pose", STOP_QUICKLY),
    Cause("an estimate or a command is no longer finite", STOP_QUICKLY),
    Cause(
        "the estimated pose needs leg {} far outside its stroke: the IMUs' errors are larger than the filters assume (raw ones "
        "need a calibration)",
        STOP_QUICKLY,
        "m",
    ),
    Cause("the pose is badly determined", STOP),
    Cause("leg {} is beyond its stroke", STOP, "m"),
    Cause("leg {} is too fast", STOP, "m/s"),
    Cause("leg {} does not follow its reference", STOP, "m"),
    Cause("the command of leg {} stays at its limit", STOP, "s"),
    Cause("an exchange with the rig was late or its answer was refused", GO_ON),
    Cause("the bus is lost: the rig does not answer", STOP_QUICKLY, "cycles"),
    Cause("drive {} reports a fault", STOP_QUICKLY),
    Cause("drive {} has left its operation", STOP_QUICKLY),
    Cause("drive {} does not do what it is told", BRAKE_AT_ONCE, "m/s"),
    Cause("armed", GO_ON),
    Cause("not armed: IMU {} is not plausible: a raw one needs a calibration, else check its place", STOP, "rad"),
    Cause("not armed: leg {} is not where the target begins", STOP, "m"),
    Cause("not armed: leg {} is outside its stroke", STOP, "m"),
    Cause("not armed: drive {} is not ready", STOP),
    Cause("the target's stream has stopped", STOP, "s"),
    Cause("the target jumps for leg {}", STOP, "m"),
    Cause("the target is not finite, or its quaternion is none", STOP),
)
"""By number. Causes of `GO_ON` are told and end nothing."""

EVENT_SLOTS = 8

EVENTS = (
    ("event_count", np.int64),
    ("event_cause", np.int32, EVENT_SLOTS),
    ("event_index", np.int32, EVENT_SLOTS),
    ("event_value", np.float64, EVENT_SLOTS),
    ("event_limit", np.float64, EVENT_SLOTS),
)
"""Fields of what happened in a cycle."""


def describe_end(state: Record) -> str:
    """Why a run has ended, in words."""
    safety = state["safety"]
    values = int(safety["end_index"]), float(safety["end_value"]), float(safety["end_limit"])
    before = int(safety["stopped_for"])
    first = f"{CAUSES[before].text.replace(_WORST, '').replace(' {}', '')}, and then: " if before != NO_CAUSE else ""
    return first + describe_event(int(state["stopping"]), *values)


def describe_obstacle(state: Record) -> str:
    """What is in the way of arming, in words; "" if nothing is."""
    safety = state["safety"]
    cause = int(safety["obstacle"])
    values = int(safety["obstacle_index"]), float(safety["obstacle_value"]), float(safety["obstacle_limit"])
    return describe_event(cause, *values) if cause != NO_CAUSE else ""


def describe_event(cause: int, index: int, value: float, limit: float) -> str:
    """An event in words; the worst IMU is not named where the index, -1, tells none."""
    known = CAUSES[cause]
    text = (known.text if index >= 0 else known.text.replace(_WORST, "")).format(index)
    if np.isnan(value):
        return text
    unit = f" {known.unit}" if known.unit else ""
    return f"{text} ({value:.4g}{unit})" if np.isnan(limit) else f"{text} ({value:.4g}{unit}, the limit is {limit:.4g}{unit})"


SAFETY_PARAMETERS = np.dtype(
    [
        ("arm", np.int64),
        ("most_lost_imus", np.int64),
        ("watch_imus", np.int64),
        ("noise", np.float64, 2),
        ("noise_smoothing", np.float64),
        ("disagreement", np.float64),
        ("smoothing", np.float64),
        ("lasting", np.float64),
        ("conditioning", np.float64),
        ("lengths", np.float64, (LEGS, 2)),
        ("speed", np.float64),
        ("following", np.float64),
        ("saturation", np.float64),
        ("drive_deviation", np.float64),
        ("patience", np.float64),
        ("bus_cycles", np.int64),
        ("stale_cycles", np.int64),
        ("arming_distance", np.float64),
        ("arming_cycles", np.int64),
    ],
    align=True,
)
"""Constants of the watch; durations that are compared with sums of periods are in s."""

SAFETY_STATE = np.dtype(
    [
        ("mode", np.int64),
        ("request", np.int64),
        ("waited", np.int64),
        ("sample_age", np.int64, IMU_COUNT),
        ("drive", np.int64, LEGS),
        ("silent", np.int64),
        ("unanswered", np.int64),
        ("excluded", np.int64, IMU_COUNT),
        ("before", np.float64, (2, 2, IMU_COUNT, 3)),
        ("variance", np.float64, (2, IMU_COUNT)),
        ("noise", np.float64, IMU_COUNT),
        ("monitor", MONITOR),
        ("contradicted", np.float64),
        ("astray", np.float64, LEGS),
        ("deviating", np.float64, LEGS),
        ("saturated", np.float64, LEGS),
        ("speed", np.float64, LEGS),
        ("end_index", np.int64),
        ("end_value", np.float64),
        ("end_limit", np.float64),
        ("stopped_for", np.int64),
        ("obstacle", np.int64),
        ("obstacle_index", np.int64),
        ("obstacle_value", np.float64),
        ("obstacle_limit", np.float64),
        *EVENTS,
    ],
    align=True,
)
"""State of the watch.

`mode` and `request` are as above; arming `waited` for so many cycles beyond the hold. What the rig has said before the
cycle: how many cycles old each IMU's sample is, the state of each drive, and for how many cycles it has been `silent`, and
how many more are `unanswered` than answered. IMUs that disagreed are `excluded` for good; the last two raw samples `before`
tell the `variance` of each sensor, low-passed, and of that the `noise` of each IMU over its limit. For how long [s] the
IMUs have contradicted each other, each leg has been `astray` from its reference, each drive `deviating` from its command,
each command `saturated`; the legs' estimated `speed` [m/s]; what made the run end, and for what cause it was stopping
before a fault; and what is in the way of arming.
"""

_CONTRADICTION_S = 0.03
"""Time constant of the low-pass on an IMU's contradiction, and how long one must last [s]."""

_LARGEST_SHARE, _LEAST_LOOKS, _LEAST_CYCLES = 0.25, 3, 10
"""At low rates: the largest share that one look has in the low-pass, for how many looks a contradiction must last, and for how
many cycles any other deviation."""

_SLOW_HZ, _SHAKEN_HZ = 300.0, 400.0
"""Below these rates the filters' directions are less exact, and motion shows in second differences."""

_NOISE_S = 0.02
"""Time constant over which the noise of an IMU is averaged [s]."""

_STALE_S = 0.01
"""How old a sample may be while others are new [s]."""

_CLEARER = 1.3
"""How much more of the residuals the IMU that is named must explain than any other."""

REACTION = np.array([cause.reaction for cause in CAUSES])
"""Of each cause."""


def safety_parameters(settings: SafetySettings, rate: float, limits: Limits, arm: bool) -> Record:
    """Constants of the watch, at so many cycles per second [Hz]; the drives are asked for only if it is to `arm`."""
    parameters: Record = np.zeros((), SAFETY_PARAMETERS)
    slow = _SLOW_HZ / rate
    shaken = _SHAKEN_HZ / rate
    values = {
        "arm": arm,
        "most_lost_imus": settings.most_lost_imus,
        "watch_imus": settings.watch_imus,
        "noise": np.array([settings.gyroscope_noise, settings.accelerometer_noise]) * max(1.0, shaken**2),
        "noise_smoothing": min(0.05, 1.0 / (rate * _NOISE_S)),
        "disagreement": settings.disagreement * max(1.0, slow),
        # Each IMU's turn comes in every seventh cycle.
        "smoothing": min(IMU_COUNT / (rate * _CONTRADICTION_S), _LARGEST_SHARE),
        "lasting": max(_CONTRADICTION_S, _LEAST_LOOKS * IMU_COUNT / rate),
        "conditioning": settings.conditioning,
        "lengths": six_rows(limits.stroke + settings.stroke_margin * np.array([-1.0, 1.0])),
        "speed": settings.velocity_margin * limits.velocity,
        "following": settings.following,
        "saturation": settings.saturation,
        "drive_deviation": settings.drive_deviation,
        "patience": max(settings.patience, _LEAST_CYCLES / rate),
        "bus_cycles": max(3, round(settings.bus_patience * rate)),
        "stale_cycles": max(3, round(_STALE_S * rate)),
        "arming_distance": settings.arming_distance,
        "arming_cycles": np.ceil(settings.arming_time * rate),
    }
    for name, value in values.items():
        parameters[name] = value
    return parameters


def watch_nothing(parameters: Record) -> None:
    """Let the cycle with these parameters arm and go on whatever it finds, for motions that do not rely on the estimate."""
    parameters["plausible_lengths"] = -np.inf, np.inf
    safety = parameters["safety"]
    safety["most_lost_imus"], safety["watch_imus"], safety["conditioning"] = IMU_COUNT, 0, 0.0
    safety["lengths"] = -np.inf, np.inf
    for name in ("noise", "speed", "following", "saturation", "drive_deviation", "arming_distance"):
        safety[name] = np.inf


@kernel
def tell(state: Record, cause: int, index: int, value: float, limit: float) -> None:
    """Take note of an event; what is more than there are slots for in a cycle is counted."""
    e = state[()].safety
    if e.event_count < EVENT_SLOTS:
        e.event_cause[e.event_count] = cause
        e.event_index[e.event_count] = index
        e.event_value[e.event_count] = value
        e.event_limit[e.event_count] = limit
    e.event_count += 1


@kernel
def react(parameters: Record, state: Record, cause: int, index: int, value: float, limit: float) -> None:
    """React to a cause as it is said in `CAUSES`, and tell it; of stops the first counts, of faults, too, and a fault more."""
    s = state[()]
    reaction = REACTION[cause]
    if s.safety.mode == FAULT or (reaction == STOP and s.stopping != 0):
        return
    tell(state, cause, index, value, limit)
    if reaction != GO_ON:
        s.safety.end_index, s.safety.end_value, s.safety.end_limit = index, value, limit
    if reaction == STOP:
        _begin_stop(parameters, state, cause)
    elif reaction != GO_ON:
        _fail(parameters, state, cause)


@kernel
def begin_stop(parameters: Record, state: Record, cause: int) -> None:
    """Between cycles: react to a cause that has neither a value nor a limit."""
    react(parameters, state, cause, -1, np.nan, np.nan)


@kernel
def _begin_stop(parameters: Record, state: Record, cause: int) -> None:
    """Leave the motion for the fastest stop within the limits, leg by leg; before the motion there is nothing to stop. In
    periods that were missed the drives went on as they were last told, and the stop begins from where that has led.
    """
    p, s = parameters[()], state[()]
    s.stopping = cause
    s.stop_cycle = s.stopped_cycle = s.cycle
    if s.safety.mode == RUNNING:
        if s.missed > 0:
            for k in range(p.legs):
                speed = min(max(s.command[k], -p.velocity_limit), p.velocity_limit)
                s.reference[k, 0] += s.missed * p.period * speed
                s.reference[k, 1], s.reference[k, 2] = speed, 0.0
        duration = plan_stop(s.reference, p.acceleration_limit, p.jerk_limit, s.stop_segments)
        s.stopped_cycle += int(np.ceil(duration / p.period)) + p.settling_cycles
        s.reference_index[:] = 0
        s.prepared = 0
    else:
        s.safety.request = BRAKED
    s.safety.mode = STOPPING


@kernel
def _fail(parameters: Record, state: Record, cause: int) -> None:
    """End without the estimate: the drives come to rest by themselves, or the brakes close at once."""
    p, s = parameters[()], state[()]
    moving = s.safety.request == ENABLED
    s.safety.stopped_for = s.stopping
    s.stopping = cause
    s.stop_cycle = s.stopped_cycle = s.cycle
    s.safety.mode = FAULT
    s.safety.request = BRAKED
    if REACTION[cause] == STOP_QUICKLY and moving:
        s.safety.request = QUICK_STOP
        fastest = 0.0
        for k in range(p.legs):
            if not np.isfinite(s.command[k]):
                s.command[k] = 0.0
            fastest = max(fastest, abs(s.command[k]))
        s.stopped_cycle += int(np.ceil(fastest / (p.acceleration_limit * p.period)))
    else:
        s.command[:] = 0.0
    if moving:
        s.stopped_cycle += p.settling_cycles


@kernel
def coast(parameters: Record, state: Record) -> None:
    """A cycle after a fault: every command comes to rest at the limit of acceleration, whatever is measured."""
    p, s = parameters[()], state[()]
    step = p.acceleration_limit * p.period * (1 + s.missed)
    for k in range(p.legs):
        s.command[k] -= min(max(s.command[k], -step), step)
    s.cycle += 1


@kernel
def has_stopped(state: Record) -> bool:
    """Whether a stop or a fault has come to its end, so that the brakes may hold; a stop is `STOPPED` then."""
    s = state[()]
    ended = s.stopping != 0 and s.cycle >= s.stopped_cycle
    if ended:
        s.safety.request = BRAKED
        if s.safety.mode == STOPPING:
            s.safety.mode = STOPPED
    return bool(ended)


@kernel
def hear(parameters: Record, state: Record, sample_age: Record, drive: Record, silent: int) -> None:
    """Before a cycle: take what the rig has said, and react to a bus that is lost and drives that do not do their duty."""
    p, s = parameters[()], state[()]
    w = s.safety
    for k in range(IMU_COUNT):
        w.sample_age[k] = sample_age[k]
    for k in range(p.legs):
        w.drive[k] = drive[k]
    if silent > 0 and w.silent == 0:
        tell(state, ANSWER_LATE, -1, np.nan, np.nan)
    w.silent = silent
    w.unanswered = max(w.unanswered + (1 if silent > 0 else -1), 0)
    if w.request != ENABLED:
        return
    if silent >= p.safety.bus_cycles or w.unanswered >= 2 * p.safety.bus_cycles:
        react(parameters, state, BUS_LOST, -1, max(silent, w.unanswered), p.safety.bus_cycles)
    for k in range(p.legs):
        if drive[k] == FAULTY:
            react(parameters, state, DRIVE_FAULT, k, np.nan, np.nan)
        elif w.mode != ARMED and drive[k] != FOLLOWING:
            react(parameters, state, DRIVE_OFF, k, np.nan, np.nan)


@kernel
def watch_imus(parameters: Record, state: Record) -> None:
    """After the refinement: leave out an IMU that contradicts the others and can be named, once; else stop. Three legs and the
    roll of a planar mechanism are one measurement more than its pose needs: they tell that one is wrong, not which.
    """
    p, s = parameters[()], state[()]
    w, m = s.safety, s.safety.monitor
    worst = 0
    for k in range(1, IMU_COUNT):
        if m.explained[k] > m.explained[worst]:
            worst = k
    off = contradiction(m, worst)
    w.contradicted = w.contradicted + p.period if off > p.safety.disagreement else 0.0
    if w.contradicted < p.safety.lasting or w.mode != RUNNING:
        return
    second = left = 0.0
    excluded = 0
    for k in range(IMU_COUNT):
        excluded += w.excluded[k]
        left += m.squares[k]
        if k != worst:
            second = max(second, m.explained[k])
    # Without the one that is to blame, the others must agree.
    disagree = left - m.explained[worst] > p.leg_weight * p.safety.disagreement**2
    if disagree or excluded > 0 or m.explained[worst] < _CLEARER * second or p.safety.most_lost_imus == 0:
        react(parameters, state, IMUS_DISAGREE, worst if p.planar == 0 else -1, off, p.safety.disagreement)
        return
    w.excluded[worst] = 1
    w.contradicted = 0.0
    for k in range(IMU_COUNT):
        forget(m, k)
    tell(state, IMU_DISAGREES, worst, off, p.safety.disagreement)


@kernel
def arm(parameters: Record, state: Record) -> None:
    """Before the commands: from idle to armed, when the sensors are plausible, the pose is in the workspace and where the
    target begins, and the drives are there; from armed to running, when all drives follow.
    """
    p, s = parameters[()], state[()]
    w = s.safety
    if s.cycle < p.hold_cycles or w.mode > ARMED:
        return
    if w.mode == IDLE:
        _look_for_obstacle(parameters, state)
        if w.obstacle == NO_CAUSE and p.safety.arm != 0:
            w.mode, w.request = ARMED, ENABLED
            tell(state, ARMED_NOW, -1, np.nan, np.nan)
    if w.mode == ARMED:
        _look_for_obstacle(parameters, state)
        if w.obstacle != NO_CAUSE:
            # The drives are enabled already: this does not wait.
            react(parameters, state, w.obstacle, w.obstacle_index, w.obstacle_value, w.obstacle_limit)
            return
        for k in range(p.legs):
            if w.drive[k] != FOLLOWING:
                _obstruct(state, NO_DRIVES, k, np.nan, np.nan)
        if w.obstacle == NO_CAUSE:
            w.mode = RUNNING
            w.waited = s.cycle - p.hold_cycles
            return
    if p.safety.arm == 0:
        return
    w.waited = s.cycle + 1 - p.hold_cycles
    if w.waited > p.safety.arming_cycles:
        react(parameters, state, w.obstacle, w.obstacle_index, w.obstacle_value, w.obstacle_limit)


@kernel
def is_held(parameters: Record, state: Record, cause: int) -> bool:
    """Whether a cause is no fault but in the way of arming: nothing has been armed, and there is still time."""
    p, s = parameters[()], state[()]
    w = s.safety
    if w.mode != IDLE:
        return False
    w.obstacle, w.obstacle_index, w.obstacle_value, w.obstacle_limit = cause, -1, np.nan, np.nan
    if s.cycle >= p.hold_cycles and p.safety.arm != 0:
        w.waited = s.cycle + 1 - p.hold_cycles
    return bool(w.waited <= p.safety.arming_cycles)


@kernel
def _look_for_obstacle(parameters: Record, state: Record) -> None:
    p, s = parameters[()], state[()]
    w, limits = s.safety, p.safety
    w.obstacle = NO_CAUSE
    lost = 0
    for k in range(IMU_COUNT):
        off = contradiction(w.monitor, k)
        if not off <= limits.disagreement:
            _obstruct(state, NO_SENSORS, k, off, limits.disagreement)
        if p.imu_present[k] != 0 and s.imu_used[k] == 0:
            lost += 1
            if lost > limits.most_lost_imus:
                _obstruct(state, NO_SENSORS, k, np.nan, np.nan)
    for k in range(p.legs):
        low, high = limits.lengths[k, 0], limits.lengths[k, 1]
        if not low <= s.lengths[k] <= high:
            _obstruct(state, NO_WORKSPACE, k, s.lengths[k], low if s.lengths[k] < low else high)
        if not abs(s.error[k]) <= limits.arming_distance:
            _obstruct(state, NO_AGREEMENT, k, abs(s.error[k]), limits.arming_distance)
        if w.drive[k] != READY and w.drive[k] != FOLLOWING:
            _obstruct(state, NO_DRIVES, k, np.nan, np.nan)
    if w.silent > 0:
        _obstruct(state, BUS_LOST, -1, w.silent, 0)


@kernel
def _obstruct(state: Record, cause: int, index: int, value: float, limit: float) -> None:
    """The first obstacle counts."""
    w = state[()].safety
    if w.obstacle == NO_CAUSE:
        w.obstacle, w.obstacle_index, w.obstacle_value, w.obstacle_limit = cause, index, value, limit


@kernel
def watch(parameters: Record, state: Record) -> int:
    """After the commands, while there is motion: everything has a limit, and each has its cause; returns that of a fault, or
    0.
    """
    p, s = parameters[()], state[()]
    w, limits = s.safety, p.safety
    for k in range(p.legs):
        if not (np.isfinite(s.command[k]) and np.isfinite(s.lengths[k])):
            react(parameters, state, NOT_FINITE, k, np.nan, np.nan)
            return NOT_FINITE
    if w.mode < RUNNING or w.request != ENABLED:
        return NO_CAUSE
    lost = 0
    for k in range(IMU_COUNT):
        lost += p.imu_present[k] != 0 and s.imu_used[k] == 0
    if lost > limits.most_lost_imus:
        react(parameters, state, IMUS_LOST, -1, lost, limits.most_lost_imus)
    if s.conditioning < limits.conditioning and s.filter_trusted == 0:
        react(parameters, state, ILL_CONDITIONED, -1, s.conditioning, limits.conditioning)
    for k in range(p.legs):
        length, command, d, a = s.lengths[k], s.command[k], s.predicted[k], s.arms[k]
        low, high = p.plausible_lengths[k, 0], p.plausible_lengths[k, 1]
        if not low <= length <= high:
            react(parameters, state, IMPLAUSIBLE, k, length, low if length < low else high)
            return IMPLAUSIBLE
        low, high = limits.lengths[k, 0], limits.lengths[k, 1]
        if not low <= length <= high:
            react(parameters, state, BEYOND_STROKE, k, length, low if length < low else high)
        t = s.smooth_twist
        w.speed[k] = (
            d[0] * (t[0] + t[4] * a[2] - t[5] * a[1])
            + d[1] * (t[1] + t[5] * a[0] - t[3] * a[2])
            + d[2] * (t[2] + t[3] * a[1] - t[4] * a[0])
        )
        if not abs(w.speed[k]) <= limits.speed:
            react(parameters, state, TOO_FAST, k, abs(w.speed[k]), limits.speed)
        w.astray[k] = w.astray[k] + p.period if abs(s.error[k]) > limits.following else 0.0
        if w.astray[k] > limits.patience:
            react(parameters, state, FOLLOWING_ERROR, k, abs(s.error[k]), limits.following)
        # A drive is behind its command, by less than what it may deviate by.
        w.deviating[k] = w.deviating[k] + p.period if abs(w.speed[k] - command) > limits.drive_deviation else 0.0
        if w.deviating[k] > limits.patience:
            react(parameters, state, DRIVE_DEVIATES, k, abs(w.speed[k] - command), limits.drive_deviation)
            return DRIVE_DEVIATES
        w.saturated[k] = w.saturated[k] + p.period if abs(command) >= p.command_limit else 0.0
        if w.saturated[k] > limits.saturation:
            react(parameters, state, SATURATED, k, w.saturated[k], limits.saturation)
    return NO_CAUSE
