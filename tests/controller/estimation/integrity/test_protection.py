"""The protection level beside its formula by dense algebra, and that it covers what happens."""

import numpy as np
import pytest

from controller.estimation.integrity.hypotheses import HYPOTHESES, directions_of, evidence_for
from controller.estimation.integrity.protection import begin_level, end_level, take_hypothesis
from tests.controller.estimation.integrity.made_up import constants
from tests.controller.estimation.integrity.test_evidence import evaluated
from tests.controller.estimation.integrity.test_hypotheses import all_steps, readings

OWN = np.diag([4e-8, 1e-8, 9e-8, 1e-6, 4e-6, 1e-6])
"""The pose's own covariance."""


def level_of(state, frames, predicted, place):
    """The level by the formula of the module."""
    e = state["integrity"]["evidence"]
    information = np.tril(e["pose_information"])
    information = information + np.tril(information, -1).T
    covariance = np.linalg.inv(information)
    error, effect = covariance @ e["pose_vector"], covariance @ e["pose_by_fault"]
    faults, d = [[np.linalg.norm(error[:3]), np.linalg.norm(error[3:])]], np.zeros((6, 42))
    for h in range(HYPOTHESES):
        count = directions_of(h, frames, predicted, place, d)
        used = d[:count]
        matrix, right = used @ e["weight"] @ used.T, used @ e["vector"]
        inverse = np.linalg.pinv(matrix, rcond=1e-9, hermitian=True)
        seen = right @ inverse @ right - count
        spread = effect @ used.T @ inverse @ used @ effect.T
        m = error - effect @ used.T @ inverse @ right
        faults.append(
            [
                np.sqrt(max(seen, 0.5) * np.trace(spread[s, s])) + (3.0 * np.linalg.norm(m[s]) if seen > 6.0 else 0.0)
                for s in (slice(0, 3), slice(3, 6))
            ]
        )
    own = np.trace(OWN[:3, :3]), np.trace(OWN[3:, 3:])
    return np.sqrt(2.2**2 * np.array(own) + np.max(faults, axis=0) ** 2)


@pytest.mark.parametrize("fault", [None, (1, 2, 0, 0.2), (0, 6, 1, 0.05)])
def test_it_is_the_greatest_over_the_hypotheses(fault):
    _, state = evaluated("mixed", (), 1.5, 3, fault)
    s = state["integrity"]
    e, t, level = s["evidence"], s["hypotheses"], s["protection"]
    frames = np.tile(np.eye(3), (7, 1, 1))
    begin_level(level[()], e[()])
    for h in range(HYPOTHESES):
        count = directions_of(h, frames, s["filter"]["predicted"], e["place"], t["directions"])
        take_hypothesis(level[()], e[()], h, count, evidence_for(count, e["weight"], e["vector"], t[()]), t[()])
    end_level(level[()], OWN)
    np.testing.assert_allclose(level["level"], level_of(state, frames, s["filter"]["predicted"], e["place"]), rtol=2e-3)


def test_where_the_pose_is_not_determined_there_is_no_level():
    _, state = evaluated()
    s = state["integrity"]
    s["evidence"]["pose_information"] = 0.0
    begin_level(s["protection"][()], s["evidence"][()])
    end_level(s["protection"][()], OWN)
    assert np.isinf(s["protection"]["level"]).all()


def test_it_covers_the_error_of_the_pose_without_and_with_a_fault():
    """With the fault, the pose is 2 mm off, which the readings know."""
    for spoil in (0.0, 0.3):
        mechanism, r = readings("0.5", 3.0, 4)
        r.samples[1000:, 1, 3, 0] += spoil
        r.positions[:] += [0.002 * (spoil != 0.0), 0.0, 0.0]
        parameters, state = constants(mechanism)
        s = all_steps(mechanism, r, parameters, state)
        end_level(s["protection"][()], OWN)
        least = 0.002 if spoil else 2.2 * np.sqrt(np.trace(OWN[:3, :3]))
        assert least < s["protection"]["level"][0] < 0.02
        assert 0.0 < s["protection"]["level"][1] < 0.05


def test_it_grows_where_nothing_is_redundant():
    """Faults of three IMUs show in the pose alone."""
    levels = []
    for healthy in (1, 0):
        mechanism, r = readings("0.5", 3.0, 4)
        parameters, state = constants(mechanism)
        state["imus"]["healthy"][3:] = healthy
        s = all_steps(mechanism, r, parameters, state)
        end_level(s["protection"][()], OWN)
        levels.append(s["protection"]["level"].copy())
    assert (levels[1] > 8.0 * levels[0]).all()
