"""Target motions: poses over time, from a CSV file or by name."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from controller.inverse_kinematics import leg_lengths, sample_workspace
from plant.checks import check_duration
from plant.errors import InputError, UnknownNameError
from plant.mechanism import Mechanism
from plant.pose import (
    UNIT_TOLERANCE,
    Array,
    Pose,
    checked_unit,
    quaternion_from_rotation,
    rotation_from_vector,
    rotations_from_quaternions,
    vector_from_rotation,
)

COLUMNS = ("time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
SAMPLE_PERIOD_S = 0.01
MARGIN_S = 0.1
"""How far a target goes on beyond the duration, for whoever looks ahead."""

REST_S = 2.5
"""How long each pose of `rests` stands, the way to it included."""

_REST_CHOICE = 2000
_SHAKING_HZ = 0.8
_SHAKING_SHARE = 0.85
_FADE_S = 1.0
_STEP_S = 2.0

_IN_PLANE_M, _IN_PLANE_RAD = 1e-9, 1e-6
"""What counts as being in the plane."""


@dataclass(frozen=True, eq=False)
class Target:
    """Poses to be reached at given times.

    Attributes:
        name: for messages and reports.
        times: (N,) [s], increasing from 0.
        positions: (N, 3) [m], origin of {2} in {1}.
        rotations: (N, 3, 3), map {2} to {1}.
        held: whether each pose stands until the next one's time, instead of being passed through.
    """

    name: str
    times: Array
    positions: Array
    rotations: Array
    held: bool = False

    @property
    def start(self) -> Pose:
        """The first pose."""
        return Pose(self.positions[0], self.rotations[0])

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions (M, 3) and rotations (M, 3, 3) at times (M,) [s], interpolated (linearly, and along the shortest
        turn); before the first and after the last sample these stand.
        """
        if self.held:
            index = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 1)
            return self.positions[index], self.rotations[index]
        quaternions = quaternion_from_rotation(self.rotations)
        flips = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0, -1.0, 1.0)
        quaternions[1:] *= np.cumprod(flips)[:, None]
        between = _interpolate(self.times, np.hstack([self.positions, quaternions]), times)
        turns = between[:, 3:] / np.linalg.norm(between[:, 3:], axis=1, keepdims=True)
        return between[:, :3], rotations_from_quaternions(turns)


def _interpolate(knots: Array, values: Array, times: Array) -> Array:
    """Monotone cubic interpolation (Fritsch and Butland 1984) of values (N, m) at knots (N,), evaluated at times (M,).

    It passes through the samples with a continuous slope and never swings beyond them; outside, the ends stand.
    """
    h = np.diff(knots)[:, None]
    secants = np.diff(values, axis=0) / h
    slopes = np.zeros_like(values)
    if len(knots) > 2:
        before, after = secants[:-1], secants[1:]
        w1, w2 = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
        same_sense = before * after > 0.0
        mean = (w1 + w2) / (w1 / np.where(same_sense, before, 1.0) + w2 / np.where(same_sense, after, 1.0))
        slopes[1:-1] = np.where(same_sense, mean, 0.0)
    slopes[0], slopes[-1] = secants[0], secants[-1]
    times = np.clip(times, knots[0], knots[-1])
    i = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(knots) - 2)
    step = h[i]
    t = (times - knots[i])[:, None] / step
    start = values[i] * (1.0 + 2.0 * t) * (1.0 - t) ** 2 + step * slopes[i] * t * (1.0 - t) ** 2
    interpolated: Array = start + values[i + 1] * t * t * (3.0 - 2.0 * t) + step * slopes[i + 1] * t * t * (t - 1.0)
    return interpolated


def load_target(name_or_path: str | Path, mechanism: Mechanism, duration: float) -> Target:
    """A motion by its name, or the displacements from home in a CSV file, cut to `duration` [s].

    Raises:
        UnknownNameError: neither a motion nor a file.
        InputError: the file is malformed, not finite, out of order, its quaternions are off unit by more than 1e-3, or it
            leaves the plane of a planar mechanism.
    """
    check_duration(duration)
    if str(name_or_path) in (*MOTIONS, *_WIDE_MOTIONS):
        return _named_motion(str(name_or_path), mechanism, duration)
    path = Path(name_or_path)
    if not path.is_file():
        raise UnknownNameError(
            f"no target {str(name_or_path)!r}: neither a motion ({', '.join((*MOTIONS, *_WIDE_MOTIONS))}) nor a CSV file"
        )
    target = _cut(_read_csv(path, mechanism), duration)
    if mechanism.planar:
        _check_in_plane(target, mechanism)
    return target


def _read_csv(path: Path, mechanism: Mechanism) -> Target:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}") from None
    header = [name.strip() for name in lines[0].split(",")] if lines else []
    if header != list(COLUMNS):
        raise InputError(f"{path}, line 1: the header must be {','.join(COLUMNS)}")
    rows: list[list[float]] = []
    for number, line in enumerate(lines[1:], start=2):
        if not line.strip():
            continue
        try:
            row = [float(field) for field in line.split(",")]
        except ValueError:
            raise InputError(f"{path}, line {number}: {line.strip()!r} is not a row of {len(COLUMNS)} numbers") from None
        if len(row) != len(COLUMNS):
            raise InputError(f"{path}, line {number}: {len(row)} numbers instead of {len(COLUMNS)}")
        if not np.isfinite(row).all():
            raise InputError(f"{path}, line {number}: {line.strip()!r} is not finite")
        if rows and row[0] <= rows[-1][0]:
            raise InputError(f"{path}, line {number}: time {row[0]:g} s does not come after {rows[-1][0]:g} s")
        norm = float(np.linalg.norm(row[4:]))
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise InputError(
                f"{path}, line {number}: the quaternion has length {norm:.6g}; it must be 1 within {UNIT_TOLERANCE:g}"
            )
        rows.append(row)
    if len(rows) < 2:
        raise InputError(f"{path} has {len(rows)} samples; a motion needs at least 2")
    table = np.array(rows)
    quaternions = np.array([checked_unit(quaternion, 4, "quaternion") for quaternion in table[:, 4:]])
    home = mechanism.require_home()
    return Target(
        name=path.name,
        times=table[:, 0] - table[0, 0],
        positions=home.position + table[:, 1:4],
        rotations=rotations_from_quaternions(quaternions) @ home.rotation,
    )


def _check_in_plane(target: Target, mechanism: Mechanism) -> None:
    off = np.abs(target.positions[:, 2])
    tilts = np.arccos(np.clip(target.rotations[:, 2, 2], -1.0, 1.0))
    out = np.flatnonzero((off > _IN_PLANE_M) | (tilts > _IN_PLANE_RAD))
    if len(out):
        first = out[0]
        raise InputError(
            f"the target {target.name} leaves the plane of {mechanism.name!r} at {target.times[first]:g} s by "
            f"{1e3 * off[first]:.3g} mm and {np.degrees(tilts[first]):.3g} deg: give x, y and a turn about z alone"
        )


def _cut(target: Target, duration: float) -> Target:
    """Leave out what comes after the first sample past the duration, to which the motion is still heading."""
    last = int(np.searchsorted(target.times, duration + MARGIN_S)) + 1
    return Target(target.name, target.times[:last], target.positions[:last], target.rotations[:last], target.held)


def _named_motion(name: str, mechanism: Mechanism, duration: float) -> Target:
    if name in _WIDE_MOTIONS:
        return _WIDE_MOTIONS[name](mechanism, duration)
    home = mechanism.require_home()
    held = name == "steps"
    period = _STEP_S if held else SAMPLE_PERIOD_S
    times = np.arange(0.0, duration + MARGIN_S + period, period)
    # The reach is in proportion to the stroke, so that every preset can make every motion.
    stroke = mechanism.require_limits().stroke
    motions = PLANAR_MOTIONS if mechanism.planar else MOTIONS
    displacements = motions[name](times) * float((stroke[:, 1] - stroke[:, 0]).min() / 0.12)
    rotations = np.array([rotation_from_vector(vector) @ home.rotation for vector in displacements[:, 3:]])
    return Target(name, times, home.position + displacements[:, :3], rotations, held)


def _fade(times: Array) -> Array:
    """From 0 to 1 within the first second, with continuous acceleration."""
    x = np.clip(times / _FADE_S, 0.0, 1.0)
    faded: Array = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
    return faded[:, None]


def _hold(times: Array) -> Array:
    return np.zeros((len(times), 6))


def _circle(times: Array) -> Array:
    angle = 2.0 * np.pi * 0.25 * times
    motion = np.zeros((len(times), 6))
    motion[:, 0], motion[:, 1] = 0.03 * np.cos(angle), 0.03 * np.sin(angle)
    motion[:, 3], motion[:, 4] = np.radians(4.0) * np.sin(angle), -np.radians(4.0) * np.cos(angle)
    return motion * _fade(times)


def _sines(times: Array) -> Array:
    frequencies = np.array([0.30, 0.37, 0.43, 0.50, 0.57, 0.63])
    amplitudes = np.array([0.012, 0.012, 0.012, np.radians(3.0), np.radians(3.0), np.radians(5.0)])
    return amplitudes * np.sin(2.0 * np.pi * frequencies * times[:, None]) * _fade(times)


def _steps(times: Array) -> Array:
    poses = np.zeros((7, 6))
    for axis, size in enumerate((0.02, 0.02, 0.02, np.radians(4.0), np.radians(4.0), np.radians(8.0))):
        poses[axis + 1, axis] = size
    return poses[np.arange(len(times)) % len(poses)]


def _planar_circle(times: Array) -> Array:
    angle = 2.0 * np.pi * 0.25 * times
    motion = np.zeros((len(times), 6))
    motion[:, 0], motion[:, 1], motion[:, 5] = 0.03 * np.cos(angle), 0.03 * np.sin(angle), np.radians(10.0) * np.sin(angle)
    return motion * _fade(times)


def _planar_sines(times: Array) -> Array:
    motion = _sines(times)
    motion[:, 2:5] = 0.0
    return motion


def _planar_steps(times: Array) -> Array:
    poses = np.zeros((4, 6))
    for row, (axis, size) in enumerate(((0, 0.02), (1, 0.02), (5, np.radians(8.0)))):
        poses[row + 1, axis] = size
    return poses[np.arange(len(times)) % len(poses)]


def rests(mechanism: Mechanism, duration: float, share: float = 0.8, size: float = 1.0) -> Target:
    """Poses to rest at for `REST_S` each, home first, as different as this share of the strokes allows.

    They are chosen among random ones of the workspace, whose way from home is shortened to this `size`: of those that are not,
    hardly any is within a small share.
    """
    limits, home = mechanism.require_limits(), mechanism.require_home()
    lengths = leg_lengths(mechanism, home.position, home.rotation)
    positions, rotations = sample_workspace(mechanism, _REST_CHOICE, seed=0)
    if size < 1.0:
        turns = size * vector_from_rotation(rotations @ home.rotation.T)
        positions = home.position + size * (positions - home.position)
        rotations = np.array([rotation_from_vector(turn) @ home.rotation for turn in turns])
    drawn = leg_lengths(mechanism, positions, rotations)
    middle, half = limits.stroke.mean(axis=1), 0.5 * (limits.stroke[:, 1] - limits.stroke[:, 0])
    inside = (np.abs(drawn - middle) <= share * half).all(axis=1)
    positions, rotations, drawn = positions[inside], rotations[inside], drawn[inside]
    if not len(drawn):
        raise InputError(f"the workspace of {mechanism.name!r} has no poses within {share:g} of the strokes")
    # Each is the one that is farthest from all before.
    chosen: list[int] = []
    away = np.linalg.norm(drawn - lengths, axis=1)
    for _ in range(int(np.ceil(duration / REST_S))):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(drawn - drawn[chosen[-1]], axis=1))
    times = REST_S * np.arange(len(chosen) + 1)
    return Target(
        "rests",
        times,
        np.concatenate([home.position[None], positions[chosen]]),
        np.concatenate([home.rotation[None], rotations[chosen]]),
        held=True,
    )


def shaking(mechanism: Mechanism, duration: float, share: float = 1.0) -> Target:
    """Sines about home on all axes at once, about 0.8 Hz and a few percent apart, at this share of what the limits allow."""
    limits, home = mechanism.require_limits(), mechanism.require_home()
    times = np.arange(0.0, duration + MARGIN_S + SAMPLE_PERIOD_S, SAMPLE_PERIOD_S)
    spread = float(np.linalg.norm(mechanism.platform_joints, axis=1).mean())
    frequencies = _SHAKING_HZ * (1.0 + 0.04 * (np.arange(6.0) - 2.5))
    shape = np.sin(2.0 * np.pi * frequencies * times[:, None]) * _fade(times) * np.repeat([1.0, 1.0 / spread], 3)
    if mechanism.planar:
        shape[:, 2:5] = 0.0

    def at(size: float) -> tuple[Array, Array]:
        turned = np.array([rotation_from_vector(size * vector) @ home.rotation for vector in shape[:, 3:]])
        return home.position + size * shape[:, :3], turned

    low, high = 0.0, spread
    for _ in range(20):
        size = 0.5 * (low + high)
        lengths = leg_lengths(mechanism, *at(size))
        middle, half = limits.stroke.mean(axis=1), 0.5 * (limits.stroke[:, 1] - limits.stroke[:, 0])
        rates = np.gradient(lengths, SAMPLE_PERIOD_S, axis=0)
        use = max(
            float((np.abs(lengths - middle) / half).max()),
            float(np.abs(rates).max()) / limits.velocity,
            float(np.abs(np.gradient(rates, SAMPLE_PERIOD_S, axis=0)).max()) / limits.acceleration,
        )
        low, high = (size, high) if use < _SHAKING_SHARE else (low, size)
    return Target("shaking", times, *at(share * low))


_WIDE_MOTIONS: dict[str, Callable[[Mechanism, float], Target]] = {
    "near-rests": partial(rests, share=0.4, size=0.5),
    "rests": rests,
    "shaking": shaking,
    "probing": partial(shaking, share=0.3),
}
"""Motions for the calibration, fitted to the limits of the mechanism."""

MOTIONS: dict[str, Callable[[Array], Array]] = {"hold": _hold, "circle": _circle, "sines": _sines, "steps": _steps}
"""Displacements from home (N, 6), position [m] and rotation vector [rad], at times (N,) [s]."""

PLANAR_MOTIONS: dict[str, Callable[[Array], Array]] = {
    "hold": _hold, "circle": _planar_circle, "sines": _planar_sines, "steps": _planar_steps,
}  # fmt: skip
"""The same in the plane."""
