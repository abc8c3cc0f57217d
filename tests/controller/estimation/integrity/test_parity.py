"""The parity of the gyroscopes beside dense algebra: what it tells, whom it names, and what it leaves to others."""

import numpy as np
import pytest

from controller.estimation.integrity.parity import step_parity
from tests.controller.estimation.integrity.made_up import constants, filtered, readings

LIMIT = np.radians(2.0)


def look(imu=None, fault=(0.0, 0.0, 0.0), kind="0.5", lost=(), excluded=(), windows=3):
    """The parity's state after some windows, and what each has returned; `imu` reads a `fault` too much, or all with None."""
    mechanism, r = readings(kind, 1.0, 2)
    r.samples[:, 0, slice(None) if imu is None else imu] += fault
    parameters, state = constants(mechanism)
    state["imus"]["healthy"][list(lost)] = 0
    state["imus"]["excluded"][list(excluded)] = 1
    s, told = state["integrity"], []
    for n in range(windows):
        # One cycle more than the windows, in which the last one's readings are predicted.
        part = type(r)(*(each[5 * n + (n > 0) : 5 * n + 6] for each in vars(r).values()))
        filtered(mechanism, part, parameters, state)
        told.append(bool(step_parity(s["parity"][()], s["filter"][()], state["imus"]["excluded"])))
    return s, told


def residual(f, used):
    """The greatest error of a gyroscope when the twist fits those that are used."""
    z = f["mean"][used, :3] - f["predicted"][used, :3]
    j = f["jacobian"][used, :3, 6:12]
    t = np.linalg.lstsq(j.reshape(-1, 6), z.ravel(), rcond=None)[0]
    return np.linalg.norm(z - j @ t, axis=1).max()


@pytest.mark.parametrize("imu", range(7))
def test_the_error_is_what_least_squares_leaves(imu):
    s, _ = look(imu, (0.02, -0.03, 0.01))
    assert s["parity"]["error"] == pytest.approx(residual(s["filter"], list(range(7))), rel=1e-6)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("imu", range(7))
def test_a_gyroscope_that_is_far_off_is_named_in_the_second_window(imu, axis):
    s, told = look(imu, 0.6 * np.eye(3)[axis])
    assert told[:2] == [False, True]
    assert s["parity"]["worst"] == imu and s["parity"]["named"]
    assert s["parity"]["error"] > s["parity"]["limit"] >= LIMIT


@pytest.mark.parametrize("kind", ["static", "0.5", "mixed"])
def test_sound_gyroscopes_agree(kind):
    s, told = look(kind=kind, windows=90)
    assert not any(told)
    assert s["parity"]["error"] < 0.5 * LIMIT


def test_two_that_are_off_are_not_taken_for_one():
    mechanism, r = readings("0.5", 1.0, 2)
    r.samples[:, 0, 1] += [0.5, 0.0, 0.0]
    r.samples[:, 0, 4] += [0.0, 0.0, 0.5]
    parameters, state = constants(mechanism)
    s = state["integrity"]
    filtered(mechanism, r, parameters, state, count=16)
    s["parity"]["off_for"] = 5
    assert step_parity(s["parity"][()], s["filter"][()], state["imus"]["excluded"])
    assert not s["parity"]["named"]


def test_what_is_left_out_or_lost_does_not_count():
    for options in ({"excluded": (3,)}, {"lost": (3,)}):
        s, told = look(3, (1.0, 0.0, 0.0), **options)
        assert not any(told)
        assert s["parity"]["error"] == pytest.approx(residual(s["filter"], [0, 1, 2, 4, 5, 6]), rel=1e-6)


def test_two_gyroscopes_cannot_contradict_each_other():
    s, told = look(5, (1.0, 0.0, 0.0), lost=(0, 1, 2, 3, 4))
    assert not any(told) and s["parity"]["error"] == 0.0
