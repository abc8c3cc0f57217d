"""What the closed forms read of a mechanism and of its measured legs, and the memory in which they work.

A leg along the unit vector r gives `skew(r) (p + R a - b) = 0`, of rank two. The closed forms write it with two unit vectors
across the leg: the same least-squares problem with two rows for each leg instead of three.
"""

from functools import lru_cache

import numpy as np

from plant.compiled import Record, kernel, record_dtype
from plant.mechanism import LEGS, Mechanism, six_rows
from plant.mechanism.checks import SAME_JOINT_M
from plant.pose import Array
from plant.vectors import Vector, dot, scale, subtract

MOST_FREE = 5  # parameters that the legs' equations may leave open for the equations of a rotation to settle
ROTATION_EQUATIONS = 20  # that the elements of a rotation obey, quadratic ones

_SETS = 1 << LEGS
# Greatest rank that is used of the legs' equations. With three parameters open, the equations of a rotation settle those with
# a sixth of the error that the last three pivots of a 6-6 mechanism would bring.
LINEAR_RANK = 9

GEOMETRY = record_dtype(
    base_joints=(np.float64, (LEGS, 3)),  # [m]
    platform_joints=(np.float64, (LEGS, 3)),  # [m]
    platform_numbers=(np.int64, LEGS),  # the first leg of each leg's platform joint
    centers=(np.float64, (_SETS, 3)),  # of the platform joints of a set of legs [m]
    axes=(np.float64, (_SETS, 3, 3)),  # in columns, of which the first two span the plane of these joints
    spreads=(np.float64, _SETS),  # the joints' root mean square distance from the centre [m]
    bulges=(np.float64, _SETS),  # the share of the spread by which the joints leave their plane
    ranks=(np.int64, _SETS),  # of the legs' equations for p and R
)
"""The joints of a mechanism, and what follows from them for each set of legs. Leg k has bit k in the number of a set."""

SCRATCH = record_dtype(
    matrix=(np.float64, (ROTATION_EQUATIONS, ROTATION_EQUATIONS)),
    right=(np.float64, ROTATION_EQUATIONS),
    unknowns=(np.float64, ROTATION_EQUATIONS),
    span=(np.float64, (1 + MOST_FREE, 12)),
    norms=(np.float64, ROTATION_EQUATIONS),
    order=(np.float64, ROTATION_EQUATIONS),
    points=(np.float64, (LEGS, 3)),
    selected=(np.float64, LEGS),
    second_root=(np.float64, 12),
    roots=np.int64,  # how many `pose_from_legs` found
    approximate=np.int64,  # whether it took joints for coplanar that are so only approximately
    misfit=np.float64,  # how far its matrix was from a rotation
)
"""Memory for the closed forms, which allocate nothing."""

_OUT_OF_THE_WAY = (0.0, 0.0, -1.0)  # base joint [m] of legs that a planar mechanism lacks: no row has the length zero


@lru_cache(maxsize=256)
def geometry_of(mechanism: Mechanism) -> Record:
    """What the closed forms read of a mechanism, a record of dtype `GEOMETRY`."""
    geometry = np.zeros((), GEOMETRY)
    platform = six_rows(mechanism.platform_joints)
    apart = np.linalg.norm(platform[:, None] - platform, axis=2)
    geometry["base_joints"], geometry["platform_joints"] = six_rows(mechanism.base_joints, _OUT_OF_THE_WAY), platform
    geometry["platform_numbers"] = numbers = np.argmax(apart < SAME_JOINT_M, axis=1)
    geometry["spreads"] = 1.0
    for number in range(1, _SETS):
        legs = [leg for leg in range(LEGS) if number >> leg & 1]
        center = platform[legs].mean(axis=0)
        _, spread, axes = np.linalg.svd(platform[legs] - center)
        axes[2] *= np.sign(np.linalg.det(axes))
        size = float(np.linalg.norm(spread))
        geometry["centers"][number], geometry["axes"][number] = center, axes.T
        if size > SAME_JOINT_M:
            geometry["spreads"][number] = size / np.sqrt(len(legs))
            if len(legs) > 3:
                geometry["bulges"][number] = spread[2] / size
        # Two legs of one platform joint already fix it as a point: further legs add nothing to the rank.
        geometry["ranks"][number] = min(LINEAR_RANK, int(np.minimum(2 * np.bincount(numbers[legs]), 3).sum()))
    return geometry[()]


@kernel
def set_number(measured: Array) -> int:
    """Number of a set of legs, given as (6,) with 0 for the legs that are not in it."""
    number = 0
    for k in range(LEGS):
        if measured[k] != 0.0:
            number += 1 << k
    return number


@kernel
def across(direction: Array) -> tuple[Vector, Vector]:
    """Two unit vectors that span the plane across a unit vector (Duff et al. 2017, with the sign of z)."""
    x, y, z = direction[0], direction[1], direction[2]
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


@kernel
def across_leg(direction: Vector, v: Vector) -> Vector:
    """What a vector has across a unit vector, `P v` with P = I - d d^T."""
    return subtract(v, scale(dot(direction, v), direction))
