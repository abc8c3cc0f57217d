"""The records of the loop: what it keeps of a cycle, its own state, and what it shares with other processes."""

import mmap
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from controller.cycle import MARKS
from controller.safety.causes import EVENT_SLOTS, Cause
from hil.rigs import FEEDBACK
from hil.rigs.position_loops import POSITION_LOOPS
from plant.compiled import MOST, Limits, Record, record_dtype
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS
from plant.truth import TRUTH_SIZE

STAGES = (
    "sense",
    "leg filters",
    "platform filter",
    "direct kinematics",
    "refinement",
    "whole mechanism",
    "integrity",
    "control",
    "record",
    "plant",
)
"""The stages of a cycle that are timed. `sense` is the exchange with the rig, which sends the last commands. `leg filters`
begin with the calibration. `control` is inverse kinematics, PID, feed-forward and the watch. `record` is telemetry and the
next reference. `plant` is the time that a simulated plant takes."""


class Stage(IntEnum):
    """Places of the stages in the durations of a cycle."""

    SENSE, LEGS, PLATFORM, POSE, REFINEMENT, MECHANISM, INTEGRITY, CONTROL, RECORD, PLANT = range(len(STAGES))


COMPUTED, TO_COMMAND = slice(Stage.LEGS, Stage.RECORD), slice(Stage.SENSE, Stage.RECORD)
"""The stages of the paper's Figure 4, and all between the wake-up and the command."""

RECORD_FIELDS = (
    ("cycle", "i8", (), "periods since the first"),
    ("time_ns", "i8", (), "when it woke, since the first deadline"),
    ("late_ns", "i8", (), "how late it woke"),
    ("stage_ns", "i8", len(STAGES), ", ".join(STAGES)),
    ("cpu_ns", "i8", (), "processor time of the thread"),
    ("missed", "i8", (), "periods missed before this one"),
    ("status", "i4", (), "cause of a fault that began in this cycle; 0: none"),
    ("stop", "i4", (), "cause of the stop or fault that is under way; 0: none"),
    ("asked", "i4", (), "cause that was asked for before the cycle; 0: none"),
    ("mode", "i4", (), "0 idle, 1 armed, 2 running, 3 stopping, 4 stopped, 5 fault"),
    ("request", "i4", (), "to the drives: 0 braked, 1 enabled, 2 quick stop"),
    ("silent", "i4", (), "cycles since the rig has answered"),
    ("drive", "i4", LEGS, "0 following, 1 ready, 2 not ready, 3 stopping quickly, 4 faulty"),
    ("drive_code", "i4", LEGS, "the drives' own fault codes"),
    ("sample_age", "i4", IMU_COUNT, "cycles since each IMU's sample was new"),
    ("imus", "i4", (), "which IMUs were used, a bit each, and the eighth for the platform's magnetometer"),
    ("trusted", "i4", (), "1: the pose is the whole-mechanism filter's"),
    ("sample_ns", "i8", IMU_COUNT, "time of each IMU's sample on the rig's clock"),
    ("round_trip_ns", "i8", (), "of the exchange"),
    ("refused", "i8", (), "frames or packets that were refused since the start"),
    ("sent", "f8", LEGS, "m/s, what was really sent"),
    ("event_count", "i8", (), "number of events in this cycle; the first eight follow"),
    ("event_cause", "i4", EVENT_SLOTS, "by number, as in controller/safety"),
    ("event_index", "i4", EVENT_SLOTS, "which leg or IMU; -1: none"),
    ("event_value", "f8", EVENT_SLOTS, "in the unit of its cause; NaN: none"),
    ("event_limit", "f8", EVENT_SLOTS, "that the value broke; NaN: none"),
    ("angular_velocity", "f8", (IMU_COUNT, 3), "rad/s, seven IMUs by three axes: 0-5 on the legs, 6 on the platform; raw"),
    ("specific_force", "f8", (IMU_COUNT, 3), "m/s^2, raw"),
    ("magnetic_field", "f8", (IMU_COUNT, 3), "uT, raw"),
    ("length", "f8", LEGS, "m, that each encoder reads; NaN: none; raw"),
    ("length_rate", "f8", LEGS, "m/s, its rate"),
    ("home", "i4", LEGS, "1 beyond the home switch, 0 before it, -1: none"),
    ("base_imu", "f8", (2, 3), "rad/s and m/s^2, of an IMU on the base; NaN: none; raw"),
    ("base_imu_age", "i4", (), "cycles since its sample was new"),
    ("base_imu_ns", "i8", (), "time of its sample on the rig's clock"),
    ("position", "f8", 3, "m, of {2} in {1}"),
    ("rotation", "f8", (3, 3), "row by row, maps {2} to {1}"),
    ("covariance", "f4", (6, 6), "row by row, of translation [m] and rotation [rad] in {1}"),
    ("protection", "f4", 2, "protection level of position [m] and rotation [rad]; NaN: not known"),
    ("residuals", "f4", (LEGS, 3), "measured less predicted direction, six legs by three"),
    ("conditioning", "f8", (), "1 is best, 0 singular"),
    ("lengths", "f8", LEGS, "m; 0 for legs that a planar mechanism lacks"),
    ("reference", "f8", (LEGS, 3), "six legs by length [m], rate [m/s], acceleration [m/s^2]"),
    ("command", "f8", LEGS, "m/s"),
    ("truth", "f8", TRUTH_SIZE, "position [m], quaternion (w first), lengths [m], currents [A]"),
)
"""What is kept of a cycle: name, type, shape and meaning. A recording's schema is made from it."""

RECORD = np.dtype([(name, kind, shape) for name, kind, shape, _ in RECORD_FIELDS], align=True)

RECORD_LIMITS: Limits = {"missed": (0, MOST), "status": (Cause.NONE, max(Cause)), "asked": (Cause.NONE, max(Cause))}
"""Least and greatest of what a replay takes from a record."""


class Link(IntEnum):
    """Places in the array that processes share, int64 (`LINK_SIZE`,)."""

    HEAD = 0  # number of records written
    STOP = 1  # the `StopRequest`, 0: none
    DONE = 2  # whether the loop has ended
    TAIL = 3  # where the next recorder continues
    KEPT = 4  # number of records in complete files
    SUPERVISOR = 5  # the process whose end ends the motion, 0: none
    START = 6  # the first deadline [ns]


LINK_SIZE = 16


class StopRequest(IntEnum):
    """How another process asks the loop to stop."""

    CONTROLLED, QUICK = 1, 2


class TargetStream(NamedTuple):
    """A streamed target as the compiled loop sees it."""

    stream: Record  # dtype `STREAM`
    reader: Record  # dtype `STREAM_READER`


WORK = record_dtype(
    cycle=np.int64,  # the one that runs
    asked=np.int64,  # the cause that was asked for before it
    silent=np.int64,  # cycles since the rig has answered
    sequence=(np.int64, IMU_COUNT),  # numbers of the last samples
    sample_age=(np.int64, IMU_COUNT),  # cycles since they were new
    base_imu_sequence=np.int64,  # the same of the IMU on the base
    base_imu_age=np.int64,
    feedback=FEEDBACK,
    loops=POSITION_LOOPS,  # of the simulated plant's drives
    factor=(np.float64, (6, 6)),
    covariance=(np.float64, (6, 6)),
    stage_ns=(np.int64, len(STAGES)),
    marks=MARKS,
    signals=(np.int64, 16),  # a set of signals
)
"""The loop's own state and scratch."""


def shared_array(count: int, dtype: np.dtype[Any]) -> Any:
    """Zeros (count,), shared with the processes forked later."""
    return np.frombuffer(mmap.mmap(-1, count * dtype.itemsize), dtype)
