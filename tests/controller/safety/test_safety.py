"""The states of a run, and that nothing but the specified reactions comes of what is seen, whatever it is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.cycle import OK, STATE, cycle, cycle_parameters, prepare
from controller.inverse_kinematics import leg_lengths
from controller.safety.watch import (
    ARMED,
    ASKED_TO_STOP,
    BRAKED,
    BUS_LOST,
    CAUSES,
    DRIVE_FAULT,
    DRIVE_OFF,
    EMERGENCY_STOP,
    ENABLED,
    FAULT,
    FAULTY,
    FOLLOWING,
    IDLE,
    NO_AGREEMENT,
    NO_DRIVES,
    OFF,
    QUICK_STOP,
    QUICK_STOPPING,
    READY,
    RUNNING,
    STOPPED,
    STOPPING,
    begin_stop,
    describe_end,
    describe_event,
    describe_obstacle,
    has_stopped,
    hear,
)
from controller.settings import SafetySettings, control_settings, fusion_settings, safety_settings
from plant.errors import InputError
from plant.mechanism import Mechanism
from tests.controller.leg_geometry import static_signals

RATE_HZ = 500.0
ALL_FRESH = np.zeros(7, np.int64)


class Bench:
    """A cycle on signals of a platform at rest at home, with drives and bus as a test has them."""

    def __init__(self, mechanism, off=0.0, **choices):
        control = control_settings(mechanism)
        self.parameters = cycle_parameters(mechanism, RATE_HZ, control, fusion_settings(mechanism), **choices)
        self.state = np.zeros((), STATE)
        self.hold = int(self.parameters["hold_cycles"])
        self.signals = static_signals(mechanism, mechanism.home.position, mechanism.home.rotation)
        self.segments = np.zeros((6, 1, 5))
        self.segments[:, 0, 1] = leg_lengths(mechanism, mechanism.home.position, mechanism.home.rotation) + off

    @property
    def mode(self):
        return int(self.state["safety"]["mode"])

    @property
    def request(self):
        return int(self.state["safety"]["request"])

    def step(self, drive=FOLLOWING, silent=0, age=ALL_FRESH, cause=None):
        """A cycle; what it has told."""
        drives = np.full(6, drive, np.int64) if np.isscalar(drive) else np.array(drive, np.int64)
        if cause is not None:
            begin_stop(self.parameters, self.state, cause)
        hear(self.parameters, self.state, age, drives, silent)
        cycle(self.parameters, self.state, self.signals, self.segments)
        safety = self.state["safety"]
        told = safety["event_cause"][: min(int(safety["event_count"]), 8)].tolist()
        prepare(self.parameters, self.state, self.segments)
        return told

    def steps(self, count, **given):
        return [cause for _ in range(count) for cause in self.step(**given)]


@pytest.fixture
def bench(hexapod):
    return Bench(hexapod)


def test_from_idle_to_running_as_the_drives_are_ready(bench):
    bench.steps(bench.hold, drive=READY)
    assert (bench.mode, bench.request) == (IDLE, BRAKED)
    bench.step(drive=READY)
    assert (bench.mode, bench.request) == (ARMED, ENABLED)
    bench.steps(5, drive=READY)
    assert bench.mode == ARMED
    assert (bench.state["command"] == 0.0).all()
    bench.step(drive=[FOLLOWING] * 5 + [READY])
    assert bench.mode == ARMED
    bench.step()
    assert bench.mode == RUNNING
    assert bench.state["safety"]["waited"] == 7


def test_what_goes_wrong_between_armed_and_running_ends_it_at_once(hexapod):
    bench = Bench(hexapod)
    bench.steps(bench.hold + 5, drive=READY)
    assert bench.mode == ARMED
    bench.segments[:, 0, 1] += 0.02
    bench.steps(2, drive=READY)
    assert bench.state["stopping"] == NO_AGREEMENT
    assert bench.request == BRAKED
    assert (bench.state["command"] == 0.0).all()
    assert has_stopped(bench.state)


def test_a_bus_that_answers_now_and_then_is_lost(hexapod):
    bench = running(hexapod)
    for _ in range(20):
        bench.steps(3, silent=1)
        bench.step()
    assert (bench.mode, bench.state["stopping"]) == (FAULT, BUS_LOST)


@pytest.mark.parametrize("drive", [OFF, FAULTY, QUICK_STOPPING])
def test_drives_that_are_not_ready_are_not_armed(bench, drive):
    told = bench.steps(bench.hold + round(1.1 * RATE_HZ), drive=[READY] * 3 + [drive] + [READY] * 2)
    assert bench.state["stopping"] == NO_DRIVES
    assert told.count(NO_DRIVES) == 1
    assert bench.request == BRAKED
    assert describe_end(bench.state) == "not armed: drive 3 is not ready"
    assert has_stopped(bench.state)


def test_a_target_that_begins_elsewhere_is_not_armed(hexapod):
    bench = Bench(hexapod, off=0.012)
    bench.steps(bench.hold + round(1.1 * RATE_HZ))
    assert bench.state["stopping"] == NO_AGREEMENT
    assert "leg 0 is not where the target begins (0.012 m, the limit is 0.01 m)" in describe_end(bench.state)


def test_a_dry_run_says_what_is_in_the_way_and_asks_nothing_of_the_drives(hexapod):
    for off, words in ((0.0, ""), (0.012, "not armed: leg 0 is not where the target begins")):
        bench = Bench(hexapod, off=off, to_arm=False)
        bench.steps(bench.hold + 1000)
        assert (bench.mode, bench.request) == (IDLE, BRAKED)
        assert describe_obstacle(bench.state).startswith(words) and bool(describe_obstacle(bench.state)) == bool(words)


def running(hexapod):
    bench = Bench(hexapod)
    bench.steps(bench.hold + 50)
    assert bench.mode == RUNNING
    return bench


@pytest.mark.parametrize(
    ("given", "cause", "asked"),
    [
        ({"drive": [FOLLOWING, FAULTY] + [FOLLOWING] * 4}, DRIVE_FAULT, QUICK_STOP),
        ({"drive": [FOLLOWING] * 5 + [OFF]}, DRIVE_OFF, QUICK_STOP),
        ({"silent": 10}, BUS_LOST, QUICK_STOP),
        ({"cause": EMERGENCY_STOP}, EMERGENCY_STOP, QUICK_STOP),
    ],
)
def test_a_fault_is_for_good(hexapod, given, cause, asked):
    bench = running(hexapod)
    assert cause in bench.step(**given)
    assert (bench.mode, bench.request) == (FAULT, asked)
    bench.steps(300)
    assert bench.mode == FAULT
    assert bench.state["stopping"] == cause
    assert has_stopped(bench.state)
    assert bench.request == BRAKED


def test_a_fault_counts_more_than_a_stop_and_the_first_stop_more_than_others(hexapod):
    bench = running(hexapod)
    bench.step(cause=ASKED_TO_STOP)
    assert (bench.mode, bench.state["stopping"]) == (STOPPING, ASKED_TO_STOP)
    assert bench.step(cause=1) == []
    bench.step(drive=[FAULTY] * 6)
    assert (bench.mode, bench.state["stopping"]) == (FAULT, DRIVE_FAULT)


def test_a_controlled_stop_ends_on_the_brakes(hexapod):
    bench = running(hexapod)
    bench.step(cause=ASKED_TO_STOP)
    for _ in range(500):
        if has_stopped(bench.state):
            break
        bench.step()
    assert (bench.mode, bench.request) == (STOPPED, BRAKED)


@settings(max_examples=40)
@given(st.data())
def test_whatever_drives_and_bus_say_nothing_moves_but_as_specified(hexapod, data):
    bench = Bench(hexapod)
    limits, period = hexapod.limits, 1.0 / RATE_HZ
    drives = st.lists(st.sampled_from([FOLLOWING] * 8 + [READY, OFF, QUICK_STOPPING, FAULTY, 77]), min_size=6, max_size=6)
    mode, command = IDLE, np.zeros(6)
    for _ in range(data.draw(st.integers(1, 12))):
        given = {
            "drive": data.draw(drives),
            "silent": data.draw(st.integers(0, 30)),
            "age": np.array(data.draw(st.lists(st.integers(0, 20), min_size=7, max_size=7))),
            "cause": data.draw(st.one_of(st.none(), st.sampled_from([ASKED_TO_STOP, EMERGENCY_STOP, BUS_LOST]))),
        }
        for _ in range(data.draw(st.integers(1, 80))):
            bench.step(**given)
            given["cause"] = None
            now = bench.state["command"].copy()
            assert np.isfinite(now).all() and np.abs(now).max() <= bench.parameters["command_limit"]
            if bench.mode in (IDLE, ARMED):
                assert (now == 0.0).all()
            if mode == FAULT:
                # For good, and to rest at the limit of acceleration.
                assert bench.mode == FAULT
                assert np.abs(now - command).max() <= limits.acceleration * period * (1.0 + 1e-9)
                assert (np.abs(now) <= np.abs(command)).all()
            if bench.mode == RUNNING:
                assert bench.request == ENABLED
            mode, command = bench.mode, now


def test_every_cause_reads_well():
    for number, cause in enumerate(CAUSES):
        assert describe_event(number, 3, np.nan, np.nan) == cause.text.format(3)
    assert describe_event(BUS_LOST, -1, 21.0, 20.0).endswith("(21 cycles, the limit is 20 cycles)")
    assert OK == 0


def test_settings_are_read_and_checked(hexapod):
    def of(**table):
        return Mechanism.from_legs(
            hexapod.base_joints, hexapod.platform_joints, home=hexapod.home, settings={"safety": table}
        )  # fmt: skip

    assert safety_settings(of(following=0.02)).following == 0.02
    assert safety_settings(of()) == SafetySettings()
    for table, words in (({"followed": 1.0}, "no entry 'followed'"), ({"following": -1.0}, "following is -1")):
        with pytest.raises(InputError, match=words):
            safety_settings(of(**table))
    raw = SafetySettings(following=0.2).for_raw_imus()
    assert (raw.watch_imus, raw.following, raw.arming_distance) == (0.0, 0.2, 0.05)
