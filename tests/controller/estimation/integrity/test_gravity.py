"""The drift from what gravity shows: batch least squares, a response in closed form, made-up motions, and a closed loop."""

import numpy as np
import pytest

from controller.estimation.integrity.fault_filter import STATE as FILTER_STATE
from controller.estimation.integrity.gravity import STATE, compare_with_gravity
from hil.faults.rows import all_rows
from hil.faults.trials import Trial, figures_of
from tests.controller.estimation.integrity.made_up import RATE_HZ, constants, filtered, readings

WINDOW_S = 0.01
NONE_LEFT_OUT = np.zeros(7, np.int64)


def windows(jacobian, off):
    """Windows in which all accelerometers read `off` (N, 7, 3) more than predicted."""
    f = np.zeros((), FILTER_STATE)
    f["counted"], f["between"], f["weight"] = 1, WINDOW_S, 1.0
    f["jacobian"][:, 3:, :6] = jacobian
    for each in off:
        f["mean"][:, 3:] = each
        yield f[()]


def drifts(found, excluded=NONE_LEFT_OUT, moves=True):
    s = np.zeros((), STATE)
    for f in found:
        compare_with_gravity(s[()], f, excluded, moves)
        yield s["drifted"].copy()


def test_a_pose_that_steps_off_is_followed_and_forgotten_as_the_two_time_constants_have_it():
    """What readings tell grows with 1 s; the reference is the mean since the motion began."""
    random = np.random.default_rng(1)
    jacobian, size = random.normal(size=(7, 3, 6)), np.array([3e-4, -5e-4, 2e-4, 1e-3, 2e-3, -1e-3])
    begin, n = 600, 1600
    off = np.zeros((n, 7, 3))
    off[begin:] = jacobian @ size
    expected = np.linalg.norm(size.reshape(2, 3), axis=1)
    for i, found in enumerate(drifts(windows(jacobian, off))):
        since, age = WINDOW_S * max(0, i + 1 - begin), WINDOW_S * (i + 1)
        grown = 1.0 - np.exp(-since)
        left = grown - (since - grown) / age
        np.testing.assert_allclose(found / expected, abs(left), atol=0.01)


def test_the_pose_is_that_of_batch_least_squares_over_all_windows():
    """With windows of different weights and geometry, and an IMU that has been left out."""
    random = np.random.default_rng(2)
    n, excluded = 40, NONE_LEFT_OUT.copy()
    excluded[2] = 1
    s, f = np.zeros((), STATE), np.zeros((), FILTER_STATE)
    f["counted"], f["between"] = 1, WINDOW_S
    rows, rights, weights = [], [], []
    for i in range(n):
        for name in ("jacobian", "mean", "predicted"):
            f[name] = random.normal(size=f[name].shape)
        f["weight"] = random.uniform(0.5, 2.0, f["weight"].shape)
        compare_with_gravity(s[()], f[()], excluded, False)
        used = np.flatnonzero(excluded == 0)
        rows.append(f["jacobian"][used, 3:, :6].reshape(-1, 6))
        rights.append((f["mean"] - f["predicted"])[used, 3:].ravel())
        weights.append(np.repeat(f["weight"][used, 1], 3) * np.exp(-WINDOW_S * (n - 1 - i)))
    root = np.sqrt(np.concatenate(weights))
    expected = np.linalg.lstsq(root[:, None] * np.concatenate(rows), root * np.concatenate(rights), rcond=None)[0]
    np.testing.assert_allclose(s["reference"], expected, rtol=1e-9)


def test_before_the_motion_and_where_gravity_does_not_show_the_pose_nothing_has_drifted():
    random = np.random.default_rng(3)
    jacobian = random.normal(size=(7, 3, 6))
    off = random.normal(size=(50, 7, 3))
    assert max(each.max() for each in drifts(windows(jacobian, off), moves=False)) == 0.0
    assert max(each.max() for each in drifts(windows(jacobian, off))) > 0.1
    jacobian[..., 5] = 0.0
    assert max(each.max() for each in drifts(windows(jacobian, off))) == 0.0
    one_left = np.ones(7, np.int64)
    one_left[0] = 0
    assert max(each.max() for each in drifts(windows(random.normal(size=(7, 3, 6)), off), one_left)) == 0.0


@pytest.mark.parametrize("biased", [0.0, 0.015])
def test_an_estimate_that_creeps_away_is_seen_and_constant_errors_are_not(biased):
    """A hexapod in motion; the estimate creeps by 1 mm and 1 mrad from the third second on, or stays."""
    for creeps in (0.0, 1e-3):
        mechanism, r = readings("mixed", 8.0, 3)
        r.samples[:, 1] += biased * np.random.default_rng(1).normal(size=(7, 3))
        parameters, state = constants(mechanism)
        state = state[()]
        times = np.arange(len(r.samples)) / RATE_HZ
        away = creeps * np.clip((times - 3.0) / 2.0, 0.0, 1.0)
        off = away[:, None] * np.array([0.0, 0.0, 1.0, 0.0, 1.0, 0.0])
        g, found = state["integrity"]["gravity"], []

        def compare(state=state, g=g, found=found):
            compare_with_gravity(g, state["integrity"]["filter"], NONE_LEFT_OUT, True)
            found.append(g["drifted"].copy())

        filtered(mechanism, r, parameters, state, off, then=compare)
        usual, late = np.array(found)[100:300].max(axis=0), np.array(found)[-100:]
        assert usual[0] < 2e-4 and usual[1] < 1.2e-3
        if creeps:
            # The mean of what has passed holds some of it.
            np.testing.assert_allclose(late.mean(axis=0), 0.6 * creeps, rtol=0.5)
        else:
            assert late[:, 0].max() < 2e-4 and late[:, 1].max() < 1.2e-3


@pytest.mark.parametrize("fusion", ["compiled", "whole"])
def test_the_level_covers_gyroscopes_that_drift_so_slowly_that_nothing_is_told(fusion):
    (row,) = (row for row in all_rows() if row.name == "all gyroscopes drift by 0.005 deg/s per second about x")
    found = figures_of(Trial(row, 3, fusion))
    assert not found["told"] and found["position_before"] > 0.8e-3
    assert found["covered"] > 0.999 * found["cycles"]
