"""Actuators of the plant: drives, friction, brakes and end stops, and where the energy goes."""

from collections.abc import Callable, Mapping
from math import pi

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_trapezoid, simpson
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from plant.dynamics.variables import BRAKE, OPEN, VELOCITY
from plant.fmu.plant import FmuPlant
from plant.mechanism import Mechanism, load_spatial
from plant.pose import Array, quaternion_from_rotation, rotation_from_quaternion
from tests.plant.dynamics.explicit_bodies import static_forces

MakePlant = Callable[..., FmuPlant]

WEIGHTLESS: dict[str, ArrayLike] = {"gravity": [0.0, 0.0, 0.0]}
FRICTIONLESS: dict[str, ArrayLike] = {"friction.coulomb": 0.0, "friction.viscous": 0.0}
BRAKELESS: dict[str, ArrayLike] = {"brake.force": 1e-9, "brake.stiffness": 1e-9}
RESISTANCE = 0.6
COMPENSATING_RESISTANCE = 0.5 * 0.6
FORCE_CONSTANT = 2.0 * pi / 0.005 * 0.05
"""Of the preset: 2 pi / lead times the torque constant [N/A]; also the back-EMF constant [V s/m]."""


def set_all(plant: FmuPlant, mode: int, command: float = 0.0) -> None:
    plant.set("drive_mode", np.full(6, mode))
    plant.set("velocity_command", np.full(6, command))


def run(plant: FmuPlant, duration: float, *names: str, step: float = 1e-3) -> list[Array]:
    """Go on with held inputs; the values of the named outputs after every step, (N, ...) each."""
    seen: list[list[Array]] = [[] for _ in names]
    for _ in range(round(duration / step)):
        plant.step(step)
        for values, name in zip(seen, names, strict=True):
            values.append(plant.get(name))
    return [np.array(values) for values in seen]


# ---- energy ----


def energy_beyond_work(plant: FmuPlant, intervals: int) -> tuple[float, dict[str, float]]:
    """What the energy grows by in 0.8 s beyond the work of all forces [J], and the work of each.

    Sines as commands and a wrench; the brakes fall in at 0.4 s and open at 0.5 s. Inputs are held for 1 ms, which is cut
    into as many intervals of Simpson's rule, each of two steps.
    """
    work = dict.fromkeys(("drive", "friction", "brake", "stop", "external"), 0.0)
    step = 1e-3 / intervals / 2.0

    def energy() -> float:
        return float(plant.get("kinetic_energy") + plant.get("potential_energy"))

    before = energy()
    for cycle in range(800):
        t = 1e-3 * cycle
        set_all(plant, BRAKE if 0.4 <= t < 0.5 else VELOCITY)
        plant.set("velocity_command", 0.15 * np.sin(9.0 * t + np.arange(6)) + 0.02)
        plant.set("external_wrench.force", np.array([20.0, -10.0, 30.0]) * np.sin(20.0 * t))
        plant.set("external_wrench.torque", np.array([1.0, 2.0, -1.0]) * np.sin(20.0 * t))
        for _ in range(intervals):
            for sample, weight in enumerate((1.0, 4.0, 1.0)):
                if sample:
                    plant.step(step)
                for source in work:
                    work[source] += weight * step / 3.0 * float(plant.get(f"power.{source}"))
    return energy() - before - sum(work.values()), work


@pytest.mark.slow
def test_energy_changes_by_the_work_of_all_forces(make_plant: MakePlant) -> None:
    gaps = []
    for intervals in (1, 2, 4, 8):
        gap, work = energy_beyond_work(make_plant({"substep": 0.5e-3 / intervals}), intervals)
        gaps.append(abs(gap))
    assert gaps[-1] < 1e-6
    assert gaps[-1] < gaps[1] / 16.0 < gaps[0] / 16.0
    # Each kind of work, the end stops' apart, is large against what is left over.
    assert work["drive"] > 1.0 and work["friction"] < -1.0
    assert work["brake"] < -0.1 and abs(work["external"]) > 0.1


def test_an_end_stop_gives_back_no_more_than_it_took(make_plant: MakePlant) -> None:
    """Free flight up into the stops: kinetic energy is lost in every bounce and never won."""
    plant = make_plant(WEIGHTLESS | FRICTIONLESS)
    set_all(plant, OPEN)
    plant.set("external_wrench.force", [0.0, 0.0, 300.0])
    run(plant, 0.1)
    plant.set("external_wrench.force", np.zeros(3))
    thrown = float(plant.get("kinetic_energy"))
    kinetic, power = run(plant, 1.5, "kinetic_energy", "power.stop")
    assert np.abs(power).max() > 10.0
    assert kinetic.max() < thrown * (1.0 + 1e-9)
    assert kinetic[-100:].max() < 0.9 * thrown


@pytest.mark.slow
def test_end_stops_at_full_command_win_no_energy(make_plant: MakePlant) -> None:
    """Up and down into the stops at full speed: they take energy and return less, and no energy comes from elsewhere."""
    plant = make_plant({"substep": 1e-4})
    sources = ("drive", "friction", "brake", "stop", "external")
    names = ("kinetic_energy", "potential_energy", *(f"power.{source}" for source in sources))
    before = float(plant.get("kinetic_energy") + plant.get("potential_energy"))
    work, taken = 0.0, 0.0
    for command in (0.25, -0.25, 0.25):
        set_all(plant, VELOCITY, command)
        kinetic, potential, *powers = run(plant, 0.8, *names, step=1e-4)
        # Simpson's rule; the powers are smooth while inputs are held, but for the touch of a stop.
        by_source = [simpson(power, dx=1e-4) for power in powers]
        work += sum(by_source)
        stop = cumulative_trapezoid(powers[sources.index("stop")], dx=1e-4, initial=0.0) + taken
        assert stop.max() < 1e-6
        assert stop[-1] < taken - 1.0
        taken = float(stop[-1])
        assert kinetic[-1] < 1e-8, "the stops hold"
    assert float(kinetic[-1] + potential[-1]) - before == pytest.approx(work, abs=1e-2)


def test_without_damping_a_bounce_keeps_its_energy(make_plant: MakePlant) -> None:
    plant = make_plant(WEIGHTLESS | FRICTIONLESS | {"stop.damping": 0.0, "substep": 1e-4})
    set_all(plant, OPEN)
    plant.set("external_wrench.force", [0.0, 0.0, 300.0])
    run(plant, 0.1)
    plant.set("external_wrench.force", np.zeros(3))
    thrown = float(plant.get("kinetic_energy"))
    kinetic, power, velocity = run(plant, 0.5, "kinetic_energy", "power.stop", "velocity")
    assert np.abs(power).max() > 10.0
    assert velocity[-1, 2] < 0.0
    assert kinetic[-1] == pytest.approx(thrown, rel=1e-4)


# ---- rest, droop and the brake ----


@pytest.mark.parametrize("mode", [OPEN, BRAKE, VELOCITY])
def test_without_gravity_the_platform_stays_at_rest(make_plant: MakePlant, hexapod: Mechanism, mode: int) -> None:
    plant = make_plant(WEIGHTLESS)
    set_all(plant, mode)
    run(plant, 1.0)
    home = hexapod.require_home()
    np.testing.assert_allclose(plant.get("position"), home.position, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(plant.get("quaternion"), [1.0, 0.0, 0.0, 0.0], rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(plant.get("leg_velocity"), 0.0, atol=1e-15)


def leaning(hexapod: Mechanism) -> dict[str, ArrayLike]:
    """A start without symmetry, so that the legs bear different loads."""
    turned = Rotation.from_rotvec([0.08, -0.05, 0.1]).as_matrix()
    return {
        "initial_position": hexapod.require_home().position + [0.02, -0.01, 0.0],
        "initial_quaternion": quaternion_from_rotation(turned),
        "payload.center_of_mass": [0.02, 0.01, 0.1],
    }


@pytest.mark.parametrize("friction", [{}, FRICTIONLESS])
def test_under_gravity_each_leg_creeps_at_the_rate_of_its_load(
    make_plant: MakePlant, hexapod: Mechanism, friction: dict[str, ArrayLike]
) -> None:
    changes = leaning(hexapod) | friction
    plant = make_plant(changes)
    set_all(plant, VELOCITY)
    run(plant, 0.5)
    p = hexapod.plant_parameters() | {name: np.asarray(value) for name, value in changes.items()}
    loads = static_forces(p, plant.get("position"), rotation_from_quaternion(plant.get("quaternion")))

    def creep(load: float) -> float:
        def unbalance(speed: float) -> float:
            lost = np.mean(p["friction.viscous"]) * speed
            lost += np.mean(p["friction.coulomb"]) * speed / np.hypot(speed, p["friction.velocity"])
            return speed + (RESISTANCE - COMPENSATING_RESISTANCE) * (load + lost) / FORCE_CONSTANT**2

        return float(brentq(unbalance, -0.1, 0.1))

    predicted = np.array([creep(load) for load in loads])
    assert predicted.max() < -1e-4 and np.ptp(predicted) > 0.3 * np.abs(predicted).max()
    np.testing.assert_allclose(plant.get("leg_velocity"), predicted, rtol=0.01)
    if friction:
        np.testing.assert_allclose(plant.get("current"), loads / FORCE_CONSTANT, rtol=0.01)


def loads_at_start(p: Mapping[str, Array]) -> Array:
    """The forces (6,) [N] that hold all weights at the initial pose."""
    return static_forces(p, p["initial_position"], rotation_from_quaternion(p["initial_quaternion"]))


@pytest.mark.parametrize("preset", ["hexapod", "6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "genhexkins"])
@pytest.mark.parametrize("mode", [BRAKE, VELOCITY, OPEN])
def test_the_plant_begins_on_brakes_that_carry_the_load(make_plant: MakePlant, preset: str, mode: int) -> None:
    """Whatever the drives do at first, every accelerometer reads gravity alone; on the brakes nothing moves."""
    p = load_spatial(preset).plant_parameters() | {"payload.center_of_mass": np.array([0.02, 0.01, 0.1])}
    plant = make_plant(p)
    set_all(plant, mode)
    np.testing.assert_allclose(plant.get("state.brake_deflection"), -loads_at_start(p) / p["brake.stiffness"], rtol=1e-7)
    size = np.linalg.norm(p["gravity"])
    np.testing.assert_allclose(np.linalg.norm(plant.get("imu_specific_force"), axis=1), size, rtol=1e-7)
    if mode == BRAKE:
        lengths, brake = run(plant, 1.0, "leg_length", "power.brake")
        assert np.ptp(lengths, axis=0).max() < 1e-12 and np.abs(brake).max() < 1e-9
    elif mode == VELOCITY:
        # The drives take the load over while the brakes let go.
        (forces,) = run(plant, 0.1, "imu_specific_force")
        assert np.abs(np.linalg.norm(forces, axis=2) - size).max() < 0.3 * size


def test_brakes_too_weak_for_the_load_begin_at_their_force(make_plant: MakePlant, hexapod: Mechanism) -> None:
    """They carry an equal share of each leg's load, and the rest of gravity accelerates the platform."""
    p = hexapod.plant_parameters() | {name: np.asarray(value) for name, value in leaning(hexapod).items()}
    loads = loads_at_start(p)
    share = 0.4
    plant = make_plant(leaning(hexapod) | {"brake.force": share * np.abs(loads).max(), "brake.stiffness": 1e5})
    np.testing.assert_allclose(plant.get("state.brake_deflection"), -share * loads / 1e5, rtol=1e-7)
    falling = make_plant(leaning(hexapod) | BRAKELESS)
    held, free = (each.get("imu_specific_force")[6] for each in (plant, falling))
    gravity = rotation_from_quaternion(p["initial_quaternion"]).T @ p["gravity"]
    np.testing.assert_allclose(held + gravity, (1.0 - share) * (free + gravity), atol=1e-7)


def test_a_stop_that_is_touched_at_the_start_counts_as_load(make_plant: MakePlant, hexapod: Mechanism) -> None:
    lengths = make_plant().get("leg_length")
    plant = make_plant({"stop.minimum_length": lengths + 1e-4})
    loads = loads_at_start(hexapod.plant_parameters())
    np.testing.assert_allclose(plant.get("state.brake_deflection"), -(loads - 1e6 * 1e-4) / 5e6, rtol=1e-7)
    run(plant, 0.2)
    np.testing.assert_allclose(plant.get("leg_length"), lengths, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("lean", [0.0, 1e-9, 1e-6, 1e-3])
def test_a_start_at_a_singular_pose_falls_no_faster_than_free(make_plant: MakePlant, hexapod: Mechanism, lean: float) -> None:
    """Six parallel legs, or nearly so, bear no load across themselves: what the brakes cannot hold falls."""
    base = np.array(hexapod.base_joints)
    changes = {
        "base_joints": base,
        "platform_joints": (1.0 + lean) * base,
        "base_joint_axes": np.tile([1.0, 0.0, 0.0], (6, 1)),
        "gravity": [3.0, 0.0, -9.0],
        "stop.minimum_length": 0.2,
        "stop.maximum_length": 0.5,
    }
    held, free = (make_plant(changes | more) for more in ({}, BRAKELESS))
    assert np.abs(held.get("state.brake_deflection")).max() <= 1500.0 / 5e6 * (1.0 + 1e-12)
    forces = np.array([plant.get("imu_specific_force")[6] for plant in (held, free)])
    accelerations = np.linalg.norm(forces + changes["gravity"], axis=1)
    assert accelerations[0] <= accelerations[1] * (1.0 + 1e-6)


def test_a_braked_platform_does_not_drift(make_plant: MakePlant, hexapod: Mechanism) -> None:
    plant = make_plant(leaning(hexapod))
    set_all(plant, BRAKE)
    plant.set("external_wrench.force", [30.0, -20.0, 40.0])
    run(plant, 0.5)
    settled = plant.get("leg_length")
    assert 0.0 < np.abs(settled - make_plant(leaning(hexapod)).get("leg_length")).max() < 1e-4
    run(plant, 2.0)
    assert np.abs(plant.get("leg_length") - settled).max() < 2.0 * 1e-6 * 1e-3


def pushed_along_all_legs(plant: FmuPlant, force: float) -> None:
    """Set the wrench that pulls with `force` [N] on every leg of a hexapod at home; by symmetry it is vertical."""
    plant.set("external_wrench.force", [0.0, 0.0, 6.0 * force * 0.35 / float(plant.get("leg_length")[0])])


def test_a_closed_brake_slips_above_its_force_alone(make_plant: MakePlant) -> None:
    def moved(force: float, duration: float = 0.2) -> float:
        plant = make_plant(WEIGHTLESS | FRICTIONLESS)
        set_all(plant, BRAKE)
        before = plant.get("leg_length")
        pushed_along_all_legs(plant, force)
        run(plant, duration)
        return float((plant.get("leg_length") - before).max())

    elastic = 1000.0 / 5e6
    assert moved(1000.0) == pytest.approx(elastic, rel=0.01)
    assert moved(1000.0, 1.0) == pytest.approx(elastic, rel=0.01)
    assert moved(1650.0) > 1e-3


def test_an_opened_brake_lets_go(make_plant: MakePlant) -> None:
    plant = make_plant(FRICTIONLESS)
    set_all(plant, BRAKE)
    run(plant, 0.3)
    set_all(plant, OPEN)
    power, current = run(plant, 0.1, "power.brake", "current")
    assert plant.get("velocity")[2] < -0.05
    assert np.abs(power[-20:]).max() < 1e-4
    np.testing.assert_allclose(current, 0.0, atol=1e-12)


def test_an_opened_brake_and_an_open_motor_leave_no_denormal_number(make_plant: MakePlant) -> None:
    plant = make_plant()
    set_all(plant, BRAKE)
    run(plant, 0.2)
    assert np.abs(plant.get("state.brake_deflection")).min() > 1e-6
    set_all(plant, VELOCITY, 0.02)
    run(plant, 1.5)
    np.testing.assert_array_equal(plant.get("state.brake_deflection"), 0.0)
    set_all(plant, OPEN)
    run(plant, 1.0)
    np.testing.assert_array_equal(plant.get("state.current"), 0.0)


# ---- the drive ----


def test_an_unloaded_leg_follows_its_command(make_plant: MakePlant) -> None:
    plant = make_plant(WEIGHTLESS | FRICTIONLESS)
    set_all(plant, VELOCITY, 0.02)
    run(plant, 1.0)
    np.testing.assert_allclose(plant.get("leg_velocity"), 0.02, rtol=2e-3)


def test_an_open_motor_carries_no_current_and_falls(make_plant: MakePlant) -> None:
    plant = make_plant(FRICTIONLESS | BRAKELESS)
    set_all(plant, OPEN, 0.2)
    current, voltage, kinetic, potential = run(plant, 0.15, "current", "voltage", "kinetic_energy", "potential_energy")
    np.testing.assert_array_equal(current, 0.0)
    np.testing.assert_array_equal(voltage, 0.0)
    assert kinetic[-1] > 1.0
    np.testing.assert_allclose(kinetic + potential, kinetic[0] + potential[0], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(("limit", "reached"), [(10.0, True), (1000.0, False)])
def test_the_current_stays_within_its_limit(make_plant: MakePlant, limit: float, reached: bool) -> None:
    plant = make_plant({"drive.current_limit": limit})
    greatest = 0.0
    for command in (0.25, -0.25, 0.25, -0.25):
        set_all(plant, VELOCITY, command)
        (current,) = run(plant, 0.1, "current", step=2.5e-4)
        greatest = max(greatest, float(np.abs(current).max()))
    assert greatest <= limit
    assert (greatest > 0.999 * limit) == reached
    assert greatest > 9.9


@pytest.mark.parametrize("command", [2.0, -2.0])
def test_the_voltage_stays_within_its_limit(make_plant: MakePlant, command: float) -> None:
    plant = make_plant(WEIGHTLESS)
    set_all(plant, VELOCITY, command)
    (voltage,) = run(plant, 0.05, "voltage")
    np.testing.assert_array_equal(voltage, np.sign(command) * 24.0)


def test_the_voltage_makes_up_for_its_share_of_the_resistive_drop(make_plant: MakePlant) -> None:
    plant = make_plant({"drive.voltage_limit": 1000.0, "substep": 2e-5})
    command = 0.03 * np.arange(-3, 3)
    set_all(plant, VELOCITY)
    plant.set("velocity_command", command)
    run(plant, 0.1)
    current = plant.get("current")
    assert np.abs(current).min() > 0.1
    np.testing.assert_allclose(plant.get("voltage"), FORCE_CONSTANT * command + COMPENSATING_RESISTANCE * current, rtol=1e-12)


@pytest.mark.parametrize("command", [0.25, -0.25])
def test_end_stops_hold_at_full_command(make_plant: MakePlant, hexapod: Mechanism, command: float) -> None:
    plant = make_plant()
    set_all(plant, VELOCITY, command)
    lengths, current = run(plant, 2.0, "leg_length", "current")
    limits = hexapod.require_limits()
    beyond = np.maximum(limits.stroke[:, 0] - lengths, lengths - limits.stroke[:, 1]).max(axis=1) - limits.stop_clearance
    assert 0.0 < beyond.max() < 2e-3
    # At rest the stop bears the motor at its limit and, or less, the weight.
    assert np.abs(current[-1]).max() == pytest.approx(10.0, rel=1e-6)
    assert beyond[-1] == pytest.approx(FORCE_CONSTANT * 10.0 / 1e6, rel=0.2)
    assert np.ptp(beyond[-200:]) < 1e-7


@pytest.mark.parametrize(("resistance", "stable"), [(0.8, True), (1.2, True), (0.45, False)])
def test_the_drive_is_stable_while_it_makes_up_for_less_than_the_resistance(
    make_plant: MakePlant, resistance: float, stable: bool
) -> None:
    """Resistance against its nominal value; the unstable case is below the compensated share of one half."""
    plant = make_plant(WEIGHTLESS | FRICTIONLESS | {"motor.resistance": resistance * RESISTANCE})
    set_all(plant, VELOCITY, 0.05)
    run(plant, 0.2)
    set_all(plant, VELOCITY)
    run(plant, 0.5)
    (current,) = run(plant, 0.3, "current")
    if stable:
        assert np.abs(current).max() < 1e-3
        assert np.abs(plant.get("leg_velocity")).max() < 1e-5
    else:
        assert np.abs(current).max() > 5.0
