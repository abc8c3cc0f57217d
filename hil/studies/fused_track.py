"""Poses that the cycle's fusing stages estimate from raw IMU samples of an imposed motion, and the errors of these poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.cycle import MARKS, STATE, CycleStage, run_stages
from controller.estimation.whole_mechanism.filter import extrapolate_covariance
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.imposed import ImposedMotion
from plant.imu import ImuModel, imu_state, measure
from plant.mechanism import LEGS
from plant.pose import Array, pose_errors, rms_figures

CLOSED, REFINED, WHOLE, LEGS_ALONE = range(4)
"""Steps of a fused track: closed form, refined pose, whole-mechanism filter; times have the leg filters alone as well."""

FUSED = record_dtype(
    positions=(np.float64, (3, 3)),
    rotations=(np.float64, (3, 3, 3)),
    information=(np.float64, (6, 6)),
    covariance=(np.float64, (6, 6)),
    directions=(np.float64, (LEGS, 3)),
    leg_covariances=(np.float64, (LEGS, 2, 2)),
    vertical=(np.float64, 3),
    vertical_covariance=(np.float64, (3, 3)),
    ns=(np.int64, 4),
)
"""Estimates for a sample.

Positions [m] and rotations of the closed form, the refined pose and the whole-mechanism filter; the refined pose's inverse
covariance and the filter's covariance; the directions of the legs and the covariances of their angles [rad^2], by the leg
filters; the vertical in {2}, with its covariance, by the platform filter; durations from raw sample to each step's pose, and of
the leg filters alone [ns].
"""


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


def pooled_rms(figures: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """`position_rms` and `rotation_rms` over several runs, each of which counts the same."""
    return {key: float(np.sqrt(np.mean([each[key] ** 2 for each in figures]))) for key in ("position_rms", "rotation_rms")}


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
        return pooled_rms(self._rms) | {"nees": float(np.mean(self._nees)) if self._nees else None}

    def worst(self) -> dict[str, float]:
        """RMS errors of the worst tracks."""
        return {f"worst_{key}": max(each[key] for each in self._rms) for key in self._rms[0]}


def track(fused: Record, step: int) -> PoseTrack:
    """The poses of one step of a fused track (N,)."""
    return PoseTrack(
        fused["positions"][:, step],
        fused["rotations"][:, step],
        information=fused["information"] if step == REFINED else None,
        covariances=fused["covariance"] if step == WHOLE else None,
        us=float(np.median(fused["ns"][:, step])) / 1e3,
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


def fuse(parameters: Record, raw: Array, state: Record | None = None) -> Record:
    """Run the fusing stages of the cycle over raw samples (N, 3, 7, 3), from a given state or from the start.

    Returns:
        (N,), dtype `FUSED`.
    """
    fused = np.zeros(len(raw), FUSED)
    _follow(
        parameters, np.zeros((), STATE) if state is None else state, raw, fused, np.zeros((LEGS, 1, 5)), np.zeros((), MARKS)[()]
    )
    return fused


@kernel
def _follow(parameters: Record, state: Record, raw: Array, fused: Record, segments: Array, marks: Record) -> None:
    p, s, m = parameters[()], state[()], marks
    for i in range(raw.shape[0]):
        f = fused[i]
        run_stages(parameters, state, raw[i], segments, marks, CycleStage.SCREENING, CycleStage.REFINEMENT)
        f.positions[CLOSED], f.rotations[CLOSED] = s.pose.position, s.pose.rotation
        f.directions[:], f.vertical[:] = s.legs.directions, s.platform.vertical
        f.leg_covariances[:], f.vertical_covariance[:] = s.legs.covariance[:, :2, :2], s.platform.covariance[:3, :3]
        run_stages(parameters, state, raw[i], segments, marks, CycleStage.REFINEMENT, CycleStage.MECHANISM)
        f.positions[REFINED], f.rotations[REFINED] = s.pose.position, s.pose.rotation
        for j in range(6):
            for k in range(6):
                f.information[j, k] = s.pose.information[max(j, k), min(j, k)]
        run_stages(parameters, state, raw[i], segments, marks, CycleStage.MECHANISM, CycleStage.CONTROL)
        f.positions[WHOLE], f.rotations[WHOLE] = s.pose.position, s.pose.rotation
        extrapolate_covariance(p.mechanism.filter, s.mechanism.filter, s.time.cycle * p.rig.period, f.covariance)
        f.ns[LEGS_ALONE] = m.ns[CycleStage.LEGS]
        f.ns[CLOSED] = m.ns[: CycleStage.REFINEMENT].sum()
        f.ns[REFINED] = f.ns[CLOSED] + m.ns[CycleStage.REFINEMENT]
        f.ns[WHOLE] = f.ns[REFINED] + m.ns[CycleStage.MECHANISM]
        s.time.cycle += 1
