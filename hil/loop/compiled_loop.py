"""The compiled loop: wait for the clock, exchange with the rig, run the cycle, record."""

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from controller.cycle import CycleStage, hear_base_imu, hear_encoders, hear_rig, prepare_next, react, run_stages, skip_periods
from controller.estimation.whole_mechanism.trust import find_covariance
from controller.planning.plan_handover import STREAM_PATIENCE_S, stream_cause, take_plan
from controller.reference import motion_cycle
from controller.safety.causes import EVENT_SLOTS, REACTION, Cause, Request
from controller.safety.stop import has_stopped, ramp_down
from hil.loop.records import Link, Stage, StopRequest, TargetStream
from hil.realtime.clock import FREE, REAL, finish, start, wait
from hil.rigs import ANSWERED, SILENT, DriveState
from hil.rigs.position_loops import (
    LONGEST_STEP_S,
    are_closed,
    follow_goal,
    hold_goal,
    loop_fault,
    take_motors,
    take_readings,
)
from hil.rigs.udp.emulator import UdpEmulator, exchange_in_memory
from hil.rigs.udp.link import UdpLink, exchange_udp, send_command
from plant.compiled import Record, kernel, shared_kernel, store_release
from plant.dynamics.variables import BRAKE, IMU_COUNT, VELOCITY
from plant.encoder_readings import read_encoders
from plant.fmu.calls import advance, read_base_imu, read_imus, read_motors, read_truth, write_command, write_drive_mode
from plant.imu import measure
from plant.imu_wiring import BASE_IMU
from plant.mechanism import LEGS
from plant.pose import Array
from plant.stopwatch import now

_LOOK_NS = 100_000_000
_STREAM_PATIENCE_NS = round(1e9 * STREAM_PATIENCE_S)

_SIGQUIT = 1 << 2
_SIGNALS = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14
"""SIGHUP, SIGINT, SIGQUIT and SIGTERM."""

_getppid: Any = types.ExternalFunction("getppid", types.int32())
_sigpending: Any = types.ExternalFunction("sigpending", types.int32(types.intp))


@shared_kernel
def exchange_fmu(
    fmu: Record, imu: Record, encoders: Record, loops: Record, command: Array, request: int, periods: int, period: float,
    feedback: Record, stage_ns: NDArray[np.int64], timespec: NDArray[np.int64],
) -> int:  # fmt: skip
    """Let the plant move with the command for some periods, and read it; returns the status of the exchange."""
    began = now(timespec)
    status = write_drive_mode(fmu, BRAKE if request == Request.BRAKED else VELOCITY)
    closed = are_closed(loops)
    if periods > 0 and not closed:
        status |= write_command(fmu, command)
    for _ in range(periods):
        status |= _advance_loops(fmu, loops, command, request, period, feedback) if closed else advance(fmu, period)
    stage_ns[Stage.PLANT] = now(timespec) - began
    if status == 0:
        status = read_imus(fmu) | read_truth(fmu)
        m = imu[()]
        m.time = fmu[()].time
        if m.count > BASE_IMU:
            status = read_base_imu(fmu)
            m.base[:2] = fmu[()].base_imu
        measure(imu, fmu[()].imu, feedback.measurement)
        if encoders[()].legs > 0:
            status |= read_motors(fmu)
            encoders[()].time = m.time
            read_encoders(encoders, fmu[()].motors, feedback.length, feedback.length_rate, feedback.home)
            take_readings(loops, fmu[()].motors, feedback.length)
        feedback.truth[:] = fmu[()].truth
        for k in range(LEGS):
            feedback.sent[k] = 0.0 if request == Request.BRAKED else command[k]
        for k in range(IMU_COUNT):
            if m.fresh[k] > 0:
                feedback.sequence[k] += m.fresh[k]
                feedback.sample_ns[k] = np.int64(np.rint(1e9 * m.sampled_at[k]))
        if m.fresh[BASE_IMU] > 0:
            feedback.base_imu[:] = m.reading[:2, BASE_IMU]
            feedback.base_imu_sequence += m.fresh[BASE_IMU]
            feedback.base_imu_ns = np.int64(np.rint(1e9 * m.sampled_at[BASE_IMU]))
    return ANSWERED if status == 0 else SILENT + status


@kernel
def _advance_loops(fmu: Record, loops: Record, command: Array, request: int, period: float, feedback: Record) -> int:
    """Let the plant move for a period, driven by drives that close position loops; returns FMI's status."""
    c = fmu[()]
    count = max(int(np.ceil(period / LONGEST_STEP_S - 1e-9)), 1)
    step, status = period / count, 0
    for _ in range(count):
        status |= read_motors(fmu)
        take_motors(loops, c.motors)
        for k in range(LEGS):
            if request == Request.BRAKED:
                hold_goal(loops, k)
            else:
                follow_goal(loops, k, command[k], step, np.inf, step)
                if loop_fault(loops, k) != 0:
                    feedback.drive[k], feedback.drive_code[k] = DriveState.FAULTY, loop_fault(loops, k)
        status |= write_command(fmu, loops.velocity) | advance(fmu, step)
    return status


@kernel
def exchange(
    fmu: Record | None, imu: Record | None, encoders: Record | None, udp: UdpLink | None, emulator: UdpEmulator | None,
    parameters: Record, state: Record, work: Record, timespec: NDArray[np.int64],
) -> int:  # fmt: skip
    """Send the last commands, and read the sensors; returns the rig's status. numba leaves out the branches of what is None."""
    s, w, period = state[()], work[()], parameters[()].rig.period
    began = now(timespec)
    status = SILENT
    if fmu is not None:
        periods = periods_passed(state)
        status = exchange_fmu(
            fmu, imu, encoders, w.loops, s.pid.command, s.safety.request, periods, period, w.feedback, w.stage_ns, timespec
        )  # fmt: skip
    if udp is not None and emulator is not None:
        at = int(np.rint(1e9 * period * s.time.cycle))
        status = exchange_in_memory(emulator, udp, s.pid.command, s.safety.request, w.feedback, at)
    elif udp is not None:
        status = exchange_udp(udp, s.pid.command, s.safety.request, w.feedback, timespec)
    w.stage_ns[Stage.SENSE] = now(timespec) - began - w.stage_ns[Stage.PLANT]
    return status


@kernel
def hold_brakes(
    fmu: Record | None, udp: UdpLink | None, emulator: UdpEmulator | None, parameters: Record, state: Record, work: Record,
    timespec: NDArray[np.int64],
) -> None:  # fmt: skip
    """Let the drives hold on their brakes."""
    if fmu is not None:
        write_drive_mode(fmu, BRAKE)
    if udp is not None and emulator is not None:
        at = int(np.rint(1e9 * parameters[()].rig.period * state[()].time.cycle))
        exchange_in_memory(emulator, udp, state[()].pid.command, Request.BRAKED, work[()].feedback, at)
    elif udp is not None:
        send_command(udp, state[()].pid.command, Request.BRAKED, now(timespec))


@kernel
def periods_passed(state: Record) -> int:
    """Periods since the last exchange; none before the first."""
    time = state[()].time
    return 1 + time.missed if time.cycle > 0 else 0


@kernel
def begin_cycle(
    parameters: Record, state: Record, clock: Record, script: NDArray[np.int64], link: NDArray[np.int64], work: Record,
    streamed: TargetStream | None, most_missed: int, end: int,
) -> int:  # fmt: skip
    """Wait for the next period, count missed ones, and begin a stop that is due; returns the cause if the run has ended."""
    c, s, w = clock[()], state[()], work[()]
    if c.cycles == 0:
        start(clock)
    missed = wait(clock, script)
    w.asked = Cause.NONE
    if missed < 0:
        _ask(work, Cause.CLOCK_FAILED)
        missed = 0
    skip_periods(state, missed)
    w.cycle = s.time.cycle
    w.stage_ns[:] = 0
    w.marks.ns[:] = 0
    if s.time.cycle - s.safety.arming.delay >= end:
        _ask(work, Cause.END_OF_MOTION)
    if c.mode == REAL and c.cycles % max(_LOOK_NS // c.period, 1) == 0:
        signals = w.signals
        if _sigpending(signals.ctypes.data) == 0 and signals[0] & _SIGNALS != 0:
            _ask(work, Cause.STOP_REQUESTED if signals[0] & _SIGQUIT == 0 else Cause.EMERGENCY_STOP)
        if link[Link.SUPERVISOR] != 0 and _getppid() != link[Link.SUPERVISOR]:
            _ask(work, Cause.SUPERVISOR_GONE)
    if c.in_a_row >= most_missed:
        _ask(work, Cause.MISSED_PERIODS)
    if link[Link.STOP] != 0:
        _ask(work, Cause.STOP_REQUESTED if link[Link.STOP] == StopRequest.CONTROLLED else Cause.EMERGENCY_STOP)
    leg, value, limit = -1, np.nan, np.nan
    if streamed is not None and s.safety.stop.cause == Cause.NONE and w.asked == Cause.NONE:
        cause, leg, value, limit = stream_cause(streamed.stream, c.woke, _STREAM_PATIENCE_NS)
        _ask(work, cause)
    if w.asked == Cause.MISSED_PERIODS:
        value, limit = float(c.in_a_row), float(most_missed)
    if w.asked != Cause.NONE:
        react(parameters, state, w.asked, leg, value, limit)
    return int(s.safety.stop.cause) if has_stopped(s.safety, s.time) else Cause.NONE.value


@kernel
def _ask(work: Record, cause: int) -> None:
    """Ask for a reaction; the most severe cause wins, and ties go to the latest."""
    if REACTION[cause] >= REACTION[work[()].asked]:
        work[()].asked = cause


@shared_kernel
def process_feedback(parameters: Record, state: Record, work: Record, status: int) -> int:
    """Note which samples are new, and react to the rig's status; returns a cause if the cycle cannot run."""
    p, s, w = parameters[()], state[()], work[()]
    feedback, missed = w.feedback, s.time.missed
    w.silent = w.silent + 1 + missed if status == SILENT else 0
    for k in range(IMU_COUNT):
        fresh = feedback.sequence[k] != w.sequence[k]
        w.sample_age[k] = 0 if fresh else w.sample_age[k] + 1 + missed
        w.sequence[k] = feedback.sequence[k]
    fresh = feedback.base_imu_sequence != w.base_imu_sequence
    w.base_imu_age = 0 if fresh else w.base_imu_age + 1 + missed
    w.base_imu_sequence = feedback.base_imu_sequence
    if status != ANSWERED and status != SILENT:
        react(parameters, state, Cause.RIG_FAILED, -1, float(status), np.nan)
        ramp_down(p.safety.stop, p.rig, s.time, s.pid)
        return Cause.RIG_FAILED.value
    hear_rig(parameters, state, w.sample_age, feedback.drive, feedback.drive_code, w.silent)
    hear_base_imu(parameters, state, feedback.base_imu, w.base_imu_age)
    hear_encoders(parameters, state, w.silent, feedback.length, feedback.length_rate, feedback.home)
    return Cause.NONE.value


@shared_kernel
def record_cycle(parameters: Record, state: Record, clock: Record, work: Record, failed: int, record: Record) -> None:
    """Fill in the record of a cycle except its durations."""
    p, s, c, w = parameters[()], state[()], clock[()], work[()]
    record.cycle = w.cycle
    record.time_ns = c.woke - c.start if c.mode != FREE else np.int64(np.rint(1e9 * p.rig.period * w.cycle))
    record.late_ns = c.late
    record.missed = s.time.missed
    record.status = failed
    record.asked = w.asked
    record.request = s.safety.request
    record.silent = w.silent
    record.drive[:] = w.feedback.drive
    record.drive_code[:] = w.feedback.drive_code
    record.sample_age[:] = w.sample_age
    record.sample_ns[:] = w.feedback.sample_ns
    record.round_trip_ns, record.refused = w.feedback.round_trip_ns, w.feedback.refused
    record.sent[:] = w.feedback.sent
    events = s.safety.events
    record.event_count = events.count
    for i in range(EVENT_SLOTS):
        reported = i < events.count
        record.event_cause[i] = events.cause[i] if reported else 0
        record.event_index[i] = events.index[i] if reported else 0
        record.event_value[i] = events.value[i] if reported else 0.0
        record.event_limit[i] = events.limit[i] if reported else 0.0
    record.imus = s.heading.used << IMU_COUNT
    for k in range(IMU_COUNT):
        record.imus |= s.imus.used[k] << k
    record.trusted = s.mechanism.trusted
    record.angular_velocity[:] = w.feedback.measurement[0]
    record.specific_force[:] = w.feedback.measurement[1]
    record.magnetic_field[:] = w.feedback.measurement[2]
    record.length[:] = w.feedback.length
    record.length_rate[:] = w.feedback.length_rate
    record.home[:] = w.feedback.home
    record.base_imu[:] = w.feedback.base_imu
    record.base_imu_age, record.base_imu_ns = w.base_imu_age, w.feedback.base_imu_ns
    record.truth[:] = w.feedback.truth
    for k in range(LEGS):
        for i in range(3):
            record.residuals[k, i] = s.legs.directions[k, i] - s.pose.directions[k, i] if s.legs.used[k] != 0.0 else np.nan
    find_covariance(p.mechanism, s.mechanism, p.rig, s.time, s.pose, w.factor, w.covariance)
    record.covariance[:] = w.covariance
    record.protection[:] = s.integrity.protection.level
    if s.integrity.evaluations == 0:
        record.protection[:] = np.nan
    record_state(state, record)


@kernel
def record_state(state: Record, record: Record) -> None:
    """Fill in what a replay compares."""
    s = state[()]
    record.position[:] = s.pose.position
    record.rotation[:] = s.pose.rotation
    record.conditioning = s.pose.conditioning
    record.lengths[:] = s.pose.lengths
    record.reference[:] = s.reference.motion
    record.command[:] = s.pid.command
    record.mode, record.stop = s.safety.mode, s.safety.stop.cause


@kernel
def update_next_reference(parameters: Record, state: Record, segments: Array, streamed: TargetStream | None) -> None:
    """Take over the latest plan of a streamed target, and prepare the next cycle."""
    rig, s = parameters[()].rig, state[()]
    if streamed is not None and s.safety.stop.cause == Cause.NONE:
        cycle = motion_cycle(rig, s.time, s.safety)
        take_plan(streamed.stream, streamed.reader, cycle, rig.period, segments, s.reference.index)
    prepare_next(parameters, state, segments)


@kernel
def end_cycle(
    parameters: Record, state: Record, segments: Array, records: Record, clock: Record, script: NDArray[np.int64],
    link: NDArray[np.int64], work: Record, streamed: TargetStream | None, failed: int,
) -> None:  # fmt: skip
    """Record the cycle, update the next reference, set the next deadline, and publish the record."""
    w, timespec = work[()], clock[()].timespec
    began = now(timespec)
    head = link[Link.HEAD]
    record = records[head % records.shape[0]]
    record_cycle(parameters, state, clock, work, failed, record)
    update_next_reference(parameters, state, segments, streamed)
    stage_ns, ns = w.stage_ns, w.marks.ns
    stage_ns[Stage.LEGS] = ns[CycleStage.SCREENING] + ns[CycleStage.LEGS]
    stage_ns[Stage.PLATFORM] = ns[CycleStage.PLATFORM] + ns[CycleStage.HEADING]
    # From here to `control`, both have the same stages.
    stage_ns[Stage.POSE.value : Stage.RECORD.value] = ns[CycleStage.POSE.value : CycleStage.WATCH.value]
    stage_ns[Stage.CONTROL] += ns[CycleStage.WATCH]
    stage_ns[Stage.RECORD] = now(timespec) - began
    link[Link.START] = clock[()].start
    record.stage_ns[:] = stage_ns
    record.cpu_ns = finish(clock, script, record.stage_ns.sum())
    store_release(link, Link.HEAD, head + 1)


@kernel
def run_loop(
    fmu: Record | None, imu: Record | None, encoders: Record | None, udp: UdpLink | None, emulator: UdpEmulator | None,
    parameters: Record, state: Record, segments: Array, records: Record, clock: Record, script: NDArray[np.int64],
    link: NDArray[np.int64], work: Record, streamed: TargetStream | None, most_missed: int, last: int, end: int,
) -> int:  # fmt: skip
    """Run cycles up to `last`, or until a stop that begins at `end` or earlier is over; returns its cause, or `Cause.NONE`.

    The rig is the plant `fmu` with its `imu` and `encoders`, or the one on `udp`, in memory if that has an `emulator`; the
    rest is None.
    """
    s, w, timespec = state[()], work[()], clock[()].timespec
    cause = Cause.NONE.value
    while cause == Cause.NONE and s.time.cycle < last:
        cause = begin_cycle(parameters, state, clock, script, link, work, streamed, most_missed, end)
        if cause != Cause.NONE:
            break
        status = exchange(fmu, imu, encoders, udp, emulator, parameters, state, work, timespec)
        failed = process_feedback(parameters, state, work, status)
        if failed == Cause.NONE:
            failed = run_stages(
                parameters, state, w.feedback.measurement, segments, w.marks, CycleStage.SCREENING, CycleStage.END
            )
        end_cycle(parameters, state, segments, records, clock, script, link, work, streamed, failed)
    if cause != Cause.NONE:
        hold_brakes(fmu, udp, emulator, parameters, state, work, timespec)
    return cause
