"""The UDP rig against two rigs, the reference in C and the emulated one; and its decoders against what is wrong."""

import re
import secrets
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

import hil.rigs.udp
from hil.command_line import main
from hil.rigs import (
    ANSWERED,
    BRAKED,
    ENABLED,
    FAULTY,
    FOLLOWING,
    QUICK_STOP,
    QUICK_STOPPING,
    READY,
    RigError,
    new_feedback,
)
from hil.rigs.canopen.settings import LARGEST_LOAD, canopen_settings
from hil.rigs.udp import datagrams
from hil.rigs.udp.datagrams import (
    COMMAND_DATAGRAM,
    HELLO_DATAGRAM,
    LENGTHS_DATAGRAM,
    MEASUREMENT_DATAGRAM,
    TRUTH_DATAGRAM,
    VERSION,
    WELCOME_DATAGRAM,
    WITH_LENGTHS,
    DatagramKind,
    crc32,
    decode,
    encode,
)
from hil.rigs.udp.emulator import WATCHDOG_CODE, answer_command, new_udp_emulator, serve
from hil.rigs.udp.link import (
    address_in,
    await_datagram,
    bound_socket,
    decode_answer,
    new_link,
    parse_address,
    receive_datagram,
    socket_address,
)
from hil.rigs.udp.rig import UdpRig
from hil.runs.config import EmulatorConfig, SimulationConfig
from hil.runs.emulator_process import _rig_of
from plant.compiled import kernel
from plant.errors import InputError
from tests.hil.ports import free_port

SOURCES = Path(hil.rigs.udp.__file__).parent
DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "rigs.md"
COMPILE = (shutil.which("cc") or "gcc", "-std=c11", "-Wall", "-Wextra", "-Werror", "-Wpedantic", f"-I{SOURCES}")
DATAGRAMS = {
    name: getattr(datagrams, f"{name.upper()}_DATAGRAM")
    for name in ("hello", "welcome", "command", "measurement", "lengths", "base_imu", "truth")
}
HEAD = ("magic", "version", "kind", "session", "sequence", "time_ns")
PERIOD = 0.01
SPEEDS = 0.01 * np.array([1.0, -2.0, 3.0, -4.0, 5.0, -6.0])


def fields(dtype):
    """Name, offset and type of each field, such as `float32[6]`."""
    for name, (kind, offset, *_) in dtype.fields.items():
        yield name, offset, kind.base.name + "".join(f"[{size}]" for size in kind.shape)


# The header, and the table in the documentation.


def test_the_header_has_the_layout_of_the_datagrams(tmp_path):
    lines = []
    for name, dtype in DATAGRAMS.items():
        for field, _, _ in fields(dtype):
            member = f"head.{field}" if field in HEAD and name not in ("lengths", "base_imu", "truth") else field
            size = f"sizeof ((struct gough_{name} *)0)->{member}"
            lines.append(f'printf("{name} {field} %zu %zu\\n", offsetof(struct gough_{name}, {member}), {size});')
        lines.append(f'printf("{name} - %zu 0\\n", GOUGH_{name.upper()}_LENGTH);')
    lines.append('printf("crc %#x\\n", gough_crc32("123456789", 9));')
    source, program = tmp_path / "offsets.c", tmp_path / "offsets"
    source.write_text('#include "gough_rig.h"\n#include <stdio.h>\nint main(void) {\n' + "\n".join(lines) + "\nreturn 0;\n}\n")
    subprocess.run([*COMPILE, "-o", program, source], check=True)
    told = subprocess.run([program], check=True, capture_output=True, text=True).stdout.splitlines()
    expected = []
    for name, dtype in DATAGRAMS.items():
        expected += [f"{name} {field} {offset} {dtype[field].itemsize}" for field, offset, _ in fields(dtype)]
        expected.append(f"{name} - {dtype.itemsize} 0")
    assert told == [*expected, "crc 0xcbf43926"]


def test_the_header_has_the_constants_of_the_datagrams():
    text = (SOURCES / "gough_rig.h").read_text()
    constants = {
        name: int(value, 0) for name, value in re.findall(r"#define GOUGH_(\w+) (\w+?)u?\b", text) if value[0].isdigit()
    }
    assert constants == {
        "LEGS": 6, "IMUS": 7, "MAGIC": datagrams.MAGIC, "VERSION": VERSION, "WITH_LENGTHS": WITH_LENGTHS,
        "WITH_BASE_IMU": datagrams.WITH_BASE_IMU, "PORT": 47100, "WATCHDOG_CODE": WATCHDOG_CODE,
    }  # fmt: skip
    enums = {
        name: re.sub(r"GOUGH_| = 1", "", body).split(", ") for name, body in re.findall(r"enum gough_(\w+) \{ (.*) \}", text)
    }
    assert [DatagramKind[name] for name in enums["kind"]] == [1, 2, 3, 4]
    assert [getattr(hil.rigs, name) for name in enums["request"]] == [0, 1, 2]
    assert [getattr(hil.rigs, name) for name in enums["drive"]] == [0, 1, 2, 3, 4]


def test_the_documented_layout_is_that_of_the_datagrams():
    rows = [
        line.strip("| ").split(" | ") for line in DOCUMENT.read_text(encoding="utf-8").splitlines() if line.startswith("| ")
    ]
    documented = [tuple(row[:4]) for row in rows if row[0] in DATAGRAMS or row[0] == "all"]
    expected = [("all", str(offset), f"`{name}`", kind) for name, offset, kind in fields(COMMAND_DATAGRAM) if name in HEAD]
    for datagram, dtype in DATAGRAMS.items():
        own = [each for each in fields(dtype) if each[0] not in HEAD]
        expected += [(datagram, str(offset), f"`{name}`", kind) for name, offset, kind in own]
        expected.append((datagram, str(dtype.itemsize), "", "length"))
    assert documented == expected


def test_the_documented_rates_are_those_that_the_buses_carry():
    found = re.findall(r"^\| (classic|FD) \| (.*) \| (\d+) Hz", DOCUMENT.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(found) == 7
    units = {"kbit/s": 1_000, "Mbit/s": 1_000_000}
    for kind, rates, highest in found:
        nominal, *data = (int(number) * units[unit] for number, unit in (rate.split() for rate in rates.split(", ")))
        changes = {"fd": kind == "FD", "bitrate": nominal, **({"data_bitrate": data[0]} if data else {})}
        assert int(LARGEST_LOAD / canopen_settings(bus=changes).bus_load(1.0)) == int(highest)


# Rigs in other processes.


@contextmanager
def process(command):
    """A process, when it has said that it listens; then what it has to say."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as started:
        try:
            assert any("listens" in line for line in started.stdout)
            yield started
        finally:
            started.send_signal(signal.SIGTERM)
            started.wait(10.0)


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    built = tmp_path_factory.mktemp("rig") / "reference_rig"
    subprocess.run([*COMPILE, "-o", built, SOURCES / "reference_rig.c"], check=True)
    return built


@pytest.fixture(scope="module")
def emulator():
    """An emulated rig and its control channel."""
    address, control = (f"127.0.0.1:{free_port()}" for _ in range(2))
    command = [sys.executable, "-m", "hil.command_line", "emulate", "--imu", "ideal", "--lengths", "incremental"]
    command += ["--at", address, "--control", control]
    with process(command):
        yield address, control


@pytest.fixture(scope="module")
def reference(program):
    port = free_port()
    with process([program, str(port)]):
        yield f"127.0.0.1:{port}"


@pytest.fixture(params=["reference", "emulator"])
def address(request):
    rig = request.getfixturevalue(request.param)
    return rig if isinstance(rig, str) else rig[0]


@contextmanager
def opened(address, lengths=False):
    rig = UdpRig(address, PERIOD, lengths=lengths)
    rig.open()
    with closing(rig):
        yield rig


def exchange(rig, command, request):
    """An exchange that is answered."""
    feedback = new_feedback()[()]
    deadline = time.monotonic() + 5.0
    while rig.exchange(command, request, feedback) != ANSWERED:
        assert time.monotonic() < deadline, "nothing is answered"
    return feedback


def enable(rig, command):
    """Have the drives follow, again if the machine was busy elsewhere and the watchdog stopped them."""
    for _ in range(10):
        rig.arm()
        for _ in range(3):
            feedback = exchange(rig, command, ENABLED)
        if (feedback["drive"] == FOLLOWING).all():
            return feedback
    raise AssertionError(feedback)


def test_a_rig_says_who_it_is_and_does_as_it_is_told(address):
    with opened(address) as rig:
        assert "gough" in rig.identify().name and rig.identify().parts["watchdog"] == "0.03 s"
        rig.arm()
        before = exchange(rig, SPEEDS, BRAKED)
        assert (before["drive"] == READY).all() and (before["sent"] == 0.0).all()
        np.testing.assert_allclose(np.linalg.norm(before["measurement"][1], axis=1), 9.81, rtol=0.05)
        np.testing.assert_allclose(enable(rig, SPEEDS)["sent"], SPEEDS, rtol=1e-6)
        np.testing.assert_allclose(enable(rig, -SPEEDS)["sent"], -SPEEDS, rtol=1e-6)
        feedback = enable(rig, np.full(6, 10.0))
        np.testing.assert_allclose(feedback["sent"], 0.375)
        assert (feedback["sequence"] > before["sequence"]).all() and (feedback["sample_ns"] > before["sample_ns"]).all()
        feedback = exchange(rig, SPEEDS, BRAKED)
        assert (feedback["drive"] == READY).all() and (feedback["sent"] == 0.0).all()


def test_in_version_2_a_rig_tells_what_its_encoders_read(address):
    with opened(address, lengths=True) as rig:
        enable(rig, SPEEDS)
        before = exchange(rig, SPEEDS, ENABLED)
        time.sleep(0.02)
        feedback = exchange(rig, SPEEDS, ENABLED)
        moved = feedback["length"] - before["length"]
        # At most the watchdog's time and this pause.
        assert np.isfinite(moved).all() and (np.sign(moved) == np.sign(SPEEDS)).all() and np.abs(moved).max() < 0.06 * 0.2
        assert (feedback["home"] == -1).all() and np.isfinite(feedback["length_rate"]).all()
    with opened(address) as rig:
        assert np.isnan(exchange(rig, SPEEDS, BRAKED)["length"]).all()


def test_a_rig_that_knows_no_lengths_is_told(tmp_path):
    """With the rig as it was before there was a version 2."""
    source = (SOURCES / "reference_rig.c").read_text()
    old = source.replace("hello->head.session == 0 ||", "hello->head.version != GOUGH_VERSION || hello->head.session == 0 ||")
    assert old != source
    (tmp_path / "old.c").write_text(old)
    subprocess.run([*COMPILE, "-o", tmp_path / "old", tmp_path / "old.c"], check=True)
    port = free_port()
    with process([tmp_path / "old", str(port)]), opened(f"127.0.0.1:{port}") as rig:
        exchange(rig, SPEEDS, BRAKED)
        with pytest.raises(RigError, match=r"up to version 1 only.* 2 has lengths .*: give it newer firmware"):
            UdpRig(f"127.0.0.1:{port}", PERIOD, lengths=True).open()


def test_a_quick_stop_slows_down_and_then_holds(address):
    with opened(address) as rig:
        enable(rig, np.full(6, 0.3))
        speeds = [0.3]
        # At 3 m/s^2 it takes 0.1 s.
        began = time.monotonic()
        while (feedback := exchange(rig, np.full(6, 0.3), QUICK_STOP))["drive"][0] == QUICK_STOPPING:
            speeds.append(feedback["sent"][0])
        assert time.monotonic() - began > 0.09
        assert len(speeds) > 5 and (np.diff(speeds) <= 1e-6).all()
        assert (feedback["drive"] == READY).all() and (feedback["sent"] == 0.0).all() and (feedback["drive_code"] == 0).all()


def test_after_silence_the_drives_stop_with_a_fault_that_arming_resets(address):
    with opened(address) as rig:
        enable(rig, np.full(6, 0.1))
        time.sleep(0.3)
        for request in (ENABLED, QUICK_STOP, BRAKED):
            feedback = exchange(rig, np.full(6, 0.1), request)
            assert (feedback["drive"] == FAULTY).all() and (feedback["drive_code"] == WATCHDOG_CODE).all()
            assert (feedback["sent"] == 0.0).all()
        assert (enable(rig, SPEEDS)["drive_code"] == 0).all()


def test_quick_stop_and_close_can_come_at_any_time(address):
    rig = UdpRig(address, PERIOD)
    rig.quick_stop()
    rig.close()
    rig.open()
    enable(rig, SPEEDS)
    rig.quick_stop()
    rig.quick_stop()
    assert set(exchange(rig, SPEEDS, QUICK_STOP)["drive"]) <= {READY, QUICK_STOPPING}
    rig.close()
    rig.close()
    rig.quick_stop()


@pytest.mark.slow
def test_a_rig_that_is_not_there_or_too_impatient_is_told(address):
    with pytest.raises(RigError, match="no rig answers"):
        UdpRig(f"127.0.0.1:{free_port()}", PERIOD).open()
    slow = UdpRig(address, 0.02)
    slow.open()
    with closing(slow):
        # Ours wait for three periods, whatever the rate; firmware may not.
        assert slow.watchdog_s >= 0.06
        slow.identify()
        slow.watchdog_s = 0.03
        with pytest.raises(RigError, match="after 30 ms without a command; at a period of 20 ms it must be 60 ms"):
            slow.identify()


class Sender:
    """A controller in plain Python, which can do everything wrong."""

    def __init__(self, address):
        host, port = address.split(":")
        self.rig, self.session, self.sequence = (host, int(port)), secrets.randbits(31) + 1, 0
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))

    def ask(self, content, patience):
        """Send bytes; returns the answer, None if there is none."""
        self.socket.settimeout(patience)
        self.socket.sendto(content, self.rig)
        try:
            return self.socket.recv(2048)
        except TimeoutError:
            return None

    def hello(self, patience=2.0, **changes):
        content = encode(
            HELLO_DATAGRAM, **{"kind": DatagramKind.HELLO, "session": self.session, "period_us": 10_000, **changes}
        )
        answer = self.ask(content, patience)
        return answer and decode(WELCOME_DATAGRAM, answer, kind=DatagramKind.WELCOME)

    def encoded(self, **changes):
        self.sequence += 1
        own = {"kind": DatagramKind.COMMAND, "session": self.session, "sequence": self.sequence}
        return encode(COMMAND_DATAGRAM, **{**own, **changes})

    def command(self, **changes):
        """Send a command that must be answered; returns the answer."""
        answer = self.ask(self.encoded(**changes), 2.0)
        assert answer is not None
        measurement = decode(MEASUREMENT_DATAGRAM, answer[: MEASUREMENT_DATAGRAM.itemsize], kind=DatagramKind.MEASUREMENT)
        assert measurement["session"] == self.session and measurement["sequence"] == self.sequence
        return measurement


@contextmanager
def senders(address, count=1):
    made = [Sender(address) for _ in range(count)]
    try:
        yield made
    finally:
        for sender in made:
            sender.socket.close()


def with_another_bit(content):
    return content[:-1] + bytes([content[-1] ^ 1])


def test_what_is_wrong_is_refused_counted_and_without_effect(address):
    with senders(address, 2) as (controller, stranger):
        assert controller.hello()["session"] == controller.session
        good = controller.encoded(velocity=SPEEDS)
        assert controller.ask(good, 2.0) is not None
        before = controller.command()
        infinite = np.where(np.arange(6) == 3, np.inf, 0.0)
        wrong = {
            "repeated": good,
            "old": controller.encoded(sequence=1),
            "number 0": controller.encoded(sequence=0),
            "session": controller.encoded(session=controller.session + 1),
            "no session": controller.encoded(session=0),
            "magic": controller.encoded(magic=0x12345678),
            "version": controller.encoded(version=VERSION + 1),
            "kind": controller.encoded(kind=DatagramKind.MEASUREMENT),
            "request": controller.encoded(request=3),
            "not finite": controller.encoded(velocity=infinite),
            "crc": with_another_bit(controller.encoded()),
            "short": controller.encoded()[:-1],
            "long": controller.encoded() + b"!",
            "very long": controller.encoded() + bytes(1000),
            "empty": b"",
            "hello as command": controller.encoded()[: HELLO_DATAGRAM.itemsize],
        }
        for name, content in wrong.items():
            assert controller.ask(content, 0.02) is None, name
        assert stranger.ask(controller.encoded(request=ENABLED), 0.02) is None
        assert controller.hello(0.02, session=0) is None and controller.hello(0.02, period_us=0) is None
        after = controller.command()
        assert after["refused"] - before["refused"] == len(wrong) + 3
        assert (after["drive"] == READY).all() and (after["velocity"] == 0.0).all()


def test_a_rig_that_moves_has_one_controller(address):
    with senders(address, 2) as (controller, second):
        assert controller.hello() is not None
        # The same controller may ask again, if the welcome was lost.
        assert controller.hello()["session"] == controller.session
        assert (controller.command(reset=1)["drive"] == READY).all()
        refused = controller.command(request=ENABLED, velocity=SPEEDS)["refused"]
        assert second.hello(0.01) is None
        moving = controller.command(request=ENABLED, velocity=SPEEDS)
        assert (moving["drive"] == FOLLOWING).all() and moving["refused"] == refused + 1
        assert (controller.command()["drive"] == READY).all()
        assert second.hello()["session"] == second.session
        assert controller.ask(controller.encoded(request=ENABLED), 0.02) is None
        assert (second.command()["drive"] == READY).all()


def test_the_watchdog_is_not_held_up_by_a_flood(address):
    with senders(address, 2) as (controller, stranger):
        controller.hello()
        controller.command(reset=1)
        controller.command(request=ENABLED, velocity=SPEEDS)
        # The rig has no pause; a command behind the flood may be lost, for its buffer is full.
        controller.socket.setblocking(False)
        began, content = time.monotonic(), None
        while content is None:
            assert time.monotonic() < began + 5.0, "nothing is answered"
            for size in 20 * (36, 64):
                stranger.socket.sendto(bytes(size), stranger.rig)
            if time.monotonic() > began + 0.1:
                controller.socket.sendto(controller.encoded(request=ENABLED, velocity=SPEEDS), controller.rig)
                with suppress(BlockingIOError):
                    content = controller.socket.recv(2048)
        answer = decode(MEASUREMENT_DATAGRAM, content[: MEASUREMENT_DATAGRAM.itemsize], kind=DatagramKind.MEASUREMENT)
        assert (answer["code"] == WATCHDOG_CODE).all() and answer["refused"] > 100


def test_nothing_that_is_refused_moves_the_reference_rig(program):
    port = free_port()
    with process([program, str(port)]) as started:
        random = np.random.default_rng(1)
        with senders(f"127.0.0.1:{port}", 2) as (controller, stranger):
            controller.hello()
            controller.command(reset=1)
            for n in range(2000):
                if n % 20 == 0:
                    # No more than the rig's buffer holds.
                    controller.command()
                content = bytearray(controller.encoded(request=ENABLED, velocity=SPEEDS))
                content[random.integers(len(content))] ^= 1 << random.integers(8)
                controller.socket.sendto(content, controller.rig)
                stranger.socket.sendto(controller.encoded(request=ENABLED, velocity=SPEEDS), stranger.rig)
            controller.command()
        started.send_signal(signal.SIGTERM)
        told = started.stdout.read()
    assert told == "4000 datagrams refused; the legs have moved by" + 6 * " 0.000000" + " m\n"


def inject(emulator, *arguments):
    assert main(["inject", *arguments, "--to", emulator[1]]) == 0


def test_injected_faults_change_what_is_measured(emulator, capsys):
    with opened(emulator[0]) as rig:
        rig.arm()
        before = exchange(rig, np.zeros(6), BRAKED)
        inject(emulator, "imu-dead:3")
        inject(emulator, "imu-frozen:4")
        inject(emulator, "imu-biased:5,size=10")
        inject(emulator, "drive-faults:2")
        after = exchange(rig, np.zeros(6), BRAKED)
        later = exchange(rig, np.zeros(6), BRAKED)
        advanced = later["sequence"] - after["sequence"]
        assert advanced[3] == 0 and (np.delete(advanced, 3) > 0).all()
        assert (later["measurement"][:2, 4] == after["measurement"][:2, 4]).all()
        turned = np.degrees(np.arccos(np.dot(*(each["measurement"][1, 5] / 9.81 for each in (before, later)))))
        assert 8.0 < turned < 12.0
        assert later["drive"].tolist() == [READY, READY, FAULTY, READY, READY, READY] and later["drive_code"][2] == 0x7500
        capsys.readouterr()
        inject(emulator)
        output = capsys.readouterr().out
        assert "code: [0, 0, 29952, 0, 0, 0]" in output
        assert output.startswith("emulator: hexapod on udp, of ")
        inject(emulator, "--clear")
        rig.arm()
        assert (exchange(rig, np.zeros(6), BRAKED)["drive"] == READY).all()
    assert main(["inject", "nonsense", "--to", emulator[1]]) == 2
    assert "there is no fault 'nonsense'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text", ["", ":", "localhost:1", "127.0.0.1", "127.0.0.1:", "127.0.0.1:x", ":1", "::1:1", "1.2.3:1", "127.0.0.1:1:1"]
)
def test_what_is_no_address_is_told(text):
    with pytest.raises(InputError, match=r"such as 127\.0\.0\.1:47100|must be a number from 1 to 65535"):
        parse_address(text)


def test_addresses_and_ports_that_cannot_be_used_are_told():
    for port in ("0", "65536", "-1", "+1", " 1", "1_0"):
        with pytest.raises(InputError, match="1 to 65535"):
            parse_address(f"127.0.0.1:{port}")
    for host in ("8.8.8.8", "0.0.0.0"):
        with pytest.raises(InputError, match="neither loopback nor of a private network"):
            parse_address(f"{host}:1")
    assert parse_address("8.8.8.8:1", anywhere=True) == ("8.8.8.8", 1)
    assert parse_address("192.168.7.2:47100") == ("192.168.7.2", 47100)


# The decoders, against what is wrong.

ROUNDS = 1_000_000
MEASUREMENT_BYTES = MEASUREMENT_DATAGRAM.itemsize
WITH_LENGTHS_BYTES = MEASUREMENT_BYTES + LENGTHS_DATAGRAM.itemsize
RANDOM, FLIPPED, CUT, HEADED = range(4)


@kernel
def next_random(state):
    """xorshift64*."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return (x * np.uint64(0x2545F4914F6CDD1D)) >> np.uint64(32)


@kernel
def spoil(data, good, length, state, kind):
    """Write a datagram that is wrong, made of a good one of this length; returns its length."""
    for i in range(data.size):
        data[i] = good[i] if i < length else 0
    if kind == RANDOM:
        size = int(next_random(state) % np.uint64(data.size + 1))
        # Some have the right length and the right head.
        begin = int(next_random(state) % np.uint64(24))
        if next_random(state) % np.uint64(2) == 0:
            size = length
        for i in range(begin, size):
            data[i] = next_random(state) & np.uint64(0xFF)
        return size
    if kind == FLIPPED:
        for _ in range(1 + next_random(state) % np.uint64(3)):
            bit = int(next_random(state) % np.uint64(8 * length))
            data[bit // 8] ^= np.uint8(1 << (bit % 8))
        same = True
        for i in range(length):
            same = same and data[i] == good[i]
        if same:
            data[0] ^= np.uint8(1)
        return length
    if kind == CUT:
        size = int(next_random(state) % np.uint64(data.size + 200))
        # A measurement is sound without its truth.
        return size + 1 if size in (length, MEASUREMENT_BYTES, WITH_LENGTHS_BYTES) else size
    # A sound CRC is written later, for a head in which a byte is wrong, or the number is 0.
    at = int(next_random(state) % np.uint64(13))
    if at < 12:
        data[at] ^= np.uint8(1 + next_random(state) % np.uint64(255))
    else:
        data[12:16] = 0
    return length


@kernel
def fuzz_decode_answer(link, good, length, feedback, rounds, state):
    """How many wrong answers are taken."""
    taken = 0
    size = link.answer.itemsize
    for n in range(rounds):
        got = spoil(link.answer_bytes, good, length, state, n % 4)
        if n % 4 == HEADED:
            link.answer[0].crc = crc32(link.answer_bytes, size - 4)
        taken += decode_answer(link, got, feedback)
    return taken


@kernel
def fuzz_answer(emulator, good, length, rounds, state):
    """How many wrong commands are answered."""
    answered = 0
    for n in range(rounds):
        got = spoil(emulator.link.command_bytes, good, length, state, n % 4)
        if n % 4 == HEADED:
            emulator.link.command[0].crc = crc32(emulator.link.command_bytes, length - 4)
        answered += answer_command(emulator, got, 1_000_000_000 + n) != 0
    return answered


@kernel
def bytes_changed_in_decode_answer(link, good, length, feedback):
    """How many answers with one byte changed are taken."""
    taken = 0
    for at in range(length):
        for change in range(1, 256):
            for i in range(length):
                link.answer_bytes[i] = good[i]
            link.answer_bytes[at] ^= np.uint8(change)
            taken += decode_answer(link, length, feedback)
    return taken


@kernel
def bytes_changed_in_answer(emulator, good, length):
    """How many commands with one byte changed are answered."""
    answered = 0
    for at in range(length):
        for change in range(1, 256):
            for i in range(length):
                emulator.link.command_bytes[i] = good[i]
            emulator.link.command_bytes[at] ^= np.uint8(change)
            answered += answer_command(emulator, length, 1_000_000_000) != 0
    return answered


def without_refused(record):
    return {name: record[name].tobytes() for name in record.dtype.names if name != "refused"}


@pytest.mark.slow
@pytest.mark.parametrize("truthful", [False, True])
@pytest.mark.parametrize("version", [VERSION, WITH_LENGTHS])
def test_the_controller_takes_nothing_that_is_wrong(truthful, version):
    link, feedback = new_link(), new_feedback()[()]
    link.socket["session"], link.socket["sequence"], link.socket["version"] = 7, 9, version
    values = np.random.default_rng(1).normal(size=(3, 7, 3))
    head = {"version": version, "kind": DatagramKind.MEASUREMENT, "session": 7, "sequence": 9}
    sound = encode(MEASUREMENT_DATAGRAM, **head, measurement=values)
    if version == WITH_LENGTHS:
        lengths = np.zeros(1, LENGTHS_DATAGRAM)
        lengths["length"], lengths["rate"], lengths["home"] = np.arange(6.0), -np.arange(6.0), [1, 0, -1, 1, 0, -1]
        lengths["crc"] = crc32(lengths.view(np.uint8), LENGTHS_DATAGRAM.itemsize - 4)
        sound += lengths.tobytes()
    if truthful:
        truth = np.zeros(1, TRUTH_DATAGRAM)
        truth["truth"] = np.arange(19.0)
        truth["crc"] = crc32(truth.view(np.uint8), TRUTH_DATAGRAM.itemsize - 4)
        sound += truth.tobytes()
    good = np.frombuffer(sound, np.uint8).copy()
    link.answer_bytes[: len(good)] = good
    assert decode_answer(link, len(good), feedback) and feedback["refused"] == 0
    np.testing.assert_array_equal(feedback["measurement"], values.astype(np.float32))
    assert (feedback["truth"][3] == 3.0) == truthful
    if version == WITH_LENGTHS:
        assert feedback["length"].tolist() == [0, 1, 2, 3, 4, 5] and feedback["length_rate"].tolist() == [0, -1, -2, -3, -4, -5]
        assert feedback["home"].tolist() == [1, 0, -1, 1, 0, -1]
    else:
        assert np.isnan(feedback["length"]).all() and (feedback["home"] == -1).all()
    before, state = without_refused(feedback), np.array([88172645463325252], np.uint64)
    assert fuzz_decode_answer(link, good, len(good), feedback, ROUNDS // 2, state) == 0
    assert bytes_changed_in_decode_answer(link, good, len(good), feedback) == 0
    assert feedback["refused"] == ROUNDS // 2 + 255 * len(good)
    link.answer_bytes[: len(good)] = good
    link.socket["stranger"] = 1
    assert not decode_answer(link, len(good), feedback)
    assert without_refused(feedback) == before
    assert link.socket["session"] == 7 and link.socket["sequence"] == 9
    link.socket["stranger"] = 0
    assert decode_answer(link, len(good), feedback)


def test_the_rig_does_nothing_that_is_wrong():
    plant, imu, encoders, rig = _rig_of(EmulatorConfig(SimulationConfig(imu="ideal")), PERIOD, [])
    with plant:
        emulator = new_udp_emulator(plant.handle, imu, encoders, rig, session=7)
        content = encode(COMMAND_DATAGRAM, kind=DatagramKind.COMMAND, session=7, sequence=1, request=ENABLED, velocity=SPEEDS)
        emulator.link.command_bytes[: len(content)] = np.frombuffer(content, np.uint8)
        assert answer_command(emulator, len(content), 1_000_000) > 0
        # The next one, which would turn all drives around.
        content = encode(COMMAND_DATAGRAM, kind=DatagramKind.COMMAND, session=7, sequence=2, request=ENABLED, velocity=-SPEEDS)
        good = np.frombuffer(content, np.uint8).copy()
        before = without_refused(emulator.session), rig.tobytes(), emulator.link.answer_bytes.tobytes()
        state = np.array([88172645463325252], np.uint64)
        assert fuzz_answer(emulator, good, len(good), ROUNDS, state) == 0
        assert bytes_changed_in_answer(emulator, good, len(good)) == 0
        assert (without_refused(emulator.session), rig.tobytes(), emulator.link.answer_bytes.tobytes()) == before
        assert emulator.session["refused"] == ROUNDS + 255 * len(good)
        emulator.link.command_bytes[: len(good)] = good
        assert answer_command(emulator, len(good), 2_000_000) > 0
        np.testing.assert_allclose(rig["velocity"], -SPEEDS, rtol=1e-6)


def test_a_flood_of_old_hellos_does_not_keep_a_moving_rig_from_its_controller():
    plant, imu, encoders, rig = _rig_of(EmulatorConfig(SimulationConfig(imu="ideal")), PERIOD, [])
    with plant, closing(bound_socket("127.0.0.1", 0)) as own, senders("127.0.0.1:1", 2) as (controller, stranger):
        # Its drives go on, however long the test pauses.
        emulator = new_udp_emulator(plant.handle, imu, encoders, rig, controller.session, watchdog_s=60.0)
        link, timespec, began = emulator.link.socket, np.zeros(2, np.int64), time.monotonic_ns()
        link["descriptor"], link["peer"] = own.fileno(), socket_address(controller.socket.getsockname())
        controller.rig = stranger.rig = own.getsockname()
        old = encode(HELLO_DATAGRAM, kind=DatagramKind.HELLO, session=5, period_us=10_000)
        stranger.socket.sendto(old, stranger.rig)
        assert serve(emulator, began, 1_000_000_000, timespec) == 1 and emulator.session["refused"] == 0
        rig["drive"], rig["request"] = FOLLOWING, ENABLED
        for _ in range(100):
            stranger.socket.sendto(old, stranger.rig)
        controller.socket.sendto(controller.encoded(request=ENABLED), controller.rig)
        while not select.select([controller.socket], [], [], 0.0)[0]:
            assert serve(emulator, began, 10_000_000, timespec) == 0
            assert time.monotonic_ns() - began < 30_000_000_000
        assert emulator.session["refused"] == 100
        assert address_in(bytes(emulator.session["stranger"])) == stranger.socket.getsockname()
        assert decode(
            MEASUREMENT_DATAGRAM, controller.socket.recv(2048)[: MEASUREMENT_DATAGRAM.itemsize], kind=DatagramKind.MEASUREMENT
        )


@pytest.mark.slow
def test_only_datagrams_from_the_peers_host_and_port_are_its_own():
    with ExitStack() as stack:

        def opened(host, port=0):
            return stack.enter_context(closing(bound_socket(host, port)))

        own, peer = opened("127.0.0.1"), opened("127.0.0.1")
        link = new_link()
        link.socket["descriptor"], link.socket["peer"] = own.fileno(), socket_address(peer.getsockname())
        port = peer.getsockname()[1]
        others = [opened("127.0.0.1"), *(opened(host, port) for host in ("127.0.0.2", "127.0.1.1", "127.1.0.1"))]
        for sender, strange in [(peer, 0), *((other, 1) for other in others), (peer, 0)]:
            sender.sendto(b"four", own.getsockname())
            await_datagram(link.socket, 1_000_000_000)
            assert receive_datagram(link.socket, link.answer_bytes) == 4
            assert link.socket["stranger"] == strange
