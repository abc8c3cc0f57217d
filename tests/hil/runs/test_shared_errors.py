"""Errors that all IMUs share, and the only IMU that shows them: what the closed loop tells, before a motion and in it."""

import numpy as np
import pytest

from controller.safety.causes import Cause, Mode
from hil.runs.config import SimulationConfig
from hil.runs.simulation import SimulationStoppedError, simulate
from plant.fmu.settings import Setting
from plant.truth import TRUTH_POSITION

MM = 1e-3


def stopped(**changes):
    """The result and the reason of a run that ends early."""
    with pytest.raises(SimulationStoppedError) as ended:
        simulate(SimulationConfig(**changes))
    return ended.value.result, str(ended.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("imu-offset:all,axis=z,size_m_per_s2=1.5", "the IMUs share an error, or the base is not at rest"),
        ("imu-offset:legs,axis=z,size_m_per_s2=1.5", "the IMUs share an error, or the base is not at rest"),
        ("imu-scale:all,sensor=accelerometer,axis=all,size_percent=15", "the IMUs share an error, or the base is not at rest"),
        ("imu-turn:3,axis=x,size_deg=2", "IMU 3 is not plausible"),
    ],
)
def test_what_is_wrong_from_the_start_is_never_armed(fault, reason):
    """Neither when the first evaluations see it, nor when it begins to be learned."""
    result, said = stopped(duration=1.5, faults=(fault,))
    assert f"not armed: {reason}" in said
    assert (result.records["mode"] != Mode.RUNNING).all()
    # A large offset is also noted as shaking.
    assert any(event.endswith(said.split(": ", 1)[1]) for event in result.events)


@pytest.mark.parametrize("fusion", ["compiled", "whole"])
@pytest.mark.parametrize(
    "changes",
    [
        {"faults": ("imu-offset:all,axis=z,size_m_per_s2=1.5,ramp_s=30,at=1",)},
        {"faults": ("imu-scale:all,sensor=accelerometer,axis=all,size_percent=15,ramp_s=4,at=1",)},
    ],
    ids=["offset", "scale"],
)
def test_what_all_accelerometers_share_is_told_in_motion_before_the_pose_is_5_mm_off(changes, fusion):
    result, _ = stopped(duration=4.0, fusion=fusion, **changes)
    shared = (Cause.ACCELEROMETERS_SHARE, Cause.BASE_MOVES, Cause.BASE_TURNS)
    assert int(result.records["stop"][-1]) in shared
    assert result.summary()["estimation"]["position_max"] < 5.0 * MM


@pytest.mark.parametrize(
    ("fault", "reason", "out"),
    [
        ("imu-turn:6,axis=y,size_deg=3,at=1", "the IMUs contradict each other, the worst is IMU 6", False),
        (
            "imu-noise:6,axis=all,size_deg_per_s=60,at=1",
            "without IMU 6 nothing shows an error that the legs' IMUs share: need_platform_imu = 0",
            True,
        ),
    ],
    ids=["turned", "noisy"],
)
def test_a_run_that_cannot_rely_on_the_platforms_imu_ends_unless_that_is_allowed(tmp_path, fault, reason, out):
    """A contradiction ends it at once; what the IMU's own readings show leaves it out first."""
    result, said = stopped(duration=2.0, faults=(fault,))
    assert reason in said
    events = [event.split(": ", 1)[1] for event in result.summary()["events"]]
    assert any(event.startswith("IMU 6 is left out") for event in events) == out
    assert f"stop: {reason}" in events[-1]
    allowing = tmp_path / "allowing.toml"
    allowing.write_text('based_on = "hexapod"\n[safety]\nneed_platform_imu = 0\n')
    events = simulate(SimulationConfig(str(allowing), duration=2.0, faults=(fault,))).summary()["events"]
    assert any("IMU 6 is left out" in event for event in events) and not any("stop" in event for event in events)


@pytest.mark.parametrize("seed", [0, 4])
def test_gyroscopes_that_share_an_error_along_the_legs_are_told_by_legs_that_fit_no_pose(seed):
    """A leg hardly turns about itself, so its filter takes that for a tilt, of 0.3 deg within 0.05 s."""
    result, said = stopped(
        target="sines", duration=5.0, seed=seed, faults=("imu-offset:legs,axis=z,size_deg_per_s=0.5,at=2.3",)
    )
    assert "the gyroscopes contradict each other" in said or "no pose fits the IMUs, even without the worst of them" in said
    assert np.degrees(result.summary()["estimation"]["rotation_max"]) < 0.7


@pytest.mark.parametrize("fusion", ["compiled", "whole"])
def test_a_legs_imu_that_turns_hardly_moves_the_pose_although_it_takes_a_third_of_a_second_to_be_told(fusion):
    result = simulate(
        SimulationConfig(target="sines", duration=4.5, seed=5, fusion=fusion, faults=("imu-turn:1,axis=x,size_deg=3,at=3",))
    )
    assert any("IMU 1 is left out" in event for event in result.summary()["events"])
    after = result.records[result.times > 3.0]
    off = np.linalg.norm(after["position"] - after["truth"][:, TRUTH_POSITION], axis=1)
    assert off.max() < 1.2 * MM


@pytest.mark.parametrize("imus", [(0, 1, 2, 3, 4, 5), (0, 1, 3, 4)])
def test_a_set_that_never_had_the_platforms_imu_runs(imus):
    result = simulate(SimulationConfig(duration=1.0, imus=imus))
    assert len(result.events) == 1 and result.events[0].endswith(": armed")


def test_the_protection_level_shows_that_few_imus_do_not_check_each_other():
    """An error of the platform's IMU that nothing contradicts: 10 mm without a word, which is learned as a constant one."""
    sound = simulate(SimulationConfig(duration=4.0)).summary()
    few = {"imus": (0, 5, 6), "magnetometer": True}
    wrong = simulate(SimulationConfig(duration=4.0, **few, faults=("imu-turn:6,axis=x,size_deg=2,at=1.5",))).summary()
    assert wrong["estimation"]["position_max"] > 8.0 * MM
    assert wrong["protection"]["covered"] > 0.7
    for level in ("position_p50", "rotation_p50"):
        assert wrong["protection"][level] > 3.0 * sound["protection"][level]


@pytest.mark.parametrize("imu", ["ideal", pytest.param("mpu9150-calibrated", marks=pytest.mark.slow)])
def test_a_target_that_is_rounded_to_a_millimetre_is_no_error_of_accelerometers(tmp_path, imu):
    """It makes the plan jerk to and fro within 10 ms, again and again."""
    times = 0.01 * np.arange(301)
    waves = np.round(np.array([5e-3, 3e-3, 4e-3]) * np.sin(np.outer(times, [2.0, 3.0, 2.5])), 3)
    path = tmp_path / "rounded.csv"
    rows = [f"{t:.2f},{x},{y},{z},1,0,0,0\n" for t, (x, y, z) in zip(times, waves, strict=True)]
    path.write_text("time_s,x_m,y_m,z_m,qw,qx,qy,qz\n" + "".join(rows))
    result = simulate(SimulationConfig(target=str(path), duration=2.9, imu=imu))
    assert [event.partition(": ")[2] for event in result.summary()["events"]] == ["armed"]


@pytest.mark.parametrize("fusion", ["compiled", "whole"])
def test_gravity_that_turns_for_all_imus_at_once_is_told_and_said_in_the_summary(fusion):
    """By 1.5 deg, which looks like a tilt of the platform to all of them: 15 mm before it was told."""
    turned = Setting.parse("gravity=0.2568,0,-9.8066@1")
    result, said = stopped(target="hold", duration=2.0, fusion=fusion, settings=(turned,))
    summary = result.summary()
    assert int(result.records["stop"][-1]) in (Cause.FORCES_SHARE, Cause.BASE_MOVES)
    assert summary["events"][-1].endswith(said.split(": ", 1)[1])
    assert summary["estimation"]["position_max"] < 5.0 * MM
