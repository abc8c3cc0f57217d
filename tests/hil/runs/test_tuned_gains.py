"""Gains from `gough tune` in closed loop on the FMU: crossover and margins as predicted, and stable in all of the workspace.

Predicted by linear systems, measured on the plant's C code with the compiled cycle. Coulomb friction is left out, as in the
design, and signals are small.
"""

import numpy as np
import pytest

from controller.design.linear_loop import SETTLED_S, Setup, open_loop
from controller.design.stability import Response, margins
from controller.design.tuning import tune, workspace_poses
from controller.settings import control_settings
from hil.rigs.position_loops import BANDWIDTH
from plant.mechanism import load_in_space
from tests.hil.runs.tuned_loop import standing_loop

RATE_HZ = 1000.0
MECHANISMS = ["hexapod", "6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "planar-3rpr"]
"""One of each type of section 4, and a planar one."""


def check_margins(loop, found, singly):
    """The loop on the FMU has these margins, within 20 %."""
    factor, delay = 10.0 ** (found.together.gain_db / 20.0), found.together.delay * loop.rate
    assert not loop.grows(gain=0.8 * factor)
    assert loop.grows(gain=1.2 * factor)
    assert not loop.grows(delay=int(0.8 * delay))
    assert loop.grows(delay=int(np.ceil(1.2 * delay)))
    for leg in singly:
        own = found.legs[leg]
        assert loop.crossover(leg, own.crossover_hz) == pytest.approx(own.crossover_hz, rel=0.2)
        factor = 10.0 ** (own.gain_db / 20.0)
        assert not loop.grows(gain=0.8 * factor, leg=leg)
        assert loop.grows(gain=1.2 * factor, leg=leg)


def check_design(name, poses, position=False, delay=0.0):
    mechanism = load_in_space(name)
    setup = Setup(RATE_HZ, bandwidth=BANDWIDTH if position else None, delay=delay)
    design = tune(mechanism, setup, poses=poses)
    worst = design.worst("sensitivity peak, all loops")
    for pose, found in ((design.home, design.margins), (worst.pose, worst.margins)):
        fastest = int(np.argmax([leg.crossover_hz for leg in found.legs]))
        weakest = int(np.argmin([leg.gain_db for leg in found.legs]))
        with standing_loop(mechanism, design.gains, pose, RATE_HZ, position) as loop:
            check_margins(loop, found, {fastest, weakest})


@pytest.mark.slow
def test_a_loop_on_the_fmu_has_the_crossover_and_the_margins_of_the_linear_one():
    """The planar preset's gains, which ring: its crossover and margins are far from those of exact lengths."""
    mechanism = load_in_space("planar-3rpr")
    gains = control_settings(mechanism)
    found = margins(Response.of(open_loop(mechanism, Setup(RATE_HZ))), gains)
    with standing_loop(mechanism, gains, mechanism.home, RATE_HZ) as loop:
        check_margins(loop, found, {1})


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("planar-3rpr", marks=pytest.mark.slow(seconds=30)),
        *(pytest.param(name, marks=pytest.mark.endurance) for name in ("hexapod", "6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5")),
    ],
)
def test_designed_gains_have_their_margins_at_home_and_at_the_worst_pose(name):
    check_design(name, 12)


@pytest.mark.slow
def test_so_have_those_for_drives_that_close_position_loops():
    check_design("hexapod", 4, position=True)


@pytest.mark.slow
def test_a_delay_in_the_design_is_taken_off_the_margins():
    """The loop on the FMU with the delay of the design has the margins that are left."""
    mechanism, delay = load_in_space("6-3-I"), 0.008
    gains = control_settings(mechanism)
    found = margins(Response.of(open_loop(mechanism, Setup(RATE_HZ, delay=delay))), gains)
    cycles = round(delay * RATE_HZ)
    factor, left = 10.0 ** (found.together.gain_db / 20.0), found.together.delay * RATE_HZ
    with standing_loop(mechanism, gains, mechanism.home, RATE_HZ) as loop:
        assert not loop.grows(gain=0.8 * factor, delay=cycles)
        assert loop.grows(gain=1.2 * factor, delay=cycles)
        assert not loop.grows(delay=int(cycles + 0.8 * left))
        assert loop.grows(delay=int(np.ceil(cycles + 1.2 * left)))


@pytest.mark.slow
def test_at_a_lower_rate_the_loop_has_the_margins_of_that_rate():
    mechanism, rate = load_in_space("6-4-I"), 200.0
    gains = control_settings(mechanism)
    found = margins(Response.of(open_loop(mechanism, Setup(rate))), gains)
    with standing_loop(mechanism, gains, mechanism.home, rate) as loop:
        check_margins(loop, found, {0})


@pytest.mark.endurance
@pytest.mark.parametrize("name", MECHANISMS)
def test_no_pose_of_the_workspace_is_unstable(name):
    """At 500 random poses that the design has not seen no kick grows: when feedback closes, and when filters have settled."""
    mechanism = load_in_space(name)
    design = tune(mechanism, Setup(RATE_HZ))
    for pose in workspace_poses(mechanism, 500, seed=1):
        with standing_loop(mechanism, design.gains, pose, RATE_HZ, settled=design.hold, closed=0.02) as loop:
            assert not loop.grows(duration=1.0)
            assert not loop.later(SETTLED_S).grows(duration=1.0)
