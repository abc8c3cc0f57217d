"""How a run ends: a controlled stop within the limits, a quick stop by the drives themselves, or the brakes at once."""

import numpy as np

from controller.planning.segments import STOP_SEGMENTS, plan_stop
from controller.safety.causes import REACTION, Cause, Mode, Reaction, Request, report_event
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.mechanism import LEGS, Limits

STOP_SETTLING_S = 0.1
"""How long the drives hold a mechanism that has stopped before the brakes take over [s]."""

PARAMETERS = record_dtype(
    velocity_limit=np.float64,  # [m/s]
    acceleration_limit=np.float64,  # [m/s^2]
    jerk_limit=np.float64,  # [m/s^3]
    settling_cycles=np.int64,  # how long the drives hold before the brakes
)
"""The actuators' limits."""

STATE = record_dtype(
    cause=np.int64,  # of the stop, `Cause.NONE` while the run goes on
    cycle=np.int64,  # when it began
    end_cycle=np.int64,  # when the brakes may hold
    segments=(np.float64, (LEGS, STOP_SEGMENTS, 5)),  # the reference of a controlled stop
    index=np.int64,  # with value and limit: of the cause
    value=np.float64,
    limit=np.float64,
    earlier_cause=np.int64,  # why the run was stopping already when a fault came
)
"""The stop or fault that is under way."""


def stop_parameters(limits: Limits, rate: float) -> Record:
    """The constants of a stop (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    return filled(
        PARAMETERS,
        velocity_limit=limits.velocity,
        acceleration_limit=limits.acceleration,
        jerk_limit=limits.jerk,
        settling_cycles=int(np.ceil(STOP_SETTLING_S * rate)),
    )


def describe_end(state: Record) -> str:
    """Why a run has ended, in words, from the cycle's state."""
    stop = state["safety"]["stop"]
    earlier = Cause(int(stop["earlier_cause"]))
    first = f"{earlier.short}, and then: " if earlier != Cause.NONE else ""
    return first + Cause(int(stop["cause"])).describe(int(stop["index"]), float(stop["value"]), float(stop["limit"]))


@shared_kernel
def handle_cause(
    p: Record, s: Record, rig: Record, time: Record, reference: Record, pid: Record,
    cause: int, index: int, value: float, limit: float,
) -> None:  # fmt: skip
    """Report a cause and react to it as `Cause` says.

    The first cause of a stop counts, and the first of a fault. A fault overrides a stop.

    Args:
        reference, pid: states of these stages, which a stop changes.
        index: the number of the leg or IMU; -1 if none is named.
        value, limit: in the unit of the cause; NaN if there is none.
    """
    reaction = REACTION[cause]
    if s.mode == Mode.FAULT or (reaction == Reaction.STOP and s.stop.cause != Cause.NONE):
        return
    report_event(s.events, cause, index, value, limit)
    if reaction == Reaction.GO_ON:
        return
    s.stop.index, s.stop.value, s.stop.limit = index, value, limit
    if reaction == Reaction.STOP:
        _begin_stop(p.stop, s, rig, time, reference, pid, cause)
    else:
        _fail(p.stop, s, rig, time, pid, cause)


@kernel
def _begin_stop(p: Record, s: Record, rig: Record, time: Record, reference: Record, pid: Record, cause: int) -> None:
    """Leave the motion for the fastest stop within the limits, leg by leg.

    Before the motion there is nothing to stop. In missed periods the drives followed the last command, so a stop begins where
    that has led, until the reference is that of the present cycle.
    """
    s.stop.cause = cause
    s.stop.cycle = s.stop.end_cycle = time.cycle
    if s.mode == Mode.RUNNING:
        if time.behind > 0:
            for k in range(rig.legs):
                speed = min(max(pid.command[k], -p.velocity_limit), p.velocity_limit)
                reference.motion[k, 0] += time.behind * rig.period * speed
                reference.motion[k, 1], reference.motion[k, 2] = speed, 0.0
        duration = plan_stop(reference.motion, p.acceleration_limit, p.jerk_limit, s.stop.segments)
        s.stop.end_cycle += int(np.ceil(duration / rig.period)) + p.settling_cycles
        reference.index[:] = 0
        reference.due_cycle = 0
    else:
        s.request = Request.BRAKED
    s.mode = Mode.STOPPING


@kernel
def _fail(p: Record, s: Record, rig: Record, time: Record, pid: Record, cause: int) -> None:
    """End without the estimate: the drives come to rest by themselves, or the brakes close at once."""
    moving = s.request == Request.ENABLED
    s.stop.earlier_cause = s.stop.cause
    s.stop.cause = cause
    s.stop.cycle = s.stop.end_cycle = time.cycle
    s.mode = Mode.FAULT
    s.request = Request.BRAKED
    if REACTION[cause] == Reaction.QUICK_STOP and moving:
        s.request = Request.QUICK_STOP
        fastest = 0.0
        for k in range(rig.legs):
            if not np.isfinite(pid.command[k]):
                pid.command[k] = 0.0
            fastest = max(fastest, abs(pid.command[k]))
        s.stop.end_cycle += int(np.ceil(fastest / (p.acceleration_limit * rig.period)))
    else:
        pid.command[:] = 0.0
    if moving:
        s.stop.end_cycle += p.settling_cycles


@kernel
def ramp_down(p: Record, rig: Record, time: Record, pid: Record) -> None:
    """A cycle after a fault: every command comes to rest at the limit of acceleration, whatever is measured."""
    step = p.acceleration_limit * rig.period * (1 + time.missed)
    for k in range(rig.legs):
        pid.command[k] -= min(max(pid.command[k], -step), step)
    time.cycle += 1


@kernel
def moves(s: Record) -> bool:
    """Whether the loop moves the legs: in the motion, and in a controlled stop, which needs the estimate as well."""
    return bool(s.mode == Mode.RUNNING or s.mode == Mode.STOPPING)


@kernel
def has_stopped(s: Record, time: Record) -> bool:
    """Whether a stop or a fault has come to its end, so that the brakes may hold; a stop becomes `Mode.STOPPED` then."""
    ended = s.stop.cause != Cause.NONE and time.cycle >= s.stop.end_cycle
    if ended:
        s.request = Request.BRAKED
        if s.mode == Mode.STOPPING:
            s.mode = Mode.STOPPED
    return bool(ended)
