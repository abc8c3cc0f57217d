"""The records of the loop: what it keeps of a cycle, its own state, and what it shares with other processes."""

import mmap
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from controller.cycle import MARKS
from controller.safety.causes import EVENT_SLOTS
from hil.rigs import FEEDBACK
from hil.rigs.udp.emulator import UdpEmulator
from hil.rigs.udp.link import UdpLink
from plant.compiled import Record
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
    "control",
    "record",
    "plant",
)
"""What a cycle is made of: `sense` is the exchange with the rig, the last commands sent; `leg filters` begin with the
calibration; `control` is inverse kinematics, PID, feed-forward and the watch; `record` is telemetry and the next reference;
`plant` is the simulated one's own time."""


class Stage(IntEnum):
    """Places in the durations of the stages."""

    SENSE = 0
    LEGS = 1
    PLATFORM = 2
    POSE = 3
    REFINEMENT = 4
    MECHANISM = 5
    CONTROL = 6
    RECORD = 7
    PLANT = 8


COMPUTED, TO_COMMAND = slice(Stage.LEGS, Stage.RECORD), slice(Stage.SENSE, Stage.RECORD)
"""The stages of the paper's Figure 4, and all between the wake-up and the command."""

RECORD = np.dtype(
    [
        ("cycle", np.int64),
        ("time_ns", np.int64),
        ("late_ns", np.int64),
        ("stage_ns", np.int64, len(STAGES)),
        ("cpu_ns", np.int64),
        ("missed", np.int64),
        ("status", np.int32),
        ("stop", np.int32),
        ("asked", np.int32),
        ("mode", np.int32),
        ("request", np.int32),
        ("silent", np.int32),
        ("drive", np.int32, LEGS),
        ("drive_code", np.int32, LEGS),
        ("sample_age", np.int32, IMU_COUNT),
        ("imus", np.int32),
        ("trusted", np.int32),
        ("sample_ns", np.int64, IMU_COUNT),
        ("round_trip_ns", np.int64),
        ("refused", np.int64),
        ("sent", np.float64, LEGS),
        ("event_count", np.int64),
        ("event_cause", np.int32, EVENT_SLOTS),
        ("event_index", np.int32, EVENT_SLOTS),
        ("event_value", np.float64, EVENT_SLOTS),
        ("event_limit", np.float64, EVENT_SLOTS),
        ("angular_velocity", np.float64, (IMU_COUNT, 3)),
        ("specific_force", np.float64, (IMU_COUNT, 3)),
        ("magnetic_field", np.float64, (IMU_COUNT, 3)),
        ("position", np.float64, 3),
        ("rotation", np.float64, (3, 3)),
        ("covariance", np.float32, (6, 6)),
        ("residuals", np.float32, (LEGS, 3)),
        ("conditioning", np.float64),
        ("lengths", np.float64, LEGS),
        ("reference", np.float64, (LEGS, 3)),
        ("command", np.float64, LEGS),
        ("truth", np.float64, TRUTH_SIZE),
    ],
    align=True,
)
"""What is kept of a cycle: the period that it ran in; when it woke [ns since the first] and how late; the stages' durations
and the thread's CPU time; periods missed before it; the cause of a fault that began in it, and of the stop or fault that is
on, and what was asked of it before it; mode and request to the drives (`controller.safety.watch`); what the rig said
(`hil.rigs.FEEDBACK`): for how many cycles it has been silent, the drives, how many cycles old the samples are, their time,
round trip, refused packets, and what was really sent; what happened; which IMUs were used (a bit each, and the eighth for
the platform's magnetometer), and whether the pose is the whole-mechanism filter's; raw IMU data; the pose with covariance
(translation, rotation; in {1}), residuals of the directions and conditioning; lengths, reference (length, rate,
acceleration) and commands, 0 for legs that a planar mechanism has not; and the truth as the plant's `truth` buffer has it.
"""


class Link(IntEnum):
    """Places in the array that the loop shares with other processes, int64 (`LINK_SIZE`,).

    `HEAD`: number of records written. `STOP`: the `StopRequest`, 0 for none. `DONE`: whether the loop has ended. `TAIL`: where
    the next recorder continues. `KEPT`: number of records that are safely in files. `SUPERVISOR`: the process whose end ends
    the motion, 0 for none. `START`: the first deadline [ns].
    """

    HEAD = 0
    STOP = 1
    DONE = 2
    TAIL = 3
    KEPT = 4
    SUPERVISOR = 5
    START = 6


LINK_SIZE = 16


class StopRequest(IntEnum):
    """How another process asks the loop to stop."""

    CONTROLLED = 1
    QUICK = 2


FMU_RIG, UDP_RIG, EMULATED_RIG = range(3)
"""What the compiled loop exchanges with: the plant; a rig over UDP; an emulated one over UDP's datagrams, in memory."""


class RigHandle(NamedTuple):
    """The rig as compiled code sees it: which of the three it is, and what each needs.

    Attributes:
        kind: `FMU_RIG`, `UDP_RIG` or `EMULATED_RIG`.
        fmu: the plant (dtype `plant.fmu.calls.FMU_HANDLE`).
        imu: the IMUs' imperfections (dtype `plant.imu.IMU_STATE`).
        link: the controller's side of UDP.
        emulator: the rig's side, in memory.
    """

    kind: int
    fmu: Record
    imu: Record
    link: UdpLink
    emulator: UdpEmulator


class TargetStream(NamedTuple):
    """A streamed target as compiled code sees it.

    Attributes:
        active: whether there is one.
        patience_ns: how long it may be silent.
        stream, reader: dtypes `controller.planning.stream.STREAM` and `STREAM_READER`.
    """

    active: int
    patience_ns: int
    stream: Record
    reader: Record


WORK = np.dtype(
    [
        ("cycle", np.int64),
        ("asked", np.int64),
        ("silent", np.int64),
        ("sequence", np.int64, IMU_COUNT),
        ("sample_age", np.int64, IMU_COUNT),
        ("feedback", FEEDBACK),
        ("factor", np.float64, (6, 6)),
        ("covariance", np.float64, (6, 6)),
        ("stage_ns", np.int64, len(STAGES)),
        ("marks", MARKS),
        ("signals", np.int64, 16),
    ],
    align=True,
)


def shared_array(count: int, dtype: np.dtype[Any]) -> Any:
    """Zeros (count,) in memory that is shared with the processes forked later."""
    return np.frombuffer(mmap.mmap(-1, count * dtype.itemsize), dtype)
