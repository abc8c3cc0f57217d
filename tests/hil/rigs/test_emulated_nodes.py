"""The emulated CANopen nodes without a bus: units and signs, watchdogs to the nanosecond, turns of the magnetometers."""

import struct

import numpy as np
import pytest
from canopen.sdo import SdoAbortedError

from hil.rigs import BRAKED, ENABLED, FAULTY, FOLLOWING, OFF, QUICK_STOP, READY
from hil.rigs.canopen.cia402 import HEARTBEAT_LOST, PDO_LOST, PowerState
from hil.rigs.canopen.emulated_bus import EmulatedBus, faulty_channel
from hil.rigs.canopen.frames import NodeState, new_message
from hil.rigs.canopen.settings import canopen_settings
from hil.rigs.emulation import EMULATED, fault, new_emulated
from plant.mechanism import load_spatial

DRIVES, IMUS = [41, 7, 23, 3, 55, 12], [70, 64, 99, 61, 88, 93, 62]
SIGNS = [1, -1, -1, 1, -1, 1]
COUNTS = 1024 * 4.0 / 0.008
MS = 1_000_000


class Machine:
    """Drives and readings as a test sets them."""

    def __init__(self):
        self.rig, self.resets, self.restarts = np.zeros((), EMULATED), [], 0
        self.rig["drive"], self.rig["length"], self.rig["home"] = READY, np.nan, -1

    def advance(self, now_ns):
        pass

    def sample(self, now_ns):
        self.rig["sequence"] += 1

    def reset(self, drive):
        self.resets.append(drive)

    def restart(self):
        self.restarts += 1


@pytest.fixture(scope="module", params=[True])
def made(request):
    """Nodes on a virtual bus, and the frames that they send."""
    config = canopen_settings(
        bus={"interface": "virtual", "channel": "nodes", "fd": request.param},
        controller={"node": 100},
        drives={"nodes": DRIVES, "signs": SIGNS, "screw_lead": 0.008, "gear_ratio": 4.0, "counts_per_turn": 1024},
        imus={"nodes": IMUS},
    )
    nodes = EmulatedBus(config, Machine())
    nodes.frames = []
    nodes._arrive = lambda message, outgoing: nodes.frames.append((message.arbitration_id, bytes(message.data)))
    yield nodes
    nodes.close()


@pytest.fixture
def bus(made):
    """The same as new, for reading their data sheets takes a while."""
    made._machine.__init__()
    for node in (*made.drives, *made.imus):
        node.reset()
    made.frames.clear()
    return made


def enabled(drive):
    drive.mode, drive.power = 9, PowerState.OPERATION_ENABLED
    return drive


def test_a_drives_target_and_velocity_are_in_counts_of_its_motor(bus):
    rig = bus._machine.rig
    rig["velocity"] = velocities = [0.01, 0.02, -0.03, -0.04, 0.05, 1e9]
    for leg, drive in enumerate(bus.drives):
        enabled(drive).obey(0x0F, 3000 + leg)
        assert (rig["request"][leg], drive.target) == (ENABLED, 3000 + leg)
        assert rig["target"][leg] == pytest.approx(SIGNS[leg] * (3000 + leg) / COUNTS, rel=1e-15)
        assert drive.velocity() == min(round(velocities[leg] * SIGNS[leg] * COUNTS), 2**31 - 1)
    bus.drives[2].mode = 0
    bus.drives[2].request()
    assert rig["target"][2] == 0.0
    rig["velocity"][4] = np.nan
    assert bus.drives[4].velocity() == 0


@pytest.mark.parametrize("power", list(PowerState))
def test_a_drives_power_state_is_a_request_to_its_mechanics(bus, power):
    drive, rig = enabled(bus.drives[3]), bus._machine.rig
    drive.power, drive.target = power, 5000
    drive.request()
    stopping = (PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
    expected = ENABLED if power == PowerState.OPERATION_ENABLED else QUICK_STOP if power in stopping else BRAKED
    assert rig["request"][3] == expected and (rig["target"][3] != 0.0) == (expected == ENABLED)
    assert (np.delete(rig["request"], 3) == BRAKED).all()


@pytest.mark.parametrize(
    "power, after",
    [
        (PowerState.OPERATION_ENABLED, PowerState.FAULT_REACTION_ACTIVE),
        (PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE),
        (PowerState.SWITCHED_ON, PowerState.FAULT),
        (PowerState.SWITCH_ON_DISABLED, PowerState.SWITCH_ON_DISABLED),
    ],
)
def test_a_drive_stops_once_the_heartbeat_is_older_than_its_timeout(bus, power, after):
    drive = enabled(bus.drives[1])
    drive.power, drive.consumer_ns = power, 100 * MS
    # Before the first heartbeat it does not watch.
    drive.watch(10**12)
    drive.controller_ns = 5 * MS
    drive.watch(105 * MS)
    assert drive.power == power and bus.frames == []
    drive.watch(105 * MS + 1)
    assert drive.power == after and drive.controller_ns == 0
    if after != power:
        assert drive.code == HEARTBEAT_LOST == 0x8130
        assert bus.frames == [(0x80 + 7, bytes((0x30, 0x81, 0x81, 0, 0, 0, 0, 0)))]
    else:
        assert drive.code == 0 and bus.frames == []


@pytest.mark.parametrize("power", [PowerState.OPERATION_ENABLED, PowerState.SWITCHED_ON, PowerState.QUICK_STOP_ACTIVE])
def test_only_an_enabled_drive_needs_commands_in_time(bus, power):
    drive = enabled(bus.drives[5])
    drive.power, drive.timeout_ns, drive.commanded_ns = power, 30 * MS, 7 * MS
    drive.watch(37 * MS)
    assert drive.power == power
    drive.watch(37 * MS + 1)
    missed = power == PowerState.OPERATION_ENABLED
    assert (drive.power, drive.code) == ((PowerState.FAULT_REACTION_ACTIVE, PDO_LOST) if missed else (power, 0))
    drive = enabled(bus.drives[4])
    drive.watch(10**15)
    assert drive.power == PowerState.OPERATION_ENABLED


def test_a_drive_follows_what_its_mechanics_do_by_themselves(bus):
    drive, rig = enabled(bus.drives[2]), bus._machine.rig
    rig["drive"][2] = FOLLOWING
    drive.settle()
    assert drive.power == PowerState.OPERATION_ENABLED and drive.statusword() == 0x1237
    rig["drive"][2], rig["code"][2] = FAULTY, 0x2310
    drive.settle()
    drive.settle()
    assert (drive.power, drive.code) == (PowerState.FAULT, 0x2310)
    assert bus.frames == [(0x80 + 23, bytes((0x10, 0x23, 0x81, 0, 0, 0, 0, 0)))]
    # A reset by its rising edge, and once.
    drive.obey(0x00, 0)
    drive.obey(0x80, 0)
    assert bus._machine.resets == [2] and drive.code == 0 and drive.power == PowerState.SWITCH_ON_DISABLED
    rig["drive"][2] = OFF
    drive.settle()
    assert drive.power == PowerState.NOT_READY_TO_SWITCH_ON and drive.statusword() == 0x0200
    rig["drive"][2] = READY
    drive.settle()
    assert drive.power == PowerState.SWITCH_ON_DISABLED
    drive.power = PowerState.QUICK_STOP_ACTIVE
    drive.settle()
    assert drive.power == PowerState.SWITCH_ON_DISABLED


def test_objects_that_are_written_set_the_watchdogs_and_the_mode(bus):
    drive = bus.drives[0]
    drive.local.sdo[0x1016][1].raw = 100 << 16 | 125
    drive.local.sdo[0x1400][5].raw = 40
    drive.local.sdo[0x1017].raw = 75
    drive.local.sdo[0x6060].raw = 9
    assert (drive.controller, drive.consumer_ns, drive.timeout_ns, drive.heartbeat_ns) == (100, 125 * MS, 40 * MS, 75 * MS)
    assert drive.mode == 9
    with pytest.raises(SdoAbortedError):
        drive.local.sdo[0x6060].raw = 3
    drive.reset()
    assert (drive.controller, drive.consumer_ns, drive.timeout_ns, drive.heartbeat_ns, drive.mode) == (0, 0, 0, 0, 0)
    assert drive.state == NodeState.PRE_OPERATIONAL


@pytest.mark.parametrize("made", [False], indirect=True)
def test_magnetometers_answer_every_tenth_sync_one_after_the_other(bus):
    for imu, node in enumerate(bus.imus):
        node.active, node.magnetometer_start = frozenset({0x180, 0x280, 0x380}), imu + 1
    for sync in (*range(1, 25), 240):
        bus.frames.clear()
        bus._on_sync(sync)
        turns = [node for imu, node in enumerate(IMUS) if sync % 10 == (imu + 1) % 10]
        assert [identifier - 0x380 for identifier, _ in bus.frames if 0x380 <= identifier < 0x400] == turns
        assert (
            sum(identifier in {base + node for base in (0x180, 0x280) for node in IMUS} for identifier, _ in bus.frames) == 14
        )


def test_on_sync_a_drive_obeys_its_last_command_once_and_answers(bus):
    drive, rig = enabled(bus.drives[1]), bus._machine.rig
    drive.active = frozenset({0x180, 0x200})
    rig["drive"][1], rig["velocity"][1], drive.code = FOLLOWING, 0.05, 0x2310
    for target in (-100, -4096):
        bus._dispatch(0x200 + 7, bytearray(struct.pack("<Hi", 0x0F, target)))
    assert rig["target"][1] == 0.0
    bus._on_sync(9)
    assert rig["target"][1] == pytest.approx(4096 / COUNTS) and drive.command is None
    found = dict(bus.frames)
    assert struct.unpack("<HiH", found[0x180 + 7]) == (0x1237, -round(0.05 * COUNTS), 0x2310)
    assert set(found) == {0x180 + 7, 0x1F470001} and found[0x1F470001][52] == 9
    # A command of the wrong length is none.
    bus._dispatch(0x200 + 7, bytearray(5))
    assert drive.command is None


@pytest.mark.parametrize("addressed", [0, 23])
def test_nmt_commands_concern_one_node_or_all(bus, addressed):
    concerned = [node for node in (*bus.drives, *bus.imus) if addressed in (0, node.node)]
    for command, state in ((0x01, 5), (0x02, 4), (0x80, 127), (0x81, 127), (0x01, 5), (0x82, 127)):
        bus.frames.clear()
        bus._dispatch(0, bytearray((command, addressed)))
        assert {int(node.state) for node in concerned} == {state}
        boots = [(0x700 + node.node, b"\0") for node in concerned] if command in (0x81, 0x82) else []
        assert bus.frames == boots
        assert all(node.state == 127 for node in (*bus.drives, *bus.imus) if node not in concerned)
    assert bus._machine.restarts == 2 * len(concerned)


def test_a_drive_that_leaves_operation_stops_quickly(bus):
    drive = enabled(bus.drives[2])
    drive.stop(NodeState.STOPPED)
    assert drive.power == PowerState.QUICK_STOP_ACTIVE and bus._machine.rig["request"][2] == QUICK_STOP


@pytest.mark.parametrize(
    "texts, delays",
    [
        ((), [0.0]),
        (("bus-delays,size=2.5",), [0.0025]),
        (("bus-repeats,size=1",), [0.0, 0.0]),
        (("bus-down",), []),
        (("bus-corrupts,size=1",), []),
        (("bus-reorders,size=1", "bus-delays,size=1"), [0.003]),
        (("bus-delays,at=1",), [0.0]),
    ],
)
def test_the_bus_faults_delay_repeat_or_lose_frames(texts, delays):
    rig, frame = new_emulated(load_spatial("hexapod"), MS, 0, [fault(text) for text in texts]), new_message(0x80, b"\1")
    arrived = list(faulty_channel(rig)(frame, True))
    assert [delay for delay, _ in arrived] == pytest.approx(delays)
    assert all(each is frame for _, each in arrived)
