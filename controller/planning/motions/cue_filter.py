"""The washout of motion cueing for a vehicle's motion as it comes, sample by sample."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from controller.planning.motions.cueing import Site, Washout, advance, at_rest
from controller.planning.motions.waves import checked_number
from plant.imu.model import STANDARD_GRAVITY
from plant.pose import Array, checked_array, quaternion_from_rotation

_SHARES = np.linspace(0.0, 1.0, 33)
"""Shares of a move that are tried at once."""

_USED_VELOCITY = 0.9
"""Share of a leg's velocity that a streamed cue may use; what follows it needs the rest to catch up."""

_SPARE_M = 1e-6
"""What a streamed cue leaves of every stroke [m]."""


@dataclass
class Kept:
    """What a streamed cue was kept from.

    Attributes:
        samples: how many there were.
        clipped: how many had an acceleration or an angular velocity that was clipped.
        tilt_clipped, tilt_slowed: how many wanted a steeper, and a faster tilt.
        stroke: how many would have left a stroke, and were brought back towards the beginning.
        excess: by how much at most [m], and by which leg.
        slowed: how many would have moved a leg faster than it can.
        speed: that a leg would have had at most [m/s].
    """

    samples: int = 0
    clipped: int = 0
    tilt_clipped: int = 0
    tilt_slowed: int = 0
    stroke: int = 0
    excess: float = 0.0
    leg: int = -1
    slowed: int = 0
    speed: float = 0.0


class CueFilter:
    """The causal washout, sample by sample; every pose that it gives is within the strokes, and no leg is too fast.

    Attributes:
        kept: what it was kept from so far.

    Args:
        washout: settings.
        site: where it begins.
    """

    def __init__(self, washout: Washout, site: Site) -> None:
        self._site, self._parameters, self._state = site, site.filter(washout), at_rest()
        self._moves: Array = np.zeros(6)
        self._lengths = site.lengths(np.zeros((1, 6)))[0]
        self._stroke = site.limits.stroke + np.array([_SPARE_M, -_SPARE_M])
        self.kept = Kept()
        # Loads the machine code.
        advance(self._parameters, at_rest(), np.zeros(3), np.zeros(3), 1.0, 1e-3)

    def step(self, force: ArrayLike, rate: ArrayLike, time: float, gravity: bool = False) -> tuple[Array, Array]:
        """Go on for a time [s], in which the vehicle comes to this motion.

        Args:
            force: (3,), acceleration of the vehicle along its axes, or with `gravity` its specific force [m/s^2].
            rate: (3,), its angular velocity [rad/s].
            time: since the last sample [s].
            gravity: as it says.

        Returns:
            Position (3,) and unit quaternion (4,), as the motion has them.

        Raises:
            InputError: the sample is not finite, or the time not positive.
        """
        p, s = self._parameters, self._state
        force, rate = checked_array(force, (3,), "the acceleration"), checked_array(rate, (3,), "the angular velocity")
        checked_number(time, "the time since the last sample", 1e-9)
        force = force - STANDARD_GRAVITY * self._site.up * gravity
        advance(p, s, np.array(force), np.array(rate), 1.0, time)
        kept = self.kept
        kept.samples += 1
        kept.clipped += bool(
            (np.abs(s["wanted"]) > p["most_acceleration"]).any()
            or (np.abs(p["turn_scale"] * rate) > p["most_turn_speed"]).any()
        )
        kept.tilt_clipped += bool(s["wanted_sine"] > p["steepest"])
        kept.tilt_slowed += bool(s["lagging"])
        self._moves = self._slowed(self._confined(np.concatenate([s["move"], s["turn"]])), time)
        positions, rotations = self._site.poses(self._moves[None])
        return positions[0], quaternion_from_rotation(rotations[0])

    def _excess(self, lengths: Array) -> Array:
        excess: Array = np.maximum(self._stroke[:, 0] - lengths, lengths - self._stroke[:, 1])
        return excess

    def _confined(self, moves: Array) -> Array:
        """The share of moves (6,) that leaves no stroke."""
        excess = self._excess(self._site.lengths(moves[None])[0])
        if excess.max() <= 0.0:
            return moves
        self.kept.stroke += 1
        if excess.max() > self.kept.excess:
            self.kept.excess, self.kept.leg = float(excess.max()), int(excess.argmax())
        low, high = 0.0, 1.0
        for _ in range(3):
            shares = low + (high - low) * _SHARES
            inside = self._excess(self._site.lengths(shares[:, None] * moves)).max(axis=1) <= 0.0
            last = max(int(np.argmin(inside)) - 1, 0)
            low, high = shares[last], shares[last + 1]
        return low * moves

    def _slowed(self, moves: Array, time: float) -> Array:
        """The moves (6,), or a part of the way there that the legs can go in a time."""
        before, most = self._moves, _USED_VELOCITY * self._site.limits.velocity * time
        lengths = self._site.lengths(moves[None])[0]
        step = float(np.abs(lengths - self._lengths).max())
        if step > most:
            self.kept.slowed += 1
            self.kept.speed = max(self.kept.speed, step / time)
            ways = before + _SHARES[:, None] * (moves - before)
            all_lengths = self._site.lengths(ways)
            allowed = (np.abs(all_lengths - self._lengths).max(axis=1) <= most) & (self._excess(all_lengths).max(axis=1) <= 0.0)
            last = max(int(np.argmin(allowed)) - 1, 0)
            moves, lengths = ways[last], all_lengths[last]
        self._lengths = lengths
        return moves
