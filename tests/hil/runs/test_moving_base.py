"""A base that moves, with an IMU on it: how good the pose is, over every link, and what is told when that IMU is lost."""

from dataclasses import replace

import numpy as np
import pytest

from controller.safety.causes import Cause, Mode
from hil.faults.links import run
from hil.faults.rows import Drawn
from hil.runs.config import SimulationConfig
from hil.runs.simulation import SimulationStoppedError, simulate
from plant.errors import GoughError, InputError
from plant.pose import pose_errors, vector_from_rotation
from plant.truth import TRUTH_LENGTHS
from tests.hil.runs.test_lengths import errors_of, rms

SEA = (
    "base-tilt,axis=x,size_deg=3,sine_hz=0.125,at=0.2", "base-tilt,axis=y,size_deg=1.5,sine_hz=0.0917,at=0.7",
    "base-tilt,axis=z,size_deg=1,sine_hz=0.109,at=0.5", "base-acceleration,axis=z,size_m_per_s2=0.1,sine_hz=0.159,at=0.2",
    "base-acceleration,axis=y,size_m_per_s2=0.16,sine_hz=0.2,at=0.9",
)  # fmt: skip
"""Tilts by degrees and moves of a decimetre, with periods of 5 to 11 s."""

AT_SEA = SimulationConfig(target="sines", duration=8.0, base_imu=True, faults=SEA)


def lasts(text):
    return replace(AT_SEA, faults=(*SEA, text))


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["compiled", "whole"])
def test_with_ideal_sensors_the_pose_on_a_base_that_moves_is_exact(fusion):
    """As with a base at rest, once the base no longer begins to move within a tenth of a second."""
    still, moved = (
        rms(errors_of(simulate(replace(AT_SEA, imu="ideal", fusion=fusion, **changes)).records)[4000:])
        for changes in ({"base_imu": False, "faults": ()}, {})
    )
    assert (moved < still + (5e-3, 1e-3)).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("fusion", "most"), [("compiled", (1.0, 0.2)), ("whole", (0.5, 0.1))])
def test_with_calibrated_imus_the_pose_on_a_base_that_moves_is_as_good_as_at_rest(fusion, most, seed):
    result = simulate(replace(AT_SEA, fusion=fusion, seed=seed))
    assert (rms(errors_of(result.records)) < most).all()
    assert not [event for event in result.events if "left out" in event or "share" in event]


def test_without_an_imu_on_the_base_its_motion_is_told():
    with pytest.raises(SimulationStoppedError, match=r"base|all accelerometers|all gyroscopes|contradict"):
        simulate(replace(AT_SEA, base_imu=False))


def test_a_base_that_leans_far_and_turns_fast():
    """It heels by 20 deg from 6 deg at power-on, at up to 9 deg/s, and turns by 60 deg, at up to 19 deg/s."""
    storm = (
        "base-tilt,axis=y,size_deg=6",
        "base-tilt,axis=x,size_deg=20,ramp_s=4,at=1",
        "base-tilt,axis=z,size_deg=60,ramp_s=6,at=3",
    )
    records = simulate(replace(AT_SEA, faults=storm, duration=10.0)).records
    assert np.linalg.norm(errors_of(records)[:, :3], axis=1).max() < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("link", ["udp", "canopen"])
def test_the_imu_on_the_base_comes_over_a_bus(link):
    records, _, cause = run(Drawn(replace(AT_SEA, faults=(), duration=4.0, rate=500.0), link, SEA, frozenset(), 0.0))
    assert cause == Cause.END_OF_MOTION
    assert np.isfinite(records["base_imu"][10:]).all() and (records["base_imu_age"][10:] <= 1).all()
    assert (rms(errors_of(records)) < (1.0, 0.25)).all()


@pytest.mark.parametrize(
    "fault", ["imu-dead:7,at=2", "imu-frozen:7,at=2"]
)  # fmt: skip
def test_a_lost_imu_on_the_base_ends_the_run(fault):
    config = replace(AT_SEA, faults=(), duration=4.0, rate=500.0)
    records, first, cause = run(Drawn(config, "udp", (*SEA, fault), frozenset(), 2.0))
    assert cause == Cause.BASE_IMU_LOST
    told = np.flatnonzero((records["event_cause"] == Cause.BASE_IMU_LOST).any(axis=1))[0]
    assert first <= told <= first + 0.025 * config.rate
    assert np.linalg.norm(errors_of(records)[:, :3], axis=1).max() < 2.0


def test_an_imu_on_the_base_that_turns_on_its_mounting_is_told_before_the_pose_is_far_off():
    """It looks like a base that tilts, or like an error that all share."""
    with pytest.raises(SimulationStoppedError) as stopped:
        simulate(lasts("imu-turn:7,axis=x,size_deg=5,at=3"))
    records = stopped.value.result.records
    running = records[records["mode"] == Mode.RUNNING]
    assert np.linalg.norm(errors_of(running)[:, :3], axis=1).max() < 15.0


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"magnetometer": True}, "leave out --magnetometer or --base-imu"),
        ({"fusion": "filterpy"}, "with --base-imu the fusion is one of compiled, whole"),
        ({"fusion": "section-5", "magnetometer": True}, "with --base-imu the fusion is one of"),
    ],
)
def test_what_has_no_moving_base_is_refused(changes, text):
    with pytest.raises(InputError, match=text):
        simulate(replace(AT_SEA, **changes))


HEAVING = (*SEA[:2], "base-acceleration,axis=z,size_m_per_s2=0.02,sine_hz=0.159,at=0.2")
"""Heave of 2 cm, and no sway: sway along the axes of a base that rolls is heave as well, of long periods."""

AT_LEVEL = replace(AT_SEA, frame="level", duration=60.0)


@pytest.mark.slow
@pytest.mark.parametrize(("target", "fusion", "seed"), [("hold", "whole", 2), ("sines", "compiled", 0)])
def test_a_target_in_the_level_frame_keeps_its_attitude_on_the_earth(target, fusion, seed):
    """Against the true motion of the base, of which the loop knows nothing."""
    result = simulate(replace(AT_LEVEL, target=target, fusion=fusion, seed=seed))
    late = result.times > 30.0
    truth = result.true_positions[late], result.true_rotations[late]
    off = pose_errors(*truth, result.target_positions[late], result.target_rotations[late]).reshape(-1, 6)
    tilt, heading = np.degrees(np.sqrt((off[:, 3:5] ** 2).sum(axis=1).mean())), np.degrees(np.sqrt((off[:, 5] ** 2).mean()))
    assert tilt < 0.1 and heading < 0.15
    assert 1e3 * np.sqrt((off[:, :3] ** 2).sum(axis=1).mean()) < 2.0
    rolled = pose_errors(*truth, *result.target.at(result.times[late])).reshape(-1, 6)
    assert np.degrees(np.abs(rolled[:, 3]).max()) > 2.5


@pytest.mark.slow
def test_the_platform_takes_no_part_in_the_heave_of_its_base():
    """A quarter of it is left, by an IMU whose noise alone makes a heave of some millimetres; told a period that is not quite
    that of the waves."""
    config = replace(AT_LEVEL, target="hold", faults=HEAVING, heave_period=7.0)
    result = simulate(config)
    late = result.times > 30.0
    truth = result.true_positions[late], result.true_rotations[late]
    off = pose_errors(*truth, result.target_positions[late], result.target_rotations[late]).reshape(-1, 6)
    heave = result.heaves[late, 2]
    assert heave.std() == pytest.approx(0.02 / np.sqrt(2.0), rel=0.05)
    assert off[:, 2].std() < 0.4 * heave.std() and 1e3 * np.abs(off[:, :2]).max() < 2.0
    assert np.degrees(np.sqrt((off[:, 3:5] ** 2).sum(axis=1).mean())) < 0.1
    # Without being told of it, the platform rises and falls with its base.
    rising = simulate(replace(config, heave_period=0.0, duration=10.0))
    assert (rising.heaves == 0.0).all()
    assert np.abs(rising.true_positions[:, 2] - rising.target_positions[:, 2])[5000:].max() < 2e-3


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"frame": "base"}, "heave_period is of a target in the level frame: add --frame level"),
        ({"heave_period": 1.0}, "heave_period is 1 s; it must be 2 to 30 s, or 0 for none"),
        ({"heave_period": float("nan")}, "heave_period is nan s; it must be 2 to 30 s"),
    ],
)
def test_a_heave_that_cannot_be_is_refused(changes, text):
    with pytest.raises(InputError, match=text):
        replace(AT_LEVEL, **{"heave_period": 7.0, **changes})


def test_what_cannot_be_kept_level_is_told_and_stays_within_the_stroke():
    heeling = ("base-tilt,axis=x,size_deg=15,ramp_s=6,at=3",)
    result = simulate(replace(AT_LEVEL, target="hold", faults=heeling, duration=12.0))
    assert any("cannot follow the target in the level frame" in event for event in result.events)
    lengths, stroke = result.records["truth"][:, TRUTH_LENGTHS], result.mechanism.require_limits().stroke
    assert (lengths >= stroke[:, 0]).all() and (lengths <= stroke[:, 1]).all()


def test_the_platform_leaves_the_bases_frame_within_the_limits_of_its_drives():
    """The base leans when the motion begins."""
    result = simulate(replace(AT_LEVEL, target="hold", faults=("base-tilt,axis=y,size_deg=5",), duration=12.0))
    limits, reference = result.mechanism.require_limits(), result.records["reference"]
    assert np.abs(reference[:, :, 1]).max() <= limits.velocity and np.abs(reference[:, :, 2]).max() <= limits.acceleration
    assert np.degrees(vector_from_rotation(result.true_rotations[-1] @ result.target_rotations[-1].T)[1]) == pytest.approx(
        0, abs=0.3
    )


@pytest.mark.parametrize("frame", ["level", "sky"])
def test_a_frame_without_its_sensor_is_refused(frame):
    with pytest.raises(GoughError, match="add --base-imu" if frame == "level" else "there are base, level"):
        replace(AT_SEA, base_imu=False, frame=frame)
