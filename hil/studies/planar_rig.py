"""Direct kinematics of a real planar rig, from the leg angles that its IMUs measured at known static poses.

Each pose has a file `pose_*.csv`: a line with the true pose by image processing, the names of the columns, and samples of all
leg angles, raw and by two filters.
"""

import re
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.direct_kinematics.planar import AssemblyMode, closing_angles, closing_positions, solve_planar, wrapped
from plant.csv import read_csv
from plant.errors import InputError, SingularConfigurationError
from plant.files import read_text
from plant.mechanism.planar import PLANAR_LEGS, PlanarMechanism
from plant.pose import Array

SOURCES = ("raw", "kalman", "complementary")
COLUMNS = tuple(f"leg{leg}_{source}_deg" for source in SOURCES for leg in range(1, PLANAR_LEGS + 1))
TRUE_DISTANCE_M, TRUE_ANGLE = 0.010, np.radians(8.0)
"""A mode that is no farther off [m, rad] counts as the true pose."""
_FIRST_LINE = re.compile(r"# true pose by image processing: x (\S+) mm, y (\S+) mm, gamma (\S+) deg")
COMPONENTS = (("x", "mm", 1e3), ("y", "mm", 1e3), ("angle", "deg", np.degrees(1.0)))
"""Components of a pose: name, unit in files and reports, and the factor from SI units to it."""


@dataclass(frozen=True, eq=False)
class RigPose:
    """A static pose of the rig; N samples of each source, in the order of `SOURCES`.

    Attributes:
        name: of its file.
        true_pose: (3,) [m, m, rad].
        true_leg_angles: (3,) [rad].
        leg_errors: (3, N, 3), measured minus true angles [rad], by source, sample and leg.
        errors: (3, N, 3), of the assembly mode nearest to the true pose [m, m, rad].
    """

    name: str
    true_pose: Array
    true_leg_angles: Array
    leg_errors: Array
    errors: Array


@dataclass(frozen=True, eq=False)
class RigEvaluation:
    """The poses of a rig by direct kinematics from its leg angles."""

    mechanism: PlanarMechanism
    poses: tuple[RigPose, ...]

    def summary(self) -> dict[str, Any]:
        """The figures by source, in SI units.

        - `rms`: over the poses, of the mean error of a pose.
        - `true_mode`: the share of `samples` and number of `poses` at which a mode is the true pose.
        - `leg_angles`: RMS of their mean errors (`constant_error`) and standard deviations (`noise`).
        - `poses`: mean and standard deviation of the error of each.
        """
        means = np.array([pose.errors.mean(axis=1) for pose in self.poses])
        samples = np.concatenate([pose.errors for pose in self.poses], axis=1)
        constant_error = _rms(np.array([pose.leg_errors.mean(axis=1) for pose in self.poses]), (0, 2))
        noise = _rms(np.array([pose.leg_errors.std(axis=1) for pose in self.poses]), (0, 2))
        sources = {
            source: {
                "rms": _named(_rms(means[:, i], 0)),
                "true_mode": {"samples": float(_is_true(samples[i]).mean()), "poses": int(_is_true(means[:, i]).sum())},
                "leg_angles": {"constant_error": float(constant_error[i]), "noise": float(noise[i])},
                "poses": {
                    pose.name: {
                        "mean_error": _named(pose.errors[i].mean(axis=0)),
                        "standard_deviation": _named(pose.errors[i].std(axis=0)),
                    }
                    for pose in self.poses
                },
            }
            for i, source in enumerate(SOURCES)
        }
        return {
            "mechanism": self.mechanism.name,
            "true_poses": {pose.name: _named(pose.true_pose) for pose in self.poses},
            "sources": sources,
            "version": version("gough"),
        }


def evaluate(folder: str | Path, mechanism: PlanarMechanism) -> RigEvaluation:
    """Solve every sample of every pose in the files `pose_*.csv` of a folder.

    Raises:
        InputError: the folder has no such file, or a file is malformed; the message names file and line.
        SingularConfigurationError: a sample leaves the pose open.
    """
    paths = sorted(Path(folder).glob("pose_*.csv"))
    if not paths:
        raise InputError(f"{folder} is no folder with files pose_*.csv: give one with the poses of a rig")
    return RigEvaluation(mechanism, tuple(_evaluate_pose(path, mechanism) for path in paths))


def _evaluate_pose(path: Path, mechanism: PlanarMechanism) -> RigPose:
    true_pose, leg_angles = _read_csv(path)
    x, y = (mechanism.joints_at(true_pose[:2], true_pose[2]) - mechanism.base_joints).T
    true_leg_angles = np.arctan2(y, x)
    try:
        angles = closing_angles(mechanism, leg_angles)
    except SingularConfigurationError as error:
        raise SingularConfigurationError(f"{path}: {error}") from None
    positions = closing_positions(mechanism, leg_angles[..., None, :], angles)
    nearest = _distances(mechanism, true_pose, positions, angles).argmin(axis=-1)[..., None, None]
    errors = np.concatenate([positions - true_pose[:2], wrapped(angles - true_pose[2])[..., None]], axis=-1)
    errors = np.take_along_axis(errors, nearest, axis=-2)[..., 0, :]
    return RigPose(path.stem, true_pose, true_leg_angles, wrapped(leg_angles - true_leg_angles), errors)


def modes_near(mechanism: PlanarMechanism, pose: RigPose, source: int) -> tuple[AssemblyMode, AssemblyMode]:
    """The assembly modes at a source's mean leg angles, the nearest to the truth first; equal if they merge."""
    modes = solve_planar(mechanism, pose.true_leg_angles + pose.leg_errors[source].mean(axis=0))

    def distance(mode: AssemblyMode) -> float:
        return float(_distances(mechanism, pose.true_pose, mode.position, mode.angle))

    near, *others = sorted(modes, key=distance)
    return near, others[0] if others else near


def _distances(mechanism: PlanarMechanism, true_pose: Array, positions: Array, angles: Array | float) -> Array:
    """Root sum square distances (...) [m] of the platform joints from their true places."""
    offsets = mechanism.joints_at(positions, angles) - mechanism.joints_at(true_pose[:2], true_pose[2])
    distances: Array = np.linalg.norm(offsets, axis=(-2, -1))
    return distances


def _read_csv(path: Path) -> tuple[Array, Array]:
    """The true pose (3,) [m, m, rad] and the leg angles (3, N, 3) [rad], by source, sample and leg."""
    first = read_text(path).removeprefix("\ufeff").partition("\n")[0].strip()
    match = _FIRST_LINE.fullmatch(first)
    true_pose = np.full(3, np.nan)
    with suppress(ValueError):
        true_pose[:] = match.groups() if match else np.nan
    if not np.isfinite(true_pose).all():
        raise InputError(
            f"{path}, line 1: {first!r} gives no true pose in finite numbers: write "
            "'# true pose by image processing: x 107 mm, y 192 mm, gamma 0 deg'"
        )
    rows = read_csv(path, COLUMNS, skipped=1).rows
    if not len(rows):
        raise InputError(f"{path} ends without a sample: it needs at least 1")
    by_source = np.radians(rows).reshape(-1, len(SOURCES), PLANAR_LEGS).swapaxes(0, 1)
    return true_pose / [scale for _, _, scale in COMPONENTS], by_source


def _rms(values: Array, axes: int | tuple[int, ...]) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=axes)))


def _is_true(errors: Array) -> NDArray[np.bool_]:
    return np.asarray((np.hypot(*errors.T[:2]) <= TRUE_DISTANCE_M) & (np.abs(errors[:, 2]) <= TRUE_ANGLE))


def _named(pose: Array) -> dict[str, float]:
    return {name: float(value) for (name, _, _), value in zip(COMPONENTS, pose, strict=True)}
