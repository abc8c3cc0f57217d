"""The link to a UDP rig: addresses, and the exchange of datagrams from compiled code, without the GIL.

The controller refuses and counts every datagram that does not come from the rig's address, is malformed, or does not answer the
last command, such as one that is late, repeated or replayed.
"""

import ipaddress
import socket
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from hil.rigs import ANSWERED, SILENT, DriveState
from hil.rigs.udp.datagrams import (
    BASE_IMU_DATAGRAM,
    COMMAND_DATAGRAM,
    LENGTHS_DATAGRAM,
    LONGEST,
    MAGIC,
    MEASUREMENT_DATAGRAM,
    TRUTH_DATAGRAM,
    VERSION,
    WITH_BASE_IMU,
    WITH_LENGTHS,
    Bytes,
    DatagramKind,
    crc32,
    is_valid,
)
from plant.compiled import Record, kernel, record_dtype
from plant.errors import InputError
from plant.mechanism import LEGS
from plant.pose import Array
from plant.stopwatch import now

DEFAULT_ADDRESS = "127.0.0.1:47100"


def parse_address(text: str, anywhere: bool = False) -> tuple[str, int]:
    """Host and port of an address such as 127.0.0.1:47100.

    Raises:
        InputError: the text is not an address, or is neither loopback nor of a private network and not allowed `anywhere`.
    """
    host, _, port = text.rpartition(":")
    try:
        address = ipaddress.IPv4Address(host)
        # int would accept blanks, signs and underscores, too.
        number = int(port) if port.isdecimal() else 0
    except ValueError:
        raise InputError(f"{text!r} is not an address; give an IPv4 address and a port, such as {DEFAULT_ADDRESS}") from None
    if not 0 < number < 65536:
        raise InputError(f"the port of {text!r} must be a number from 1 to 65535")
    # 0.0.0.0, which means every interface, counts as private.
    if not (anywhere or address.is_loopback or (address.is_private and not address.is_unspecified)):
        raise InputError(f"{host} is neither loopback nor of a private network: nothing is encrypted; use a dedicated link")
    return host, number


def bound_socket(host: str, port: int) -> socket.socket:
    """A socket that receives at an address; port 0 takes a free one.

    Raises:
        OSError: the address is taken or does not exist.
    """
    family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    opened = socket.socket(family, socket.SOCK_DGRAM)
    try:
        opened.bind(address)
    except OSError:
        opened.close()
        raise
    return opened


def socket_address(address: tuple[str, int]) -> NDArray[np.uint8]:
    """A `sockaddr_in` as bytes (16,)."""
    host, port = address
    content = socket.AF_INET.to_bytes(2, "little") + port.to_bytes(2, "big") + socket.inet_aton(host) + bytes(8)
    return np.frombuffer(content, np.uint8)


def address_in(content: bytes) -> tuple[str, int]:
    """Host and port in the bytes of a `sockaddr_in`."""
    return socket.inet_ntoa(content[4:8]), int.from_bytes(content[2:4], "big")


SOCKET = record_dtype(
    descriptor=np.int64,
    session=np.uint32,
    version=np.uint16,  # of the session's datagrams
    sequence=np.uint32,  # of the last command
    timeout_ns=np.int64,  # to wait for the answer
    reset=np.uint32,  # whether commands reset the drives' faults
    peer=(np.uint8, 16),  # sockaddr_in
    sender=(np.uint8, 16),  # the last one, sockaddr_in
    sender_size=(np.int32, 2),
    stranger=np.int64,  # whether the sender is not the peer
    poll=(np.int32, 2),  # scratch
    timespec=(np.int64, 2),  # scratch
)
"""A socket in compiled code."""


class UdpLink(NamedTuple):
    """One side of the link, in compiled code."""

    socket: Record  # dtype `SOCKET`
    command: Record  # from the controller
    command_bytes: Bytes  # its buffer
    answer: Record  # the measurement from the rig
    lengths: Record  # which follow it from version 2 on
    base_imu: Record  # which follows these in version 3
    truth: tuple[Record, Record, Record]  # which may follow all that, by version
    answer_bytes: Bytes  # the buffer of all


def new_link() -> UdpLink:
    """A link without a socket."""
    command, answer, socket = np.zeros(LONGEST, np.uint8), np.zeros(LONGEST, np.uint8), np.zeros((), SOCKET)
    socket["version"] = VERSION
    first = MEASUREMENT_DATAGRAM.itemsize
    second = first + LENGTHS_DATAGRAM.itemsize
    third = second + BASE_IMU_DATAGRAM.itemsize
    return UdpLink(
        socket, command[: COMMAND_DATAGRAM.itemsize].view(COMMAND_DATAGRAM), command,
        answer[:first].view(MEASUREMENT_DATAGRAM), answer[first:second].view(LENGTHS_DATAGRAM),
        answer[second:third].view(BASE_IMU_DATAGRAM),
        (_truth_at(answer, first), _truth_at(answer, second), _truth_at(answer, third)), answer,
    )  # fmt: skip


def _truth_at(answer: Bytes, place: int) -> Record:
    return answer[place : place + TRUTH_DATAGRAM.itemsize].view(TRUTH_DATAGRAM)


_POLLIN = 1
_MSG_DONTWAIT, _MSG_TRUNC = 0x40, 0x20
_sendto: Any = types.ExternalFunction(
    "sendto", types.intp(types.int32, types.intp, types.intp, types.int32, types.intp, types.int32)
)
_recvfrom: Any = types.ExternalFunction(
    "recvfrom", types.intp(types.int32, types.intp, types.intp, types.int32, types.intp, types.intp)
)
_ppoll: Any = types.ExternalFunction("ppoll", types.int32(types.intp, types.intp, types.intp, types.intp))


@kernel
def send_datagram(socket: Record, data: Bytes, length: int) -> int:
    """Send the first `length` bytes to the peer; returns the number of bytes sent, or a negative number for an error."""
    s = socket[()]
    return int(_sendto(s.descriptor, data.ctypes.data, length, _MSG_DONTWAIT, s.peer.ctypes.data, 16))


@kernel
def receive_datagram(socket: Record, data: Bytes) -> int:
    """Receive a datagram if there is one; returns its length, which may exceed the buffer's, or a negative number without one.
    Notes whether the sender is a `stranger`: another address than the peer's.
    """
    s = socket[()]
    s.sender_size[0] = 16
    length = _recvfrom(
        s.descriptor, data.ctypes.data, data.size, _MSG_DONTWAIT | _MSG_TRUNC, s.sender.ctypes.data, s.sender_size.ctypes.data
    )
    s.stranger = 0
    # Family, port and address; the rest is padding.
    for i in range(8):
        if s.sender[i] != s.peer[i]:
            s.stranger = 1
    return int(length)


@kernel
def await_datagram(socket: Record, duration_ns: int) -> None:
    """Wait for a datagram, at most for this duration."""
    s = socket[()]
    s.poll[0], s.poll[1] = s.descriptor, _POLLIN
    s.timespec[0], s.timespec[1] = duration_ns // 1_000_000_000, duration_ns % 1_000_000_000
    _ppoll(s.poll.ctypes.data, 1, s.timespec.ctypes.data, 0)


@kernel
def encode_command(link: UdpLink, command: Array, request: int, time_ns: int) -> None:
    """Write the next command datagram."""
    s, c = link.socket[()], link.command[0]
    s.sequence += np.uint32(1)
    c.magic, c.version, c.kind = MAGIC, s.version, DatagramKind.COMMAND
    c.session, c.sequence, c.time_ns = s.session, s.sequence, time_ns
    c.request, c.reset = request, s.reset
    c.velocity[:] = command
    c.crc = crc32(link.command_bytes, link.command.itemsize - 4)


@kernel
def send_command(link: UdpLink, command: Array, request: int, time_ns: int) -> None:
    """Send the next command."""
    encode_command(link, command, request, time_ns)
    send_datagram(link.socket, link.command_bytes, link.command.itemsize)


@kernel
def decode_answer(link: UdpLink, length: int, feedback: Record) -> bool:
    """Accept the received datagram of `length` bytes if it is the answer to the last command; otherwise only count it as
    refused.
    """
    s, a, b, c = link.socket[()], link.answer[0], link.lengths[0], link.base_imu[0]
    with_lengths, with_base_imu = s.version >= WITH_LENGTHS, s.version >= WITH_BASE_IMU
    size = link.answer.itemsize
    to_base_imu = size + (link.lengths.itemsize if with_lengths else 0)
    whole = to_base_imu + (link.base_imu.itemsize if with_base_imu else 0)
    t = link.truth[s.version - VERSION][0]
    with_truth = length == whole + link.truth[0].itemsize
    if (
        s.stranger != 0
        or (length != whole and not with_truth)
        or not is_valid(link.answer_bytes, a, size, size, DatagramKind.MEASUREMENT, s.version)
        or a.session != s.session
        or a.sequence != s.sequence
        or (with_lengths and b.crc != crc32(link.answer_bytes[size:], link.lengths.itemsize - 4))
        or (with_base_imu and c.crc != crc32(link.answer_bytes[to_base_imu:], link.base_imu.itemsize - 4))
        or (with_truth and t.crc != crc32(link.answer_bytes[whole:], link.truth[0].itemsize - 4))
    ):
        feedback.refused += 1
        return False
    for k in range(LEGS):
        feedback.length[k] = b.length[k] if with_lengths else np.nan
        feedback.length_rate[k] = b.rate[k] if with_lengths else np.nan
        feedback.home[k] = b.home[k] if with_lengths else -1
    if with_base_imu:
        feedback.base_imu[:] = c.measurement
        feedback.base_imu_ns, feedback.base_imu_sequence = c.sample_ns, c.sample_number
    feedback.sample_ns[:], feedback.sequence[:] = a.sample_ns, a.sample_number
    feedback.measurement[:] = a.measurement
    for k in range(LEGS):
        feedback.drive[k] = a.drive[k] if a.drive[k] <= DriveState.FAULTY else DriveState.NOT_READY.value
    feedback.drive_code[:], feedback.sent[:] = a.code, a.velocity
    for i in range(feedback.truth.size):
        feedback.truth[i] = t.truth[i] if with_truth else np.nan
    return True


@kernel
def exchange_udp(link: UdpLink, command: Array, request: int, feedback: Record, timespec: NDArray[np.int64]) -> int:
    """Send the command, and wait for its answer; returns `ANSWERED` or `SILENT`."""
    s = link.socket[()]
    began = now(timespec)
    send_command(link, command, request, began)
    while True:
        length = receive_datagram(link.socket, link.answer_bytes)
        if length >= 0 and decode_answer(link, length, feedback):
            feedback.round_trip_ns = now(timespec) - began
            return ANSWERED
        left = s.timeout_ns - (now(timespec) - began)
        if left <= 0:
            feedback.round_trip_ns = s.timeout_ns
            return SILENT
        if length < 0:
            await_datagram(link.socket, left)
