"""A plant FMU as a linear system of python-control, for design; never imported by a process that runs a loop."""

from collections.abc import Sequence

import control

from plant.fmu.plant import FmuPlant


def state_space(
    plant: FmuPlant, inputs: Sequence[str] = ("velocity_command",), outputs: Sequence[str] = ("leg_length",)
) -> control.StateSpace:
    """The plant linearised at its present state, from the FMU's directional derivatives.

    Signals have their names of FMI 2.0, with underscores for points, which python-control does not allow. gough's spatial
    plant has a quaternion among its states, so one state too many: its length, which nothing observes.

    Args:
        plant: any plant that has directional derivatives and shows its states.
        inputs, outputs: names of its variables.

    Raises:
        UnknownNameError: the FMU has no such variable.
        FmuError: the FMU cannot be linearised.
    """
    linear = plant.linearize(inputs, outputs)
    return control.StateSpace(
        linear.a, linear.b, linear.c, linear.d, name=_label(plant.path.stem),
        **{side: [_label(name) for name in getattr(linear, side)] for side in ("states", "inputs", "outputs")},
    )  # fmt: skip


def _label(name: str) -> str:
    return name.replace(".", "_")
