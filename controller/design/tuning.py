"""Design of the PID gains from the linearised loop: plant, filters, kinematics and one controller per actuator.

CasADi linearises the plant at home, at rest under its load. Coulomb friction does not change sign there: this is a moving leg,
the less damped case. The estimator is linearised from the compiled cycle itself, with settled covariances. python-control makes
the plant discrete and finds the margins of one actuator's loop with the other five closed.

The rule: an integral time of 0.3 s, and the largest proportional gain at which the multivariable sensitivity peak stays
at 2 with 65 deg of phase margin and 12 dB of gain margin.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import control
import numpy as np

from controller.cycle import MARKS, STATE, CycleStage, cycle_parameters, run_stages
from controller.inverse_kinematics import leg_lengths
from controller.loop_margins import SENSITIVITY_LIMIT
from controller.settings import ControlSettings, control_settings, fusion_settings
from plant.checks import check_rate
from plant.compiled import Record
from plant.dynamics.spatial import build_dynamics
from plant.dynamics.variables import SPATIAL, VELOCITY
from plant.errors import SingularConfigurationError
from plant.imu import ACCELEROMETER, GYROSCOPE
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array

STATES, INPUTS = SPATIAL.states, SPATIAL.inputs

INTEGRAL_TIME_S = 0.3
PHASE_MARGIN_DEG, GAIN_MARGIN_DB = 65.0, 12.0
_SETTLE_S = 10.0
_SMALL_STEP = 1e-3
_SIGNALS = 2 * 7 * 3
_ESTIMATOR_STATE = (("legs", "x"), ("platform", "x"), ("pose", "smooth_twist"), ("pose", "acceleration"))


@dataclass(frozen=True)
class Margins:
    """Stability of the loop of one actuator with the others closed, for the worst actuator, and of all six together."""

    gain_db: float
    phase_deg: float
    crossover_hz: float  # highest frequency at which the loop gain falls below one
    sensitivity_peak: float  # greatest singular value of the sensitivity over frequency, all loops closed
    stable: bool  # whether all poles lie inside the unit circle

    @property
    def sound(self) -> bool:
        """Whether the design rule holds."""
        return (
            self.stable
            and self.sensitivity_peak <= SENSITIVITY_LIMIT
            and self.phase_deg >= PHASE_MARGIN_DEG
            and self.gain_db >= GAIN_MARGIN_DB
        )


@dataclass(frozen=True)
class Design:
    """Designed gains and their margins, beside the preset's gains and margins."""

    rate: float
    gains: ControlSettings
    margins: Margins
    preset: ControlSettings
    preset_margins: Margins

    def summary(self) -> dict[str, Any]:
        """Everything, for JSON."""
        figures = asdict(self)
        for found in (figures["margins"], figures["preset_margins"]):
            found["gain_db"] = found["gain_db"] if np.isfinite(found["gain_db"]) else None
        return figures

    def rows(self) -> list[tuple[str, str, str]]:
        """Label, value and unit of each figure."""
        rows = []
        for name, gains, margins in (("designed", self.gains, self.margins), ("preset", self.preset, self.preset_margins)):
            rows += [
                (f"{name}: proportional", f"{gains.proportional:.1f}", "1/s"),
                (f"{name}: integral", f"{gains.integral:.1f}", "1/s2"),
                (f"{name}: derivative", f"{gains.derivative:g}", "-"),
                (f"{name}: gain margin", f"{margins.gain_db:.1f}", "dB"),
                (f"{name}: phase margin", f"{margins.phase_deg:.1f}", "deg"),
                (f"{name}: crossover", f"{margins.crossover_hz:.2f}", "Hz"),
                (f"{name}: sensitivity peak, all loops", f"{margins.sensitivity_peak:.2f}", "-"),
            ]
        return rows


class Linear(NamedTuple):
    """A discrete linear system x+ = A x + B u, y = C x + D u."""

    a: Array
    b: Array
    c: Array
    d: Array


def tune(mechanism: Mechanism, rate: float) -> Design:
    """Design the gains for cycles of 1 / `rate`.

    Raises:
        SingularConfigurationError: no gains have the required margins.
        InputError: the mechanism lacks data.
    """
    check_rate(rate)
    loop = open_loop(mechanism, rate)
    response = frequency_response(loop, rate)
    preset = control_settings(mechanism)

    def with_proportional(proportional: float) -> ControlSettings:
        return replace(preset, proportional=proportional, integral=proportional / INTEGRAL_TIME_S, derivative=0.0)

    # Small gains do not meet the rule either, because the integral time is fixed: search from above.
    steps = np.geomspace(0.5 * rate, 1.0, 40)
    sound = [margins(loop, response, with_proportional(float(step)), rate).sound for step in steps]
    if True not in sound:
        raise SingularConfigurationError(f"no gains have these margins at {rate:g} Hz: raise the rate")
    low, high = float(steps[sound.index(True)]), float(steps[max(sound.index(True) - 1, 0)])
    while high / low > 1.002:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if margins(loop, response, with_proportional(middle), rate).sound else (low, middle)
    gains = with_proportional(_rounded_down(low))
    gains = replace(gains, integral=_rounded_down(gains.integral))
    return Design(rate, gains, margins(loop, response, gains, rate), preset, margins(loop, response, preset, rate))


def _rounded_down(gain: float) -> float:
    """A gain as it is shown, and not above what was found: a greater one would break the rule."""
    return float(np.floor(10.0 * gain) / 10.0)


def open_loop(mechanism: Mechanism, rate: float) -> Linear:
    """From the six velocity commands [m/s] to the six estimated lengths [m], plant and estimator in series."""
    plant, signals = linear_plant(mechanism, rate)
    estimator = linear_estimator(mechanism, rate, signals)
    return Linear(
        a=np.block([[plant.a, np.zeros((len(plant.a), len(estimator.a)))], [estimator.b @ plant.c, estimator.a]]),
        b=np.vstack([plant.b, np.zeros((len(estimator.a), LEGS))]),
        c=np.hstack([estimator.d @ plant.c, estimator.c]),
        d=np.zeros((LEGS, LEGS)),
    )


def linear_plant(mechanism: Mechanism, rate: float) -> tuple[Linear, Array]:
    """The plant at home under its load, from velocity commands to ideal IMU signals (42,), and the signals at home.

    The signals are the angular velocities of the seven IMUs, then their specific forces. The attitude's state is a rotation
    vector. Legs count as perfect, and the base as at rest.
    """
    values = mechanism.plant_parameters()
    friction = {"friction.coulomb": np.zeros(LEGS)}
    flat = np.concatenate([np.ravel((values | friction)[variable.name]) for variable in SPATIAL.parameters])
    dynamics = build_dynamics()
    constants = dynamics.constants(flat)
    x, u = (np.zeros(sum(variable.size for variable in variables)) for variables in (STATES, INPUTS))
    x[:7] = *values["initial_position"], *values["initial_quaternion"]
    u[_slice(INPUTS, "drive_mode")] = VELOCITY
    _balance(dynamics.ideal_rates, x, u, constants)

    states, inputs = ca.SX.sym("x", len(x)), ca.SX.sym("u", len(u))
    rates = dynamics.ideal_rates(states, inputs, constants)
    signals = dynamics.ideal_outputs(states, inputs, constants)[:_SIGNALS]
    a, b, c = (
        np.array(ca.Function("jacobian", [states, inputs], [ca.jacobian(of, by)])(x, u))
        for of, by in ((rates, states), (rates, inputs), (signals, states))
    )
    reduce = _reduction(values["initial_quaternion"])
    expand = np.linalg.pinv(reduce)
    continuous = control.ss(
        reduce @ a @ expand, reduce @ b[:, _slice(INPUTS, "velocity_command")], c @ expand, np.zeros((_SIGNALS, LEGS))
    )
    discrete = control.sample_system(continuous, 1.0 / rate, method="zoh")
    at_rest = np.array(dynamics.ideal_outputs(x, u, constants)[:_SIGNALS]).ravel()
    return Linear(discrete.A, discrete.B, discrete.C, discrete.D), at_rest


def _slice(variables: Any, name: str) -> slice:
    at = 0
    for variable in variables:
        if variable.name == name:
            return slice(at, at + variable.size)
        at += variable.size
    raise KeyError(name)


def _balance(rates: Any, x: Array, u: Array, constants: Any) -> None:
    """Set the currents in x, then the commands in u, so that nothing accelerates; both enter linearly below saturation."""
    current, command = _slice(STATES, "state.current"), _slice(INPUTS, "velocity_command")
    acceleration = slice(_slice(STATES, "state.velocity").start, _slice(STATES, "state.angular_velocity").stop)
    for vector, sought, rows in ((x, current, acceleration), (u, command, current)):
        base, columns = np.array(rates(x, u, constants)).ravel()[rows], []
        for k in range(sought.start, sought.stop):
            vector[k] += _SMALL_STEP
            columns.append((np.array(rates(x, u, constants)).ravel()[rows] - base) / _SMALL_STEP)
            vector[k] -= _SMALL_STEP
        vector[sought] = -np.linalg.solve(np.stack(columns, axis=1), base)


def _reduction(quaternion: Array) -> Array:
    """The map (18, n) from the plant's states, without the brakes' deflections, to states with a rotation vector in {1}."""
    w, x, y, z = quaternion
    from_rotation = 0.5 * np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])
    identity, attitude = np.eye(sum(variable.size for variable in STATES)), _slice(STATES, "state.quaternion")
    before, after = identity[: attitude.start], identity[attitude.stop : _slice(STATES, "state.brake_deflection").start]
    return np.concatenate([before, after, np.linalg.pinv(from_rotation) @ identity[attitude]])


def linear_estimator(mechanism: Mechanism, rate: float, signals: Array) -> Linear:
    """The estimator, from IMU signals (42,) to the six lengths [m], with settled covariances."""
    parameters = cycle_parameters(mechanism, rate, control_settings(mechanism), fusion_settings(mechanism))
    measurement, no_reference, marks = np.zeros((3, 7, 3)), np.zeros((LEGS, 1, 5)), np.zeros((), MARKS)[()]
    settled: Record = np.zeros((), STATE)

    def step(state: Record, sample: Array) -> None:
        measurement[GYROSCOPE], measurement[ACCELEROMETER] = sample.reshape(2, 7, 3)
        run_stages(parameters, state, measurement, no_reference, marks, CycleStage.SCREENING.value, CycleStage.CONTROL.value)
        state["time"]["cycle"] += 1

    def flat(state: Record) -> Array:
        return np.concatenate([np.ravel(state[stage][name]) for stage, name in _ESTIMATOR_STATE])

    for _ in range(round(_SETTLE_S * rate)):
        step(settled, signals)
    size = len(flat(settled))

    def response(change: Array) -> Array:
        """State and lengths after a step, by changes of the state and of the signals."""
        state, at = settled.copy(), 0
        for stage, name in _ESTIMATOR_STATE:
            part = state[stage][name]
            part += change[at : at + part.size].reshape(part.shape)
            at += part.size
        step(state, signals + change[size:])
        return np.concatenate([flat(state), leg_lengths(mechanism, state["pose"]["position"], state["pose"]["rotation"])])

    steps = 1e-6 * np.eye(size + _SIGNALS)
    slopes = np.stack([(response(change) - response(-change)) / 2e-6 for change in steps], axis=1)
    return Linear(slopes[:size, :size], slopes[:size, size:], slopes[size:, :size], slopes[size:, size:])


def frequency_response(loop: Linear, rate: float) -> tuple[Array, Any]:
    """Frequencies (F,) [Hz] up to half the rate, and the response (F, 6, 6) of a discrete system there."""
    frequencies = np.geomspace(0.05, 0.499 * rate, 800)
    identity = np.eye(len(loop.a))
    response = [loop.c @ np.linalg.solve(z * identity - loop.a, loop.b) for z in np.exp(2j * np.pi * frequencies / rate)]
    return frequencies, np.array(response)


def margins(loop: Linear, response: tuple[Array, Any], gains: ControlSettings, rate: float) -> Margins:
    """Margins of the loop closed by six PID controllers, without the low-pass of their derivative.

    `loop` leads from commands to estimated lengths, `response` is its `frequency_response`, `rate` is in cycles per second.
    """
    n, period = len(loop.a), 1.0 / rate
    # Two further states per actuator close the loop: the integral of the error, and the previous error.
    a = np.block(
        [
            [loop.a, np.zeros((n, 2 * LEGS))],
            [period * loop.c, np.eye(LEGS), np.zeros((LEGS, LEGS))],
            [loop.c, np.zeros((LEGS, 2 * LEGS))],
        ]
    )
    b = np.vstack([loop.b, np.zeros((2 * LEGS, LEGS))])
    slope = gains.derivative * rate
    c = np.hstack([(gains.proportional + slope) * loop.c, gains.integral * np.eye(LEGS), -slope * np.eye(LEGS)])
    # The unobserved bias of a gyroscope neither decays nor matters: its pole stays at one.
    stable = bool(np.abs(np.linalg.eigvals(a - b @ c)).max() < 1.0 + 1e-6)

    frequencies, plant = response
    z = np.exp(2j * np.pi * frequencies / rate)
    controller = gains.proportional + gains.integral * period / (z - 1.0) + slope * (1.0 - 1.0 / z)
    sensitivity = np.linalg.inv(np.eye(LEGS) + controller[:, None, None] * plant)
    # With the other five closed, 1 + L of an actuator is the inverse of its own sensitivity.
    singles = (control.FRD(1.0 / sensitivity[:, k, k] - 1.0, 2.0 * np.pi * frequencies) for k in range(LEGS))
    gain_margins, phase_margins, _, _, crossovers, _ = zip(*map(control.stability_margins, singles), strict=True)
    return Margins(
        gain_db=float(20.0 * np.log10(min(gain_margins))),
        phase_deg=float(min(phase_margins)),
        crossover_hz=float(max(crossovers) / (2.0 * np.pi)),
        sensitivity_peak=float(np.linalg.norm(sensitivity, 2, axis=(1, 2)).max()),
        stable=stable,
    )
