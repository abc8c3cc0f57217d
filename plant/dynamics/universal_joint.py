"""A universal joint whose axes do not meet.

The first axis e1 is fixed in the base. The second one, e2, is square to e1 and to the leg, and lies beyond the first by an
offset along `w = (r - k e1) / d`, the part of r that is square to e1; r is the vector from base joint to platform joint,
k = e1 . r and d = |r - k e1|. The leg points from the second axis to its platform joint. With `turn' = e2 . r' / d`,
`w' = turn' e2` and `e2' = -turn' w`.
"""

from dataclasses import dataclass

import casadi as ca

SX = ca.SX


@dataclass(frozen=True)
class Reach:
    """The vector (3, 1) from the second axis to the platform joint, and its velocity; its acceleration is `slope r'' + bias`.

    r is the vector from the base joint, and `beyond`, with its velocity, that from there to the second axis.
    """

    s: SX
    velocity: SX
    slope: SX
    bias: SX
    beyond: SX
    beyond_velocity: SX


def reach_at(r: SX, velocity: SX, e1: SX, offset: SX) -> Reach:
    """From the vector r (3, 1) between base and platform joint, and its velocity."""
    k = ca.dot(e1, r)
    across = r - k * e1
    inverse = ca.sqrt(1 / ca.dot(across, across))
    w = across * inverse
    e2 = ca.cross(w, e1)
    turning = ca.dot(e2, velocity) * inverse
    growth = ca.dot(w, velocity) * inverse
    beyond, beyond_velocity = offset * w, offset * turning * e2
    return Reach(
        s=r - beyond,
        velocity=velocity - beyond_velocity,
        slope=SX.eye(3) - (offset * inverse) * (e2 @ e2.T),
        bias=offset * turning * (2 * growth * e2 + turning * w),
        beyond=beyond,
        beyond_velocity=beyond_velocity,
    )
