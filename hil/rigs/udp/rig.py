"""The UDP rig: one datagram in each direction per cycle, from compiled code and without the GIL.

What does not come from the rig's address, is malformed, or does not answer the command just sent, such as what is late,
repeated or replayed, is refused and counted. Loopback and the link of a dedicated interface are safe places for it; a network
that others use is not, for nothing is encrypted.
"""

import ipaddress
import secrets
import socket
import time
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from hil.realtime.clock import now
from hil.rigs import (
    ANSWERED,
    BRAKED,
    FAULTY,
    FOLLOWING,
    OFF,
    QUICK_STOP,
    QUICK_STOPPING,
    READY,
    SILENT,
    Identity,
    RigError,
    new_feedback,
)
from hil.rigs.udp.datagrams import (
    COMMAND,
    COMMAND_DATAGRAM,
    HELLO,
    HELLO_DATAGRAM,
    LONGEST,
    MAGIC,
    MEASUREMENT,
    MEASUREMENT_DATAGRAM,
    TRUTH_DATAGRAM,
    VERSION,
    WELCOME,
    WELCOME_DATAGRAM,
    Bytes,
    crc32,
    decode,
    encode,
    is_sound,
)
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.errors import InputError
from plant.mechanism import LEGS
from plant.pose import Array

DEFAULT_ADDRESS = "127.0.0.1:47100"
TIMEOUT_SHARE = 0.5
"""How much of a period an exchange may last."""

_OPENING_S, _HAND_SHAKE_S = 2.0, 0.2
_ARMING_S = 2.0
_STOPPING_S = 0.5
_FAREWELLS = 3

SOCKET = np.dtype(
    [
        ("descriptor", np.int64),
        ("session", np.uint32),
        ("sequence", np.uint32),
        ("timeout_ns", np.int64),
        ("reset", np.uint32),
        ("peer", np.uint8, 16),
        ("sender", np.uint8, 16),
        ("sender_size", np.int32, 2),
        ("stranger", np.int64),
        ("poll", np.int32, 2),
        ("timespec", np.int64, 2),
    ],
    align=True,
)
"""A socket as compiled code sees it: its descriptor, session and last sequence number, the other side's address as a
`sockaddr_in`, and what system calls want room for.
"""

_POLLIN = 1
_MSG_DONTWAIT, _MSG_TRUNC = 0x40, 0x20
_sendto: Any = types.ExternalFunction(
    "sendto", types.intp(types.int32, types.intp, types.intp, types.int32, types.intp, types.int32)
)
_recvfrom: Any = types.ExternalFunction(
    "recvfrom", types.intp(types.int32, types.intp, types.intp, types.int32, types.intp, types.intp)
)
_ppoll: Any = types.ExternalFunction("ppoll", types.int32(types.intp, types.intp, types.intp, types.intp))


class UdpLink(NamedTuple):
    """The controller's side, as compiled code takes it.

    Attributes:
        socket: dtype `SOCKET`.
        command, command_bytes: the datagram that is sent, and the same as bytes.
        answer, truth, answer_bytes: the datagram that is received, what may follow it, and all of it as bytes.
    """

    socket: Record
    command: Record
    command_bytes: Bytes
    answer: Record
    truth: Record
    answer_bytes: Bytes


def new_link() -> UdpLink:
    """A link without a socket."""
    command = np.zeros(1, COMMAND_DATAGRAM)
    data = np.zeros(LONGEST, np.uint8)
    answer = data[: MEASUREMENT_DATAGRAM.itemsize].view(MEASUREMENT_DATAGRAM)
    truth = data[MEASUREMENT_DATAGRAM.itemsize :].view(TRUTH_DATAGRAM)
    return UdpLink(np.zeros((), SOCKET), command, command.view(np.uint8), answer, truth, data)


@kernel
def send_datagram(socket: Record, data: Bytes, length: int) -> int:
    """Send the first `length` bytes to the peer; returns how many were sent, negative if none."""
    s = socket[()]
    return int(_sendto(s.descriptor, data.ctypes.data, length, _MSG_DONTWAIT, s.peer.ctypes.data, 16))


@kernel
def receive_datagram(socket: Record, data: Bytes) -> int:
    """Receive a datagram if there is one; returns its length, also where it did not fit, or a negative number for none.
    Whether it is a `stranger`'s is noted: from elsewhere than the peer.
    """
    s = socket[()]
    s.sender_size[0] = 16
    length = _recvfrom(
        s.descriptor, data.ctypes.data, data.size, _MSG_DONTWAIT | _MSG_TRUNC, s.sender.ctypes.data, s.sender_size.ctypes.data
    )
    s.stranger = 0
    # Family, port and address; what follows is padding.
    for i in range(8):
        if s.sender[i] != s.peer[i]:
            s.stranger = 1
    return int(length)


@kernel
def await_datagram(socket: Record, duration_ns: int) -> None:
    """Wait for a datagram, or for so long."""
    s = socket[()]
    s.poll[0], s.poll[1] = s.descriptor, _POLLIN
    s.timespec[0], s.timespec[1] = duration_ns // 1_000_000_000, duration_ns % 1_000_000_000
    _ppoll(s.poll.ctypes.data, 1, s.timespec.ctypes.data, 0)


@kernel
def encode_command(link: UdpLink, command: Array, request: int, time_ns: int) -> None:
    """Write the next command datagram."""
    s, c = link.socket[()], link.command[0]
    s.sequence += np.uint32(1)
    c.magic, c.version, c.kind = MAGIC, VERSION, COMMAND
    c.session, c.sequence, c.time_ns = s.session, s.sequence, time_ns
    c.request, c.reset = request, s.reset
    for k in range(LEGS):
        c.velocity[k] = command[k]
    c.crc = crc32(link.command_bytes, link.command_bytes.size - 4)


@kernel
def decode_answer(link: UdpLink, length: int, feedback: Record) -> bool:
    """Take the received datagram of `length` bytes, if it is the answer to the last command; else nothing changes but the
    count of refused ones.
    """
    s, a, t = link.socket[()], link.answer[0], link.truth[0]
    size = link.answer.itemsize
    with_truth = length == size + link.truth.itemsize
    if s.stranger != 0 or not is_sound(link.answer_bytes, a, size if with_truth else length, size, MEASUREMENT):
        feedback.refused += 1
        return False
    if a.session != s.session or a.sequence != s.sequence:
        feedback.refused += 1
        return False
    if with_truth and t.crc != crc32(link.answer_bytes[size:], link.truth.itemsize - 4):
        feedback.refused += 1
        return False
    for k in range(IMU_COUNT):
        feedback.sample_ns[k], feedback.sequence[k] = a.sample_ns[k], a.sample_number[k]
        for kind in range(3):
            for i in range(3):
                feedback.measurement[kind, k, i] = a.measurement[kind, k, i]
    for k in range(LEGS):
        feedback.drive[k] = a.drive[k] if a.drive[k] <= FAULTY else OFF
        feedback.drive_code[k], feedback.sent[k] = a.code[k], a.velocity[k]
    for i in range(feedback.truth.size):
        feedback.truth[i] = t.truth[i] if with_truth else np.nan
    return True


@kernel
def exchange_udp(link: UdpLink, command: Array, request: int, feedback: Record, timespec: NDArray[np.int64]) -> int:
    """Send the command, and wait for its answer; returns `ANSWERED` or `SILENT`."""
    s = link.socket[()]
    began = now(timespec)
    encode_command(link, command, request, began)
    send_datagram(link.socket, link.command_bytes, link.command_bytes.size)
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


class UdpRig:
    """The UDP rig, from the controller's side. In a compiled loop `link` is exchanged through directly.

    Args:
        address: of the rig, such as 127.0.0.1:47100.
        period: of the exchanges [s].
        anywhere: whether an address that is neither loopback nor of a private network is allowed.

    Raises:
        InputError: an address that is none, or is not allowed.
    """

    def __init__(self, address: str, period: float, anywhere: bool = False) -> None:
        self.address = parse_address(address, anywhere)
        self.command_delay = period
        self.link = new_link()
        self.watchdog_s = 0.0
        self._socket: socket.socket | None = None
        self._timespec = np.zeros(2, np.int64)
        self._identity: Identity | None = None

    def open(self) -> None:
        """Shake hands: the rig takes part in a new session with this controller alone.

        Raises:
            RigError: nobody answers.
        """
        self.close()
        host, port = self.address
        self._socket = opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.settimeout(_HAND_SHAKE_S)
        session = secrets.randbits(31) + 1
        hello = encode(HELLO_DATAGRAM, kind=HELLO, session=session, period_us=round(1e6 * self.command_delay))
        welcome = None
        deadline = time.monotonic() + _OPENING_S
        while time.monotonic() < deadline:
            try:
                opened.sendto(hello, self.address)
                content, sender = opened.recvfrom(2048)
            except TimeoutError:
                continue
            except OSError as error:
                self.close()
                raise RigError(f"the rig at {host}:{port} cannot be reached: {error.strerror}") from None
            welcome = decode(WELCOME_DATAGRAM, WELCOME, content) if sender == self.address else None
            if welcome is not None and welcome["session"] == session:
                break
            welcome = None
        if welcome is None:
            self.close()
            raise RigError(
                f"no rig answers at {host}:{port}: start it ('gough emulate --bus udp'), check the address, and that no other "
                "controller has it"
            )
        link = self.link.socket
        link["descriptor"], link["session"], link["sequence"] = opened.fileno(), session, 0
        link["timeout_ns"] = round(1e9 * TIMEOUT_SHARE * self.command_delay)
        link["peer"] = socket_address(self.address)
        self.watchdog_s = 1e-6 * int(welcome["watchdog_us"])
        name, firmware = (bytes(welcome[field]).rstrip(b"\0").decode("ascii", "replace") for field in ("name", "firmware"))
        parts = {"firmware": firmware, "address": f"{host}:{port}", "watchdog": f"{self.watchdog_s:g} s"}
        self._identity = Identity(name, parts)

    def identify(self) -> Identity:
        """What the rig has said of itself.

        Raises:
            RigError: its drives would stop within three periods by themselves.
        """
        if self._identity is None:
            raise RigError("the rig is not open")
        if self.watchdog_s < 3.0 * self.command_delay:
            raise RigError(
                f"the rig's watchdog stops its drives after {1e3 * self.watchdog_s:g} ms without a command; at a period of "
                f"{1e3 * self.command_delay:g} ms it must be {3e3 * self.command_delay:g} ms at least: choose a higher rate"
            )
        return self._identity

    def arm(self) -> None:
        """Reset faults, and see that all drives are ready.

        Raises:
            RigError: one is not.
        """
        if self._socket is None:
            raise RigError("the rig is not open: open it first")
        feedback = new_feedback()[()]
        deadline = time.monotonic() + _ARMING_S
        self.link.socket["reset"] = 1
        ready = False
        while not ready and time.monotonic() < deadline:
            status = self.exchange(np.zeros(LEGS), BRAKED, feedback)
            ready = status == ANSWERED and bool(np.isin(feedback["drive"], (READY, FOLLOWING)).all())
            time.sleep(self.command_delay)
        self.link.socket["reset"] = 0
        if not ready:
            states = ", ".join(f"{k}: {int(drive)}" for k, drive in enumerate(feedback["drive"]))
            codes = ", ".join(f"{int(code):#06x}" for code in feedback["drive_code"])
            raise RigError(f"the drives are not ready within {_ARMING_S:g} s (states {states}; fault codes {codes})")

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """One exchange, as `Rig` says."""
        if self._socket is None:
            return SILENT
        return exchange_udp(self.link, command, request, feedback, self._timespec)

    def quick_stop(self) -> None:
        """Tell the drives to stop until they say that they have, or do not answer for half a second."""
        if self._socket is None:
            return
        feedback, deadline = new_feedback()[()], time.monotonic() + _STOPPING_S
        self.link.socket["reset"] = 0
        while time.monotonic() < deadline:
            answered = self.exchange(np.zeros(LEGS), QUICK_STOP, feedback) == ANSWERED
            if answered and not np.isin(feedback["drive"], (FOLLOWING, QUICK_STOPPING)).any():
                return
            time.sleep(self.command_delay)

    def close(self) -> None:
        """Leave the drives on their brakes, and close the socket; if nothing comes through, the rig's watchdog does that."""
        if self._socket is None:
            return
        if self._identity is not None:
            for _ in range(_FAREWELLS):
                encode_command(self.link, np.zeros(LEGS), BRAKED, 0)
                send_datagram(self.link.socket, self.link.command_bytes, COMMAND_DATAGRAM.itemsize)
        self._socket.close()
        self._socket, self._identity = None, None
        self.link.socket["descriptor"] = -1


def parse_address(text: str, anywhere: bool = False) -> tuple[str, int]:
    """Host and port of an address such as 127.0.0.1:47100.

    Raises:
        InputError: it is none, or not of loopback or a private network unless it may be `anywhere`.
    """
    host, _, port = text.rpartition(":")
    try:
        address = ipaddress.IPv4Address(host)
        # int would take blanks, signs and underscores too.
        number = int(port) if port.isdecimal() else 0
    except ValueError:
        raise InputError(f"{text!r} is no address; give an IPv4 address and a port, such as {DEFAULT_ADDRESS}") from None
    if not 0 < number < 65536:
        raise InputError(f"the port of {text!r} must be a number from 1 to 65535")
    # 0.0.0.0, which is every interface, counts as private.
    if not (anywhere or address.is_loopback or (address.is_private and not address.is_unspecified)):
        raise InputError(f"{host} is neither loopback nor of a private network: nothing is encrypted; use a dedicated link")
    return host, number


def socket_address(address: tuple[str, int]) -> NDArray[np.uint8]:
    """A `sockaddr_in` as bytes (16,)."""
    host, port = address
    content = socket.AF_INET.to_bytes(2, "little") + port.to_bytes(2, "big") + socket.inet_aton(host) + bytes(8)
    return np.frombuffer(content, np.uint8)
