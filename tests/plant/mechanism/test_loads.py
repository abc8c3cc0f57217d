"""What the drives bear at home, against explicit bodies and the plant's own equations, and limits that they do not reach."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from plant.dynamics.planar import build_dynamics as planar_dynamics
from plant.dynamics.spatial import build_dynamics as spatial_dynamics
from plant.dynamics.variables import PLANAR, SPATIAL, VELOCITY, VariableTable
from plant.errors import InputError
from plant.mechanism import Mechanism, load_in_space
from plant.mechanism.loads import home_loads
from plant.pose import Array
from tests.plant.dynamics.explicit_bodies import static_forces

PRESETS = ["hexapod", "6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "genhexkins", "planar-3rpr"]
QUICK = ["hexapod", "6-4-II", "planar-3rpr"]
MOVED: dict[str, Any] = {
    "payload.center_of_mass": np.array([0.03, -0.02, 0.1]),
    "platform.center_of_mass": np.array([0.0, 0.02, 0.01]),
}
NO_AXIAL = {"leg.lower.axial_inertia": np.array(0.0), "leg.upper.axial_inertia": np.array(0.0)}


def lopsided(name: str) -> Mechanism:
    """A preset whose bodies are off their middle, with legs that have no inertia about their own axis."""
    mechanism = load_in_space(name)
    if mechanism.planar:
        return replace(mechanism, plant=mechanism.plant | {"payload.center_of_mass": np.array([0.03, -0.02])})
    return replace(mechanism, plant=mechanism.plant | MOVED | NO_AXIAL)


def flat(values: Mapping[str, Array], variables: tuple[Any, ...]) -> Array:
    return np.concatenate([np.ravel(values.get(variable.name, np.zeros(variable.shape))) for variable in variables])


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in PRESETS if name not in QUICK)]
)
def test_forces_and_masses_at_home_are_those_of_the_plants_equations(name: str) -> None:
    """Motors that push with the forces leave the plant at rest; one ampere more accelerates the lengths as the masses say."""
    mechanism = lopsided(name)
    table: VariableTable = PLANAR if mechanism.planar else SPATIAL
    dynamics = planar_dynamics() if mechanism.planar else spatial_dynamics()
    p = mechanism.plant_parameters()
    found = home_loads(mechanism)
    assert found is not None
    if not mechanism.planar:
        home = mechanism.require_home()
        np.testing.assert_allclose(found.forces, static_forces(p, home.position, home.rotation), rtol=1e-9)
    constant = float(2.0 * np.pi / p["motor.screw_lead"] * p["motor.torque_constant"])
    pose = {"state.position": p["initial_position"]}
    pose |= {f"state.{what}": p[f"initial_{what}"] for what in ("quaternion", "angle") if f"initial_{what}" in p}
    inputs = flat({"drive_mode": np.full(mechanism.legs, VELOCITY)}, table.inputs)
    constants = dynamics.constants(flat(p, table.parameters))
    names = [variable.name for variable in table.outputs]
    ends = np.cumsum([0, *(variable.size for variable in table.outputs)])
    speeds = slice(ends[names.index("leg_velocity")], ends[names.index("leg_velocity") + 1])

    def accelerations(forces: Array) -> Array:
        x = flat(pose | {"state.current": forces / constant}, table.states)
        rates = np.array(dynamics.rates(x, inputs, constants)).ravel()
        step = 1e-6
        moved = [np.array(dynamics.outputs(x + sign * step * rates, inputs, constants)).ravel()[speeds] for sign in (1.0, -1.0)]
        return (moved[0] - moved[1]) / (2.0 * step)

    np.testing.assert_allclose(accelerations(found.forces), 0.0, atol=1e-6)
    for leg in range(mechanism.legs):
        more = found.forces.copy()
        more[leg] += 1.0
        np.testing.assert_allclose(found.masses @ accelerations(more), np.eye(mechanism.legs)[leg], atol=1e-5)


def with_changes(mechanism: Mechanism, limits: Mapping[str, float], plant: Mapping[str, Any]) -> Mechanism:
    """The same mechanism, built anew with other limits and parameters."""
    kept = mechanism.require_limits()
    given = {"stroke": kept.stroke, "velocity": kept.velocity, "acceleration": kept.acceleration, "jerk": kept.jerk}
    return Mechanism.from_legs(
        mechanism.base_joints, mechanism.platform_joints, home=mechanism.home, limits={**given, **limits},
        plant={**mechanism.plant, **plant}, base_joint_axes=mechanism.base_joint_axes,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("limits", "plant", "said"),
    [
        (
            {"velocity": 9.0},
            {},
            r"velocity is 9 m/s, and leg \d reaches 0\.\d+ m/s at home with its drive.voltage_limit of 24 V",
        ),
        ({"velocity": 0.38}, {}, "the limit of velocity is 0.38 m/s, and leg"),
        ({}, {"drive.voltage_limit": 12.0}, "the limit of velocity is 0.25 m/s, and leg"),
        (
            {"acceleration": 20.0},
            {},
            r"acceleration is 20 m/s2, and leg \d reaches \d+\.\d m/s2 at home with its drive.current_l",
        ),
        ({}, {"drive.current_limit": 1.0}, r"the limit of acceleration is 3 m/s2, and leg \d reaches"),
        ({}, {"payload.mass": 400.0}, r"leg \d needs 1\d\.\d A to hold the platform at home, and drive.current_limit is 10 A"),
        (
            {},
            {"brake.force": 20.0},
            r"leg \d needs \d\d\.\d N to hold the platform at home, and brake.force is 20 N: check masses",
        ),
    ],
)
def test_limits_that_the_drives_cannot_reach_are_refused(
    hexapod: Mechanism, limits: dict[str, float], plant: dict[str, float], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        with_changes(hexapod, limits, plant)


def test_limits_just_within_reach_are_taken_and_are_reached(hexapod: Mechanism) -> None:
    """By the speed at the voltage limit and the acceleration of one leg at the current limit, worked out by hand."""
    loads, p = home_loads(hexapod), hexapod.plant_parameters()
    assert loads is not None
    force, constant = np.abs(loads.forces).max(), 2.0 * np.pi / 0.005 * 0.05
    # k v + R (F + 15 N + 50 N s/m v) / k = 24 V
    speed = brentq(lambda v: constant * v + 0.6 * (force + 15.0 + 50.0 * v) / constant - 24.0, 0.0, 1.0)
    with_changes(hexapod, {"velocity": 0.9999 * speed}, {})
    with pytest.raises(InputError, match="velocity"):
        with_changes(hexapod, {"velocity": 1.0001 * speed}, {})
    acceleration = float((10.0 * constant - force - 15.0 - 50.0 * 0.25) / loads.masses[0, 0])
    with_changes(hexapod, {"acceleration": 0.999 * acceleration}, {})
    with pytest.raises(InputError, match="acceleration"):
        with_changes(hexapod, {"acceleration": 1.001 * acceleration}, {})
    assert p["drive.voltage_limit"] == 24.0


def test_a_singular_home_has_no_loads(hexapod: Mechanism) -> None:
    """Six parallel legs bear nothing across themselves."""
    base = np.array(hexapod.base_joints)
    upright = Mechanism.from_legs(base, base, home=hexapod.home, limits={"stroke": (-0.05, 0.05)}, plant=hexapod.plant)
    assert home_loads(upright) is None


def test_without_drives_nothing_is_asked_of_them(hexapod: Mechanism) -> None:
    plant = {name: value for name, value in hexapod.plant.items() if not name.startswith("motor")}
    limits = {"stroke": (-0.05, 0.05), "velocity": 9.0}
    Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints, home=hexapod.home, limits=limits, plant=plant)
