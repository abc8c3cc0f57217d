"""Streamed targets: poses arrive as UDP datagrams, about 100 a second, and a process of its own plans how to follow them.

    sender --UDP--> receiver   checks each pose, plans, writes into shared memory and never waits for the loop
                      loop     takes the plans as they come (see `controller.planning.plan_handover`)

A datagram of version 1 is little-endian and packed, 78 bytes: `GGHT`, version (2 bytes), sequence number (4), time of the pose
on the sender's clock [ns] (8), displacement from home x, y, z [m] and rotation from home as a unit quaternion, w first (7
doubles), or those of the tool in the run's work frame, and the CRC-32 of all these bytes (4). One that begins with `GGHE`
instead ends the stream: the platform comes to rest at its pose and stays there. A sender that falls silent without it is lost.

UDP does not authenticate senders: by default the receiver listens only to this machine, and only to the first sender.
"""

import math
import os
import select
import socket
import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from controller.frames import ActiveFrames
from controller.planning.plan_handover import (
    CAUSE,
    CYCLE,
    END_PLANNER,
    SEEN,
    STREAM,
    TAKEN,
    fail_stream,
    note_sample,
    publish_plan,
)
from controller.planning.stream_planner import Plan, StreamPlanner, TargetRefusedError
from controller.planning.target import Target, samples_of
from controller.safety.causes import Cause
from hil.realtime.scheduling import before_others
from hil.rigs.udp import datagrams
from hil.rigs.udp.link import bound_socket
from plant.compiled import Record
from plant.errors import GoughError, InputError
from plant.mechanism import Mechanism

HOST, PORT = "127.0.0.1", 47200

_HEAD = [("magic", "u4"), ("version", "u2"), ("sequence", "u4"), ("time_ns", "u8")]
TARGET_DATAGRAM = np.dtype([*_HEAD, ("displacement", "f8", 3), ("quaternion", "f8", 4), ("crc", "u4")])
_NUMBERS = 1 << 32
_POSE, _END = ({"magic": int.from_bytes(magic, "little"), "version": 1} for magic in (b"GGHT", b"GGHE"))

FAREWELLS = 5
"""How often a sender sends the end of its stream, because datagrams can be lost."""

LEAD_S = 0.01
"""How long before its start a plan is made: the delay that planner and loop together may have [s]."""

_POLL_S = 0.02
_SETTLE_S = 1e-3
"""The receiver's longest sleep while it waits for a sample, and while the loop decides on a plan."""

_CLOCK_SAMPLES = 15
"""Number of samples over which the sender's clock is compared with the motion's time, against the network's jitter."""

_BATCH = 64
_JUMP_M = 0.05


class StreamError(GoughError, OSError):
    """The network refuses what a stream needs."""


def encode(number: int, time_ns: int, displacement: ArrayLike, quaternion: ArrayLike, last: bool = False) -> bytes:
    """The datagram of a pose, or of the last one, which ends the stream; its number wraps."""
    kind, pose = _END if last else _POSE, {"displacement": displacement, "quaternion": quaternion}
    return datagrams.encode(TARGET_DATAGRAM, **kind, sequence=number % _NUMBERS, time_ns=time_ns, **pose)


def decode(content: bytes) -> Record | None:
    """The pose (dtype `TARGET_DATAGRAM`) of a datagram, which may be the last one; None if it is malformed, damaged, or of
    another version.
    """
    pose = datagrams.decode(TARGET_DATAGRAM, content, **_POSE)
    return datagrams.decode(TARGET_DATAGRAM, content, **_END) if pose is None else pose


def is_last(pose: Record) -> bool:
    """Whether a pose ends its stream."""
    return bool(pose["magic"] == _END["magic"])


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


def receive(stream: Record, planner: StreamPlanner, receiver: socket.socket, period: float) -> None:
    """Receive a stream and plan, until `END_PLANNER` is set or the parent process has ended; the body of a process.

    A sample that cannot be followed fails the stream for good: planning ends, and the last plan ends at rest.

    Args:
        stream: dtype `STREAM`, shared with the loop.
        planner: at the lengths at which the loop's reference rests.
        receiver: from `open_socket`.
        period: of a cycle [s].
    """
    parent = os.getppid()
    load_handover()
    reception = Reception(stream, planner, period)
    with before_others():
        while not (stream["shared"][END_PLANNER] or os.getppid() != parent):
            select.select([receiver], [], [], _SETTLE_S if reception.waits else _POLL_S)
            for _ in range(_BATCH):
                try:
                    datagram, sender = receiver.recvfrom(TARGET_DATAGRAM.itemsize + 1)
                except BlockingIOError:
                    break
                except OSError:
                    # An error of an earlier datagram does not concern the stream.
                    continue
                reception.take(datagram, sender)
            reception.plan()


def load_handover() -> None:
    """Load the machine code that hands plans over: between samples there is not enough time."""
    scratch = np.zeros((), STREAM)
    publish_plan(scratch, np.zeros(STREAM["plans"].shape[1:]), 0.0, 0)
    note_sample(scratch, 1)
    fail_stream(scratch, Cause.NONE, 0, 0.0, 0.0)


class PlanOffers:
    """The plans of a stream, one after the other: each is followed if the loop has taken it.

    Attributes:
        late: whether the loop could not take the last one in time.
    """

    def __init__(self, stream: Record, planner: StreamPlanner, period: float) -> None:
        self._stream, self._shared, self._planner, self._period = stream, stream["shared"], planner, period
        self._lead = math.ceil(LEAD_S / period - 1e-9)
        self._pending: tuple[int, Plan] | None = None
        self.late = False

    @property
    def waits(self) -> bool:
        """Whether the loop has not decided on a plan yet."""
        return self._pending is not None

    def settle(self) -> bool:
        """Note the loop's decision on the last plan; returns whether there is one."""
        self.late = False
        if self._pending is None:
            return True
        number, plan = self._pending
        if self._shared[SEEN] < number:
            return False
        self._pending = None
        if self._shared[TAKEN] == number:
            self._planner.follow(plan)
        else:
            self._stream["late"] += 1
            self.late = True
        return True

    def offer(self, target_began: float, ended: bool = False) -> None:
        """Make a plan, and offer it to the loop. The target's own time is 0 at `target_began` [s] of the motion."""
        begin = max((int(self._shared[CYCLE]) + self._lead) * self._period, self._planner.current.begin)
        made = self._planner.plan(begin, begin - target_began, ended)
        if made is not None:
            self._pending = publish_plan(self._stream, made.segments, made.begin, int(self._shared[TAKEN])), made
            self._stream["planned"] += 1


class Reception:
    """The sender, its last sample and its clock, and the plans that come of it."""

    def __init__(self, stream: Record, planner: StreamPlanner, period: float) -> None:
        self._stream, self._planner, self._period = stream, planner, period
        self._shared, self._offers = stream["shared"], PlanOffers(stream, planner, period)
        self._sender: object = None
        self._number, self._time_ns, self._first_ns, self._at = 0, 0, 0, 0.0
        self._offsets: deque[float] = deque(maxlen=_CLOCK_SAMPLES)
        self._fresh = self._ended = False

    @property
    def waits(self) -> bool:
        """Whether the loop has not decided on a plan yet."""
        return self._offers.waits

    def take(self, datagram: bytes, sender: object) -> None:
        """Check a datagram, and keep its sample."""
        stream, pose = self._stream, decode(datagram)
        if pose is None:
            stream["malformed"] += 1
            return
        number, time_ns, first = int(pose["sequence"]), int(pose["time_ns"]), self._sender is None
        if not first and sender != self._sender:
            stream["strange"] += 1
            return
        newer = 0 < (number - self._number) % _NUMBERS < _NUMBERS // 2 and time_ns > self._time_ns
        if self._ended or (not first and not newer):
            stream["stale"] += 1
            return
        if self._shared[CAUSE] != Cause.NONE:
            return
        if first:
            self._first_ns = time_ns
        at = 1e-9 * (time_ns - self._first_ns)
        try:
            self._planner.add(at, pose["displacement"], pose["quaternion"])
        except TargetRefusedError as refusal:
            fail_stream(stream, refusal.cause, refusal.index, refusal.value, refusal.limit)
            return
        self._sender, self._number, self._time_ns, self._at, self._fresh = sender, number, time_ns, at, True
        cycle = int(self._shared[CYCLE])
        if cycle == 0:
            # The motion's time does not run before its start.
            self._offsets.clear()
        self._offsets.append(cycle * self._period - at)
        stream["accepted"] += 1
        self._ended = is_last(pose)
        # After the last sample none is missed.
        note_sample(stream, 0 if self._ended else time.monotonic_ns())

    def plan(self) -> None:
        """Note the loop's decision on the last plan, and make a plan for the newest sample."""
        if not self._offers.settle():
            return
        # After the end of a stream no further sample would bring another plan.
        self._fresh |= self._ended and self._offers.late
        if self._fresh and self._shared[CAUSE] == Cause.NONE:
            self._fresh = False
            self._offers.offer(self._at + median(self._offsets), self._ended)


@dataclass(frozen=True)
class Faults:
    """Faults of a sender on purpose, each from a time of its motion on [s]."""

    stop_at: float = math.inf  # silence
    jump_at: float = math.inf  # a jump up by 5 cm
    nan_at: float = math.inf  # NaN


def send_target(
    mechanism: Mechanism,
    target: Target,
    rate: float = 100.0,
    host: str = HOST,
    port: int = PORT,
    duration: float | None = None,
    faults: Faults | None = None,
    frames: ActiveFrames | None = None,
) -> int:
    """Stream a target in real time, each pose at its time; returns the number of poses sent.

    Args:
        mechanism: its home is the origin of the displacements.
        target: the motion.
        rate: poses per second [Hz].
        host, port: of the receiver.
        duration: of the motion [s]; None for all of it.
        faults: of the sender.
        frames: those of the run; None if it has none.

    Raises:
        InputError: the rate or the duration is not positive and finite, or the rate is above 10 kHz.
        StreamError: there is no such address.
    """
    duration = float(target.times[-1]) if duration is None else duration
    _check_rate(rate)
    if not 0.0 < duration < math.inf:
        raise InputError(f"the duration is {duration:g} s; it must be positive and finite")
    home, faults = mechanism.require_home(), faults or Faults()
    times = np.arange(math.floor(duration * rate) + 1) / rate
    times = times[times < faults.stop_at]
    positions, rotations = target.at(times)
    displacements, quaternions = samples_of(positions, rotations, home, frames)
    displacements[times >= faults.jump_at] += [0.0, 0.0, _JUMP_M]
    displacements[times >= faults.nan_at] = np.nan
    # One that falls silent on purpose does not say so.
    return send_poses(zip(displacements, quaternions, strict=True), rate, host, port, faults.stop_at >= duration)


def send_poses(
    poses: Iterable[tuple[ArrayLike, ArrayLike]], rate: float, host: str = HOST, port: int = PORT, ends: bool = True
) -> int:
    """Stream poses in real time, each made and sent when it is due, and the last one again as the end of the stream if it
    `ends`; returns how many were sent.

    Args:
        poses: displacements (3,) [m] and quaternions (4,), as in a datagram.
        rate: poses per second [Hz].
        host, port: of the receiver.
        ends: whether the receiver is told the end.

    Raises:
        InputError: the rate is not positive, or above 10 kHz.
        StreamError: there is no such address.
    """
    _check_rate(rate)
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as sender:
            return _send(sender, address, rate, iter(poses), ends)
    except (OSError, OverflowError) as error:
        raise StreamError(f"cannot send a target to {host}:{port}: {error}: choose another address or port") from None


def _check_rate(rate: float) -> None:
    if not 0.0 < rate <= 10_000.0:
        raise InputError(f"the rate is {rate:g} Hz; it must be positive and at most 10000: choose another")


def _send(sender: socket.socket, address: Any, rate: float, poses: Iterator[tuple[ArrayLike, ArrayLike]], ends: bool) -> int:
    began, sent, number, left = time.monotonic_ns(), 0, 0, FAREWELLS if ends else 0
    pose: tuple[ArrayLike, ArrayLike] | None = None
    while True:
        due = began + round(1e9 * number / rate)
        late = time.monotonic_ns() - due
        if late < 0:
            time.sleep(-1e-9 * late)
        following = next(poses, None)
        last = following is None
        pose = pose if following is None else following
        if pose is None or (last and left == 0):
            return sent
        number += 1
        left -= last
        # A sender that is held up leaves out the poses whose time is over.
        if late <= 1e9 / rate or last:
            try:
                sender.sendto(encode(number - 1, due, *pose, last), address)
            except ConnectionRefusedError:
                # Nobody listens yet, or nobody listens any more.
                continue
            sent += not last
