"""From the dynamics to an FMU: C code, layout, modelDescription.xml, a shared library, and the archive around them.

Run in a process of its own (`python -m plant.export FILE`), because CasADi must not be loaded by a process that runs a
loop. The FMU is native and holds no Python.
"""

import io
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from xml.sax.saxutils import quoteattr

import fmpy

from plant.compiled import hash_of_files, keyed_folder
from plant.errors import ToolchainError
from plant.files import write_whole
from plant.mechanism import load_spatial
from plant.pose import Array
from plant.variables import BRAKE, DRIVE_MODES, INPUTS, OUTPUTS, PARAMETERS, STATES, Variable

MODEL = "gough_plant"
EXPOSED = (*INPUTS, *PARAMETERS, *OUTPUTS)
"""The variables that the FMU shows; a value reference is an index into them."""

TIME_REFERENCE = len(EXPOSED)
C_FLAGS = (
    "-std=c11", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math",
)  # fmt: skip
_EPOCH = (1980, 1, 1, 0, 0, 0)

_UNITS: dict[str, dict[str, int | str]] = {
    "m": {"m": 1}, "m/s": {"m": 1, "s": -1}, "m/s2": {"m": 1, "s": -2}, "rad/s": {"rad": 1, "s": -1}, "kg": {"kg": 1},
    "kg.m2": {"kg": 1, "m": 2}, "s": {"s": 1}, "s/m": {"s": 1, "m": -1}, "N": {"kg": 1, "m": 1, "s": -2},
    "N.s/m": {"kg": 1, "s": -1}, "N/m": {"kg": 1, "s": -2}, "Ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "H": {"kg": 1, "m": 2, "s": -2, "A": -2}, "N.m/A": {"kg": 1, "m": 2, "s": -2, "A": -1},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1}, "A": {"A": 1}, "J": {"kg": 1, "m": 2, "s": -2}, "W": {"kg": 1, "m": 2, "s": -3},
    "uT": {"kg": 1, "s": -2, "A": -1, "factor": "1e-6"}, "1": {},
}  # fmt: skip


def default_fmu() -> Path:
    """The plant's FMU for this machine, built on first use and kept under a hash of all that it is made from.

    Raises:
        ToolchainError: no C compiler, or it failed.
    """
    here = Path(__file__).parent
    sources = [here / name for name in ("dynamics.py", "variables.py", "export.py", "mechanism.py", "presets/hexapod.toml")]
    with resources.as_file(resources.files("fmus") / "fmi3.c") as wrapper:
        key = hash_of_files([*sources, wrapper], version("casadi"), platform.machine(), sys.platform)
    path = keyed_folder("fmus", key) / f"{MODEL}.fmu"
    if not path.exists():
        build_in_subprocess(path)
    return path


def build_in_subprocess(path: Path) -> None:
    """Build the FMU at `path` without loading CasADi into this process.

    Raises:
        ToolchainError: no C compiler, or it failed, or `path` cannot be written.
    """
    run = subprocess.run([sys.executable, "-P", "-m", "plant.export", str(path)], capture_output=True, text=True, check=False)
    if run.returncode:
        last = (run.stderr.strip() or "no output").splitlines()[-1]
        raise ToolchainError(f"the plant's FMU could not be built: {last.split(': ', 1)[-1]}")


def c_compiler() -> str:
    """The path of a C compiler.

    Raises:
        ToolchainError: none is installed.
    """
    for name in ("cc", "gcc", "clang"):
        if found := shutil.which(name):
            return found
    raise ToolchainError("no C compiler (cc, gcc or clang) was found: install one, on Debian with 'apt install gcc'")


def build(path: Path) -> None:
    """Write the plant as an FMI 3.0 Co-Simulation FMU; the file appears whole or not at all.

    Raises:
        ToolchainError: no C compiler, or it failed.
        InputError: `path` cannot be written.
    """
    compiler = c_compiler()
    starts = load_spatial("hexapod").plant_parameters()
    with tempfile.TemporaryDirectory(prefix="gough-fmu-") as folder:
        work = Path(folder)
        dependencies = _generate_c(work)
        wrapper = (resources.files("fmus") / "fmi3.c").read_text()
        (work / "fmi3.c").write_text(wrapper)
        token = "{" + hash_of_files([work / "fmi3.c", work / "plant.c"], repr({k: v.tolist() for k, v in starts.items()})) + "}"
        (work / "layout.h").write_text(_layout(starts, token))
        (work / "unsupported.c").write_text(_unsupported(wrapper))
        library = work / f"{MODEL}.so"
        headers = Path(fmpy.__file__).parent / "c-code"
        sources = [str(work / name) for name in ("fmi3.c", "plant.c", "unsupported.c")]
        command = [compiler, *C_FLAGS, f"-I{headers}", f"-I{work}", *sources, "-o", str(library), "-lm", "-s"]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        if run.returncode:
            complaint = next((line for line in run.stderr.splitlines() if "error" in line), run.stderr.strip())
            raise ToolchainError(f"{compiler} could not compile the plant: {complaint}")
        description = _model_description(starts, token, dependencies)
        contents = {"modelDescription.xml": description.encode(), f"binaries/{_platform()}/{MODEL}.so": library.read_bytes()}
        write_whole(path, _archive(contents))


def _archive(contents: dict[str, bytes]) -> bytes:
    """A zip archive without the time of its making, so that the same sources give the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in contents.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), data, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def _platform() -> str:
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    return f"{machine}-{ {'linux': 'linux', 'darwin': 'darwin', 'win32': 'windows'}[sys.platform] }"


def _generate_c(work: Path) -> dict[str, list[int]]:
    """Write plant.c and plant.h; return the value references of the inputs that each output depends on directly."""
    import casadi as ca

    from plant.dynamics import build_dynamics

    dynamics = build_dynamics()
    generator = ca.CodeGenerator("plant.c", {"with_header": True})
    for function in (dynamics.constants, dynamics.rates, dynamics.outputs):
        generator.add(function)
    generator.generate(str(work) + "/")
    with (work / "plant.h").open("a") as header:
        header.write(f"#define CONSTANTS {dynamics.constants.size1_out(0)}\n")

    pattern = dynamics.outputs.jac_sparsity(0, 1)
    rows, columns = pattern.get_triplet()
    pairs = set(zip(rows, columns, strict=True))
    dependencies: dict[str, list[int]] = {}
    row = 0
    for output in OUTPUTS:
        column = 0
        touched = []
        for reference, known in enumerate(INPUTS):
            if any((r, c) in pairs for r in range(row, row + output.size) for c in range(column, column + known.size)):
                touched.append(reference)
            column += known.size
        dependencies[output.name] = touched
        row += output.size
    return dependencies


def _start_of(variable: Variable, starts: dict[str, Array]) -> list[float]:
    if variable.discrete:
        return [float(BRAKE)] * variable.size
    if variable.causality == "parameter":
        return [float(value) for value in starts[variable.name].reshape(-1)]
    return [0.0] * variable.size


def _kind(variable: Variable) -> str:
    if variable.causality == "parameter":
        return "TUNABLE" if variable.tunable else "FIXED"
    return ("DISCRETE_" if variable.discrete else "") + variable.causality.upper()


def _layout(starts: dict[str, Array], token: str) -> str:
    offsets, at = {}, 0
    blocks = {}
    for block, variables in (("STATES", STATES), ("INPUTS", INPUTS), ("PARAMETERS", PARAMETERS), ("OUTPUTS", OUTPUTS)):
        blocks[block] = at
        for variable in variables:
            offsets[variable.name] = at
            at += variable.size

    def table(kind: str, name: str, values: list[str]) -> str:
        return f"static const {kind} {name}[] = {{{', '.join(values)}}};"

    everything = (*STATES, *INPUTS, *PARAMETERS, *OUTPUTS)
    lines = [
        "#pragma once",
        "enum { FIXED, TUNABLE, INPUT, DISCRETE_INPUT, OUTPUT };",
        f"#define VALUES {at}",
        f"#define VARIABLES {len(EXPOSED)}",
        f"#define TIME_REFERENCE {TIME_REFERENCE}",
        f"#define STATES {blocks['INPUTS']}",
        f"#define INPUTS {blocks['PARAMETERS'] - blocks['INPUTS']}",
        f"#define DRIVE_MODES {len(DRIVE_MODES)}",
        f'#define TOKEN "{token}"',
        f"#define LAYOUT 0x{token[1:17]}ULL",
        *(f"#define {block}_AT {blocks[block]}" for block in ("INPUTS", "PARAMETERS", "OUTPUTS")),
        *(
            f"#define {macro}_AT {offsets[name]}"
            for macro, name in (
                ("POSITION", "state.position"),
                ("QUATERNION", "state.quaternion"),
                ("INITIAL_POSITION", "initial_position"),
                ("INITIAL_QUATERNION", "initial_quaternion"),
                ("SUBSTEP", "substep"),
            )
        ),
        table("char *const", "names", [f'"{v.name}"' for v in EXPOSED]),
        table("int", "kind", [_kind(v) for v in EXPOSED]),
        table("int", "offset", [str(offsets[v.name]) for v in EXPOSED]),
        table("int", "length", [str(v.size) for v in EXPOSED]),
        table("double", "minimum", ["-INFINITY" if v.minimum is None else repr(v.minimum) for v in EXPOSED]),
        table("double", "start", [value.hex() for v in everything for value in _start_of(v, starts)]),
        "",
    ]
    return "\n".join(lines)


def _unsupported(wrapper: str) -> str:
    """C code of the FMI functions outside this FMU's capabilities: importers want every symbol, and each must fail."""
    declared = re.findall(
        r"FMI3_Export fmi3\w+TYPE\s+(fmi3\w+);",
        (Path(fmpy.__file__).parent / "c-code" / "fmi3Functions.h").read_text(),
    )
    missing = [name for name in declared if not re.search(rf"\b{name}\(", wrapper)]
    bodies = [
        f"FMI3_Export void *{name}(void) {{ return 0; }}"
        if "Instantiate" in name
        else f"FMI3_Export int {name}(void) {{ return 3; /* fmi3Error */ }}"
        for name in missing
    ]
    return "\n".join(['#define FMI3_Export __attribute__((visibility("default")))', *bodies, ""])


def _model_description(starts: dict[str, Array], token: str, dependencies: dict[str, list[int]]) -> str:
    units = []
    for name, exponents in sorted(_UNITS.items()):
        attributes = " ".join(f'{base}="{exponent}"' for base, exponent in exponents.items())
        units.append(
            f'<Unit name="{name}"><BaseUnit {attributes}/></Unit>' if exponents else f'<Unit name="{name}"><BaseUnit/></Unit>'
        )
    items = "".join(f'<Item name="{name}" value="{value}"/>' for value, name in DRIVE_MODES.items())
    outputs = []
    unknowns = []
    for reference, variable in enumerate(EXPOSED):
        if variable.causality == "output":
            listed = " ".join(str(i) for i in dependencies[variable.name])
            outputs.append(f'<Output valueReference="{reference}" dependencies="{listed}"/>')
            unknowns.append(f'<InitialUnknown valueReference="{reference}"/>')
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<fmiModelDescription fmiVersion="3.0" modelName="{MODEL}" instantiationToken="{token}"'
        ' variableNamingConvention="structured" generationTool="gough"'
        ' description="Six-leg parallel mechanism with encoderless drives and ideal IMUs">',
        f'<CoSimulation modelIdentifier="{MODEL}" canHandleVariableCommunicationStepSize="true"'
        ' canGetAndSetFMUState="true" canSerializeFMUState="true"/>',
        f"<UnitDefinitions>{''.join(units)}</UnitDefinitions>",
        f'<TypeDefinitions><EnumerationType name="DriveMode">{items}</EnumerationType></TypeDefinitions>',
        '<LogCategories><Category name="logStatusError" description="why a call was refused or failed"/></LogCategories>',
        '<DefaultExperiment startTime="0" stopTime="10" stepSize="0.001"/>',
        "<ModelVariables>",
        f'<Float64 name="time" valueReference="{TIME_REFERENCE}" causality="independent" variability="continuous" unit="s"/>',
        *(_scalar_or_array(reference, variable, starts) for reference, variable in enumerate(EXPOSED)),
        "</ModelVariables>",
        f"<ModelStructure>{''.join(outputs + unknowns)}</ModelStructure>",
        "</fmiModelDescription>",
        "",
    ]
    return "\n".join(lines)


def _scalar_or_array(reference: int, variable: Variable, starts: dict[str, Array]) -> str:
    tag, extra = "Float64", f' unit="{variable.unit}"'
    values = [repr(value) for value in _start_of(variable, starts)]
    if variable.discrete:
        tag, extra = "Enumeration", ' declaredType="DriveMode"'
        values = [str(int(float(value))) for value in values]
    if variable.minimum is not None:
        extra += f' min="{variable.minimum!r}"'
    variability = {
        "FIXED": "fixed", "TUNABLE": "tunable", "DISCRETE_INPUT": "discrete", "INPUT": "continuous", "OUTPUT": "continuous",
    }[_kind(variable)]  # fmt: skip
    start = "" if variable.causality == "output" else f' start="{" ".join(values)}"'
    initial = ' initial="calculated"' if variable.causality == "output" else ""
    dimensions = "".join(f'<Dimension start="{n}"/>' for n in variable.shape)
    return (
        f'<{tag} name="{variable.name}" valueReference="{reference}" causality="{variable.causality}"'
        f' variability="{variability}"{initial}{extra}{start}'
        f" description={quoteattr(variable.description)}>{dimensions}</{tag}>"
    )


if __name__ == "__main__":
    build(Path(sys.argv[1]))
