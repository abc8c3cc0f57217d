"""How a base moves over time: tilts about axes of {1}, and accelerations along them, in the words of `imu_disturbances`:

    base-tilt,axis=x,size_deg=2,at=3,ramp_s=4
    base-acceleration,axis=0/0.6/0.8,size_g=0.1,sine_hz=3

A base has inertia: a ramp begins and ends gently, and a step takes a tenth of a second. Axes are those of {1}; a base tilts
about its origin.
"""

from collections.abc import Sequence
from enum import IntEnum
from math import radians
from typing import Any

import numpy as np

from plant.checks import nearest
from plant.compiled import Record, filled, kernel, record_dtype
from plant.errors import InputError, UnknownNameError
from plant.files import check_entries
from plant.imu_disturbances import BASE_PREFIX, WORDS, Course, axis_in, course_in, number_in, times_in, words_of_text
from plant.pose import Array, rotation_from_vector

MOST_BASE_MOTIONS = 8
"""The most that act on a base."""

STEP_S = 0.1
"""How long a step of a base takes, and how long it takes at the end of any motion but a ramp or pulses [s]."""


class BaseMotionKind(IntEnum):
    """What a base does."""

    sizes: dict[str, float]  # words for its size, with the factor to SI units
    text: str

    def __new__(cls, sizes: dict[str, float], text: str) -> "BaseMotionKind":
        """The next member."""
        kind = int.__new__(cls, len(cls.__members__) + 1)
        kind._value_ = len(cls.__members__) + 1
        kind.sizes, kind.text = sizes, text
        return kind

    @property
    def label(self) -> str:
        """The kind's name as text, such as base-tilt."""
        return BASE_PREFIX + self.name.lower()

    TILT = {"size_deg": radians(1.0)}, "the base tilts about this axis of {1} through its origin"
    ACCELERATION = {"size_m_per_s2": 1.0, "size_g": 9.80665}, "the base is accelerated along this axis of {1}"


BASE_MOTION = record_dtype(
    kind=np.int64,  # BaseMotionKind; 0: none
    course=np.int64,  # Course
    axis=(np.float64, 3),  # unit vector, in {1}
    size=np.float64,  # angle [rad], or acceleration [m/s^2]
    rise=np.float64,  # time in which it comes, and goes at its end [s]; 0 for pulses
    span=np.float64,  # time constant, period, or duration of a pulse [s]
    every=np.float64,  # time from pulse to pulse [s]
    begin=np.float64,  # [s]
    end=np.float64,  # [s]
)
"""One motion of a base."""


def base_motion(kind: str, **words: Any) -> Record:
    """A motion of the base (dtype `BASE_MOTION`) from its words, which begins below 0 if it is there from the start.

    Args:
        kind: tilt or acceleration.
        words: `axis`, the size by one of `size_deg`, `size_m_per_s2` and `size_g`, and the times and courses of
            `plant.imu_disturbances.WORDS`.

    Raises:
        UnknownNameError: there is no such kind.
        InputError: a word is missing, unknown or out of range.
    """
    kinds = {each.name.lower(): each for each in BaseMotionKind}
    if kind not in kinds:
        raise UnknownNameError(f"there is no motion {kind!r} of a base; there are {', '.join(kinds)}{nearest(kind, kinds)}")
    made, title = kinds[kind], f"the base's {kind}"
    check_entries(words, [word for word in WORDS if word not in ("imus", "sensor")] + [*made.sizes], title)
    sizes = [word for word in made.sizes if word in words]
    if len(sizes) != 1:
        raise InputError(f"{title} needs one of {', '.join(made.sizes)}, and it has {' and '.join(sizes) or 'none'}")
    size = number_in(words, sizes[0], title) * made.sizes[sizes[0]]
    course, span, every = course_in(words, title)
    rise = {Course.RAMP: span, Course.PULSES: 0.0}.get(course, STEP_S)
    begin, duration = times_in(words, title)
    return filled(
        BASE_MOTION, kind=made, course=course, axis=axis_in(words, title, False), size=size, rise=rise, span=span, every=every,
        begin=begin, end=max(begin, 0.0) + duration,
    )  # fmt: skip


def placed(motion: Record, origin: float) -> Record:
    """A motion whose times count from `origin` [s]; one from the start is there at 0, and a step has been there before."""
    made: Record = motion.copy()
    if motion["begin"] < 0.0:
        made["begin"] = -motion["rise"] if motion["course"] == Course.STEP else 0.0
    else:
        made["begin"], made["end"] = motion["begin"] + origin, motion["end"] + origin
    return made


def base_motion_of_text(text: str) -> Record:
    """A motion of the base (dtype `BASE_MOTION`) from text; `at` and `for` do for `at_s` and `for_s`.

    Raises:
        GoughError: as `base_motion`.
    """
    name, which, words = words_of_text(text)
    if which:
        raise InputError(f"{text!r} names {which!r} after a colon, and there is one base: leave it out")
    return base_motion(name.removeprefix(BASE_PREFIX), **words)


BASE_SIZE = 12
"""Rotation vector [rad], angular velocity [rad/s], angular acceleration [rad/s^2] and acceleration [m/s^2], three of each."""


@kernel
def _window(time: float, rise: float) -> tuple[float, float, float]:
    """From 0 to 1 within `rise` [s], without a jump of the second derivative; with the two derivatives."""
    if time <= 0.0:
        return 0.0, 0.0, 0.0
    if time >= rise:
        return 1.0, 0.0, 0.0
    x = time / rise
    y = x * (1.0 - x)
    return x * x * x * (10.0 - x * (15.0 - 6.0 * x)), 30.0 * y * y / rise, 60.0 * y * (1.0 - 2.0 * x) / rise**2


@kernel
def _course(m: Record, time: float) -> tuple[float, float, float]:
    """The size of a motion at a time since its begin [s], as if it went on for ever, and two derivatives."""
    if m.course == Course.SETTLE:
        left = np.exp(-time / m.span)
        return 1.0 - left, left / m.span, -left / m.span**2
    if m.course == Course.STEP or m.course == Course.RAMP:
        return 1.0, 0.0, 0.0
    turns = 2.0 * np.pi / m.span
    if m.course == Course.PULSES:
        turns *= 0.5
        if time >= m.every:
            time -= np.floor(time / m.every) * m.every
        if time >= m.span:
            return 0.0, 0.0, 0.0
    wave = np.sin(turns * time)
    return wave, turns * np.cos(turns * time), -(turns**2) * wave


@kernel
def level(m: Record, time: float) -> tuple[float, float, float]:
    """The size of a motion (dtype `BASE_MOTION`) at a time [s], with its first and second derivative."""
    if time < m.begin or time >= m.end + m.rise:
        return 0.0, 0.0, 0.0
    size, rate, change = _course(m, time - m.begin)
    if m.rise > 0.0:
        come, coming, hurry = _window(time - m.begin, m.rise)
        gone, going, haste = _window(time - m.end, m.rise)
        w, dw, ddw = come - gone, coming - going, hurry - haste
        size, rate, change = size * w, rate * w + size * dw, change * w + 2.0 * rate * dw + size * ddw
    return m.size * size, m.size * rate, m.size * change


@kernel
def base_motion_at(motions: Record, count: int, time: float, motion: Array) -> None:
    """The motion (12,) of a base, as the plant's inputs take it, under the first `count` motions at a time [s].

    Tilts add up as a rotation vector phi. Seen in {1} the angular velocity is `phi' - b phi x phi' + c phi x (phi x phi')`,
    b = (1 - cos |phi|) / |phi|^2, c = (|phi| - sin |phi|) / |phi|^3.
    """
    motion[:] = 0.0
    for i in range(count):
        m = motions[i]
        size, rate, change = level(m, time)
        for j in range(3):
            if m.kind == BaseMotionKind.ACCELERATION:
                motion[9 + j] += size * m.axis[j]
            else:
                motion[j] += size * m.axis[j]
                motion[3 + j] += rate * m.axis[j]
                motion[6 + j] += change * m.axis[j]
    px, py, pz = motion[0], motion[1], motion[2]
    rx, ry, rz = motion[3], motion[4], motion[5]
    square = px * px + py * py + pz * pz
    if square > 1e-3:
        angle = np.sqrt(square)
        sine, cosine = np.sin(angle), np.cos(angle)
        b, c = (1.0 - cosine) / square, (angle - sine) / (square * angle)
        b_slope, c_slope = (sine / angle - 2.0 * b) / square, (b - 3.0 * c) / square
    else:
        b, c = 0.5 - square / 24.0 + square**2 / 720.0, 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0
        b_slope, c_slope = -1.0 / 12.0 + square / 180.0, -1.0 / 60.0 + square / 1260.0
    along = px * rx + py * ry + pz * rz
    # phi x phi', and phi x (phi x phi')
    ux, uy, uz = py * rz - pz * ry, pz * rx - px * rz, px * ry - py * rx
    vx, vy, vz = py * uz - pz * uy, pz * ux - px * uz, px * uy - py * ux
    motion[3] += c * vx - b * ux
    motion[4] += c * vy - b * uy
    motion[5] += c * vz - b * uz
    ax, ay, az = motion[6], motion[7], motion[8]
    # phi x phi'', and phi x (phi x phi'')
    sx, sy, sz = py * az - pz * ay, pz * ax - px * az, px * ay - py * ax
    tx, ty, tz = py * sz - pz * sy, pz * sx - px * sz, px * sy - py * sx
    bs, cs = b_slope * along, c_slope * along
    motion[6] += c * (tx + ry * uz - rz * uy) - b * sx - bs * ux + cs * vx
    motion[7] += c * (ty + rz * ux - rx * uz) - b * sy - bs * uy + cs * vy
    motion[8] += c * (tz + rx * uy - ry * ux) - b * sz - bs * uz + cs * vz


def base_motions_at(motions: Sequence[Record], times: Array) -> Array:
    """The motion (N, 12) of a base under such motions at times (N,) [s], each as `base_motion_at` has it."""
    made, found = np.zeros(max(len(motions), 1), BASE_MOTION), np.empty((len(times), BASE_SIZE))
    for place, each in enumerate(motions):
        made[place] = each
    for motion, time in zip(found, times, strict=True):
        base_motion_at(made, len(motions), time, motion)
    return found


def attitudes_of(motions: Sequence[Record], times: Array) -> Array:
    """The attitudes (N, 3, 3) of a base under such motions at times (N,) [s]: they turn {1} to where it was before."""
    attitudes = np.empty((len(times), 3, 3))
    for attitude, motion in zip(attitudes, base_motions_at(motions, times), strict=True):
        attitude[:] = rotation_from_vector(motion[:3])
    return attitudes


def displacements_of(motions: Sequence[Record], times: Array) -> Array:
    """Where a base is (N, 3) [m] under such motions at even times (N,) [s], on the axes that {1} has at rest.

    A steady speed, a mean place and a mean acceleration are taken off: what an unknown start gives, and no sensor tells.
    """
    moved = base_motions_at(motions, times)
    attitudes = attitudes_of(motions, times)
    accelerations = (attitudes @ moved[:, 9:, None])[..., 0]
    period = float(times[1] - times[0]) if len(times) > 1 else 0.0
    places = period**2 * np.cumsum(np.cumsum(accelerations, axis=0), axis=0)
    powers = np.vander(np.linspace(-1.0, 1.0, len(times)), 3)
    displacements: Array = places - powers @ np.linalg.lstsq(powers, places, rcond=None)[0]
    return displacements
