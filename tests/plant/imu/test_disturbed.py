"""Disturbed IMUs against physics and a slow twin: vibration, shocks, rectification, clocks, temperature, loosening."""

from dataclasses import replace
from math import inf, pi, radians, sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete, lfilter
from scipy.spatial.transform import Rotation

from plant.errors import InputError
from plant.imu import (
    ACCELEROMETER,
    GYROSCOPE,
    MAGNETOMETER,
    MOST_DISTURBANCES,
    ImuModel,
    SensorErrors,
    add_disturbances,
    imu_state,
    load_imu,
    measure,
)
from plant.imu_disturbances import Course, DisturbanceKind, disturbance_of_text
from plant.pose import Array

G = 9.80665
PERIOD = 1e-3


def run(state: Any, ideal: Array) -> tuple[Array, Array, Array]:
    """Readings (N, 3, 7, 3), the number of new samples (N, 7), and their times (N, 7) [s]."""
    measured, fresh, times = np.empty_like(ideal), np.empty((len(ideal), 7), int), np.empty((len(ideal), 7))
    for n, signal in enumerate(ideal):
        measure(state, signal, measured[n])
        fresh[n], times[n] = state["fresh"][:7], state["sampled_at"][:7]
    return measured, fresh, times


def disturbed(model: ImuModel, *texts: str, seed: int = 0, period: float = PERIOD) -> Any:
    state = imu_state(model, seed, period)
    add_disturbances(state, map(disturbance_of_text, texts))
    return state


def at_rest(cycles: int) -> Array:
    """Signals of IMUs that stand upright: gravity along z, nothing else."""
    signals = np.zeros((cycles, 3, 7, 3))
    signals[:, ACCELEROMETER, :, 2] = G
    return signals


def filtered(bandwidth: float = inf, order: int = 1, conversion_rate: float = 0.0, **errors: Any) -> ImuModel:
    sensor = SensorErrors(bandwidth=bandwidth, order=order, **errors)
    return ImuModel("filtered", gyroscope=sensor, accelerometer=sensor, conversion_rate=conversion_rate)


def tone(signal: Array, frequency: float, period: float = PERIOD) -> float:
    """The amplitude of a sine of this frequency in a signal, beside a constant."""
    phase = 2.0 * pi * frequency * period * np.arange(len(signal))
    fitted = np.linalg.lstsq(np.stack([np.sin(phase), np.cos(phase), np.ones_like(phase)], axis=1), signal, rcond=None)[0]
    return float(np.hypot(*fitted[:2]))


# ---- vibration ----


@pytest.mark.parametrize("frequency", [37.0, 480.0, 999.9, 1010.0, 2995.0])
def test_vibration_without_a_low_pass_appears_at_its_alias_with_its_whole_amplitude(frequency: float) -> None:
    state = disturbed(ImuModel("bare"), f"imu-vibration:all,axis=x,size_g=1,sine_hz={frequency}")
    alias = abs(frequency - 1000.0 * round(frequency / 1000.0))
    seconds = 10.0 if alias < 1.0 else 1.0
    read = run(state, at_rest(round(1000 * seconds)))[0][:, ACCELEROMETER, 4, 0]
    assert tone(read, alias) == pytest.approx(G, rel=1e-6)
    assert np.abs(read).max() <= G * (1.0 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2, 4])
@pytest.mark.parametrize("frequency", [90.0, 700.0, 999.9])
def test_oversampling_weighs_the_alias_as_the_low_pass_does(order: int, frequency: float) -> None:
    """Sections of first order in continuous time: 1 / |1 + j f / f_s|^n, and 3 dB at the bandwidth in all."""
    bandwidth = 260.0
    model = filtered(bandwidth, order, conversion_rate=32000.0)
    state = disturbed(model, f"imu-vibration:all,axis=x,size_g=1,sine_hz={frequency}")
    read = run(state, at_rest(10500))[0][500:, ACCELEROMETER, 2, 0]
    section = bandwidth / sqrt(2.0 ** (1.0 / order) - 1.0)
    expected = G / sqrt(1.0 + (frequency / section) ** 2) ** order
    assert tone(read, abs(frequency - 1000.0 * round(frequency / 1000.0))) == pytest.approx(expected, rel=0.02)
    assert 1.0 / sqrt(1.0 + (bandwidth / section) ** 2) ** order == pytest.approx(sqrt(0.5))


def test_conversions_alias_as_well_before_the_low_pass() -> None:
    """A vibration near the rate of the conversions passes the digital low-pass at its alias."""
    model = filtered(260.0, 2, conversion_rate=8000.0)
    read = run(disturbed(model, "imu-vibration:all,axis=x,size_g=1,sine_hz=7990"), at_rest(3000))[0]
    assert tone(read[1000:, ACCELEROMETER, 0, 0], 10.0) == pytest.approx(G, rel=0.01)


def test_vibration_is_rectified_by_its_mean_square() -> None:
    """Reading x + k x^2: a sine of amplitude A leaves k A^2 / 2, and 1.8 mg/g^2 is the ADXL357's limit."""
    rectification = 1.8e-3 / G
    model = filtered(100.0, 2, conversion_rate=16000.0, rectification=rectification)
    still = run(disturbed(model), at_rest(400))[0][-1, ACCELEROMETER, 0]
    shaken = run(disturbed(model, "imu-vibration:all,axis=z,size_g=10,sine_hz=400"), at_rest(4400))[0][400:, ACCELEROMETER, 0]
    assert shaken[:, 2].mean() - still[2] == pytest.approx(rectification * (10.0 * G) ** 2 / 2.0, rel=1e-3)
    assert shaken[:, 2].mean() - still[2] == pytest.approx(1.8e-3 * G * 50.0, rel=1e-3)
    np.testing.assert_allclose(shaken[:, :2], 0.0, atol=1e-12)


def test_a_conversion_beyond_the_range_is_clipped_before_the_low_pass() -> None:
    """What is clipped on one side leaves a bias that the filtered reading does not show as clipping."""
    model = filtered(50.0, 1, conversion_rate=32000.0, reach=2.0 * G)
    read = run(disturbed(model, "imu-vibration:all,axis=z,size_g=3,sine_hz=501.7"), at_rest(3000))[0][
        1000:, ACCELEROMETER, 0, 2
    ]
    phase = 2.0 * pi * (np.arange(64000) + 0.5) / 64000
    expected = np.clip(G + 3.0 * G * np.sin(phase), -2.0 * G, 2.0 * G).mean()
    assert read.mean() == pytest.approx(expected, abs=0.01)
    assert expected < G - 2.0 and np.abs(read).max() < 1.5 * G


# ---- shocks ----


def test_shocks_are_half_sines_that_repeat() -> None:
    state = disturbed(ImuModel("bare"), "imu-vibration:2+5,axis=z,size_g=3.5,pulse_ms=4,repeat_hz=20,at=0.1003,for=0.5")
    read = run(state, at_rest(1000))[0][:, ACCELEROMETER, :, 2] - G
    times = PERIOD * np.arange(1000)
    since = (times - 0.1003) % 0.05
    there = (times >= 0.1003) & (times < 0.6003) & (since < 0.004)
    expected = np.where(there, 3.5 * G * np.sin(pi * since / 0.004), 0.0)
    for imu in range(7):
        np.testing.assert_allclose(read[:, imu], expected if imu in (2, 5) else 0.0, atol=1e-6)
    assert there.sum() == 40


def test_a_low_pass_keeps_the_impulse_of_a_shock() -> None:
    model = filtered(40.0, 3, conversion_rate=16000.0)
    state = disturbed(model, "imu-vibration:all,axis=x,size_g=50,pulse_ms=0.5,at=0.0502")
    read = run(state, at_rest(300))[0][:, ACCELEROMETER, 0, 0]
    assert read.sum() * PERIOD == pytest.approx(50.0 * G * 0.5e-3 * 2.0 / pi, rel=2e-3)
    assert 0.0 < read.max() < 0.3 * 50.0 * G


# ---- clocks ----


def test_a_clock_of_its_own_samples_at_its_rate_and_phase() -> None:
    model = ImuModel("own", sample_rate=1000.0, clock_error=0.01)
    state = imu_state(model, 3, PERIOD)
    rates = state["rate"][:7].copy()
    cycles = 20000
    _, fresh, times = run(state, at_rest(cycles))
    assert np.all(np.abs(rates / 1000.0 - 1.0) <= 0.01) and np.ptp(rates) > 5.0
    # As many samples as the clock has ticks; never more than two a cycle.
    np.testing.assert_allclose(fresh.sum(axis=0), rates * cycles * PERIOD, atol=2.0)
    assert fresh.max() == 2 and fresh.min() == 0
    for imu in range(7):
        distinct = np.unique(times[1:, imu])
        gaps = np.diff(distinct)
        # Slow clocks: each tick is seen; of fast ones some pass between two cycles.
        np.testing.assert_allclose(gaps / np.rint(gaps * rates[imu]), 1.0 / rates[imu], rtol=1e-6)
    first = times[1:4].max(axis=0) * rates % 1.0
    assert np.ptp(first) > 0.3, "phases differ"


def test_the_loop_reads_the_latest_sample() -> None:
    """Every reading is the signal at the time that is told of its sample, which is at most one sample old."""
    model = ImuModel("own", sample_rate=700.0, clock_error=0.01, jitter=5e-5)
    signals = np.broadcast_to(PERIOD * np.arange(2000.0)[:, None, None, None], (2000, 3, 7, 3)).copy()
    read, _, times = run(imu_state(model, 1, PERIOD), signals)
    np.testing.assert_allclose(read[:, GYROSCOPE, :, 0], times, atol=1e-12)
    age = PERIOD * np.arange(2000)[:, None] - times
    assert age.min() >= 0.0 and age[10:].max() < 1.0 / 693.0 + 5e-4


@pytest.mark.parametrize("rate", [250.0, 1000.0, 4000.0])
def test_a_clock_told_to_halve_its_rate_gives_every_other_cycle_a_new_sample(rate: float) -> None:
    state = disturbed(ImuModel("bare"), "imu-clock:3,size_percent=-50,at=0.1", period=1.0 / rate)
    fresh = run(state, at_rest(round(rate)))[1]
    begun = round(0.1 * rate) + 3
    assert (fresh[:, [0, 1, 2, 4, 5, 6]] == 1).all() and (fresh[: begun - 4, 3] == 1).all()
    np.testing.assert_array_equal(np.unique(fresh[begun:, 3].reshape(-1)), [0, 1])
    assert fresh[begun:, 3].mean() == pytest.approx(0.5, abs=2.0 / rate)


def test_clocks_that_together_would_stand_still_go_on_slowly() -> None:
    state = disturbed(ImuModel("bare"), "imu-clock:3,size_percent=-60,at=0.0105", "imu-clock:3,size_percent=-60,at=0.0105")
    fresh = run(state, at_rest(2100))[1]
    assert fresh[11:, 3].sum() == 2 and fresh[:, 4].sum() == 2100


def test_jitter_is_that_of_a_half_normal_distribution_and_reproducible() -> None:
    state, again = (disturbed(ImuModel("bare"), "imu-jitter:1,size_ms=0.05") for _ in range(2))
    _, _, times = run(state, at_rest(8000))
    early = PERIOD * np.arange(1, 8000) - times[1:, 1]
    assert np.sqrt(np.mean(early**2)) == pytest.approx(5e-5, rel=0.03) and early.min() >= 0.0
    assert early.mean() == pytest.approx(5e-5 * sqrt(2.0 / pi), rel=0.03)
    np.testing.assert_allclose(times[:, [0, 2, 3, 4, 5, 6]], np.broadcast_to(PERIOD * np.arange(8000)[:, None], (8000, 6)))
    # A cycle can be made again on its own.
    again["cycle"], again["time"], again["before"] = 4321, 4.321, 4.320
    np.testing.assert_allclose(run(again, at_rest(3))[2][:, 1], times[4321:4324, 1], atol=1e-12)


def test_noise_keeps_its_density_with_oversampling_and_a_clock_of_its_own() -> None:
    """Of the white noise of conversions, the low-pass leaves the density over its noise bandwidth."""
    density, bandwidth = 0.02, 40.0
    for own in (0.0, 900.0):
        model = replace(filtered(bandwidth, 1, conversion_rate=8.0 * (own or 1000.0), noise=density), sample_rate=own)
        noise = run(imu_state(model, 5, PERIOD), np.zeros((6000, 3, 7, 3)))[0][200:, :2]
        assert noise.std() == pytest.approx(density * sqrt(bandwidth * pi / 2.0), rel=0.03)
        assert np.abs(np.corrcoef(noise.reshape(len(noise), -1).T) - np.eye(42)).max() < 0.25


# ---- temperature and supply ----


def test_temperature_moves_bias_and_scale_with_its_time_constant() -> None:
    model = load_imu("icm42688")
    quiet = {
        name: replace(getattr(model, name), noise=0.0, resolution=0.0, bias=(0.0, 0.0), scale=0.0)
        for name in ("gyroscope", "accelerometer")
    }
    model = replace(model, **quiet)
    signals = np.zeros((4000, 3, 7, 3))
    warm = run(disturbed(model, "imu-temperature:all,size_k=20,settle_s=1,at=0.5", seed=4), signals)[0]
    np.testing.assert_array_equal(warm[:400, :2], 0.0)
    course = warm[2500, GYROSCOPE] / warm[3500, GYROSCOPE]
    np.testing.assert_allclose(course, (1.0 - np.exp(-2.0)) / (1.0 - np.exp(-3.0)), rtol=1e-3)
    # The scale: what doubles with the signal.
    constants = [run(disturbed(model, "imu-temperature:all,size_k=20", seed=4), signals[:50] + c)[0][-1] for c in (0.0, 1.0)]
    scale = (constants[1] - constants[0] - 1.0)[:2] / 20.0
    assert 0.0 < np.abs(scale).max() <= 5e-5 and np.ptp(scale) > 0.0


def test_drifts_have_a_common_and_an_individual_part() -> None:
    """Over seeds: the common part is the same for all IMUs and has its magnitude, the individual ones are spread around it."""
    sensor = SensorErrors(bias_per_kelvin=(3.0, 1.0), bias_per_volt=(0.0, 2.0), scale_per_kelvin=(0.1, 0.0))
    states = [imu_state(ImuModel("drifting", gyroscope=sensor), seed, PERIOD) for seed in range(60)]
    drift = np.array([state["bias_per_kelvin"][GYROSCOPE] for state in states])
    assert np.linalg.norm(drift.mean(axis=1), axis=1).mean() == pytest.approx(3.0, abs=0.1)
    assert np.linalg.norm(drift - drift.mean(axis=1, keepdims=True), axis=2).max() <= 2.0
    per_volt = np.linalg.norm([state["bias_per_volt"][GYROSCOPE] for state in states], axis=2)
    assert per_volt.max() <= 2.0 and per_volt.mean() == pytest.approx(1.0, abs=0.1)
    scale = np.array([state["scale_per_kelvin"][GYROSCOPE] for state in states])
    np.testing.assert_array_equal(scale, np.repeat(scale[:, :1], 8, axis=1))
    assert 0.08 < np.abs(scale).max() <= 0.1


def test_a_step_of_the_supply_is_a_step_of_every_bias() -> None:
    state = disturbed(load_imu("mpu9150"), "imu-supply:all,size_v=0.1,at=1.9995", seed=2)
    read = run(state, at_rest(4000))[0]
    step = read[2000:].mean(axis=0) - read[:2000].mean(axis=0)
    assert np.linalg.norm(step[GYROSCOPE], axis=1).max() <= radians(0.2) * 1.1
    assert np.linalg.norm(step[GYROSCOPE].mean(axis=0)) > radians(0.05), "a part is common"


# ---- loosening, stuck axes, scales, offsets ----


def test_an_imu_that_loosens_reads_in_its_turned_axes() -> None:
    state = disturbed(ImuModel("bare"), "imu-turn:6,axis=1/2/-1,size_deg=3,ramp_s=0.5,at=0.2")
    signals = np.random.default_rng(0).normal(size=(1000, 3, 7, 3))
    read = run(state, signals)[0]
    np.testing.assert_array_equal(read[:, :, :6], signals[:, :, :6])
    angles = np.radians(3.0) * np.clip((PERIOD * np.arange(1000) - 0.2) / 0.5, 0.0, 1.0)
    turned = Rotation.from_rotvec(angles[:, None] * np.array([1.0, 2.0, -1.0]) / sqrt(6.0))
    for sensor in range(3):
        np.testing.assert_allclose(read[:, sensor, 6], turned.inv().apply(signals[:, sensor, 6]), atol=1e-12)


def test_added_noise_has_its_size_and_is_keyed_by_seed_imu_and_conversion() -> None:
    texts = ("imu-noise:2+3,axis=y,size_g=0.3", "imu-noise:2,axis=all,size_ut=5")
    first, again, other = (run(disturbed(ImuModel("bare"), *texts, seed=seed), at_rest(5000))[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    noise = first - at_rest(5000)
    there = np.zeros((3, 7, 3), bool)
    there[ACCELEROMETER, 2:4, 1] = there[MAGNETOMETER, 2] = True
    assert (noise[:, ~there] == 0.0).all() and (first != other)[:, there].mean() > 0.99
    np.testing.assert_allclose(noise[:, there].std(axis=0), [0.3 * G, 0.3 * G, 5.0, 5.0, 5.0], rtol=0.05)
    assert np.abs(np.corrcoef(noise[:, there].T) - np.eye(5)).max() < 5.0 / sqrt(5000)
    # A cycle can be made again on its own, with other noise unchanged.
    late = disturbed(ImuModel("bare"), *texts, seed=1)
    late["cycle"] = 4000
    np.testing.assert_array_equal(run(late, at_rest(3))[0], first[4000:4003])
    healthy, noisy = (run(disturbed(load_imu("mpu9150"), *each, seed=1), at_rest(50))[0] for each in ((), texts))
    np.testing.assert_array_equal(healthy[:, GYROSCOPE], noisy[:, GYROSCOPE])


@pytest.mark.parametrize("conversion_rate", [0.0, 8000.0])
def test_a_range_that_is_told_clips(conversion_rate: float) -> None:
    model = ImuModel("bare", conversion_rate=conversion_rate)
    state = disturbed(model, "imu-range:1,size_g=1.5,at=0.0995", "imu-vibration:all,axis=z,size_g=3,sine_hz=2.5")
    read = run(state, at_rest(400))[0][:, ACCELEROMETER, :, 2] / G
    free = 1.0 + 3.0 * np.sin(2.0 * pi * 2.5 * PERIOD * np.arange(400))
    np.testing.assert_allclose(read[:, 0], free, atol=1e-9)
    np.testing.assert_allclose(read[:, 1], np.where(np.arange(400) < 100, free, np.clip(free, -1.5, 1.5)), atol=1e-9)


def test_a_stuck_axis_keeps_its_reading_and_the_others_go_on() -> None:
    signals = np.random.default_rng(1).normal(size=(100, 3, 7, 3))
    read = run(disturbed(ImuModel("bare"), "imu-stuck:4,sensor=gyroscope,axis=y,at=0.0395,for=0.03"), signals)[0]
    expected = signals.copy()
    expected[40:70, GYROSCOPE, 4, 1] = signals[39, GYROSCOPE, 4, 1]
    np.testing.assert_array_equal(read, expected)


@pytest.mark.parametrize("sensor", ["gyroscope", "accelerometer", "magnetometer"])
def test_offsets_and_scales_are_of_their_sensor_and_axes_alone(sensor: str) -> None:
    kind = ("gyroscope", "accelerometer", "magnetometer").index(sensor)
    unit = ("size_deg_per_s", "size_m_per_s2", "size_ut")[kind]
    signals = np.random.default_rng(2).normal(size=(40, 3, 7, 3))
    state = disturbed(
        ImuModel("bare"), f"imu-offset:1+2,axis=-z,{unit}=2", f"imu-scale:2,sensor={sensor},axis=all,size_percent=10"
    )
    expected = signals.copy()
    expected[:, kind, 2] *= 1.1
    expected[:, kind, 1:3, 2] -= radians(2.0) if kind == GYROSCOPE else 2.0
    np.testing.assert_allclose(run(state, signals)[0], expected, atol=1e-12)


def test_disturbances_outside_their_time_leave_the_readings_bit_for_bit() -> None:
    signals = np.random.default_rng(3).normal(size=(300, 3, 7, 3))
    later = [
        f"imu-{each},at=5"
        for each in (
            "offset:all,axis=x,size_g=1", "vibration:all,axis=x,size_g=1,sine_hz=999.9", "turn:all,axis=x,size_deg=1",
            "stuck:all,sensor=gyroscope,axis=x", "temperature:all,size_k=9", "clock:all,size_percent=3", "jitter:all,size_ms=1",
        )
    ]  # fmt: skip
    for name in ("mpu9150", "icm42688"):
        healthy, waiting = (run(disturbed(load_imu(name), *texts, seed=5), signals) for texts in ((), later))
        for one, other in zip(healthy, waiting, strict=True):
            np.testing.assert_array_equal(one, other)


def test_there_is_room_for_so_many_disturbances_and_no_more() -> None:
    text = "imu-supply:all,size_v=1"
    state = disturbed(ImuModel("bare"), *[text] * MOST_DISTURBANCES)
    with pytest.raises(InputError, match=f"more than {MOST_DISTURBANCES} disturbances of IMUs"):
        add_disturbances(state, [disturbance_of_text(text)])


# ---- the slow twin ----


def twin(model: ImuModel, texts: list[str], ideal: Array, imu: int, state: Any) -> Array:
    """Readings (N, 3, 3) of one IMU without noise, from its constants: all conversions at once, in NumPy and SciPy."""
    cycles, made = PERIOD * np.arange(len(ideal)), [disturbance_of_text(text) for text in texts]
    interval = 1.0 / state["rate"][imu] if model.sample_rate else PERIOD
    conversions = max(1, round(model.conversion_rate / (model.sample_rate or 1.0 / PERIOD)))
    if model.sample_rate:
        begin = float(imu_state(model, 8, PERIOD)["converted_at"][imu])
        ticks = begin + interval / conversions * np.arange(1, int((cycles[-1] - begin) / interval * conversions) + 1)
    else:
        ticks = np.concatenate([np.arange(1, conversions + 1) / conversions * PERIOD + start for start in cycles[:-1]])
    ticks = np.concatenate([[0.0], ticks])
    signal = np.stack([np.interp(ticks, cycles, channel) for channel in ideal[:, :, imu].reshape(len(ideal), 9).T], axis=1)
    signal = signal.reshape(-1, 3, 3)
    added, scale, warmer, supply = np.zeros_like(signal), np.zeros_like(signal), np.zeros(len(ticks)), np.zeros(len(ticks))
    for each in made:
        if imu not in each.imus:
            continue
        begin = max(each.begin, 0.0)
        passed = np.maximum(ticks - begin, 0.0)
        shape = {
            Course.STEP: lambda t, _: np.ones_like(t),
            Course.RAMP: lambda t, each: np.clip(t / each.span, 0.0, 1.0),
            Course.SETTLE: lambda t, each: 1.0 - np.exp(-t / each.span),
            Course.SINE: lambda t, each: np.sin(2.0 * pi * t / each.span),
            Course.PULSES: lambda t, each: np.where(t % each.every < each.span, np.sin(pi * (t % each.every) / each.span), 0.0),
        }[each.course](passed, each)
        size = each.size * shape * ((ticks >= begin) & (ticks < begin + each.duration))
        part = size[:, None] * np.array(each.axis)
        if each.kind == DisturbanceKind.TURN:
            turned = Rotation.from_rotvec(part).inv()
            signal = np.stack([turned.apply(signal[:, kind]) for kind in range(3)], axis=1)
        elif each.kind == DisturbanceKind.TEMPERATURE:
            warmer += size
        elif each.kind == DisturbanceKind.SUPPLY:
            supply += size
        elif each.kind == DisturbanceKind.VIBRATION:
            signal[:, each.sensor] += part
        else:
            (added if each.kind == DisturbanceKind.OFFSET else scale)[:, each.sensor] += part
    last = np.arange(len(ticks))[(np.arange(len(ticks)) % conversions) == 0]
    read = np.empty((len(last), 3, 3))
    every = round(1.0 / (model.magnetometer_rate * (1.0 / model.sample_rate if model.sample_rate else PERIOD)))
    for kind, errors in enumerate((model.gyroscope, model.accelerometer, model.magnetometer)):
        sensed = signal[:, kind] @ state["gain"][kind, imu].T
        sensed = sensed + errors.rectification * sensed**2
        sensed = sensed * (1.0 + scale[:, kind] + warmer[:, None] * state["scale_per_kelvin"][kind, imu])
        sensed = sensed + added[:, kind] + warmer[:, None] * state["bias_per_kelvin"][kind, imu]
        sensed = sensed + supply[:, None] * state["bias_per_volt"][kind, imu] + state["offset"][kind, imu]
        if conversions > 1:
            sensed = np.clip(sensed, -errors.reach, errors.reach)
        nominal = (1.0 / model.sample_rate if model.sample_rate else PERIOD) / conversions
        if kind == MAGNETOMETER:
            sensed, nominal = sensed[last][::every], nominal * conversions * every
        if errors.bandwidth < inf:
            corner = 2.0 * pi * errors.bandwidth / sqrt(2.0 ** (1.0 / errors.order) - 1.0)
            (numerator,), denominator, *_ = cont2discrete(([corner], [1.0, corner]), nominal, "foh")
            for _ in range(errors.order):
                # Settled at the first conversion.
                state0 = (numerator[1] - denominator[1] * 1.0) * sensed[:1]
                sensed = lfilter(numerator, denominator, sensed, axis=0, zi=state0)[0]
        sensed = np.repeat(sensed, every, axis=0)[: len(last)] if kind == MAGNETOMETER else sensed[last]
        read[:, kind] = np.clip(sensed, -errors.reach, errors.reach)
    sampled = ticks[last]
    return read[np.searchsorted(sampled, cycles + 1e-12, side="right") - 1]


TEXTS = [
    "imu-offset:0+3,axis=0/0.89/-0.46,size_m_per_s2=0.5,ramp_s=0.1,at=0.0203",
    "imu-offset:legs,axis=x,size_deg_per_s=3,sine_hz=333.3",
    "imu-scale:3,sensor=magnetometer,axis=all,size_percent=5,at=0.0503,for=0.1",
    "imu-vibration:all,axis=1/2/3,size_g=2.5,sine_hz=999.9,at=0.0103",
    "imu-vibration:3+4,axis=z,size_g=3,pulse_ms=4,repeat_hz=20,at=0.0133,for=0.12",
    "imu-turn:3,axis=-y,size_deg=20,settle_s=0.05",
    "imu-temperature:all,size_k=30,settle_s=0.1",
    "imu-supply:all,size_v=0.5,at=0.1003",
]


@settings(max_examples=12)
@given(
    st.sampled_from([0.0, 500.0, 970.0]),
    st.sampled_from([1, 3, 8]),
    st.integers(1, 4),
    st.sampled_from([50.0, 260.0, inf]),
    st.lists(st.sampled_from(TEXTS), max_size=8, unique=True),
)
def test_readings_are_those_of_a_slow_twin(
    rate: float, conversions: int, order: int, bandwidth: float, texts: list[str]
) -> None:
    raw = load_imu("mpu9150")
    sensors = {
        name: replace(
            getattr(raw, name), noise=0.0, resolution=0.0, order=order, bandwidth=bandwidth, rectification=1e-4
        )
        for name in ("gyroscope", "accelerometer", "magnetometer")
    }  # fmt: skip
    model = replace(
        raw,
        **sensors,
        sample_rate=rate,
        clock_error=0.01 if rate else 0.0,
        conversion_rate=conversions * (rate or 1000.0),
        sparing=False,
    )
    random = np.random.default_rng(9)
    times = PERIOD * np.arange(200)[:, None, None, None]
    ideal = 5.0 * np.sin(2.0 * pi * random.uniform(1.0, 8.0, (3, 7, 3)) * times + random.uniform(0.0, 6.0, (3, 7, 3)))
    state = disturbed(model, *texts, seed=8)
    measured = run(state, ideal)[0]
    for imu in (0, 3, 6):
        np.testing.assert_allclose(measured[:, :, imu], twin(model, texts, ideal, imu, state), atol=1e-8)


# ---- presets ----


@pytest.mark.parametrize("name", ["mpu9150-nominal", "icm42688-nominal"])
def test_nominal_presets_stay_near_those_without_imperfections(name: str) -> None:
    """All that real ones do is small: within 3 deg/s and 0.05 g of the truth for half a minute."""
    state = imu_state(load_imu(name), 1, PERIOD)
    read = run(state, at_rest(5000))[0]
    assert np.abs(read[:, GYROSCOPE]).max() < radians(3.0)
    assert np.abs(read[:, ACCELEROMETER] - at_rest(1)[:, ACCELEROMETER]).max() < 0.05 * G
    assert np.ptp(state["rate"]) > 0.0 and int(state["conversions"]) == 8


def test_the_figures_of_data_sheets_over_temperature() -> None:
    """MPU-6050: 20 deg/s over 60 K, 35 mg over 45 K; ICM-42688-P: 0.005 deg/s and 0.15 mg per kelvin, 0.005 %/K."""
    for name, gyroscope, accelerometer in (("mpu9150", 20.0 / 65.0, 35.0 / 45.0), ("icm42688", 0.005, 0.15)):
        model = load_imu(name)
        assert np.degrees(sum(model.gyroscope.bias_per_kelvin)) == pytest.approx(gyroscope, rel=0.05)
        assert sum(model.accelerometer.bias_per_kelvin) / G * 1e3 == pytest.approx(accelerometer, rel=0.05)
    assert sum(load_imu("icm42688").gyroscope.scale_per_kelvin) == pytest.approx(5e-5)


def wander_of(model: ImuModel, seed: int, frequency: float, phases: int = 8) -> Array:
    """By how much gravity's reading (7, 3) changes with the kind's disturbances, which have settled, without what vibrates."""
    random = np.random.default_rng(seed)
    ideal = np.zeros((3, 7, 3))
    up = random.normal(size=(7, 3))
    ideal[ACCELEROMETER] = G * up / np.linalg.norm(up, axis=1, keepdims=True)
    time, readings = random.uniform(1e5, 2e5), np.empty((2, phases, 3, 7, 3))
    for kind, reading in zip((model, replace(model, disturbances=())), readings, strict=True):
        start = imu_state(kind, seed, PERIOD)
        for phase in range(phases):
            state = start.copy()
            state["time"] = time + phase / (phases * frequency)
            measure(state, ideal, reading[phase])
    changed: Array = np.mean(readings[0] - readings[1], axis=0)[ACCELEROMETER]
    return changed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mpu9150-nominal", ()),
        ("icm42688-nominal", ()),
        ("mpu9150", ("imu-supply:all,size_v=0.5,sine_hz=0.01", "imu-vibration:all,axis=z,size_deg_per_s=5,sine_hz=173")),
        ("mpu9150-nominal", ("imu-vibration:all,axis=1/2/0,size_g=2,sine_hz=173", "imu-temperature:all,size_k=-1,ramp_s=9")),
    ],
)
def test_the_accelerometer_wanders_by_what_its_kind_says(name: str, words: tuple[str, ...]) -> None:
    model = load_imu(name)
    sensor = replace(model.accelerometer, resolution=0.0)
    disturbances = tuple(map(disturbance_of_text, words)) or model.disturbances
    model = replace(model, accelerometer=sensor, disturbances=disturbances)
    squares = np.array([np.mean(wander_of(model, seed, 173.0) ** 2) for seed in range(100)])
    error = np.std(squares) / sqrt(len(squares))
    assert error < 0.1 * np.mean(squares)
    assert np.mean(squares) == pytest.approx(model.accelerometer_wander**2, abs=4.0 * error)


@pytest.mark.parametrize("name", ["ideal", "mpu9150", "mpu9150-calibrated", "icm42688"])
def test_an_accelerometer_whose_kind_has_no_disturbances_does_not_wander(name: str) -> None:
    model = load_imu(name)
    assert model.accelerometer_wander == 0.0
    # Nor does one that a disturbance of another sensor or kind concerns alone.
    others = "imu-vibration:all,axis=z,size_deg_per_s=9,sine_hz=50", "imu-clock:all,size_percent=1"
    assert replace(model, disturbances=tuple(map(disturbance_of_text, others))).accelerometer_wander == 0.0
