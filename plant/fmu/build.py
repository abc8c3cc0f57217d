"""From the dynamics of a plant to its FMU.

`python -m plant.fmu.build FILE ...` builds in its own process: one that runs a loop must not load CasADi.
"""

import io
import platform
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module, resources
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import fmpy

from plant.compiled import hash_of_files, keyed_folder
from plant.dynamics.variables import PLANAR, SPATIAL, VariableTable
from plant.errors import InputError, ToolchainError
from plant.extras import check_installed
from plant.files import check_writable, write_whole
from plant.fmu.description_writer import Layout, build_description, model_description
from plant.mechanism import Mechanism, load_in_space

C_FLAGS = (
    "-std=c11", "-fPIC", "-fvisibility=hidden", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math",
)  # fmt: skip
SOURCES = ("model.c", "plant.c", "disturbed.c", "derivatives.c", "unsupported.c")
"""The C files of an FMU, beside `fmi2.c` or `fmi3.c`."""

_HEADERS = Path(fmpy.__file__).parent / "c-code"
_EPOCH = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Model:
    """A plant that can be exported."""

    identifier: str  # of the FMU and its binaries
    description: str
    table: VariableTable
    preset: str  # with the default start values
    module: str  # with its equations, which loads CasADi

    def dynamics(self) -> Any:
        """Derive its equations (`plant.dynamics.assembly.Dynamics`)."""
        return import_module(self.module).build_dynamics()


SPATIAL_MODEL = Model(
    "gough_plant",
    "Six-leg parallel mechanism with encoderless drives and ideal IMUs",
    SPATIAL,
    "hexapod",
    "plant.dynamics.spatial",
)
PLANAR_MODEL = Model(
    "gough_planar_plant", "Planar three-leg mechanism with encoderless drives and ideal IMUs", PLANAR, "planar-3rpr",
    "plant.dynamics.planar",
)  # fmt: skip


class Platform(NamedTuple):
    """A platform for FMUs."""

    folder: str  # in FMI 3.0
    folder_2: str  # in FMI 2.0
    zig: str  # zig's name for it
    suffix: str


PLATFORMS = {
    "linux": (Platform("x86_64-linux", "linux64", "x86_64-linux-gnu.2.17", ".so"),),
    "windows": (Platform("x86_64-windows", "win64", "x86_64-windows-gnu", ".dll"),),
    "darwin": (
        Platform("x86_64-darwin", "darwin64", "x86_64-macos.11.0", ".dylib"),
        Platform("aarch64-darwin", "darwin64", "aarch64-macos.11.0", ".dylib"),
    ),
}
"""The names for `--platforms`. In FMI 2.0 both processors of darwin share one universal library."""


def default_fmu(model: Model = SPATIAL_MODEL, fmi: int = 3) -> Path:
    """A plant's FMU for this machine, built on first use and kept under a hash of all its sources.

    Raises:
        ToolchainError: no C compiler, or it failed.
    """
    with building_default_fmu(model, fmi) as finish:
        return finish()


@contextmanager
def building_default_fmu(model: Model = SPATIAL_MODEL, fmi: int = 3) -> Iterator[Callable[[], Path]]:
    """Build the `default_fmu` meanwhile; yields a function that waits for its path."""
    package = Path(__file__).resolve().parent.parent
    sources = [*sorted(package.rglob("*.py")), package / "mechanism" / "presets" / f"{model.preset}.toml"]
    with resources.as_file(resources.files("fmus")) as folder:
        wrappers = sorted([*folder.glob("*.c"), *folder.glob("*.h")])
        key = hash_of_files([*sources, *wrappers], version("casadi"), platform.machine(), sys.platform, str(fmi))
    path = keyed_folder("fmus", key) / f"{model.identifier}.fmu"
    process = None if path.exists() else _start_build(path, fmi, model.preset, ())

    def finish() -> Path:
        if process is not None:
            _finish_build(process)
        return path

    try:
        yield finish
    finally:
        if process is not None and process.poll() is None:
            process.kill()
            process.communicate()


def build_in_subprocess(path: Path, fmi: int = 3, mechanism: str = "hexapod", platforms: Sequence[str] = ()) -> None:
    """As `build`, without loading CasADi into this process; every error is a `ToolchainError`."""
    _finish_build(_start_build(path, fmi, mechanism, platforms))


def _start_build(path: Path, fmi: int, mechanism: str, platforms: Sequence[str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-P", "-m", "plant.fmu.build", str(path), str(fmi), mechanism, *platforms]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _finish_build(process: subprocess.Popen[str]) -> None:
    _, errors = process.communicate()
    if process.returncode:
        last = (errors.strip() or "no output").splitlines()[-1]
        raise ToolchainError(f"the plant's FMU could not be built: {last.split(': ', 1)[-1]}")


def c_compiler() -> list[str]:
    """The command of a C compiler for this machine; `ToolchainError` if none is installed."""
    for name in ("cc", "gcc", "clang"):
        if found := shutil.which(name):
            return [found]
    raise ToolchainError("no C compiler (cc, gcc or clang) was found: install one, on Debian with 'apt install gcc'")


def _zig() -> list[str]:
    """The command of the compiler for other platforms."""
    check_installed("ziglang")
    return [sys.executable, "-m", "ziglang", "cc"]


def build(path: Path, fmi: int = 3, mechanism: str | Path = "hexapod", platforms: Sequence[str] = ()) -> None:
    """Write the plant of a mechanism as an FMU; the file appears whole or not at all.

    Args:
        path: the file.
        fmi: 3 for Co-Simulation and Model Exchange, 2 for Co-Simulation.
        mechanism: preset or file whose parameters are the start values.
        platforms: keys of `PLATFORMS`; by default this machine's.

    Raises:
        ToolchainError: no C compiler, or it failed.
        InputError: a version or platform that does not exist, or `path` cannot be written.
    """
    from plant.fmu import c_code

    check_build(fmi, platforms)
    check_writable(path)
    loaded = load_in_space(mechanism)
    model = model_of(loaded)
    starts = loaded.plant_parameters()
    layout = Layout(model.table)
    with tempfile.TemporaryDirectory(prefix="gough-build-") as folder:
        work = Path(folder)
        dynamics = model.dynamics()
        c_code.write_functions(dynamics, work)
        wrapper = f"fmi{fmi}.c"
        for name in ("model.h", "model.c", wrapper):
            (work / name).write_text((resources.files("fmus") / name).read_text())
        declarations = (_HEADERS / f"fmi{fmi}Functions.h").read_text()
        (work / "unsupported.c").write_text(c_code.unsupported_functions(fmi, declarations, (work / wrapper).read_text()))
        values = repr({name: value.tolist() for name, value in starts.items()})
        token = "{" + hash_of_files([work / name for name in (*SOURCES, wrapper, "model.h")], values) + "}"
        (work / "layout.h").write_text(c_code.layout_header(layout, starts, token, dynamics))
        sources = [*SOURCES, wrapper]
        dependencies = c_code.find_dependencies(dynamics, layout)
        contents = {
            "modelDescription.xml": model_description(
                fmi, model.identifier, model.description, layout, starts, token, dependencies, sources
            ),
            **{f"sources/{file.name}": file.read_bytes() for file in sorted(work.iterdir())},
            "sources/buildDescription.xml": build_description(model.identifier, sources),
        }
        for name, library in _libraries(model, fmi, work, sources, platforms).items():
            contents[f"binaries/{name}"] = library
        write_whole(path, _archive(contents))


def check_build(fmi: int, platforms: Sequence[str]) -> None:
    """Check the version and the platforms of a build (`InputError`) and the compiler (`ToolchainError`)."""
    if fmi not in (2, 3):
        raise InputError(f"there is no FMI {fmi} to export: choose 2 or 3")
    if unknown := [name for name in platforms if name not in PLATFORMS]:
        raise InputError(f"no platform {unknown[0]!r}; there are {', '.join(PLATFORMS)}")
    if platforms:
        _zig()
    else:
        c_compiler()


def model_of(mechanism: Mechanism) -> Model:
    """The plant for a mechanism."""
    return PLANAR_MODEL if mechanism.planar else SPATIAL_MODEL


def _archive(contents: Mapping[str, bytes]) -> bytes:
    """A zip archive without time stamps: the same sources give the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in contents.items():
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, data, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def _libraries(model: Model, fmi: int, work: Path, sources: list[str], platforms: Sequence[str]) -> dict[str, bytes]:
    if not platforms:
        library = _compile(c_compiler(), work, sources, fmpy.sharedLibraryExtension)
        folder = fmpy.platform_tuple if fmi == 3 else fmpy.platform
        return {f"{folder}/{model.identifier}{fmpy.sharedLibraryExtension}": library}
    libraries: dict[str, bytes] = {}
    for name in platforms:
        compiled = []
        for each in PLATFORMS[name]:
            library = _compile([*_zig(), "-target", each.zig], work, sources, each.suffix)
            compiled.append(library)
            libraries[f"{each.folder if fmi == 3 else each.folder_2}/{model.identifier}{each.suffix}"] = library
        if fmi == 2 and len(compiled) > 1:
            libraries[f"{each.folder_2}/{model.identifier}{each.suffix}"] = _universal(compiled)
    return libraries


def _compile(compiler: list[str], work: Path, sources: list[str], suffix: str) -> bytes:
    """A shared library."""

    def compile_one(source: str) -> str:
        # The equations are one long block of scalars, and with these options GCC keeps them in registers. What seldom runs is
        # rather compiled fast: the derivatives would take half a minute.
        often = ["-O2", "-frename-registers", "-fno-tree-slp-vectorize"]
        effort = {"disturbed.c": ["-O1"], "derivatives.c": ["-O0"]}.get(source, often)
        # The compilers run in the folder, so that their output contains no path of this machine.
        _run([*compiler, *C_FLAGS, *effort, f"-I{_HEADERS}", "-c", source, "-o", f"{source}.o"], work)
        return f"{source}.o"

    with ThreadPoolExecutor() as pool:
        objects = list(pool.map(compile_one, sources))
    _run([*compiler, "-shared", "-s", *objects, "-o", f"library{suffix}", "-lm"], work)
    library = (work / f"library{suffix}").read_bytes()
    return _without_time(library) if suffix == ".dll" else library


def _run(command: list[str], folder: Path) -> None:
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if run.returncode:
        complaint = next((line for line in run.stderr.splitlines() if "error" in line), run.stderr.strip())
        raise ToolchainError(f"{command[0]} could not compile the plant: {complaint}")


def _without_time(library: bytes) -> bytes:
    """A library of Windows without its time stamp in the PE header."""
    stamp = struct.unpack_from("<I", library, 0x3C)[0] + 8
    return library[:stamp] + bytes(4) + library[stamp + 4 :]


def _universal(libraries: list[bytes]) -> bytes:
    """Mach-O libraries of several processors in one file (mach-o/fat.h)."""
    alignment = 14
    header, body = struct.pack(">2I", 0xCAFEBABE, len(libraries)), b""
    at = 1 << alignment
    for library in libraries:
        _, processor, variant = struct.unpack_from("<3I", library)
        header += struct.pack(">5I", processor, variant, at, len(library), alignment)
        padded = library + bytes(-len(library) % (1 << alignment))
        body += padded
        at += len(padded)
    return header.ljust(1 << alignment, b"\0") + body


if __name__ == "__main__":
    build(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3], sys.argv[4:])
