"""A foreign FMU behind a binding: what its variables become, what is refused and why, and how it fails."""

import re
import signal
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plant.dynamics.variables import BRAKE, PLANAR, SPATIAL, VELOCITY
from plant.errors import FmuError, InputError, UnknownNameError
from plant.fmu.binding import SIGNAL_UNITS, UNITS, Binding, SignalBinding, bind, load_binding
from plant.fmu.calls import MOST_CHANGES, advance, read_imus, read_truth, write_command, write_drive_mode, write_drive_modes
from plant.fmu.description_reader import FmuVariable
from plant.fmu.plant import FmuPlant
from plant.fmu.settings import Setting
from plant.pose import Array
from plant.truth import TRUTH_LENGTHS
from tests.plant.fmu.foreign import BINDING, TRUTH, edited

Load = Callable[..., FmuPlant]
SPEEDS = np.linspace(-0.02, 0.03, 6)


@pytest.fixture
def load(foreign_fmu: Path, tmp_path: Path) -> Iterator[Load]:
    """A function that loads the foreign FMU with a binding, given as text, and settings as on the command line."""
    with ExitStack() as stack:

        def start(text: str = BINDING + TRUTH, *settings: str, period: float = 1e-3, fmu: Path = foreign_fmu) -> FmuPlant:
            path = tmp_path / "foreign.toml"
            path.write_text(text)
            return stack.enter_context(FmuPlant(fmu, {}, period, path, [Setting.parse(each) for each in settings]))

        yield start


def move(plant: FmuPlant, cycles: int, period: float = 1e-3, mode: int = VELOCITY) -> Array:
    """Drive the plant; returns what its IMUs and the truth then are."""
    for _ in range(cycles):
        assert write_drive_mode(plant.handle, mode) == 0
        assert write_command(plant.handle, SPEEDS) == 0
        assert advance(plant.handle, period) == 0
    assert read_imus(plant.handle) == 0
    assert read_truth(plant.handle) == 0
    return np.hstack([plant.handle["imu"].ravel(), plant.handle["truth"]])


def without(table: str, text: str = BINDING) -> str:
    """A binding without one of its tables."""
    shorter = re.sub(rf"\[{re.escape(table)}\].*?(?=\n\[|\Z)", "", text, flags=re.DOTALL)
    assert shorter != text
    return shorter


# ---- what the variables become ----


def test_units_signs_and_order_are_the_loops(load: Load) -> None:
    plant = load()
    move(plant, 200)
    handle = plant.handle
    for imu in range(7):
        name = "top" if imu == 6 else f"leg{imu + 1}"
        for axis, letter in enumerate("xyz"):
            flipped = -1.0 if letter == "y" and imu < 6 else 1.0
            rate = flipped * np.radians(float(plant.get(f"{name}.gyro.{letter}")))
            assert handle["imu"][0, imu, axis] == pytest.approx(rate, rel=1e-14, abs=1e-16)
            assert handle["imu"][1, imu, axis] == pytest.approx(-9.80665 * float(plant.get(f"{name}.acc.{letter}")), rel=1e-14)
    assert np.isnan(handle["imu"][2]).all()
    np.testing.assert_allclose(handle["truth"][:3], [1e-3 * float(plant.get(f"pose.{axis}")) for axis in "xyz"], rtol=1e-14)
    # The extension declares its unit itself, and the binding adds the tube's 300 mm.
    lengths = [0.3 + 1e-3 * float(plant.get(f"servo{k}.extension")) for k in range(1, 7)]
    np.testing.assert_allclose(handle["truth"][TRUTH_LENGTHS], lengths, rtol=1e-14)
    assert np.isnan(handle["truth"][13:]).all()


def test_commands_reach_the_drives_and_the_pose_follows(load: Load) -> None:
    plant = load()
    before = move(plant, 1, mode=BRAKE)[-12:-6].copy()
    after = move(plant, 500)[-12:-6]
    # With its lag of 15 ms a drive is behind by 15 ms.
    np.testing.assert_allclose(after - before, (0.5 - 0.015) * SPEEDS, rtol=1e-9)
    assert np.linalg.norm(plant.handle["imu"][1, 6]) == pytest.approx(9.81, abs=0.5)


def test_what_is_written_is_converted_back_as_what_is_read(load: Load) -> None:
    """`loop = sign * unit * fmu + offset`, also where the loop writes, and for each element by itself."""
    signs, offsets = np.array([1, -1, 1, -1, -1, 1]), 0.01 * np.arange(-2, 4)
    own = f"unit = 'mm/s'\nsign = {signs.tolist()}\noffset = {offsets.tolist()}"
    for text, sign, offset in ((own, signs, offsets), ("unit = 'mm/s'\nsign = -1\noffset = 0.004", -1, 0.004)):
        plant = load(BINDING.replace('unit = "mm/s"\nsign = -1', text))
        assert write_drive_mode(plant.handle, VELOCITY) == 0
        assert write_command(plant.handle, SPEEDS) == 0
        told = np.array([float(plant.get(f"servo{k}.retract")) for k in range(1, 7)])
        np.testing.assert_allclose(1e-3 * sign * told + offset, SPEEDS, rtol=0.0, atol=1e-16)


def test_a_common_switch_is_on_while_any_drive_moves(load: Load) -> None:
    plant = load()
    for modes, expected in (([BRAKE] * 6, 0), ([VELOCITY] * 6, 1), ([BRAKE] * 5 + [VELOCITY], 1)):
        plant.handle["mode"] = modes
        assert write_drive_modes(plant.handle) == 0
        assert plant.get("servo.on") == expected


def test_drives_without_a_switch_are_told_to_stand(load: Load) -> None:
    plant = load(without("drive_mode"))
    told = [f"servo{k}.retract" for k in range(1, 7)]
    write_drive_mode(plant.handle, VELOCITY)
    write_command(plant.handle, SPEEDS)
    np.testing.assert_allclose([float(plant.get(name)) for name in told], -1e3 * SPEEDS)
    write_drive_mode(plant.handle, BRAKE)
    assert [float(plant.get(name)) for name in told] == [0.0] * 6


def test_imus_that_are_not_there_read_nothing(load: Load) -> None:
    legs = re.sub(r", 'top\.[^']*'", "", BINDING).replace(", 1, 1, 1]", "]")
    legs = re.sub(r"(\[imu_\w+\])", r"\1\nimus = [0, 1, 2, 3, 4, 5]", legs)
    plant = load(legs)
    whole = load()
    move(plant, 10), move(whole, 10)
    assert plant.bound.imus == (0, 1, 2, 3, 4, 5)
    np.testing.assert_array_equal(plant.handle["imu"][:2, :6], whole.handle["imu"][:2, :6])
    assert np.isnan(plant.handle["imu"][:, 6]).all()


def test_imus_may_come_in_any_order(load: Load) -> None:
    turned = re.sub(r"('leg1\.acc\.x'.*?), ('leg2\.acc\.x'.*?), ('leg3)", r"\2, \1, \3", BINDING)
    assert turned != BINDING
    turned = turned.replace("[imu_specific_force]", "[imu_specific_force]\nimus = [1, 0, 2, 3, 4, 5, 6]")
    plant, straight = load(turned), load(BINDING)
    assert move(plant, 20)[:42].tobytes() == move(straight, 20)[:42].tobytes()
    assert plant.bound.imus == (0, 1, 2, 3, 4, 5, 6)
    for imus in ("[true, 0]", "[1.0, 0]", "[0, 0]"):
        with pytest.raises(
            FmuError, match=r"\[imu_specific_force\] imus is .*; it must be a list of different numbers from 0 to 6"
        ):
            load(BINDING.replace("[imu_specific_force]", f"[imu_specific_force]\nimus = {imus}"))


def test_a_planar_plant_has_its_pose_in_space(load: Load) -> None:
    imus = {
        signal: [f"{place}.{kind}.{axis}" for place in ("leg1", "leg2", "leg3", "top") for axis in "xyz"]
        for signal, kind in (("imu_angular_velocity", "gyro"), ("imu_specific_force", "acc"))
    }
    tables = [f"[{signal}]\nvariables = {names}" for signal, names in imus.items()]
    commands = [f"servo{k}.retract" for k in range(1, 4)]
    tables.append(f"[velocity_command]\nvariables = {commands}")
    tables.append("[position]\nvariables = ['pose.x', 'pose.y']\nunit = 'mm'")
    tables.append("[angle]\nvariables = 'pose.z'\nunit = 'deg'")
    plant = load("\n".join(tables))
    read_imus(plant.handle), read_truth(plant.handle)
    assert (plant.bound.legs, plant.bound.imus) == (3, (0, 1, 2, 6))
    assert np.isfinite(plant.handle["imu"][:2, [0, 1, 2, 6]]).all() and np.isnan(plant.handle["imu"][:2, 3:6]).all()
    half = np.radians(float(plant.get("pose.z"))) / 2.0
    np.testing.assert_allclose(plant.handle["truth"][:7], [0, 0, 0, np.cos(half), 0, 0, np.sin(half)], atol=1e-15)


def test_the_communication_step_divides_the_period(load: Load, foreign_fmu: Path) -> None:
    plant = load()
    for _ in range(5000):
        plant.step(1e-3)
    # A sum of so many steps would be off by 1e-12 s.
    assert plant.handle["time"] == 10_000 * 0.0005
    plant.step(2e-3)
    assert plant.handle["time"] == 10_004 * 0.0005
    message = (
        r"foreign.fmu cannot take a rate of 800 Hz: its binding sets a step of 0.0005 s, so the rate must be 2000 Hz divided"
    )
    with pytest.raises(InputError, match=message):
        load(period=1.25e-3)


# ---- what is refused ----


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("'top.acc.z'", "'top.acc.q'"), r"imu_specific_force: has no variable 'top.acc.q'; did you mean top.acc.\w\?"),
        (("'top.acc.z'", "'servo.on'"), "imu_specific_force: servo.on is of causality input and must be output"),
        (("'servo6.retract'", "'pose.x'"), "velocity_command: pose.x is of causality output and must be input"),
        (("'servo6.retract'", "'servo.on'"), "velocity_command: servo.on is of type Boolean and must be double-precision real"),
        ((", 'servo6.retract'", ""), "velocity_command: .*servo5.retract together have 5 elements and must have 6"),
        ((", 'top.acc.z'", ""), "have 20 elements and must have 21; if there are fewer imus, name them with imus"),
        (('unit = "g"', 'unit = "stone"'), r"\[imu_specific_force\] unit is 'stone'; it must be one of m/s2, m/s\^2, mm/s2"),
        (("sign = -1\n\n[drive", "sign = 2\n\n[drive"), r"\[velocity_command\] sign is 2; it must be 1 or -1"),
        (("[1, -1, 1,", "[1, -1,"), r"\[imu_angular_velocity\] sign has 20 numbers and must have 1, 3 or 21"),
        (("velocity = true", "velocity = 7"), "drive_mode: servo.on of foreign.fmu must be true or false, got "),
        (("[velocity_command]", "[velocity]"), r"there is no table \[velocity\];.*no table \[velocity_command\], which"),
        (('unit = "mm/s"', 'units = "mm/s"'), r"\[velocity_command\] has no entry 'units'; it has offset, sign, unit, vari"),
        (("step = 0.0005", "step = 'fast'"), r"\[fmu\] step is 'fast'; it must be a number of seconds"),
        (('"servo.lag" =', '"servo.leg" ='), r"\[start\] foreign.fmu has no variable 'servo.leg'; did you mean servo.lag"),
        (('"servo.lag" = 0.015', '"servo.lag" = [1, 2]'), r"\[start\] servo.lag of foreign.fmu has 1 elements, got 2"),
        (("[quaternion]", "[current]"), "position, and quaternion or angle, are the pose only together"),
        (('variables = "servo.on"', "variables = 3"), r"\[drive_mode\] variables is 3; it must be the name of a variable"),
        (("offset = 0.3", "offset = 'far'"), r"\[leg_length\] offset is 'far'; it must be a number"),
        (("offset = 0.3", "unit = 'A'"), r"\[leg_length\] unit is 'A'; it must be one of m, dm, cm, mm"),
        (('unit = "g"', 'unit = ["g"]'), r"\[imu_specific_force\] unit is \['g'\]; it must be one of"),
        (("step = 0.0005", "step = 1e-320"), r"\[fmu\] step is 1e-320; it must be a number of seconds, at least 1e-06"),
        (("step = 0.0005", f"step = 1{'0' * 400}"), r"\[fmu\] step is 10+; it must be a number of seconds"),
        (("'servo6.retract'", "'servo5.retract'"), "velocity_command: servo5.retract must be bound once, and not more often"),
        (("'leg1.acc.x'", "'leg1.gyro.x'"), "imu_angular_velocity and imu_specific_force: leg1.gyro.x must be bound once"),
        (('"servo.lag" = 0.015', '"servo1.retract" = 1'), r"\[start\] servo1.retract of foreign.fmu is set by the loop"),
        (("velocity = true\n", "velocity = false\n"), "drive_mode: brake and velocity are both 0 and must differ"),
        (("brake = false", "brake = [0]"), r"\[drive_mode\] brake is \[0\]; it must be a number, true or false"),
    ],
)  # fmt: skip
def test_a_binding_that_does_not_fit_is_refused_with_its_one_error(load: Load, change: tuple[str, str], message: str) -> None:
    text = BINDING + TRUTH
    assert change[0] in text
    with pytest.raises(FmuError, match=message) as caught:
        load(text.replace(*change))
    assert str(caught.value).startswith("foreign.fmu with foreign.toml: ")
    assert "\n" not in str(caught.value)


def test_all_that_is_wrong_is_said_at_once(load: Load) -> None:
    text = BINDING.replace("'top.acc.z'", "'top.acc.q'").replace('"deg/s"', '"deg/h"').replace('"servo.lag"', '"servo.mass"')
    with pytest.raises(FmuError, match=r"'deg/h'.*'top.acc.q'.*'servo.mass'"):
        load(text.replace("[fmu]", "[fmi]"))


def test_a_unit_that_the_fmu_declares_and_nobody_knows_has_to_be_said(load: Load, foreign_fmu: Path, tmp_path: Path) -> None:
    path = edited(foreign_fmu, tmp_path / "furlong.fmu", ('"mm"', '"furlong"'))
    with pytest.raises(FmuError, match=r"leg_length: servo1.extension is in furlong: say with unit which of m, dm, .* that is"):
        load(fmu=path)


@pytest.mark.parametrize(
    ("content", "message"), [(None, "cannot read .*foreign.toml"), (b"[fmu", "is not valid TOML"), (b"\xff", "is not UTF-8")]
)
def test_a_file_that_is_no_binding_is_refused(foreign_fmu: Path, tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "foreign.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        FmuPlant(foreign_fmu, {}, 1e-3, path)


def test_an_fmu_without_a_binding_must_have_our_names(foreign_fmu: Path) -> None:
    with pytest.raises(
        FmuError, match=r"foreign.fmu: velocity_command: has no variable 'velocity_command'.*imu_angular_velocity"
    ):
        FmuPlant(foreign_fmu, {}, 1e-3)


def test_start_values_that_the_fmu_refuses_come_with_its_message(load: Load) -> None:
    with pytest.raises(FmuError, match=r"initialisation failed: the lag of the servos is -1 s and must be positive"):
        load(BINDING, "servo.lag=-1")


def test_an_fmu_whose_tool_is_missing_says_so(load: Load, foreign_fmu: Path, tmp_path: Path) -> None:
    changes = ('modelIdentifier="foreign"', 'modelIdentifier="foreign" needsExecutionTool="true"'), ("<Real/>", "<Real/>")
    path = edited(foreign_fmu, tmp_path / "tool.fmu", *changes)
    with zipfile.ZipFile(path) as archive:
        library = next(name for name in archive.namelist() if name.endswith(".so"))
    noise = edited(path, tmp_path / "noise.fmu")
    with zipfile.ZipFile(tmp_path / "broken.fmu", "w") as broken, zipfile.ZipFile(noise) as archive:
        broken.writestr("modelDescription.xml", archive.read("modelDescription.xml"))
        broken.writestr(library, b"not a library")
    with pytest.raises(FmuError, match=r"broken.fmu cannot be loaded: .* \(it needs its tool on this machine\)"):
        load(fmu=tmp_path / "broken.fmu")


# ---- settings ----


def test_settings_come_after_the_binding_and_at_their_time(load: Load) -> None:
    plant = load(BINDING, "servo.lag=0.03", "servo.lag=0.5@0.01", "servo.lag=0.05@0.004")
    assert plant.get("servo.lag") == 0.03
    seen = []
    for _ in range(12):
        assert advance(plant.handle, 1e-3) == 0
        seen.append(float(plant.get("servo.lag")))
    assert seen == [0.03] * 4 + [0.05] * 6 + [0.5] * 2


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        (["servo.leg=1"], UnknownNameError, "foreign.fmu has no variable 'servo.leg'; did you mean servo.lag?"),
        (["servo.lag=1,2"], InputError, "servo.lag of foreign.fmu has 1 elements, got 2"),
        (["servo.lag=1,2@3"], InputError, "servo.lag of foreign.fmu has 1 elements, got 2"),
        (["fault.status=1@3"], InputError, "neither an input nor a tunable parameter: set it without @"),
        (["servo1.retract=1@3"], InputError, "servo1.retract of foreign.fmu is set by the loop"),
        (["servo1.retract=1"], InputError, "servo1.retract of foreign.fmu is set by the loop"),
        (["pose.x=1"], InputError, "pose.x of foreign.fmu is a continuous output variable, which takes no start value"),
        (["servo.lag=0@3"], InputError, "servo.lag of foreign.fmu would be 0; it must be from 0.001 to inf"),
        (["fault.status=0.5"], InputError, "fault.status of foreign.fmu must be whole numbers"),
        ([f"servo.lag=1@{n}" for n in range(MOST_CHANGES + 1)], InputError, f"at most {MOST_CHANGES} can"),
    ],
)
def test_settings_that_do_not_fit_are_refused(load: Load, settings: list[str], error: type, message: str) -> None:
    with pytest.raises(error, match=re.escape(message)):
        load(BINDING, *settings)


def test_each_scalar_of_an_array_keeps_its_own_limits(load: Load, foreign_fmu: Path, tmp_path: Path) -> None:
    limits = 'valueReference="1007" causality="parameter" variability="tunable"><Real start="1" min="0.001"'
    path = edited(
        foreign_fmu,
        tmp_path / "array.fmu",
        ("servo.lag", "set[1]"),
        ("fault.at", "set[2]"),
        (limits, limits.replace("0.001", "5")),
    )
    plant = load(without("start"), "set=0.02,7", "set=0.05,8@0.001", fmu=path)
    for _ in range(2):
        plant.step(1e-3)
    np.testing.assert_array_equal(plant.get("set"), [0.05, 8.0])
    with pytest.raises(InputError, match=r"set\[2\] of array.fmu would be 0.05; it must be from 5 to inf"):
        load(without("start"), "set=0.05@0.001", fmu=path)


def test_a_binding_may_leave_what_is_usual(load: Load) -> None:
    plant = load(BINDING.replace("velocity = true\nbrake = false\n", "velocity = 1\n"))
    np.testing.assert_array_equal(plant.bound.modes.values, [0.0, 0.0, 1.0])


def test_settings_are_read_from_text() -> None:
    assert Setting.parse("gravity=0, 0,-9.8") == Setting("gravity", (0.0, 0.0, -9.8))
    assert Setting.parse("a[1,2]=true@2.5") == Setting("a[1,2]", (1.0,), 2.5)
    assert Setting.parse("payload.mass=12@3.5").text == "payload.mass=12@3.5"
    for text in ("", "mass", "=1", "mass=", "mass=heavy", "mass=1@", "mass=1@-1", "mass=nan", "mass=1@inf"):
        with pytest.raises(InputError, match="is no setting"):
            Setting.parse(text)


# ---- failures ----


@pytest.mark.parametrize(
    ("status", "ending"),
    [
        (1, "gave a warning"),
        (2, "was discarded"),
        (3, "failed"),
        (4, "failed for good"),
        (5, "continues in the background, .*"),
    ],
)
def test_every_status_but_ok_ends_with_the_message_of_the_fmu(load: Load, status: int, ending: str) -> None:
    plant = load(BINDING, f"fault.status={status}", "fault.at=0.003")
    for _ in range(3):
        assert advance(plant.handle, 1e-3) == 0
    assert advance(plant.handle, 1e-3) & status
    # The placeholders of the message are filled in.
    message = rf"foreign.fmu: a step {ending}: servo 3 is at 91.5 degrees after a while"
    assert re.fullmatch(message, str(plant.failure()))
    # After an error FMI allows nothing but the end, and after a fatal one not even that.
    assert (read_imus(plant.handle) == 0) == (status < 3)
    plant.close()


def test_each_of_two_plants_hears_its_own_messages(load: Load) -> None:
    first, second = (load(BINDING, "fault.status=3", f"fault.at={at}") for at in (0.001, 0.002))
    with pytest.raises(FmuError, match=r"servo 3"):
        first.step(2e-3)
    assert list(second.messages) == []
    first.close()
    with pytest.raises(FmuError, match=r"servo 3"):
        second.step(3e-3)


# ---- state ----


def test_a_restored_state_goes_on_bit_for_bit(load: Load) -> None:
    plant = load(BINDING, "servo.lag=0.1@0.08")
    move(plant, 50)
    saved = plant.state()
    first = move(plant, 60)
    plant.restore(saved)
    assert plant.handle["time"] == 100 * 0.0005
    np.testing.assert_array_equal(move(plant, 60), first)
    other = load(BINDING, "servo.lag=0.1@0.08")
    other.restore(saved)
    np.testing.assert_array_equal(move(other, 60), first)
    assert other.handle["time"] == 220 * 0.0005


def test_a_state_that_cannot_be_saved_or_is_none_is_an_error(load: Load, foreign_fmu: Path, tmp_path: Path) -> None:
    with pytest.raises(FmuError, match=r"cannot restore a state of 3 bytes"):
        load().restore(b"abc")
    with pytest.raises(FmuError, match=r"foreign.fmu: restoring a state failed"):
        load().restore(bytes(40))
    with pytest.raises(FmuError, match=r"cannot restore a state after 3472328296227680304 changes: it has not so many"):
        load().restore(b"0" * 40)
    path = edited(foreign_fmu, tmp_path / "stateless.fmu", (' canSerializeFMUstate="true"', ""))
    with pytest.raises(FmuError, match=r"stateless.fmu cannot save its state: export it with canSerializeFMUState"):
        load(fmu=path).state()


# ---- nothing is left behind ----


def test_the_next_to_load_removes_what_a_killed_process_has_left(foreign_fmu: Path, tmp_path: Path) -> None:
    binding, temporary = tmp_path / "foreign.toml", tmp_path / "temporary"
    binding.write_text(BINDING)
    temporary.mkdir()
    code = (
        "import sys, tempfile; tempfile.tempdir = sys.argv[3]; from plant.fmu.plant import FmuPlant\n"
        "plant = FmuPlant(sys.argv[1], {}, 1e-3, sys.argv[2]); print(plant.folder, flush=True); sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", code, foreign_fmu, binding, temporary]
    with ExitStack() as stack:
        killed, alive = (
            stack.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
            for _ in range(2)
        )
        left, kept = (Path(process.stdout.readline().strip()) for process in (killed, alive))
        killed.send_signal(signal.SIGKILL)
        killed.wait()
        assert left.is_dir() and kept.is_dir()
        before, tempfile.tempdir = tempfile.tempdir, str(temporary)
        try:
            FmuPlant(foreign_fmu, {}, 1e-3, binding).close()
        finally:
            tempfile.tempdir = before
        assert list(temporary.iterdir()) == [kept]
        alive.communicate("")
    assert list(temporary.iterdir()) == []


# ---- matched without an FMU ----


class Described(dict[str, FmuVariable]):
    """What `bind` needs of a description."""

    path = Path("any.fmu")

    def __missing__(self, name: str) -> FmuVariable:
        raise UnknownNameError(f"any.fmu has no variable {name!r}")


def described(*variables: FmuVariable) -> Any:
    return Described({each.name: each for each in variables})


def variable(
    name: str, size: int, first: int, causality: str = "output", unit: str | None = None, type_: str = "Float64"
) -> FmuVariable:
    """A variable with consecutive references from `first` on."""
    limits = ((-np.inf, np.inf),) * size
    dtype = {"Float64": "float64", "Int32": "int32", "Boolean": "bool"}[type_]
    references = tuple(range(first, first + size))
    return FmuVariable(name, (size,), type_, causality, "continuous", unit, limits, True, references, type_, np.dtype(dtype))


def plant_of(legs: int) -> list[FmuVariable]:
    """The least that a plant needs, in odd units."""
    return [
        variable("u", legs, 100, "input", "mm/s"),
        variable("gyro", 3 * (legs + 1), 200, unit="deg/s"),
        variable("acc", 3 * (legs + 1), 300),
    ]


LEAST = {
    "velocity_command": SignalBinding(("u",)),
    "imu_angular_velocity": SignalBinding(("gyro",)),
    "imu_specific_force": SignalBinding(("acc",), unit="g"),
}

HAND_COMPUTED = {
    "m": {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "um": 0.000001, "in": 0.0254},
    "m/s": {
        "m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001, "um/s": 0.000001, "m/min": 1.0 / 60.0, "mm/min": 1.0 / 60000.0, "in/s": 0.0254
    },
    "m/s2": {"m/s2": 1.0, "m/s^2": 1.0, "mm/s2": 0.001, "mm/s^2": 0.001, "g": 9.80665, "mg": 0.00980665},
    "rad": {"rad": 1.0, "mrad": 0.001, "deg": 0.017453292519943295},
    "rad/s": {
        "rad/s": 1.0, "mrad/s": 0.001, "deg/s": 0.017453292519943295, "rpm": 0.10471975511965977, "1/min": 0.10471975511965977
    },
    "rad/s2": {"rad/s2": 1.0, "rad/s^2": 1.0, "deg/s2": 0.017453292519943295, "deg/s^2": 0.017453292519943295},
    "uT": {"uT": 1.0, "nT": 0.001, "mT": 1000.0, "T": 1000000.0, "G": 100.0, "mG": 0.1},
    "A": {"A": 1.0, "mA": 0.001},
    "kg": {"kg": 1.0, "g": 0.001, "t": 1000.0},
    "1": {"1": 1.0, "": 1.0},
}  # fmt: skip


def test_every_unit_is_worth_what_it_is() -> None:
    assert {kind: set(units) for kind, units in UNITS.items()} == {kind: set(units) for kind, units in HAND_COMPUTED.items()}
    for kind, units in HAND_COMPUTED.items():
        for unit, worth in units.items():
            assert UNITS[kind][unit] == pytest.approx(worth, rel=1e-15), (kind, unit)
    own = [each for table in (SPATIAL, PLANAR) for each in (*table.inputs, *table.parameters, *table.outputs)]
    for name, kind in SIGNAL_UNITS.items():
        assert {each.unit for each in own if each.name == name} == {kind}


@pytest.mark.parametrize("legs", [6, 3])
def test_readings_go_to_their_place_with_unit_sign_and_offset_of_each_axis(legs: int) -> None:
    """One variable for all gyroscopes, and one for each accelerometer, of which two declare units of their own."""
    imus = [*range(legs), 6]
    each = [variable(f"acc{k}", 3, 300 + 10 * k, unit={0: "m/s2", 1: "mm/s2"}.get(k)) for k in range(legs + 1)]
    order = tuple(reversed(imus))
    signals = {
        "velocity_command": SignalBinding(("u",), sign=(-1.0,), offset=(0.25,)),
        "imu_angular_velocity": SignalBinding(("gyro",), sign=(1.0, -1.0, 1.0), offset=(0.1, 0.2, 0.3)),
        "imu_specific_force": SignalBinding(tuple(v.name for v in each), imus=order),
        "imu_magnetic_field": SignalBinding(("field",), unit="G", imus=(6, 1)),
    }
    bound = bind(Binding("", signals), described(*plant_of(legs)[:2], *each, variable("field", 6, 400)))
    assert (bound.legs, bound.imus, bound.magnetometers) == (legs, tuple(imus), (1, 6))
    assert bound.driven == {f"u[{k}]" for k in range(1, legs + 1)} and not bound.knows_pose
    np.testing.assert_array_equal(bound.commanded.places, range(legs))
    np.testing.assert_allclose(bound.commanded.factors, [-1e-3] * legs, rtol=1e-15)
    np.testing.assert_array_equal(bound.commanded.offsets, [0.25] * legs)

    raw = dict(zip(range(200, 500), np.random.default_rng(0).normal(size=300), strict=True))
    read = np.full((3, 7, 3), np.nan)
    scalars = bound.sensed
    for place, reference, factor, offset in zip(
        scalars.places, scalars.references, scalars.factors, scalars.offsets, strict=True
    ):
        read.reshape(-1)[place] = factor * raw[int(reference)] + offset
    expected = np.full((3, 7, 3), np.nan)
    for row, imu in enumerate(imus):
        for axis in range(3):
            sign, offset = ((1.0, 0.1), (-1.0, 0.2), (1.0, 0.3))[axis]
            expected[0, imu, axis] = sign * np.pi / 180.0 * raw[200 + 3 * row + axis] + offset
    for k, imu in enumerate(order):
        expected[1, imu] = [{1: 1e-3}.get(k, 1.0) * raw[300 + 10 * k + axis] for axis in range(3)]
    for row, imu in enumerate((6, 1)):
        expected[2, imu] = [100.0 * raw[400 + 3 * row + axis] for axis in range(3)]
    np.testing.assert_allclose(read, expected, rtol=1e-14)


@pytest.mark.parametrize("legs", [6, 3])
def test_the_truth_of_either_plant_goes_to_its_place(legs: int) -> None:
    spatial = legs == 6
    attitude = "quaternion" if spatial else "angle"
    signals = LEAST | {
        "position": SignalBinding(("p",), unit="mm"),
        attitude: SignalBinding(("turn",)),
        "leg_length": SignalBinding(("l",), sign=(-1.0,), offset=tuple(0.1 * k for k in range(legs))),
        "current": SignalBinding(("i",)),
        "payload.mass": SignalBinding(("load",), unit="g"),
    }
    truth = [
        variable("p", 3 if spatial else 2, 10), variable("turn", 4 if spatial else 1, 20, unit=None if spatial else "deg"),
        variable("l", legs, 30, unit="cm"), variable("i", legs, 40, unit="mA"), variable("load", 1, 50, "input"),
    ]  # fmt: skip
    bound = bind(Binding("", signals), described(*plant_of(legs), *truth))
    assert (bound.knows_pose, bound.planar_angle) == (True, not spatial)
    found = {
        int(reference): (int(place), factor, offset)
        for place, reference, factor, offset in zip(
            bound.known.places, bound.known.references, bound.known.factors, bound.known.offsets, strict=True
        )
    }
    expected: dict[int, tuple[int, float, float]] = {10 + k: (k, 1e-3, 0.0) for k in range(3 if spatial else 2)}
    expected |= {20 + k: (3 + k, 1.0 if spatial else np.pi / 180.0, 0.0) for k in range(4 if spatial else 1)}
    expected |= {30 + k: (7 + k, -1e-2, 0.1 * k) for k in range(legs)}
    expected |= {40 + k: (13 + k, 1e-3, 0.0) for k in range(legs)}
    assert found == {key: pytest.approx(value) for key, value in expected.items()}
    assert bound.loaded.places.tolist() == [0] and bound.loaded.factors.tolist() == [1e-3]
    assert bound.loaded.references.tolist() == [50]


@pytest.mark.parametrize(
    ("type_", "told", "values"),
    [
        ("Int32", (None, None, None), [0.0, 1.0, 2.0]),
        ("Boolean", (None, None, None), [0.0, 0.0, 1.0]),
        ("Int32", (None, 5.0, 7.0), [5.0, 5.0, 7.0]),
        ("Int32", (3.0, 5.0, None), [3.0, 5.0, 2.0]),
        ("Int32", (None, None, 9.0), [0.0, 1.0, 9.0]),
        ("Boolean", (None, 1.0, 0.0), [1.0, 1.0, 0.0]),
    ],
)
@pytest.mark.parametrize("common", [True, False])
def test_a_drive_that_has_no_open_mode_is_braked_instead(
    type_: str, told: tuple[float | None, ...], values: list[float], common: bool
) -> None:
    modes = variable("m", 1 if common else 6, 60, "input", type_=type_)
    bound = bind(Binding("", LEAST | {"drive_mode": SignalBinding(("m",), modes=told)}), described(*plant_of(6), modes))
    np.testing.assert_array_equal(bound.modes.values, values)
    assert bound.modes.common == common and bound.modes.variable is modes
    np.testing.assert_array_equal(bound.modes.references, modes.references)
    assert {each for each in bound.driven if each[0] == "m"} == set(modes.element_names)


@pytest.mark.parametrize(
    ("legs", "changes", "message"),
    [
        (3, {"imu_specific_force": SignalBinding(("acc",), imus=(0, 1, 2, 3))}, "there is no imu 3 on 3 legs; there are"),
        (6, {"imu_specific_force": SignalBinding(("acc3",), imus=(0,))}, "imu_specific_force are of different imus"),
        (6, {"angle": SignalBinding(("acc3",))}, "angle: only a planar plant, with three commands, has one"),
        (6, {"imu_angular_velocity": SignalBinding(("gyro",), sign=(1.0, -1.0))}, "sign has 2 numbers and must have 1, 3"),
        (6, {"velocity_command": SignalBinding(("u",), offset=(1.0, 2.0, 3.0))}, "offset has 3 numbers and must have 1 or 6"),
        (6, {"drive_mode": SignalBinding(("acc3",))}, "drive_mode: acc3 is of causality output and must be input"),
        (6, {"drive_mode": SignalBinding(("m2",))}, "drive_mode: m2 together have 2 elements and must have 1, or 6"),
        (6, {"drive_mode": SignalBinding(("m2", "n4"))}, "drive_mode: m2, n4 are of different types and must be of one"),
        (6, {"payload.mass": SignalBinding(("u",))}, "velocity_command and payload.mass: u.* must be bound once"),
    ],
)  # fmt: skip
def test_what_no_plant_has_is_refused(legs: int, changes: dict[str, SignalBinding], message: str) -> None:
    others = [variable("acc3", 3, 500), variable("m2", 2, 510, "input", type_="Int32"),
        variable("n4", 4, 520, "input", type_="Boolean")]  # fmt: skip
    with pytest.raises(FmuError, match=message):
        bind(Binding("", LEAST | changes), described(*plant_of(legs), *others))


def test_a_binding_that_names_no_signal_is_our_own_with_its_step_and_start(tmp_path: Path) -> None:
    path = tmp_path / "step.toml"
    path.write_text("[fmu]\nstep = 0.00025\n[start]\n'payload.mass' = 4.0\n")
    found = load_binding(path)
    assert (found.step, found.native, found.start, found.source) == (0.00025, True, {"payload.mass": 4.0}, "step.toml")
    assert set(found.signals) == set(SIGNAL_UNITS) and found.problems == ()
    path.write_text("[current]\nvariables = 'i'\nunit = 'mA'\nsign = -1\noffset = [0.5, 1]\n")
    found = load_binding(path)
    assert (found.step, found.native, dict(found.start)) == (None, False, {})
    assert dict(found.signals) == {"current": SignalBinding(("i",), "mA", (-1.0,), (0.5, 1.0))}


@pytest.mark.parametrize(("step", "good"), [("0.000001", True), ("0.0000009", False), ("-0.001", False), ("true", False)])
def test_a_step_is_at_least_a_microsecond(tmp_path: Path, step: str, good: bool) -> None:
    path = tmp_path / "step.toml"
    path.write_text(f"[fmu]\nstep = {step}\n")
    assert (load_binding(path).problems == ()) == good
