"""The pose of encoders that lead: from home to any pose of the workspace, and what has no solution."""

import numpy as np
import pytest

from controller.estimation import leg_filter, pose_estimator
from controller.estimation.encoders import (
    STATE,
    compare_lengths,
    encoder_parameters,
    find_pose_by_lengths,
    move_to_lengths,
    screen_encoders,
)
from controller.inverse_kinematics import inverse_kinematics, leg_lengths, sample_workspace
from controller.rig import TIME, rig_parameters
from controller.settings import FusionSettings, sensor_settings
from plant.encoders import EncoderModel, load_encoder
from plant.imu import load_imu
from plant.mechanism import LEGS, load_in_space, six_rows
from plant.pose import Pose, vector_from_rotation

FUSION, NO_HOME = FusionSettings(), np.full(LEGS, -1)


class Bench:
    """Encoders on a mechanism without IMUs; the IMUs' weights are zero until they are given."""

    def __init__(self, name):
        self.mechanism = load_in_space(name)
        encoder = load_encoder("ideal")
        known = sensor_settings(self.mechanism, load_imu("ideal"), 1000.0, encoder)
        self.parameters = encoder_parameters(encoder, known, self.mechanism, lead=True)
        self.estimator = pose_estimator.pose_parameters(FUSION, False)
        self.rig = rig_parameters(self.mechanism, 1000.0, 0.2, np.zeros(2))
        self.time, self.encoders = np.zeros((), TIME), np.zeros((), STATE)
        self.legs, self.pose = np.zeros((), leg_filter.STATE), np.zeros((), pose_estimator.STATE)

    def find(self, lengths, rates=None):
        """Whether there is a pose with these lengths (n,) [m]."""
        readings, speeds = (np.pad(each, (0, LEGS - len(each))) for each in (lengths, lengths if rates is None else rates))
        screen_encoders(self.parameters[()], self.encoders[()], 1e-3, 0, readings, speeds, NO_HOME)
        self.pose["found"] = find_pose_by_lengths(
            self.parameters[()], self.encoders[()], self.estimator[()], self.rig[()], self.time[()], self.legs[()], np.zeros(3),
            self.pose[()],
        )  # fmt: skip
        return bool(self.pose["found"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "hexapod", "genhexkins", "planar-3rpr"])
def test_from_home_it_finds_every_pose_of_the_workspace_with_its_twist(name):
    random, bench = np.random.default_rng(0), Bench(name)
    mechanism = bench.mechanism
    for position, rotation in zip(*sample_workspace(mechanism, 200, seed=1), strict=True):
        bench.pose["found"] = 0
        lengths = leg_lengths(mechanism, position, rotation)
        twist = random.normal(size=6) * ([1.0, 1.0, 0.0, 0.0, 0.0, 1.0] if mechanism.planar else 1.0)
        assert bench.find(lengths, inverse_kinematics(mechanism, Pose(position, rotation)).jacobian @ twist)
        np.testing.assert_allclose(bench.pose["position"], position, atol=1e-9)
        np.testing.assert_allclose(bench.pose["rotation"], rotation, atol=1e-8)
        np.testing.assert_allclose(bench.pose["twist"], twist, atol=1e-5)
        assert bench.pose["conditioning"] > 0.1


def test_it_follows_from_the_last_pose():
    """Across the workspace in small steps, without going back to home."""
    bench = Bench("hexapod")
    home = bench.mechanism.require_home()
    assert bench.find(leg_lengths(bench.mechanism, home.position, home.rotation))
    bench.parameters["position"] = np.nan
    for share in np.linspace(0.0, 1.0, 20):
        position = home.position + share * np.array([0.03, -0.02, 0.02])
        assert bench.find(leg_lengths(bench.mechanism, position, home.rotation))
        np.testing.assert_allclose(bench.pose["position"], position, atol=1e-9)


def test_lengths_without_a_pose_have_none():
    bench = Bench("hexapod")
    home = bench.mechanism.require_home()
    lengths = leg_lengths(bench.mechanism, home.position, home.rotation)
    assert not bench.find(lengths * [1.0, 1.0, 1.0, 1.0, 1.0, 4.0])
    assert not Bench("hexapod").find(lengths + [0.0, 0.0, np.nan, 0.0, 0.0, 0.0])


def test_for_30_ms_a_silent_encoder_counts_by_its_last_reading_and_its_rate():
    bench = Bench("hexapod")
    home = bench.mechanism.require_home()
    speed, nothing = np.array([0.05, -0.02, 0.03, 0.0, 0.0, 0.0]), np.full(6, np.nan)
    rates = inverse_kinematics(bench.mechanism, home).jacobian @ speed
    assert bench.find(leg_lengths(bench.mechanism, home.position, home.rotation), rates)
    for cycle in range(1, 30):
        assert bench.find(nothing, nothing)
        moved = bench.pose["position"] - home.position
        np.testing.assert_allclose(moved, 1e-3 * cycle * speed[:3], atol=0.02e-3)
    assert not [bench.find(nothing, nothing) for _ in range(2)][-1]


def test_where_an_encoder_is_silent_the_platform_s_vertical_makes_up_for_it():
    bench = Bench("hexapod")
    position, rotation = (each[0] for each in sample_workspace(bench.mechanism, 1, seed=2))
    lengths = leg_lengths(bench.mechanism, position, rotation)
    lengths[2] = np.nan
    assert not bench.find(lengths)
    bench.pose["found"] = 0
    bench.pose["vectors"][0] = bench.mechanism.up_in_base @ rotation
    bench.pose["vector_weights"][0] = 1.0 / FUSION.tilt_sigma**2
    assert bench.find(lengths)
    np.testing.assert_allclose(bench.pose["position"], position, atol=1e-7)


def test_directions_of_legs_make_up_for_it_too():
    bench = Bench("hexapod")
    position, rotation = (each[0] for each in sample_workspace(bench.mechanism, 1, seed=3))
    legs = inverse_kinematics(bench.mechanism, Pose(position, rotation))
    bench.legs["directions"] = six_rows(legs.directions)
    bench.legs["weights"][:2] = 1.0 / FUSION.leg_sigma**2
    lengths = legs.lengths.copy()
    lengths[3:5] = np.nan
    assert bench.find(lengths)
    np.testing.assert_allclose(bench.pose["position"], position, atol=1e-7)


def test_a_zero_is_the_mean_of_what_the_imus_say_weighted_by_the_time_before():
    """Their lengths are means over time themselves, and get better; without new ones the pose stays where the encoders are."""
    mechanism, encoder = load_in_space("hexapod"), load_encoder("incremental")
    parameters = encoder_parameters(encoder, sensor_settings(mechanism, load_imu("ideal"), 1000.0, encoder), mechanism)
    rig, home = rig_parameters(mechanism, 1000.0, 0.2, np.zeros(2)), mechanism.home
    encoders, pose, time = np.zeros((), STATE), np.zeros((), pose_estimator.STATE), np.zeros((), TIME)
    pose["information"], pose["factor"] = np.eye(6), np.eye(6)
    random, heights, readings = np.random.default_rng(4), [], leg_lengths(mechanism, home.position, home.rotation)
    for _ in range(50):
        heights.append(random.normal(0.0, 1e-5))
        pose["position"], pose["rotation"] = home.position + [0.0, 0.0, heights[-1]], home.rotation
        screen_encoders(parameters[()], encoders[()], 1e-3, 0, readings, np.zeros(LEGS), NO_HOME)
        compare_lengths(parameters[()], encoders[()], rig[()], pose[()])
        assert move_to_lengths(parameters[()], encoders[()], rig[()], time[()], pose[()])
        time["cycle"] += 1
    expected = np.average(heights, weights=np.arange(50))
    assert pose["position"][2] - home.position[2] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("name", ["hexapod", "planar-3rpr"])
def test_how_far_an_unseen_error_moves_the_pose(name):
    """As far as the pose goes when one reading is off by that; the encoder that moves it the most counts."""
    mechanism, encoder = load_in_space(name), load_encoder("absolute")
    parameters = encoder_parameters(encoder, sensor_settings(mechanism, load_imu("ideal"), 1000.0, encoder), mechanism)
    rig, home, legs = rig_parameters(mechanism, 1000.0, 0.2, np.zeros(2)), mechanism.home, range(mechanism.legs)
    time, lengths, unseen = np.zeros((), TIME), np.zeros(LEGS), np.linspace(1e-5, 3e-5, LEGS)
    lengths[: mechanism.legs] = leg_lengths(mechanism, home.position, home.rotation)

    def moved(readings):
        encoders, pose = np.zeros((), STATE), np.zeros((), pose_estimator.STATE)
        pose["information"], pose["factor"] = np.eye(6), np.eye(6)
        pose["position"], pose["rotation"], pose["bent"] = home.position, home.rotation, 9.0
        screen_encoders(parameters[()], encoders[()], 1e-3, 0, readings, np.zeros(LEGS), NO_HOME)
        compare_lengths(parameters[()], encoders[()], rig[()], pose[()])
        encoders["unseen"] = unseen
        assert move_to_lengths(parameters[()], encoders[()], rig[()], time[()], pose[()])
        shift = pose["position"] - home.position, vector_from_rotation(pose["rotation"] @ home.rotation.T)
        return pose["bent"], np.linalg.norm(shift, axis=1)

    bent, still = moved(lengths)
    np.testing.assert_allclose(still, 0.0, atol=1e-12)
    steps = np.array([moved(lengths + unseen * (np.arange(LEGS) == k))[1] for k in legs])
    np.testing.assert_allclose(bent, steps.max(axis=0), rtol=1e-3)
    nothing, _ = moved(np.full(LEGS, np.nan))
    np.testing.assert_array_equal(nothing, 0.0)


def test_a_home_switch_makes_a_zero_exact_to_where_it_was_passed():
    """Between two readings; not where one is missing, where they are far apart, or where the switch was not known before."""
    mechanism, model = load_in_space("hexapod"), EncoderModel("homed", switches=(0.4,) * LEGS)
    parameters = encoder_parameters(model, sensor_settings(mechanism, load_imu("ideal"), 1000.0, model), mechanism)
    encoders = np.zeros((), STATE)
    encoders["home"] = [0, 0, 0, 0, -1, 0]
    encoders["carried"], encoders["zero"], encoders["followed_for"] = 0.4998, 0.099, 2.0
    encoders["silent_for"][2] = 1e-3
    readings, home = np.full(LEGS, 0.5002), np.array([1, 0, 1, 1, 1, 1])
    readings[3], encoders["excluded"][5] = 0.501, 1
    screen_encoders(parameters[()], encoders[()], 1e-3, 0, readings, np.zeros(LEGS), home)
    assert encoders["passed_switch"].tolist() == [1, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(encoders["zero"], [0.1, *[0.099] * 5], rtol=1e-12)
    np.testing.assert_allclose(encoders["switch_step"][0], 4e-4, rtol=1e-9)
    assert np.isinf(encoders["followed_for"]).tolist() == [True, *[False] * 5]
    # It tells no more while the leg stays beyond it, and again on the way back.
    screen_encoders(parameters[()], encoders[()], 1e-3, 0, readings, np.zeros(LEGS), home)
    assert not encoders["passed_switch"].any()
    screen_encoders(parameters[()], encoders[()], 1e-3, 0, readings - 2e-4, np.zeros(LEGS), 1 - home)
    assert encoders["passed_switch"].tolist() == [1, 1, 1, 1, 1, 0]
    np.testing.assert_allclose(encoders["zero"][:3], 0.1001, rtol=1e-12)
