"""The CANopen rig's frames on the wire and its patience, on a virtual clock, with nodes, signs, screw and gear of its own."""

import struct
from types import SimpleNamespace

import can
import numpy as np
import pytest

from hil.rigs import ANSWERED, BRAKED, ENABLED, FOLLOWING, OFF, QUICK_STOP, SILENT, RigError, new_feedback
from hil.rigs.canopen.cia402 import PowerState, commanded, statusword
from hil.rigs.canopen.configuration import RemoteNode, configure_drive, configure_imu, interpolation_period, switch_on
from hil.rigs.canopen.frames import Pdo, new_message, pack_imu
from hil.rigs.canopen.rig import CanopenRig
from hil.rigs.canopen.settings import canopen_settings
from plant.errors import InputError

DRIVES, IMUS = [41, 7, 23, 3, 55, 12], [70, 64, 99, 61, 88, 93, 62]
SIGNS = np.array([1, -1, -1, 1, -1, 1])
COUNTS = 1024 * 4.0 / 0.008
"""Counts/s per m/s."""

PERIOD, MS = 0.02, 1_000_000
FOLLOWS = 0x1237


def settings(fd=True):
    screw = {"screw_lead": 0.008, "gear_ratio": 4.0, "counts_per_turn": 1024, "velocity_limit": 0.3, "silence": 0.21}
    return canopen_settings(
        bus={"interface": "virtual", "fd": fd},
        controller={"node": 100, "heartbeat": 0.05, "heartbeat_timeout": 0.125, "answer_share": 0.4},
        drives={"nodes": DRIVES, "signs": SIGNS.tolist(), **screw},
        imus={"nodes": IMUS, "heartbeat": 0.075},
    )


class Clock:
    """Time that passes only when someone waits."""

    def __init__(self):
        self.now_ns = 10**9

    def monotonic_ns(self):
        return self.now_ns

    def monotonic(self):
        return 1e-9 * self.now_ns


class Wire:
    """A bus that notes what is sent, and gives what a test has prepared: frames from before a SYNC, and answers to it."""

    def __init__(self, clock):
        self.clock, self.sent, self.waiting, self.answer, self.open = clock, [], [], lambda sync: (), True

    def send(self, message):
        self.sent.append((message.arbitration_id, bytes(message.data)))
        if message.arbitration_id == 0x80:
            self.waiting += self.answer(message.data[0])

    def recv(self, timeout):
        if self.waiting:
            return self.waiting.pop(0)
        self.clock.now_ns += round(1e9 * timeout)
        return None

    def shutdown(self):
        self.open = False

    def since(self):
        """What was sent since the last look."""
        sent, self.sent = self.sent, []
        return sent


@pytest.fixture
def wired():
    """An open rig whose drives follow, and its wire."""
    clock = Clock()
    rig = CanopenRig(settings(), PERIOD, clock=clock.monotonic_ns)
    rig._bus = wire = Wire(clock)
    rig.decoder.statuswords = [FOLLOWS] * 6
    rig.decoder.nmt[:6] = [5] * 6
    return rig, wire


def answers(sync, drives=range(6), imus=range(7), word=FOLLOWS):
    """Frames of these drives and IMUs in answer to a SYNC."""
    made = [new_message(0x180 + DRIVES[drive], struct.pack("<HiH", word, 0, 0)) for drive in drives]
    for imu in imus:
        ((cob_id, data),) = pack_imu(np.zeros((3, 3), np.int16), sync, sync * 20 * MS, sync, True, False)
        made.append(new_message(cob_id + IMUS[imu], data))
    return made


def exchange(rig, command=None, request=ENABLED):
    feedback = new_feedback()
    status = rig.exchange(np.zeros(6) if command is None else np.array(command), request, feedback)
    return status, feedback


# ------------------------------------------------------------------------------------------------------------- exchanges


def test_commands_go_out_in_counts_of_each_motor_with_its_sign_before_sync(wired):
    rig, wire = wired
    command = np.array([0.1, -0.2, 0.05, -0.31, 0.7, np.nan])
    status, feedback = exchange(rig, command)
    sent = wire.since()
    assert [identifier for identifier, _ in sent] == [*(0x200 + node for node in DRIVES), 0x80, 0x700 + 100]
    expected = np.array([0.1, -0.2, 0.05, -0.3, 0.3, 0.0])
    assert [struct.unpack("<Hi", data) for _, data in sent[:6]] == [
        (0x0F, round(each * COUNTS)) for each in (expected * SIGNS).tolist()
    ]
    np.testing.assert_allclose(feedback["sent"], expected, atol=0.5 / COUNTS)
    assert sent[6:] == [(0x80, b"\x01"), (0x764, b"\x05")] and status == SILENT
    exchange(rig, command, BRAKED)
    assert [struct.unpack("<Hi", data) for _, data in wire.since()[:6]] == [(0x07, 0)] * 6
    _, feedback = exchange(rig, command, QUICK_STOP)
    assert [struct.unpack("<Hi", data) for _, data in wire.since()[:6]] == [(0x02, 0)] * 6
    assert (feedback["sent"] == 0.0).all()


def test_each_drive_is_led_on_from_its_own_state(wired):
    rig, wire = wired
    rig.decoder.statuswords = [0x0250, 0x0231, 0x0233, 0x0237, 0x0217, 0x0218]
    exchange(rig, np.full(6, 0.1))
    assert [struct.unpack("<Hi", data)[0] for _, data in wire.since()[:6]] == [0x06, 0x07, 0x0F, 0x0F, 0x02, 0x00]


def test_syncs_count_from_1_to_240_and_heartbeats_come_in_their_interval(wired):
    rig, wire = wired
    counters, beats = [], 0
    for cycle in range(242):
        wire.clock.now_ns = 10**9 + cycle * 20 * MS
        exchange(rig)
        sent = wire.since()
        counters += [data[0] for identifier, data in sent if identifier == 0x80]
        beats += sum(identifier == 0x764 for identifier, _ in sent)
    assert counters == [*range(1, 241), 1, 2]
    # Every 50 ms, at the next exchange: every third.
    assert beats == 81


def test_an_exchange_is_answered_by_imus_and_waits_for_its_share_of_the_period(wired):
    rig, wire = wired
    wire.answer = answers
    status, feedback = exchange(rig)
    assert (status, feedback["round_trip_ns"]) == (ANSWERED, 0)
    assert (
        (feedback["drive"] == FOLLOWING).all()
        and (feedback["sequence"] == 1).all()
        and (feedback["sample_ns"] == 20 * MS).all()
    )
    wire.answer = lambda sync: answers(sync, imus=())
    status, feedback = exchange(rig)
    assert (status, feedback["round_trip_ns"]) == (SILENT, 0.4 * 20 * MS)
    assert (feedback["sequence"] == 1).all()
    wire.answer = lambda sync: answers(sync, drives=(), imus=(6,))
    status, feedback = exchange(rig)
    assert status == ANSWERED and feedback["sequence"].tolist() == [1, 1, 1, 1, 1, 1, 3]


def test_what_comes_before_sync_is_too_late_for_the_last_one(wired):
    rig, wire = wired
    wire.waiting = [*answers(0), new_message(0x80 + DRIVES[5], bytes((0x10, 0x23, 1, 0, 0, 0, 0, 0)))]
    status, feedback = exchange(rig)
    assert status == SILENT and feedback["refused"] == 13 and (feedback["sequence"] == -1).all()
    assert feedback["drive_code"].tolist() == [0, 0, 0, 0, 0, 0x2310]


def test_a_drive_that_is_silent_for_long_or_not_operational_is_off(wired):
    rig, wire = wired
    wire.answer = answers
    exchange(rig)
    wire.answer = lambda sync: answers(sync, drives=(0, 1, 2, 3, 5))
    rig.decoder.nmt[0] = 127
    found = []
    for _ in range(12):
        wire.clock.now_ns = 10**9 + (len(found) + 1) * 20 * MS
        _, feedback = exchange(rig)
        found.append(feedback["drive"].tolist())
    others = [OFF, FOLLOWING, FOLLOWING, FOLLOWING]
    # Until 210 ms after its last frame; the exchange in which it is missed ends 8 ms after its SYNC.
    assert found == 10 * [[*others, FOLLOWING, FOLLOWING]] + 2 * [[*others, OFF, FOLLOWING]]


def test_nobody_waits_any_more_for_a_frame_that_was_missing_ten_times(wired):
    rig, wire = wired
    wire.answer = lambda sync: answers(sync, imus=(0, 1, 2, 3, 4, 6))
    waits = [int(exchange(rig)[1]["round_trip_ns"]) for _ in range(12)]
    assert waits == 10 * [8 * MS] + 2 * [0]
    wire.answer = answers
    assert exchange(rig)[1]["round_trip_ns"] == 0 and rig.decoder.sequence[5] >= 12
    wire.answer = lambda sync: answers(sync, imus=(0, 1, 2, 3, 4, 6))
    assert exchange(rig)[1]["round_trip_ns"] == 8 * MS


def test_a_bus_that_fails_makes_the_exchange_silent_and_is_counted(wired):
    rig, wire = wired
    wire.answer = answers

    def broken(message):
        raise can.CanOperationError("no buffer space")

    wire.send = broken
    status, feedback = exchange(rig, np.full(6, 0.1))
    assert (status, int(feedback["refused"])) == (SILENT, 1)


@pytest.mark.parametrize("method, word", [("quick_stop", 2), ("close", 0)])
def test_stopping_orders_each_drive_by_pdo_and_sdo_and_syncs(wired, method, word):
    rig, wire = wired
    exchange(rig, np.full(6, 0.1))
    wire.since()
    getattr(rig, method)()
    expected = []
    for node in DRIVES:
        sdo = bytes((0x2B, 0x40, 0x60, 0x00, word, 0, 0, 0))
        expected += [(0x200 + node, struct.pack("<Hi", word, 0)), (0x600 + node, sdo)]
    expected.append((0x80, b"\x02"))
    if method == "close":
        expected.append((0x000, b"\x80\x00"))
    assert wire.since() == expected and wire.open == (method == "quick_stop")
    getattr(rig, method)()
    assert len(wire.since()) == (13 if method == "quick_stop" else 0)


def test_stopping_goes_on_when_a_frame_cannot_be_sent(wired):
    rig, wire = wired
    send = wire.send

    def sometimes(message):
        if message.arbitration_id == 0x200 + DRIVES[0]:
            raise can.CanOperationError("no buffer space")
        send(message)

    wire.send = sometimes
    rig.quick_stop()
    assert len(wire.since()) == 12


# --------------------------------------------------------------------------------------------------------- configuration


class Node:
    """A node's objects, and the order in which they are written."""

    map_pdo, check, configure = RemoteNode.map_pdo, RemoteNode.check, RemoteNode.configure

    def __init__(self, lacks=()):
        self.name, self.node, self.objects, self.writes, self._lacks = "drive 2 (node 23)", 23, {}, [], lacks

    def write(self, index, subindex, value):
        self.objects[index, subindex] = int(value)
        self.writes.append((int(index), int(subindex), int(value)))

    def read(self, index, subindex=0):
        return 9 if index == 0x6061 else self.objects[index, subindex]

    def has(self, index, subindex=0):
        return (index, subindex) not in self._lacks

    def now(self):
        return 0.0


def test_a_pdo_is_off_while_it_is_mapped():
    node = Node()
    node.map_pdo(Pdo(0x1801, 0x1A01, 0x280, 7, (0x60410010, 0x606C0020)))
    assert node.writes == [
        (0x1801, 1, 0x80000280 + 23),
        (0x1A01, 0, 0),
        (0x1A01, 1, 0x60410010),
        (0x1A01, 2, 0x606C0020),
        (0x1A01, 0, 2),
        (0x1801, 2, 7),
        (0x1801, 1, 0x280 + 23),
    ]


def test_a_drive_is_configured_with_its_pdos_and_option_codes():
    node, drives = Node(), settings().drives
    configure_drive(node, drives, 0.0025)
    expected = {
        (0x1400, 1): 0x200 + 23, (0x1400, 2): 1, (0x1400, 5): 100,
        (0x1600, 0): 2, (0x1600, 1): 0x60400010, (0x1600, 2): 0x60FF0020,
        (0x1800, 1): 0x180 + 23, (0x1800, 2): 1,
        (0x1A00, 0): 3, (0x1A00, 1): 0x60410010, (0x1A00, 2): 0x606C0020, (0x1A00, 3): 0x603F0010,
        (0x1017, 0): 100, (0x1019, 0): 240, (0x605A, 0): 2, (0x605C, 0): 0, (0x605E, 0): 2, (0x6007, 0): 3,
        (0x60C2, 1): 25, (0x60C2, 2): -4, (0x6080, 0): 9000, (0x6085, 0): round(5.0 * COUNTS), (0x6060, 0): 9, (0x60FF, 0): 0,
    }  # fmt: skip
    assert node.objects == expected
    optional = [(0x1400, 5), (0x1019, 0), (0x605C, 0), (0x605E, 0), (0x6007, 0), (0x60C2, 2), (0x60C2, 1), (0x6080, 0)]
    node = Node(optional)
    configure_drive(node, drives, 0.0025)
    assert node.objects == {entry: value for entry, value in expected.items() if entry not in optional}


@pytest.mark.parametrize("fd", [True, False])
def test_imus_take_turns_with_their_magnetometers_on_classic_can(fd):
    for imu in (0, 4, 6):
        node = Node()
        configure_imu(node, imu, settings(fd))
        assert (node.objects[0x1017, 0], node.objects[0x1019, 0]) == (75, 240)
        if fd:
            assert node.objects[0x1A00, 0] == 12 and node.objects[0x1800, 1] == 0x180 + 23 and (0x1801, 1) not in node.objects
        else:
            assert [node.objects[index, 1] for index in (0x1800, 0x1801, 0x1802)] == [0x180 + 23, 0x280 + 23, 0x380 + 23]
            assert [node.objects[index, 2] for index in (0x1800, 0x1801, 0x1802)] == [1, 1, 10]
            assert node.objects[0x1802, 6] == imu + 1


@pytest.mark.parametrize(
    "period, units, exponent",
    [
        (0.001, 1, -3),
        (0.02, 20, -3),
        (0.255, 255, -3),
        (0.0005, 5, -4),
        (0.0025, 25, -4),
        (0.000125, 125, -6),
        (0.00075, 75, -5),
        (1.0 / 3000.0, 33, -5),
        (1.0 / 600.0, 167, -5),
        (0.0000004, 1, -6),
        (0.256, 26, -2),
        (0.3, 30, -2),
        (2.55, 255, -2),
        (0.3001, 30, -2),
        (25.0, 250, -1),
        (255.0, 255, 0),
    ],
)
def test_a_period_in_units_of_a_power_of_ten(period, units, exponent):
    assert interpolation_period(period) == (units, exponent)


@pytest.mark.parametrize("period", [255.5, np.inf, np.nan])
def test_a_period_that_the_object_cannot_hold_is_refused(period):
    with pytest.raises(InputError, match=f"the period is {period:g} s, and object 60C2h holds 255 s at most"):
        interpolation_period(period)


class PoweredNode(Node):
    """A drive's power states over SDO, from a state, with a cause of its fault that resets leave or not."""

    def __init__(self, state, resets=1):
        super().__init__()
        self.state, self.previous, self.resets, self.words = state, 0, resets, []

    def write(self, index, subindex, value):
        super().write(index, subindex, value)
        if index == 0x6040:
            self.words.append(int(value))
            before, self.state, self.previous = self.state, commanded(self.state, value, self.previous), value
            if before == PowerState.FAULT and self.state != before:
                self.resets -= 1
                self.state = self.state if self.resets == 0 else before

    def read(self, index, subindex=0):
        if index == 0x603F:
            return 0x2310 if self.state == PowerState.FAULT else 0
        return statusword(self.state, True, False) if index == 0x6041 else super().read(index, subindex)


@pytest.mark.parametrize(
    "state, resets, words",
    [
        (PowerState.SWITCHED_ON, 1, []),
        (PowerState.SWITCH_ON_DISABLED, 1, [0x06, 0x07]),
        (PowerState.OPERATION_ENABLED, 1, [0x07]),
        (PowerState.QUICK_STOP_ACTIVE, 1, [0x00, 0x06, 0x07]),
        (PowerState.FAULT, 1, [0x00, 0x80, 0x00, 0x06, 0x07]),
        (PowerState.FAULT, 2, [0x00, 0x80, 0x00, 0x00, 0x80, 0x00, 0x06, 0x07]),
    ],
)
def test_a_drive_is_switched_on_from_any_state_and_watches_for_the_heartbeat(wired, state, resets, words):
    node = PoweredNode(state, resets)
    assert switch_on(node, settings().controller) == 0x0233
    assert node.words == words
    assert node.objects[0x1016, 1] == 100 << 16 | 125


def test_a_fault_that_two_resets_leave_is_reported_with_its_code(wired):
    node = PoweredNode(PowerState.FAULT, 3)
    with pytest.raises(RigError, match=r"drive 2 \(node 23\) does not reach Switched on: it stays in Fault, error code 0x2310"):
        switch_on(node, settings().controller)
    assert node.words.count(0x80) == 2


def test_a_value_is_awaited_for_as_long_as_it_may_take(wired):
    _, wire = wired
    found = iter([1, 1, 1, 9, 9])

    def read(index, subindex):
        wire.clock.now_ns += 40 * MS
        return next(found)

    node = SimpleNamespace(name="drive 2 (node 23)", read=read, now=wire.clock.monotonic)
    RemoteNode.check(node, 0x6061, 0, 9, 0.15)
    found = iter([-1] * 9)
    with pytest.raises(RigError, match=r"drive 2 \(node 23\) has 0xFFFFFFFF in object 6061h:00; it must be 0x9"):
        RemoteNode.check(node, 0x6061, 0, 9, 0.15)
    assert len(list(found)) == 5
    found = iter([1, 9])
    with pytest.raises(RigError, match="has 0x1 in object"):
        RemoteNode.check(node, 0x6061, 0, 9)
