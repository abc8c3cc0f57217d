"""An emulated rig in a process of its own: the plant on the machine's clock, behind a bus, with faults on demand.

It uses the bus as hardware would, and knows nothing of the controller. A session begins with the platform at its start. A
control channel, with one text datagram per question and answer, injects faults and reports the rig's state.
"""

import getpass
import json
import os
import select
import signal
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.planning.target import load_target
from hil.loop.driver import prevent_compilation
from hil.realtime.scheduling import RealTimeSettings, real_time
from hil.rigs.emulation import add_fault, fault, new_emulated
from hil.rigs.udp.datagrams import (
    HELLO_DATAGRAM,
    VERSIONS,
    WELCOME_DATAGRAM,
    DatagramKind,
    decode,
    encode,
)
from hil.rigs.udp.emulator import UdpEmulator, new_udp_emulator, serve
from hil.rigs.udp.link import DEFAULT_ADDRESS, address_in, bound_socket, parse_address, socket_address
from hil.runs.config import POSITION_DRIVES, EmulatorConfig
from hil.runs.prepare import simulated_plant
from plant.compiled import Record
from plant.encoder_readings import encoder_state
from plant.encoders import load_encoder
from plant.errors import GoughError, InputError
from plant.fmu.plant import FmuPlant
from plant.imu import imu_state, load_imu
from plant.mechanism import load_spatial
from plant.truth import TRUTH_LENGTHS

_STEP_NS = 1_000_000
_TURN_NS = 20_000_000
_IDLE_S = 0.1
_MOST_QUESTIONS = 16
"""How many questions the control channel answers at a time, so that a flood of them does not keep the rig waiting."""

_MOST_STRANGERS = 10
_FOUND_AS = "gough-emulator"

_Address = tuple[str, int]


class BusyError(GoughError, OSError):
    """An address is taken, or nobody answers there."""


def emulate(config: EmulatorConfig, settings: RealTimeSettings, say: Callable[[str], None]) -> None:
    """Emulate a rig until SIGINT, SIGTERM or SIGHUP, or `stop` on the control channel; `say` gets each message.

    Raises:
        GoughError: something in the configuration cannot be used, or an address is taken.
    """
    base_imu = config.simulated.base_imu
    faults = [fault(text, base_imu) for text in config.faults]
    with ExitStack() as stack:
        control = _Control(stack.enter_context(_listen(config.control)), _name_of(config), base_imu)
        stack.enter_context(_findable(config.control))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, control.stop)
        if config.bus == "canopen":
            _emulate_canopen(config, faults, settings, say, control)
            return
        where = config.at or DEFAULT_ADDRESS
        udp = _UdpSessions(stack.enter_context(_listen(where)), config, faults, control, say)
        _load(config)
        _announce(config, where, stack.enter_context(real_time(settings)), say)
        while not control.stopped:
            readable, _, _ = select.select([udp.opened, control.socket], [], [], _IDLE_S)
            if control.socket in readable:
                control.answer(None)
            if udp.opened in readable:
                udp.serve(*udp.opened.recvfrom(2048))


def _emulate_canopen(
    config: EmulatorConfig, faults: list[Record], settings: RealTimeSettings, say: Callable[[str], None], control: "_Control"
) -> None:
    from hil.rigs.canopen.emulated_bus import EmulatedBus, faulty_channel
    from hil.rigs.canopen.emulated_nodes import PlantMachine
    from hil.rigs.canopen.settings import DEFAULT_FILE, canopen_settings

    bus = canopen_settings(config.at or DEFAULT_FILE, config.simulated.base_imu)
    with (
        closing(PlantMachine(lambda: _rig_of(config, 1.0 / config.simulated.rate, faults))) as machine,
        real_time(settings) as refused,
        closing(EmulatedBus(bus, machine, faulty_channel(machine.rig))) as nodes,
    ):
        _announce(config, f"{bus.bus.interface} {bus.bus.channel}", refused, say)
        nodes.serve(lambda: control.stopped, lambda: control.answer(machine.rig, {"lost": nodes.lost}))


def _announce(config: EmulatorConfig, where: str, refused: list[str], say: Callable[[str], None]) -> None:
    for text in refused:
        say(f"without {text}")
    say(f"the rig {config.simulated.mechanism} listens at {where}, its control at {config.control}")


def _name_of(config: EmulatorConfig) -> str:
    """The emulator's name, for whoever asks its control channel."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = f"user {os.getuid()}"
    return f"{config.simulated.mechanism} on {config.bus}, of {user}, process {os.getpid()}"


def _findable(control: str) -> socket.socket:
    """A name in the kernel's list of abstract sockets, by which `own_control` finds this emulator as long as it runs."""
    named = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    with suppress(OSError):
        named.bind(f"\0{_FOUND_AS}/{os.getuid()}/{control}")
    return named


def own_control() -> str:
    """The control channel of the one emulator that this user has running on this machine.

    Raises:
        GoughError: there is none, or there are several.
    """
    prefix = f"@{_FOUND_AS}/{os.getuid()}/"
    names = (line.rpartition(" ")[2] for line in Path("/proc/net/unix").read_text().splitlines())
    found = sorted({name.removeprefix(prefix) for name in names if name.startswith(prefix)})
    if not found:
        raise BusyError(
            "no emulator of this user runs on this machine: start one with 'gough emulate', or name another's with --to"
        )
    if len(found) > 1:
        raise InputError(f"there are emulators with their control at {' and '.join(found)}: name one with --to")
    return found[0]


def _listen(address: str) -> socket.socket:
    try:
        return bound_socket(*parse_address(address))
    except OSError as error:
        raise BusyError(f"cannot listen at {address}: {error.strerror}: is another emulator running there?") from None


class _Control:
    """The control channel of a rig with or without an IMU on its base; each answer has the emulator's `name`."""

    def __init__(self, opened: socket.socket, name: str, base_imu: bool) -> None:
        self.socket, self.stopped, self._name, self._base_imu = opened, False, name, base_imu
        opened.setblocking(False)

    def stop(self, *signalled: object) -> None:
        """Ask the emulator to end."""
        del signalled
        self.stopped = True

    def answer(self, rig: Record | None, bus: dict[str, Any] | None = None) -> None:
        """Answer some of the questions that have arrived. There is no `rig` without a session; `bus` becomes part of the
        state.
        """
        for _ in range(_MOST_QUESTIONS):
            try:
                content, sender = self.socket.recvfrom(4096)
            except OSError:
                return
            command, _, argument = content.decode("utf-8", "replace").strip().partition(" ")
            try:
                reply = self._do(command, argument.strip(), rig, bus or {})
            except GoughError as error:
                reply = {"error": str(error)}
            with suppress(OSError):
                self.socket.sendto(json.dumps({"emulator": self._name, **reply}).encode(), sender)

    def _do(self, command: str, argument: str, rig: Record | None, bus: dict[str, Any]) -> dict[str, Any]:
        if command == "stop":
            self.stop()
            return {"stopping": True}
        if rig is None:
            raise InputError("no controller has begun a session: the rig has no state and cannot be disturbed")
        if command == "fault":
            made = fault(argument, self._base_imu)
            if made["begin_ns"] < 0 and rig["enabled_ns"] >= 0:
                passed = int(rig["time_ns"] - rig["enabled_ns"])
                made["begin_ns"], made["end_ns"] = passed, min(int(made["end_ns"]), 2**62) + passed
            # Before the drives are enabled, the course of a disturbance begins now.
            now = 1e-9 * int(rig["time_ns"])
            made["disturbance"]["begin"], made["base"]["begin"] = now, now
            made["base"]["end"] += now
            add_fault(rig, made)
            return {"fault": argument}
        if command == "clear":
            rig["faults"] = 0
            return {"faults": 0}
        if command == "state":
            return {
                "time_s": 1e-9 * int(rig["time_ns"]),
                "drive": rig["drive"].tolist(),
                "code": rig["code"].tolist(),
                "velocity": rig["velocity"].tolist(),
                "lengths": rig["truth"][TRUTH_LENGTHS].tolist(),
                **bus,
            }
        raise InputError(f"the control channel has the commands fault, clear, state and stop, not {command!r}")


def ask(address: str, question: str, patience: float = 2.0) -> dict[str, Any]:
    """Ask an emulator's control channel.

    Raises:
        GoughError: nobody answers, or the emulator refuses.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.settimeout(patience)
        try:
            opened.sendto(question.encode(), parse_address(address))
            reply: dict[str, Any] = json.loads(opened.recv(65536))
        except OSError:
            raise BusyError(f"no emulator answers at {address}: start one with 'gough emulate'") from None
    if "error" in reply:
        raise InputError(reply["error"])
    return reply


def _rig_of(config: EmulatorConfig, period: float, faults: list[Record]) -> tuple[FmuPlant, Record, Record, Record]:
    simulated = config.simulated
    mechanism = load_spatial(simulated.mechanism)
    start = load_target(simulated.target, mechanism, 1.0, simulated.active_frames).start
    plant = simulated_plant(simulated, mechanism, start)
    imu = imu_state(load_imu(simulated.imu), simulated.seed, period, simulated.wiring, simulated.base_imu)
    encoders = encoder_state(load_encoder(simulated.lengths), simulated.seed, period, legs=mechanism.legs)
    position = simulated.drives == POSITION_DRIVES
    return plant, imu, encoders, new_emulated(mechanism, _STEP_NS, simulated.seed, faults, position)


def _load(config: EmulatorConfig) -> None:
    plant, *parts = _rig_of(config, 1e-3, [])
    with plant, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as scratch:
        emulator = new_udp_emulator(plant.handle, *parts)
        emulator.link.socket["descriptor"] = scratch.fileno()
        serve(emulator, time.monotonic_ns(), 0, np.zeros(2, np.int64))


@dataclass(eq=False)
class _UdpSessions:
    """The rig's side of the UDP link: one session after the other."""

    opened: socket.socket
    config: EmulatorConfig
    faults: list[Record]
    control: _Control
    say: Callable[[str], None]

    def serve(self, content: bytes, sender: _Address) -> None:
        """Serve the session that a datagram from `sender` begins, and those that follow it."""
        hello = _hello(content)
        while hello is not None and not self.control.stopped:
            period = 1e-6 * int(hello["period_us"])
            plant, imu, encoders, rig = _rig_of(self.config, period, self.faults)
            with plant:
                watchdog = self.config.watchdog_for(int(hello["period_us"]))
                session, version = int(hello["session"]), int(hello["version"])
                emulator = new_udp_emulator(plant.handle, imu, encoders, rig, session, watchdog, version)
                link = emulator.link.socket
                link["descriptor"], link["peer"] = self.opened.fileno(), socket_address(sender)
                self._welcome(hello, sender)
                self.say(f"session with {sender[0]}:{sender[1]} at {1.0 / period:g} Hz")
                hello, sender = self._serve_session(emulator, sender)
                self.say(f"end of the session; {int(emulator.session['refused'])} datagrams refused")

    def _welcome(self, hello: Record, sender: _Address) -> None:
        watchdog_us = round(1e6 * self.config.watchdog_for(int(hello["period_us"])))
        name = _padded(f"gough emulated {load_spatial(self.config.simulated.mechanism).name}", 32)
        fields = {
            "version": hello["version"],
            "session": hello["session"],
            "watchdog_us": watchdog_us,
            "truthful": 1,
            "name": name,
            "firmware": _padded("1", 16),
        }
        self.opened.sendto(encode(WELCOME_DATAGRAM, kind=DatagramKind.WELCOME, **fields), sender)

    def _serve_session(self, emulator: UdpEmulator, sender: _Address) -> tuple[Record | None, _Address]:
        """Serve a session to its end; returns the hello that begins the next one, and its sender."""
        started, timespec = time.monotonic_ns(), np.zeros(2, np.int64)
        strangers: set[_Address] = set()
        rig, session, link = emulator.rig, emulator.session, emulator.link
        with prevent_compilation():
            while not self.control.stopped:
                met = serve(emulator, started, _TURN_NS, timespec)
                self.control.answer(rig, {"refused": int(session["refused"])})
                self._tell_stranger(address_in(bytes(session["stranger"])), strangers)
                if not met:
                    continue
                hello = _hello(link.command_bytes[: HELLO_DATAGRAM.itemsize].tobytes())
                sender = address_in(bytes(link.socket["sender"]))
                if hello is None:
                    session["refused"] += 1
                elif hello["session"] == session["id"]:
                    self._welcome(hello, sender)
                else:
                    return hello, sender
        return None, sender

    def _tell_stranger(self, stranger: _Address, told: set[_Address]) -> None:
        """Say once of each, but of no more than some, who else sends datagrams to this rig during a session."""
        if stranger[1] and stranger not in told and len(told) < _MOST_STRANGERS:
            told.add(stranger)
            self.say(f"refused: {stranger[0]}:{stranger[1]} sends datagrams that are none of this session's")


def _padded(text: str, size: int) -> NDArray[np.uint8]:
    """A text in ASCII, cut or padded with zeros to this size."""
    return np.frombuffer(text.encode("ascii", "replace")[:size].ljust(size, b"\0"), np.uint8)


def _hello(content: bytes) -> Record | None:
    decoded = (decode(HELLO_DATAGRAM, content, version=version, kind=DatagramKind.HELLO) for version in VERSIONS)
    hello = next((each for each in decoded if each is not None), None)
    return hello if hello is not None and hello["session"] != 0 and hello["period_us"] != 0 else None
