"""The motions of a calibration within a user's limits: they begin and end at home, stay inside, and are worth it."""

from math import inf, radians

import numpy as np
import pytest

from controller.direct_kinematics import poses_from_lengths
from controller.planning.motions import EVERYWHERE, Box, rests, shaking
from controller.planning.offline_planner import plan
from controller.planning.segments import evaluate_reference
from controller.workspace import Demands, margins
from hil.calibration.data import TO_50_UM, Knowledge
from hil.calibration.drives import within_drives
from hil.calibration.excitation import (
    MotionLimits,
    calibration_targets,
    check_useful,
    check_within,
    cut_of_box,
    expected_accuracy,
    gentle_mechanism,
)
from plant.errors import InputError
from plant.mechanism import Mechanism, load_mechanism, load_spatial
from plant.mechanism.loads import home_loads
from plant.pose import vector_from_rotation

BOX = Box(0.02, radians(4.0))


def followed(mechanism: Mechanism, target, seconds: float):
    """Positions, rotations and leg speeds of what is planned for a target."""
    reference, index = plan(mechanism, target, seconds), np.zeros(6, np.int64)
    states = np.zeros((round(100.0 * seconds), 6, 3))
    for k, state in enumerate(states):
        evaluate_reference(reference.segments, 0.01 * k, index, state)
    assert reference.violations == 0
    return *poses_from_lengths(mechanism, states[:, :, 0], target.start), np.abs(states[:, :, 1]).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["probing", "near-rests", "rests", "shaking"])
def test_what_is_planned_stays_in_the_box_and_below_the_speed_and_ends_at_home(hexapod: Mechanism, name: str) -> None:
    limits = MotionLimits(BOX, speed=0.06)
    mechanism = gentle_mechanism(hexapod, limits)
    target, home = calibration_targets(mechanism, BOX)[name], hexapod.require_home()
    positions, rotations, speed = followed(mechanism, target, float(target.times[-1]))
    moved = np.linalg.norm(positions - home.position, axis=1)
    turned = np.linalg.norm(vector_from_rotation(rotations @ home.rotation.T), axis=1)
    assert moved.max() < 1.02 * BOX.position and turned.max() < 1.02 * BOX.rotation and speed < 0.0601
    assert max(moved[0], moved[-1]) < 1e-4 and max(turned[0], turned[-1]) < radians(0.01)
    if name.endswith("rests"):
        assert moved.max() > 0.9 * BOX.position and turned.max() > 0.9 * BOX.rotation, "the box is used"


@pytest.mark.slow
def test_without_limits_the_motions_are_the_named_ones(hexapod: Mechanism) -> None:
    assert gentle_mechanism(hexapod, MotionLimits()) is hexapod
    for ours, named in zip(rests(hexapod, 50.0, box=EVERYWHERE), rests(hexapod, 50.0), strict=True):
        np.testing.assert_array_equal(ours, named)
    target = calibration_targets(hexapod, EVERYWHERE)["rests"]
    np.testing.assert_array_equal(target.positions[:-2], rests(hexapod, 50.0)[1])
    (times, positions, _), back = shaking(hexapod, 40.0), shaking(hexapod, 40.0, back=True)
    middle = (times > 1.0) & (times < 39.0)
    np.testing.assert_allclose(back[1][middle], positions[middle], atol=2e-3)


@pytest.mark.endurance
def test_a_box_costs_accuracy_and_one_that_is_too_small_is_refused(hexapod: Mechanism) -> None:
    within, best = (
        expected_accuracy(hexapod, calibration_targets(hexapod, box)["rests"], Knowledge()) for box in (BOX, EVERYWHERE)
    )
    measured = expected_accuracy(hexapod, calibration_targets(hexapod, BOX)["rests"], Knowledge(encoder=TO_50_UM))
    assert measured.position < 0.7 * within.position, "encoders help"
    assert 1.5 * best.position < within.position < 10.0 * best.position and within.rotation > 1.5 * best.rotation
    for limits, message in (
        (MotionLimits(Box(0.005, radians(1.0))), "--box is too small: between any two poses of near-rests, no IMU would turn"),
        (MotionLimits(BOX, speed=0.005), "--box or --speed is too small: the IMUs would turn at .* times as large"),
    ):
        mechanism = gentle_mechanism(hexapod, limits)
        with pytest.raises(InputError, match=message):
            check_useful(mechanism, calibration_targets(mechanism, limits.box), limits.box)
    with pytest.raises(InputError, match="--speed is 0 mm/s; it must be positive"):
        MotionLimits(speed=0.0)


def test_what_the_motions_need_stays_below_the_force(hexapod: Mechanism) -> None:
    loads, p = home_loads(hexapod), hexapod.plant_parameters()
    carried = np.abs(loads.forces) + p["friction.coulomb"] + p["friction.viscous"] * hexapod.require_limits().velocity
    force = 1.2 * float(carried.max())
    gentle = within_drives(hexapod, force).require_limits()
    needed = carried + np.abs(loads.masses).sum(axis=1) * gentle.acceleration
    assert float(needed.max()) == pytest.approx(force, rel=1e-6)
    assert 0.0 < gentle.acceleration < hexapod.require_limits().acceleration
    with pytest.raises(InputError, match=f"--force is {0.9 * carried.max():g} N, and leg . needs .* for its load and friction"):
        within_drives(hexapod, 0.9 * float(carried.max()))
    assert within_drives(hexapod, inf) is hexapod


@pytest.mark.slow
@pytest.mark.parametrize("name", ["6-3-I", "6-5", "genhexkins"])
def test_other_mechanisms_have_motions_too(name: str) -> None:
    mechanism = load_spatial(name)
    check_useful(mechanism, calibration_targets(mechanism, EVERYWHERE), EVERYWHERE)


def swinging(swing: float, **changes: float) -> Mechanism:
    """The preset with joints that swing by so much [rad], and legs of 30 mm."""
    return load_mechanism(
        "hexapod", {"joints.base_swing": swing, "joints.platform_swing": swing, "bodies.leg_diameter": 0.03} | changes
    )


@pytest.mark.parametrize(
    ("swing", "box"),
    [
        pytest.param(0.15, Box(0.05, radians(15.0)), marks=pytest.mark.slow),
        pytest.param(0.3, EVERYWHERE, marks=pytest.mark.slow),
        pytest.param(0.3, Box(0.05, radians(15.0)), marks=pytest.mark.endurance),
        pytest.param(0.15, EVERYWHERE, marks=pytest.mark.endurance),
    ],
)
def test_what_is_planned_stays_within_swings_and_clearances(swing: float, box: Box) -> None:
    mechanism = swinging(swing)
    free = load_spatial("hexapod")
    wide = calibration_targets(free, box)["rests"]
    assert not margins(mechanism, wide.positions, wide.rotations).reachable.all(), "strokes alone do not keep within the swings"
    targets = calibration_targets(mechanism, box)
    check_useful(mechanism, targets, box)
    check_within(mechanism, targets, Demands())
    for target in targets.values():
        positions, rotations, _ = followed(mechanism, target, float(target.times[-1]))
        assert margins(mechanism, positions, rotations).reachable.all()
    home = mechanism.require_home()
    left = margins(mechanism, home.position[None], home.rotation[None]).of("platform swing")
    resting = margins(mechanism, targets["rests"].positions, targets["rests"].rotations).of("platform swing")
    assert resting.min() >= 0.1 * left.min(), "there is a reserve for the error of the pose"


@pytest.mark.slow
def test_the_limit_that_cuts_the_box_is_named() -> None:
    box, mechanism = Box(0.05, radians(15.0)), swinging(0.15)
    assert "mainly by the limit of the platform swing of leg" in cut_of_box(mechanism, calibration_targets(mechanism, box), box)
    free = load_spatial("hexapod")
    assert cut_of_box(free, calibration_targets(free, BOX), BOX) == ""


@pytest.mark.slow
def test_motions_beyond_a_limit_are_refused_with_the_box_as_the_remedy() -> None:
    targets = calibration_targets(load_spatial("hexapod"), EVERYWHERE)
    with pytest.raises(InputError, match=r"rests, up to .*platform swing of leg . would be .*: give a smaller --box"):
        check_within(swinging(0.15), targets, Demands())


@pytest.mark.slow
def test_limits_that_leave_too_little_are_told_apart_from_the_box() -> None:
    with pytest.raises(InputError, match=r"no poses to rest at within .* all other limits .*--box"):
        calibration_targets(swinging(0.03), EVERYWHERE)
    small, mechanism = Box(0.005, radians(1.0)), swinging(0.3)
    with pytest.raises(InputError, match=r"--box is too small: .* make it about .* times as large"):
        check_useful(mechanism, calibration_targets(mechanism, small), small)
    tight = swinging(0.05)
    with pytest.raises(InputError, match=r"has too little room .* its limits cut the --box to .* of the platform swing of leg"):
        check_useful(tight, calibration_targets(load_spatial("hexapod"), small), EVERYWHERE)


def test_a_home_without_room_for_the_trial_of_the_legs_is_refused() -> None:
    with pytest.raises(InputError, match=r"too close to a limit for the trial of leg ., which extends by 2 mm: the limit of"):
        check_within(swinging(0.002), {}, Demands())
