"""By what a target must be stretched in time, against the analytic motion of the legs."""

import numpy as np
import pytest

from controller.inverse_kinematics import leg_lengths
from controller.planning.offline_planner import plan
from controller.planning.pace import required_stretch
from controller.planning.segments import evaluate_reference
from controller.planning.target import Target, load_target


def heave(mechanism, size, seconds):
    """Up and down by this size [m] once in so many seconds [s]."""
    times = np.linspace(0.0, seconds, 401)
    up = size * (1.0 - np.cos(2.0 * np.pi * times / seconds))[:, None] * mechanism.up_in_base
    home = mechanism.home
    return Target("heave", times, home.position + up, np.repeat(home.rotation[None], len(times), axis=0))


@pytest.mark.parametrize("name", ["hold", "circle", "sines", "steps"])
def test_the_built_in_motions_need_none(hexapod, name):
    assert required_stretch(hexapod, load_target(name, hexapod, 10.0)) <= 1.05


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
    stretch = required_stretch(hexapod, target)
    if faster == 1.0:
        assert stretch == 1.0 and behind(hexapod, target) < 1e-3
        return
    # A sinusoid's acceleration goes with the square of its pace.
    assert stretch == pytest.approx(0.256 * faster, rel=0.15)
    error = behind(hexapod, target)
    assert error > 0.01 and behind(hexapod, heave(hexapod, 0.02, 1.1 * stretch * 2.0 / faster)) < 0.1 * error
