"""Parts as their data sheets describe them: words, units, contradictions, what is missing, grades, parts."""

from dataclasses import replace
from math import radians, sqrt
from pathlib import Path

import numpy as np
import pytest

from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from plant.errors import InputError
from plant.imu import ACCELEROMETER, GYROSCOPE, MILLI_G, PRESETS, STANDARD_GRAVITY, imu_state, load_imu, measure
from plant.imu.model import ImuModel
from plant.pose import pose_errors

PARTS = ("bmi088", "icm20948", "lsm6dso")

SHEET = """
output_data_rate = "2 kHz"
clock_tolerance = "300 ppm"

[gyroscope]
full_scale = "±2000 °/s"
noise_density = "8 mdps/√Hz"

[accelerometer]
full_scale = "+-16 g"
noise_density = "160 µg/√Hz"
"""


def described(folder: Path, text: str) -> ImuModel:
    (folder / "part.toml").write_text(text, encoding="utf-8")
    return load_imu(str(folder / "part.toml"))


def accelerometer(folder: Path, *lines: str) -> ImuModel:
    return described(folder, SHEET + "\n".join(lines))


def test_words_of_a_data_sheet_give_the_fields_in_si_units(tmp_path: Path) -> None:
    model = accelerometer(
        tmp_path, 'sensitivity = "2048 LSb/g"', "bits = 16", 'zero_level = ["20 mg", "0.05 g"]',
        'zero_level_drift = "0.2 mg/°C"', 'zero_level_supply = "7 mg/V"',
        'sensitivity_tolerance = "±0.5 %"', 'sensitivity_drift = "100 ppm/K"',
        'cross_axis = "1 %"', 'bandwidth = "0.4 kHz"', "order = 2", "rectification_per_m_per_s2 = 1e-4",
    )  # fmt: skip
    sensor = model.accelerometer
    assert (model.sample_rate, model.clock_error) == (2000.0, pytest.approx(3e-4))
    assert model.gyroscope.reach == pytest.approx(radians(2000.0)) and model.gyroscope.noise == pytest.approx(radians(0.008))
    assert sensor.reach == pytest.approx(16.0 * STANDARD_GRAVITY) and sensor.noise == pytest.approx(0.16 * MILLI_G)
    assert sensor.resolution == pytest.approx(STANDARD_GRAVITY / 2048.0)
    assert sensor.bias == pytest.approx((20.0 * MILLI_G, 50.0 * MILLI_G))
    assert sensor.bias_per_kelvin == pytest.approx((0.1 * MILLI_G, 0.1 * MILLI_G))
    assert sensor.bias_per_volt == pytest.approx((3.5 * MILLI_G, 3.5 * MILLI_G))
    assert sensor.scale_per_kelvin == pytest.approx((5e-5, 5e-5))
    assert (sensor.scale, sensor.cross_axis) == pytest.approx((0.005, 0.01))
    assert (sensor.bandwidth, sensor.order, sensor.rectification) == (400.0, 2, 1e-4)


@pytest.mark.parametrize(
    ("same", "other"),
    [
        ("0.122 mg/LSB", "8196.7 LSB/g"),
        ("122 ug/LSB", "0.0011964 m/s^2/LSB"),
        ("0.122mg/LSB", "8196.7LSB/(g)"),
    ],
)
def test_units_of_a_sensitivity_say_the_same(tmp_path: Path, same: str, other: str) -> None:
    steps = [accelerometer(tmp_path, f'sensitivity = "{each}"').accelerometer.resolution for each in (same, other)]
    assert steps[0] == pytest.approx(steps[1], rel=1e-4) == pytest.approx(0.122 * MILLI_G, rel=1e-4)


def test_bits_alone_give_the_step_of_the_reading(tmp_path: Path) -> None:
    assert accelerometer(tmp_path, "bits = 16").accelerometer.resolution == pytest.approx(16.0 * STANDARD_GRAVITY / 32768.0)


def test_a_random_walk_is_a_noise_density(tmp_path: Path) -> None:
    """ADIS16470, revision C: 0.34 deg/sqrt(h) and 0.008 deg/s/sqrt(Hz) are one figure."""
    walk = SHEET.replace('noise_density = "8 mdps/√Hz"', 'random_walk = "0.34 °/√hr"')
    assert described(tmp_path, walk).gyroscope.noise == pytest.approx(radians(0.008), rel=0.005)
    both = SHEET.replace('noise_density = "8 mdps/√Hz"', 'noise_density = "8 mdps/√Hz"\nrandom_walk = "0.34 °/√hr"')
    assert described(tmp_path, both).gyroscope.noise == pytest.approx(radians(0.008))


def test_the_allan_deviation_is_least_at_the_bias_instability(tmp_path: Path) -> None:
    text = SHEET.replace('noise_density = "8 mdps/√Hz"', 'noise_density = "8 mdps/√Hz"\nbias_instability = "36 °/h"')
    model, every = described(tmp_path, text.replace('"2 kHz"', '"50 Hz"')), 0.02
    state, ideal, read = imu_state(model, 1, every), np.zeros((3, 7, 3)), np.empty((30_000, 3, 7, 3))
    for reading in read:
        measure(state, ideal, reading)
    rates = np.degrees(read[:, GYROSCOPE].reshape(len(read), 21))
    deviations = []
    for samples in (4, 8, 16, 32, 64, 128, 256):
        means = rates[: len(rates) // samples * samples].reshape(-1, samples, 21).mean(axis=1)
        deviations.append(sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2)))
    # Noise alone would give 0.0025 deg/s in the end, and the walk 0.001 deg/s at the beginning.
    assert min(deviations) == pytest.approx(0.01, rel=0.05)
    assert min(deviations) < 0.8 * min(deviations[0], deviations[-1])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('zero_level = "20"', "zero_level of .accelerometer. of .* is '20'; its unit must be one of g, mg, ug"),
        ('zero_level = "20 mdps"', "is '20 mdps'; its unit must be one of g, mg, ug, m/s2, mm/s2"),
        ("zero_level = 20", 'zero_level of .* is 20; it must be a number and its unit, such as "4 g"'),
        ('zero_level = "-20 mg"', "it must be a number and its unit"),
        ('random_walk = "1 m/s/√h"', "random_walk and noise_density of .* contradict each other: '1 m/s/√h' is 15 times '160"),
        (
            'sensitivity = "8192 LSB/g"\nbits = 16',
            "sensitivity, bits and full_scale .* contradict each other: .* reach 0.25 times",
        ),
        ('sensitivity = "0 LSB/g"', "it must be positive"),
        ("bits = 16.5", "bits of .* is 16.5; it must be a whole number from 8 to 32"),
        ("noise_m_per_s2_per_root_hz = 1e-3", "has noise_density and noise_m_per_s2_per_root_hz, which say the same"),
        ('bandwith = "100 Hz"', "has no entry 'bandwith'; it has .* did you mean 'bandwidth'"),
    ],
)
def test_what_contradicts_or_cannot_be_read_is_told(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        accelerometer(tmp_path, line)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[gyroscope]\nfull_scale = "250 dps"', "has no noise_density or random_walk"),
        ('[gyroscope]\nnoise_density = "5 mdps/√Hz"', "has no full_scale"),
        ('grade = "best"', "grade of .* is 'best'; it must be one of raw, calibrated, nominal"),
        ('output_data_rate = "1 kHz"\nsample_rate_hz = 1000', "output_data_rate and sample_rate_hz, which say the same"),
        ("low_passes_hz = [[100, 100]]", "low_passes_hz of .* it must be a list of settings"),
        (
            'low_pass = 0\nlow_passes_hz = [[9, 9, 1]]\n[gyroscope]\nbandwidth = "9 Hz"',
            "low_pass, and bandwidth in .gyroscope.",
        ),
    ],
)
def test_what_is_missing_is_told(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        described(tmp_path, text)


def test_a_part_has_nothing_left_of_what_its_file_is_based_on(tmp_path: Path) -> None:
    model = described(tmp_path, f'based_on = "mpu9150"{SHEET}')
    assert (model.accelerometer.bias, model.accelerometer.bias_per_volt, model.low_passes) == ((0.0, 0.0), (0.0, 0.0), ())
    assert model.magnetometer == load_imu("mpu9150").magnetometer and model.misalignment == load_imu("mpu9150").misalignment


def test_grades_of_a_file_are_those_of_the_presets(tmp_path: Path) -> None:
    for grade in ("calibrated", "nominal"):
        assert described(tmp_path, f'based_on = "mpu9150"\ngrade = "{grade}"') == replace(
            load_imu(f"mpu9150-{grade}"), name="part"
        )
    graded = described(tmp_path, f'grade = "calibrated"{SHEET}bias_m_per_s2 = [0.1, 0.1]')
    assert graded.accelerometer.bias == (0.1, 0.1), "single figures come on top"
    assert graded.gyroscope.bias == load_imu("mpu9150-calibrated").gyroscope.bias
    own = described(tmp_path, f'grade = "nominal"{SHEET}')
    assert (own.sample_rate, own.clock_error) == (2000.0, pytest.approx(3e-4)), "the part's own clock stays"


def test_parts_have_the_figures_of_their_data_sheets() -> None:
    """Noise [deg/s, mg per root of Hz], step [1/(deg/s), 1/g], bias [deg/s, mg], bandwidths [Hz], typical values."""
    for name, noise, steps, bias, bandwidths in (
        ("bmi088", (0.014, 0.175), (131.072, 5460.0), (1.0, 20.0), (230.0, 280.0)),
        ("icm20948", (0.015, 0.23), (131.0, 8192.0), (5.0, 50.0), (196.6, 246.0)),
        ("lsm6dso", (0.0038, 0.075), (1.0 / 8.75e-3, 1.0 / 0.122e-3), (1.0, 20.0), (300.0, 416.0)),
    ):
        for model in (load_imu(name), load_imu(f"{name}-calibrated"), load_imu(f"{name}-nominal")):
            sensors, units = (model.gyroscope, model.accelerometer), (radians(1.0), STANDARD_GRAVITY)
            assert (sensors[0].noise / radians(1.0), sensors[1].noise / MILLI_G) == pytest.approx(noise)
            assert [unit / each.resolution for each, unit in zip(sensors, units, strict=True)] == pytest.approx(steps)
            assert (sensors[0].bandwidth, sensors[1].bandwidth) == bandwidths
        raw = load_imu(name)
        assert (raw.gyroscope.bias[1] / radians(1.0), raw.accelerometer.bias[1] / MILLI_G) == pytest.approx(bias)
        assert load_imu(f"{name}-nominal").sample_rate == 1000.0 and load_imu(f"{name}-nominal").disturbances
    assert load_imu("icm20948").magnetometer.resolution == 0.15


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
def test_the_loop_runs_with_each_part(part: str) -> None:
    """Calibrated and nominal ones follow to a millimetre; of a raw one the readings alone are looked at."""
    for grade in ("-calibrated", "-nominal"):
        result = simulate(SimulationConfig(target="sines", duration=0.5, imu=part + grade))
        records, moving = result.records, result.times >= 0.0
        pose = records["position"], records["rotation"]
        errors = pose_errors(*pose, result.true_positions, result.true_rotations)[moving].reshape(-1, 2, 3)
        position, rotation = np.linalg.norm(errors, axis=2).max(axis=0)
        assert position < 1.5e-3 and np.degrees(rotation) < 0.5, grade
        assert result.records["imus"].all()
    state, ideal, read = imu_state(PRESETS[part], 1, 1e-3), np.zeros((3, 7, 3)), np.empty((500, 3, 7, 3))
    ideal[ACCELEROMETER, :, 2] = STANDARD_GRAVITY
    for reading in read:
        measure(state, ideal, reading)
    offsets = np.linalg.norm(read[:, GYROSCOPE].mean(axis=0), axis=1)
    assert offsets == pytest.approx(PRESETS[part].gyroscope.bias[1], rel=0.1)
