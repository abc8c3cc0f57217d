"""Which IMU contradicts the others, while the loop runs: one IMU is looked at in each cycle.

If this IMU alone is wrong, by f in the plane across its direction, the residual of the refined pose is r = S f with
S = 1 - w J A^-1 J^T, where J is its Jacobian, w its weight and A the information of all; then f = S^-1 r, and it
explains w f^T r of the sum of squares. `controller.direct_kinematics.integrity` finds the same from poses without each IMU.
"""

import numpy as np

from controller.least_squares import solve_cholesky
from controller.settings import SafetySettings
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.pose import Array

_CONTRADICTION_S = 0.03
"""Time constant of the low-pass on an IMU's contradiction, and how long a contradiction must last [s]."""

_LARGEST_SHARE, _LEAST_LOOKS = 0.25, 3
"""At low rates: the largest share of one look in the low-pass, and for how many looks a contradiction must last."""

_SLOW_HZ = 300.0
"""Below this rate the filters' directions are less exact."""

PARAMETERS = record_dtype(
    active=np.int64,
    disagreement=np.float64,
    smoothing=np.float64,
    lasting=np.float64,
)
"""Whether IMUs are compared; the limit of a contradiction [rad]; the share of a new look; how long it must last [s]."""

STATE = record_dtype(
    looked_at=np.int64,
    contradiction=(np.float64, (IMU_COUNT, 3)),
    explained=(np.float64, IMU_COUNT),
    squares=(np.float64, IMU_COUNT),
    across=(np.float64, (2, 3)),
    jacobian=(np.float64, (2, 6)),
    solved=(np.float64, (2, 6)),
    direction=(np.float64, 3),
)
"""State of the monitor.

Fields:
    looked_at: the IMU that was looked at last.
    contradiction: by how much each IMU's direction is off what the others say, a vector in {1} [rad], low-passed.
    explained, squares: how much of the residuals' sum of squares that explains, and the IMU's own part of it, low-passed.
    across, jacobian, solved, direction: scratch.
"""

_LEAST_SHARE = 0.08
"""How much of an error must show in the residuals for it to be told from those of others."""


def monitor_parameters(settings: SafetySettings, rate: float) -> Record:
    """The constants of the monitor (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    parameters: Record = np.zeros((), PARAMETERS)
    parameters["active"], parameters["disagreement"] = settings.watch_imus, settings.disagreement * max(1.0, _SLOW_HZ / rate)
    # Each IMU's turn comes in every seventh cycle.
    parameters["smoothing"] = min(IMU_COUNT / (rate * _CONTRADICTION_S), _LARGEST_SHARE)
    parameters["lasting"] = max(_CONTRADICTION_S, _LEAST_LOOKS * IMU_COUNT / rate)
    return parameters


@kernel
def look_at_next(
    p: Record, monitor: Record, pose: Record, measured: Array, leg_weights: Array, vertical_in_base: Array
) -> None:
    """Look at the next IMU's contradiction at a refined pose.

    Args:
        p, monitor: dtypes `PARAMETERS` and `STATE`.
        pose: state of the pose estimator: the pose, its legs, the Cholesky factor, and the measured vertical.
        measured, leg_weights: (6, 3) and (6,), the legs' measured directions and their weights.
        vertical_in_base: (3,), unit.
    """
    m = monitor
    k = m.looked_at = (m.looked_at + 1) % IMU_COUNT
    platform = k == PLATFORM_IMU
    weight = pose.vector_weights[0] if platform else leg_weights[k]
    determinant = least = 0.0
    s00 = s01 = s11 = 0.0
    if weight > 0.0:
        for i in range(3):
            m.direction[i] = 0.0 if platform else pose.directions[k, i]
            if platform:
                for j in range(3):
                    m.direction[i] += pose.rotation[i, j] * pose.vectors[0, j]
        _find_across(m.direction, m.across)
        for n in range(2):
            _find_jacobian(m, n, platform, pose.arms[min(k, 5)], pose.lengths[min(k, 5)])
            m.solved[n] = m.jacobian[n]
            solve_cholesky(pose.factor, m.solved[n])
        s00 = s11 = 1.0
        for i in range(6):
            s00 -= weight * m.jacobian[0, i] * m.solved[0, i]
            s01 -= weight * m.jacobian[0, i] * m.solved[1, i]
            s11 -= weight * m.jacobian[1, i] * m.solved[1, i]
        determinant = s00 * s11 - s01 * s01
        least = 0.5 * (s00 + s11) - np.sqrt(0.25 * (s00 - s11) ** 2 + s01 * s01)
    if not least > _LEAST_SHARE:
        reset(monitor, k)
        return
    r0 = r1 = 0.0
    for i in range(3):
        off = vertical_in_base[i] - m.direction[i] if platform else measured[k, i] - m.direction[i]
        r0 += m.across[0, i] * off
        r1 += m.across[1, i] * off
    if not np.isfinite(r0 + r1):
        reset(monitor, k)
        return
    f0, f1 = (s11 * r0 - s01 * r1) / determinant, (s00 * r1 - s01 * r0) / determinant
    for i in range(3):
        m.contradiction[k, i] += p.smoothing * (f0 * m.across[0, i] + f1 * m.across[1, i] - m.contradiction[k, i])
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
    c = monitor.contradiction[k]
    return float(np.sqrt(c[0] * c[0] + c[1] * c[1] + c[2] * c[2]))


@kernel
def _find_across(direction: Array, across: Array) -> None:
    """Two unit vectors (2, 3) across a unit vector, the first in the plane of the axis that it is farthest from."""
    least = 0
    for i in range(1, 3):
        if abs(direction[i]) < abs(direction[least]):
            least = i
    norm = np.sqrt(1.0 - direction[least] ** 2)
    for i in range(3):
        across[0, i] = ((1.0 if i == least else 0.0) - direction[least] * direction[i]) / norm
    _cross(direction, across[0], across[1], 1.0)


@kernel
def _find_jacobian(monitor: Record, n: int, platform: bool, arm: Array, length: float) -> None:
    """How a component across the direction changes with the pose: for a leg t^T [1, -skew(arm)] / l, for the vertical that is
    turned with the platform [0, v x t].
    """
    m = monitor
    t, row = m.across[n], m.jacobian[n]
    for i in range(3):
        row[i] = 0.0 if platform else t[i] / length
    if platform:
        _cross(m.direction, t, row[3:], 1.0)
    else:
        _cross(arm, t, row[3:], 1.0 / length)


@kernel
def _cross(a: Array, b: Array, product: Array, scale: float) -> None:
    product[0] = scale * (a[1] * b[2] - a[2] * b[1])
    product[1] = scale * (a[2] * b[0] - a[0] * b[2])
    product[2] = scale * (a[0] * b[1] - a[1] * b[0])
