"""The actuators of a machine from the commands that it was given and what its IMUs, or its encoders too, have read.

The plant predicts all readings from the commands; its actuators, the delay of the commands and the pose at the start are fitted
to those that were measured, by maximum likelihood (Gauss-Newton steps, over longer and longer parts of the motion). Three
things make the intervals honest:

- Each sensor may have an offset, and a gain that is not quite one, within what is known of it (`Doubts`): they are estimated
  beside the actuators.
- What remains is correlated from sample to sample, by low-passes and by what the model lacks. An autoregression is fitted to
  it, reading by reading, and takes the correlation out of residuals and slopes alike (generalized least squares).
- What remains may be correlated between sensors too. So the covariance is also estimated from how much the scores of successive
  blocks of time scatter (the "sandwich" of Huber and White), and of both standard deviations the larger one counts.

Names are those of the mechanism's file. The delay has none there: it belongs to the bus.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import interp1d
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter
from scipy.stats import norm

from controller.design.predicted_readings import Commands, Prediction, Readings
from plant.checks import nearest
from plant.errors import CalibrationError, InputError, UnknownNameError
from plant.imu import MILLI_G, ImuModel
from plant.imu_wiring import IMU_COUNT
from plant.mechanism import LEGS, Mechanism
from plant.mechanism.loads import force_constant, home_loads, moving_axes
from plant.pose import Array, Pose, rotation_from_vector

DELAY = "delay"
"""The name of the delay among the parameters [s]."""

QUANTILE = float(norm.ppf(0.975))
"""Half the width of a 95 % interval, in standard deviations."""

MOST_WIDTH = 0.1
"""A parameter is known if its interval reaches no further to either side than this share of it."""

_TOGETHER = 0.8
"""Two parameters go together if their correlation is at least this."""


class Parameter(NamedTuple):
    """A parameter that can be fitted: how much of it a slope is taken over, and the remedy if it cannot be told."""

    step: float  # relative
    remedy: str


_QUICKER = "a higher limit of jerk, or a longer --duration, with quicker lines of the multisine (a higher --rate)"
_LONGER = "a longer --duration, or encoders (--lengths)"

PARAMETERS = {
    "drive.gain": Parameter(0.002, _LONGER),
    "motor.resistance": Parameter(0.01, _LONGER),
    "friction.coulomb": Parameter(0.02, _LONGER),
    "friction.viscous": Parameter(0.05, "taking it from a data sheet: at these speeds it does the same as drive.gain"),
    "motor.inductance": Parameter(0.05, _QUICKER),
    "motor.rotor_inertia": Parameter(0.02, _QUICKER),
    "payload.mass": Parameter(0.02, "weighing it, or taking motor.rotor_inertia from a data sheet"),
    DELAY: Parameter(0.05, _QUICKER),
}
"""All parameters that can be fitted; of the delay, `step` is a share of the period."""

USUAL = ("drive.gain", "motor.resistance", "friction.coulomb", "motor.inductance", "motor.rotor_inertia", DELAY)
"""Those that the IMUs can tell apart: gain, droop, friction and lags of the actuators, and the delay."""


@dataclass(frozen=True)
class Doubts:
    """What is not known of the sensors and of the start, as standard deviations."""

    rate: float = np.radians(0.2)  # offset of a gyroscope [rad/s]
    force: float = 2.0 * MILLI_G  # offset of an accelerometer [m/s^2]
    length: float = 1.0  # offset of an encoder, whose zero may be anywhere [m]
    gain: float = 5e-4  # of an axis of a sensor to any other, and to itself
    position: float = 0.01  # start [m]
    rotation: float = np.radians(2.0)  # [rad]

    @classmethod
    def of(cls, imu: ImuModel) -> "Doubts":
        """What is not known of a kind of IMU whose calibration, if it has one, counts as part of it."""
        rate, force = (max(sensor.bias) for sensor in (imu.gyroscope, imu.accelerometer))
        gains = [max(sensor.scale, sensor.cross_axis) for sensor in (imu.gyroscope, imu.accelerometer)]
        known = cls()
        return replace(
            known, rate=max(known.rate, rate), force=max(known.force, force), gain=max(known.gain, *gains, imu.misalignment)
        )


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured along commands.

    Attributes:
        commands: (N), from where the platform rests at its home on, with the drives enabled.
        readings: (N), calibrated; NaN where a sensor has none.
        fresh: (N, 7), whether each IMU's sample was new.
        ages: (N, 7) [s], of these samples at the time of the exchange; not negative.
        period: of the loop [s].
        rest: (2, 7, 3), standard deviations of the IMUs' readings while the brakes held; NaN if they are not known.
    """

    commands: Commands
    readings: Readings
    fresh: NDArray[np.bool_]
    ages: Array
    period: float
    rest: Array = field(default_factory=lambda: np.full((2, IMU_COUNT, 3), np.nan))


@dataclass(frozen=True)
class Value:
    """A fitted value with its standard deviation, in the unit of the mechanism's file, the delay in s."""

    name: str
    leg: int | None  # None: of all legs
    value: float
    sigma: float

    @property
    def label(self) -> str:
        """The name, with the leg."""
        return self.name if self.leg is None else f"{self.name}, leg {self.leg}"

    @property
    def half(self) -> float:
        """Half the width of the 95 % interval."""
        return QUANTILE * self.sigma

    @property
    def width(self) -> float:
        """That as a share of the value."""
        return self.half / abs(self.value) if self.value else inf

    def holds(self, value: float) -> bool:
        """Whether the interval holds a value."""
        return abs(value - self.value) <= self.half


@dataclass(frozen=True, eq=False)
class Identified:
    """The actuators of a machine.

    Attributes:
        values: the fitted parameters in the order of `covariance` (P, P).
        figures: what follows from them, which an actuator is known by: droop of each leg [m/s/N], and its lag at home [s].
        unexplained: RMS over sensors of the residual over the noise at rest; NaN if that is not known.
        residual: RMS of what remains, of gyroscopes [rad/s] and accelerometers [m/s^2].
        remarks: what cannot be told, a line each, with the remedy.
        predicted: the readings of the fitted model, for a plot.
    """

    mechanism: Mechanism
    values: tuple[Value, ...]
    covariance: Array
    figures: tuple[Value, ...]
    unexplained: float
    residual: tuple[float, float]
    duration: float
    period: float
    remarks: tuple[str, ...]
    predicted: Readings

    def parameters(self) -> dict[str, Any]:
        """The values by their names in the mechanism's file, an array (n,) for those of each leg, without the delay."""
        found: dict[str, Any] = {}
        for each in self.values:
            if each.leg is None:
                found[each.name] = each.value
            else:
                found.setdefault(each.name, []).append(each.value)
        found.pop(DELAY, None)
        return found

    @property
    def delay(self) -> float | None:
        """The delay [s]; None if it was not fitted."""
        return next((each.value for each in self.values if each.name == DELAY), None)

    def summary(self) -> dict[str, Any]:
        """Everything, in SI units."""

        def plain(each: Value) -> dict[str, Any]:
            low, high = each.value - each.half, each.value + each.half
            return {"name": each.name, "leg": each.leg, "value": each.value, "sigma": each.sigma, "interval": [low, high]}

        return {
            "parameters": [plain(each) for each in self.values],
            "figures": [plain(each) for each in self.figures],
            "covariance": self.covariance.tolist(),
            "unexplained": self.unexplained if np.isfinite(self.unexplained) else None,
            "residual": {"rate": self.residual[0], "force": self.residual[1]},
            "duration": self.duration,
            "remarks": list(self.remarks),
        }


_HORIZONS_S = (2.0, 5.0)
"""A wrong droop lets the model drift away: the first fits are of the beginning of the motion [s]."""

_STEPS, _LAST_STEPS = 2, 12
"""Gauss-Newton steps on a part of the motion, and at most on the whole."""

_CLOSE = 0.1
"""A fit has converged when no step is larger than this share of a standard deviation."""

_DENSE_S = 2.5e-4
"""Between such times readings count as linear [s]."""

_SETTLED_S = 0.1
"""For which the model's drives take up the load at first [s]."""

_ORDER = 12
"""Of the autoregression of what remains."""

_BLOCKS = 40
"""Blocks of time, whose scores are compared."""

_AT_MOST = 2.0
"""Factor by which a positive parameter may change in a step."""

_LOOSE = 1.0
"""Standard deviation of what is not known of a parameter before, relative to the mechanism's file."""

_LEAST_SAMPLES = 200
_FLOORS = (1e-7, 1e-6, 1e-9)
"""Least noise of gyroscopes [rad/s], accelerometers [m/s^2] and encoders [m] that a residual may be thought to have."""

_POSE_STEP = 2e-4
"""Of the slopes by the pose at the start [m, rad]."""


def identify_actuators(
    mechanism: Mechanism, imu: ImuModel, measured: Measured, names: Sequence[str] = USUAL, doubts: Doubts | None = None
) -> Identified:
    """Fit the actuators of a mechanism.

    Args:
        mechanism: whose file has first values of what is fitted, and all else.
        imu: the kind of IMU, with its low-passes.
        measured: commands and readings.
        names: of `PARAMETERS`.
        doubts: what is not known of the sensors; by default what the kind of IMU tells.

    Raises:
        UnknownNameError: a name that cannot be fitted.
        InputError: no name, or one twice.
        CalibrationError: there are too few readings, or the fit does not converge.
    """
    check_parameters(names)
    with Prediction(mechanism, imu, measured.period) as prediction:
        fit = _Fit(prediction, measured, names, doubts or Doubts.of(imu))
        end = float(measured.commands.times[-1])
        for horizon in (each for each in _HORIZONS_S if each < 0.8 * end):
            fit.improve(horizon, _STEPS, whiten=False)
        fit.improve(end, _LAST_STEPS, whiten=True)
    return fit.result()


def check_parameters(names: Sequence[str]) -> None:
    """Check that parameters can be fitted; errors as for `identify_actuators`."""
    if not names or len({*names}) < len(names):
        raise InputError(f"the parameters to fit are {', '.join(names) or 'none'}: name each once, and one at least")
    for name in names:
        if name not in PARAMETERS:
            raise UnknownNameError(
                f"{name!r} cannot be fitted; there are {', '.join(PARAMETERS)}{nearest(name, PARAMETERS)}"
            )  # fmt: skip


class _Channel(NamedTuple):
    """One reading over time: which samples are new, and what is not known of its offset and gains."""

    kind: int  # 0 gyroscope, 1 accelerometer, 2 encoder
    sensor: int
    axis: int
    rows: NDArray[np.int64]
    offset: float


@dataclass(frozen=True, eq=False)
class _Equations:
    """The part of the normal equations that one channel gives, without its doubts: these are solved for beside the parameters.

    Attributes:
        rows: (n,), of the readings.
        taken: the filter that takes the correlation out of what remains.
        weight: inverse variance of what is new in each sample.
        slopes: (n', m), filtered, without what the doubts explain of them.
        doubts: (n', d), filtered.
        solve: (d, n'), from a filtered residual to the doubts.
        shared: (m, d), by which doubts that are not likely count against a step.
        information: (m, m).
    """

    channel: _Channel
    rows: NDArray[np.int64]
    taken: Array
    weight: float
    slopes: Array
    doubts: Array
    solve: Array
    shared: Array
    information: Array

    @classmethod
    def of(
        cls, channel: _Channel, rows: NDArray[np.int64], taken: Array, sigma: float, slopes: Array, doubts: Array, prior: Array
    ) -> "_Equations":
        """From slopes (n, m) and doubts (n, d), whose standard deviations are `prior` (d,)."""
        skipped, weight = len(taken) - 1, sigma**-2
        slopes, doubts = (lfilter(taken, 1.0, each, axis=0)[skipped:] for each in (slopes, doubts))
        solve = np.linalg.solve(doubts.T @ doubts + np.diag((sigma / prior) ** 2), doubts.T)
        by_slopes = solve @ slopes
        slopes = slopes - doubts @ by_slopes
        shared = by_slopes.T * prior**-2
        return cls(
            channel, rows, taken, weight, slopes, doubts, solve, shared, weight * slopes.T @ slopes + shared @ by_slopes
        )  # fmt: skip

    def gradient(self, residual: Array) -> Array:
        """The gradient (m,) of the likelihood."""
        filtered = lfilter(self.taken, 1.0, residual)[len(self.taken) - 1 :]
        found = self.solve @ filtered
        gradient: Array = self.weight * self.slopes.T @ (filtered - self.doubts @ found) + self.shared @ found
        return gradient

    def scores(self, residual: Array, bounds: NDArray[np.int64]) -> Array:
        """The parts (B, m) of the gradient that blocks of time give, whose ends are `bounds` (B + 1,) in the readings."""
        skipped = len(self.taken) - 1
        filtered = lfilter(self.taken, 1.0, residual)[skipped:]
        each = self.weight * self.slopes * (filtered - self.doubts @ (self.solve @ filtered))[:, None]
        sums = np.vstack([np.zeros(self.slopes.shape[1]), np.cumsum(each, axis=0)])
        ends = np.clip(np.searchsorted(self.rows, bounds) - skipped, 0, len(each))
        blocks: Array = np.diff(sums[ends], axis=0)
        return blocks


class _Fit:
    """The parameters, their first values and their present ones; those of the pose at the start come last."""

    def __init__(self, prediction: Prediction, measured: Measured, names: Sequence[str], doubts: Doubts) -> None:
        mechanism = prediction.mechanism
        self._mechanism, self._measured, self._doubts = mechanism, measured, doubts
        self._prediction, self._period = prediction, measured.period
        plant = mechanism.plant_parameters()
        compensated = float(plant["drive.compensation"] * plant["drive.nominal_resistance"])
        self._names: list[tuple[str, int | None]] = []
        first, floors, steps = [], [], []
        for name in names:
            given = np.array(0.0) if name == DELAY else np.asarray(plant[name], float)
            for leg, value in enumerate(np.ravel(given)):
                self._names.append((name, leg if given.ndim else None))
                floor = {DELAY: -inf, "motor.resistance": compensated}.get(name, 0.0)
                scale = self._period if name == DELAY else float(value) - floor
                if not scale > 0.0:
                    raise InputError(f"{name} is {value:g} in the mechanism's file: give a first value that is positive")
                first.append(float(value))
                floors.append(floor)
                steps.append((PARAMETERS[name].step * scale, scale))
        self._delay = next((i for i, (name, _) in enumerate(self._names) if name == DELAY), None)
        self._axes = moving_axes(mechanism)
        count = len(self._axes)
        self._first, self._floors = np.array([*first, *np.zeros(count)]), np.array([*floors, *np.full(count, -inf)])
        self._steps = np.array([*(step for step, _ in steps), *np.full(count, _POSE_STEP)])
        loose = [self._doubts.position if axis < 3 else self._doubts.rotation for axis in self._axes]
        self._prior = np.array([*(_LOOSE * scale for _, scale in steps), *loose])
        self._at, self._channels = self._first.copy(), self._found_channels()
        self._equations: list[_Equations] = []
        self._predicted = measured.readings

    def _found_channels(self) -> list[_Channel]:
        measured, channels = self._measured, []
        settled = self._measured.commands.times >= _SETTLED_S
        for kind, offset in enumerate((self._doubts.rate, self._doubts.force)):
            for sensor in range(IMU_COUNT):
                for axis in range(3):
                    values = measured.readings.imus[:, kind, sensor, axis]
                    rows = np.flatnonzero(settled & measured.fresh[:, sensor] & np.isfinite(values))
                    channels.append(_Channel(kind, sensor, axis, rows, offset))
        for leg in range(LEGS):
            rows = np.flatnonzero(settled & np.isfinite(measured.readings.lengths[:, leg]))
            channels.append(_Channel(2, leg, 0, rows, self._doubts.length))
        used = [each for each in channels if len(each.rows) >= _LEAST_SAMPLES]
        if not used:
            raise CalibrationError(
                f"no sensor has {_LEAST_SAMPLES} readings after the first {_SETTLED_S:g} s: take a longer --duration"
            )
        return used

    def _model(self, at: Array, commands: Commands) -> Readings:
        """The readings that the model has for parameters."""
        parameters: dict[str, Any] = {}
        delay = 0.0
        for (name, leg), value in zip(self._names, at, strict=False):
            if name == DELAY:
                delay = float(value)
            elif leg is None:
                parameters[name] = value
            else:
                parameters.setdefault(name, np.zeros(self._mechanism.legs))[leg] = value
        move = np.zeros(6)
        move[self._axes] = at[len(self._names) :]
        home = self._mechanism.require_home()
        start = Pose(home.position + move[:3], rotation_from_vector(move[3:]) @ home.rotation)
        if not self._measured.ages.any():
            return self._prediction.readings(commands, parameters, start, delay)
        # Each IMU has samples of times of its own, and a force follows each command within a period.
        times, ages = commands.times, self._measured.ages
        dense = np.linspace(times[0], times[-1], (len(times) - 1) * max(1, round(self._period / _DENSE_S)) + 1)
        found = self._prediction.readings(commands, parameters, start, delay, dense)
        imus = np.stack(
            [
                interp1d(dense, found.imus[:, :, k], axis=0)(np.maximum(times - ages[: len(times), k], times[0]))
                for k in range(IMU_COUNT)
            ],
            axis=2,
        )
        return Readings(imus, interp1d(dense, found.lengths, axis=0)(times))

    def improve(self, horizon: float, most: int, whiten: bool) -> None:
        """Take Gauss-Newton steps on the motion up to a time [s], with the slopes of the first; `most` of them.

        Raises:
            CalibrationError: `whiten` is asked for, and the steps do not become small.
        """
        commands = self._measured.commands.until(horizon)
        predicted = self._model(self._at, commands)
        slopes = self._slopes(commands, predicted)
        for number in range(most):
            # A first step on the whole motion tells what remains, and the second how it is correlated.
            if number == 0 or (number == 1 and whiten):
                self._equations = self._made_equations(predicted, slopes, whiten and number == 1)
            information = sum((each.information for each in self._equations), np.diag(self._prior**-2))
            gradient = sum(
                (each.gradient(self._residual(each, predicted)) for each in self._equations), np.zeros(len(self._at))
            )
            step = self._step(information, gradient - self._prior**-2 * (self._at - self._first))
            before, self._predicted = self._at, predicted
            improved = self._limited(before + step)
            size = float(np.abs((improved - before) / np.sqrt(np.diag(np.linalg.inv(information)))).max())
            if whiten and number > 0 and size < _CLOSE:
                return
            self._at = improved
            predicted = self._model(self._at, commands)
        if whiten:
            raise CalibrationError(
                f"the fit does not converge: its last step is {size:.2g} standard deviations. Either the machine is unlike "
                "its model (check masses, screw lead and torque constant in the mechanism's file), or what is fitted cannot be "
                "told apart: leave a parameter out with --fit"
            )

    def _step(self, information: Array, gradient: Array) -> Array:
        """The step to the optimum whose delay is not negative.

        The loop has put the noise of a reading into the command that it computed from it: a command that may act before its
        reading explains this noise, and biases the fit.
        """
        step: Array = np.linalg.solve(information, gradient)
        if self._delay is not None and self._at[self._delay] + step[self._delay] < 0.0:
            free = np.arange(len(step)) != self._delay
            step[self._delay] = -self._at[self._delay]
            step[free] = np.linalg.solve(
                information[np.ix_(free, free)], gradient[free] - information[free, self._delay] * step[self._delay]
            )
        return step

    def _limited(self, at: Array) -> Array:
        """Parameters that have changed by no more than a factor above their floors, and the delay by a period."""
        before = self._at - self._floors
        with np.errstate(invalid="ignore"):
            bounded = np.clip(at, self._floors + before / _AT_MOST, self._floors + before * _AT_MOST)
        limited: Array = np.where(np.isfinite(self._floors), bounded, at)
        if self._delay is not None:
            limited[self._delay] = min(at[self._delay], self._at[self._delay] + self._period)
        return limited

    def _slopes(self, commands: Commands, predicted: Readings) -> Sequence[Array]:
        """Slopes (n, m) of the readings of each channel by the parameters."""
        slopes = [np.empty((int(np.searchsorted(each.rows, len(commands.times))), len(self._at))) for each in self._channels]
        for i, step in enumerate(self._steps):
            moved, back = np.array([self._at, self._at])
            moved[i] += step
            # Where samples and commands come together, the slope by the delay is another one to either side.
            both = i == self._delay and self._at[i] > step
            back[i] -= step if both else 0.0
            ahead, behind = self._model(moved, commands), self._model(back, commands) if both else predicted
            for channel, column in zip(self._channels, slopes, strict=True):
                rows = channel.rows[: len(column)]
                column[:, i] = (_of(ahead, channel)[rows] - _of(behind, channel)[rows]) / (moved[i] - back[i])
        return slopes

    def _residual(self, equations: "_Equations", predicted: Readings) -> Array:
        """What the readings of a channel are more than predicted."""
        channel, rows = equations.channel, equations.rows
        residual: Array = _of(self._measured.readings, channel)[rows] - _of(predicted, channel)[rows]
        return residual

    def _made_equations(self, predicted: Readings, slopes: Sequence[Array], whiten: bool) -> "list[_Equations]":
        made = []
        for channel, slope in zip(self._channels, slopes, strict=True):
            rows = channel.rows[: len(slope)]
            residual = _of(self._measured.readings, channel)[rows] - _of(predicted, channel)[rows]
            doubts, prior = self._doubtful(predicted, channel, rows)
            remaining, sigma = _without(residual, doubts, prior, channel)
            taken: Array = np.ones(1)
            if whiten:
                taken, sigma = _autoregression(remaining, _FLOORS[channel.kind])
            made.append(_Equations.of(channel, rows, taken, sigma, slope, doubts, prior))
        return made

    def _doubtful(self, predicted: Readings, channel: _Channel, rows: NDArray[np.int64]) -> tuple[Array, Array]:
        """What a sensor's offset and gains add to a reading (n, d), and their standard deviations (d,)."""
        if channel.kind == 2:
            signals = predicted.lengths[rows, channel.sensor][:, None]
        else:
            signals = predicted.imus[rows, channel.kind, channel.sensor]
        prior = np.array([channel.offset, *np.full(signals.shape[1], self._doubts.gain)])
        return np.column_stack([np.ones(len(rows)), signals]), prior

    def result(self) -> Identified:
        """What was found."""
        predicted = self._predicted
        covariance = np.linalg.inv(sum((each.information for each in self._equations), np.diag(self._prior**-2)))
        bounds = np.linspace(0, len(predicted.imus), _BLOCKS + 1).astype(int)
        scores = np.sum([each.scores(self._residual(each, predicted), bounds) for each in self._equations], axis=0)
        scattered = covariance @ (scores.T @ scores) @ covariance
        # Scaled so that both standard deviations are covered, and correlations stay those of the likelihood.
        wider = np.sqrt(np.maximum(np.diag(scattered) / np.diag(covariance), 1.0))
        covariance = covariance * np.outer(wider, wider)
        count = len(self._names)
        sigmas = np.sqrt(np.diag(covariance))
        values = tuple(
            Value(name, leg, float(value), float(sigma))
            for (name, leg), value, sigma in zip(self._names, self._at, sigmas, strict=False)
        )
        residual, unexplained = self._remaining(predicted)
        remarks = [*_not_told(values, covariance[:count, :count], self._period)]
        if unexplained > 1.5:
            remarks.append(
                f"the model leaves {unexplained:.2g} times the noise at rest: the machine has play, bends or has other masses "
                "than its file; the intervals allow for what scatters from time to time, not for what is always wrong"
            )
        return Identified(
            self._mechanism, values, covariance[:count, :count], self._figures(covariance[:count, :count]), unexplained,
            residual, float(self._measured.commands.times[-1]), self._period, tuple(remarks), predicted,
        )  # fmt: skip

    def _remaining(self, predicted: Readings) -> tuple[tuple[float, float], float]:
        squares: tuple[list[float], list[float]] = ([], [])
        ratios = []
        for channel in self._channels:
            if channel.kind == 2:
                continue
            residual = _of(self._measured.readings, channel)[channel.rows] - _of(predicted, channel)[channel.rows]
            _, sigma = _without(residual, *self._doubtful(predicted, channel, channel.rows), channel)
            squares[channel.kind].append(sigma**2)
            rest = self._measured.rest[channel.kind, channel.sensor, channel.axis]
            if np.isfinite(rest) and rest > _FLOORS[channel.kind]:
                ratios.append((sigma / rest) ** 2)
        rate, force = (float(np.sqrt(np.mean(each))) if each else float("nan") for each in squares)
        return (rate, force), float(np.sqrt(np.mean(ratios))) if ratios else float("nan")

    def _figures(self, covariance: Array) -> tuple[Value, ...]:
        """Droop and lag of each leg, whose standard deviations follow from the slopes of these by the parameters."""
        at = self._at[: len(self._names)]

        def figures(values: Array) -> dict[tuple[str, int], float]:
            parameters: dict[str, Any] = {}
            for (name, leg), value in zip(self._names, values, strict=True):
                if leg is None:
                    parameters[name] = value
                else:
                    parameters.setdefault(name, np.zeros(self._mechanism.legs))[leg] = value
            parameters.pop(DELAY, None)
            mechanism = replace(self._mechanism, plant={**self._mechanism.plant, **parameters})
            plant, loads = mechanism.plant_parameters(), home_loads(mechanism)
            resistance = plant["motor.resistance"] - plant["drive.compensation"] * plant["drive.nominal_resistance"]
            droop = resistance / force_constant(mechanism) ** 2
            found = {("droop", leg): float(value) for leg, value in enumerate(droop)}
            if loads is not None:
                lags = droop * np.diag(loads.masses)
                found |= {("lag", leg): float(value) for leg, value in enumerate(lags)}
            return found

        now = figures(at)
        slopes = {key: np.zeros(len(at)) for key in now}
        for i, step in enumerate(self._steps[: len(at)]):
            moved = at.copy()
            moved[i] += 0.1 * step
            for key, value in figures(moved).items():
                slopes[key][i] = (value - now[key]) / (0.1 * step)
        return tuple(
            Value(name, leg, value, float(np.sqrt(slopes[name, leg] @ covariance @ slopes[name, leg])))
            for (name, leg), value in now.items()
        )  # fmt: skip


def _of(readings: Readings, channel: _Channel) -> Array:
    """The readings (N,) of a channel."""
    if channel.kind == 2:
        return readings.lengths[:, channel.sensor]
    return readings.imus[:, channel.kind, channel.sensor, channel.axis]


def _without(residual: Array, doubts: Array, prior: Array, channel: _Channel) -> tuple[Array, float]:
    """A residual (n,) without what the sensor's offset and gains explain, and its standard deviation."""
    scale = max(float(residual.std()), _FLOORS[channel.kind])
    own = doubts.T @ doubts + np.diag((scale / prior) ** 2)
    remaining: Array = residual - doubts @ np.linalg.solve(own, doubts.T @ residual)
    return remaining, max(float(remaining.std()), _FLOORS[channel.kind])


def _autoregression(remaining: Array, floor: float) -> tuple[Array, float]:
    """The filter (`_ORDER` + 1,) that leaves of a series what is new in each sample, and the standard deviation of that.

    By the equations of Yule and Walker; a little white noise keeps them regular.
    """
    count = len(remaining)
    moments = np.array([remaining[: count - lag] @ remaining[lag:] for lag in range(_ORDER + 1)]) / count
    moments[0] = moments[0] * (1.0 + 1e-9) + floor**2
    shares = solve_toeplitz(moments[:-1], moments[1:])
    return np.array([1.0, *-shares]), float(np.sqrt(max(moments[0] - shares @ moments[1:], floor**2)))


def _not_told(values: Sequence[Value], covariance: Array, period: float) -> list[str]:
    """What is not known to `MOST_WIDTH`, of the delay that of a period, in a line for each name: with the remedy, and with what
    it cannot be told apart from.
    """
    spread = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(spread, spread)
    lines = []
    for name in dict.fromkeys(each.name for each in values):
        mine = [i for i, each in enumerate(values) if each.name == name]
        worst = max(mine, key=lambda i: _width(values[i], period))
        if (width := _width(values[worst], period)) <= MOST_WIDTH:
            continue
        others = [i for i, each in enumerate(values) if each.name != name]
        beside = ""
        if others:
            other = max(others, key=lambda i: abs(correlation[worst, i]))
            if abs(correlation[worst, other]) >= _TOGETHER:
                beside = f", as {values[other].label} does much the same (correlation {correlation[worst, other]:.3f})"
        of = "a period" if name == DELAY else "its value"
        lines.append(
            f"{values[worst].label} is known to {100.0 * width:.0f} % of {of} only{beside}; what helps: "
            f"{PARAMETERS[name].remedy}"
        )
    return lines


def _width(value: Value, period: float) -> float:
    return value.half / period if value.name == DELAY else value.width
