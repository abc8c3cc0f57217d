"""Settings of the CANopen rig, from a TOML file: bus, node ids, units, signs and gear ratios; and the load on the bus."""

import configparser
import os
import socket
import sys
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from math import ceil, isfinite
from pathlib import Path
from typing import Any

import can
import canopen
import numpy as np
from numpy.typing import NDArray

from hil.rigs import RigError
from plant.errors import InputError
from plant.files import check_entries, read_toml
from plant.imu_wiring import IMU_COUNT, SLOTS
from plant.mechanism import LEGS

DEFAULT_FILE = Path(__file__).with_name("canopen.toml")
MODES = VELOCITY, POSITION = "velocity", "position"
INTERFACES = ("socketcan", "udp_multicast", "virtual")
LARGEST_LOAD = 0.9
"""The largest share of the bus' time for the frames of a cycle in the worst case; the rest is for heartbeats and SDO."""

MAGNETOMETER_INTERVAL = 10
"""SYNCs per sample of the magnetometers on classic CAN; each IMU has its own turn."""

COMMAND_BYTES, ANSWER_BYTES, FD_BYTES = 6, 8, 32
"""Length of a drive's RPDO; of a drive's TPDO and of an IMU's on classic CAN; of an IMU's one TPDO on CAN FD."""

_LONGEST_TIME = 65.535
_INT32 = 2**31 - 1


@dataclass(frozen=True)
class Check:
    """What the value of an entry must be; a call with the entry's name and value raises an `InputError` if it is not."""

    hold: Callable[[Any], bool]
    text: str
    shown: Callable[[Any], str] = repr
    each: "Check | None" = None  # of the elements of a list

    def __call__(self, name: str, value: Any) -> None:
        """Check a value."""
        if not self.hold(value):
            raise InputError(f"{name} is {self.shown(value)}; it must be {self.text}")
        if self.each is not None:
            for i, element in enumerate(value):
                self.each(f"{name}[{i}]", element)


def _entry(text: str, check: Check = Check(lambda _: True, ""), **default: Any) -> Any:
    """An entry of a table: its meaning, a check of its value, and `default`, if it can be left out."""
    return field(**default, metadata={"text": text, "check": check})


def _within(lowest: float, highest: float) -> Check:
    return Check(lambda value: lowest <= value <= highest, f"from {lowest:g} to {highest:g}", "{:g}".format)


def _one_of(*values: object) -> Check:
    return Check(lambda value: type(value) is type(values[0]) and value in values, f"one of {', '.join(map(str, values))}")


def _list_of(counts: int | tuple[int, ...], check_element: Check) -> Check:
    allowed = counts if isinstance(counts, tuple) else (counts,)
    return Check(
        lambda values: isinstance(values, tuple) and len(values) in allowed,
        f"a list of {' or '.join(map(str, allowed))}",
        each=check_element,
    )


_TIME = _within(0.001, _LONGEST_TIME)
_POSITIVE = Check(lambda value: isfinite(value) and value > 0.0, "positive and finite", "{:g}".format)
_NODE_ID = Check(lambda value: type(value) is int and 1 <= value <= 127, "a whole number from 1 to 127")


def _confine_to_loopback(bus: can.BusABC, group: str) -> None:
    """Let a multicast bus of python-can, which listens on every interface, listen and send on the loopback alone."""
    loopback = socket.if_nametoindex("lo")
    with socket.socket(fileno=os.dup(bus.fileno())) as opened:
        address = socket.inet_pton(opened.family, str(socket.getaddrinfo(group, None, opened.family)[0][4][0]))
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
        index = loopback.to_bytes(4, sys.byteorder)
        if opened.family == socket.AF_INET:
            nowhere = bytes(4)
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_DROP_MEMBERSHIP, address + nowhere)
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, address + nowhere + index)
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, address + nowhere + index)
        else:
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_LEAVE_GROUP, address + bytes(4))
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, address + index)
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, loopback)


@dataclass(frozen=True)
class BusSettings:
    """The bus, as python-can names it."""

    interface: str = _entry(f"one of {', '.join(INTERFACES)}", _one_of(*INTERFACES))
    channel: str = _entry("such as can0, or the multicast group")
    port: int = _entry("port of the multicast group", _within(1, 65535))
    hop_limit: int = _entry("hop limit of the multicast group; 0 keeps to this machine's loopback", _within(0, 255))
    fd: bool = _entry("CAN FD, PDOs with bit rate switching; SDO, NMT, SYNC and heartbeats stay classic frames")
    bitrate: int = _entry("[bit/s]", _within(10_000, 1_000_000))
    data_bitrate: int = _entry("bit rate of CAN FD's data phase [bit/s], at least the other one")

    def __post_init__(self) -> None:
        _within(self.bitrate, 8_000_000)("[bus] data_bitrate", self.data_bitrate)

    def arguments(self) -> dict[str, Any]:
        """The arguments of `can.Bus`."""
        needed = {"virtual": (), "socketcan": ("fd",), "udp_multicast": ("port", "hop_limit", "fd")}[self.interface]
        return {name: getattr(self, name) for name in ("interface", "channel", *needed)}

    def opened(self) -> can.BusABC:
        """The bus, opened. A multicast group without hops neither hears nor reaches anything but this machine's loopback.

        Raises:
            can.CanError, OSError: it cannot be opened.
        """
        bus = can.Bus(**self.arguments())
        if self.interface == "udp_multicast" and self.hop_limit == 0:
            try:
                _confine_to_loopback(bus, self.channel)
            except OSError:
                bus.shutdown()
                raise
        return bus


@dataclass(frozen=True)
class ControllerSettings:
    """The controller's node."""

    node: int = _entry("node id, for the heartbeat", _NODE_ID)
    heartbeat: float = _entry("interval of the heartbeats [s]", _TIME)
    heartbeat_timeout: float = _entry("time without a heartbeat after which the drives stop by themselves [s]")
    answer_share: float = _entry("share of the period that an exchange waits for answers", _within(0.05, 0.95))
    boot_timeout: float = _entry("time for all nodes to boot up [s]", _within(0.01, 60.0))

    def __post_init__(self) -> None:
        _within(2.0 * self.heartbeat, _LONGEST_TIME)("[controller] heartbeat_timeout", self.heartbeat_timeout)


@dataclass(frozen=True)
class DriveSettings:
    """The six drives, by leg."""

    nodes: tuple[int, ...] = _entry("node ids", _list_of(LEGS, _NODE_ID))
    signs: tuple[int, ...] = _entry("signs of the motors' velocities when the legs extend", _list_of(LEGS, _one_of(1, -1)))
    eds: str = _entry("electronic data sheet; a relative path begins at the folder of the settings file")
    screw_lead: float = _entry("lead of the actuators' screws [m per turn]", _POSITIVE)
    gear_ratio: float = _entry("turns of the motor per turn of the screw", _POSITIVE)
    counts_per_turn: int = _entry("of the motor; velocities are in counts per second", _within(1, _INT32))
    velocity_limit: float = _entry("larger commands are cut to it [m/s]", _POSITIVE)
    quick_stop_deceleration: float = _entry("[m/s^2]", _POSITIVE)
    heartbeat: float = _entry("interval of the heartbeats [s]", _TIME)
    silence: float = _entry("time after which a silent drive counts as not ready [s]")
    command_timeout: float = _entry("time without SYNC and commands after which a drive stops by itself [s]", _TIME)
    mode: str = _entry("of operation: cyclic synchronous velocity or position", _one_of(*MODES), default=VELOCITY)
    following_error: float = _entry("in position mode, beyond which a drive has a fault [m]", _POSITIVE, default=0.005)

    def __post_init__(self) -> None:
        _within(2.0 * self.heartbeat, _LONGEST_TIME)("[drives] silence", self.silence)
        for name in ("velocity_limit", "quick_stop_deceleration", "following_error"):
            if (counts := getattr(self, name) * self.counts_per_metre) > _INT32:
                raise InputError(
                    f"[drives] {name} is {counts:.3g} counts, more than 32 bits hold: lower it, counts_per_turn or gear_ratio"
                )

    @property
    def counts_per_metre(self) -> float:
        """Counts of the motor per metre of the leg, and so counts per second per m/s."""
        return self.counts_per_turn * self.gear_ratio / self.screw_lead

    @property
    def holds_positions(self) -> bool:
        """Whether the drives are told positions, and close a loop around their encoders."""
        return self.mode == POSITION

    @property
    def scales(self) -> list[float]:
        """Counts/s per m/s of each drive, with its sign."""
        return [sign * self.counts_per_metre for sign in self.signs]


@dataclass(frozen=True)
class ImuSettings:
    """The seven IMUs: those on the legs, then the platform's; with --base-imu, that on the base comes last."""

    nodes: tuple[int, ...] = _entry("node ids", _list_of((IMU_COUNT, SLOTS), _NODE_ID))
    signs: tuple[tuple[int, ...], ...] = _entry("signs of the axes", _list_of((IMU_COUNT, SLOTS), _list_of(3, _one_of(1, -1))))
    eds: str = _entry("electronic data sheet; a relative path begins at the folder of the settings file")
    gyroscope_scale: float = _entry("value of one LSB of 16 bits [rad/s]", _POSITIVE)
    accelerometer_scale: float = _entry("value of one LSB of 16 bits [m/s^2]", _POSITIVE)
    magnetometer_scale: float = _entry("value of one LSB of 16 bits [uT]", _POSITIVE)
    heartbeat: float = _entry("interval of the heartbeats [s]", _TIME)

    def __post_init__(self) -> None:
        if len(self.nodes) != len(self.signs):
            raise InputError(f"[imus] has {len(self.nodes)} nodes and signs of {len(self.signs)}: give as many of both")

    @property
    def scales(self) -> NDArray[np.float64]:
        """Value of an LSB of each axis (3, n, 3) [rad/s, m/s^2, uT], with its sign."""
        scales = self.gyroscope_scale, self.accelerometer_scale, self.magnetometer_scale
        return np.multiply.outer(scales, np.array(self.signs, np.float64))


@dataclass(frozen=True)
class CanopenSettings:
    """Settings of the CANopen rig: the tables of the file, with absolute paths of the EDS files."""

    bus: BusSettings
    controller: ControllerSettings
    drives: DriveSettings
    imus: ImuSettings

    def __post_init__(self) -> None:
        owners = {self.controller.node: "the controller"}
        for kind, table in (("drive", self.drives), ("IMU", self.imus)):
            for number, node in enumerate(table.nodes):
                if node in owners:
                    raise InputError(f"{kind} {number} and {owners[node]} have the same node id {node}: each needs its own")
                owners[node] = f"{kind} {number}"
        for eds in (self.drives.eds, self.imus.eds):
            if not Path(eds).is_file():
                raise InputError(f"there is no EDS file {eds}: name the one of the node's manufacturer")

    def bus_load(self, rate: float, lengths: bool = False) -> float:
        """Share of the bus' time that the frames of a cycle take at `rate` [Hz] with the most stuff bits: the PDOs, SYNC and a
        heartbeat; on classic CAN two frames per IMU and one magnetometer's. With `lengths`, or if it is told positions, each
        drive has another frame.
        """
        lengths = lengths or self.drives.holds_positions
        count = len(self.imus.nodes)
        bus, of_drive = self.bus, (COMMAND_BYTES, ANSWER_BYTES, *([ANSWER_BYTES] if lengths else []))
        if bus.fd:
            drive = sum(fd_duration(count, bus.bitrate, bus.data_bitrate) for count in of_drive)
            imus = count * fd_duration(FD_BYTES, bus.bitrate, bus.data_bitrate)
        else:
            drive = sum(map(classic_bits, of_drive)) / bus.bitrate
            imus = (2 * count + 1) * classic_bits(ANSWER_BYTES) / bus.bitrate
        return (LEGS * drive + imus + 2 * classic_bits(1) / bus.bitrate) * rate

    def check_bus_load(self, rate: float, lengths: bool = False) -> float:
        """The bus load at `rate` [Hz]; an emulated bus has no limit.

        Raises:
            RigError: a real bus cannot carry the load.
        """
        load = self.bus_load(rate, lengths)
        if self.bus.interface == "socketcan" and load > LARGEST_LOAD:
            remedy = "" if self.bus.fd else ", or use CAN FD"
            highest = int(LARGEST_LOAD / self.bus_load(1.0, lengths))
            raise RigError(
                f"at {rate:g} Hz the frames of a cycle take {load:.0%} of the bus' time, more than {LARGEST_LOAD:.0%}: "
                f"lower the rate to {highest} Hz, raise the bit rate{remedy}"
            )
        return load


TABLES: dict[str, Any] = {
    "bus": BusSettings,
    "controller": ControllerSettings,
    "drives": DriveSettings,
    "imus": ImuSettings,
}
"""The tables of the file, and what they are read as."""


def object_dictionary(eds: str, node: int) -> Any:
    """The object dictionary (canopen's) of a node.

    Raises:
        InputError: the file is not an EDS.
    """
    try:
        dictionary = canopen.import_od(eds, node_id=node)
    except (configparser.Error, LookupError, ValueError, OSError, canopen.ObjectDictionaryError) as error:
        raise InputError(f"{eds} is not a usable EDS file: {error}") from None
    if 0x1000 not in dictionary or 0x1018 not in dictionary:
        raise InputError(f"{eds} lacks object 1000h or 1018h: use the EDS of the node's manufacturer")
    return dictionary


def classic_bits(count: int) -> int:
    """Bits on the wire of a classic frame with an 11-bit identifier and `count` bytes, with the most stuff bits and the
    interframe space.
    """
    return 47 + 8 * count + (34 + 8 * count - 1) // 4


def fd_duration(count: int, bitrate: int, data_bitrate: int) -> float:
    """Duration [s] of a CAN FD frame with an 11-bit identifier and `count` bytes, bit rate switched, with the most stuff bits.

    At the nominal bit rate: start, identifier and flags until BRS (17 bits), and from the CRC delimiter to the interframe space
    (13). At the data bit rate: ESI, DLC, data, stuff count and CRC with fixed stuff bits.
    """
    crc = 4 + (17 if count <= 16 else 21)
    head, body = 17, 5 + 8 * count
    stuff_of_head = (head - 1) // 4
    stuff_of_body = (head + body - 1) // 4 - stuff_of_head
    return (head + stuff_of_head + 13) / bitrate + (body + stuff_of_body + crc + ceil(crc / 4)) / data_bitrate


def canopen_settings(
    path: Path | str = DEFAULT_FILE, base_imu: bool = False, **changes: Mapping[str, Any]
) -> CanopenSettings:  # fmt: skip
    """Read the settings of a CANopen rig.

    Args:
        path: a TOML file with all entries of the default one.
        base_imu: whether there is an IMU on the base; else its entries are left out.
        changes: by table, such as `bus={"interface": "virtual"}`.

    Raises:
        InputError: the file cannot be read, or an entry is missing, unknown or out of range.
    """
    path = Path(path)
    document = read_toml(path)
    for name in [*document, *changes]:
        if name not in TABLES:
            raise InputError(f"{path} has a table [{name}] that is not known; the tables are {', '.join(TABLES)}")
    made = []
    for name, kind in TABLES.items():
        values = _checked(name, kind, {**document.get(name, {}), **changes.get(name, {})})
        if "eds" in values:
            values["eds"] = str(path.resolve().parent / values["eds"])
        if kind is ImuSettings:
            if base_imu and len(values["nodes"]) < SLOTS:
                raise InputError(f"[imus] nodes of {path} has no eighth IMU, on the base: add it, or leave out --base-imu")
            count = SLOTS if base_imu else IMU_COUNT
            values |= {name: values[name][:count] for name in ("nodes", "signs")}
        made.append(kind(**values))
    return CanopenSettings(*made)


def _checked(title: str, kind: Any, table: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a table, whose types and ranges are those of the fields of `kind`."""
    check_entries(table, [each.name for each in fields(kind)], f"[{title}]")
    values = {}
    for each in fields(kind):
        name = f"[{title}] {each.name}"
        if each.name not in table and each.default is not MISSING:
            values[each.name] = each.default
            continue
        if each.name not in table:
            raise InputError(f"[{title}] lacks the entry {each.name!r} ({each.metadata['text']})")
        value, wanted = _frozen(table[each.name]), each.type
        if wanted is float and type(value) is int:
            value = float(value)
        if wanted in (bool, int, float, str) and type(value) is not wanted:
            raise InputError(f"{name} must be a {wanted.__name__}, got {value!r}")
        if wanted not in (bool, int, float, str) and not isinstance(value, tuple):
            raise InputError(f"{name} must be a list, got {value!r}")
        each.metadata["check"](name, value)
        values[each.name] = value
    return values


def _frozen(value: Any) -> Any:
    return tuple(_frozen(each) for each in value) if isinstance(value, list | tuple) else value
