"""A plant's expressions as CasADi functions of flat vectors, in the order of its variable table."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import casadi as ca

from plant.dynamics.legs_and_actuators import SX, Condition, brake_deflections
from plant.dynamics.play import PLAYS, play_under
from plant.dynamics.variables import Variable, VariableTable

Values = dict[str, SX]
"""Expressions by name."""


@dataclass(frozen=True)
class Dynamics:
    """A plant as functions of flat vectors; `conditions` and `limits` return values and their greatest values.

    `ideal_limits`, `ideal_rates` and `ideal_outputs` are the same functions with all disturbances at zero, and much shorter.
    """

    constants: ca.Function  # of the parameters
    start: ca.Function  # the states, of the parameters
    conditions: ca.Function  # on the parameters
    condition_texts: tuple[str, ...]
    limits: ca.Function  # on states and constants
    limit_texts: tuple[str, ...]
    rates: ca.Function  # of states, inputs and constants
    outputs: ca.Function  # of the same
    ideal_limits: ca.Function
    ideal_rates: ca.Function
    ideal_outputs: ca.Function


def assemble(
    table: VariableTable,
    parameters: Values,
    constants: Values,
    start: Values,
    conditions: list[Condition],
    limits: Callable[[Values, Values], list[Condition]],
    plant: Callable[[Values, Values, Values], tuple[Values, Values]],
) -> Dynamics:
    """The functions of a plant from its expressions; `start` has the states that are not zero, without those of the brakes."""
    # In `rates` and `outputs`, symbols replace the computed constants.
    symbols = {name: SX.sym(name, *value.shape) for name, value in constants.items()}
    states, inputs = variable_symbols(table.states), variable_symbols(table.inputs)
    arguments = [_flat(states), _flat(inputs), _flat(symbols)]
    given = [_flat(parameters)]
    options = {"cse": True}
    watched = limits(states, symbols)

    def running(prefix: str, changed: Values) -> tuple[ca.Function, ca.Function, ca.Function]:
        """Limits, rates and outputs; CasADi leaves out what zeros among the changed values make vanish."""
        x, u, c = ({name: changed.get(name, value) for name, value in side.items()} for side in (states, inputs, symbols))
        rates, outputs = plant(x, u, c)
        return (
            ca.Function(f"plant_{prefix}limits", [arguments[0], arguments[2]], _sides(limits(x, c)), options),
            ca.Function(f"plant_{prefix}rates", arguments, [_in_order(rates, table.states)], options),
            ca.Function(f"plant_{prefix}outputs", arguments, [_in_order(outputs, table.outputs)], options),
        )

    within, rates, outputs = running("", {})
    ideal_within, ideal_rates, ideal_outputs = running("ideal_", zeros(each for each in table.variables if each.disturbance))
    return Dynamics(
        constants=ca.Function("plant_constants", given, [_flat(constants)], options),
        start=ca.Function("plant_start", given, [_in_order(_braked(table, start, constants, plant), table.states)], options),
        conditions=ca.Function("plant_conditions", given, _sides(conditions), options),
        condition_texts=tuple(condition.text for condition in conditions),
        limits=within,
        limit_texts=tuple(condition.text for condition in watched),
        rates=rates,
        outputs=outputs,
        ideal_limits=ideal_within,
        ideal_rates=ideal_rates,
        ideal_outputs=ideal_outputs,
    )


def _braked(
    table: VariableTable, start: Values, constants: Values, plant: Callable[[Values, Values, Values], tuple[Values, Values]]
) -> Values:
    """The states of a plant that stands on brakes that carry the load, by its own equations, which are linear in that.

    Its play is taken up by the load, and its legs are bent by their weight.
    """
    resting = zeros(table.states) | start
    deflection = SX.sym("deflection", *resting["state.brake_deflection"].shape)
    tight = constants | {name: SX.zeros(*constants[name].shape) for name in PLAYS}
    rates, _ = plant(resting | {"state.brake_deflection": deflection}, zeros(table.inputs), tight)
    acceleration = ca.vertcat(rates["state.velocity"], rates["state.angular_velocity"])
    effect = -ca.jacobian(acceleration, deflection)
    falling = ca.substitute(acceleration, deflection, SX.zeros(deflection.shape[0]))
    braked = resting | {"state.brake_deflection": brake_deflections(effect, falling, constants["brake_slip"])}
    rates, _ = plant(braked, zeros(table.inputs), tight)
    return braked | {
        "state.play": play_under(-constants["brake.stiffness"] * braked["state.brake_deflection"], constants),
        # An oscillator at rest, whose centre is away by its acceleration over the square of its frequency.
        "state.bending": rates["state.bending_rate"] / (2 * ca.pi * constants["leg.bending_frequency"]) ** 2,
    }


def zeros(variables: Iterable[Variable]) -> Values:
    """Zeros for each variable, in its shape."""
    return {variable.name: SX.zeros(*(*variable.shape, 1, 1)[:2]) for variable in variables}


def variable_symbols(variables: tuple[Variable, ...]) -> Values:
    """A symbol for each variable, in its shape."""
    made = {}
    for variable in variables:
        rows, columns = (*variable.shape, 1, 1)[:2]
        # CasADi stores matrices by columns, and the table by rows.
        made[variable.name] = SX.sym(variable.name, columns, rows).T
    return made


def _sides(conditions: list[Condition]) -> list[SX]:
    values = [ca.densify(ca.vertcat(*side)) for side in zip(*((c.value, c.limit) for c in conditions), strict=True)]
    return values or [SX.zeros(0), SX.zeros(0)]


def _in_order(values: Values, variables: tuple[Variable, ...]) -> SX:
    return _flat({variable.name: values[variable.name] for variable in variables})


def _flat(values: Values) -> SX:
    return ca.vertcat(*[ca.vec(ca.densify(value).T) for value in values.values()])
