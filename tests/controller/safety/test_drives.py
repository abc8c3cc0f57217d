"""What was commanded against the estimate: intervals and sums against slow twins, and what is told in closed loop."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.safety import watch_nothing
from controller.safety.causes import Cause, Mode, Request
from controller.safety.drives import check_drives, drive_parameters, expect_rates
from controller.settings import DriveSettings
from plant.mechanism import load_in_space
from tests.controller.safety.moving import PERIOD_S, moving, stop_of

MM = 1e-3
KNOWN = DriveSettings(load=0.0, resistance=0.0, friction=0.0)
"""Nothing is unknown."""


def check(parameters, state):
    """Compare a cycle with what was commanded; returns the cause of a fault."""
    p, s = parameters, state
    return check_drives(
        p["safety"][()], s["safety"][()], p["rig"][()], s["time"][()], float(p["load"]["command_delay"]), s["load"][()],
        s["pose"][()], s["reference"][()], s["pid"][()],
    )  # fmt: skip


def moving_with(drives, preset="hexapod"):
    """Mechanism, parameters and state, as `moving`, with settings of the drives."""
    mechanism, parameters, state = moving(preset)
    parameters["safety"]["drives"] = drive_parameters(drives, mechanism)
    return mechanism, parameters, state


def loaded(mechanism, state, random):
    """Give the drives loads, and the platform's static forces, which lack the rods' weight and the acceleration."""
    legs = mechanism.legs
    state["load"]["drive"][:legs] = random.normal(20.0, 40.0, legs)
    state["load"]["force"][:legs] = state["load"]["drive"][:legs] + random.normal(0.0, 5.0, legs)


# -------------------------------------------------------------------------------------------------------------- the interval


def test_the_constants_by_hand():
    mechanism = load_in_space("hexapod")
    p = drive_parameters(DriveSettings(load=0.5, resistance=0.1, friction=3.0, slack=0.004), mechanism)
    # 0.6 Ohm, half of which is compensated; 0.05 N m/A on a screw of 5 mm.
    force_constant = 2.0 * np.pi * 0.05 / 0.005
    np.testing.assert_allclose(p["droop"], np.array([0.54 - 0.3, 0.66 - 0.3]) / force_constant**2, rtol=1e-13)
    assert (p["load"], p["friction"], p["slack"], p["lag"]) == (0.5, 45.0, 0.004, 0.001)
    # Less than no droop would not be stable.
    assert drive_parameters(DriveSettings(resistance=0.9), mechanism)["droop"][0] == 0.0


def rate_of(command, load, droop, friction):
    """The rate at which a motor holds its load and a friction that brakes it."""
    free = command - droop * load
    return np.sign(free) * max(abs(free) - droop * friction, 0.0)


@settings(max_examples=6)
@given(seed=st.integers(0, 10**6), preset=st.sampled_from(["hexapod", "planar-3rpr"]))
def test_the_interval_holds_every_rate_that_the_uncertainties_allow_and_little_more(seed, preset):
    random = np.random.default_rng(seed)
    drives = DriveSettings(*random.uniform(0.0, [1.0, 0.4, 3.0]))
    mechanism, parameters, state = moving_with(drives, preset)
    loaded(mechanism, state, random)
    p, s, legs, plant = parameters["safety"]["drives"], state["safety"]["drives"], mechanism.legs, mechanism.plant_parameters()
    state["pid"]["command"][:legs] = s["rate"][:legs] = random.normal(0.0, 0.005, legs)
    expect_rates(p[()], s[()], parameters["rig"][()], 0.0, state["load"][()], state["pid"][()])
    turns = 2.0 * np.pi / plant["motor.screw_lead"]
    nominal, mean = plant["drive.nominal_resistance"], np.abs(state["load"]["force"][:legs]).mean()
    for k in range(legs):
        found = []
        for share, load, friction in np.array(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 3)).reshape(3, -1).T:
            resistance = nominal * (1.0 + share * drives.resistance - plant["drive.compensation"])
            droop = resistance / (turns * plant["motor.torque_constant"]) ** 2
            weight = state["load"]["drive"][k] + load * drives.load * mean
            most = drives.friction * np.max(plant["friction.coulomb"])
            found.append(rate_of(state["pid"]["command"][k], weight, droop, 0.5 * (1.0 + friction) * most))
        low, high = s["low"][k], s["high"][k]
        assert low <= min(found) + 1e-15 and max(found) <= high + 1e-15
        # What it holds beyond: friction at another resistance than the load.
        beyond = (p["droop"][1] - p["droop"][0]) * p["friction"]
        assert min(found) - low <= beyond + 1e-15 and high - max(found) <= beyond + 1e-15


# ------------------------------------------------------------------------------------------------------------------ the sums


def excess_of(lengths, low, high, period):
    """How far the last lengths (n, legs) have come beyond and stayed behind the intervals, the worst of all windows."""
    ahead, behind = np.zeros(lengths.shape[1]), np.zeros(lengths.shape[1])
    for first in range(len(lengths)):
        change = lengths[-1] - lengths[first]
        ahead = np.maximum(ahead, change - high[first:-1].sum(axis=0) * period)
        behind = np.maximum(behind, low[first:-1].sum(axis=0) * period - change)
    return ahead, behind


@settings(max_examples=4)
@given(seed=st.integers(0, 10**6), preset=st.sampled_from(["hexapod", "planar-3rpr"]))
def test_the_sums_are_the_greatest_excess_of_all_windows(seed, preset):
    random = np.random.default_rng(seed)
    mechanism, parameters, state = moving_with(DriveSettings(load=0.2, resistance=0.1, friction=0.5, slack=np.inf), preset)
    s, pose, legs = state["safety"]["drives"], state["pose"], mechanism.legs
    lengths, low, high = [], [], []
    for _ in range(60):
        state["pid"]["command"][:legs] = random.normal(0.0, 0.02, legs)
        loaded(mechanism, state, random)
        pose["lengths"][:legs] += random.normal(0.0, 0.2 * PERIOD_S, legs)
        assert check(parameters, state) == Cause.NONE
        lengths.append(pose["lengths"][:legs].copy())
        low.append(s["low"][:legs].copy())
        high.append(s["high"][:legs].copy())
    ahead, behind = excess_of(np.array(lengths), np.array(low), np.array(high), PERIOD_S)
    np.testing.assert_allclose(s["ahead"][:legs], ahead, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(s["behind"][:legs], behind, rtol=0.0, atol=1e-15)
    assert ahead.max() > 0.0 and behind.max() > 0.0


@settings(max_examples=6)
@given(leg=st.integers(0, 5), share=st.floats(1.05, 3.0), grows=st.booleans(), seed=st.integers(0, 10**6))
def test_a_creep_beyond_the_bound_is_told_when_it_has_used_up_the_slack(leg, share, grows, seed):
    mechanism, parameters, state = moving_with(DriveSettings(load=1.5))
    loaded(mechanism, state, np.random.default_rng(seed))
    check(parameters, state)
    s, slack = state["safety"]["drives"], DriveSettings().slack
    bound = s["high"][leg] if grows else s["low"][leg]
    creep = share * bound + (1e-3 if grows else -1e-3)
    expected = int(np.ceil(slack / (abs(creep - bound) * PERIOD_S)))

    def told():
        state["pose"]["lengths"][leg] += creep * PERIOD_S
        return check(parameters, state) != Cause.NONE

    assert next((n for n in range(1, expected + 2) if told()), None) in (expected, expected + 1)
    assert stop_of(state) == (Cause.MOVED_OTHERWISE, leg, pytest.approx(slack, rel=0.05), slack)
    assert (state["safety"]["mode"], state["safety"]["request"]) == (Mode.FAULT, Request.BRAKED)


@settings(max_examples=4)
@given(seed=st.integers(0, 10**6))
def test_a_creep_within_the_bound_is_never_told(seed):
    random = np.random.default_rng(seed)
    mechanism, parameters, state = moving_with(replace(DriveSettings(), slack=1e-9))
    loaded(mechanism, state, random)
    check(parameters, state)
    s = state["safety"]["drives"]
    creep = s["low"] + random.uniform(0.0, 1.0, 6) * (s["high"] - s["low"])
    for _ in range(5000):
        state["pose"]["lengths"] += creep * PERIOD_S
        assert check(parameters, state) == Cause.NONE


@pytest.mark.parametrize(("rate", "delay", "most"), [(1000.0, 0.0, 0.01), (250.0, 0.004, 0.2), (50.0, 0.02, 3.0)])
def test_fast_motions_leave_little_of_a_known_delay(rate, delay, most):
    """To 0.25 m/s with 3 m/s2, back and forth; the drives do exactly what they are told, later."""
    _, parameters, state = moving_with(replace(KNOWN, slack=np.inf))
    parameters["rig"]["period"], parameters["load"]["command_delay"] = 1.0 / rate, delay
    parameters["safety"]["drives"]["lag"] = 0.0
    times = np.arange(0.0, 2.0, 1.0 / rate)
    speeds = np.interp(times % 0.8, [0.0, 0.08, 0.24, 0.4, 0.56, 0.72, 0.8], 0.25 * np.array([0, 1, 1, -1, -1, 0, 0]))
    late = np.interp(times - delay, times, speeds, left=0.0)
    lengths = 0.4 + np.concatenate([[0.0], np.cumsum(late[:-1]) / rate])
    s, greatest = state["safety"]["drives"], 0.0
    for speed, length in zip(speeds, lengths, strict=True):
        state["pid"]["command"], state["pose"]["lengths"] = speed, length
        assert check(parameters, state) == Cause.NONE
        greatest = max(greatest, s["ahead"].max(), s["behind"].max())
    assert greatest < most * MM


@pytest.mark.parametrize("how", ["missed", "stopping", "armed", "quick stop"])
def test_the_sums_begin_anew_when_lengths_and_commands_do_not_belong_together(how):
    _, parameters, state = moving_with(DriveSettings())
    safety, step = state["safety"], 0.9 * DriveSettings().slack
    for _ in range(3):
        check(parameters, state)
        state["pose"]["lengths"] += step
        assert check(parameters, state) == Cause.NONE and safety["drives"]["ahead"].min() > 0.8 * step
        kept = safety.copy()
        if how == "missed":
            state["time"]["missed"] = 1
        elif how == "quick stop":
            safety["request"] = Request.QUICK_STOP
        else:
            safety["mode"] = Mode.STOPPING if how == "stopping" else Mode.ARMED
        state["pose"]["lengths"] += step
        assert check(parameters, state) == Cause.NONE
        state["time"]["missed"], safety["mode"], safety["request"] = 0, kept["mode"], kept["request"]
        check(parameters, state)
        assert not safety["drives"]["ahead"].any() and not safety["drives"]["behind"].any()


@pytest.mark.parametrize("how", ["nothing is watched", "no limit"])
def test_without_a_limit_nothing_is_told(how):
    _, parameters, state = moving_with(replace(DriveSettings(), slack=np.inf) if how == "no limit" else DriveSettings())
    if how == "nothing is watched":
        watch_nothing(parameters)
    for n in range(50):
        state["pose"]["lengths"] += (-1.0) ** n
        assert check(parameters, state) == Cause.NONE
