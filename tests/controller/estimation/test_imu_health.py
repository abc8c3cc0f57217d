"""Which IMUs are used: every limit on both of its sides, what is told, and when an IMU comes back."""

from unittest.mock import ANY

import numpy as np
import pytest

from controller.calibration.file import Calibration
from controller.cycle import STATE, CycleStage, cycle_parameters
from controller.estimation.imu_health import END_OF_RANGE, imu_parameters
from controller.safety.causes import Cause
from controller.settings import FusionSettings, SafetySettings, control_settings, fusion_settings
from plant.imu import ACCELEROMETER, GYROSCOPE, MAGNETOMETER, PRESETS
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import load_in_space
from tests.controller.cycles import run_stages

RATE_HZ = 500.0
FROZEN, HEALTHY, STALE, BRIDGED = 5, 10, 5, 25
"""How many cycles the durations last at this rate."""


class Screening:
    """The screening alone, on readings of which every one is new."""

    def __init__(self, mechanism, imus=ALL_IMUS, safety=None, cycle=0, **choices):
        settings = control_settings(mechanism), fusion_settings(mechanism)
        self.parameters = cycle_parameters(mechanism, RATE_HZ, *settings, imus, safety=safety, **choices)
        self.state = np.zeros((), STATE)
        self.random = np.random.default_rng(0)
        self.state["time"]["cycle"] = cycle
        self.last = self.reading()

    def reading(self):
        """A quiet reading (3, 7, 3), a little different each time."""
        return self.random.uniform(-1e-3, 1e-3, (3, 7, 3))

    def step(self, spoil=lambda reading: None, missed=0, age=(), silent=0):
        """A cycle; what it has told: cause, IMU, value and limit."""
        state, time = self.state, self.state["time"]
        time["missed"] = missed
        time["cycle"] += missed
        state["safety"]["watch"]["silent"] = silent
        state["imus"]["sample_age"] = 0
        for imu, cycles in age:
            state["imus"]["sample_age"][imu] = cycles
        before, self.last = self.last, self.reading()
        self.before = before
        spoil(self.last)
        run_stages(self.parameters, state, self.last, CycleStage.SCREENING)
        time["cycle"] += 1
        events = state["safety"]["events"]
        told = [tuple(events[name][i] for name in ("cause", "index", "value", "limit")) for i in range(int(events["count"]))]
        events["count"] = 0
        return told

    def leave_stale(self, imu, answers):
        """Answers of the rig without a new sample of this IMU; what they have told."""
        return [told for age in range(1, answers + 1) for told in self.step(age=[(imu, age)])]

    @property
    def used(self):
        return np.flatnonzero(self.state["imus"]["used"]).tolist()

    def without(self, *imus):
        return [imu for imu in ALL_IMUS if imu not in imus]


@pytest.fixture
def settled(hexapod):
    """After twice the time of recovery, with all IMUs in use."""
    screening = Screening(hexapod)
    for _ in range(2 * HEALTHY):
        assert screening.step() == []
    return screening


@pytest.mark.parametrize(
    ("rate", "noise", "smoothing", "cycles"),
    [
        (4000.0, 1.0, 1.0 / 80.0, (40, 80, 40)),
        (1000.0, 1.0, 0.05, (10, 20, 10)),
        (400.0, 1.0, 0.05, (4, 8, 4)),
        (200.0, 4.0, 0.05, (3, 4, 3)),
        (50.0, 64.0, 0.05, (3, 1, 3)),
    ],
)
def test_the_constants_are_those_of_the_settings_in_cycles_of_the_rate(rate, noise, smoothing, cycles):
    fusion = FusionSettings(gyroscope_range=3.0, accelerometer_range=70.0)
    safety = SafetySettings(gyroscope_noise=0.2, accelerometer_noise=7.0)
    calibration = Calibration()
    found = imu_parameters((1, 4, 6), calibration.gain, calibration.offset, fusion, safety, rate)
    assert found["present"].tolist() == [0, 1, 0, 0, 1, 0, 1]
    assert found["range"].tolist() == [3.0, 70.0]
    np.testing.assert_allclose(found["noise"], [0.2 * noise, 7.0 * noise], rtol=1e-12)
    assert found["noise_smoothing"] == pytest.approx(smoothing, rel=1e-12)
    assert tuple(int(found[name]) for name in ("frozen_cycles", "healthy_cycles", "stale_cycles")) == cycles


def test_every_sample_is_calibrated_by_its_own_constants(hexapod):
    """Gains that are not symmetric, of three sensors and seven IMUs, against NumPy and the same calibration offline."""
    random = np.random.default_rng(1)
    calibration = Calibration(gain=random.normal(size=(3, 7, 3, 3)), offset=random.normal(size=(3, 7, 3)))
    screening = Screening(hexapod, calibration=calibration)
    screening.step()
    found = screening.state["imus"]["sample"]
    by_hand = np.einsum("skij,skj->ski", calibration.gain, screening.last) + calibration.offset
    np.testing.assert_allclose(found, by_hand, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(found, calibration.apply(screening.last), rtol=0.0, atol=1e-14)
    np.testing.assert_array_equal(screening.state["imus"]["raw"], screening.last)


@pytest.mark.parametrize("imu", ALL_IMUS)
def test_a_stale_sample_is_left_out_from_its_limit_on_unless_the_whole_rig_is_silent(settled, imu):
    assert settled.leave_stale(imu, STALE - 1) == []
    assert settled.step(age=[(imu, STALE + 7)], silent=1) == []
    assert settled.used == list(ALL_IMUS)
    assert settled.step(age=[(imu, STALE + 8)]) == [(Cause.IMU_STALE, imu, STALE, STALE)]
    assert settled.used == settled.without(imu)
    # It is told once.
    assert settled.step(age=[(imu, STALE + 9)]) == []


@pytest.mark.parametrize("held_up", [{"silent": 10 * STALE}, {"missed": 10 * STALE}])
def test_imus_that_answer_later_than_another_after_a_pause_are_not_left_out(settled, held_up):
    """A bus or a loop that was held up goes on: at first one IMU is heard, then the others, one by one."""
    everyone = [(imu, 10 * STALE) for imu in ALL_IMUS]
    assert settled.step(age=everyone, silent=held_up.get("silent", 0), missed=held_up.get("missed", 0)) == []
    for heard in range(1, STALE - 1):
        assert settled.step(age=everyone[heard:]) == []
    assert settled.step() == []
    assert settled.used == list(ALL_IMUS)


@pytest.mark.parametrize("imu", ALL_IMUS)
def test_an_imu_that_stands_still_while_another_moves_is_left_out_from_its_limit_on(settled, imu):
    def freeze(reading):
        reading[:2, imu] = settled.before[:2, imu]

    def freeze_all(reading):
        reading[:2] = settled.before[:2]

    for _ in range(FROZEN - 1):
        assert settled.step(freeze) == []
    # When nothing moves, that says nothing of this IMU.
    for _ in range(20):
        assert settled.step(freeze_all) == []
    assert settled.step(freeze) == [(Cause.IMU_FROZEN, imu, FROZEN, FROZEN)]
    assert settled.used == settled.without(imu)


def test_rounding_does_not_show_that_others_live(settled):
    """A simulated rig at rest, whose IMUs have no noise: some readings change by their last digits, and others do not."""

    def round_off(reading):
        reading[:2] = settled.before[:2]
        reading[0, 3, 1] += 1e-12 if settled.state["time"]["cycle"] % 2 else -1e-12

    for _ in range(10 * FROZEN):
        assert settled.step(round_off) == []
    assert settled.used == list(ALL_IMUS)


def test_all_imus_are_frozen_when_none_changes_although_the_reference_moves(settled):
    def freeze(reading):
        reading[:2] = settled.before[:2]

    def cycles_until(speed, most=500, **given):
        settled.state["reference"]["motion"] = 0.0
        settled.step()
        settled.state["reference"]["motion"][4, 1] = speed
        for cycle in range(most):
            if told := settled.step(freeze, **given):
                return cycle, told
        return most, []

    # 1 mm takes 10 cycles of 0.2 mm and five more of being frozen, this and that way.
    assert cycles_until(0.0) == (500, [])
    for speed in (0.1, -0.1):
        assert cycles_until(speed, most=9) == (9, [])
        assert cycles_until(speed, silent=1) == (500, [])
    cycle, told = cycles_until(-0.1)
    assert [(cause, imu) for cause, imu, *_ in told] == [(Cause.IMU_FROZEN, imu) for imu in ALL_IMUS]
    assert cycle == pytest.approx(5 + FROZEN, abs=1) and settled.used == []


@pytest.mark.parametrize(("kind", "axis"), [(kind, axis) for kind in (GYROSCOPE, ACCELEROMETER) for axis in range(3)])
def test_one_number_that_changes_shows_that_an_imu_lives_and_its_magnetometer_does_not(settled, kind, axis):
    def freeze(reading):
        number = reading[kind, 2, axis]
        reading[:2, 2] = settled.before[:2, 2]
        reading[kind, 2, axis] = number

    for _ in range(2 * FROZEN):
        assert settled.step(freeze) == []
    for _ in range(FROZEN - 1):
        assert settled.step(lambda reading: reading[:2].__setitem__((slice(None), 2), settled.before[:2, 2])) == []
    # A life sign begins the count anew.
    assert settled.step(freeze) == []
    assert settled.state["imus"]["frozen_for"].tolist() == [0] * 7
    assert not (settled.last[MAGNETOMETER, 2] == settled.before[MAGNETOMETER, 2]).any()


def test_an_imu_that_is_not_there_does_not_show_that_others_stand_still(hexapod):
    screening = Screening(hexapod, imus=(0, 1, 2, 4, 5, 6))

    def freeze(reading):
        reading[:2, [0, 1, 2, 4, 5, 6]] = screening.before[:2, [0, 1, 2, 4, 5, 6]]

    screening.step()
    for _ in range(5 * FROZEN):
        assert screening.step(freeze) == []
    assert screening.used == [0, 1, 2, 4, 5, 6]


@pytest.mark.parametrize("imu", ["mpu9150", "icm42688-nominal"])
@pytest.mark.parametrize("sensor", ["gyroscope", "accelerometer"])
def test_the_largest_readings_of_12_bits_and_of_whole_steps_are_at_the_end_of_the_range(imu, sensor):
    """Of 12 bits, the largest is a step short of the range; whole steps may add up to a rounding less than the range."""
    errors = getattr(PRESETS[imu], sensor)
    in_steps = np.rint(errors.reach / errors.resolution) * errors.resolution
    assert END_OF_RANGE * errors.reach < min(in_steps, errors.reach * (1.0 - 2.0**-11))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("kind", "reach"), [(GYROSCOPE, np.radians(250.0)), (ACCELEROMETER, 4.0 * 9.80665)])
@pytest.mark.parametrize(("imu", "axis"), [(0, 0), (3, 1), (6, 2)])
def test_a_reading_is_in_range_below_the_limit_and_out_of_it_at_the_limit(hexapod, kind, reach, sign, imu, axis):
    # So large a reading in one cycle is noise, too.
    screening = Screening(hexapod, safety=SafetySettings(gyroscope_noise=1e3, accelerometer_noise=1e3))

    def spoil(share):
        return lambda reading: reading.__setitem__((kind, imu, axis), sign * share * reach)

    for _ in range(2 * HEALTHY):
        screening.step()
    assert screening.step(spoil(END_OF_RANGE - 1e-9)) == []
    # For 50 ms, others bridge it; that is told once.
    ((cause, at, *_),) = screening.step(spoil(1.0))
    assert (cause, at) == (Cause.BRIDGED, imu) and screening.used == list(ALL_IMUS)
    for _ in range(BRIDGED - 1):
        assert screening.step(spoil(1.0)) == []
    ((cause, at, value, limit),) = screening.step(spoil(1.5))
    assert (cause, at, limit) == (Cause.IMU_OUT_OF_RANGE, imu, END_OF_RANGE) and screening.used == screening.without(imu)
    assert value == pytest.approx(1.5, rel=1e-12)
    # While it is left out, one such reading begins the wait anew.
    for _ in range(HEALTHY):
        screening.step()
    assert screening.step(spoil(1.0)) == []
    for _ in range(HEALTHY):
        assert screening.step() == []
    assert screening.step() == [(Cause.IMU_BACK, imu, ANY, ANY)]
    ((cause, at, value, limit),) = screening.step(spoil(np.nan))
    assert (cause, at) == (Cause.IMU_NOT_FINITE, imu)
    assert np.isnan(value) and np.isnan(limit)
    # Nothing is the range of the magnetometer.
    for _ in range(2 * HEALTHY):
        screening.step()
    for wrong in (1e9, np.nan):
        assert screening.step(lambda reading, wrong=wrong: reading.__setitem__((MAGNETOMETER, imu, axis), wrong)) == []


@pytest.mark.parametrize("missed", [0, 1, 3, 30])
def test_an_imu_comes_back_when_it_has_been_healthy_for_so_long_missed_periods_counted(settled, missed):
    imu = 4
    settled.leave_stale(imu, STALE)
    healthy = 0
    while imu not in settled.used:
        told = settled.step(missed=missed)
        healthy += 1 + missed
        assert told == ([(Cause.IMU_BACK, imu, pytest.approx(np.nan, nan_ok=True), pytest.approx(np.nan, nan_ok=True))]
                        if healthy > HEALTHY else [])  # fmt: skip
        assert (imu in settled.used) == (healthy > HEALTHY)
    # A relapse on the way begins the count anew.
    settled.leave_stale(imu, STALE)
    for _ in range(HEALTHY):
        settled.step()
    settled.leave_stale(imu, STALE)
    for _ in range(HEALTHY):
        assert settled.step() == []
        assert settled.used == settled.without(imu)
    assert [cause for cause, *_ in settled.step()] == [Cause.IMU_BACK]


def test_in_the_first_cycle_the_healthy_ones_are_used_at_once_and_the_others_are_told(hexapod):
    screening = Screening(hexapod, imus=(0, 1, 2, 3, 4, 6))

    def spoil(reading):
        reading[ACCELEROMETER, [2, 5]] = np.nan

    # IMU 5 is not there, which is no news.
    assert [(cause, imu) for cause, imu, *_ in screening.step(spoil)] == [(Cause.IMU_NOT_FINITE, 2)]
    assert screening.used == [0, 1, 3, 4, 6]
    assert screening.step(spoil) == []
    for _ in range(HEALTHY):
        assert screening.step() == []
        assert screening.used == [0, 1, 3, 4, 6]
    assert [(cause, imu) for cause, imu, *_ in screening.step()] == [(Cause.IMU_BACK, 2)]
    assert screening.used == [0, 1, 2, 3, 4, 6]


def test_an_imu_that_contradicted_the_others_stays_out(settled):
    settled.state["imus"]["excluded"][3] = 1
    for _ in range(5 * HEALTHY):
        assert settled.step() == []
        assert settled.used == settled.without(3)


def alternating(screening, amplitudes):
    """A spoiler: accelerometers that swing from sample to sample, whose second differences are four times as large."""
    sign = -1.0 if screening.state["time"]["cycle"] % 2 else 1.0

    def spoil(reading):
        reading[ACCELEROMETER] = sign * np.asarray(amplitudes)[:, None]

    return spoil


@pytest.mark.parametrize("kind", [GYROSCOPE, ACCELEROMETER])
def test_noise_is_measured_as_its_rms_over_the_limit(hexapod, kind):
    limits = (0.4, 3.0)
    safety = SafetySettings(gyroscope_noise=limits[0], accelerometer_noise=limits[1])
    screening, random, found = Screening(hexapod, safety=safety), np.random.default_rng(2), []

    def spoil(reading):
        # A slow motion is none; the share of the limit differs from IMU to IMU.
        swing = np.sin(2.0 * np.pi * screening.state["time"]["cycle"] / RATE_HZ)
        shares = 0.1 * np.arange(1, 8)[:, None]
        reading[kind] = limits[kind] * (0.5 * swing + shares * random.normal(size=(7, 3)))

    for k in range(1500):
        screening.step(spoil)
        if k > 200:
            found.append(screening.state["imus"]["noise"] ** 2)
    np.testing.assert_allclose(np.sqrt(np.mean(found, axis=0)), 0.1 * np.arange(1, 8), rtol=0.1)


def noisy(mechanism, amplitudes, cycles=200, **choices):
    """What has been told when accelerometers swing by these shares (7,) of their limit."""
    screening, told = Screening(mechanism, **choices), []
    limit = screening.parameters["imus"]["noise"][ACCELEROMETER]
    for _ in range(cycles):
        # Second differences of +-a are 4 a, and noise of this RMS has those of sqrt(6) times it.
        told += screening.step(alternating(screening, np.asarray(amplitudes) * limit * np.sqrt(6.0) / 4.0))
    return told, screening


@pytest.mark.parametrize("imu", [0, 5, 6])
def test_an_imu_is_noisy_beyond_the_limit_and_three_times_what_the_others_are(hexapod, imu):
    def told(one, others):
        shares = np.full(7, others)
        shares[imu] = one
        return noisy(hexapod, shares)[0]

    assert told(0.98, 0.0) == []
    ((cause, at, value, limit),) = told(1.02, 0.0)
    assert (cause, at, limit) == (Cause.IMU_NOISY, imu, 1.0)
    assert 1.0 < value < 1.02
    # The mean of the six others, not of seven, and not with its own.
    assert told(2.95, 1.0) == []
    assert [(cause, at) for cause, at, *_ in told(3.05, 1.0)] == [(Cause.IMU_NOISY, imu)]
    # What shakes all of them is no fault of one.
    assert told(5.0, 5.0) == []


@pytest.mark.parametrize("remembers", [True, False])
def test_samples_that_beat_with_a_vibration_are_no_fault_of_one_imu(hexapod, remembers):
    """Each IMU, on a clock of its own, looks quiet most of the time: without a memory, one of them would look noisy."""
    screening, told = Screening(hexapod), []
    if not remembers:
        screening.parameters["imus"]["remembering"] = 0.0
    limit = screening.parameters["imus"]["noise"][ACCELEROMETER]
    for cycle in range(4000):
        beats = np.maximum(np.cos(2.0 * np.pi * (0.5 * cycle / RATE_HZ + np.arange(7) / 7.0)), 0.0) ** 8
        if cycle == 1000:
            told.clear()
        told += screening.step(alternating(screening, 1.5 * beats * limit * np.sqrt(6.0) / 4.0))
    assert bool([cause for cause, *_ in told if cause == Cause.IMU_NOISY]) == (not remembers)


def test_what_one_imu_was_shaken_by_long_ago_hides_no_noise_of_another(hexapod):
    screening, told = Screening(hexapod), []
    limit = screening.parameters["imus"]["noise"][ACCELEROMETER] * np.sqrt(6.0) / 4.0
    shares = np.full(7, 1.0)
    for cycle in range(5000):
        shares[:] = 1.0 if cycle < 500 else 0.0
        shares[4] = 2.0 if cycle >= 500 else 1.0
        for cause, imu, *_ in screening.step(alternating(screening, shares * limit)):
            told.append((cycle, cause, imu))
    # The others fade from 1 to 2 / 3 within 5 ln 1.5 = 2.03 s.
    ((cycle, cause, imu),) = [each for each in told if each[1] == Cause.IMU_NOISY]
    assert imu == 4 and (cycle - 500) / RATE_HZ == pytest.approx(2.03, abs=0.1)


def test_no_imu_is_taken_back_while_imus_are_shaken(settled):
    """A filter would begin with a force that is not gravity."""
    settled.leave_stale(3, STALE)
    assert settled.used == settled.without(3)
    for _ in range(5 * HEALTHY):
        settled.state["imus"]["shaking"]["told"] = 1
        assert not [cause for cause, *_ in settled.step() if cause == Cause.IMU_BACK]
        assert settled.used == settled.without(3)
    settled.state["imus"]["shaking"]["told"] = 0
    assert [(cause, imu) for cause, imu, *_ in settled.step()] == [(Cause.IMU_BACK, 3)]
    assert settled.used == list(ALL_IMUS)


def test_a_planar_mechanism_compares_an_imu_with_three_others():
    rig = load_in_space("planar-3rpr")
    shares = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    for one, causes in ((2.9, []), (3.1, [Cause.IMU_NOISY])):
        shares[1] = one
        told, _ = noisy(rig, shares)
        assert [cause for cause, *_ in told] == causes
