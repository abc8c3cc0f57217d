"""Signs and units of a rig, by small motions from rest to rest: its commands, IMUs and encoders must agree.

The mechanism's file says how each IMU turns, and how gravity moves in its axes, when a leg moves a little near home. So the
accelerometers at rest tell, first, whether they point as gravity does at home, and then by how much the legs have moved. With
this motion are compared what was commanded, what each gyroscope has turned, by what each accelerometer has tilted, and by what
each encoder reads more, if there is one. A sign or a unit is wrong where the two are apart by more than a factor of two, and by
more than the noise allows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from controller.direct_kinematics import pose_from_lengths
from controller.inverse_kinematics import inverse_kinematics
from hil.rigs.kinematic import ideal_signals
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array

_FACTOR = 2.0
"""How much larger or smaller a motion may be than the one that it is compared with."""

_SIGMAS = 3.0
"""Standard errors that are allowed for noise."""

_OFF_GRAVITY_DEG = 45.0
"""How far the specific force may point from where it does at home: a platform near home and an IMU that is mounted askew are
well within, and a wrong sign or exchanged axes are mostly beyond."""

_FASTER, _RATE_FLOOR = 4.0, 0.03
"""A motion is stopped when an IMU turns this many times as fast as its command makes it, and this much more [rad/s]."""

_NOISY, _RECENT_S, _LEAST_RECENT = 3.0, 0.025, 2
"""How much more for noise, in standard deviations of a sample, and time [s] and least number of samples over which the rate is
averaged."""

_ASKEW = 0.15
"""How much of an IMU's motion its other axes may read, because it is mounted askew or the platform is not quite at home."""

_BLOCKS = 8
"""Number of parts of a rest whose means tell the noise, so that noise that lasts from sample to sample counts."""

_PROBE_M = 1e-3


@dataclass(frozen=True, eq=False)
class _Responses:
    """What the mechanism's file expects of ideal IMUs near home."""

    force: Array  # (7, 3), at rest [m/s^2]
    turns: Array  # (7, 3, 6), per extension of each leg [rad/m]
    tilts: Array  # (7, 3, 6), change of the force [m/s^2 per m]


def _responses_of(mechanism: Mechanism) -> _Responses:
    home = mechanism.require_home()
    signals, legs = ideal_signals(mechanism), inverse_kinematics(mechanism, home)
    still = np.zeros(6)
    twists = np.linalg.inv(legs.jacobian)
    turns = np.stack([signals(home, twist, still)[0] for twist in twists.T], axis=2)
    force = signals(home, still, still)[1]
    tilts = []
    for step in _PROBE_M * np.eye(LEGS):
        out, back = (signals(pose_from_lengths(mechanism, legs.lengths + d, home), still, still)[1] for d in (step, -step))
        tilts.append((out - back) / (2.0 * _PROBE_M))
    return _Responses(force, turns, np.stack(tilts, axis=2))


@dataclass(frozen=True, eq=False)
class _Rest:
    """Samples at rest of gyroscopes and accelerometers, each (2, 7, 3) but their number."""

    mean: Array
    spread: Array  # standard deviation of a sample
    error: Array  # standard error of the mean
    count: int
    lengths: Array  # (6,), mean of what the encoders read [m]; NaN without one


def _rest_of(samples: Array, lengths: Array) -> _Rest:
    parts = np.array([part.mean(axis=0) for part in np.array_split(samples, min(_BLOCKS, len(samples)))])
    error = parts.std(axis=0) / np.sqrt(max(len(parts) - 1, 1))
    return _Rest(samples.mean(axis=0), samples.std(axis=0), error, len(samples), lengths.mean(axis=0))


@dataclass(frozen=True, eq=False)
class _Motion:
    """A small motion from rest to rest."""

    commanded: Array  # (6,), of the legs [m]
    turns: Array  # (7, 3), by the gyroscopes [rad]
    tilts: Array  # (7, 3), change of the specific force [m/s^2]
    turn_error: Array  # (7, 3), standard errors of both
    tilt_error: Array
    lengths: Array  # (6,), by what the encoders read more [m]


class SmallMotions:
    """The small motions of a rig, sample by sample. Rest and motion come by turns, and rest comes first and last."""

    def __init__(self, mechanism: Mechanism) -> None:
        self._expected = _responses_of(mechanism)
        self._motions: list[_Motion] = []
        self._rest: list[Array] = []
        self._lengths: list[Array] = []
        self._turning: list[tuple[float, Array]] = []
        self._commanded = np.zeros(LEGS)
        self._at_ns = np.zeros(IMU_COUNT, np.int64)
        self._before: _Rest | None = None
        self._stopped = False

    @property
    def begun(self) -> bool:
        """Whether there was a rest, so that a motion can be told."""
        return self._before is not None or bool(self._rest)

    def add_rest(self, feedback: Record) -> None:
        """Add a sample at rest."""
        self._rest.append(feedback["measurement"][:2].copy())
        self._lengths.append(feedback["length"].copy())
        self._at_ns = feedback["sample_ns"].copy()

    def add_motion(self, command: Array, period: float, feedback: Record) -> str:
        """Add a sample in motion, or in what is left of it, with the command (6,) [m/s] of this exchange; returns why the
        motion must be stopped, "" if it may go on.
        """
        if self._rest:
            self._close_rest()
        assert self._before is not None
        rest = self._before
        passed = 1e-9 * (feedback["sample_ns"] - self._at_ns)
        self._at_ns = feedback["sample_ns"].copy()
        self._commanded = self._commanded + period * command
        self._turning.append((float(passed.mean()), passed[:, None] * (feedback["measurement"][0] - rest.mean[0])))
        count = max(_LEAST_RECENT, round(_RECENT_S / period))
        recent = self._turning[-count:]
        seconds = sum(each[0] for each in recent)
        if len(recent) < count or not seconds > 0.0:
            return ""
        rates = np.linalg.norm(sum(each[1] for each in recent), axis=1) / seconds
        usual = np.linalg.norm(self._expected.turns @ command, axis=1)
        limits = _FASTER * usual + _RATE_FLOOR + _NOISY * rest.spread[0].max(axis=1)
        beyond = np.nan_to_num(rates - limits, nan=-np.inf)
        imu = int(beyond.argmax())
        if not command.any() or beyond[imu] <= 0.0:
            return ""
        self._stopped = True
        return (
            f"The motion was stopped: IMU {imu} turns at {rates[imu]:.2g} rad/s, and the command makes it turn at "
            f"{usual[imu]:.2g} rad/s: check the unit of the commands and of the gyroscopes."
        )

    def _close_rest(self) -> None:
        """End a rest; with the one before, it encloses a motion."""
        now, before = _rest_of(np.array(self._rest), np.array(self._lengths)), self._before
        self._rest, self._lengths = [], []
        if before is not None and self._turning:
            seconds = sum(each[0] for each in self._turning)
            self._motions.append(
                _Motion(
                    self._commanded,
                    np.sum([each[1] for each in self._turning], axis=0),
                    now.mean[1] - before.mean[1],
                    seconds * before.error[0] * np.sqrt(1.0 + before.count / len(self._turning)),
                    np.hypot(now.error[1], before.error[1]),
                    now.lengths - before.lengths,
                )
            )
        self._before, self._turning, self._commanded = now, [], np.zeros(LEGS)

    def findings(self) -> Iterator[tuple[str, str]]:
        """What is wrong: the clause, and a sentence."""
        if self._rest:
            self._close_rest()
        assert self._before is not None
        force, expected = self._before.mean[1], self._expected
        cosine = np.sum(force * expected.force, axis=1) / (
            np.linalg.norm(force, axis=1) * np.linalg.norm(expected.force, axis=1)
        )
        off = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        for imu in np.flatnonzero(off > _OFF_GRAVITY_DEG).tolist():
            yield (
                "gravity",
                f"The specific force of IMU {imu} points {off[imu]:.0f} deg away from where it does at home: check the signs "
                "and the order of its axes, and that the platform is near home.",
            )
        sound = off <= _OFF_GRAVITY_DEG
        told = [self._told_motion(motion, sound) for motion in self._motions]
        if sound.any():
            yield from self._wrong_commands(told)
        else:
            # The commands are the only witness that is left.
            told = [(1.0, 0.0)] * len(self._motions)
        turns = [(m.turns, expected.turns @ m.commanded, m.turn_error) for m in self._motions]
        tilts = [(m.tilts, expected.tilts @ m.commanded, m.tilt_error) for m in self._motions]
        yield from _wrong_axes("gyroscopes", "gyroscope", "turns", "about", turns, told, np.isfinite(off))
        yield from _wrong_axes("accelerometers", "accelerometer", "tilts", "along", tilts, told, sound)
        yield from self._wrong_lengths(told)

    def _told_motion(self, motion: _Motion, sound: Array) -> tuple[float, float]:
        """The motion that the sound accelerometers tell, over the commanded one, and its standard error: the share that most
        of them agree upon (a weighted median, the least sum of absolute residuals).
        """
        expected = (self._expected.tilts @ motion.commanded)[sound].ravel()
        measured, errors = motion.tilts[sound].ravel(), motion.tilt_error[sound].ravel()
        used = np.abs(expected) > 1e-9
        if not used.any():
            return 1.0, np.inf
        shares, weights = measured[used] / expected[used], np.abs(expected[used])
        order = np.argsort(shares)
        total = np.cumsum(weights[order])
        share = float(shares[order][np.searchsorted(total, 0.5 * total[-1])])
        # A median is noisier than a mean by this.
        error = np.sqrt(0.5 * np.pi) * np.sqrt(np.sum((weights * errors[used]) ** 2)) / np.sum(weights**2)
        return share, float(error)

    def _wrong_commands(self, told: list[tuple[float, float]]) -> Iterator[tuple[str, str]]:
        single = False
        for motion, (share, error) in zip(self._motions, told, strict=True):
            legs = np.flatnonzero(motion.commanded).tolist()
            if len(legs) != 1 and single:
                # Each leg was looked at by itself.
                continue
            single = len(legs) == 1
            who = f"Leg {legs[0]}" if len(legs) == 1 else "All legs"
            most = 1e3 * motion.commanded[np.abs(motion.commanded).argmax()]
            if _is_wrong(share, 1.0, _SIGMAS * error):
                yield (
                    "commands",
                    f"{who} moved by {share * most:.2f} mm, as the accelerometers tell, and by {most:.2f} mm as commanded: "
                    "check the sign and the unit of the commands.",
                )
            elif single and not self._stopped and _SIGMAS * error > 1.0:
                yield (
                    "commands",
                    f"The accelerometers are too noisy to tell the sign of {who.lower()}'s motion by {most:.2f} mm: it is "
                    "not known whether its commands are right.",
                )

    def _wrong_lengths(self, told: list[tuple[float, float]]) -> Iterator[tuple[str, str]]:
        """The encoders that read another motion than the accelerometers tell when their leg moves alone."""
        for leg in range(LEGS):
            alone = [
                pair for pair in zip(self._motions, told, strict=True) if np.flatnonzero(pair[0].commanded).tolist() == [leg]
            ]
            parts = [(motion.lengths[leg], motion.commanded[leg], *each) for motion, each in alone]
            read = sum(np.copysign(1.0, share) * moved * asked for moved, asked, share, _ in parts)
            due = sum(abs(share) * asked**2 for _, asked, share, _ in parts)
            unsure = np.sqrt(sum((asked**2 * min(error, 1e6)) ** 2 for _, asked, _, error in parts))
            if np.isfinite(read) and due > 0.0 and _is_wrong(read, due, _SIGMAS * unsure):
                yield (
                    "encoders",
                    f"The encoder of leg {leg} reads {read / due:.3g} times the motion that the accelerometers tell: check its "
                    "sign and its unit.",
                )


def _is_wrong(value: float, expected: float, allowance: float) -> bool:
    """Whether a value is more than a factor and an allowance from the positive one that is expected."""
    return not expected / _FACTOR - allowance <= value <= _FACTOR * expected + allowance


def _wrong_axes(
    clause: str,
    sensor: str,
    does: str,
    how: str,
    motions: Sequence[tuple[Array, Array, Array]],
    told: Sequence[tuple[float, float]],
    who: Array,
) -> Iterator[tuple[str, str]]:  # fmt: skip
    """The axes of the IMUs `who` (7,) that read another motion than the accelerometers tell.

    Args:
        motions: (7, 3) of each motion: what is measured, what is expected, and the standard error.
        told: share of each motion that was made, and its standard error.
    """
    measured = expected = squares = noise = shares = askew = np.zeros((IMU_COUNT, 3))
    for (value, each, error), (share, share_error) in zip(motions, told, strict=True):
        # Motions that went the other way than commanded add up, too.
        sign = 1.0 if share >= 0.0 else -1.0
        measured = measured + sign * each * value
        expected = expected + abs(share) * each**2
        squares = squares + each**2
        noise = noise + (each * error) ** 2
        shares = shares + (each**2 * min(share_error, 1e6)) ** 2
        askew = askew + abs(share) * np.abs(each) * np.linalg.norm(each, axis=1)[:, None]
    for imu in np.flatnonzero(who).tolist():
        wrong = []
        for axis in range(3):
            if not squares[imu, axis] > 0.0:
                continue
            unsure = float(np.sqrt(noise[imu, axis]) + _FACTOR * np.sqrt(shares[imu, axis]))
            read, due = float(measured[imu, axis]), float(expected[imu, axis])
            if _is_wrong(read, due, _SIGMAS * unsure + _ASKEW * float(askew[imu, axis])):
                more = "more than " if unsure > due else ""
                wrong.append(f"{more}{read / max(due, unsure):.3g} times {how} {'xyz'[axis]}")
        if wrong:
            yield (
                clause,
                f"The {sensor} of IMU {imu} reads other {does} than the motion makes, {', '.join(wrong)}: check the signs and "
                "the order of its axes, and its unit.",
            )
