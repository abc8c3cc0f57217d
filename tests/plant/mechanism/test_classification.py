"""Combinatorial classes: the paper's counts, every graph found by other means, and mechanisms recognised again."""

import re
from collections import Counter
from collections.abc import Iterator
from itertools import chain, combinations, combinations_with_replacement, permutations, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant.errors import InputError
from plant.mechanism import Mechanism
from plant.mechanism.classification import (
    Legs,
    MechanismClass,
    canonical_legs,
    classify,
    draw_mechanism,
    draw_planar_mechanism,
    joint_numbers,
    layout,
    planar_classes,
    spatial_classes,
)
from plant.mechanism.planar import PlanarMechanism
from plant.pose import Array

SPATIAL, PLANAR = spatial_classes(), planar_classes()
EVERY = SPATIAL + PLANAR

every_class = pytest.mark.parametrize("each", EVERY, ids=lambda each: each.label)
spatial_class = pytest.mark.parametrize("each", SPATIAL, ids=lambda each: each.label)

# ---- the classes ----


def test_the_groups_have_the_numbers_of_classes_of_the_paper() -> None:
    groups = {"n-3-I": 7, "n-3-II": 10, "n-4-I": 16, "n-4-II": 9, "n-5": 12, "n-6": 6}
    assert Counter(each.group for each in SPATIAL) == groups
    assert Counter(each.group for each in PLANAR) == {"n-2": 2, "n-3": 2}


def test_the_groups_are_those_of_the_platform_degrees_in_the_paper() -> None:
    assert {(each.group, each.platform_degrees) for each in SPATIAL} == {
        ("n-3-I", (2, 2, 2)),
        ("n-3-II", (3, 2, 1)),
        ("n-4-I", (2, 2, 1, 1)),
        ("n-4-II", (3, 1, 1, 1)),
        ("n-5", (2, 1, 1, 1, 1)),
        ("n-6", (1, 1, 1, 1, 1, 1)),
    }
    assert {(each.group, each.platform_degrees) for each in PLANAR} == {("n-2", (2, 1)), ("n-3", (1, 1, 1))}


Rows = tuple[tuple[int, ...], ...]
"""For every platform joint the base joints it is joined to, sorted; the platform joints in no order, so sorted too."""


def rows_of(legs: Legs, order: tuple[int, ...]) -> Rows:
    """The legs with base joint b renamed to order[b]."""
    return tuple(sorted(tuple(sorted(order[base] for base, other in legs if other == p)) for p in {leg[1] for leg in legs}))


def every_graph(legs: int, base_count: int, platform_count: int) -> Iterator[Rows]:
    """Every graph between numbered base joints and unnumbered platform joints in which no joint has over three legs."""
    for degrees in combinations_with_replacement((1, 2, 3), platform_count):
        if sum(degrees) != legs:
            continue
        choices = (
            combinations_with_replacement(combinations(range(base_count), degree), count)
            for degree, count in Counter(degrees).items()
        )
        for parts in product(*choices):
            rows = tuple(sorted(chain.from_iterable(parts)))
            base_degrees = Counter(chain.from_iterable(rows))
            if len(base_degrees) == base_count and max(base_degrees.values()) <= 3:
                yield rows


@pytest.mark.parametrize(
    ("classes", "legs", "base_count"), [*((SPATIAL, 6, n) for n in range(1, 7)), *((PLANAR, 3, n) for n in (1, 2, 3))]
)
def test_the_numberings_of_the_classes_are_all_graphs_and_each_once(
    classes: tuple[MechanismClass, ...], legs: int, base_count: int
) -> None:
    least = 3 if legs == 6 else 2
    platform_counts = range(least, legs + 1) if base_count >= least else ()
    expected = [rows for m in platform_counts for rows in every_graph(legs, base_count, m)]
    orbits = [
        {rows_of(each.legs, order) for order in permutations(range(base_count))}
        for each in classes
        if each.base_count == base_count
    ]
    assert sorted(chain.from_iterable(orbits)) == sorted(expected)


@given(st.sampled_from(EVERY), st.randoms(use_true_random=False))
def test_numbering_does_not_matter(each: MechanismClass, random: Any) -> None:
    base, platform = random.sample(range(-9, 9), each.base_count), random.sample(range(-9, 9), each.platform_count)
    legs = [(base[b], platform[p]) for b, p in random.sample(each.legs, len(each.legs))]
    renumbered = MechanismClass(tuple(legs))
    assert renumbered == each and hash(renumbered) == hash(each)
    assert renumbered.legs == each.legs and renumbered.label == each.label


@every_class
def test_canonical_joints_count_from_zero_with_the_most_legs_first(each: MechanismClass) -> None:
    assert each.legs == tuple(sorted(each.legs))
    for side, degrees in ((0, each.base_degrees), (1, each.platform_degrees)):
        assert tuple(np.bincount([leg[side] for leg in each.legs])) == degrees
    assert (each.base_count, each.platform_count) == (len(each.base_degrees), len(each.platform_degrees))


# ---- names ----


def test_labels_count_the_classes_of_each_group() -> None:
    assert len({each.label for each in EVERY}) == 64
    assert [each.label for each in EVERY if each.group == "n-3"] == ["planar n-3.1", "planar n-3.2"]
    assert [each.label for each in EVERY if each.group == "n-3-I"] == [f"n-3-I.{i}" for i in range(1, 8)]
    keys = [(each.platform_count, each.type, -each.base_count) for each in SPATIAL]
    assert keys == sorted(keys)


def test_names_have_the_numbers_of_joints() -> None:
    assert SPATIAL[0].name == "6-3-I" and SPATIAL[-1].name == "3-6"
    assert [each.name for each in PLANAR] == ["planar 3-2", "planar 2-2", "planar 3-3", "planar 2-3"]


@pytest.mark.parametrize(
    ("legs", "drawing"),
    [
        ([(0, 0), (1, 1), (2, 2), (3, 3), (4, 4), (5, 5)], "|⁶"),
        ([(0, 0), (1, 0), (2, 1), (3, 1), (4, 2), (5, 3)], "∧²|²"),
        ([(0, 0), (0, 1), (1, 2), (1, 3), (2, 4), (2, 5)], "∨³"),
        ([(0, 0), (1, 0), (2, 0), (3, 1), (4, 2), (5, 3)], "⩚|³"),
        ([(0, 0), (0, 1), (0, 2), (1, 3), (1, 4), (2, 5)], "⩛∨|"),
        ([(0, 0), (1, 0), (1, 1), (2, 2), (3, 2), (3, 3)], "N²"),
        ([(0, 0), (1, 0), (1, 1), (2, 1), (3, 2), (4, 3)], "M|²"),
        ([(0, 0), (0, 1), (1, 1), (1, 2), (2, 3), (3, 3)], "W∧"),
        ([(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (3, 3)], r"(/\/\/)|"),
        ([(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (0, 2)], r"[/\/\/\]"),
        ([(0, 0), (1, 0), (0, 1), (1, 1), (2, 2), (3, 3)], r"[/\/\]|²"),
        ([(0, 0), (1, 1), (2, 2), (3, 0), (3, 1), (3, 2)], r"(/\(/\)/\)"),
        ([(0, 0), (1, 0), (1, 1)], "N"),
        ([(0, 0), (0, 1), (1, 2)], "∨|"),
    ],
)
def test_drawings_of_the_paper_and_of_others(legs: list[tuple[int, int]], drawing: str) -> None:
    assert MechanismClass(tuple(legs)).drawing == drawing


SPELLED = {"|": "/", "∧": "/\\", "∨": "\\/", "N": "/\\/", "M": "/\\/\\", "W": "\\/\\/", "⩚": "/|\\", "⩛": "\\|/"}


def component(zigzag: str, closed: bool) -> list[tuple[str, str]]:
    """The legs of a zigzag, read stroke by stroke."""
    joint, lower, legs, branches = 0, zigzag[0] == "/", [], []
    for count, sign in enumerate(zigzag, start=1):
        if sign == "(":
            branches.append((joint, lower))
        elif sign == ")":
            joint, lower = branches.pop()
        else:
            following = 0 if closed and count == len(zigzag) else count
            legs.append((joint, following) if lower else (following, joint))
            if sign != "|":
                assert sign == ("/" if lower else "\\")
                joint, lower = following, not lower
    return [(f"base {base}", f"platform {platform}") for base, platform in legs]


@every_class
def test_a_drawing_can_be_read_back(each: MechanismClass) -> None:
    legs: list[tuple[str, str]] = []
    for glyph, repeats in re.findall(r"(\[[^]]+\]|\((?:[^()]|\([^()]+\))+\)|.)([²³⁴⁵⁶]?)", each.drawing):
        for _ in range("  ²³⁴⁵⁶".index(repeats) if repeats else 1):
            strokes = component(SPELLED.get(glyph, glyph[1:-1]), closed=glyph[0] == "[")
            legs += [(f"{len(legs)}: {base}", f"{len(legs)}: {platform}") for base, platform in strokes]
    names = sorted(set(chain.from_iterable(legs)))
    assert MechanismClass(tuple((names.index(base), names.index(platform)) for base, platform in legs)) == each


def test_no_two_classes_share_a_drawing() -> None:
    assert len({each.drawing for each in EVERY}) == 64


# ---- pictures ----


def crossings(legs: Legs, base: Any, platform: Any) -> int:
    """Legs that begin in one order and end in the other."""
    return sum((base[b] - base[d]) * (platform[p] - platform[q]) < 0 for (b, p), (d, q) in combinations(legs, 2))


@every_class
def test_a_picture_has_its_joints_apart_and_the_fewest_crossings(each: MechanismClass) -> None:
    base, platform = layout(each)
    assert base.shape == (each.base_count,) and platform.shape == (each.platform_count,)
    for row in (base, platform):
        assert row.min() >= 0.0 and np.diff(np.sort(row)).min() >= 1.0
    found = crossings(each.legs, base, platform)
    if "[" in each.drawing or "(/\\)" in each.drawing or "(\\/)" in each.drawing:
        orders = product(permutations(range(each.base_count)), permutations(range(each.platform_count)))
        assert found == min(crossings(each.legs, *order) for order in orders)
    else:
        assert found == 0


def test_a_picture_has_components_side_by_side_in_the_order_of_the_drawing() -> None:
    (each,) = (each for each in SPATIAL if each.drawing == "N∧|")
    base, platform = layout(each)
    assert sorted(base) == [0.0, 1.0, 2.0, 3.0, 4.0] and sorted(platform) == [0.0, 1.0, 2.5, 4.0]
    assert sorted((base[b], platform[p]) for b, p in each.legs) == [(0, 0), (1, 0), (1, 1), (2, 2.5), (3, 2.5), (4, 4)]


# ---- mechanisms ----


@spatial_class
@pytest.mark.parametrize("coplanar", [True, False])
def test_a_drawn_mechanism_is_of_its_class(each: MechanismClass, coplanar: bool) -> None:
    random = np.random.default_rng(each.number)
    for _ in range(5):
        assert classify(draw_mechanism(each, random, coplanar=coplanar)) == each


def out_of_plane(joints: Array) -> float:
    return float(np.linalg.svd(joints - joints.mean(axis=0), compute_uv=False)[2])


@spatial_class
def test_a_drawn_mechanism_is_generic_and_of_desk_size(each: MechanismClass) -> None:
    random = np.random.default_rng(each.number)
    up = np.array([0.6, 0.0, 0.8])
    for _ in range(5):
        flat = draw_mechanism(each, random, up_in_base=up)
        bent = draw_mechanism(each, random, coplanar=False)
        np.testing.assert_array_equal(flat.up_in_base, up)
        assert out_of_plane(flat.platform_joints) < 1e-12
        assert np.linalg.matrix_rank(flat.platform_joints, tol=1e-3) == 3, "the plane runs through the origin of {2}"
        if each.platform_count > 3:
            assert out_of_plane(bent.platform_joints) > 0.02
        if each.base_count > 3:
            assert out_of_plane(flat.base_joints) > 1e-4
        for joints, greatest in ((flat.base_joints, 0.35), (bent.platform_joints, 0.35)):
            apart = [np.linalg.norm(a - b) for a, b in combinations(np.unique(joints, axis=0), 2)]
            assert min(apart) > 0.05 and np.linalg.norm(joints, axis=1).max() < greatest


def test_draws_follow_the_generator_alone() -> None:
    first, same, other = (draw_mechanism(SPATIAL[20], np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.base_joints, same.base_joints)
    np.testing.assert_array_equal(first.platform_joints, same.platform_joints)
    assert np.abs(first.base_joints - other.base_joints).max() > 0.01


def test_the_preset_has_no_shared_joint(hexapod: Mechanism) -> None:
    found = classify(hexapod)
    assert (found.name, found.label, found.drawing) == ("6-6", "n-6.1", "|⁶")


def test_a_planar_mechanism_is_classified_too() -> None:
    base = [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]]
    platform = [[0.0, 0.0], [0.3, 0.0], [0.3, 0.0]]
    found = classify(PlanarMechanism.from_legs(base, platform))
    assert found.planar and (found.name, found.drawing, found.type) == ("planar 2-2", "N", "")


def test_joints_are_numbered_by_first_appearance_and_within_the_tolerance() -> None:
    points = np.array([[2.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 5e-10], [0.0, 3.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 2e-9]])
    np.testing.assert_array_equal(joint_numbers(points), [0, 1, 0, 2, 1, 3])
    np.testing.assert_array_equal(joint_numbers([[1, 0], [0, 1], [1, 0]]), [0, 1, 0])


# ---- refusals ----


class Joints:
    """Two arrays of joints that nothing has checked."""

    def __init__(self, base: Any, platform: Any) -> None:
        """Keep the arrays."""
        self.base_joints = base
        self.platform_joints = platform


def points(numbers: list[int], size: int = 3) -> Array:
    """Joint number i at i times a fixed vector."""
    return np.outer(numbers, [0.1, 0.2, 0.3][:size])


@pytest.mark.parametrize(
    ("base", "platform", "message"),
    [
        (points([0, 1, 0, 0, 2, 0]), points([0, 1, 2, 3, 4, 5]), "legs 0, 2, 3, 5 share a base joint, which carries 3 at most"),
        (points([0, 1, 2, 3, 4, 5]), points([3, 1, 1, 1, 1, 1]), "legs 1, 2, 3, 4, 5 share a platform joint.*: move some"),
        (points([0, 0, 0, 1, 1, 1]), points([0, 1, 2, 0, 1, 2]), "the number of base joints is 2; 6 legs need 3 at least"),
        (points([0, 1, 2], 2), points([4, 4, 4], 2), "the number of platform joints is 1; 3 legs need 2 at least"),
        (points([0, 1, 2, 3, 1, 5]), points([0, 1, 2, 3, 1, 5]), "legs 1 and 4 share both joints: move one of them"),
        (points([0, 1, 2], 2), points([0, 1, 2, 3, 4, 5]), "3 legs start in base_joints and 6 end in platform_joints"),
        (points([0, 1, 2, 3]), points([0, 1, 2, 3]), r"base_joints has shape \(4, 3\); give \(6, 3\) .*, \(3, 2\) for three"),
        (points([0, 1, 2, 3, 4, 5]), points([0, 1, 2]), r"platform_joints has shape \(3, 3\)"),
        (points([0, 1, 2], 2), [[0.0, 0.0], [np.nan, 1.0], [1.0, 0.0]], "platform_joints has a coordinate that is not finite"),
        ("joints", points([0, 1, 2], 2), "base_joints must be an array of numbers"),
    ],
)
def test_what_is_no_mechanism_of_a_class_is_refused(base: Any, platform: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        classify(Joints(base, platform))


def test_another_number_of_legs_is_refused() -> None:
    with pytest.raises(InputError, match="there are 4 legs; a class has six in space or three in the plane: give as many"):
        MechanismClass(((0, 0), (1, 1), (2, 2), (3, 3)))


def test_a_planar_class_is_not_drawn_in_space() -> None:
    with pytest.raises(InputError, match=r"planar n-2\.1 has three legs in the plane; draw one of the spatial classes"):
        draw_mechanism(PLANAR[0], np.random.default_rng(0))


@spatial_class
def test_each_leg_is_found_again_in_the_numbers_of_the_class(each: MechanismClass) -> None:
    mechanism = draw_mechanism(each, np.random.default_rng(3))
    legs = canonical_legs(mechanism)
    assert sorted(legs) == list(each.legs)
    for side, joints in ((0, mechanism.base_joints), (1, mechanism.platform_joints)):
        numbers = [leg[side] for leg in legs]
        for k, other in product(range(6), repeat=2):
            assert (numbers[k] == numbers[other]) == (np.linalg.norm(joints[k] - joints[other]) < 1e-9)


def test_planar_mechanisms_are_drawn_in_every_planar_class_and_no_other() -> None:
    random = np.random.default_rng(4)
    for each in PLANAR:
        assert classify(draw_planar_mechanism(each, random)) == each
    with pytest.raises(InputError, match="six legs"):
        draw_planar_mechanism(SPATIAL[0], random)
