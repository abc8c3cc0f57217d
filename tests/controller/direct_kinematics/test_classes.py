"""Direct kinematics of all 60 classes: every method gives the true pose from any legs that will do, and a typed error else.

What will do is told by counting, `enough`, not by the code under test. Near singularities, in symmetric mechanisms and in
other frames and units there is never a wrong pose. Ten thousand examples instead of two hundred:
`pytest tests/controller/direct_kinematics/test_classes.py -k any_draw --hypothesis-profile=thorough
--hypothesis-show-statistics`.
"""

from concurrent.futures import ThreadPoolExecutor
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from controller.direct_kinematics import METHODS, Requirement, required_measurements, solve, solve_batch
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism import Mechanism
from plant.mechanism.classification import draw_mechanism, joint_numbers, spatial_classes
from tests.controller.leg_geometry import (
    UP,
    angle_between,
    leg_directions,
    leg_vectors,
    random_rotation,
    rotation_of,
    skew,
    unit,
)

DEGREE = np.pi / 180.0
EVERY = spatial_classes()
GROUPS = {each.group: each for each in reversed(EVERY)}
SETS = [legs for count in range(7) for legs in combinations(range(6), count)]
FEWEST = {"section-5": 2, "up": 3, "normal": 3, "legs": 4, "section-3.1.1": 6, "section-4": 3}

every_class = pytest.mark.parametrize("each", EVERY, ids=lambda each: each.label)
every_group = pytest.mark.parametrize("each", GROUPS.values(), ids=GROUPS.keys())
every_method = pytest.mark.parametrize("method", METHODS)


def enough(method, mechanism, legs):
    """Whether a set of legs gives the pose: by the legs (k,) that end in each platform joint."""
    k = np.bincount(joint_numbers(mechanism.platform_joints)[list(legs)], minlength=1)
    two_joints = len(legs) >= 3 and np.count_nonzero(k) >= 2
    return {
        "section-5": len(legs) >= 2,
        "up": two_joints,
        "normal": two_joints,
        "legs": np.minimum(2 * k, 3).sum() >= 7,
        "section-3.1.1": sorted(k[k > 0]) == [2, 2, 2],
        "section-4": two_joints and k.max() >= 2,
    }[method]


def drawn(each, random, coplanar):
    """A random mechanism of a class, its base turned and its vertical pointing anywhere; and the base's own frame in {1}."""
    mechanism = draw_mechanism(each, random, coplanar=coplanar)
    turn, shift = random_rotation(random), random.uniform(-0.5, 0.5, 3)
    base = mechanism.base_joints @ turn.T + shift
    return Mechanism.from_legs(base, mechanism.platform_joints, up_in_base=unit(random.normal(size=3))), turn, shift


def poses_over(random, mechanism, turn, shift, tilts, yaws):
    """Poses (N, 3), (N, 3, 3) whose platform joints lie over the base's, turned by `yaws` and tilted by `tilts` against it."""
    towards = random.uniform(0.0, 2.0 * np.pi, len(tilts))
    axes = np.column_stack([np.cos(towards), np.sin(towards), np.zeros(len(tilts))])
    tilted = Rotation.from_rotvec(np.asarray(tilts)[:, None] * axes)
    rotations = turn @ (Rotation.from_rotvec(np.outer(yaws, UP)) * tilted).as_matrix()
    centers = random.uniform([-0.1, -0.1, 0.25], [0.1, 0.1, 0.45], (len(tilts), 3)) @ turn.T + shift
    return centers - mechanism.platform_joints.mean(axis=0) @ rotations.transpose(0, 2, 1), rotations


def any_poses(random, mechanism, turn, shift, count):
    """The first two without tilt, the first without yaw and the third turned by pi, the others anywhere."""
    tilts, yaws = random.uniform(0.0, 60.0 * DEGREE, count), random.uniform(-np.pi, np.pi, count)
    tilts[:2], yaws[[0, 2]] = 0.0, [0.0, np.pi]
    return poses_over(random, mechanism, turn, shift, tilts, yaws)


def seen(mechanism, positions, rotations):
    """The paper's (1) for many poses at once: directions (N, 6, 3)."""
    return unit(positions[:, None] + mechanism.platform_joints @ rotations.transpose(0, 2, 1) - mechanism.base_joints)


def attitude(method, mechanism, rotations):
    """What a method needs to know of rotations (..., 3, 3)."""
    return {
        "section-5": {"rotation": rotations},
        "up": {"up_in_platform": mechanism.up_in_base @ rotations},
        "normal": {"normal": rotations[..., 2]},
        "section-4": {"normal": rotations[..., 2]},
    }.get(method, {})


def of_sets(directions, sets):
    """Directions (N, 6, 3) as (sets * N, 6, 3), with the legs of each set alone."""
    kept = np.array([[leg in legs for leg in range(6)] for legs in sets])
    return np.where(kept[:, None, :, None], directions, np.nan).reshape(-1, 6, 3)


def with_legs(directions, legs):
    return of_sets(directions[None], [legs])[0]


def solve_sets(method, mechanism, positions, rotations, sets=SETS):
    """Solutions for every set at every pose, and by how much each misses its pose, in m or in elements of the rotation."""
    directions = of_sets(seen(mechanism, positions, rotations), sets)
    positions, rotations = np.tile(positions, (len(sets), 1)), np.tile(rotations, (len(sets), 1, 1))
    found = solve_batch(mechanism, directions, method=method, workers=1, **attitude(method, mechanism, rotations))
    moved = np.linalg.norm(found.positions - positions, axis=1)
    return found, np.maximum(moved, np.abs(found.rotations - rotations).max(axis=(1, 2)))


# ----------------------------------------------------------------------------------------------------------- every class


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [(0,), pytest.param((1, 2), marks=pytest.mark.slow)])
@every_class
def test_every_method_gives_the_pose_from_all_legs_that_will_do_and_an_error_from_others(each, seeds):
    tries, refused = dict.fromkeys(METHODS, 0), dict.fromkeys(METHODS, 0)
    for seed, coplanar in product(seeds, (True, False)[: 1 if each.platform_count == 3 else 2]):
        random = np.random.default_rng([EVERY.index(each), seed, coplanar])
        mechanism, *frame = drawn(each, random, coplanar)
        poses = any_poses(random, mechanism, *frame, count=8)
        for method in METHODS:
            found, missed = solve_sets(method, mechanism, *poses)
            will_do = np.repeat([enough(method, mechanism, legs) for legs in SETS], 8)
            assert not found.solved[~will_do].any()
            assert (missed[found.solved] < 1e-8).all()
            assert (found.conditionings[found.solved] > 1e-6).all()
            assert all(isinstance(error, SingularConfigurationError) for error in found.errors.values())
            assert sorted(found.errors) == np.flatnonzero(~found.solved).tolist()
            tries[method] += will_do.sum()
            refused[method] += (will_do & ~found.solved).sum()
    assert (tries["section-3.1.1"] > 0) == (each.group == "n-3-I")
    assert (tries["section-4"] > 0) == (each.platform_count < 6)
    for method in METHODS:
        assert refused[method] <= 0.01 * tries[method], method


THOROUGH = settings().max_examples > 1000


@pytest.mark.slow
@settings(max_examples=settings().max_examples if THOROUGH else 200, deadline=None, derandomize=not THOROUGH)
@given(
    st.sampled_from(EVERY),
    st.integers(0, 2**32 - 1),
    st.booleans(),
    st.sampled_from(SETS),
    st.sampled_from(METHODS),
    st.one_of(st.floats(0.0, 60.0 * DEGREE), st.sampled_from([0.0, 1e-12, 1e-8, 1e-4])),
    st.one_of(st.floats(-np.pi, np.pi), st.sampled_from([0.0, np.pi, -np.pi, np.pi / 2.0, 1e-12, np.pi - 1e-9])),
)
def test_any_draw_gives_its_pose_or_a_typed_error(each, seed, coplanar, legs, method, tilt, yaw):
    random = np.random.default_rng(seed)
    mechanism, *frame = drawn(each, random, coplanar)
    (position,), (rotation,) = poses_over(random, mechanism, *frame, [tilt], [yaw])
    directions = with_legs(leg_directions(mechanism, position, rotation), legs)
    known = attitude(method, mechanism, rotation)
    if not enough(method, mechanism, legs):
        event("legs that will not do")
        with pytest.raises(SingularConfigurationError):
            solve(mechanism, directions, method=method, **known)
        return
    try:
        solution = solve(mechanism, directions, method=method, **known)
    except SingularConfigurationError:
        event("refused")
        return
    event("solved")
    assert solution.method == method
    assert np.linalg.norm(solution.position - position) < 1e-8
    assert angle_between(solution.rotation, rotation) < 1e-8


# ------------------------------------------------------------------------------------ symmetry and the way to singularity


def ring(radius, count=6, first=0.0):
    angles = first + 2.0 * np.pi * np.arange(count) / count
    return radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.15, 0.2, 0.4])
@pytest.mark.parametrize("first", [0.0, np.pi / 6.0])
def test_regular_hexagons_give_no_wrong_pose(radius, first):
    random = np.random.default_rng(11)
    tilts, yaws = np.repeat([0.0, 0.0, 0.0, 0.3, 1.0], 8), np.tile(np.arange(8) * np.pi / 6.0, 5)
    for turned in (0, 1, 2):
        mechanism = Mechanism.from_legs(ring(0.3), np.roll(ring(radius, first=first), turned, axis=0))
        positions, rotations = poses_over(random, mechanism, np.eye(3), np.zeros(3), tilts, yaws)
        positions[:16, :2] = 0.0
        for method in ("section-5", "up", "normal", "legs"):
            found, missed = solve_sets(method, mechanism, positions, rotations)
            assert (missed[found.solved] < 1e-8).all()
            # The platform is its base to scale: legs alone leave that open, and on a level platform all but section 5 do.
            level, six = tilts == 0.0, found.solved[-len(tilts) :]
            assert six[~level].all() if method != "legs" else not six.any()
            assert six[level].all() if method == "section-5" else not six[level].any()


@pytest.mark.parametrize("method", ["up", "normal"])
@pytest.mark.parametrize("joints", [(0, 1, 2), (0, 2, 4)])
@pytest.mark.parametrize("tilt", [0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.3, 1.0])
def test_three_legs_from_one_base_joint_tell_near_from_far_and_up_from_down(method, joints, tilt):
    random = np.random.default_rng(12)
    base = ring(0.3)
    base[list(joints)] = base[joints[0]]
    mechanism = Mechanism.from_legs(base, ring(0.2))
    poses = poses_over(random, mechanism, np.eye(3), np.zeros(3), np.full(12, tilt), np.tile([0.0, np.pi, -np.pi, 0.4], 3))
    found, missed = solve_sets(method, mechanism, *poses, sets=[joints])
    assert found.solved.all()
    assert missed.max() < 1e-8


def parallel_legs(random, off):
    rotation, position = rotation_of(random.uniform(-0.5, 0.5, 3)), random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4]
    platform = random.uniform(-0.2, 0.2, (6, 3))
    legs = random.uniform(0.3, 0.5, (6, 1)) * unit(unit([0.2, -0.1, 1.0]) + off * random.normal(size=(6, 3)))
    return position + platform @ rotation.T - legs, platform, position, rotation


def legs_in_the_joint_plane(random, off):
    rotation, position = rotation_of(random.uniform(-0.5, 0.5, 3)), random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4]
    platform = ring(0.2)[[0, 0, 2, 3, 4, 5]]
    legs = random.uniform(-1.0, 1.0, (6, 3)) * [0.4, 0.4, 0.0] + off * 0.4 * UP
    legs[:2] = [[0.1, 0.2, 0.3], [-0.2, 0.1, 0.4]]
    return position + (platform - legs) @ rotation.T, platform, position, rotation


def affinely_alike(random, off):
    base = ring(0.3) * random.uniform(0.8, 1.2, (6, 1))
    platform = base @ np.diag([0.7, 0.4, 0.0]) @ rotation_of([0.0, 0.0, 0.5]).T
    platform[:, :2] += 0.1 * off * random.normal(size=(6, 2))
    return base, platform, random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4], rotation_of(random.uniform(-0.5, 0.5, 3))


def alike_and_level(random, off):
    base = ring(0.3) * random.uniform(0.8, 1.2, (6, 1))
    rotation = rotation_of([0.0, 0.0, random.uniform(-3.0, 3.0)]) @ rotation_of(off * random.normal(size=3) * [1.0, 1.0, 0.0])
    return base, 0.6 * base, random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4], rotation


def four_joints_in_line(random, off):
    base = ring(0.3) + random.uniform(-0.05, 0.05, (6, 3))
    platform = np.outer([-0.2, -0.1, 0.05, 0.2, 0.1, 0.0], [0.8, 0.6, 0.0]) + 0.1 * off * random.normal(size=(6, 3))
    platform[4:] += random.uniform(0.05, 0.1, (2, 3))
    return base, platform, random.uniform(-0.1, 0.1, 3) + [0.0, 0.0, 0.4], rotation_of(random.uniform(-0.5, 0.5, 3))


def bent_out_of_plane(random, off):
    """Never singular for six legs, but the last step from twelve unknowns to nine."""
    base, platform, position, rotation = affinely_alike(random, 1e-3)
    platform[:, 2] = 0.1 * off * random.normal(size=6)
    return base, platform, position, rotation


@pytest.mark.slow
@pytest.mark.parametrize(
    ("approach", "method", "legs"),
    [
        (parallel_legs, "section-5", range(6)),
        (parallel_legs, "up", range(6)),
        (parallel_legs, "legs", range(6)),
        (legs_in_the_joint_plane, "section-4", range(6)),
        (affinely_alike, "legs", range(6)),
        (alike_and_level, "up", range(6)),
        (alike_and_level, "normal", range(6)),
        (four_joints_in_line, "legs", range(4)),
        (bent_out_of_plane, "legs", None),
    ],
)
@pytest.mark.parametrize("draws", [3, pytest.param(12, marks=pytest.mark.endurance)])
def test_on_the_way_to_a_singularity_there_is_the_pose_or_an_error(approach, method, legs, draws):
    random = np.random.default_rng(13)
    offs = 10.0 ** -np.arange(0.0, 12.5, 0.5)
    solved = np.zeros((len(offs), len(SETS)), bool)
    for i, off in enumerate(offs):
        for _ in range(draws):
            base, platform, position, rotation = approach(random, off)
            found, missed = solve_sets(method, Mechanism.from_legs(base, platform), position[None], rotation[None])
            assert (missed[found.solved] < 1e-8).all(), off
            solved[i] |= found.solved
    if legs is None:
        assert solved[:, -1].all()
    else:
        which = SETS.index(tuple(legs))
        assert solved[:6, which].all() and not solved[-6:, which].any()


# ------------------------------------------------------------------------------------------------------------ closed forms


def meeting_twin(points, directions):
    """The point nearest to lines, three rows skew(r) x = skew(r) o each."""
    right = np.concatenate([skew(r) @ o for o, r in zip(points, directions, strict=True)])
    return np.linalg.lstsq(np.vstack([skew(r) for r in directions]), right, rcond=None)[0]


def triad(points):
    """(9) and (10): along the first two points, and normal to all three."""
    x, z = unit(points[1] - points[0]), unit(np.cross(points[1] - points[0], points[2] - points[0]))
    return np.column_stack([x, np.cross(z, x), z])


def section_3_1_1_twin(mechanism, directions):
    numbers = joint_numbers(mechanism.platform_joints)
    pairs = [np.flatnonzero(numbers == joint) for joint in range(3)]
    met = np.array([meeting_twin(mechanism.base_joints[pair], directions[pair]) for pair in pairs])
    known = mechanism.platform_joints[[pair[0] for pair in pairs]]
    rotation = triad(met) @ triad(known).T
    return met[0] - rotation @ known[0], rotation


def section_4_twin(mechanism, directions, normal, pair, further):
    """Two legs meet in a joint; one further leg cuts the plane through its own, where an angle about the normal is read."""
    point = meeting_twin(mechanism.base_joints[pair], directions[pair])
    level = Rotation.align_vectors(normal[None], UP[None])[0].as_matrix()
    arm = mechanism.platform_joints[further] - mechanism.platform_joints[pair[0]]
    start, along = mechanism.base_joints[further] - point, directions[further]
    cut = level.T @ (start + (arm[2] - normal @ start) / (normal @ along) * along)
    rotation = rotation_of((np.arctan2(cut[1], cut[0]) - np.arctan2(arm[1], arm[0])) * normal) @ level
    return point - rotation @ mechanism.platform_joints[pair[0]], rotation


def noisy(random, directions, sigma):
    return unit(directions + random.normal(scale=sigma, size=directions.shape))


def test_without_refinement_section_3_1_1_is_the_papers_construction():
    random = np.random.default_rng(14)
    for each in [each for each in EVERY if each.group == "n-3-I"]:
        mechanism, *frame = drawn(each, random, coplanar=True)
        poses = any_poses(random, mechanism, *frame, count=5)
        for directions in noisy(random, seen(mechanism, *poses), 1e-3):
            solution = solve(mechanism, directions, method="section-3.1.1", refine=False)
            position, rotation = section_3_1_1_twin(mechanism, directions)
            np.testing.assert_allclose(solution.position, position, rtol=0.0, atol=1e-11)
            np.testing.assert_allclose(solution.rotation, rotation, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("coplanar", [True, False])
def test_without_refinement_section_4_is_the_papers_construction(coplanar):
    random = np.random.default_rng(15)
    for each in [each for each in EVERY if each.group == "n-5"]:
        mechanism, *frame = drawn(each, random, coplanar)
        numbers = joint_numbers(mechanism.platform_joints)
        pair = np.flatnonzero(numbers == np.bincount(numbers).argmax())
        poses = any_poses(random, mechanism, *frame, count=4)
        directions = noisy(random, seen(mechanism, *poses), 1e-3)
        normals = unit(poses[1][:, :, 2] + random.normal(scale=1e-3, size=(4, 3)))
        for further in [leg for leg in range(6) if leg not in pair]:
            for row in range(4):
                legs = with_legs(directions[row], (*pair, further))
                solution = solve(mechanism, legs, normal=normals[row], method="section-4", refine=False)
                position, rotation = section_4_twin(mechanism, directions[row], normals[row], pair, further)
                np.testing.assert_allclose(solution.position, position, rtol=0.0, atol=1e-10)
                np.testing.assert_allclose(solution.rotation, rotation, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("coplanar", [True, False])
def test_section_4_weighs_further_legs_by_how_steeply_they_cut_the_plane(coplanar):
    """The yaw is that of weighted least squares on the points at which the legs cut the planes of their joints."""
    random = np.random.default_rng(31)
    for each in [each for each in EVERY if each.group == "n-5"]:
        mechanism, *frame = drawn(each, random, coplanar)
        numbers = joint_numbers(mechanism.platform_joints)
        pair = np.flatnonzero(numbers == np.bincount(numbers).argmax())
        others = [leg for leg in range(6) if leg not in pair]
        positions, rotations = any_poses(random, mechanism, *frame, count=4)
        directions = noisy(random, seen(mechanism, positions, rotations), 1e-2)
        for row in range(4):
            normal = rotations[row, :, 2]
            found = solve(mechanism, directions[row], normal=normal, method="section-4", refine=False)
            point = meeting_twin(mechanism.base_joints[pair], directions[row, pair])
            level = Rotation.align_vectors(normal[None], UP[None])[0].as_matrix()
            total = 0.0
            for leg in others:
                arm = mechanism.platform_joints[leg] - mechanism.platform_joints[pair[0]]
                start, along = mechanism.base_joints[leg] - point, directions[row, leg]
                slope = normal @ along
                x, y, _ = level.T @ (start + (arm[2] - normal @ start) / slope * along)
                total += slope**2 * (x + 1j * y) * (arm[0] - 1j * arm[1])
            rotation = rotation_of(np.angle(total) * normal) @ level
            np.testing.assert_allclose(found.rotation, rotation, rtol=0.0, atol=1e-10)
            position = point - rotation @ mechanism.platform_joints[pair[0]]
            np.testing.assert_allclose(found.position, position, rtol=0.0, atol=1e-10)


@every_method
def test_a_refined_pose_fits_better_than_the_closed_form_that_it_starts_from(method):
    random = np.random.default_rng(16)
    mechanism, *frame = drawn(GROUPS["n-3-I"], random, coplanar=True)
    positions, rotations = any_poses(random, mechanism, *frame, count=20)
    directions = noisy(random, seen(mechanism, positions, rotations), 1e-3)
    given_ = dict(method=method, leg_sigma=1e-3, tilt_sigma=1e-3, yaw_sigma=1e-3, **attitude(method, mechanism, rotations))
    raw, refined = (solve_batch(mechanism, directions, refine=refine, **given_) for refine in (False, True))
    assert raw.solved.all() and refined.solved.all()
    assert (refined.chi_squares < raw.chi_squares * (1.0 - 1e-9)).all()
    assert (refined.degrees_of_freedom == raw.degrees_of_freedom).all()
    np.testing.assert_array_equal(raw.conditionings, refined.conditionings)
    for i in range(20):
        if method == "section-5":
            np.testing.assert_allclose(raw[i].rotation, rotations[i], rtol=0.0, atol=1e-14)
        # Residuals, and so their sum, are those of the pose that was given.
        predicted = leg_directions(mechanism, raw[i].position, raw[i].rotation)
        np.testing.assert_allclose(raw[i].residuals, directions[i] - predicted, rtol=0.0, atol=1e-14)


def test_auto_takes_the_next_measurement_where_the_first_leaves_the_pose_open():
    """The vertical does on a level platform that is its base to scale, the z axis of {2} does not if it is not the vertical."""
    random = np.random.default_rng(17)
    for _ in range(10):
        base, platform, position, level = alike_and_level(random, 0.0)
        tilted = rotation_of([0.3, 0.2, 0.0])
        mechanism, rotation = Mechanism.from_legs(base, platform @ tilted), level @ tilted
        directions = leg_directions(mechanism, position, rotation)
        known = {"up_in_platform": rotation.T @ UP, "normal": rotation[:, 2]}
        with pytest.raises(SingularConfigurationError, match=r"by up .*: choose the method auto"):
            solve(mechanism, directions, **known, method="up")
        with pytest.raises(SingularConfigurationError, match="measure more legs, or rotation"):
            solve(mechanism, directions, up_in_platform=rotation.T @ UP)
        solution = solve(mechanism, directions, **known)
        assert solution.method == "normal"
        np.testing.assert_allclose(solution.position, position, rtol=0.0, atol=1e-8)
        np.testing.assert_allclose(solution.rotation, rotation, rtol=0.0, atol=1e-8)
        assert solve(mechanism, directions, **known, rotation=rotation).method == "section-5"


def test_methods_are_known_by_name_and_ask_for_what_they_need(hexapod):
    directions = leg_directions(hexapod, hexapod.home.position, np.eye(3))
    known = {"rotation": np.eye(3), "up_in_platform": UP, "normal": UP}
    needs = {"section-5": "rotation", "up": "up_in_platform", "normal": "normal", "section-4": "normal"}
    for method, need in needs.items():
        without = {name: value for name, value in known.items() if name != need}
        for call, extra in ((solve, without), (solve_batch, {name: value[None] for name, value in without.items()})):
            with pytest.raises(InputError, match=f"the method '{method}' needs {need}: give it"):
                call(hexapod, directions if call is solve else directions[None], method=method, **extra)
    for unknown in ("UP", "", None, "section-6"):
        with pytest.raises(InputError, match=r"there is no method .*; there are auto, section-5, up, normal, legs, section-3"):
            solve(hexapod, directions, method=unknown)
    for method in ("section-5", "up", "normal", "legs"):
        assert solve(hexapod, directions, method=method, **known).method == method
    for method in ("section-3.1.1", "section-4"):
        with pytest.raises(SingularConfigurationError, match=f"'hexapod' here by {method} .*: choose the method auto"):
            solve(hexapod, directions, method=method, **known)


# ------------------------------------------------------------------------------------------------------------------ batches

FIELDS = ("positions", "rotations", "covariances", "residuals", "chi_squares", "degrees_of_freedom", "conditionings")


@pytest.mark.parametrize("method", ["auto", *METHODS])
def test_a_batch_is_its_rows_one_by_one_bit_for_bit(method):
    random = np.random.default_rng(18)
    mechanism, *frame = drawn(GROUPS["n-3-I"], random, coplanar=True)
    positions, rotations = any_poses(random, mechanism, *frame, count=40)
    directions = noisy(random, seen(mechanism, positions, rotations), 1e-3)
    directions[random.random((40, 6)) < 0.4] = np.nan
    known = attitude(method, mechanism, rotations)
    batch = solve_batch(mechanism, directions, method=method, **known)
    assert batch.solved.any() and not batch.solved.all()
    for i in range(40):
        alone = {name: value[i] for name, value in known.items()}
        if batch.solved[i]:
            one, row = solve(mechanism, directions[i], method=method, **alone), batch[i]
            for name in row.__dataclass_fields__:
                np.testing.assert_array_equal(getattr(row, name), getattr(one, name), strict=True)
        else:
            with pytest.raises(SingularConfigurationError):
                solve(mechanism, directions[i], method=method, **alone)


def test_any_number_of_workers_gives_the_same(hexapod):
    random = np.random.default_rng(19)
    positions, rotations = any_poses(random, hexapod, np.eye(3), np.zeros(3), 10_000)
    directions = seen(hexapod, positions, rotations)
    directions[random.random((10_000, 6)) < 0.1] = np.nan
    one, two, all_cores = (solve_batch(hexapod, directions, workers=workers) for workers in (1, 2, None))
    assert one.solved.any() and not one.solved.all()
    for other in (two, all_cores):
        assert all(np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in FIELDS)
        said, said_too = ([(row, str(error)) for row, error in found.errors.items()] for found in (one, other))
        assert said == said_too


def test_calls_at_once_in_several_threads_do_not_meet(hexapod):
    random = np.random.default_rng(20)
    positions, rotations = any_poses(random, hexapod, np.eye(3), np.zeros(3), 500)
    directions = seen(hexapod, positions, rotations)
    expected = solve_batch(hexapod, directions, workers=1)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda each: solve(hexapod, each), directions))
    np.testing.assert_array_equal([each.position for each in found], expected.positions)
    np.testing.assert_array_equal([each.covariance for each in found], expected.covariances)


def test_a_row_without_a_pose_is_nan_and_raises_when_it_is_asked_for(hexapod):
    home = leg_directions(hexapod, hexapod.home.position, np.eye(3))
    directions = np.array([home, np.full((6, 3), np.nan), with_legs(home, (1, 2)), with_legs(home, range(5)), -home])
    found = solve_batch(hexapod, directions)
    np.testing.assert_array_equal(found.solved, [True, False, False, True, False])
    assert len(found) == 5
    for name in ("positions", "rotations", "covariances", "residuals", "chi_squares"):
        values = getattr(found, name).reshape(5, -1)
        assert np.isnan(values[~found.solved]).all()
        assert np.isfinite(values[0]).all()
    assert np.isnan(found[3].residuals[5]).all() and np.isfinite(found[3].residuals[:5]).all()
    expected = {1: "nothing of row 1 ", 2: "leg 1, leg 2 of row 2 do not", 4: r"negative length.* of row 4", -1: "of row 4"}
    for row, said in expected.items():
        with pytest.raises(SingularConfigurationError, match=said):
            found[row]
    with pytest.raises(IndexError):
        found[5]
    with pytest.raises(SingularConfigurationError, match="of row 1"):
        list(found)


def test_a_malformed_row_of_a_batch_is_refused_by_its_number(hexapod):
    random = np.random.default_rng(20)
    positions, rotations = any_poses(random, hexapod, np.eye(3), np.zeros(3), 4)
    arrays = {"leg_directions": seen(hexapod, positions, rotations), "rotation": rotations}
    arrays |= {"up_in_platform": rotations[:, 2].copy(), "normal": rotations[:, :, 2].copy()}
    for name, place, value, said in (
        ("leg_directions", (2, 3, 1), np.nan, r"leg_directions\[3\] of row 2 is partly NaN"),
        ("leg_directions", (3, 5, 0), np.inf, r"leg_directions\[5\] of row 3 is .*finite"),
        ("leg_directions", (1, 0), [0.0, 0.0, 1.01], r"leg_directions\[0\] of row 1 has length 1.01"),
        ("rotation", (2, 0, 0), np.nan, "rotation of row 2 .*finite"),
        ("rotation", 1, np.diag([1.0, 1.0, -1.0]), "rotation of row 1 is a reflection"),
        ("rotation", 3, 1.01 * np.eye(3), "rotation of row 3 is off orthogonal"),
        ("up_in_platform", 2, [0.0, 0.0, 1.01], "up_in_platform of row 2 has length 1.01"),
        ("normal", 1, [0.0, np.nan, 1.0], "normal of row 1 .*finite"),
    ):
        broken = {key: array.copy() for key, array in arrays.items()}
        broken[name][place] = value
        with pytest.raises(InputError, match=said):
            solve_batch(hexapod, **broken)
    for name, wrong in (("leg_directions", np.zeros((4, 5, 3))), ("rotation", np.eye(3)), ("normal", np.zeros((3, 3)))):
        with pytest.raises(InputError, match=f"{name} must have shape"):
            solve_batch(hexapod, **(arrays | {name: wrong}))
    assert len(solve_batch(hexapod, np.empty((0, 6, 3)))) == 0


# --------------------------------------------------------------------------------------------------------- frames and units


@every_group
@every_method
def test_neither_frames_nor_units_nor_the_order_of_legs_change_the_pose(each, method):
    random = np.random.default_rng(21)
    mechanism, *frame = drawn(each, random, coplanar=False)
    positions, rotations = any_poses(random, mechanism, *frame, count=8)
    directions = noisy(random, seen(mechanism, positions, rotations), 1e-4)
    found = solve_batch(mechanism, directions, method=method, **attitude(method, mechanism, rotations))
    assert found.solved.all() if enough(method, mechanism, range(6)) else not found.solved.any()
    turn, shift, order = random_rotation(random), random.uniform(-1.0, 1.0, 3), random.permutation(6)
    # The normal is the z axis of {2}, which may turn about that alone.
    turn_2 = rotation_of(1.2 * UP) if method in ("normal", "section-4") else random_rotation(random)
    same = {"turn_1": np.eye(3), "shift_1": np.zeros(3), "turn_2": np.eye(3), "shift_2": np.zeros(3), "scale": 1.0}
    same |= {"order": np.arange(6), "factor": 1.0 + 1e-6}
    for change in (
        {"shift_1": shift},
        {"shift_2": shift},
        # Mechanisms of more than 10 m are refused.
        {"scale": 20.0},
        {"scale": 1e-3},
        # Which joint comes first, and how axes lie, decides what the triad of section 3.1.1 and the pivots of QR see.
        {"order": order, "factor": 10.0 if method == "section-3.1.1" else 1.0 + 1e-6},
        {"turn_1": turn, "factor": 10.0},
        {"turn_2": turn_2, "factor": 10.0},
    ):
        turn_1, shift_1, turn_2, shift_2, scale, order, factor = (same | change).values()
        other = Mechanism.from_legs(
            scale * (mechanism.base_joints @ turn_1.T + shift_1)[order],
            scale * ((mechanism.platform_joints - shift_2) @ turn_2)[order],
            up_in_base=turn_1 @ mechanism.up_in_base,
        )
        known = attitude(method, other, turn_1 @ rotations @ turn_2)
        again = solve_batch(other, np.take(directions @ turn_1.T, order, axis=1), method=method, **known)
        np.testing.assert_array_equal(again.solved, found.solved)
        moved = scale * ((found.positions + found.rotations @ shift_2) @ turn_1.T + shift_1)
        np.testing.assert_allclose(again.positions, moved, rtol=0.0, atol=1e-9 * scale)
        np.testing.assert_allclose(again.rotations, turn_1 @ found.rotations @ turn_2, rtol=0.0, atol=1e-9)
        ratios = again.conditionings[found.solved] / found.conditionings[found.solved]
        assert ((ratios < factor) & (ratios > 1.0 / factor)).all()


# ------------------------------------------------------------------------------------------------------------- covariance


def bound_of(mechanism, position, rotation, leg_sigma, up_sigma):
    """The Cramer-Rao bound (6, 6): of directions known to sigma in each component, and of the vertical unless infinite."""
    information = np.zeros((6, 6))
    information[3:, 3:] = skew(mechanism.up_in_base).T @ skew(mechanism.up_in_base) / up_sigma**2
    for vector, joint in zip(leg_vectors(mechanism, position, rotation), mechanism.platform_joints, strict=True):
        change = skew(unit(vector)) @ np.hstack([np.eye(3), -skew(rotation @ joint)]) / np.linalg.norm(vector)
        information += change.T @ change / leg_sigma**2
    return np.linalg.inv(information)


@every_group
@pytest.mark.parametrize("method", ["legs", "up"])
def test_errors_of_well_conditioned_mechanisms_are_as_large_as_the_covariance_says_and_the_bound_allows(each, method):
    def well_conditioned_poses(count):
        for seed in range(1000):
            random = np.random.default_rng([27, seed])
            mechanism, *frame = drawn(each, random, coplanar=True)
            tilts, yaws = random.uniform(0.0, 0.2, count), random.uniform(-0.3, 0.3, count)
            poses = poses_over(random, mechanism, *frame, tilts, yaws)
            exact = solve_batch(mechanism, seen(mechanism, *poses), method=method, **attitude(method, mechanism, poses[1]))
            if exact.solved.all() and exact.conditionings.min() > 0.05:
                return random, mechanism, *poses
        raise AssertionError("no seed is well conditioned")

    def errors(sigma):
        directions = noisy(random, seen(mechanism, positions, rotations), sigma)
        known = {}
        if method == "up":
            known["up_in_platform"] = noisy(random, mechanism.up_in_base @ rotations, sigma)
        found = solve_batch(mechanism, directions, leg_sigma=sigma, tilt_sigma=sigma, **known)
        turned = Rotation.from_matrix(found.rotations @ rotations.transpose(0, 2, 1)).as_rotvec()
        return np.hstack([found.positions - positions, turned]), found

    random, mechanism, positions, rotations = well_conditioned_poses(20)
    positions, rotations = np.repeat(positions, 100, axis=0), np.repeat(rotations, 100, axis=0)
    error, found = errors(0.01 * DEGREE)
    least, greatest = chi2.ppf([0.005, 0.995], 6 * 2000)
    assert least < np.einsum("ni,nij,nj->", error, np.linalg.inv(found.covariances), error) < greatest
    least, greatest = chi2.ppf([0.005, 0.995], found.degrees_of_freedom.sum())
    assert least < found.chi_squares.sum() < greatest

    error, found = errors(0.05 * DEGREE)
    up_sigma = 0.05 * DEGREE if method == "up" else np.inf
    bounds = [bound_of(mechanism, positions[i], rotations[i], 0.05 * DEGREE, up_sigma) for i in range(0, 2000, 100)]
    variances = np.mean(np.diagonal(bounds, axis1=1, axis2=2), axis=0).reshape(2, 3).sum(axis=1)
    squares = np.mean(error**2, axis=0).reshape(2, 3).sum(axis=1)
    np.testing.assert_allclose(np.sqrt(squares / variances), 1.0, rtol=0.0, atol=0.05)


# ------------------------------------------------------------------------------------------------------------ requirements


@every_class
def test_the_required_measurements_of_a_class_are_those_that_counting_tells(each):
    mechanism = draw_mechanism(each, np.random.default_rng(23), coplanar=False)
    found = {requirement.method: requirement for requirement in required_measurements(mechanism)}
    assert [method for method in METHODS if method in found] == list(found)
    for method in METHODS:
        will_do = [legs for legs in SETS if enough(method, mechanism, legs)]
        assert (method in found) == bool(will_do)
        if will_do:
            assert found[method].fewest == FEWEST[method]
            assert found[method].choices == tuple(legs for legs in will_do if len(legs) == FEWEST[method])
            lacking = [len(legs) for legs in SETS if legs not in will_do]
            assert found[method].any_choice == max(lacking) + 1
            assert found[method].platform == next(iter(attitude(method, mechanism, np.eye(3))), "nothing")
    assert ("section-3.1.1" in found) == (each.group == "n-3-I")
    assert ("section-4" in found) == (each.platform_count < 6)


@every_group
def test_required_legs_suffice_at_other_poses_and_none_can_be_spared(each):
    random = np.random.default_rng(24)
    mechanism, *frame = drawn(each, random, coplanar=True)
    poses = any_poses(random, mechanism, *frame, count=6)
    for requirement in required_measurements(mechanism):
        found, missed = solve_sets(requirement.method, mechanism, *poses, sets=requirement.choices)
        assert found.solved.mean() > 0.9
        assert missed[found.solved].max() < 1e-8
        fewer = [tuple(set(legs) - {leg}) for legs in requirement.choices for leg in legs]
        assert not solve_sets(requirement.method, mechanism, *poses, sets=fewer)[0].solved.any()


@pytest.mark.parametrize(
    ("choices", "fewest", "any_choice", "platform", "text", "choice_text"),
    [
        (((0, 1, 2, 3, 4, 5),), 6, 6, "nothing", "6 legs", ""),
        (((0, 1), (0, 2), (1, 2)), 2, 2, "rotation", "any 2 legs + rotation", ""),
        (((0, 1, 2), (0, 2, 4)), 3, 4, "normal", "3 legs, 2 choices + normal", "012, 024"),
        (((1, 3, 5),), 3, 4, "up_in_platform", "3 legs + up_in_platform", ""),
    ],
)
def test_requirements_read_well(choices, fewest, any_choice, platform, text, choice_text):
    requirement = Requirement("up", platform, fewest, choices, any_choice)
    assert (requirement.text, requirement.choice_text) == (text, choice_text)
