"""The loop as a linear system at any pose: from the velocity commands to the estimated lengths, in cycles of a rate.

CasADi linearises the plant at rest under its load. Coulomb friction does not change sign there: this is a moving leg, the less
damped case. The estimator is linearised from the compiled cycle itself, with covariances that have settled at the pose.
python-control makes the plant discrete and joins the parts:

    delay of the bus -> drives -> mechanism -> low-passes of the IMUs -> filters, direct and inverse kinematics
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import control
import numpy as np

from controller.cycle import MARKS, STATE, CycleStage, cycle_parameters, run_stages
from controller.inverse_kinematics import legs_at
from controller.load_feed_forward import find_feed_forward
from controller.settings import control_settings, fusion_settings, sensor_settings
from plant.checks import check_rate
from plant.compiled import Record
from plant.dynamics import planar, spatial
from plant.dynamics.variables import PLANAR, SPATIAL, VELOCITY, Variable
from plant.errors import InputError
from plant.imu import ACCELEROMETER, GYROSCOPE, ImuModel, SensorErrors
from plant.imu_wiring import IMU_COUNT, PLATFORM_IMU
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose

SETTLED_S = 10.0
"""How long filters have stood at a pose when they count as settled [s]."""

MOST_DELAY_PERIODS = 32
"""The longest delay of the bus, in periods."""

_LONGEST_STEP_S = 1e-3
_SMALL_STEP, _CHANGE = 1e-3, 1e-6
_SIGNALS = 2 * IMU_COUNT * 3
_STEPPED = ("time", "imus", "legs", "platform", "heading", "pose")
_ESTIMATOR_STATE = (("legs", "x"), ("platform", "x"), ("pose", "smooth_twist"), ("pose", "unplanned"))


@dataclass(frozen=True, eq=False)
class Setup:
    """What a loop runs with.

    Attributes:
        rate: cycles per second [Hz].
        delay: from the sample to when the drives take the command computed from it [s].
        imu: whose low-passes and delay the loop has; None for ideal ones.
        bandwidth: of the position loop that each drive closes [1/s]; None if drives follow velocities.

    Raises:
        InputError: a rate or a delay out of range.
    """

    rate: float
    delay: float = 0.0
    imu: ImuModel | None = None
    bandwidth: float | None = None

    def __post_init__(self) -> None:
        check_rate(self.rate)
        longest = MOST_DELAY_PERIODS / self.rate
        if not 0.0 <= self.delay <= longest:
            raise InputError(
                f"the delay is {1e3 * self.delay:g} ms; at {self.rate:g} Hz it must be 0 to {1e3 * longest:g} ms, which is "
                f"{MOST_DELAY_PERIODS} periods"
            )

    @property
    def period(self) -> float:
        """[s]."""
        return 1.0 / self.rate


def open_loop(
    mechanism: Mechanism, setup: Setup, pose: Pose | None = None, settled: float = SETTLED_S
) -> control.StateSpace:  # fmt: skip
    """From the n velocity commands [m/s] to the n estimated lengths [m] at a pose, by default home, when the filters have stood
    there for so long [s]: the gains with which they take the accelerometers fall for many seconds.

    The feed-forward of the load, which follows the estimated pose, is within.

    Raises:
        InputError: the mechanism lacks data.
    """
    pose = pose or mechanism.require_home()
    plant, at_rest = linear_plant(mechanism, setup, pose)
    readings = _low_passes(setup.imu, setup.period) * plant if setup.imu is not None else plant
    whole, n = linear_estimator(mechanism, setup, at_rest, settled) * readings, mechanism.legs
    # Commands act on the readings of later cycles alone.
    return control.ss(whole.A + whole.B @ whole.C[n:], whole.B, whole.C[:n], np.zeros((n, n)), setup.period)


def linear_plant(mechanism: Mechanism, setup: Setup, pose: Pose) -> tuple[control.StateSpace, Array]:
    """Drives and mechanism under their load, from velocity commands to ideal IMU signals (42,), and the signals at rest.

    The signals are the angular velocities of the seven IMUs, then their specific forces. Legs count as perfect, and the base as
    at rest.
    """
    steps = 1 if setup.bandwidth is None else int(np.ceil(setup.period / _LONGEST_STEP_S - 1e-9))
    continuous, at_rest = _continuous_plant(mechanism, pose)
    discrete = control.sample_system(continuous, setup.period / steps, method="zoh")
    n, delay = mechanism.legs, np.full(mechanism.legs, setup.delay)
    a, b, c = discrete.A, discrete.B, discrete.C
    if setup.bandwidth is not None:
        a, b, c = _with_position_loops(a, b, c, setup.bandwidth, setup.period / steps, n)
        whole = np.linalg.matrix_power(a, steps)
        a, b = whole, sum(np.linalg.matrix_power(a, k) @ b for k in range(steps))
    driven = control.ss(a, b, c[:_SIGNALS], np.zeros((_SIGNALS, n)), setup.period)
    return (driven * _delayed(delay, setup.period) if delay.any() else driven), at_rest


class _Equations(NamedTuple):
    """A plant's equations as functions of flat states, inputs and constants."""

    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    constants: ca.Function
    rates: ca.Function
    signals: ca.Function
    slopes: ca.Function  # of the rates by states and commands, and of the signals and lengths by states


@lru_cache(maxsize=2)
def _equations(of_plane: bool) -> _Equations:
    table, dynamics = (PLANAR, planar.build_dynamics()) if of_plane else (SPATIAL, spatial.build_dynamics())
    x, u = (ca.SX.sym(name, sum(each.size for each in side)) for name, side in (("x", table.states), ("u", table.inputs)))
    c = ca.SX.sym("c", dynamics.constants.size1_out(0))
    rates, outputs = dynamics.ideal_rates(x, u, c), dynamics.ideal_outputs(x, u, c)
    read = ("imu_angular_velocity", "imu_specific_force", "leg_length")
    signals = ca.vertcat(*(outputs[_slice(table.outputs, name)] for name in read))
    commands = _slice(table.inputs, "velocity_command")
    by = [ca.jacobian(rates, x), ca.jacobian(rates, u)[:, commands], ca.jacobian(signals, x)]
    return _Equations(
        table.states, table.inputs, table.parameters, table.outputs, dynamics.constants, dynamics.ideal_rates,
        ca.Function("signals", [x, u, c], [signals]), ca.Function("slopes", [x, u, c], by, {"cse": True}),
    )  # fmt: skip


def _continuous_plant(mechanism: Mechanism, pose: Pose) -> tuple[control.StateSpace, Array]:
    """From commands to signals (42,) and lengths (n,); the attitude's state is a rotation vector."""
    equations, n = _equations(mechanism.planar), mechanism.legs
    values: dict[str, Any] = mechanism.plant_parameters(pose) | {"friction.coulomb": np.zeros(n)}
    constants = equations.constants(np.concatenate([np.ravel(values[each.name]) for each in equations.parameters]))
    x, u = (np.zeros(sum(each.size for each in side)) for side in (equations.states, equations.inputs))
    for name in ("position", "angle") if mechanism.planar else ("position", "quaternion"):
        x[_slice(equations.states, f"state.{name}")] = values[f"initial_{name}"]
    u[_slice(equations.inputs, "drive_mode")] = VELOCITY
    _balance(equations, x, u, constants)
    a, b, c = (np.array(each) for each in equations.slopes(x, u, constants))
    reduce = _reduction(equations, x)
    expand = np.linalg.pinv(reduce)
    a, b, c = reduce @ a @ expand, reduce @ b, c @ expand
    count = len(c) - n
    place = _places(count // 6)
    at_rest = np.array(equations.signals(x, u, constants)).ravel()[:count]
    outputs = np.vstack([place @ c[:count], c[count:]])
    return control.ss(a, b, outputs, np.zeros((len(outputs), n))), place @ at_rest


def _places(imus: int) -> Array:
    """The map (42, 6 imus) from the signals of a plant's IMUs, the platform's last, to those of seven IMUs."""
    there = np.zeros((IMU_COUNT, imus))
    there[[*range(imus - 1), PLATFORM_IMU], range(imus)] = 1.0
    return np.kron(np.eye(2), np.kron(there, np.eye(3)))


def _slice(variables: tuple[Variable, ...], name: str) -> slice:
    at = 0
    for variable in variables:
        if variable.name == name:
            return slice(at, at + variable.size)
        at += variable.size
    raise KeyError(name)


def _balance(equations: _Equations, x: Array, u: Array, constants: Any) -> None:
    """Set the currents in x, then the commands in u, so that nothing accelerates; both enter linearly below saturation."""
    current, command = _slice(equations.states, "state.current"), _slice(equations.inputs, "velocity_command")
    twist = slice(
        _slice(equations.states, "state.velocity").start, _slice(equations.states, "state.angular_velocity").stop
    )  # fmt: skip
    for vector, sought, rows in ((x, current, twist), (u, command, current)):
        base, columns = np.array(equations.rates(x, u, constants)).ravel()[rows], []
        for k in range(sought.start, sought.stop):
            vector[k] += _SMALL_STEP
            columns.append((np.array(equations.rates(x, u, constants)).ravel()[rows] - base) / _SMALL_STEP)
            vector[k] -= _SMALL_STEP
        vector[sought] = -np.linalg.solve(np.stack(columns, axis=1), base)


def _reduction(equations: _Equations, x: Array) -> Array:
    """The map from the plant's states to those without brakes and imperfections, and with a rotation vector in {1}."""
    identity = np.eye(len(x))[: _slice(equations.states, "state.brake_deflection").start]
    if all(each.name != "state.quaternion" for each in equations.states):
        return identity
    attitude = _slice(equations.states, "state.quaternion")
    w, x, y, z = x[attitude]
    from_rotation = 0.5 * np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])
    return np.concatenate(
        [identity[: attitude.start], identity[attitude.stop :], np.linalg.pinv(from_rotation) @ identity[attitude]]
    )


def _with_position_loops(
    a: Array, b: Array, c: Array, bandwidth: float, step: float, n: int
) -> tuple[Array, Array, Array]:  # fmt: skip
    """The discrete plant (A, B, C), whose last n outputs are the lengths, with drives that close the position loops of
    `hil.rigs.position_loops`. Further states are the goals, and the integral parts of the velocities.
    """
    one, none, lengths = np.eye(n), np.zeros((n, n)), c[-n:]
    inner = len(a)
    whole = np.block(
        [
            [a - bandwidth * b @ lengths, bandwidth * b, b],
            [np.zeros((n, inner)), one, none],
            [-0.25 * bandwidth**2 * step * lengths, 0.25 * bandwidth**2 * step * one, one],
        ]
    )
    return whole, np.vstack([b, step * one, none]), np.hstack([c, np.zeros((len(c), 2 * n))])


def _delayed(delay: Array, period: float) -> control.StateSpace:
    """A delay of each of n signals [s]. What falls between two periods is shared between them."""
    lines = []
    for periods in delay / period:
        whole = int(periods + 1e-9)
        part = max(periods - whole, 0.0)
        taps = np.zeros(whole + 2)
        taps[whole], taps[whole + 1] = 1.0 - part, part
        length = max(int(np.flatnonzero(taps).max()), 1)
        lines.append(control.ss(np.eye(length, k=-1), np.eye(length, 1), taps[None, 1 : length + 1], taps[:1, None], period))
    return control.append(*lines)


def _low_passes(imu: ImuModel, period: float) -> control.StateSpace:
    """From ideal signals (42,) to readings of a kind of IMU: its low-passes and its delay."""
    wait = imu.delay + (0.5 / imu.sample_rate if imu.sample_rate else 0.0)
    sensors = [_low_pass(sensor, wait, period) for sensor in (imu.gyroscope, imu.accelerometer)]
    parts = []
    for sensor in sensors:
        one = np.eye(_SIGNALS // 2)
        parts.append(control.ss(*(np.kron(one, each) for each in (sensor.A, sensor.B, sensor.C, sensor.D)), period))
    return control.append(*parts)


def _low_pass(sensor: SensorErrors, wait: float, period: float) -> control.StateSpace:
    whole = control.ss([], [], [], [[1.0]], period)
    if np.isfinite(sensor.bandwidth):
        corner = 2.0 * np.pi * sensor.section_bandwidth
        section = control.sample_system(control.ss([[-corner]], [[corner]], [[1.0]], [[0.0]]), period, method="foh")
        for _ in range(sensor.order):
            whole = section * whole
    return whole * _delayed(np.array([wait]), period) if wait > 0.0 else whole


def linear_estimator(
    mechanism: Mechanism, setup: Setup, signals: Array, settled: float = SETTLED_S
) -> control.StateSpace:  # fmt: skip
    """The estimator, from IMU signals (42,) to the n lengths [m] and the feed-forward of the load for each [m/s], with
    covariances after such signals for so long [s].
    """
    fusion = fusion_settings(mechanism) if setup.imu is None else sensor_settings(mechanism, setup.imu, setup.rate)
    parameters = cycle_parameters(
        mechanism, setup.rate, control_settings(mechanism), fusion, position_drives=setup.bandwidth is not None
    )
    rig, load = parameters["rig"][()], parameters["load"][()]
    up, gravity = tuple(rig["vectors_in_base"][0].tolist()), float(rig["sensors"]["gravity"])
    measurement, no_reference, marks = np.zeros((3, IMU_COUNT, 3)), np.zeros((LEGS, 1, 5)), np.zeros((), MARKS)[()]
    standing: Record = np.zeros((), STATE)

    first, last = CycleStage.SCREENING.value, CycleStage.MECHANISM.value

    def step(state: Record, sample: Array, cycles: int = 1) -> None:
        measurement[GYROSCOPE], measurement[ACCELEROMETER] = sample.reshape(2, IMU_COUNT, 3)
        for _ in range(cycles):
            run_stages(parameters, state, measurement, no_reference, marks, first, last)
            state["time"]["cycle"] += 1

    def part(state: Record, stage: str, name: str) -> Any:
        return state[stage][name][: mechanism.legs] if stage == "legs" else state[stage][name]

    def flat(state: Record) -> Array:
        return np.concatenate([np.ravel(part(state, *each)) for each in _ESTIMATOR_STATE])

    step(standing, signals, round(settled * setup.rate))
    state, size = standing.copy(), len(flat(standing))

    def response(change: Array) -> Array:
        """State and lengths after a step, by changes of the state and of the signals."""
        for stage in _STEPPED:
            state[stage] = standing[stage]
        at = 0
        for each in _ESTIMATOR_STATE:
            values = part(state, *each)
            values += change[at : at + values.size].reshape(values.shape)
            at += values.size
        step(state, signals + change[size:])
        pose, ahead = state["pose"][()], state["load"][()]
        legs_at(
            rig["geometry"]["base_joints"], rig["geometry"]["platform_joints"], pose["position"], pose["rotation"],
            pose["arms"], pose["directions"], pose["lengths"],
        )  # fmt: skip
        find_feed_forward(load, ahead, rig, pose, state["reference"][()], up, gravity)
        return np.concatenate([flat(state), pose["lengths"][: mechanism.legs], ahead["feed_forward"][: mechanism.legs]])

    changes = _CHANGE * np.eye(size + _SIGNALS)
    slopes = np.stack([(response(change) - response(-change)) / (2.0 * _CHANGE) for change in changes], axis=1)
    return control.ss(slopes[:size, :size], slopes[:size, size:], slopes[size:, :size], slopes[size:, size:], setup.period)
