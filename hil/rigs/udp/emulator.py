"""The emulated rig on UDP: it answers commands, looks after its drives when none come, and loses, delays or repeats packets on
demand.

The same code answers a controller in another process, through a socket on the machine's clock, and one in the same thread,
through memory on the clock of its cycles, so that what takes minutes elsewhere takes milliseconds and comes out the same every
time.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controller.safety.watch import BRAKED, FAULTY, FOLLOWING, QUICK_STOP, QUICK_STOPPING
from hil.realtime.clock import now
from hil.rigs import ANSWERED, SILENT
from hil.rigs.emulation.drives import move, sample
from hil.rigs.emulation.faults import disturb, draw
from hil.rigs.udp.datagrams import (
    COMMAND,
    COMMAND_DATAGRAM,
    HELLO_DATAGRAM,
    LONGEST,
    MAGIC,
    MEASUREMENT,
    MEASUREMENT_DATAGRAM,
    TRUTH_DATAGRAM,
    VERSION,
    Bytes,
    crc32,
    is_sound,
)
from hil.rigs.udp.rig import SOCKET, UdpLink, await_datagram, decode_answer, encode_command, receive_datagram, send_datagram
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS
from plant.pose import Array

WATCHDOG_S = 0.03
WATCHDOG_CODE = 0x8130
"""CiA 402's code for a controller whose life guarding has failed."""

_PACKETS = 64
_HELLO_BYTES = HELLO_DATAGRAM.itemsize
_IN, _OUT = 0, 1
_NEVER = np.iinfo(np.int64).max
_LATENCY_NS = 20_000
"""What a packet takes each way through memory."""

_IDLE_NS = 1_000_000
"""How often an emulated rig looks after itself while nothing comes."""

PACKET = np.dtype(
    [("due_ns", np.int64), ("way", np.int64), ("length", np.int64), ("content", np.uint8, LONGEST)],
    align=True,
)

UDP_PORT = np.dtype(
    [
        ("session", np.uint32),
        ("last", np.uint32),
        ("heard_ns", np.int64),
        ("watchdog_ns", np.int64),
        ("refused", np.int64),
        ("held_back", np.int64, 2),
        ("packet", PACKET, _PACKETS),
    ],
    align=True,
)
"""The bus side of an emulated rig: its session and the last command's number, when that came, after how long without one the
drives stop, how many datagrams were refused, whether one is held back to come after the next, and the packets that are under
way."""


class UdpEmulator(NamedTuple):
    """An emulated rig on UDP, as compiled code takes it.

    Attributes:
        fmu, imu: the plant and its IMUs' imperfections.
        rig: dtype `hil.rigs.emulation.drives.EMULATED`.
        port: dtype `UDP_PORT`.
        socket: dtype `hil.rigs.udp.rig.SOCKET`; without a descriptor the rig is in memory.
        command, command_bytes: what is received.
        answer, truth, answer_bytes: what is sent.
    """

    fmu: Record
    imu: Record
    rig: Record
    port: Record
    socket: Record
    command: Record
    command_bytes: Bytes
    answer: Record
    truth: Record
    answer_bytes: Bytes


def new_udp_emulator(fmu: Record, imu: Record, rig: Record, session: int = 0, watchdog_s: float = WATCHDOG_S) -> UdpEmulator:
    """An emulated rig on UDP that has not been spoken to."""
    port: Record = np.zeros((), UDP_PORT)
    port["session"], port["watchdog_ns"] = session, round(1e9 * watchdog_s)
    received, sent = np.zeros(LONGEST, np.uint8), np.zeros(LONGEST, np.uint8)
    size = MEASUREMENT_DATAGRAM.itemsize
    return UdpEmulator(
        fmu, imu, rig, port, np.zeros((), SOCKET), received[: COMMAND_DATAGRAM.itemsize].view(COMMAND_DATAGRAM), received,
        sent[:size].view(MEASUREMENT_DATAGRAM), sent[size:].view(TRUTH_DATAGRAM), sent,
    )  # fmt: skip


@kernel
def is_later(sequence: int, last: int) -> bool:
    """Whether a number that wraps at 2^32 comes after another."""
    ahead = (np.int64(sequence) - np.int64(last)) & 0xFFFFFFFF
    return bool(0 < ahead < 0x80000000)


@kernel
def answer(emulator: UdpEmulator, length: int, now_ns: int) -> int:
    """Do what the received datagram of `length` bytes says, and write the answer; returns its length, 0 if there is none."""
    rig, port, c, a = emulator.rig[()], emulator.port[()], emulator.command[0], emulator.answer[0]
    data, size = emulator.command_bytes, emulator.command.itemsize
    if (
        not is_sound(data, c, length, size, COMMAND)
        or c.session != port.session
        or c.session == 0
        or not is_later(c.sequence, port.last)
    ):
        port.refused += 1
        return 0
    finite = True
    for k in range(LEGS):
        finite = finite and np.isfinite(c.velocity[k])
    if c.request > QUICK_STOP or not finite:
        port.refused += 1
        return 0
    move(emulator.fmu, emulator.rig, now_ns)
    port.last, port.heard_ns = c.sequence, now_ns
    for k in range(LEGS):
        rig.request[k], rig.target[k] = c.request, c.velocity[k]
        rig.reset[k] = 1 if c.reset != 0 and c.request == BRAKED else 0
    # What is asked for takes effect in this instant.
    move(emulator.fmu, emulator.rig, now_ns + 1)
    if sample(emulator.fmu, emulator.imu, emulator.rig, now_ns + 1) != 0:
        return 0
    a.magic, a.version, a.kind = MAGIC, VERSION, MEASUREMENT
    a.session, a.sequence, a.time_ns = c.session, c.sequence, now_ns
    a.refused = port.refused
    for k in range(IMU_COUNT):
        a.sample_ns[k], a.sample_number[k] = rig.sample_ns[k], rig.sequence[k]
        for kind in range(3):
            for i in range(3):
                a.measurement[kind, k, i] = rig.measurement[kind, k, i]
    for k in range(LEGS):
        a.drive[k], a.code[k], a.velocity[k] = rig.drive[k], rig.code[k], rig.velocity[k]
    a.crc = crc32(emulator.answer_bytes, emulator.answer.itemsize - 4)
    t = emulator.truth[0]
    for i in range(rig.truth.size):
        t.truth[i] = rig.truth[i]
    t.crc = crc32(emulator.answer_bytes[emulator.answer.itemsize :], emulator.truth.itemsize - 4)
    return int(emulator.answer_bytes.size)


@kernel
def look_after(emulator: UdpEmulator, now_ns: int) -> None:
    """Let the plant move on, and stop the drives with a fault if no command has come for too long."""
    rig, port = emulator.rig[()], emulator.port[()]
    move(emulator.fmu, emulator.rig, now_ns)
    if now_ns - port.heard_ns <= port.watchdog_ns:
        return
    for k in range(LEGS):
        if rig.drive[k] == FOLLOWING or rig.drive[k] == QUICK_STOPPING:
            rig.drive[k], rig.code[k], rig.request[k] = FAULTY, WATCHDOG_CODE, BRAKED


@kernel
def post(emulator: UdpEmulator, content: Bytes, length: int, way: int, now_ns: int) -> None:
    """Put a packet on its way, with what the faults of the bus do to it."""
    port = emulator.port[()]
    copies, delay, corrupt, held = disturb(emulator.rig[()], now_ns)
    if emulator.socket[()].descriptor == 0:
        delay += _LATENCY_NS
    released = port.held_back[way] > 0 and not held
    for i in range(_PACKETS):
        p = port.packet[i]
        if released and p.length > 0 and p.way == way and p.due_ns == _NEVER:
            p.due_ns = now_ns + delay + 1
        if copies > 0 and p.length == 0:
            p.way, p.length = way, length
            p.due_ns = _NEVER if held else now_ns + delay
            for j in range(length):
                p.content[j] = content[j]
            if corrupt:
                bit = int(draw(emulator.rig[()].random) * 8 * length)
                p.content[bit // 8] ^= np.uint8(1 << (bit % 8))
            copies -= 1
    port.held_back[way] = 1 if held else 0


@kernel
def next_due(port: Record) -> int:
    """The packet that is due next, -1 if none is under way."""
    best, due = -1, _NEVER
    for i in range(_PACKETS):
        p = port[()].packet[i]
        if p.length > 0 and p.due_ns < due:
            best, due = i, p.due_ns
    return best


@kernel
def exchange_in_memory(
    emulator: UdpEmulator, link: UdpLink, command: Array, request: int, feedback: Record, now_ns: int
) -> int:
    """An exchange through memory, `now_ns` on the clock of both sides; returns `ANSWERED` or `SILENT`."""
    port = emulator.port[()]
    deadline = now_ns + link.socket[()].timeout_ns
    look_after(emulator, now_ns)
    encode_command(link, command, request, now_ns)
    post(emulator, link.command_bytes, link.command_bytes.size, _IN, now_ns)
    while True:
        i = next_due(emulator.port)
        if i < 0 or port.packet[i].due_ns > deadline:
            feedback.round_trip_ns = link.socket[()].timeout_ns
            return SILENT
        p = port.packet[i]
        at = max(p.due_ns, now_ns)
        length, way = p.length, p.way
        p.length = 0
        target = emulator.command_bytes if way == _IN else link.answer_bytes
        for j in range(length):
            target[j] = p.content[j]
        if way == _IN:
            written = answer(emulator, length, at)
            if written > 0:
                post(emulator, emulator.answer_bytes, written, _OUT, at)
        elif decode_answer(link, length, feedback):
            feedback.round_trip_ns = at - now_ns
            return ANSWERED


@kernel
def serve(emulator: UdpEmulator, started_ns: int, duration_ns: int, timespec: NDArray[np.int64]) -> int:
    """Serve the socket for so long on the machine's clock, which read `started_ns` when the rig's clock began; returns 1 at
    once when what may be a hello has been received, else 0.

    Args:
        emulator: with a socket that is bound, and its peer known.
        started_ns, duration_ns: [ns].
        timespec: (2,), scratch.
    """
    port = emulator.port[()]
    begin = now(timespec)
    while True:
        at = now(timespec)
        if at - begin >= duration_ns:
            return 0
        time_ns = at - started_ns
        # Also while datagrams come all the time: a flood of them must not hold the watchdog up.
        if time_ns - emulator.rig[()].time_ns >= _IDLE_NS:
            look_after(emulator, time_ns)
        length = receive_datagram(emulator.socket, emulator.command_bytes)
        if length == _HELLO_BYTES:
            return 1
        if length == 0 or (length > 0 and emulator.socket[()].stranger != 0):
            port.refused += 1
        elif length > 0:
            post(emulator, emulator.command_bytes, min(length, LONGEST), _IN, time_ns)
        i = next_due(emulator.port)
        if i >= 0 and port.packet[i].due_ns <= time_ns:
            p = port.packet[i]
            length, way = p.length, p.way
            p.length = 0
            target = emulator.command_bytes if way == _IN else emulator.answer_bytes
            for j in range(length):
                target[j] = p.content[j]
            if way == _OUT:
                send_datagram(emulator.socket, emulator.answer_bytes, length)
                continue
            written = answer(emulator, length, time_ns)
            if written > 0:
                post(emulator, emulator.answer_bytes, written, _OUT, now(timespec) - started_ns)
            continue
        if length >= 0:
            continue
        wait = _IDLE_NS
        if i >= 0 and port.packet[i].due_ns != _NEVER:
            wait = min(wait, max(port.packet[i].due_ns - time_ns, 1000))
        await_datagram(emulator.socket, wait)
