"""Poses that the cycle's fusing stages estimate from raw IMU samples of an imposed motion, and the errors of these poses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.cycle import STATE
from controller.estimation.fusion import (
    calibrate,
    find_pose,
    fuse_heading,
    fuse_legs,
    fuse_mechanism,
    fuse_platform,
    improve_pose,
)
from controller.estimation.mechanism_filter import extrapolate_covariance
from hil.realtime.clock import now
from plant.compiled import Record, kernel
from plant.dynamics.imposed import ImposedMotion
from plant.imu import ImuModel, imu_state, measure
from plant.mechanism import LEGS
from plant.pose import Array, pose_errors, rms_figures

CLOSED, REFINED, WHOLE, LEGS_ALONE = range(4)
"""Steps of a `FusedTrack`: closed form, refined pose, whole-mechanism filter; times have the leg filters alone as well."""


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses along a motion, true or estimated.

    Attributes:
        positions: (N, 3) [m].
        rotations: (N, 3, 3).
        information: (N, 6, 6), the inverse of the covariances that the method states.
        covariances: (N, 6, 6), where the method states them without an inverse.
        us: median time of a cycle from raw sample to pose [us].
    """

    positions: Array
    rotations: Array
    information: Array | None = None
    covariances: Array | None = None
    us: float | None = None

    def at(self, samples: slice | NDArray[np.bool_]) -> "PoseTrack":
        """Some of the poses."""

        def part(values: Array | None) -> Array | None:
            return None if values is None else values[samples]

        taken = self.positions[samples], self.rotations[samples], part(self.information), part(self.covariances)
        return PoseTrack(*taken, us=self.us)

    def errors(self, truth: "PoseTrack") -> Array:
        """Errors (N, 6) against the true poses [m, rad]."""
        return pose_errors(self.positions, self.rotations, truth.positions, truth.rotations)

    def nees(self, errors: Array) -> float | None:
        """Mean square of the errors (N, 6) over the stated covariances: 6 is consistent; None without covariances."""
        information = self.information
        if self.covariances is not None:
            information = np.linalg.inv(self.covariances)
        return None if information is None else float(np.einsum("ni,nij,nj->n", errors, information, errors).mean())


def poses_of(motion: ImposedMotion, samples: slice) -> PoseTrack:
    """The true poses of a motion in some samples, copied: the motion's readings need not be kept."""
    return PoseTrack(motion.positions[samples].copy(), motion.rotations[samples].copy())


class PoseErrors:
    """Errors of tracks, pooled: every track counts the same."""

    def __init__(self) -> None:
        """Start without a track."""
        self._rms: list[dict[str, float]] = []
        self._nees: list[float] = []

    def add(self, track: PoseTrack, truth: PoseTrack) -> None:
        """Add the errors of a track against the true poses."""
        errors = track.errors(truth)
        self._rms.append(rms_figures(errors))
        if (nees := track.nees(errors)) is not None:
            self._nees.append(nees)

    def figures(self) -> dict[str, float | None]:
        """RMS errors over all tracks, `position_rms` [m] and `rotation_rms` [rad], and the mean `nees`, if there is one."""
        rms = {key: float(np.sqrt(np.mean([each[key] ** 2 for each in self._rms]))) for key in self._rms[0]}
        return rms | {"nees": float(np.mean(self._nees)) if self._nees else None}

    def worst(self) -> dict[str, float]:
        """RMS errors of the worst tracks."""
        return {f"worst_{key}": max(each[key] for each in self._rms) for key in self._rms[0]}


class FusedTrack:
    """The estimates of the fusing stages over N samples.

    Attributes:
        positions, rotations: (3, N, 3) [m] and (3, N, 3, 3), by step: closed form, refined pose, whole-mechanism filter.
        information: (N, 6, 6), the inverse covariances of the refined poses.
        covariances: (N, 6, 6), of the poses of the whole-mechanism filter.
        directions, leg_covariances: (N, 6, 3) and (N, 6, 2, 2) [rad^2], of the legs and of their angles, by the leg filters.
        verticals, vertical_covariances: (N, 3) and (N, 3, 3), the vertical in {2}, by the platform filter.
        ns: (4, N), from raw sample to each step's pose, and of the leg filters alone [ns].
    """

    def __init__(self, count: int) -> None:
        """Make room for so many samples."""
        self.positions, self.rotations = np.zeros((3, count, 3)), np.zeros((3, count, 3, 3))
        self.information, self.covariances = np.zeros((count, 6, 6)), np.zeros((count, 6, 6))
        self.directions, self.verticals = np.zeros((count, LEGS, 3)), np.zeros((count, 3))
        self.leg_covariances, self.vertical_covariances = np.zeros((count, LEGS, 2, 2)), np.zeros((count, 3, 3))
        self.ns = np.zeros((4, count), np.int64)

    def track(self, step: int) -> PoseTrack:
        """The poses of one step."""
        return PoseTrack(
            self.positions[step],
            self.rotations[step],
            information=self.information if step == REFINED else None,
            covariances=self.covariances if step == WHOLE else None,
            us=float(np.median(self.ns[step])) / 1e3,
        )


def read(motion: ImposedMotion, model: ImuModel, rate: float, seed: int) -> Array:
    """Raw samples (N, 3, 7, 3) of imperfect IMUs on a motion, at this rate [Hz]."""
    raw = np.empty_like(motion.signals)
    measure_all(imu_state(model, seed, 1.0 / rate), motion.signals, raw)
    return raw


@kernel
def measure_all(imu: Record, signals: Array, raw: Array) -> None:
    """Write the raw samples (N, 3, 7, 3) of imperfect IMUs for ideal signals."""
    for i in range(signals.shape[0]):
        measure(imu, signals[i], raw[i])


def fuse(parameters: Record, raw: Array, state: Record | None = None) -> FusedTrack:
    """Run the fusing stages of the cycle over raw samples (N, 3, 7, 3), from a given state or from the start."""
    fused, state = FusedTrack(len(raw)), np.zeros((), STATE) if state is None else state
    _follow(
        parameters, state, raw, fused.positions, fused.rotations, fused.information, fused.covariances, fused.directions,
        fused.leg_covariances, fused.verticals, fused.vertical_covariances, fused.ns, np.zeros(2, np.int64),
    )  # fmt: skip
    return fused


@kernel
def _follow(
    parameters: Record, state: Record, raw: Array, positions: Array, rotations: Array, information: Array, covariances: Array,
    directions: Array, leg_covariances: Array, verticals: Array, vertical_covariances: Array, ns: NDArray[np.int64],
    timespec: NDArray[np.int64],
) -> None:  # fmt: skip
    s = state[()]
    for i in range(raw.shape[0]):
        began = now(timespec)
        calibrate(parameters, state, raw[i])
        before_legs = now(timespec)
        fuse_legs(parameters, state)
        ns[LEGS_ALONE, i] = now(timespec) - before_legs
        fuse_platform(parameters, state)
        fuse_heading(parameters, state)
        find_pose(parameters, state)
        ns[0, i] = now(timespec) - began
        positions[0, i], rotations[0, i] = s.position, s.rotation
        directions[i], verticals[i] = s.directions, s.vectors[0]
        leg_covariances[i], vertical_covariances[i] = s.leg_covariance[:, :2, :2], s.platform_covariance[:3, :3]
        began = now(timespec)
        improve_pose(parameters, state)
        ns[1, i] = ns[0, i] + now(timespec) - began
        positions[1, i], rotations[1, i] = s.position, s.rotation
        for j in range(6):
            for k in range(6):
                information[i, j, k] = s.information[max(j, k), min(j, k)]
        began = now(timespec)
        fuse_mechanism(parameters, state, True)
        ns[2, i] = ns[1, i] + now(timespec) - began
        positions[2, i], rotations[2, i] = s.position, s.rotation
        extrapolate_covariance(parameters[()].filter, s.filter, s.cycle * parameters[()].period, covariances[i])
        s.cycle += 1
