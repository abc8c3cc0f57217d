"""The drift from what gravity shows: batch least squares, a response in closed form, made-up motions, and a closed loop."""

import numpy as np
import pytest

from controller.estimation.imu_health import STATE as IMUS
from controller.estimation.integrity.fault_filter import STATE as FILTER_STATE
from controller.estimation.integrity.gravity import STATE, compare_with_gravity, spread_by_legs
from hil.faults.rows import all_rows, rows_of
from hil.faults.trials import Trial, figures_of
from tests.controller.estimation.integrity.made_up import RATE_HZ, constants, filtered, readings

WINDOW_S = 0.01


def imus(left_out=(), lost=()):
    made = np.zeros((), IMUS)
    made["used"] = 1
    made["used"][[*left_out, *lost]] = 0
    made["excluded"][[*left_out]] = 1
    return made[()]


def windows(jacobian, off):
    """Windows in which all accelerometers read `off` (N, 7, 3) more than predicted."""
    f = np.zeros((), FILTER_STATE)
    f["counted"], f["between"], f["weight"] = 1, WINDOW_S, 1.0
    f["jacobian"][:, 3:, :6] = jacobian
    for each in off:
        f["mean"][:, 3:] = each
        yield f[()]


def drifts(found, seen=None, moves=True):
    s = np.zeros((), STATE)
    for f in found:
        compare_with_gravity(s[()], f, imus() if seen is None else seen, moves)
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
    n, seen = 40, imus(left_out=[2], lost=[5])
    s, f = np.zeros((), STATE), np.zeros((), FILTER_STATE)
    f["counted"], f["between"] = 1, WINDOW_S
    rows, rights, weights = [], [], []
    for i in range(n):
        for name in ("jacobian", "mean", "predicted"):
            f[name] = random.normal(size=f[name].shape)
        f["weight"] = random.uniform(0.5, 2.0, f["weight"].shape)
        compare_with_gravity(s[()], f[()], seen, i == n - 1)
        used = np.flatnonzero(seen["used"])
        rows.append(f["jacobian"][used, 3:, :6].reshape(-1, 6))
        rights.append((f["mean"] - f["predicted"])[used, 3:].ravel())
        weights.append(np.repeat(f["weight"][used, 1], 3) * np.exp(-WINDOW_S * (n - 1 - i)))
    root = np.sqrt(np.concatenate(weights))
    expected = np.linalg.lstsq(root[:, None] * np.concatenate(rows), root * np.concatenate(rights), rcond=None)[0]
    np.testing.assert_allclose(s["reference"], expected, rtol=1e-9)


def test_the_spread_by_the_legs_is_that_of_estimates_from_noise():
    """It is that of least squares over the legs' accelerometers alone, as often as they are read with new noise."""
    random = np.random.default_rng(6)
    jacobian, sigma, seen = random.normal(size=(7, 3, 6)), 0.02, imus(lost=[4])
    s, found, told = np.zeros((), STATE), [], 0.0
    used = [0, 1, 2, 3, 5]
    for i, f in enumerate(windows(jacobian, random.normal(size=(20000, 7, 3), scale=sigma))):
        f["weight"] = 1.0 / sigma**2
        compare_with_gravity(s[()], f, seen, False)
        if i > 500 and i % 100 == 0:
            told = spread_by_legs(s[()], seen)
            found.append(np.linalg.solve(s["information"][used].sum(axis=0), s["vector"][used].sum(axis=0))[3:])
    np.testing.assert_allclose(told, np.sqrt(np.mean(np.sum(np.square(found), axis=1))), rtol=0.1)
    assert spread_by_legs(s[()], imus(lost=[0, 1, 2])) == 0.0


@pytest.mark.parametrize("information", [0.0, np.nan, 1e-3])
def test_legs_that_hardly_show_a_rotation_have_the_greatest_spread(information):
    s = np.zeros((), STATE)
    s["information"] = information * np.eye(6)
    assert spread_by_legs(s[()], imus()) == 0.02


def test_before_the_motion_and_where_gravity_does_not_show_the_pose_nothing_has_drifted():
    random = np.random.default_rng(3)
    jacobian = random.normal(size=(7, 3, 6))
    off = random.normal(size=(50, 7, 3))
    assert max(each.max() for each in drifts(windows(jacobian, off), moves=False)) == 0.0
    assert max(each.max() for each in drifts(windows(jacobian, off))) > 0.1
    jacobian[..., 5] = 0.0
    assert max(each.max() for each in drifts(windows(jacobian, off))) == 0.0
    one_left = imus(left_out=range(1, 7))
    assert max(each.max() for each in drifts(windows(random.normal(size=(7, 3, 6)), off), one_left)) == 0.0


def test_an_imu_that_is_left_out_takes_what_it_has_read_with_it():
    """Its readings are 1 m/s^2 off; without it nothing has drifted."""
    random = np.random.default_rng(4)
    s, off = np.zeros((), STATE), np.zeros((100, 7, 3))
    off[50:, 3] = 1.0
    jacobian = random.normal(size=(7, 3, 6))
    for i, f in enumerate(windows(jacobian, off)):
        compare_with_gravity(s[()], f, imus(left_out=[3] if i >= 80 else []), True)
        if i == 79:
            assert (s["drifted"] > 0.03).all()
    # The mean of before holds some of it.
    assert (s["drifted"] < 0.03).all()


def test_each_motion_has_its_own_reference():
    random = np.random.default_rng(5)
    jacobian = random.normal(size=(7, 3, 6))
    s, off = np.zeros((), STATE), np.zeros((300, 7, 3))
    off[100:] = jacobian @ [1e-3, 0.0, 0.0, 0.0, 0.0, 0.0]
    for i, f in enumerate(windows(jacobian, off)):
        compare_with_gravity(s[()], f, imus(), not 150 <= i < 250)
        assert s["drifted"][0] == 0.0 or i < 150 or i > 250
    assert s["drifted"][0] < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("biased", [0.0, 0.015])
def test_an_estimate_that_creeps_away_is_seen_and_constant_errors_are_not(biased):
    """A hexapod in motion; the estimate creeps by 3 mm and 6 mrad from the third second on, or stays."""
    for creeps in (0.0, 1.0):
        mechanism, r = readings("mixed", 8.0, 3)
        r.samples[:, 1] += biased * np.random.default_rng(1).normal(size=(7, 3))
        parameters, state = constants(mechanism)
        state = state[()]
        times = np.arange(len(r.samples)) / RATE_HZ
        away = creeps * np.clip((times - 3.0) / 2.0, 0.0, 1.0)
        off = away[:, None] * np.array([0.0, 0.0, 3e-3, 0.0, 6e-3, 0.0])
        g, found = state["integrity"]["gravity"], []

        def compare(state=state, g=g, found=found):
            compare_with_gravity(g, state["integrity"]["filter"], imus(), True)
            found.append(g["drifted"].copy())

        filtered(mechanism, r, parameters, state, off, then=compare)
        before, late = np.array(found)[100:300], np.array(found)[-100:]
        usual = np.array([3e-4, 2e-3])
        assert (before < usual).all()
        if creeps:
            # The readings are a second late, and the mean of 7.5 s holds some of it.
            expected = 1.0 - np.exp(-2.5) - (7.5 - 4.0 - 1.0) / 7.5
            np.testing.assert_allclose(late.mean(axis=0), expected * np.array([3e-3, 6e-3]), rtol=0.15)
        else:
            assert (late < usual).all()


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["compiled", "whole"])
def test_the_level_covers_gyroscopes_that_drift_so_slowly_that_nothing_is_told(fusion):
    (row,) = (row for row in all_rows() if row.name == "all gyroscopes drift by 0.005 deg/s per second about x")
    found = figures_of(Trial(row, 3, fusion))
    assert not found["told"] and found["position_before"] > 0.8e-3
    assert found["covered"] > 0.999 * found["cycles"]


@pytest.mark.parametrize(
    ("fusion", "rate", "seed", "turn"),
    [("whole", 200, 6, "axis=x,size_deg=2,ramp_s=5"), ("compiled", 250, 7, "axis=1/1/0,size_deg=1,ramp_s=4")],
)
def test_the_level_covers_a_platform_imu_that_turns_so_slowly_that_it_is_told_late(fusion, rate, seed, turn):
    """At low rates the legs show a rotation of the platform less well."""
    (row,) = rows_of({"loosening": [{"name": "a turn", "faults": [f"imu-turn:6,{turn}"], "rate": rate, "duration": 14.0}]})
    found = figures_of(Trial(row, seed, fusion))
    assert found["told"] and found["rotation_before"] > 0.008
    assert found["covered"] > 0.999 * found["cycles"]


def test_encoders_of_all_legs_show_the_turn():
    levels = []
    for lengths in ("none", "absolute"):
        entry = {"name": "sound", "rate": 250, "duration": 6.0, "lengths": lengths}
        (row,) = rows_of({"sound": [entry]})
        levels.append(figures_of(Trial(row, 1, "whole"))["level_rotation"])
    assert levels[0] > 0.007 and levels[1] < 0.7 * levels[0]
