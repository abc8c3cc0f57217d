"""What contradicts the others, beside the pose that is solved without it."""

import numpy as np
import pytest

from controller.cycle import STATE, cycle_parameters
from controller.direct_kinematics import integrity, solve
from controller.direct_kinematics.refinement import normal_equations, solve_normal_equations
from controller.estimation import imu_monitor, pose_estimator
from controller.estimation.imu_monitor import contradiction, look_at_next
from controller.inverse_kinematics import inverse_kinematics, sample_workspace
from controller.settings import SafetySettings, control_settings, fusion_settings
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import load_mechanism
from plant.pose import Pose, rotation_from_vector

UP = np.array([0.0, 0.0, 1.0])
DEGREE = np.pi / 180.0


def monitored(mechanism, pose, directions, vertical, used=range(6), turns=1, smoothing=1.0, tilt_weight=None, before=0.0):
    """The monitor after it has looked at every IMU so many times, by default without a low-pass."""
    fusion = fusion_settings(mechanism)
    weights = np.zeros(6)
    weights[list(used)] = 1.0 / fusion.leg_sigma**2
    pose_state = np.zeros((), pose_estimator.STATE)[()]
    pose_state["position"], pose_state["rotation"] = pose.position, pose.rotation
    pose_state["vectors"], pose_state["vector_weights"] = vertical, (1.0 / fusion.tilt_sigma**2, 0.0)
    if tilt_weight is not None:
        pose_state["vector_weights"][0] = tilt_weight
    s = pose_state
    normal_equations(
        mechanism.base_joints, mechanism.platform_joints, directions, weights, np.array([UP, UP]), s["vectors"],
        s["vector_weights"], s["position"], s["rotation"], s["arms"], s["directions"], s["lengths"], s["information"],
        s["correction"],
    )  # fmt: skip
    assert solve_normal_equations(s["information"], s["correction"], s["factor"])
    s["weights"] = *weights, *s["vector_weights"]
    parameters, monitor = np.zeros((), imu_monitor.PARAMETERS), np.zeros((), imu_monitor.STATE)
    parameters["smoothing"] = smoothing
    monitor["contradiction"] = monitor["explained"] = monitor["squares"] = before
    for _ in range(turns * IMU_COUNT):
        look_at_next(parameters[()], monitor[()], pose_state, directions, weights, UP)
    return monitor


def measured(mechanism, seed, faulty, angle):
    """Directions and vertical at a random pose, with noise and one IMU that is off by an angle, and the true pose."""
    random = np.random.default_rng(seed)
    position, rotation = (each[0] for each in sample_workspace(mechanism, 1, seed=seed))
    directions = np.array(inverse_kinematics(mechanism, Pose(position, rotation)).directions)
    vertical = rotation[2].copy()
    for k in range(6):
        directions[k] = rotation_from_vector(random.normal(0.0, 0.03 * DEGREE, 3)) @ directions[k]
    across = np.cross(vertical if faulty == PLATFORM_IMU else directions[faulty], random.normal(size=3))
    turn = rotation_from_vector(angle * across / np.linalg.norm(across))
    if faulty == PLATFORM_IMU:
        vertical = turn @ vertical
    else:
        directions[faulty] = turn @ directions[faulty]
    return directions, vertical


@pytest.mark.parametrize("seed", range(10))
def test_a_contradiction_is_the_difference_to_the_pose_solved_without_the_imu(hexapod, seed):
    # To the first order, for which the fault is small.
    directions, vertical = measured(hexapod, seed, seed % 7, 0.02 * DEGREE)
    fitted = solve(hexapod, directions, up_in_platform=vertical)
    monitor = monitored(hexapod, fitted, directions, vertical)
    for k in range(6):
        without = directions.copy()
        without[k] = np.nan
        pose = solve(hexapod, without, up_in_platform=vertical)
        off = directions[k] - inverse_kinematics(hexapod, Pose(pose.position, pose.rotation)).directions[k]
        np.testing.assert_allclose(monitor["contradiction"][k], off, atol=0.03 * np.linalg.norm(off) + 1e-6)
    pose = solve(hexapod, directions)
    off = UP - pose.rotation @ vertical
    np.testing.assert_allclose(
        monitor["contradiction"][PLATFORM_IMU], off - UP * (UP @ off), atol=0.03 * np.linalg.norm(off) + 1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("mechanism", ["hexapod", "6-4-I", "genhexkins"])
@pytest.mark.parametrize("faulty", range(7))
def test_the_imu_that_explains_most_is_the_one_that_is_wrong_and_the_slow_twin_names_it_too(mechanism, faulty):
    mechanism = load_mechanism(mechanism)
    named = agreed = 0
    for seed in range(20):
        directions, vertical = measured(mechanism, seed, faulty, 2.0 * DEGREE)
        monitor = monitored(mechanism, solve(mechanism, directions, up_in_platform=vertical), directions, vertical)
        named += int(np.argmax(monitor["explained"])) == faulty
        agreed += integrity(mechanism, directions, up_in_platform=vertical).faulty in (faulty, None)
        assert contradiction(monitor[()], faulty) == pytest.approx(2.0 * DEGREE, rel=0.5)
    assert named >= 19
    assert agreed >= 19


def test_what_the_pose_needs_contradicts_nothing(hexapod):
    # Four legs alone have two degrees of freedom to spare; three with the vertical as well: none is decidable for sure.
    directions, vertical = measured(hexapod, 1, 0, 2.0 * DEGREE)
    fitted = solve(hexapod, np.where(np.isin(np.arange(6), (0, 2, 4))[:, None], directions, np.nan), up_in_platform=vertical)
    monitor = monitored(hexapod, fitted, directions, vertical, used=(0, 2, 4))
    assert np.isfinite(monitor["contradiction"]).all()
    for k in (1, 3, 5):
        assert contradiction(monitor[()], k) == 0.0


def test_in_the_cycle_it_is_off_for_raw_imus(hexapod):
    settings = control_settings(hexapod), fusion_settings(hexapod)
    assert cycle_parameters(hexapod, 1000.0, *settings, ALL_IMUS)["safety"]["monitor"]["active"] == 1
    assert np.zeros((), STATE)["safety"]["monitor"]["looked_at"] == 0


@pytest.mark.parametrize(
    ("rate", "disagreement", "smoothing", "lasting"),
    [(4000.0, 1.0, 7.0 / 120.0, 0.03), (1000.0, 1.0, 7.0 / 30.0, 0.03), (250.0, 1.2, 0.25, 0.084), (50.0, 6.0, 0.25, 0.42)],
)
def test_the_constants_are_those_of_the_settings_at_the_rate(rate, disagreement, smoothing, lasting):
    for watch in (0.0, 1.0):
        found = imu_monitor.monitor_parameters(SafetySettings(disagreement=0.05, watch_imus=watch), rate)
        assert found["active"] == watch
        assert float(found["disagreement"]) == pytest.approx(0.05 * disagreement)
        assert float(found["smoothing"]) == pytest.approx(smoothing)
        assert float(found["lasting"]) == pytest.approx(lasting)


def chi_squares(mechanism, pose, directions, vertical):
    """Of each IMU (7,), the square of its residual over its variance at a pose; the legs' directions may be NaN."""
    fusion = fusion_settings(mechanism)
    legs = directions - inverse_kinematics(mechanism, Pose(pose.position, pose.rotation)).directions
    up = UP - pose.rotation @ vertical
    return np.array([*np.sum(legs**2, axis=1) / fusion.leg_sigma**2, up @ up / fusion.tilt_sigma**2])


@pytest.mark.parametrize("faulty", range(7))
def test_what_an_imu_explains_is_by_how_much_the_others_fit_better_without_it(hexapod, faulty):
    sigmas = {"leg_sigma": fusion_settings(hexapod).leg_sigma, "tilt_sigma": fusion_settings(hexapod).tilt_sigma}
    directions, vertical = measured(hexapod, 30 + faulty, faulty, 0.02 * DEGREE)
    fitted = solve(hexapod, directions, up_in_platform=vertical, **sigmas)
    monitor = monitored(hexapod, fitted, directions, vertical)
    squares = chi_squares(hexapod, fitted, directions, vertical)
    # The share of a residual along the direction itself is of second order.
    np.testing.assert_allclose(monitor["squares"], squares, rtol=1e-3, atol=1e-6)
    for k in range(7):
        without = directions.copy()
        without[k if k < 6 else []] = np.nan
        extra = {"up_in_platform": vertical} if k < 6 else {}
        pose = solve(hexapod, without, **extra, **(sigmas if k < 6 else {"leg_sigma": sigmas["leg_sigma"]}))
        left = chi_squares(hexapod, pose, without, vertical)
        explained = squares.sum() - np.delete(left, k).sum()
        assert monitor["explained"][k] == pytest.approx(explained, rel=0.03, abs=1e-3 * squares.sum())


def test_every_look_counts_by_the_share_of_the_low_pass(hexapod):
    directions, vertical = measured(hexapod, 3, 2, 2.0 * DEGREE)
    fitted = solve(hexapod, directions, up_in_platform=vertical)
    whole = monitored(hexapod, fitted, directions, vertical)
    for turns in (1, 2, 5):
        some = monitored(hexapod, fitted, directions, vertical, turns=turns, smoothing=0.2)
        for name in ("contradiction", "explained", "squares"):
            np.testing.assert_allclose(some[name], (1.0 - 0.8**turns) * whole[name], rtol=1e-10)
        assert some["looked_at"] == 0


def test_what_was_known_of_an_imu_is_forgotten_when_it_is_not_used(hexapod):
    directions, vertical = measured(hexapod, 1, 0, 2.0 * DEGREE)
    fitted = solve(hexapod, directions, up_in_platform=vertical)
    some = monitored(hexapod, fitted, directions, vertical, used=(0, 1, 2, 3, 5), smoothing=0.2, tilt_weight=0.0, before=3.0)
    for k in range(7):
        values = [*some["contradiction"][k], some["explained"][k], some["squares"][k]]
        assert all(value == 0.0 for value in values) if k in (4, 6) else all(value != 0.0 for value in values)
