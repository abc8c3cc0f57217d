"""Streamed targets: poses arrive as UDP datagrams, about 100 a second, and a process of its own plans how to follow them.

    sender --UDP--> receiver   checks each pose, plans, writes into shared memory and never waits for the loop
                      loop     takes the plans as they come (see `controller.planning.stream`)

A datagram of version 1 is little-endian and packed, 78 bytes: `GGHT`, version (2 bytes), sequence number (4), time of the pose
on the sender's clock [ns] (8), displacement from home x, y, z [m] and rotation from home as a unit quaternion, w first (7
doubles), and the CRC-32 of all these bytes (4). UDP does not authenticate senders: by default the receiver listens only to this
machine, and only to the first sender.
"""

import math
import os
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from controller.planning.stream import CAUSE, CYCLE, END_PLANNER, SEEN, STREAM, TAKEN, fail_stream, note_sample, publish_plan
from controller.planning.stream_planner import Plan, StreamPlanner, TargetRefusedError
from controller.planning.target import Target
from controller.safety.causes import Cause
from hil.rigs.udp import datagrams
from hil.rigs.udp.link import bound_socket
from plant.compiled import Record
from plant.errors import GoughError, InputError
from plant.mechanism import Mechanism
from plant.pose import Array, quaternion_from_rotation

HOST, PORT = "127.0.0.1", 47200
MAGIC, VERSION = int.from_bytes(b"GGHT", "little"), 1

TARGET_DATAGRAM = np.dtype(
    [
        ("magic", np.uint32),
        ("version", np.uint16),
        ("sequence", np.uint32),
        ("time_ns", np.uint64),
        ("displacement", np.float64, 3),
        ("quaternion", np.float64, 4),
        ("crc", np.uint32),
    ]
)
DATAGRAM_BYTES = TARGET_DATAGRAM.itemsize
_SEQUENCES = 1 << 32

LEAD_S = 0.01
"""How long before its start a plan is made: the delay that planner and loop together may have [s]."""

_POLL_S = 0.02
_SETTLE_S = 1e-3
"""The receiver's longest sleep while it waits for a sample, and while the loop decides on a plan."""

_CLOCK_SAMPLES = 15
"""Number of samples over which the sender's clock is compared with the motion's time, against the network's jitter."""

_BATCH = 64


class StreamError(GoughError, OSError):
    """The network refuses what a stream needs."""


class Sample(NamedTuple):
    """A pose of the target: number, time on the sender's clock [ns], displacement (3,) [m], quaternion (4,), w first."""

    sequence: int
    time_ns: int
    displacement: tuple[float, ...]
    quaternion: tuple[float, ...]


def encode(sample: Sample) -> bytes:
    """The datagram of a sample."""
    fields = sample._asdict() | {"sequence": sample.sequence % _SEQUENCES}
    return datagrams.encode(TARGET_DATAGRAM, magic=MAGIC, version=VERSION, **fields)


def decode(content: bytes) -> Sample | None:
    """The sample of a datagram; None if it is malformed, damaged, or of another version."""
    datagram = datagrams.decode(TARGET_DATAGRAM, content, magic=MAGIC, version=VERSION)
    if datagram is None:
        return None
    displacement, quaternion = tuple(datagram["displacement"].tolist()), tuple(datagram["quaternion"].tolist())
    return Sample(int(datagram["sequence"]), int(datagram["time_ns"]), displacement, quaternion)


def open_socket(host: str = HOST, port: int = PORT) -> socket.socket:
    """A socket that receives a stream; port 0 takes a free one.

    Raises:
        StreamError: the address cannot be used.
    """
    try:
        receiver = bound_socket(host, port)
    except (OSError, OverflowError) as error:
        raise StreamError(f"cannot receive a target at {host}:{port}: {error}: choose another address or port") from None
    receiver.setblocking(False)
    return receiver


def receive(
    stream: Record,
    planner: StreamPlanner,
    receiver: socket.socket,
    period: float,
    lead: float = LEAD_S,
    ended: Callable[[], bool] = lambda: False,
) -> None:
    """Receive a stream and plan, until `END_PLANNER` is set or the parent process has ended; the body of a process.

    A sample that cannot be followed fails the stream for good: planning ends, and the last plan ends at rest.

    Args:
        stream: dtype `controller.planning.stream.STREAM`, shared with the loop.
        planner: at the lengths at which the loop's reference rests.
        receiver: from `open_socket`.
        period: of a cycle [s].
        lead: how long before its start a plan is made [s].
        ended: whether to end for another reason.
    """
    parent = os.getppid()
    _load_kernels()
    reception = Reception(stream, planner, period, lead)
    while not (stream["shared"][END_PLANNER] or ended() or os.getppid() != parent):
        select.select([receiver], [], [], _SETTLE_S if reception.waits else _POLL_S)
        for _ in range(_BATCH):
            try:
                datagram, sender = receiver.recvfrom(DATAGRAM_BYTES + 1)
            except BlockingIOError:
                break
            except OSError:
                # An error of an earlier datagram does not concern the stream.
                continue
            reception.take(datagram, sender)
        reception.plan()


def _load_kernels() -> None:
    """Run the kernels once on scratch, so that none has to be loaded or compiled when a sample arrives."""
    scratch = np.zeros((), STREAM)
    publish_plan(scratch, np.zeros(STREAM["plans"].shape[1:]), 0.0, 0)
    note_sample(scratch, 1)
    fail_stream(scratch, Cause.NONE, 0, 0.0, 0.0)


class Reception:
    """State of the receiver: the sender, the last sample, the sender's clock, and the plan that the loop may still take."""

    def __init__(self, stream: Record, planner: StreamPlanner, period: float, lead: float) -> None:
        self._stream, self._planner, self._period = stream, planner, period
        self._shared = stream["shared"]
        self._lead = math.ceil(lead / period - 1e-9)
        self._sender: object = None
        self._last: Sample | None = None
        self._first, self._at = 0, 0.0
        self._offsets: deque[float] = deque(maxlen=_CLOCK_SAMPLES)
        self._pending: tuple[int, Plan] | None = None
        self._fresh = False

    @property
    def waits(self) -> bool:
        """Whether the loop has not decided on a plan yet."""
        return self._pending is not None

    def take(self, datagram: bytes, sender: object) -> None:
        """Check a datagram, and keep its sample."""
        stream, sample = self._stream, decode(datagram)
        if sample is None:
            stream["malformed"] += 1
            return
        if self._last is not None:
            if sender != self._sender:
                stream["strange"] += 1
                return
            newer = 0 < (sample.sequence - self._last.sequence) % _SEQUENCES < _SEQUENCES // 2
            if not (newer and sample.time_ns > self._last.time_ns):
                stream["stale"] += 1
                return
        if self._shared[CAUSE] != Cause.NONE:
            return
        if self._last is None:
            self._first = sample.time_ns
        at = 1e-9 * (sample.time_ns - self._first)
        try:
            self._planner.add(at, sample.displacement, sample.quaternion)
        except TargetRefusedError as refusal:
            fail_stream(stream, refusal.cause, refusal.index, refusal.value, refusal.limit)
            return
        self._sender, self._last, self._at, self._fresh = sender, sample, at, True
        cycle = int(self._shared[CYCLE])
        if cycle == 0:
            # The motion's time does not run before its start.
            self._offsets.clear()
        self._offsets.append(cycle * self._period - at)
        stream["accepted"] += 1
        note_sample(stream, time.monotonic_ns())

    def plan(self) -> None:
        """Note the loop's decision on the last plan, and make a plan for the newest sample."""
        stream, shared = self._stream, self._shared
        if self._pending is not None:
            number, plan = self._pending
            if shared[SEEN] < number:
                return
            self._pending = None
            if shared[TAKEN] == number:
                self._planner.follow(plan)
            else:
                stream["late"] += 1
        if not self._fresh or shared[CAUSE] != Cause.NONE:
            return
        self._fresh = False
        begin = max((int(shared[CYCLE]) + self._lead) * self._period, self._planner.current.begin)
        made = self._planner.plan(begin, begin - (self._at + median(self._offsets)))
        if made is not None:
            self._pending = publish_plan(stream, made.segments, made.begin, int(shared[TAKEN])), made
            stream["planned"] += 1


@dataclass(frozen=True)
class Faults:
    """Faults of a sender on purpose, each from a time of its motion on [s]: silence, a jump by 5 cm, NaN."""

    stop_at: float = math.inf
    jump_at: float = math.inf
    nan_at: float = math.inf


_JUMP_M = 0.05


def send_target(
    mechanism: Mechanism,
    target: Target,
    rate: float = 100.0,
    host: str = HOST,
    port: int = PORT,
    duration: float | None = None,
    faults: Faults | None = None,
) -> int:
    """Stream a target in real time, each pose at its time; returns the number of poses sent.

    Args:
        mechanism: its home is the origin of the displacements.
        target: the motion.
        rate: poses per second [Hz].
        host, port: of the receiver.
        duration: of the motion [s]; None for all of it.
        faults: of the sender.

    Raises:
        InputError: the rate or the duration is not positive and finite, or the rate is above 10 kHz.
        StreamError: there is no such address.
    """
    duration = float(target.times[-1]) if duration is None else duration
    if not 0.0 < rate <= 10_000.0:
        raise InputError(f"the rate is {rate:g} Hz; it must be positive and at most 10000: choose another")
    if not 0.0 < duration < math.inf:
        raise InputError(f"the duration is {duration:g} s; it must be positive and finite")
    times = np.arange(math.floor(duration * rate) + 1) / rate
    displacements, quaternions = _streamed(mechanism, target, times, faults or Faults())
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as sender:
            return _send(sender, address, rate, displacements, quaternions)
    except (OSError, OverflowError) as error:
        raise StreamError(f"cannot send a target to {host}:{port}: {error}: choose another address or port") from None


def _streamed(mechanism: Mechanism, target: Target, times: Array, faults: Faults) -> tuple[Array, Array]:
    """Displacements (n, 3) and quaternions (n, 4) from home at times (n,), with the faults."""
    home = mechanism.require_home()
    times = times[times < faults.stop_at]
    positions, rotations = target.at(times)
    displacements = positions - home.position
    displacements[times >= faults.jump_at] += [0.0, 0.0, _JUMP_M]
    displacements[times >= faults.nan_at] = np.nan
    return displacements, quaternion_from_rotation(rotations @ home.rotation.T)


def _send(sender: socket.socket, address: tuple[Any, ...], rate: float, displacements: Array, quaternions: Array) -> int:
    began, sent = time.monotonic_ns(), 0
    for k, (displacement, quaternion) in enumerate(zip(displacements.tolist(), quaternions.tolist(), strict=True)):
        due = began + round(1e9 * k / rate)
        late = time.monotonic_ns() - due
        if late > 1e9 / rate:
            # A sender that is held up leaves out the poses whose time is over.
            continue
        if late < 0:
            time.sleep(-1e-9 * late)
        datagram = encode(Sample(k, due, tuple(displacement), tuple(quaternion)))
        try:
            sender.sendto(datagram, address)
        except ConnectionRefusedError:
            # Nobody listens yet, or nobody listens any more.
            continue
        sent += 1
    return sent
