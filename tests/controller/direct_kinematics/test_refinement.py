"""The refinement's twist against weighted least squares in NumPy, its misfit and its doubts against SciPy's least squares."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from controller.cycle import STATE, cycle_parameters
from controller.direct_kinematics import solve
from controller.direct_kinematics.refinement import find_doubts
from controller.direct_kinematics.spatial import LEG_SIGMA, TILT_SIGMA, YAW_SIGMA
from controller.direct_kinematics.synthetic import draw_measurements, draw_poses, measurements_of
from controller.settings import control_settings, fusion_settings
from plant.pose import pose_errors
from tests.controller.cycles import refine
from tests.controller.leg_geometry import UP, leg_directions, leg_vectors, rotation_of, skew


@pytest.mark.parametrize("left_out", [(), (2,), (0, 5)])
@pytest.mark.parametrize("vector_weights", [(4e5, 0.0), (4e5, 3e4), (0.0, 0.0)])
def test_the_twist_is_that_of_weighted_least_squares(hexapod, left_out, vector_weights):
    """Each leg tells of `P (v + omega x arm) / length`, each vector of the angular velocity across it, by its own weight."""
    random = np.random.default_rng(7)
    parameters = cycle_parameters(hexapod, 1000.0, control_settings(hexapod), fusion_settings(hexapod))
    in_base = parameters["rig"]["vectors_in_base"]
    for _ in range(5):
        position, rotation = hexapod.home.position + random.uniform(-0.03, 0.03, 3), rotation_of(random.uniform(-0.3, 0.3, 3))
        weights = random.uniform(1e5, 1e6, 6) * [leg not in left_out for leg in range(6)]
        rates, turning = random.normal(size=(6, 3)), random.normal(size=3)
        state = np.zeros((), STATE)
        legs, pose = state["legs"], state["pose"]
        legs["directions"], legs["rates"], legs["weights"] = leg_directions(hexapod, position, rotation), rates, weights
        pose["vectors"], pose["vector_weights"], state["platform"]["rate"] = in_base @ rotation, vector_weights, turning
        pose["position"], pose["rotation"] = position, rotation
        assert refine(parameters, state)
        rows, right = [], []
        for weight, rate, leg, joint in zip(
            weights, rates, leg_vectors(hexapod, position, rotation), hexapod.platform_joints, strict=True
        ):
            length, along = np.linalg.norm(leg), np.outer(leg, leg) / (leg @ leg)
            rows.append(np.sqrt(weight) / length * (np.eye(3) - along) @ np.hstack([np.eye(3), -skew(rotation @ joint)]))
            right.append(np.sqrt(weight) * (np.eye(3) - along) @ rate)
        for weight, known in zip(vector_weights, in_base, strict=True):
            across = np.sqrt(weight) * (np.eye(3) - np.outer(known, known))
            rows.append(np.hstack([np.zeros((3, 3)), across]))
            right.append(across @ rotation @ turning)
        expected = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
        np.testing.assert_allclose(pose["twist"], expected, rtol=0.0, atol=1e-8)
        # The information is that of the same rows.
        jacobian = np.vstack(rows)
        information = np.tril(pose["information"]) + np.tril(pose["information"], -1).T
        np.testing.assert_allclose(information, jacobian.T @ jacobian, rtol=1e-8, atol=1e-6 * np.abs(information).max())


@pytest.mark.parametrize(
    ("left_out", "vector_weights", "freedom"), [((), (4e5, 0.0), 8), ((2, 4), (4e5, 3e4), 6), ((0, 3, 5), (0.0, 0.0), 0)]
)
def test_the_misfit_is_what_the_best_pose_leaves_over(hexapod, left_out, vector_weights, freedom):
    random = np.random.default_rng(11)
    parameters = cycle_parameters(hexapod, 1000.0, control_settings(hexapod), fusion_settings(hexapod))
    in_base = parameters["rig"]["vectors_in_base"]
    position, rotation = hexapod.home.position, rotation_of(np.array([0.1, -0.2, 0.1]))
    weights = random.uniform(1e5, 1e6, 6) * [leg not in left_out for leg in range(6)]
    directions = leg_directions(hexapod, position, rotation) + 1e-4 * random.normal(size=(6, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, np.newaxis]
    vectors = in_base @ rotation_of(1e-4 * random.normal(size=3)) @ rotation
    state = np.zeros((), STATE)
    legs, pose = state["legs"], state["pose"]
    legs["directions"], legs["weights"] = directions, weights
    pose["vectors"], pose["vector_weights"], pose["position"], pose["rotation"] = vectors, vector_weights, position, rotation

    def left_over(step):
        turned = rotation_of(step[3:]) @ rotation
        off = directions - leg_directions(hexapod, position + step[:3], turned), in_base - vectors @ turned.T
        return np.concatenate(
            [
                (np.sqrt(w)[:, np.newaxis] * each).ravel()
                for w, each in zip((weights, np.array(vector_weights)), off, strict=True)
            ]
        )

    best = least_squares(left_over, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert refine(parameters, state)
    # Each measurement by itself, -1 where there is none.
    each = np.square(best.fun).reshape(8, 3).sum(axis=1)
    there = np.concatenate([weights, vector_weights]) > 0.0
    np.testing.assert_allclose(pose["misfits"][there], each[there], rtol=1e-3, atol=1e-7)
    assert (pose["misfits"][~there] == -1.0).all()
    expected = 2.0 * best.cost / freedom if freedom else 0.0
    np.testing.assert_allclose(pose["misfit"], expected, rtol=1e-4)


def wrong_directions(mechanism, wrong, angle):
    """Parameters, and a state at the home pose with some legs' directions turned by an angle [rad]."""
    parameters = cycle_parameters(mechanism, 1000.0, control_settings(mechanism), fusion_settings(mechanism))
    state, home = np.zeros((), STATE), mechanism.home
    directions, vectors = leg_directions(mechanism, home.position, home.rotation), np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    for k in wrong:
        across = np.cross(directions[k], [1.0, 0.3, 0.2])
        directions[k] = rotation_of(angle * across / np.linalg.norm(across)) @ directions[k]
    state["legs"]["directions"], state["legs"]["weights"] = directions, 4e5
    state["pose"]["vectors"], state["pose"]["vector_weights"] = vectors @ home.rotation, (4e5, 0.0)
    state["pose"]["position"], state["pose"]["rotation"] = home.position, home.rotation
    return parameters, state


def moved_by(parameters, state, mechanism, cycles):
    """How far refinements in so many cycles move the pose from home [m, rad]."""
    for _ in range(cycles):
        assert refine(parameters, state)
    off = pose_errors(state["pose"]["position"], state["pose"]["rotation"], mechanism.home.position, mechanism.home.rotation)
    return np.linalg.norm(off[:3]), np.linalg.norm(off[3:])


@pytest.mark.parametrize("wrong", range(6))
@pytest.mark.parametrize(("degrees", "share"), [(1.0, 0.2), (3.0, 0.02)])
def test_one_leg_that_is_off_moves_the_pose_much_less_far_than_in_least_squares(hexapod, wrong, degrees, share):
    """The first cycle has no doubts yet."""
    parameters, state = wrong_directions(hexapod, [wrong], np.radians(degrees))
    plain, doubting = (moved_by(parameters, state, hexapod, cycles) for cycles in (1, 20))
    assert doubting[0] < share * plain[0] and doubting[1] < share * plain[1]
    pose = state["pose"]
    assert np.argmax(pose["doubts"]) == wrong and pose["doubts"][wrong] > 4.0
    # The rest agrees.
    assert pose["rest_misfit"] < 0.02 * pose["misfit"]


def test_the_doubts_find_the_pose_of_their_own_weights(hexapod):
    """After some cycles the pose is that of SciPy's least squares with the reduced weights."""
    parameters, state = wrong_directions(hexapod, [2], np.radians(0.6))
    moved_by(parameters, state, hexapod, 50)
    pose, legs, home = state["pose"], state["legs"], hexapod.home
    weights = np.concatenate([legs["weights"], pose["vector_weights"]]) / (1.0 + pose["doubts"])

    def left_over(step):
        turned = rotation_of(step[3:]) @ home.rotation
        off = legs["directions"] - leg_directions(hexapod, home.position + step[:3], turned)
        tilt = np.array([0.0, 0.0, 1.0]) - turned @ pose["vectors"][0]
        return (np.sqrt(weights[:7])[:, np.newaxis] * np.vstack([off, tilt])).ravel()

    best = least_squares(left_over, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(pose["position"], home.position + best.x[:3], rtol=0.0, atol=1e-8)
    # Cauchy's weights, whose scale grows with what the others leave.
    squares = np.square(left_over(best.x)).reshape(7, 3).sum(axis=1) * (1.0 + pose["doubts"][:7])
    others = (squares.sum() - squares) / 6.0
    np.testing.assert_allclose(pose["doubts"][:7], squares / (9.0 + 6.0 * others), rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(pose["rest_misfit"], (squares.sum() - squares.max()) / 6.0, rtol=1e-4)


@given(st.lists(st.floats(0.0, 1e6), min_size=6, max_size=8))
def test_what_all_are_off_alike_is_hardly_doubted_and_one_alone_the_more(squares):
    misfits, doubts = np.array(squares), np.zeros(len(squares))
    rest = find_doubts(misfits, doubts)
    assert (doubts >= 0.0).all() and rest <= misfits.sum() / (2 * len(misfits) - 8) + 1e-9
    # The order of the measurements does not matter, and a worse one is doubted more.
    assert (np.diff(doubts[np.argsort(misfits)]) >= -1e-12 * doubts.max()).all()
    alike = np.full(len(squares), squares[0])
    find_doubts(alike, doubts)
    assert (doubts <= 1.0 / 6.0 + 1e-12).all()


@pytest.mark.parametrize("left_out", [(0, 1), (4, 6), (1, 2, 3)])
def test_with_few_measurements_none_is_doubted(hexapod, left_out):
    parameters, state = wrong_directions(hexapod, [5], np.radians(1.0))
    for k in left_out:
        if k == 6:
            state["pose"]["vector_weights"][0] = 0.0
        else:
            state["legs"]["weights"][k] = 0.0
    moved_by(parameters, state, hexapod, 3)
    assert (state["pose"]["doubts"] == 0.0).all() and state["pose"]["rest_misfit"] == 0.0
    assert state["pose"]["misfit"] > 1.0 or len(left_out) == 3


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_what_is_not_finite_is_not_doubted_for_ever(lost):
    doubts = np.full(7, np.nan)
    find_doubts(np.array([lost, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), doubts)
    assert np.isfinite(doubts).all() and doubts[0] == 0.0


@pytest.mark.parametrize("noise", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("method", ["section-5", "up", "normal", "legs"])
def test_the_covariance_is_from_equations_at_the_pose_however_few_steps_renewed_it(hexapod, method, noise):
    """Twins in NumPy: the inverse of the weighted normal matrix at the pose, and the pose is where their right side is zero."""
    random = np.random.default_rng(13)
    measured = draw_measurements(hexapod, *draw_poses(hexapod, 20, random), random, noise)
    for row in range(20):
        given = {name: values[row] for name, values in measurements_of(method, measured).items()}
        found = solve(hexapod, **given, method=method)
        yaw = 0.5 * YAW_SIGMA**-2
        known = []  # in {1}, in {2}, weight
        if method == "section-5":
            weights = yaw, yaw, TILT_SIGMA**-2 - yaw
            known = [(axis, given["rotation"].T @ axis, weight) for axis, weight in zip(np.eye(3), weights, strict=True)]
        elif method == "up":
            known = [(UP, given["up_in_platform"], TILT_SIGMA**-2)]
        elif method == "normal":
            known = [(given["normal"], UP, TILT_SIGMA**-2)]
        information, right = np.zeros((6, 6)), np.zeros(6)
        legs = leg_vectors(hexapod, found.position, found.rotation)
        for direction, leg, joint in zip(given["leg_directions"], legs, hexapod.platform_joints, strict=True):
            along = leg / np.linalg.norm(leg)
            jacobian = (
                (np.eye(3) - np.outer(along, along))
                / np.linalg.norm(leg)
                @ np.hstack([np.eye(3), -skew(found.rotation @ joint)])
            )
            information += jacobian.T @ jacobian / LEG_SIGMA**2
            right += jacobian.T @ (direction - along) / LEG_SIGMA**2
        for in_base, in_platform, weight in known:
            seen = found.rotation @ in_platform
            jacobian = np.hstack([np.zeros((3, 3)), -skew(seen)])
            information += weight * jacobian.T @ jacobian
            right += weight * jacobian.T @ (in_base - seen)
        expected = np.linalg.inv(information)
        deviations = np.sqrt(np.diag(expected))
        np.testing.assert_allclose((found.covariance - expected) / np.outer(deviations, deviations), 0.0, rtol=0.0, atol=1e-8)
        assert (np.abs(expected @ right) < 1e-7 * deviations).all()
