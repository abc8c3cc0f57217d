"""Target motions: poses over time, from a CSV file, a motion file, or a built-in motion."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from controller.frames import ActiveFrames
from controller.inverse_kinematics import leg_lengths
from controller.planning.motions import (
    HELD,
    MARGIN_S,
    MOTIONS,
    NAMES,
    SAMPLE_PERIOD_S,
    Motion,
    PlannedMotion,
    load_motion,
    named_motion,
    plan_motion,
)
from controller.planning.motions.splines import stretched
from plant.checks import check_duration, check_time_scale, nearest
from plant.csv import read_csv
from plant.errors import InputError, UnknownNameError
from plant.mechanism import Mechanism
from plant.pose import (
    UNIT_TOLERANCE,
    Array,
    Pose,
    checked_array,
    checked_unit,
    quaternion_from_rotation,
    quaternions_along,
    rotation_from_vector,
    rotations_from_quaternions,
)

COLUMNS = ("time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
"""Of a motion through poses."""

HELD_COLUMNS = ("from_s", *COLUMNS[1:])
"""Of poses that are held, each from its time on."""

TargetFunction = Callable[[float], ArrayLike]
"""A target as a function of the time [s], from 0 on: place (3,) [m] and rotation vector (3,) [rad], as one array (6,).

They are those of a file: a displacement from home along the base's axes, or with frames the pose of the tool in the work frame.
"""

MOTION_SUFFIX = ".toml"
"""Of the name of a motion file."""

_IN_PLANE_M, _IN_PLANE_RAD = 1e-9, 1e-6
"""Largest deviation from the plane that counts as in the plane."""


@dataclass(frozen=True, eq=False)
class Target:
    """Poses to be reached at given times."""

    name: str  # for messages and reports
    times: Array  # (N,) [s], increasing from 0
    positions: Array  # (N, 3) [m], origin of {2} in {1}
    rotations: Array  # (N, 3, 3), map {2} to {1}
    held: bool = False  # whether each pose is held until the time of the next one; else the platform passes through it
    absolute: bool = False  # whether its file has poses in a frame, not displacements from home
    segments: Array | None = None  # (n, m, 5), the reference of the actuators, if the poses were planned with it
    remarks: tuple[str, ...] = ()  # what a user should know of it, a line each

    @property
    def start(self) -> Pose:
        """The first pose."""
        return Pose(self.positions[0], self.rotations[0])

    def slower(self, factor: float) -> "Target":
        """The same poses, with all times multiplied by a factor."""
        segments = None if self.segments is None else stretched(self.segments, factor)
        return replace(self, times=factor * self.times, segments=segments)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions (M, 3) and rotations (M, 3, 3) at times (M,) [s], interpolated by monotone cubics along the shortest turn.
        Before the first and after the last sample, that sample holds.
        """
        if self.held:
            index = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 1)
            return self.positions[index], self.rotations[index]
        between = _interpolate(self.times, np.hstack([self.positions, quaternions_along(self.rotations)]), times)
        turns = between[:, 3:] / np.linalg.norm(between[:, 3:], axis=1, keepdims=True)
        return between[:, :3], rotations_from_quaternions(turns)

    def likely_reading(self, mechanism: Mechanism) -> str:
        """What the positions of a file that is out of reach were probably meant as, and the remedy, in words; "" if no other
        reading is within the strokes.
        """
        least, most = mechanism.require_limits().stroke.T
        for reading, positions in self._other_readings(mechanism):
            lengths = leg_lengths(mechanism, positions, self.rotations)
            if ((lengths >= least) & (lengths <= most)).all():
                return reading
        return ""

    def _other_readings(self, mechanism: Mechanism) -> Iterator[tuple[str, Array]]:
        if self.name in NAMES or self.absolute or self.segments is not None:
            return
        home = mechanism.require_home().position
        given = self.positions - home
        yield "its positions fit as absolute ones, so give displacements from home", given
        yield "its positions fit as absolute ones in mm, so give displacements from home in m", 1e-3 * given
        if np.abs(given).max() > mechanism.require_limits().stroke.max():
            yield "its displacements fit in mm, so give them in m", home + 1e-3 * given


def _interpolate(knots: Array, values: Array, times: Array) -> Array:
    """Monotone cubic interpolation (Fritsch and Butland 1984) of values (N, m) at knots (N,), evaluated at times (M,).

    It passes through the samples with a continuous slope and never swings beyond them. Outside, the end values hold.
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


def load_target(
    name_or_path: str | Path,
    mechanism: Mechanism,
    duration: float,
    frames: ActiveFrames | None = None,
    time_scale: float = 1.0,
) -> Target:
    """A built-in motion by its name, or the displacements from home in a CSV file, cut to `duration` [s]; in a file whose
    header begins with `from_s` instead of `time_s`, each pose is held until the next one. A motion file (`.toml`) is planned
    whole, within all limits.

    With `frames` a file has poses of the tool in the work frame, if that is one of a file, and a motion displaces the tool from
    where it is at home, along the axes of the work frame. The target's poses are those of {2} in the root of the work frame.

    All times are multiplied by `time_scale`, but what has no times of its own is never faster than its limits allow.

    Raises:
        UnknownNameError: neither a motion nor a file.
        InputError: the file is malformed, not finite, out of order, its quaternions are off unit by more than 1e-3, it
            leaves the plane of a planar mechanism, or a motion file is too fast.
        UnreachableError: a motion file needs a leg outside its stroke.
    """
    check_duration(duration)
    check_time_scale(time_scale)
    name, home = str(name_or_path), mechanism.require_home()
    lasts = duration / time_scale
    if name in NAMES:
        times, positions, rotations = named_motion(name, mechanism, lasts)
        if frames is not None:
            if name not in MOTIONS:
                raise InputError(
                    f"{name} is fitted to the strokes, and not a motion in a frame: leave --frames out, or take another target"
                )
            moved = frames.displaced(home, positions - home.position, rotations @ home.rotation.T)
            positions, rotations = moved.position, moved.rotation
        return Target(name, times, positions, rotations, held=name in HELD).slower(time_scale)
    check_target(name)
    path = Path(name_or_path)
    if path.suffix == MOTION_SUFFIX:
        motion = load_motion(path)
        motion = replace(motion, time_scale=time_scale * motion.time_scale)
        target = target_of_motion(plan_in_frames(motion, mechanism, frames), duration)
    else:
        target = _cut(_read_csv(path, home, frames), lasts).slower(time_scale)
    if mechanism.planar:
        _check_in_plane(target, mechanism)
    return target


def target_of_function(
    function: TargetFunction, mechanism: Mechanism, duration: float, frames: ActiveFrames | None = None
) -> Target:
    """The target that a function of time describes, for a motion of `duration` [s].

    It is sampled each 10 ms, as the planner samples every target.

    Raises:
        InputError: the function returns anything but six finite numbers.
    """
    check_duration(duration)
    name = getattr(function, "__name__", type(function).__name__)
    times = np.arange(0.0, duration + MARGIN_S + SAMPLE_PERIOD_S, SAMPLE_PERIOD_S)
    samples = np.array([checked_array(function(float(time)), (6,), f"{name}({time:g})") for time in times])
    rotations = np.array([rotation_from_vector(vector) for vector in samples[:, 3:]])
    positions, rotations = poses_of(samples[:, :3], rotations, mechanism.require_home(), frames)
    return Target(name, times, positions, rotations)


def plan_in_frames(motion: Motion, mechanism: Mechanism, frames: ActiveFrames | None) -> PlannedMotion:
    """Plan a motion whose poses are displacements from home, or as in a file with these frames; errors as for `plan_motion`."""
    if frames is None:
        return plan_motion(motion, mechanism)
    home, active = mechanism.require_home(), frames
    at_home = active.to_target(home, home)

    def platform(positions: Array, rotations: Array) -> tuple[Array, Array]:
        return poses_of(positions, rotations, home, active)

    return plan_motion(motion, mechanism, platform, Pose(*at_home))


def target_of_motion(motion: PlannedMotion, duration: float) -> Target:
    """The target of a planned motion, for a run of `duration` [s]."""
    takes = f"{motion.duration:.3f}"
    cut = f"{motion.name} takes {takes} s, and the run ends after {duration:g} s: --duration {takes} lets it end"
    return Target(
        name=motion.name,
        times=motion.times,
        positions=motion.positions,
        rotations=motion.rotations,
        segments=motion.segments,
        remarks=(*motion.remarks, *([cut] if motion.duration > duration + 1e-3 else [])),
    )


def check_target(name: str) -> None:
    """Check that there is a motion or a file of this name, or raise an `UnknownNameError`."""
    if name not in NAMES and not Path(name).is_file():
        raise UnknownNameError(f"no target {name!r}: neither a motion ({', '.join(NAMES)}) nor a file{nearest(name, NAMES)}")


def text_of_target(target: Target, mechanism: Mechanism, frames: ActiveFrames | None = None) -> str:
    """The CSV text of a target as displacements from a mechanism's home, or as frames want it, which `load_target` reads again
    from a file.

    Raises:
        InputError: times, positions and rotations are not of one length of at least 2, or not finite.
    """
    home, count = mechanism.require_home(), len(target.times)
    if not (count >= 2 and np.shape(target.positions) == (count, 3) and np.shape(target.rotations) == (count, 3, 3)):
        raise InputError(
            f"the target {target.name!r} has times {np.shape(target.times)}, positions {np.shape(target.positions)} and "
            f"rotations {np.shape(target.rotations)}; it needs (N,), (N, 3) and (N, 3, 3), N at least 2"
        )
    rows = np.column_stack([target.times, *samples_of(target.positions, target.rotations, home, frames)])
    header = ",".join(HELD_COLUMNS if target.held else COLUMNS)
    return "\n".join([header, *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n"


def samples_of(positions: Array, rotations: Array, home: Pose, frames: ActiveFrames | None) -> tuple[Array, Array]:
    """The positions (N, 3) and quaternions (N, 4) by which a file or a stream tells poses of {2}."""
    if frames is None:
        return positions - home.position, quaternion_from_rotation(rotations @ home.rotation.T)
    positions, rotations = frames.to_target(home, Pose(positions, rotations))
    return positions, quaternion_from_rotation(rotations)


def _read_csv(path: Path, home: Pose, frames: ActiveFrames | None) -> Target:
    columns, table, lines = read_csv(path, COLUMNS, HELD_COLUMNS)
    for i, (time, norm) in enumerate(zip(table[:, 0], np.linalg.norm(table[:, 4:], axis=1), strict=True)):
        if i and time <= table[i - 1, 0]:
            raise InputError(f"{path}, line {lines[i]}: time {time:g} s does not come after {table[i - 1, 0]:g} s")
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise InputError(
                f"{path}, line {lines[i]}: the quaternion has length {norm:.6g}; it must be 1 within {UNIT_TOLERANCE:g}"
            )
    if len(table) < 2:
        raise InputError(f"{path} has {len(table)} samples; a motion needs at least 2")
    quaternions = np.array([checked_unit(quaternion, 4, "quaternion") for quaternion in table[:, 4:]])
    positions, rotations = poses_of(table[:, 1:4], rotations_from_quaternions(quaternions), home, frames)
    return Target(
        name=path.name,
        times=table[:, 0] - table[0, 0],
        positions=positions,
        rotations=rotations,
        held=columns == HELD_COLUMNS,
        absolute=frames is not None and frames.absolute,
    )


def poses_of(positions: Array, rotations: Array, home: Pose, frames: ActiveFrames | None) -> tuple[Array, Array]:
    """The positions (..., 3) and rotations (..., 3, 3) of {2} that a file or a stream means."""
    if frames is None:
        return home.position + positions, rotations @ home.rotation
    platform = frames.from_target(home, positions, rotations)
    return platform.position, platform.rotation


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
    """Leave out what comes after the first sample past the duration; the motion is still heading for that sample."""
    last = int(np.searchsorted(target.times, duration + MARGIN_S)) + 1
    times, positions, rotations = (part[:last] for part in (target.times, target.positions, target.rotations))
    return replace(target, times=times, positions=positions, rotations=rotations)
