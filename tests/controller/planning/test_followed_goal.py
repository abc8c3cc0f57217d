"""A way to a goal that changes: where it ends, and what it needs of the actuators."""

import numpy as np
import pytest

from controller.frames import ActiveFrames, Frames, Move
from controller.inverse_kinematics import leg_lengths
from controller.planning.followed_goal import FollowedGoal
from controller.planning.straight_way import StraightWay
from plant.errors import InputError, PlanningError
from plant.mechanism import load_in_space
from plant.pose import Pose, rotation_from_vector, vector_from_rotation

STEP_S = 1e-3


def displaced(mechanism, coordinates):
    home = mechanism.home
    return Pose(home.position + coordinates[:3], rotation_from_vector(coordinates[3:]) @ home.rotation)


def coordinates_of(mechanism, pose):
    turn = vector_from_rotation(pose.rotation @ mechanism.home.rotation.T)
    return np.concatenate([pose.position - mechanism.home.position, turn])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexapod", "planar-3rpr"])
@pytest.mark.parametrize("seed", range(3))
def test_it_goes_to_the_last_goal_smoothly_and_within_a_share_of_the_actuators_limits(name, seed):
    mechanism, random = load_in_space(name), np.random.default_rng(seed)
    free = [0, 1, 5] if mechanism.planar else [*range(6)]

    def goal():
        coordinates = np.zeros(6)
        coordinates[free] = random.uniform(-1.0, 1.0, len(free)) * np.where(np.array(free) < 3, 0.03, 0.15)
        return coordinates

    last = goal()
    way = FollowedGoal(mechanism, mechanism.home, displaced(mechanism, last), 0.05, 0.2)
    lengths, rates, poses, time = [], [], [], 0.0
    for _ in range(8):
        for _ in range(int(random.integers(20, 400))):
            here, rate = way.at(time)
            pose = way.pose(time)
            np.testing.assert_allclose(here, leg_lengths(mechanism, pose.position, pose.rotation), atol=1e-12)
            lengths.append(here)
            rates.append(rate)
            poses.append(coordinates_of(mechanism, pose))
            time += STEP_S
        last = goal()
        way.aim(displaced(mechanism, last), time)
    limits = mechanism.limits
    rates, poses = np.array(rates), np.array(poses)
    assert np.abs(rates).max() <= limits.velocity and np.abs(np.diff(rates, axis=0)).max() / STEP_S <= limits.acceleration
    np.testing.assert_allclose(np.diff(lengths, axis=0) / STEP_S, 0.5 * (rates[1:] + rates[:-1]), atol=1e-4)
    assert np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1).max() / STEP_S <= 0.05 * 1.001
    assert np.linalg.norm(np.diff(poses[:, 3:], axis=0), axis=1).max() / STEP_S <= 0.2 * 1.05
    np.testing.assert_allclose(coordinates_of(mechanism, way.pose(way.duration)), last, atol=1e-9)
    here, rate = way.at(way.duration)
    assert not rate.any() and np.array_equal(here, way.lengths)


def test_a_stop_ends_it_at_rest_where_no_later_goal_counts(hexapod):
    way = FollowedGoal(hexapod, hexapod.home, displaced(hexapod, np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.1])), 0.05, 0.2)
    way.stop(0.4)
    rests = way.duration
    way.aim(hexapod.home, 0.5)
    assert way.stopped and way.duration == rests > 0.4
    ended = coordinates_of(hexapod, way.pose(rests))
    assert 0.0 < ended[0] < 0.03 and not way.at(rests)[1].any()
    np.testing.assert_allclose(way.at(rests - 1e-6)[1], 0.0, atol=1e-6)


@pytest.mark.parametrize("goal", [[0.0, 0.0, 0.0, 2.5, 0.0, 0.0], [np.nan, 0.0, 0.0, 0.0, 0.0, 0.0]])
def test_a_goal_that_is_refused_leaves_the_way_as_it_is(hexapod, goal):
    """Turned too far, and one to which ruckig finds no way."""
    goes_to = np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.1])
    way = FollowedGoal(hexapod, hexapod.home, displaced(hexapod, goes_to), 0.05, 0.2)
    way.aim(displaced(hexapod, goes_to), 0.1)
    asked, end = 0.4, way.duration
    before = [way.at(time) for time in np.linspace(asked, end, 20)]
    with pytest.raises((InputError, PlanningError), match=r"turned by 2\.5 rad from home; at most 2|ruckig finds no way"):
        way.aim(displaced(hexapod, np.array(goal)), asked)
    assert way.duration == end
    np.testing.assert_array_equal([way.at(time) for time in np.linspace(asked, end, 20)], before)
    np.testing.assert_allclose(coordinates_of(hexapod, way.pose(end)), goes_to, atol=1e-9)


def test_a_stop_to_which_there_is_no_plan_leaves_the_way_as_it_is(hexapod):
    goal = np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.1])
    straight = StraightWay(hexapod, ActiveFrames(Frames()), hexapod.home, Move(goal[:3], goal[3:]))
    for way in (FollowedGoal(hexapod, hexapod.home, displaced(hexapod, goal), 0.05, 0.2), straight):
        asked, end = 0.1 * way.duration, way.duration
        before, jerk = way.at(asked), way._parameters.max_jerk
        # ruckig itself refuses this.
        way._parameters.max_jerk = [-1.0] * len(jerk)
        with pytest.raises(PlanningError, match="ruckig finds no way"):
            way.stop(asked)
        assert not way.stopped and way.duration == end
        np.testing.assert_array_equal(way.at(asked), before)
        way._parameters.max_jerk = jerk
        way.stop(asked)
        assert way.stopped and way.duration < end
        np.testing.assert_allclose(way.at(asked), before, atol=1e-4)
