"""Arming: what is in its way, how long that may last, and what is made of it."""

import numpy as np
import pytest

from controller.cycle import skip_periods
from controller.safety import watch_nothing
from controller.safety.arming import arming_parameters, describe_obstacle
from controller.safety.causes import Cause, DriveState, Mode, Request
from controller.settings import SafetySettings
from tests.controller.leg_geometry import static_signals
from tests.controller.safety.test_safety import RATE_HZ, Bench

ARMING_CYCLES = 2500
"""5 s at 500 Hz."""


def obstacle(bench):
    arming = bench.state["safety"]["arming"]
    return Cause(int(arming["obstacle"])), int(arming["index"]), float(arming["value"]), float(arming["limit"])


def test_arming_takes_whole_cycles():
    p = arming_parameters(SafetySettings(arming_distance=0.02, arming_time=0.5), 333.0, True)
    assert (p["active"], p["distance"], p["cycles"]) == (1, 0.02, 167)
    assert arming_parameters(SafetySettings(), RATE_HZ, False)["active"] == 0


@pytest.mark.parametrize("late", [0, 30])
def test_arming_may_last_its_time_and_missed_periods_count(hexapod, late):
    bench = Bench(hexapod)
    bench.steps(bench.hold + 10, drive=DriveState.NOT_READY)
    skip_periods(bench.state, late)
    bench.step(drive=DriveState.NOT_READY)
    skip_periods(bench.state, 0)
    arming = bench.state["safety"]["arming"]
    assert arming["delay"] == 11 + late
    bench.steps(ARMING_CYCLES - late - 11, drive=DriveState.NOT_READY)
    assert (bench.mode, arming["delay"]) == (Mode.IDLE, ARMING_CYCLES)
    assert obstacle(bench)[:2] == (Cause.NO_DRIVES, 0)
    bench.step(drive=DriveState.NOT_READY)
    assert (bench.mode, bench.state["safety"]["stop"]["cause"]) == (Mode.STOPPING, Cause.NO_DRIVES)


def test_in_its_last_cycle_it_is_still_armed(hexapod):
    bench = Bench(hexapod)
    bench.steps(bench.hold + ARMING_CYCLES, drive=DriveState.NOT_READY)
    bench.step()
    assert (bench.mode, bench.request) == (Mode.RUNNING, Request.ENABLED)
    # The motion begins later by that.
    assert bench.state["safety"]["arming"]["delay"] == ARMING_CYCLES


def test_arming_waits_until_the_imus_have_been_judged(hexapod):
    """Periods are missed so often that hardly any window is full: without an evaluation there is no protection level."""
    bench = Bench(hexapod)
    for _ in range(bench.hold + 20):
        skip_periods(bench.state, 1)
        bench.step()
    assert bench.mode == Mode.IDLE and bench.state["integrity"]["evaluations"] == 0
    assert obstacle(bench)[:2] == (Cause.NOT_JUDGED, -1)
    skip_periods(bench.state, 0)
    while bench.mode == Mode.IDLE:
        bench.step()
    assert (bench.mode, bench.state["integrity"]["evaluations"]) == (Mode.RUNNING, 1)


@pytest.mark.parametrize(
    ("lost", "need_platform", "armed"),
    [((2,), True, True), ((6,), True, False), ((6,), False, True), ((2, 5), True, False), ((0, 6), False, False)],
)
def test_as_many_imus_may_be_lost_as_in_motion(hexapod, lost, need_platform, armed):
    bench = Bench(hexapod)
    if not need_platform:
        bench.parameters["safety"]["watch"]["without_platform_imu"] = np.inf
    bench.signals[:, list(lost)] = np.nan
    bench.steps(bench.hold + 5)
    assert bench.mode == (Mode.RUNNING if armed else Mode.IDLE)
    if not armed:
        cause = Cause.PLATFORM_IMU_LOST if lost == (6,) else Cause.NO_SENSORS
        assert obstacle(bench)[:2] == (cause, lost[-1])
        assert np.isnan(obstacle(bench)[2:]).all()


def test_a_rig_that_does_not_answer_is_waited_for(hexapod):
    bench = Bench(hexapod)
    bench.steps(bench.hold)
    bench.step(silent=2)
    assert (bench.mode, obstacle(bench)) == (Mode.IDLE, (Cause.BUS_LOST, -1, 2.0, 0.0))
    assert describe_obstacle(bench.state) == "the bus is lost: the rig does not answer (2 cycles, the limit is 0 cycles)"
    bench.step()
    assert bench.mode == Mode.RUNNING
    assert describe_obstacle(bench.state) == ""


def test_a_rig_that_missed_many_exchanges_is_armed_only_when_it_has_answered_as_often(hexapod):
    bench, most = Bench(hexapod), 10
    # The bus counts as lost after 20 ms; what was missed before counts twice that at most.
    bench.steps(bench.hold, silent=1)
    bench.steps(2 * most - 1)
    assert (bench.mode, obstacle(bench)) == (Mode.IDLE, (Cause.BUS_LOST, -1, 1.0, 0.0))
    told = bench.steps(3)
    assert told == [Cause.ARMED] and bench.mode == Mode.RUNNING


def test_a_rig_that_answers_now_and_then_is_not_armed(hexapod):
    bench = Bench(hexapod)
    for _ in range(bench.hold + ARMING_CYCLES):
        bench.step(silent=1)
        bench.step(silent=0)
        bench.step(silent=1)
    assert bench.request == Request.BRAKED
    assert bench.state["safety"]["stop"]["cause"] == Cause.BUS_LOST


@pytest.mark.parametrize("to_arm", [True, False])
@pytest.mark.parametrize("lost", ["readings", "agreement"])
def test_without_answers_the_bus_is_blamed_and_no_imu(hexapod, to_arm, lost):
    bench = Bench(hexapod, to_arm=to_arm)
    if lost == "readings":
        bench.signals[:] = np.nan
    bench.steps(bench.hold, silent=1)
    bench.state["safety"]["monitor"]["contradiction"][6] = (0.0, np.nan, 0.0)
    bench.steps(20, silent=1)
    assert (bench.mode, obstacle(bench)[0]) == (Mode.IDLE, Cause.BUS_LOST)


def test_late_answers_do_not_change_the_verdict_of_a_dry_run_for_a_tenth_of_a_second(hexapod):
    bench, few = Bench(hexapod, to_arm=False), round(0.1 * RATE_HZ)
    bench.steps(bench.hold + 1, silent=1)
    assert obstacle(bench)[0] == Cause.BUS_LOST
    bench.steps(2 * bench.hold)
    assert (bench.mode, describe_obstacle(bench.state)) == (Mode.IDLE, "")
    # A stall of the loop takes none of that time.
    skip_periods(bench.state, 2 * few)
    bench.step(silent=1)
    skip_periods(bench.state, 0)
    bench.steps(few - 1, silent=1)
    assert describe_obstacle(bench.state) == ""
    bench.step(silent=1)
    assert obstacle(bench)[0] == Cause.BUS_LOST
    bench.steps(2 * bench.hold)
    assert describe_obstacle(bench.state) == ""
    bench.step(drive=DriveState.NOT_READY)
    assert obstacle(bench)[0] == Cause.NO_DRIVES


@pytest.mark.parametrize("to_arm", [True, False])
@pytest.mark.parametrize(("part", "cause"), [(0, Cause.POSITION_UNSURE), (1, Cause.ROTATION_UNSURE)])
def test_a_level_beyond_its_limit_is_in_the_way(hexapod, to_arm, part, cause):
    bench = Bench(hexapod, to_arm=to_arm)
    limits = bench.parameters["safety"]["watch"]["level"]
    assert np.isinf(limits).all()
    limits[part] = 1e-9
    bench.steps(bench.hold + 50)
    level = float(bench.state["integrity"]["protection"]["level"][part])
    assert bench.mode == Mode.IDLE and level > 1e-6
    assert obstacle(bench) == (cause, -1, level, 1e-9)
    limits[part] = np.inf
    bench.step()
    assert bench.mode == (Mode.RUNNING if to_arm else Mode.IDLE) and describe_obstacle(bench.state) == ""


def test_an_imu_that_contradicts_the_others_is_in_the_way(hexapod):
    bench = Bench(hexapod)
    bench.steps(bench.hold - 1)
    limit = float(bench.parameters["safety"]["monitor"]["disagreement"])
    # What is found of one at rest fades slowly.
    bench.parameters["safety"]["monitor"]["smoothing"] = 1e-9
    for off, mode in ((1.01 * limit, Mode.IDLE), (0.99 * limit, Mode.RUNNING)):
        bench.state["safety"]["monitor"]["contradiction"][4] = (0.0, -off, 0.0)
        bench.steps(2)
        assert bench.mode == mode
        if mode == Mode.IDLE:
            assert obstacle(bench) == (Cause.NO_SENSORS, 4, pytest.approx(off, rel=1e-6), limit)


def without_pose(bench):
    """Only two legs' IMUs and the platform's are left, which determine no pose."""
    kept = bench.signals.copy()
    bench.signals[:, [0, 1, 2, 3]] = np.nan
    return kept


def test_a_pose_that_is_lost_before_arming_is_waited_for(hexapod):
    bench = Bench(hexapod)
    kept = without_pose(bench)
    bench.steps(bench.hold + 100)
    assert (bench.mode, obstacle(bench)[:2]) == (Mode.IDLE, (Cause.POSE_LOST, -1))
    bench.signals[:] = kept
    # The filters settle for 0.1 s, and the estimate stands still for another.
    bench.steps(99)
    assert (bench.mode, obstacle(bench)[0]) == (Mode.IDLE, Cause.NOT_STILL)
    # Then the IMUs are judged.
    bench.steps(20)
    assert (bench.mode, obstacle(bench)[0]) == (Mode.IDLE, Cause.NOT_JUDGED)
    bench.steps(60)
    assert bench.mode == Mode.RUNNING and bench.state["integrity"]["evaluations"] > 0


def test_a_pose_that_stays_lost_is_a_fault_when_the_time_is_over(hexapod):
    bench = Bench(hexapod)
    without_pose(bench)
    bench.steps(bench.hold + ARMING_CYCLES)
    assert bench.mode == Mode.IDLE
    assert Cause.POSE_LOST in bench.step()
    assert (bench.mode, bench.request) == (Mode.FAULT, Request.BRAKED)
    dry = Bench(hexapod, to_arm=False)
    without_pose(dry)
    dry.steps(dry.hold + 2 * ARMING_CYCLES)
    assert (dry.mode, obstacle(dry)[0]) == (Mode.IDLE, Cause.POSE_LOST)


def test_a_pose_that_is_lost_between_armed_and_running_is_a_fault_at_once(hexapod):
    bench = Bench(hexapod)
    bench.steps(bench.hold + 5, drive=DriveState.READY)
    assert bench.mode == Mode.ARMED
    without_pose(bench)
    bench.step(drive=DriveState.READY)
    assert (bench.mode, bench.state["safety"]["stop"]["cause"]) == (Mode.FAULT, Cause.POSE_LOST)


def test_evidence_is_told_in_the_cycle_of_its_evaluation_alone(hexapod):
    """A pose that is lost in the next cycle must not have it told again."""
    bench = Bench(hexapod)
    bench.steps(bench.hold + 5)
    assert bench.mode == Mode.RUNNING
    integrity = bench.state["integrity"]
    integrity["fresh"], integrity["blamed"], integrity["rival_evidence"] = 1, 3, 0.0
    integrity["best_evidence"] = integrity["imu_evidence"] = integrity["all_evidence"] = 1e4
    without_pose(bench)
    told = bench.step()
    assert Cause.POSE_LOST in told and Cause.IMU_CONTRADICTED not in told


@pytest.mark.parametrize("blamed", [-1, 6])
def test_evidence_below_its_limit_that_lasts_prevents_arming(hexapod, blamed):
    """It would end the run at once."""
    bench = Bench(hexapod)
    bench.steps(bench.hold - 1)
    lasting = bench.state["safety"]["attribution"]["lasting"]
    lasting[:] = 25.0, 24.0
    bench.state["safety"]["attribution"]["lasting_imu"] = blamed
    bench.steps(2)
    assert bench.mode == Mode.IDLE
    cause = Cause.NO_TRUST if blamed < 0 else Cause.NO_SENSORS
    assert obstacle(bench) == (cause, blamed, 5.0, np.sqrt(24.0))
    lasting[:] = 0.0
    bench.steps(2)
    assert bench.mode == Mode.RUNNING


@pytest.mark.parametrize("blamed", [-1, 3])
@pytest.mark.parametrize("kind", [0, 1])
def test_evidence_of_either_kind_prevents_arming(hexapod, kind, blamed):
    """That of the last half second, and that of all that was learned; the other evaluations are silent meanwhile."""
    bench = Bench(hexapod)
    bench.steps(bench.hold - 1)
    limit = float(bench.parameters["safety"]["watch"]["evidence"])
    arming = bench.state["safety"]["arming"]
    for size, armed in ((1.01, False), (0.99, True)):
        arming["evidence"][kind], arming["blamed"][kind], arming["most_evidence"][kind] = size * limit, blamed, limit
        bench.step()
        bench.step()
        assert (bench.mode == Mode.RUNNING) == armed
        if not armed:
            cause = Cause.NO_TRUST if blamed < 0 else Cause.NO_SENSORS
            assert obstacle(bench) == (cause, blamed, pytest.approx(np.sqrt(size * limit)), np.sqrt(limit))


@pytest.mark.parametrize(("factor", "armed"), [(1.01, True), (0.99, False)])
def test_an_estimate_that_drifts_on_the_brakes_is_not_armed(hexapod, factor, armed):
    """A platform that sinks; the limit is around what the means of the lengths over 50 ms change by, from one to the next."""
    bench, home, lengths = Bench(hexapod), hexapod.home, []
    # Its platform's IMU reads the same for ever.
    bench.parameters["safety"]["watch"]["without_platform_imu"] = np.inf
    window = int(bench.parameters["safety"]["arming"]["window"])
    assert window == 0.05 * RATE_HZ
    for number in range(bench.hold):
        bench.signals[:] = static_signals(hexapod, home.position - [0.0, 0.0, 3e-5 * number], home.rotation)
        bench.step()
        lengths.append(bench.state["pose"]["lengths"].copy())
    means = np.mean(np.reshape(lengths, (-1, window, 6)), axis=1)
    drift = np.abs(means[-1] - means[-2])
    np.testing.assert_allclose(bench.state["safety"]["arming"]["drift"], drift, rtol=1e-9)
    assert drift.min() > 1e-4
    limit = bench.parameters["safety"]["arming"]["drift"] = factor * drift.max()
    bench.step()
    assert (bench.mode == Mode.RUNNING) == armed
    if armed:
        return
    first = int(np.argmax(drift > limit))
    assert obstacle(bench) == (Cause.NOT_STILL, first, pytest.approx(drift[first]), limit)
    assert f"the estimate of leg {first} changes too much within 50 ms on closed brakes" in describe_obstacle(bench.state)
    # When it stands still, two windows must pass.
    assert Cause.ARMED in bench.steps(3 * window)


@pytest.mark.parametrize("off", [0.009, -0.0075, 0.0004, 5e-6])
def test_the_reference_begins_where_the_legs_are_and_comes_to_the_target_within_the_limits(hexapod, off):
    bench, limits, period = Bench(hexapod), hexapod.limits, 1.0 / RATE_HZ
    bench.segments[:, 0, 1] += off * np.array([1.0, -0.5, 0.2, 0.0, 0.7, 1.0])
    bench.steps(bench.hold)
    lengths, references = bench.state["pose"]["lengths"].copy(), []
    # The legs stay, which these limits would end.
    for name in ("following", "drive_deviation", "saturation"):
        bench.parameters["safety"]["watch"][name] = np.inf
    bench.parameters["safety"]["drives"]["slack"] = np.inf
    for number in range(200):
        bench.signals[0, :, 0] = 1e-9 * (-1.0) ** number
        bench.step()
        references.append(bench.state["reference"]["motion"].copy())
        assert bench.mode == Mode.RUNNING
    references, arrived = np.array(references), int(bench.state["safety"]["arming"]["delay"])
    # What is kept is the reference of the next cycle.
    np.testing.assert_allclose(references[0, :, 0], lengths, rtol=0.0, atol=limits.jerk * period**3 / 6.0 + 1e-9)
    assert 0 < arrived < 150
    at_target = np.broadcast_to(bench.segments[:, 0], (201 - arrived, 6, 5))
    np.testing.assert_allclose(references[arrived - 1 :], at_target[:, :, 1:4], rtol=0.0, atol=1e-9)
    rates, accelerations = references[:, :, 1], references[:, :, 2]
    assert np.abs(rates).max() <= limits.velocity and np.abs(accelerations).max() <= limits.acceleration
    assert np.abs(np.diff(accelerations, axis=0)).max() <= 1.0001 * limits.jerk * period
    # No leg need take longer: one cycle less would break a limit.
    shorter = (arrived - 1) * period
    needed = [
        abs(off) * 2.0 / limits.velocity,
        np.sqrt(abs(off) * 8.0 / limits.acceleration),
        np.cbrt(abs(off) * 32.0 / limits.jerk),
    ]
    assert max(needed) > shorter


def test_where_the_estimate_is_not_relied_upon_the_reference_begins_with_the_target(hexapod):
    bench = Bench(hexapod)
    watch_nothing(bench.parameters)
    bench.segments[:, 0, 1] += 0.02
    bench.steps(bench.hold + 1)
    assert bench.mode == Mode.RUNNING and bench.state["safety"]["arming"]["delay"] == 0
    np.testing.assert_array_equal(bench.state["reference"]["motion"][:, 0], bench.segments[:, 0, 1])
