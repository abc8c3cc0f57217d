"""Emulated nodes of the CANopen rig: CiA 402 drives and IMUs, whose mechanics and readings are a machine's.

Their object dictionaries are canopen's. The nodes accept the PDO mapping of `hil.rigs.canopen.objects` and refuse any other
over SDO.
"""

import time
from collections.abc import Callable
from typing import Any, Protocol

import can
import canopen
from canopen.sdo import SdoAbortedError

from hil.rigs import DriveState, Request
from hil.rigs.canopen.cia402 import (
    CYCLIC_SYNCHRONOUS_VELOCITY,
    HEARTBEAT_LOST,
    PDO_LOST,
    PowerState,
    commanded,
    settled,
    statusword,
)
from hil.rigs.canopen.frames import ANSWER, CobId, NodeState, new_message
from hil.rigs.canopen.objects import (
    COB_ID,
    COMMAND_PDO,
    DRIVE_PDOS,
    EVENT_TIMER,
    INVALID_COB_ID,
    MAGNETOMETER_PDO,
    SYNC_START_VALUE,
    TRANSMISSION_TYPE,
    Object,
    Pdo,
    imu_pdos,
)
from hil.rigs.canopen.settings import CanopenSettings, object_dictionary

Send = Callable[[can.Message], None]

_LARGEST = 2**31 - 1
_CLASSIC_PDO_BITS, _FD_PDO_BITS = 64, 512
_NOT_MAPPABLE, _TOO_LONG, _NOT_NOW, _TOO_HIGH, _TOO_LOW = 0x06040041, 0x06040042, 0x08000022, 0x06090031, 0x06090032
_MODE_UNSUPPORTED = 0x06090030
_DRIVE_ERROR = 0x81


class Machine(Protocol):
    """What the nodes drive and read.

    Attributes:
        rig: arrays by name, as the fields of `hil.rigs.emulation.drives.EMULATED`: the nodes write `request` and `target`, and
            read `drive`, `code`, `velocity`, `measurement`, `sample_ns`, `sequence` and, for CAN FD, `truth`.
    """

    rig: Any

    def advance(self, now_ns: int) -> None:
        """Move the machine on to a time [ns]."""

    def sample(self, now_ns: int) -> None:
        """Take a sample of the IMUs at a time [ns]."""

    def reset(self, drive: int) -> None:
        """Clear a drive's fault, if its cause is gone; `drive` shows it at once."""

    def restart(self) -> None:
        """A node has been reset."""


class Network(canopen.Network):  # type: ignore[misc]
    """A network whose object dictionaries send their answers with the nodes' own `send`."""

    def __init__(self, send: Send) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a frame."""
        self._send(new_message(can_id, data, is_remote_frame=remote))


class EmulatedNode:
    """What drives and IMUs have in common: object dictionary, NMT state, heartbeat and configuration of the PDOs."""

    def __init__(self, name: str, node: int, eds: Any, pdos: tuple[Pdo, ...], fd: bool, network: Network) -> None:
        self.name, self.node, self.pdos = name, node, pdos
        self.local = canopen.LocalNode(node, object_dictionary(eds, node))
        # canopen's own callback would start a thread that sends the heartbeat.
        self.local._write_callbacks.clear()
        self.local.add_write_callback(self._on_write)
        self.local.add_read_callback(self._on_read)
        self.local.associate_network(network)
        self.heartbeat_due = 0
        self._most_bits = _FD_PDO_BITS if fd else _CLASSIC_PDO_BITS

    def value(self, index: int, subindex: int = 0) -> int:
        """A number in the object dictionary."""
        entry = self.local.sdo[index]
        return int((entry[subindex] if subindex or not hasattr(entry, "raw") else entry).raw)

    def reset(self) -> None:
        """Return to the values of the EDS."""
        self.local.data_store.clear()
        self.heartbeat_ns, self.state = 0, NodeState.PRE_OPERATIONAL
        self.active: frozenset[int] = frozenset()

    def start(self) -> None:
        """Become operational, with the PDOs that are configured."""
        self.state = NodeState.OPERATIONAL
        self.active = frozenset(
            pdo.cob_id
            for pdo in self.pdos
            if self.value(pdo.communication, COB_ID) == pdo.cob_id + self.node
            and self.value(pdo.communication, TRANSMISSION_TYPE) == pdo.transmission_type
            and self._mapped(pdo, self.value(pdo.mapping)) == pdo.objects
        )

    def stop(self, state: NodeState) -> None:
        """Leave the operational state."""
        self.state, self.active = state, frozenset()

    def _mapped(self, pdo: Pdo, count: int) -> tuple[int, ...]:
        return tuple(self.value(pdo.mapping, i + 1) for i in range(count))

    def _on_read(self, index: int, subindex: int, od: Any) -> int | None:
        return None

    def _on_write(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        number = od.decode_raw(data)
        if od.max is not None and number > od.max:
            raise SdoAbortedError(_TOO_HIGH)
        if od.min is not None and number < od.min:
            raise SdoAbortedError(_TOO_LOW)
        for pdo in self.pdos:
            if index == pdo.mapping:
                self._check_mapping(pdo, subindex, number)
        if index == Object.PRODUCER_HEARTBEAT:
            self.heartbeat_ns = number * 1_000_000
            self.heartbeat_due = time.monotonic_ns() + self.heartbeat_ns

    def _check_mapping(self, pdo: Pdo, subindex: int, number: int) -> None:
        if not self.value(pdo.communication, COB_ID) & INVALID_COB_ID or self.state == NodeState.OPERATIONAL:
            raise SdoAbortedError(_NOT_NOW)
        if subindex:
            if self.value(pdo.mapping):
                raise SdoAbortedError(_NOT_NOW)
            if number:
                self._check_mappable(number)
        elif number:
            objects = self._mapped(pdo, number)
            if sum(each & 0xFF for each in objects) > self._most_bits:
                raise SdoAbortedError(_TOO_LONG)
            if objects != pdo.objects:
                raise SdoAbortedError(_NOT_MAPPABLE)

    def _check_mappable(self, entry: int) -> None:
        index, subindex, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        dictionary = self.local.object_dictionary
        found = dictionary.get(index)
        if isinstance(found, canopen.objectdictionary.ODRecord | canopen.objectdictionary.ODArray):
            found = found.get(subindex)
        if found is None or not found.pdo_mappable or len(found) != bits:
            raise SdoAbortedError(_NOT_MAPPABLE)


class EmulatedDrive(EmulatedNode):
    """A CiA 402 drive, whose mechanics are the machine's."""

    def __init__(self, leg: int, settings: CanopenSettings, machine: Machine, network: Network, send: Send) -> None:
        node, fd = settings.drives.nodes[leg], settings.bus.fd
        self.leg, self.machine = leg, machine
        self.commanded_ns = 0
        self._scale = settings.drives.scales[leg]
        self._send = send
        self.answer = new_message(CobId.TPDO + node, dlc=ANSWER.size, is_fd=fd, bitrate_switch=fd)
        super().__init__(f"drive {leg}", node, settings.drive_eds, DRIVE_PDOS, fd, network)

    def reset(self) -> None:
        """Return to the values of the EDS, without power."""
        super().reset()
        self.power, self.code, self.controlword, self.target = PowerState.NOT_READY_TO_SWITCH_ON, 0, 0, 0
        self.command: tuple[int, int] | None = None
        self.timeout_ns = self.controller = self.consumer_ns = self.controller_ns = self.mode = 0
        self.request()

    def start(self) -> None:
        """Become operational, without a command."""
        super().start()
        self.command = None

    def stop(self, state: NodeState) -> None:
        """Leave the operational state, with a quick stop."""
        super().stop(state)
        if self.power == PowerState.OPERATION_ENABLED:
            self.power = PowerState.QUICK_STOP_ACTIVE
            self.request()

    def _on_read(self, index: int, subindex: int, od: Any) -> int | None:
        if index == Object.STATUSWORD:
            return self.statusword()
        if index == Object.ERROR_CODE:
            return self.code
        if index == Object.VELOCITY_ACTUAL:
            return self.velocity()
        if index == Object.ERROR_REGISTER:
            return _DRIVE_ERROR if self.power in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE) else 0
        return self.mode if index == Object.MODE_DISPLAY else None

    def _on_write(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        super()._on_write(index, subindex, od, data)
        number = od.decode_raw(data)
        if index == Object.CONTROLWORD:
            self.settle()
            self.obey(number, self.target)
        elif index == Object.TARGET_VELOCITY:
            self.target = number
        elif index == Object.MODE:
            if number != CYCLIC_SYNCHRONOUS_VELOCITY:
                raise SdoAbortedError(_MODE_UNSUPPORTED)
            self.mode = number
        elif (index, subindex) == (Object.CONSUMER_HEARTBEAT, 1):
            self.controller, self.consumer_ns, self.controller_ns = number >> 16 & 0x7F, (number & 0xFFFF) * 1_000_000, 0
        elif (index, subindex) == (COMMAND_PDO.communication, EVENT_TIMER):
            self.timeout_ns = number * 1_000_000

    def statusword(self) -> int:
        """The present statusword."""
        drive = self.machine.rig["drive"][self.leg]
        return statusword(self.power, bool(drive != DriveState.NOT_READY), bool(drive == DriveState.FOLLOWING))

    def velocity(self) -> int:
        """[counts/s]."""
        counts = float(self.machine.rig["velocity"][self.leg]) * self._scale
        return round(min(max(counts, -_LARGEST), _LARGEST)) if counts == counts else 0

    def obey(self, controlword: int, target: int) -> None:
        """Let a command take effect."""
        before = self.power
        self.power = commanded(before, controlword, self.controlword)
        self.controlword, self.target, self.commanded_ns = controlword, target, time.monotonic_ns()
        if before == PowerState.FAULT and self.power != PowerState.FAULT:
            self.code = 0
            self.machine.reset(self.leg)
        self.request()

    def settle(self) -> None:
        """Follow what the machine's drive does by itself."""
        drive = int(self.machine.rig["drive"][self.leg])
        if drive == DriveState.NOT_READY:
            self.power = PowerState.NOT_READY_TO_SWITCH_ON
        elif self.power == PowerState.NOT_READY_TO_SWITCH_ON:
            self.power = PowerState.SWITCH_ON_DISABLED
        if drive == DriveState.FAULTY and self.power not in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE):
            self.power = PowerState.FAULT
            self._report(int(self.machine.rig["code"][self.leg]))
        elif drive in (DriveState.READY, DriveState.FAULTY):
            self.power = settled(self.power)
        self.request()

    def watch(self, now_ns: int) -> None:
        """Stop if the controller is gone."""
        if self.consumer_ns and self.controller_ns and now_ns - self.controller_ns > self.consumer_ns:
            self.controller_ns = 0
            self._miss(HEARTBEAT_LOST)
        enabled = self.power == PowerState.OPERATION_ENABLED
        if self.timeout_ns and enabled and now_ns - self.commanded_ns > self.timeout_ns:
            self._miss(PDO_LOST)

    def _miss(self, code: int) -> None:
        if self.power in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE):
            self.power = PowerState.FAULT_REACTION_ACTIVE
        elif self.power == PowerState.SWITCHED_ON:
            self.power = PowerState.FAULT
        else:
            return
        self.request()
        self._report(code)

    def _report(self, code: int) -> None:
        self.code = code
        self._send(new_message(CobId.EMERGENCY + self.node, code.to_bytes(2, "little") + bytes((_DRIVE_ERROR,)) + bytes(5)))

    def request(self) -> None:
        """Pass the power state on to the machine's drive, as a request and a target."""
        rig, leg, power, target = self.machine.rig, self.leg, self.power, 0.0
        if power == PowerState.OPERATION_ENABLED:
            rig["request"][leg] = Request.ENABLED
            target = self.target / self._scale if self.mode == CYCLIC_SYNCHRONOUS_VELOCITY else 0.0
        else:
            stopping = power in (PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
            rig["request"][leg] = Request.QUICK_STOP if stopping else Request.BRAKED
        rig["target"][leg] = target


class EmulatedImu(EmulatedNode):
    """An IMU, whose readings are the machine's."""

    def __init__(self, imu: int, settings: CanopenSettings, network: Network) -> None:
        node, fd = settings.imus.nodes[imu], settings.bus.fd
        self.imu = imu
        super().__init__(f"IMU {imu}", node, settings.imu_eds, imu_pdos(fd), fd, network)
        self.answers = {pdo.cob_id: new_message(pdo.cob_id + node, is_fd=fd, bitrate_switch=fd) for pdo in self.pdos}
        self.magnetometer_start = 0

    def start(self) -> None:
        """Become operational; the magnetometer's turn is as configured."""
        super().start()
        self.magnetometer_start = self.value(MAGNETOMETER_PDO.communication, SYNC_START_VALUE)
