"""Encoders in the closed loop: how good the pose is with them, where it is at power-on, and what is told when one is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from controller.safety.causes import Cause, Mode
from hil.faults.links import run
from hil.faults.rows import Drawn
from hil.runs.config import SimulationConfig
from hil.runs.simulation import SimulationStoppedError, simulate
from plant.encoders import EncoderModel
from plant.mechanism import LEGS
from plant.pose import pose_errors, rotations_from_quaternions
from plant.truth import TRUTH_LENGTHS, TRUTH_POSITION, TRUTH_QUATERNION

SINES = SimulationConfig(target="sines", duration=20.0, fusion="whole", lengths="incremental")

ALSO_SLOW = ("jumps:2,size_mm=2", "canopen"), ("frozen:2", "udp")
"""Faults and links that are slow tests beside those of the plant itself; the others are endurance tests."""


def errors_of(records):
    """Errors of the pose in motion (N, 6) [mm, deg]."""
    records = records[records["mode"] == Mode.RUNNING]
    rotations = rotations_from_quaternions(np.ascontiguousarray(records["truth"][:, TRUTH_QUATERNION]))
    errors = pose_errors(records["position"], records["rotation"], records["truth"][:, TRUTH_POSITION], rotations)
    return errors.reshape(-1, 6) * np.repeat([1e3, np.degrees(1.0)], 3)


def rms(errors):
    return np.sqrt((errors.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "absolute", "relative"),
    [
        ({}, (0.10, 0.02), (0.03, 0.006)),
        ({"fusion": "compiled"}, (0.4, 0.1), (0.06, 0.01)),
        ({"lengths": "absolute"}, (0.03, 0.006), (0.01, 0.003)),
        ({"lengths": "absolute", "fusion": "compiled", "imus": (0, 1, 2, 6)}, (0.03, 0.006), (0.01, 0.003)),
        ({"rate": 250.0, "seed": 4}, (0.10, 0.02), (0.035, 0.006)),
    ],
)
def test_the_pose_is_as_repeatable_as_the_encoders(changes, absolute, relative):
    """In the second half of a run: absolute, and without the constant error."""
    errors = errors_of(simulate(replace(SINES, **changes)).records)
    late = errors[len(errors) // 2 :]
    assert (rms(late) < absolute).all()
    assert (rms(late - late.mean(axis=0)) < relative).all()


@pytest.mark.parametrize("seed", range(3))
def test_at_power_on_the_pose_is_known_without_homing(seed):
    records = simulate(replace(SINES, target="hold", duration=0.3, seed=seed)).records
    rotations = rotations_from_quaternions(np.ascontiguousarray(records["truth"][:, TRUTH_QUATERNION]))
    errors = pose_errors(records["position"], records["rotation"], records["truth"][:, TRUTH_POSITION], rotations)
    position, rotation = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).T
    for cycle, most, turned in ((100, 1.5, 0.4), (300, 1.0, 0.3)):
        assert 1e3 * position[cycle] < most and np.degrees(rotation[cycle]) < turned


@pytest.mark.parametrize(
    ("fault", "link"),
    [
        pytest.param(
            fault, link, marks=pytest.mark.slow if (fault, link) in ALSO_SLOW or link == "fmu" else pytest.mark.endurance
        )
        for link in ("fmu", "udp", "canopen")
        for fault in ("jumps:2,size_mm=2", "reversed:2", "slips:2,size_percent=20", "frozen:2")
    ],
)
def test_an_encoder_that_is_wrong_is_named_and_left_out(fault, link):
    """Before it is 1 mm off or within 50 ms, whichever is later; the pose is hardly moved."""
    begin, text = 3.0, f"encoder-{fault},at=3"
    config = replace(SINES, duration=4.0, fusion="compiled", rate=500.0, faults=(text,) if link == "fmu" else ())
    records, first, cause = run(Drawn(config, link, (text,), frozenset(), begin))
    told = np.argwhere(records["event_cause"] == Cause.ENCODER_CONTRADICTED)
    assert cause == Cause.END_OF_MOTION and len(told) == 1
    cycle, slot = told[0]
    assert records["event_index"][cycle, slot] == 2
    off = records["length"][:, 2] - records["truth"][:, TRUTH_LENGTHS][:, 2]
    beyond = np.flatnonzero(np.abs(off - off[first - 10]) > 1e-3)
    assert first <= cycle <= max(beyond[0], first + round(0.05 * config.rate))
    errors = errors_of(records)
    assert np.linalg.norm(errors[:, :3], axis=1).max() < 1.5


def test_an_encoder_that_is_silent_is_told_and_used_again():
    result = simulate(replace(SINES, duration=4.0, faults=("encoder-dead:1,at=2,for=0.5",)))
    for event, text in zip(result.events[-2:], ("reads nothing", "is used again"), strict=True):
        assert event.endswith(f"the encoder of leg 1 {text}")
    assert np.linalg.norm(errors_of(result.records)[-1000:, :3], axis=1).max() < 0.5


@pytest.mark.parametrize(
    "changes",
    [
        {"fusion": "compiled"},
        {"fusion": "compiled", "lengths": "absolute", "imus": (6,)},
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"lengths": "absolute", "imus": (6,)}, marks=pytest.mark.slow),
    ],
)
def test_lost_answers_move_neither_the_pose_nor_the_commands(changes):
    """For a cycle without a reading the pose was that of the IMUs alone, 0.4 mm away, or there was none."""
    config, text = replace(SINES, duration=3.0, seed=1, **changes), "bus-drops,size=0.1,at=1"
    records, _, cause = run(Drawn(config, "udp", (text,), frozenset(), 1.0))
    assert cause == Cause.END_OF_MOTION and (records["silent"] > 0).sum() > 100
    moving = records[records["mode"] == Mode.RUNNING]
    steps = np.linalg.norm(np.diff(moving["position"], axis=0), axis=1)
    assert steps.max() < 0.1e-3 and np.abs(np.diff(moving["command"], axis=0)).max() < 8e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lengths", "fault"), [("incremental", "encoder-jumps:4,size_mm=3,at=3"), ("absolute", "encoder-frozen:4,at=3,for=0.5")]
)
def test_an_encoder_that_agrees_again_is_used_again(lengths, fault):
    """One that has lost counts, with a new zero, and an absolute one that stood still, with its own."""
    result = simulate(replace(SINES, lengths=lengths, duration=16.0, fusion="compiled", faults=(fault,)))
    causes, indices = result.records["event_cause"], result.records["event_index"]
    of_encoders = np.isin(causes, (Cause.ENCODER_CONTRADICTED, Cause.ENCODER_BACK))
    told = list(zip(causes[of_encoders], indices[of_encoders], strict=True))
    assert told == [(Cause.ENCODER_CONTRADICTED, 4), (Cause.ENCODER_BACK, 4)]
    assert np.linalg.norm(errors_of(result.records)[-500:, :3], axis=1).max() < 0.6


@pytest.mark.parametrize(
    "changes",
    [
        {"imus": (6,)},
        {"imus": (6,), "fusion": "compiled", "rate": 250.0},
        {"imus": (0, 3), "fusion": "compiled"},
        {"imus": (0, 1), "fusion": "compiled", "mechanism": "planar-3rpr"},
    ],
)
def test_absolute_encoders_lead_where_the_imus_do_not_determine_the_pose(changes):
    result = simulate(replace(SINES, lengths="absolute", duration=3.0, **changes))
    assert (rms(errors_of(result.records)) < (0.03, 0.01)).all()
    assert any("it is that of the encoders" in remark for remark in result.remarks)


def test_encoders_that_lead_do_without_one_that_is_silent_if_an_imu_makes_up_for_it():
    """The platform's vertical does for one of them, not for three."""
    led = replace(SINES, lengths="absolute", duration=3.0, imus=(6,), fusion="compiled")
    records = simulate(replace(led, faults=("encoder-dead:1,at=1,for=1",))).records
    assert np.linalg.norm(errors_of(records)[:, :3], axis=1).max() < 2.0
    with pytest.raises(SimulationStoppedError, match="pose"):
        simulate(replace(led, faults=("encoder-dead:1+2+3,at=1",)))


def test_encoders_beside_few_imus_are_judged_by_what_these_know():
    """Four legs alone know a length fifteen times less well than all IMUs do, which is no fault of an encoder."""
    result = simulate(replace(SINES, target="hold", duration=2.0, fusion="compiled", imus=(1, 2, 3, 4)))
    assert not (result.records["event_cause"] == Cause.ENCODER_CONTRADICTED).any()


@pytest.mark.parametrize("changes", [{"target": "hold", "seed": 139}, {"target": "steps", "seed": 127, "joint_error": 1e-4}])
def test_errors_of_imus_and_joints_that_last_are_no_fault_of_an_absolute_encoder(changes):
    """With these seeds the IMUs' lengths are half a millimetre off on one leg."""
    result = simulate(replace(SINES, lengths="absolute", duration=4.0, fusion="compiled", **changes))
    assert not (result.records["event_cause"] == Cause.ENCODER_CONTRADICTED).any()


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["compiled", "whole"])
def test_the_protection_level_covers_an_absolute_encoder_that_creeps(fusion):
    """Until it is named, it moves the pose, and the IMUs see little of that."""
    creeping = replace(
        SINES, lengths="absolute", fusion=fusion, duration=8.0, faults=("encoder-creeps:2,size_mm_per_s=0.3,at=4",)
    )
    records = simulate(creeping).records
    errors = errors_of(records).reshape(-1, 2, 3)
    level = records["protection"][records["mode"] == Mode.RUNNING] * [1e3, np.degrees(1.0)]
    sizes = np.linalg.norm(errors, axis=2)
    assert sizes[:, 0].max() > 0.1
    assert (sizes <= level).all(axis=1).mean() > 0.999


@pytest.mark.slow
@pytest.mark.parametrize(("fusion", "limits"), [("compiled", (0.06, 0.01)), ("whole", (0.03, 0.006))])
def test_the_pose_is_as_exact_as_the_encoders_once_the_legs_have_passed_their_switches(fusion, limits):
    """The absolute errors are then below the limits of the relative ones without a switch."""
    switches = EncoderModel("homed", switches=(0.397,) * LEGS)
    errors = errors_of(simulate(replace(SINES, lengths=switches, fusion=fusion, duration=4.0, seed=3)).records)
    assert (rms(errors[-2000:]) < limits).all()
