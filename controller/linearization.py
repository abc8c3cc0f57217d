"""A plant FMU as a linear system of python-control, for design; not for a process that runs a loop."""

from collections.abc import Sequence

import control

from plant.fmu import FmuPlant


def state_space(
    plant: FmuPlant, inputs: Sequence[str] = ("velocity_command",), outputs: Sequence[str] = ("leg_length",)
) -> control.StateSpace:
    """The plant about where it is, from the FMU's directional derivatives, its signals by their names in FMI 2.0.

    gough's own plants have a quaternion among their states, so one state more than they have coordinates: along it, in the
    direction of its own length, nothing moves.

    Args:
        plant: any that has directional derivatives and shows its states.
        inputs, outputs: names of its variables.

    Raises:
        UnknownNameError: the FMU has no such variable.
        FmuError: the FMU cannot be linearised.
    """
    linear = plant.linearize(inputs, outputs)
    return control.StateSpace(
        linear.a, linear.b, linear.c, linear.d, name=plant.path.stem, states=list(linear.states), inputs=list(linear.inputs),
        outputs=list(linear.outputs),
    )  # fmt: skip
