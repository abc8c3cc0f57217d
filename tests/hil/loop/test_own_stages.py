"""Stages of the user's own: they stand in place of gough's, are checked as these are, and fail safely."""

import sys
import time
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest

from controller.direct_kinematics import solve
from controller.inverse_kinematics import inverse_kinematics
from controller.safety.causes import Cause, Mode, Request
from hil import (
    RealTimeSettings,
    RunStoppedError,
    SimulationConfig,
    SimulationStoppedError,
    Stages,
    load_mechanism,
    open_simulation,
    run,
    simulate,
)
from hil.loop.records import Stage
from hil.recording.mcap import RecordingError
from hil.recording.replay import replay
from plant.errors import InputError
from plant.pose import Pose, rotation_from_quaternion, rotation_from_vector

CONFIG = SimulationConfig(target="sines", duration=0.6, rate=500.0)
COMPARED = ("position", "rotation", "lengths", "reference", "command", "truth", "covariance", "protection", "mode", "imus")
HEXAPOD = load_mechanism("hexapod")


def true_pose(cycle):
    return Pose(cycle.true_position, rotation_from_quaternion(cycle.true_quaternion))


def same(first, second, names=COMPARED):
    for name in names:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


@pytest.fixture(scope="module")
def compiled():
    return simulate(CONFIG)


def test_a_command_that_is_goughs_own_changes_nothing(compiled):
    result = simulate(CONFIG, stages=Stages(command=lambda cycle: cycle.command))
    same(result.records, compiled.records)
    assert result.summary()["stages"]["command"].endswith("<lambda>") and compiled.summary()["stages"] == {}


def test_directions_and_a_pose_that_are_goughs_own_change_rounding_alone(compiled):
    """Both are made unit again, which may change their last bits."""
    stages = Stages(lambda cycle: cycle.directions, lambda cycle: Pose(cycle.position, cycle.rotation))
    records = simulate(CONFIG, stages=stages).records
    np.testing.assert_allclose(records["position"], compiled.records["position"], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(records["command"], compiled.records["command"], rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("mechanism", ["hexapod", "planar-3rpr"])
def test_a_stepped_loop_is_the_compiled_one(mechanism):
    config = replace(CONFIG, mechanism=mechanism, target="circle")
    with open_simulation(config) as simulation:
        while not simulation.ended:
            simulation.step()
        records = simulation.result().records
    expected = simulate(config)
    same(records, expected.records)
    assert len(records) == len(expected.times)


def test_a_controller_of_ones_own_is_the_pid_with_the_same_gains(tmp_path):
    """A proportional controller with feed-forward, against the compiled one without integral."""
    (tmp_path / "proportional.toml").write_text('based_on = "hexapod"\n[control]\nproportional = 30.0\nintegral = 0.0\n')
    expected = simulate(replace(CONFIG, mechanism=str(tmp_path / "proportional.toml"))).records
    given = simulate(CONFIG, stages=Stages(command=lambda cycle: cycle.feed_forward + 30.0 * cycle.deviation)).records
    np.testing.assert_allclose(given["command"], expected["command"], rtol=0.0, atol=1e-12)
    assert np.abs(given["command"] - simulate(CONFIG).records["command"]).max() > 1e-4


def test_an_estimate_of_ones_own_is_what_the_loop_controls(compiled):
    result = simulate(CONFIG, stages=Stages(pose=true_pose))
    np.testing.assert_allclose(result.records["position"], result.true_positions, rtol=0.0, atol=1e-12)
    ours, known = (each.summary()["tracking"]["position_rms"] for each in (compiled, result))
    assert known < 0.3 * ours


def test_directions_of_ones_own_give_the_pose(compiled):
    """Those of the true pose, without the fourth leg's: the rest gives the pose all the same."""

    def directions(cycle):
        found = np.array(inverse_kinematics(HEXAPOD, true_pose(cycle)).directions)
        found[3] = np.nan
        return found

    result = simulate(CONFIG, stages=Stages(directions))
    ours, known = (each.summary()["estimation"]["position_rms"] for each in (compiled, result))
    assert known < 0.3 * ours
    assert np.isnan(result.records["residuals"][:, 3]).all() and np.isfinite(result.records["residuals"][:, 2]).all()


def test_an_estimate_may_use_direct_kinematics_as_a_library():
    def pose(cycle):
        solution = solve(HEXAPOD, cycle.directions, up_in_platform=cycle.vertical)
        return Pose(solution.position, solution.rotation)

    result = simulate(replace(CONFIG, duration=0.2, rate=250.0), stages=Stages(pose=pose))
    assert result.summary()["estimation"]["position_max"] < 2e-3


def test_what_a_cycle_knows_is_what_is_recorded():
    with open_simulation(replace(CONFIG, imu="ideal")) as simulation:
        cycle = simulation.cycle
        assert cycle.time == -0.2 and cycle.mode == Mode.IDLE and not cycle.driving
        times = [simulation.step().time for _ in range(250)]
        np.testing.assert_allclose(np.diff(times), cycle.period, rtol=1e-9)
        assert cycle.mode == Mode.RUNNING and cycle.driving and cycle.number == 250 and cycle.missed == 0
        record = simulation.result().records[-1]
        for name, recorded in (
            ("position", "position"), ("rotation", "rotation"), ("lengths", "lengths"), ("command", "command"),
            ("angular_velocity", "angular_velocity"), ("specific_force", "specific_force"),
        ):  # fmt: skip
            np.testing.assert_array_equal(getattr(cycle, name), record[recorded], err_msg=name)
        np.testing.assert_array_equal(cycle.true_position, record["truth"][:3])
        assert cycle.imus_used.all() and np.isnan(cycle.measured_lengths).all()
        at_truth = inverse_kinematics(HEXAPOD, true_pose(cycle))
        np.testing.assert_allclose(cycle.true_lengths, at_truth.lengths, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(cycle.directions, at_truth.directions, rtol=0.0, atol=5e-4)
        np.testing.assert_allclose(cycle.vertical, cycle.rotation[2], rtol=0.0, atol=5e-4)


def test_nobody_can_write_into_what_a_cycle_knows():
    def command(cycle):
        cycle.command[:] = 0.0

    with pytest.raises(SimulationStoppedError, match="read-only"):
        simulate(CONFIG, stages=Stages(command=command))


def test_a_command_that_is_given_moves_the_plant_and_is_cut_off():
    with open_simulation(replace(CONFIG, target="hold", imu="ideal")) as simulation:
        while simulation.cycle.mode != Mode.RUNNING or simulation.cycle.time < 0.0:
            simulation.step()
        began = simulation.cycle.true_lengths.copy()
        for _ in range(50):
            simulation.step(np.full(6, 0.01))
        # 0.1 s at 10 mm/s, less lag and droop of the drives.
        assert (np.abs(simulation.cycle.true_lengths - began - 1e-3) < 4e-4).all()
        limit = 1.4 * HEXAPOD.require_limits().velocity
        np.testing.assert_array_equal(simulation.step(np.full(6, 10.0)).command, limit)


def test_a_command_is_asked_for_while_the_drives_follow():
    asked = []

    def command(cycle):
        asked.append((cycle.mode, cycle.driving))
        return np.zeros(6)

    records = simulate(replace(CONFIG, target="hold", duration=0.1), stages=Stages(command=command)).records
    assert set(asked) == {(Mode.RUNNING, True)}
    assert len(asked) == np.count_nonzero(records["mode"] == Mode.RUNNING) < len(records)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stages", "said"),
    [
        (Stages(command=lambda cycle: cycle.command[:, 0]), "IndexError"),
        (Stages(command=lambda cycle: cycle.command[:5]), r"the command must have shape \(6,\), got \(5,\)"),
        (Stages(command=lambda cycle: np.nan * cycle.command), r"the command\[0\] is nan"),
        (Stages(pose=lambda cycle: Pose(cycle.position, 2.0 * cycle.rotation)), "off orthogonal"),
        (Stages(pose=lambda cycle: Pose(np.full(3, np.nan), cycle.rotation)), "it must be finite"),
        (Stages(directions=lambda cycle: 1.1 * cycle.directions), "the direction of leg 0 has length 1.1"),
        (Stages(directions=lambda cycle: "forwards"), "array of numbers"),
    ],
)
def test_a_stage_that_fails_ends_the_run_by_a_quick_stop(stages, said):
    good = Stages(
        lambda cycle: cycle.directions, lambda cycle: Pose(cycle.position, cycle.rotation), lambda cycle: cycle.command
    )

    def later(name):
        return lambda cycle: (getattr(good, name) if cycle.time < 0.1 else getattr(stages, name) or getattr(good, name))(cycle)

    failing = Stages(*(later(each.name) for each in fields(Stages)))
    with pytest.raises(SimulationStoppedError, match=f"a stage in Python has failed: .*{said}") as caught:
        simulate(CONFIG, stages=failing)
    error, records = caught.value, caught.value.result.records
    assert type(error.__cause__).__name__ in str(error)
    assert Cause.STAGE_FAILED in records["event_cause"] and records["mode"][-1] == Mode.FAULT
    # No cycle is counted twice, and the drives were told to stop by themselves.
    assert all(after == before + 1 for before, after in pairwise(records["cycle"].tolist()))
    assert records["request"][-1] == Request.QUICK_STOP and len(records) < CONFIG.rate * (CONFIG.duration + 0.2)


def test_a_stage_that_fails_before_anything_has_moved_leaves_the_brakes_closed():
    with pytest.raises(SimulationStoppedError, match="a stage in Python has failed") as caught:
        simulate(CONFIG, stages=Stages(pose=lambda cycle: 1 / 0))
    assert (caught.value.result.records["request"] == Request.BRAKED).all()
    assert "before the motion" in repr(caught.value.result)


def test_a_pose_that_is_not_found_ends_the_run():
    with pytest.raises(SimulationStoppedError, match="no longer determine the pose"):
        simulate(CONFIG, stages=Stages(pose=lambda cycle: None if cycle.time > 0.1 else Pose(cycle.position, cycle.rotation)))


def test_a_wild_estimate_is_stopped_as_goughs_own_would_be():
    def pose(cycle):
        turn = rotation_from_vector([0.0, 0.0, 0.3 * (cycle.time > 0.1)])
        return Pose(cycle.position, turn @ cycle.rotation)

    with pytest.raises(SimulationStoppedError, match="stopped on the brakes") as caught:
        simulate(CONFIG, stages=Stages(pose=pose))
    assert caught.value.result.times[-1] < 0.3


def test_a_cycle_is_sensed_once_and_ended_once():
    with open_simulation(replace(CONFIG, target="hold", duration=0.01)) as simulation:
        with pytest.raises(InputError, match="no cycle has been sensed"):
            simulation.act()
        simulation.sense()
        with pytest.raises(InputError, match="sensed already"):
            simulation.sense()
        with pytest.raises(InputError, match="the command must have shape"):
            simulation.act([0.0])
        simulation.act()
        while not simulation.ended:
            simulation.step()
        with pytest.raises(InputError, match=r"the motion of 0\.01 s is over"):
            simulation.step()
        assert len(simulation.result().times) == simulation.cycle.number


def test_the_time_of_a_function_counts_as_that_of_its_stage():
    def slow(cycle):
        time.sleep(2e-3)
        return cycle.command

    config = replace(CONFIG, target="hold", duration=0.05)
    records = simulate(config, stages=Stages(command=slow)).records
    moving = records["mode"] == Mode.RUNNING
    assert records["stage_ns"][moving, Stage.CONTROL].min() > 2_000_000
    assert np.median(records["stage_ns"][moving, Stage.POSE]) < 500_000


def test_what_cannot_be_saved_is_refused():
    with pytest.raises(InputError, match="cannot be saved"):
        simulate(CONFIG, save_at=0.1, stages=Stages(command=lambda cycle: cycle.command))


@pytest.mark.slow
def test_stages_run_on_the_clock_and_a_replay_says_that_it_lacks_them(tmp_path):
    config, settings = replace(CONFIG, rate=100.0), RealTimeSettings(most_missed=1000)
    stages = Stages(command=lambda cycle: cycle.feed_forward + 30.0 * cycle.deviation)
    recording = tmp_path / "own.mcap"
    summary = run(config, settings, recording, stages=stages)
    assert summary["cause"] == "end of the motion" and summary["errors_m"]["tracking"] < 1e-3
    assert summary["motion_s"] == pytest.approx(config.duration) and list(summary["stages"]) == ["command"]
    with pytest.raises(RecordingError, match="stages of its own, command"):
        replay([recording])


@pytest.mark.slow
def test_a_stage_that_fails_on_the_clock_ends_the_run_by_a_quick_stop():
    def command(cycle):
        raise ValueError("no gains")

    with pytest.raises(RunStoppedError, match="a stage in Python has failed: ValueError: no gains"):
        run(replace(CONFIG, rate=100.0), RealTimeSettings(most_missed=1000), stages=Stages(command=command))


def test_a_controlled_stop_is_goughs_whatever_the_function_commands():
    """A function that never looks at the reference drives on; the stop that its limits cause ends at rest all the same."""
    config = replace(CONFIG, target="hold", imu="ideal", duration=3.0)
    with pytest.raises(SimulationStoppedError, match="does not follow its reference") as caught:
        simulate(config, stages=Stages(command=lambda cycle: np.full(6, 0.05 * (cycle.time > 0.1))))
    records = caught.value.result.records
    stopping = records[records["mode"] == Mode.STOPPING]
    off = np.abs(stopping["truth"][:, 7:13] - stopping["reference"][:, :, 0]).max(axis=1)
    assert off[0] > 0.01 and off[-1] < 1.5e-3 and np.abs(stopping["command"][-1]).max() < 0.02


def test_a_leg_whose_imu_is_left_out_has_no_direction():
    seen = {}

    def pose(cycle):
        seen[cycle.time > 0.05] = cycle.directions
        return Pose(cycle.position, cycle.rotation)

    simulate(replace(CONFIG, duration=1.0, faults=("imu-turn:3,axis=x,size_deg=2,at=0.2",)), stages=Stages(pose=pose))
    assert np.isfinite(seen[False]).all() and len(seen) == 2
    assert np.isnan(seen[True]).any(axis=1).tolist() == [False, False, False, True, False, False]


def test_a_direction_that_is_given_counts_although_the_legs_imu_is_left_out():
    def directions(cycle):
        return inverse_kinematics(HEXAPOD, true_pose(cycle)).directions

    result = simulate(replace(CONFIG, duration=1.0, faults=("imu-turn:3,axis=x,size_deg=2,at=0.2",)), stages=Stages(directions))
    assert np.isfinite(result.records["residuals"][-1]).all()
    assert result.summary()["estimation"]["position_rms"] < 1.5e-4


def test_of_two_stages_that_fail_the_first_is_told():
    def failing(name):
        def stage(cycle):
            if cycle.time > 0.1:
                raise ValueError(name)
            return {"pose": Pose(cycle.position, cycle.rotation), "command": cycle.command}[name]

        return stage

    with pytest.raises(SimulationStoppedError, match=r"ValueError: pose$"):
        simulate(CONFIG, stages=Stages(pose=failing("pose"), command=failing("command")))
    with pytest.raises(SimulationStoppedError, match="SystemExit: 3"):
        simulate(CONFIG, stages=Stages(command=lambda cycle: sys.exit(3)))


def test_a_malformed_pose_leaves_nothing_of_it_behind():
    with open_simulation(CONFIG, Stages(pose=lambda cycle: Pose(np.full(3, 7.0), 2.0 * np.eye(3)))) as simulation:
        simulation.sense()
        assert np.abs(simulation.cycle.position).max() < 1.0


def test_a_stepped_loop_shows_the_stages_command_and_takes_another_one():
    stages = Stages(command=lambda cycle: np.full(6, 0.003))
    with open_simulation(replace(CONFIG, target="hold", imu="ideal"), stages) as simulation:
        while not simulation.cycle.driving:
            simulation.step()
        np.testing.assert_array_equal(simulation.sense().command, np.full(6, 0.003))
        simulation.act(np.full(6, 0.002))
        np.testing.assert_array_equal(simulation.cycle.command, np.full(6, 0.002))


def test_a_stop_that_is_under_way_at_the_end_is_told_when_stepping():
    stages = Stages(command=lambda cycle: np.full(6, np.nan if cycle.time > 0.59 else 0.0))
    with open_simulation(replace(CONFIG, target="hold"), stages) as simulation:
        with pytest.raises(SimulationStoppedError, match=r"still stopping at the end, from.*the command"):
            while not simulation.ended:
                simulation.step()
        assert simulation.ended


@pytest.mark.slow(seconds=20)
def test_a_stage_that_never_returns_is_ended():
    def command(cycle):
        if cycle.time > 0.1:
            time.sleep(600.0)
        return cycle.command

    with pytest.raises(RunStoppedError, match="has not answered for 10 s and was killed"):
        run(replace(CONFIG, rate=100.0), RealTimeSettings(most_missed=1000), stages=Stages(command=command))
