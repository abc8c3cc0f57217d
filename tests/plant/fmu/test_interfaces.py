"""One plant behind several interfaces: FMI 3.0 Co-Simulation and Model Exchange, FMI 2.0, other importers, other compilers."""

import ctypes
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Model, FMU3Slave
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from plant.dynamics.variables import SPATIAL, VELOCITY, Variable
from plant.errors import InputError
from plant.fmu.build import PLANAR_MODEL, SPATIAL_MODEL, Model, build, check_build, default_fmu
from plant.fmu.check import check_fmu
from plant.fmu.description_writer import Layout, element_names
from plant.fmu.plant import FmuPlant
from plant.mechanism import Mechanism
from plant.pose import Array

LAYOUT = Layout(SPATIAL)
REFERENCE = {variable.name: reference for reference, variable in enumerate(LAYOUT.exposed)}
SIZE = {variable.name: variable.size for variable in LAYOUT.exposed}
VARIABLE = {variable.name: variable for variable in LAYOUT.exposed}


@pytest.fixture(scope="session")
def fmi2_path() -> Path:
    return default_fmu(SPATIAL_MODEL, fmi=2)


@contextmanager
def opened(path: Path, kind: Any, log: Any = None) -> Iterator[Any]:
    """An instance of an FMU through FMPy's own classes."""
    folder = fmpy.extract(str(path))
    description = fmpy.read_model_description(str(path))
    fmu = kind(
        guid=description.guid, unzipDirectory=folder, modelIdentifier=description.coSimulation.modelIdentifier, instanceName="p"
    )
    fmu.instantiate(**({} if log is None else {"logMessage": log}))
    try:
        yield fmu
    finally:
        fmu.freeInstance()
        shutil.rmtree(folder)


def values_of(fmu: Any, *names: str) -> Array:
    return np.array(fmu.getFloat64([REFERENCE[n] for n in names], nValues=sum(SIZE[n] for n in names)))


def command(t: float) -> Array:
    """A lively motion of all legs, in steps of 20 ms."""
    steps = np.floor(t / 0.02 + 0.5) * 0.02
    command: Array = 0.06 * np.sin(2.0 * np.pi * (0.4 + 0.07 * np.arange(6)) * steps + np.arange(6))
    return command


@pytest.mark.slow
@pytest.mark.parametrize("model", [pytest.param(SPATIAL_MODEL, id="spatial"), pytest.param(PLANAR_MODEL, id="planar")])
def test_every_exported_fmu_is_clean_and_keeps_its_promises(model: Model) -> None:
    for path in (default_fmu(model), default_fmu(model, fmi=2)):
        assert validate_fmu(str(path)) == []
        assert [(check.name, check.problems) for check in check_fmu(path) if check.problems != ()] == []
        run = subprocess.run(
            [sys.executable, "-m", "fmu_manipulation_toolbox", "-input", str(path), "-check"],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        said = run.stdout + run.stderr
        assert "No semantic error" in said and "seems to be compliant" in said
        assert "ERROR" not in said and "WARNING" not in said, said


# ---- Model Exchange ----


def exchange(path: Path, duration: float) -> Array:
    """Poses (n, 7) every 20 ms, by an adaptive integrator of high order on the states of Model Exchange."""
    with opened(path, FMU3Model) as fmu:
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        n = ctypes.c_size_t()
        fmu.fmi3GetNumberOfContinuousStates(fmu.component, n)
        assert n.value == sum(variable.size for variable in SPATIAL.states)
        x, dx = np.zeros(n.value), np.zeros(n.value)
        pointers = [array.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for array in (x, dx)]
        fmu.setInt64([REFERENCE["drive_mode"]], [VELOCITY] * 6)
        fmu.enterContinuousTimeMode()
        fmu.fmi3GetContinuousStates(fmu.component, pointers[0], n)

        def rates(t: float, state: Array) -> Array:
            fmu.fmi3SetTime(fmu.component, t)
            x[:] = state
            fmu.fmi3SetContinuousStates(fmu.component, pointers[0], n)
            fmu.fmi3GetContinuousStateDerivatives(fmu.component, pointers[1], n)
            return dx.copy()

        state, step, poses = x.copy(), 0.02, []
        for i in range(round(duration / step)):
            fmu.setFloat64([REFERENCE["velocity_command"]], command(i * step))
            state = solve_ivp(rates, (i * step, (i + 1) * step), state, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
            poses.append(state[:7])
        return np.array(poses)


def cosimulate(path: Path, duration: float, substep: float) -> Array:
    poses = []
    with opened(path, FMU3Slave) as fmu:
        fmu.setFloat64([REFERENCE["substep"]], [substep])
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        fmu.setInt64([REFERENCE["drive_mode"]], [VELOCITY] * 6)
        for cycle in range(round(1000 * duration)):
            fmu.setFloat64([REFERENCE["velocity_command"]], command(1e-3 * (cycle - cycle % 20)))
            fmu.doStep(currentCommunicationPoint=1e-3 * cycle, communicationStepSize=1e-3)
            if cycle % 20 == 19:
                poses.append(values_of(fmu, "position", "quaternion"))
    return np.array(poses)


@pytest.mark.slow
def test_co_simulation_agrees_with_model_exchange_by_an_adaptive_integrator(fmu_path: Path, hexapod: Mechanism) -> None:
    """10 s at a tolerance of 1e-10: within 1e-8 m and rad at any time, with substeps of 0.25 ms."""
    exact = exchange(fmu_path, 10.0)
    error = np.abs(cosimulate(fmu_path, 10.0, 2.5e-4) - exact)
    assert error[:, :3].max() < 1e-8 and 2.0 * error[:, 3:].max() < 1e-8
    coarse = np.abs(cosimulate(fmu_path, 10.0, 5e-4) - exact)
    assert error[:, :3].max() < coarse[:, :3].max() < 1e-7
    assert np.abs(exact[:, :3] - hexapod.require_home().position).max() > 1e-2


def test_model_exchange_has_its_modes(fmu_path: Path) -> None:
    messages: list[str] = []

    def log(environment: Any, status: int, category: bytes, message: bytes) -> None:
        messages.append(message.decode())

    with opened(fmu_path, FMU3Model, log) as fmu:
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        assert fmu.updateDiscreteStates()[:5] == (False, False, False, False, False)
        fmu.enterContinuousTimeMode()
        for refused, said in (
            (lambda: fmu.setInt64([REFERENCE["drive_mode"]], [0] * 6), "drive_mode can change in event mode only"),
            (lambda: fmu.setFloat64([REFERENCE["payload.mass"]], [1.0]), "payload.mass can change in event mode only"),
            (fmu.enterContinuousTimeMode, "fmi3EnterContinuousTimeMode cannot be called in this mode"),
        ):
            with pytest.raises(FMICallException):
                refused()
            assert messages[-1] == said
        fmu.enterEventMode()
        fmu.setFloat64([REFERENCE["payload.mass"]], [1.0])


# ---- FMI 2.0 ----


def places(name: str) -> list[int]:
    return list(LAYOUT.places(VARIABLE[name]))


def drive_with_fmi2(path: Path, cycles: int) -> Array:
    """Truth and IMU signals after every cycle, through FMPy."""
    seen = []
    with opened(path, FMU2Slave) as fmu:
        fmu.setupExperiment()
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        fmu.setInteger(places("drive_mode"), [VELOCITY] * 6)
        for cycle in range(cycles):
            fmu.setReal(places("velocity_command"), command(1e-3 * cycle))
            fmu.doStep(currentCommunicationPoint=1e-3 * cycle, communicationStepSize=1e-3)
            seen.append(fmu.getReal([*places("position"), *places("quaternion"), *places("imu_specific_force")]))
    return np.array(seen)


def drive_with_fmi3(path: Path, cycles: int) -> Array:
    seen = []
    with opened(path, FMU3Slave) as fmu:
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        fmu.setInt64([REFERENCE["drive_mode"]], [VELOCITY] * 6)
        for cycle in range(cycles):
            fmu.setFloat64([REFERENCE["velocity_command"]], command(1e-3 * cycle))
            fmu.doStep(currentCommunicationPoint=1e-3 * cycle, communicationStepSize=1e-3)
            seen.append(values_of(fmu, "position", "quaternion", "imu_specific_force"))
    return np.array(seen)


def test_fmi_2_and_fmi_3_are_the_same_plant_to_the_bit(fmu_path: Path, fmi2_path: Path) -> None:
    two, three = drive_with_fmi2(fmi2_path, 300), drive_with_fmi3(fmu_path, 300)
    np.testing.assert_array_equal(two.view(np.uint64), three.view(np.uint64))
    assert np.ptp(two[:, :3], axis=0).max() > 1e-4


def test_fmi_2_has_every_element_by_its_name_with_unit_range_and_start(fmi2_path: Path, hexapod: Mechanism) -> None:
    described = {v.name: v for v in fmpy.read_model_description(str(fmi2_path), validate=True).modelVariables}
    starts = hexapod.plant_parameters()
    assert len(described) == LAYOUT.size
    for variable in LAYOUT.exposed:
        for i, name in enumerate(element_names(variable.name, variable.shape)):
            actual = described[name]
            assert actual.valueReference == LAYOUT.offsets[variable.name] + i
            assert actual.unit == (None if variable.discrete else variable.unit)
            assert (float(actual.min), float(actual.max)) == (variable.minimum, variable.maximum)
            if variable.causality == "parameter":
                assert float(actual.start) == np.ravel(starts[variable.name])[i]
    assert described["base_joints[2,3]"].valueReference == LAYOUT.offsets["base_joints"] + 5
    assert described["der(state.velocity[2])"].derivative is described["state.velocity[2]"]


def test_another_importer_runs_the_fmi_2_fmu(fmi2_path: Path) -> None:
    """libcosim's own importer, over FMI Library: the trajectory within 1e-9 of FMPy's."""
    libcosimpy = pytest.importorskip("libcosimpy.CosimExecution")
    from libcosimpy.CosimManipulator import CosimManipulator
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    execution = libcosimpy.CosimExecution.from_step_size(step_size=1_000_000)
    slave = execution.add_local_slave(CosimLocalSlave(fmu_path=str(fmi2_path), instance_name="plant"))
    manipulator, observer = CosimManipulator.create_override(), CosimObserver.create_last_value()
    execution.add_manipulator(manipulator=manipulator)
    execution.add_observer(observer=observer)
    seen = []
    for cycle in range(200):
        assert manipulator.slave_integer_values(
            slave_index=slave, variable_references=places("drive_mode"), values=[VELOCITY] * 6
        )
        assert manipulator.slave_real_values(
            slave_index=slave, variable_references=places("velocity_command"), values=list(command(1e-3 * cycle))
        )
        assert execution.step()
        seen.append(
            observer.last_real_values(slave_index=slave, variable_references=[*places("position"), *places("quaternion")])
        )
    expected = drive_with_fmi2(fmi2_path, 200)[:, :7]
    np.testing.assert_allclose(seen, expected, rtol=0.0, atol=1e-9)


# ---- other compilers ----


def drive_as_plant(path: Path) -> Array:
    """IMU signals and lengths after every cycle."""
    seen = []
    with FmuPlant(path, {}, 1e-3) as plant:
        legs = plant.bound.legs
        plant.set("drive_mode", np.full(legs, VELOCITY))
        for cycle in range(500):
            plant.set("velocity_command", command(1e-3 * cycle)[:legs] / 2.0)
            plant.step(1e-3)
            seen.append(np.concatenate([plant.get("imu_specific_force").ravel(), plant.get("leg_length")]))
    return np.array(seen)


@pytest.mark.parametrize(
    ("model", "fmi"),
    [
        pytest.param(SPATIAL_MODEL, 3, marks=pytest.mark.slow, id="spatial, FMI 3"),
        pytest.param(PLANAR_MODEL, 2, marks=pytest.mark.slow, id="planar, FMI 2"),
    ],
)
def test_the_recompiled_fmu_behaves_the_same(model: Model, fmi: int, tmp_path: Path) -> None:
    """`fmpy compile`: CMake and its own flags instead of ours, from the sources inside."""
    original, again = default_fmu(model, fmi), tmp_path / "again.fmu"
    with zipfile.ZipFile(original) as archive, zipfile.ZipFile(again, "w") as stripped:
        for name in archive.namelist():
            if not name.startswith("binaries/"):
                # At the flags of `fmpy compile`, the derivatives, which are not called here, would take a minute and a half.
                begin = b'#pragma GCC optimize("O0")\n' if name == "sources/derivatives.c" else b""
                stripped.writestr(name, begin + archive.read(name))
    subprocess.run([sys.executable, "-m", "fmpy", "compile", str(again)], check=True, capture_output=True)
    first = drive_as_plant(original)
    np.testing.assert_array_equal(first.view(np.uint64), drive_as_plant(again).view(np.uint64))
    assert np.ptp(first[:, -1]) > 1e-4


BEGINS = {
    "x86_64-linux": b"\x7fELF",
    "x86_64-windows": b"MZ",
    "x86_64-darwin": b"\xcf\xfa\xed\xfe\x07",
    "aarch64-darwin": b"\xcf\xfa\xed\xfe\x0c",
}


@pytest.mark.parametrize(
    "platforms",
    [
        pytest.param(["linux", "darwin"], marks=pytest.mark.endurance),
        # The first link for Windows builds its libraries, which takes minutes.
        pytest.param(["linux", "windows"], marks=pytest.mark.endurance),
    ],
)
def test_other_platforms_are_compiled_by_zig(tmp_path: Path, platforms: list[str]) -> None:
    pytest.importorskip("ziglang")
    path = tmp_path / "everywhere.fmu"
    build(path, 3, "planar-3rpr", platforms)
    with zipfile.ZipFile(path) as archive:
        binaries = {name.split("/")[1]: archive.read(name) for name in archive.namelist() if name.startswith("binaries/")}
    assert set(binaries) == {platform for platform in BEGINS if platform.partition("-")[2] in platforms}
    for platform in binaries:
        assert binaries[platform].startswith(BEGINS[platform])
        assert b"fmi3DoStep\0" in binaries[platform] and b"fmi3GetAdjointDerivative\0" in binaries[platform]
        assert b"gough-build-" not in binaries[platform] and str(Path.home()).encode() + b"/" not in binaries[platform]
    # The one for this machine runs.
    assert validate_fmu(str(path)) == []
    assert np.isfinite(fmpy.simulate_fmu(str(path), stop_time=0.01, output=["kinetic_energy"])["kinetic_energy"]).all()


@pytest.mark.parametrize(
    ("fmi", "platforms", "said"),
    [
        (1, [], "there is no FMI 1 to export: choose 2 or 3"),
        (3, ["amiga"], "no platform 'amiga'; there are linux, windows, darwin"),
    ],
)
def test_what_cannot_be_built_is_refused(fmi: int, platforms: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        check_build(fmi, platforms)


# ---- derivatives ----


def live(stack: ExitStack, path: Path) -> Any:
    """The FMU after a lively motion, so that nothing is at a corner."""
    fmu = stack.enter_context(opened(path, FMU3Slave))
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    fmu.setInt64([REFERENCE["drive_mode"]], [VELOCITY] * 6)
    fmu.setFloat64([REFERENCE["external_wrench.force"]], [3.0, -2.0, 5.0])
    for cycle in range(150):
        fmu.setFloat64([REFERENCE["velocity_command"]], command(1e-3 * cycle))
        fmu.doStep(currentCommunicationPoint=1e-3 * cycle, communicationStepSize=1e-3)
    return fmu


def product(fmu: Any, function: str, unknowns: list[str], knowns: list[str], seed: Array) -> Array:
    """`fmi3GetDirectionalDerivative` or `fmi3GetAdjointDerivative`."""
    wanted = knowns if "Adjoint" in function else unknowns
    result = np.zeros(sum(SIZE[name] for name in wanted))
    arguments: list[Any] = []
    for names in (unknowns, knowns):
        references = (ctypes.c_uint32 * len(names))(*(REFERENCE[name] for name in names))
        arguments += [references, len(names)]
    for vector in (np.ascontiguousarray(seed), result):
        arguments += [vector.ctypes.data_as(ctypes.POINTER(ctypes.c_double)), vector.size]
    getattr(fmu, function)(fmu.component, *arguments)
    return result


KNOWNS = [variable.name for variable in (*SPATIAL.states, *SPATIAL.inputs) if not variable.discrete]
UNKNOWNS = [variable.name for variable in (*LAYOUT.rates, *SPATIAL.outputs)]


@pytest.mark.slow
def test_directional_derivatives_are_casadis_own_jacobians(fmu_path: Path, hexapod: Mechanism) -> None:
    import casadi as ca

    from plant.dynamics.spatial import build_dynamics

    dynamics = build_dynamics()
    with ExitStack() as stack:
        fmu = live(stack, fmu_path)

        def flat(variables: tuple[Variable, ...]) -> Array:
            return np.concatenate([values_of(fmu, v.name) if not v.discrete else np.full(6, VELOCITY) for v in variables])

        x, u, p = flat(SPATIAL.states), flat(SPATIAL.inputs), flat(SPATIAL.parameters)
        symbols = [ca.SX.sym(name, len(vector)) for name, vector in (("x", x), ("u", u), ("p", p))]
        constants = dynamics.constants(symbols[2])
        both = ca.vertcat(*(f(symbols[0], symbols[1], constants) for f in (dynamics.rates, dynamics.outputs)))
        jacobians = ca.Function("jacobians", symbols, [ca.jacobian(both, symbol) for symbol in symbols])(x, u, p)
        first = LAYOUT.offsets[SPATIAL.inputs[0].name]
        modes = [place - first for v in SPATIAL.inputs if v.discrete for place in LAYOUT.places(v)]
        by_input = np.delete(np.array(jacobians[1]), modes, axis=1)
        expected = np.hstack([np.array(jacobians[0]), by_input, np.array(jacobians[2])])
        knowns = KNOWNS + [variable.name for variable in SPATIAL.parameters]
        scale = np.maximum(np.abs(expected).max(axis=1), 1.0)
        found = np.stack(
            [product(fmu, "fmi3GetDirectionalDerivative", UNKNOWNS, knowns, seed) for seed in np.eye(expected.shape[1])], axis=1
        )
        np.testing.assert_allclose(found / scale[:, None], expected / scale[:, None], rtol=1e-12, atol=1e-12)
        for seed in np.random.default_rng(0).normal(size=(5, len(expected))):
            adjoint = product(fmu, "fmi3GetAdjointDerivative", UNKNOWNS, knowns, seed)
            wanted = seed @ expected
            np.testing.assert_allclose(adjoint, wanted, rtol=1e-10, atol=1e-10 * np.abs(wanted).max())


def test_fmi_2_has_the_same_derivatives(fmu_path: Path, fmi2_path: Path) -> None:
    seed = np.random.default_rng(1).normal(size=6)
    with opened(fmi2_path, FMU2Slave) as two, opened(fmu_path, FMU3Slave) as three:
        two.setupExperiment()
        for fmu in (two, three):
            fmu.enterInitializationMode()
            fmu.exitInitializationMode()
        two.setInteger(places("drive_mode"), [VELOCITY] * 6)
        three.setInt64([REFERENCE["drive_mode"]], [VELOCITY] * 6)
        found = two.getDirectionalDerivative(places("voltage"), places("velocity_command"), seed)
        np.testing.assert_array_equal(
            found, product(three, "fmi3GetDirectionalDerivative", ["voltage"], ["velocity_command"], seed)
        )
        assert np.abs(found).min() > 0.0


@pytest.mark.parametrize(
    ("unknown", "known"), [("position", "drive_mode"), ("velocity_command", "state.current"), ("voltage", "position")]
)
def test_derivatives_that_do_not_exist_are_refused(fmu_path: Path, unknown: str, known: str) -> None:
    messages: list[str] = []
    with opened(fmu_path, FMU3Slave, lambda *said: messages.append(said[3].decode())) as fmu:
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        with pytest.raises(FMICallException):
            product(fmu, "fmi3GetDirectionalDerivative", [unknown], [known], np.ones(SIZE[known]))
    assert "of a derivative" in messages[-1]


def test_the_sources_hold_no_path_of_this_machine(fmu_path: Path) -> None:
    with zipfile.ZipFile(fmu_path) as archive:
        for name in archive.namelist():
            data = archive.read(name)
            assert str(Path.home()).encode() + b"/" not in data and b"/tmp/" not in data, name


def test_plants_of_fmi_3_start_as_fmu_plants(fmu_path: Path, hexapod: Mechanism) -> None:
    with FmuPlant(fmu_path, hexapod.plant_parameters(), 1e-3) as plant, opened(fmu_path, FMU3Slave) as fmu:
        fmu.enterInitializationMode()
        np.testing.assert_array_equal(plant.get("imu_specific_force").ravel(), values_of(fmu, "imu_specific_force"))


def test_repeated_variables_add_up(fmu_path: Path) -> None:
    """A seed for each mention, in both directions."""
    with ExitStack() as stack:
        fmu = live(stack, fmu_path)
        once = product(fmu, "fmi3GetDirectionalDerivative", ["power.drive"], ["state.current"], np.full(6, 3.0))
        twice = product(fmu, "fmi3GetDirectionalDerivative", ["power.drive"], ["state.current"] * 2, np.repeat([1.0, 2.0], 6))
        np.testing.assert_allclose(twice, once, rtol=1e-14)
        once = product(fmu, "fmi3GetAdjointDerivative", ["power.drive"], ["state.current"], np.array([3.0]))
        twice = product(fmu, "fmi3GetAdjointDerivative", ["power.drive"] * 2, ["state.current"], np.array([1.0, 2.0]))
        np.testing.assert_allclose(twice, once, rtol=1e-14)


def test_before_the_start_states_and_outputs_follow_from_the_parameters(fmu_path: Path, fmi2_path: Path) -> None:
    """The pose by its initial values, and a length by differences; adjoint and FMI 2.0 agree."""
    seed = np.array([0.3, -0.2, 0.5])
    with opened(fmu_path, FMU3Slave) as three, opened(fmi2_path, FMU2Slave) as two:
        for fmu in (three, two):
            if fmu is two:
                two.setupExperiment()
            fmu.enterInitializationMode()
        unknowns, knowns = ["state.position", "position", "leg_length"], ["initial_position"]
        found = product(three, "fmi3GetDirectionalDerivative", unknowns, knowns, seed)
        np.testing.assert_allclose(found[:6], np.tile(seed, 2), rtol=1e-15)
        ends = []
        start = values_of(three, "initial_position")
        for sign in (1.0, -1.0):
            three.setFloat64([REFERENCE["initial_position"]], start + sign * 1e-6 * seed)
            ends.append(values_of(three, "leg_length"))
        three.setFloat64([REFERENCE["initial_position"]], start)
        np.testing.assert_allclose(found[6:], (ends[0] - ends[1]) / 2e-6, rtol=1e-8)
        weights = np.random.default_rng(0).normal(size=12)
        adjoint = product(three, "fmi3GetAdjointDerivative", unknowns, knowns, weights)
        assert adjoint @ seed == pytest.approx(weights @ found, rel=1e-12)
        all_places = [place for name in unknowns for place in LAYOUT.places(VARIABLE[name])]
        np.testing.assert_array_equal(two.getDirectionalDerivative(all_places, places("initial_position"), seed), found)


# ---- what importers may do, and may not ----


def said_by(path: Path, kind: Any, calls: Any) -> list[str]:
    """What the FMU says when each of some calls, made after initialisation, fails."""
    messages: list[str] = []
    said = []
    with opened(path, kind, lambda *told: messages.append(told[3].decode())) as fmu:
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        for call in calls(fmu):
            with pytest.raises(FMICallException):
                call()
            said.append(messages[-1])
    return said


def test_calls_out_of_their_mode_are_refused_and_change_nothing(fmu_path: Path) -> None:
    def calls(fmu: Any) -> list[Any]:
        return [
            lambda: fmu.fmi3SetTime(fmu.component, 5.0),
            lambda: fmu.fmi3EnterContinuousTimeMode(fmu.component),
            lambda: fmu.doStep(currentCommunicationPoint=0.0, communicationStepSize=1e9),
            lambda: fmu.enterInitializationMode(),
            lambda: fmu.getBoolean([0]),
            lambda: fmu.fmi3EvaluateDiscreteStates(fmu.component),
            # The clock still stands at 0, so this is a step from nowhere.
            lambda: fmu.doStep(currentCommunicationPoint=5.0, communicationStepSize=1e-3),
        ]

    said = said_by(fmu_path, FMU3Slave, calls)
    for message, expected in zip(
        said,
        (
            "fmi3SetTime cannot be called in this mode",
            "fmi3EnterContinuousTimeMode cannot be called in this mode",
            "a communication step of 1e+09 s takes more than 1e+08 substeps",
            "initialisation can be entered only once",
            "fmi3GetBoolean: this FMU has nothing for it",
            "fmi3EvaluateDiscreteStates: this FMU has nothing for it",
            "the communication point is 5 s, but the last step ended at 0 s",
        ),
        strict=True,
    ):
        assert expected in message


def test_nothing_of_an_absent_type_is_no_error(fmu_path: Path) -> None:
    with opened(fmu_path, FMU3Slave) as fmu:
        assert list(fmu.getBoolean([])) == [] and list(fmu.getString([])) == []


def test_a_state_of_the_other_interface_is_refused(fmu_path: Path) -> None:
    with opened(fmu_path, FMU3Slave) as stepped, opened(fmu_path, FMU3Model) as exchanged:
        for fmu in (stepped, exchanged):
            fmu.enterInitializationMode()
            fmu.exitInitializationMode()
        saved = stepped.getFMUState()
        state = exchanged.deserializeFMUState(stepped.serializeFMUState(saved))
        with pytest.raises(FMICallException):
            exchanged.setFMUState(state)
        stepped.freeFMUState(saved)
        exchanged.freeFMUState(state)


def test_a_matrix_is_tuned_as_a_whole_in_fmi_2(fmi2_path: Path, fmu_path: Path) -> None:
    """No element of a larger inertia makes sense alone; one that makes none at all is undone whole."""
    larger = np.diag([0.5, 0.6, 0.7])
    with opened(fmi2_path, FMU2Slave) as two:
        two.setupExperiment()
        two.enterInitializationMode()
        two.exitInitializationMode()
        two.setReal(places("payload.inertia"), larger.ravel())
        assert two.getReal(places("payload.inertia")) == list(larger.ravel())
        with pytest.raises(FMICallException):
            two.setReal([*places("payload.mass"), *places("payload.inertia")], [5.0, *np.diag([1.0, 1.0, 3.0]).ravel()])
        assert two.getReal(places("payload.inertia")) == list(larger.ravel())
        assert two.getReal(places("payload.mass")) == [10.0]


def test_the_quaternion_of_model_exchange_returns_to_unit_length(fmu_path: Path) -> None:
    with opened(fmu_path, FMU3Model) as fmu:
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        rate = product(
            fmu, "fmi3GetDirectionalDerivative", ["der(state.quaternion)"], ["state.quaternion"], np.array([1.0, 0, 0, 0])
        )
        np.testing.assert_allclose(rate, [-10.0, 0.0, 0.0, 0.0], atol=1e-12)


# ---- trying an FMU ----


@pytest.mark.slow
def test_an_fmu_that_does_not_keep_its_promises_is_found_out(foreign_fmu: Path, fmu_path: Path, tmp_path: Path) -> None:
    """A foreign one has no derivatives to try; one whose binary is of another build cannot be tried."""
    found = {check.name: check.problems for check in check_fmu(foreign_fmu)}
    assert found["10 steps with finite outputs"] == ()
    assert found["derivatives agree with differences"] is None and found["a saved state goes on the same"] == ()
    path = tmp_path / "stale.fmu"
    with zipfile.ZipFile(fmu_path) as archive, zipfile.ZipFile(path, "w") as changed:
        for name in archive.namelist():
            content = archive.read(name)
            changed.writestr(name, content.replace(b'instantiationToken="{', b'instantiationToken="{0'))
    for check in check_fmu(path)[1:]:
        assert check.problems and "the instantiationToken is not that of modelDescription.xml" in check.problems[0]
