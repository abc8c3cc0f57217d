"""Aliasing: vibration and noise that a sensor's low-pass does not take away before it is sampled."""

from math import sqrt

from plant.imu.model import ImuModel, SensorErrors


def low_pass_gain(sensor: SensorErrors, frequency: float) -> float:
    """The share of a vibration of this frequency [Hz] that passes a sensor's low-pass."""
    return float((1.0 + (frequency / sensor.section_bandwidth) ** 2) ** (-0.5 * sensor.order))


def sampled_noise(model: ImuModel, sensor: SensorErrors, rate: float) -> float:
    """The noise density of a sensor's samples when they are taken at this rate [Hz], with what aliases of it [unit/sqrt(Hz)].

    Where a sample is of several conversions, noise beyond half the rate of samples adds to the noise below it.
    """
    sampled = min(model.sample_rate or rate, rate)
    conversions = max(1, round(model.conversion_rate / sampled))
    passed = (low_pass_gain(sensor, k * sampled) for k in range(-(conversions // 2), conversions - conversions // 2))
    return sensor.noise * sqrt(sum(gain**2 for gain in passed))


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
        f"{name} (" + (f"{sensor.bandwidth:g} Hz" if sensor.bandwidth < float("inf") else "none") + ")"
        for name, sensor in sensors.items()
    )
    share = max(low_pass_gain(sensor, sampled) for sensor in sensors.values())
    return (
        f"vibration can alias: the low-pass of the {names} is wider than half of the {sampled:g} samples a second, so that "
        f"vibration near {sampled:g} Hz reads as slow motion, by {100.0 * share:.0f} % of its size: choose a low-pass of at "
        f"most {0.5 * sampled:g} Hz (low_pass or bandwidth_hz in a file for --imu; docs/imus.md), or a higher rate"
    )
