"""Plants as linear systems of python-control, against CasADi's own Jacobians of the same equations."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from controller.design.linearization import state_space
from plant.dynamics.variables import VELOCITY
from plant.errors import FmuError, InputError, UnknownNameError
from plant.fmu.build import PLANAR_MODEL, SPATIAL_MODEL, Model, default_fmu
from plant.fmu.calls import write_drive_mode
from plant.fmu.plant import FmuPlant
from plant.mechanism import Mechanism


@pytest.mark.parametrize(
    "model", [pytest.param(SPATIAL_MODEL, marks=pytest.mark.endurance), PLANAR_MODEL], ids=lambda model: model.identifier
)
@pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_the_linear_plant_is_casadis(model: Model, fmi: int) -> None:
    """About a lively state, as python-control gets it; poles and matrices by their names."""
    dynamics, table = model.dynamics(), model.table
    with FmuPlant(default_fmu(model, fmi), {}, 1e-3) as plant:
        write_drive_mode(plant.handle, VELOCITY)
        legs = plant.bound.legs
        for cycle in range(100):
            plant.set("velocity_command", 0.02 * np.sin(0.01 * cycle + np.arange(legs)))
            plant.step(1e-3)
        system = state_space(plant, outputs=("leg_length", "imu_specific_force"))
        x, u, p = (
            np.concatenate([np.ravel(plant.get(v.name)).astype(float) for v in variables])
            for variables in (table.states, table.inputs, table.parameters)
        )
    xs, us = ca.SX.sym("x", len(x)), ca.SX.sym("u", len(u))
    constants = dynamics.constants(p)
    rates, outputs = dynamics.rates(xs, us, constants), dynamics.outputs(xs, us, constants)
    at = {
        variable.name: i for variable, i in zip(table.outputs, np.cumsum([0, *(v.size for v in table.outputs)]), strict=False)
    }
    seen = [at["leg_length"] + i for i in range(legs)]
    seen += [at["imu_specific_force"] + i for i in range(3 * (legs + 1))]
    # Legs are perfect, and the states of their imperfections are left out.
    kept = [i for i, v in enumerate(v for v in table.states for _ in range(v.size)) if not v.disturbance]
    expected = {
        "A": ca.jacobian(rates, xs)[kept, kept], "B": ca.jacobian(rates, us)[kept, :legs],
        "C": ca.jacobian(outputs, xs)[seen, kept], "D": ca.jacobian(outputs, us)[seen, :legs],
    }  # fmt: skip
    for name, matrix in expected.items():
        wanted = np.array(ca.Function(name, [xs, us], [matrix])(x, u))
        np.testing.assert_allclose(getattr(system, name), wanted, rtol=1e-12, atol=1e-12 * max(np.abs(wanted).max(), 1.0))
    assert system.state_labels[:2] == ["state_position[1]", "state_position[2]"]
    assert system.input_labels == [f"velocity_command[{k + 1}]" for k in range(legs)]
    assert system.output_labels[legs] == "imu_specific_force[1,1]"


def test_names_with_points_are_told_with_underscores(fmu_path: Path, hexapod: Mechanism) -> None:
    with FmuPlant(fmu_path, hexapod.plant_parameters(), 1e-3) as plant:
        system = state_space(plant, ("external_wrench.force", "payload.mass"), ("power.drive",))
    assert system.input_labels == [*(f"external_wrench_force[{k}]" for k in (1, 2, 3)), "payload_mass"]
    assert system.output_labels == ["power_drive"]
    # A force pushes the platform, and more weight pulls it down.
    assert np.linalg.matrix_rank(system.B[:, :3]) == 3
    falling = system.state_labels.index("state_velocity[3]")
    assert system.B[falling, 3] < 0.0 < system.B[falling, 2]


def test_what_cannot_be_linearised_is_refused(fmu_path: Path, hexapod: Mechanism) -> None:
    with FmuPlant(fmu_path, hexapod.plant_parameters(), 1e-3) as plant:
        with pytest.raises(UnknownNameError, match="has no variable 'leg_lenght'; did you mean leg_length"):
            state_space(plant, outputs=("leg_lenght",))
        with pytest.raises(FmuError, match="a directional derivative failed: position cannot be a known of a derivative"):
            state_space(plant, inputs=("position",))
        with pytest.raises(InputError, match=r"drive_mode of gough_plant\.fmu is of type Enumeration and has no derivatives"):
            state_space(plant, inputs=("drive_mode",))
