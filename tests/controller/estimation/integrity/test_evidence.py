"""The evidence beside dense algebra on the same information, and what is no evidence."""

import numpy as np
import pytest

from controller.estimation.integrity import evidence
from controller.estimation.integrity.evidence import STEPS, step_evidence
from controller.estimation.integrity.fault_filter import FAULTS
from controller.estimation.whole_mechanism.readings import MOTION_STATES
from tests.controller.estimation.integrity.made_up import constants, filtered, readings

POSE = slice(0, 6)


def evaluated(kind="0.5", excluded=(), duration=1.5, seed=0, fault=None):
    """Parameters and state after an evaluation at the end of a motion."""
    mechanism, r = readings(kind, duration, seed)
    if fault is not None:
        r.samples[:, fault[0], fault[1], fault[2]] += fault[3]
    parameters, state = constants(mechanism)
    state["imus"]["excluded"][list(excluded)] = 1
    filtered(mechanism, r, parameters, state)
    evaluate(parameters, state)
    return parameters, state


def evaluate(parameters, state):
    s = state["integrity"]
    for step in range(STEPS):
        p = parameters["integrity"]["evidence"][()]
        step_evidence(p, s["evidence"][()], s["filter"][()], state["imus"]["excluded"], step)


def dense(parameters, state, apart=()):
    """W, w and the pose's system by dense algebra; faults of IMUs that are left out are free."""
    s = state["integrity"]
    y, right = s["filter"]["information"], s["filter"]["vector"]
    prior = parameters["integrity"]["evidence"]["prior"]
    m, f = np.arange(MOTION_STATES), MOTION_STATES + np.arange(FAULTS)
    # Unknowns: errors that were there before, motion, faults.
    whole = np.block([
        [y[np.ix_(f, f)] + prior, y[np.ix_(f, m)], y[np.ix_(f, f)]],
        [y[np.ix_(m, f)], y[np.ix_(m, m)], y[np.ix_(m, f)]],
        [y[np.ix_(f, f)], y[np.ix_(f, m)], y[np.ix_(f, f)]],
    ])  # fmt: skip
    side = np.concatenate([right[f], right[m], right[f]])
    own = FAULTS + MOTION_STATES
    free = [own + 6 * k + i for k in apart for i in range(6)]

    def without(gone):
        kept = np.setdiff1d(np.arange(len(whole)), gone)
        gain = np.linalg.solve(whole[np.ix_(gone, gone)], np.c_[whole[np.ix_(gone, kept)], side[gone]])
        less = whole[np.ix_(kept, gone)] @ gain
        return whole[np.ix_(kept, kept)] - less[:, :-1], side[kept] - less[:, -1]

    pose = without(np.r_[np.arange(FAULTS), FAULTS + np.arange(6, MOTION_STATES), free].astype(int))
    return without(np.r_[np.arange(own), free].astype(int)), pose


@pytest.mark.parametrize("excluded", [(), (2,), (6,), (1, 4)])
@pytest.mark.parametrize("kind", ["static", "mixed"])
def test_elimination_step_by_step_is_that_of_the_whole(kind, excluded):
    parameters, state = evaluated(kind, excluded)
    e = state["integrity"]["evidence"]
    (weight, vector), (pose, pose_side) = dense(parameters, state, excluded)
    order = [k for k in range(7) if k not in excluded]
    rows = np.concatenate([6 * np.argsort(order)[order.index(k)] + np.arange(6) for k in order]).astype(int)
    first = 6 * len(excluded)
    weight, vector = weight[np.ix_(rows, rows)], vector[rows]
    weight += np.diag(np.tile(np.repeat(parameters["integrity"]["evidence"]["least"], 3), len(order)))
    scale = np.sqrt(np.diag(weight))
    np.testing.assert_allclose((e["weight"][first:, first:] - weight) / np.outer(scale, scale), 0.0, atol=1e-6)
    np.testing.assert_allclose((e["vector"][first:] - vector) / scale, 0.0, atol=1e-4)
    assert not e["weight"][:first].any() and not e["vector"][:first].any()
    np.testing.assert_allclose(np.tril(e["pose_information"]), np.tril(pose[POSE, POSE]), rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(e["pose_vector"], pose_side[POSE], rtol=1e-4, atol=1e-4 * np.abs(pose_side[POSE]).max())


def test_what_was_learned_is_no_evidence_and_what_came_up_is():
    """An accelerometer that is off by 0.15 m/s^2 from the start is learned; the same within a second is told."""
    found = []
    for begin in (0, 2000):
        mechanism, r = readings("0.5", 5.0, 3)
        r.samples[begin:, 1, 2, 0] += 0.15
        parameters, state = constants(mechanism)
        s = state["integrity"]
        for at in range(0, 2500, 50):
            part = type(r)(*(each[at : at + 50] for each in vars(r).values()))
            filtered(mechanism, part, parameters, state)
            evaluate(parameters, state)
        weight, vector = s["evidence"]["weight"], s["evidence"]["vector"]
        block = slice(6 * 2, 6 * 3)
        found.append(vector[block] @ np.linalg.solve(weight[block, block], vector[block]))
    assert found[0] < 20.0 < 60.0 < found[1]


def test_an_imu_that_is_left_out_is_cleared_when_it_reads_right_and_only_then():
    for fault, low, high in ((None, 0.0, 25.0), ((1, 4, 1, 0.3), 60.0, np.inf)):
        parameters, state = evaluated("0.5", (4,), 1.5, 1, fault)
        for _ in range(6):
            evaluate(parameters, state)
        assert low <= state["integrity"]["evidence"]["apart_evidence"][0] <= high


def test_learning_is_late_and_fades():
    parameters, _ = evaluated()
    p = parameters["integrity"]["evidence"]
    assert p["learning_windows"] == 50
    assert p["share"] == pytest.approx(1.0)
    assert p["keep"] == pytest.approx(np.exp(-0.5 / 10.0))
    assert evidence.STEPS == 12 + 42 + 6 + 5 + 8


def test_errors_may_change_each_by_itself_and_those_of_all_gyroscopes_alike():
    """What is expected beside dense algebra: covariances add, and the estimate stays."""
    parameters, state = evaluated()
    e, eye = state["integrity"]["evidence"], np.eye(3)
    e["learned_vector"] = np.random.default_rng(0).normal(0.0, 1e3, FAULTS)
    for _ in range(4):
        evaluate(parameters, state)
    assert e["windows"] == 0 and e["waits"] > 0
    each = np.tile(np.repeat(np.square([1.5e-4, 3e-3]), 3), 7)
    alike = np.tile(np.hstack([eye, 0.0 * eye]), 7)
    covariance = np.linalg.inv(e["learned"]) + np.diag(each) + np.radians(0.015) ** 2 * alike.T @ alike
    np.testing.assert_allclose(e["expected"] @ covariance, np.eye(FAULTS), atol=1e-6)
    expected, learned = (np.linalg.solve(e[name], e[f"{name}_vector"]) for name in ("expected", "learned"))
    np.testing.assert_allclose(expected, learned, atol=1e-6 * np.abs(learned).max())
    assert np.abs(learned).max() > 1e-3
