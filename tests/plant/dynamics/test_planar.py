"""The planar plant: equations of motion, energies, ideal IMU signals, conditions on its parameters, and its FMU."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import ArrayLike

from plant.dynamics.assembly import Dynamics
from plant.dynamics.planar import build_dynamics
from plant.dynamics.variables import BRAKE, OPEN, PLANAR, VELOCITY, Variable, checked_parameters
from plant.errors import FmuError
from plant.fmu.build import PLANAR_MODEL, SPATIAL_MODEL, Model, default_fmu
from plant.fmu.plant import FmuPlant
from plant.mechanism import Mechanism, load_in_space
from plant.pose import Array
from tests.plant.dynamics.explicit_bodies import (
    base_path,
    derivatives,
    flanks,
    play,
    random_base,
    rotor_mass,
    vector_of,
)
from tests.plant.dynamics.planar_bodies import (
    LEGS,
    Values,
    bias_force,
    coordinates,
    force_in_space,
    frames_at,
    inertia_matrix,
    jacobian,
    weight_force,
)

STILL = random_base(np.random.default_rng(0), 0.0)
"""A base at rest."""


@pytest.fixture(scope="module")
def dynamics() -> Dynamics:
    return build_dynamics()


@pytest.fixture(scope="module")
def rig() -> Mechanism:
    return load_in_space("planar-3rpr")


def flat(values: Mapping[str, Array], table: tuple[Variable, ...]) -> Array:
    return np.concatenate([np.ravel(values[variable.name]) for variable in table])


def named(vector: Array, table: tuple[Variable, ...]) -> Values:
    ends = np.cumsum([variable.size for variable in table])
    parts = np.split(np.array(vector).ravel(), ends[:-1])
    return {variable.name: part.reshape(variable.shape) for variable, part in zip(table, parts, strict=True)}


def odd_rig(rig: Mechanism, random: Generator) -> Values:
    """Parameters without any symmetry, gravity and IMUs out of the plane included."""
    p = dict(rig.plant_parameters())
    p["base_joints"] = p["base_joints"] + random.normal(0.0, 0.02, (3, 2))
    p["platform_joints"] = p["platform_joints"] + random.normal(0.0, 0.02, (3, 2))
    for body in ("platform", "payload"):
        p[f"{body}.center_of_mass"] = random.normal(0.0, 0.05, 2)
        p[f"{body}.inertia"] = np.array(random.uniform(1e-3, 5e-3))
    p["leg.lower.inertia"], p["leg.upper.inertia"] = random.uniform(1e-3, 5e-3, 2)
    p["gravity"] = random.normal(0.0, 6.0, 3)
    p["magnetic_field"] = random.normal(0.0, 30.0, 3)
    p["leg_imu_position"] = random.normal(0.0, 0.05, (3, 3))
    p["platform_imu_position"] = random.normal(0.0, 0.05, 3)
    p["brake.stiffness"], p["brake.damping"], p["stop.stiffness"] = np.array(1e4), np.array(50.0), np.array(1e4)
    p["screw.backlash"], p["joint.clearance"] = random.permutation([0.0, 1e-3, 0.0]), random.permutation([0.0, 1e-3, 0.0])
    p["screw.stiffness"] = np.array(1e4)
    return p


def random_state(p: Values, random: Generator) -> tuple[Values, Values]:
    states = {
        "state.position": p["initial_position"] + random.normal(0.0, 0.03, 2),
        "state.angle": p["initial_angle"] + random.normal(0.0, 0.2),
        "state.velocity": random.normal(0.0, 0.3, 2),
        "state.angular_velocity": np.array(random.normal(0.0, 3.0)),
        "state.current": random.normal(0.0, 1.0, 3),
        "state.brake_deflection": random.normal(0.0, 1e-4, 3),
        "state.bending": np.zeros((3, 2)),
        "state.bending_rate": np.zeros((3, 2)),
        "state.play": play(p) * random.uniform(-0.6, 0.6, 3),
        "state.play_velocity": np.sign(play(p)) * random.normal(0.0, 0.02, 3),
    }
    inputs = {
        "velocity_command": random.normal(0.0, 0.05, 3),
        "drive_mode": random.permutation([OPEN, BRAKE, VELOCITY]),
        "external_wrench.force": random.normal(0.0, 10.0, 2),
        "external_wrench.torque": np.array(random.normal(0.0, 1.0)),
    }
    return states, inputs | random_base(random, 0.0)


def axial_forces(p: Values, states: Values, inputs: Values, length: Array, leg_speed: Array) -> dict[str, Array]:
    """What motor, friction, brake, end stop and play push with along each leg [N]."""
    speed = leg_speed + states["state.play_velocity"]
    below = np.maximum(p["stop.minimum_length"] - length, 0.0)
    above = np.maximum(length - p["stop.maximum_length"], 0.0)
    give = p["stop.damping"] * leg_speed
    return {
        "drive": 2.0 * np.pi / p["motor.screw_lead"] * p["motor.torque_constant"] * states["state.current"],
        "friction": -p["friction.viscous"] * speed - p["friction.coulomb"] * speed / np.hypot(speed, p["friction.velocity"]),
        "brake": (
            -p["brake.stiffness"] * states["state.brake_deflection"]
            - (inputs["drive_mode"] == BRAKE) * p["brake.damping"] * speed
        ),
        "stop": p["stop.stiffness"] * (below * np.maximum(1.0 - give, 0.0) - above * np.maximum(1.0 + give, 0.0)),
        "play": -flanks(p, states["state.play"], states["state.play_velocity"]),
    }


def force_on_legs(p: Values, forces: dict[str, Array]) -> Array:
    """What pushes the rods along the legs [N]: the motors, or the flanks of screws with play."""
    return forces["stop"] + np.where(play(p) > 0.0, -forces["play"], forces["drive"] + forces["friction"] + forces["brake"])


@pytest.mark.parametrize("seed", range(20))
def test_motion_energies_and_powers_agree_with_explicit_bodies(dynamics: Dynamics, rig: Mechanism, seed: int) -> None:
    random = np.random.default_rng(seed)
    p = odd_rig(rig, random)
    states, inputs = random_state(p, random)
    held = (flat(states, PLANAR.states), flat(inputs, PLANAR.inputs), dynamics.constants(flat(p, PLANAR.parameters)))
    rates, outputs = named(dynamics.rates(*held), PLANAR.states), named(dynamics.outputs(*held), PLANAR.outputs)
    q = np.append(states["state.position"], states["state.angle"])
    rate = np.append(states["state.velocity"], states["state.angular_velocity"])
    acceleration = np.append(rates["state.velocity"], rates["state.angular_velocity"])
    length, to_lengths = coordinates(p, q)[-LEGS:], jacobian(p, q)[-LEGS:]
    speed = to_lengths @ rate
    forces = axial_forces(p, states, inputs, length, speed)
    wrench = np.append(inputs["external_wrench.force"], inputs["external_wrench.torque"])
    applied = wrench + weight_force(p, q) + to_lengths.T @ force_on_legs(p, forces)
    inertia = inertia_matrix(p, q)
    np.testing.assert_allclose(inertia @ acceleration + bias_force(p, q, rate), applied, rtol=0.0, atol=1e-8)

    motors = speed + states["state.play_velocity"]
    apart = 0.5 * rotor_mass(p) * float(np.sum(motors[play(p) > 0.0] ** 2))
    assert outputs["kinetic_energy"] == pytest.approx(0.5 * rate @ inertia @ rate + apart, rel=1e-12)
    np.testing.assert_allclose(outputs["leg_length"], length, rtol=1e-14)
    np.testing.assert_allclose(outputs["leg_velocity"], speed, rtol=1e-12, atol=1e-14)
    pushed = {"stop": speed, "play": states["state.play_velocity"]}
    for source, force in forces.items():
        assert outputs[f"power.{source}"] == pytest.approx(force @ pushed.get(source, motors), rel=1e-11, abs=1e-11)
    assert outputs["power.external"] == pytest.approx(wrench @ rate, rel=1e-12)

    def potential(q: Array) -> float:
        moved = states | {"state.position": q[:2], "state.angle": q[2]}
        return float(named(dynamics.outputs(flat(moved, PLANAR.states), *held[1:]), PLANAR.outputs)["potential_energy"])

    step = 1e-3
    gradient = [derivatives(np.array([potential(q + i * step * unit) for i in range(-3, 4)]), step)[0] for unit in np.eye(3)]
    np.testing.assert_allclose(-np.array(gradient), weight_force(p, q), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_motion_and_imus_on_a_base_that_moves_agree_with_bodies_in_space(dynamics: Dynamics, rig: Mechanism, seed: int) -> None:
    random = np.random.default_rng(30 + seed)
    p = odd_rig(rig, random)
    states, inputs = random_state(p, random)
    inputs |= random_base(random, 1.0)
    base = base_path(inputs)
    held = (flat(states, PLANAR.states), flat(inputs, PLANAR.inputs), dynamics.constants(flat(p, PLANAR.parameters)))
    rates, outputs = named(dynamics.rates(*held), PLANAR.states), named(dynamics.outputs(*held), PLANAR.outputs)
    q = np.append(states["state.position"], states["state.angle"])
    rate = np.append(states["state.velocity"], states["state.angular_velocity"])
    acceleration = np.append(rates["state.velocity"], rates["state.angular_velocity"])
    length, to_lengths = coordinates(p, q)[-LEGS:], jacobian(p, q)[-LEGS:]
    forces = axial_forces(p, states, inputs, length, to_lengths @ rate)
    wrench = np.append(inputs["external_wrench.force"], inputs["external_wrench.torque"])
    applied = wrench + to_lengths.T @ force_on_legs(p, forces)
    taken = force_in_space(p, q, rate, acceleration, base)
    np.testing.assert_allclose(taken, applied, rtol=0.0, atol=1e-8 * np.abs(applied).max())

    step, samples = 2.5e-4, []
    for i in range(-3, 4):
        t = i * step
        moved, (place, turn) = q + rate * t + acceleration * t**2 / 2.0, base(t)
        attitudes, places = frames_at(p, moved[:2], moved[2])
        samples.append((place + places @ turn.T, turn @ attitudes))
    places, attitudes = (np.array(values) for values in zip(*samples, strict=True))
    to_sensor = np.swapaxes(attitudes[3], 1, 2)
    force = np.einsum("kij,kj->ki", to_sensor, derivatives(places, step)[1] - p["gravity"])
    turning = vector_of(to_sensor @ derivatives(attitudes, step)[0])
    np.testing.assert_allclose(outputs["imu_angular_velocity"], turning, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(outputs["imu_specific_force"], force, rtol=0.0, atol=1e-7 * np.abs(force).max())
    np.testing.assert_allclose(outputs["imu_magnetic_field"], to_sensor @ p["magnetic_field"], rtol=0.0, atol=1e-11)


def integrator(dynamics: Dynamics, p: Values, step: float) -> Callable[[Array, Array], Array]:
    """Steps of Runge and Kutta's method for states and inputs as flat vectors."""
    constants = dynamics.constants(flat(p, PLANAR.parameters))

    def advance(x: Array, u: Array) -> Array:
        def rate(x: Array) -> Array:
            return np.array(dynamics.rates(x, u, constants)).ravel()

        k1 = rate(x)
        k2 = rate(x + step / 2.0 * k1)
        k3 = rate(x + step / 2.0 * k2)
        k4 = rate(x + step * k3)
        return x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    return advance


@pytest.mark.slow
def test_energy_changes_by_the_work_of_all_forces(dynamics: Dynamics, rig: Mechanism) -> None:
    """0.3 s of sines as commands and a wrench, with brakes that fall in: Simpson's rule over every pair of steps."""
    p = rig.plant_parameters()
    constants, step = dynamics.constants(flat(p, PLANAR.parameters)), 5e-5
    advance = integrator(dynamics, p, step)
    x = np.array(dynamics.start(flat(p, PLANAR.parameters))).ravel()
    sources = [f"power.{source}" for source in ("drive", "friction", "brake", "stop", "external")]
    work = dict.fromkeys(sources, 0.0)
    energies = []
    for pair in range(3000):
        t = 2.0 * step * pair
        inputs = {
            "velocity_command": 0.06 * np.sin(25.0 * t + np.arange(3)),
            "drive_mode": np.full(3, BRAKE if 0.2 <= t < 0.25 else VELOCITY),
            "external_wrench.force": 5.0 * np.sin([20.0 * t, 30.0 * t]),
            "external_wrench.torque": np.array(0.1 * np.sin(40.0 * t)),
            **STILL,
        }
        u = flat(inputs, PLANAR.inputs)
        for sample, weight in enumerate((1.0, 4.0, 1.0)):
            x = advance(x, u) if sample else x
            outputs = named(dynamics.outputs(x, u, constants), PLANAR.outputs)
            energies.append(float(outputs["kinetic_energy"] + outputs["potential_energy"]))
            for source in sources:
                work[source] += weight * step / 3.0 * float(outputs[source])
    assert energies[-1] - energies[0] == pytest.approx(sum(work.values()), abs=1e-7)
    assert min(abs(work[f"power.{source}"]) for source in ("drive", "friction", "brake", "external")) > 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_ideal_imu_signals_are_derivatives_of_the_trajectory(dynamics: Dynamics, rig: Mechanism, seed: int) -> None:
    random = np.random.default_rng(50 + seed)
    p = odd_rig(rig, random)
    states, inputs = random_state(p, random)
    inputs["drive_mode"][:] = VELOCITY
    step = 2.5e-5
    advance, u = integrator(dynamics, p, step), flat(inputs, PLANAR.inputs)
    samples = [flat(states, PLANAR.states)]
    for _ in range(200):
        samples.append(advance(samples[-1], u))
    poses = [named(x, PLANAR.states) for x in samples[-7:]]
    found = [frames_at(p, pose["state.position"], float(pose["state.angle"])) for pose in poses]
    attitudes, places = (np.array(values) for values in zip(*found, strict=True))
    to_sensor = np.swapaxes(attitudes[3], 1, 2)
    acceleration = derivatives(places, step)[1]
    assert np.abs(acceleration).max() > 0.5
    outputs = named(dynamics.outputs(samples[-4], u, dynamics.constants(flat(p, PLANAR.parameters))), PLANAR.outputs)
    rate = vector_of(to_sensor @ derivatives(attitudes, step)[0])
    force = np.einsum("kij,kj->ki", to_sensor, acceleration - p["gravity"])
    np.testing.assert_allclose(outputs["imu_angular_velocity"], rate, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(outputs["imu_specific_force"], force, rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(outputs["imu_magnetic_field"], to_sensor @ p["magnetic_field"], rtol=0.0, atol=1e-12)


def test_the_start_is_the_initial_pose_at_rest(dynamics: Dynamics, rig: Mechanism) -> None:
    start = named(dynamics.start(flat(rig.plant_parameters(), PLANAR.parameters)), PLANAR.states)
    np.testing.assert_array_equal(start["state.position"], [0.1, 0.205])
    assert start["state.angle"] == pytest.approx(-0.4, abs=1e-15)
    for name in ("velocity", "angular_velocity", "current"):
        assert not start[f"state.{name}"].any()


@pytest.mark.parametrize("seed", range(10))
def test_at_the_start_the_brakes_carry_the_weight(dynamics: Dynamics, rig: Mechanism, seed: int) -> None:
    """Virtual work of the explicit bodies, and no acceleration in the plant's own equations."""
    p = odd_rig(rig, np.random.default_rng(seed)) | {"brake.force": np.array(1e5), "stop.stiffness": np.array(0.0)}
    states = named(np.array(dynamics.start(flat(p, PLANAR.parameters))).ravel(), PLANAR.states)
    q = np.append(states["state.position"], states["state.angle"])
    pushed = jacobian(p, q)[-LEGS:].T @ (-p["brake.stiffness"] * states["state.brake_deflection"])
    np.testing.assert_allclose(pushed, -weight_force(p, q), rtol=0.0, atol=1e-6)
    assert np.abs(pushed).max() > 1.0
    inputs = {variable.name: np.zeros(variable.shape) for variable in PLANAR.inputs}
    held = flat(states, PLANAR.states), flat(inputs, PLANAR.inputs), dynamics.constants(flat(p, PLANAR.parameters))
    rates = named(dynamics.rates(*held), PLANAR.states)
    assert np.abs(rates["state.velocity"]).max() < 1e-6 and abs(rates["state.angular_velocity"]) < 1e-5


def broken(dynamics: Dynamics, p: Values) -> list[str]:
    """What the conditions on the parameters say."""
    values, limits = (np.array(side).ravel() for side in dynamics.conditions(flat(p, PLANAR.parameters)))
    told = zip(dynamics.condition_texts, values, limits, strict=True)
    return [text % (value, limit) for text, value, limit in told if not value <= limit]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"base_joints": [[0.0, 0.0], [0.1, 0.205], [0.3, 0.0]], "platform_joints": [[0.1, 0.0], [0.0, 0.0], [0.0, 0.1]]},
            "leg 1 needs",
        ),
        ({"stop.minimum_length": [0.1, 0.1, 0.3]}, "stop.minimum_length of leg 2 is 0.3 m, beyond"),
        ({"motor.inductance": 1e-4}, "motor, friction and brake"),
        ({"friction.velocity": 1e-5}, "motor, friction and brake"),
        ({"brake.release_time": 1e-5}, "brake.release_time"),
        ({"stop.stiffness": 1e9}, "the end stops"),
        ({"substep": 0.01}, "drive.current_time_constant"),
    ],
)
def test_parameters_that_make_no_sense_together_are_told(
    dynamics: Dynamics, rig: Mechanism, changes: dict[str, ArrayLike], said: str
) -> None:
    p = dict(rig.plant_parameters())
    assert broken(dynamics, p) == []
    assert any(said in text for text in broken(dynamics, p | checked_parameters(changes, PLANAR)))


@pytest.mark.parametrize("model", [SPATIAL_MODEL, PLANAR_MODEL], ids=lambda model: model.identifier)
def test_every_text_of_a_condition_tells_a_value_and_its_limit(model: Model) -> None:
    """The FMU's C code gives just these two to `printf`."""
    built = model.dynamics()
    for texts, function in ((built.condition_texts, built.conditions), (built.limit_texts, built.limits)):
        assert len(texts) == function.size1_out(0) == function.size1_out(1) > 0
        for text in texts:
            assert text.count("%g") == text.count("%") == 2, text


def test_the_fmu_integrates_the_derived_rates(dynamics: Dynamics, rig: Mechanism) -> None:
    """The C code, its layout and its Runge-Kutta steps against the same method in Python, for odd parameters."""
    random = np.random.default_rng(5)
    p = odd_rig(rig, random)
    substep = float(p["substep"])
    advance = integrator(dynamics, p, substep)
    x = np.array(dynamics.start(flat(p, PLANAR.parameters))).ravel()
    with FmuPlant(default_fmu(PLANAR_MODEL), p, 2 * substep) as plant:
        for cycle in range(60):
            inputs = {
                "velocity_command": 0.05 * np.sin(0.3 * cycle + np.arange(3)),
                "drive_mode": np.roll([VELOCITY, OPEN, BRAKE], cycle // 20),
                "external_wrench.force": random.normal(0.0, 3.0, 2),
                "external_wrench.torque": np.array(random.normal(0.0, 0.1)),
            }
            # The base rests, moves, and rests again.
            inputs |= random_base(random, 0.1 * (20 <= cycle < 40))
            for name, value in inputs.items():
                plant.set(name, value)
            plant.step(2 * substep)
            for _ in range(2):
                x = advance(x, flat(inputs, PLANAR.inputs))
            states = named(x, PLANAR.states)
            for name in ("position", "angle", "velocity", "angular_velocity", "current"):
                np.testing.assert_allclose(plant.get(name), states[f"state.{name}"], rtol=1e-10, atol=1e-12)


def test_the_fmu_refuses_parameters_that_make_no_sense_together(rig: Mechanism) -> None:
    p = rig.plant_parameters() | {"stop.minimum_length": np.full(3, 0.3)}
    with pytest.raises(FmuError, match=r"stop\.minimum_length of leg 0 is 0.3 m, beyond its stop\.maximum_length of 0\.26"):
        FmuPlant(default_fmu(PLANAR_MODEL), p, 1e-3)


def limits_of(dynamics: Dynamics, p: Values) -> tuple[Array, Array]:
    """Values and greatest values of the limits at the start."""
    parameters = flat(p, PLANAR.parameters)
    values, limits = dynamics.limits(dynamics.start(parameters), dynamics.constants(parameters))
    return np.array(values).ravel(), np.array(limits).ravel()


@pytest.mark.parametrize("leg", range(LEGS))
def test_each_leg_keeps_a_tenth_of_a_millimetre_at_any_angle(dynamics: Dynamics, rig: Mechanism, leg: int) -> None:
    """The base joint is put beside the turned platform joint, on either side of the limit."""
    p = dict(rig.plant_parameters())
    angle = float(p["initial_angle"])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    joints = p["initial_position"] + p["platform_joints"] @ turn.T
    np.testing.assert_allclose(limits_of(dynamics, p)[1], np.linalg.norm(joints - p["base_joints"], axis=1), rtol=1e-12)
    for length, good in ((1.01e-4, True), (0.99e-4, False)):
        base = p["base_joints"].copy()
        base[leg] = joints[leg] + length * np.array([0.6, -0.8])
        values, limits = limits_of(dynamics, p | {"base_joints": base})
        np.testing.assert_array_equal(values, 1e-4)
        assert [value <= limit for value, limit in zip(values, limits, strict=True)] == [good or k != leg for k in range(LEGS)]


@pytest.mark.parametrize("leg", range(LEGS))
def test_stops_in_the_wrong_order_name_their_leg(dynamics: Dynamics, rig: Mechanism, leg: int) -> None:
    p = dict(rig.plant_parameters())
    stops = p["stop.minimum_length"].copy()
    stops[leg] = p["stop.maximum_length"][leg] + 1e-6
    said = broken(dynamics, p | {"stop.minimum_length": stops})
    assert [text[: len("stop.minimum_length of leg 0")] for text in said if "beyond" in text] == [
        f"stop.minimum_length of leg {leg}"
    ]


def test_the_planar_drives_and_brakes_change_at_their_rates(dynamics: Dynamics, rig: Mechanism) -> None:
    """Each leg in its own mode: an open motor has no back-EMF, a braked one is short-circuited, a driven one follows."""
    changes = {"motor.resistance": np.array([4.5, 5.0, 5.5]), "drive.gain": np.array([0.9, 1.0, 1.1]),
        "drive.compensation": np.array(0.4), "drive.nominal_resistance": np.array(5.0),
        "drive.current_limit": np.array(50.0)}  # fmt: skip
    p = rig.plant_parameters() | changes
    random = np.random.default_rng(8)
    states, inputs = random_state(p, random)
    constant = 2.0 * np.pi / p["motor.screw_lead"] * p["motor.torque_constant"]
    for shift in range(3):
        mode = np.roll([OPEN, BRAKE, VELOCITY], shift)
        inputs |= {"drive_mode": mode, "velocity_command": np.array([0.02, -0.03, 0.04])}
        held = flat(states, PLANAR.states), flat(inputs, PLANAR.inputs), dynamics.constants(flat(p, PLANAR.parameters))
        rates, outputs = named(dynamics.rates(*held), PLANAR.states), named(dynamics.outputs(*held), PLANAR.outputs)
        speed, current, deflection = outputs["leg_velocity"], states["state.current"], states["state.brake_deflection"]
        asked = p["drive.gain"] * constant * inputs["velocity_command"] + 0.4 * 5.0 * current
        voltage = np.where(mode == VELOCITY, asked, 0.0)
        assert np.abs(voltage).max() < p["drive.voltage_limit"]
        back = np.where(mode == OPEN, 0.0, constant * speed)
        expected = (voltage - p["motor.resistance"] * current - back) / p["motor.inductance"]
        np.testing.assert_allclose(rates["state.current"], expected, rtol=1e-10)
        np.testing.assert_allclose(outputs["voltage"], voltage, rtol=1e-12)
        # The deflections are below 70 % of the slipping one.
        assert np.abs(deflection).max() < 0.7 * p["brake.force"] / p["brake.stiffness"]
        expected = np.where(mode == BRAKE, speed, -deflection / p["brake.release_time"])
        np.testing.assert_allclose(rates["state.brake_deflection"], expected, rtol=1e-10, atol=1e-15)
        np.testing.assert_array_equal(rates["state.position"], states["state.velocity"])
        assert rates["state.angle"] == states["state.angular_velocity"]
