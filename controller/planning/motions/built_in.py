"""The built-in motions: displacements from home over time by name, and motions fitted to the limits of a mechanism."""

from collections.abc import Callable
from functools import partial
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controller.direct_kinematics import poses_from_lengths
from controller.inverse_kinematics import leg_lengths, sample_workspace
from controller.pose_limits import LIMITS, margins
from plant.errors import InputError
from plant.mechanism import Mechanism
from plant.pose import Array, Pose, rotation_from_vector, vector_from_rotation

SAMPLE_PERIOD_S = 0.01
MARGIN_S = 0.1
"""Time for which a motion goes on beyond its duration, so that the planner can look ahead."""

REST_S = 2.5
"""Time for each pose of `rests`, with the way to it."""

_REST_CHOICE = 2000
_SHAKING_HZ = 0.8
_SHAKING_SHARE = 0.85
_FADE_S = 1.0
_STEP_S = 2.0

_RESERVE = 0.1
"""Share of what home leaves of the swing of a joint or of a clearance, which the fitted motions leave, too."""
_WITH_RESERVE = np.array([limit.kind.endswith(("swing", "plate")) or limit.kind == "legs" for limit in LIMITS])
_ON_A_WAY = 50
"""Poses that are tried on the way from one rest to the next."""

Poses = tuple[Array, Array, Array]
"""Times (N,) [s], positions (N, 3) [m] and rotations (N, 3, 3)."""


class Box(NamedTuple):
    """How far a motion may lead from home."""

    position: float = inf  # [m]
    rotation: float = inf  # [rad]


EVERYWHERE = Box()


def named_motion(name: str, mechanism: Mechanism, duration: float) -> Poses:
    """The poses of a motion of `NAMES`.

    Raises:
        InputError: the mechanism has no home or no limits, or its workspace is too small.
    """
    if name in _FITTED:
        return _FITTED[name](mechanism, duration)
    home = mechanism.require_home()
    period = _STEP_S if name in HELD else SAMPLE_PERIOD_S
    times = np.arange(0.0, duration + MARGIN_S + period, period)
    # The reach is in proportion to the stroke, so that every preset can make every motion.
    stroke = mechanism.require_limits().stroke
    displacements = MOTIONS[name](times, mechanism.planar) * float((stroke[:, 1] - stroke[:, 0]).min() / 0.12)
    rotations = np.array([rotation_from_vector(vector) @ home.rotation for vector in displacements[:, 3:]])
    return times, home.position + displacements[:, :3], rotations


def _fade(times: Array) -> Array:
    """From 0 to 1 within the first second, with continuous acceleration."""
    x = np.clip(times / _FADE_S, 0.0, 1.0)
    faded: Array = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
    return faded[:, None]


def _hold(times: Array, planar: bool) -> Array:
    return np.zeros((len(times), 6))


def _circle(times: Array, planar: bool) -> Array:
    angle = 2.0 * np.pi * 0.25 * times
    motion = np.zeros((len(times), 6))
    motion[:, 0], motion[:, 1] = 0.03 * np.cos(angle), 0.03 * np.sin(angle)
    if planar:
        motion[:, 5] = np.radians(10.0) * np.sin(angle)
    else:
        motion[:, 3], motion[:, 4] = np.radians(4.0) * np.sin(angle), -np.radians(4.0) * np.cos(angle)
    return motion * _fade(times)


def _sines(times: Array, planar: bool) -> Array:
    frequencies = np.array([0.30, 0.37, 0.43, 0.50, 0.57, 0.63])
    amplitudes = np.array([0.012, 0.012, 0.012, np.radians(3.0), np.radians(3.0), np.radians(5.0)])
    motion: Array = amplitudes * np.sin(2.0 * np.pi * frequencies * times[:, None]) * _fade(times)
    if planar:
        motion[:, 2:5] = 0.0
    return motion


def _steps(times: Array, planar: bool) -> Array:
    sizes = np.diag([0.02, 0.02, 0.02, np.radians(4.0), np.radians(4.0), np.radians(8.0)])
    poses = np.concatenate([np.zeros((1, 6)), sizes[[0, 1, 5] if planar else slice(None)]])
    return poses[np.arange(len(times)) % len(poses)]


def rests(mechanism: Mechanism, duration: float, share: float = 0.8, size: float = 1.0, box: Box = EVERYWHERE) -> Poses:
    """Poses to rest at for `REST_S` each, home first, as different as this share of the strokes and the box allow.

    They are chosen among random poses of the workspace, whose way from home is shortened to this `size`, and to the box:
    without shortening, hardly any pose is within a small share. The poses, the ways from one to the next, and those home are
    within all limits.

    Raises:
        InputError: the mechanism has no home or no limits, or its limits leave no pose.
    """
    limits, home = mechanism.require_limits(), mechanism.require_home()
    inside = _Inside(mechanism)
    lengths = leg_lengths(mechanism, home.position, home.rotation)
    positions, rotations = sample_workspace(mechanism, _REST_CHOICE, seed=0)
    if size < 1.0:
        turns = size * vector_from_rotation(rotations @ home.rotation.T)
        positions = home.position + size * (positions - home.position)
        rotations = np.array([rotation_from_vector(turn) @ home.rotation for turn in turns])
    if box != EVERYWHERE:
        moves, turns = positions - home.position, vector_from_rotation(rotations @ home.rotation.T)
        positions = home.position + _shortened(moves, box.position)
        rotations = np.array([rotation_from_vector(turn) @ home.rotation for turn in _shortened(turns, box.rotation)])
    drawn = leg_lengths(mechanism, positions, rotations)
    middle, half = limits.stroke.mean(axis=1), 0.5 * (limits.stroke[:, 1] - limits.stroke[:, 0])
    usable = (np.abs(drawn - middle) <= share * half).all(axis=1) & inside(positions, rotations)
    positions, rotations, drawn = positions[usable], rotations[usable], drawn[usable]
    # Each is the pose farthest from all before to which a way leads.
    chosen: list[int] = []
    away = np.linalg.norm(drawn - lengths, axis=1)
    at, last = home, lengths
    for _ in range(int(np.ceil(duration / REST_S))):
        farthest_first = np.argsort(-away, kind="stable").tolist()
        ways = (k for k in farthest_first if inside.way(home, lengths, drawn[k]) and inside.way(at, last, drawn[k]))
        if (number := next(ways, None)) is None:
            raise InputError(
                f"the workspace of {mechanism.name!r} has no poses to rest at within {share:g} of the strokes and within all "
                "other limits ('gough workspace' shows which is closest): move home away from them, widen them, or keep to a "
                "box about home (--box of 'gough calibrate rig')"
            )
        chosen.append(number)
        at, last = Pose(positions[number], rotations[number]), drawn[number]
        away = np.minimum(away, np.linalg.norm(drawn - last, axis=1))
    return (
        REST_S * np.arange(len(chosen) + 1),
        np.concatenate([home.position[None], positions[chosen]]),
        np.concatenate([home.rotation[None], rotations[chosen]]),
    )


class _Inside:
    """Tells which poses are within all limits of a mechanism that home is within, with a reserve of swings and clearances."""

    def __init__(self, mechanism: Mechanism) -> None:
        home = mechanism.require_home()
        left = margins(mechanism, home.position[None], home.rotation[None], workers=1).values[0]
        # A home beyond a limit is told by the check of the whole motion.
        self._least = np.where(left >= 0.0, np.where(_WITH_RESERVE, _RESERVE * left, 0.0), -inf)
        self._mechanism = mechanism

    def __call__(self, positions: Array, rotations: Array) -> NDArray[np.bool_]:
        """(N,): whether poses (N, ...) are inside."""
        found: NDArray[np.bool_] = np.all(margins(self._mechanism, positions, rotations).values >= self._least, axis=1)
        return found

    def way(self, start: Pose, lengths: Array, end: Array) -> bool:
        """Whether the way from a pose, with its lengths (n,), to other lengths (n,) is inside."""
        steps = np.linspace(lengths, end, _ON_A_WAY)
        positions, rotations = poses_from_lengths(self._mechanism, steps, start, partial=True)
        return bool(np.isfinite(positions).all() and self(positions, rotations).all())


def _shortened(vectors: Array, most: float) -> Array:
    """Vectors (N, 3), those that are longer than `most` shortened to it."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    shortened: Array = vectors * np.minimum(1.0, most / np.maximum(lengths, 1e-12))
    return shortened


def shaking(mechanism: Mechanism, duration: float, share: float = 1.0, box: Box = EVERYWHERE, back: bool = False) -> Poses:
    """Sines about home on all axes at once, about 0.8 Hz and a few percent apart, at this share of what the limits and the box
    allow; with `back` they end at home.

    Raises:
        InputError: the mechanism has no home or no limits, or its limits leave no motion.
    """
    limits, home = mechanism.require_limits(), mechanism.require_home()
    times = np.arange(0.0, duration + MARGIN_S + SAMPLE_PERIOD_S, SAMPLE_PERIOD_S)
    spread = float(np.linalg.norm(mechanism.platform_joints, axis=1).mean())
    frequencies = _SHAKING_HZ * (1.0 + 0.04 * (np.arange(6.0) - 2.5))
    shape = np.sin(2.0 * np.pi * frequencies * times[:, None]) * _fade(times) * np.repeat([1.0, 1.0 / spread], 3)
    if back:
        shape *= _fade(duration - times)
    farthest = np.linalg.norm(shape.reshape(-1, 2, 3), axis=2).max(axis=0)
    if mechanism.planar:
        shape[:, 2:5] = 0.0

    def at(size: float) -> tuple[Array, Array]:
        turned = np.array([rotation_from_vector(size * vector) @ home.rotation for vector in shape[:, 3:]])
        return home.position + size * shape[:, :3], turned

    middle, half = limits.stroke.mean(axis=1), 0.5 * (limits.stroke[:, 1] - limits.stroke[:, 0])
    inside = _Inside(mechanism)
    low, high = 0.0, spread
    for _ in range(20):
        size = 0.5 * (low + high)
        lengths = leg_lengths(mechanism, *at(size))
        rates = np.gradient(lengths, SAMPLE_PERIOD_S, axis=0)
        use = max(
            float((np.abs(lengths - middle) / half).max()),
            float(np.abs(rates).max()) / limits.velocity,
            float(np.abs(np.gradient(rates, SAMPLE_PERIOD_S, axis=0)).max()) / limits.acceleration,
            _SHAKING_SHARE * float((size * farthest / box).max()),
        )
        low, high = (size, high) if use < _SHAKING_SHARE and inside(*at(size)).all() else (low, size)
    if low == 0.0:
        raise InputError(
            f"{mechanism.name!r} has no room to shake about home: a limit is too close there; 'gough workspace' shows which: "
            "move home away from it, or widen it"
        )
    return times, *at(share * low)


_FITTED: dict[str, Callable[[Mechanism, float], Poses]] = {
    "near-rests": partial(rests, share=0.4, size=0.5),
    "rests": rests,
    "shaking": shaking,
    "probing": partial(shaking, share=0.3),
}
"""Motions for the calibration, fitted to the limits of the mechanism."""

MOTIONS: dict[str, Callable[[Array, bool], Array]] = {"hold": _hold, "circle": _circle, "sines": _sines, "steps": _steps}
"""Displacements from home (N, 6), position [m] and rotation vector [rad], at times (N,) [s], and in the plane if wanted."""

NAMES = (*MOTIONS, *_FITTED)
HELD = ("steps", "rests", "near-rests")
"""Motions whose poses are held until the next one."""
