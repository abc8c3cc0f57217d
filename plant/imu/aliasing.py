"""Aliasing: vibration and noise that a sensor's low-pass does not take away before it is sampled."""

from math import hypot, inf, sqrt

import numpy as np

from plant.imu.model import MOST_CONVERSIONS, ImuModel, SensorErrors


def low_pass_gain(sensor: SensorErrors, frequency: float) -> float:
    """The share of a vibration of this frequency [Hz] that passes a sensor's low-pass."""
    return hypot(1.0, frequency / sensor.section_bandwidth) ** -sensor.order


def sampled_noise(model: ImuModel, sensor: SensorErrors, rate: float) -> float:
    """The noise density of a sensor's samples that are taken at this rate [Hz], with what aliases of it [unit/sqrt(Hz)].

    This is the density at low frequencies. Noise beyond half of this rate adds to it, as far as the low-pass takes in faster
    conversions and lets it through, or the part samples faster. A sensor without a low-pass has noise up to half the rate of
    its own samples.
    """
    sampled = min(model.sample_rate or rate, rate)
    taken = model.sample_rate if sensor.bandwidth == inf else max(model.sample_rate, model.conversion_rate)
    aliases = min(max(1, round(taken / sampled)), MOST_CONVERSIONS)
    before, share = sensor.smoothing(1.0 / (aliases * sampled))
    delay = np.exp(-2j * np.pi * np.arange(aliases) / aliases)
    passed = np.abs((share + before * delay) / (1.0 - (1.0 - before - share) * delay)) ** (2 * sensor.order)
    return float(sensor.noise * sqrt(passed.sum()))


def aliasing_remark(model: ImuModel, rate: float) -> str:
    """What a user should know of a kind of IMU that aliases in a loop of this rate [Hz], in a line; "" of others.

    Samples cannot tell an alias from motion, so that the loop cannot see it: a vibration near the rate of the samples reads as
    a slow tilt. A sensor aliases if its low-pass is wider than half of that rate. Sensors without any errors are no real ones.
    """
    sampled = min(model.sample_rate or rate, rate)
    sensors = {
        name: sensor
        for name, sensor in (("accelerometers", model.accelerometer), ("gyroscopes", model.gyroscope))
        if sensor.bandwidth > 0.5 * sampled and sensor != SensorErrors()
    }
    if not sensors:
        return ""
    names = " and ".join(
        f"{name} (" + (f"{sensor.bandwidth:g} Hz" if sensor.bandwidth < inf else "none") + ")"
        for name, sensor in sensors.items()
    )
    share = max(low_pass_gain(sensor, sampled) for sensor in sensors.values())
    return (
        f"vibration can alias: the low-pass of the {names} is wider than half of the {sampled:g} samples a second, so that "
        f"vibration near {sampled:g} Hz reads as slow motion, by {100.0 * share:.0f} % of its size: choose a low-pass of at "
        f"most {0.5 * sampled:g} Hz (low_pass or bandwidth_hz in a file for --imu; docs/imus.md), or a higher rate"
    )
