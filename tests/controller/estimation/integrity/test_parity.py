"""The parity of the gyroscopes beside dense algebra: what it tells, whom it names, and what it leaves to others."""

import numpy as np
import pytest

from controller.estimation.integrity.parity import step_parity
from tests.controller.estimation.integrity.made_up import RATE_HZ, constants, filtered, readings

LIMIT = np.radians(0.75)


def parity(state):
    """Whether gyroscopes contradict each other in the last window."""
    s, imus = state["integrity"], state["imus"]
    return bool(step_parity(s["parity"][()], s["filter"][()], imus["excluded"], 5, 1.0 / RATE_HZ, imus["shaking"]["no_motion"]))


def look(imu=None, fault=(0.0, 0.0, 0.0), kind="0.5", lost=(), excluded=(), windows=3, sensor=0, state=None):
    """The parity's state after some windows, and what each has returned; `imu` reads a `fault` too much, or all with None."""
    mechanism, r = readings(kind, 1.0, 2)
    r.samples[:, sensor, slice(None) if imu is None else imu] += fault
    parameters, fresh = constants(mechanism)
    state = fresh if state is None else state
    state["imus"]["healthy"][list(lost)] = 0
    state["imus"]["excluded"][list(excluded)] = 1
    s, told = state["integrity"], []
    for n in range(windows):
        # One cycle more than the windows, in which the last one's readings are predicted.
        part = type(r)(*(each[5 * n + (n > 0) : 5 * n + 6] for each in vars(r).values()))
        filtered(mechanism, part, parameters, state)
        told.append(parity(state))
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
    assert parity(state)
    assert not s["parity"]["named"]


def test_what_is_left_out_or_lost_does_not_count():
    for options in ({"excluded": (3,)}, {"lost": (3,)}):
        s, told = look(3, (1.0, 0.0, 0.0), **options)
        assert not any(told)
        assert s["parity"]["error"] == pytest.approx(residual(s["filter"], [0, 1, 2, 4, 5, 6]), rel=1e-6)


def test_two_gyroscopes_cannot_contradict_each_other():
    s, told = look(5, (1.0, 0.0, 0.0), lost=(0, 1, 2, 3, 4))
    assert not any(told) and s["parity"]["error"] == 0.0


@pytest.mark.parametrize("kind", ["static", "0.5", "mixed"])
def test_sound_accelerometers_read_the_motion_of_the_gyroscopes(kind):
    _, state = constants(readings(kind, 1.0, 2)[0])
    for windows in (2, 90):
        s, _ = look(kind=kind, windows=windows, state=state)
        assert 0.0 < s["parity"]["off_motion"].max() < 0.5 and not state["imus"]["shaking"]["no_motion"].any()
    assert s["parity"]["steady"] < 0.2


@pytest.mark.parametrize("imu", [0, 5, 6, None])
@pytest.mark.parametrize("size", [0.5, 1.5])
def test_a_force_that_is_no_motion_is_known_in_the_second_window_of_one_imu_or_of_all(imu, size):
    """The first window has nothing before it; a force since then is in both."""
    fault = size * np.array([0.0, 0.8, 0.6])
    mechanism, _ = readings("0.5", 1.0, 2)
    _, state = constants(mechanism)
    sound, _ = look(windows=2)
    s, told = look(imu, fault, windows=2, sensor=1, state=state)
    off, no_motion = s["parity"]["off_motion"], state["imus"]["shaking"]["no_motion"]
    guilty = slice(None) if imu is None else [imu]
    np.testing.assert_allclose(off[guilty], size, atol=0.25)
    assert np.delete(off, guilty).max(initial=0.0) < 0.25
    np.testing.assert_allclose(no_motion[guilty], 5.0 * off[guilty] ** 2 if size > 1.0 else 0.0)
    assert not any(told) and sound["parity"]["error"] == pytest.approx(s["parity"]["error"])


def test_the_change_of_the_gyroscopes_twist_is_the_acceleration_that_was_not_planned():
    """Beside numpy: what two windows' forces show beyond it."""
    mechanism, r = readings("mixed", 1.0, 3)
    r.samples[:, 1, 2] += [0.4, -0.2, 0.3]
    parameters, state = constants(mechanism)
    f, found = state["integrity"]["filter"], []
    for n in range(6):
        part = type(r)(*(each[5 * n + (n > 0) : 5 * n + 6] for each in vars(r).values()))
        filtered(mechanism, part, parameters, state)
        parity(state)
        z, j = f["mean"] - f["predicted"], f["jacobian"]
        twist = np.linalg.lstsq(j[:, :3, 6:12].reshape(-1, 6), z[:, :3].ravel(), rcond=None)[0]
        found.append((twist, z[:, 3:] - j[:, 3:, 6:12] @ twist))
        if n > 0:
            (before, force), (_, now) = found[-2:]
            beyond = 0.5 * (force + now) - j[:, 3:, 12:] @ (twist - before) * RATE_HZ / 5
            np.testing.assert_allclose(
                state["integrity"]["parity"]["off_motion"], np.linalg.norm(beyond, axis=1), rtol=1e-6, atol=1e-9
            )


def test_what_is_left_out_shows_no_force():
    _, state = constants(readings("0.5", 1.0, 2)[0])
    s, _ = look(3, (3.0, 0.0, 0.0), sensor=1, excluded=(3,), state=state)
    assert s["parity"]["off_motion"][3] == state["imus"]["shaking"]["no_motion"][3] == 0.0
    assert s["parity"]["steady"] < 0.3
