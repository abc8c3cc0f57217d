"""The platform's roll-pitch filter: a Kalman filter for the vertical seen in {2}.

State (6): the unit vertical u in {2} and the gyroscope's bias [rad/s]. The vertical turns with `u' = u x (rate - bias)`,
and once the platform's own acceleration is taken out the accelerometer measures `g u`.
"""

import numpy as np

from plant.compiled import kernel
from plant.pose import Array

STATES = 6
TILT_SIGMA = 0.15
"""What is known of the vertical after the first sample [rad]."""

INNOVATION_LIMIT = 3.0
"""Innovations are cut to this many standard deviations: a jolt between two samples, as when the brakes open, is in the
accelerometer's reading but not in the acceleration known from the legs."""


@kernel
def start_platform(x: Array, covariance: Array, accelerometer: Array, bias_sigma: float) -> None:
    """Start the filter from its first sample, taking the force for gravity."""
    norm = np.sqrt(accelerometer[0] ** 2 + accelerometer[1] ** 2 + accelerometer[2] ** 2)
    for i in range(STATES):
        x[i] = accelerometer[i] / norm if i < 3 else 0.0
        for j in range(STATES):
            covariance[i, j] = 0.0
        covariance[i, i] = TILT_SIGMA**2 if i < 3 else bias_sigma**2


@kernel
def step_platform(
    x: Array, covariance: Array, gyroscope: Array, accelerometer: Array, acceleration: Array, period: float, gravity: float,
    rate_density: float, bias_walk: float, vertical_variance: float, transition: Array, work: Array, gain: Array, change: Array,
) -> None:  # fmt: skip
    """Take one sample [rad/s, m/s^2] into state and covariance.

    Args:
        acceleration: (3,) [m/s^2], of the IMU itself without gravity, in {2}; it is taken out of the reading.
        rate_density, bias_walk: spectral densities of the gyroscope's noise and of its bias.
        vertical_variance: of each component of the accelerometer's reading over g.
        transition, work, gain, change: scratch (6, 6), (6, 6), (6,), (6,).
    """
    w0, w1, w2 = gyroscope[0] - x[3], gyroscope[1] - x[4], gyroscope[2] - x[5]
    u0, u1, u2 = x[0], x[1], x[2]
    t = period
    c0, c1, c2 = u1 * w2 - u2 * w1, u2 * w0 - u0 * w2, u0 * w1 - u1 * w0
    half = 0.5 * t * t
    x[0] += t * c0 + half * (c1 * w2 - c2 * w1)
    x[1] += t * c1 + half * (c2 * w0 - c0 * w2)
    x[2] += t * c2 + half * (c0 * w1 - c1 * w0)
    for i in range(STATES):
        change[i] = 0.0
        for j in range(STATES):
            transition[i, j] = 1.0 if i == j else 0.0
    transition[0, 1], transition[0, 2] = t * w2, -t * w1
    transition[1, 0], transition[1, 2] = -t * w2, t * w0
    transition[2, 0], transition[2, 1] = t * w1, -t * w0
    transition[0, 4], transition[0, 5] = t * u2, -t * u1
    transition[1, 3], transition[1, 5] = -t * u2, t * u0
    transition[2, 3], transition[2, 4] = t * u1, -t * u0
    # The lower half of the transition is the identity.
    for i in range(3):
        for j in range(STATES):
            total = 0.0
            for k in range(STATES):
                total += transition[i, k] * covariance[k, j]
            work[i, j] = total
    for i in range(3, STATES):
        for j in range(STATES):
            work[i, j] = covariance[i, j]
    for i in range(STATES):
        for j in range(i + 1):
            total = work[i, j]
            if j < 3:
                total = 0.0
                for k in range(STATES):
                    total += work[i, k] * transition[j, k]
            covariance[i, j] = total
            covariance[j, i] = total
    for i in range(3):
        covariance[i, i] += rate_density * t
        covariance[3 + i, 3 + i] += bias_walk * t
    for m in range(3):
        innovation = (accelerometer[m] - acceleration[m]) / gravity - x[m] - change[m]
        variance = covariance[m, m] + vertical_variance
        bound = INNOVATION_LIMIT * np.sqrt(variance)
        innovation = min(max(innovation, -bound), bound)
        inverse = 1.0 / variance
        for i in range(STATES):
            gain[i] = covariance[i, m]
        for i in range(STATES):
            k = gain[i] * inverse
            change[i] += k * innovation
            for j in range(STATES):
                covariance[i, j] -= k * gain[j]
    for i in range(STATES):
        x[i] += change[i]
    norm = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    for i in range(3):
        x[i] /= norm
