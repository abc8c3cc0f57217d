"""What the controller writes to the drives and IMUs before a run: PDOs, watchdogs, modes and option codes."""

import time

from hil.rigs import Request, RigError
from hil.rigs.canopen.cia402 import CYCLIC_SYNCHRONOUS_VELOCITY, Controlword, PowerState, controlword_towards, state_of
from hil.rigs.canopen.frames import SYNC_OVERFLOW
from hil.rigs.canopen.objects import (
    COMMAND_PDO,
    DRIVE_PDOS,
    EVENT_TIMER,
    MAGNETOMETER_PDO,
    SYNC_START_VALUE,
    Object,
    imu_pdos,
)
from hil.rigs.canopen.sdo import RemoteNode
from hil.rigs.canopen.settings import CanopenSettings, ControllerSettings, DriveSettings

_QUICK_STOP_RAMP, _DISABLE_AT_ONCE, _FAULT_RAMP, _ABORT_BY_QUICK_STOP = 2, 0, 2, 3
"""Option codes: a quick stop slows down by the quick-stop deceleration and ends in Switch on disabled; "disable operation"
takes the power off at once, which closes the brake; a fault slows down like a quick stop; a lost connection is a quick stop."""

_SWITCH_ON_TIMEOUT_S, _MODE_TIMEOUT_S = 2.0, 0.5


def configure_drive(node: RemoteNode, drives: DriveSettings, period: float) -> None:
    """Configure a drive for commands every `period` [s].

    Raises:
        RigError: the drive does not answer, or refuses a value.
    """
    units, exponent = interpolation_period(period)
    for pdo in DRIVE_PDOS:
        node.map_pdo(pdo)
    node.configure(Object.PRODUCER_HEARTBEAT, 0, round(drives.heartbeat * 1e3))
    node.configure(Object.QUICK_STOP_OPTION, 0, _QUICK_STOP_RAMP)
    for index, subindex, value in (
        (COMMAND_PDO.communication, EVENT_TIMER, round(drives.command_timeout * 1e3)),
        (Object.SYNC_OVERFLOW, 0, SYNC_OVERFLOW),
        (Object.DISABLE_OPERATION_OPTION, 0, _DISABLE_AT_ONCE),
        (Object.FAULT_REACTION_OPTION, 0, _FAULT_RAMP),
        (Object.ABORT_CONNECTION_OPTION, 0, _ABORT_BY_QUICK_STOP),
        (Object.INTERPOLATION_PERIOD, 2, exponent),
        (Object.INTERPOLATION_PERIOD, 1, units),
        (Object.MAX_MOTOR_SPEED, 0, round(drives.velocity_limit / drives.screw_lead * drives.gear_ratio * 60.0)),
    ):
        # Not every drive has these.
        if node.has(index, subindex):
            node.configure(index, subindex, value)
    node.configure(Object.QUICK_STOP_DECELERATION, 0, round(drives.quick_stop_deceleration * drives.counts_per_metre))
    node.write(Object.MODE, 0, CYCLIC_SYNCHRONOUS_VELOCITY)
    node.check(Object.MODE_DISPLAY, 0, CYCLIC_SYNCHRONOUS_VELOCITY, _MODE_TIMEOUT_S)
    node.write(Object.TARGET_VELOCITY, 0, 0)


def configure_imu(node: RemoteNode, imu: int, settings: CanopenSettings) -> None:
    """Configure an IMU.

    Raises:
        RigError: the IMU does not answer, or refuses a value.
    """
    for pdo in imu_pdos(settings.bus.fd):
        node.map_pdo(pdo)
        if pdo == MAGNETOMETER_PDO:
            # The magnetometers take turns.
            node.configure(pdo.communication, SYNC_START_VALUE, imu + 1)
    node.configure(Object.SYNC_OVERFLOW, 0, SYNC_OVERFLOW)
    node.configure(Object.PRODUCER_HEARTBEAT, 0, round(settings.imus.heartbeat * 1e3))


def switch_on(node: RemoteNode, controller: ControllerSettings) -> int:
    """Reset a drive's fault and lead the drive to Switched on; returns its statusword.

    Raises:
        RigError: the drive does not reach Switched on.
    """
    # Written each time: a drive begins to watch for the heartbeat at its next one, which comes with the first exchange.
    node.configure(Object.CONSUMER_HEARTBEAT, 1, controller.node << 16 | round(controller.heartbeat_timeout * 1e3))
    deadline = time.monotonic() + _SWITCH_ON_TIMEOUT_S
    code, resets = 0, 0
    while True:
        word = int(node.read(Object.STATUSWORD))
        state = state_of(word)
        if state == PowerState.SWITCHED_ON:
            return word
        if time.monotonic() > deadline or (state == PowerState.FAULT and resets == 2):
            where = f"statusword 0x{word:04X}" if state is None else state.label
            raise RigError(
                f"{node.name} does not reach {PowerState.SWITCHED_ON.label}: it stays in {where}, error code "
                f"0x{code or int(node.read(Object.ERROR_CODE)):04X}; remove the cause that its manual gives"
            )
        if state == PowerState.FAULT:
            code = int(node.read(Object.ERROR_CODE))
            resets += 1
            node.write(Object.CONTROLWORD, 0, Controlword.DISABLE_VOLTAGE)
            node.write(Object.CONTROLWORD, 0, Controlword.FAULT_RESET)
        node.write(Object.CONTROLWORD, 0, controlword_towards(Request.BRAKED, state))


def interpolation_period(period: float) -> tuple[int, int]:
    """A period [s] in the form of CiA 402's object 60C2h: a number of units (at most 255), and a unit's exponent of ten."""
    exponents = range(-3, -7, -1)
    exact = (each for each in exponents if abs(period * 10.0**-each - round(period * 10.0**-each)) < 1e-6)
    exponent = next((each for each in exact if 1 <= round(period * 10.0**-each) <= 255), None)
    if exponent is None:
        exponent = min((each for each in exponents if period * 10.0**-each <= 255.0), default=-3)
    return max(1, round(period * 10.0**-exponent)), exponent
