"""The commands for what the loop drives, rigs and the plant's FMU: check-rig, emulate, inject, fmu."""

from argparse import Namespace
from contextlib import nullcontext
from dataclasses import asdict
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.command_line import cli
from hil.command_line.apart import go_on_apart
from hil.command_line.terminal import progress_bar
from hil.realtime.scheduling import RealTimeSettings, keep_to_one_thread, real_time
from hil.runs.config import EmulatorConfig, SimulationConfig
from hil.table import Cell, Table
from plant.errors import GoughError, InputError
from plant.files import check_writable

if TYPE_CHECKING:
    from plant.dynamics.variables import Variable


@cli.command(
    cli.options_of(
        SimulationConfig,
        rig={"required": True},
        rig_at={},
        mechanism={},
        imu={},
        lengths={"text": "encoders that the rig has: none, incremental or absolute"},
        base_imu={"text": "the rig has an IMU on its base"},
        rate={"default": 200.0, "text": "exchanges per second, 50 to 4000"},
    ),
    cli.flag(
        "--move",
        "enable the drives, move all legs by 0.2 mm and each by 2 mm, at 5 mm/s at most, and compare signs and units",
    ),
    cli.argument(
        "--beyond",
        type=float,
        metavar="SPEED",
        help="with --move, a command beyond the limits to try [m/s]: for emulated rigs only, never for hardware",
    ),
    cli.JSON,
)
def gough_check_rig(options: Namespace) -> int:
    """Check that a rig does what the loop relies on.

    The rig is put through its contract, clause by clause. Nothing moves without --move. With it, bring the platform near home
    first: the signs and units of commands, gyroscopes and accelerometers are compared with each other, with gravity, and with
    what the mechanism's file expects of small motions there. The exit status is 1 if anything is found.
    """
    from importlib.metadata import version

    keep_to_one_thread()
    from hil.rigs.clauses import CLAUSES
    from hil.rigs.contract import examine_rig
    from hil.runs.prepare import rig_of
    from plant.imu import aliasing_remark, load_imu
    from plant.mechanism import load_in_space

    if options.beyond is not None and not options.move:
        raise InputError("--beyond is a command to the drives: it needs --move")
    config = cli.config_of(options, SimulationConfig)

    def made() -> Any:
        rig = rig_of(config)
        if rig is None:
            raise InputError("the FMU plant is no rig of its own: choose udp, canopen, replay or python:MODULE:CLASS")
        return rig

    # A recording moves as it was recorded.
    mechanism = None if options.rig == "replay" else load_in_space(config.mechanism)
    # A machine that is busy elsewhere would let the drives go on.
    with real_time(RealTimeSettings()) if options.move else nullcontext():
        examination = examine_rig(made, 1.0 / options.rate, options.move, options.beyond, mechanism=mechanism)
    table = Table("clause", "outcome", "what it asks for", left=(0, 2))
    for clause, findings in examination.findings.items():
        table.add(clause, Cell(f"{len(findings)} found" if findings else "ok", alarm=bool(findings)), CLAUSES[clause])
    table.print()
    found = examination.all_findings()
    for text in found:
        print(text)
    if examination.exchange_us:
        p50, p99, most, count = (examination.exchange_us[name] for name in ("p50", "p99", "max", "n"))
        print(f"exchange p50/p99/max {p50:.0f}/{p99:.0f}/{most:.0f} us of {1e6 / options.rate:g}, {count:g} exchanges")
    moved = "and the drives moved" if options.move else "and nothing was moved"
    if "commands" in examination.findings:
        print(
            f"compared: the accelerometers with gravity at home in {config.mechanism}; the commands and the gyroscopes with "
            "how the accelerometers tilt when a leg moves"
        )
    if remark := aliasing_remark(load_imu(config.imu), config.rate):
        print(remark)
    print(f"{len(examination.findings)} clauses checked, {len(found)} findings, {moved}")
    asked = {"rig": options.rig, "rig_at": options.rig_at, "rate": options.rate, "moved": options.move}
    cli.write_json(options.json, {**asked, **asdict(examination), "version": version("gough")})
    return int(bool(found))


@cli.command(
    cli.options_of(EmulatorConfig),
    cli.options_of(
        SimulationConfig,
        "mechanism",
        "imu",
        "lengths",
        "drives",
        "base_imu",
        "plant",
        "binding",
        "joint_error",
        "frames",
        "frame",
        "tool",
        target={"text": "the platform starts at the first pose of this target"},
        rate={"text": "rate of the IMUs' samples on canopen; on udp the run sets it"},
        seed={"text": "seed of the IMUs' imperfections and of the faults"},
    ),
    cli.options_of(RealTimeSettings, cpu={"default": 0, "shown": None}, priority={"default": 79}),
)
def gough_emulate(options: Namespace) -> None:
    """Emulate a rig on a bus, for 'gough run' in another process.

    The FMU plant, drives and IMUs run on a clock of their own, behind a bus, until Ctrl-C.
    """
    keep_to_one_thread()
    from hil.runs.emulator_process import emulate

    # The faults are the emulator's, which has other kinds, too.
    simulated = cli.config_of(options, SimulationConfig, faults=())
    config = cli.config_of(options, EmulatorConfig, simulated=simulated)
    emulate(config, cli.config_of(options, RealTimeSettings), lambda text: print(text, flush=True))


@cli.command(
    cli.argument("fault", nargs="?", metavar="KIND[:N][,WORD=VALUE]", help="the fault, from now on"),
    cli.flag("--list", "list the kinds of faults"),
    cli.flag("--clear", "take all faults away"),
    cli.argument(
        "--to", metavar="HOST:PORT", help="the emulator's control channel; needed unless one emulator of this user runs here"
    ),
)
def gough_inject(options: Namespace) -> None:
    """Inject a fault into an emulated rig that is running, or ask for its state."""
    from hil.rigs.emulation import FaultKind
    from hil.runs.emulator_process import ask, own_control
    from plant.dynamics.base_course import BaseMotionKind
    from plant.encoders import EncoderFaultKind
    from plant.imu_disturbances import WORDS, DisturbanceKind

    if options.list:
        table = Table("fault", "number", "size by default", "")
        for kind in FaultKind:
            table.add(kind.label, f"0 to {kind.count - 1}" if kind.count else "", f"{kind.default:g}", kind.text)
        table.print()
        table = Table("disturbance", "size", "where", "")
        for each in DisturbanceKind:
            table.add(each.label, ", ".join(each.sizes), ", ".join(("imus", *each.places)), each.text)
        for motion in BaseMotionKind:
            table.add(motion.label, ", ".join(motion.sizes), "axis", motion.text)
        for broken in EncoderFaultKind:
            table.add(broken.label, broken.size, "legs", broken.text)
        table.print()
        table = Table("word", "")
        for word, meaning in WORDS.items():
            table.add(word, meaning)
        table.print()
        return
    question = "clear" if options.clear else f"fault {options.fault}" if options.fault else "state"
    for name, value in ask(options.to or own_control(), question).items():
        print(f"{name}: {value}")


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
