"""Which IMU contradicts the others, while the loop runs: one IMU is looked at in each cycle.

If this IMU alone is wrong, by f in the plane across its direction, the residual of the refined pose is r = S f with
S = 1 - w J A^-1 J^T, where J is its Jacobian, w its weight and A the information of all; then f = S^-1 r, and it
explains w f^T r of the sum of squares. `controller.direct_kinematics.consistency` finds the same from poses without each IMU.
"""

import numpy as np

from controller.least_squares import solve_cholesky
from controller.settings import SafetySettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import Vector, cross, dot, rotate, scale, subtract, vector

_CONTRADICTION_S = 0.03
"""Time constant of the low-pass on an IMU's contradiction, and how long a contradiction must last [s]."""

_LARGEST_SHARE, _LEAST_LOOKS = 0.25, 3
"""At low rates: the largest share of one look in the low-pass, and for how many looks a contradiction must last."""

_SLOW_HZ = 300.0
"""Below this rate the filters' directions are less exact."""

PARAMETERS = record_dtype(
    active=np.int64,  # whether IMUs are compared
    disagreement=np.float64,  # limit of a contradiction [rad]
    smoothing=np.float64,  # share of a new look
    lasting=np.float64,  # how long a contradiction must last [s]
)
"""Constants of the monitor."""

STATE = record_dtype(
    looked_at=np.int64,  # the IMU that was looked at last
    contradiction=(np.float64, (IMU_COUNT, 3)),  # how far each IMU is off what the others say, in {1}, low-passed [rad]
    explained=(np.float64, IMU_COUNT),  # how much of the residuals' sum of squares that explains, low-passed
    squares=(np.float64, IMU_COUNT),  # each IMU's own part of that sum, low-passed
    jacobian=(np.float64, (2, 6)),  # from here on scratch
    solved=(np.float64, (2, 6)),
)
"""State of the monitor."""

_LEAST_SHARE = 0.08
"""How much of an error must show in the residuals for it to be told from those of others."""


def monitor_parameters(settings: SafetySettings, rate: float) -> Record:
    """The constants of the monitor (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    return filled(
        PARAMETERS,
        active=settings.watch_imus,
        disagreement=settings.disagreement * max(1.0, _SLOW_HZ / rate),
        # Each IMU's turn comes in every seventh cycle.
        smoothing=min(IMU_COUNT / (rate * _CONTRADICTION_S), _LARGEST_SHARE),
        lasting=max(_CONTRADICTION_S, _LEAST_LOOKS * IMU_COUNT / rate),
    )


@kernel
def look_at_next(p: Record, m: Record, pose: Record, measured: Array, leg_weights: Array, vertical_in_base: Array) -> None:
    """Look at the next IMU's contradiction at a refined pose.

    Args:
        p, m: dtypes `PARAMETERS` and `STATE`.
        pose: state of the pose estimator: the pose, its legs, the Cholesky factor, its weights, and the measured vertical.
        measured, leg_weights: (6, 3) and (6,), the legs' measured directions and their weights.
        vertical_in_base: (3,), unit.
    """
    k = m.looked_at = (m.looked_at + 1) % IMU_COUNT
    platform, leg = k == PLATFORM_IMU, min(k, LEGS - 1)
    weight = pose.vector_weights[0] if platform else leg_weights[leg]
    if not weight > 0.0:
        reset(m, k)
        return
    reduced = pose.weights[LEGS if platform else leg]
    direction = rotate(pose.rotation, vector(pose.vectors[0])) if platform else vector(pose.directions[leg])
    known = vector(vertical_in_base) if platform else vector(measured[leg])
    first, second = _across(direction)
    # A component across the direction changes with the pose by t^T [1, -skew(arm)] / l for a leg, and by [0, v x t] for the
    # vertical, which is turned with the platform.
    for n in range(2):
        t = first if n == 0 else second
        length = pose.lengths[leg]
        turn = cross(direction, t) if platform else scale(1.0 / length, cross(vector(pose.arms[leg]), t))
        for i in range(3):
            m.jacobian[n, i] = 0.0 if platform else t[i] / length
            m.jacobian[n, 3 + i] = turn[i]
        m.solved[n] = m.jacobian[n]
        solve_cholesky(pose.factor, m.solved[n])
    s00 = s11 = 1.0
    s01 = 0.0
    for i in range(6):
        s00 -= reduced * m.jacobian[0, i] * m.solved[0, i]
        s01 -= reduced * m.jacobian[0, i] * m.solved[1, i]
        s11 -= reduced * m.jacobian[1, i] * m.solved[1, i]
    least = 0.5 * (s00 + s11) - np.sqrt(0.25 * (s00 - s11) ** 2 + s01 * s01)
    off = subtract(known, direction)
    r0, r1 = dot(first, off), dot(second, off)
    if not (least > _LEAST_SHARE and np.isfinite(r0 + r1)):
        reset(m, k)
        return
    determinant = s00 * s11 - s01 * s01
    f0, f1 = (s11 * r0 - s01 * r1) / determinant, (s00 * r1 - s01 * r0) / determinant
    for i in range(3):
        m.contradiction[k, i] += p.smoothing * (f0 * first[i] + f1 * second[i] - m.contradiction[k, i])
    m.explained[k] += p.smoothing * (weight * (f0 * r0 + f1 * r1) - m.explained[k])
    m.squares[k] += p.smoothing * (weight * (r0 * r0 + r1 * r1) - m.squares[k])


@kernel
def reset(monitor: Record, k: int) -> None:
    """Begin anew with IMU `k`."""
    monitor.contradiction[k] = 0.0
    monitor.explained[k] = 0.0
    monitor.squares[k] = 0.0


@kernel
def contradiction(monitor: Record, k: int) -> float:
    """By how much IMU `k` is off what the others say [rad]."""
    c = vector(monitor.contradiction[k])
    return float(np.sqrt(dot(c, c)))


@kernel
def _across(direction: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors across a unit vector, the first in the plane of the axis that it is farthest from."""
    least = 0
    for i in range(1, 3):
        if abs(direction[i]) < abs(direction[least]):
            least = i
    norm = np.sqrt(1.0 - direction[least] ** 2)
    axis = 1.0 if least == 0 else 0.0, 1.0 if least == 1 else 0.0, 1.0 if least == 2 else 0.0
    x, y, z = subtract(axis, scale(direction[least], direction))
    first = x / norm, y / norm, z / norm
    return first, cross(direction, first)
