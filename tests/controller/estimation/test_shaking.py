"""How uncertain each reading is, what is told of it, and for how long clipped readings are bridged."""

import numpy as np
import pytest

from controller.estimation.shaking import (
    CALM_S,
    MEMORY_S,
    SAYS_NOTHING,
    STATE,
    bridges,
    note_force,
    note_rate,
    shaking_parameters,
    tell_shaking,
    variance_of,
    worth_of,
)
from controller.safety.causes import EVENTS, Cause
from plant.imu import ACCELEROMETER, GYROSCOPE

RATE_HZ, LIMIT = 1000.0, 1.5
USED = np.ones(7, np.int64)


@pytest.fixture
def shaking():
    return np.zeros((), STATE)[()]


class Teller:
    """What is told, cycle by cycle."""

    def __init__(self, state, rate=RATE_HZ):
        self.state, self.parameters = state, shaking_parameters(LIMIT, rate)[()]
        self.cycles = 0

    def step(self, excess=None, clipped=(), used=USED, missed=0):
        events = np.zeros((), EVENTS)[()]
        self.state["excess"] = 0.0
        for imu, value in (excess or {}).items():
            self.state["excess"][ACCELEROMETER, imu] = value
        self.state["clipped"] = 0
        for imu in clipped:
            self.state["clipped"][ACCELEROMETER, imu] = 1
        tell_shaking(self.parameters, self.state, used, missed, events)
        self.cycles += 1 + missed
        count = int(events["count"])
        told = zip(*(events[name][:count] for name in ("cause", "index", "value")), strict=True)
        return [(Cause(int(cause)), int(index), float(value)) for cause, index, value in told]


def test_a_shock_is_as_uncertain_as_it_is_large_and_fades_as_a_low_pass_does(shaking):
    nominal, explained = 0.16, 0.2
    note_force(shaking, 2, 9.0 * explained, explained, 1e-3)
    assert variance_of(shaking, ACCELEROMETER, 2, nominal) == nominal and worth_of(shaking, ACCELEROMETER, 2, nominal) == 1.0
    note_force(shaking, 2, 30.0**2, explained, 1e-3)
    assert variance_of(shaking, ACCELEROMETER, 2, nominal) == pytest.approx(nominal + 900.0 - 9.0 * explained)
    assert worth_of(shaking, ACCELEROMETER, 2, nominal) == pytest.approx(nominal / (nominal + 898.2))
    # The gyroscope and the other IMUs are as they were.
    assert variance_of(shaking, GYROSCOPE, 2, nominal) == variance_of(shaking, ACCELEROMETER, 1, nominal) == nominal
    cycles = 0
    while shaking["excess"][ACCELEROMETER, 2] > 0.0:
        note_force(shaking, 2, 0.0, explained, 1e-4)
        cycles += 1
    assert cycles * 1e-4 == pytest.approx(MEMORY_S * np.log(1.0 + 898.2 / explained), rel=0.05)


def test_what_passes_on_average_counts_beyond_what_is_explained(shaking):
    """Of a vibration, readings that are near zero by chance; between shocks there is nothing."""
    explained, nominal, random = 0.2, 0.16, np.random.default_rng(0)
    for _ in range(3000):
        note_force(shaking, 0, random.uniform(0.0, 9.0 * explained), explained, 1e-3)
        note_force(shaking, 1, random.uniform(0.0, 0.5 * explained) if random.random() < 0.9 else 900.0, explained, 1e-2)
    assert variance_of(shaking, ACCELEROMETER, 0, nominal) - nominal == pytest.approx(3.5 * explained, rel=0.2)
    assert variance_of(shaking, GYROSCOPE, 0, nominal) == nominal
    assert shaking["passed"][1] < 0.5 * explained and shaking["hidden"][1] == 0.0


@pytest.mark.parametrize("sensor", [GYROSCOPE, ACCELEROMETER])
def test_a_clipped_reading_says_nothing(shaking, sensor):
    shaking["clipped"][sensor, 4] = 1
    assert variance_of(shaking, sensor, 4, 0.1) == SAYS_NOTHING + 0.1
    assert variance_of(shaking, 1 - sensor, 4, 0.1) == variance_of(shaking, sensor, 3, 0.1) == 0.1


def test_a_gyroscope_counts_less_by_what_it_reads_beyond_the_motion_so_far(shaking):
    explained, nominal = 1e-5, 4e-6
    note_rate(shaking, 4, 9.0 * explained, explained, 1e-3)
    assert variance_of(shaking, GYROSCOPE, 4, nominal) == nominal
    note_rate(shaking, 4, 0.01, explained, 1e-3)
    assert variance_of(shaking, GYROSCOPE, 4, nominal) == pytest.approx(nominal + 0.01 - 9.0 * explained)
    assert variance_of(shaking, ACCELEROMETER, 4, nominal) == variance_of(shaking, GYROSCOPE, 3, nominal) == nominal
    # Of a motion that a shaken accelerometer has bent, the gyroscope is the better witness.
    shaking["mean"][4] = 1.0
    note_rate(shaking, 4, 0.01, explained, 1e-3)
    assert variance_of(shaking, GYROSCOPE, 4, nominal) == nominal


def test_a_mean_force_that_is_no_motion_counts_and_is_told_at_once(shaking):
    teller = Teller(shaking)
    shaking["no_motion"][2] = 10.0
    assert variance_of(shaking, ACCELEROMETER, 2, 0.16) == 10.16 and variance_of(shaking, GYROSCOPE, 2, 0.16) == 0.16
    ((cause, imu, value),) = teller.step()
    assert (cause, imu) == (Cause.SHAKEN, 2) and value == pytest.approx(np.sqrt(10.0))
    assert all(not teller.step() for _ in range(2000))
    shaking["no_motion"] = 0.0
    told = [event for _ in range(1100) for event in teller.step()]
    assert [cause for cause, *_ in told] == [Cause.CALM]


def test_vibration_is_told_once_with_its_size_and_once_when_it_is_over(shaking):
    teller, told = Teller(shaking), []
    for _ in range(500):
        told += teller.step({5: 16.0, 3: 9.0})
    ((cause, imu, value),) = told
    assert (cause, imu) == (Cause.SHAKEN, 5) and LIMIT < value < 1.02 * LIMIT
    assert teller.state["mean"][5] == pytest.approx(16.0 * -np.expm1(-500 / 300), rel=0.01)
    assert shaking["told"] or shaking["bridging"]
    told, began = [], teller.cycles
    while not told:
        assert shaking["told"] or shaking["bridging"]
        told += teller.step()
    assert [cause for cause, *_ in told] == [Cause.CALM] and not (shaking["told"] or shaking["bridging"])
    fading = 0.3 * np.log(16.0 * -np.expm1(-500 / 300) / (0.5 * LIMIT) ** 2)
    assert (teller.cycles - began) / RATE_HZ == pytest.approx(fading + CALM_S, abs=0.01)
    assert all(not teller.step() for _ in range(3000))


def test_bridged_readings_are_told_once_until_all_is_calm(shaking):
    teller = Teller(shaking)
    assert [cause for cause, *_ in teller.step(clipped=[2])] == [Cause.BRIDGED]
    for _ in range(20):
        assert all(not teller.step(clipped=[2]) for _ in range(3))
        assert all(not teller.step() for _ in range(900))
    told = [event for _ in range(200) for event in teller.step()]
    assert [cause for cause, *_ in told] == [Cause.CALM]
    assert [cause for cause, *_ in teller.step(clipped=[0])] == [Cause.BRIDGED]


def test_an_imu_that_is_not_used_shakes_nobody(shaking):
    teller, used = Teller(shaking), USED.copy()
    used[3] = 0
    assert all(not teller.step({3: 1e3}, clipped=[3], used=used) for _ in range(1000))


def test_clipped_readings_are_bridged_for_50_ms_and_again_when_as_many_were_good(shaking):
    p = shaking_parameters(LIMIT, RATE_HZ)[()]

    def step(clipped, missed=0, used=1):
        shaking["clipped"][GYROSCOPE, 1] = clipped
        return bridges(p, shaking, 1, used, missed)

    assert all(step(1) for _ in range(50)) and not step(1)
    assert step(0) and step(0) and step(1) and not step(1)
    # A third of the readings may be clipped forever, two thirds not.
    shaking["clipped_for"] = 0
    assert all(step(i % 3 == 0) for i in range(3000))
    assert not all(step(i % 3 != 0) for i in range(3000))
    # Missed periods count, and what is left out is not bridged.
    shaking["clipped_for"] = 0
    assert not step(1, missed=50)
    shaking["clipped_for"] = 0
    assert not step(1, used=0)
