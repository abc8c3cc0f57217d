"""What is said of IMUs that alias, the settings of their low-passes, and conversions that are spared."""

from dataclasses import replace
from math import inf, pi
from typing import Any

import numpy as np
import pytest

from plant.errors import InputError
from plant.imu import (
    ACCELEROMETER,
    PRESETS,
    ImuModel,
    SensorErrors,
    add_disturbances,
    aliasing_remark,
    imu_state,
    load_imu,
    measure,
    sampled_noise,
)
from plant.imu.aliasing import low_pass_gain
from plant.imu.presets import imu_of_table
from plant.imu_disturbances import disturbance_of_text
from plant.pose import Array

G, PERIOD = 9.80665, 1e-3


def readings(model: ImuModel, seconds: float, *texts: str) -> Array:
    """Accelerations (N, 7, 3) of IMUs that stand upright, without their noise."""
    quiet = replace(model, accelerometer=replace(model.accelerometer, noise=0.0, resolution=0.0))
    state = imu_state(quiet, 0, PERIOD)
    add_disturbances(state, map(disturbance_of_text, texts))
    ideal = np.zeros((3, 7, 3))
    ideal[ACCELEROMETER, :, 2] = G
    measured = np.empty((round(seconds / PERIOD), 3, 7, 3))
    for reading in measured:
        measure(state, ideal, reading)
    return measured[:, ACCELEROMETER]


@pytest.mark.parametrize("name", PRESETS)
def test_at_1000_hz_no_preset_aliases(name: str) -> None:
    assert aliasing_remark(load_imu(name), 1000.0) == "" == aliasing_remark(load_imu(name), 4000.0)


def test_a_low_pass_that_is_wider_than_half_the_rate_is_said_with_the_remedy() -> None:
    calibrated = load_imu("mpu9150-calibrated")
    assert aliasing_remark(calibrated, 520.0) == ""
    remark = aliasing_remark(calibrated, 519.0)
    assert "accelerometers (260 Hz)" in remark and "gyroscopes" not in remark
    assert "519 samples a second" in remark and "at most 259.5 Hz" in remark
    # 1 / sqrt(1 + (519 / 260)^2)
    assert "by 45 % of its size" in remark
    assert "accelerometers (260 Hz) and gyroscopes (256 Hz)" in aliasing_remark(calibrated, 500.0)
    bare = ImuModel("bare", accelerometer=SensorErrors(noise=1e-3))
    assert "accelerometers (none)" in aliasing_remark(bare, 4000.0) and "by 100 % of" in aliasing_remark(bare, 4000.0)


def test_what_counts_is_the_slower_one_of_loop_and_imu() -> None:
    """A loop that takes every fourth sample of an IMU samples at its own rate."""
    nominal = load_imu("mpu9150-nominal")
    assert nominal.sample_rate == 1000.0
    assert "250 samples" in aliasing_remark(nominal, 250.0)
    assert "400 samples" in aliasing_remark(replace(nominal, sample_rate=400.0), 1000.0)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_the_gain_is_that_of_a_low_pass(order: int) -> None:
    sensor = SensorErrors(bandwidth=100.0, order=order)
    assert low_pass_gain(sensor, 100.0) == pytest.approx(np.sqrt(0.5))
    assert low_pass_gain(sensor, 0.0) == low_pass_gain(SensorErrors(), 1e6) == 1.0
    assert low_pass_gain(sensor, 1e6) / low_pass_gain(sensor, 2e6) == pytest.approx(2.0**order, rel=1e-3)


DELAYS_MS = ((2.0, 1.9), (3.0, 2.8), (4.9, 4.8), (8.5, 8.3), (13.8, 13.4), (19.0, 18.6))
"""Of the accelerometer and the gyroscope of the MPU-9150 by DLPF_CFG 1 to 6, in its register map."""


@pytest.mark.parametrize(("setting", "delays"), [*enumerate(DELAYS_MS, start=1)])
def test_no_other_order_comes_nearer_to_the_delays_of_the_data_sheet(setting: int, delays: tuple[float, float]) -> None:
    model = imu_of_table({"based_on": "mpu9150-calibrated", "low_pass": setting}, "mine", "mine.toml")

    def off(order: int) -> float:
        sections = [replace(sensor, order=order).section_bandwidth for sensor in (model.accelerometer, model.gyroscope)]
        return sum(abs(1e3 * order / (2.0 * pi * width) - delay) for width, delay in zip(sections, delays, strict=True))

    assert min(range(1, 5), key=off) == model.accelerometer.order == model.gyroscope.order


def test_the_settings_of_a_low_pass_are_the_data_sheets() -> None:
    def widths(kind: str, setting: Any) -> tuple[float, float]:
        model = imu_of_table({"based_on": kind, "low_pass": setting}, "mine", "mine.toml")
        assert model.low_passes == load_imu(kind).low_passes
        return model.gyroscope.bandwidth, model.accelerometer.bandwidth

    assert [widths("mpu9150", k) for k in (0, 2, 6)] == [(256.0, 260.0), (98.0, 94.0), (5.0, 5.0)]
    assert [widths("icm42688-nominal", k) for k in (0, 1, 7)] == [(500.0, 500.0), (250.0, 250.0), (25.0, 25.0)]
    # Setting 0 is that of the preset, and what else is given comes on top.
    assert replace(imu_of_table({"based_on": "mpu9150", "low_pass": 0}, "mpu9150", "")) == load_imu("mpu9150")
    wide = imu_of_table({"based_on": "mpu9150", "low_pass": 3, "gyroscope": {"bandwidth_hz": 90.0}}, "mine", "mine.toml")
    assert (wide.gyroscope.bandwidth, wide.accelerometer.bandwidth) == (90.0, 44.0)
    for kind, setting, text in (("mpu9150", 7, "0 to 6"), ("mpu9150", True, "0 to 6"), ("ideal", 0, "bandwidth_hz")):
        with pytest.raises(InputError, match=f"low_pass of mine.toml.*{text}"):
            widths(kind, setting)


@pytest.mark.parametrize("name", ["mpu9150-calibrated", "icm42688"])
@pytest.mark.parametrize("frequency", [90.0, 700.0, 999.9])
def test_a_preset_weighs_vibration_by_its_low_pass_before_it_aliases(name: str, frequency: float) -> None:
    model = load_imu(name)
    read = readings(model, 10.5, f"imu-vibration:all,axis=x,size_g=1,sine_hz={frequency}")[500:, 3, 0]
    phase = 2.0 * pi * abs(frequency - 1000.0 * round(frequency / 1000.0)) * PERIOD * np.arange(len(read))
    fitted = np.linalg.lstsq(np.stack([np.sin(phase), np.cos(phase), np.ones_like(phase)], axis=1), read, rcond=None)[0]
    # The interpolation between conversions at 8 kHz takes some away, too.
    assert np.hypot(*fitted[:2]) == pytest.approx(G * low_pass_gain(model.accelerometer, frequency), rel=0.06)


def test_conversions_are_spared_while_nothing_shakes() -> None:
    """Readings are then to the bit those of one conversion a sample; afterwards as good as."""
    calibrated = load_imu("mpu9150-calibrated")
    single = replace(calibrated, conversion_rate=0.0, sparing=False)
    assert calibrated.sparing and calibrated.conversion_rate == 8000.0
    offset = "imu-offset:all,axis=y,size_m_per_s2=1,at_s=0.05,ramp_s=0.1"
    for texts in ((), (offset,)):
        np.testing.assert_array_equal(readings(calibrated, 0.3, *texts), readings(single, 0.3, *texts))
    shaken = readings(calibrated, 0.3, "imu-vibration:2,axis=x,size_g=1,sine_hz=300,at_s=0.1,for_s=0.1")
    still = readings(single, 0.3)
    np.testing.assert_array_equal(shaken[:100], still[:100])
    np.testing.assert_array_equal(shaken[:, [0, 1, 3, 4, 5, 6]], still[:, [0, 1, 3, 4, 5, 6]])
    assert np.abs(shaken[110:200, 2, 0] - still[110:200, 2, 0]).max() > 0.3 * G
    np.testing.assert_allclose(shaken[215:, 2], still[215:, 2], atol=1e-6)


@pytest.mark.slow
def densities(model: ImuModel, period: float, every: int = 1) -> Array:
    """Of gyroscopes and accelerometers in every n-th cycle of a rest, at low frequencies."""
    state = imu_state(model, 1, period)
    measured, ideal = np.empty((4096 * every, 3, 7, 3)), np.zeros((3, 7, 3))
    for reading in measured:
        measure(state, ideal, reading)
    signal = measured[::every, :2].reshape(4096, 2, 21)
    power = np.abs(np.fft.rfft(signal - signal.mean(axis=0), axis=0)) ** 2 * 2.0 * every * period / 4096
    return np.sqrt(power[4:200].mean(axis=(0, 2)))


def expected(model: ImuModel, rate: float) -> list[float]:
    return [sampled_noise(model, sensor, rate) for sensor in (model.gyroscope, model.accelerometer)]


SHAKEN = disturbance_of_text("imu-vibration:all,axis=z,size_g=0,sine_hz=1")


@pytest.mark.parametrize("period", [0.001, 0.004, 0.008])
@pytest.mark.parametrize("kind", ["gyroscope", "accelerometer"])
def test_the_noise_of_spared_conversions_has_the_same_density(kind: str, period: float) -> None:
    """In a band that the low-pass lets through; what it leaves beyond half the rate of the samples aliases into it."""
    model, which = load_imu("mpu9150-calibrated"), ("gyroscope", "accelerometer").index(kind)
    spared, converted = (densities(replace(model, disturbances=each), period)[which] for each in ((), (SHAKEN,)))
    assert [spared, converted] == pytest.approx([expected(model, 1.0 / period)[which]] * 2, rel=0.03)
    assert spared != converted


@pytest.mark.parametrize("order", [1, 2, 4])
def test_noise_that_aliases_is_that_of_an_analog_low_pass(order: int) -> None:
    """Of samples that are rare, it is the variance of what leaves the low-pass, spread over half their rate."""
    sensor = SensorErrors(noise=0.3, bandwidth=200.0, order=order)
    found = sampled_noise(ImuModel("own", gyroscope=sensor, conversion_rate=48_000.0), sensor, 15.0)
    frequencies = np.linspace(0.0, 24_000.0, 480_001)
    passed = np.trapezoid((1.0 + (frequencies / sensor.section_bandwidth) ** 2) ** -order, frequencies)
    assert found == pytest.approx(0.3 * np.sqrt(passed / 7.5), rel=5e-3)


@pytest.mark.parametrize(
    ("changes", "every"),
    [
        ({"conversion_rate": 5000.0}, 1),  # an odd number
        ({"conversion_rate": 0.0}, 1),
        ({"conversion_rate": 0.0, "sample_rate": 1000.0}, 4),  # faster than the loop, which takes every fourth sample
        ({"conversion_rate": 8000.0, "sample_rate": 1000.0}, 4),
        ({"conversion_rate": 8000.0, "sample_rate": 250.0}, 1),  # slower than the loop
    ],
)
@pytest.mark.parametrize("bandwidth", [260.0, np.inf])
def test_parts_of_all_kinds_have_the_noise_that_is_expected(changes: dict[str, float], every: int, bandwidth: float) -> None:
    sensor = SensorErrors(noise=0.01, bandwidth=bandwidth)
    model = ImuModel("own", gyroscope=sensor, accelerometer=sensor, **changes)
    period = 1e-3 if every > 1 else 1.0 / (model.sample_rate or 1000.0)
    found = densities(model, period, every)
    assert found == pytest.approx(expected(model, 1.0 / (every * period)), rel=0.05)


def test_sparing_needs_no_conversions() -> None:
    assert not imu_state(ImuModel("bare", sparing=True), 0, PERIOD)["sparing"]
    assert SensorErrors().bandwidth == inf
