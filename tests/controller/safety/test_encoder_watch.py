"""Which encoder is wrong: against a least-squares fit of each encoder's error alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.estimation.encoders import STATE as ENCODERS
from controller.safety.encoder_watch import _ALONE, _SHARES, STATE, _find_wrong

LEGS = 6


def fitted(covariance, differences, k):
    """The error of encoder `k` that explains most of the differences, its standard deviation, and what is left of them."""
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    (error,), *_ = np.linalg.lstsq(whiten[:, [k]], whiten @ differences, rcond=None)
    left = whiten @ differences - error * whiten[:, k]
    return error, 1.0 / np.linalg.norm(whiten[:, k]), left @ left


def state_with(covariance, differences, kind=0):
    """The state before the worst is looked for, with differences of one kind."""
    state = np.zeros((), STATE)
    state["factor"], state["differences"][kind] = covariance, differences
    return state


@given(seed=st.integers(0, 2**32 - 1), kind=st.integers(0, 2))
def test_the_encoder_and_its_error_are_those_of_the_best_fit(seed, kind):
    random = np.random.default_rng(seed)
    rows = random.normal(size=(LEGS, LEGS)) * 3e-4
    covariance, d = rows @ rows.T + 1e-10 * np.eye(LEGS), random.normal(0.0, 4e-4, LEGS)
    encoders = np.zeros((), ENCODERS)
    worst, error, sigma, alone = _find_wrong(state_with(covariance, d, kind)[()], encoders[()], True)
    fits = [fitted(covariance, d, k) for k in range(LEGS)]
    best = min(range(LEGS), key=lambda k: fits[k][2])
    assert worst == best
    assert error == pytest.approx(_SHARES[kind] * fits[best][0], rel=1e-6)
    assert sigma == pytest.approx(fits[best][1], rel=1e-6)
    assert alone == ((fits[best][0] / fits[best][1]) ** 2 > _ALONE * fits[best][2])
    unseen = [abs(fit[0]) + 2.0 * fit[1] for fit in fits] if kind == 2 else np.zeros(LEGS)
    np.testing.assert_allclose(encoders["unseen"], unseen, rtol=1e-6)


@pytest.mark.parametrize("k", range(LEGS))
def test_an_encoder_is_told_from_an_error_of_the_pose(k):
    """A shared error ten times as large as that of the encoder does not hide it, as the others show it, too."""
    shared = np.full(LEGS, 1e-3)
    covariance = np.outer(shared, shared) + (5e-5) ** 2 * np.eye(LEGS)
    changes = 2.0 * shared + 2e-4 * (np.arange(LEGS) == k)
    worst, error, sigma, alone = _find_wrong(state_with(covariance, changes)[()], np.zeros((), ENCODERS)[()], True)
    assert (worst, alone) == (k, True)
    assert error == pytest.approx(2e-4, rel=0.05) and sigma == pytest.approx(5e-5 * np.sqrt(1.2), rel=0.01)
    assert not _find_wrong(state_with(covariance, 2.0 * shared)[()], np.zeros((), ENCODERS)[()], True)[3]


def test_without_a_covariance_none_is_wrong():
    for covariance in (np.zeros((LEGS, LEGS)), np.full((LEGS, LEGS), np.nan)):
        assert not _find_wrong(state_with(covariance, np.ones(LEGS))[()], np.zeros((), ENCODERS)[()], True)[3]
