"""The rigid bodies of the plant: equations of motion, energies, integration and ideal IMU signals."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from plant.dynamics.assembly import Dynamics
from plant.dynamics.spatial import build_dynamics
from plant.dynamics.variables import BRAKE, OPEN, SPATIAL, VELOCITY, Variable
from plant.fmu.plant import FmuPlant
from plant.mechanism import Mechanism
from plant.pose import Array, quaternion_from_rotation, rotation_from_quaternion
from tests.plant.dynamics.explicit_bodies import (
    base_path,
    bent_path,
    bias_force,
    bodies_at,
    derivatives,
    energies,
    flanks,
    inertia_matrix,
    jacobian,
    leg_frames,
    leg_vectors,
    play,
    random_base,
    rotor_mass,
    second_axes,
    static_forces,
    vector_of,
)

MakePlant = Callable[..., FmuPlant]
Values = dict[str, Array]


@pytest.fixture(scope="module")
def dynamics() -> Dynamics:
    return build_dynamics()


def flat(values: Mapping[str, Array], table: tuple[Variable, ...]) -> Array:
    return np.concatenate([np.ravel(values[variable.name]) for variable in table])


def named(vector: Array, table: tuple[Variable, ...]) -> Values:
    ends = np.cumsum([variable.size for variable in table])
    parts = np.split(vector, ends[:-1])
    return {variable.name: part.reshape(variable.shape) for variable, part in zip(table, parts, strict=True)}


def unit(random: Generator, size: int = 3) -> Array:
    vector = random.normal(size=size)
    return vector / np.linalg.norm(vector)


def inertia_tensor(random: Generator) -> Array:
    root = random.normal(size=(3, 3))
    moments = 0.02 * root @ root.T + 0.01 * np.eye(3)
    return np.trace(moments) * np.eye(3) - moments


def odd_mechanism(hexapod: Mechanism, random: Generator) -> Values:
    """Parameters without any symmetry, far from all special cases."""
    p = dict(hexapod.plant_parameters())
    p["base_joints"] = p["base_joints"] + random.normal(0.0, 0.03, (6, 3))
    p["platform_joints"] = p["platform_joints"] + random.normal(0.0, 0.03, (6, 3))
    p["base_joint_axes"] = np.array([unit(random) for _ in range(6)])
    steep = np.abs(np.sum(p["base_joint_axes"] * hexapod.home_directions, axis=1)) > 0.7
    p["base_joint_axes"][steep] = hexapod.base_joint_axes[steep]
    p["platform.center_of_mass"] = random.normal(0.0, 0.05, 3)
    p["platform.inertia"] = inertia_tensor(random)
    p["payload.inertia"] = inertia_tensor(random)
    p["leg.lower.axial_inertia"] = np.array(0.02)
    p["leg.upper.axial_inertia"] = np.array(0.01)
    p["brake.stiffness"], p["brake.damping"], p["stop.stiffness"] = np.array(1e5), np.array(100.0), np.array(1e4)
    p["gravity"] = 9.81 * unit(random)
    p["magnetic_field"] = 50.0 * unit(random)
    p["leg_imu_position"] = random.normal(0.0, 0.1, (6, 3))
    p["platform_imu_position"] = random.normal(0.0, 0.1, 3)
    return p


def imperfect_legs(p: Values, random: Generator) -> Values:
    """The same with axes that do not meet, and with play in some legs."""
    return p | {
        "base_joint_offset": random.normal(0.0, 0.02, 6),
        "screw.backlash": random.permutation([0.0, 0.0, 0.0, 1e-3, 2e-3, 0.0]),
        "joint.clearance": random.permutation([0.0, 0.0, 0.0, 0.0, 1e-3, 2e-3]),
        "screw.stiffness": np.array(1e5),
        "screw.damping": np.array(15.0),
    }


def random_state(p: Values, random: Generator) -> tuple[Values, Values]:
    """A fast state somewhere in the workspace, and inputs."""
    turned = Rotation.from_rotvec(random.normal(0.0, 0.2, 3)).as_matrix()
    states = {
        "state.position": p["initial_position"] + random.normal(0.0, 0.05, 3),
        "state.quaternion": quaternion_from_rotation(turned),
        "state.velocity": random.normal(0.0, 0.5, 3),
        "state.angular_velocity": random.normal(0.0, 3.0, 3),
        "state.current": random.normal(0.0, 5.0, 6),
        "state.brake_deflection": random.normal(0.0, 1e-4, 6),
        "state.bending": np.zeros((6, 2)),
        "state.bending_rate": np.zeros((6, 2)),
        # Some legs with play are pushed either way, and some are free.
        "state.play": play(p) * random.uniform(-0.6, 0.6, 6),
        "state.play_velocity": np.sign(play(p)) * random.normal(0.0, 0.02, 6),
    }
    inputs = {
        "velocity_command": random.normal(0.0, 0.1, 6),
        "drive_mode": random.permutation([OPEN, BRAKE, VELOCITY, OPEN, BRAKE, VELOCITY]),
        "external_wrench.force": random.normal(0.0, 20.0, 3),
        "external_wrench.torque": random.normal(0.0, 20.0, 3),
    }
    return states, inputs | random_base(random, 0.0)


def external_wrench(inputs: Values) -> Array:
    return np.hstack([inputs["external_wrench.force"], inputs["external_wrench.torque"]])


def pose_and_twist(states: Values) -> tuple[Array, Array, Array]:
    rotation = rotation_from_quaternion(states["state.quaternion"])
    return states["state.position"], rotation, np.hstack([states["state.velocity"], states["state.angular_velocity"]])


def axial_forces(p: Values, states: Values, inputs: Values) -> dict[str, tuple[Array, Array]]:
    """What motor, friction, brake, end stop and play push with along each leg [N], and the speeds of what they push [m/s]."""
    position, rotation, twist = pose_and_twist(states)
    leg_speed = jacobian(p, position, rotation) @ twist
    speed = leg_speed + states["state.play_velocity"]
    length = bodies_at(p, position, rotation).lengths
    below = np.maximum(p["stop.minimum_length"] - length, 0.0)
    above = np.maximum(length - p["stop.maximum_length"], 0.0)
    give = p["stop.damping"] * leg_speed
    closed = inputs["drive_mode"] == BRAKE
    stops = p["stop.stiffness"] * (below * np.maximum(1.0 - give, 0.0) - above * np.maximum(1.0 + give, 0.0))
    on_motors = {
        "drive": 2.0 * np.pi / p["motor.screw_lead"] * p["motor.torque_constant"] * states["state.current"],
        "friction": -p["friction.viscous"] * speed - p["friction.coulomb"] * speed / np.hypot(speed, p["friction.velocity"]),
        "brake": -p["brake.stiffness"] * states["state.brake_deflection"] - closed * p["brake.damping"] * speed,
    }
    between = flanks(p, states["state.play"], states["state.play_velocity"])
    return {name: (force, speed) for name, force in on_motors.items()} | {
        "stop": (stops, leg_speed),
        "play": (-between, states["state.play_velocity"]),
    }


def forces_on_legs(p: Values, forces: dict[str, tuple[Array, Array]]) -> tuple[Array, Array]:
    """Along each leg, what pushes the rod, and what pushes a motor that is apart from it [N]."""
    on_motor, loose = sum(forces[name][0] for name in ("drive", "friction", "brake")), play(p) > 0.0
    between = -forces["play"][0]
    return forces["stop"][0] + np.where(loose, between, on_motor), np.where(loose, on_motor - between, 0.0)


MOVING = pytest.mark.parametrize("moving", [0.0, 1.0], ids=["base at rest", "base moves"])


@pytest.mark.slow
@MOVING
@pytest.mark.parametrize("seed", range(20))
def test_the_equations_of_motion_agree_with_explicit_bodies(
    dynamics: Dynamics, hexapod: Mechanism, seed: int, moving: float
) -> None:
    random = np.random.default_rng(seed)
    p = imperfect_legs(odd_mechanism(hexapod, random), random)
    states, inputs = random_state(p, random)
    inputs |= random_base(random, moving)
    base = base_path(inputs)
    constants = dynamics.constants(flat(p, SPATIAL.parameters))
    held = flat(states, SPATIAL.states), flat(inputs, SPATIAL.inputs), constants
    rates = named(np.array(dynamics.rates(*held)).ravel(), SPATIAL.states)
    position, rotation, twist = pose_and_twist(states)
    acceleration = np.hstack([rates["state.velocity"], rates["state.angular_velocity"]])

    on_legs, on_motors = forces_on_legs(p, axial_forces(p, states, inputs))
    applied = external_wrench(inputs) + jacobian(p, position, rotation).T @ on_legs
    inertia = inertia_matrix(p, position, rotation) @ acceleration
    bias = bias_force(p, position, rotation, twist, base)
    np.testing.assert_allclose(inertia + bias, applied, rtol=0.0, atol=1e-8 * np.abs(bias).max())
    np.testing.assert_array_equal(rates["state.position"], states["state.velocity"])

    # All IMUs, and the motors apart from their rods, carried along the path that has these accelerations.
    outputs = named(np.array(dynamics.outputs(*held)).ravel(), SPATIAL.outputs)
    path, step = bent_path(position, rotation, twist, acceleration), 1.5e-4
    lengths = np.array([bodies_at(p, *path(i * step)).lengths for i in range(-3, 4)])
    ahead = (play(p) > 0.0) * (on_motors / rotor_mass(p) - derivatives(lengths, step)[1])
    np.testing.assert_allclose(rates["state.play_velocity"], ahead, rtol=0.0, atol=1e-6 * np.abs(ahead).max())
    np.testing.assert_array_equal(rates["state.play"], states["state.play_velocity"])
    seen = [imus_on_earth(p, *path(i * step), *base(i * step)) for i in range(-3, 4)]
    places, attitudes = (np.array(values) for values in zip(*seen, strict=True))
    to_sensor = np.swapaxes(attitudes[3], 1, 2)
    force = np.einsum("kij,kj->ki", to_sensor, derivatives(places, step)[1] - p["gravity"])
    rate = vector_of(to_sensor @ derivatives(attitudes, step)[0])
    np.testing.assert_allclose(outputs["imu_angular_velocity"], rate, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(outputs["imu_specific_force"], force, rtol=0.0, atol=1e-6 * np.abs(force).max())
    np.testing.assert_allclose(outputs["imu_magnetic_field"], to_sensor @ p["magnetic_field"], rtol=0.0, atol=1e-11)


def imus_on_earth(p: Values, position: Array, rotation: Array, place: Array, turn: Array) -> tuple[Array, Array]:
    """Places (7, 3) and attitudes (7, 3, 3) of the IMUs on a base at a place with a rotation."""
    frames = leg_frames(p, position, rotation)
    at_legs = second_axes(p, position, rotation) + np.einsum("kij,kj->ki", frames, p["leg_imu_position"])
    places = np.vstack([at_legs, position + rotation @ p["platform_imu_position"]])
    return place + places @ turn.T, turn @ np.concatenate([frames, rotation[None]])


@MOVING
@pytest.mark.parametrize("seed", range(20))
def test_energies_and_powers_agree_with_explicit_bodies(
    dynamics: Dynamics, hexapod: Mechanism, seed: int, moving: float
) -> None:
    random = np.random.default_rng(100 + seed)
    p = imperfect_legs(odd_mechanism(hexapod, random), random)
    states, inputs = random_state(p, random)
    inputs |= random_base(random, moving)
    base = base_path(inputs)
    constants = dynamics.constants(flat(p, SPATIAL.parameters))

    def outputs_at(states: Values) -> Values:
        return named(
            np.array(dynamics.outputs(flat(states, SPATIAL.states), flat(inputs, SPATIAL.inputs), constants)).ravel(),
            SPATIAL.outputs,
        )

    def expected_energies(states: Values) -> tuple[float, float]:
        return energies(p, *pose_and_twist(states), base, base(0.0)[1] @ inputs["base_motion.acceleration"])

    outputs = outputs_at(states)
    position, rotation, twist = pose_and_twist(states)
    kinetic, potential = expected_energies(states)
    motors = jacobian(p, position, rotation) @ twist + states["state.play_velocity"]
    kinetic += 0.5 * rotor_mass(p) * float(np.sum(motors[play(p) > 0.0] ** 2))
    assert outputs["kinetic_energy"] == pytest.approx(kinetic, rel=1e-9)
    elsewhere = random_state(p, random)[0]
    change = outputs["potential_energy"] - outputs_at(elsewhere)["potential_energy"]
    assert change == pytest.approx(potential - expected_energies(elsewhere)[1], abs=1e-11)

    speed = jacobian(p, position, rotation) @ twist
    np.testing.assert_allclose(outputs["leg_velocity"], speed, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(outputs["leg_length"], bodies_at(p, position, rotation).lengths, rtol=1e-14)
    for source, (force, pushed) in axial_forces(p, states, inputs).items():
        assert outputs[f"power.{source}"] == pytest.approx(force @ pushed, rel=1e-11, abs=1e-11)
    assert outputs["power.external"] == pytest.approx(external_wrench(inputs) @ twist, rel=1e-12)


def start(plant: FmuPlant, position: Array, rotation: Array) -> None:
    """Take a plant of default parameters back to a start at this pose, before initialisation."""
    plant.fmu.reset()
    plant.set("initial_position", position)
    plant.set("initial_quaternion", quaternion_from_rotation(rotation))


@pytest.mark.parametrize("seed", range(10))
def test_the_legs_hold_the_weight_that_virtual_work_demands(make_plant: MakePlant, hexapod: Mechanism, seed: int) -> None:
    random = np.random.default_rng(200 + seed)
    position = hexapod.require_home().position + random.uniform(-0.03, 0.03, 3)
    rotation = Rotation.from_rotvec(random.uniform(-0.1, 0.1, 3)).as_matrix()
    plant = make_plant()
    step = 1e-3

    def potential(shift: Array) -> Array:
        start(plant, position + shift[:3], Rotation.from_rotvec(shift[3:]).as_matrix() @ rotation)
        return plant.get("potential_energy")

    gradient = [derivatives(np.array([potential(i * step * u) for i in range(-3, 4)]), step)[0] for u in np.eye(6)]
    p = hexapod.plant_parameters()
    forces = np.linalg.solve(jacobian(p, position, rotation).T, gradient)
    np.testing.assert_allclose(static_forces(p, position, rotation), forces, rtol=0.0, atol=1e-8)


def poses_in_the_stroke(mechanism: Mechanism, count: int, random: Generator) -> list[tuple[Array, Array]]:
    """Positions (3,) and rotations (3, 3) with every leg inside its stroke."""
    home, stroke, p = mechanism.require_home(), mechanism.require_limits().stroke, mechanism.plant_parameters()
    poses: list[tuple[Array, Array]] = []
    while len(poses) < count:
        position = home.position + random.uniform(-0.1, 0.1, 3)
        rotation = Rotation.from_rotvec(random.uniform(-0.3, 0.3, 3)).as_matrix() @ home.rotation
        lengths = np.linalg.norm(leg_vectors(p, position, rotation), axis=1)
        if ((lengths > stroke[:, 0]) & (lengths < stroke[:, 1])).all():
            poses.append((position, rotation))
    return poses


def wrench_of_legs(p: Values, position: Array, rotation: Array, wrench: Array) -> Array:
    """Forces (6,) [N] of the legs in equilibrium with all weights and a wrench on the platform: J^-T times their sum."""
    return static_forces(p, position, rotation) - np.linalg.solve(jacobian(p, position, rotation).T, wrench)


@pytest.mark.slow
def test_motors_in_equilibrium_push_as_virtual_work_demands_at_a_thousand_poses(dynamics: Dynamics, hexapod: Mechanism) -> None:
    """The motor forces that leave the derived equations at rest, under a tilted gravity and a random wrench."""
    random = np.random.default_rng(6)
    p = hexapod.plant_parameters() | {
        "gravity": 9.81 * unit(random),
        "platform.center_of_mass": random.normal(0.0, 0.05, 3),
        "payload.center_of_mass": random.normal(0.0, 0.05, 3),
    }
    poses = poses_in_the_stroke(hexapod, 1000, random)
    wrenches = random.normal(0.0, 1.0, (1000, 6)) * [100.0, 100.0, 100.0, 10.0, 10.0, 10.0]
    still = named(np.zeros(sum(variable.size for variable in SPATIAL.states)), SPATIAL.states)
    states, inputs = [], []
    for (position, rotation), wrench in zip(poses, wrenches, strict=True):
        pose = still | {"state.position": position, "state.quaternion": quaternion_from_rotation(rotation)}
        # At rest the accelerations are affine in the currents.
        states += [flat(pose | {"state.current": current}, SPATIAL.states) for current in np.vstack([np.zeros(6), np.eye(6)])]
        held = {
            "velocity_command": np.zeros(6),
            "drive_mode": np.full(6, OPEN),
            "external_wrench.force": wrench[:3],
            "external_wrench.torque": wrench[3:],
            **random_base(random, 0.0),
        }
        inputs += [flat(held, SPATIAL.inputs)] * 7
    constants = dynamics.constants(flat(p, SPATIAL.parameters))
    columns = np.array(dynamics.rates(np.transpose(states), np.transpose(inputs), constants)).T
    rates = [named(column, SPATIAL.states) for column in columns]
    accelerations = np.array([np.hstack([rate["state.velocity"], rate["state.angular_velocity"]]) for rate in rates])
    newtons_per_ampere = float(2.0 * np.pi / p["motor.screw_lead"] * p["motor.torque_constant"])
    for (position, rotation), wrench, found in zip(poses, wrenches, accelerations.reshape(1000, 7, 6), strict=True):
        currents = np.linalg.solve((found[1:] - found[0]).T, -found[0])
        expected = wrench_of_legs(p, position, rotation, wrench)
        np.testing.assert_allclose(newtons_per_ampere * currents, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("seed", range(5))
def test_forces_along_the_legs_that_hold_the_weight_leave_the_fmu_at_rest(
    make_plant: MakePlant, hexapod: Mechanism, seed: int
) -> None:
    """No brakes, open drives, and on the platform J^T times the static forces: all accelerometers read gravity alone."""
    random = np.random.default_rng(210 + seed)
    ((position, rotation),) = poses_in_the_stroke(hexapod, 1, random)
    p = hexapod.plant_parameters() | {"gravity": 9.81 * unit(random), "payload.center_of_mass": random.normal(0.0, 0.05, 3)}
    p |= {"brake.force": np.array(1e-9), "brake.stiffness": np.array(1e-9)}
    plant = make_plant(p | {"initial_position": position, "initial_quaternion": quaternion_from_rotation(rotation)})
    plant.set("drive_mode", np.full(6, OPEN))
    wrench = jacobian(p, position, rotation).T @ static_forces(p, position, rotation)
    plant.set("external_wrench.force", wrench[:3])
    plant.set("external_wrench.torque", wrench[3:])
    to_sensor = np.swapaxes(np.concatenate([leg_frames(p, position, rotation), rotation[None]]), 1, 2)
    np.testing.assert_allclose(plant.get("imu_specific_force"), -to_sensor @ p["gravity"], rtol=0.0, atol=9.81e-9)
    plant.step(0.1)
    np.testing.assert_allclose(plant.get("position"), position, rtol=0.0, atol=1e-10)


def rk4(dynamics: Dynamics, p: Values, states: Values, inputs: Values, step: float) -> Values:
    constants = dynamics.constants(flat(p, SPATIAL.parameters))
    held = flat(inputs, SPATIAL.inputs)

    def rate(x: Array) -> Array:
        return np.array(dynamics.rates(x, held, constants)).ravel()

    x = flat(states, SPATIAL.states)
    k1 = rate(x)
    k2 = rate(x + step / 2 * k1)
    k3 = rate(x + step / 2 * k2)
    k4 = rate(x + step * k3)
    after = named(x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4), SPATIAL.states)
    after["state.quaternion"] /= np.linalg.norm(after["state.quaternion"])
    return after


def test_the_fmu_integrates_the_derived_rates(dynamics: Dynamics, hexapod: Mechanism, make_plant: MakePlant) -> None:
    """The C code, its layout and its Runge-Kutta steps against the same method in Python, for odd parameters."""
    random = np.random.default_rng(5)
    p = imperfect_legs(odd_mechanism(hexapod, random), random)
    substep = float(p["substep"])
    plant = make_plant(p)
    states = named(np.array(dynamics.start(flat(p, SPATIAL.parameters))).ravel(), SPATIAL.states)
    for cycle in range(100):
        inputs = {
            "velocity_command": 0.05 * np.sin(0.3 * cycle + np.arange(6)),
            "drive_mode": np.roll([VELOCITY, VELOCITY, VELOCITY, OPEN, BRAKE, VELOCITY], cycle // 20),
            "external_wrench.force": random.normal(0.0, 10.0, 3),
            "external_wrench.torque": random.normal(0.0, 10.0, 3),
        }
        # The base rests, moves, and rests again.
        inputs |= random_base(random, 0.3 * (30 <= cycle < 60))
        for name, value in inputs.items():
            plant.set(name, value)
        plant.step(2 * substep)
        for _ in range(2):
            states = rk4(dynamics, p, states, inputs, substep)
        for name in ("position", "quaternion", "velocity", "angular_velocity", "current"):
            np.testing.assert_allclose(plant.get(name), states[f"state.{name}"], rtol=1e-10, atol=1e-12)


def drive(plant: FmuPlant, duration: float, seed: int = 0) -> None:
    """A lively motion: sines as commands and a wrench, at 1 kHz."""
    random = np.random.default_rng(seed)
    phases, frequencies = random.uniform(0.0, 2.0 * np.pi, 6), random.uniform(1.0, 4.0, 6)
    wrench = random.normal(0.0, 10.0, 6) * [1.0, 1.0, 1.0, 0.1, 0.1, 0.1]
    plant.set("drive_mode", np.full(6, VELOCITY))
    for cycle in range(round(duration / 1e-3)):
        t = 1e-3 * cycle
        plant.set("velocity_command", 0.08 * np.sin(2.0 * np.pi * frequencies * t + phases))
        plant.set("external_wrench.force", wrench[:3] * np.sin(15.0 * t))
        plant.set("external_wrench.torque", wrench[3:] * np.sin(15.0 * t))
        plant.step(1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_ideal_imu_signals_are_derivatives_of_the_trajectory(hexapod: Mechanism, make_plant: MakePlant, seed: int) -> None:
    p = odd_mechanism(hexapod, np.random.default_rng(300 + seed))
    plant = make_plant(p | {"substep": 2.5e-5})
    drive(plant, 0.3 + 0.05 * seed, seed)
    plant.step(2e-3)  # with held inputs from here on
    step = 1e-4
    places, attitudes = [], []
    for sample in range(7):
        if sample:
            plant.step(step)
        position, rotation = plant.get("position"), rotation_from_quaternion(plant.get("quaternion"))
        place, attitude = imus_on_earth(p, position, rotation, np.zeros(3), np.eye(3))
        places.append(place)
        attitudes.append(attitude)
        if sample == 3:
            signals = {name: plant.get(f"imu_{name}") for name in ("angular_velocity", "specific_force", "magnetic_field")}
    to_sensor = np.swapaxes(attitudes[3], 1, 2)
    acceleration = derivatives(np.array(places), step)[1]
    turning = derivatives(np.array(attitudes), step)[0]
    assert np.abs(acceleration).max() > 0.5
    specific_force = np.einsum("kij,kj->ki", to_sensor, acceleration - p["gravity"])
    np.testing.assert_allclose(signals["angular_velocity"], vector_of(to_sensor @ turning), rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(signals["specific_force"], specific_force, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(signals["magnetic_field"], to_sensor @ p["magnetic_field"], rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_ten_seconds_of_motion_are_within_a_tenth_of_a_micrometre_of_fine_substeps(make_plant: MakePlant) -> None:
    def ends(substep: float) -> Array:
        plant = make_plant({"substep": substep})
        drive(plant, 10.0)
        return np.hstack([plant.get("position"), plant.get("leg_length")])

    finest = ends(5e-4 / 16.0)
    preset, fine = (np.abs(ends(substep) - finest).max() for substep in (5e-4, 1.25e-4))
    assert preset < 1e-7
    # The step of the first command touches the current limiter, whose corner costs the method its fourth order.
    assert fine < preset / 2.0


def test_the_quaternion_stays_of_unit_length(make_plant: MakePlant) -> None:
    plant = make_plant({"gravity": [0.0, 0.0, 0.0]})
    farthest = 0.0
    for seed in range(20):
        drive(plant, 0.1, seed)
        farthest = max(farthest, abs(float(np.linalg.norm(plant.get("quaternion"))) - 1.0))
    assert farthest < 1e-15


def test_a_start_quaternion_that_is_nearly_unit_is_normalised(make_plant: MakePlant) -> None:
    plant = make_plant({"initial_quaternion": 1.0005 * np.array([np.cos(0.1), 0.0, 0.0, np.sin(0.1)])})
    np.testing.assert_allclose(plant.get("quaternion"), [np.cos(0.1), 0.0, 0.0, np.sin(0.1)], atol=1e-15)


def odd_drives(p: Values, random: Generator) -> Values:
    """Drives and brakes without a figure that is one, alike between legs, or never reached."""
    changes = {
        "motor.resistance": random.uniform(0.5, 0.9, 6),
        "motor.inductance": 0.7e-3,
        "motor.torque_constant": 0.06,
        "motor.screw_lead": 0.004,
        "drive.nominal_resistance": 0.8,
        "drive.gain": [0.9, 1.1, 1.0, 0.95, 1.05, 1.2],
        "drive.compensation": 0.3,
        "drive.voltage_limit": 15.0,
        "drive.current_limit": 6.0,
        "drive.current_time_constant": 0.002,
        "brake.force": 30.0,
        "brake.stiffness": 1e5,
        "brake.release_time": 0.004,
    }
    return p | {name: np.asarray(value, float) for name, value in changes.items()}


def current_rates(p: Values, mode: Array, current: Array, command: Array, speed: Array) -> tuple[Array, Array]:
    """Rates of the currents [A/s], and the voltages of the drives [V]; leg by leg."""
    constant = 2.0 * np.pi / p["motor.screw_lead"] * p["motor.torque_constant"]
    limit, lag = p["drive.current_limit"], p["drive.current_time_constant"]
    rates, voltages = [], []
    for i, which, u, v, r, g in zip(current, mode, command, speed, p["motor.resistance"], p["drive.gain"], strict=True):
        asked = g * constant * u + p["drive.compensation"] * p["drive.nominal_resistance"] * i if which == VELOCITY else 0.0
        voltage = float(np.clip(asked, -p["drive.voltage_limit"], p["drive.voltage_limit"]))
        back = 0.0 if which == OPEN else constant * v
        rates.append(np.clip((voltage - r * i - back) / p["motor.inductance"], (-limit - i) / lag, (limit - i) / lag))
        voltages.append(voltage)
    return np.array(rates), np.array(voltages)


def brake_rates(p: Values, mode: Array, deflection: Array, speed: Array) -> Array:
    """Rates of the brakes' deflections [m/s], leg by leg: stuck below 70 % of the slipping deflection, slipping at it."""
    slip = p["brake.force"] / p["brake.stiffness"]
    rates = []
    for which, z, v in zip(mode, deflection, speed, strict=True):
        load = abs(z) / slip
        if which != BRAKE:
            rates.append(-z / p["brake.release_time"])
        else:
            assert load < 0.7 or load > 1.0 - 1e-9, "the blend in between may have any smooth shape"
            rates.append(v if z * v <= 0.0 or load < 0.7 else v * (1.0 - load))
    return np.array(rates)


@pytest.mark.parametrize("seed", range(6))
def test_currents_brakes_and_attitude_change_at_their_rates(dynamics: Dynamics, hexapod: Mechanism, seed: int) -> None:
    random = np.random.default_rng(400 + seed)
    p = odd_drives(imperfect_legs(odd_mechanism(hexapod, random), random), random)
    states, inputs = random_state(p, random)
    slip = p["brake.force"] / p["brake.stiffness"]
    states["state.brake_deflection"] = slip * random.permutation([0.69, -0.69, 1.0, -1.0, 1.2, -1.2])
    # Strong and weak commands, so that voltages and currents are at their limits or within, of either sign.
    inputs["velocity_command"] = random.permutation([0.3, -0.3, 0.02, -0.02, 0.1, -0.1])
    inputs["drive_mode"] = np.full(6, (OPEN, BRAKE, VELOCITY)[seed % 3])
    states["state.velocity"] *= 0.1
    states["state.angular_velocity"] *= 0.1
    held = flat(states, SPATIAL.states), flat(inputs, SPATIAL.inputs), dynamics.constants(flat(p, SPATIAL.parameters))
    rates = named(np.array(dynamics.rates(*held)).ravel(), SPATIAL.states)
    outputs = named(np.array(dynamics.outputs(*held)).ravel(), SPATIAL.outputs)
    position, rotation, twist = pose_and_twist(states)
    speed = jacobian(p, position, rotation) @ twist + states["state.play_velocity"]
    mode, current = inputs["drive_mode"], states["state.current"]
    expected, voltage = current_rates(p, mode, current, inputs["velocity_command"], speed)
    np.testing.assert_allclose(rates["state.current"], expected, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(outputs["voltage"], voltage, rtol=1e-12)
    np.testing.assert_array_equal(outputs["current"], current)
    bristles = brake_rates(p, mode, states["state.brake_deflection"], speed)
    np.testing.assert_allclose(rates["state.brake_deflection"], bristles, rtol=1e-9, atol=1e-12)

    step = 1e-6
    after = Rotation.from_rotvec(step * states["state.angular_velocity"]).as_matrix() @ rotation
    before = Rotation.from_rotvec(-step * states["state.angular_velocity"]).as_matrix() @ rotation
    difference = (quaternion_from_rotation(after) - quaternion_from_rotation(before)) / (2.0 * step)
    np.testing.assert_allclose(rates["state.quaternion"], difference, rtol=0.0, atol=1e-8)


def test_a_start_is_the_initial_pose_at_rest(dynamics: Dynamics, hexapod: Mechanism) -> None:
    start = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_quat(scalar_first=True)
    p = hexapod.plant_parameters() | {"initial_position": np.array([0.01, -0.02, 0.34]), "initial_quaternion": 1.0005 * start}
    states = named(np.array(dynamics.start(flat(p, SPATIAL.parameters))).ravel(), SPATIAL.states)
    np.testing.assert_array_equal(states["state.position"], [0.01, -0.02, 0.34])
    np.testing.assert_allclose(states["state.quaternion"], start, atol=1e-15)
    for name in ("velocity", "angular_velocity", "current"):
        assert not states[f"state.{name}"].any()


@pytest.mark.parametrize("seed", range(10))
def test_at_the_start_the_brakes_carry_the_weight(dynamics: Dynamics, hexapod: Mechanism, seed: int) -> None:
    """The equilibrium of each body, and no acceleration in the plant's own equations."""
    random = np.random.default_rng(seed)
    p = odd_mechanism(hexapod, random) | {"brake.force": np.array(1e5), "stop.stiffness": np.array(0.0)}
    states = named(np.array(dynamics.start(flat(p, SPATIAL.parameters))).ravel(), SPATIAL.states)
    position, rotation, _ = pose_and_twist(states)
    loads = static_forces(p, position, rotation)
    np.testing.assert_allclose(-p["brake.stiffness"] * states["state.brake_deflection"], loads, atol=1e-6 * np.abs(loads).max())
    inputs = {variable.name: np.zeros(variable.shape) for variable in SPATIAL.inputs}
    held = flat(states, SPATIAL.states), flat(inputs, SPATIAL.inputs), dynamics.constants(flat(p, SPATIAL.parameters))
    rates = named(np.array(dynamics.rates(*held)).ravel(), SPATIAL.states)
    assert np.abs(rates["state.velocity"]).max() < 1e-6 and np.abs(rates["state.angular_velocity"]).max() < 1e-5


def broken(dynamics: Dynamics, p: Values) -> list[str]:
    """What the conditions on the parameters say."""
    values, limits = (np.array(side).ravel() for side in dynamics.conditions(flat(p, SPATIAL.parameters)))
    told = zip(dynamics.condition_texts, values, limits, strict=True)
    return [text % (value, limit) for text, value, limit in told if not value <= limit]


FLAT = np.diag([0.02, 0.03, 0.05])
"""Of a flat body: the third principal moment is the sum of the others."""


@pytest.mark.parametrize("body", ["platform", "payload"])
def test_an_inertia_is_that_of_a_real_body(dynamics: Dynamics, hexapod: Mechanism, body: str) -> None:
    p = dict(hexapod.plant_parameters())
    turn = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()
    for axes in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        whole = FLAT[np.ix_(axes, axes)]
        thinner = whole + np.diag(np.where(np.diag(whole) == 0.05, 1e-4, 0.0))
        for rotation in (np.eye(3), turn):
            assert broken(dynamics, p | {f"{body}.inertia": rotation @ whole @ rotation.T}) == []
            (said,) = broken(dynamics, p | {f"{body}.inertia": rotation @ thinner @ rotation.T})
            assert said.startswith(f"{body}.inertia is of no real body")
    for row, column in ((0, 1), (2, 0), (1, 2)):
        skewed = FLAT + 0.01 * np.eye(3)
        skewed[row, column] += 1e-4
        assert any(f"{body}.inertia is not symmetric" in said for said in broken(dynamics, p | {f"{body}.inertia": skewed}))
    # Second moments with one negative beside a zero, which neither the diagonal nor the determinant shows.
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        moments = np.diag([0.01, 0.01, 0.01])
        moments[axis, axis], moments[first, second], moments[second, first] = 0.0, 0.02, 0.02
        (said,) = broken(dynamics, p | {f"{body}.inertia": np.trace(moments) * np.eye(3) - moments})
        assert said.startswith(f"{body}.inertia is of no real body")
    if body == "payload":
        assert broken(dynamics, p | {"payload.inertia": np.zeros((3, 3)), "payload.mass": np.array(0.0)}) == []


@pytest.mark.parametrize("leg", [0, 5])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_leg_along_the_axis_of_its_joint_is_told_at_the_start_and_later(
    dynamics: Dynamics, hexapod: Mechanism, leg: int, sign: float
) -> None:
    p = dict(hexapod.plant_parameters())
    assert broken(dynamics, p) == []
    along, across = hexapod.home_directions[leg], hexapod.base_joint_axes[leg]

    def turned(cosine: float) -> Values:
        axes = np.array(hexapod.base_joint_axes)
        axes[leg] = sign * (cosine * along + np.sqrt(1.0 - cosine**2) * across)
        return p | {"base_joint_axes": axes}

    def limits(p: Values) -> list[str]:
        constants = dynamics.constants(flat(p, SPATIAL.parameters))
        start = dynamics.start(flat(p, SPATIAL.parameters))
        values, most = (np.array(side).ravel() for side in dynamics.limits(start, constants))
        return [text for text, value, limit in zip(dynamics.limit_texts, values, most, strict=True) if not value <= limit]

    assert broken(dynamics, turned(0.9899)) == []
    (said,) = broken(dynamics, turned(0.9901))
    assert said == f"leg {leg} starts along its base_joint_axes (cosine 0.9901, at most 0.99): turn the axis"
    assert limits(turned(0.9997)) == []
    (said,) = limits(turned(0.9999))
    assert said.startswith(f"leg {leg} has come to lie along the first axis of its base joint")
    longer = p | {"base_joint_axes": np.array(p["base_joint_axes"])}
    longer["base_joint_axes"][leg] *= 1.0011
    (said,) = broken(dynamics, longer)
    assert said.startswith(f"base_joint_axes of leg {leg} is not of unit length")


def test_a_quaternion_off_unit_length_is_told_from_either_side(dynamics: Dynamics, hexapod: Mechanism) -> None:
    p = dict(hexapod.plant_parameters())
    for length, good in ((1.0009, True), (0.9991, True), (1.0011, False), (0.9989, False)):
        said = broken(dynamics, p | {"initial_quaternion": length * p["initial_quaternion"]})
        assert (said == []) == good
        assert all("initial_quaternion is not of unit length" in text for text in said)


def test_the_greatest_substep_is_told_in_seconds(dynamics: Dynamics, hexapod: Mechanism) -> None:
    """Of drive, released brake and slipping brake: Runge and Kutta's method holds to 2.5 time constants."""
    p = dict(hexapod.plant_parameters()) | {
        "substep": np.array(0.1),
        "drive.current_time_constant": np.array(0.003),
        "brake.release_time": np.array(0.007),
    }
    constant = 2.0 * np.pi / 0.005 * 0.05
    for cause, most in (
        ("drive.current_time_constant", 2.5 * 0.003),
        ("brake.release_time", 2.5 * 0.007),
        ("a slipping brake", 2.5 * 1500.0 / 5e6 / (24.0 / constant)),
    ):
        (said,) = (text for text in broken(dynamics, p) if f"because of {cause}" in text)
        assert said.startswith(f"substep is 0.1 s, and may be at most {most:g} s because of")
