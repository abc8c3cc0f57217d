"""How many encoders are needed beside IMUs: against Gauss-Newton on the readings of single sets, and by counting equations."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from controller.direct_kinematics import required_lengths
from controller.direct_kinematics.requirements import length_conditionings
from controller.inverse_kinematics import leg_lengths
from plant.mechanism import load_in_space
from plant.mechanism.classification import draw_mechanism, spatial_classes

EQUATIONS = {"nothing": 0, "up_in_platform": 2, "rotation": 3}
PRESETS = ("6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "hexapod", "genhexkins")


def fewest(mechanism):
    return {(need.platform, need.legs): need.fewest for need in required_lengths(mechanism)}


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_needs_as_many_lengths_as_equations_lack(name):
    """Six less two for each leg's IMU and those of the platform."""
    found = fewest(load_in_space(name))
    assert len(found) == 4 + 3 + 3
    for (platform, legs), lengths in found.items():
        assert lengths == max(0, 6 - EQUATIONS[platform] - 2 * legs)


def test_a_planar_one_needs_three_equations():
    """A leg's IMU and the platform's each tell one; three leg angles leave two poses, which is one direction in between."""
    found = fewest(load_in_space("planar-3rpr"))
    for legs in (0, 1, 2):
        assert found[("nothing", legs)] == 3 - legs
        assert found[("up_in_platform", legs)] == 2 - legs


def readings(mechanism, pose, imus, encoders, tilt):
    """What the sensors of a set read at a pose: position and rotation vector."""
    rotation = Rotation.from_rotvec(pose[3:]).as_matrix()
    legs = pose[:3] + mechanism.platform_joints @ rotation.T - mechanism.base_joints
    lengths = np.linalg.norm(legs, axis=1)
    directions = (legs / lengths[:, None])[list(imus)].ravel()
    return np.concatenate([lengths[list(encoders)], directions, tilt * (mechanism.up_in_base @ rotation)])


@pytest.mark.parametrize(
    ("imus", "encoders", "tilt", "found"),
    [
        ((), range(6), 0.0, True),
        ((), range(5), 0.0, False),
        ((), range(5), 1.0, True),
        ((0, 3), (1, 2, 4, 5), 0.0, True),
        ((0, 1), (0, 1), 0.0, False),
    ],
)
def test_a_set_that_suffices_leads_gauss_newton_to_the_pose(imus, encoders, tilt, found):
    """From 10 mm and 3 deg off; a set that does not suffice fits its readings at another pose."""
    mechanism = load_in_space("hexapod")
    true = np.r_[mechanism.home.position + [0.01, -0.02, 0.01], 0.1, -0.05, 0.15]
    exact = readings(mechanism, true, imus, encoders, tilt)
    start = true + np.r_[0.01, 0.0, -0.01, 0.05, 0.02, -0.04]
    fit = least_squares(lambda pose: readings(mechanism, pose, imus, encoders, tilt) - exact, start, xtol=1e-15, ftol=1e-15)
    assert np.abs(fit.fun).max() < 1e-7
    assert (np.abs(fit.x - true).max() < 1e-5) == found


@pytest.mark.slow
def test_what_always_suffices_is_at_least_what_suffices_at_best():
    for number, each in enumerate(spatial_classes()[::6]):
        for need in required_lengths(draw_mechanism(each, np.random.default_rng(number))):
            assert need.any_choice is None or need.fewest <= need.any_choice <= 6


@pytest.mark.parametrize("name", ["hexapod", "planar-3rpr"])
def test_the_conditioning_of_lengths_is_how_little_they_change(name):
    """The least change of all lengths over 2000 small moves of the same size; a turn counts at the spread of the joints."""
    mechanism, random = load_in_space(name), np.random.default_rng(0)
    home = mechanism.require_home()
    spread = np.linalg.norm(mechanism.platform_joints - mechanism.platform_joints.mean(axis=0), axis=1).max()
    moves = random.normal(size=(20000, 6)) * ([1.0, 1.0, 0.0, 0.0, 0.0, 1.0] if mechanism.planar else 1.0)
    moves *= 1e-6 / np.linalg.norm(moves, axis=1, keepdims=True)
    turned = Rotation.from_rotvec(moves[:, 3:] / spread).as_matrix() @ home.rotation
    before = leg_lengths(mechanism, home.position, home.rotation)
    changes = leg_lengths(mechanism, home.position + moves[:, :3], turned) - before
    least = np.linalg.norm(changes, axis=1).min() / 1e-6
    assert length_conditionings(mechanism, home.position[None], home.rotation[None])[0] == pytest.approx(least, rel=0.2)
