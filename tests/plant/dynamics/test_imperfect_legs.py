"""Legs with play, with axes that do not meet, and that bend: the plant against the second model, and by hand."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from plant.dynamics.spatial import build_dynamics
from plant.dynamics.variables import BRAKE, OPEN, SPATIAL, VELOCITY
from plant.errors import FmuError
from plant.fmu.plant import FmuPlant
from plant.mechanism import load_spatial
from plant.pose import Array
from tests.plant.dynamics.explicit_bodies import leg_vectors, random_base, second_axes
from tests.plant.dynamics.maximal_coordinates import MaximalModel
from tests.plant.dynamics.test_second_model import leaning
from tests.plant.dynamics.test_spatial import flat, named

MakePlant = Callable[..., FmuPlant]
Values = dict[str, Array]

HELD = {
    "drive_mode": np.full(6, VELOCITY),
    "velocity_command": 0.05 * np.random.default_rng(3).normal(size=6),
    "external_wrench.force": np.array([20.0, -30.0, 10.0]),
    "external_wrench.torque": np.array([2.0, -3.0, 1.0]),
    **random_base(np.random.default_rng(0), 0.0),
}
PUSHED = np.hstack([HELD["external_wrench.force"], HELD["external_wrench.torque"]])


def both_ends(p: Values, duration: float, damping: float = 0.0, tolerance: float = 1e-11) -> tuple[Values, Values]:
    """What the second model and the plant's equations, by an adaptive method, put out after a time with held inputs."""
    model = MaximalModel(p, bending_damping=damping)
    model.go_on(duration, HELD["velocity_command"], HELD["drive_mode"], PUSHED, tolerance)
    assert model.gap() < 1e-9
    dynamics, inputs, parameters = build_dynamics(), flat(HELD, SPATIAL.inputs), flat(p, SPATIAL.parameters)
    constants = dynamics.constants(parameters)
    # The second model has no brakes, and begins with straight legs and motors in the middle of their play.
    start = np.array(dynamics.start(parameters)).ravel()
    start[sum(each.size for each in SPATIAL.states[:5]) :] = 0.0
    end = solve_ivp(
        lambda _, x: np.array(dynamics.rates(x, inputs, constants)).ravel(),
        (0.0, duration), start, method="DOP853", rtol=tolerance, atol=0.01 * tolerance,
    )  # fmt: skip
    outputs = named(np.array(dynamics.outputs(end.y[:, -1], inputs, constants)).ravel(), SPATIAL.outputs)
    return model.outputs(HELD["velocity_command"], HELD["drive_mode"], PUSHED), outputs


@pytest.mark.slow
def test_play_and_axes_that_do_not_meet_agree_with_maximal_coordinates() -> None:
    """Rotors that run through their play and strike the other flank, and second axes up to 10 mm off."""
    p = leaning("hexapod") | {
        "base_joint_offset": np.array([2e-3, -3e-3, 10e-3, 0.0, 5e-3, 0.0]),
        "screw.backlash": np.array([2e-4, 0.0, 1e-4, 0.0, 0.0, 0.0]),
        "joint.clearance": np.array([0.0, 0.0, 1e-4, 0.0, 0.0, 5e-5]),
        "screw.stiffness": np.array(2e5),
    }
    expected, found = both_ends(p, 0.03)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=0.0, atol=1e-8, err_msg=name)


def bent_frequency(p: Values, length: float, compliance: float) -> tuple[float, float]:
    """The natural frequency [Hz] of a leg that bends between its joints, and its inertia for the bend [kg m^2]."""
    guide, low, up = (float(p[name]) for name in ("leg.guide", "leg.lower.center", "leg.upper.center"))
    lower = p["leg.lower.inertia"] + p["leg.lower.mass"] * low**2
    rod = p["leg.upper.inertia"] + p["leg.upper.mass"] * up**2
    inertia = float(lower * (1.0 - guide / length) ** 2 + rod * (guide / length) ** 2)
    return float(1.0 / np.sqrt(compliance * inertia) / (2.0 * np.pi)), inertia


@pytest.mark.slow
def test_bending_agrees_with_a_rod_that_turns_in_its_guide_against_a_spring() -> None:
    """A compliance of 1 mrad/(N m): the IMUs turn as in the second model, where bending acts on the platform, too."""
    p, compliance, damping = leaning("hexapod"), 1e-3, 0.7
    frequency, inertia = bent_frequency(p, 0.4, compliance)
    bends = p | {
        "leg.bending_compliance": np.full(6, compliance),
        "leg.bending_frequency": np.array(frequency),
        "leg.bending_damping": np.array(damping),
    }
    expected, found = both_ends(bends, 0.06, 2.0 * damping * 2.0 * np.pi * frequency * inertia, 1e-8)
    straight = both_ends(p, 0.06, tolerance=1e-8)[1]
    for name in ("imu_angular_velocity", "imu_specific_force", "imu_magnetic_field"):
        effect = np.abs(expected[name][:6] - straight[name][:6]).max()
        assert np.abs(found[name] - expected[name]).max() < 0.03 * effect, name
    turned = np.degrees(np.abs(expected["imu_magnetic_field"] - straight["imu_magnetic_field"]).max() / 49.0)
    assert turned > 0.01
    # The platform hardly notices.
    assert np.abs(found["position"] - expected["position"]).max() < 1e-6


def parameters(changes: Mapping[str, ArrayLike]) -> Values:
    return load_spatial("hexapod").plant_parameters() | {name: np.asarray(value) for name, value in changes.items()}


def lengths_under(plant: FmuPlant, force: float) -> tuple[Array, Array]:
    """The lengths of the legs on their brakes, and at their motors, when the platform rests under a vertical force [N]."""
    plant.set("drive_mode", np.full(6, BRAKE))
    plant.set("external_wrench.force", [0.0, 0.0, force])
    for _ in range(1500):
        plant.step(1e-3)
    return plant.get("leg_length"), plant.get("motor_length")


@pytest.mark.parametrize("name", ["screw.backlash", "joint.clearance"])
def test_a_load_that_turns_moves_the_legs_by_their_play(make_plant: MakePlant, name: str) -> None:
    """On closed brakes, from 300 N down to 300 N up; beyond the play the elastic change of legs without play is added."""
    weightless = {"gravity": [0.0, 0.0, 0.0], "screw.stiffness": 5e6, "substep": 2.5e-4}
    moved, of_motors = [], []
    for play in (0.0, 1e-4, 3e-4):
        plant = make_plant(weightless | {name: play})
        down = lengths_under(plant, -300.0)
        up = lengths_under(plant, 300.0)
        moved.append(up[0] - down[0])
        of_motors.append(up[1] - down[1])
    # The flanks are as stiff as the brakes.
    elastic = moved[0]
    np.testing.assert_allclose(moved[1] - 2.0 * elastic, 1e-4, rtol=0.02)
    np.testing.assert_allclose(moved[2] - moved[1], 2e-4, rtol=0.01)
    # The brakes hold the motors, which see nothing of the play.
    np.testing.assert_allclose(of_motors, np.broadcast_to(elastic, (3, 6)), rtol=0.02)


def test_a_leg_whose_axes_do_not_meet_is_as_long_as_from_its_second_axis(make_plant: MakePlant) -> None:
    changes = {"base_joint_offset": np.array([5e-3, -5e-3, 2e-3, 0.0, 1e-2, -1e-3])}
    p, plant = parameters(changes), make_plant(changes)
    legs = leg_vectors(p, p["initial_position"], np.eye(3))
    np.testing.assert_allclose(plant.get("leg_length"), np.linalg.norm(legs, axis=1), rtol=1e-12)
    axes = second_axes(p, p["initial_position"], np.eye(3)) - p["base_joints"]
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), np.abs(changes["base_joint_offset"]), atol=1e-15)
    np.testing.assert_allclose(np.sum(axes * p["base_joint_axes"], axis=1), 0.0, atol=1e-15)


def test_energy_changes_by_the_work_of_all_forces_with_play_and_offsets(make_plant: MakePlant) -> None:
    changes = {"screw.backlash": 3e-4, "screw.stiffness": 2e5, "base_joint_offset": 0.005, "substep": 2.5e-5}
    plant, work, sources = make_plant(changes), 0.0, ("drive", "friction", "brake", "stop", "external", "play")
    names = ("kinetic_energy", "potential_energy", *(f"power.{source}" for source in sources))
    plant.set("drive_mode", np.full(6, VELOCITY))

    def values() -> Array:
        return np.array([float(plant.get(name)) for name in names])

    before, dissipated = values()[:2].sum(), 0.0
    for cycle in range(150):
        t = 1e-3 * cycle
        plant.set("velocity_command", 0.15 * np.sin(40.0 * t + np.arange(6)))
        plant.set("external_wrench.force", np.array([100.0, -50.0, 400.0]) * np.sin(90.0 * t))
        powers = values()[2:]
        for sample in range(1, 21):
            plant.step(5e-5)
            powers += (2.0 if sample < 20 else 1.0) * values()[2:]
        work += 2.5e-5 * powers.sum()
        dissipated += 2.5e-5 * powers[-1]
    assert values()[:2].sum() - before == pytest.approx(work, abs=2e-3)
    assert abs(work) > 0.1 and dissipated < -1e-3


def test_states_of_imperfections_are_there_only_with_them(make_plant: MakePlant) -> None:
    ideal = make_plant().linearize(["velocity_command"], ["leg_length"])
    assert len(ideal.states) == 25 and not [name for name in ideal.states if "play" in name or "bending" in name]
    loose = make_plant({"screw.backlash": [0.0, 0.0, 1e-4, 0.0, 0.0, 0.0]}).linearize(["velocity_command"], ["leg_length"])
    assert set(loose.states) - set(ideal.states) == {"state.play[3]", "state.play_velocity[3]"}
    assert loose.a.shape == (27, 27) and loose.b.shape == (27, 6) and loose.c.shape == (6, 27)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"screw.backlash": 1e-4, "screw.stiffness": 1e9}, r"because of the play, the square root of screw\.stiffness"),
        ({"leg.bending_compliance": 1e-4, "leg.bending_frequency": 5000.0}, r"because of the bending, leg\.bending_frequency"),
        ({"leg.bending_compliance": 1e-4, "leg.guide": 0.9}, r"leg\.guide is at 0\.9 m, beyond the end of a leg of 0\.\d+ m"),
        ({"screw.backlash": -1e-4}, "screw.backlash is -0.0001"),
    ],
)
def test_imperfections_that_make_no_sense_are_refused(make_plant: MakePlant, changes: Values, said: str) -> None:
    with pytest.raises((FmuError, ValueError), match=said):
        make_plant(changes)


def test_stiff_flanks_and_a_fast_bend_do_not_matter_where_there_is_none(make_plant: MakePlant) -> None:
    plant = make_plant({"screw.stiffness": 1e9, "leg.bending_frequency": 5000.0, "leg.guide": 0.9})
    plant.set("drive_mode", np.full(6, OPEN))
    plant.step(1e-3)


def test_a_mechanism_without_them_has_no_imperfections() -> None:
    p = load_spatial("6-3-I").plant_parameters()
    for each in SPATIAL.parameters:
        if each.disturbance:
            assert not p[each.name].any(), each.name
