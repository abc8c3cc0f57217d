"""Poses that the cycle estimates from raw IMU samples of an imposed motion, and their errors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.calibration.file import Calibration
from controller.cycle import MARKS, STATE, CycleStage, cycle_parameters, run_stages
from controller.estimation.platform_filter import vertical_covariance
from controller.estimation.whole_mechanism.trust import find_covariance
from controller.settings import control_settings, sensor_settings
from hil.runs.config import FUSIONS
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.imposed_motion import ImposedMotion, impose
from plant.imu import imu_state, load_imu, measure
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, pose_errors, rms_figures

CLOSED, REFINED, WHOLE, LEGS_ALONE = range(4)
"""Steps of a fused track: closed form, refined pose, whole-mechanism filter; of times, the leg filters too."""

FUSED = record_dtype(
    positions=(np.float64, (3, 3)),  # of each step [m]
    rotations=(np.float64, (3, 3, 3)),
    information=(np.float64, (6, 6)),  # of the refined pose: the inverse of its covariance
    covariance=(np.float64, (6, 6)),  # of the pose, as the loop states it
    directions=(np.float64, (LEGS, 3)),  # of the legs, by the leg filters
    leg_covariances=(np.float64, (LEGS, 2, 2)),  # of the angles of each leg [rad^2]
    vertical=(np.float64, 3),  # in {2}, by the platform filter
    vertical_covariance=(np.float64, (3, 3)),
    ns=(np.int64, 4),  # from the raw sample to each step [ns]
)
"""Estimates for a sample."""

Figures = dict[str, Any]
"""Errors by name; `nees` is None without covariances."""
RMS = ("position_rms", "rotation_rms")


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses along a motion, true or estimated.

    Attributes:
        positions: (N, 3) [m].
        rotations: (N, 3, 3).
        covariances, information: (N, 6, 6), as the method states them, or their inverse.
        us: median time from raw sample to pose [us].
    """

    positions: Array
    rotations: Array
    information: Array | None = None
    covariances: Array | None = None
    us: float = np.nan

    def errors(self, truth: "PoseTrack") -> Array:
        """Errors (N, 6) against the true poses [m, rad]."""
        return pose_errors(self.positions, self.rotations, truth.positions, truth.rotations)

    def figures(self, truth: "PoseTrack") -> Figures:
        """`position_rms` [m], `rotation_rms` [rad] and `nees` against the true poses, and `us`."""
        errors = self.errors(truth)
        return rms_figures(errors) | {"nees": self.nees(errors), "us": self.us}

    def nees(self, errors: Array) -> float | None:
        """Mean NEES of the errors (N, 6): 6 is consistent; None without covariances."""
        information = self.information if self.covariances is None else np.linalg.inv(self.covariances)
        if information is None:
            return None
        return float(np.einsum("ni,nij,nj->n", errors, information, errors).mean())


def pooled(figures: Sequence[Figures], worst: bool = False) -> Figures:
    """The errors over several tracks that count the same; `worst_position_rms` and `worst_rotation_rms` if asked for."""
    result: Figures = {key: float(np.sqrt(np.mean([each[key] ** 2 for each in figures]))) for key in RMS}
    if "nees" in figures[0]:
        result["nees"] = None if figures[0]["nees"] is None else float(np.mean([each["nees"] for each in figures]))
    return result | ({f"worst_{key}": max(each[key] for each in figures) for key in RMS} if worst else {})


def track(fused: Record, step: int) -> PoseTrack:
    """The poses of one step of a fused track (N,)."""
    return PoseTrack(
        fused["positions"][:, step],
        fused["rotations"][:, step],
        information=fused["information"] if step == REFINED else None,
        covariances=fused["covariance"] if step == WHOLE else None,
        us=float(np.median(fused["ns"][:, step])) / 1e3,
    )


def constants(mechanism: Mechanism, imu: str, rate: float, fusion: str, calibration: Calibration | None = None) -> Record:
    """The cycle's constants with all IMUs; `fusion` is a key of `hil.runs.config.FUSIONS`."""
    control, sensors = control_settings(mechanism), sensor_settings(mechanism, load_imu(imu), rate)
    section_5 = fusion == "section-5"
    return cycle_parameters(mechanism, rate, control, sensors, ALL_IMUS, FUSIONS[fusion], calibration, section_5, section_5)


def read(motion: ImposedMotion, imu: Record, late: slice) -> tuple[Array, PoseTrack]:
    """Raw samples (N, 3, 7, 3) of imperfect IMUs, whose state goes on, on a motion; and the true poses in some of them."""
    raw = np.empty_like(motion.signals)
    _measure(imu, motion.signals, raw)
    # Copies, so that the motion's readings need not be kept.
    return raw, PoseTrack(motion.positions[late].copy(), motion.rotations[late].copy())


def imposed(
    mechanism: Mechanism, kind: str, duration: float, rate: float, seed: int, imu: str, late: slice, imu_seed: int | None = None
) -> tuple[Array, PoseTrack]:
    """As `read`, of the IMUs of this name on an imposed motion; `imu_seed` is another seed for them."""
    motion = impose(mechanism, kind, duration, rate, seed)
    return read(motion, imu_state(load_imu(imu), seed if imu_seed is None else imu_seed, 1.0 / rate), late)


@kernel
def _measure(imu: Record, signals: Array, raw: Array) -> None:
    for i in range(signals.shape[0]):
        measure(imu, signals[i], raw[i])


def fuse(parameters: Record, raw: Array, state: Record | None = None) -> Record:
    """The cycle's estimates (N,) for raw samples (N, 3, 7, 3), from a given state or from the start."""
    fused = np.zeros(len(raw), FUSED)
    if state is None:
        state = np.zeros((), STATE)
    _follow(parameters, state, raw, fused, np.zeros((LEGS, 1, 5)), np.zeros((), MARKS)[()])
    return fused


@kernel
def _follow(parameters: Record, state: Record, raw: Array, fused: Record, segments: Array, marks: Record) -> None:
    p, s, factor = parameters[()], state[()], np.zeros((6, 6))
    for i in range(raw.shape[0]):
        f = fused[i]
        run_stages(parameters, state, raw[i], segments, marks, CycleStage.SCREENING, CycleStage.REFINEMENT)
        f.positions[CLOSED], f.rotations[CLOSED] = s.pose.position, s.pose.rotation
        f.directions[:], f.vertical[:] = s.legs.directions, s.platform.vertical
        f.leg_covariances[:] = s.legs.covariance[:, :2, :2]
        vertical_covariance(s.platform, f.vertical_covariance)
        run_stages(parameters, state, raw[i], segments, marks, CycleStage.REFINEMENT, CycleStage.MECHANISM)
        f.positions[REFINED], f.rotations[REFINED] = s.pose.position, s.pose.rotation
        for j in range(6):
            for k in range(6):
                f.information[j, k] = s.pose.information[max(j, k), min(j, k)]
        run_stages(parameters, state, raw[i], segments, marks, CycleStage.MECHANISM, CycleStage.INTEGRITY)
        f.positions[WHOLE], f.rotations[WHOLE] = s.pose.position, s.pose.rotation
        find_covariance(p.mechanism, s.mechanism, p.rig, s.time, s.pose, factor, f.covariance)
        f.ns[LEGS_ALONE] = marks.ns[CycleStage.LEGS]
        f.ns[CLOSED] = marks.ns[: CycleStage.REFINEMENT].sum()
        f.ns[REFINED] = f.ns[CLOSED] + marks.ns[CycleStage.REFINEMENT]
        f.ns[WHOLE] = f.ns[REFINED] + marks.ns[CycleStage.MECHANISM]
        s.time.cycle += 1
