"""The command fmu."""

from argparse import Namespace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.command_line import cli
from hil.command_line.apart import go_on_apart
from hil.command_line.terminal import progress_bar
from hil.runs.config import SimulationConfig
from hil.table import Table
from plant.errors import GoughError
from plant.files import check_writable

if TYPE_CHECKING:
    from plant.dynamics.variables import Variable

_FILE = cli.argument("file", type=Path, metavar="FILE.fmu")


def _names(text: str) -> list[str]:
    return text.split(",")


@cli.command(
    cli.output("--output", "FILE.fmu", "the FMU (default: in fmus/ in a checkout, else here)"),
    cli.setting("--fmi", 3, "version of FMI", choices=(2, 3)),
    cli.options_of(SimulationConfig, "mechanism"),
    cli.argument(
        "--platforms",
        type=_names,
        default=[],
        metavar="LIST",
        help="linux,windows,darwin: compiled by zig, 'pip install gough[cross]' (default: this machine's, by its C compiler)",
    ),
)
def gough_fmu_build(options: Namespace) -> None:
    """Write a plant as an FMU, with its sources.

    FMI 3.0 for Co-Simulation and Model Exchange, or FMI 2.0 for Co-Simulation. The parameters of any mechanism of the same kind
    can be set in it.
    """
    from plant.fmu.build import build_in_subprocess, check_build, model_of
    from plant.mechanism import load_in_space

    model = model_of(load_in_space(options.mechanism))
    check_build(options.fmi, options.platforms)
    folder = Path("fmus") if Path("fmus/fmi3.c").is_file() else Path()
    path = options.output or folder / f"{model.identifier}{'_fmi2' if options.fmi == 2 else ''}.fmu"
    check_writable(path)
    with progress_bar(f"compiling for {', '.join(options.platforms) or 'this machine'}"):
        build_in_subprocess(path, options.fmi, options.mechanism, options.platforms)
    print(path)


@cli.command()
def gough_fmu_table(_: Namespace) -> None:
    """Print the variables of gough's own plants, as docs/fmu.md has them: tables in Markdown."""
    from plant.fmu.build import PLANAR_MODEL, SPATIAL_MODEL

    sections = []
    for model in (SPATIAL_MODEL, PLANAR_MODEL):
        variables = model.table
        table = Table("variable", "shape", "unit", "role", "range", "nominal", "description")
        for variable in (*variables.inputs, *variables.parameters, *variables.outputs, *variables.states):
            table.add(*_cells(variable))
        sections += [f"### {model.identifier}", f"{model.description}.", table.markdown()]
    print("\n\n".join(sections))


@cli.command(_FILE, cli.JSON)
def gough_fmu_info(options: Namespace) -> None:
    """Show what any FMU for Co-Simulation is, its variables, and whether the loop can use it as it is."""
    from plant.dynamics.variables import PLANAR, SPATIAL
    from plant.fmu.binding import OWN_BINDING, bind
    from plant.fmu.check import platforms_of
    from plant.fmu.description_reader import FmuDescription
    from plant.fmu.plant import takes_parameters
    from plant.mechanism import LEGS

    description = FmuDescription(options.file)
    try:
        legs = bind(OWN_BINDING, description).legs
        own = not takes_parameters(description, [each.name for each in (SPATIAL if legs == LEGS else PLANAR).parameters])
        parameters = ", with its own parameters, from the home of --mechanism" if own else ""
        use = f"runs in the loop as it is (gough simulate --plant){parameters}"
    except GoughError:
        use = "runs in the loop with a binding (docs/fmu.md)"
    facts = {
        "file": str(options.file),
        "FMI": f"{description.version}.0",
        "made by": description.tool or "-",
        "binaries for": ", ".join(platforms_of(options.file)) or "none",
        "abilities": ", ".join(sorted(description.abilities)) or "none",
        "states": sum(state.size for state, _ in description.states),
        "use": use,
    }
    _print_pairs(facts)
    table = Table("variable", "shape", "type", "unit", "what", "least", "greatest")
    for each in description:
        kind, limits = f"{each.variability} {each.causality}", (f"{each.minimum:g}", f"{each.maximum:g}")
        table.add(each.name, _shape(each.shape), each.type, each.unit or "-", kind, *limits)
    table.print()
    names = ("name", "shape", "type", "unit", "causality", "variability", "minimum", "maximum")
    variables = [{name: _finite(getattr(each, name)) for name in names} for each in description]
    cli.write_json(options.json, facts | {"variables": variables})


@cli.command(_FILE, cli.JSON, cli.setting("--limit", 60.0, "how long a trial may take before its process is ended [s]"))
def gough_fmu_validate(options: Namespace) -> int:
    """Check that any FMU for Co-Simulation keeps what it promises.

    Its description is validated, and its steps, saved states and derivatives are tried. The exit status is 1 if something is
    wrong.
    """
    from plant.fmu.check import check_fmu

    with progress_bar(f"trying {options.file}"):
        checks = check_fmu(options.file, options.limit)
    problems = {check.name: check.problems for check in checks}
    _print_pairs({name: "not promised" if found is None else "; ".join(found) or "ok" for name, found in problems.items()})
    cli.write_json(options.json, {"file": str(options.file), "checks": problems})
    return int(any(problems.values()))


@cli.command(
    cli.source("file", "FILE.fmu", "the FMU (default: the mechanism's plant)", nargs="?"),
    cli.JSON,
    cli.options_of(SimulationConfig, "mechanism", "binding"),
    cli.setting("--inputs", "velocity_command", "names of the inputs", type=_names, metavar="NAMES"),
    cli.setting("--outputs", "leg_length", "names of the outputs", type=_names, metavar="NAMES"),
)
def gough_fmu_linearize(options: Namespace) -> None:
    """Print an FMU as a linear system.

    The plant is linearised about its start, with the drives following their commands, by its directional derivatives: matrices
    of x' = A x + B u, y = C x + D u, and the poles.
    """
    if options.own_process and options.file:
        go_on_apart(f"the FMU {options.file}")
    import numpy as np

    from controller.design.linearization import state_space
    from plant.dynamics.variables import VELOCITY
    from plant.fmu.binding import OWN_BINDING, load_binding
    from plant.fmu.build import default_fmu, model_of
    from plant.fmu.calls import write_drive_mode
    from plant.fmu.description_reader import FmuDescription
    from plant.fmu.plant import FmuPlant, takes_parameters
    from plant.mechanism import load_in_space

    mechanism = load_in_space(options.mechanism)
    path = options.file or default_fmu(model_of(mechanism))
    binding = OWN_BINDING if options.binding is None else load_binding(options.binding)
    parameters = mechanism.plant_parameters() if binding.native else {}
    if options.file is not None and binding.native and not takes_parameters(FmuDescription(path), [*parameters]):
        parameters = {}
    with FmuPlant(path, parameters, 1e-3, binding) as plant:
        write_drive_mode(plant.handle, VELOCITY)
        system = state_space(plant, options.inputs, options.outputs)
    poles = sorted(system.poles(), key=abs)
    table = Table("pole [1/s]", "frequency [Hz]", "damping")
    for pole in poles:
        if pole.imag >= 0.0:
            size = abs(pole)
            damping = f"{-pole.real / size:.3f}" if size > 0.0 else "-"
            table.add(f"{pole:.4g}", f"{size / (2.0 * np.pi):.4g}", damping)
    table.print()
    print(f"{system.nstates} states, {system.ninputs} inputs, {system.noutputs} outputs")
    matrices = {name: getattr(system, name) for name in "ABCD"}
    names = {"states": system.state_labels, "inputs": system.input_labels, "outputs": system.output_labels}
    cli.write_json(options.json, matrices | names | {"poles": [[pole.real, pole.imag] for pole in poles]})


def _cells(variable: "Variable") -> tuple[str, ...]:
    """A variable's row in the table."""
    role: str = variable.causality
    if role == "parameter":
        role = f"{'tunable' if variable.tunable else 'fixed'} parameter"
    elif variable.discrete:
        role = f"discrete {role}"
    limits = f"{variable.minimum:g} to {variable.maximum:g}"
    unit, nominal = ("-", "-") if variable.discrete else (variable.unit, f"{variable.nominal:g}")
    return f"`{variable.name}`", _shape(variable.shape), unit, role, limits, nominal, variable.description


def _shape(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape)) or "1"


def _finite(value: Any) -> Any:
    """None for what has no limit."""
    return None if value in (-inf, inf) else value


def _print_pairs(pairs: dict[str, Any]) -> None:
    width = max(map(len, pairs))
    for name, value in pairs.items():
        print(f"{name:{width}}  {value}")


gough_fmu = cli.group(
    "Build, show, validate or linearise the plant's FMU.",
    build=gough_fmu_build,
    table=gough_fmu_table,
    info=gough_fmu_info,
    validate=gough_fmu_validate,
    linearize=gough_fmu_linearize,
)
