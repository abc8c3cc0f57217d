"""The motions of a calibration within a user's limits: they begin and end at home, stay inside, and are worth it."""

from math import inf, radians

import numpy as np
import pytest

from controller.direct_kinematics import poses_from_lengths
from controller.planning.motions import EVERYWHERE, Box, rests, shaking
from controller.planning.offline_planner import plan
from controller.planning.segments import evaluate_reference
from hil.calibration.data import TO_50_UM, Knowledge
from hil.calibration.drives import within_drives
from hil.calibration.excitation import (
    MotionLimits,
    calibration_targets,
    check_useful,
    expected_accuracy,
    gentle_mechanism,
)
from plant.errors import InputError
from plant.mechanism import Mechanism, load_spatial
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


@pytest.mark.slow
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
