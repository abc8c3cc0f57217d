"""The protection level beside its formula by dense algebra, and that it covers what happens."""

import numpy as np
import pytest

from controller.estimation.integrity import stage
from controller.estimation.integrity.evidence import STATE
from controller.estimation.integrity.hypotheses import HYPOTHESES, directions_of, evidence_for, span_of
from controller.estimation.integrity.protection import begin_level, end_level, publish_level, take_hypothesis
from plant.imu import ACCELEROMETER, GYROSCOPE
from tests.controller.estimation.integrity.made_up import constants
from tests.controller.estimation.integrity.test_evidence import evaluated
from tests.controller.estimation.integrity.test_hypotheses import all_steps, readings

OWN = np.array([np.diag([4e-8, 1e-8, 9e-8, 1e-6, 4e-6, 1e-6]), np.diag([1e-8, 2e-8, 3e-8, 2e-6, 1e-6, 3e-6])])
"""Covariances of the pose, in closed form and of its source."""
NOT = (0.0, 0.0)


def ended(
    level, age=50.0, of_learned=0, steady=0.0, shaken=0.0, own=OWN, misfit=0.0, bent=NOT, moved=NOT, crept=NOT, apart=NOT,
    drifted=NOT, settled=50.0, by_legs=0.0,
):  # fmt: skip
    """The level (2,) at the end of an evaluation, with a misfit and a vibration that last."""
    level["covariance"], level["misfit"], level["shaken"] = own, misfit, np.sqrt(shaken)
    evidence = np.zeros((), STATE)
    evidence["of_learned"] = of_learned
    end_level(level[()], evidence[()], age, by_legs)
    moves = (np.array(each) for each in (bent, moved, crept, apart, drifted))
    publish_level(level[()], settled, misfit, 0.01, steady, shaken, *moves)
    return level["level"].copy()


def level_of(state, frames, predicted, place, usual):
    """The level by the formula of the module, and the error that each hypothesis leaves (HYPOTHESES, 6)."""
    e = state["integrity"]["evidence"]
    information = np.tril(e["pose_information"])
    information = information + np.tril(information, -1).T
    covariance = np.linalg.inv(information)
    error, effect = covariance @ e["pose_vector"], covariance @ e["pose_by_fault"]
    faults, d, left = [[np.linalg.norm(error[:3]), np.linalg.norm(error[3:])]], np.zeros((6, 42)), []
    for h in range(HYPOTHESES):
        count = directions_of(h, frames, predicted, place, d)
        used = d[:count]
        matrix, right = used @ e["weight"] @ used.T, used @ e["vector"]
        inverse = np.linalg.pinv(matrix, rcond=1e-9, hermitian=True)
        seen = max(right @ inverse @ right - count - 1.0, 0.0)
        spread = effect @ used.T @ inverse @ used @ effect.T
        m = error - effect @ used.T @ inverse @ right
        left.append(m)
        new = m - usual[h]
        faults.append(
            [
                np.sqrt((seen + 0.25) * np.trace(spread[s, s]))
                + (2.0 * np.linalg.norm(m[s]) + 6.0 * np.linalg.norm(new[s])) * min(1.0, seen / 7.0)
                for s in (slice(0, 3), slice(3, 6))
            ]
        )
    closed, own = traces()
    squared = [1.5**2, 1.6**2] * closed + [2.1**2, 1.2**2] * np.minimum(own, closed) + np.max(faults, axis=0) ** 2
    return np.sqrt(squared), np.array(left)


def traces(covariances=OWN):
    """Of position and rotation, (2,) each, of the closed form and the source."""
    return (np.array([np.trace(c[:3, :3]), np.trace(c[3:, 3:])]) for c in covariances)


@pytest.mark.parametrize("fault", [None, (1, 2, 0, 0.2), (0, 6, 1, 0.05)])
def test_it_is_the_greatest_over_the_hypotheses(fault):
    _, state = evaluated("mixed", (), 1.5, 3, fault)
    s = state["integrity"]
    e, t, level = s["evidence"], s["hypotheses"], s["protection"]
    frames = np.tile(np.eye(3), (7, 1, 1))
    share, usual = 0.25, np.zeros((HYPOTHESES, 6))
    for _ in range(3):
        begin_level(level[()], e[()])
        for h in range(HYPOTHESES):
            count = directions_of(h, frames, s["filter"]["predicted"], e["place"], t["directions"])
            span = span_of(h, e["place"])
            found = evidence_for(count, *span, e["weight"], e["vector"], t[()])
            take_hypothesis(level[()], e[()], h, count, *span, found, share, t[()])
        expected, left = level_of(state, frames, s["filter"]["predicted"], e["place"], usual)
        np.testing.assert_allclose(ended(level), expected, rtol=2e-3)
        usual += share * (left - usual)
        np.testing.assert_allclose(level["usual"], usual, rtol=2e-3, atol=1e-6)
    e["pose_vector"][0] = np.nan
    begin_level(level[()], e[()])
    take_hypothesis(level[()], e[()], 0, count, *span, found, share, t[()])
    np.testing.assert_allclose(level["usual"], usual, rtol=2e-3, atol=1e-6)


def test_where_the_pose_is_not_determined_there_is_no_level():
    _, state = evaluated()
    s = state["integrity"]
    s["evidence"]["pose_information"] = 0.0
    begin_level(s["protection"][()], s["evidence"][()])
    for own in (OWN, np.full_like(OWN, np.nan)):
        assert np.isinf(ended(s["protection"], own=own)).all()


def test_a_fault_has_had_as_much_time_as_the_loop_to_move_the_pose():
    _, state = evaluated("mixed", (), 1.5, 3, None)
    level = state["integrity"]["protection"]
    level["determined"] = 1
    for age, share in ((0.0, 0.0), (1.0, 0.25), (4.0, 1.0), (100.0, 1.0)):
        level["next_fault"] = 0.0
        without = ended(level, age)
        level["next_fault"] = fault = np.array([0.01, 0.1])
        np.testing.assert_allclose(ended(level, age), np.hypot(without, share * fault))


@pytest.mark.parametrize(("settled", "times"), [(0.0, (1.25, 1.6)), (2.0, (1.125, 1.3)), (4.0, 1.0), (50.0, 1.0)])
def test_while_the_filters_settle_the_standard_deviations_count_more(settled, times):
    _, state = evaluated()
    level = state["integrity"]["protection"]
    level["determined"] = 1
    level["next_fault"] = 0.0
    closed, own = traces()
    expected = np.sqrt([1.5**2, 1.6**2] * closed + [2.1**2, 1.2**2] * np.minimum(own, closed))
    np.testing.assert_allclose(ended(level, settled=settled), np.multiply(times, expected))


def test_an_evaluation_that_was_not_ended_takes_nothing_away():
    """Its greatest fault so far is not that of all hypotheses; what follows may be an evaluation of what was learned."""
    _, state = evaluated()
    level = state["integrity"]["protection"]
    level["determined"] = 1
    level["next_fault"] = 0.01, 0.1
    complete = ended(level)
    level["next_fault"] = 1e-5, 1e-4
    np.testing.assert_array_equal(ended(level, of_learned=1), complete)
    assert (ended(level) < complete).all()


def test_a_source_that_is_less_certain_than_the_closed_form_does_not_raise_it():
    _, state = evaluated()
    level = state["integrity"]["protection"]
    level["determined"] = 1
    np.testing.assert_array_equal(ended(level, own=OWN[[0, 0]]), ended(level, own=OWN * [[[1.0]], [[100.0]]]))
    assert (ended(level, own=OWN * [[[1.0]], [[0.01]]]) < ended(level, own=OWN[[0, 0]])).all()


def test_forces_that_are_no_motion_raise_the_level_between_evaluations():
    _, state = evaluated()
    level = state["integrity"]["protection"]
    level["determined"] = 1
    sound = ended(level)
    np.testing.assert_array_equal(ended(level, steady=0.2), sound)
    np.testing.assert_allclose(ended(level, steady=0.3), np.hypot(sound, [0.004, 0.006]))
    np.testing.assert_allclose(ended(level, shaken=4.0), np.hypot(sound, [0.024, 0.036]))
    np.testing.assert_allclose(ended(level, steady=5.0, shaken=9.0), np.hypot(sound, [0.04, 0.06]))
    np.testing.assert_allclose(ended(level, bent=(2e-4, 3e-3)), np.hypot(sound, [2e-4, 3e-3]))
    # A shock moves the pose little: after 0.01 s, it counts by its share of the average.
    level["shaken"] = 0.0
    publish_level(level[()], 50.0, 0.0, 0.01, 0.0, 400.0, *np.zeros((5, 2)))
    np.testing.assert_allclose(level["level"], np.hypot(sound, [0.0048, 0.0072]))
    for excess, shaken in ((np.inf, 0.4), (1e12, 0.98 * 0.4 + 3.2), (0.0, 0.98 * (0.98 * 0.4 + 3.2))):
        publish_level(level[()], 50.0, 0.0, 0.01, 0.0, excess, *np.zeros((5, 2)))
        assert level["shaken"] == pytest.approx(shaken)


def test_vibration_in_the_level_is_the_greatest_excess_of_an_accelerometer():
    """The root of 4 m^2/s^4 counts by its share of an average over 0.5 s; gyroscopes have other units."""
    parameters, state = evaluated()
    state["integrity"]["evaluations"], state["imus"]["shaking"]["excess"][GYROSCOPE] = 1, 9.0
    state["imus"]["shaking"]["excess"][ACCELEROMETER] = np.arange(7.0) - 2.0
    level = state["integrity"]["protection"]
    before = float(level["shaken"])
    p, s = parameters[()], state[()]
    stage.publish_level(p["integrity"], s["integrity"], p["rig"], s["time"], s["imus"], s["pose"])
    assert level["shaken"] == pytest.approx(before + float(p["rig"]["period"]) / 0.5 * (2.0 - before))


def test_what_was_not_commanded_and_two_estimates_that_are_apart_raise_the_level():
    _, state = evaluated()
    level = state["integrity"]["protection"]
    level["determined"] = 1
    sound = ended(level)
    np.testing.assert_array_equal(ended(level, moved=(1.5e-4, 1.5e-3), apart=(5e-4, 2e-3)), sound)
    np.testing.assert_allclose(ended(level, moved=(1.15e-3, 3.5e-3)), np.hypot(sound, [2.2e-3, 3.6e-3]))
    np.testing.assert_allclose(ended(level, apart=(1.5e-3, 12e-3)), np.hypot(sound, [0.8e-3, 8e-3]))
    np.testing.assert_allclose(ended(level, crept=(3e-3, 5e-3)), np.hypot(sound, [3.9e-3, 6.5e-3]))


def test_a_drift_from_what_gravity_shows_raises_the_level_beyond_what_calibrations_leave():
    _, state = evaluated()
    level = state["integrity"]["protection"]
    level["determined"] = 1
    sound, usual = ended(level), np.array([0.3, 0.7]) * np.sqrt(next(iter(traces())))
    np.testing.assert_allclose(ended(level, drifted=0.999 * usual), sound, rtol=1e-12)
    np.testing.assert_allclose(ended(level, drifted=usual + [1e-3, 2e-3]), np.hypot(sound, [3.2e-3, 5e-3]))


@pytest.mark.parametrize(("age", "share"), [(50.0, 1.0), (1.0, 0.25)])
def test_a_rotation_that_the_legs_hardly_show_raises_the_level_of_the_rotation_alone(age, share):
    _, state = evaluated()
    level = state["integrity"]["protection"]
    level["determined"] = 1
    sound = ended(level, age)
    np.testing.assert_array_equal(ended(level, age, by_legs=5e-4), sound)
    np.testing.assert_allclose(ended(level, age, by_legs=2.5e-3), np.hypot(sound, [0.0, 0.01 * share]))


def test_measurements_that_contradict_each_other_raise_the_level_between_evaluations():
    _, state = evaluated("mixed", (), 1.5, 3)
    level = state["integrity"]["protection"]
    calm = ended(level)
    np.testing.assert_array_equal(ended(level, misfit=0.29), calm)
    closed, _ = traces()
    np.testing.assert_allclose(ended(level, misfit=2.3), np.sqrt(calm**2 + 1.6**2 * 2.0 * closed))
    # A misfit that has just come up counts by its share of the average.
    level["misfit"] = 0.3
    publish_level(level[()], 50.0, 2.3, 0.01, 0.0, 0.0, *np.zeros((5, 2)))
    np.testing.assert_allclose(level["level"], np.sqrt(calm**2 + 1.6**2 * 0.2 * closed))
    assert np.isinf(ended(level, own=np.full_like(OWN, np.inf), misfit=2.3)).all()


def test_without_a_covariance_of_the_closed_form_that_of_the_source_counts_for_both():
    _, state = evaluated()
    level = state["integrity"]["protection"]
    level["determined"] = 1
    own = np.array([np.full((6, 6), np.nan), OWN[1]])
    np.testing.assert_array_equal(ended(level, own=own), ended(level, own=OWN[[1, 1]]))


def test_it_covers_the_error_of_the_pose_without_and_with_a_fault():
    """With the fault, the pose is 2 mm off, which the readings know."""
    for spoil in (0.0, 0.3):
        mechanism, r = readings("0.5", 3.0, 4)
        r.samples[1000:, 1, 3, 0] += spoil
        r.positions[:] += [0.002 * (spoil != 0.0), 0.0, 0.0]
        parameters, state = constants(mechanism)
        s = all_steps(mechanism, r, parameters, state)
        position, rotation = ended(s["protection"])
        least = 0.002 if spoil else 2.0 * np.sqrt(np.trace(OWN[1, :3, :3]))
        assert least < position < 0.03
        assert 0.0 < rotation < 0.05


def test_it_grows_where_nothing_is_redundant():
    """Faults of three IMUs show in the pose alone."""
    levels, faults = [], []
    for healthy in (1, 0):
        mechanism, r = readings("0.5", 3.0, 4)
        parameters, state = constants(mechanism)
        state["imus"]["healthy"][3:] = healthy
        s = all_steps(mechanism, r, parameters, state)
        levels.append(ended(s["protection"]))
        faults.append(np.sqrt(s["protection"]["evaluated"]))
    assert (levels[1] > 7.0 * levels[0]).all()
    assert (faults[1] > 8.0 * faults[0]).all()
