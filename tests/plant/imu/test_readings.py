"""Imperfections of IMUs: each error alone, its statistics, and that any cycle can be made again."""

from dataclasses import replace
from math import inf, nan, pi, radians, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from plant.errors import GoughError, InputError, UnknownNameError
from plant.imu import (
    ACCELEROMETER,
    GYROSCOPE,
    MAGNETOMETER,
    PRESETS,
    ImuModel,
    SensorErrors,
    Wiring,
    imu_state,
    load_imu,
    measure,
    philox,
)
from plant.imu_disturbances import disturbance_of_text
from plant.pose import Array

RATE = 1000.0
PERIOD = 1.0 / RATE
SENSORS = ("gyroscope", "accelerometer", "magnetometer")
MILLI_G = 9.80665e-3


def readings(state: Any, ideal: Array) -> Array:
    """What the IMUs read (N, 3, 7, 3) for ideal signals (N, 3, 7, 3)."""
    measured = np.empty_like(ideal)
    for signal, reading in zip(ideal, measured, strict=True):
        measure(state, signal, reading)
    return measured


def constant(value: float, cycles: int) -> Array:
    return np.full((cycles, 3, 7, 3), value)


def ramp(cycles: int) -> Array:
    """Every channel counts the cycles."""
    return np.broadcast_to(np.arange(float(cycles))[:, None, None, None], (cycles, 3, 7, 3)).copy()


def one_sensor(errors: SensorErrors, **others: Any) -> ImuModel:
    """A model whose three sensors all have these errors."""
    return ImuModel("test", gyroscope=errors, accelerometer=errors, magnetometer=errors, **others)


# ---- the generator ----


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)
def test_philox_gives_the_words_its_authors_publish(counter: str, key: str, words: str) -> None:
    arguments = [int(word, 16) for word in f"{counter} {key}".split()]
    assert [f"{int(word):08x}" for word in philox(*arguments)] == words.split()


NOISY = one_sensor(SensorErrors(noise=1.0 / sqrt(RATE / 2.0)))
"""Noise of unit standard deviation at 1 kHz, and nothing else."""


def test_a_seed_gives_the_same_readings_again_and_another_seed_does_not() -> None:
    first, again, other = (readings(imu_state(NOISY, seed, PERIOD), constant(0.0, 50)) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


@pytest.mark.parametrize("seed", [0, 1, 2**32, 2**63 - 1])
def test_the_whole_seed_counts(seed: int) -> None:
    draws = {float(readings(imu_state(NOISY, s, PERIOD), constant(0.0, 1))[0, 0, 0, 0]) for s in (seed, 2, 2**32 + 2, 2**62)}
    assert len(draws) == 4


@given(st.integers(1, 2**40))
def test_the_noise_of_a_cycle_does_not_depend_on_earlier_cycles(cycle: int) -> None:
    fresh = imu_state(NOISY, 3, PERIOD)
    used = imu_state(NOISY, 3, PERIOD)
    used["cycle"] = cycle - 3
    signal = constant(0.25, 4)
    after = readings(used, signal)
    fresh["cycle"] = cycle
    np.testing.assert_array_equal(readings(fresh, signal[:1])[0], after[3])


def test_the_noise_does_not_come_round_again_after_2_to_the_32_cycles() -> None:
    early, late = imu_state(NOISY, 3, PERIOD), imu_state(NOISY, 3, PERIOD)
    early["cycle"], late["cycle"] = 5, 5 + 2**32
    assert (readings(early, constant(0.0, 1)) != readings(late, constant(0.0, 1))).all()


def test_a_copy_of_the_state_goes_on_as_the_state_does() -> None:
    state = imu_state(replace(PRESETS["mpu9150"], delay=0.004, dropout=0.1), 5, PERIOD)
    random = np.random.default_rng(0)
    readings(state, random.normal(size=(37, 3, 7, 3)))
    snapshot = state.copy()
    signals = random.normal(size=(50, 3, 7, 3))
    np.testing.assert_array_equal(readings(state, signals), readings(snapshot, signals))


# ---- ideal ----


def test_the_ideal_imu_passes_its_signals_bit_for_bit() -> None:
    random = np.random.default_rng(0)
    signals = random.normal(size=(500, 3, 7, 3)) * 10.0 ** random.uniform(-6.0, 3.0, (500, 3, 7, 3))
    np.testing.assert_array_equal(readings(imu_state(load_imu("ideal"), 0, PERIOD), signals), signals)


# ---- noise ----


@pytest.mark.parametrize("rate", [250.0, 1000.0, 4000.0])
def test_white_noise_has_the_density_asked_for(rate: float) -> None:
    density, cycles = 0.02, 4000
    noise = readings(imu_state(one_sensor(SensorErrors(noise=density)), 1, 1.0 / rate), constant(1.0, cycles)) - 1.0
    expected = density * sqrt(rate / 2.0)
    for kind in range(3):
        assert noise[:, kind].std() == pytest.approx(expected, rel=0.015)  # 4 standard errors of 84,000 samples
        assert abs(noise[:, kind].mean()) < 4.0 * expected / sqrt(noise[:, kind].size)


def test_white_noise_is_normal_and_independent_between_all_channels_and_cycles() -> None:
    cycles = 3000
    noise = readings(imu_state(NOISY, 2, PERIOD), constant(0.0, cycles)).reshape(cycles, 63)
    assert kstest(noise.ravel(), "norm").pvalue > 0.01
    bound = 5.0 / sqrt(cycles)
    correlation = np.corrcoef(noise.T)
    assert np.abs(correlation - np.eye(63)).max() < bound
    for lag in (1, 2, 10):
        assert np.abs(np.mean(noise[lag:] * noise[:-lag], axis=0)).max() < bound


def test_a_low_pass_leaves_the_variance_of_its_bandwidth() -> None:
    bandwidth, cycles = 50.0, 6000
    model = one_sensor(SensorErrors(noise=1.0, bandwidth=bandwidth))
    noise = readings(imu_state(model, 4, PERIOD), constant(0.0, cycles))[200:]
    ratio = 2.0 * pi * bandwidth * PERIOD
    pole, share = np.exp(-ratio), -np.expm1(-ratio) / ratio
    # Of y+ = pole y + old x + new x+, for a signal that is linear in between.
    old, new = share - pole, 1.0 - share
    expected = sqrt(RATE / 2.0 * (old**2 + new**2 + 2.0 * pole * old * new) / (1.0 - pole**2))
    # The samples are correlated over 1 / (1 - pole), which widens the tolerance.
    assert noise.std() == pytest.approx(expected, rel=0.03)
    # Well below half the rate that is a density over the filter's noise bandwidth of pi/2 times its corner.
    assert noise.std() == pytest.approx(sqrt(bandwidth * pi / 2.0), rel=0.1)


@pytest.mark.parametrize("rate", [250.0, 1000.0, 4000.0])
def test_a_low_pass_lags_by_its_time_constant_at_any_rate(rate: float) -> None:
    bandwidth = 20.0
    state = imu_state(one_sensor(SensorErrors(bandwidth=bandwidth)), 0, 1.0 / rate)
    times = np.arange(round(0.5 * rate)) / rate
    response = readings(state, constant(1.0, len(times)) * times[:, None, None, None])
    np.testing.assert_allclose(times[-1] - response[-1], 1.0 / (2.0 * pi * bandwidth), rtol=1e-9)


def test_a_preset_is_late_by_its_low_pass_and_its_delay() -> None:
    model = replace(load_imu("mpu9150"), delay=0.002)
    assert model.latency == pytest.approx(0.002 + 0.5 / (2.0 * pi * 256.0) + 0.5 / (2.0 * pi * 260.0), rel=1e-12)
    assert load_imu("ideal").latency == 0.0


def test_a_step_comes_through_a_low_pass_in_its_time_constant() -> None:
    bandwidth = 20.0
    state = imu_state(one_sensor(SensorErrors(bandwidth=bandwidth)), 0, PERIOD)
    signal = np.concatenate([constant(0.0, 10), constant(1.0, 100)])
    response = readings(state, signal)
    np.testing.assert_array_equal(response[:10], 0.0)
    # Between two samples the step is a ramp.
    ratio = 2.0 * pi * bandwidth * PERIOD
    expected = 1.0 + np.expm1(-ratio) / ratio * np.exp(-ratio * np.arange(100))
    np.testing.assert_allclose(response[10:], np.broadcast_to(expected[:, None, None, None], (100, 3, 7, 3)), atol=1e-12)


def test_a_low_pass_starts_settled() -> None:
    np.testing.assert_array_equal(
        readings(imu_state(one_sensor(SensorErrors(bandwidth=5.0)), 0, PERIOD), constant(9.81, 20)), 9.81
    )


def test_drift_is_a_random_walk_of_the_bias() -> None:
    """Its variance grows linearly: drift^2 times the time, for rates of the loop alike."""
    drift, seconds = 0.3, 2.0
    for rate in (250.0, 1000.0):
        cycles = round(seconds * rate)
        walks = np.concatenate(
            [
                readings(imu_state(one_sensor(SensorErrors(drift=drift)), seed, 1.0 / rate), constant(0.0, cycles))[:, :2]
                for seed in range(8)
            ],
            axis=1,
        ).reshape(cycles, -1)
        steps = np.diff(walks, axis=0)
        assert steps.std() == pytest.approx(drift / sqrt(rate), rel=0.02)
        assert np.abs(np.mean(steps[1:] * steps[:-1])) < 0.02 * steps.var()
        for share in (0.5, 1.0):
            variance = np.mean(walks[round(share * cycles) - 1] ** 2)
            assert variance == pytest.approx(drift**2 * share * seconds, rel=0.3)  # of 336 walks


def test_every_random_error_has_random_numbers_of_its_own() -> None:
    """Neither a sensor, an axis or an IMU shares them with another, nor the noise with the walk of the bias."""
    cycles = 3000
    walks = readings(imu_state(one_sensor(SensorErrors(drift=1.0)), 4, PERIOD), constant(0.0, cycles))[:, :2]
    noise = readings(imu_state(NOISY, 4, PERIOD), constant(0.0, cycles))
    columns = np.hstack([np.diff(walks.reshape(cycles, 42), axis=0), noise[1:].reshape(-1, 63)])
    assert np.abs(np.corrcoef(columns.T) - np.eye(105)).max() < 5.0 / sqrt(cycles)


# ---- constant errors ----


def probe(model: ImuModel, seed: int) -> tuple[Array, Array]:
    """Gain (3, 7, 3, 3) and offset (3, 7, 3) of the readings, found with four constant signals and nothing random."""
    quiet = {name: replace(getattr(model, name), noise=0.0, resolution=0.0, reach=inf) for name in SENSORS}
    model = replace(model, **quiet, magnetometer_rate=inf)

    def read(signal: list[float]) -> Array:
        return readings(imu_state(model, seed, PERIOD), np.broadcast_to(signal, (1, 3, 7, 3)).copy())[0]

    offset = read([0.0, 0.0, 0.0])
    return np.stack([read(axis) - offset for axis in np.eye(3).tolist()], axis=-1), offset


MPU = (radians(20.0), radians(20.0), 50.0 * MILLI_G, 80.0 * MILLI_G)
CALIBRATED = (radians(0.2), radians(0.2), MILLI_G, MILLI_G)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bounds"), [("mpu9150", MPU), ("mpu9150-calibrated", CALIBRATED), ("icm42688", CALIBRATED)])
def test_biases_of_a_preset_have_the_magnitude_of_its_data_sheet(name: str, bounds: tuple[float, ...]) -> None:
    offsets = np.array([probe(load_imu(name), seed)[1] for seed in range(60)])
    for kind, (least, greatest) in enumerate((bounds[:2], bounds[2:])):
        size = np.linalg.norm(offsets[:, kind], axis=-1)
        assert least * (1.0 - 1e-9) <= size.min() and size.max() <= greatest * (1.0 + 1e-9)
        if greatest > least:
            assert size.max() - size.min() > 0.9 * (greatest - least)
        # In all directions alike: 420 unit vectors, each component with variance 1/3.
        directions = (offsets[:, kind] / size[..., None]).reshape(-1, 3)
        assert np.abs(directions.mean(axis=0)).max() < 4.0 * sqrt(1.0 / 3.0 / len(directions))
        assert np.abs(directions.T @ directions / len(directions) - np.eye(3) / 3.0).max() < 0.08
    hard_iron = 20.0 if name == "mpu9150" else 0.3
    np.testing.assert_allclose(np.linalg.norm(offsets[:, MAGNETOMETER], axis=-1), hard_iron, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "gyroscope_scale", "accelerometer_scale", "cross_axis"),
    [("mpu9150", 0.03, 0.03, 0.02), ("mpu9150-calibrated", 0.0, 1e-3, 0.0), ("icm42688", 0.0, 1e-3, 0.0)],
)
def test_scales_and_axes_of_a_preset_stay_within_its_data_sheet(
    name: str, gyroscope_scale: float, accelerometer_scale: float, cross_axis: float
) -> None:
    """The inverse of the gain is T S of (37): upper triangular, with the scales on its diagonal."""
    model = replace(load_imu(name), misalignment=0.0)
    inverse = np.linalg.inv([probe(model, seed)[0] for seed in range(40)])
    soft_iron = 0.05 if name == "mpu9150" else 5e-3
    for kind, scale in ((GYROSCOPE, gyroscope_scale), (ACCELEROMETER, accelerometer_scale), (MAGNETOMETER, soft_iron)):
        matrices = inverse[:, kind].reshape(-1, 3, 3)
        scales = np.diagonal(matrices, axis1=1, axis2=2)
        np.testing.assert_allclose(np.tril(matrices, -1), 0.0, atol=1e-13)
        assert np.abs(scales - 1.0).max() <= scale + 1e-12
        assert np.abs(scales - 1.0).max() >= 0.95 * scale
        axes = matrices / scales[:, None, :]
        greatest = cross_axis if kind != MAGNETOMETER else soft_iron
        assert np.abs(np.triu(axes, 1)).max() <= greatest + 1e-12
        assert np.abs(np.triu(axes, 1)).max() >= 0.95 * greatest


def test_an_imu_is_turned_as_a_whole() -> None:
    """Mounting misalignment is a small rotation about each axis, the same for the three sensors of an IMU."""
    gains = np.array([probe(ImuModel("turned", misalignment=radians(1.0)), seed)[0] for seed in range(40)])
    np.testing.assert_allclose(gains[:, 1:], np.repeat(gains[:, :1], 2, axis=1), atol=1e-15)
    vectors = Rotation.from_matrix(gains[:, 0].reshape(-1, 3, 3)).as_rotvec()
    assert radians(0.95) < np.abs(vectors).max() <= radians(1.0) + 1e-12
    assert vectors.std() == pytest.approx(radians(1.0) / sqrt(3.0), rel=0.05)
    assert np.ptp(vectors.reshape(40, 7, 3), axis=1).min() > 0.0


def test_the_calibration_of_the_paper_undoes_the_constant_errors() -> None:
    """`a_cal = T S (a_u + b)` with the probed T S and b gives back the true signal, seen in the turned sensor."""
    model = replace(load_imu("mpu9150"), misalignment=0.0)
    gain, offset = probe(model, 11)
    quiet = {name: replace(getattr(model, name), noise=0.0, resolution=0.0, reach=inf, bandwidth=inf) for name in SENSORS}
    signals = np.random.default_rng(0).normal(size=(20, 3, 7, 3))
    raw = readings(imu_state(replace(model, **quiet, magnetometer_rate=inf), 11, PERIOD), signals)
    calibrated = np.einsum("kijl,nkil->nkij", np.linalg.inv(gain), raw - offset)
    np.testing.assert_allclose(calibrated, signals, atol=1e-12)


def test_constant_errors_do_not_depend_on_the_rate() -> None:
    slow, fast = (imu_state(load_imu("mpu9150"), 6, 1.0 / rate) for rate in (250.0, 4000.0))
    np.testing.assert_array_equal(slow["gain"], fast["gain"])
    np.testing.assert_array_equal(slow["offset"], fast["offset"])


# ---- range, resolution, delay, dropouts, the magnetometer's rate ----


def test_readings_stop_at_the_range() -> None:
    signals = np.linspace(-3.0, 3.0, 61)[:, None, None, None] * np.ones((3, 7, 3))
    measured = readings(imu_state(one_sensor(SensorErrors(reach=2.0)), 0, PERIOD), signals)
    np.testing.assert_array_equal(measured, np.clip(signals, -2.0, 2.0))


@pytest.mark.parametrize("name", ["mpu9150", "mpu9150-calibrated", "icm42688"])
def test_presets_saturate_where_their_data_sheets_say(name: str) -> None:
    state = imu_state(load_imu(name), 0, PERIOD)
    measured = readings(state, constant(1e4, 3))[-1]
    for kind, reach in ((GYROSCOPE, radians(250.0)), (ACCELEROMETER, 4.0 * 9.80665), (MAGNETOMETER, 1200.0)):
        np.testing.assert_allclose(measured[kind], reach, rtol=1e-12)


@given(st.floats(1e-4, 1.0))
def test_readings_are_the_nearest_multiples_of_the_resolution(resolution: float) -> None:
    signals = np.random.default_rng(0).uniform(-5.0, 5.0, (5, 3, 7, 3))
    measured = readings(imu_state(one_sensor(SensorErrors(resolution=resolution)), 0, PERIOD), signals)
    steps = measured / resolution
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    assert np.abs(measured - signals).max() <= resolution / 2.0 + 1e-12


@pytest.mark.parametrize("cycles", [0, 1, 2, 7, 32])
def test_a_delay_shifts_the_readings_by_whole_cycles(cycles: int) -> None:
    signals = ramp(100)
    measured = readings(imu_state(ImuModel("late", delay=cycles * PERIOD), 0, PERIOD), signals)
    np.testing.assert_array_equal(measured[cycles:], signals[: 100 - cycles])
    np.testing.assert_array_equal(measured[:cycles], 0.0)


def test_a_delay_is_rounded_to_cycles() -> None:
    measured = readings(imu_state(ImuModel("late", delay=0.0026), 0, PERIOD), ramp(20))
    np.testing.assert_array_equal(measured[3:], ramp(17))


def test_a_dropout_repeats_the_sample_before() -> None:
    probability, cycles = 0.15, 4000
    signals = ramp(cycles)
    measured = readings(imu_state(ImuModel("lossy", dropout=probability), 0, PERIOD), signals)
    np.testing.assert_array_equal(measured[0], signals[0])
    repeated = measured[1:] == measured[:-1]
    fresh = measured[1:] == signals[1:]
    assert (repeated ^ fresh).all()
    # All channels of an IMU are lost together, those of different IMUs independently.
    lost = repeated[:, 0, :, 0]
    np.testing.assert_array_equal(repeated, np.broadcast_to(lost[:, None, :, None], repeated.shape))
    assert lost.mean() == pytest.approx(probability, abs=4.0 * sqrt(probability * (1.0 - probability) / lost.size))
    assert np.abs(np.corrcoef(lost.T) - np.eye(7)).max() < 5.0 / sqrt(cycles)


def test_without_dropouts_every_sample_is_fresh_and_with_certain_ones_none() -> None:
    np.testing.assert_array_equal(readings(imu_state(ImuModel("lossy", dropout=1.0), 0, PERIOD), ramp(50)), 0.0)
    np.testing.assert_array_equal(readings(imu_state(ImuModel("fine", dropout=0.0), 0, PERIOD), ramp(50)), ramp(50))


def test_the_magnetometer_stands_still_between_its_samples() -> None:
    measured = readings(imu_state(ImuModel("slow", magnetometer_rate=100.0), 0, PERIOD), ramp(95))
    np.testing.assert_array_equal(measured[:, :MAGNETOMETER], ramp(95)[:, :MAGNETOMETER])
    expected = 10.0 * (np.arange(95) // 10)
    np.testing.assert_array_equal(measured[:, MAGNETOMETER], np.broadcast_to(expected[:, None, None], (95, 7, 3)))


@pytest.mark.parametrize("delay", [1, 3, 9, 10, 15])
def test_a_slow_magnetometer_is_delayed_like_the_rest(delay: int) -> None:
    model = ImuModel("slow and late", magnetometer_rate=100.0, delay=delay * PERIOD)
    measured = readings(imu_state(model, 0, PERIOD), ramp(200))[100:, MAGNETOMETER]
    age = np.arange(100, 200)[:, None, None] - measured
    assert age.min() >= delay
    assert age.max() < delay + 20


def slow_magnetometer(errors: SensorErrors, rate: float) -> Any:
    """The state of a magnetometer of 100 Hz in a loop of this rate."""
    return imu_state(ImuModel("slow", magnetometer=errors, magnetometer_rate=100.0), 0, 1.0 / rate)


@pytest.mark.parametrize("rate", [100.0, 500.0, 4000.0])
def test_a_slow_magnetometer_keeps_its_bandwidth_at_any_rate_of_the_loop(rate: float) -> None:
    every = round(rate / 100.0)
    step = np.concatenate([constant(0.0, every), constant(1.0, 10 * every)])
    settled = readings(slow_magnetometer(SensorErrors(bandwidth=10.0), rate), step)[-1, MAGNETOMETER]
    np.testing.assert_allclose(settled, 1.0 - np.exp(-2.0 * pi * 10.0 * 0.1), rtol=0.02)  # after 0.1 s


@pytest.mark.parametrize("rate", [100.0, 500.0, 4000.0])
def test_a_slow_magnetometer_keeps_its_noise_at_any_rate_of_the_loop(rate: float) -> None:
    every = round(rate / 100.0)
    noise = readings(slow_magnetometer(SensorErrors(noise=1.0), rate), constant(0.0, 300 * every))[::every, MAGNETOMETER]
    assert noise.std() == pytest.approx(sqrt(100.0 / 2.0), rel=0.04)  # 6,300 samples


# ---- models ----


def test_presets_have_the_noise_of_their_data_sheets() -> None:
    parts = {f"{part}{grade}" for part in ("bmi088", "icm20948", "lsm6dso") for grade in ("", "-calibrated", "-nominal")}
    first = {"ideal", "mpu9150", "mpu9150-calibrated", "icm42688", "mpu9150-nominal", "icm42688-nominal"}
    assert set(PRESETS) == first | parts
    for name, gyroscope, accelerometer in (
        ("mpu9150", 0.005, 400e-3),
        ("mpu9150-calibrated", 0.005, 400e-3),
        ("icm42688", 0.0028, 70e-3),
    ):
        model = load_imu(name)
        assert model.gyroscope.noise == pytest.approx(radians(gyroscope))
        assert model.accelerometer.noise == pytest.approx(accelerometer * MILLI_G)
        assert model.magnetometer_rate == 100.0 and model.magnetometer.resolution == 0.3


def test_a_model_of_ones_own_is_a_preset_with_changes() -> None:
    calibrated = load_imu("mpu9150-calibrated")
    quiet = replace(calibrated, name="quiet", gyroscope=replace(calibrated.gyroscope, noise=0.0), delay=0.002)
    state = imu_state(quiet, 3, PERIOD)
    assert state["delay"] == 2 and not state["noise"][:, GYROSCOPE].any()
    noise = imu_state(calibrated, 3, PERIOD)["noise"][:, ACCELEROMETER]
    assert (state["noise"][:, ACCELEROMETER] == noise).all() and (noise > 0.0).all()


def test_an_unknown_preset_names_the_presets() -> None:
    with pytest.raises(UnknownNameError, match="no IMU preset 'mpu6050'; there are ideal, mpu9150, mpu9150-calibrated, icm"):
        load_imu("mpu6050")


@pytest.mark.parametrize(
    "errors",
    [
        {"noise": -1.0},
        {"noise": nan},
        {"bias": (-0.1, 0.1)},
        {"scale": -0.01},
        {"cross_axis": -0.01},
        {"drift": -1.0},
        {"bandwidth": -5.0},
        {"reach": -2.0},
        {"resolution": -0.1},
        {"noise": "loud"},
    ],
)
def test_errors_of_a_sensor_are_checked(errors: dict[str, Any]) -> None:
    (name,) = errors
    with pytest.raises(InputError, match=f"the {name} of a sensor is"):
        SensorErrors(**errors)


def test_a_bandwidth_of_zero_is_refused_with_what_to_do_instead():
    with pytest.raises(InputError, match="the bandwidth of a sensor is 0; it must be positive: leave it out"):
        SensorErrors(bandwidth=0.0)


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_a_seed_out_of_range_is_refused(seed: int) -> None:
    with pytest.raises(InputError, match=f"the seed is {seed}; it must be a whole number between 0 and"):
        imu_state(ImuModel("any"), seed, PERIOD)


def test_a_delay_longer_than_the_queue_is_refused() -> None:
    with pytest.raises(InputError, match="the delay of the IMUs is 33 cycles; at most 32 are kept"):
        imu_state(ImuModel("late", delay=0.033), 0, PERIOD)


@pytest.mark.parametrize(
    "values",
    [
        {"dropout": -0.1},
        {"dropout": 1.5},
        {"dropout": nan},
        {"delay": -0.001},
        {"delay": inf},
        {"delay": nan},
        {"magnetometer_rate": 0.0},
        {"magnetometer_rate": -100.0},
        {"magnetometer_rate": nan},
        {"misalignment": -0.1},
        {"misalignment": nan},
    ],
)
def test_the_rest_of_a_model_is_checked(values: dict[str, float]) -> None:
    (name,) = values
    with pytest.raises(InputError, match=name.split("_")[0]):
        imu_state(ImuModel("odd", **values), 0, PERIOD)  # type: ignore[arg-type]


def test_imus_are_wired_as_told():
    axes = ("+x+y+z",) * 7
    wiring = Wiring((1, 0, 2, 3, 4, 5, 6), (*axes[:3], "+y-x+z", *axes[4:]), (*axes[:5], "-x-y-z", "0+y+z"))
    signals = np.random.default_rng(0).normal(size=(1, 3, 7, 3))
    (read,), right = readings(imu_state(load_imu("ideal"), 0, PERIOD, wiring), signals), signals[0]
    np.testing.assert_array_equal(read[:, :3], right[:, [1, 0, 2]])
    np.testing.assert_array_equal(read[0, 3], [right[0, 3, 1], -right[0, 3, 0], right[0, 3, 2]])
    np.testing.assert_array_equal(read[1, 5:], [-right[1, 5], [0.0, *right[1, 6, 1:]]])
    for wrong in ({"places": (0, 0, 2, 3, 4, 5, 6)}, {"gyroscopes": axes[:3]}, {"accelerometers": (*axes[:6], "+x+y")}):
        with pytest.raises(InputError, match=r"places are|has axes of|no axes"):
            Wiring(**wrong)


SENSOR_ERRORS = {
    "noise": SensorErrors(noise=0.1),
    "bias": SensorErrors(bias=(0.5, 0.5)),
    "scale": SensorErrors(scale=0.1),
    "cross_axis": SensorErrors(cross_axis=0.1),
    "drift": SensorErrors(drift=1.0),
    "bandwidth": SensorErrors(bandwidth=5.0),
    "reach": SensorErrors(reach=0.5),
    "resolution": SensorErrors(resolution=0.3),
}


@pytest.mark.parametrize("name", SENSOR_ERRORS)
@pytest.mark.parametrize("sensor", SENSORS)
def test_an_error_of_one_sensor_alone_disturbs_this_sensor_alone(sensor: str, name: str) -> None:
    model = ImuModel("one", **{sensor: SENSOR_ERRORS[name]})
    signals = np.random.default_rng(1).normal(size=(200, 3, 7, 3))
    measured = readings(imu_state(model, 3, PERIOD), signals)
    kind = SENSORS.index(sensor)
    others = [other for other in range(3) if other != kind]
    np.testing.assert_array_equal(measured[:, others], signals[:, others])
    # The bias of a magnetometer does not drift.
    disturbed = (measured[:, kind] != signals[:, kind]).any(axis=(0, 2)).all()
    assert disturbed == ((name, sensor) != ("drift", "magnetometer"))


def test_what_arrives_late_or_never_begins_with_the_first_sample() -> None:
    """Neither a delay nor a dropout makes an IMU read zero before its first sample."""
    first = np.random.default_rng(2).normal(size=(1, 3, 7, 3))
    signals = np.concatenate([first, first + 1.0, first + 2.0, first + 3.0])
    late = readings(imu_state(ImuModel("late", delay=2.0 * PERIOD), 0, PERIOD), signals)
    np.testing.assert_array_equal(late, np.concatenate([first, first, first, first + 1.0]))
    lost = readings(imu_state(ImuModel("lossy", dropout=1.0), 0, PERIOD), signals)
    np.testing.assert_array_equal(lost, np.repeat(first, 4, axis=0))


def test_an_imu_on_another_place_keeps_its_own_errors_and_its_axes_are_turned_after_them() -> None:
    """Wiring turns what the sensor reads, bias included, but not which IMU has which bias."""
    places, turned = (3, 1, 2, 0, 4, 6, 5), "-y+x0"
    wiring = Wiring(places, (turned,) * 7, ("+z+x+y",) * 7)
    model = replace(load_imu("mpu9150"), **{name: replace(getattr(load_imu("mpu9150"), name), noise=0.0, resolution=0.0,
        bandwidth=inf, reach=inf) for name in SENSORS}, magnetometer_rate=inf)  # fmt: skip
    signals = np.random.default_rng(3).normal(size=(5, 3, 7, 3))
    raw = readings(imu_state(model, 9, PERIOD), signals[:, :, list(places)])
    wired = readings(imu_state(model, 9, PERIOD, wiring), signals)
    x, y = raw[:, GYROSCOPE, :, 0], raw[:, GYROSCOPE, :, 1]
    np.testing.assert_allclose(wired[:, GYROSCOPE], np.stack([-y, x, np.zeros_like(x)], axis=-1), atol=1e-13)
    np.testing.assert_allclose(wired[:, ACCELEROMETER], raw[:, ACCELEROMETER][..., [2, 0, 1]], atol=1e-13)
    np.testing.assert_allclose(wired[:, MAGNETOMETER], raw[:, MAGNETOMETER], atol=1e-13)
    assert np.abs(raw - signals[:, :, list(places)]).min(axis=(0, 3))[GYROSCOPE].max() > 0.05, "there are errors to turn"


def test_presets_have_the_figures_of_their_data_sheets() -> None:
    """MPU-9150: 131 LSB/(deg/s), 8192 LSB/g, 0.3 uT; the low-pass of the gyroscope and the accelerometer of each [Hz]."""
    for name, bandwidths, misalignment in (
        ("mpu9150", (256.0, 260.0), 1.0), ("mpu9150-calibrated", (256.0, 260.0), 0.0), ("icm42688", (400.0, 400.0), 0.0)
    ):  # fmt: skip
        model = load_imu(name)
        assert (model.name, model.delay, model.dropout) == (name, 0.0, 0.0)
        assert np.degrees(model.misalignment) == pytest.approx(misalignment)
        assert (model.gyroscope.bandwidth, model.accelerometer.bandwidth, model.magnetometer.bandwidth) == (*bandwidths, inf)
        assert 1.0 / np.degrees(model.gyroscope.resolution) == pytest.approx(131.0)
        assert 9.80665 / model.accelerometer.resolution == pytest.approx(8192.0)
        assert (model.magnetometer.noise, model.magnetometer.drift, model.gyroscope.drift) == (0.05, 0.0, 0.0)


@pytest.mark.parametrize(("delay", "cycles"), [(0.0324, 32), (0.0004, 0), (0.0006, 1)])
def test_the_longest_delay_is_kept_and_the_shortest_is_none(delay: float, cycles: int) -> None:
    assert imu_state(ImuModel("late", delay=delay), 0, PERIOD)["delay"] == cycles


# ---- files ----

FILE = """
based_on = "icm42688"
sample_rate_hz = 500
clock_error_percent = 1
jitter_ms = 0.02
conversion_rate_hz = 8000.0
misalignment_deg = 0.5
delay_ms = 2

[accelerometer]
bandwidth_hz = 100.0
order = 2
reach_m_per_s2 = 78.5
bias_m_per_s2_per_k = [0.001, 0.002]
scale_percent_per_k = [0.002, 0.005]
rectification_per_m_per_s2 = 1.8e-4

[gyroscope]
noise_deg_per_s_per_root_hz = 0.01
bias_deg_per_s = [0.1, 0.3]

[[disturbances]]
kind = "offset"
imus = [0, 3]
axis = [0, 3, 4]
size_m_per_s2 = 0.5
at_s = 5
"""


def test_a_file_describes_a_kind_of_imu_in_words_with_units(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(FILE)
    model, preset = load_imu(str(path)), load_imu("icm42688")
    assert model == replace(
        preset,
        name="mine",
        sample_rate=500.0,
        clock_error=0.01,
        jitter=1e-3 * 0.02,
        conversion_rate=8000.0,
        misalignment=radians(1.0) * 0.5,
        delay=0.002,
        accelerometer=replace(
            preset.accelerometer, bandwidth=100.0, order=2, reach=78.5, bias_per_kelvin=(0.001, 0.002),
            scale_per_kelvin=(0.01 * 0.002, 0.01 * 0.005), rectification=1.8e-4,
        ),
        gyroscope=replace(preset.gyroscope, noise=radians(1.0) * 0.01, bias=(radians(1.0) * 0.1, radians(1.0) * 0.3)),
        disturbances=(disturbance_of_text("imu-offset:0+3,axis=0/0.6/0.8,size_m_per_s2=0.5,at=5"),),
    )  # fmt: skip
    # Half a sample's wait, the delay, and the mean of both low-passes.
    section = 100.0 / sqrt(sqrt(2.0) - 1.0)
    assert model.latency == pytest.approx(0.001 + 0.002 + 0.5 * 2.0 / (2.0 * pi * section) + 0.5 / (2.0 * pi * 400.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("colour = 1", "has no entry 'colour'; it has based_on, grade, low_passes_hz, low_pass, disturbances, output"),
        ("[gyroscope]\nnoise = 1", "gyroscope. of .* has no entry 'noise'; it has noise_deg_per_s_per_root_hz"),
        ("[gyroscope]\norder = 5", "the order of a sensor is 5; it must be a whole number from 1 to 4"),
        ("[accelerometer]\nbias_m_per_s2 = 1", "it must be a list of two numbers"),
        ("[accelerometer]\nreach_m_per_s2 = 'far'", "is 'far'; it must be a number"),
        ("sample_rate_hz = -1", "the sample_rate of an IMU is -1.0"),
        ("clock_error_percent = 100", "its clock_error below 1"),
        ("[[disturbances]]\nkind = 'turn'\nimus = 3\nsize_deg = 1", "needs its axis: add x, -y, z, or a direction"),
        ("based_on = 'mpu6050'", "no IMU preset 'mpu6050'"),
        ("sample_rate_hz", "is not valid TOML"),
    ],
)
def test_what_is_wrong_in_a_file_is_told(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(GoughError, match=message):
        load_imu(str(path))
    with pytest.raises(InputError, match="cannot read"):
        load_imu(str(tmp_path / "none.toml"))


# ---- an eighth IMU, on the base ----


@pytest.mark.parametrize("name", ["mpu9150", "mpu9150-nominal"])
def test_an_imu_on_the_base_leaves_the_others_as_they_are(name: str) -> None:
    signals, model = np.random.default_rng(1).normal(size=(60, 3, 7, 3)), load_imu(name)
    alone, beside = imu_state(model, 5, PERIOD), imu_state(model, 5, PERIOD, on_base=True)
    np.testing.assert_array_equal(readings(alone, signals), readings(beside, signals))
    assert not alone["reading"][:, 7].any() and beside["reading"][:2, 7].all()


def test_an_imu_on_the_base_has_errors_of_its_own_and_reads_the_base() -> None:
    state, ideal = (
        imu_state(load_imu("mpu9150"), 5, PERIOD, on_base=True),
        imu_state(load_imu("ideal"), 5, PERIOD, on_base=True),
    )
    assert not (state["offset"][:, 7:] == state["offset"][:, :7]).all(axis=2).any()
    ideal["base"] = np.arange(9.0).reshape(3, 3)
    readings(ideal, constant(0.5, 3))
    np.testing.assert_array_equal(ideal["reading"][:, 7], np.arange(9.0).reshape(3, 3))
    np.testing.assert_array_equal(ideal["reading"][:, :7], 0.5)


def test_a_disturbance_of_the_imu_on_the_base_is_its_own() -> None:
    models = replace(load_imu("ideal"), disturbances=(disturbance_of_text("imu-offset:7,axis=x,size_m_per_s2=0.5"),))
    state = imu_state(models, 0, PERIOD, on_base=True)
    assert not readings(state, constant(0.0, 2)).any()
    np.testing.assert_array_equal(state["reading"][ACCELEROMETER, 7], [0.5, 0.0, 0.0])
    assert disturbance_of_text("imu-noise:all,size_m_per_s2=1,axis=all").imus == (*range(8),)
    with pytest.raises(InputError, match="there are 0 to 7"):
        disturbance_of_text("imu-offset:8,axis=x,size_m_per_s2=0.5")
