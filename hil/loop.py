"""The loop around the cycle: read the plant, run the cycle, command the plant, record. Compiled, and without a clock.

All state lies in the arrays of `Loop`, so a run can be taken up again at any cycle. The same steps in Python serve leg
filters that are written in Python.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from controller.cycle import OK, control, cycle
from plant.compiled import Record, kernel
from plant.fmu import CALLS, advance, read_imus, read_truth, write_command, write_drive_mode
from plant.imu import measure
from plant.mechanism import LEGS
from plant.pose import Array
from plant.variables import BRAKE, IMU_COUNT, VELOCITY

PLANT_FAILED = 100
"""Added to FMI's status when the plant reports a failure; below it are the statuses of the cycle."""

CYCLE_RECORD = np.dtype(
    [
        ("truth", np.float64, CALLS["truth"].shape),
        ("position", np.float64, 3),
        ("rotation", np.float64, (3, 3)),
        ("lengths", np.float64, LEGS),
        ("reference", np.float64, (LEGS, 3)),
        ("command", np.float64, LEGS),
        ("conditioning", np.float64),
        ("cycle_ns", np.int64),
    ],
    align=True,
)
"""What is kept of a cycle: the truth as the plant's `truth` buffer has it, estimate, reference, command, duration."""

LegFusion = Callable[[Record, Array], None]
"""Leg filters in Python: take the cycle's state and a measurement (3, 7, 3), and leave directions and rates in the state."""

_CLOCK_MONOTONIC = 1
_clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.intp))


@dataclass(eq=False)
class Loop:
    """Everything that a run changes or reads.

    Attributes:
        calls: the plant (dtype `plant.fmu.CALLS`).
        imu: the IMUs' imperfections (dtype `plant.imu.IMU_STATE`).
        parameters, state: of the cycle.
        segments: the reference.
        records: (N,), dtype `CYCLE_RECORD`, one for each cycle.
    """

    calls: Record
    imu: Record
    parameters: Record
    state: Record
    segments: Array
    records: Record

    def __post_init__(self) -> None:
        self._measurement = np.zeros((3, IMU_COUNT, 3))
        self._clock = np.zeros(2, np.int64)

    def run(self, last: int, fuse: LegFusion | None = None) -> int:
        """Run up to but not including cycle `last`; returns a status, 0 when all is well, and brakes when it is not."""
        if fuse is None:
            return _run(
                self.calls, self.imu, self.parameters, self.state, self.segments, self.records, self._measurement, self._clock,
                last,
            )  # fmt: skip
        for k in range(int(self.state["cycle"]), last):
            status = _sense(self.calls, self.imu, self.parameters, self.state, self._measurement)
            began = now(self._clock)
            if status == OK:
                fuse(self.state, self._measurement)
                status = control(self.parameters, self.state, self._measurement, self.segments)
            duration = now(self._clock) - began
            status = _act(self.calls, self.parameters, self.state, self.records[k : k + 1], duration, status)
            if status != OK:
                return status
        return OK


@kernel
def now(clock: NDArray[np.int64]) -> int:
    """The monotonic clock [ns]; `clock` (2,) is scratch."""
    _clock_gettime(_CLOCK_MONOTONIC, clock.ctypes.data)
    return int(clock[0] * 1_000_000_000 + clock[1])


@kernel
def _sense(calls: Record, imu: Record, parameters: Record, state: Record, measurement: Array) -> int:
    """Read the plant through the IMUs' imperfections; the brakes hold from the first cycle to the end of the hold."""
    status = 0
    if state[()].cycle == 0:
        status |= write_drive_mode(calls, BRAKE)
    if state[()].cycle == parameters[()].hold_cycles:
        status |= write_drive_mode(calls, VELOCITY)
    status |= read_imus(calls)
    status |= read_truth(calls)
    measure(imu, calls[()].imu, measurement)
    return PLANT_FAILED + status if status else OK


@kernel
def _act(calls: Record, parameters: Record, state: Record, records: Record, duration: int, status: int) -> int:
    """Record the cycle, command the plant and let it move for a period; brake it if the cycle failed."""
    s, record = state[()], records[0]
    record.truth[:] = calls[()].truth
    record.position[:] = s.position
    record.rotation[:] = s.rotation
    record.lengths[:] = s.lengths
    record.reference[:] = s.reference
    record.command[:] = s.command
    record.conditioning = s.conditioning
    record.cycle_ns = duration
    if status != OK:
        write_drive_mode(calls, BRAKE)
        return status
    plant_status = write_command(calls, s.command) | advance(calls, parameters[()].period)
    return PLANT_FAILED + plant_status if plant_status else OK


@kernel
def _run(
    calls: Record, imu: Record, parameters: Record, state: Record, segments: Array, records: Record, measurement: Array,
    clock: NDArray[np.int64], last: int,
) -> int:  # fmt: skip
    for k in range(state[()].cycle, last):
        status = _sense(calls, imu, parameters, state, measurement)
        began = now(clock)
        if status == OK:
            status = cycle(parameters, state, measurement, segments)
        duration = now(clock) - began
        status = _act(calls, parameters, state, records[k : k + 1], duration, status)
        if status != OK:
            return status
    return OK
