"""The encoders of the legs: which readings are used, what their zeros are, and the pose with them.

A reading is `length + zero`. Encoders tell how a length changes far better than IMUs do, and incremental ones tell nothing of
where it began, which the IMUs do. So the pose that the IMUs have is moved to the lengths, as if their zeros were exact, and
these are the mean differences between readings and the IMUs' lengths. The pose's covariance knows that they are no better than
that. A zero is exact once the leg has passed its home switch; an absolute encoder's is so from the start.

Without a reading, as when an answer of the rig is lost, the last difference from the IMUs counts for a moment: the pose goes on
from where it is, instead of to that of the IMUs and back.

Where the IMUs do not determine the pose, absolute encoders lead: the pose is that of least squares over lengths and IMUs, found
by iteration from home or from the last pose. Lengths alone belong to several poses, of which this finds the nearest.
"""

import numpy as np
from numpy.typing import NDArray

from controller.direct_kinematics.refinement import (
    find_twist,
    move_pose,
    normal_equations,
    solve_normal_equations,
    stay_in_plane,
)
from controller.estimation.pose_estimator import follow_twist
from controller.inverse_kinematics import legs_at
from controller.least_squares import solve_cholesky
from controller.rig import elapsed
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.encoders import EncoderModel
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array
from plant.vectors import cross, rotate, vector

_FORGETTING_S = 30.0
"""A zero is the mean over all the time that it has been followed, and at most over as long [s]."""

_SETTLING_S = 0.25
"""For twice as long a difference counts in that mean by the time before it: the IMUs' lengths are means that get better [s]."""

_HELD_S = 0.03
"""For so long an encoder without a reading counts by its last one: longer than it takes to tell that the bus is lost [s]."""

_LONGEST_STEP_M = 5e-4
"""Readings that are farther apart do not tell where the leg passed its home switch [m]."""

_MOST_STEPS = 20
_SETTLED = 1e-9
"""A step below this ends the iteration from a first guess [m, rad]."""

_MOST_LEFT_M = 1e-3
"""Lengths that a pose misses by more belong to no pose near the first guess [m]."""

PARAMETERS = record_dtype(
    count=np.int64,  # how many encoders there are
    present=(np.int64, LEGS),  # which legs have one
    absolute=np.int64,  # whether their zeros are known
    variance=np.float64,  # of a reading about its zero, play included [m^2]
    zero_variance=np.float64,  # of a zero that is known [m^2]
    switch=(np.float64, LEGS),  # length at which the home switch closes; NaN without one [m]
    lead=np.int64,  # whether the pose is the lengths', as the IMUs do not determine it
    position=(np.float64, 3),  # of home [m]
    rotation=(np.float64, (3, 3)),
    leg_sigma=np.float64,  # of a leg's direction in the refinement [rad]
)
"""Constants of the encoders."""

STATE = record_dtype(
    reading=(np.float64, LEGS),  # last one; NaN for none [m]
    carried=(np.float64, LEGS),  # the same, carried on at its rate while there is none [m]
    rate=(np.float64, LEGS),  # of the last one [m/s]
    silent_for=(np.float64, LEGS),  # how long there has been none [s]
    home=(np.int64, LEGS),  # last state of the home switch: 1 beyond it, 0 before it, -1 not known
    used=(np.float64, LEGS),  # 1 if the reading is used
    counts=(np.float64, LEGS),  # the same, or whether the last one was, for `_HELD_S`
    passed_switch=(np.int64, LEGS),  # whether the leg has passed its home switch since the last cycle
    switch_step=(np.float64, LEGS),  # between the readings before and after the switch: it was passed between these [m]
    excluded=(np.int64, LEGS),  # whether the encoder contradicts the rest
    zero=(np.float64, LEGS),  # what it reads more than the length [m]
    followed_for=(np.float64, LEGS),  # how long the zero has been followed; infinite for one that is known [s]
    off=(np.float64, LEGS),  # reading less zero and the IMUs' length [m]; NaN without a reading for `_HELD_S`
    covariance=(np.float64, (LEGS, LEGS)),  # of these differences, as the IMUs know the pose [m^2]
    unseen=(np.float64, LEGS),  # by how much the reading could be off unseen, if its zero is known [m]
    information=(np.float64, (6, 6)),  # from here on scratch
    factor=(np.float64, (6, 6)),
    correction=(np.float64, 6),
    row=(np.float64, 6),
    rows=(np.float64, (LEGS, 6)),
)
"""State of the encoders."""


def encoder_parameters(model: EncoderModel | None, fusion: FusionSettings, mechanism: Mechanism, lead: bool = False) -> Record:
    """The constants of the encoders (dtype `PARAMETERS`); none are present without a model.

    Args:
        lead: whether the pose is the lengths', as the IMUs do not determine it.
    """
    legs, home = mechanism.legs, mechanism.require_home()
    p = filled(
        PARAMETERS,
        lead=lead,
        position=home.position,
        rotation=home.rotation,
        leg_sigma=fusion.leg_sigma,
        count=0 if model is None else legs,
        present=[model is not None and leg < legs for leg in range(LEGS)],
        absolute=model is not None and model.absolute,
        variance=fusion.length_noise**2 + fusion.length_play**2,
        zero_variance=fusion.length_zero**2,
        switch=np.nan,
    )
    if model is not None:
        p["switch"][: len(model.switches)] = model.switches
    return p


@shared_kernel
def screen_encoders(
    p: Record, s: Record, passed: float, silent: int, readings: Array, rates: Array, home: NDArray[np.int64]
) -> None:
    """Before a cycle: take readings [m], rates [m/s] and home switches (6,), and find out which of them can be used.

    Args:
        passed: time since the last cycle [s].
        silent: for how many cycles the rig has not answered.
    """
    for k in range(LEGS):
        before, known = s.carried[k], s.silent_for[k] == 0.0
        s.reading[k] = readings[k]
        if silent == 0 and np.isfinite(readings[k]):
            s.carried[k], s.rate[k], s.silent_for[k] = readings[k], rates[k], 0.0
        else:
            s.carried[k] += passed * s.rate[k]
            s.silent_for[k] += passed
        good = p.present[k] != 0 and s.silent_for[k] == 0.0 and s.excluded[k] == 0
        s.used[k] = 1.0 if good else 0.0
        switched = good and home[k] >= 0 and s.home[k] >= 0 and home[k] != s.home[k] and np.isfinite(p.switch[k])
        # The switch was passed between two readings. If one of them is missing, or they are far apart, the zero is not exact.
        step = readings[k] - before
        s.passed_switch[k] = 1 if switched and known and abs(step) < _LONGEST_STEP_M else 0
        if s.passed_switch[k] != 0:
            s.switch_step[k] = step
            s.zero[k] = before + 0.5 * step - p.switch[k]
            s.followed_for[k] = np.inf
        if good:
            s.home[k] = home[k]


@kernel
def compare_lengths(p: Record, s: Record, rig: Record, pose: Record) -> None:
    """Find by how much the encoders' lengths are off those of the pose, which the IMUs have, and how well that is known; a zero
    begins there.
    """
    legs_at(
        rig.geometry.base_joints, rig.geometry.platform_joints, pose.position, pose.rotation, pose.arms, pose.directions,
        pose.lengths,
    )  # fmt: skip
    for k in range(rig.legs):
        if s.used[k] != 0.0 and s.followed_for[k] == 0.0 and p.absolute == 0:
            s.zero[k] = s.reading[k] - pose.lengths[k]
        if s.silent_for[k] == 0.0:
            s.off[k] = s.reading[k] - s.zero[k] - pose.lengths[k]
        elif s.followed_for[k] == 0.0 or s.silent_for[k] > _HELD_S:
            s.off[k] = np.nan
        _find_row(pose, k, s.row)
        for i in range(6):
            # With the Cholesky factor L of the pose's information, the covariance is that of L^-1 times the rows.
            value = s.row[i]
            for j in range(i):
                value -= pose.factor[i, j] * s.rows[k, j]
            s.rows[k, i] = value / pose.factor[i, i]
        for other in range(k + 1):
            value = 0.0
            for i in range(6):
                value += s.rows[k, i] * s.rows[other, i]
            s.covariance[k, other] = s.covariance[other, k] = value


@kernel
def _count(s: Record, k: int) -> bool:
    """Find out whether the encoder of leg `k` counts, after it has been judged."""
    if s.silent_for[k] == 0.0:
        s.counts[k] = s.used[k]
    elif s.silent_for[k] > _HELD_S or s.excluded[k] != 0:
        s.counts[k] = 0.0
    return bool(s.counts[k] != 0.0)


@kernel
def move_to_lengths(p: Record, s: Record, rig: Record, time: Record, pose: Record) -> bool:
    """Move the pose that has just been compared to the encoders' lengths; False if that has no solution."""
    pose.bent[:] = 0.0
    for i in range(6):
        s.correction[i] = 0.0
        for j in range(i + 1):
            s.information[i, j] = pose.information[i, j]
    used = 0
    for k in range(rig.legs):
        if not _count(s, k):
            continue
        used += 1
        row = s.row
        _find_row(pose, k, row)
        if s.silent_for[k] == 0.0:
            _follow_zero(p, s, elapsed(rig, time), k)
        uncertain = p.zero_variance if s.followed_for[k] == np.inf else s.covariance[k, k]
        weight, known = 1.0 / p.variance, 1.0 / (p.variance + uncertain)
        for i in range(6):
            s.correction[i] += weight * s.off[k] * row[i]
            for j in range(i + 1):
                s.information[i, j] += weight * row[i] * row[j]
                pose.information[i, j] += known * row[i] * row[j]
    if used == 0:
        return True
    if rig.planar != 0:
        stay_in_plane(s.information, s.correction)
        stay_in_plane(pose.information, pose.correction)
    if not solve_normal_equations(s.information, s.correction, s.factor):
        return False
    move_pose(s.correction, pose.position, pose.rotation)
    _find_bent(p, s, rig, pose)
    return True


@kernel
def _find_bent(p: Record, s: Record, rig: Record, pose: Record) -> None:
    """Write how far the encoder that could move the pose the most could do so unseen."""
    for k in range(rig.legs):
        if s.counts[k] == 0.0 or s.unseen[k] == 0.0:
            continue
        _find_row(pose, k, s.correction)
        solve_cholesky(s.factor, s.correction)
        for part in range(2):
            squared = 0.0
            for i in range(3 * part, 3 * part + 3):
                squared += s.correction[i] ** 2
            pose.bent[part] = max(pose.bent[part], s.unseen[k] / p.variance * np.sqrt(squared))


@kernel
def find_pose_by_lengths(
    p: Record, s: Record, estimator: Record, rig: Record, time: Record, legs: Record, platform_rate: Array, pose: Record
) -> bool:
    """Find pose and twist from lengths and IMUs together, starting from the last pose, or from home if there is none; False if
    there is none near.

    Args:
        estimator: constants of the pose's estimator.
        platform_rate: (3,), angular velocity in {2} [rad/s].
    """
    if pose.found == 0:
        pose.position[:] = p.position
        pose.rotation[:] = p.rotation
    pose.weights[:LEGS] = legs.weights
    pose.weights[LEGS:] = pose.vector_weights
    pose.misfit = pose.rest_misfit = 0.0
    weight, settled = 1.0 / (p.variance + p.zero_variance), False
    for k in range(rig.legs):
        _count(s, k)
    for _ in range(_MOST_STEPS):
        normal_equations(
            rig.geometry.base_joints, rig.geometry.platform_joints, legs.directions, pose.weights[:LEGS], rig.vectors_in_base,
            pose.vectors, pose.vector_weights, pose.position, pose.rotation, pose.arms, pose.directions, pose.lengths,
            pose.information, pose.correction,
        )  # fmt: skip
        for k in range(rig.legs):
            if s.counts[k] != 0.0:
                s.off[k] = s.carried[k] - pose.lengths[k]
                _find_row(pose, k, s.row)
                for i in range(6):
                    pose.correction[i] += weight * s.off[k] * s.row[i]
                    for j in range(i + 1):
                        pose.information[i, j] += weight * s.row[i] * s.row[j]
        if rig.planar != 0:
            stay_in_plane(pose.information, pose.correction)
        if settled or not solve_normal_equations(pose.information, pose.correction, pose.factor):
            break
        move_pose(pose.correction, pose.position, pose.rotation)
        longest = 0.0
        for i in range(6):
            longest = max(longest, abs(pose.correction[i]))
        settled = longest < _SETTLED
    if not settled:
        return False
    for k in range(rig.legs):
        if s.counts[k] != 0.0 and abs(s.off[k]) > _MOST_LEFT_M:
            return False
    turning = rotate(pose.rotation, vector(platform_rate))
    pose.angular_velocity[0], pose.angular_velocity[1], pose.angular_velocity[2] = turning
    find_twist(
        legs.rates, pose.weights[:LEGS], pose.vectors, pose.vector_weights, pose.angular_velocity, pose.rotation, pose.arms,
        pose.directions, pose.lengths, pose.factor, pose.twist,
    )  # fmt: skip
    s.correction[:] = 0.0
    for k in range(rig.legs):
        if s.counts[k] != 0.0:
            _find_row(pose, k, s.row)
            for i in range(6):
                s.correction[i] += weight * s.rate[k] * s.row[i]
    solve_cholesky(pose.factor, s.correction)
    for i in range(6):
        pose.twist[i] += s.correction[i]
    follow_twist(estimator, pose, rig, time)
    pose.conditioning = 1.0
    for i in range(6):
        # Relative to a direction that a leg's IMU measures.
        known = pose.factor[i, i] * p.leg_sigma * (rig.geometry.spreads[-1] if i < 3 else 1.0)
        pose.conditioning = min(pose.conditioning, known)
    return True


@kernel
def _find_row(pose: Record, k: int, row: Array) -> None:
    """Write how the length of leg `k` changes with a small move (6,) of the platform."""
    d, turn = pose.directions[k], cross(vector(pose.arms[k]), vector(pose.directions[k]))
    for i in range(3):
        row[i], row[3 + i] = d[i], turn[i]


@kernel
def _follow_zero(p: Record, s: Record, passed: float, k: int) -> None:
    """Take what the encoder of leg `k` reads more than the IMUs' length into the mean that is its zero."""
    if p.absolute != 0:
        s.followed_for[k] = np.inf
    s.followed_for[k] += passed
    if s.followed_for[k] < np.inf:
        span = min(max(0.5 * s.followed_for[k], s.followed_for[k] - _SETTLING_S), _FORGETTING_S)
        change = min(1.0, passed / span) * s.off[k]
        s.zero[k] += change
        s.off[k] -= change
