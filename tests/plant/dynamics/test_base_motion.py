"""A base that moves: the FMU against a second model on the earth, and against motions that are alike."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from plant.dynamics.spatial import build_dynamics
from plant.dynamics.variables import BRAKE, SPATIAL, VELOCITY
from plant.fmu.build import PLANAR_MODEL, default_fmu
from plant.fmu.plant import FmuPlant
from plant.mechanism import load_in_space, load_spatial
from plant.pose import Array
from tests.plant.dynamics.maximal_coordinates import MaximalModel, MovingBase
from tests.plant.dynamics.test_second_model import NO_BRAKES, TOLERANCES, leaning
from tests.plant.dynamics.test_spatial import flat, imus_on_earth, named

MakePlant = Callable[..., FmuPlant]

IMUS = ("imu_angular_velocity", "imu_specific_force", "imu_magnetic_field")
SEEN = ("position", "quaternion", "velocity", "angular_velocity", "leg_length", "current", *IMUS)


def swaying(t: ca.SX) -> tuple[ca.SX, ca.SX]:
    """A base that sways and tilts about all axes, off from upright at the start."""
    place = ca.vertcat(0.3 * ca.sin(7 * t), 0.2 * ca.cos(9 * t), 0.1 * ca.sin(11 * t + 1))
    angles = ca.vertcat(0.3 * ca.sin(6 * t + 0.4), 0.2 * ca.cos(8 * t), 0.5 * ca.sin(5 * t) - 0.3)
    turn = ca.SX.eye(3)
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        about = ca.SX.eye(3)
        about[i, i] = about[j, j] = ca.cos(angles[axis])
        about[j, i] = ca.sin(angles[axis])
        about[i, j] = -about[j, i]
        turn = turn @ about
    return place, turn


@pytest.mark.slow
def test_motion_on_a_swaying_base_agrees_with_maximal_coordinates_on_the_earth(make_plant: MakePlant) -> None:
    """The equations agree to rounding; in the FMU, inputs held over a step cost the step's second order."""
    p = leaning("hexapod")
    model, base, duration = MaximalModel(p, swaying), MovingBase(swaying), 0.05
    held = {
        "drive_mode": np.full(6, VELOCITY),
        "velocity_command": 0.05 * np.random.default_rng(3).normal(size=6),
        "external_wrench.force": np.array([20.0, -30.0, 10.0]),
        "external_wrench.torque": np.array([2.0, -3.0, 1.0]),
    }
    pushed = np.hstack([held["external_wrench.force"], held["external_wrench.torque"]])
    model.go_on(duration, held["velocity_command"], held["drive_mode"], pushed)
    expected = model.outputs(held["velocity_command"], held["drive_mode"], pushed)
    assert model.gap() < 1e-9

    dynamics = build_dynamics()
    parameters = flat(p, SPATIAL.parameters)
    constants = dynamics.constants(parameters)

    def inputs(t: float) -> Array:
        return flat(held | base.inputs(t), SPATIAL.inputs)

    end = solve_ivp(
        lambda t, x: np.array(dynamics.rates(x, inputs(t), constants)).ravel(),
        (0.0, duration), np.array(dynamics.start(parameters)).ravel(), method="DOP853", rtol=1e-11, atol=1e-12,
    )  # fmt: skip
    outputs = named(np.array(dynamics.outputs(end.y[:, -1], inputs(duration), constants)).ravel(), SPATIAL.outputs)
    for name, tolerance in TOLERANCES.items():
        np.testing.assert_allclose(outputs[name], expected[name], rtol=0.0, atol=tolerance, err_msg=name)

    def stepped(step: float) -> dict[str, Array]:
        plant = make_plant(p | {"substep": np.array(1e-3 / 16.0)})
        for name, value in held.items():
            plant.set(name, value)
        for n in range(round(duration / step)):
            move_base(plant, base.inputs((n + 0.5) * step))
            plant.step(step)
        move_base(plant, base.inputs(duration))
        return {name: np.abs(plant.get(name) - value).max() for name, value in expected.items()}

    coarse, fine = stepped(1e-3), stepped(2.5e-4)
    assert coarse["position"] < 2e-7
    assert fine["position"] < coarse["position"] / 12.0 and fine["imu_specific_force"] < coarse["imu_specific_force"] / 12.0


def move_base(plant: FmuPlant, inputs: dict[str, Array]) -> None:
    for name, value in inputs.items():
        plant.set(name, value)


def ends(plant: FmuPlant, inputs: dict[str, Array], names: tuple[str, ...] = SEEN, legs: int = 6) -> dict[str, Array]:
    """What the plant puts out after 50 ms in motion with these inputs."""
    move_base(plant, inputs)
    plant.set("drive_mode", np.full(legs, VELOCITY))
    plant.set("velocity_command", 0.03 * np.cos(np.arange(legs)))
    plant.step(0.05)
    return {name: plant.get(name) for name in names}


def test_a_base_that_accelerates_is_another_gravity(make_plant: MakePlant) -> None:
    pull = np.array([1.5, -2.0, 3.0])
    accelerated = ends(make_plant(NO_BRAKES), {"base_motion.acceleration": pull})
    heavier = ends(make_plant(NO_BRAKES | {"gravity": np.array([0.0, 0.0, -9.81]) - pull}), {})
    for name in SEEN:
        np.testing.assert_allclose(accelerated[name], heavier[name], rtol=0.0, atol=1e-11, err_msg=name)


@pytest.mark.parametrize("tilt", [[0.3, -0.2, 0.5], [1e-9, 0.0, 0.0], [0.0, 3.0, 0.0], [2.0, 3.0, -4.0]])
def test_a_base_that_leans_is_a_turned_gravity_and_field(make_plant: MakePlant, tilt: list[float]) -> None:
    gravity, field = np.array([0.0, 0.0, -9.81]), np.array([20.0, 5.0, -40.0])
    turn = Rotation.from_rotvec(tilt).as_matrix()
    leaning = ends(make_plant(NO_BRAKES | {"magnetic_field": field}), {"base_motion.rotation": tilt})
    turned = ends(make_plant(NO_BRAKES | {"gravity": turn.T @ gravity, "magnetic_field": turn.T @ field}), {})
    for name in SEEN:
        np.testing.assert_allclose(leaning[name], turned[name], rtol=0.0, atol=1e-11, err_msg=name)


def test_a_planar_base_that_leans_and_accelerates_is_another_gravity() -> None:
    rig = load_in_space("planar-3rpr")
    p, pull, tilt = rig.plant_parameters() | NO_BRAKES, np.array([1.0, -2.0, 3.0]), np.array([0.3, -0.2, 0.5])
    turn = Rotation.from_rotvec(tilt).as_matrix()
    names = ("position", "angle", "velocity", "current", *IMUS)
    changed = {"gravity": turn.T @ p["gravity"] - pull, "magnetic_field": turn.T @ p["magnetic_field"]}
    with FmuPlant(default_fmu(PLANAR_MODEL), p, 1e-3) as plant, FmuPlant(default_fmu(PLANAR_MODEL), p | changed, 1e-3) as other:
        moved = ends(plant, {"base_motion.rotation": tilt, "base_motion.acceleration": pull}, names, 3)
        expected = ends(other, {}, names, 3)
    for name in names:
        np.testing.assert_allclose(moved[name], expected[name], rtol=0.0, atol=1e-11, err_msg=name)


def test_on_a_turntable_all_imus_feel_its_rate_and_their_distance_from_its_axis(make_plant: MakePlant) -> None:
    """The brakes hold the platform, and the base turns at a steady rate about an axis through the origin of {1}."""
    changes = {
        "leg_imu_position": np.random.default_rng(4).normal(0.0, 0.1, (6, 3)),
        "platform_imu_position": [0.1, 0.05, 0.02],
    }
    plant, rate = make_plant(changes), np.array([2.0, -1.0, 3.0])
    p = load_spatial("hexapod").plant_parameters() | {name: np.array(value) for name, value in changes.items()}
    plant.set("drive_mode", np.full(6, BRAKE))
    move_base(plant, {"base_motion.angular_velocity": rate})
    plant.step(2.0)
    rotation = Rotation.from_quat(plant.get("quaternion"), scalar_first=True).as_matrix()
    places, attitudes = imus_on_earth(p, plant.get("position"), rotation, np.zeros(3), np.eye(3))
    to_sensor = np.swapaxes(attitudes, 1, 2)
    felt = np.einsum("kij,kj->ki", to_sensor, np.cross(rate, np.cross(rate, places)) - p["gravity"])
    np.testing.assert_allclose(plant.get("imu_angular_velocity"), to_sensor @ rate, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(plant.get("imu_specific_force"), felt, rtol=0.0, atol=1e-4)


def test_a_base_that_is_back_at_rest_leaves_no_trace(make_plant: MakePlant) -> None:
    """After zero comes back the equations of a base at rest are used, which are the shorter ones, to the bit."""
    one, other = make_plant(), make_plant()
    move_base(one, {"base_motion.rotation": [0.1, 0.0, 0.0]})
    one.get("imu_specific_force")
    move_base(one, {"base_motion.rotation": [0.0, 0.0, 0.0]})
    for plant in (one, other):
        plant.step(0.05)
    for name in SEEN:
        np.testing.assert_array_equal(one.get(name), other.get(name), err_msg=name)


@pytest.mark.parametrize("name", ["hexapod", "planar-3rpr"])
def test_an_imu_on_the_base_reads_what_its_path_on_the_earth_makes(name: str, make_plant: MakePlant) -> None:
    """The path of its place is differentiated twice, by automatic differentiation of the swaying base alone."""
    place = np.array([0.2, -0.1, 0.15])
    moving, t, at = MovingBase(swaying), ca.SX.sym("t"), 0.37
    origin, turn = swaying(t)
    path = origin + turn @ place
    felt = turn.T @ (ca.jacobian(ca.jacobian(path, t), t) - ca.DM([0.0, 0.0, -9.81]))
    spin = turn.T @ ca.reshape(ca.jacobian(ca.vec(turn), t), 3, 3)
    rate = ca.vertcat(spin[2, 1], spin[0, 2], spin[1, 0])
    expected = [np.array(ca.Function("at", [t], [each])(at)).ravel() for each in (rate, felt)]
    p = load_in_space(name).plant_parameters() | {"base_imu_position": place, "gravity": np.array([0.0, 0.0, -9.81])}
    with make_plant(p) if name == "hexapod" else FmuPlant(default_fmu(PLANAR_MODEL), p, 1e-3) as plant:
        move_base(plant, moving.inputs(at))
        np.testing.assert_allclose(plant.get("base_imu_angular_velocity"), expected[0], atol=1e-12)
        np.testing.assert_allclose(plant.get("base_imu_specific_force"), expected[1], atol=1e-10)
