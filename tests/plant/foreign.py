"""Builds the foreign FMU of `foreign.c`, and a binding for it."""

import subprocess
import zipfile
from pathlib import Path

import fmpy

from plant.export import c_compiler
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


def build_foreign(folder: Path, mechanism: Mechanism) -> Path:
    """The FMU, with the geometry of a mechanism."""
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
    library, headers = folder / "foreign.so", Path(fmpy.__file__).parent / "c-code"
    command = [
        *c_compiler(),
        "-O2",
        "-fPIC",
        "-shared",
        f"-I{headers}",
        f"-I{folder}",
        str(Path(__file__).with_name("foreign.c")),
    ]
    subprocess.run([*command, "-o", str(library), "-lm"], check=True)
    path = folder / "foreign.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _description())
        archive.writestr(f"binaries/{fmpy.platform}/foreign.so", library.read_bytes())
    return path


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
