"""The states of a run, and that nothing but the specified reactions comes of what is seen, whatever it is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.cycle import STATE, cycle_parameters, hear_rig, prepare_next, react
from controller.inverse_kinematics import leg_lengths
from controller.safety.arming import describe_obstacle
from controller.safety.causes import Cause, DriveState, Mode, Request
from controller.safety.stop import describe_end, has_stopped
from controller.settings import SafetySettings, control_settings, fusion_settings, safety_settings
from plant.errors import InputError
from plant.mechanism import Mechanism
from tests.controller.cycles import cycle
from tests.controller.leg_geometry import static_signals

RATE_HZ = 500.0
ALL_FRESH = np.zeros(7, np.int64)


class Bench:
    """A cycle on signals of a platform at rest at home, with drives and bus as a test has them."""

    def __init__(self, mechanism, off=0.0, **choices):
        control = control_settings(mechanism)
        self.parameters = cycle_parameters(mechanism, RATE_HZ, control, fusion_settings(mechanism), **choices)
        self.state = np.zeros((), STATE)
        self.hold = int(self.parameters["rig"]["hold_cycles"])
        self.signals = static_signals(mechanism, mechanism.home.position, mechanism.home.rotation)
        self.segments = np.zeros((6, 1, 5))
        self.segments[:, 0, 1] = leg_lengths(mechanism, mechanism.home.position, mechanism.home.rotation) + off

    @property
    def mode(self):
        return int(self.state["safety"]["mode"])

    @property
    def request(self):
        return int(self.state["safety"]["request"])

    def step(self, drive=DriveState.FOLLOWING, silent=0, age=ALL_FRESH, cause=None):
        """A cycle; what it has told."""
        drives = np.full(6, drive, np.int64) if np.isscalar(drive) else np.array(drive, np.int64)
        if cause is not None:
            react(self.parameters, self.state, cause, -1, np.nan, np.nan)
        hear_rig(self.parameters, self.state, age, drives, np.zeros(6, np.int64), silent)
        cycle(self.parameters, self.state, self.signals, self.segments)
        safety = self.state["safety"]
        told = safety["events"]["cause"][: min(int(safety["events"]["count"]), 8)].tolist()
        prepare_next(self.parameters, self.state, self.segments)
        return told

    def steps(self, count, **given):
        return [cause for _ in range(count) for cause in self.step(**given)]


@pytest.fixture
def bench(hexapod):
    return Bench(hexapod)


def test_from_idle_to_running_as_the_drives_are_ready(bench):
    bench.steps(bench.hold, drive=DriveState.READY)
    assert (bench.mode, bench.request) == (Mode.IDLE, Request.BRAKED)
    bench.step(drive=DriveState.READY)
    assert (bench.mode, bench.request) == (Mode.ARMED, Request.ENABLED)
    bench.steps(5, drive=DriveState.READY)
    assert bench.mode == Mode.ARMED
    assert (bench.state["pid"]["command"] == 0.0).all()
    bench.step(drive=[DriveState.FOLLOWING] * 5 + [DriveState.READY])
    assert bench.mode == Mode.ARMED
    bench.step()
    assert bench.mode == Mode.RUNNING
    assert bench.state["safety"]["arming"]["delay"] == 7


def test_what_goes_wrong_between_armed_and_running_ends_it_at_once(hexapod):
    bench = Bench(hexapod)
    bench.steps(bench.hold + 5, drive=DriveState.READY)
    assert bench.mode == Mode.ARMED
    bench.segments[:, 0, 1] += 0.02
    bench.steps(2, drive=DriveState.READY)
    assert bench.state["safety"]["stop"]["cause"] == Cause.NO_AGREEMENT
    assert bench.request == Request.BRAKED
    assert (bench.state["pid"]["command"] == 0.0).all()
    assert has_stopped(bench.state["safety"][()], bench.state["time"][()])


def test_a_bus_that_answers_now_and_then_is_lost(hexapod):
    bench = running(hexapod)
    for _ in range(20):
        bench.steps(3, silent=1)
        bench.step()
    assert (bench.mode, bench.state["safety"]["stop"]["cause"]) == (Mode.FAULT, Cause.BUS_LOST)


@pytest.mark.parametrize("drive", [DriveState.NOT_READY, DriveState.FAULTY, DriveState.QUICK_STOPPING])
def test_drives_that_are_not_ready_are_not_armed(bench, drive):
    told = bench.steps(bench.hold + round(5.1 * RATE_HZ), drive=[DriveState.READY] * 3 + [drive] + [DriveState.READY] * 2)
    assert bench.state["safety"]["stop"]["cause"] == Cause.NO_DRIVES
    assert told.count(Cause.NO_DRIVES) == 1
    assert bench.request == Request.BRAKED
    assert describe_end(bench.state) == "not armed: drive 3 is not ready"
    assert has_stopped(bench.state["safety"][()], bench.state["time"][()])


def test_a_target_that_begins_elsewhere_is_not_armed(hexapod):
    bench = Bench(hexapod, off=0.012)
    bench.steps(bench.hold + round(5.1 * RATE_HZ))
    assert bench.state["safety"]["stop"]["cause"] == Cause.NO_AGREEMENT
    assert "leg 0 is not where the target begins (0.012 m, the limit is 0.01 m)" in describe_end(bench.state)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("leg", range(6))
def test_a_leg_too_short_is_in_the_way_of_arming_as_one_too_long(hexapod, leg, sign):
    def obstacle(bench):
        bench.steps(bench.hold + 1, drive=DriveState.READY)
        arming = bench.state["safety"]["arming"]
        return bench.mode, arming["obstacle"], arming["index"], arming["value"], arming["limit"]

    off = np.zeros(6)
    off[leg] = 0.0099 * sign
    assert obstacle(Bench(hexapod, off=off))[0] == Mode.ARMED
    off[leg] = 0.0101 * sign
    found = obstacle(Bench(hexapod, off=off))
    assert found == (Mode.IDLE, Cause.NO_AGREEMENT, leg, pytest.approx(0.0101, abs=1e-6), 0.01)

    bench = Bench(hexapod)
    length = bench.segments[leg, 0, 1]
    for margin, mode in ((1e-4, Mode.ARMED), (-1e-4, Mode.IDLE)):
        bench = Bench(hexapod)
        limits = bench.parameters["safety"]["watch"]["lengths"][leg]
        limits[int(sign > 0.0)] = length + sign * margin
        found = obstacle(bench)
        assert found[0] == mode
    assert found[1:] == (Cause.NO_WORKSPACE, leg, pytest.approx(length, abs=1e-6), length - 1e-4 * sign)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("leg", [0, 3, 5])
def test_in_motion_a_leg_is_watched_in_both_directions(hexapod, leg, sign):
    def stopped(change):
        bench = running(hexapod)
        bench.parameters["safety"]["watch"]["drive_deviation"] = 1e3
        bench.parameters["safety"]["drives"]["slack"] = np.inf
        change(bench)
        bench.steps(round(0.6 * RATE_HZ))
        return bench.state["safety"]["stop"]["cause"], bench.state["safety"]["stop"]["index"]

    def shift_reference(bench):
        bench.segments[leg, 0, 1] += sign * 2.0 * bench.parameters["safety"]["watch"]["following"]

    def narrow_stroke(bench):
        limits = bench.parameters["safety"]["watch"]["lengths"][leg]
        limits[int(sign > 0.0)] = bench.segments[leg, 0, 1] - 1e-4 * sign

    def command(bench):
        shift_reference(bench)
        bench.parameters["safety"]["watch"]["drive_deviation"] = 0.1

    def saturate(bench):
        bench.parameters["safety"]["watch"]["following"] = 1e3
        bench.segments[leg, 0, 1] += sign

    assert stopped(shift_reference) == (Cause.FOLLOWING_ERROR, leg)
    assert stopped(narrow_stroke) == (Cause.BEYOND_STROKE, leg)
    assert stopped(command) == (Cause.DRIVE_DEVIATES, leg)
    assert stopped(saturate) == (Cause.SATURATED, leg)


def test_a_dry_run_says_what_is_in_the_way_and_asks_nothing_of_the_drives(hexapod):
    for off, words in ((0.0, ""), (0.012, "not armed: leg 0 is not where the target begins")):
        bench = Bench(hexapod, off=off, to_arm=False)
        bench.steps(bench.hold + round(6.0 * RATE_HZ))
        assert (bench.mode, bench.request) == (Mode.IDLE, Request.BRAKED)
        assert describe_obstacle(bench.state).startswith(words) and bool(describe_obstacle(bench.state)) == bool(words)


def running(hexapod):
    bench = Bench(hexapod)
    bench.steps(bench.hold + 50)
    assert bench.mode == Mode.RUNNING
    return bench


@pytest.mark.parametrize(
    ("given", "cause", "asked"),
    [
        (
            {"drive": [DriveState.FOLLOWING, DriveState.FAULTY] + [DriveState.FOLLOWING] * 4},
            Cause.DRIVE_FAULT,
            Request.QUICK_STOP,
        ),
        ({"drive": [DriveState.FOLLOWING] * 5 + [DriveState.NOT_READY]}, Cause.DRIVE_OFF, Request.QUICK_STOP),
        ({"silent": 10}, Cause.BUS_LOST, Request.QUICK_STOP),
        ({"cause": Cause.EMERGENCY_STOP}, Cause.EMERGENCY_STOP, Request.QUICK_STOP),
    ],
)
def test_a_fault_is_for_good(hexapod, given, cause, asked):
    bench = running(hexapod)
    assert cause in bench.step(**given)
    assert (bench.mode, bench.request) == (Mode.FAULT, asked)
    bench.steps(300)
    assert bench.mode == Mode.FAULT
    assert bench.state["safety"]["stop"]["cause"] == cause
    assert has_stopped(bench.state["safety"][()], bench.state["time"][()])
    assert bench.request == Request.BRAKED


def test_a_fault_counts_more_than_a_stop_and_the_first_stop_more_than_others(hexapod):
    bench = running(hexapod)
    bench.step(cause=Cause.STOP_REQUESTED)
    assert (bench.mode, bench.state["safety"]["stop"]["cause"]) == (Mode.STOPPING, Cause.STOP_REQUESTED)
    assert bench.step(cause=1) == []
    bench.step(drive=[DriveState.FAULTY] * 6)
    assert (bench.mode, bench.state["safety"]["stop"]["cause"]) == (Mode.FAULT, Cause.DRIVE_FAULT)


def test_a_controlled_stop_ends_on_the_brakes(hexapod):
    bench = running(hexapod)
    bench.step(cause=Cause.STOP_REQUESTED)
    for _ in range(500):
        if has_stopped(bench.state["safety"][()], bench.state["time"][()]):
            break
        bench.step()
    assert (bench.mode, bench.request) == (Mode.STOPPED, Request.BRAKED)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.data())
def test_whatever_drives_and_bus_say_nothing_moves_but_as_specified(hexapod, data):
    bench = Bench(hexapod)
    limits, period = hexapod.limits, 1.0 / RATE_HZ
    drives = st.lists(
        st.sampled_from(
            [DriveState.FOLLOWING] * 8
            + [DriveState.READY, DriveState.NOT_READY, DriveState.QUICK_STOPPING, DriveState.FAULTY, 77]
        ),
        min_size=6,
        max_size=6,
    )
    mode, command = Mode.IDLE, np.zeros(6)
    for _ in range(data.draw(st.integers(1, 12))):
        given = {
            "drive": data.draw(drives),
            "silent": data.draw(st.integers(0, 30)),
            "age": np.array(data.draw(st.lists(st.integers(0, 20), min_size=7, max_size=7))),
            "cause": data.draw(
                st.one_of(st.none(), st.sampled_from([Cause.STOP_REQUESTED, Cause.EMERGENCY_STOP, Cause.BUS_LOST]))
            ),
        }
        for _ in range(data.draw(st.integers(1, 80))):
            bench.step(**given)
            given["cause"] = None
            now = bench.state["pid"]["command"].copy()
            assert np.isfinite(now).all() and np.abs(now).max() <= bench.parameters["pid"]["limit"]
            if bench.mode in (Mode.IDLE, Mode.ARMED):
                assert (now == 0.0).all()
            if mode == Mode.FAULT:
                # For good, and to rest at the limit of acceleration.
                assert bench.mode == Mode.FAULT
                assert np.abs(now - command).max() <= limits.acceleration * period * (1.0 + 1e-9)
                assert (np.abs(now) <= np.abs(command)).all()
            if bench.mode == Mode.RUNNING:
                assert bench.request == Request.ENABLED
            mode, command = bench.mode, now


def test_every_cause_reads_well():
    for cause in Cause:
        assert cause.describe(3, np.nan, np.nan) == cause.text.format(3)
    assert Cause.BUS_LOST.describe(-1, 21.0, 20.0).endswith("(21 cycles, the limit is 20 cycles)")
    assert Cause.NONE == 0


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
