"""Streamed cues: from a vehicle's motion, as it comes, to poses that a run follows.

The vehicle's motion is a CSV file, or lines of its form that arrive on standard input or as UDP datagrams. They are
`time_s,ax_m_s2,ay_m_s2,az_m_s2,wx_rad_s,wy_rad_s,wz_rad_s`; after a header with `fx_m_s2,fy_m_s2,fz_m_s2` they have specific
forces, with gravity. The newest line counts. A vehicle that falls silent is taken to be at rest, so that the platform goes back
to the middle, gently.

As UDP does not authenticate senders, only the first one is listened to.
"""

import os
import select
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from controller.frames import ActiveFrames
from controller.planning.motions import CueFilter, load_washout, read_vehicle
from controller.planning.motions.cueing import COLUMNS, FORCE_COLUMNS, Site
from controller.planning.target import poses_of
from hil.rigs.udp.link import bound_socket
from hil.runs.target_stream import StreamError, send_poses
from plant.errors import InputError
from plant.mechanism import Mechanism
from plant.pose import Array, Pose

STDIN, UDP = "-", "udp:"
"""Where a vehicle's motion may come from, besides a file."""

SETTLE_S = 6.0
"""Time after the vehicle's motion for the platform to go back to the middle."""

_PATIENCE_S = 0.5
"""A vehicle that is silent for so long is taken to be at rest."""

_DATAGRAM, _CHUNK = 512, 65536
_AT_REST = np.zeros(3), np.zeros(3), False

Sample = tuple[Array, Array, bool]
"""Acceleration or specific force (3,) [m/s^2], angular velocity (3,) [rad/s], and whether it is a specific force."""


class Source(Protocol):
    """A vehicle."""

    def sample(self, number: int, period: float) -> Sample | None:
        """The vehicle's motion for a pose, the first of which has the number 1; None at its end."""

    def figures(self) -> dict[str, Any]:
        """What came."""


class Recorded:
    """A vehicle's motion from a CSV file, each sample at its time."""

    def __init__(self, path: str) -> None:
        self._vehicle = read_vehicle(path)

    def sample(self, number: int, period: float) -> Sample | None:
        """As `Source` says."""
        at, (times, forces, rates, gravity) = number * period, self._vehicle
        if at > times[-1]:
            return None
        force, rate = (np.array([np.interp(at, times, column) for column in values.T]) for values in (forces, rates))
        return force, rate, gravity

    def figures(self) -> dict[str, Any]:
        """As `Source` says."""
        return {"lines": len(self._vehicle.times), "malformed": 0, "stale": 0}


class Lines:
    """A vehicle's motion that arrives line by line; the newest counts."""

    def __init__(self) -> None:
        self._last: Sample = _AT_REST
        self._time, self._heard, self._gravity = -np.inf, 0.0, False
        self._counts = {"lines": 0, "malformed": 0, "stale": 0}

    def figures(self) -> dict[str, Any]:
        """As `Source` says."""
        return dict(self._counts)

    def take(self, line: str) -> None:
        """Take a line, if it is one."""
        line = line.strip()
        names = tuple(name.strip() for name in line.split(","))
        if names in (COLUMNS, FORCE_COLUMNS):
            self._gravity = names == FORCE_COLUMNS
            return
        if not line:
            return
        try:
            row = np.array([float(field) for field in line.split(",")])
        except ValueError:
            row = np.empty(0)
        if len(row) != len(COLUMNS) or not np.isfinite(row).all():
            self._counts["malformed"] += 1
        elif row[0] <= self._time:
            self._counts["stale"] += 1
        else:
            self._time, self._heard = float(row[0]), time.monotonic()
            self._last = row[1:4], row[4:], self._gravity
            self._counts["lines"] += 1

    def newest(self) -> Sample:
        """The newest sample, or that of a vehicle at rest."""
        return self._last if time.monotonic() - self._heard <= _PATIENCE_S else _AT_REST


class StandardInput(Lines):
    """Lines on a descriptor, by default standard input, until its end."""

    def __init__(self, descriptor: int = 0) -> None:
        super().__init__()
        self._descriptor, self._rest = descriptor, b""

    def sample(self, number: int, period: float) -> Sample | None:
        """As `Source` says."""
        while select.select([self._descriptor], [], [], 0.0)[0]:
            chunk = os.read(self._descriptor, _CHUNK)
            if not chunk:
                return None
            *lines, self._rest = (self._rest + chunk).split(b"\n")
            for line in lines:
                self.take(line.decode(errors="replace"))
        return self.newest()


class Datagrams(Lines):
    """Lines in UDP datagrams, one or several in each, until one that says `end`."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__()
        try:
            self.socket = bound_socket(host, port)
        except (OSError, OverflowError) as error:
            raise StreamError(f"cannot receive a vehicle's motion at {host}:{port}: {error}: choose another") from None
        self.socket.setblocking(False)
        self._sender: Any = None
        self._counts["strange"] = 0

    def sample(self, number: int, period: float) -> Sample | None:
        """As `Source` says."""
        while True:
            try:
                content, sender = self.socket.recvfrom(_DATAGRAM)
            except BlockingIOError:
                return self.newest()
            except OSError:
                # An error of an earlier datagram does not concern the stream.
                continue
            self._sender = self._sender or sender
            if sender != self._sender:
                self._counts["strange"] += 1
                continue
            for line in content.decode(errors="replace").splitlines():
                if line.strip() == "end":
                    self.socket.close()
                    return None
                self.take(line)


def source_of(text: str) -> Source:
    """The vehicle that a text names: a CSV file, "-" for standard input, or udp:HOST:PORT.

    Raises:
        InputError: it names none, or the file is malformed.
        StreamError: the address cannot be used.
    """
    if text == STDIN:
        return StandardInput()
    if not text.startswith(UDP):
        return Recorded(text)
    host, _, port = text.removeprefix(UDP).rpartition(":")
    if not host or not port.isdecimal():
        raise InputError(f"{text!r} is no address such as udp:127.0.0.1:47300")
    return Datagrams(host.strip("[]"), int(port))


def site_of(mechanism: Mechanism, frames: ActiveFrames | None, point: tuple[float, ...]) -> Site:
    """Where a streamed cue is rendered: at home, in poses as a stream has them."""
    home = mechanism.require_home()
    begin = Pose(np.zeros(3), np.eye(3)) if frames is None else Pose(*frames.to_target(home, home))
    return Site(mechanism, begin, lambda positions, rotations: poses_of(positions, rotations, home, frames), point)


def send_cues(
    mechanism: Mechanism,
    settings: str | Path,
    source: Source,
    rate: float,
    host: str,
    port: int,
    duration: float | None = None,
    frames: ActiveFrames | None = None,
) -> dict[str, Any]:
    """Send what a platform renders of a vehicle's motion, in real time; returns what came, was sent, and was kept from it.

    Args:
        mechanism: with home and limits.
        settings: TOML file of the washout (docs/motions.md).
        source: the vehicle.
        rate: poses per second [Hz].
        host, port: of the receiver.
        duration: after which the vehicle's motion ends in any case [s].
        frames: those of the run; None if it has none.

    Raises:
        InputError: the settings or the rate are wrong.
        StreamError: there is no such address.
    """
    washout = load_washout(settings)
    cue = CueFilter(washout, site_of(mechanism, frames, washout.point))
    sent = send_poses(_poses(cue, source, rate, duration), rate, host, port)
    return {"sent": sent, "vehicle": source.figures(), "kept": asdict(cue.kept)}


def _poses(cue: CueFilter, source: Source, rate: float, duration: float | None) -> Iterator[tuple[Array, Array]]:
    """Poses, each made when it is asked for."""
    period, number, settled = 1.0 / rate, 0, 0
    yield cue.step(*_AT_REST[:2], period)
    while settled < SETTLE_S * rate:
        number += 1
        over = settled > 0 or (duration is not None and number * period > duration)
        sample = None if over else source.sample(number, period)
        settled += sample is None
        force, turn, gravity = sample or _AT_REST
        yield cue.step(force, turn, period, gravity)
