"""Settings of the CANopen rig, from a TOML file: bus, node ids, units, signs and gear ratios; and the load on the bus."""

import configparser
from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import ceil, isfinite
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_type_hints

import canopen

from hil.rigs import RigError
from plant.dynamics.variables import IMU_COUNT
from plant.errors import InputError
from plant.mechanism import LEGS
from plant.toml import check_entries, read_toml

DEFAULT_FILE = Path(__file__).with_name("canopen.toml")
INTERFACES = ("socketcan", "udp_multicast", "virtual")
LARGEST_LOAD = 0.9
"""Share of the bus' time that the frames of a cycle may take in the worst case; the rest is for heartbeats and SDO."""

MAGNETOMETER_INTERVAL = 10
"""SYNCs per sample of the magnetometers on classic CAN; each IMU has its own turn."""

COMMAND_BYTES, ANSWER_BYTES, FD_BYTES = 6, 8, 32
"""Of a drive's RPDO; of a drive's TPDO and of an IMU's on classic CAN; of an IMU's one TPDO on CAN FD."""

_LARGEST_NODE = 127
_LONGEST_TIME = 65.535
_INT32 = 2**31 - 1

S = TypeVar("S")


@dataclass(frozen=True)
class BusSettings:
    """The bus, as python-can names it.

    Attributes:
        interface: one of `INTERFACES`.
        channel: such as `can0`, or the multicast group.
        port: of the multicast group.
        hop_limit: of the multicast group; 0 stays on this machine.
        fd: CAN FD, its PDOs with bit rate switching; SDO, NMT, SYNC and heartbeats stay classic frames.
        bitrate: [bit/s].
        data_bitrate: of CAN FD's data phase [bit/s].
    """

    table: ClassVar[str] = "bus"
    interface: str
    channel: str
    port: int
    hop_limit: int
    fd: bool
    bitrate: int
    data_bitrate: int

    def __post_init__(self) -> None:
        if self.interface not in INTERFACES:
            raise InputError(f"[bus] interface is {self.interface!r}; it must be one of {', '.join(INTERFACES)}")
        _check(self, "port", 1, 65535)
        _check(self, "hop_limit", 0, 255)
        _check(self, "bitrate", 10_000, 1_000_000)
        _check(self, "data_bitrate", self.bitrate, 8_000_000)

    def arguments(self) -> dict[str, Any]:
        """What `can.Bus` takes."""
        common: dict[str, Any] = {"interface": self.interface, "channel": self.channel}
        if self.interface == "virtual":
            return common
        if self.interface == "socketcan":
            return common | {"fd": self.fd}
        return common | {"port": self.port, "hop_limit": self.hop_limit, "fd": self.fd}


@dataclass(frozen=True)
class ControllerSettings:
    """The controller's node.

    Attributes:
        node: its id, for its heartbeat.
        heartbeat: [s].
        heartbeat_timeout: after which the drives stop by themselves [s].
        answer_share: of the period, how long an exchange waits for answers.
        boot_timeout: for all nodes to boot up [s].
    """

    table: ClassVar[str] = "controller"
    node: int
    heartbeat: float
    heartbeat_timeout: float
    answer_share: float
    boot_timeout: float

    def __post_init__(self) -> None:
        _check(self, "node", 1, _LARGEST_NODE)
        _check(self, "heartbeat", 0.001, _LONGEST_TIME)
        _check(self, "heartbeat_timeout", 2.0 * self.heartbeat, _LONGEST_TIME)
        _check(self, "answer_share", 0.05, 0.95)
        _check(self, "boot_timeout", 0.01, 60.0)


@dataclass(frozen=True)
class DriveSettings:
    """The six drives, by leg.

    Attributes:
        nodes: their ids.
        signs: of the motor's velocity when the leg extends.
        eds: electronic data sheet; a relative path begins at the folder of the settings file.
        screw_lead: of the actuators' screws [m per turn].
        gear_ratio: turns of the motor per turn of the screw.
        counts_per_turn: of the motor; velocities are in counts per second.
        velocity_limit: commands beyond it are cut [m/s].
        quick_stop_deceleration: [m/s^2].
        heartbeat: of the drives [s].
        silence: after which a drive that says nothing is taken to be off [s].
        command_timeout: without SYNC and commands, after which a drive stops by itself [s].
    """

    table: ClassVar[str] = "drives"
    nodes: tuple[int, ...]
    signs: tuple[int, ...]
    eds: str
    screw_lead: float
    gear_ratio: float
    counts_per_turn: int
    velocity_limit: float
    quick_stop_deceleration: float
    heartbeat: float
    silence: float
    command_timeout: float

    def __post_init__(self) -> None:
        _check_nodes(self, self.nodes, LEGS)
        _check_signs("[drives] signs", self.signs, LEGS)
        _check(self, "counts_per_turn", 1, _INT32)
        for name in ("screw_lead", "gear_ratio", "velocity_limit", "quick_stop_deceleration"):
            _check_positive(self, name)
        for name in ("heartbeat", "command_timeout"):
            _check(self, name, 0.001, _LONGEST_TIME)
        _check(self, "silence", 2.0 * self.heartbeat, _LONGEST_TIME)
        for name in ("velocity_limit", "quick_stop_deceleration"):
            if (counts := getattr(self, name) * self.counts_per_metre) > _INT32:
                raise InputError(
                    f"[drives] {name} is {counts:.3g} counts, more than 32 bits hold: lower it, counts_per_turn or gear_ratio"
                )

    @property
    def counts_per_metre(self) -> float:
        """Counts of the motor per metre of the leg, and so counts per second per m/s."""
        return self.counts_per_turn * self.gear_ratio / self.screw_lead


@dataclass(frozen=True)
class ImuSettings:
    """The seven IMUs: those on the legs, and last the platform's.

    Attributes:
        nodes: their ids.
        signs: of each IMU's three axes.
        eds: electronic data sheet; a relative path begins at the folder of the settings file.
        gyroscope_scale, accelerometer_scale, magnetometer_scale: of one LSB of 16 bits [rad/s, m/s^2, uT].
        heartbeat: [s].
    """

    table: ClassVar[str] = "imus"
    nodes: tuple[int, ...]
    signs: tuple[tuple[int, ...], ...]
    eds: str
    gyroscope_scale: float
    accelerometer_scale: float
    magnetometer_scale: float
    heartbeat: float

    def __post_init__(self) -> None:
        _check_nodes(self, self.nodes, IMU_COUNT)
        if len(self.signs) != IMU_COUNT:
            raise InputError(f"[imus] signs has {len(self.signs)} entries; {IMU_COUNT} are needed, one per IMU")
        for imu, signs in enumerate(self.signs):
            _check_signs(f"[imus] signs of IMU {imu}", signs, 3)
        for name in ("gyroscope_scale", "accelerometer_scale", "magnetometer_scale"):
            _check_positive(self, name)
        _check(self, "heartbeat", 0.001, _LONGEST_TIME)

    @property
    def scales(self) -> tuple[float, float, float]:
        """Of gyroscope, accelerometer and magnetometer."""
        return self.gyroscope_scale, self.accelerometer_scale, self.magnetometer_scale


@dataclass(frozen=True)
class CanopenSettings:
    """Settings of the CANopen rig.

    Attributes:
        bus: what it is connected to.
        controller: this side.
        drives: the six drives.
        imus: the seven IMUs.
        folder: at which the paths of the EDS files begin.
    """

    bus: BusSettings
    controller: ControllerSettings
    drives: DriveSettings
    imus: ImuSettings
    folder: Path = DEFAULT_FILE.parent

    def __post_init__(self) -> None:
        owners = {self.controller.node: "the controller"}
        for kind, nodes in (("drive", self.drives.nodes), ("IMU", self.imus.nodes)):
            for number, node in enumerate(nodes):
                if node in owners:
                    raise InputError(f"{kind} {number} and {owners[node]} have the same node id {node}: each needs its own")
                owners[node] = f"{kind} {number}"
        for eds in (self.drive_eds, self.imu_eds):
            if not eds.is_file():
                raise InputError(f"there is no EDS file {eds}: name the one of the node's manufacturer")

    @property
    def drive_eds(self) -> Path:
        """Electronic data sheet of the drives."""
        return self.folder / self.drives.eds

    @property
    def imu_eds(self) -> Path:
        """Electronic data sheet of the IMUs."""
        return self.folder / self.imus.eds

    def bus_load(self, rate: float) -> float:
        """Share of the bus' time that the frames of a cycle take at `rate` [Hz], with as many stuff bits as there can be: the
        PDOs, SYNC and a heartbeat; on classic CAN two frames per IMU and one magnetometer's.
        """
        bus = self.bus
        if bus.fd:
            drive = sum(fd_duration(count, bus.bitrate, bus.data_bitrate) for count in (COMMAND_BYTES, ANSWER_BYTES))
            imus = IMU_COUNT * fd_duration(FD_BYTES, bus.bitrate, bus.data_bitrate)
        else:
            drive = (classic_bits(COMMAND_BYTES) + classic_bits(ANSWER_BYTES)) / bus.bitrate
            imus = (2 * IMU_COUNT + 1) * classic_bits(ANSWER_BYTES) / bus.bitrate
        return (LEGS * drive + imus + 2 * classic_bits(1) / bus.bitrate) * rate

    def check_bus_load(self, rate: float) -> float:
        """The bus load at `rate` [Hz]; on a bus that is only emulated it may be any.

        Raises:
            RigError: it is more than a real bus can carry.
        """
        load = self.bus_load(rate)
        if self.bus.interface == "socketcan" and load > LARGEST_LOAD:
            remedy = "" if self.bus.fd else ", or use CAN FD"
            highest = int(LARGEST_LOAD / self.bus_load(1.0))
            raise RigError(
                f"at {rate:g} Hz the frames of a cycle take {load:.0%} of the bus' time, more than {LARGEST_LOAD:.0%}: "
                f"lower the rate to {highest} Hz, raise the bit rate{remedy}"
            )
        return load


def object_dictionary(eds: Path, node: int) -> Any:
    """The object dictionary (canopen's) of a node.

    Raises:
        InputError: the file is no EDS.
    """
    try:
        dictionary = canopen.import_od(str(eds), node_id=node)
    except (configparser.Error, LookupError, ValueError, OSError, canopen.ObjectDictionaryError) as error:
        raise InputError(f"{eds} is no EDS file that can be used: {error}") from None
    if 0x1000 not in dictionary or 0x1018 not in dictionary:
        raise InputError(f"{eds} lacks object 1000h or 1018h: use the EDS of the node's manufacturer")
    return dictionary


def classic_bits(count: int) -> int:
    """Bits on the wire of a classic frame with an 11-bit identifier and `count` bytes, with the most stuff bits and the space
    between frames.
    """
    return 47 + 8 * count + (34 + 8 * count - 1) // 4


def fd_duration(count: int, bitrate: int, data_bitrate: int) -> float:
    """Duration [s] of a CAN FD frame with an 11-bit identifier and `count` bytes, bit rate switched, with the most stuff bits.

    At the nominal bit rate: start, identifier and flags until BRS (17 bits), and from the CRC delimiter to the space between
    frames (13). At the data bit rate: ESI, DLC, data, stuff count and CRC with fixed stuff bits.
    """
    crc = 4 + (17 if count <= 16 else 21)
    head, body = 17, 5 + 8 * count
    stuff_of_head = (head - 1) // 4
    stuff_of_body = (head + body - 1) // 4 - stuff_of_head
    return (head + stuff_of_head + 13) / bitrate + (body + stuff_of_body + crc + ceil(crc / 4)) / data_bitrate


def canopen_settings(path: Path | str = DEFAULT_FILE, **changes: Mapping[str, Any]) -> CanopenSettings:
    """Read the settings of a CANopen rig.

    Args:
        path: a TOML file with all the entries that the default one has.
        changes: by table, such as `bus={"interface": "virtual"}`.

    Raises:
        InputError: the file cannot be read, or an entry is missing, unknown or out of range.
    """
    path = Path(path)
    document = read_toml(path)
    names = {kind.table for kind in (BusSettings, ControllerSettings, DriveSettings, ImuSettings)}
    for name in [*document, *changes]:
        if name not in names:
            raise InputError(f"{path} has a table [{name}] that is not known; the tables are {', '.join(sorted(names))}")
    tables = {name: {**document.get(name, {}), **changes.get(name, {})} for name in names}
    return CanopenSettings(
        _read(BusSettings, tables["bus"]),
        _read(ControllerSettings, tables["controller"]),
        _read(DriveSettings, tables["drives"]),
        _read(ImuSettings, tables["imus"]),
        path.resolve().parent,
    )


def _read(kind: type[S], table: Mapping[str, Any]) -> S:
    title = f"[{kind.table}]"  # type: ignore[attr-defined]
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    hints = get_type_hints(kind)
    check_entries(table, known, title)
    values = {}
    for name in known:
        if name not in table:
            raise InputError(f"{title} lacks the entry {name!r}")
        value = _frozen(table[name])
        wanted = hints[name]
        if wanted is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if wanted in (bool, int, float, str) and type(value) is not wanted:
            raise InputError(f"{title} {name} must be a {wanted.__name__}, got {value!r}")
        if wanted not in (bool, int, float, str) and not isinstance(value, tuple):
            raise InputError(f"{title} {name} must be a list, got {value!r}")
        values[name] = value
    return kind(**values)


def _frozen(value: Any) -> Any:
    return tuple(_frozen(each) for each in value) if isinstance(value, list | tuple) else value


def _check(settings: Any, name: str, lowest: float, highest: float) -> None:
    value = getattr(settings, name)
    if not lowest <= value <= highest:
        raise InputError(f"[{settings.table}] {name} is {value:g}; it must be from {lowest:g} to {highest:g}")


def _check_positive(settings: Any, name: str) -> None:
    value = getattr(settings, name)
    if not (isfinite(value) and value > 0.0):
        raise InputError(f"[{settings.table}] {name} is {value:g}; it must be positive and finite")


def _check_nodes(settings: Any, nodes: tuple[Any, ...], count: int) -> None:
    if len(nodes) != count:
        raise InputError(f"[{settings.table}] nodes has {len(nodes)} entries; {count} are needed")
    for node in nodes:
        if type(node) is not int or not 1 <= node <= _LARGEST_NODE:
            raise InputError(f"[{settings.table}] nodes has {node!r}; a node id is a number from 1 to {_LARGEST_NODE}")


def _check_signs(name: str, signs: Any, count: int) -> None:
    if not isinstance(signs, tuple) or len(signs) != count or any(type(s) is not int or s not in (-1, 1) for s in signs):
        raise InputError(f"{name} is {signs!r}; it must be {count} numbers, each 1 or -1")
