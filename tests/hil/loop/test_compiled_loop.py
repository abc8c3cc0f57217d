"""What the loop begins a cycle with, notes of an exchange with the rig, and records."""

import os
import signal
import threading

import numpy as np
import pytest

from controller.cycle import STATE, cycle_parameters, skip_periods
from controller.safety.causes import Cause, Mode, Request
from controller.settings import control_settings, fusion_settings
from hil.loop.compiled_loop import begin_cycle, end_cycle, periods_passed, process_feedback
from hil.loop.driver import FmuRig
from hil.loop.records import STAGES, WORK, Link, Stage, StopRequest
from hil.realtime.clock import REAL, SCRIPTED, new_clock
from hil.rigs import ANSWERED, SILENT, new_feedback
from hil.runs.config import SimulationConfig
from hil.runs.prepare import prepared_loop
from plant.dynamics.variables import BRAKE, VELOCITY
from plant.truth import TRUTH_LENGTHS


@pytest.mark.parametrize("seed", range(3))
def test_samples_and_silence_age_by_the_periods_that_pass_missed_ones_too(hexapod, seed):
    """Against the times of the last new sample and of the last answer."""
    random = np.random.default_rng(seed)
    parameters = cycle_parameters(hexapod, 500.0, control_settings(hexapod), fusion_settings(hexapod))
    state, work = np.zeros((), STATE), np.zeros((), WORK)
    work["feedback"], work["sequence"] = new_feedback(), -1
    renewed, answered = np.zeros(7, np.int64), 0
    for cycle in range(200):
        missed = int(random.choice([0, 0, 1, 7])) if cycle else 0
        skip_periods(state, missed)
        now = int(state["time"]["cycle"])
        new = (random.random(7) < 0.3) | (cycle == 0)
        status = ANSWERED if random.random() < 0.7 or cycle == 0 else SILENT
        work["feedback"]["sequence"] += new
        renewed[new], answered = now, now if status == ANSWERED else answered
        assert process_feedback(parameters, state, work, status) == Cause.NONE
        np.testing.assert_array_equal(work["sample_age"], now - renewed)
        np.testing.assert_array_equal(state["imus"]["sample_age"], now - renewed)
        assert work["silent"] == state["safety"]["watch"]["silent"] == now - answered
        state["time"]["cycle"] += 1


# ----------------------------------------------------------------------------------------------------- what a cycle begins with


@pytest.fixture
def loop():
    """A loop in motion, in cycle 700, on a scripted clock that is on time."""
    with prepared_loop(SimulationConfig(target="hold", duration=2.0)) as loop:
        loop.clock = new_clock(SCRIPTED, 1_000_000)
        loop.state["time"]["cycle"] = 700
        safety = loop.state["safety"]
        safety["mode"], safety["request"] = Mode.RUNNING, Request.ENABLED
        safety["arming"]["delay"] = 30
        loop.work = loop.memory()["work"]
        yield loop


def begin(loop, most_missed=10, end=10_000, streamed=None):
    return begin_cycle(loop.parameters, loop.state, loop.clock, loop.script, loop.link, loop.work, streamed, most_missed, end)


def stop_of(loop):
    stop = loop.state["safety"]["stop"]
    return Cause(int(stop["cause"])), int(stop["index"]), float(stop["value"]), float(stop["limit"])


def test_the_motion_ends_when_its_cycles_without_those_of_arming_are_over(loop):
    for end, cause in ((671, Cause.NONE), (670, Cause.END_OF_MOTION)):
        assert begin(loop, end=end) == Cause.NONE
        assert (loop.work["asked"], loop.work["cycle"]) == (cause, 700)
    assert stop_of(loop)[0] == Cause.END_OF_MOTION and loop.state["safety"]["mode"] == Mode.STOPPING


def test_as_many_periods_as_are_too_many_in_a_row_stop_it(loop):
    begin(loop)
    loop.clock["cycles"], loop.clock["overrun"], loop.clock["in_a_row"] = 1, 3, 6
    assert begin(loop, most_missed=10) == Cause.NONE
    assert (loop.clock["in_a_row"], loop.state["time"]["cycle"], loop.state["time"]["missed"]) == (9, 703, 3)
    assert stop_of(loop)[0] == Cause.NONE
    loop.clock["overrun"] = 1
    begin(loop, most_missed=10)
    assert stop_of(loop) == (Cause.MISSED_PERIODS, -1, 10.0, 10.0)
    assert loop.work["asked"] == Cause.MISSED_PERIODS and loop.work["cycle"] == 704


@pytest.mark.parametrize(
    ("asked", "cause", "mode"),
    [
        (StopRequest.CONTROLLED, Cause.STOP_REQUESTED, Mode.STOPPING),
        (StopRequest.QUICK, Cause.EMERGENCY_STOP, Mode.FAULT),
        # The most severe counts; of those that are as severe, the latest.
        ((StopRequest.CONTROLLED, "missed"), Cause.STOP_REQUESTED, Mode.STOPPING),
        ((StopRequest.QUICK, "missed"), Cause.EMERGENCY_STOP, Mode.FAULT),
        ((0, "missed"), Cause.MISSED_PERIODS, Mode.STOPPING),
    ],
)
def test_another_process_may_ask_for_a_stop_of_either_kind(loop, asked, cause, mode):
    asked, *missed = asked if isinstance(asked, tuple) else (asked,)
    begin(loop)
    if missed:
        loop.clock["cycles"], loop.clock["overrun"] = 1, 50
    loop.link[Link.STOP] = asked
    begin(loop)
    assert stop_of(loop)[0] == cause == loop.work["asked"]
    assert loop.state["safety"]["mode"] == mode
    if cause != Cause.MISSED_PERIODS:
        assert np.isnan(stop_of(loop)[2:]).all()


def test_what_was_asked_for_before_is_not_asked_for_again(loop):
    loop.link[Link.STOP] = StopRequest.CONTROLLED
    begin(loop)
    loop.link[Link.STOP] = 0
    loop.work["stage_ns"], loop.work["marks"]["ns"] = 77, 77
    begin(loop)
    assert loop.work["asked"] == Cause.NONE and stop_of(loop)[0] == Cause.STOP_REQUESTED
    assert not loop.work["stage_ns"].any() and not loop.work["marks"]["ns"].any()


def test_when_a_stop_is_over_its_cause_is_returned(loop):
    loop.link[Link.STOP] = StopRequest.CONTROLLED
    begin(loop)
    loop.link[Link.STOP] = 0
    loop.state["time"]["cycle"] = int(loop.state["safety"]["stop"]["end_cycle"]) - 1
    assert begin(loop) == Cause.NONE
    loop.state["time"]["cycle"] += 1
    assert begin(loop) == Cause.STOP_REQUESTED
    assert loop.state["safety"]["request"] == Request.BRAKED


def test_the_plant_moves_by_the_periods_that_have_passed_but_not_before_the_first(loop):
    for cycle, missed, periods in ((0, 0, 0), (1, 0, 1), (9, 4, 5)):
        loop.state["time"]["cycle"], loop.state["time"]["missed"] = cycle, missed
        assert periods_passed(loop.state) == periods


def test_a_rig_that_fails_is_told_with_its_status_and_ends_at_once(loop):
    loop.state["pid"]["command"] = [0.1, -0.1, 0.0, 0.2, -0.2, 0.05]
    assert process_feedback(loop.parameters, loop.state, loop.work, SILENT + 5) == Cause.RIG_FAILED
    cause, index, value, limit = stop_of(loop)
    assert (cause, index, value) == (Cause.RIG_FAILED, -1, SILENT + 5.0) and np.isnan(limit)
    assert loop.state["safety"]["request"] == Request.BRAKED and not loop.state["pid"]["command"].any()
    # No stage runs, so the cycle is counted here.
    assert loop.state["time"]["cycle"] == 701


# ------------------------------------------------------------------------------------------------------------- what is recorded


def test_a_record_holds_what_each_part_has_found_in_its_place(loop):
    begin(loop)
    random, state, work = np.random.default_rng(0), loop.state, loop.work
    feedback, safety = work["feedback"], state["safety"]
    for name in ("measurement", "truth", "sent"):
        feedback[name] = random.normal(size=feedback[name].shape)
    for name in ("sequence", "sample_ns", "drive_code"):
        feedback[name] = random.integers(1, 1000, feedback[name].shape)
    feedback["drive"] = [0, 1, 2, 3, 4, 0]
    feedback["round_trip_ns"], feedback["refused"] = 123_456, 7
    work["sample_age"], work["silent"], work["asked"] = np.arange(7) + 11, 5, Cause.SUPERVISOR_GONE
    for stage, names in {
        "pose": ("position", "rotation", "conditioning", "lengths", "directions"),
        "reference": ("motion",),
        "pid": ("command",),
    }.items():
        for name in names:
            state[stage][name] = random.normal(size=state[stage][name].shape)
    state["legs"]["directions"] = random.normal(size=(6, 3))
    state["legs"]["used"], state["imus"]["used"] = [1, 1, 0, 1, 1, 0], [1, 0, 0, 1, 1, 0, 1]
    state["heading"]["used"], state["mechanism"]["trusted"] = 1, 0
    state["time"]["missed"] = 4
    root = random.normal(size=(6, 6))
    information = root @ root.T + np.eye(6)
    state["pose"]["information"] = information
    state["integrity"]["protection"]["level"], state["integrity"]["evaluations"] = [0.125, 0.25], 1
    loop.clock["late"], loop.clock["start"], loop.clock["woke"] = 4321, 1_000_000, 9_500_000
    events = safety["events"]
    events["count"], events["cause"], events["index"] = 2, np.arange(20, 28), np.arange(8)
    events["value"], events["limit"] = 0.5 * np.arange(8) + 1.0, 2.0 * np.arange(8) + 1.0
    safety["mode"], safety["stop"]["cause"] = Mode.STOPPING, Cause.TOO_FAST
    work["marks"]["ns"] = [1, 20, 300, 4000, 50_000, 600_000, 7_000_000, 80_000_000, 900_000_000, 3]
    work["stage_ns"][Stage.SENSE], work["stage_ns"][Stage.PLANT] = 9, 13
    expected = {
        "cycle": 700, "time_ns": 8_500_000, "late_ns": 4321, "missed": 4, "status": Cause.RIG_FAILED,
        "asked": Cause.SUPERVISOR_GONE, "mode": Mode.STOPPING, "stop": Cause.TOO_FAST, "request": Request.ENABLED, "silent": 5,
        "drive": [0, 1, 2, 3, 4, 0], "drive_code": feedback["drive_code"], "sample_age": np.arange(7) + 11, "imus": 0b11011001,
        "trusted": 0, "sample_ns": feedback["sample_ns"], "round_trip_ns": 123_456, "refused": 7, "sent": feedback["sent"],
        "event_count": 2, "event_cause": [20, 21] + 6 * [0], "event_index": [0, 1] + 6 * [0],
        "event_value": [1.0, 1.5] + 6 * [0.0], "event_limit": [1.0, 3.0] + 6 * [0.0],
        "angular_velocity": feedback["measurement"][0], "specific_force": feedback["measurement"][1],
        "magnetic_field": feedback["measurement"][2], "truth": feedback["truth"], "position": state["pose"]["position"],
        "rotation": state["pose"]["rotation"], "lengths": state["pose"]["lengths"],
        "conditioning": state["pose"]["conditioning"], "reference": state["reference"]["motion"],
        "command": state["pid"]["command"], "protection": [0.125, 0.25],
    }  # fmt: skip
    expected = {name: np.array(value) for name, value in expected.items()}
    off = np.where(state["legs"]["used"][:, None] != 0, state["legs"]["directions"] - state["pose"]["directions"], np.nan)
    loop.link[Link.HEAD] = 5
    end_cycle(
        loop.parameters,
        state,
        loop.segments,
        loop.records,
        loop.clock,
        loop.script,
        loop.link,
        work,
        None,
        int(Cause.RIG_FAILED),
    )
    record = loop.records[5]
    assert loop.link[Link.HEAD] == 6 and loop.link[Link.START] == loop.clock["start"]
    for name, value in expected.items():
        np.testing.assert_array_equal(record[name], value, err_msg=name)
    np.testing.assert_allclose(record["residuals"], off, rtol=1e-6)
    np.testing.assert_allclose(record["covariance"], np.linalg.inv(information), rtol=1e-4, atol=1e-7)
    stages = dict(zip(STAGES, record["stage_ns"].tolist(), strict=True))
    assert stages.pop("record") > 0
    assert stages == {
        "sense": 9, "leg filters": 21, "platform filter": 4300, "direct kinematics": 50_000, "refinement": 600_000,
        "whole mechanism": 7_000_000, "integrity": 80_000_000, "control": 900_000_003, "plant": 13,
    }  # fmt: skip
    # Information that is none has no covariance; a second record goes behind the first.
    state["pose"]["information"] = -np.eye(6)
    state["integrity"]["evaluations"] = 0
    end_cycle(loop.parameters, state, loop.segments, loop.records, loop.clock, loop.script, loop.link, work, None, 0)
    assert np.isnan(loop.records[6]["protection"]).all()
    assert np.isnan(loop.records[6]["covariance"]).all() and loop.records[6]["status"] == 0
    assert loop.records[6]["event_count"] == 0


# ------------------------------------------------------------------------------------------------------ what else may end a run


@pytest.fixture
def real_loop(loop):
    """The loop on this machine's clock, which looks about every 100 ms."""
    loop.clock = new_clock(REAL, 1_000_000)
    return loop


@pytest.mark.parametrize(
    ("number", "cause"),
    [
        (signal.SIGHUP, Cause.STOP_REQUESTED),
        (signal.SIGINT, Cause.STOP_REQUESTED),
        (signal.SIGTERM, Cause.STOP_REQUESTED),
        (signal.SIGQUIT, Cause.EMERGENCY_STOP),
        (signal.SIGUSR1, Cause.NONE),
    ],
)
def test_a_signal_that_waits_asks_for_a_stop(real_loop, number, cause):
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [number])
    try:
        # To this thread: of the others, which a test runner may have, one might not block it.
        signal.pthread_kill(threading.get_ident(), number)
        begin(real_loop, most_missed=10**9)
    finally:
        signal.sigwait([number])
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    assert real_loop.work["asked"] == stop_of(real_loop)[0] == cause


def test_when_the_supervisor_has_gone_the_loop_stops_when_it_looks(real_loop):
    for supervisor, cycles, cause in (
        (0, 0, Cause.NONE), (os.getppid(), 0, Cause.NONE), (2**22 + 5, 99, Cause.NONE), (2**22 + 5, 200, Cause.SUPERVISOR_GONE),
    ):  # fmt: skip
        real_loop.link[Link.SUPERVISOR], real_loop.clock["cycles"] = supervisor, cycles
        begin(real_loop, most_missed=10**9)
        assert real_loop.work["asked"] == stop_of(real_loop)[0] == cause


def test_the_plant_is_given_the_commands_for_the_periods_that_passed_and_says_what_was_sent(loop):
    rig, feedback, command = FmuRig(loop), new_feedback()[()], np.array([0.02, -0.01, 0.015, 0.0, -0.02, 0.01])
    time, lengths = loop.state["time"], []
    for n, (cycle, missed, request, passed_ns) in enumerate(
        [
            (0, 0, Request.BRAKED, 0),
            (1, 2, Request.BRAKED, 3_000_000),
            (2, 0, Request.ENABLED, 4_000_000),
            (3, 299, Request.ENABLED, 304_000_000),
            (4, 0, Request.QUICK_STOP, 305_000_000),
            (5, 0, Request.BRAKED, 306_000_000),
        ]
    ):
        time["cycle"], time["missed"] = cycle, missed
        assert rig.exchange(command, int(request), feedback) == ANSWERED
        np.testing.assert_array_equal(feedback["sent"], 0.0 * command if request == Request.BRAKED else command)
        # The first sample is number 0.
        np.testing.assert_array_equal(feedback["sequence"], n)
        np.testing.assert_array_equal(feedback["sample_ns"], passed_ns)
        assert (loop.fmu["mode"] == (BRAKE if request == Request.BRAKED else VELOCITY)).all()
        lengths.append(feedback["truth"][TRUTH_LENGTHS].copy())
    np.testing.assert_allclose(lengths[1], lengths[0], atol=1e-5)
    # 0.3 s at these speeds, less what it takes to get up to them.
    np.testing.assert_allclose(lengths[3] - lengths[2], 0.3 * command, atol=1.5e-3)


class Failing:
    """A rig that raises in its first exchange, and then again when it is stopped."""

    def __init__(self, error):
        self.error, self.stops = error, 0

    def exchange(self, command, request, feedback):
        raise self.error

    def quick_stop(self):
        self.stops += 1
        raise OSError("no drives")


def test_a_rig_that_raises_is_stopped_and_what_it_raised_is_kept(loop):
    rig = Failing(ValueError("a wire is loose"))
    assert loop.follow(10_000, rig) == Cause.RIG_FAILED
    assert (loop.failure, rig.stops) == ("ValueError: a wire is loose", 1)
    assert loop.records[0]["status"] == Cause.RIG_FAILED


def test_a_rig_is_stopped_before_an_interrupt_goes_on(loop):
    rig = Failing(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        loop.follow(10_000, rig)
    assert rig.stops == 1 and loop.failure == ""
