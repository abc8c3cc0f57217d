"""By what a target must be stretched in time, against the analytic motion of the legs."""

import numpy as np
import pytest

from controller.inverse_kinematics import leg_lengths
from controller.planning.offline_planner import plan
from controller.planning.pace import least_time_scale, target_peaks
from controller.planning.segments import evaluate_reference
from controller.planning.target import Target, load_target
from plant.pose import rotation_from_vector


def heave(mechanism, size, seconds):
    """Up and down by this size [m] once in so many seconds [s]."""
    times = np.linspace(0.0, seconds, 401)
    up = size * (1.0 - np.cos(2.0 * np.pi * times / seconds))[:, None] * mechanism.up_in_base
    home = mechanism.home
    return Target("heave", times, home.position + up, np.repeat(home.rotation[None], len(times), axis=0))


@pytest.mark.parametrize("name", ["hold", "circle", "sines", "steps"])
def test_the_built_in_motions_need_none(hexapod, name):
    assert least_time_scale(hexapod, load_target(name, hexapod, 10.0), 1.0) == 1.0


def behind(mechanism, target):
    """How far the planned reference is from a target at most [m]."""
    span = float(target.times[-1])
    times = np.arange(0.0, span, 1e-3)
    segments, index, reference = plan(mechanism, target, span).segments, np.zeros(6, np.int64), np.zeros((6, 3))
    planned = np.array([evaluate_reference(segments, t, index, reference) or reference[:, 0].copy() for t in times])
    return np.abs(planned - leg_lengths(mechanism, *target.at(times))).max()


@pytest.mark.parametrize("faster", [1.0, 6.0, 10.0])
def test_a_target_that_is_stretched_by_it_is_followed(hexapod, faster):
    target = heave(hexapod, 0.02, 2.0 / faster)
    scale = least_time_scale(hexapod, target, 1.0)
    if faster == 1.0:
        assert scale == 1.0 and behind(hexapod, target) < 1e-3
        return
    # A sinusoid's acceleration goes with the square of its pace.
    assert scale == pytest.approx(0.256 * faster, rel=0.3)
    error = behind(hexapod, target)
    assert error > 0.01 and behind(hexapod, target.slower(scale)) < 0.1 * error


def test_the_peaks_are_those_of_the_analytic_motion(hexapod):
    """Of a smooth motion, whose samples are dense, by differences of its formula; it is faster than at its start."""
    size, w, home = 0.015, 2.0 * np.pi / 1.6, hexapod.home
    peaks = {
        peak.name.partition(" of ")[0]: peak for peak in target_peaks(hexapod, heave(hexapod, size, 1.6)) if peak.most < np.inf
    }
    h = 1e-3
    times = np.arange(0.03, 1.6, h)
    up = size * (1.0 - np.cos(w * times))[:, None] * hexapod.up_in_base
    lengths = leg_lengths(hexapod, home.position + up, np.repeat(home.rotation[None], len(times), axis=0))
    for order, (name, most) in enumerate((("velocity", 0.25), ("acceleration", 3.0)), start=1):
        assert peaks[name].value == pytest.approx(np.abs(np.diff(lengths, order, axis=0)).max() / h**order, rel=0.04)
        assert peaks[name].most == most and peaks[name].order == order
    platform = {each.name: each for each in target_peaks(hexapod, heave(hexapod, size, 1.6))}
    assert platform["speed of the platform"].value == pytest.approx(size * w, rel=0.02)
    assert platform["acceleration of the platform"].value == pytest.approx(size * w**2, rel=0.02)
    assert platform["speed of the platform"].time % 0.8 == pytest.approx(0.4, abs=0.03)
    # At the start the acceleration begins at once.
    assert peaks["jerk"].value > 2.0 * size * w**3 and peaks["jerk"].time < 0.03


def test_a_turn_has_the_speed_of_the_turn(hexapod):
    times, home = np.linspace(0.0, 2.0, 201), hexapod.home
    turns = 0.1 * (1.0 - np.cos(3.0 * times))
    rotations = np.array([rotation_from_vector([0.0, 0.0, turn]) @ home.rotation for turn in turns])
    target = Target("turn", times, np.repeat(home.position[None], len(times), axis=0), rotations)
    found = {peak.name: peak for peak in target_peaks(hexapod, target)}
    assert found["turn speed of the platform"].value == pytest.approx(0.3, rel=0.02)
    assert found["turn acceleration of the platform"].value == pytest.approx(0.9, rel=0.02)
    assert found["speed of the platform"].value < 1e-9


def random_target(mechanism, random):
    """Samples of waves, or of points with corners, at some pace."""
    home, lasts = mechanism.home, random.uniform(0.5, 3.0)
    times = np.linspace(0.0, lasts, int(random.integers(8, 200)))
    moves = np.zeros((len(times), 6))
    size = np.array([0.012, 0.012, 0.012, 0.03, 0.03, 0.05]) * 10.0 ** random.uniform(-2.0, 0.0)
    if random.random() < 0.5:
        moves = size * np.sin(random.uniform(0.5, 12.0, 6) * times[:, None] + random.uniform(0.0, 6.0, 6))
    else:
        knots = np.sort(np.append(random.uniform(0.0, lasts, 5), [0.0, lasts]))
        moves = np.column_stack([np.interp(times, knots, random.uniform(-each, each, 7)) for each in size])
    rotations = np.array([rotation_from_vector(move[3:]) @ home.rotation for move in moves])
    return Target("random", times, home.position + moves[:, :3], rotations)


@pytest.mark.slow
@pytest.mark.parametrize("count", [25, pytest.param(1000, marks=pytest.mark.endurance)])
def test_the_time_scale_passes_and_hardly_any_less_would(hexapod, count):
    random, slowed = np.random.default_rng(7), 0
    for _ in range(count):
        target = random_target(hexapod, random)
        scale = least_time_scale(hexapod, target)
        passing = [peak.share for peak in target_peaks(hexapod, target.slower(scale)) if peak.most < np.inf]
        assert max(passing) <= 1.0
        if scale > 1.0:
            shares = [peak.share for peak in target_peaks(hexapod, target.slower(0.95 * scale)) if peak.most < np.inf]
            assert max(shares) > 1.0
        slowed += scale > 1.0
        # The reference may then follow, so that it stays near.
        if scale > 1.0 and slowed % 5 == 0:
            assert behind(hexapod, target.slower(scale)) < min(5e-3, 0.5 * behind(hexapod, target) + 5e-4)
    assert count // 5 < slowed < count


def test_what_is_held_or_at_rest_has_no_pace(hexapod):
    assert target_peaks(hexapod, load_target("steps", hexapod, 10.0)) == []
    for name in ("steps", "hold"):
        assert least_time_scale(hexapod, load_target(name, hexapod, 5.0)) == 1.0
