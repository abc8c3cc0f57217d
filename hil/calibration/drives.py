"""What the drives of a mechanism can do in the motions of a calibration, which move all legs at once."""

from dataclasses import replace
from math import inf

import numpy as np

from plant.errors import InputError
from plant.mechanism import Mechanism
from plant.mechanism.loads import force_constant, home_loads

_CURRENT, _VOLTAGE = 0.75, 0.9
"""Shares of the drives' current and voltage that the motions may need at home; wide poses need more."""


def within_drives(mechanism: Mechanism, force: float = inf) -> Mechanism:
    """The mechanism with limits that its drives reach when all legs accelerate at once, each to the worst side; itself if they
    do with its own. None of them then needs more than `force` [N] at home, by the plant data.

    Raises:
        InputError: the drives, or `force`, have nothing left for that; or `force` is given, and home is singular.
    """
    loads = home_loads(mechanism)
    if loads is None:
        if force < inf:
            raise InputError(
                f"--force needs the loads of the legs at home, and the home of {mechanism.name!r} is singular: leave it out, "
                "and limit the current in the drives"
            )
        return mechanism
    p, limits, constant = mechanism.plant_parameters(), mechanism.require_limits(), force_constant(mechanism)
    carried = np.abs(loads.forces) + p["friction.coulomb"] + p["friction.viscous"] * limits.velocity
    together = np.abs(loads.masses).sum(axis=1)
    has = np.minimum(force, _CURRENT * constant * float(p["drive.current_limit"]))
    leg = int(np.argmin((has - carried) / together))
    acceleration = min(limits.acceleration, float((has - carried[leg]) / together[leg]))
    currents = (carried + together * max(acceleration, 0.0)) / constant
    speeds = (_VOLTAGE * float(p["drive.voltage_limit"]) - p["motor.resistance"] * currents) / constant
    velocity = min(limits.velocity, float(speeds.min()))
    if acceleration <= 0.0 and force <= has:
        raise InputError(
            f"--force is {force:g} N, and leg {leg} needs {carried[leg]:.4g} N for its load and friction at "
            f"{limits.velocity:g} m/s alone: give more, or a lower --speed"
        )
    if min(acceleration, velocity) <= 0.0:
        raise InputError(
            f"leg {leg} needs {carried[leg] / constant:.3g} A for its load at {limits.velocity:g} m/s, and its drive has "
            f"{float(p['drive.current_limit']):g} A: too little is left for the motions of a calibration; lower the load or "
            "the limit of velocity"
        )
    if (velocity, acceleration) == (limits.velocity, limits.acceleration):
        return mechanism
    return replace(mechanism, limits=replace(limits, velocity=velocity, acceleration=acceleration))
