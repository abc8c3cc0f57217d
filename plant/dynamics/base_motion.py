"""A prescribed motion of the base: what it does to the field of gravity, and the acceleration that it adds to every body.

The equations of motion are seen in {1}. While {1} turns with `omega` and `alpha`, a body at r with the velocity v in {1} has
the acceleration `v' + carry r + 2 omega x v` beyond that of the origin of {1}, with `carry = [alpha]x + [omega]x [omega]x`.
"""

from dataclasses import dataclass

import casadi as ca

SX = ca.SX

_NO_ANGLE = 1e-20
"""Added to the square of an angle [rad^2], so that its root has a derivative at zero."""


@dataclass(frozen=True)
class BaseMotion:
    """The motion of {1} at one instant, (3, 1) each but `carry`; all are seen in {1}.

    `gravity` is what a body at rest on the origin of {1} feels: gravity less the acceleration of that origin.
    """

    gravity: SX
    magnetic_field: SX
    omega: SX
    alpha: SX
    carry: SX  # (3, 3)

    def acceleration(self, place: SX, velocity: SX) -> SX:
        """What the turning of {1} adds to the acceleration of a point (3, 1), beside that of the origin of {1}."""
        return self.carry @ place + 2 * ca.cross(self.omega, velocity)

    def imu_signals(self, place: SX) -> dict[str, SX]:
        """Ideal signals (3, 1) of an IMU that is fixed to the base at `place` (3, 1), with the axes of {1}; by their names."""
        return {"base_imu_angular_velocity": self.omega, "base_imu_specific_force": self.carry @ place - self.gravity}


def base_motion(motion: dict[str, SX], constants: dict[str, SX]) -> BaseMotion:
    """The motion of {1} from the inputs `base_motion`, and from gravity and magnetic field in the constants."""
    turn, omega, alpha = (motion[f"base_motion.{name}"] for name in ("rotation", "angular_velocity", "angular_acceleration"))
    half = ca.sqrt(ca.dot(turn, turn) + _NO_ANGLE) / 2
    share = ca.sin(half) / half
    skew = ca.skew(omega)

    def in_base(v: SX) -> SX:
        """By Rodrigues' formula; the rotation of the base turns {1} vectors the other way."""
        across = ca.cross(turn, v)
        return v - share * ca.cos(half) * across + share**2 / 2 * ca.cross(turn, across)

    return BaseMotion(
        gravity=in_base(constants["gravity"]) - motion["base_motion.acceleration"],
        magnetic_field=in_base(constants["magnetic_field"]),
        omega=omega,
        alpha=alpha,
        carry=ca.skew(alpha) + skew @ skew,
    )
