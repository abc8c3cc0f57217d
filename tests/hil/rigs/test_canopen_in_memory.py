"""CANopen in one thread: the frames are those of a bus, time is the loop's, and watchdogs of both sides work on it."""

import numpy as np
import pytest

from hil.rigs import ANSWERED, BRAKED, ENABLED, FAULTY, FOLLOWING, QUICK_STOP, SILENT, new_feedback
from hil.rigs.canopen.cia402 import HEARTBEAT_LOST, PDO_LOST, PowerState
from hil.rigs.canopen.frames import COMMAND, CobId, Object
from hil.rigs.canopen.in_memory import CanopenInMemory
from hil.rigs.canopen.settings import canopen_settings
from hil.rigs.emulation import fault, new_emulated
from hil.rigs.position_loops import ENCODER_LOST, FOLLOWING_ERROR
from hil.runs.config import SimulationConfig
from hil.runs.prepare import simulated_plant
from plant.encoder_readings import encoder_state
from plant.encoders import load_encoder
from plant.imu import imu_state, load_imu
from plant.mechanism import load_in_space
from plant.truth import TRUTH_LENGTHS

PERIOD = 0.002


@pytest.fixture
def made():
    """Makes an armed rig with faults."""
    opened = []

    def make(*faults, fd=True, lengths="none", **drives):
        mechanism = load_in_space("hexapod")
        plant = simulated_plant(SimulationConfig(rate=1.0 / PERIOD), mechanism, mechanism.require_home())
        emulated = new_emulated(mechanism, round(1e9 * PERIOD), 1, [fault(text) for text in faults])
        state = imu_state(load_imu("ideal"), 1, PERIOD)
        settings = canopen_settings(bus={"fd": fd}, drives=drives)
        encoders = encoder_state(load_encoder(lengths), 1, PERIOD)
        rig = CanopenInMemory(settings, PERIOD, lambda: (plant, state, encoders, emulated), lengths != "none")
        opened.append((rig, plant))
        rig.open()
        assert len(rig.identify().parts) == 13
        rig.arm()
        return rig

    yield make
    for rig, plant in opened:
        rig.close()
        plant.close()


def exchange(rig, cycles, velocity=0.0, request=ENABLED):
    feedback, statuses = new_feedback(), []
    for _ in range(cycles):
        statuses.append(rig.exchange(np.full(6, velocity), request, feedback))
    return feedback, statuses


def test_drives_follow_and_imus_sample_in_each_cycle(made):
    rig = made()
    _, statuses = exchange(rig, 5)
    before, _ = exchange(rig, 1)
    after, more = exchange(rig, 100, 0.05)
    assert set(statuses[1:] + more) == {ANSWERED}
    assert (after["drive"] == FOLLOWING).all()
    assert (after["sequence"] - before["sequence"] == 100).all()
    np.testing.assert_allclose(after["sample_ns"] - before["sample_ns"], 100 * PERIOD * 1e9, atol=2e5)
    # Commands take effect at the SYNC after them, and loaded drives are a little slower.
    np.testing.assert_allclose(after["truth"][7:13] - before["truth"][7:13], 99 * PERIOD * 0.05, rtol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("fd", [True, False])
def test_encoders_follow_the_legs(made, fd):
    rig = made("encoder-jumps:4,size_mm=2,at=0.1", fd=fd, lengths="ideal")
    exchange(rig, 5)
    found = []
    for _ in range(100):
        feedback, _ = exchange(rig, 1, 0.05)
        found.append(feedback["length"] - rig.machine.rig["truth"][7:13])
    off = np.array(found)
    assert np.abs(np.delete(off, 4, axis=1)).max() < 1e-6
    np.testing.assert_allclose(off[[0, 30, 60, 99], 4], [0.0, 0.0, 2e-3, 2e-3], atol=1e-6)


def test_a_bus_that_is_down_is_silence_and_the_drives_stop_by_themselves(made):
    rig = made("bus-down,at=0.1")
    _, statuses = exchange(rig, 150, 0.02)
    assert statuses[:45] == [ANSWERED] * 45 and statuses[55:] == [SILENT] * 95
    assert {drive.power for drive in rig.nodes.drives} == {PowerState.FAULT} and (rig.machine.rig["velocity"] == 0.0).all()
    assert {drive.code for drive in rig.nodes.drives} <= {HEARTBEAT_LOST, PDO_LOST}


def test_frames_that_are_late_by_more_than_the_exchange_waits_are_missing(made):
    rig = made("bus-delays,size=1.5,at=0.1")
    _, statuses = exchange(rig, 100, 0.01)
    assert statuses[:45] == [ANSWERED] * 45 and SILENT in statuses[55:]


def test_braked_drives_hold(made):
    rig = made()
    exchange(rig, 50, 0.05)
    first, _ = exchange(rig, 50, 0.05, BRAKED)
    last, _ = exchange(rig, 50, 0.05, BRAKED)
    np.testing.assert_allclose(last["truth"][7:13], first["truth"][7:13], atol=1e-6)


# ------------------------------------------------------------------------------------------- drives that are told positions

STEP = 100 * PERIOD * 0.05
"""How far a drive goes in 100 cycles at 50 mm/s [m]."""


def at_rest(rig, cycles=20):
    """True lengths of an enabled rig that is told not to move."""
    exchange(rig, cycles)
    return rig.machine.rig["truth"][TRUTH_LENGTHS].copy()


@pytest.fixture
def moving(made):
    """An enabled rig whose drives are told positions, and its lengths at rest."""

    def make(*faults, **choices):
        rig = made(*faults, mode="position", **choices)
        exchange(rig, 5, request=BRAKED)
        return rig, at_rest(rig, 100)

    return make


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fd", "lengths", "signs"),
    # Every two of these choices meet once.
    [
        (True, "none", [1] * 6),
        (True, "ideal", [-1, 1] * 3),
        (False, "none", [-1, 1] * 3),
        (False, "ideal", [1] * 6),
    ],
)
def test_drives_that_are_told_positions_do_not_droop(moving, fd, lengths, signs):
    rig, first = moving(fd=fd, lengths=lengths, signs=signs)
    assert {drive.value(Object.MODE) for drive in rig.nodes.drives} == {8}
    feedback, _ = exchange(rig, 100, 0.05)
    assert (feedback["drive"] == FOLLOWING).all() and np.isfinite(feedback["length"]).all() == (lengths != "none")
    np.testing.assert_allclose(feedback["sent"], 0.05)
    # The same drives fall short by 9 % as the platform's weight pulls, if they follow velocities.
    np.testing.assert_allclose(at_rest(rig, 100) - first, STEP, atol=5e-6)


def test_the_count_wraps(moving):
    """The encoders are 1 mm before the end of their 32 bits, one after the other way."""
    rig = moving()[0]
    exchange(rig, 5, request=BRAKED)
    for drive, ahead in zip(rig.nodes.drives, [1, -1, 1, -1, 1, -1], strict=True):
        wanted = 2**31 - ahead * round(0.001 * 65536 / 0.005)
        drive.origin += wanted - drive.position()
    exchange(rig, 5, request=BRAKED)
    first = at_rest(rig, 100)
    np.testing.assert_allclose(exchange(rig, 100, 0.05)[0]["truth"][TRUTH_LENGTHS] - first, 0.99 * STEP, atol=5e-5)
    exchange(rig, 200, -0.05)
    np.testing.assert_allclose(at_rest(rig, 100) - first, -STEP, atol=5e-6)


def test_after_missed_periods_nothing_jumps_and_the_motion_is_missing(moving):
    rig, first = moving(lengths="ideal")
    exchange(rig, 100, 0.05)
    rig._next_ns += 10 * round(1e9 * PERIOD)
    before = rig.machine.rig["truth"][TRUTH_LENGTHS].copy()
    speeds = []
    for _ in range(30):
        exchange(rig, 1, 0.05)
        speeds.append(np.abs(rig.machine.rig["velocity"]).max())
    assert max(speeds) < 0.06
    # In ten periods more than one each drive goes on to its last target, and no further.
    np.testing.assert_allclose(rig.machine.rig["truth"][TRUTH_LENGTHS] - before, 30 * PERIOD * 0.05, atol=2e-4)
    np.testing.assert_allclose(at_rest(rig, 100) - first, 1.3 * STEP, atol=5e-6)


@pytest.mark.slow
def test_lost_frames_cost_no_way_and_no_jump(moving):
    """Of commands and answers a fifth is lost; the target has gone on, and the drive makes up for it within its limit."""
    rig, first = moving("bus-drops,size=0.2,at=0.1", lengths="ideal")
    _, statuses = exchange(rig, 300, 0.05)
    assert set(statuses) <= {ANSWERED, SILENT} and rig._rig.decoder.received != 0
    assert np.abs(rig.machine.rig["velocity"]).max() < 0.15
    rig.machine.rig["faults"] = 0
    np.testing.assert_allclose(at_rest(rig, 100) - first, 3.0 * STEP, atol=5e-6)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [BRAKED, QUICK_STOP])
def test_a_drive_that_is_enabled_again_begins_where_it_is(moving, stop):
    rig, _ = moving(lengths="ideal")
    exchange(rig, 50, 0.1)
    exchange(rig, 100, 0.1, stop)
    held = rig.machine.rig["truth"][TRUTH_LENGTHS].copy()
    moves = []
    for _ in range(30):
        exchange(rig, 1)
        moves.append(np.abs(rig.machine.rig["truth"][TRUTH_LENGTHS] - held).max())
    # The weight moves it a little as the brake opens.
    assert max(moves) < 5e-5
    exchange(rig, 100, 0.05)
    np.testing.assert_allclose(at_rest(rig, 100) - held, STEP, atol=5e-6)


def test_while_it_stands_the_target_is_where_the_drive_is(moving):
    rig, _ = moving(lengths="ideal")
    exchange(rig, 50, 0.1)
    sent = {}
    take = rig.nodes.hear

    def hear(message):
        if CobId.RPDO < message.arbitration_id <= CobId.RPDO + 6:
            sent[message.arbitration_id - CobId.RPDO - 1] = COMMAND.unpack(message.data)[1]
        take(message)

    rig.nodes.hear = hear
    exchange(rig, 100, 0.1, QUICK_STOP)
    assert [drive.position() for drive in rig.nodes.drives] == pytest.approx([sent[k] for k in range(6)], abs=1)
    # Ordered by the controller itself, too.
    rig.quick_stop()
    assert [drive.target_position for drive in rig.nodes.drives] == [sent[k] for k in range(6)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ("drive-stuck:2,at=0.1", FOLLOWING_ERROR),
        ("drive-runs-away:2,at=0.1,size=0.2", FOLLOWING_ERROR),
        ("encoder-reversed:2,at=0.1", FOLLOWING_ERROR),
        ("encoder-dead:2,at=0.1", ENCODER_LOST),
    ],
)
def test_a_drive_that_cannot_follow_has_a_fault(moving, fault, code):
    rig, _ = moving(fault, lengths="incremental")
    feedback, cycles = None, 0
    while cycles < 250 and (feedback is None or feedback["drive"][2] != FAULTY):
        feedback, _ = exchange(rig, 1, 0.05)
        cycles += 1
    assert (feedback["drive"] == FAULTY).tolist() == [False, False, True, False, False, False]
    assert feedback["drive_code"][2] == code
    exchange(rig, 10, 0.05)
    assert rig.nodes.drives[2].code == code


def test_the_window_of_the_following_error_is_that_of_the_settings(moving):
    """A drive that stands while it is told 50 mm/s is off by the window after so much time, and has a fault 10 ms later."""
    for window in (0.001, 0.004):
        rig, _ = moving("drive-stuck:0,at=0.21", lengths="ideal", following_error=window)
        assert rig.nodes.drives[0].value(Object.FOLLOWING_WINDOW) == round(window * 65536 / 0.005)
        words, cycles = 0, 0
        while not rig.nodes.drives[0].code and cycles < 200:
            exchange(rig, 1, 0.05)
            words |= rig._rig.decoder.statuswords[0]
            cycles += 1
        # It stands from 10 ms after its first command on.
        assert cycles * PERIOD == pytest.approx(0.01 + window / 0.05 + 0.01, abs=6 * PERIOD)
        assert words & 1 << 13
