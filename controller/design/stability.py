"""How stable a linear loop is with its PID controllers: margins of each actuator's loop, and of all of them together.

`control.stability_margins` takes 23 ms a loop, and a design over a workspace asks for thousands of them. So the margins are
read here from the response; the tests compare both.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import control
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from controller.settings import ControlSettings
from plant.pose import Array

Complex = NDArray[np.complexfloating[Any, Any]]

LOWEST_HZ = 0.05
_POINTS = 600
_UNIT_CIRCLE = 1.0 + 1e-6
"""A pole up to here counts as stable: the unobserved bias of a gyroscope neither decays nor matters."""

_BIASES = 1.0 - 1e-6


@dataclass(frozen=True)
class LoopMargins:
    """What a loop bears until it is unstable, each alone; infinite if nothing of this kind makes it so."""

    gain_db: float  # more gain
    phase_deg: float  # phase, to either side
    delay: float  # more delay [s]
    crossover_hz: float  # highest frequency at which the loop gain falls below one; 0 if it is never above


@dataclass(frozen=True)
class Margins:
    """Stability of the loop at a pose.

    Attributes:
        legs: of the loop of each actuator with the others closed.
        together: of all actuators alike, the others with them: of the loci of the eigenvalues of the loop.
        sensitivity_peak: greatest singular value of the sensitivity S over frequency, all loops closed.
        complementary_peak: the same of 1 - S.
        disk: the disk margin of all actuators at once, each with a gain and phase error of its own (Seiler, Packard, Gahinet,
            *An introduction to disk margins*, IEEE Control Systems 40, 2020, with skew 0): at least this radius.
        damping: the least damping ratio of a pole, and `damped_hz` its frequency.
        stable: whether all poles lie inside the unit circle.
    """

    legs: tuple[LoopMargins, ...]
    together: LoopMargins
    sensitivity_peak: float
    complementary_peak: float
    disk: float
    damping: float
    damped_hz: float
    stable: bool

    @property
    def gain_db(self) -> float:
        """Of the worst actuator."""
        return min(each.gain_db for each in self.legs)

    @property
    def phase_deg(self) -> float:
        """Of the worst actuator."""
        return min(each.phase_deg for each in self.legs)

    @property
    def delay(self) -> float:
        """Of the worst actuator [s]."""
        return min(each.delay for each in self.legs)

    @property
    def crossover_hz(self) -> float:
        """Of the fastest actuator."""
        return max(each.crossover_hz for each in self.legs)

    @property
    def disk_gain_db(self) -> float:
        """By how much all gains may be off at once, each as it likes, to either side."""
        return 20.0 * float(np.log10((2.0 + self.disk) / (2.0 - self.disk))) if self.disk < 2.0 else np.inf

    @property
    def disk_phase_deg(self) -> float:
        """By how much all phases may be off at once, each as it likes, to either side."""
        return 2.0 * float(np.degrees(np.arctan(self.disk / 2.0)))

    def summary(self) -> dict[str, Any]:
        """All figures for JSON, in which None is infinite."""
        names = "gain_db", "phase_deg", "delay", "crossover_hz", "disk_gain_db", "disk_phase_deg"
        figures: dict[str, Any] = finite({name: getattr(self, name) for name in names} | asdict(self))
        return figures


def finite(value: Any) -> Any:
    """A value for JSON: None for an infinite number."""
    if isinstance(value, dict):
        return {name: finite(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


@dataclass(frozen=True, eq=False)
class Response:
    """A linear loop, and its response.

    Attributes:
        loop: from n commands to n lengths.
        frequencies: (F,) [Hz], up to half the rate.
        values: (F, n, n).
    """

    loop: control.StateSpace
    frequencies: Array
    values: Complex

    @classmethod
    def of(cls, loop: control.StateSpace) -> "Response":
        """The response of a discrete system."""
        frequencies = np.geomspace(LOWEST_HZ, 0.499 / loop.dt, _POINTS)
        return cls(loop, frequencies, np.moveaxis(loop(np.exp(2j * np.pi * frequencies * loop.dt)), 2, 0))

    @property
    def count(self) -> int:
        """The number of actuators."""
        return len(self.loop.C)


def controller(gains: ControlSettings, period: float) -> control.StateSpace:
    """The PID controller of one actuator, as `controller.pid` computes it in each cycle: from the error to the command."""
    smoothing = period * gains.derivative_bandwidth / (1.0 + period * gains.derivative_bandwidth)
    if gains.derivative == 0.0:
        return control.ss([[1.0]], [[period]], [[gains.integral]], [[gains.proportional]], period)
    # The integral, the error of the cycle before, and the low-passed derivative.
    slope = smoothing / period
    kept = [0.0, -slope, 1.0 - smoothing]
    return control.ss(
        [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], kept],
        [[period], [1.0], [slope]],
        [[gains.integral, *(gains.derivative * each for each in kept[1:])]],
        [[gains.proportional + gains.derivative * slope]],
        period,
    )


def closed_poles(loop: control.StateSpace, gains: ControlSettings | Sequence[ControlSettings]) -> Complex:
    """The poles of the loop closed by a PID controller for each actuator: all alike, or one each."""
    each = [gains] * len(loop.C) if isinstance(gains, ControlSettings) else gains
    whole = loop * control.append(*(controller(one, loop.dt) for one in each))
    poles: Complex = np.linalg.eigvals(whole.A - whole.B @ np.linalg.solve(np.eye(len(whole.D)) + whole.D, whole.C))
    return poles


def is_stable(poles: Complex) -> bool:
    """Whether a discrete system with these poles is stable."""
    return bool(np.abs(poles).max() < _UNIT_CIRCLE)


def sensitivity(response: Response, gains: ControlSettings) -> tuple[Complex, Complex]:
    """The loop gain (F, n, n), and the sensitivity (F, n, n)."""
    period = float(response.loop.dt)
    pid = controller(gains, period)(np.exp(2j * np.pi * response.frequencies * period))
    gain = pid[:, None, None] * response.values
    return gain, np.linalg.inv(np.eye(response.count) + gain)


def single_loops(inverse: Complex) -> Complex:
    """The loop gain (F, n) of each actuator with the others closed, by the sensitivity: 1 + L is the inverse of its own."""
    gains: Complex = 1.0 / np.diagonal(inverse, axis1=1, axis2=2) - 1.0
    return gains


def single_margins(response: Response, inverse: Complex) -> list[LoopMargins]:
    """The margins of each actuator's loop with the others closed, by the sensitivity (F, n, n)."""
    return loop_margins(response.frequencies, single_loops(inverse))


def loci(gain: Complex) -> Complex:
    """The eigenvalues (F, n) of a loop gain (F, n, n), each along a continuous line."""
    values: Complex = np.linalg.eigvals(gain)
    for before, row in pairwise(values):
        _, order = linear_sum_assignment(np.abs(np.log(before[:, None] / row[None])))
        row[:] = row[order]
    return values


def loop_margins(frequencies: Array, gains: Complex) -> list[LoopMargins]:
    """The margins of scalar loops from their responses (F, n), by interpolation between frequencies (F,) [Hz]."""
    return [_loop_margins(frequencies, gains[:, k]) for k in range(gains.shape[1])]


def _loop_margins(frequencies: Array, gain: Complex) -> LoopMargins:
    logs, steps = np.log(np.abs(gain)), np.log(frequencies)
    # Where the loop gain crosses one.
    at = np.flatnonzero((logs[:-1] > 0.0) != (logs[1:] > 0.0))
    share = logs[at] / (logs[at] - logs[at + 1])
    crossed = np.exp(steps[at] + share * (steps[at + 1] - steps[at]))
    turns = np.angle(gain[at + 1] / gain[at])
    phases = np.angle(-gain[at] * np.exp(1j * share * turns))
    falling = crossed[logs[at] > 0.0]
    # Where it is real and negative.
    left = np.flatnonzero((gain.imag[:-1] > 0.0) != (gain.imag[1:] > 0.0))
    share = gain.imag[left] / (gain.imag[left] - gain.imag[left + 1])
    real = gain.real[left] + share * (gain.real[left + 1] - gain.real[left])
    bearable = -1.0 / real[(real < 0.0) & (real > -1.0)]
    return LoopMargins(
        gain_db=20.0 * float(np.log10(bearable.min(initial=np.inf))),
        phase_deg=float(np.degrees(np.abs(phases).min(initial=np.inf))),
        delay=float((np.mod(phases, 2.0 * np.pi) / (2.0 * np.pi * crossed)).min(initial=np.inf)),
        crossover_hz=float(falling.max(initial=0.0)),
    )


def margins(response: Response, gains: ControlSettings) -> Margins:
    """The margins of a loop that a PID controller for each actuator closes, all with the same gains."""
    poles = closed_poles(response.loop, gains)
    gain, inverse = sensitivity(response, gains)
    one, period = np.eye(response.count), float(response.loop.dt)
    # Real poles and the biases' do not swing.
    swinging = poles[(np.abs(poles.imag) > 1e-9) & (np.abs(poles) < _BIASES) & (np.abs(poles) > 1e-6)]
    s = np.append(np.log(swinging) / period, -1.0)
    ratios = -s.real / np.abs(s)
    least = int(np.argmin(ratios))
    return Margins(
        legs=tuple(single_margins(response, inverse)),
        together=_worst(loop_margins(response.frequencies, loci(gain))),
        sensitivity_peak=peak_of(inverse),
        complementary_peak=peak_of(one - inverse),
        disk=1.0 / peak_of(inverse - 0.5 * one),
        damping=float(ratios[least]),
        damped_hz=float(np.abs(s[least]) / (2.0 * np.pi)) if least < len(swinging) else 0.0,
        stable=is_stable(poles),
    )


def _worst(found: Sequence[LoopMargins]) -> LoopMargins:
    return LoopMargins(
        gain_db=min(each.gain_db for each in found),
        phase_deg=min(each.phase_deg for each in found),
        delay=min(each.delay for each in found),
        crossover_hz=max(each.crossover_hz for each in found),
    )


def peak_of(matrices: Complex) -> float:
    """The greatest singular value of matrices (F, n, n)."""
    return float(np.linalg.norm(matrices, 2, axis=(1, 2)).max())


def step_responses(response: Response, gains: ControlSettings, duration: float) -> tuple[Array, Array]:
    """Times (N,) [s], and the estimated length (N, n) of each leg after a step by 1 of its own reference, by feedback alone."""
    loop, n = response.loop, response.count
    each = controller(gains, loop.dt)
    closed = control.feedback(loop * control.append(*[each] * n), control.ss([], [], [], np.eye(n), loop.dt))
    times = np.arange(round(duration / loop.dt)) * loop.dt
    states, lengths = np.zeros((len(closed.A), n)), []
    for _ in times:
        lengths.append(np.diag(closed.C @ states + closed.D))
        states = closed.A @ states + closed.B
    return times, np.array(lengths)
