"""The CANopen rig against emulated nodes, with real frames on python-can's virtual bus, and between processes by multicast."""

import multiprocessing
import os
import socket
import threading
import time
from collections import Counter
from contextlib import contextmanager, suppress
from itertools import count

import can
import numpy as np
import pytest

from hil.rigs import (
    ANSWERED,
    BRAKED,
    ENABLED,
    FAULTY,
    FOLLOWING,
    OFF,
    QUICK_STOP,
    QUICK_STOPPING,
    READY,
    SILENT,
    RigError,
    new_feedback,
)
from hil.rigs.canopen.cia402 import HEARTBEAT_LOST, PDO_LOST
from hil.rigs.canopen.configuration import configure_drive
from hil.rigs.canopen.decoder import Decoder, advance_of
from hil.rigs.canopen.emulated_bus import EmulatedBus
from hil.rigs.canopen.frames import ANSWER, COMMAND_PDO, POSITION, CobId, Object, Parameter, new_message, pack_imu, raw_readings
from hil.rigs.canopen.rig import CanopenRig
from hil.rigs.canopen.settings import DEFAULT_FILE, canopen_settings, classic_bits, fd_duration
from hil.rigs.position_loops import POSITION_LOOPS
from plant.errors import InputError

PERIOD = 0.02
PATIENT = 0.4  # A rig of this period waits for answers longer than a busy machine delays them; the exchanges are PERIOD apart.
CHANNELS = count()


class Kinematic:
    """Drives that follow at once and stop at 5 m/s^2, and IMUs whose readings tell which is which."""

    def __init__(self):
        self.request, self.drive, self.code = np.zeros(6, np.int64), np.full(6, READY), np.zeros(6, np.int64)
        self.target, self.velocity, self.length, self.home = np.zeros(6), np.zeros(6), np.zeros(6), np.full(6, -1)
        self.measurement = np.fromfunction(lambda s, i, a: (s + 1) * (i + 1) * 0.01 * (a - 1.5), (3, 7, 3))
        self.sample_ns, self.sequence = np.zeros(7, np.int64), np.zeros(7, np.int64)
        self.frozen, self.truth = np.zeros(7, bool), np.arange(19.0)
        self.now = None
        names = "request drive code target velocity length home measurement sample_ns sequence truth"
        self.rig = {name: getattr(self, name) for name in names.split()} | {"loops": np.zeros((), POSITION_LOOPS)}

    def advance(self, now_ns):
        dt = 0.0 if self.now is None else (now_ns - self.now) * 1e-9
        self.now = now_ns
        for k in range(6):
            if self.drive[k] in (FAULTY, OFF):
                self.velocity[k] = 0.0
            elif self.request[k] == ENABLED:
                self.drive[k], self.velocity[k] = FOLLOWING, self.target[k]
            elif self.request[k] == QUICK_STOP and self.velocity[k] != 0.0:
                self.drive[k] = QUICK_STOPPING
                self.velocity[k] -= np.sign(self.velocity[k]) * min(5.0 * dt, abs(self.velocity[k]))
            else:
                self.drive[k], self.velocity[k] = READY, 0.0
        self.length += dt * self.velocity

    def restart(self):
        pass

    def sample(self, now_ns):
        self.sample_ns[~self.frozen] = now_ns
        self.sequence[~self.frozen] += 1

    def reset(self, drive):
        self.drive[drive], self.code[drive] = READY, 0


def settings(**changes):
    """A virtual bus of its own, and watchdogs that a loaded machine does not trip."""
    patient = {
        "bus": {"interface": "virtual", "channel": f"test-{next(CHANNELS)}"},
        "controller": {"heartbeat_timeout": 1.0},
        "drives": {"command_timeout": 1.0, "silence": 1.0},
    }
    return canopen_settings(**{name: {**patient.get(name, {}), **changes.get(name, {})} for name in {*patient, *changes}})


def wait_for(condition, seconds=5.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it takes too long"
        time.sleep(0.002)


@contextmanager
def serving(config, machine=None, channel=None):
    """Nodes that are served in a thread."""
    nodes = EmulatedBus(config, machine or Kinematic(), channel)
    stop = threading.Event()
    thread = threading.Thread(target=nodes.serve, args=(stop.is_set,))
    thread.start()
    try:
        yield nodes
    finally:
        stop.set()
        thread.join()
        nodes.close()


@contextmanager
def armed(config, machine=None, channel=None, lengths=False):
    with serving(config, machine, channel) as nodes:
        rig = CanopenRig(config, PATIENT, lengths=lengths)
        rig.open()
        rig.identify()
        rig.arm()
        try:
            yield rig, nodes
        finally:
            rig.close()


def run(rig, cycles, command=None, request=ENABLED, until=None):
    """Exchange for so many cycles; returns the feedback and the statuses."""
    feedback, statuses = new_feedback(), []
    command = np.zeros(6) if command is None else command
    for _ in range(cycles):
        due = time.monotonic() + PERIOD
        statuses.append(rig.exchange(command, request, feedback))
        if until is not None and until(feedback):
            break
        time.sleep(max(due - time.monotonic(), 0.0))
    return feedback, statuses


@pytest.mark.slow
@pytest.mark.parametrize("fd", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_it_runs_from_open_to_close(fd):
    machine = Kinematic()
    config = settings(bus={"fd": fd}, drives={"signs": [1, -1, 1, -1, 1, -1]}, imus={"signs": [[1, -1, 1]] * 7})
    command = np.array([0.1, -0.1, 0.05, 0.02, -0.2, 0.5])
    with armed(config, machine) as (rig, _):
        threads = threading.active_count()
        feedback, statuses = run(rig, 60, command)
        assert threading.active_count() == threads
        assert statuses.count(ANSWERED) >= 50
        np.testing.assert_array_equal(feedback["drive"], FOLLOWING)
        np.testing.assert_allclose(feedback["sent"], np.clip(command, -0.35, 0.35), atol=1e-7)
        np.testing.assert_allclose(machine.velocity, feedback["sent"], atol=1e-12)
        np.testing.assert_allclose(feedback["measurement"][0], machine.measurement[0], atol=7e-5)
        np.testing.assert_allclose(feedback["measurement"][1], machine.measurement[1], atol=6e-4)
        np.testing.assert_allclose(feedback["measurement"][2], machine.measurement[2], atol=0.026)
        before = feedback["sequence"].copy(), feedback["sample_ns"].copy()
        feedback, more = run(rig, 20, command)
        np.testing.assert_allclose(feedback["sequence"] - before[0], 20, atol=3)
        np.testing.assert_allclose(feedback["sample_ns"] - before[1], 20 * PERIOD * 1e9, rtol=0.5)
        rig.quick_stop()
        rig.quick_stop()
        wait_for(lambda: (machine.velocity == 0.0).all())
        feedback, last = run(rig, 5, request=QUICK_STOP)
        np.testing.assert_array_equal(feedback["drive"], READY)
        # Nothing but answers that came too late: on a busy machine some do.
        late = len(statuses + more + last) - (statuses + more + last).count(ANSWERED)
        assert feedback["refused"] <= rig.decoder.all_frames.bit_count() * (late + 2)
        run(rig, 10, command)
        np.testing.assert_array_equal(machine.drive, FOLLOWING)
        rig.close()
        wait_for(lambda: (machine.request == BRAKED).all())
        rig.close()
        rig.quick_stop()


@pytest.mark.slow
@pytest.mark.parametrize("fd", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_drives_tell_what_their_encoders_read_if_they_are_asked(fd):
    machine, counts = Kinematic(), 65536 / 0.005
    machine.length[:] = [-0.5, 0.4, 0.3, 0.2, 200.0, 0.0]
    config = settings(bus={"fd": fd}, drives={"signs": [1, -1, 1, -1, 1, -1]})
    with armed(config, machine, lengths=True) as (rig, _):
        feedback, _ = run(rig, 10, request=BRAKED)
        # A position has 32 bits, 328 m; what it was before the first reading nobody knows.
        wrapped = (machine.length + 2**31 / counts) % (2**32 / counts) - 2**31 / counts
        np.testing.assert_allclose(feedback["length"], wrapped, atol=0.6 / counts)
        assert (feedback["home"] == 0).all() and not feedback["length_rate"].any()
        before, start = machine.length.copy(), feedback["length"].copy()
        machine.home[2] = 1
        rates = np.array([0.1, -0.1, 0.05, 0.02, -0.2, 0.3])
        feedback, _ = run(rig, 40, rates)
        moved = machine.length - before
        assert (np.abs(moved) > 0.005).all()
        # All are of one time: the machine has gone on since, for as long as this process has waited.
        age = (moved - (feedback["length"] - start)) / rates
        assert age.min() > -PERIOD and age.max() < 10.0 * PERIOD
        np.testing.assert_allclose(age, age[5], atol=1.0 / counts / np.abs(rates).min())
        np.testing.assert_allclose(feedback["length_rate"], machine.velocity, atol=2.0 / counts)
        assert feedback["home"].tolist() == [0, 0, 1, 0, 0, 0]
    with armed(config, machine) as (rig, _):
        feedback, _ = run(rig, 10, request=BRAKED)
        assert np.isnan(feedback["length"]).all() and (feedback["home"] == -1).all()


def test_a_position_goes_on_when_it_wraps():
    decoder, node = Decoder(settings(), lengths=True), 3
    positions = [2**31 - 2, -(2**31) + 1, -(2**31) + 5, 2**31 - 1, 0x7000_0000, -0x7000_0000]
    for number, position in enumerate(positions):
        decoder.begin(number + 1)
        assert decoder.take(new_message(CobId.TPDO + 0x100 + node, POSITION.pack(position, 4 * (number % 2))))
        assert decoder.homes[2] == bool(number % 2)
        decoder.end()
        assert decoder.answered_position(2) and not decoder.answered_position(1)
    assert decoder.positions[2] == 2**32 - 0x7000_0000
    decoder.begin(100)
    decoder.end()
    assert not decoder.answered_position(2)


def test_it_says_who_is_there():
    with serving(config := settings()):
        rig = CanopenRig(config, PERIOD)
        rig.open()
        identity = rig.identify()
        rig.close()
    assert identity.parts["drive 0 (node 1)"] == "gough drive, revision 1.0"
    assert identity.parts["IMU 6 (node 17)"] == "gough IMU, revision 1.0"


def test_a_node_that_is_missing_is_named():
    config = settings(controller={"boot_timeout": 0.3})
    rig = CanopenRig(config, PERIOD)
    with pytest.raises(RigError, match=r"drive 0 \(node 1\).*IMU 6 \(node 17\)"):
        rig.open()


@pytest.mark.parametrize(
    "index, subindex, value, message",
    [
        (0x1018, 2, 0x999, r"drive 3 \(node 4\) has 0x999 in object 1018h:02; it must be 0x402"),
        (0x1A00, 2, 0x60640020, r"drive 3 \(node 4\) has 0x60640020 in object 1A00h:02; it must be 0x606C0020"),
        (0x6061, 0, 3, r"drive 3 \(node 4\) has 0x3 in object 6061h:00; it must be 0x9"),
    ],
)
def test_another_node_than_configured_is_refused(index, subindex, value, message):
    with serving(config := settings()) as nodes:
        answers = {(index, subindex): value}
        nodes.drives[3]._check_mapping = lambda pdo, subindex, number: None
        nodes.drives[3].local._read_callbacks.insert(0, lambda index, subindex, od: answers.get((index, subindex)))
        rig = CanopenRig(config, PERIOD)
        rig.open()
        with pytest.raises(RigError, match=message):
            rig.identify()
            rig.arm()
        rig.close()


def test_what_a_drive_needs_and_its_eds_lacks_is_named(tmp_path):
    path, eds = tmp_path / "rig.toml", (DEFAULT_FILE.parent / "drive.eds").read_text()
    path.write_text(DEFAULT_FILE.read_text().replace('"imu.eds"', f'"{DEFAULT_FILE.parent}/imu.eds"'))
    # Without the max motor speed it does.
    for old, new in (("6080", "3080"), ("6085", "3085")):
        eds = eds.replace(f"[{old}]", f"[{new}]")
    (tmp_path / "drive.eds").write_text(eds)
    with serving(config := canopen_settings(path, bus={"interface": "virtual", "channel": "lacks"})):
        rig = CanopenRig(config, PERIOD)
        rig.open()
        with pytest.raises(RigError, match=r"drive 0 \(node 1\) needs object 6085h:00, which its EDS does not have"):
            rig.arm()
        rig.close()


def test_nodes_refuse_a_mapping_that_they_do_not_have():
    with serving(config := settings()):
        rig = CanopenRig(config, PERIOD)
        rig.open()
        node = rig._nodes[7]
        node.write(0x1800, 1, 0x80000180 + node.node)
        node.write(0x1A00, 0, 0)
        for entry in (0x60410010, 0x20000120, 0x10000020):
            with pytest.raises(RigError, match=r"IMU 1 \(node 12\) refuses 0x.* cannot be mapped"):
                node.write(0x1A00, 1, entry)
        node.write(0x1A00, 1, 0x20000210)
        with pytest.raises(RigError, match="refuses"):
            node.write(0x1A00, 0, 1)
        rig.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes, code",
    [({"controller": {"heartbeat_timeout": 0.2}}, HEARTBEAT_LOST), ({"drives": {"command_timeout": 0.2}}, PDO_LOST)],
)
def test_drives_stop_by_themselves_without_the_controller(changes, code):
    machine, velocities = Kinematic(), []
    with armed(settings(**changes), machine) as (rig, _):
        run(rig, 20, np.full(6, 0.3))
        np.testing.assert_array_equal(machine.drive, FOLLOWING)
        wait_for(lambda: velocities.append(machine.velocity[0]) or (machine.velocity == 0.0).all())
        assert any(0.0 < velocity < 0.3 for velocity in velocities)
        feedback, _ = run(rig, 5, np.full(6, 0.3))
        np.testing.assert_array_equal(feedback["drive"], FAULTY)
        np.testing.assert_array_equal(feedback["drive_code"], code)
        np.testing.assert_array_equal(machine.velocity, 0.0)
        time.sleep(0.3)
        rig.arm()
        time.sleep(0.3)
        feedback, _ = run(rig, 20)
        np.testing.assert_array_equal(feedback["drive"], FOLLOWING)
        np.testing.assert_array_equal(feedback["drive_code"], 0)


def test_a_drives_fault_is_reported_and_reset():
    machine = Kinematic()
    with armed(settings(), machine) as (rig, _):
        run(rig, 10, np.full(6, 0.1))
        machine.drive[2], machine.code[2] = FAULTY, 0x2310
        feedback, _ = run(rig, 5, np.full(6, 0.1))
        assert feedback["drive"].tolist() == [FOLLOWING, FOLLOWING, FAULTY, FOLLOWING, FOLLOWING, FOLLOWING]
        assert feedback["drive_code"].tolist() == [0, 0, 0x2310, 0, 0, 0]
        rig.arm()
        feedback, _ = run(rig, 10)
        np.testing.assert_array_equal(feedback["drive"], FOLLOWING)


def test_a_drive_that_cannot_be_armed_is_named_with_its_code():
    machine = Kinematic()
    machine.reset = lambda drive: None
    with serving(config := settings(), machine):
        machine.drive[5], machine.code[5] = FAULTY, 0x4210
        rig = CanopenRig(config, PERIOD)
        rig.open()
        with pytest.raises(RigError, match=r"drive 5 \(node 6\).*Fault, error code 0x4210"):
            rig.arm()
        rig.close()


def test_a_drive_without_power_is_off():
    machine = Kinematic()
    with armed(settings(), machine) as (rig, _):
        run(rig, 10)
        machine.drive[1] = OFF
        feedback, _ = run(rig, 3)
        assert feedback["drive"][1] == OFF


@pytest.mark.slow
def test_a_silent_drive_is_off_and_a_silent_imu_stands():
    muted = set()

    def channel(frame, outgoing):
        return [] if outgoing and frame.arbitration_id & 0x7F in muted and frame.arbitration_id < 0x780 else [(0.0, frame)]

    config = settings(drives={"silence": 0.3})
    with armed(config, channel=channel) as (rig, _):
        before, _ = run(rig, 10)
        muted |= {4, 12}
        feedback, statuses = run(rig, 40)
        assert statuses.count(ANSWERED) >= 35
        assert feedback["drive"].tolist() == [FOLLOWING] * 3 + [OFF] + [FOLLOWING] * 2
        assert feedback["sequence"][1] <= before["sequence"][1] + 1
        assert feedback["sequence"][0] >= before["sequence"][0] + 35
        # Nobody waits for it any more.
        assert feedback["round_trip_ns"] < rig._answer_ns
        muted.clear()
        feedback, _ = run(rig, 30)
        assert feedback["drive"][3] == FOLLOWING
        assert feedback["sequence"][1] >= before["sequence"][1] + 55


@pytest.mark.slow
def test_a_leg_that_leaves_operation_stops():
    machine = Kinematic()
    with armed(settings(), machine) as (rig, _):
        run(rig, 10, np.full(6, 0.3))
        rig._command_nodes(0x80)
        wait_for(lambda: (machine.velocity == 0.0).all())
        _, statuses = run(rig, 12, np.full(6, 0.3))
        assert statuses[-1] == SILENT
        np.testing.assert_array_equal(machine.velocity, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("fd", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_late_and_double_frames_are_refused_and_counted(fd):
    faults = Counter()

    def channel(frame, outgoing):
        if outgoing and frame.arbitration_id == CobId.TPDO + 11:
            faults["sent"] += 1
            if faults["sent"] % 10 == 0:
                faults["late"] += 1
                return [(1.3 * PATIENT, frame)]
            if faults["sent"] % 10 == 5:
                faults["double"] += 1
                return [(0.0, frame), (0.0, frame)]
        return [(0.0, frame)]

    with armed(settings(bus={"fd": fd}), channel=channel) as (rig, _):
        last, stood = -1, 0
        feedback = new_feedback()
        for _ in range(100):
            due = time.monotonic() + PERIOD
            rig.exchange(np.zeros(6), ENABLED, feedback)
            stood += feedback["sequence"][0] == last
            assert feedback["sequence"][0] >= last
            last = int(feedback["sequence"][0])
            time.sleep(max(due - time.monotonic(), 0.0))
        # On classic CAN the second half of a late sample has nothing to go with.
        expected = faults["double"] + faults["late"] * (1 if fd else 2)
        assert faults["late"] >= 9
        assert faults["late"] - 1 <= stood <= faults["late"] + 10
        assert expected - 3 <= feedback["refused"] <= expected + 60
        feedback, _ = run(rig, 2)
        assert abs(int(feedback["sequence"][0]) - int(feedback["sequence"][1])) <= 2


def test_a_repeated_sample_is_an_answer_but_no_new_one():
    machine = Kinematic()
    with armed(settings(), machine) as (rig, _):
        before, _ = run(rig, 5)
        machine.frozen[3] = True
        feedback, statuses = run(rig, 20)
        assert feedback["sequence"][3] <= before["sequence"][3] + 1
        assert feedback["sequence"][2] >= before["sequence"][2] + 15
        assert statuses.count(ANSWERED) >= 17


def test_nothing_raises_when_the_bus_has_gone():
    with armed(settings()) as (rig, _):
        run(rig, 5)
        rig._bus.shutdown()
        _, statuses = run(rig, 3)
        assert set(statuses) == {SILENT}
        rig.quick_stop()
        rig.quick_stop()
        rig.close()
        rig.close()
    rig = CanopenRig(settings(), PERIOD)
    rig.quick_stop()
    rig.close()
    assert rig.exchange(np.zeros(6), BRAKED, new_feedback()) == SILENT
    for call in (rig.identify, rig.arm):
        with pytest.raises(RigError, match="not open"):
            call()


def test_commands_that_are_not_numbers_are_zero():
    machine = Kinematic()
    with armed(settings(), machine) as (rig, _):
        feedback, _ = run(rig, 10, np.array([np.nan, np.inf, -np.inf, 0.1, 0.1, 0.1]))
        np.testing.assert_allclose(feedback["sent"], [0.0, 0.35, -0.35, 0.1, 0.1, 0.1], atol=1e-7)
        feedback, _ = run(rig, 3, np.full(6, 0.1), BRAKED)
        np.testing.assert_array_equal(feedback["sent"], 0.0)
        np.testing.assert_array_equal(feedback["drive"], READY)


FRAMES = 500_000


@pytest.mark.slow
@pytest.mark.parametrize("fd", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_decoder_takes_anything(fd):
    config = settings(bus={"fd": fd})
    decoder = Decoder(config)
    rng = np.random.default_rng(7)
    known = [*decoder._table, -1, 1 << 40, 0x7FF]
    identifiers = np.where(rng.random(FRAMES) < 0.9, rng.choice(known, FRAMES), rng.integers(0, 1 << 29, FRAMES)).tolist()
    sizes = rng.choice([0, 1, 2, 6, 7, 8, 8, 8, 8, 12, 16, 32, 32, 32, 48, 64], FRAMES).tolist()
    flags = (rng.random((FRAMES, 3)) < 0.02).tolist()
    # Few values, so that many frames have the right SYNC counter.
    noise = (
        np.where(rng.random(1 << 16) < 0.7, rng.integers(1, 5, 1 << 16), rng.integers(0, 256, 1 << 16)).astype("u1").tobytes()
    )
    begins = rng.integers(1, 5, FRAMES).tolist()
    measurement = np.zeros((3, 7, 3))
    taken = 0
    for i, (identifier, size, flag) in enumerate(zip(identifiers, sizes, flags, strict=True)):
        if i % 500 == 0:
            decoder.end()
            decoder.begin(begins[i])
        at = (i * 37) % 65_000
        before = decoder.refused
        remote, error, extended = flag
        data = noise[at : at + size]
        message = can.Message(0.0, identifier, extended, remote, error, data=data)
        sound = decoder.take(message)
        assert decoder.refused == before + (not sound)
        taken += sound
    decoder.write_measurement(measurement)
    assert 0 < taken < FRAMES
    assert min(decoder.sequence) >= 0
    assert np.nanmax(np.abs(measurement[0])) < 4.4


@pytest.mark.slow
def test_nodes_take_anything():
    config = settings()
    machine = Kinematic()
    nodes = EmulatedBus(config, machine)
    rng = np.random.default_rng(11)
    identifiers = rng.choice(sorted(nodes._heard), 20_000).tolist()
    sizes = rng.choice([0, 1, 2, 6, 7, 8, 64], 20_000).tolist()
    for identifier, size in zip(identifiers, sizes, strict=True):
        nodes._pass(can.Message(arbitration_id=identifier, data=rng.bytes(size), is_extended_id=False), False)
    nodes.close()
    assert (machine.request == BRAKED).all() and (machine.length == 0.0).all()


@pytest.mark.slow
def test_it_can_be_opened_again():
    with serving(config := settings()):
        rig = CanopenRig(config, PERIOD)
        for _ in range(2):
            rig.open()
            rig.identify()
            rig.arm()
            feedback, statuses = run(rig, 10)
            assert ANSWERED in statuses
            np.testing.assert_array_equal(feedback["drive"], FOLLOWING)
            rig.close()


def test_what_is_refused_changes_nothing():
    config = settings()
    decoder = Decoder(config)
    scales = config.imus.scales
    measurement = np.fromfunction(lambda s, i, a: 0.5 * s + 0.01 * i + 0.1 * a, (3, 7, 3))
    measurement[2, 4] = np.nan
    raw = raw_readings(measurement, scales)
    decoder.begin(5)
    for imu in range(7):
        for cob_id, data in pack_imu(raw[:, imu], 2**32 + 3, 10**12, 5, True, True):
            assert decoder.take(new_message(cob_id + 11 + imu, data))
    decoded = np.zeros((3, 7, 3))
    decoder.write_measurement(decoded)
    np.testing.assert_allclose(decoded, measurement, atol=0.026)
    decoder.begin(6)
    state = decoder.sequence.copy(), decoder.sample_ns.copy()
    for sync, extra in ((5, b""), (7, b""), (6, b"\0")):
        (_, data), *_ = pack_imu(raw[:, 0] + 1, 9, 10**13, sync, True, True)
        assert not decoder.take(new_message(CobId.TPDO + 11, data + extra))
    assert not decoder.take(new_message(CobId.TPDO + 1, bytes(ANSWER.size - 1)))
    again = np.zeros((3, 7, 3))
    decoder.write_measurement(again)
    np.testing.assert_array_equal(again, decoded)
    assert (decoder.sequence, decoder.sample_ns, decoder.refused) == (*state, 4)


def test_counters_that_wrap():
    assert advance_of(3, 254, 256, 5) == 5
    assert advance_of(3, 254, 256, 517) == 517
    assert advance_of(3, 254, 256, 515) == 517
    assert advance_of(4, 4, 256, 0) == 0
    assert advance_of(1, 5000, 1 << 32, 2) == 2
    assert advance_of(10, 60_000, 65_536, 65_536 * 3.1) == 5546 + 65_536 * 3


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"bus": {"interface": "serial"}}, "interface is 'serial'; it must be one of socketcan"),
        ({"bus": {"speed": 1}}, "no entry 'speed'"),
        ({"bus": {"fd": 1}}, "fd must be a bool"),
        ({"bus": {"bitrate": 2_000_000}}, "bitrate is 2e.06; it must be from 10000 to 1e.06"),
        ({"drives": {"nodes": [1, 2, 3, 4, 5]}}, r"nodes is .*; it must be a list of 6"),
        ({"drives": {"nodes": [1, 2, 3, 4, 5, 128]}}, r"nodes\[5\] is 128; it must be a whole number from 1 to 127"),
        ({"drives": {"nodes": [1, 2, 3, 4, 5, 11]}}, "IMU 0 and drive 5 have the same node id 11"),
        ({"drives": {"signs": [1, 1, 1, 1, 1, 2]}}, r"signs\[5\] is 2; it must be one of 1, -1"),
        ({"drives": {"screw_lead": 0.0}}, "screw_lead is 0; it must be positive"),
        ({"drives": {"counts_per_turn": 2**31 - 1}}, "velocity_limit is .* counts, more than 32 bits hold"),
        ({"drives": {"eds": "none.eds"}}, "there is no EDS file"),
        ({"imus": {"gyroscope_scale": float("nan")}}, "gyroscope_scale is nan"),
        ({"imus": {"signs": [[1, 1, 1]] * 6}}, "signs is .*; it must be a list of 7"),
        ({"imus": {"nodes": 3}}, "nodes must be a list"),
        ({"controller": {"heartbeat_timeout": 0.03}}, "heartbeat_timeout is 0.03; it must be from 0.04"),
        ({"gears": {}}, r"a table \[gears\] that is not known"),
    ],
)
def test_settings_are_checked(changes, message):
    with pytest.raises(InputError, match=message):
        canopen_settings(**changes)


def test_files_of_settings_are_checked(tmp_path):
    path = tmp_path / "rig.toml"
    with pytest.raises(InputError, match=r"cannot read .*rig\.toml"):
        canopen_settings(path)
    path.write_text("[bus")
    with pytest.raises(InputError, match="is not valid TOML"):
        canopen_settings(path)
    path.write_text("[bus]\ninterface = 'virtual'\n")
    with pytest.raises(InputError, match=r"\[bus\] lacks the entry 'channel'"):
        canopen_settings(path)
    eds = tmp_path / "drive.eds"
    path.write_text(DEFAULT_FILE.read_text().replace('"imu.eds"', f'"{DEFAULT_FILE.parent}/imu.eds"'))
    eds.write_text("[1000]\n")
    rig = CanopenRig(canopen_settings(path, bus={"interface": "virtual"}), PERIOD)
    with pytest.raises(InputError, match=r"drive.eds is not a usable EDS file"):
        rig.open()
    with pytest.raises(RigError, match="not open"):
        rig.arm()


def test_a_real_bus_is_not_overloaded():
    assert classic_bits(8) == 135
    assert fd_duration(8, 10**6, 10**6) == pytest.approx(1e-6 * (17 + 4 + 13 + 69 + 17 + 21 + 6))
    can_20 = {"interface": "socketcan", "channel": "can0", "fd": False}
    config = canopen_settings(bus=can_20)
    assert config.check_bus_load(200.0) == pytest.approx(0.731)
    with pytest.raises(RigError, match=r"at 500 Hz .* 183% .*: lower the rate to 246 Hz, raise the bit rate, or use CAN FD"):
        CanopenRig(config, 0.002)
    assert canopen_settings(bus={**can_20, "fd": True}).check_bus_load(500.0) < 0.9
    assert canopen_settings(bus={"fd": False}).check_bus_load(500.0) > 1.8


def _serve_in_process(config, ready, stop):
    nodes = EmulatedBus(config, Kinematic())
    ready.set()
    nodes.serve(stop.is_set)
    nodes.close()


def test_a_multicast_bus_without_hops_hears_the_loopback_alone():
    """Without hops and beyond the loopback: what another machine's frame would be to this one."""
    bus = canopen_settings(bus={"port": 43_218}).bus
    assert bus.hop_limit == 0
    with bus.opened() as one, bus.opened() as other, can.Bus(**bus.arguments()) as stranger:
        for each in (one, other):
            with socket.socket(fileno=os.dup(each.fileno())) as opened:
                assert opened.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16).rstrip(b"\0") == b"lo"
        with suppress(can.CanError, OSError):
            stranger.send(can.Message(arbitration_id=0x77))
        one.send(can.Message(arbitration_id=0x123))
        assert [message and message.arbitration_id for message in (other.recv(0.5), other.recv(0.05))] == [0x123, None]


@pytest.mark.slow
def test_two_processes_by_multicast():
    patient = {"controller": {"heartbeat_timeout": 1.0}, "drives": {"command_timeout": 1.0, "silence": 1.0}}
    config = canopen_settings(bus={"port": 43_217}, **patient)
    try:
        with config.bus.opened() as one, config.bus.opened() as other:
            one.send(can.Message(arbitration_id=0x123))
            if other.recv(0.5) is None:
                pytest.skip("multicast frames do not arrive on this machine")
    except (can.CanError, OSError) as error:
        pytest.skip(f"multicast is impossible here: {error}")
    context = multiprocessing.get_context("fork")
    ready, stop = context.Event(), context.Event()
    process = context.Process(target=_serve_in_process, args=(config, ready, stop), daemon=True)
    process.start()
    rig = CanopenRig(config, PERIOD)
    try:
        assert ready.wait(10.0)
        rig.open()
        assert len(rig.identify().parts) == 13
        rig.arm()
        # On a busy machine, many answers are late.
        feedback, statuses = run(rig, 200, np.full(6, 0.05))
        assert statuses.count(ANSWERED) >= 120
        np.testing.assert_array_equal(feedback["drive"], FOLLOWING)
        rig.quick_stop()
        feedback, _ = run(rig, 30, request=QUICK_STOP)
        np.testing.assert_array_equal(feedback["drive"], READY)
    finally:
        rig.close()
        stop.set()
        process.join(5.0)


def test_scales_have_signs():
    config = settings(drives={"signs": [1, -1, 1, -1, 1, -1]})
    assert config.drives.scales[:2] == [65536 / 0.005, -65536 / 0.005]


class Dictionary:
    """A node that notes what is written to it."""

    def __init__(self):
        self.written = {}

    def write(self, index, subindex, value):
        self.written[index, subindex] = value

    configure = write

    def check(self, index, subindex, value, within=0.0):
        pass

    def has(self, index, subindex):
        return True

    def map_pdo(self, pdo):
        pass


@pytest.mark.parametrize("gear", [1.0, 4.0, 0.5])
def test_a_drive_is_configured_in_its_own_units_for_any_screw_and_gear(gear):
    """Of lengths that differ from their defaults and from each other, so that none can stand for another."""
    lead, counts, speed, deceleration = 0.004, 1024, 0.3, 2.5
    changes = {"heartbeat": 0.03, "silence": 0.7, "command_timeout": 0.11}
    changes |= {"screw_lead": lead, "gear_ratio": gear, "counts_per_turn": counts}
    drives = settings(drives={**changes, "velocity_limit": speed, "quick_stop_deceleration": deceleration}).drives
    node = Dictionary()
    configure_drive(node, drives, 0.004)
    # A metre of the leg is so many turns of the motor.
    turns = gear / lead
    assert drives.counts_per_metre == pytest.approx(turns * counts)
    found = node.written
    assert found[Object.MAX_MOTOR_SPEED, 0] == pytest.approx(60.0 * turns * speed, abs=0.5)
    assert found[Object.QUICK_STOP_DECELERATION, 0] == pytest.approx(turns * counts * deceleration, abs=0.5)
    assert found[Object.PRODUCER_HEARTBEAT, 0] == 30
    assert found[COMMAND_PDO.communication, Parameter.EVENT_TIMER] == 110
    assert found[Object.INTERPOLATION_PERIOD, 1] * 10.0 ** found[Object.INTERPOLATION_PERIOD, 2] == pytest.approx(0.004)
    assert (found[Object.MODE, 0], found[Object.TARGET_VELOCITY, 0]) == (9, 0)
