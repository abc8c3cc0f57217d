"""The largest box and ellipsoid, volumes and slices, against random poses."""

import numpy as np
import pytest

from controller.workspace import (
    GEOMETRY_ALONE,
    LIMITS,
    Demands,
    largest_box,
    largest_ellipsoid,
    margins,
    poses_about,
    reach_from,
    slice_about,
)
from plant.errors import InputError
from plant.mechanism import load_in_space, load_spatial
from tests.controller.workspace.twin import limited, slow_margins

CUBE = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)


def moves_within(half_sizes, count, seed, ellipsoid):
    random = np.random.default_rng(seed)
    if not ellipsoid:
        # Many of them on the surface, where the limits are met first.
        points = np.clip(random.uniform(-1.6, 1.6, (count, 6)), -1.0, 1.0)
    else:
        points = random.standard_normal((count, 6)) * (half_sizes > 0.0)
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points * half_sizes


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("hexapod", marks=pytest.mark.slow), "planar-3rpr"])
@pytest.mark.parametrize("find", [largest_box, largest_ellipsoid])
def test_every_pose_of_the_largest_region_is_reached_and_a_larger_one_touches(name, find):
    mechanism = limited(name)
    shape = (1.0, 1.0, 0.0, 0.0, 0.0, 2.0) if mechanism.planar else (1.0, 1.0, 1.0, 2.0, 2.0, 2.0)
    region = find(mechanism, mechanism.home, shape, GEOMETRY_ALONE)
    moves = moves_within(region.half_sizes, 10_000, 0, find is largest_ellipsoid)
    slow = slow_margins(mechanism, *poses_about(mechanism.home, 0.999 * moves), forces=False, conditioning=False)
    assert slow.min() > -1e-9
    touched = slow_margins(mechanism, region.pose.position[None], region.pose.rotation[None], forces=False, conditioning=False)[
        0
    ]
    assert touched.min() == pytest.approx(0.0, abs=1e-7)
    assert region.limit is not None and touched[LIMITS.index(region.limit)] == pytest.approx(0.0, abs=1e-7)


def test_the_boxes_of_the_hexapod_are_those_of_its_design():
    """Section 10 of the design: +-38 mm at no rotation, +-31 mm with +-2 deg, +-19 mm with +-5 deg."""
    hexapod = load_spatial("hexapod")
    for half, tilt in ((0.038, 0.0), (0.031, 2.0), (0.019, 5.0)):
        shape = np.repeat([half, np.radians(tilt)], 3)
        found = largest_box(hexapod, hexapod.home, shape).half_sizes
        assert found[0] == pytest.approx(half, rel=0.03)
        np.testing.assert_allclose(found / found[0], shape / half, atol=1e-12)


def test_the_largest_ball_of_positions_has_the_stroke_for_its_radius():
    """Moved by r along a leg, that leg changes by r, and no leg changes by more."""
    hexapod = load_spatial("hexapod")
    found = largest_ellipsoid(hexapod, hexapod.home, CUBE)
    assert found.half_sizes[:3] == pytest.approx(0.06, abs=1e-6)


def test_the_volume_is_that_of_random_poses():
    """Of the hexapod, whose reach is seen whole from home."""
    mechanism = limited("hexapod")
    random, half = np.random.default_rng(1), 0.13
    moves = np.zeros((60_000, 6))
    moves[:, :3] = random.uniform(-half, half, (60_000, 3))
    share = margins(mechanism, *poses_about(mechanism.home, moves), GEOMETRY_ALONE).reachable.mean()
    found = reach_from(mechanism, mechanism.home, GEOMETRY_ALONE)
    assert found.volume == pytest.approx(share * (2.0 * half) ** 3, rel=0.03)
    assert sum(found.shares.values()) == pytest.approx(1.0)


def test_the_area_of_a_planar_mechanism():
    planar = load_in_space("planar-3rpr")
    random, half = np.random.default_rng(1), 0.08
    moves = np.zeros((60_000, 6))
    moves[:, :2] = random.uniform(-half, half, (60_000, 2))
    share = margins(planar, *poses_about(planar.home, moves), GEOMETRY_ALONE).reachable.mean()
    assert reach_from(planar, planar.home, GEOMETRY_ALONE).volume == pytest.approx(share * (2.0 * half) ** 2, rel=0.05)
    assert 0.0 < reach_from(planar, planar.home, GEOMETRY_ALONE, turning=True).volume < 2.0 * np.pi


def test_a_slice_is_what_margins_say():
    mechanism = limited("hexapod")
    found = slice_about(mechanism, mechanism.home, ("x", "rz"), GEOMETRY_ALONE, points=21)
    assert found.reachable.shape == (21, 21) and 0.2 < found.reachable.mean() < 0.9
    moves = np.zeros((1, 6))
    for row, column in ((0, 0), (10, 10), (20, 3)):
        moves[0, [0, 5]] = found.columns[column], found.rows[row]
        one = margins(mechanism, *poses_about(mechanism.home, moves), GEOMETRY_ALONE)
        assert found.reachable[row, column] == one.reachable[0]
        assert found.binding[row, column] == one.binding[0]
    edge = np.concatenate([found.reachable[0], found.reachable[-1], found.reachable[:, 0], found.reachable[:, -1]])
    assert edge.mean() < 0.1


def test_shapes_and_slices_that_are_none_are_refused():
    hexapod, planar = load_spatial("hexapod"), load_in_space("planar-3rpr")
    for shape in (np.zeros(6), -np.ones(6)):
        with pytest.raises(InputError, match="give sizes of at least 0 along x, y, z, rx, ry, rz"):
            largest_box(hexapod, hexapod.home, shape)
    with pytest.raises(InputError, match="along x, y and rz alone"):
        largest_ellipsoid(planar, planar.home, CUBE, Demands(forces=False))
    with pytest.raises(InputError, match="take two of x, y, rz"):
        slice_about(planar, planar.home, ("x", "z"))
    with pytest.raises(InputError, match="no slice along x and x"):
        slice_about(hexapod, hexapod.home, ("x", "x"))
