"""Builds the foreign FMUs of `foreign.c` and `foreign3.c`, and bindings for them."""

import re
import subprocess
import zipfile
from pathlib import Path

import fmpy

from plant.fmu.build import c_compiler
from plant.mechanism import Mechanism

AXES = "xyz"
_REALS = [
    *(f"servo{k}.retract" for k in range(1, 7)), "servo.lag", "fault.at",
    *(f"leg{k}.gyro.{axis}" for k in range(1, 7) for axis in AXES),
    *(f"leg{k}.acc.{axis}" for k in range(1, 7) for axis in AXES),
    *(f"top.gyro.{axis}" for axis in AXES), *(f"top.acc.{axis}" for axis in AXES),
    *(f"pose.{axis}" for axis in AXES), *(f"att.{part}" for part in "wxyz"), *(f"servo{k}.extension" for k in range(1, 7)),
]  # fmt: skip

BINDING = f"""
[fmu]
step = 0.0005

[start]
"servo.lag" = 0.015

[velocity_command]
variables = {[f"servo{k}.retract" for k in range(1, 7)]}
unit = "mm/s"
sign = -1

[drive_mode]
variables = "servo.on"
velocity = true
brake = false

[imu_angular_velocity]
variables = {[name for name in _REALS if ".gyro." in name]}
unit = "deg/s"
sign = {[1, -1, 1] * 6 + [1, 1, 1]}

[imu_specific_force]
variables = {[name for name in _REALS if ".acc." in name]}
unit = "g"
sign = -1
"""
TRUTH = f"""
[position]
variables = {[f"pose.{axis}" for axis in AXES]}
unit = "mm"

[quaternion]
variables = {[f"att.{part}" for part in "wxyz"]}

[leg_length]
variables = {[f"servo{k}.extension" for k in range(1, 7)]}
offset = 0.3
"""


BINDING_3 = f"""
[fmu]
step = 0.0005

[start]
"drive.lag" = 0.015

[velocity_command]
variables = "drive.shrink"
unit = "m/min"
sign = -1

[drive_mode]
variables = "brake.closed"
velocity = false
brake = true

[imu_angular_velocity]
variables = "imu.turn"
unit = "rpm"
sign = {[1, -1, 1] * 6 + [1, 1, 1]}

[imu_specific_force]
variables = "imu.pull"
unit = "mg"
sign = -1

[position]
variables = "platform.place"
unit = "cm"

[quaternion]
variables = "platform.attitude"

[leg_length]
variables = "drive.extension"
offset = 0.3
"""


def build_foreign(folder: Path, mechanism: Mechanism) -> Path:
    """The FMU of FMI 2.0, with the geometry of a mechanism."""
    library = _compiled(folder, mechanism, "foreign.c")
    return _packed(folder / "foreign.fmu", _description(), f"binaries/{fmpy.platform}/foreign.so", library)


def build_foreign_3(folder: Path, mechanism: Mechanism) -> Path:
    """The same hexapod as an FMU of FMI 3.0."""
    source = Path(__file__).with_name("foreign3.c").read_text()
    functions = re.findall(r"FMI3_Export \w+\s+(\w+);", (_HEADERS / "fmi3Functions.h").read_text())
    stubs = folder / "stubs.c"
    # FMPy loads no library that lacks a function.
    stubs.write_text("".join(f"int {name}() {{ return 3; }}\n" for name in functions if f"{name}(" not in source))
    library = _compiled(folder, mechanism, "foreign3.c", stubs)
    return _packed(folder / "foreign3.fmu", _description_3(), f"binaries/{fmpy.platform_tuple}/foreign3.so", library)


_HEADERS = Path(fmpy.__file__).parent / "c-code"


def _compiled(folder: Path, mechanism: Mechanism, source: str, *more: Path) -> bytes:
    geometry = {
        "BASE": 1e3 * mechanism.base_joints, "PLATFORM": 1e3 * mechanism.platform_joints, "AXES": mechanism.base_joint_axes,
        "LEG_IMU": 1e3 * mechanism.plant["leg_imu_position"], "PLATFORM_IMU": 1e3 * mechanism.plant["platform_imu_position"],
        "HOME": 1e3 * mechanism.require_home().position, "GRAVITY": 1e3 * mechanism.plant["gravity"],
    }  # fmt: skip
    lines = []
    for name, values in geometry.items():
        sizes = "".join(f"[{size}]" for size in values.shape)
        numbers = str(values.tolist()).replace("[", "{").replace("]", "}")
        lines.append(f"static const double {name}{sizes} = {numbers};")
    (folder / "geometry.h").write_text("\n".join(lines) + "\n")
    library, sources = folder / "library.so", [str(Path(__file__).with_name(source)), *map(str, more)]
    command = [*c_compiler(), "-O2", "-fPIC", "-shared", f"-I{_HEADERS}", f"-I{folder}", *sources]
    subprocess.run([*command, "-o", str(library), "-lm"], check=True)
    return library.read_bytes()


def _packed(path: Path, description: str, member: str, library: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        archive.writestr(member, library)
    return path


def _description_3() -> str:
    reals = {
        "drive.shrink": (6,), "drive.lag": (), "trouble.time": (), "imu.turn": (7, 3), "imu.pull": (7, 3),
        "platform.place": (3,), "platform.attitude": (4,), "drive.extension": (6,),
    }  # fmt: skip
    variables, structure = [], {"Output": "", "InitialUnknown": ""}
    for reference, (name, shape) in enumerate(reals.items(), start=1):
        role = 'causality="output"'
        if name == "drive.shrink":
            role = 'causality="input" start="0 0 0 0 0 0"'
        elif name in ("drive.lag", "trouble.time"):
            role = 'causality="parameter" variability="tunable" start="1" min="0.001"'
        else:
            for kind in structure:
                structure[kind] += f'<{kind} valueReference="{reference}"/>'
        unit = ' unit="cm"' if name == "drive.extension" else ""
        sizes = "".join(f'<Dimension start="{size}"/>' for size in shape)
        variables.append(f'<Float64 name="{name}" valueReference="{reference}" {role}{unit}>{sizes}</Float64>')
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<fmiModelDescription fmiVersion="3.0" modelName="foreign3" instantiationToken="{foreign3}">'
        '<CoSimulation modelIdentifier="foreign3" canHandleVariableCommunicationStepSize="true" canGetAndSetFMUState="true"'
        ' canSerializeFMUState="true"/>'
        '<UnitDefinitions><Unit name="cm"><BaseUnit m="1" factor="0.01"/></Unit></UnitDefinitions>'
        f"<ModelVariables>{''.join(variables)}"
        '<Float64 name="time" valueReference="100" causality="independent" variability="continuous"/>'
        '<Boolean name="brake.closed" valueReference="101" causality="input" start="true"/>'
        '<UInt8 name="trouble.kind" valueReference="102" causality="parameter" variability="fixed" start="0"/></ModelVariables>'
        f"<ModelStructure>{structure['Output']}{structure['InitialUnknown']}</ModelStructure></fmiModelDescription>"
    )


def _description() -> str:
    variables = [
        '<ScalarVariable name="fault.status" valueReference="1" causality="parameter" variability="fixed"><Integer start="0"/>',
        '<ScalarVariable name="servo.on" valueReference="1" causality="input" variability="discrete"><Boolean start="false"/>',
    ]
    for index, name in enumerate(_REALS):
        role, value = 'causality="output" variability="continuous"', "<Real/>"
        if name.endswith(".retract"):
            role, value = 'causality="input" variability="continuous"', '<Real start="0"/>'
        elif name in ("servo.lag", "fault.at"):
            role, value = 'causality="parameter" variability="tunable"', '<Real start="1" min="0.001"/>'
        elif name.endswith(".extension"):
            value = '<Real unit="mm"/>'
        variables.append(f'<ScalarVariable name="{name}" valueReference="{1000 + index}" {role}>{value}')
    outputs = [f'<Unknown index="{number}"/>' for number, text in enumerate(variables, start=1) if '"output"' in text]
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<fmiModelDescription fmiVersion="2.0" modelName="foreign" guid="{foreign}" variableNamingConvention="structured">'
        '<CoSimulation modelIdentifier="foreign" canHandleVariableCommunicationStepSize="true" canGetAndSetFMUstate="true"'
        ' canSerializeFMUstate="true"/>'
        '<UnitDefinitions><Unit name="mm"><BaseUnit m="1" factor="0.001"/></Unit></UnitDefinitions>'
        f"<ModelVariables>{''.join(f'{text}</ScalarVariable>' for text in variables)}</ModelVariables>"
        f"<ModelStructure><Outputs>{''.join(outputs)}</Outputs><InitialUnknowns>{''.join(outputs)}</InitialUnknowns>"
        "</ModelStructure></fmiModelDescription>"
    )


def edited(fmu: Path, path: Path, *changes: tuple[str, str]) -> Path:
    """A copy of an FMU with another text in its description."""
    with zipfile.ZipFile(fmu) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    text = contents["modelDescription.xml"].decode()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in {**contents, "modelDescription.xml": text.encode()}.items():
            archive.writestr(name, data)
    return path
