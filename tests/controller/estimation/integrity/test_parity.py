"""The parity of the gyroscopes beside dense algebra: what it tells, whom it names, and what it leaves to others."""

import numpy as np
import pytest

from controller.estimation.integrity.parity import step_parity
from controller.estimation.whole_mechanism.readings import find_frames
from tests.controller.estimation.integrity.made_up import RATE_HZ, constants, filtered, readings

LIMIT = np.radians(0.55)


def parity(state, variance=0.0):
    """Whether gyroscopes contradict each other in the last window."""
    s, imus = state["integrity"], state["imus"]
    frames, shaking = s["hypotheses"]["frames"], imus["shaking"][()]
    return bool(step_parity(s["parity"][()], s["filter"][()], imus["excluded"], frames, 5, 1.0 / RATE_HZ, variance, shaking))


def look(imu=None, fault=(0.0, 0.0, 0.0), kind="0.5", lost=(), excluded=(), windows=3, sensor=0, state=None, made=None):
    """The parity's state after some windows, and what each has returned; `imu` reads a `fault` too much, or all with None."""
    mechanism, r = readings(kind, 1.0, 2)
    r = r if made is None else made
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


@pytest.mark.parametrize(("of_a_sample", "least"), [(0.2, 0.55), (0.3, 0.55 * 0.3 / 0.205), (0.41, 1.1)])
def test_the_limit_is_six_standard_deviations_of_noise_if_that_is_more(of_a_sample, least):
    """The mean of 5 samples has 1 / sqrt(5) of a sample's noise [deg/s]; what turning adds is the same for all."""
    mechanism, r = readings("0.5", 1.0, 2)
    parameters, state = constants(mechanism)
    filtered(mechanism, type(r)(*(each[:6] for each in vars(r).values())), parameters, state)
    parity(state)
    quiet = float(state["integrity"]["parity"]["limit"])
    parity(state, np.radians(of_a_sample) ** 2)
    assert state["integrity"]["parity"]["limit"] - quiet + LIMIT == pytest.approx(np.radians(least), rel=3e-3)


def sum_of_squares(f, used):
    """What the fit of a twist to some gyroscopes leaves, summed over them."""
    z = f["mean"][used, :3] - f["predicted"][used, :3]
    j = f["jacobian"][used, :3, 6:12]
    t = np.linalg.lstsq(j.reshape(-1, 6), z.ravel(), rcond=None)[0]
    return np.sum((z - j @ t) ** 2)


def greatest_error(f, used):
    """The root of the greatest part of this sum that one gyroscope takes with it when it is left out."""
    whole = sum_of_squares(f, used)
    return np.sqrt(max(whole - sum_of_squares(f, [other for other in used if other != k]) for k in used))


@pytest.mark.parametrize("imu", range(7))
def test_the_error_is_what_least_squares_leaves_less_without_the_gyroscope(imu):
    s, _ = look(imu, (0.2, -0.3, 0.1), windows=1)
    assert s["parity"]["error"] == pytest.approx(greatest_error(s["filter"], list(range(7))), rel=1e-6)
    assert s["parity"]["worst"] == imu


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


def frames_of(mechanism, r):
    """The axes of the IMUs (7, 3, 3) in the base frame, by rows, at the first pose."""
    parameters, state = constants(mechanism)
    frames = np.zeros((7, 3, 3))
    path = state["integrity"]["filter"]["path"]
    path["position"], path["rotation"] = r.positions[0], r.rotations[0]
    find_frames(parameters["rig"]["sensors"][()], path["position"], path["rotation"], frames)
    return frames


@pytest.mark.parametrize("axis", range(3))
def test_on_a_base_that_turns_no_gyroscope_is_named(axis):
    mechanism, r = readings("0.5", 1.0, 2)
    frames = frames_of(mechanism, r)
    r.samples[:, 0] += frames @ (0.15 * np.eye(3)[axis])
    _, state = constants(mechanism)
    state["integrity"]["hypotheses"]["frames"] = frames
    s, told = look(state=state, made=r)
    assert told[1] and s["parity"]["error"] > s["parity"]["limit"]
    assert not s["parity"]["named"]


@pytest.mark.parametrize("imu", range(7))
def test_a_gyroscope_that_is_a_little_off_is_not_taken_for_a_base_that_turns(imu):
    mechanism, r = readings("0.5", 1.0, 2)
    _, state = constants(mechanism)
    state["integrity"]["hypotheses"]["frames"] = frames_of(mechanism, r)
    s, told = look(imu, (0.0, 0.0, 2.0 * LIMIT), state=state)
    assert told[1] and s["parity"]["worst"] == imu and s["parity"]["named"]


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
        # What is usual is hardly learned in three windows.
        assert s["parity"]["error"] == pytest.approx(greatest_error(s["filter"], [0, 1, 2, 4, 5, 6]), rel=3e-3)


def test_what_a_gyroscope_has_been_off_for_long_does_not_count():
    """It fades with 10 s; a fault that comes up at once counts in full beside it."""
    fault = np.array([0.008, 0.0, -0.004])
    mechanism, r = readings("static", 1.0, 2)
    r.samples[:, 0, 3] += fault
    parameters, state = constants(mechanism)
    s = state["integrity"]
    errors = []
    for n in range(900):
        at = 5 * (n % 90)
        part = type(r)(*(each[at + (n > 0) : at + 6] for each in vars(r).values()))
        if n % 90 == 0 and n > 0:
            part = type(r)(*(each[at : at + 6] for each in vars(r).values()))
            s["filter"]["collected"] = 0
        filtered(mechanism, part, parameters, state)
        assert not parity(state)
        errors.append(float(s["parity"]["error"]))
    assert np.mean(errors[-50:]) == pytest.approx(np.exp(-0.9) * np.mean(errors[:50]), rel=0.15)
    usual = s["parity"]["usual"].copy()
    r.samples[:, 0, 5] += [0.6, 0.0, 0.0]
    told = []
    for n in range(1, 4):
        filtered(mechanism, type(r)(*(each[5 * n : 5 * n + 5] for each in vars(r).values())), parameters, state)
        told.append(parity(state))
    assert any(told) and s["parity"]["worst"] == 5 and s["parity"]["named"]
    np.testing.assert_allclose(s["parity"]["usual"], usual, atol=1e-4)


@pytest.mark.parametrize("turning", [0.0, 200.0])
def test_the_limit_grows_with_the_angular_acceleration_planned_or_not(turning):
    """All gyroscopes see the same unplanned turn of the platform."""
    mechanism, r = readings("static", 1.0, 2)
    frames = r.rotations[0].T
    parameters, state = constants(mechanism)
    f = state["integrity"]["filter"]
    for n in range(3):
        rows = slice(5 * n + (n > 0), 5 * n + 6)
        part = type(r)(*(each[rows].copy() for each in vars(r).values()))
        filtered(mechanism, part, parameters, state)
        # A twist of all gyroscopes that grows by `turning` x time about the vertical.
        turn = turning * 0.01 * n * np.concatenate([np.zeros(3), frames @ [0.0, 0.0, 1.0]])
        f["mean"][:, :3] += f["jacobian"][:, :3, 6:12] @ turn
        parity(state)
    planned = f["turning"]
    seen = np.linalg.norm(f["jacobian"][:, :3, 6:12] @ np.eye(6)[5], axis=1).max()
    assert state["integrity"]["parity"]["limit"] == pytest.approx(LIMIT + 1e-3 * (planned + turning * seen), abs=2e-2)


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


@pytest.mark.slow
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
    assert not s["parity"]["shared"]
    assert not any(told) and sound["parity"]["error"] == pytest.approx(s["parity"]["error"])


def test_the_change_of_the_gyroscopes_twist_is_the_acceleration_that_was_not_planned():
    """Beside numpy: what two windows' forces show beyond it, with weights that rise in the first and fall in the second.

    How unevenly it changes is known less the part of noise.
    """
    mechanism, r = readings("mixed", 1.0, 3)
    r.samples[:, 1, 2] += [0.4, -0.2, 0.3]
    parameters, state = constants(mechanism)
    f, found, mean_square, variance = state["integrity"]["filter"], [], np.zeros(2), 1e-6
    for n in range(6):
        part = type(r)(*(each[5 * n + (n > 0) : 5 * n + 6] for each in vars(r).values()))
        filtered(mechanism, part, parameters, state)
        parity(state, variance)
        z, j = f["mean"] - f["predicted"], f["jacobian"]
        twist = np.linalg.lstsq(j[:, :3, 6:12].reshape(-1, 6), z[:, :3].ravel(), rcond=None)[0]
        forces = r.samples[5 * n : 5 * n + 5, 1]
        trend = np.einsum("n,nki->ki", np.linspace(-0.8, 0.8, 5), forces - forces.mean(axis=0)) / 5
        found.append((twist, z[:, 3:] - j[:, 3:, 6:12] @ twist, trend))
        if n > 0:
            (before, force, rises), (_, now, falls) = found[-2:]
            beyond = 0.5 * (force + rises + now - falls) - j[:, 3:, 12:] @ (twist - before) * RATE_HZ / 5
            np.testing.assert_allclose(state["integrity"]["parity"]["off_motion"], np.linalg.norm(beyond, axis=1), rtol=1e-5)
        if n > 1:
            first, second, third = (twist for twist, *_ in found[-3:])
            change = (third - 2.0 * second + first) * RATE_HZ / 5
            rows = j[:, :3, 6:12].reshape(-1, 6)
            noise = 6.0 * variance / 5 * (RATE_HZ / 5) ** 2 * np.linalg.inv(rows.T @ rows)
            force = j[6, 3:, 12:]
            squares = [np.square(force @ change).sum(), np.square(change[3:]).sum()]
            squares = np.array(squares) - [np.trace(force @ noise @ force.T), np.trace(noise[3:, 3:])]
            mean_square += 0.1 * (squares - mean_square)
        np.testing.assert_allclose(state["integrity"]["parity"]["mean_square"], mean_square, rtol=1e-5)
        np.testing.assert_allclose(f["unplanned_change"], np.maximum(mean_square, 0.0), rtol=1e-5)


def test_what_is_left_out_shows_no_force():
    _, state = constants(readings("0.5", 1.0, 2)[0])
    s, _ = look(3, (3.0, 0.0, 0.0), sensor=1, excluded=(3,), state=state)
    assert s["parity"]["off_motion"][3] == state["imus"]["shaking"]["no_motion"][3] == 0.0
    assert s["parity"]["steady"] < 0.3


def test_a_force_that_all_accelerometers_go_on_to_show_is_told_after_ten_windows():
    for imu, size, expected in ((None, 0.4, True), (None, 0.1, False), (2, 0.8, False)):
        mechanism, _ = readings("0.5", 1.0, 2)
        _, state = constants(mechanism)
        s, _ = look(imu, size * np.array([0.0, 0.8, 0.6]), windows=40, sensor=1, state=state)
        assert bool(s["parity"]["shared"]) == expected
        assert (s["parity"]["common"] > 0.15) == expected


@pytest.mark.parametrize("imus", [(2,), (2, 4), (0, 6)])
def test_a_force_that_two_accelerometers_go_on_to_show_is_told_after_twelve_windows(imus):
    """The average is beyond the limit after some windows; one alone is none, however far it is off."""
    mechanism, r = readings("0.5", 1.0, 2)
    fault = (0.5 if len(imus) == 2 else 5.0) * np.array([0.0, 0.8, 0.6])
    r.samples[:, 1, list(imus)] += fault
    parameters, state = constants(mechanism)
    s, first = state["integrity"]["parity"], None
    for n in range(40):
        part = type(r)(*(each[5 * n + (n > 0) : 5 * n + 6] for each in vars(r).values()))
        filtered(mechanism, part, parameters, state)
        parity(state)
        shown = np.minimum(np.linalg.norm(s["average"], axis=1), s["off_motion"]) if n else np.zeros(7)
        left = max(sorted(shown)[-2] - 3.0 * state["integrity"]["filter"]["rough"], 0.0)
        assert n == 0 or s["second"] == pytest.approx(left)
        first = n if s["two"] and first is None else first
    assert (first is not None) == (len(imus) == 2)
    assert first is None or 12 <= first <= 18


def test_missed_periods_do_not_hide_what_two_accelerometers_go_on_to_show():
    """A period is missed in every fifth window: fewer than twelve windows ever follow each other directly."""
    mechanism, r = readings("0.5", 1.0, 2)
    r.samples[:, 1, [2, 4]] += [0.0, 0.4, 0.3]
    parameters, state = constants(mechanism)
    s, f, first, before, broken = state["integrity"]["parity"], state["integrity"]["filter"], None, 0, 0
    for n in range(60):
        part = type(r)(*(each[5 * n + (n > 0) : 5 * n + 6] for each in vars(r).values()))
        filtered(mechanism, part, parameters, state, missed={3: 1} if n % 5 == 4 else None)
        if f["windows"] > before and f["job"] > 0:
            before = int(f["windows"])
            broken += not f["follows"]
            parity(state)
            first = n if s["two"] and first is None else first
    assert broken > 8 and first is not None and 12 <= first <= 30


@pytest.mark.parametrize("mean, hidden", [(1.0, 0.0), (0.0, 1.0)])
def test_vibration_of_the_accelerometers_is_no_error_of_two(mean, hidden):
    mechanism, r = readings("0.5", 1.0, 2)
    r.samples[:, 1, [2, 4]] += [0.0, 0.4, 0.3]
    parameters, state = constants(mechanism)
    for n in range(40):
        part = type(r)(*(each[5 * n + (n > 0) : 5 * n + 6] for each in vars(r).values()))
        filtered(mechanism, part, parameters, state)
        state["imus"]["shaking"]["mean"][4], state["imus"]["shaking"]["hidden"][4] = mean, hidden
        parity(state)
        assert not state["integrity"]["parity"]["two"]


def test_shocks_that_all_accelerometers_show_are_no_error_that_they_share():
    """Two of five windows are struck; the average is far beyond the limit all the time."""
    mechanism, r = readings("0.5", 1.0, 2)
    struck = (np.arange(len(r.samples)) // 5) % 5 < 2
    r.samples[struck, 1] += [0.0, 0.0, 4.0]
    parameters, state = constants(mechanism)
    s = state["integrity"]["parity"]
    for n in range(60):
        part = type(r)(*(each[5 * n + (n > 0) : 5 * n + 6] for each in vars(r).values()))
        filtered(mechanism, part, parameters, state)
        parity(state)
        assert not s["shared"]
        assert n < 5 or np.linalg.norm(s["average"], axis=1).min() > 0.5
