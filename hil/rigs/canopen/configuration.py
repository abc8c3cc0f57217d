"""The nodes as the controller reads and configures them over SDO: PDOs, watchdogs, modes and option codes, all read back.

A node that does not answer, refuses a value, has another one or does not reach a state raises a `RigError`.
"""

import struct
import time
from collections.abc import Callable
from typing import Any

import can
import canopen
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

from hil.rigs import Request, RigError
from hil.rigs.canopen.cia402 import POSITION_MODE, VELOCITY_MODE, Controlword, PowerState, controlword_towards, state_of
from hil.rigs.canopen.frames import (
    ANSWER_PDO,
    COMMAND_PDO,
    INVALID_COB_ID,
    MAGNETOMETER_PDO,
    POSITION_PDO,
    SYNC_OVERFLOW,
    TARGET_PDO,
    CobId,
    Object,
    Parameter,
    Pdo,
    imu_pdos,
)
from hil.rigs.canopen.settings import CanopenSettings, ControllerSettings, DriveSettings, object_dictionary
from plant.errors import InputError

BUS_ERRORS = (can.CanError, OSError, ValueError)
"""What python-can raises when a bus fails."""

MOST_DRAINED = 256
"""The largest number of old frames that are read at once."""

_QUICK_STOP_RAMP, _DISABLE_AT_ONCE, _FAULT_RAMP, _ABORT_BY_QUICK_STOP = 2, 0, 2, 3
"""Option codes: a quick stop slows down by the quick-stop deceleration and ends in Switch on disabled; "disable operation"
takes the power off at once, which closes the brake; a fault slows down like a quick stop; a lost connection is a quick stop."""

_SWITCH_ON_TIMEOUT_S, _MODE_TIMEOUT_S = 2.0, 0.5
_SDO_ATTEMPTS = 3


class RemoteNode(SdoClient):  # type: ignore[misc]
    """A node on the bus: canopen's SDO client, but it reads the bus itself instead of having a thread do it.

    Args:
        name: for messages, such as drive 0.
        node: its id.
        eds: electronic data sheet.
        network: canopen's.
        receive: returns the next frame within a time [s], or None.
        clock: [ns].
    """

    RESPONSE_TIMEOUT = 1.0

    def __init__(
        self, name: str, node: int, eds: Any, network: canopen.Network, receive: Callable[[float], can.Message | None],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        super().__init__(CobId.SDO_REQUEST + node, CobId.SDO_ANSWER + node, object_dictionary(eds, node))
        self._clock = clock
        self.name, self.node, self.network, self._receive = f"{name} (node {node})", node, network, receive

    def now(self) -> float:
        """The present on its clock [s]."""
        return 1e-9 * self._clock()

    def send_request(self, request: bytes) -> None:
        """Send a request; frames that an earlier one has left are no answer to it."""
        for _ in range(MOST_DRAINED):
            if self._receive(0.0) is None:
                break
        super().send_request(request)

    def read_response(self) -> bytes:
        """Wait for the answer."""
        deadline = self.now() + self.RESPONSE_TIMEOUT
        while self.responses.empty():
            left = deadline - self.now()
            if left <= 0.0:
                raise SdoCommunicationError("no answer")
            message = self._receive(left)
            if message is not None and message.arbitration_id == self.tx_cobid and len(message.data) == 8:
                self.responses.put(bytes(message.data))
        response: bytes = super().read_response()
        return response

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the EDS has this object."""
        return self.od.get_variable(index, subindex) is not None

    def expected(self, index: int, subindex: int = 0) -> Any:
        """The value of an object in the EDS."""
        return self._variable(index, subindex).default

    def read(self, index: int, subindex: int = 0) -> Any:
        """The value of an object."""
        variable, purpose = self._variable(index, subindex), f"to give object {_named(index, subindex)}"
        return self._transfer(lambda: variable.decode_raw(self.upload(index, subindex)), purpose)

    def write(self, index: int, subindex: int, value: int) -> None:
        """Write an object."""
        data = self._variable(index, subindex).encode_raw(value)
        purpose = f"{_shown(value)} for object {_named(index, subindex)}"
        self._transfer(lambda: self.download(index, subindex, data), purpose)

    def check(self, index: int, subindex: int, value: Any, within: float = 0.0) -> None:
        """Check that an object has this value, or takes it within a time [s]."""
        deadline = self.now() + within
        found = self.read(index, subindex)
        while found != value and self.now() < deadline:
            found = self.read(index, subindex)
        if found != value:
            raise RigError(
                f"{self.name} has {_shown(found)} in object {_named(index, subindex)}; it must be {_shown(value)}: "
                "check that it is the right device with the right firmware"
            )

    def configure(self, index: int, subindex: int, value: int) -> None:
        """Write an object and check that the node has accepted it."""
        self.write(index, subindex, value)
        self.check(index, subindex, value)

    def map_pdo(self, pdo: Pdo) -> None:
        """Configure a PDO and check all of it."""
        cob_id = pdo.cob_id + self.node
        self.write(pdo.communication, Parameter.COB_ID, cob_id | INVALID_COB_ID)
        self.write(pdo.mapping, 0, 0)
        for i, entry in enumerate(pdo.objects):
            self.write(pdo.mapping, i + 1, entry)
        self.configure(pdo.mapping, 0, len(pdo.objects))
        for i, entry in enumerate(pdo.objects):
            self.check(pdo.mapping, i + 1, entry)
        self.configure(pdo.communication, Parameter.TRANSMISSION_TYPE, pdo.transmission_type)
        self.configure(pdo.communication, Parameter.COB_ID, cob_id)

    def _variable(self, index: int, subindex: int) -> Any:
        variable = self.od.get_variable(index, subindex)
        if variable is None:
            raise RigError(f"{self.name} needs object {_named(index, subindex)}, which its EDS does not have: check the EDS")
        return variable

    def _transfer(self, transfer: Callable[[], Any], purpose: str) -> Any:
        reason: Exception | None = None
        for _ in range(_SDO_ATTEMPTS):
            try:
                return transfer()
            except SdoAbortedError as error:
                raise RigError(f"{self.name} refuses {purpose}: {error}; check its EDS") from None
            except (SdoCommunicationError, struct.error, *BUS_ERRORS) as error:
                reason = error
        raise RigError(f"{self.name} does not answer over SDO: {reason}; check its power, wiring and bit rate")


def configure_drive(node: RemoteNode, drives: DriveSettings, period: float, lengths: bool = False) -> None:
    """Configure a drive for commands every `period` [s], and whether it tells what its encoder reads."""
    units, exponent = interpolation_period(period)
    position = drives.holds_positions
    for pdo in (TARGET_PDO if position else COMMAND_PDO, ANSWER_PDO, *([POSITION_PDO] if lengths or position else [])):
        node.map_pdo(pdo)
    node.configure(Object.PRODUCER_HEARTBEAT, 0, round(drives.heartbeat * 1e3))
    node.configure(Object.QUICK_STOP_OPTION, 0, _QUICK_STOP_RAMP)
    for index, subindex, value in (
        (COMMAND_PDO.communication, Parameter.EVENT_TIMER, round(drives.command_timeout * 1e3)),
        (Object.SYNC_OVERFLOW, 0, SYNC_OVERFLOW),
        (Object.DISABLE_OPERATION_OPTION, 0, _DISABLE_AT_ONCE),
        (Object.FAULT_REACTION_OPTION, 0, _FAULT_RAMP),
        (Object.ABORT_CONNECTION_OPTION, 0, _ABORT_BY_QUICK_STOP),
        (Object.INTERPOLATION_PERIOD, 2, exponent),
        (Object.INTERPOLATION_PERIOD, 1, units),
        (Object.MAX_MOTOR_SPEED, 0, round(drives.velocity_limit / drives.screw_lead * drives.gear_ratio * 60.0)),
    ):
        # Not every drive has these; a drive that is told positions must know when to be there.
        if node.has(index, subindex) or (position and index == Object.INTERPOLATION_PERIOD):
            node.configure(index, subindex, value)
    node.configure(Object.QUICK_STOP_DECELERATION, 0, round(drives.quick_stop_deceleration * drives.counts_per_metre))
    if position:
        node.configure(Object.FOLLOWING_WINDOW, 0, round(drives.following_error * drives.counts_per_metre))
    mode = POSITION_MODE if position else VELOCITY_MODE
    node.write(Object.MODE, 0, mode)
    node.check(Object.MODE_DISPLAY, 0, mode, _MODE_TIMEOUT_S)
    if position:
        node.write(Object.TARGET_POSITION, 0, node.read(Object.POSITION_ACTUAL))
    else:
        node.write(Object.TARGET_VELOCITY, 0, 0)


def configure_imu(node: RemoteNode, imu: int, settings: CanopenSettings) -> None:
    """Configure an IMU."""
    for pdo in imu_pdos(settings.bus.fd):
        node.map_pdo(pdo)
        if pdo == MAGNETOMETER_PDO:
            # The magnetometers take turns.
            node.configure(pdo.communication, Parameter.SYNC_START_VALUE, imu + 1)
    node.configure(Object.SYNC_OVERFLOW, 0, SYNC_OVERFLOW)
    node.configure(Object.PRODUCER_HEARTBEAT, 0, round(settings.imus.heartbeat * 1e3))


def switch_on(node: RemoteNode, controller: ControllerSettings) -> int:
    """Reset a drive's fault and lead the drive to Switched on; returns its statusword."""
    # Written each time: a drive begins to watch for the heartbeat at its next one, which comes with the first exchange.
    node.configure(Object.CONSUMER_HEARTBEAT, 1, controller.node << 16 | round(controller.heartbeat_timeout * 1e3))
    deadline = node.now() + _SWITCH_ON_TIMEOUT_S
    code, resets = 0, 0
    while True:
        word = int(node.read(Object.STATUSWORD))
        state = state_of(word)
        if state == PowerState.SWITCHED_ON:
            return word
        if node.now() > deadline or (state == PowerState.FAULT and resets == 2):
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
    """A period [s] in the form of CiA 402's object 60C2h: a number of units (at most 255), and a unit's exponent of ten.

    Raises:
        InputError: the period is longer than 255 s.
    """
    if not period <= 255.0:
        raise InputError(f"the period is {period:g} s, and object 60C2h holds 255 s at most: raise the rate")
    # Drives know the first ones best.
    exponents = (-3, -4, -5, -6, -2, -1, 0)
    exact = (each for each in exponents if abs(period * 10.0**-each - round(period * 10.0**-each)) < 1e-6)
    exponent = next((each for each in exact if 1 <= round(period * 10.0**-each) <= 255), None)
    if exponent is None:
        exponent = min(each for each in exponents if period * 10.0**-each <= 255.0)
    return max(1, round(period * 10.0**-exponent)), exponent


def _named(index: int, subindex: int) -> str:
    return f"{index:04X}h:{subindex:02X}"


def _shown(value: Any) -> str:
    return f"0x{value & 0xFFFFFFFF:X}" if isinstance(value, int) else repr(value)
