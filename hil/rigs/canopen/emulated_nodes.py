"""Emulated nodes of the CANopen rig: CiA 402 drives and IMUs, and the machine whose mechanics and readings they have.

Their object dictionaries are canopen's. The nodes accept the PDO mapping of `hil.rigs.canopen.frames` and refuse any other
over SDO.
"""

import time
from collections.abc import Callable
from typing import Any

import canopen
import numpy as np
from canopen.sdo import SdoAbortedError

from hil.rigs import DriveState, Request
from hil.rigs.canopen.cia402 import (
    HEARTBEAT_LOST,
    PDO_LOST,
    POSITION_MODE,
    VELOCITY_MODE,
    PowerState,
    commanded,
    settled,
    statusword,
)
from hil.rigs.canopen.frames import (
    ANSWER,
    ANSWER_PDO,
    COMMAND_PDO,
    HOME_INPUT,
    INVALID_COB_ID,
    MAGNETOMETER_PDO,
    POSITION,
    POSITION_PDO,
    TARGET_PDO,
    CobId,
    NodeState,
    Object,
    Parameter,
    Pdo,
    imu_pdos,
    int32,
    new_message,
)
from hil.rigs.canopen.settings import CanopenSettings, object_dictionary
from hil.rigs.emulation import EMULATED, move, sample
from plant.compiled import Record
from plant.fmu.plant import FmuPlant

_LARGEST = 2**31 - 1
_CLASSIC_PDO_BITS, _FD_PDO_BITS = 64, 512
_NOT_MAPPABLE, _TOO_LONG, _NOT_NOW, _TOO_HIGH, _TOO_LOW = 0x06040041, 0x06040042, 0x08000022, 0x06090031, 0x06090032
_MODE_UNSUPPORTED = 0x06090030
_DRIVE_ERROR = 0x81


class PlantMachine:
    """The plant that the nodes drive and read, on a clock of its own.

    Args:
        make: makes the plant at its start, its IMUs' imperfections, its encoders, and the drives (dtype `EMULATED`).
        clock: [ns].
    """

    def __init__(
        self, make: Callable[[], tuple[FmuPlant, Record, Record, Record]], clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._make, self._clock = make, clock
        self.rig: Record = np.zeros((), EMULATED)  # the nodes write `request` and `target`, and read the rest
        self._started = 0
        self._begin()
        # The clock starts when the machine code is loaded: a node that waits for it would not answer over SDO in time.
        self.sample(self._started)
        self.advance(self._started)
        self._started = self._clock()

    def _begin(self) -> None:
        self._plant, self._imu, self._encoders, self.rig[()] = self._make()
        self._started = self._clock()

    def advance(self, now_ns: int) -> None:
        """Move the plant on to this time of the machine's clock."""
        self._check(move(self._plant.handle, self.rig, now_ns - self._started))

    def sample(self, now_ns: int) -> None:
        """Read the IMUs and the encoders."""
        self._check(sample(self._plant.handle, self._imu, self._encoders, self.rig, now_ns - self._started))

    def reset(self, drive: int) -> None:
        """Reset a drive's fault."""
        self.rig["reset"][drive] = 1
        self._check(move(self._plant.handle, self.rig, int(self.rig["time_ns"]) + 1))

    def restart(self) -> None:
        """Put the platform back to its start, unless a drive moves or none was ever enabled."""
        if self.rig["enabled_ns"] < 0 or np.isin(self.rig["drive"], (DriveState.FOLLOWING, DriveState.QUICK_STOPPING)).any():
            return
        self._plant.close()
        self._begin()

    def close(self) -> None:
        """Close the plant."""
        self._plant.close()

    def _check(self, status: int) -> None:
        if status:
            raise self._plant.failure()


class EmulatedNode:
    """What drives and IMUs have in common: object dictionary, NMT state, heartbeat and configuration of the PDOs."""

    def __init__(
        self, node: int, eds: Any, pdos: tuple[Pdo, ...], fd: bool, network: canopen.Network, clock: Callable[[], int]
    ) -> None:
        self.node, self.pdos, self.network, self._clock = node, pdos, network, clock
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
            if self.value(pdo.communication, Parameter.COB_ID) == pdo.cob_id + self.node
            and self.value(pdo.communication, Parameter.TRANSMISSION_TYPE) == pdo.transmission_type
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
        if mapped := [pdo for pdo in self.pdos if pdo.mapping == index]:
            self._check_mapping(mapped, subindex, number)
        if index == Object.PRODUCER_HEARTBEAT:
            self.heartbeat_ns = number * 1_000_000
            self.heartbeat_due = self._clock() + self.heartbeat_ns

    def _check_mapping(self, pdos: list[Pdo], subindex: int, number: int) -> None:
        pdo = pdos[0]
        if not self.value(pdo.communication, Parameter.COB_ID) & INVALID_COB_ID or self.state == NodeState.OPERATIONAL:
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
            if objects not in [each.objects for each in pdos]:
                raise SdoAbortedError(_NOT_MAPPABLE)

    def _check_mappable(self, entry: int) -> None:
        found = self.local.object_dictionary.get_variable(entry >> 16, entry >> 8 & 0xFF)
        if found is None or not found.pdo_mappable or len(found) != entry & 0xFF:
            raise SdoAbortedError(_NOT_MAPPABLE)


class EmulatedDrive(EmulatedNode):
    """A CiA 402 drive, whose mechanics are the machine's."""

    def __init__(
        self, leg: int, settings: CanopenSettings, machine: PlantMachine, network: canopen.Network, clock: Callable[[], int]
    ) -> None:
        node, fd = settings.drives.nodes[leg], settings.bus.fd
        self.leg, self.machine = leg, machine
        self.commanded_ns = 0
        self._scale = settings.drives.scales[leg]
        self.answer = new_message(CobId.TPDO + node, dlc=ANSWER.size, is_fd=fd, bitrate_switch=fd)
        self.position_answer = new_message(CobId.TPDO + 0x100 + node, dlc=POSITION.size, is_fd=fd, bitrate_switch=fd)
        self._position = 0
        self.origin = 0  # what the encoder counts at the zero of its readings
        super().__init__(node, settings.drives.eds, (COMMAND_PDO, TARGET_PDO, ANSWER_PDO, POSITION_PDO), fd, network, clock)

    def reset(self) -> None:
        """Return to the values of the EDS, without power."""
        super().reset()
        self.power, self.code, self.controlword, self.target = PowerState.NOT_READY_TO_SWITCH_ON, 0, 0, 0
        self.target_position, self._told_positions, self._rate = 0, False, 0.0
        self._loops["active"][self.leg] = 0
        self.command: tuple[int, int] | None = None
        self.timeout_ns = self.controller = self.consumer_ns = self.controller_ns = self.mode = 0
        self.request()

    def start(self) -> None:
        """Become operational, without a command."""
        super().start()
        self._told_positions = self._mapped(TARGET_PDO, self.value(TARGET_PDO.mapping)) == TARGET_PDO.objects
        self.command = None

    def stop(self, state: NodeState) -> None:
        """Leave the operational state, with a quick stop."""
        super().stop(state)
        if self.power == PowerState.OPERATION_ENABLED:
            self.power = PowerState.QUICK_STOP_ACTIVE
            self.request()

    def _on_read(self, index: int, subindex: int, od: Any) -> int | None:
        faulty = self.power in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)
        values: dict[int, int] = {
            Object.STATUSWORD: self.statusword(),
            Object.ERROR_CODE: self.code,
            Object.VELOCITY_ACTUAL: self.velocity(),
            Object.POSITION_ACTUAL: self.position(),
            Object.DIGITAL_INPUTS: self.inputs(),
            Object.ERROR_REGISTER: _DRIVE_ERROR if faulty else 0,
            Object.MODE_DISPLAY: self.mode,
        }
        return values.get(index)

    def _on_write(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        super()._on_write(index, subindex, od, data)
        number = od.decode_raw(data)
        if index == Object.CONTROLWORD:
            self.settle()
            self.obey(number)
        elif index == Object.TARGET_VELOCITY:
            self.target = number
        elif index == Object.TARGET_POSITION:
            self.target_position = number
        elif index == Object.FOLLOWING_WINDOW:
            self._loops["window"][self.leg] = number / abs(self._scale)
        elif index == Object.MODE:
            if number not in (POSITION_MODE, VELOCITY_MODE):
                raise SdoAbortedError(_MODE_UNSUPPORTED)
            self.mode = number
            self._loops["active"][self.leg] = number == POSITION_MODE
        elif (index, subindex) == (Object.CONSUMER_HEARTBEAT, 1):
            self.controller, self.consumer_ns, self.controller_ns = number >> 16 & 0x7F, (number & 0xFFFF) * 1_000_000, 0
        elif (index, subindex) == (COMMAND_PDO.communication, Parameter.EVENT_TIMER):
            self.timeout_ns = number * 1_000_000

    def statusword(self) -> int:
        """The present statusword."""
        drive = self.machine.rig["drive"][self.leg]
        off_target = self._loops["beyond_for"][self.leg] > 0.0
        follows = drive == DriveState.FOLLOWING
        return statusword(self.power, bool(drive != DriveState.NOT_READY), bool(follows), bool(off_target))

    @property
    def _loops(self) -> Record:
        return self.machine.rig["loops"]

    def velocity(self) -> int:
        """[counts/s]."""
        # A drive with a loop measures it.
        measured = float(self.machine.rig["length_rate"][self.leg]) if self.mode == POSITION_MODE else float("nan")
        velocity = measured if measured == measured else float(self.machine.rig["velocity"][self.leg])
        counts = velocity * self._scale
        return round(min(max(counts, -_LARGEST), _LARGEST)) if counts == counts else 0

    def position(self) -> int:
        """What the encoder reads [counts], in 32 bits; the last value while it reads nothing."""
        read, loops = float(self.machine.rig["length"][self.leg]), self._loops[()]
        if read != read and loops["active"][self.leg] and not loops["unread"][self.leg]:
            # The machine has no encoders with errors of their own; a drive with a loop reads its motor.
            read = float(loops["place"][self.leg])
        counts = read * self._scale
        if counts == counts:
            self._position = int32(self.origin + round(counts))
        return self._position

    def inputs(self) -> int:
        """The digital inputs."""
        return HOME_INPUT if self.machine.rig["home"][self.leg] == 1 else 0

    def obey(self, controlword: int, target: int | None = None) -> None:
        """Let a command take effect, with another target if there is one."""
        before = self.power
        self.power = commanded(before, controlword, self.controlword)
        if target is not None and self._told_positions:
            self.target_position = target
        elif target is not None:
            self.target = target
        self.controlword, self.commanded_ns = controlword, self._clock()
        if self.mode == POSITION_MODE:
            self._interpolate()
        if before == PowerState.FAULT and self.power != PowerState.FAULT:
            self.code = 0
            self.machine.reset(self.leg)
        self.request()

    def _interpolate(self) -> None:
        """Let the goal reach the target position in an interpolation period."""
        rig, leg = self.machine.rig, self.leg
        period = self.value(Object.INTERPOLATION_PERIOD, 1) * 10.0 ** self.value(Object.INTERPOLATION_PERIOD, 2)
        goal = self.origin + round(float(rig["loops"]["goal"][leg]) * self._scale)
        self._rate = int32(self.target_position - goal) / self._scale / period
        rig["until_ns"][leg] = rig["time_ns"] + round(1e9 * period)

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
        data = code.to_bytes(2, "little") + bytes((_DRIVE_ERROR,)) + bytes(5)
        self.network.send_message(CobId.EMERGENCY + self.node, data)

    def request(self) -> None:
        """Pass the power state on to the machine's drive, as a request and a target."""
        rig, leg, power, target = self.machine.rig, self.leg, self.power, 0.0
        if power == PowerState.OPERATION_ENABLED:
            rig["request"][leg] = Request.ENABLED
            target = self._rate if self.mode == POSITION_MODE else self.target / self._scale if self.mode else 0.0
        else:
            stopping = power in (PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
            rig["request"][leg] = Request.QUICK_STOP if stopping else Request.BRAKED
        rig["target"][leg] = target


class EmulatedImu(EmulatedNode):
    """An IMU, whose readings are the machine's."""

    def __init__(self, imu: int, settings: CanopenSettings, network: canopen.Network, clock: Callable[[], int]) -> None:
        node, fd = settings.imus.nodes[imu], settings.bus.fd
        self.imu = imu
        super().__init__(node, settings.imus.eds, imu_pdos(fd), fd, network, clock)
        self.answers = {pdo.cob_id: new_message(pdo.cob_id + node, is_fd=fd, bitrate_switch=fd) for pdo in self.pdos}
        self.magnetometer_start = 0

    def start(self) -> None:
        """Become operational; the magnetometer's turn is as configured."""
        super().start()
        self.magnetometer_start = self.value(MAGNETOMETER_PDO.communication, Parameter.SYNC_START_VALUE)
