"""Play between motor and rod: the backlash of the screw, and the clearance of the joints.

A leg's load lies along it, and so does the play that the load moves: clearance of the joints counts like backlash of the
screw. A leg with play has a motor that is a body of its own. It pushes the rod by the flanks of its screw, beyond half of the
play on either side. A leg without play is one body with its motor.
"""

from dataclasses import dataclass

import casadi as ca

SX = ca.SX


PLAYS = ("screw.backlash", "joint.clearance")
"""The parameters that add up to the play of a leg."""


def width_of(c: dict[str, SX]) -> SX:
    """The play of each leg (n, 1) [m]."""
    return c["screw.backlash"] + c["joint.clearance"]


def play_under(force: SX, c: dict[str, SX]) -> SX:
    """How far the motors (n, 1) are ahead of the middle of their play while they push the rods by a force (n, 1)."""
    width = width_of(c)
    return (width > 0) * (force / c["screw.stiffness"] + ca.sign(force) * width / 2)


@dataclass(frozen=True)
class Play:
    """The play of n legs at one instant, (n, 1) each.

    `loose` is 1 where there is play, else 0; `speed` [m/s] is that of the motor ahead of the rod; `force` [N] pushes the rod.
    """

    loose: SX
    speed: SX
    force: SX


def play_at(x: dict[str, SX], c: dict[str, SX]) -> Play:
    """The play, from states and constants."""
    width = width_of(c)
    loose = width > 0
    ahead, speed = x["state.play"], loose * x["state.play_velocity"]
    return Play(loose, speed, loose * contact(ahead - width / 2, speed, c) - loose * contact(-ahead - width / 2, -speed, c))


def contact(depth: SX, speed: SX, c: dict[str, SX]) -> SX:
    """Hunt and Crossley's contact of the flanks, which never pulls."""
    return c["screw.stiffness"] * ca.fmax(depth, 0) * ca.fmax(1 + c["screw.damping"] * speed, 0)
