"""The C code of an exported plant."""

import re
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path

import casadi as ca

from plant.dynamics.assembly import Dynamics
from plant.dynamics.variables import Variable
from plant.fmu.description_writer import Dependencies, Layout, start_of
from plant.pose import Array


def write_functions(dynamics: Dynamics, folder: Path) -> None:
    """Write plant.c, disturbed.c and derivatives.c with their headers."""
    plant = (
        dynamics.constants, dynamics.conditions, dynamics.ideal_limits, dynamics.ideal_rates, dynamics.ideal_outputs,
    )  # fmt: skip
    disturbed = dynamics.start, dynamics.limits, dynamics.rates, dynamics.outputs
    for file, functions in (("plant", plant), ("disturbed", disturbed), ("derivatives", _derivatives(dynamics))):
        generator = ca.CodeGenerator(f"{file}.c", {"with_header": True})
        for function in functions:
            generator.add(function)
        generator.generate(f"{folder}/")


def _derivatives(dynamics: Dynamics) -> list[ca.Function]:
    """Products with the Jacobians of rates, outputs and constants, and their transposes."""

    def product(name: str, function: ca.Function, reverse: bool) -> ca.Function:
        arguments = [ca.SX.sym(f"i{i}", function.size1_in(i)) for i in range(function.n_in())]
        results = function.call(arguments)
        here, there = (results, arguments) if reverse else (arguments, results)
        seeds = [ca.SX.sym(f"s{i}", value.shape[0]) for i, value in enumerate(here)]
        derived = ca.jtimes(ca.vertcat(*results), ca.vertcat(*arguments), ca.vertcat(*seeds), reverse)
        sides = ca.vertsplit(ca.densify(derived), [0, *accumulate(value.shape[0] for value in there)])
        return ca.Function(name, [*arguments, *seeds], sides, {"cse": True})

    states, inputs, constants = _symbols(dynamics)
    both = ca.Function(
        "both",
        [states, inputs, constants],
        [dynamics.rates(states, inputs, constants), dynamics.outputs(states, inputs, constants)],
    )
    return [
        product(f"plant_{prefix}{name}", function, reverse)
        for prefix, function in (("", both), ("constants_", dynamics.constants), ("start_", dynamics.start))
        for name, reverse in (("forward", False), ("reverse", True))
    ]


def _symbols(dynamics: Dynamics) -> list[ca.SX]:
    """States, inputs and constants."""
    return [ca.SX.sym(name, dynamics.rates.size1_in(i)) for i, name in enumerate("xuc")]


def find_dependencies(dynamics: Dynamics, layout: Layout) -> Dependencies:
    """What depends on what, from the sparsity of the Jacobians."""
    table = layout.table
    p = ca.SX.sym("p", dynamics.constants.size1_in(0))
    x, u, c = _symbols(dynamics)
    running = ca.Function("running", [ca.vertcat(x, u), c], [ca.vertcat(dynamics.rates(x, u, c), dynamics.outputs(x, u, c))])
    started, constants = dynamics.start(p), dynamics.constants(p)
    initial = ca.Function(
        "initial",
        [ca.vertcat(u, p)],
        [ca.vertcat(dynamics.rates(started, u, constants), dynamics.outputs(started, u, constants), started)],
    )

    def places(*variables: Variable) -> list[int]:
        return [place for variable in variables for place in layout.places(variable)]

    def found(function: ca.Function, unknowns: list[int], knowns: list[int]) -> dict[int, frozenset[int]]:
        touched: dict[int, set[int]] = {place: set() for place in unknowns}
        for row, column in zip(*function.jac_sparsity(0, 0).get_triplet(), strict=True):
            touched[unknowns[row]].add(knowns[column])
        return {place: frozenset(known) for place, known in touched.items()}

    unknowns = places(*layout.rates, *table.outputs)
    return Dependencies(
        running=found(running, unknowns, places(*table.states, *table.inputs)),
        initial=found(initial, [*unknowns, *places(*table.states)], places(*table.inputs, *table.parameters)),
    )


def layout_header(layout: Layout, starts: Mapping[str, Array], token: str, dynamics: Dynamics) -> str:
    """The text of layout.h: sizes, offsets, and a table for each property of the variables."""
    table, exposed = layout.table, layout.exposed
    blocks = {"INPUTS": table.inputs, "PARAMETERS": table.parameters, "OUTPUTS": table.outputs, "RATES": layout.rates}
    disturbances = [place for variable in exposed if variable.disturbance for place in layout.places(variable)]
    places = sorted((place, v) for v, variable in enumerate(exposed) for place in layout.places(variable))

    def array(kind: str, name: str, values: Sequence[object]) -> str:
        return f"static const {kind} {name}[] = {{{', '.join(map(str, values))}}};"

    def texts(name: str, values: Sequence[str]) -> str:
        return array("char *const", name, [f'"{value}"' for value in values])

    def size(variables: Sequence[Variable]) -> int:
        return sum(variable.size for variable in variables)

    macros = {
        "VALUES": layout.size,
        "CONSTANTS": dynamics.constants.size1_out(0),
        "CONDITIONS": len(dynamics.condition_texts),
        "LIMITS": len(dynamics.limit_texts),
        "VARIABLES": len(exposed),
        "STATES": size(table.states),
        "INPUTS": size(table.inputs),
        "PARAMETERS": size(table.parameters),
        "LONGEST": max(variable.size for variable in exposed),
        "TOKEN": f'"{token}"',
        "LAYOUT": f"0x{token[1:17]}ULL",
        **{f"{block}_AT": layout.offsets[variables[0].name] for block, variables in blocks.items()},
        "SUBSTEP_AT": layout.offsets["substep"],
        "DISTURBANCES": len(disturbances),
        "IDEAL_STATES": sum(variable.size for variable in table.states if not variable.disturbance),
    }
    if "state.quaternion" in layout.offsets:
        macros["QUATERNION_AT"] = layout.offsets["state.quaternion"]
    lines = [
        "#pragma once",
        # Every file includes all tables, and uses some.
        "#if defined __GNUC__",
        '#pragma GCC diagnostic ignored "-Wunused-variable"',
        "#endif",
        "enum { FIXED, TUNABLE, INPUT, DISCRETE_INPUT, OUTPUT, STATE, RATE };",
        *(f"#define {name} {value}" for name, value in macros.items()),
        texts("names", [v.name for v in exposed]),
        texts("condition_texts", dynamics.condition_texts),
        texts("limit_texts", (*dynamics.limit_texts, "")),
        array("int", "kind", [_kind(layout, v) for v in exposed]),
        array("int", "offset", [layout.offsets[v.name] for v in exposed]),
        array("int", "length", [v.size for v in exposed]),
        array("unsigned", "variable_of", [v for _, v in places]),
        array("double", "minimum", [float(v.minimum) for v in exposed]),
        array("double", "maximum", [float(v.maximum) for v in exposed]),
        array("double", "nominal", [float(v.nominal) for v in exposed]),
        array("int", "disturbance_at", disturbances),
        array("double", "start", [value.hex() for v in layout.stored for value in start_of(v, starts)]),
        "",
    ]
    return "\n".join(lines)


def _kind(layout: Layout, variable: Variable) -> str:
    if variable in layout.rates:
        return "RATE"
    if variable.causality == "parameter":
        return "TUNABLE" if variable.tunable else "FIXED"
    return ("DISCRETE_" if variable.discrete else "") + variable.causality.upper()


_UNSUPPORTED_HEAD = """\
#if defined _WIN32 || defined __CYGWIN__
#define EXPORT __declspec(dllexport)
#elif defined __GNUC__
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif
#include "model.h"
"""


def unsupported_functions(fmi: int, declarations: str, wrapper: str) -> str:
    """Functions of the standard's header that the wrapper lacks: importers need every symbol."""
    declared = re.findall(rf"FMI{fmi}_Export\s+fmi{fmi}\w+TYPE\s+(fmi{fmi}\w+);", declarations)
    lines = []
    for name in (name for name in declared if not re.search(rf"\b{name}\(", wrapper)):
        if "Instantiate" in name:
            lines.append(f"EXPORT void *{name}(void) {{ return 0; }}\n")
        elif re.search(r"[GS]et(U?Int|Float|Real|Integer|Boolean|String|Binary|Clock)\w*$", name):
            lines.append(
                f"EXPORT int {name}(void *instance, const unsigned *references, size_t n) "
                f'{{ (void)references; return model_absent(instance, "{name}", n); }}\n'
            )
        else:
            lines.append(f'EXPORT int {name}(void *instance) {{ return model_absent(instance, "{name}", 1); }}\n')
    return _UNSUPPORTED_HEAD + "".join(lines)
