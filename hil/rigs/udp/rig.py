"""The UDP rig: one datagram in each direction per cycle.

Use it over loopback or over a dedicated network interface only: nothing is encrypted, so a network that others use is not safe.
"""

import secrets
import socket
import time

import numpy as np

from hil.rigs import ANSWERED, SILENT, DriveState, Identity, Request, RigError, new_feedback
from hil.rigs.udp.datagrams import HELLO_DATAGRAM, WELCOME_DATAGRAM, WITH_BASE_IMU, DatagramKind, decode, encode, version_for
from hil.rigs.udp.link import exchange_udp, new_link, parse_address, send_command, socket_address
from plant.compiled import Record
from plant.mechanism import LEGS
from plant.pose import Array

TIMEOUT_SHARE = 0.5
"""Share of the period that an exchange may take."""

_OPENING_S, _OLDER_S, _HANDSHAKE_S, _ARMING_S, _STOPPING_S = 2.0, 0.5, 0.2, 2.0, 0.5
_FAREWELLS = 3


class UdpRig:
    """The UDP rig, on the controller's side. A compiled loop exchanges over `link` directly.

    Args:
        address: of the rig, such as 127.0.0.1:47100.
        period: of the exchanges [s].
        anywhere: whether the address may be neither loopback nor of a private network.
        lengths: whether the rig is to tell what its encoders read.
        base_imu: whether it is to tell what an IMU on its base reads.

    Raises:
        InputError: the text is not an address, or the address is not allowed.
    """

    def __init__(
        self, address: str, period: float, anywhere: bool = False, lengths: bool = False, base_imu: bool = False
    ) -> None:  # fmt: skip
        self.address = parse_address(address, anywhere)
        self.command_delay = period
        self.link = new_link()
        self.link.socket["version"] = version_for(lengths, base_imu)
        self.watchdog_s = 0.0
        self._socket: socket.socket | None = None
        self._timespec = np.zeros(2, np.int64)
        self._identity: Identity | None = None

    def open(self) -> None:
        """Shake hands: the rig begins a new session with this controller alone (see `hil.rigs.Rig.open`)."""
        self.close()
        host, port = self.address
        self._socket = opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.settimeout(_HANDSHAKE_S)
        session, version = secrets.randbits(31) + 1, int(self.link.socket["version"])
        welcome = self._greet(opened, session, version, _OPENING_S)
        if welcome is None:
            known = next(
                (each for each in range(version - 1, 0, -1) if self._greet(opened, session + each, each, _OLDER_S)), None
            )  # fmt: skip
            self.close()
            raise RigError(
                f"the rig at {host}:{port} knows the datagrams up to version {known} only, and this run needs version "
                f"{version}, as 2 has lengths and 3 the base's IMU: give it newer firmware (docs/rigs.md), or do without "
                f"{'--base-imu' if version == WITH_BASE_IMU else '--lengths'}"
                if known is not None
                else f"no rig answers at {host}:{port}: start it ('gough emulate --bus udp'), check the address, and that no "
                "other controller has it"
            )
        link = self.link.socket
        link["descriptor"], link["session"], link["sequence"] = opened.fileno(), session, 0
        link["timeout_ns"] = round(1e9 * TIMEOUT_SHARE * self.command_delay)
        link["peer"] = socket_address(self.address)
        self.watchdog_s = 1e-6 * int(welcome["watchdog_us"])
        name, firmware = (bytes(welcome[field]).rstrip(b"\0").decode("ascii", "replace") for field in ("name", "firmware"))
        parts = {"firmware": firmware, "address": f"{host}:{port}", "watchdog": f"{self.watchdog_s:g} s"}
        self._identity = Identity(name, parts)

    def _greet(self, opened: socket.socket, session: int, version: int, patience: float) -> Record | None:
        """The rig's answer to a hello, for which it waits so long [s]; None without one."""
        (host, port), period_us = self.address, round(1e6 * self.command_delay)
        hello = encode(HELLO_DATAGRAM, version=version, kind=DatagramKind.HELLO, session=session, period_us=period_us)
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline:
            try:
                opened.sendto(hello, self.address)
                content, sender = opened.recvfrom(2048)
            except TimeoutError:
                continue
            except OSError as error:
                self.close()
                raise RigError(f"the rig at {host}:{port} cannot be reached: {error.strerror}") from None
            if sender == self.address:
                welcome = decode(WELCOME_DATAGRAM, content, version=version, kind=DatagramKind.WELCOME, session=session)
                if welcome is not None:
                    return welcome
        return None

    def identify(self) -> Identity:
        """The identity that the rig has sent in the handshake.

        Raises:
            RigError: without commands its drives would stop within three periods.
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
        """Reset faults, and wait until all drives are ready (see `hil.rigs.Rig.arm`)."""
        if self._socket is None:
            raise RigError("the rig is not open: open it first")
        self.link.socket["reset"] = 1
        ready, feedback = self._exchange_until(Request.BRAKED, (DriveState.READY, DriveState.FOLLOWING), _ARMING_S)
        self.link.socket["reset"] = 0
        # The next exchange comes a period later.
        time.sleep(self.command_delay)
        if not ready:
            states = ", ".join(f"{k}: {int(drive)}" for k, drive in enumerate(feedback["drive"]))
            codes = ", ".join(f"{int(code):#06x}" for code in feedback["drive_code"])
            raise RigError(f"the drives are not ready within {_ARMING_S:g} s (states {states}; fault codes {codes})")

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """One exchange (see `hil.rigs.Rig.exchange`)."""
        if self._socket is None:
            return SILENT
        return exchange_udp(self.link, command, int(request), feedback, self._timespec)

    def quick_stop(self) -> None:
        """Request a quick stop until the drives report that they have stopped, at most for half a second."""
        if self._socket is None:
            return
        self.link.socket["reset"] = 0
        self._exchange_until(Request.QUICK_STOP, (DriveState.READY, DriveState.NOT_READY, DriveState.FAULTY), _STOPPING_S)

    def _exchange_until(self, request: int, states: tuple[int, ...], patience: float) -> tuple[bool, Record]:
        """Repeat a request until all drives are in one of these states, at most for the patience [s]; returns whether they are,
        and the feedback.
        """
        feedback, deadline = new_feedback()[()], time.monotonic() + patience
        while time.monotonic() < deadline:
            status = self.exchange(np.zeros(LEGS), request, feedback)
            if status == ANSWERED and np.isin(feedback["drive"], states).all():
                return True, feedback
            time.sleep(self.command_delay)
        return False, feedback

    def close(self) -> None:
        """Brake the drives and close the socket. If the commands do not arrive, the rig's watchdog brakes the drives."""
        if self._socket is None:
            return
        if self._identity is not None:
            for _ in range(_FAREWELLS):
                send_command(self.link, np.zeros(LEGS), int(Request.BRAKED), 0)
        self._socket.close()
        self._socket, self._identity = None, None
        self.link.socket["descriptor"] = -1
