"""A platform at rest: what creeps by commands alone, what gyroscopes show as well, and both in closed loop."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.estimation.integrity.rest import compare_at_rest, forget_motion
from controller.inverse_kinematics import leg_lengths
from controller.safety.causes import Cause
from hil.runs.config import SimulationConfig
from hil.runs.simulation import SimulationStoppedError, simulate
from plant.fmu.settings import Setting
from plant.pose import rotation_from_vector
from tests.controller.estimation.integrity.test_commanded import errors_and_levels
from tests.controller.safety.moving import PERIOD_S, moving

DROOP = 2e-5
MEAN_S, ADDED_S, WARMING_S = 2.5, 5.0, 20.0


class Resting:
    """A loop that holds home: commands, loads and gyroscopes are what a test makes of them."""

    def __init__(self, mechanism="hexapod"):
        self.mechanism, self.parameters, self.state = moving(mechanism)
        self.loads, self.covariance = np.zeros(6), np.zeros((6, 6))

    def run(self, seconds, commands=0.0, twist=0.0, follows=True, measured=False, shaken=False, source=0):
        """Cycles with these commands of all legs [m/s] and this twist that the gyroscopes show."""
        s = self.state
        commanded, twist = np.broadcast_to(commands, 6).astype(float), np.broadcast_to(twist, 6).astype(float)
        for _ in range(round(seconds / PERIOD_S)):
            compare_at_rest(
                self.rest[()], self.parameters["rig"][()], PERIOD_S, follows, measured, shaken, commanded, DROOP, self.loads,
                twist, self.covariance, source, s["pose"][()], s["reference"][()],
            )  # fmt: skip

    @property
    def rest(self):
        return self.state["integrity"]["rest"]

    @property
    def crept(self):
        """By how much position and rotation have crept."""
        return self.rest["crept"].copy()

    def rates_of(self, twist):
        """The rates of the legs (6,) when the platform moves at home, by the difference of two poses."""
        home, lengths = self.mechanism.home, []
        for sign in (-0.5, 0.5):
            turned = rotation_from_vector(sign * 1e-4 * twist[3:]) @ home.rotation
            lengths.append(leg_lengths(self.mechanism, home.position + sign * 1e-4 * twist[:3], turned))
        return (lengths[1] - lengths[0]) / 1e-4


def drawn_twist(random):
    return np.concatenate([random.normal(0.0, 1e-3, 3), random.normal(0.0, 5e-3, 3)])


@settings(max_examples=5)
@given(seed=st.integers(0, 10**6))
def test_what_is_commanded_beyond_what_holds_the_legs_still_counts_as_creep(seed):
    random, loop = np.random.default_rng(seed), Resting()
    holding, twist = random.normal(0.0, 0.003, 6), drawn_twist(random)
    # The first second is that of a loop that still settles.
    loop.run(0.9, holding + 0.01)
    loop.run(MEAN_S - 0.9 + 2 * PERIOD_S, holding)
    assert loop.crept.max() < 1e-7
    loop.run(4.0, holding + loop.rates_of(twist))
    expected = 4.0 * np.array([np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])])
    np.testing.assert_allclose(loop.crept, expected, rtol=2e-3)
    # A load that is known to have changed takes its share.
    crept, loop.loads = loop.crept, loop.loads + 20.0
    loop.run(1.0, holding + DROOP * 20.0)
    np.testing.assert_allclose(loop.crept, crept, rtol=1e-9)


def test_what_has_crept_fades_in_motion_and_a_rest_begins_anew_after_it():
    loop = Resting()
    loop.run(2.6)
    loop.run(2.4, 0.002)
    crept, rates = loop.crept, loop.state["reference"]["motion"][:, 1]
    assert crept[0] > 3e-3
    rates[2] = 1e-3
    loop.run(5.0)
    np.testing.assert_allclose(loop.crept, np.exp(-1.0) * crept, rtol=1e-3, atol=1e-12)
    crept, rates[2] = loop.crept, 0.0
    loop.run(1.2, 0.001)
    loop.run(1.2, 0.002)
    np.testing.assert_array_equal(loop.crept, crept)
    loop.run(PERIOD_S, follows=False)
    assert (loop.crept == 0.0).all()


def test_where_the_legs_did_not_determine_the_pose_for_a_while_the_creep_is_known_again():
    loop = Resting()
    directions = loop.state["pose"]["directions"].copy()
    loop.run(2.6)
    loop.run(0.4, 0.002)
    crept = loop.crept
    loop.state["pose"]["directions"] = [0.0, 0.0, 1.0]
    loop.run(PERIOD_S, 0.002)
    np.testing.assert_array_equal(loop.crept, crept)
    loop.state["pose"]["directions"] = directions
    loop.run(PERIOD_S, 0.002)
    assert crept[0] < loop.crept[0] < 2e-3 and loop.crept[1] < 1e-6


def test_nothing_is_added_up_where_encoders_measure_the_legs():
    loop = Resting()
    loop.run(2.6, measured=True)
    loop.run(2.4, 0.002, 0.002, measured=True)
    assert (loop.crept == 0.0).all() and loop.rest["both"] == 0.0


def test_while_imus_are_shaken_no_motion_is_added_up_and_the_means_are_taken_anew_after_it():
    loop = Resting()
    twist = np.array([2e-3, -1e-3, 1e-3, 5e-3, 0.0, 2e-3])
    rates = loop.rates_of(twist)
    loop.run(2.6)
    loop.run(1.0, rates, twist)
    assert loop.rest["both"] > 1e-3
    loop.run(1.0, 30.0 * rates, 30.0 * twist, shaken=True)
    assert loop.rest["both"] == 0.0
    loop.run(MEAN_S + 1.0, rates, twist)
    assert loop.rest["both"] < 1e-7


def expected_sum(rate, seconds, warming):
    """m' = r(t) - m / tau from zero, for a constant rate r, or one whose mean is learned: r exp(-t / T)."""
    left = np.exp(-seconds / ADDED_S)
    if not warming:
        return rate * ADDED_S * (1.0 - left)
    return rate * (np.exp(-seconds / WARMING_S) - left) / (1.0 / ADDED_S - 1.0 / WARMING_S)


@settings(max_examples=5)
@given(seed=st.integers(0, 10**6), seconds=st.floats(0.5, 15.0))
def test_a_motion_that_commands_and_gyroscopes_show_is_in_both(seed, seconds):
    random, loop = np.random.default_rng(seed), Resting()
    holding, bias, twist = random.normal(0.0, 0.003, 6), drawn_twist(random), drawn_twist(random)
    loop.run(MEAN_S + 2 * PERIOD_S, holding, bias)
    assert loop.rest["both"] < 1e-7
    rates = loop.rates_of(twist)
    loop.run(seconds, holding + rates, bias + twist)
    rms = np.sqrt(np.mean(rates**2))
    moved = np.sqrt(np.mean(loop.rest["moved"] ** 2, axis=1))
    np.testing.assert_allclose(
        moved, [expected_sum(rms, seconds, False), expected_sum(rms, seconds, True)], rtol=5e-3, atol=2e-5
    )
    # They have one direction, so that the smaller of them is in both.
    assert loop.rest["both"] == pytest.approx(moved.min(), rel=1e-3)
    forget_motion(loop.rest[()])
    assert loop.rest["both"] == 0.0 and (loop.rest["moved"] == 0.0).all()


@pytest.mark.parametrize(("by_commands", "by_gyroscopes"), [(1.0, 0.0), (0.0, 1.0), (1.0, -1.0)])
def test_a_load_that_changes_gyroscopes_that_drift_and_both_against_each_other_are_no_motion(by_commands, by_gyroscopes):
    loop = Resting()
    rates = loop.rates_of(twist := np.array([0.0, 0.0, 5e-3, 0.0, 0.0, 0.0]))
    loop.run(2.6)
    loop.run(4.0, by_commands * rates, by_gyroscopes * twist)
    assert loop.rest["moved"].max() > 5e-3 and loop.rest["both"] < 1e-9


def test_when_the_pose_comes_from_other_imus_a_motion_is_forgotten_and_the_creep_is_not():
    """The loop corrects the pose then: commands and gyroscopes show that motion."""
    loop = Resting()
    twist = np.array([0.0, 0.0, 2e-3, 0.0, 0.0, 0.0])
    rates = loop.rates_of(twist)
    loop.run(2.6)
    loop.run(1.0, rates, twist)
    crept = loop.crept
    assert loop.rest["both"] > 1e-3
    loop.run(0.1, 20.0 * rates, 20.0 * twist, source=1)
    assert loop.rest["both"] == 0.0 and loop.crept[0] > crept[0] + 3e-3
    crept = loop.crept
    loop.run(2.4, source=1)
    loop.run(1.0, rates, twist, source=1)
    assert loop.rest["both"] == pytest.approx(1.6e-3, rel=0.2)
    assert loop.crept[0] > crept[0] + 1.5e-3


@pytest.mark.parametrize("mechanism", ["hexapod", "6-4-II"])
def test_what_is_told_grows_with_what_is_not_known_of_the_lengths(mechanism):
    """The standard deviation of the lengths, by poses that are drawn with the covariance."""
    loop, rng = Resting(mechanism), np.random.default_rng(5)
    loop.run(0.1)
    assert loop.rest["limit"] == 2e-3
    factor = 4.0 * np.sqrt(PERIOD_S / 2e-3)
    root = np.diag([1e-3] * 3 + [8e-3] * 3) @ rng.standard_normal((6, 6))
    loop.covariance = root @ root.T
    loop.run(0.1)
    rates = [loop.rates_of(root @ rng.standard_normal(6)) for _ in range(2000)]
    assert loop.rest["limit"] == pytest.approx(factor * np.sqrt(np.mean(np.square(rates))), rel=0.05)
    loop.covariance = np.full((6, 6), np.inf)
    loop.run(0.1)
    assert loop.rest["limit"] == 2e-3


HEIGHT = "imu-offset:legs,axis=0/0.89/-0.46,size_m_per_s2={size},ramp_s={within},at=4"
"""At rest, the legs' IMUs agree on another height: the IMUs do not show it."""


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["compiled", "whole"])
@pytest.mark.parametrize("rate", [250.0, 1000.0])
def test_a_height_that_the_legs_accelerometers_agree_on_is_told_and_covered(rate, fusion):
    config = SimulationConfig(duration=14.0, target="hold", rate=rate, fusion=fusion, seed=12)
    errors, levels = errors_and_levels(simulate(config).records)
    assert (errors <= levels).all() and errors[:, 0].max() < 2e-3
    with pytest.raises(SimulationStoppedError) as stopped:
        simulate(replace(config, faults=(HEIGHT.format(size=0.5, within=15),)))
    records = stopped.value.result.records
    errors, levels = errors_and_levels(records)
    assert (errors <= levels).all() and 2e-3 < errors[-1, 0] < 5e-3
    assert records["stop"][-1] == Cause.MOVES_AT_REST


def test_what_comes_up_more_slowly_raises_the_level_alone():
    config = SimulationConfig(duration=19.0, target="hold", rate=250.0, seed=12, faults=(HEIGHT.format(size=0.08, within=15),))
    records = simulate(config).records
    errors, levels = errors_and_levels(records)
    assert (errors <= levels).all() and errors[-1, 0] > 5e-3
    assert not records["stop"].any()


@pytest.mark.parametrize("setting", ["payload.mass=20@5", "motor.resistance=0.72", "friction.coulomb=30"])
def test_drives_and_loads_that_are_not_as_the_file_says_are_no_motion_at_rest(setting):
    config = SimulationConfig(duration=10.0, target="hold", rate=250.0, seed=3, settings=(Setting.parse(setting),))
    assert not simulate(config).records["stop"].any()


def test_with_encoders_the_level_does_not_grow_at_rest():
    records = simulate(SimulationConfig(duration=12.0, target="hold", rate=250.0, seed=12, lengths="absolute")).records
    errors, levels = errors_and_levels(records)
    assert (errors <= levels).all() and levels[-1, 0] < 1.1 * np.median(levels[:, 0])
