"""Manoeuvres of a car: the accelerations and angular velocities that a passenger has, to try motion cueing with.

The car is a rigid body on springs. It keeps its speed but where it brakes; in a bend its nose follows the way. Heave, pitch and
roll are oscillators of second order: they follow the road under both axles, and lean with the acceleration.
"""

from collections.abc import Callable, Sequence

import numpy as np

from controller.planning.motions.cueing import COLUMNS, Vehicle
from controller.planning.motions.waves import checked_number
from plant.checks import nearest
from plant.errors import UnknownNameError
from plant.pose import Array

PERIOD_S = 0.01
_REST_S = 3.0
"""Time before, between and after manoeuvres."""

_RISE_S = 0.3
"""Time in which a brake comes to act, and to release."""

_WHEELBASE_M = 2.7
_BODY_HZ, _BODY_DAMPING = 1.3, 0.35
_PITCH, _ROLL = np.radians(0.25), np.radians(0.45)
"""By which the body leans at an acceleration of 1 m/s^2 [rad]."""

_BUMP_M, _BUMP_LENGTH_M, _BUMPS, _BETWEEN_M = 0.04, 0.5, 3, 10.0
_LANE_M, _LANE_S = 3.5, 4.0


def _brake(times: Array, speed: float, strength: float) -> tuple[Array, Array, Array]:
    """Braking from a speed to standstill: accelerations (N,) along and across the way, height of the road at a way (N,)."""
    size = 5.0 * strength
    held = max(speed / size, _RISE_S)
    ramp = np.clip(np.minimum(times / _RISE_S, (held + _RISE_S - times) / _RISE_S), 0.0, 1.0)
    along = -speed / held * ramp * ramp * (3.0 - 2.0 * ramp)
    return along, 0.0 * times, 0.0 * times


def _lane_change(times: Array, speed: float, strength: float) -> tuple[Array, Array, Array]:
    """One period of a sine to the side, by the width of a lane."""
    duration = _LANE_S / np.sqrt(strength)
    phase = 2.0 * np.pi * np.clip(times / duration, 0.0, 1.0)
    return 0.0 * times, 2.0 * np.pi * _LANE_M / duration**2 * np.sin(phase), 0.0 * times


def _bumps(times: Array, speed: float, strength: float) -> tuple[Array, Array, Array]:
    """Rounded bumps, one after the other."""
    way = speed * times
    phase = np.clip((way % _BETWEEN_M) / _BUMP_LENGTH_M, 0.0, 1.0)
    height = strength * _BUMP_M * np.sin(np.pi * phase) ** 2 * (way < _BUMPS * _BETWEEN_M)
    return 0.0 * times, 0.0 * times, height


MANOEUVRES: dict[str, Callable[[Array, float, float], tuple[Array, Array, Array]]] = {
    "brake": _brake,
    "lane-change": _lane_change,
    "bumps": _bumps,
}
"""By their names, each from the time since it begins, the speed and the strength."""


def drive(names: Sequence[str], speed: float = 14.0, strength: float = 1.0, rest: float = _REST_S) -> Vehicle:
    """The motion of a car that does manoeuvres one after the other, each at the same speed.

    Args:
        names: of `MANOEUVRES`.
        speed: [m/s].
        strength: factor on braking, on the acceleration to the side, and on the height of bumps.
        rest: time without a manoeuvre before, between and after them [s].

    Raises:
        UnknownNameError: there is no such manoeuvre.
        InputError: a number is out of its range.
    """
    checked_number(speed, "speed", 1.0, 100.0)
    checked_number(strength, "strength", 0.1, 10.0)
    checked_number(rest, "rest", 0.0, 60.0)
    parts = [np.zeros((round(rest / PERIOD_S), 3))]
    for name in names:
        if name not in MANOEUVRES:
            raise UnknownNameError(f"no manoeuvre {name!r}; there are {', '.join(MANOEUVRES)}{nearest(name, MANOEUVRES)}")
        lasts = max(speed / (5.0 * strength), _RISE_S) + _RISE_S
        lasts = max(lasts, _LANE_S / np.sqrt(strength), _BUMPS * _BETWEEN_M / speed)
        times = np.arange(0.0, lasts, PERIOD_S)
        parts += [np.column_stack(MANOEUVRES[name](times, speed, strength)), parts[0]]
    along, across, front = np.concatenate([*parts, np.zeros((1, 3))]).T
    times = PERIOD_S * np.arange(len(along))
    # The rear axle goes over the same road later.
    rear = np.interp(times - _WHEELBASE_M / speed, times, front)
    heave, (pitch, roll) = (
        _swung(0.5 * (front + rear)),
        (_swung((rear - front) / _WHEELBASE_M - _PITCH * along), _swung(_ROLL * across)),
    )
    forces = np.column_stack([along, across, np.gradient(np.gradient(heave, PERIOD_S), PERIOD_S)])
    rates = np.column_stack([np.gradient(roll, PERIOD_S), np.gradient(pitch, PERIOD_S), across / speed])
    return Vehicle(times, forces, rates)


def text_of_vehicle(vehicle: Vehicle) -> str:
    """The CSV text of a vehicle's motion without gravity, which `read_vehicle` reads again from a file."""
    rows = np.column_stack([vehicle.times, vehicle.forces, vehicle.rates]).round(9) + 0.0
    return "\n".join([",".join(COLUMNS), *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n"


def _swung(wanted: Array) -> Array:
    """What an oscillator of the body makes of values (N,), by its exact response to steps."""
    frequency = 2.0 * np.pi * _BODY_HZ
    decay, turn = _BODY_DAMPING * frequency, frequency * np.sqrt(1.0 - _BODY_DAMPING**2)
    kept, cosine, sine = np.exp(-decay * PERIOD_S), np.cos(turn * PERIOD_S), np.sin(turn * PERIOD_S)
    found, (off, rate) = np.empty_like(wanted), (0.0, 0.0)
    last = 0.0
    for i, value in enumerate(wanted.tolist()):
        off -= value - last
        last = value
        off, rate = (
            kept * (off * cosine + (rate + decay * off) / turn * sine),
            kept * (rate * cosine - (frequency**2 * off + decay * rate) / turn * sine),
        )
        found[i] = value + off
    return found
