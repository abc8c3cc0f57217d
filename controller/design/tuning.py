"""Design of the PID gains from the linearised loop, at home and at poses drawn from the workspace.

The rule: an integral time of 0.3 s, or the shortest of longer ones, and the largest proportional gain, or the one with the
crossover that is asked for, with which at home the multivariable sensitivity peak stays at 2 with 65 deg of phase margin and 12
dB of gain margin, and anywhere in the workspace at 1.5 times that with half of these margins.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date
from importlib.metadata import version
from typing import Any

import numpy as np
import tomlkit

from controller.design.linear_loop import SETTLED_S, Setup, open_loop
from controller.design.stability import (
    LoopMargins,
    Margins,
    Response,
    closed_poles,
    finite,
    is_stable,
    margins,
    peak_of,
    sensitivity,
    single_margins,
)
from controller.inverse_kinematics import sample_workspace
from controller.loop_margins import SENSITIVITY_LIMIT
from controller.settings import ControlSettings, control_settings
from controller.workspace import margins as margins_of_poses
from plant.checks import RATE_RANGE_HZ
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism import Mechanism
from plant.mechanism.documents import mechanism_text
from plant.pose import Array, Pose, vector_from_rotation

INTEGRAL_TIMES_S = (0.3, 1.0, 3.0, 10.0)
"""The first is taken, and a longer one where the rule does not hold with it."""

POSES = 40
_LEAST_GAIN, _STEPS, _CLOSE = 1.0, 40, 1.002
_RATE_STEP, _LONGER = 1.5, 1.25

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Rule:
    """What gains must leave, and which crossover they shall have.

    Attributes:
        crossover_hz: of the fastest actuator at home; None for the highest that the rest allows.
        sensitivity: greatest peak of the sensitivity, all loops closed.
        phase_deg, gain_db: least margins of an actuator's loop with the others closed.

    Raises:
        InputError: a value out of its range.
    """

    crossover_hz: float | None = None
    sensitivity: float = SENSITIVITY_LIMIT
    phase_deg: float = 65.0
    gain_db: float = 12.0

    def __post_init__(self) -> None:
        ranges = (
            ("crossover", self.crossover_hz, " Hz", 0.05, 500.0), ("sensitivity", self.sensitivity, "", 1.05, 10.0),
            ("phase margin", self.phase_deg, " deg", 1.0, 90.0), ("gain margin", self.gain_db, " dB", 0.5, 60.0),
        )  # fmt: skip
        for name, value, unit, least, most in ranges:
            if value is not None and not least <= value <= most:
                raise InputError(f"the {name} is {value:g}{unit}; it must be {least:g} to {most:g}{unit}")

    def broken_by(self, peak: float, legs: Sequence[LoopMargins], at_home: bool = True) -> str:
        """How a sensitivity peak, and margins of the legs, break the rule; "" if they do not."""
        allowed, share = (self.sensitivity, 1.0) if at_home else (1.5 * self.sensitivity, 0.5)
        phase, gain = min(each.phase_deg for each in legs), min(each.gain_db for each in legs)
        where = "at home" if at_home else "in the workspace"
        if peak > allowed:
            return f"a sensitivity peak of {peak:.2f} {where}, and {allowed:.3g} is allowed there"
        if phase < share * self.phase_deg:
            return f"a phase margin of {phase:.1f} deg {where}, and {share * self.phase_deg:.3g} deg are needed there"
        if gain < share * self.gain_db:
            return f"a gain margin of {gain:.1f} dB {where}, and {share * self.gain_db:.3g} dB are needed there"
        return ""


@dataclass(frozen=True, eq=False)
class PoseMargins:
    """The margins at a pose."""

    pose: Pose
    margins: Margins

    def where(self, home: Pose) -> tuple[Array, Array]:
        """The move from home [m], and the rotation vector from home in {1} [rad]."""
        return self.pose.position - home.position, vector_from_rotation(self.pose.rotation @ home.rotation.T)


FIGURES: dict[str, tuple[str, str, float, Callable[[Margins], float], bool]] = {
    "gain margin": ("dB", ".1f", 1.0, lambda m: m.gain_db, False),
    "phase margin": ("deg", ".1f", 1.0, lambda m: m.phase_deg, False),
    "delay margin": ("ms", ".1f", 1e3, lambda m: m.delay, False),
    "crossover": ("Hz", ".2f", 1.0, lambda m: m.crossover_hz, True),
    "all together: gain margin": ("dB", ".1f", 1.0, lambda m: m.together.gain_db, False),
    "all together: phase margin": ("deg", ".1f", 1.0, lambda m: m.together.phase_deg, False),
    "all together: delay margin": ("ms", ".1f", 1e3, lambda m: m.together.delay, False),
    "sensitivity peak, all loops": ("-", ".2f", 1.0, lambda m: m.sensitivity_peak, True),
    "complementary peak, all loops": ("-", ".2f", 1.0, lambda m: m.complementary_peak, True),
    "each its own error: gain": ("dB", ".1f", 1.0, lambda m: m.disk_gain_db, False),
    "each its own error: phase": ("deg", ".1f", 1.0, lambda m: m.disk_phase_deg, False),
    "least damping of a pole": ("-", ".2f", 1.0, lambda m: m.damping, False),
}
"""Unit, format, factor from SI units, value, and whether the greatest is the worst."""


@dataclass(frozen=True, eq=False)
class Design:
    """Designed gains and their margins, beside the preset's gains and margins.

    Attributes:
        mechanism: what it is for.
        setup: what the loop runs with.
        rule: what was asked for.
        gains: `proportional` and `integral` are those of drives with position loops, if the setup has these.
        margins: at home.
        workspace: at poses of the workspace.
        preset, preset_margins: the gains in the mechanism's file, and theirs at home.
        lowest_rate: the lowest rate with which the loop is stable at home and where its margins are worst [Hz].
        hold: how long the brakes must hold at least for the loop to be stable at all poses when feedback closes, as the filters
            take the accelerometers with greater gains then [s].
        responses: of the loop at home, and at each pose of the workspace.
    """

    mechanism: Mechanism
    setup: Setup
    rule: Rule
    gains: ControlSettings
    margins: Margins
    workspace: tuple[PoseMargins, ...]
    preset: ControlSettings
    preset_margins: Margins
    lowest_rate: float
    hold: float
    responses: tuple[Response, ...] = ()

    @property
    def home(self) -> Pose:
        """Where the design began."""
        return self.mechanism.require_home()

    def worst(self, figure: str) -> PoseMargins | None:
        """The pose of the workspace with the worst of `FIGURES`; None without poses."""
        _, _, _, value, greatest = FIGURES[figure]
        return min(self.workspace, key=lambda each: (-1 if greatest else 1) * value(each.margins), default=None)

    def summary(self) -> dict[str, Any]:
        """Everything, for JSON, in SI units; None is infinite."""
        worst = {}
        for name, (_, _, _, value, _) in FIGURES.items():
            if (at := self.worst(name)) is not None:
                worst[name] = {"value": value(at.margins), "pose": self.workspace.index(at)}
        poses = [
            {"position": each.pose.position.tolist(), "rotation": each.pose.rotation.tolist(), **each.margins.summary()}
            for each in self.workspace
        ]
        figures: dict[str, Any] = finite(
            {
                "rate": self.setup.rate,
                "delay": self.setup.delay,
                "rule": asdict(self.rule),
                "gains": asdict(self.gains),
                "margins": self.margins.summary(),
                "preset": asdict(self.preset),
                "preset_margins": self.preset_margins.summary(),
                "lowest_rate": self.lowest_rate,
                "hold": self.hold,
                "worst": worst,
                "workspace": poses,
            }
        )
        return figures

    @property
    def remark(self) -> str:
        """From which rate and which time on the loop is stable, in a line."""
        least, _ = RATE_RANGE_HZ
        floor = f"{least:g} Hz, the lowest that there is" if self.lowest_rate == least else f"{self.lowest_rate:.0f} Hz"
        text = f"stable with rates down to {floor}, and {self.hold:.2g} s after the filters have begun"
        if self.longer_hold is not None:
            text += (
                f", which is more than the {self._present_hold:g} s for which the brakes hold: "
                f"it takes hold = {self.longer_hold:g}, which --write writes with the gains"
            )
        return text

    @property
    def longer_hold(self) -> float | None:
        """The `hold` that these gains need [s], as it is shown and not below what was found; None if theirs is enough."""
        return float(np.ceil(100.0 * self.hold - 1e-9) / 100.0) if self.hold > self._present_hold else None

    @property
    def _present_hold(self) -> float:
        """How long the brakes hold without a change of `hold` [s]."""
        return self.gains.hold_at(self.setup.rate)

    def rows(self) -> list[tuple[str, str, str]]:
        """Label, value and unit of each figure at home."""
        rows = []
        for name, gains, found in (("designed", self.gains, self.margins), ("preset", self.preset, self.preset_margins)):
            rows += [
                (f"{name}: proportional", f"{gains.proportional:.1f}", "1/s"),
                (f"{name}: integral", f"{gains.integral:.1f}", "1/s2"),
                (f"{name}: derivative", f"{gains.derivative:g}", "-"),
            ]
            for label in ("gain margin", "phase margin", "crossover", "sensitivity peak, all loops"):
                rows.append((f"{name}: {label}", shown(label, found), FIGURES[label][0]))
        return rows

    def workspace_rows(self) -> list[tuple[str, str, str, str, str]]:
        """For each figure its label with the unit, its value at home, its worst, and there the move [mm] and the turn [deg]."""
        rows = []
        for label, (unit, *_) in FIGURES.items():
            if (at := self.worst(label)) is not None:
                move, turn = at.where(self.home)
                where = _listed(1e3 * move, 0), _listed(np.degrees(turn), 1)
                rows.append((f"{label} [{unit}]", shown(label, self.margins), shown(label, at.margins), *where))
        return rows

    def leg_rows(self) -> list[tuple[str, ...]]:
        """For each leg its margins and crossover at home, and the worst of each in the workspace."""
        rows = []
        for k, leg in enumerate(self.margins.legs):
            others = [each.margins.legs[k] for each in self.workspace]
            cells = [f"leg {k}"]
            for name, scale, form, most in (
                ("gain_db", 1.0, ".1f", min), ("phase_deg", 1.0, ".1f", min), ("delay", 1e3, ".1f", min),
                ("crossover_hz", 1.0, ".2f", max),
            ):  # fmt: skip
                worst = f" ({scale * most(getattr(each, name) for each in others):{form}})" if others else ""
                cells.append(f"{scale * getattr(leg, name):{form}}{worst}")
            rows.append(tuple(cells))
        return rows


def _listed(values: Array, digits: int) -> str:
    # Adding 0 takes the sign off a zero.
    return ", ".join(f"{value + 0.0:.{digits}f}" for value in np.round(values, digits))


def shown(figure: str, found: Margins) -> str:
    """The value of one of `FIGURES`, in its unit."""
    _, form, scale, value, _ = FIGURES[figure]
    return f"{scale * value(found):{form}}"


def _silent(_: float) -> None:
    """No progress is shown."""


def tune(
    mechanism: Mechanism,
    setup: Setup,
    rule: Rule | None = None,
    poses: int = POSES,
    seed: int = 0,
    progress: Progress = _silent,
) -> Design:
    """Design the gains.

    Args:
        mechanism: spatial, or a planar one seen in space.
        setup: what the loop runs with.
        rule: what gains must leave.
        poses: how many are drawn from the workspace; 0 for home alone.
        seed: of the poses.
        progress: called with the share that is done.

    Raises:
        SingularConfigurationError: no gains keep the rule.
        InputError: the mechanism lacks data, or a value is out of its range.
    """
    rule, home = rule or Rule(), mechanism.require_home()
    if poses < 0:
        raise InputError(f"there are {poses} poses of the workspace; it must be 0 or more")
    preset = control_settings(mechanism)
    if setup.bandwidth is not None:
        preset = preset.for_position_drives()
    found: list[Response] = []
    where = [home, *workspace_poses(mechanism, poses, seed)]
    for pose in where:
        found.append(Response.of(open_loop(mechanism, setup, pose)))
        progress(0.6 * len(found) / len(where))
    gains = _designed(found, preset, rule)
    at_home, *elsewhere = (margins(response, gains) for response in found)
    design = Design(
        mechanism, setup, rule, gains, at_home,
        tuple(PoseMargins(*each) for each in zip(where[1:], elsewhere, strict=True)),
        preset, margins(found[0], preset), setup.rate, preset.hold_at(setup.rate), tuple(found),
    )  # fmt: skip
    progress(0.7)
    hold = shortest_hold(mechanism, setup, gains, where, lambda share: progress(0.7 + 0.2 * share))
    worst = [design.worst(name) for name in ("gain margin", "phase margin", "sensitivity peak, all loops")]
    critical = {id(each): each.pose for each in worst if each is not None}
    lowest = lowest_stable_rate(mechanism, setup, gains, [home, *critical.values()], lambda share: progress(0.9 + 0.1 * share))
    return replace(design, lowest_rate=lowest, hold=hold)


def workspace_poses(mechanism: Mechanism, count: int, seed: int) -> list[Pose]:
    """Random poses at which no limit is exceeded, as `controller.workspace.margins` has them with its usual demands.

    Raises:
        InputError: the mechanism lacks data, or too few poses are within its limits.
    """
    if count == 0:
        return []
    positions, rotations = sample_workspace(mechanism, 20 * count, seed)
    inside = np.flatnonzero(margins_of_poses(mechanism, positions, rotations).reachable)[:count]
    if len(inside) < count:
        raise InputError(
            f"only {len(inside)} of {20 * count} random poses are within all limits of {mechanism.name!r}, and {count} are "
            "asked for: take fewer poses, or see what limits them with 'gough workspace'"
        )
    return [Pose(positions[i], rotations[i]) for i in inside]


def _designed(responses: Sequence[Response], preset: ControlSettings, rule: Rule) -> ControlSettings:
    """The gains by the rule; the first response is that at home."""
    rate, reasons = 1.0 / float(responses[0].loop.dt), []
    for integral_time in INTEGRAL_TIMES_S:

        def gains(proportional: float, time: float = integral_time) -> ControlSettings:
            return replace(preset, proportional=proportional, integral=proportional / time, derivative=0.0)

        if rule.crossover_hz is not None:
            found = gains(_rounded_down(_for_crossover(responses[0], gains, rule.crossover_hz)))
            reasons.append(_broken(responses, found, rule))
            if not reasons[-1]:
                return replace(found, integral=_rounded_down(found.integral))
        elif largest := _largest(lambda proportional: not _broken(responses, gains(proportional), rule), 0.5 * rate):
            found = gains(_rounded_down(largest))
            return replace(found, integral=_rounded_down(found.integral))
    if rule.crossover_hz is None:
        raise SingularConfigurationError(
            f"no gains have these margins at {rate:g} Hz: raise the rate, shorten the delay, or allow a greater sensitivity "
            "peak and smaller margins"
        )
    raise SingularConfigurationError(
        f"a crossover of {rule.crossover_hz:g} Hz leaves {reasons[-1]}: choose another one, raise the rate, or allow more; "
        "without a crossover the highest is found"
    )


def _broken(responses: Sequence[Response], gains: ControlSettings, rule: Rule) -> str:
    """How these gains break the rule, and where; "" if they keep it."""
    for number, response in enumerate(responses):
        if not is_stable(closed_poles(response.loop, gains)):
            return f"a loop that is unstable {'in the workspace' if number else 'at home'}"
        _, inverse = sensitivity(response, gains)
        if broken := rule.broken_by(peak_of(inverse), single_margins(response, inverse), at_home=number == 0):
            return broken
    return ""


def _largest(keeps_rule: Callable[[float], bool], most: float) -> float:
    """The largest gain, up to `most`, that keeps the rule; 0 if none does.

    Small gains do not keep it either, because the integral time is fixed: search from above.
    """
    steps = np.geomspace(most, _LEAST_GAIN, _STEPS).tolist()
    for high, low in zip([most, *steps], steps, strict=False):
        if keeps_rule(low):
            while high / low > _CLOSE:
                middle = float(np.sqrt(low * high))
                low, high = (middle, high) if keeps_rule(middle) else (low, middle)
            return float(low)
    return 0.0


def _for_crossover(home: Response, with_proportional: Callable[[float], ControlSettings], crossover_hz: float) -> float:
    """The proportional gain with which the fastest actuator at home has this crossover."""

    def crossover(proportional: float) -> float:
        _, inverse = sensitivity(home, with_proportional(proportional))
        return max(each.crossover_hz for each in single_margins(home, inverse))

    low, high = 1e-3, 20.0 * crossover_hz
    while high / low > 1.0 + 1e-5:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if crossover(middle) < crossover_hz else (low, middle)
    return low


def _rounded_down(gain: float) -> float:
    """A gain as it is shown, and not above what was found: a greater one would break the rule."""
    return float(np.floor(10.0 * gain) / 10.0)


def lowest_stable_rate(
    mechanism: Mechanism, setup: Setup, gains: ControlSettings, poses: Sequence[Pose], progress: Progress = _silent
) -> float:
    """The lowest rate [Hz] at which the loop is stable at all of these poses, with gains and delay as they are.

    It is the lowest of the rates that lead down to it without an unstable one in between, to 1 %.
    """

    def stable(rate: float) -> bool:
        slow = replace(setup, rate=rate)
        return all(is_stable(closed_poles(open_loop(mechanism, slow, pose), gains)) for pose in poses)

    least, _ = RATE_RANGE_HZ
    high, low = setup.rate, setup.rate
    while low > least:
        low = max(low / _RATE_STEP, least)
        if not stable(low):
            break
        high = low
        progress(0.8 * float(np.log(setup.rate / low) / np.log(setup.rate / least)))
    else:
        progress(1.0)
        return least
    while high / low > 1.01:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if stable(middle) else (middle, high)
        progress(1.0 - 0.2 * (high / low - 1.0))
    return high


def shortest_hold(
    mechanism: Mechanism, setup: Setup, gains: ControlSettings, poses: Sequence[Pose], progress: Progress = _silent
) -> float:
    """The shortest time on the brakes, from the gains' own on, after which the loop is stable at all poses [s].

    Raises:
        SingularConfigurationError: it is not even when the filters have settled.
    """
    left, hold = list(poses), gains.hold_at(setup.rate)
    while left:
        unstable = []
        for tried, pose in enumerate(left, start=1):
            if not is_stable(closed_poles(open_loop(mechanism, setup, pose, hold), gains)):
                unstable.append(pose)
            progress(1.0 - (len(left) - tried + len(unstable)) / len(poses))
        left = unstable
        if left and hold >= SETTLED_S:
            raise SingularConfigurationError(f"the loop is unstable {hold:g} s after its start: choose smaller gains")
        hold = min(_LONGER * hold, SETTLED_S) if left else hold
    return float(hold)


def tuned_text(mechanism: str, design: Design) -> str:
    """The TOML text of a mechanism with the designed gains in its table `control`, their date and margins beside them, and no
    other change.

    Raises:
        GoughError: no such mechanism, or its file cannot be read.
    """
    document = tomlkit.parse(mechanism_text(mechanism))
    table = document.setdefault("control", tomlkit.table())
    setup, prefix = design.setup, "" if design.setup.bandwidth is None else "position_"
    about = (
        f"gough tune {version('gough')}, {date.today().isoformat()}: {setup.rate:g} Hz, delay {1e3 * setup.delay:g} ms, "
        f"crossover {design.margins.crossover_hz:.2f} Hz"
    )
    names = "gain margin", "phase margin", "sensitivity peak, all loops"
    margins_of = [f"at home {', '.join(_with_unit(name, design.margins) for name in names)}"]
    worst = [(name, design.worst(name)) for name in names]
    if design.workspace:
        texts = ", ".join(_with_unit(name, each.margins) for name, each in worst if each is not None)
        margins_of.append(f"at worst of {len(design.workspace)} poses {texts}")
    for name, comment in (("proportional", about), ("integral", "; ".join(margins_of))):
        table[prefix + name] = tomlkit.item(getattr(design.gains, name)).comment(comment)
    if not prefix:
        table["derivative"] = design.gains.derivative
    if design.longer_hold is not None:
        table["hold"] = design.longer_hold
    return tomlkit.dumps(document)


def _with_unit(figure: str, found: Margins) -> str:
    unit = FIGURES[figure][0]
    return f"{figure.partition(',')[0]} {shown(figure, found)}{'' if unit == '-' else f' {unit}'}"
