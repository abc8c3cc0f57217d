"""CANopen in one thread: the frames are those of a bus, time is the loop's, and watchdogs of both sides work on it."""

import numpy as np
import pytest

from hil.rigs import ANSWERED, BRAKED, ENABLED, FOLLOWING, SILENT, new_feedback
from hil.rigs.canopen.cia402 import HEARTBEAT_LOST, PDO_LOST, PowerState
from hil.rigs.canopen.in_memory import CanopenInMemory
from hil.rigs.canopen.settings import canopen_settings
from hil.rigs.emulation import fault, new_emulated
from hil.runs.config import SimulationConfig
from hil.runs.prepare import simulated_plant
from plant.encoder_readings import encoder_state
from plant.encoders import load_encoder
from plant.imu import imu_state, load_imu
from plant.mechanism import load_in_space

PERIOD = 0.002


@pytest.fixture
def made():
    """Makes an armed rig with faults."""
    opened = []

    def make(*faults, fd=True, lengths="none"):
        mechanism = load_in_space("hexapod")
        plant = simulated_plant(SimulationConfig(rate=1.0 / PERIOD), mechanism, mechanism.require_home())
        emulated = new_emulated(mechanism, round(1e9 * PERIOD), 1, [fault(text) for text in faults])
        state = imu_state(load_imu("ideal"), 1, PERIOD)
        settings = canopen_settings(bus={"fd": fd})
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
