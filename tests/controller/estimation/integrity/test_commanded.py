"""Motion that was not commanded: against the response of a second-order filter in closed form, and in closed loop."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.estimation.integrity.commanded import compare_with_commands
from controller.inverse_kinematics import leg_lengths
from controller.load_feed_forward import friction_at
from controller.rig import elapsed
from controller.safety.causes import Mode
from hil.faults.links import run
from hil.faults.rows import all_rows
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from plant.fmu.settings import Setting
from plant.pose import pose_errors, rotation_from_vector, rotations_from_quaternions
from plant.truth import TRUTH_POSITION, TRUTH_QUATERNION
from tests.controller.safety.moving import PERIOD_S, moving, place

SLOW_S = 1.5
LAG_S = 0.002


class Compared:
    """A loop that holds home: its estimate and commands are what a test makes of them."""

    def __init__(self):
        self.mechanism, self.parameters, self.state = moving("hexapod")

    def set_pose(self, position, rotation):
        place(self.mechanism, self.state, position, rotation)

    def cycle(self, commands=0.0, follows=True, missed=0):
        """A cycle with these commands of all legs; returns what has moved otherwise."""
        s = self.state
        s["time"]["missed"], s["pid"]["command"] = missed, commands
        compared = s["integrity"]["commanded"]
        compare_with_commands(
            compared[()], self.parameters["rig"][()], s["time"][()], follows, LAG_S, self.parameters["load"][()], s["load"][()],
            s["pose"][()], s["reference"][()], s["pid"]["command"],
        )  # fmt: skip
        return compared["moved"].copy()


def response(kind, t):
    """What is left of a step, and of a ramp: s^2 / (s^2 + 2 s / tau + 1.5 / tau^2) in the time domain."""
    decay, w = np.exp(-t / SLOW_S), np.sqrt(0.5) / SLOW_S
    return decay * (np.cos(w * t) - np.sin(w * t) / (w * SLOW_S)) if kind == "step" else decay * np.sin(w * t) / w


@pytest.mark.slow
@settings(max_examples=10)
@given(seed=st.integers(0, 10**6), kind=st.sampled_from(["step", "ramp"]), missed=st.sampled_from([0, 3]))
def test_an_estimate_that_leaves_what_is_commanded_is_seen_and_fades_as_a_second_order_filter_has_it(seed, kind, missed):
    random, loop = np.random.default_rng(seed), Compared()
    home, loads = loop.mechanism.home, random.normal(0.0, 50.0, 6)
    loop.state["load"]["drive"] = loads
    loop.state["reference"]["motion"][:, 1] = rates = random.normal(0.0, 0.002, 6)
    braked = loads + [friction_at(loop.parameters["load"][()], k, rates[k]) for k in range(6)]
    commands = float(loop.parameters["load"]["droop"]) * braked
    shift, turn = random.normal(0.0, 1e-4, 3), random.normal(0.0, 1e-4, 3)
    loop.state["time"]["missed"] = missed
    period = elapsed(loop.parameters["rig"][()], loop.state["time"][()])
    assert period == pytest.approx((1 + missed) * PERIOD_S)
    for _ in range(int(2.0 * SLOW_S / period) + 2):
        assert loop.cycle(commands, missed=missed).max() < 1e-9
    for n in range(1, 600):
        size = 1.0 if kind == "step" else n * period
        loop.set_pose(home.position + size * shift, rotation_from_vector(size * turn) @ home.rotation)
        moved = loop.cycle(commands, missed=missed)
        # The rule of the filter is of the first order in the period.
        expected = np.abs(response(kind, n * period)) * np.array([np.linalg.norm(shift), np.linalg.norm(turn)])
        np.testing.assert_allclose(moved, expected, rtol=0.02, atol=5e-6)


@pytest.mark.parametrize("at", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("kind", ["step", "ramp"])
def test_in_the_first_seconds_what_is_left_is_that_of_the_best_straight_line(kind, at):
    """By least squares over all cycles so far; a wrong load leaves a constant rate from the start besides."""
    loop = Compared()
    home, times = loop.mechanism.home, PERIOD_S * np.arange(1, round(2.0 * SLOW_S / PERIOD_S))
    courses = 1e-3 * (times >= at) if kind == "step" else 1e-3 * np.maximum(times - at, 0.0)
    courses += 2e-3 * times
    loop.cycle()
    for n, course in enumerate(courses):
        loop.set_pose(home.position + [0.0, 0.0, course], home.rotation)
        moved = loop.cycle()[0]
        if n % 50 == 49 and times[n] > at:
            line = np.polyfit(times[: n + 1], courses[: n + 1], 1)
            left = abs(courses[n] - np.polyval(line, times[n]))
            assert moved == pytest.approx(left, rel=0.1, abs=2e-5), times[n]


@settings(max_examples=20)
@given(missed=st.lists(st.integers(0, 200), min_size=20, max_size=20), seed=st.integers(0, 10**6))
def test_whatever_is_missed_it_stays_bounded_and_comes_to_rest(missed, seed):
    random, loop = np.random.default_rng(seed), Compared()
    home = loop.mechanism.home
    loop.cycle()
    for number in missed:
        loop.set_pose(home.position + random.uniform(-1e-3, 1e-3, 3), home.rotation)
        assert loop.cycle(missed=number)[0] < 0.02
    loop.set_pose(home.position, home.rotation)
    for _ in range(100):
        loop.cycle(missed=100)
    assert loop.cycle()[0] < 1e-6


def test_where_the_legs_do_not_determine_the_pose_it_is_not_known():
    loop = Compared()
    loop.cycle()
    loop.state["pose"]["directions"] = [0.0, 0.0, 1.0]
    assert np.isinf(loop.cycle()).all()


def test_what_the_commands_say_moves_nothing_and_a_drive_that_lags_is_late():
    loop = Compared()
    home, rate = loop.mechanism.home, 0.02
    lengths = leg_lengths(loop.mechanism, home.position, home.rotation)
    loop.cycle()
    followed, lagged = 0.0, 0.0
    loop.cycle(rate)
    for _ in range(300):
        lagged += PERIOD_S / (PERIOD_S + LAG_S) * (rate - lagged)
        followed += PERIOD_S * lagged
        loop.state["pose"]["lengths"] = lengths + followed
        assert loop.cycle(rate).max() < 1e-9
    assert followed > 0.005


def test_it_begins_anew_with_each_motion():
    loop = Compared()
    home = loop.mechanism.home
    assert loop.cycle().max() == 0.0
    loop.set_pose(home.position + [1e-3, 0.0, 0.0], home.rotation)
    assert loop.cycle()[0] == pytest.approx(1e-3, rel=1e-2)
    assert loop.cycle(follows=False).max() == 0.0
    assert loop.cycle().max() == 0.0 and loop.cycle().max() < 1e-12


def errors_and_levels(records):
    """Errors (N, 2) of the pose, and the level, in motion."""
    records = records[records["mode"] == Mode.RUNNING]
    rotations = rotations_from_quaternions(np.ascontiguousarray(records["truth"][:, TRUTH_QUATERNION]))
    errors = pose_errors(records["position"], records["rotation"], records["truth"][:, TRUTH_POSITION].copy(), rotations)
    return np.linalg.norm(errors.reshape(-1, 2, 3), axis=2), records["protection"].astype(float)


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["compiled", "whole"])
@pytest.mark.parametrize(
    "name", ["all gyroscopes 0.5 deg/s about x at once", "all gyroscopes swing by 0.5 deg/s about x, 0.2 Hz"]
)
def test_the_level_covers_what_all_imus_share_before_it_is_told(name, fusion):
    (row,) = (row for row in all_rows() if row.name == name)
    records, begin, _ = run(row.drawn(2, fusion))
    errors, levels = errors_and_levels(records[begin:])
    assert errors[:, 0].max() > 1e-3
    assert (errors <= levels).all(axis=1).mean() > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["motor.resistance=0.72", "friction.coulomb=30", "friction.coulomb=0", "payload.mass=20"])
def test_drives_and_loads_that_are_not_as_the_file_says_raise_the_level_by_millimetres(setting):
    config = SimulationConfig(duration=8.0, seed=5)
    usual, other = (
        simulate(replace(config, settings=each)).summary()["protection"]["position_max"]
        for each in ((), (Setting.parse(setting),))
    )
    assert usual < other < usual + 3.5e-3
