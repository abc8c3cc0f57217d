"""The refinement's twist against weighted least squares in NumPy, its misfit against SciPy's least squares."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from controller.cycle import STATE, cycle_parameters
from controller.settings import control_settings, fusion_settings
from tests.controller.cycles import refine
from tests.controller.leg_geometry import leg_directions, leg_vectors, rotation_of, skew


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
    expected = 2.0 * best.cost / freedom if freedom else 0.0
    np.testing.assert_allclose(pose["misfit"], expected, rtol=1e-4)
