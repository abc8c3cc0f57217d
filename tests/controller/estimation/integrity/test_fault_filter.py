"""The fault filter beside a batch of least squares, and what it does not depend on."""

import numpy as np
import pytest

from controller.estimation.integrity.fault_filter import (
    _CATCHING_UP,
    _CATCHING_UP_STIFFNESS,
    _JUMPS,
    FAULTS,
    MEMORY_S,
    UNKNOWNS,
    _forget,
    bridge_gap,
)
from controller.estimation.whole_mechanism.readings import MOTION_STATES
from tests.controller.estimation.integrity.made_up import RATE_HZ, constants, filtered, readings

FIRST_ROWS = slice(0, MOTION_STATES)


def faults_of(state, known):
    """What the filter believes of the faults, with a weak belief that they are zero, and its covariance."""
    f = state["integrity"]["filter"]
    information = f["information"] + np.diag(np.r_[np.full(MOTION_STATES, 1e-9), 1.0 / known**2])
    covariance = np.linalg.inv(information)
    return covariance @ f["vector"], covariance


KNOWN = np.tile(np.repeat([0.01, 0.1], 3), 7)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["static", "0.5", "mixed"])
def test_without_a_fault_what_is_found_is_as_small_as_it_claims(kind):
    squares = []
    for seed in range(6):
        mechanism, r = readings(kind, 2.0, seed)
        parameters, state = constants(mechanism)
        assert filtered(mechanism, r, parameters, state) == 2.0 * RATE_HZ / 5 - 1
        found, covariance = faults_of(state, KNOWN)
        seen = covariance[MOTION_STATES:, MOTION_STATES:]
        share = np.diag(seen) < 0.1 * KNOWN**2
        squares.append((found[MOTION_STATES:] ** 2 / np.diag(seen))[share].mean())
    # With a memory that fades, noise counts half of what the information says, and in motion its times are not off here.
    assert 0.03 < np.mean(squares) < 1.2


@pytest.mark.parametrize("fault", [3, 8, 22, 40])
def test_a_fault_is_found_with_its_size(fault):
    mechanism, r = readings("0.5", 3.0, 1)
    size = 0.3 if fault % 6 >= 3 else 0.02
    r.samples[:, fault % 6 // 3, fault // 6, fault % 3] += size
    parameters, state = constants(mechanism)
    filtered(mechanism, r, parameters, state)
    found, covariance = faults_of(state, KNOWN)
    at = MOTION_STATES + fault
    assert found[at] == pytest.approx(size, abs=0.01 * size + 4.0 * np.sqrt(covariance[at, at]))


def test_it_does_not_matter_around_which_pose_it_works():
    """A pose that is off by 0.3 mm and 0.3 mrad gives another error of the pose, and the same faults."""
    mechanism, r = readings("0.5", 2.0, 2)
    off = np.array([3e-4, -2e-4, 1e-4, 2e-4, -1e-4, 3e-4])
    found = []
    for shift in (0.0 * off, off):
        parameters, state = constants(mechanism)
        filtered(mechanism, r, parameters, state, tuple(shift))
        found.append(faults_of(state, KNOWN))
    (here, covariance), (there, _) = found
    sigmas = np.sqrt(np.diag(covariance))
    assert (np.abs(there - here)[MOTION_STATES:] < 0.1 * sigmas[MOTION_STATES:]).all()
    np.testing.assert_allclose((here - there)[:6], off, atol=3e-5)


def test_its_information_is_symmetric_and_no_unknown_has_a_negative_one():
    mechanism, r = readings("mixed", 4.0, 3)
    parameters, state = constants(mechanism)
    filtered(mechanism, r, parameters, state)
    information = state["integrity"]["filter"]["information"]
    assert information.shape == (UNKNOWNS, UNKNOWNS) and FAULTS == 42
    np.testing.assert_allclose(information, information.T, rtol=0.0, atol=1e-12 * np.abs(information).max())
    assert np.linalg.eigvalsh(information)[0] > -1e-9 * np.abs(information).max()


def test_it_forgets():
    """What was read two memories ago counts e^-2 of what is read now."""
    mechanism, r = readings("static", 8.0, 4)
    parameters, state = constants(mechanism)
    filtered(mechanism, r, parameters, state)
    weights = np.diag(state["integrity"]["filter"]["information"])[MOTION_STATES:]
    window = 5 / RATE_HZ
    expected = 5.0 / parameters["integrity"]["filter"]["variance"] / (1.0 - np.exp(-window / MEMORY_S))
    weights = weights.reshape(7, 2, 3)
    np.testing.assert_allclose(weights[:, 1], expected[1], rtol=0.1)
    # Of angular velocity, the unknown jerk takes a part away.
    assert (weights[:, 0] < 1.001 * expected[0]).all()


@pytest.mark.parametrize("jumped", [0.0, 1e-12, 2e-4, 0.01])
@pytest.mark.parametrize("catching_up", [False, True])
@pytest.mark.parametrize("follows", [False, True])
@pytest.mark.parametrize("unplanned_change", [(0.0, 0.0), (4.0, 25.0)])
def test_what_jerk_and_jumps_take_away_is_what_they_add_to_the_covariance(unplanned_change, follows, catching_up, jumped):
    """Y^-1 becomes (Y^-1 + G Q G^T) / keep, and after a gap the variances of jumps are added to it."""
    mechanism, _ = readings("static", 0.1)
    parameters, state = constants(mechanism)
    p, f = parameters[()]["integrity"]["filter"], state[()]["integrity"]["filter"]
    random = np.random.default_rng(7)
    # Deviations of 1 mm, 1 mrad, 10 mm/s, and so on, which depend on each other.
    deviations = np.r_[np.repeat([1e-3, 1e-2, 1.0], 6), np.full(FAULTS, 0.1)]
    mixed = np.eye(UNKNOWNS) + 0.05 * random.normal(size=(UNKNOWNS, UNKNOWNS))
    covariance = deviations[:, None] * (mixed @ mixed.T) * deviations
    estimate = deviations * random.normal(size=UNKNOWNS)
    f["information"] = np.linalg.inv(covariance)
    f["vector"] = f["information"] @ estimate
    f["between"], f["follows"], f["catching_up"], f["jumped"] = 0.02, follows, catching_up, jumped
    f["unplanned_change"] = unplanned_change
    _forget(p, f, f["information"], f["vector"])
    t, eye = 0.02, np.eye(6)
    by_jerk = np.vstack([t**3 / 6.0 * eye, 0.5 * t**2 * eye, t * eye, np.zeros((FAULTS, 6))])
    stiffness = np.repeat(p["stiffness"], 3) * (_CATCHING_UP_STIFFNESS if catching_up else 1.0)
    jerk = 1.0 / stiffness + np.repeat(unplanned_change, 3) / p["duration"] ** 2
    expected = (covariance + by_jerk * jerk @ by_jerk.T) * np.exp(t / MEMORY_S)
    if jumped > 1e-9 and not follows:
        jumps = np.repeat(np.array(_JUMPS) * jumped, 3)
        expected += np.diag(np.r_[np.zeros(6), jumps**2, (jumps / p["duration"]) ** 2, np.zeros(FAULTS)])
    found, expected = (each / np.outer(deviations, deviations) for each in (np.linalg.inv(f["information"]), expected))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    # What is believed stays as it was; how firmly does not.
    believed = np.linalg.solve(f["information"], f["vector"])
    np.testing.assert_allclose(believed / deviations, estimate / deviations, rtol=1e-5, atol=1e-5)


def test_a_mean_force_counts_less_where_the_acceleration_is_not_steady():
    weights = []
    for unplanned_change in (0.0, 4.0):
        mechanism, r = readings("static", 0.1)
        parameters, state = constants(mechanism)
        state["integrity"]["filter"]["unplanned_change"][0] = unplanned_change
        filtered(mechanism, r, parameters, state)
        weights.append(state["integrity"]["filter"]["weight"].copy())
    (calm, uneasy), window = weights, 5
    np.testing.assert_allclose(uneasy[:, 0], calm[:, 0])
    np.testing.assert_allclose(window / uneasy[:, 1] - window / calm[:, 1], window * 0.15**2 * 4.0, rtol=1e-9)


def test_drives_catch_up_for_some_windows_after_a_gap_and_not_before():
    """The window before a gap, whose work is not done yet when periods are missed, keeps what is known of its jerk."""
    mechanism, r = readings("0.5", 1.0, 5)
    parameters, state = constants(mechanism)
    f, seen = state["integrity"]["filter"], []
    filtered(mechanism, r, parameters, state, missed={303: 2}, then=lambda: seen.append(int(f["catching_up"])))
    first = seen.index(1)
    assert seen[first:] == [1] * _CATCHING_UP + [0] * (len(seen) - first - _CATCHING_UP)
    # 60 windows were full before, and the work of the last one was under way.
    assert first == 60
    before = f["catching_up"].copy()
    bridge_gap(parameters[()]["integrity"]["filter"], state[()]["integrity"]["filter"], 3)
    assert f["catching_up"] == before == 0


def gaps(lost, seed, apart=(60, 160)):
    """By number before which samples how many are missed, now and then."""
    ends = np.cumsum(np.random.default_rng(seed).integers(*apart, 12))
    return {int(end): lost for end in ends if end < 900}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["static", "0.5", "mixed"])
@pytest.mark.parametrize("lost", [1, 3, 9])
def test_what_was_read_before_a_missed_period_still_counts(kind, lost):
    """Windows of five samples: one is dropped at each gap, and the rest says as much as without gaps, and the truth."""
    squares, knowledge = [], []
    for seed in range(4):
        mechanism, r = readings(kind, 2.0, seed)
        deviations = []
        for missed in ({}, gaps(lost, seed)):
            parameters, state = constants(mechanism)
            taken = filtered(mechanism, r, parameters, state, missed=missed)
            whole = (len(r.samples) - lost * len(missed)) // 5
            assert whole - 1 - len(missed) <= taken <= whole
            found, covariance = faults_of(state, KNOWN)
            variances = np.diag(covariance)
            deviations.append(np.sqrt(variances))
        share = variances[MOTION_STATES:] < 0.1 * KNOWN**2
        squares.append((found[MOTION_STATES:] ** 2 / variances[MOTION_STATES:])[share].mean())
        knowledge.append(deviations[1] / deviations[0])
    assert 0.03 < np.mean(squares) < 1.2
    # Of the pose and of all faults. A window's rate and acceleration are worth less without the one before.
    steady = [*range(6), *range(MOTION_STATES, UNKNOWNS)]
    assert np.max(np.array(knowledge)[:, steady]) < 1.25 and np.mean(np.array(knowledge)[:, steady]) < 1.06


@pytest.mark.parametrize(("lost", "begins_anew"), [(15, False), (16, True)])
def test_after_a_long_gap_it_begins_anew(lost, begins_anew):
    mechanism, r = readings("0.5", 1.0, 5)
    parameters, state = constants(mechanism)
    # The last window before the gap is full.
    filtered(mechanism, r, parameters, state, missed={300 + lost: lost}, count=300 + lost + 5)
    assert state["integrity"]["filter"]["windows"] == (1 if begins_anew else 61)
    assert state["integrity"]["filter"]["between"] == pytest.approx(0.01 if begins_anew else 0.04)


def test_many_short_gaps_without_a_window_between_them_are_a_long_one():
    mechanism, r = readings("0.5", 1.0, 5)
    parameters, state = constants(mechanism)
    missed = {300 + 4 * k: 1 for k in range(1, 6)}
    filtered(mechanism, r, parameters, state, missed=missed, count=324)
    assert state["integrity"]["filter"]["windows"] <= 1
    assert np.isfinite(state["integrity"]["filter"]["information"]).all()


def test_an_imu_that_is_not_healthy_tells_nothing():
    mechanism, r = readings("0.5", 1.0, 5)
    r.samples[:, :, 3] = np.nan
    parameters, state = constants(mechanism)
    state["imus"]["healthy"][3] = 0
    filtered(mechanism, r, parameters, state)
    information = state["integrity"]["filter"]["information"]
    assert np.isfinite(information).all()
    assert not information[MOTION_STATES + 18 : MOTION_STATES + 24].any()
    assert information[MOTION_STATES + 12, MOTION_STATES + 12] > 0.0
