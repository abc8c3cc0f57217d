"""The command fmu."""

import argparse
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.command_line.options import add_actions, add_options
from hil.command_line.outputs import add_json, check_outputs, write_json
from hil.command_line.terminal import progress_bar
from hil.runs.config import SimulationConfig
from hil.table import Table
from plant.errors import GoughError

if TYPE_CHECKING:
    from plant.dynamics.variables import Variable


_PERIOD_S = 1e-3
"""The step of a plant that is only linearised."""


def add_fmu(command: argparse.ArgumentParser) -> None:
    """Build, show, validate or linearise the plant's FMU."""
    add_actions(command, build=_add_build, table=_add_table, info=_add_info, validate=_add_validate, linearize=_add_linearize)


def _add_build(command: argparse.ArgumentParser) -> None:
    """Write a plant as an FMU, with its sources.

    FMI 3.0 for Co-Simulation and Model Exchange, or FMI 2.0 for Co-Simulation. The parameters of any mechanism of the same kind
    can be set in it.
    """
    command.add_argument("--output", type=Path, metavar="FILE.fmu", help="the FMU (default: in fmus/ in a checkout, else here)")
    command.add_argument("--fmi", type=int, choices=(2, 3), default=3, help="version of FMI (default: %(default)s)")
    add_options(command, SimulationConfig, "mechanism")
    command.add_argument(
        "--platforms",
        type=_names,
        default=[],
        metavar="LIST",
        help="linux,windows,darwin: compiled by zig, 'pip install gough[cross]' (default: this machine's, by its C compiler)",
    )
    command.set_defaults(run=_build_fmu)


def _add_table(command: argparse.ArgumentParser) -> None:
    """Print the variables of gough's own plants, as docs/fmu.md has them: tables in Markdown."""
    command.set_defaults(run=_print_tables)


def _add_info(command: argparse.ArgumentParser) -> None:
    """Show what any FMU for Co-Simulation is, its variables, and whether the loop can use it as it is."""
    command.add_argument("file", type=Path, metavar="FILE.fmu")
    add_json(command)
    command.set_defaults(run=_show)


def _add_validate(command: argparse.ArgumentParser) -> None:
    """Check that any FMU for Co-Simulation keeps what it promises.

    Its description is validated, and its steps, saved states and derivatives are tried. The exit status is 1 if something is
    wrong.
    """
    command.add_argument("file", type=Path, metavar="FILE.fmu")
    add_json(command)
    command.set_defaults(run=_validate)


def _add_linearize(command: argparse.ArgumentParser) -> None:
    """Print an FMU as a linear system.

    The plant is linearised about its start, with the drives following their commands, by its directional derivatives: matrices
    of x' = A x + B u, y = C x + D u, and the poles.
    """
    command.add_argument("file", type=Path, metavar="FILE.fmu", nargs="?", help="the FMU (default: the mechanism's plant)")
    add_json(command)
    add_options(command, SimulationConfig, "mechanism", "binding")
    for side, default in (("inputs", "velocity_command"), ("outputs", "leg_length")):
        command.add_argument(
            f"--{side}", type=_names, default=[default], metavar="NAMES", help=f"names of the {side} (default: {default})"
        )
    command.set_defaults(run=_linearize)


def _names(text: str) -> list[str]:
    return text.split(",")


def _build_fmu(options: argparse.Namespace) -> int:
    from plant.fmu.build import build_in_subprocess, check_build, model_of
    from plant.mechanism import load_in_space

    model = model_of(load_in_space(options.mechanism))
    check_build(options.fmi, options.platforms)
    folder = Path("fmus") if Path("fmus/fmi3.c").is_file() else Path()
    path = options.output or folder / f"{model.identifier}{'_fmi2' if options.fmi == 2 else ''}.fmu"
    check_outputs(path)
    with progress_bar(f"compiling for {', '.join(options.platforms) or 'this machine'}"):
        build_in_subprocess(path, options.fmi, options.mechanism, options.platforms)
    print(path)
    return 0


def _print_tables(options: argparse.Namespace) -> int:
    from plant.fmu.build import PLANAR_MODEL, SPATIAL_MODEL

    del options
    headings = ("variable", "shape", "unit", "role", "range", "nominal", "description")
    sections = []
    for model in (SPATIAL_MODEL, PLANAR_MODEL):
        table = model.table
        shown = Table(*headings)
        for variable in (*table.inputs, *table.parameters, *table.outputs, *table.states):
            shown.add(*_cells(variable))
        sections += [f"### {model.identifier}", f"{model.description}.", shown.markdown()]
    print("\n\n".join(sections))
    return 0


def _cells(variable: "Variable") -> tuple[str, ...]:
    """A variable's row in the table."""
    role: str = variable.causality
    if variable.causality == "parameter":
        role = f"{'tunable' if variable.tunable else 'fixed'} parameter"
    elif variable.discrete:
        role = f"discrete {role}"
    least_and_greatest = f"{variable.minimum:g} to {variable.maximum:g}"
    unit, nominal = ("-", "-") if variable.discrete else (variable.unit, f"{variable.nominal:g}")
    return f"`{variable.name}`", _shape(variable.shape), unit, role, least_and_greatest, nominal, variable.description


def _shape(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape)) or "1"


def _show(options: argparse.Namespace) -> int:
    from plant.fmu.binding import bind
    from plant.fmu.binding_file import OWN_BINDING
    from plant.fmu.check import platforms_of
    from plant.fmu.importer import FmuDescription

    description = FmuDescription(options.file)
    try:
        bind(OWN_BINDING, description)
        fits = "runs in the loop as it is (gough simulate --plant)"
    except GoughError:
        fits = "runs in the loop with a binding (docs/fmu.md)"
    facts = {
        "file": str(options.file),
        "FMI": f"{description.version}.0",
        "made by": description.tool or "-",
        "binaries for": ", ".join(platforms_of(options.file)) or "none",
        "abilities": ", ".join(sorted(description.abilities)) or "none",
        "states": sum(state.size for state, _ in description.states),
        "use": fits,
    }
    _print_pairs(facts)
    table = Table("variable", "shape", "type", "unit", "what", "least", "greatest")
    for each in description:
        kind = f"{each.variability} {each.causality}"
        table.add(each.name, _shape(each.shape), each.type, each.unit or "-", kind, f"{each.minimum:g}", f"{each.maximum:g}")
    table.print()
    variables = [
        {
            **{name: getattr(each, name) for name in ("name", "shape", "type", "unit", "causality", "variability")},
            "minimum": _finite(each.minimum),
            "maximum": _finite(each.maximum),
        }
        for each in description
    ]
    write_json(options.json, facts | {"variables": variables})
    return 0


def _validate(options: argparse.Namespace) -> int:
    from plant.fmu.check import check_fmu

    with progress_bar(f"trying {options.file}"):
        checks = check_fmu(options.file)
    _print_pairs(
        {check.name: "not promised" if check.problems is None else "; ".join(check.problems) or "ok" for check in checks}
    )
    write_json(options.json, {"file": str(options.file), "checks": {check.name: check.problems for check in checks}})
    return int(any(check.problems for check in checks))


def _finite(limit: float) -> float | None:
    return limit if isfinite(limit) else None


def _print_pairs(pairs: dict[str, Any]) -> None:
    width = max(map(len, pairs))
    for name, value in pairs.items():
        print(f"{name:{width}}  {value}")


def _linearize(options: argparse.Namespace) -> int:
    import numpy as np

    from controller.design.linearization import state_space
    from plant.dynamics.variables import VELOCITY
    from plant.fmu.build import default_fmu, model_of
    from plant.fmu.calls import write_drive_mode
    from plant.fmu.plant import FmuPlant
    from plant.mechanism import load_in_space

    mechanism = load_in_space(options.mechanism)
    path = options.file or default_fmu(model_of(mechanism))
    parameters = mechanism.plant_parameters() if options.binding is None else {}
    with FmuPlant(path, parameters, _PERIOD_S, options.binding) as plant:
        write_drive_mode(plant.handle, VELOCITY)
        system = state_space(plant, options.inputs, options.outputs)
    table = Table("pole [1/s]", "frequency [Hz]", "damping")
    poles = sorted(system.poles(), key=abs)
    for pole in poles:
        if pole.imag >= 0.0:
            size = abs(pole)
            table.add(f"{pole:.4g}", f"{size / (2.0 * np.pi):.4g}", f"{-pole.real / size:.3f}" if size > 0.0 else "-")
    table.print()
    print(f"{system.nstates} states, {system.ninputs} inputs, {system.noutputs} outputs")
    matrices = {name: getattr(system, name).tolist() for name in "ABCD"}
    names = {"states": system.state_labels, "inputs": system.input_labels, "outputs": system.output_labels}
    write_json(options.json, matrices | names | {"poles": [[pole.real, pole.imag] for pole in poles]})
    return 0
