"""Kinds of IMUs by name: presets with the figures of data sheets, and TOML files that change them or describe a part."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from importlib import resources
from math import radians
from pathlib import Path
from typing import Any

import numpy as np

from plant.checks import nearest
from plant.errors import InputError, UnknownNameError
from plant.files import check_entries, parse_toml, read_toml, toml_entries
from plant.imu.data_sheet import IMU_WORDS, SENSOR_WORDS, figure, sensor_of_words, words_for
from plant.imu.model import MILLI_G, MOST_SECTIONS, STANDARD_GRAVITY, ImuModel, SensorErrors
from plant.imu_disturbances import SENSORS, disturbance, disturbance_of_table, words_of

_MPU9150_LOW_PASSES = (
    (256.0, 260.0, 1), (188.0, 184.0, 4), (98.0, 94.0, 4), (42.0, 44.0, 2), (20.0, 21.0, 1), (10.0, 10.0, 1), (5.0, 5.0, 1),
)  # fmt: skip
"""DLPF_CFG of the MPU-9150 (register map RM-MPU-9150A, register 26), with the order that comes nearest to its delays."""

_ICM42688_LOW_PASSES = tuple((width, width, 2) for width in (500.0, 250.0, 200.0, 125.0, 100.0, 62.5, 50.0, 25.0))
"""GYRO_UI_FILT_BW and ACCEL_UI_FILT_BW of the ICM-42688-P at 1000 samples a second (DS-000347); the order as after a reset."""

# InvenSense MPU-9150, +-4 g, +-250 deg/s, widest filter, as in its product specification; with iron of a motor beside it. It
# has the dies of the MPU-6050, whose specification gives, off 25 C, 20 deg/s and 2 % over -40 to 85 C, 35 mg over 0 to 70 C,
# 0.02 %/K, and 0.2 deg/s for 0.1 V of supply. Assumed, as no data sheet tells: half of each is common to all IMUs, and the
# accelerometer's supply counts 7 mg/V.
_MPU9150 = ImuModel(
    "mpu9150",
    gyroscope=SensorErrors(
        noise=radians(0.005), bias=(radians(20.0), radians(20.0)), scale=0.03, cross_axis=0.02,
        bandwidth=256.0, reach=radians(250.0), resolution=radians(1.0 / 131.0),
        bias_per_kelvin=(radians(0.15), radians(0.15)), scale_per_kelvin=(1.6e-4, 1.6e-4),
        bias_per_volt=(radians(1.0), radians(1.0)),
    ),
    accelerometer=SensorErrors(
        noise=0.4 * MILLI_G, bias=(50.0 * MILLI_G, 80.0 * MILLI_G), scale=0.03, cross_axis=0.02,
        bandwidth=260.0, reach=4.0 * STANDARD_GRAVITY, resolution=STANDARD_GRAVITY / 8192.0,
        bias_per_kelvin=(0.4 * MILLI_G, 0.4 * MILLI_G), scale_per_kelvin=(1e-4, 1e-4),
        bias_per_volt=(3.5 * MILLI_G, 3.5 * MILLI_G),
    ),
    magnetometer=SensorErrors(noise=0.05, bias=(20.0, 20.0), scale=0.05, cross_axis=0.05, reach=1200.0, resolution=0.3),
    magnetometer_rate=100.0,
    misalignment=radians(1.0),
    conversion_rate=8000.0,
    low_passes=_MPU9150_LOW_PASSES,
    sparing=True,
)  # fmt: skip


def _calibrated(model: ImuModel) -> ImuModel:
    """The kind with constant errors as a calibration on the rig leaves them."""
    return replace(
        model,
        name=f"{model.name}-calibrated",
        gyroscope=replace(model.gyroscope, bias=(radians(0.2), radians(0.2)), scale=0.0, cross_axis=0.0),
        accelerometer=replace(model.accelerometer, bias=(MILLI_G, MILLI_G), scale=1e-3, cross_axis=0.0),
        magnetometer=replace(model.magnetometer, bias=(0.3, 0.3), scale=5e-3, cross_axis=5e-3),
        misalignment=0.0,
    )


_CALIBRATED = _calibrated(_MPU9150)

# TDK ICM-42688-P after the same calibration; it has no magnetometer, so the MPU-9150's is used. Its data sheet gives, from 0 to
# 70 C, 0.005 deg/s and 0.15 mg per kelvin, and 0.005 %/K for both; the supply counts as in the MPU-9150, by a tenth.
_ICM42688 = replace(
    _CALIBRATED,
    name="icm42688",
    gyroscope=replace(
        _CALIBRATED.gyroscope, noise=radians(0.0028), bandwidth=400.0,
        bias_per_kelvin=(radians(0.0025), radians(0.0025)), scale_per_kelvin=(2.5e-5, 2.5e-5),
        bias_per_volt=(radians(0.1), radians(0.1)),
    ),
    accelerometer=replace(
        _CALIBRATED.accelerometer, noise=0.07 * MILLI_G, bandwidth=400.0,
        bias_per_kelvin=(0.075 * MILLI_G, 0.075 * MILLI_G), scale_per_kelvin=(2.5e-5, 2.5e-5),
        bias_per_volt=(0.35 * MILLI_G, 0.35 * MILLI_G),
    ),
    low_passes=_ICM42688_LOW_PASSES,
)  # fmt: skip

_NOMINAL_LIFE = (
    disturbance("temperature", imus="all", size_k=3.0, settle_s=300.0),
    disturbance("vibration", imus="all", axis="1/1/1", size_g=0.02, sine_hz=173.0),
    disturbance("supply", imus="all", size_v=0.02, sine_hz=0.7),
)
"""3 K warmer with the time constant of a rig's housing, drives that shake by 0.02 g, and a supply that gives way by 20 mV."""


def _nominal(model: ImuModel) -> ImuModel:
    """The kind after a calibration, with its imperfections of nominal size: a clock of its own, conversions, rectification,
    and `_NOMINAL_LIFE`.

    Where the kind does not say it, it takes 1000 samples a second of 8000 conversions, and clocks are 1 % off, as the
    MPU-6050's specification and the ICM-42688-P's data sheet allow. Rectification is that of the ADXL357 (at most 0.1 g for
    7.5 g RMS), as none of them tells.
    """
    calibrated = _calibrated(model)
    return replace(
        calibrated,
        name=f"{model.name}-nominal",
        accelerometer=replace(calibrated.accelerometer, rectification=1.8 * MILLI_G / STANDARD_GRAVITY**2),
        sample_rate=model.sample_rate or 1000.0,
        clock_error=model.clock_error or 0.01,
        jitter=20e-6,
        conversion_rate=model.conversion_rate or 8000.0,
        sparing=False,
        disturbances=_NOMINAL_LIFE,
    )


GRADES: dict[str, Callable[[ImuModel], ImuModel]] = {
    "raw": lambda model: model,
    "calibrated": _calibrated,
    "nominal": _nominal,
}
"""What a file's `grade` makes of a kind."""

PRESETS = {
    model.name: model
    for model in (
        ImuModel("ideal"), _MPU9150, _CALIBRATED, _ICM42688, _nominal(_MPU9150),
        _nominal(replace(
            _ICM42688,
            gyroscope=replace(_ICM42688.gyroscope, order=2),
            accelerometer=replace(_ICM42688.accelerometer, order=2),
        )),
    )
}  # fmt: skip


def load_imu(name: str) -> ImuModel:
    """The preset of that name, or the kind that a TOML file describes.

    Raises:
        UnknownNameError: there is neither.
        InputError: the file cannot be used.
    """
    if name in PRESETS:
        return PRESETS[name]
    if not name.endswith(".toml"):
        question = nearest(name, PRESETS)
        raise UnknownNameError(f"no IMU preset {name!r}; there are {', '.join(PRESETS)}, or a TOML file{question}")
    return imu_of_table(read_toml(name), Path(name).stem, name)


WORDS = {
    "magnetometer_rate_hz": ("magnetometer_rate", 1.0),
    "misalignment_deg": ("misalignment", radians(1.0)),
    "delay_ms": ("delay", 1e-3),
    "dropout": ("dropout", 1.0),
    "sample_rate_hz": ("sample_rate", 1.0),
    "clock_error_percent": ("clock_error", 0.01),
    "jitter_ms": ("jitter", 1e-3),
    "conversion_rate_hz": ("conversion_rate", 1.0),
}
"""The words of an IMU's file: the field, and the factor to its unit."""


def sensor_words(unit: str, factor: float) -> dict[str, tuple[str, float]]:
    """The words of a sensor in its file: the field, and the factor to its unit."""
    return {
        f"noise_{unit}_per_root_hz": ("noise", factor),
        f"bias_{unit}": ("bias", factor),
        "scale_percent": ("scale", 0.01),
        "cross_axis_percent": ("cross_axis", 0.01),
        f"drift_{unit}_per_root_s": ("drift", factor),
        "bandwidth_hz": ("bandwidth", 1.0),
        "order": ("order", 1),
        f"reach_{unit}": ("reach", factor),
        f"resolution_{unit}": ("resolution", factor),
        f"bias_{unit}_per_k": ("bias_per_kelvin", factor),
        "scale_percent_per_k": ("scale_per_kelvin", 0.01),
        f"bias_{unit}_per_v": ("bias_per_volt", factor),
        f"rectification_per_{unit}": ("rectification", 1.0 / factor),
    }


UNITS = {"gyroscope": ("deg_per_s", radians(1.0)), "accelerometer": ("m_per_s2", 1.0), "magnetometer": ("ut", 1.0)}
_PAIRS = ("bias", "bias_per_kelvin", "scale_per_kelvin", "bias_per_volt")


def imu_of_table(table: Mapping[str, Any], name: str, title: str) -> ImuModel:
    """The kind of IMU that the content of a TOML file describes; messages call it `title`.

    What is said in the words of a data sheet comes first, then `low_pass`, then `grade`; single figures come on top.

    Raises:
        GoughError: an entry is unknown or out of range, figures contradict each other, or a data sheet's lacks one.
    """
    check_entries(
        table, ("based_on", "grade", "low_passes_hz", "low_pass", "disturbances", *IMU_WORDS, *WORDS, *SENSORS), title
    )
    model = _of_data_sheet(table, load_imu(table.get("based_on", "ideal")), title)
    if "low_pass" in table:
        model = _with_low_pass(model, table["low_pass"], title)
    if "grade" in table:
        if table["grade"] not in GRADES:
            raise InputError(f"grade of {title} is {table['grade']!r}; it must be one of {', '.join(GRADES)}")
        model = GRADES[table["grade"]](model)
    changes = _values({word: value for word, value in table.items() if word in WORDS}, WORDS, title)
    for sensor in (sensor for sensor in SENSORS if sensor in table):
        words = sensor_words(*UNITS[sensor])
        single = {word: value for word, value in table[sensor].items() if word in words}
        changes[sensor] = replace(getattr(model, sensor), **_values(single, words, f"[{sensor}] of {title}"))
    if "disturbances" in table:
        changes["disturbances"] = tuple(disturbance_of_table(each) for each in table["disturbances"])
    return replace(model, name=name, **changes)


def text_of_imu(model: ImuModel) -> str:
    """The TOML text of a kind of IMU, which `imu_of_table` reads again, to rounding."""
    # Only a kind that is sparing makes another one so.
    lines = toml_entries(
        {
            "based_on": _MPU9150.name if model.sparing else "ideal",
            "low_passes_hz": model.low_passes,
            **_entries(model, WORDS),
        }
    )
    for sensor in SENSORS:
        lines += ["", f"[{sensor}]", *toml_entries(_entries(getattr(model, sensor), sensor_words(*UNITS[sensor])))]
    for each in model.disturbances:
        lines += ["", "[[disturbances]]", *toml_entries(words_of(each))]
    return "\n".join(lines) + "\n"


def _entries(of: ImuModel | SensorErrors, words: Mapping[str, tuple[str, float]]) -> dict[str, Any]:
    """The fields that words stand for, in the words' units."""
    values = {word: (np.array(getattr(of, field)), factor) for word, (field, factor) in words.items()}
    return {word: value if factor == 1.0 else value / factor for word, (value, factor) in values.items()}


def _of_data_sheet(table: Mapping[str, Any], model: ImuModel, title: str) -> ImuModel:
    """A kind of IMU with all that a file says of it in the words of a data sheet."""
    changes: dict[str, Any] = {}
    for word, (field, units) in IMU_WORDS.items():
        if word in table:
            _refuse_both(table, word, WORDS, field, title)
            changes[field] = figure(table[word], units, f"{word} of {title}")
    for sensor in (sensor for sensor in SENSORS if sensor in table):
        words, where = sensor_words(*UNITS[sensor]), f"[{sensor}] of {title}"
        check_entries(table[sensor], (*words, *words_for(sensor)), where)
        if not any(word in SENSOR_WORDS for word in table[sensor]):
            continue
        for word, field in SENSOR_WORDS.items():
            if word in table[sensor]:
                _refuse_both(table[sensor], word, words, field, where)
        if "low_pass" in table and "bandwidth" in table[sensor]:
            raise InputError(f"{title} gives low_pass, and bandwidth in [{sensor}]: leave one of them out")
        fields = sensor_of_words(table[sensor], sensor, where)
        # The settings of a low-pass are those of another part.
        changes |= {sensor: SensorErrors(**fields), "low_passes": ()}
    if "low_passes_hz" in table:
        changes["low_passes"] = _low_passes(table["low_passes_hz"], title)
    return replace(model, **changes)


def _refuse_both(table: Mapping[str, Any], word: str, others: Mapping[str, tuple[str, float]], field: str, title: str) -> None:
    """Refuse a table with a word of a data sheet and another word for the same field."""
    for other in (other for other, (of, _) in others.items() if of == field and other in table):
        raise InputError(f"{title} has {word} and {other}, which say the same: leave one of them out")


def _low_passes(settings: Any, title: str) -> tuple[tuple[float, float, int], ...]:
    """The settings of a part's low-pass that a file lists."""

    def good(setting: Any) -> bool:
        return (
            isinstance(setting, list)
            and len(setting) == 3
            and all(type(each) in (int, float) and each > 0.0 for each in setting)
            and setting[2] in range(1, MOST_SECTIONS + 1)
        )

    if not isinstance(settings, list) or not all(map(good, settings)):
        raise InputError(
            f"low_passes_hz of {title} is {settings!r}; it must be a list of settings: bandwidth of gyroscope and of "
            f"accelerometer, and order from 1 to {MOST_SECTIONS}"
        )
    return tuple((float(gyroscope), float(accelerometer), int(order)) for gyroscope, accelerometer, order in settings)


def _with_low_pass(model: ImuModel, setting: Any, title: str) -> ImuModel:
    """A kind of IMU with another setting of its own low-pass."""
    if type(setting) is not int or not 0 <= setting < len(model.low_passes):
        last = len(model.low_passes) - 1
        known = f"those of {model.name} are 0 to {last}" if last >= 0 else f"{model.name} has none: give bandwidth_hz and order"
        raise InputError(f"low_pass of {title} is {setting!r}, which is no setting; {known}")
    of_gyroscope, of_accelerometer, order = model.low_passes[setting]
    return replace(
        model,
        gyroscope=replace(model.gyroscope, bandwidth=of_gyroscope, order=order),
        accelerometer=replace(model.accelerometer, bandwidth=of_accelerometer, order=order),
    )


def _values(table: Mapping[str, Any], words: Mapping[str, tuple[str, float]], title: str) -> dict[str, Any]:
    """The fields that a table gives, in their units."""
    values: dict[str, Any] = {}
    for word, value in table.items():
        field, factor = words[word]
        numbers = value if isinstance(value, list) else [value]
        count = 2 if field in _PAIRS else 1
        if (
            len(numbers) != count
            or isinstance(value, list) != (count > 1)
            or not all(type(each) in (int, float) for each in numbers)
        ):
            raise InputError(
                f"{word} of {title} is {value!r}; it must be {'a number' if count == 1 else 'a list of two numbers'}"
            )
        scaled = tuple(factor * each for each in numbers)
        values[field] = scaled if count > 1 else scaled[0]
    return values


def _parts() -> Iterator[ImuModel]:
    """The parts that come as data sheets in `parts`, raw."""
    for file in sorted((resources.files("plant.imu") / "parts").iterdir(), key=lambda file: file.name):
        yield imu_of_table(parse_toml(file.read_text(encoding="utf-8"), file.name), Path(file.name).stem, file.name)


PRESETS |= {model.name: model for part in _parts() for model in (grade(part) for grade in GRADES.values())}
