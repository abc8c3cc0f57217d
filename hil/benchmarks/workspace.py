"""The benchmark of `controller.workspace`: what the margins of a pose cost, against its inverse kinematics."""

from collections.abc import Callable
from functools import partial
from time import process_time
from timeit import repeat
from typing import Any

import numpy as np

from controller.direct_kinematics.geometry import geometry_of
from controller.inverse_kinematics import jacobian_at, legs_at, sample_workspace
from controller.workspace import Demands, margins, travels
from plant.compiled import kernel
from plant.mechanism import LEGS, Mechanism
from plant.mechanism.documents import mechanism_from_text
from plant.pose import Array

_ROWS = 1000
_WAYS = 200
_REPEATS = 7
_LIMITED = """
based_on = "hexapod"
[joints]
base_swing = 0.5
platform_swing = 0.6
[bodies]
leg_diameter = 0.03
[bodies.base_plate]
center = [0.0, 0.0, -0.03]
radius = 0.35
[bodies.platform_plate]
center = [0.0, 0.0, 0.03]
radius = 0.25
"""
"""The hexapod with every kind of limit."""


def measure_workspace() -> dict[str, Any]:
    """Time the margins of poses of a hexapod with every kind of limit, on one core.

    Returns:
        Microseconds per pose: `inverse_us`, the compiled inverse kinematics with the Jacobian of the lengths, and `margins_us`
        of the margins without conditioning and with it; their `ratios` to the former; and `travel_us`, of one travel along a
        random direction.
    """
    mechanism = mechanism_from_text(_LIMITED, "limited hexapod")
    assert isinstance(mechanism, Mechanism)
    positions, rotations = sample_workspace(mechanism, _ROWS, seed=0)
    geometry, jacobian = geometry_of(mechanism), np.empty((6, 6))
    joints = geometry["base_joints"], geometry["platform_joints"]
    inverse = partial(_inverse_rows, *joints, positions, rotations, jacobian)
    twist = np.array([0.05, 0.0, 0.05, 0.1, 0.0, 0.1])
    demands = {"without conditioning": Demands(twist=twist, conditioning=False), "with conditioning": Demands(twist=twist)}
    inverse_us = _microseconds(inverse, _ROWS)
    margins_us, ratios = {}, {}
    for name, asked in demands.items():
        margins_us[name] = _microseconds(partial(margins, mechanism, positions, rotations, asked, workers=1), _ROWS)
        ratios[name] = margins_us[name] / inverse_us
    directions = np.random.default_rng(0).standard_normal((_WAYS, 6)) * np.repeat([0.1, 0.4], 3)
    go = partial(travels, mechanism, mechanism.require_home(), directions, workers=1)
    return {
        "inverse_us": inverse_us,
        "margins_us": margins_us,
        "ratios": ratios,
        "travel_us": _microseconds(go, _WAYS),
    }


def _microseconds(work: Callable[[], object], rows: int) -> float:
    """The median duration of some work, by row; the first run may compile and does not count."""
    return 1e6 * float(np.median(repeat(work, timer=process_time, number=1, repeat=_REPEATS + 1)[1:])) / rows


@kernel
def _inverse_rows(base_joints: Array, platform_joints: Array, positions: Array, rotations: Array, jacobian: Array) -> float:
    """The inverse kinematics of all rows; returns a sum, so that nothing is left out."""
    arms, directions, lengths, total = np.empty((LEGS, 3)), np.empty((LEGS, 3)), np.empty(LEGS), 0.0
    for row in range(positions.shape[0]):
        legs_at(base_joints, platform_joints, positions[row], rotations[row], arms, directions, lengths)
        jacobian_at(arms, directions, LEGS, jacobian)
        total += lengths[0] + jacobian[5, 5]
    return total
