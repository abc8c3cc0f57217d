"""The loop around the cycle on a scripted clock: its records, late wake-ups, long work, missed periods and stops."""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from controller.cycle import MARKS, STATE, prepare_next, skip_periods
from controller.estimation.integrity.hypotheses import HYPOTHESES, imu_of
from controller.inverse_kinematics import leg_lengths
from controller.planning.plan_handover import STREAM, TAKEN, publish_plan
from controller.planning.stream_planner import StreamPlanner
from controller.safety.causes import Cause
from hil.loop.compiled_loop import run_loop
from hil.loop.driver import FmuRig, Loop
from hil.loop.records import RECORD, STAGES, Link
from hil.realtime.clock import REAL, SCRIPTED, new_clock
from hil.recording.replay import COMPARED, _replay
from hil.runs.config import SimulationConfig
from hil.runs.prepare import prepared_loop
from plant.compiled.linking import flat_linking
from plant.compiled.shared import described
from plant.dynamics.variables import BRAKE
from plant.imu import imu_state, load_imu
from plant.truth import TRUTH_LENGTHS
from tests.controller.cycles import cycle

MS = 1_000_000
CONFIG = SimulationConfig(target="sines", duration=2.0)
SENSORS = ("angular_velocity", "specific_force", "magnetic_field")
FOUND = {"position": "pose", "rotation": "pose", "lengths": "pose", "command": "pid", "conditioning": "pose"}
"""What a cycle finds, and the stage whose state keeps it."""


def scripted(loop, late=(), work=(), cpu=(), cycles=5000):
    """Put a loop on a scripted clock; dicts from cycle number to ns say which cycles are late or work long."""
    loop.script = np.zeros((cycles, 3), np.int64)
    loop.script[:, 1:] = 100_000
    for column, values in enumerate((late, work, cpu)):
        for index, value in dict(values).items():
            loop.script[index, column] = value
    loop.clock = new_clock(SCRIPTED, MS)
    return loop


def missed_now_and_then(seed, share=0.06, most=5, cycles=5000):
    """Lateness [ns] by cycle: a busy machine that misses up to some periods in a row, now and then."""
    random = np.random.default_rng(seed)
    late = np.flatnonzero(random.random(cycles) < share)
    return dict(zip(late.tolist(), (random.integers(1, most + 1, len(late)) * MS).tolist(), strict=True))


def written(loop):
    return loop.records[: int(loop.link[Link.HEAD])]


def replayed(loop, records):
    """Run the cycle again on the raw data of records; returns records with what it finds."""
    state, measurement = np.zeros((), STATE), np.zeros((3, 7, 3))
    found = np.zeros_like(records)
    for record, again in zip(records, found, strict=True):
        skip_periods(state, int(record["missed"]))
        for i, name in enumerate(SENSORS):
            measurement[i] = record[name]
        assert cycle(loop.parameters, state, measurement, loop.segments) == Cause.NONE
        for name, stage in FOUND.items():
            again[name] = state[stage][name]
        prepare_next(loop.parameters, state, loop.segments)
    return found


def test_the_stages_that_are_timed_are_the_cycle():
    with prepared_loop(CONFIG) as loop:
        assert loop.run(1500) == Cause.NONE
        found = replayed(loop, written(loop))
        for name in FOUND:
            np.testing.assert_array_equal(found[name], written(loop)[name])
        assert (written(loop)["stage_ns"] >= 0).all()
        assert (np.median(written(loop)["stage_ns"], axis=0) > 0).all()
        assert len(STAGES) == written(loop)["stage_ns"].shape[1]


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["compiled", "whole"])
def test_missed_periods_hardly_raise_the_protection_level(fusion):
    """The evidence lasts over missed periods: beginning anew after each would raise the level fivefold at times."""
    levels = []
    ends = np.cumsum(np.random.default_rng(4).integers(200, 1100, 9)).tolist()
    for late in ({}, {end: (1 + k % 5) * MS for k, end in enumerate(ends)}):
        with prepared_loop(replace(CONFIG, duration=8.0, fusion=fusion)) as loop:
            assert scripted(loop, late, cycles=10_000).run(8000) == Cause.NONE
            records = written(loop)
        assert np.count_nonzero(records["missed"]) == len(late)
        settled = records[3000:]
        error = np.linalg.norm(settled["position"] - settled["truth"][:, :3], axis=1)
        assert (error < settled["protection"][:, 0]).all()
        levels.append(settled["protection"].max(axis=0))
    assert (levels[1] < 1.3 * levels[0]).all()


@pytest.mark.parametrize(("missed", "waits"), [(5, 0), (50, 99)])
def test_after_many_missed_periods_evidence_waits_until_the_pose_is_corrected(missed, waits):
    with prepared_loop(CONFIG) as loop:
        loop.most_missed = 1000
        scripted(loop, {1000: missed * MS})
        while not (seen := written(loop))["missed"].any():
            assert loop.run(int(seen["cycle"][-1]) + 2 if len(seen) else 1000) == Cause.NONE
        integrity = loop.state["integrity"]
        before = int(integrity["filter"]["windows"])
        assert integrity["waits"] == waits and (before > 50) == (waits == 0)
        assert loop.run(int(seen["cycle"][-1]) + 151) == Cause.NONE
        assert integrity["waits"] == 0
        assert integrity["filter"]["windows"] == pytest.approx((150 - waits) / 10 + before * (waits == 0), abs=1)


def steps_until(loop, condition, cycle):
    """Run cycle by cycle from this one until a condition of the integrity stage's state holds; returns the cycle."""
    while not condition(loop.state["integrity"]):
        cycle += 1
        assert cycle < 1900
        assert loop.run(cycle) == Cause.NONE
    return cycle


@pytest.mark.parametrize(("late", "windows"), [({1000: 50 * MS}, 16), ({1000 + 7 * k: 6 * MS for k in range(4)}, 7)])
def test_evidence_that_begins_anew_waits_longer_after_a_stall_than_after_short_gaps(late, windows):
    with prepared_loop(CONFIG) as loop:
        loop.most_missed = 1000
        scripted(loop, late)
        at = steps_until(loop, lambda s: s["waits"] > 0, 990)
        at = steps_until(loop, lambda s: s["waits"] == 0 and s["filter"]["windows"] == 1, at)
        steps_until(loop, lambda s: s["step"] > 0, at)
        assert loop.state["integrity"]["filter"]["windows"] == windows
        assert loop.state["integrity"]["stalled"] == 0


def test_a_stall_during_an_evaluation_is_not_forgotten_when_that_ends():
    """A stall of two windows is bridged, and the evaluation goes on. The next new beginning still has to wait."""
    with prepared_loop(CONFIG) as loop:
        loop.most_missed = 1000
        scripted(loop)
        at = steps_until(loop, lambda s: s["evaluations"] > 5 and s["step"] == 0, 990)
        at = steps_until(loop, lambda s: s["step"] > 0, at)
        loop.script[at + 1, 0] = 20 * MS
        at = steps_until(loop, lambda s: s["stalled"] == 1, at)
        assert loop.state["integrity"]["waits"] == 0 and loop.state["integrity"]["step"] > 0
        at = steps_until(loop, lambda s: s["fresh"] == 1, at)
        assert loop.state["integrity"]["stalled"] == 1
        steps_until(loop, lambda s: s["step"] > 0, at)
        assert loop.state["integrity"]["stalled"] == 0


def test_evidence_from_before_parity_has_left_out_an_imu_is_not_judged():
    """A gap of two periods lets a window end with an evaluation, in which something speaks against another IMU."""
    with prepared_loop(CONFIG) as loop:
        begin = steps_until(scripted(loop), lambda s: s["evaluations"] > 5 and s["step"] == 0, 990)
        begin = steps_until(loop, lambda s: s["step"] > 0, begin)
        at = 1e-3 * (begin + 76 - int(loop.parameters["rig"]["hold_cycles"]))
    with prepared_loop(replace(CONFIG, faults=(f"imu-offset:2,axis=z,size_deg_per_s=20,at={at:.3f}",))) as loop:
        scripted(loop, {begin + 8: 2 * MS})
        assert loop.run(begin + 90) == Cause.NONE
        integrity = loop.state["integrity"]
        integrity["found"][np.array([imu_of(h) for h in range(HYPOTHESES)]) == 4] = 1e4
        assert loop.run(begin + 91) == Cause.NONE
        assert integrity["contradicts"] == 1 and integrity["fresh"] == 1 and integrity["best_evidence"] == 1e4
        assert loop.state["safety"]["stop"]["cause"] == Cause.NONE
        assert loop.state["imus"]["excluded"].tolist() == [0, 0, 1, 0, 0, 0, 0]


def test_the_level_rises_as_soon_as_the_evidence_begins_anew():
    with prepared_loop(CONFIG) as loop:
        loop.most_missed = 1000
        assert scripted(loop, {1500: 50 * MS}).run(1600) == Cause.NONE
        records = written(loop)
    after = int(np.argmax(records["missed"] > 0))
    before, then = records["protection"][after - 1], records["protection"][after]
    assert (then > 1.05 * before).all() and (then < 2.0 * before).all()


@pytest.mark.parametrize(("seed", "stall"), [(0, 702), (0, 640), (4, 680), (21, 600), (22, 760)])
def test_after_a_stall_in_the_first_second_sound_imus_do_not_look_wrong(seed, stall):
    """The filters still learn then, and the loop corrects to and fro: with few windows that was evidence of 9.7 sigma."""
    with prepared_loop(replace(CONFIG, target="circle", seed=seed)) as loop:
        loop.most_missed = 1000
        scripted(loop, {stall: 35 * MS})
        most = 0.0
        for end in range(stall + 60, stall + 700, 20):
            assert loop.run(end) == Cause.NONE
            most = max(most, float(loop.state["integrity"]["best_evidence"]))
        assert loop.state["safety"]["stop"]["cause"] == Cause.NONE
        assert int(loop.state["integrity"]["evaluations"]) > stall // 100
        assert most < 6.0**2


def test_a_level_that_is_recorded_is_one():
    """Even in the cycle that completes the first evaluation."""
    with prepared_loop(CONFIG) as loop:
        assert loop.run(400) == Cause.NONE
        levels = written(loop)["protection"]
    known = ~np.isnan(levels)
    assert 100 < np.argmax(known[:, 0]) < 200 and known[200:].all()
    assert (levels[known] > 1e-4).all()


def test_without_disturbance_a_clock_changes_nothing():
    with prepared_loop(CONFIG) as free, prepared_loop(CONFIG) as timed:
        free.run(1000)
        scripted(timed).run(1000)
        for name in (*SENSORS, *FOUND, "truth", "reference", "missed", "time_ns"):
            np.testing.assert_array_equal(written(timed)[name], written(free)[name])
        assert (written(timed)["late_ns"] == 0).all()
        assert (written(timed)["cpu_ns"] == 100_000).all()
        assert free.state.tobytes() == timed.state.tobytes()


def test_a_wake_up_late_by_less_than_a_period_misses_nothing():
    with prepared_loop(CONFIG) as loop:
        scripted(loop, late={10: 999_999, 500: 300_000}).run(1000)
        records = written(loop)
        assert records["late_ns"][10] == 999_999
        # A late cycle ends late; the next one is on time unless it had to wait.
        assert records["late_ns"][11] == 0 or records["missed"][11] > 0
        assert records["late_ns"][500] == 300_000 and records["late_ns"][501] == 0
        assert loop.clock["missed_late"] == 0


@pytest.mark.parametrize("periods", [1, 3, 8])
def test_a_late_wake_up_skips_whole_periods_and_keeps_the_phase(periods):
    with prepared_loop(CONFIG) as loop:
        scripted(loop, late={400: periods * MS + 200_000}).run(1500)
        records = written(loop)
        assert records["cycle"].tolist() == [*range(400), *range(400 + periods, 1500)]
        assert records["missed"][400] == periods and records["missed"].sum() == periods
        assert records["late_ns"][400] == periods * MS + 200_000
        expected = records["cycle"] * MS
        expected[400] += 200_000
        np.testing.assert_array_equal(records["time_ns"], expected)
        clock = loop.clock
        assert (clock["missed_late"], clock["missed_own"], clock["missed_host"]) == (periods, 0, 0)
        # The reference and the plant follow the time that has passed, and the estimate follows the plant.
        on_time = np.isin(np.arange(1500), records["cycle"])
        with prepared_loop(CONFIG) as undisturbed:
            undisturbed.run(1500)
            np.testing.assert_array_equal(records["reference"], written(undisturbed)["reference"][on_time])
        errors = np.linalg.norm(records["position"] - records["truth"][:, :3], axis=1)
        assert errors[401:].max() < 2e-3
        found = replayed(loop, records)
        np.testing.assert_array_equal(found["command"], records["command"])


@pytest.mark.parametrize("fusion", ["compiled", "whole"])
def test_a_stream_that_is_followed_over_missed_periods_replays_bit_for_bit(fusion):
    """The plans are not recorded: the recorded references must be all that the cycle has taken from them."""
    with prepared_loop(replace(CONFIG, target="stream", fusion=fusion)) as loop:
        home, began = loop.segments.copy(), 0.3
        scripted(loop, late={100: 2 * MS + 5, 480: 3 * MS + 9, 620: MS + 1, 900: 8 * MS + 3})
        loop.stream = np.zeros((), STREAM)
        planner = StreamPlanner(loop.mechanism, leg_lengths(loop.mechanism, loop.target.start.position, np.eye(3)))
        for k in range(60):
            planner.add(0.01 * k, [0.004 * np.sin(0.1 * k), 0.0, 0.003 * (1.0 - np.cos(0.1 * k))], [1.0, 0.0, 0.0, 0.0])
            at = began + 0.01 * k
            loop.run(loop.cycle_at(at))
            if (plan := planner.plan(at + 0.02, 0.01 * k)) is not None:
                publish_plan(loop.stream, plan.segments, plan.begin, int(loop.stream["shared"][TAKEN]))
                loop.run(loop.cycle_at(at) + 3)
                planner.follow(plan)
        records = written(loop)
        moved = np.ptp(records["reference"][:, :6, 0], axis=0).max()
        assert moved > 2e-3 and records["missed"].sum() == 14 and loop.stream["shared"][TAKEN] > 10
        again, marks = np.zeros_like(records), np.zeros((), MARKS)[()]
        assert _replay(loop.parameters, np.zeros((), STATE), home, records, again, marks, True) == len(records)
        for name in COMPARED:
            np.testing.assert_array_equal(again[name], records[name], err_msg=name)


def test_long_work_of_our_own_is_told_from_work_that_the_host_held_up():
    with prepared_loop(CONFIG) as loop:
        scripted(loop, work={300: 1_500_000, 600: 4_200_000}, cpu={300: 1_400_000, 600: 150_000}).run(1200)
        records = written(loop)
        assert records["cycle"].tolist() == [*range(301), *range(302, 602), *range(606, 1200)]
        assert records["missed"][301] == 1 and records["missed"].sum() == 5
        assert (records["late_ns"] == 0).all()
        clock = loop.clock
        assert (clock["missed_late"], clock["missed_own"], clock["missed_host"]) == (0, 1, 4)
        assert records["cpu_ns"][300] == 1_400_000


def test_work_that_lasts_just_a_period_misses_none():
    with prepared_loop(CONFIG) as loop:
        scripted(loop, work={300: MS, 301: MS + 1}, cpu={301: MS + 1}).run(600)
        assert written(loop)["missed"].nonzero()[0].tolist() == [302]
        assert loop.clock["missed_own"] == 1


def test_a_late_start_sets_the_phase_and_misses_nothing():
    with prepared_loop(CONFIG) as loop:
        scripted(loop, late={0: 7 * MS + 300_000}).run(500)
        records = written(loop)
        assert records["cycle"].tolist() == list(range(500))
        assert records["missed"].sum() == 0
        assert records["time_ns"][:2].tolist() == [300_000, MS]


def follow(loop, seconds=2.0):
    loop.records = np.concatenate([loop.records, np.zeros(1000, RECORD)])
    end = round(seconds * 1000) + int(loop.parameters["rig"]["hold_cycles"])
    return loop.follow(end), written(loop)


def stops_within_limits(loop, records, off=1e-3):
    """The reference starts where the mechanism is and comes to rest within its limits; the drives follow it."""
    limits = loop.mechanism.require_limits()
    stopping = records[records["stop"] > 0]
    reference = stopping["reference"]
    assert np.abs(reference[:, :, 1]).max() <= limits.velocity * (1.0 + 1e-9)
    assert np.abs(reference[:, :, 2]).max() <= limits.acceleration * (1.0 + 1e-9)
    assert (reference[:, :, 0] >= limits.stroke[:, 0]).all() and (reference[:, :, 0] <= limits.stroke[:, 1]).all()
    assert np.abs(reference[0, :, 0] - stopping["truth"][0, TRUTH_LENGTHS]).max() < off
    assert (reference[-1, :, 1:] == 0.0).all()
    lengths = stopping["truth"][:, TRUTH_LENGTHS]
    assert np.abs(lengths[-1] - reference[-1, :, 0]).max() < off
    assert np.abs(lengths[-1] - lengths[-10]).max() < 0.15 * off


def test_the_end_of_a_motion_is_a_stop_within_the_limits_and_the_brakes():
    with prepared_loop(CONFIG) as loop:
        cause, records = follow(scripted(loop), 1.234)
        assert cause == loop.state["safety"]["stop"]["cause"] == Cause.END_OF_MOTION
        assert records["stop"].nonzero()[0][0] == 1234 + loop.parameters["rig"]["hold_cycles"] + loop.delay
        stops_within_limits(loop, records)
        assert (loop.fmu["mode"] == BRAKE).all()


def test_too_many_missed_in_a_row_end_in_a_controlled_stop_and_fewer_do_not():
    for periods, stops in ((9, False), (10, True), (400, True)):
        with prepared_loop(CONFIG) as loop:
            cause, records = follow(scripted(loop, late={900: periods * MS}))
            assert cause == (Cause.MISSED_PERIODS if stops else Cause.END_OF_MOTION)
            # In a long pause the drives keep their last command, and then have some way back.
            stops_within_limits(loop, records, off=1e-3 if periods < 100 else 2e-2)
            if stops:
                assert records["cycle"][-1] < 900 + periods + 500
                if periods < 100:
                    assert np.abs(records["command"][900] - records["command"][899]).max() < 0.1


def test_work_that_is_always_too_long_ends_in_a_controlled_stop():
    with prepared_loop(CONFIG) as loop:
        loop.most_missed = 25
        work = dict.fromkeys(range(800, 5000), 1_200_000)
        cause, records = follow(scripted(loop, work=work, cpu=work))
        assert cause == Cause.MISSED_PERIODS
        assert records["stop"].nonzero()[0][0] == 825
        assert loop.clock["most_in_a_row"] >= 25
        stops_within_limits(loop, records)


def test_asked_to_stop_it_does_in_motion_at_once_and_in_the_hold_without_moving():
    with prepared_loop(CONFIG) as loop:
        scripted(loop).run(1000)
        loop.link[Link.STOP] = 1
        cause, records = follow(loop)
        assert cause == Cause.STOP_REQUESTED
        assert records["stop"].nonzero()[0][0] == 1000
        stops_within_limits(loop, records)
    with prepared_loop(CONFIG) as loop:
        scripted(loop).run(100)
        loop.link[Link.STOP] = 1
        cause, records = follow(loop)
        assert cause == Cause.STOP_REQUESTED
        assert len(records) == 100
        assert (records["command"] == 0.0).all()


def test_records_go_round_and_the_head_goes_on():
    with prepared_loop(CONFIG) as loop, prepared_loop(CONFIG) as whole:
        loop.records = loop.records[:128].copy()
        loop.run(1000)
        whole.run(1000)
        assert loop.link[Link.HEAD] == 1000
        for k in range(872, 1000):
            assert loop.records[k % 128]["cycle"] == k
            np.testing.assert_array_equal(loop.records[k % 128]["command"], whole.records[k]["command"])


def test_a_rig_in_python_runs_the_same_cycle_at_the_same_times():
    late, work = {300: 2_500_000}, {500: 1_700_000}
    with prepared_loop(CONFIG) as compiled, prepared_loop(CONFIG) as python:
        for loop in (compiled, python):
            scripted(loop, late=late, work=work)
        end = 1000
        assert compiled.follow(end) == Cause.END_OF_MOTION
        assert python.follow(end, FmuRig(python)) == Cause.END_OF_MOTION
        assert compiled.link[Link.HEAD] == python.link[Link.HEAD]
        first, second = written(compiled), written(python)
        for name in set(first.dtype.names) - {"stage_ns"}:
            np.testing.assert_array_equal(first[name], second[name])
        assert compiled.state.tobytes() == python.state.tobytes()


def test_a_clock_on_the_machine_wakes_at_every_deadline():
    with prepared_loop(SimulationConfig(target="hold", duration=0.5, rate=250.0)) as loop:
        loop.clock = new_clock(REAL, 4 * MS)
        loop.most_missed = 1000
        loop.records = np.zeros(2000, RECORD)
        assert loop.follow(175) == Cause.END_OF_MOTION
        records = written(loop)
        assert (np.diff(records["cycle"]) == 1 + records["missed"][1:]).all()
        assert (records["late_ns"] >= 0).all()
        deadlines = records["time_ns"] - records["late_ns"] % (4 * MS)
        np.testing.assert_array_equal(deadlines, 4 * MS * records["cycle"])
        assert (records["cpu_ns"] > 0).all()
        assert loop.clock["missed_own"] == 0


def test_loops_of_other_imus_record_what_the_cycle_was_given():
    with prepared_loop(SimulationConfig(target="circle", duration=1.0, imus=(0, 1, 3, 4))) as loop:
        assert isinstance(loop, Loop)
        loop.imu[()] = imu_state(load_imu("ideal"), 0, 1e-3)
        loop.run(600)
        records = written(loop)
        assert np.isnan(records["residuals"][:, [2, 5]]).all()
        assert np.isfinite(records["residuals"][:, [0, 1, 3, 4]]).all()
        found = replayed(loop, records)
        np.testing.assert_array_equal(found["position"], records["position"])


@pytest.mark.parametrize(
    ("fusion", "seed"),
    [
        ("compiled", 2),
        ("whole", 4),
        *(pytest.param(fusion, seed, marks=pytest.mark.slow) for fusion in ("compiled", "whole") for seed in range(200, 206)),
    ],
)
def test_a_machine_that_misses_periods_now_and_then_is_no_contradiction(fusion, seed):
    """The drives catch up after each of about a hundred gaps, with a motion that no plan has: this is no fault."""
    with prepared_loop(replace(CONFIG, fusion=fusion, seed=seed)) as loop:
        loop.most_missed = 1000
        assert scripted(loop, missed_now_and_then(seed)).run(2200) == Cause.NONE
        records = written(loop)
        assert records["missed"].sum() > 200
        assert not np.isin(records["event_cause"], (Cause.IMUS_CONTRADICT, Cause.IMU_CONTRADICTED)).any()


def test_recorded_covariance_is_that_of_the_errors_at_rest():
    with prepared_loop(SimulationConfig(target="hold", duration=1.0, imu="ideal")) as loop:
        loop.run(800)
        covariance = written(loop)["covariance"][-1].astype(float)
        np.testing.assert_array_equal(covariance, covariance.T)
        expected = np.linalg.inv(np.tril(loop.state["pose"]["information"]) + np.tril(loop.state["pose"]["information"], -1).T)
        np.testing.assert_allclose(covariance, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_the_loops_shared_kernels_are_what_their_callers_in_other_processes_expect():
    """Each has the name in machine code, and the types, that follow from its declaration."""
    with prepared_loop(CONFIG), flat_linking():
        to_do, seen = [*run_loop.overloads.values()], set()
        while to_do:
            for module, name, arguments in to_do.pop().library.calls:
                dispatcher = getattr(import_module(module), name)
                compiled, expected = dispatcher.overloads[arguments], described(dispatcher, arguments)
                for each in ("mangled_name", "restype", "argtypes", "args"):
                    assert getattr(compiled.fndesc, each) == getattr(expected, each), name
                seen.add(name)
                to_do.append(compiled)
    assert {"run_stages", "exchange_fmu", "step_integrity", "step_mechanism_filter"} <= seen
