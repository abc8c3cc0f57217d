"""The emulated rig on UDP: it answers commands, stops its drives without them, and loses, delays or repeats packets on demand.

The same code answers a controller in another process, through a socket on the machine's clock, and a controller in the same
thread, through memory on the clock of its cycles. The latter is much faster, and its results are repeatable.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.rigs import ANSWERED, SILENT, DriveState, Request
from hil.rigs.emulation import accepted_velocity, disturb, draw, move, sample
from hil.rigs.udp.datagrams import (
    HELLO_DATAGRAM,
    LONGEST,
    MAGIC,
    VERSION,
    WITH_BASE_IMU,
    WITH_LENGTHS,
    Bytes,
    DatagramKind,
    crc32,
    is_valid,
)
from hil.rigs.udp.link import UdpLink, await_datagram, decode_answer, encode_command, new_link, receive_datagram, send_datagram
from plant.compiled import Record, kernel, record_dtype, shared_kernel
from plant.mechanism import LEGS
from plant.pose import Array
from plant.stopwatch import now

WATCHDOG_S = 0.03
WATCHDOG_CODE = 0x8130
"""CiA 402's code for a failed life guarding: the controller has been silent for too long."""

_PACKETS = 64
_HELLO_BYTES = HELLO_DATAGRAM.itemsize
_TO_RIG, _TO_CONTROLLER = 0, 1
_NEVER = np.iinfo(np.int64).max
_LATENCY_NS = 20_000
"""Travel time of a packet through memory, each way."""

_IDLE_NS = 1_000_000
"""How often an emulated rig checks its watchdog while no datagram arrives."""

PACKET = record_dtype(
    due_ns=np.int64,
    way=np.int64,
    length=np.int64,
    content=(np.uint8, LONGEST),
)

UDP_SESSION = record_dtype(
    id=np.uint32,
    last=np.uint32,  # sequence number of the last command
    commanded_ns=np.int64,  # its time
    watchdog_ns=np.int64,  # time without a command after which the drives stop
    refused=np.int64,  # datagrams
    stranger=(np.uint8, 16),  # who sent the last one that came from elsewhere or wanted another session, sockaddr_in
    held_back=(np.int64, 2),  # whether a packet arrives after the next, each way
    packet=(PACKET, _PACKETS),  # in transit
)
"""A session of an emulated rig."""


class UdpEmulator(NamedTuple):
    """An emulated rig on UDP, in compiled code."""

    fmu: Record  # the plant
    imu: Record  # its IMUs' imperfections
    encoders: Record  # its encoders
    rig: Record  # dtype `hil.rigs.emulation.EMULATED`
    session: Record  # dtype `UDP_SESSION`
    link: UdpLink  # the rig's side; the rig is in memory if its socket has no descriptor


def new_udp_emulator(
    fmu: Record, imu: Record, encoders: Record, rig: Record, session: int = 0, watchdog_s: float = WATCHDOG_S,
    version: int = VERSION,
) -> UdpEmulator:  # fmt: skip
    """An emulated rig on UDP that has received nothing yet."""
    made: Record = np.zeros((), UDP_SESSION)
    made["id"], made["watchdog_ns"] = session, round(1e9 * watchdog_s)
    link = new_link()
    link.socket["version"] = version
    return UdpEmulator(fmu, imu, encoders, rig, made, link)


@kernel
def is_later(sequence: int, last: int) -> bool:
    """Whether a sequence number, which wraps at 2^32, comes after another."""
    ahead = (np.int64(sequence) - np.int64(last)) & 0xFFFFFFFF
    return bool(0 < ahead < 0x80000000)


@shared_kernel
def answer_command(emulator: UdpEmulator, length: int, now_ns: int) -> int:
    """Apply the received command of `length` bytes, and write the answer; returns its length, 0 without one."""
    rig, session, link = emulator.rig[()], emulator.session[()], emulator.link
    c, a, b, base, version = link.command[0], link.answer[0], link.lengths[0], link.base_imu[0], link.socket[()].version
    finite = True
    for k in range(LEGS):
        finite = finite and np.isfinite(c.velocity[k])
    if (
        not is_valid(link.command_bytes, c, length, link.command.itemsize, DatagramKind.COMMAND, version)
        or c.session != session.id
        or c.session == 0
        or not is_later(c.sequence, session.last)
        or c.request > Request.QUICK_STOP
        or not finite
    ):
        session.refused += 1
        return 0
    move(emulator.fmu, emulator.rig, now_ns)
    session.last, session.commanded_ns = c.sequence, now_ns
    for k in range(LEGS):
        rig.request[k], rig.target[k] = c.request, c.velocity[k]
        rig.reset[k] = 1 if c.reset != 0 and c.request == Request.BRAKED else 0
    # The request takes effect in this instant.
    move(emulator.fmu, emulator.rig, now_ns + 1)
    if sample(emulator.fmu, emulator.imu, emulator.encoders, emulator.rig, now_ns + 1) != 0:
        return 0
    a.magic, a.version, a.kind = MAGIC, version, DatagramKind.MEASUREMENT
    a.session, a.sequence, a.time_ns = c.session, c.sequence, now_ns
    a.refused = session.refused
    a.sample_ns[:], a.sample_number[:] = rig.sample_ns, rig.sequence
    a.measurement[:] = rig.measurement
    a.drive[:], a.code[:] = rig.drive, rig.code
    for k in range(LEGS):
        a.velocity[k] = accepted_velocity(rig, k)
    a.crc = crc32(link.answer_bytes, link.answer.itemsize - 4)
    t, written = link.truth[version - VERSION][0], link.answer.itemsize
    if version >= WITH_LENGTHS:
        b.length[:], b.rate[:], b.home[:] = rig.length, rig.length_rate, rig.home
        b.crc = crc32(link.answer_bytes[written:], link.lengths.itemsize - 4)
        written += link.lengths.itemsize
    if version >= WITH_BASE_IMU:
        base.measurement[:] = rig.base_imu
        base.sample_ns, base.sample_number = rig.base_imu_ns, rig.base_imu_sequence
        base.crc = crc32(link.answer_bytes[written:], link.base_imu.itemsize - 4)
        written += link.base_imu.itemsize
    t.truth[:] = rig.truth
    t.crc = crc32(link.answer_bytes[written:], link.truth[0].itemsize - 4)
    return int(written + link.truth[0].itemsize)


@kernel
def check_watchdog(emulator: UdpEmulator, now_ns: int) -> None:
    """Move the plant on to `now_ns`, and stop the drives with a fault if no command has arrived for too long."""
    rig, session = emulator.rig[()], emulator.session[()]
    move(emulator.fmu, emulator.rig, now_ns)
    if now_ns - session.commanded_ns <= session.watchdog_ns:
        return
    for k in range(LEGS):
        if rig.drive[k] == DriveState.FOLLOWING or rig.drive[k] == DriveState.QUICK_STOPPING:
            rig.drive[k], rig.code[k], rig.request[k] = DriveState.FAULTY, WATCHDOG_CODE, Request.BRAKED


@kernel
def post_packet(emulator: UdpEmulator, content: Bytes, length: int, way: int, now_ns: int) -> None:
    """Put a packet in transit, subject to the faults of the bus."""
    session = emulator.session[()]
    copies, delay, corrupt, held = disturb(emulator.rig[()], now_ns)
    if emulator.link.socket[()].descriptor == 0:
        delay += _LATENCY_NS
    released = session.held_back[way] > 0 and not held
    for i in range(_PACKETS):
        p = session.packet[i]
        if released and p.length > 0 and p.way == way and p.due_ns == _NEVER:
            p.due_ns = now_ns + delay + 1
        if copies > 0 and p.length == 0:
            p.way, p.length = way, length
            p.due_ns = _NEVER if held else now_ns + delay
            p.content[:length] = content[:length]
            if corrupt:
                bit = int(draw(emulator.rig[()].random) * 8 * length)
                p.content[bit // 8] ^= np.uint8(1 << (bit % 8))
            copies -= 1
    session.held_back[way] = 1 if held else 0


@kernel
def next_packet(session: Record) -> int:
    """Index of the packet that arrives next, -1 if none is in transit."""
    best, due = -1, _NEVER
    for i in range(_PACKETS):
        p = session[()].packet[i]
        if p.length > 0 and p.due_ns < due:
            best, due = i, p.due_ns
    return best


@kernel
def take_packet(packet: Record, data: Bytes) -> int:
    """Take a packet out of transit into `data`; returns its length."""
    length = packet.length
    packet.length = 0
    data[:length] = packet.content[:length]
    return int(length)


@kernel
def exchange_in_memory(
    emulator: UdpEmulator, link: UdpLink, command: Array, request: int, feedback: Record, now_ns: int
) -> int:
    """An exchange through memory at `now_ns` on the clock of both sides; returns `ANSWERED` or `SILENT`."""
    session, rig_link = emulator.session[()], emulator.link
    deadline = now_ns + link.socket[()].timeout_ns
    check_watchdog(emulator, now_ns)
    encode_command(link, command, request, now_ns)
    post_packet(emulator, link.command_bytes, link.command.itemsize, _TO_RIG, now_ns)
    while True:
        i = next_packet(emulator.session)
        if i < 0 or session.packet[i].due_ns > deadline:
            feedback.round_trip_ns = link.socket[()].timeout_ns
            return SILENT
        p = session.packet[i]
        at = max(p.due_ns, now_ns)
        if p.way == _TO_RIG:
            written = answer_command(emulator, take_packet(p, rig_link.command_bytes), at)
            if written > 0:
                post_packet(emulator, rig_link.answer_bytes, written, _TO_CONTROLLER, at)
        elif decode_answer(link, take_packet(p, link.answer_bytes), feedback):
            feedback.round_trip_ns = at - now_ns
            return ANSWERED


@kernel
def _moves(rig: Record) -> bool:
    """Whether a drive follows or slows down."""
    for k in range(LEGS):
        drive = rig[()].drive[k]
        if drive == DriveState.FOLLOWING or drive == DriveState.QUICK_STOPPING:
            return True
    return False


@kernel
def serve(emulator: UdpEmulator, started_ns: int, duration_ns: int, timespec: NDArray[np.int64]) -> int:
    """Serve the socket for a duration on the machine's clock. Returns 1 as soon as a possible hello arrives, else 0; a rig
    whose drives move has one controller, and refuses every hello.

    Args:
        emulator: with a bound socket and its peer.
        started_ns: the machine's clock when the rig's clock began [ns].
        duration_ns: [ns].
        timespec: (2,), scratch.
    """
    session, link = emulator.session[()], emulator.link
    begin = now(timespec)
    while True:
        at = now(timespec)
        if at - begin >= duration_ns:
            return 0
        time_ns = at - started_ns
        # Also while datagrams keep arriving: a flood of them must not block the watchdog.
        if time_ns - emulator.rig[()].time_ns >= _IDLE_NS:
            check_watchdog(emulator, time_ns)
        length = receive_datagram(link.socket, link.command_bytes)
        greeting = length == _HELLO_BYTES
        if greeting and not _moves(emulator.rig):
            return 1
        if greeting or length == 0 or (length > 0 and link.socket[()].stranger != 0):
            session.refused += 1
            session.stranger[:] = link.socket[()].sender
        elif length > 0:
            post_packet(emulator, link.command_bytes, min(length, LONGEST), _TO_RIG, time_ns)
        i = next_packet(emulator.session)
        if i >= 0 and session.packet[i].due_ns <= time_ns:
            p = session.packet[i]
            if p.way == _TO_CONTROLLER:
                send_datagram(link.socket, link.answer_bytes, take_packet(p, link.answer_bytes))
                continue
            written = answer_command(emulator, take_packet(p, link.command_bytes), time_ns)
            if written > 0:
                post_packet(emulator, link.answer_bytes, written, _TO_CONTROLLER, now(timespec) - started_ns)
            continue
        if length >= 0:
            continue
        wait = _IDLE_NS
        if i >= 0 and session.packet[i].due_ns != _NEVER:
            wait = min(wait, max(session.packet[i].due_ns - time_ns, 1000))
        await_datagram(link.socket, wait)
