"""Direct kinematics: poses come back, closed forms and refinement agree with independent derivations, and the covariance and
the noise figures of the design hold.
"""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from controller.direct_kinematics import (
    integrity,
    pose_difference,
    pose_from_lengths,
    poses_from_lengths,
    required_measurements,
    solve,
    solve_batch,
)
from controller.direct_kinematics.geometry import SCRATCH, geometry_of
from controller.direct_kinematics.legs_and_attitude import pose_from_rotation, rotation_between
from controller.inverse_kinematics import leg_lengths, sample_workspace
from controller.least_squares import RANK_TOLERANCE
from plant.errors import GoughError, InputError, SingularConfigurationError
from plant.mechanism import Mechanism, load_mechanism
from plant.pose import Pose
from tests.controller.leg_geometry import (
    UP,
    angle_between,
    leg_directions,
    leg_vectors,
    random_mechanism,
    random_rotation,
    rotation_of,
    skew,
    unit,
)

SEEDS = st.integers(0, 2**32 - 1)
YAWS = st.one_of(
    st.floats(-np.pi, np.pi), st.sampled_from([0.0, np.pi, -np.pi, np.pi - 1e-9, np.pi / 2, -np.pi / 2, 1e-12, 2.0, -3.0])
)
TILTS = st.one_of(
    st.floats(0.0, np.pi), st.sampled_from([0.0, 1e-12, 1e-8, np.pi / 2, np.pi - 1e-5, np.pi - 1e-8, np.pi - 1e-12, np.pi])
)
DEGREE = np.pi / 180.0


# ---------------------------------------------------------------------------------------------------- independent twins


def position_twin(mechanism, directions, rotation):
    """The paper's (21)-(28) as printed: three rows a leg, skew(r) (p + R a - b) = 0."""
    matrix = np.vstack([skew(r) for r in directions])
    right = np.concatenate(
        [
            -skew(r) @ (rotation @ a - b)
            for r, a, b in zip(directions, mechanism.platform_joints, mechanism.base_joints, strict=True)
        ]
    )
    return np.linalg.lstsq(matrix, right, rcond=None)[0]


def vector_system(mechanism, directions, in_base, in_platform):
    """Design 5.3, five unknowns (p, cos, sin): R = Rot(in_base, yaw) R_0, with an R_0 of SciPy's."""
    r0 = Rotation.align_vectors(in_base[None], in_platform[None])[0].as_matrix()
    along = np.outer(in_base, in_base)
    rows, right = [], []
    for r, a, b in zip(directions, mechanism.platform_joints, mechanism.base_joints, strict=True):
        q = r0 @ a
        rows.append(skew(r) @ np.column_stack([np.eye(3), q - along @ q, skew(in_base) @ q]))
        right.append(skew(r) @ (b - along @ q))
    return np.vstack(rows), np.concatenate(right), r0


def vector_twin(mechanism, directions, in_base, in_platform):
    matrix, right, r0 = vector_system(mechanism, directions, in_base, in_platform)
    x = np.linalg.lstsq(matrix, right, rcond=None)[0]
    rotation = rotation_of(np.arctan2(x[4], x[3]) * in_base) @ r0
    return position_twin(mechanism, directions, rotation), rotation


def legs_system(mechanism, directions):
    """Design 5.3, nine unknowns: p and the two columns of R that turn x and y of joints in the plane z = 0 of {2}."""
    joints = zip(directions, mechanism.platform_joints, strict=True)
    rows = [skew(r) @ np.kron([1.0, a[0], a[1]], np.eye(3)) for r, a in joints]
    return np.vstack(rows), np.concatenate([skew(r) @ b for r, b in zip(directions, mechanism.base_joints, strict=True)])


def legs_twin(mechanism, directions):
    matrix, right = legs_system(mechanism, directions)
    x = np.linalg.lstsq(matrix, right, rcond=None)[0]
    u, _, vt = np.linalg.svd(x[3:].reshape(2, 3).T, full_matrices=False)
    columns = u @ vt
    rotation = np.column_stack([columns, np.cross(columns[:, 0], columns[:, 1])])
    return position_twin(mechanism, directions, rotation), rotation


def refined_twin(mechanism, directions, vectors, start, leg_sigma):
    """Weighted least squares over the pose by SciPy; `vectors` has rows of (in {1}, in {2}, sigma)."""

    def residuals(x):
        rotation = rotation_of(x[3:]) @ start.rotation
        predicted = leg_directions(mechanism, start.position + x[:3], rotation)
        parts = [((directions - predicted) / leg_sigma)[~np.isnan(directions)]]
        parts += [np.cross(b, rotation @ v) / sigma for b, v, sigma in vectors]
        return np.concatenate(parts)

    found = least_squares(residuals, np.zeros(6), jac="3-point", x_scale=[1e-3] * 3 + [1e-2] * 3, xtol=1e-15, ftol=1e-15)
    return start.position + found.x[:3], rotation_of(found.x[3:]) @ start.rotation


# ------------------------------------------------------------------------------------------------- the kernels, unrefined


def run_closed_form(mechanism, directions, **given):
    solution = solve(mechanism, directions, refine=False, **given)
    return solution.position, solution.rotation


def noisy_directions(random, mechanism, position, rotation, sigma):
    return unit(leg_directions(mechanism, position, rotation) + random.normal(scale=sigma, size=(6, 3)))


def with_legs(directions, legs):
    kept = np.full((6, 3), np.nan)
    kept[list(legs)] = directions[list(legs)]
    return kept


def assert_pose(solution, position, rotation, tolerance=1e-9):
    assert np.linalg.norm(solution.position - position) < tolerance
    assert angle_between(solution.rotation, rotation) < tolerance
    np.testing.assert_allclose(solution.rotation @ solution.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(solution.rotation) > 0.0


def reciprocal_condition(matrix):
    singular_values = np.linalg.svd(matrix, compute_uv=False)
    return singular_values[-1] / singular_values[0]


def design_pose(random, mechanism):
    """A pose as the noise table of design 5.3 has them: home +-50 mm and +-15 deg (xyz angles)."""
    rotation = Rotation.from_euler("xyz", random.uniform(-15.0, 15.0, 3), degrees=True).as_matrix()
    return mechanism.home.position + random.uniform(-0.05, 0.05, 3), rotation


# --------------------------------------------------------------------------------------------- noise-free poses come back


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(SEEDS, YAWS, TILTS, st.booleans())
def test_every_set_of_measurements_gives_back_a_noise_free_pose(seed, yaw, tilt, coplanar):
    random = np.random.default_rng(seed)
    up = unit(random.normal(size=3))
    mechanism = random_mechanism(random, coplanar=coplanar, up_in_base=up)
    across = unit(np.cross(up, random.normal(size=3)))
    rotation = rotation_of(yaw * up) @ rotation_of(tilt * across)
    # Legs as in practice, 0.2 to 0.6 m long, whichever way the base lies.
    position = random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4] - rotation @ mechanism.platform_joints.mean(axis=0)
    directions = leg_directions(mechanism, position, rotation)

    assert_pose(solve(mechanism, directions, rotation=rotation), position, rotation)
    seen, normal = rotation.T @ up, rotation[:, 2]
    assume(reciprocal_condition(vector_system(mechanism, directions, up, seen)[0]) > 1e-3)
    solution = solve(mechanism, directions, up_in_platform=seen)
    assert solution.method == "up"
    assert_pose(solution, position, rotation)
    assert np.abs(solution.residuals).max() < 1e-9
    assume(reciprocal_condition(vector_system(mechanism, directions, normal, UP)[0]) > 1e-3)
    solution = solve(mechanism, directions, normal=normal)
    assert solution.method == "normal"
    assert_pose(solution, position, rotation)
    solution = solve(mechanism, directions, normal=normal, up_in_platform=seen, rotation=rotation)
    assert solution.method == "section-5"
    assert_pose(solution, position, rotation)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(SEEDS, YAWS, TILTS)
def test_legs_alone_give_back_the_pose_of_coplanar_platform_joints(seed, yaw, tilt):
    random = np.random.default_rng(seed)
    mechanism = random_mechanism(random, up_in_base=unit(random.normal(size=3)))
    rotation = rotation_of(yaw * UP) @ rotation_of([tilt, 0.0, 0.0])
    position = random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4] - rotation @ mechanism.platform_joints.mean(axis=0)
    directions = leg_directions(mechanism, position, rotation)
    assume(nine_unknowns_condition(mechanism, directions) > 1e-3)
    solution = solve(mechanism, directions)
    assert solution.method == "legs"
    assert_pose(solution, position, rotation)
    assert np.abs(solution.residuals).max() < 1e-9


def nine_unknowns_condition(mechanism, directions):
    """Of design 5.3's system of legs alone, in coordinates of the platform's own plane."""
    centered = mechanism.platform_joints - mechanism.platform_joints.mean(axis=0)
    flat = centered @ np.linalg.svd(centered)[2].T
    rows = [skew(r) @ np.kron([1.0, a[0], a[1]], np.eye(3)) for r, a in zip(directions, flat, strict=True)]
    return reciprocal_condition(np.vstack(rows))


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.sampled_from([(6, 3), (3, 6), (5, 4), (4, 5), (5, 5), (4, 4), (3, 3), (3, 5), (6, 4)]))
def test_mechanisms_with_shared_joints_are_solved_from_their_two_arrays(seed, counts):
    random = np.random.default_rng(seed)
    mechanism = random_mechanism(random, *counts)
    rotation = rotation_of(random.uniform(-0.6, 0.6, 3))
    position = random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4]
    directions = leg_directions(mechanism, position, rotation)
    up, normal = rotation.T @ UP, rotation[:, 2]
    assert_pose(solve(mechanism, directions, rotation=rotation), position, rotation)
    if reciprocal_condition(vector_system(mechanism, directions, UP, up)[0]) > 1e-3:
        assert_pose(solve(mechanism, directions, up_in_platform=up), position, rotation)
    if reciprocal_condition(vector_system(mechanism, directions, normal, UP)[0]) > 1e-3:
        assert_pose(solve(mechanism, directions, normal=normal), position, rotation)
    if nine_unknowns_condition(mechanism, directions) > 1e-3:
        assert_pose(solve(mechanism, directions), position, rotation)


def octahedral(random):
    """A 6-3 mechanism of type I: platform joints in pairs, base joints all apart."""
    angles = np.radians([-20.0, 20.0, 100.0, 140.0, 220.0, 260.0]) + random.uniform(-0.1, 0.1, 6)
    base = 0.3 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(6)])
    corners = np.radians([60.0, 180.0, 300.0])[[2, 0, 0, 1, 1, 2]]
    return Mechanism.from_legs(base, 0.2 * np.column_stack([np.cos(corners), np.sin(corners), np.zeros(6)]))


def test_the_papers_6_3_mechanism_needs_its_legs_alone():
    random = np.random.default_rng(0)
    mechanism = octahedral(random)
    for _ in range(20):
        rotation, position = rotation_of(random.uniform(-0.3, 0.3, 3)), random.uniform(-0.05, 0.05, 3) + [0.0, 0.0, 0.4]
        directions = leg_directions(mechanism, position, rotation)
        assert_pose(solve(mechanism, directions), position, rotation)
        # The construction of section 3.1.1: the lines of a pair meet in their platform joint.
        for first, second in ((0, 5), (1, 2), (3, 4)):
            lines = np.column_stack([directions[first], -directions[second]])
            along = np.linalg.lstsq(lines, mechanism.base_joints[second] - mechanism.base_joints[first], rcond=None)[0]
            meeting = mechanism.base_joints[first] + along[0] * directions[first]
            np.testing.assert_allclose(meeting, position + rotation @ mechanism.platform_joints[first], atol=1e-12)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, -0.8, 0.0)])
@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-8, 1e-4])
@pytest.mark.parametrize("yaw", [0.0, 2.5, np.pi])
def test_a_platform_upside_down_is_no_exception(hexapod, axis, off, yaw):
    rotation = rotation_of([0.0, 0.0, yaw]) @ rotation_of((np.pi - off) * np.array(axis))
    if off == 0.0 and axis == (1.0, 0.0, 0.0) and yaw == 0.0:
        rotation = np.diag([1.0, -1.0, -1.0])
    position = np.array([0.02, 0.01, 0.4])
    directions = leg_directions(hexapod, position, rotation)
    up = rotation.T @ UP
    assert up[2] < -0.99
    assert_pose(solve(hexapod, directions, up_in_platform=up), position, rotation)
    assert_pose(solve(hexapod, directions, normal=rotation[:, 2]), position, rotation)
    assert_pose(solve(hexapod, directions), position, rotation)


def test_rotations_between_vectors_carry_one_to_the_other():
    random = np.random.default_rng(4)
    cases = [(unit(random.normal(size=3)), unit(random.normal(size=3))) for _ in range(200)]
    axes = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    cases += [(a, b) for a in axes for b in axes]
    for a in [unit(random.normal(size=3)) for _ in range(50)]:
        for off in (0.0, 1e-16, 1e-12, 1e-8, 1e-4):
            cases += [(a, unit(-a + off * random.normal(size=3))), (a, unit(a + off * random.normal(size=3)))]
    for start, end in cases:
        rotation = np.empty((3, 3))
        rotation_between(start, end, rotation)
        np.testing.assert_allclose(rotation @ start, end, atol=4e-16)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(rotation) > 0.0


# ------------------------------------------------------------------------------------------------------------- fewer legs


@pytest.mark.parametrize("legs", list(combinations(range(6), 2)))
def test_two_legs_and_the_rotation_are_enough(hexapod, legs):
    random = np.random.default_rng(sum(legs))
    rotation, position = rotation_of(random.uniform(-0.3, 0.3, 3)), random.uniform(-0.05, 0.05, 3) + [0.0, 0.0, 0.35]
    directions = with_legs(leg_directions(hexapod, position, rotation), legs)
    solution = solve(hexapod, directions, rotation=rotation)
    assert_pose(solution, position, rotation)
    unmeasured = [leg for leg in range(6) if leg not in legs]
    assert np.isnan(solution.residuals[unmeasured]).all()
    assert np.abs(solution.residuals[list(legs)]).max() < 1e-12


@pytest.mark.parametrize("legs", list(combinations(range(6), 3)))
def test_three_legs_and_the_vertical_are_enough(hexapod, legs):
    random = np.random.default_rng(sum(legs))
    for _ in range(5):
        rotation, position = rotation_of(random.uniform(-0.3, 0.3, 3)), random.uniform(-0.05, 0.05, 3) + [0.0, 0.0, 0.35]
        directions = leg_directions(hexapod, position, rotation)
        matrix, _, _ = vector_system(hexapod, directions, UP, rotation.T @ UP)
        if reciprocal_condition(matrix.reshape(6, 3, 5)[list(legs)].reshape(9, 5)) < 1e-3:
            continue
        solution = solve(hexapod, with_legs(directions, legs), up_in_platform=rotation.T @ UP)
        assert_pose(solution, position, rotation)
        np.testing.assert_array_equal(np.isnan(solution.residuals).all(axis=1), [leg not in legs for leg in range(6)])


@pytest.mark.parametrize("lost", range(6))
def test_five_legs_alone_are_enough_for_a_6_6(hexapod, lost):
    rotation, position = rotation_of([0.1, -0.05, 0.08]), np.array([0.02, -0.01, 0.36])
    legs = [leg for leg in range(6) if leg != lost]
    assert_pose(solve(hexapod, with_legs(leg_directions(hexapod, position, rotation), legs)), position, rotation)


# ------------------------------------------------------------------------------------------ agreement of closed forms


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.floats(-6.0, -2.0), st.booleans())
def test_closed_forms_agree_with_lapack_on_noisy_directions(seed, exponent, anywhere):
    random = np.random.default_rng(seed)
    mechanism = random_mechanism(random, *(int(n) for n in random.integers(4, 7, 2)), up_in_base=unit(random.normal(size=3)))
    rotation = random_rotation(random) if anywhere else rotation_of(random.uniform(-0.5, 0.5, 3))
    position = random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4]
    directions = noisy_directions(random, mechanism, position, rotation, 10.0**exponent)
    up, seen = mechanism.up_in_base, unit(rotation.T @ mechanism.up_in_base + random.normal(scale=10.0**exponent, size=3))

    found, _ = run_closed_form(mechanism, directions, rotation=rotation)
    np.testing.assert_allclose(found, position_twin(mechanism, directions, rotation), rtol=0.0, atol=1e-10)

    assume(reciprocal_condition(vector_system(mechanism, directions, up, seen)[0]) > 1e-3)
    found, turned = run_closed_form(mechanism, directions, up_in_platform=seen)
    expected = vector_twin(mechanism, directions, up, seen)
    np.testing.assert_allclose(found, expected[0], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(turned, expected[1], rtol=0.0, atol=1e-10)


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.floats(-6.0, -2.5))
def test_the_closed_form_of_legs_alone_agrees_with_lapack_on_noisy_directions(seed, exponent):
    random = np.random.default_rng(seed)
    mechanism = flat_mechanism(random, *(int(n) for n in random.integers(4, 7, 2)))
    rotation, position = random_rotation(random), random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4]
    directions = noisy_directions(random, mechanism, position, rotation, 10.0**exponent)
    assume(reciprocal_condition(legs_system(mechanism, directions)[0]) > 1e-3)
    found, turned = run_closed_form(mechanism, directions)
    expected = legs_twin(mechanism, directions)
    np.testing.assert_allclose(found, expected[0], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(turned, expected[1], rtol=0.0, atol=1e-10)


def flat_mechanism(random, base_count, platform_count):
    """Platform joints in the plane z = 0 of {2}, as the nine unknowns of the design have them."""
    tilted = random_mechanism(random, base_count, platform_count)
    platform = tilted.platform_joints - tilted.platform_joints.mean(axis=0)
    _, _, axes = np.linalg.svd(platform)
    return Mechanism.from_legs(tilted.base_joints, platform @ axes.T * [1.0, 1.0, 0.0])


# ------------------------------------------------------------------------------------------------------------ refinement


@pytest.mark.slow
@pytest.mark.parametrize("known", ["legs", "up", "normal", "both"])
@pytest.mark.parametrize("legs", [range(6), range(5)])
def test_the_solution_is_the_weighted_least_squares_minimum(hexapod, known, legs):
    random = np.random.default_rng(5)
    leg_sigma, tilt_sigma = 0.05 * DEGREE, 0.02 * DEGREE
    for _ in range(10):
        position, rotation = design_pose(random, hexapod)
        directions = with_legs(noisy_directions(random, hexapod, position, rotation, leg_sigma), legs)
        given_vectors, vectors = {}, []
        if known in ("up", "both"):
            seen = unit(rotation.T @ UP + random.normal(scale=tilt_sigma, size=3))
            given_vectors["up_in_platform"] = seen
            vectors.append((UP, seen, tilt_sigma))
        if known in ("normal", "both"):
            normal = unit(rotation @ UP + random.normal(scale=tilt_sigma, size=3))
            given_vectors["normal"] = normal
            vectors.append((normal, UP, tilt_sigma))
        solution = solve(hexapod, directions, leg_sigma=leg_sigma, tilt_sigma=tilt_sigma, **given_vectors)
        expected = refined_twin(hexapod, directions, vectors, Pose(position, rotation), leg_sigma)
        # Cross products are sines where the refinement has chords; cubes of 0.02 deg are between them.
        assert np.linalg.norm(solution.position - expected[0]) < 1e-9
        # What SciPy's stopping rule leaves differs by machine, most for the weakly determined attitude.
        assert angle_between(solution.rotation, expected[1]) < 1e-8
        residuals = solution.residuals[list(legs)]
        predicted = leg_directions(hexapod, solution.position, solution.rotation)[list(legs)]
        np.testing.assert_allclose(directions[list(legs)] - residuals, predicted, atol=1e-12)


@pytest.mark.parametrize("legs", [range(6), (0, 3)])
def test_with_a_measured_rotation_the_solution_weighs_tilt_and_yaw_by_their_sigmas(hexapod, legs):
    random = np.random.default_rng(6)
    leg_sigma, tilt_sigma, yaw_sigma = 0.05 * DEGREE, 0.05 * DEGREE, 1.5 * DEGREE
    sigmas = np.array([tilt_sigma, tilt_sigma, yaw_sigma])
    for _ in range(10):
        position, rotation = design_pose(random, hexapod)
        directions = with_legs(noisy_directions(random, hexapod, position, rotation, leg_sigma), legs)
        measured = rotation_of(random.normal(size=3) * sigmas) @ rotation

        def residuals(x, position=position, rotation=rotation, directions=directions, measured=measured):
            turned = rotation_of(x[3:]) @ rotation
            predicted = leg_directions(hexapod, position + x[:3], turned)
            off = Rotation.from_matrix(measured @ turned.T).as_rotvec() / sigmas
            return np.concatenate([((directions - predicted) / leg_sigma)[~np.isnan(directions)], off])

        solution = solve(hexapod, directions, rotation=measured)
        x = np.concatenate([solution.position - position, Rotation.from_matrix(solution.rotation @ rotation.T).as_rotvec()])
        best = least_squares(residuals, np.zeros(6), jac="3-point", x_scale=[1e-3] * 3 + [1e-2] * 3, xtol=1e-15, ftol=1e-15).x
        # A rotation's vector and the sines of its turn part in the third order; what counts is the covariance's own scale.
        off = x - best
        assert off @ np.linalg.solve(solution.covariance, off) < 0.02**2


def consistency(mechanism, known, legs, tilt_sigma, yaw_sigma, runs=1000):
    """Sum of the normalised squared errors of noisy runs, with the chi-square bounds that 99 % of such sums keep to."""
    random = np.random.default_rng(7)
    leg_sigma, total = 0.01 * DEGREE, 0.0
    for _ in range(runs):
        position, rotation = design_pose(random, mechanism)
        directions = with_legs(noisy_directions(random, mechanism, position, rotation, leg_sigma), legs)
        extra = {}
        if known == "up":
            extra["up_in_platform"] = unit(rotation.T @ UP + random.normal(scale=tilt_sigma, size=3))
        elif known == "normal":
            extra["normal"] = unit(rotation @ UP + random.normal(scale=tilt_sigma, size=3))
        elif known == "rotation":
            extra["rotation"] = rotation_of(random.normal(size=3) * [tilt_sigma, tilt_sigma, yaw_sigma]) @ rotation
        solution = solve(mechanism, directions, leg_sigma=leg_sigma, tilt_sigma=tilt_sigma, yaw_sigma=yaw_sigma, **extra)
        turned = Rotation.from_matrix(rotation @ solution.rotation.T).as_rotvec()
        error = np.concatenate([position - solution.position, turned])
        total += error @ np.linalg.solve(solution.covariance, error)
    return total, chi2.ppf([0.005, 0.995], 6 * runs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("known", "legs", "tilt_deg", "yaw_deg"),
    [
        ("legs", range(6), 1.0, 1.0),
        ("up", range(6), 0.01, 1.0),
        ("up", (0, 1, 3), 0.01, 1.0),
        ("normal", range(6), 0.02, 1.0),
        ("rotation", range(6), 0.01, 0.3),
        ("rotation", (0, 3), 0.05, 0.5),
        ("rotation", (0, 3), 0.1, 0.1),
        ("rotation", (0, 3), 0.2, 0.05),
    ],
)
def test_the_covariance_is_that_of_the_errors(hexapod, known, legs, tilt_deg, yaw_deg):
    total, (least, greatest) = consistency(hexapod, known, legs, tilt_deg * DEGREE, yaw_deg * DEGREE)
    assert least < total < greatest


def test_a_covariance_is_symmetric_and_scales_with_the_variances(hexapod):
    directions = leg_directions(hexapod, hexapod.home.position, np.eye(3))
    fine = solve(hexapod, directions, up_in_platform=UP, leg_sigma=1e-4, tilt_sigma=2e-4)
    coarse = solve(hexapod, directions, up_in_platform=UP, leg_sigma=1e-3, tilt_sigma=2e-3)
    np.testing.assert_allclose(coarse.covariance, 100.0 * fine.covariance, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(fine.covariance, fine.covariance.T, rtol=1e-9, atol=1e-18)
    assert (np.linalg.eigvalsh(fine.covariance) > 0.0).all()


@pytest.mark.slow
def test_the_noise_figures_of_the_design_hold(hexapod):
    """Design 5.3: 0.05 deg on each component of every leg and on roll and pitch, 1.5 deg on a magnetic yaw, 1500 poses."""
    random = np.random.default_rng(8)
    sigma, errors = 0.05 * DEGREE, {}

    def note(method, found, truth):
        apart = np.linalg.norm(found[0] - truth[0]), angle_between(found[1], truth[1])
        errors.setdefault(method, []).append(np.square(apart))

    for _ in range(1500):
        truth = design_pose(random, hexapod)
        directions = noisy_directions(random, hexapod, *truth, sigma)
        seen = unit(truth[1].T @ UP + random.normal(scale=sigma, size=3))
        measured = rotation_of(random.normal(size=3) * [sigma, sigma, 1.5 * DEGREE]) @ truth[1]
        note("section 5, two legs", run_closed_form(hexapod, with_legs(directions, (0, 3)), rotation=measured), truth)
        note("section 5, six legs", run_closed_form(hexapod, directions, rotation=measured), truth)
        note("legs", run_closed_form(hexapod, directions), truth)
        note("legs and vertical", run_closed_form(hexapod, directions, up_in_platform=seen), truth)
        refined = solve(hexapod, directions, up_in_platform=seen)
        note("refined", (refined.position, refined.rotation), truth)

    found = {method: np.sqrt(np.mean(squares, axis=0)) * [1e3, 1.0 / DEGREE] for method, squares in errors.items()}
    expected = {
        "section 5, two legs": (6.28, 1.48),
        "section 5, six legs": (1.31, 1.48),
        "legs": (0.386, 0.195),
        "legs and vertical": (0.374, 0.083),
        "refined": (0.373, 0.078),
    }
    for method, figures in expected.items():
        np.testing.assert_allclose(found[method], figures, rtol=0.1, err_msg=method)
    assert found["refined"][1] < found["legs and vertical"][1]


# ----------------------------------------------------------------------------------------------------------------- errors


def home_directions(mechanism):
    return leg_directions(mechanism, mechanism.home.position, np.eye(3))


def test_too_few_legs_do_not_determine_the_pose(hexapod):
    directions = home_directions(hexapod)
    for legs, extra in (
        ((), {"rotation": np.eye(3)}),
        ((2,), {"rotation": np.eye(3)}),
        ((0, 3), {"up_in_platform": UP}),
        ((0, 3), {"normal": UP}),
        ((), {}),
        ((0, 1, 2), {}),
    ):
        with pytest.raises(SingularConfigurationError, match="measure more"):
            solve(hexapod, with_legs(directions, legs), **extra)


def test_parallel_legs_do_not_determine_the_pose(hexapod):
    parallel = np.tile(unit([0.1, -0.2, 1.0]), (6, 1))
    for extra in ({"rotation": np.eye(3)}, {"up_in_platform": UP}, {"normal": UP}, {}):
        with pytest.raises(SingularConfigurationError):
            solve(hexapod, parallel, **extra)
    two = with_legs(parallel, (1, 4))
    with pytest.raises(SingularConfigurationError):
        solve(hexapod, two, rotation=np.eye(3))


@pytest.mark.parametrize("known", ["rotation", "up_in_platform", "normal", "legs"])
def test_legs_that_are_parallel_but_for_rounding_give_an_error_and_no_number(hexapod, known):
    """Design 5.2. A thousandth of the assumed noise tells nothing: the lines meet a thousand metres away, or below the base."""
    random = np.random.default_rng(10)
    extra = {"rotation": np.eye(3), "up_in_platform": UP, "normal": UP}
    for _ in range(20):
        directions = unit(np.tile(UP, (6, 1)) + random.normal(scale=1e-7, size=(6, 3)))
        with pytest.raises(SingularConfigurationError):
            solve(hexapod, directions, **({known: extra[known]} if known in extra else {}))


def test_a_platform_alike_its_base_is_singular_where_the_design_says_so():
    angles = np.radians([10.0, 50.0, 130.0, 170.0, 250.0, 290.0])
    base = 0.3 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(6)])
    mechanism = Mechanism.from_legs(base, 0.6 * base)
    tilted = rotation_of([0.2, 0.1, 0.3])
    position = np.array([0.01, 0.02, 0.4])
    # With legs alone "base and platform coincide, all lengths zero" fits as well, at every pose.
    directions = leg_directions(mechanism, position, tilted)
    with pytest.raises(SingularConfigurationError):
        solve(mechanism, directions)
    assert_pose(solve(mechanism, directions, up_in_platform=tilted.T @ UP), position, tilted)
    # With the vertical the same happens on a level platform, of any yaw; the rotation settles it.
    level = rotation_of([0.0, 0.0, 0.3])
    directions = leg_directions(mechanism, position, level)
    with pytest.raises(SingularConfigurationError):
        solve(mechanism, directions, up_in_platform=UP)
    assert_pose(solve(mechanism, directions, rotation=level), position, level)


@pytest.mark.parametrize("known", ["rotation", "up_in_platform", "normal", "legs"])
def test_directions_down_the_legs_are_refused(hexapod, known):
    rotation, position = rotation_of([0.1, 0.05, -0.2]), np.array([0.02, 0.01, 0.36])
    extra = {"rotation": rotation, "up_in_platform": rotation.T @ UP, "normal": rotation[:, 2]}
    extra = {known: extra[known]} if known in extra else {}
    directions = leg_directions(hexapod, position, rotation)
    assert_pose(solve(hexapod, directions, **extra), position, rotation)
    for reversed_legs in (range(6), (2,)):
        turned = directions.copy()
        turned[list(reversed_legs)] *= -1.0
        with pytest.raises(SingularConfigurationError, match="negative length"):
            solve(hexapod, turned, **extra)


def test_malformed_measurements_are_refused_by_name(hexapod):
    good = home_directions(hexapod)

    def changed(row, column, value):
        directions = good.copy()
        directions[row, column] = value
        return directions

    cases = [
        (changed(2, 1, np.nan), {}, r"leg_directions\[2\]"),
        (changed(2, 1, np.inf), {}, r"leg_directions\[2\].*finite"),
        (changed(4, 2, good[4, 2] + 0.01), {}, r"leg_directions\[4\]"),
        (changed(4, slice(None), 0.0), {}, r"leg_directions\[4\]"),
        (good[:5], {}, "leg_directions.*shape"),
        (good.T, {}, "leg_directions.*shape"),
        ("north", {}, "leg_directions"),
        (good, {"rotation": np.diag([1.0, -1.0, 1.0])}, "rotation.*reflection"),
        (good, {"rotation": 1.01 * np.eye(3)}, "rotation.*orthogonal"),
        (good, {"rotation": np.full((3, 3), np.nan)}, "rotation"),
        (good, {"rotation": np.eye(4)}, "rotation.*shape"),
        (good, {"normal": [0.0, 0.0, 1.01]}, "normal"),
        (good, {"normal": [0.0, 0.0, np.nan]}, "normal"),
        (good, {"up_in_platform": [0.0, 0.0, 0.9]}, "up_in_platform"),
        (good, {"up_in_platform": [0.0, 1.0]}, "up_in_platform.*shape"),
        *((good, {f"{name}_sigma": bad}, name) for name in ("leg", "tilt", "yaw") for bad in (0.0, -1.0, np.inf, np.nan)),
    ]
    for directions, extra, said in cases:
        with pytest.raises(InputError, match=said) as caught:
            solve(hexapod, directions, **extra)
        assert isinstance(caught.value, GoughError)
        assert isinstance(caught.value, ValueError)
    assert issubclass(SingularConfigurationError, GoughError)
    assert issubclass(SingularConfigurationError, ArithmeticError)


def test_directions_off_unit_within_the_tolerance_are_normalised(hexapod):
    rotation, position = rotation_of([0.1, 0.0, 0.1]), np.array([0.01, 0.02, 0.36])
    directions = leg_directions(hexapod, position, rotation) * (1.0 + np.linspace(-9e-4, 9e-4, 6)[:, None])
    kept = directions.copy()
    assert_pose(solve(hexapod, directions, up_in_platform=1.0005 * rotation.T @ UP), position, rotation)
    np.testing.assert_array_equal(directions, kept)


def test_the_kernels_report_what_they_cannot_solve_below_the_tolerance(hexapod):
    geometry, memory, position = geometry_of(hexapod), np.zeros((), SCRATCH)[()], np.zeros(3)
    for broken in (np.nan, np.inf):
        directions = home_directions(hexapod)
        directions[3, 0] = broken
        assert pose_from_rotation(geometry, directions, np.ones(6), np.eye(3), position, memory) < RANK_TOLERANCE
        # Without the leg it does not matter.
        others = np.array([1.0, 1.0, 1.0, 0.0, 1.0, 1.0])
        assert pose_from_rotation(geometry, directions, others, np.eye(3), position, memory) > 0.1
        np.testing.assert_allclose(position, hexapod.home.position, atol=1e-12)


# ---------------------------------------------------------------------------------------------------------------- lengths


def test_lengths_give_back_the_pose_that_they_came_from(hexapod):
    positions, rotations = sample_workspace(hexapod, 100, seed=1)
    for position, rotation, lengths in zip(positions, rotations, leg_lengths(hexapod, positions, rotations), strict=True):
        pose = pose_from_lengths(hexapod, lengths)
        assert_pose(pose, position, rotation)
        again = np.linalg.norm(leg_vectors(hexapod, pose.position, pose.rotation), axis=1)
        np.testing.assert_allclose(again, lengths, rtol=0.0, atol=1e-11)


def test_lengths_that_no_pose_has_are_refused(hexapod):
    home = leg_lengths(hexapod, hexapod.home.position, np.eye(3))
    for lengths in (home * [1.0, 5.0, 1.0, 1.0, 1.0, 1.0], np.full(6, 0.01), -home):
        with pytest.raises(SingularConfigurationError, match="lengths"):
            pose_from_lengths(hexapod, lengths)
    for lengths in (home[:5], np.full(6, np.nan), home * [1, 1, 1, np.inf, 1, 1]):
        with pytest.raises(InputError, match="lengths"):
            pose_from_lengths(hexapod, lengths)


@pytest.mark.parametrize(
    "guess",
    [
        Pose(np.full(3, np.nan), np.eye(3)),
        Pose(np.array([0.0, 0.0, 0.35]), np.full((3, 3), np.nan)),
        Pose(np.array([0.0, 0.0, 0.35]), 2.0 * np.eye(3)),
        Pose(np.array([0.0, 0.0, 0.35]), np.diag([1.0, 1.0, -1.0])),
    ],
)
def test_a_guess_that_is_no_pose_is_refused(hexapod, guess):
    lengths = leg_lengths(hexapod, hexapod.home.position, np.eye(3))
    with pytest.raises(GoughError):
        pose_from_lengths(hexapod, lengths, guess)


def test_a_mechanism_of_two_arrays_has_no_home_to_start_from(hexapod):
    bare = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints)
    rotation, position = rotation_of([0.05, 0.1, -0.1]), np.array([0.01, 0.02, 0.36])
    lengths = leg_lengths(bare, position, rotation)
    with pytest.raises(InputError, match="home"):
        pose_from_lengths(bare, lengths)
    pose = pose_from_lengths(bare, lengths, hexapod.home)
    assert_pose(pose, position, rotation)
    assert_pose(solve(bare, leg_directions(bare, position, rotation)), position, rotation)


def test_a_motion_of_lengths_is_followed_row_by_row(hexapod):
    turns = np.linspace(0.0, 1.0, 200)[:, None] * [0.2, -0.1, 0.3]
    positions = hexapod.home.position + np.linspace(0.0, 1.0, 200)[:, None] * [0.02, 0.01, -0.02]
    rotations = np.array([rotation_of(turn) for turn in turns])
    lengths = leg_lengths(hexapod, positions, rotations)
    found, turned = poses_from_lengths(hexapod, lengths, hexapod.home)
    np.testing.assert_allclose(found, positions, atol=1e-10)
    np.testing.assert_allclose(turned, rotations, atol=1e-9)
    lengths[150, 2] = 5.0
    with pytest.raises(SingularConfigurationError, match="row 150"):
        poses_from_lengths(hexapod, lengths, hexapod.home)
    some, some_turned = poses_from_lengths(hexapod, lengths, hexapod.home, partial=True)
    np.testing.assert_array_equal(some[:150], found[:150])
    np.testing.assert_array_equal(some_turned[:150], turned[:150])
    assert np.isnan(some[150:]).all() and np.isnan(some_turned[150:]).all()


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.one_of(st.floats(0.0, np.pi), st.sampled_from([0.0, 1e-12, 1e-8, np.pi - 1e-8, np.pi])))
def test_the_difference_of_poses_is_their_distance_and_angle(seed, angle):
    random = np.random.default_rng(seed)
    rotation, position = random_rotation(random), random.normal(size=3)
    axis, away = unit(random.normal(size=3)), random.normal(size=3)
    distance, turned = pose_difference(Pose(position, rotation), Pose(position + away, rotation_of(angle * axis) @ rotation))
    assert abs(distance - np.linalg.norm(away)) < 1e-14
    assert abs(turned - angle) < 1e-14


@pytest.mark.parametrize("lengths", [np.full((3, 6), np.nan), np.full((3, 5), 0.4), np.full((3, 7), 0.4), np.full(6, 0.4), "x"])
def test_a_motion_of_malformed_lengths_is_refused(hexapod, lengths):
    with pytest.raises(InputError, match="lengths"):
        poses_from_lengths(hexapod, lengths, hexapod.home)


# -------------------------------------------------------------------------------------------------------- other wrong inputs


def test_what_is_no_mechanism_option_or_number_is_refused_in_words(hexapod):
    planar = load_mechanism("planar-3rpr")
    directions = leg_directions(hexapod, hexapod.home.position, np.eye(3))
    for call, said in (
        (lambda: solve(hexapod, None), "leg_directions must be an array of numbers"),
        (lambda: solve(planar, directions), "must be a Mechanism of six legs, not a PlanarMechanism"),
        (lambda: solve("hexapod", directions), "must be a Mechanism of six legs, not a str"),
        (lambda: required_measurements(planar), "must be a Mechanism of six legs, not a PlanarMechanism"),
        (lambda: solve(hexapod, directions, refine="no"), "refine must be True or False, got 'no'"),
        (lambda: solve(hexapod, directions, leg_sigma=1e-200), "leg_sigma is 1e-200; it must be at least 1e-09"),
        (lambda: solve_batch(hexapod, [directions], workers=-1), "workers is -1; it must be a whole number of threads"),
        (lambda: integrity(hexapod, directions, false_alarm_rate="a"), "the false-alarm rate must be"),
        (lambda: integrity(hexapod, directions, rotation=UP), r"rotation must have shape \(3, 3\), got \(3,\)"),
        (lambda: integrity(hexapod, 1.1 * directions), r"leg_directions\[0\] has length 1.1"),
    ):
        with pytest.raises(InputError, match=said):
            call()


# ----------------------------------------------------------------------------------------- joints that are coplanar but nearly


@pytest.mark.slow
@pytest.mark.parametrize("height", [1e-15, 1e-12, 1e-9, 1e-6, 2e-4, 2e-3])
@pytest.mark.parametrize("refine", [True, False])
def test_legs_alone_give_the_pose_of_joints_that_are_nearly_coplanar(hexapod, height, refine):
    random = np.random.default_rng(29)
    for _ in range(20):
        bent = hexapod.platform_joints + height * random.uniform(-1.0, 1.0, (6, 1)) * UP
        mechanism = Mechanism.from_legs(hexapod.base_joints, bent)
        position, rotation = hexapod.home.position, rotation_of(random.uniform(-0.5, 0.5, 3))
        directions = leg_directions(mechanism, position, rotation)
        for missing in ([], [1], [1, 4]):
            directions[missing] = np.nan
            solution = solve(mechanism, directions, refine=refine)
            np.testing.assert_allclose(solution.position, position, rtol=0.0, atol=1e-8)
            np.testing.assert_allclose(solution.rotation, rotation, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("sigma", [1e-9, 1e-7, 1e-3])
def test_exact_measurements_agree_however_small_their_sigmas(hexapod, sigma):
    random = np.random.default_rng(30)
    for _ in range(50):
        position, rotation = hexapod.home.position, rotation_of(random.uniform(-0.5, 0.5, 3))
        known = {"up_in_platform": rotation.T @ UP}
        solution = solve(hexapod, leg_directions(hexapod, position, rotation), leg_sigma=sigma, **known)
        np.testing.assert_allclose(solution.position, position, rtol=0.0, atol=1e-9)
