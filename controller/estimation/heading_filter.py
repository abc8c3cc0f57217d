"""The platform's heading filter: a Kalman filter for the horizontal part of the magnetic field, seen in {2}.

State (4): its unit vector n in {2}, across the vertical u, and what the platform filter leaves of the gyroscope's bias about u
[rad/s]. n turns with `n' = n x rate`, and the magnetometer measures it with the vertical taken out: that is its tilt
compensation. Errors (2) are the angle about u by which the true n is turned from the estimate, and that of the bias.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from controller.estimation.platform_filter import INNOVATION_LIMIT
from controller.estimation.readings import tilt_rotation
from controller.settings import FusionSettings
from plant.compiled import kernel
from plant.mechanism import Mechanism
from plant.pose import Array

STATES = 4
ERRORS = 2
_LEAST_HORIZONTAL = 1e-9


@dataclass(frozen=True, eq=False)
class MagneticField:
    """The magnetic field of the earth at a mechanism.

    Attributes:
        vectors: (2, 3), the vertical and the field's horizontal direction, as unit vectors in {1}.
        horizontal, vertical: its components, the second positive upwards [uT].
    """

    vectors: Array
    horizontal: float
    vertical: float

    @property
    def strength(self) -> float:
        """[uT]."""
        return float(np.hypot(self.horizontal, self.vertical))

    def heading_variance(self, fusion: FusionSettings, rate: float) -> float:
        """Of the heading that a sample of the magnetometer tells, in cycles of this rate [Hz]; in rad^2."""
        return fusion.magnetometer_noise**2 * min(fusion.magnetometer_rate, rate) / 2.0 / self.horizontal**2


def field_of(mechanism: Mechanism, tilt: ArrayLike = (0.0, 0.0)) -> MagneticField:
    """The field in the plant data of a mechanism, next to none without; `tilt` (2,) [rad] turns it with the vertical."""
    up, field = mechanism.up_in_base, mechanism.plant.get("magnetic_field", np.zeros(3))
    vertical = float(field @ up)
    across = field - vertical * up
    horizontal = max(float(np.linalg.norm(across)), _LEAST_HORIZONTAL)
    vectors: Array = np.stack([up, across / horizontal]) @ tilt_rotation(tilt).T
    return MagneticField(vectors, horizontal, vertical)


@kernel
def start_heading(x: Array, covariance: Array, field: Array, vertical: Array, variance: float, bias_sigma: float) -> None:
    """Start from the first sample of the field (3,) [uT] and the vertical (3,); `variance` is that of the angle [rad^2]."""
    for i in range(3):
        x[i] = field[i]
    x[3] = 0.0
    _level(x, vertical)
    covariance[0, 0], covariance[1, 1] = variance, bias_sigma**2
    covariance[0, 1] = covariance[1, 0] = 0.0


@kernel
def predict_heading(
    x: Array, covariance: Array, vertical: Array, rate: Array, period: float, rate_density: float, bias_walk: float
) -> None:
    """Carry the state on by `period` [s], in which the vertical (3,) has come to be what it is.

    Args:
        rate: (3,) [rad/s], less the bias that the platform filter knows.
        rate_density, bias_walk: spectral densities of the gyroscope's noise and of its bias.
    """
    t, b = period, x[3]
    w0, w1, w2 = rate[0] - b * vertical[0], rate[1] - b * vertical[1], rate[2] - b * vertical[2]
    n0, n1, n2 = x[0], x[1], x[2]
    c0, c1, c2 = n1 * w2 - n2 * w1, n2 * w0 - n0 * w2, n0 * w1 - n1 * w0
    half = 0.5 * t * t
    x[0] += t * c0 + half * (c1 * w2 - c2 * w1)
    x[1] += t * c1 + half * (c2 * w0 - c0 * w2)
    x[2] += t * c2 + half * (c0 * w1 - c1 * w0)
    _level(x, vertical)
    # Too large a bias turns n too far against the rate: the angle's error grows by that of the bias.
    mixed = covariance[0, 1] + t * covariance[1, 1]
    covariance[0, 0] += t * (covariance[0, 1] + mixed) + t * rate_density
    covariance[0, 1] = covariance[1, 0] = mixed
    covariance[1, 1] += t * bias_walk


@kernel
def update_heading(x: Array, covariance: Array, field: Array, vertical: Array, variance: float) -> None:
    """Take a sample of the field (3,) [uT], whose horizontal part has an angle of this variance [rad^2]."""
    n0, n1, n2, u0, u1, u2 = x[0], x[1], x[2], vertical[0], vertical[1], vertical[2]
    e0, e1, e2 = u1 * n2 - u2 * n1, u2 * n0 - u0 * n2, u0 * n1 - u1 * n0
    along = n0 * field[0] + n1 * field[1] + n2 * field[2]
    aside = e0 * field[0] + e1 * field[1] + e2 * field[2]
    total = covariance[0, 0] + variance
    bound = INNOVATION_LIMIT * np.sqrt(total)
    innovation = min(max(np.arctan2(aside, along), -bound), bound)
    k0, k1 = covariance[0, 0] / total, covariance[0, 1] / total
    sine, cosine = np.sin(k0 * innovation), np.cos(k0 * innovation)
    x[0], x[1], x[2] = cosine * n0 + sine * e0, cosine * n1 + sine * e1, cosine * n2 + sine * e2
    x[3] += k1 * innovation
    covariance[1, 1] -= k1 * covariance[0, 1]
    covariance[0, 0] *= 1.0 - k0
    covariance[0, 1] *= 1.0 - k0
    covariance[1, 0] = covariance[0, 1]


@kernel
def _level(x: Array, vertical: Array) -> None:
    """Make n a unit vector across the vertical."""
    along = x[0] * vertical[0] + x[1] * vertical[1] + x[2] * vertical[2]
    size = 0.0
    for i in range(3):
        x[i] -= along * vertical[i]
        size += x[i] * x[i]
    size = np.sqrt(size)
    for i in range(3):
        x[i] /= size
