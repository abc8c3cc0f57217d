"""Imposed motion: ideal IMU signals for a motion of the platform, whatever the actuators could follow."""

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

from plant.checks import checked_seed
from plant.dynamics.assembly import variable_symbols
from plant.dynamics.spatial import imu_signals
from plant.dynamics.variables import SPATIAL
from plant.errors import InputError
from plant.mechanism import Mechanism
from plant.pose import Array

SIZE = (0.03, np.radians(10.0))
"""Size of the motion along and about each axis [m, rad]."""

MOST_HZ = 5.0
"""With 10 degrees about every axis, the gyroscopes reach the end of their range here."""

_MIXED_HZ = 0.5 * np.array([0.2, 0.45, 0.8, 1.3, 2.0])


@dataclass(frozen=True, eq=False)
class ImposedMotion:
    """A prescribed motion of {2} and its ideal readings."""

    times: Array  # (N,) [s]
    positions: Array  # (N, 3) [m]
    rotations: Array  # (N, 3, 3)
    signals: Array  # (N, 3, 7, 3) [rad/s, m/s^2, uT]


def impose(
    mechanism: Mechanism, kind: str, duration: float, rate: float, seed: int, size: tuple[float, float] = SIZE
) -> ImposedMotion:
    """A motion about home on all axes at once, in samples at `rate` [Hz] for `duration` [s].

    Its kind is "static" for a random pose; a frequency such as "0.5" [Hz], which all axes share within 10 %; or "mixed" for
    five sines from 0.1 to 1 Hz on every axis.

    Raises:
        InputError: no such kind.
    """
    random = np.random.default_rng([checked_seed(seed), *kind.encode()])
    reach: Array = np.repeat(size, 3)[:, None]
    times = np.arange(round(duration * rate)) / rate
    home = mechanism.require_home()
    if kind == "static":
        coordinates: Array = np.zeros((3, 6, len(times)))
        coordinates[0] = reach * random.uniform(-1.0, 1.0, (6, 1))
    else:
        coordinates = _sines(_frequencies(kind), reach, times, random)
    coordinates[0, :3] += home.position[:, None]
    values = mechanism.plant_parameters()
    columns = [ca.DM(np.asarray(values[name]).ravel()) for name in values]
    outputs = _signals().map(len(times))(*coordinates, ca.DM(home.rotation), *columns)
    rotations, *signals = (np.array(output).T.reshape(len(times), -1, 3) for output in outputs)
    return ImposedMotion(times, coordinates[0, :3].T.copy(), rotations, np.stack(signals, axis=1))


def _frequencies(kind: str) -> Array:
    """(6, n) [Hz], for each axis."""
    if kind == "mixed":
        return np.outer(1.0 + 0.03 * np.arange(6), _MIXED_HZ)
    try:
        frequency = float(kind)
    except ValueError:
        frequency = np.nan
    if not 0.0 < frequency <= MOST_HZ:
        raise InputError(
            f"there is no imposed motion {kind!r}: give static, mixed, or a frequency such as 0.5, at most {MOST_HZ:g} Hz"
        )
    return frequency * (1.0 + 0.04 * (np.arange(6.0) - 2.5))[:, None]


def _sines(frequencies: Array, reach: Array, times: Array, random: np.random.Generator) -> Array:
    """Coordinates with their first and second derivatives (3, 6, N)."""
    rates = 2.0 * np.pi * frequencies[:, :, None]
    shares = 1.0 / frequencies
    sizes = (reach * shares / shares.sum(axis=1, keepdims=True))[:, :, None]
    phases = rates * times + random.uniform(0.0, 2.0 * np.pi, (*frequencies.shape, 1))
    waves = (sizes * np.sin(phases), sizes * rates * np.cos(phases), -sizes * rates**2 * np.sin(phases))
    return np.array([wave.sum(axis=1) for wave in waves])


@cache
def _signals() -> ca.Function:
    """Rotation and readings, row by row."""
    q, qd, qdd = (ca.SX.sym(name, 6) for name in ("q", "qd", "qdd"))
    home = ca.SX.sym("home", 3, 3)
    parameters = variable_symbols(SPATIAL.parameters)
    turn = _turn(2, q[5]) @ _turn(1, q[4]) @ _turn(0, q[3])
    turning = ca.reshape(ca.jtimes(ca.vec(turn), q, qd), 3, 3) @ turn.T
    omega = ca.vertcat(turning[2, 1], turning[0, 2], turning[1, 0])
    angular = ca.jtimes(omega, q, qd) + ca.jtimes(omega, qd, qdd)
    rotation = turn @ home
    signals = imu_signals(q[:3], rotation, qd[:3], omega, ca.vertcat(qdd[:3], angular), parameters)
    outputs = [ca.vec(ca.densify(value).T) for value in (rotation, *signals.values())]
    symbols = [ca.vec(symbol.T) for symbol in parameters.values()]
    return ca.Function("imposed", [q, qd, qdd, home, *symbols], outputs, {"cse": True})


def _turn(axis: int, angle: ca.SX) -> ca.SX:
    c, s = ca.cos(angle), ca.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn = ca.SX.eye(3)
    turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
    return turn
