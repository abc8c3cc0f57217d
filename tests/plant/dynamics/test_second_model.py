"""The plant's motion against a second model, derived in maximal coordinates, for three classes of mechanism."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from plant.dynamics.variables import OPEN, VELOCITY
from plant.fmu.plant import FmuPlant
from plant.mechanism import load_spatial
from plant.pose import Array, quaternion_from_rotation
from tests.plant.dynamics.maximal_coordinates import MaximalModel

MakePlant = Callable[..., FmuPlant]
Values = dict[str, Array]

NO_BRAKES = {"brake.stiffness": np.array(1e-9), "brake.force": np.array(1e-9)}
"""A plant whose brakes carry nothing at the start."""

SEGMENT_S = 0.07
"""How long inputs are held: they jump between segments, which neither integrator steps across."""

TOLERANCES = {
    "position": 1e-11, "quaternion": 1e-11, "angular_velocity": 1e-10, "current": 1e-10,
    "imu_angular_velocity": 1e-10, "imu_specific_force": 1e-9, "imu_magnetic_field": 1e-9,
}  # fmt: skip
"""Of the second model's own integration at a relative 1e-11; the plant's substep of 1/32 ms is finer than that."""


def leaning(name: str) -> Values:
    """A preset at an odd start, with bodies, gravity and IMUs off its symmetries, light rotors, and neither
    end stops in reach nor brakes."""
    random = np.random.default_rng(1)
    p = load_spatial(name).plant_parameters()
    changes = {
        "initial_position": p["initial_position"] + [0.01, -0.02, 0.01],
        "initial_quaternion": quaternion_from_rotation(Rotation.from_rotvec([0.1, -0.05, 0.1]).as_matrix()),
        "payload.center_of_mass": [0.02, 0.03, 0.10],
        "payload.inertia": [[0.10, 0.01, -0.02], [0.01, 0.07, 0.015], [-0.02, 0.015, 0.12]],
        "leg.lower.axial_inertia": 0.01,
        "motor.rotor_inertia": 2e-6,
        "friction.velocity": 0.01,
        "drive.current_limit": 1000.0,
        "stop.stiffness": 0.0,
        **NO_BRAKES,
        "gravity": [1.0, -2.0, -9.0],
        "leg_imu_position": random.normal(0.0, 0.1, (6, 3)),
        "platform_imu_position": random.normal(0.0, 0.1, 3),
    }
    return p | {key: np.asarray(value) for key, value in changes.items()}


@pytest.mark.parametrize("mode", [OPEN, pytest.param(VELOCITY, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name", ["hexapod", pytest.param("6-3-I", marks=pytest.mark.slow), pytest.param("6-4-II", marks=pytest.mark.slow)]
)
def test_free_and_driven_motion_agree_with_maximal_coordinates(make_plant: MakePlant, name: str, mode: int) -> None:
    """A push, and then on without it: falling with open drives and no friction, or driven against friction."""
    p = leaning(name)
    if mode == OPEN:
        p |= {"friction.coulomb": np.zeros(6), "friction.viscous": np.zeros(6)}
    random = np.random.default_rng(2)
    modes = np.full(6, mode)
    wrench = np.array([20.0, -30.0, 10.0, 2.0, -3.0, 1.0])
    segments = [(0.05 * random.normal(size=6), wrench), (0.05 * random.normal(size=6), np.zeros(6))]

    model = MaximalModel(p)
    for command, push in segments:
        model.go_on(SEGMENT_S, command, modes, push)
    expected = model.outputs(segments[-1][0], modes, segments[-1][1])
    assert model.gap() < 1e-9

    def differences(substep: float) -> Values:
        plant = make_plant(p | {"substep": np.array(substep)})
        for command, push in segments:
            plant.set("drive_mode", modes)
            plant.set("velocity_command", command)
            plant.set("external_wrench.force", push[:3])
            plant.set("external_wrench.torque", push[3:])
            plant.step(SEGMENT_S)
        moved = np.abs(plant.get("position") - p["initial_position"]).max()
        assert moved > 2e-3 and np.abs(plant.get("angular_velocity")).max() > 0.1
        return {output: np.abs(plant.get(output) - value).max() for output, value in expected.items()}

    fine = differences(1e-3 / 32.0)
    assert all(fine[output] < tolerance for output, tolerance in TOLERANCES.items()), fine
    # At the presets' substep too, the plant is no further from the second model than its own steps explain.
    assert differences(0.5e-3)["position"] < 2e-7
