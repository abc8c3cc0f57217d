"""The course of a base's motion over time, for an FMU that takes one: tilts about axes of {1}, and accelerations along them."""

import numpy as np

from plant.compiled import Record, kernel, record_dtype
from plant.pose import Array

MOST_BASE_MOTIONS = 8
"""The most that act on a base."""

TILT, SHAKE = range(2)
STEADY, SETTLE, SINE, PULSES = range(4)

BASE_MOTION = record_dtype(
    kind=np.int64,  # TILT or SHAKE
    course=np.int64,  # STEADY, SETTLE, SINE or PULSES
    axis=(np.float64, 3),  # unit vector, in {1}
    size=np.float64,  # angle [rad], or acceleration [m/s^2]
    rise=np.float64,  # time in which it comes, and goes at its end [s]; 0 for pulses
    span=np.float64,  # time constant, period, or duration of a pulse [s]
    every=np.float64,  # time from pulse to pulse [s]
    begin=np.float64,  # [s]
    end=np.float64,  # [s]
)
"""One motion of a base. Steady ones with a rise are steps and ramps."""

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
    if m.course == SETTLE:
        left = np.exp(-time / m.span)
        return 1.0 - left, left / m.span, -left / m.span**2
    if m.course == STEADY:
        return 1.0, 0.0, 0.0
    turns = 2.0 * np.pi / m.span
    if m.course == PULSES:
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
            if m.kind == SHAKE:
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
