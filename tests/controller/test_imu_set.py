"""Which sets of IMUs do: those that there are, the conditioning over the workspace, and the limits of what gravity and the
magnetic field tell.
"""

import re

import numpy as np
import pytest

from controller.direct_kinematics import integrity, solve, solve_batch
from controller.imu_set import (
    are_few,
    check_imus,
    encoder_remark,
    imus_of,
    integrity_remark,
    length_share,
    lengths_lead,
    measured_rows,
    pose_share,
)
from controller.inverse_kinematics import inverse_kinematics, sample_workspace
from controller.settings import FusionSettings
from plant.encoders import load_encoder
from plant.errors import InputError
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import Mechanism, load_in_space, load_mechanism
from tests.controller.leg_geometry import leg_directions, unit


def test_a_planar_mechanism_has_the_imus_of_three_legs_and_the_platform(hexapod):
    planar = load_in_space("planar-3rpr")
    assert imus_of(planar) == (0, 1, 2, 6)
    assert imus_of(planar, (6, 5, 3, 2, 0)) == (0, 2, 6)
    assert imus_of(hexapod) == (0, 1, 2, 3, 4, 5, 6)
    assert imus_of(hexapod, [6, 4, 1]) == (1, 4, 6)
    assert imus_of(hexapod, {3}) == (3,)


def test_few_are_fewer_than_five_in_space(hexapod):
    planar = load_in_space("planar-3rpr")
    assert are_few(hexapod, (0, 1, 3, 4)) and are_few(hexapod, {6, 0, 5}) and not are_few(hexapod, (0, 1, 2, 3, 6))
    assert not are_few(planar, ALL_IMUS)


@pytest.mark.parametrize(
    ("imus", "method"), [(range(6), "legs"), ((0, 1, 3, 4), "legs"), (range(7), "up"), ((0, 2, 3, 6), "up")]
)
def test_the_worst_conditioning_over_the_workspace_is_told(hexapod, imus, method):
    """The least of the public solver's over the same poses."""
    poses = sample_workspace(hexapod, 50, seed=0)
    directions = np.array([leg_directions(hexapod, *pose) for pose in zip(*poses, strict=True)])
    directions[:, [leg for leg in range(6) if leg not in imus]] = np.nan
    known = {"up_in_platform": hexapod.up_in_base @ poses[1]} if method == "up" else {}
    found = solve_batch(hexapod, directions, method=method, workers=1, **known)
    assert check_imus(hexapod, imus) == pytest.approx(found.conditionings.min(), rel=1e-9)
    assert found.conditionings.min() < 0.99 * np.median(found.conditionings)


def with_field(hexapod, horizontal):
    return Mechanism.from_legs(
        hexapod.base_joints, hexapod.platform_joints, home=hexapod.home, limits={"stroke": hexapod.limits.stroke},
        plant={**hexapod.plant, "magnetic_field": [0.6 * horizontal, -0.8 * horizontal, -60.0]},
    )  # fmt: skip


def test_a_heading_needs_5_microtesla_across_the_vertical(hexapod):
    assert check_imus(with_field(hexapod, 5.01), ALL_IMUS, magnetometer=True) > 0.0
    with pytest.raises(InputError, match=r"the horizontal magnetic field is 4\.99 uT; a heading needs at least 5"):
        check_imus(with_field(hexapod, 4.99), ALL_IMUS, magnetometer=True)
    # Nobody asks for it without a magnetometer.
    assert check_imus(with_field(hexapod, 0.1), ALL_IMUS) > 0.0


def least_across(mechanism):
    """For each leg, the least share of the vertical across both axes of its joint over home and the poses that are looked at,
    with the sign that it has at home counted as positive.
    """
    home, poses = mechanism.home, sample_workspace(mechanism, 50, seed=0)
    found = []
    for pose in [(home.position, home.rotation), *zip(*poses, strict=True)]:
        directions = leg_directions(mechanism, *pose)
        seconds = unit(np.cross(directions, mechanism.base_joint_axes))
        found.append(np.cross(mechanism.base_joint_axes, seconds) @ mechanism.up_in_base)
    found = np.array(found)
    return (found * np.sign(found[0])).min(axis=0)


@pytest.mark.parametrize("leg", [0, 3, 5])
@pytest.mark.parametrize("share", [0.6, 0.4, 0.3, 0.19, -0.19, -0.3, -0.4, -0.6])
def test_gravity_must_lie_across_the_axes_of_a_legs_joint_in_the_whole_workspace(hexapod, leg, share):
    """The joint's third axis, across the first, near the leg's direction at home, leans so that this share is vertical."""
    # In the frame of the joint the third axis is what of the leg is across the first axis, and the second is across both.
    up_in_joint = unit([np.sqrt(1.0 - share**2), 0.0, share])
    up = hexapod.joint_rotations[leg] @ up_in_joint
    leaning = Mechanism.from_legs(
        hexapod.base_joints, hexapod.platform_joints, up_in_base=up, home=hexapod.home,
        base_joint_axes=hexapod.base_joint_axes, limits={"stroke": hexapod.limits.stroke},
        plant={**hexapod.plant, "gravity": -9.81 * up},
    )  # fmt: skip
    least = least_across(leaning)
    assert least[leg] < abs(share)
    others = [k for k in range(6) if k != leg and least[k] >= 0.2]
    if least[leg] >= 0.2:
        check_imus(leaning, (*others, leg, 6))
    else:
        with pytest.raises(
            InputError, match=rf"the angles of leg {leg}: of the vertical only {least[leg]:.2g} lies across"
        ) as told:
            check_imus(leaning, (leg, 6))
        assert f"turn base_joint_axes[{leg}], such as to [" in str(told.value)


def test_a_leg_must_stay_away_from_the_first_axis_of_its_joint(hexapod):
    """The first axis is 15 deg from the leg at home, and the leg turns by more than 7 of them."""
    axes = hexapod.base_joint_axes.copy()
    direction = hexapod.home_directions[2]
    axes[2] = np.cos(np.radians(15.0)) * direction + np.sin(np.radians(15.0)) * axes[2]
    near = Mechanism.from_legs(
        hexapod.base_joints, hexapod.platform_joints, home=hexapod.home, base_joint_axes=axes,
        limits={"stroke": hexapod.limits.stroke}, plant=hexapod.plant,
    )  # fmt: skip
    with pytest.raises(
        InputError, match=r"leg 2 comes to within .* of the first axis .* 8\.1 deg are needed: turn base_joint_axes\[2\]"
    ):
        check_imus(near, ALL_IMUS)
    check_imus(near, (0, 1, 3, 4, 5, 6))


@pytest.mark.parametrize(("share", "fits"), [(0.21, True), (0.19, False)])
def test_gravity_must_lie_in_the_plane_of_a_planar_mechanism(share, fits):
    planar = load_mechanism("planar-3rpr")
    gravity = -9.81 * np.array([0.0, share, np.sqrt(1.0 - share**2)])
    made = type(planar).from_legs(
        planar.base_joints, planar.platform_joints, home=planar.home, limits={"stroke": [-0.02, 0.02]},
        plant={**planar.plant, "gravity": gravity},
    )  # fmt: skip
    rig = Mechanism.from_planar(made)
    if fits:
        assert check_imus(rig, ALL_IMUS) > 0.0
    else:
        with pytest.raises(InputError, match=r"of the vertical only 0\.19 lies in it, and 0\.2 is needed"):
            check_imus(rig, ALL_IMUS)


def test_the_heading_and_two_legs_are_conditioned_as_section_5_is(hexapod):
    mechanism, poses = with_field(hexapod, 20.0), sample_workspace(hexapod, 50, seed=0)
    directions = np.array([leg_directions(hexapod, *pose) for pose in zip(*poses, strict=True)])
    directions[:, [1, 2, 4, 5]] = np.nan
    found = solve_batch(hexapod, directions, rotation=poses[1], method="section-5", workers=1)
    told = check_imus(mechanism, (0, 3, 6), magnetometer=True)
    assert told == pytest.approx(found.conditionings.min(), rel=1e-9)
    assert check_imus(mechanism, ALL_IMUS, magnetometer=True, section_5=True) > told


# ---- how well they check each other ----

FUSION = FusionSettings()


@pytest.mark.parametrize(
    ("name", "imus", "magnetometer", "told"),
    [
        ("hexapod", range(7), False, None),
        ("hexapod", range(6), False, None),
        ("hexapod", range(1, 7), False, "IMU 6: an error there is not told"),
        ("hexapod", range(7), True, None),
        ("hexapod", (0, 1, 3, 4, 6), False, "IMU 6: an error there is not told"),
        ("hexapod", (0, 1, 3, 4), False, "one of them is not told"),
        ("hexapod", (0, 2, 4, 6), False, "IMU 6: an error there is not told"),
        ("hexapod", (0, 5, 6), True, "one of them is not told"),
        ("planar-3rpr", range(7), False, "IMU 6: an error there is not told"),
        ("planar-3rpr", (0, 2, 6), False, "one of them is not told"),
    ],
)
def test_few_imus_that_hardly_check_each_other_are_named(name, imus, magnetometer, told):
    mechanism = load_in_space(name)
    remark = integrity_remark(mechanism, FUSION, imus, magnetometer)
    if told is None:
        assert remark == ""
        return
    begins = f"the others hardly check {told}, and 1 deg of IMU"
    if "one of them" in told:
        names = ", ".join(map(str, imus_of(mechanism, imus)))
        begins = f"the IMUs {names} hardly check each other: an error of {told}, and 1 deg of IMU"
    assert remark.startswith(begins)
    assert remark.endswith(": add IMUs") == (imus != range(7))


def test_an_error_moves_the_pose_as_the_remark_says(hexapod):
    """Four legs without the platform, one of them turned by a little: the public solver agrees on how far, and that it
    cannot say whose error it is.
    """
    imus = (0, 1, 3, 4)
    remark = integrity_remark(hexapod, FUSION, imus)
    far, mm, deg = re.fullmatch(
        r".*1 deg of IMU (\d) moves the pose by ([\d.]+) mm and ([\d.]+) deg: add IMUs", remark
    ).groups()
    home = hexapod.home
    directions = leg_directions(hexapod, home.position, home.rotation)
    directions[[2, 5]] = np.nan
    furthest = np.zeros(2)
    for leg in imus:
        sideways = np.linalg.svd(directions[leg][None])[2][1:]
        for angle in np.linspace(0.0, np.pi, 37):
            turned = directions.copy()
            turned[leg] = unit(turned[leg] + 1e-4 * np.array([np.cos(angle), np.sin(angle)]) @ sideways)
            found = solve(hexapod, turned, method="legs", refine=True)
            turn = np.arccos(np.clip((np.trace(found.rotation @ home.rotation.T) - 1.0) / 2.0, -1.0, 1.0))
            moved = np.array([np.linalg.norm(found.position - home.position), turn]) / 1e-4
            if leg == int(far):
                furthest = np.maximum(furthest, moved)
            assert moved[0] <= 1.01 * float(mm) / np.radians(1.0) * 1e-3 + 1e-2
    assert 1e3 * furthest[0] * np.radians(1.0) == pytest.approx(float(mm), rel=0.02)
    assert furthest[1] == pytest.approx(float(deg), rel=0.02)
    turned = directions.copy()
    turned[3] = unit(turned[3] + np.radians(2.0) * np.linalg.svd(turned[3][None])[2][1])
    found = integrity(hexapod, turned)
    assert found.detected and found.faulty is None


INCREMENTAL, ABSOLUTE = load_encoder("incremental"), load_encoder("absolute")


@pytest.mark.parametrize("imus", [(6,), (0, 3), (0, 6), (0, 1, 2)])
def test_absolute_encoders_determine_the_pose_beside_any_imus(hexapod, imus):
    assert check_imus(hexapod, imus, encoder=ABSOLUTE) > 0.1
    assert lengths_lead(hexapod, imus, encoder=ABSOLUTE)
    with pytest.raises(InputError, match=r"and incremental encoders tell none at power-on: add legs.*\(--lengths absolute\)$"):
        check_imus(hexapod, imus, encoder=INCREMENTAL)
    with pytest.raises(InputError, match=r"or absolute encoders \(--lengths absolute\)$"):
        check_imus(hexapod, imus)


def test_imus_that_determine_the_pose_lead_whatever_the_encoders(hexapod):
    for encoder in (None, INCREMENTAL, ABSOLUTE):
        assert check_imus(hexapod, (0, 2, 3, 6), encoder=encoder) == check_imus(hexapod, (0, 2, 3, 6))
        assert not lengths_lead(hexapod, (0, 2, 3, 6), encoder=encoder)
    assert not lengths_lead(hexapod, (0, 3, 6), magnetometer=True, encoder=ABSOLUTE)


def test_absolute_encoders_tell_the_assembly_modes_of_a_planar_mechanism_apart():
    planar = load_in_space("planar-3rpr")
    assert check_imus(planar, (0, 1, 2), encoder=ABSOLUTE) > 0.01 and lengths_lead(planar, (0, 1, 2), encoder=ABSOLUTE)
    for encoder in (None, INCREMENTAL):
        with pytest.raises(InputError, match="add the platform's IMU"):
            check_imus(planar, (0, 1, 2), encoder=encoder)
    assert not lengths_lead(planar, ALL_IMUS, encoder=ABSOLUTE)


def test_lengths_that_do_not_determine_the_pose_are_no_remedy(hexapod):
    """Base and platform alike and level: to first order no length changes with a turn about the vertical."""
    alike = Mechanism.from_legs(
        hexapod.base_joints, hexapod.base_joints, home=hexapod.home, limits={"stroke": [-0.02, 0.02]}, plant=hexapod.plant
    )
    with pytest.raises(InputError, match="do not determine the pose"):
        check_imus(alike, (6,), encoder=ABSOLUTE)


def test_few_imus_know_lengths_and_pose_less_well(hexapod):
    """By as much as the standard deviations of simulated least squares at home."""
    fusion, random = FusionSettings(), np.random.default_rng(0)
    assert length_share(hexapod, fusion, ALL_IMUS) == pose_share(hexapod, fusion, ALL_IMUS) == 1.0

    def poses(imus):
        rows = np.vstack([rows for rows, _ in measured_rows(hexapod, fusion, imus).values()])
        return np.linalg.lstsq(rows, random.normal(size=(len(rows), 4000)), rcond=None)[0]

    few, many = poses((0, 4, 5, 6)), poses(ALL_IMUS)
    of_lengths = [(inverse_kinematics(hexapod, hexapod.home).jacobian @ each).std(axis=1).max() for each in (few, many)]
    assert length_share(hexapod, fusion, (0, 4, 5, 6)) == pytest.approx(of_lengths[0] / of_lengths[1], rel=0.05)
    for imus, part in (((0, 4, 5, 6), slice(3)), ((1, 2, 3, 4), slice(3, 6))):
        share = poses(imus)[part].std() / many[part].std()
        assert pose_share(hexapod, fusion, imus) == pytest.approx(share, rel=0.05)
    assert encoder_remark(False) == "" and "by iteration from home" in encoder_remark(True)
