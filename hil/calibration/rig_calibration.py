"""Calibration on the rig: it rests at wide poses and shakes, and its IMUs' errors come out of the redundancy.

First, while the brakes hold, the gyroscopes are zeroed, and while the drives follow a small planned motion with the loop open,
each IMU must read what its place does. Then the rig rests at a few poses near home, driven by raw data, for a first
calibration; with that at twenty wide ones; with that it shakes, for the rest. Every run is one of `hil.runs.simulation`, and
between them the rig stands on its brakes; or all that comes from recordings.
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.calibration.at_rest import (
    LEAST_POSES,
    CalibrationError,
    Found,
    Prior,
    Rests,
    calibrate_at_rest,
    calibrate_in_motion,
    expected_forces,
    fit_pose,
    pose_covariance,
    track,
    undo,
)
from controller.calibration.checks import check_alive, check_all_along, check_motion, check_places, check_spread
from controller.calibration.file import Calibration, save_calibration, split_gain
from controller.direct_kinematics import poses_from_lengths
from controller.estimation.mechanism_filter import (
    ACCELEROMETER_BIAS,
    ALIGNMENT,
    ALL_ERRORS,
    ERROR_NAMES,
    ERRORS,
    GYROSCOPE_BIAS,
    filter_parameters,
)
from controller.estimation.readings import RATE, VELOCITY, readings_along, sensor_geometry
from controller.planning.target import REST_S
from controller.safety.watch import watch_nothing
from controller.settings import sensor_settings
from hil.loop.records import Link
from hil.recording.mcap import Recording, RecordingError, read
from hil.runs.config import SimulationConfig
from hil.runs.prepare import prepared_loop
from hil.runs.simulation import SimulationStoppedError, simulate
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.imu import ACCELEROMETER, GYROSCOPE, MILLI_G, STANDARD_GRAVITY, load_imu
from plant.mechanism import LEGS, Mechanism, load_spatial
from plant.pose import Array, Pose, rotation_angle, rotations_from_quaternions

FIRST_POSES, WIDE_POSES, SHAKING_S = 8, 20, 40.0
STAGES = {
    "before": "as they are",
    "known": "by known poses",
    "rests": "calibrated at rest",
    "motion": "and in motion",
}
"""Of a calibration, in words."""

UNTOLD = 0.5
"""A constant whose standard deviation is still more than this share of what it was before was hardly told by the data."""

_PROBING_S = 4.0
_ZEROING_S = 1.0
_SETTLED_S = 0.5
"""What is left out at the beginning of a rest [s]."""

_SHORTEST_REST_S = 0.4
_SHORTEST_MOTION_S = 10.0
_MEAN_S = 0.1
_CHECKED_S = 0.04
_MOST_RATE = np.radians(0.5)
"""A mean over `_MEAN_S` that turns faster than this is no rest [rad/s]."""

_FOLDS = 5
_POSE_SIGMA = np.radians(0.3)
"""Of the orientation of a leg or the platform, where the poses are taken for the planned ones [rad]."""

_LENGTH_NOISE = 5e-5
"""Of the lengths that a simulated rig measures [m]."""


@dataclass(frozen=True)
class Knowledge:
    """What is known besides the IMUs' readings.

    Attributes:
        prior: of the IMUs' errors and the base's tilt.
        home: whether the rig's first pose is home exactly.
        lengths: whether the rig measures by how much its lengths change.
        known_poses: whether to take the poses at rest for the planned ones, as the paper's section 7 has it, and to look for
            nothing but the mounting.
    """

    prior: Prior = field(default_factory=Prior)
    home: bool = False
    lengths: bool = False
    known_poses: bool = False


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """What a calibration on the rig has found.

    Attributes:
        mechanism: the rig's.
        calibration: of the IMUs.
        at_rest: what was found from the rests alone.
        summary: the figures.
    """

    mechanism: Mechanism
    calibration: Calibration
    at_rest: Found
    summary: dict[str, Any]


def raw_samples(records: Record) -> Array:
    """Raw measurements (N, 3, 7, 3) of records."""
    return np.stack([records["angular_velocity"], records["specific_force"], records["magnetic_field"]], axis=1)


def find_rests(samples: Array, zero: Array, rate: float) -> list[slice]:
    """The stretches of raw samples (N, 3, 7, 3) in which no gyroscope, less its `zero` (7, 3) [rad/s], turns."""
    length = max(1, round(_MEAN_S * rate))
    count = len(samples) // length
    means = (samples[: count * length, 0] - zero).reshape(count, length, IMU_COUNT, 3).mean(axis=1)
    still = np.abs(means).max(axis=(1, 2)) < _MOST_RATE
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    return [slice(first * length, last * length) for first, last in edges.reshape(-1, 2)]


def is_long(rest: slice, rate: float) -> bool:
    """Whether enough of a rest is left without its beginning."""
    return int(rest.stop) - int(rest.start) >= (_SETTLED_S + _SHORTEST_REST_S) * rate


def calibrate_rig(
    config: SimulationConfig,
    knowledge: Knowledge = Knowledge(),
    progress: Callable[[float], None] = lambda share: None,
    validate: bool = True,
) -> RigCalibration:
    """Drive the rig and calibrate its IMUs.

    Args:
        config: mechanism, IMUs, seed, rate and plant; its target and durations are the calibration's own.
        knowledge: besides the readings.
        progress: called with the share that is done.
        validate: whether to find out, too, how well calibrations by parts of the data agree.

    Raises:
        CalibrationError: an IMU is not what it should be, or the data have no explanation, or do not suffice.
        GoughError: something in the configuration cannot be used.
    """
    config = replace(config, raw_imus=True)
    data = _Data(load_spatial(config.mechanism), config.imu, config.rate, knowledge, config.seed)
    probing = _run_open(replace(config, target="probing", duration=_PROBING_S, hold=_ZEROING_S), blind=True)
    data.begin(probing, round(_ZEROING_S * config.rate))
    data.check_places(probing)
    offset = np.zeros((3, IMU_COUNT, 3))
    offset[GYROSCOPE] = -data.zero
    zeroed, whole, done = Calibration(offset=offset), (FIRST_POSES + WIDE_POSES) * REST_S + SHAKING_S, 0.0
    if knowledge.known_poses:
        with _calibrated(replace(config, target="rests", duration=WIDE_POSES * REST_S), zeroed) as run:
            data.known = data.mounting(_run_open(run))

    with _calibrated(replace(config, target="near-rests", duration=FIRST_POSES * REST_S), zeroed) as run:
        data.add_rests(_run_open(run))
    done = FIRST_POSES * REST_S

    def drive(target: str, duration: float, calibration: Calibration) -> Record:
        nonlocal done
        start, done = done, done + duration
        with _calibrated(replace(config, target=target, duration=duration), calibration) as run:
            return _run(run, lambda share: progress((start + share * duration) / whole))

    first = calibrate_at_rest(data.mechanism, data.rests, knowledge.prior)
    data.add_rests(drive("rests", WIDE_POSES * REST_S, first.calibration()))
    found = calibrate_at_rest(data.mechanism, data.rests, knowledge.prior)
    return data.evaluate(found, [drive("shaking", SHAKING_S, found.calibration())], validate)


def calibrate_recordings(paths: Sequence[Path], knowledge: Knowledge = Knowledge()) -> RigCalibration:
    """Calibrate the IMUs from recordings of one rig that rested at wide poses and shook.

    The rests are taken from all, and the motion is the longest one that begins at rest. The gyroscopes are zeroed while the
    brakes hold in the first.

    Args:
        paths: MCAP files, each from the first cycle of its run on.
        knowledge: besides the readings.

    Raises:
        RecordingError: no recordings, or not of one rig.
        CalibrationError: as `calibrate_rig`.
    """
    recordings = [_complete(path, read(path)) for path in paths]
    first = recordings[0].config
    for path, each in zip(paths, recordings, strict=True):
        for name in ("mechanism", "imu", "rate"):
            if each.config[name] != first[name]:
                raise RecordingError(
                    f"the {name} of {path} is {each.config[name]} and of {paths[0]} {first[name]}: give recordings of one rig"
                )
    data = _Data(load_spatial(first["mechanism"]), first["imu"], first["rate"], knowledge, first["seed"])
    runs = [_every_cycle(each.records) for each in recordings]
    data.begin(runs[0], int(recordings[0].arrays["parameters"]["hold_cycles"]))
    for records in runs:
        data.check_places(records)
        data.add_rests(records)
    if knowledge.known_poses:
        data.known = data.mounting(*runs)
    return data.evaluate(calibrate_at_rest(data.mechanism, data.rests, knowledge.prior), runs)


def _complete(path: Path, recording: Recording) -> Recording:
    if "parameters" not in recording.arrays or not len(recording.records):
        raise RecordingError(f"{path} holds no cycle, or lacks the constants of its run: it is damaged")
    if recording.records["cycle"][0] != 0:
        raise RecordingError(f"{path} does not begin with the first cycle of its run, in which the brakes hold: record it anew")
    return recording


def _every_cycle(records: Record) -> Record:
    """Records with those before in the place of missed ones."""
    cycles = records["cycle"]
    filled: Record = records[np.searchsorted(cycles, np.arange(cycles[0], cycles[-1] + 1), side="right") - 1]
    return filled


def _run_open(config: SimulationConfig, blind: bool = False) -> Record:
    """The records of a run with the loop open, wherever the IMUs say the platform is: the drives follow the planned speeds and
    what the load takes beyond them; when `blind` the speeds alone, so that the platform sinks by some millimetres.
    """
    with prepared_loop(config) as loop:
        loop.parameters["gains"] = 0.0
        watch_nothing(loop.parameters)
        if blind:
            loop.parameters["droop"] = 0.0
        loop.run(len(loop.records))
        return loop.records[: int(loop.link[Link.HEAD])].copy()


@contextmanager
def _calibrated(config: SimulationConfig, calibration: Calibration) -> Iterator[SimulationConfig]:
    with tempfile.TemporaryDirectory(prefix="gough-calibration-") as folder:
        file = Path(folder) / "calibration.toml"
        save_calibration(file, calibration)
        yield replace(config, calibration=str(file))


def _run(config: SimulationConfig, progress: Callable[[float], None]) -> Record:
    """The records of a run with the loop closed."""
    try:
        return simulate(config, progress).records
    except SimulationStoppedError as error:
        raise CalibrationError(f"the rig stopped at {config.target}: {error}: check the IMUs' errors and the drives") from None


class _Data:
    """What runs have given so far.

    Attributes:
        mechanism: the rig's.
        zero: (7, 3) [rad/s], of the gyroscopes.
        known: the mounting by known poses, if that is looked for.
    """

    def __init__(self, mechanism: Mechanism, imu: str, rate: float, knowledge: Knowledge, seed: int) -> None:
        self.mechanism, self.known = mechanism, Calibration()
        self.zero = np.zeros((IMU_COUNT, 3))
        self._fusion, self._rate, self._knowledge = sensor_settings(mechanism, load_imu(imu)), rate, knowledge
        self._random = np.random.default_rng([seed, LEGS])
        self._readings, self._truth, self._lengths = np.zeros((0, IMU_COUNT, 6)), np.zeros((0, 7)), np.zeros((0, LEGS))

    def begin(self, records: Record, hold: int) -> None:
        """Zero the gyroscopes while the brakes hold, for the first so many cycles, and check that every IMU lives.

        Where the rig begins at home, that is its rest there: a loop that closes over raw IMUs leaves it.
        """
        samples = raw_samples(records[:hold])
        check_alive(samples)
        self.zero = samples[:, GYROSCOPE].mean(axis=0)
        if self._knowledge.home:
            self._add_rest(records[:hold])

    def check_places(self, records: Record) -> None:
        """Check that each IMU reads what its place does along the planned motion."""
        length = max(1, round(_CHECKED_S * self._rate))
        count = len(records) // length

        def means(values: Array) -> Array:
            found: Array = values[: count * length].reshape(count, length, *values.shape[1:]).mean(axis=1)
            return found

        positions, rotations = self._planned(means(records["reference"][:, :, 0]))
        expected = readings_along(sensor_geometry(self.mechanism), positions, rotations, self._rate / length)
        readings = np.concatenate([means(records["angular_velocity"]) - self.zero, means(records["specific_force"])], axis=2)
        check_places(readings, expected)

    def _planned(self, lengths: Array) -> tuple[Array, Array]:
        return poses_from_lengths(self.mechanism, lengths, self.mechanism.require_home())

    def _rests_in(self, records: Record) -> list[slice]:
        """The rests in records, without their beginnings."""
        rests = find_rests(raw_samples(records), self.zero, self._rate)
        settled = round(_SETTLED_S * self._rate)
        return [slice(rest.start + settled, rest.stop) for rest in rests if is_long(rest, self._rate)]

    def add_rests(self, records: Record) -> None:
        """Take the rests out of records."""
        check_all_along(raw_samples(records), self._rate)
        for rest in self._rests_in(records):
            self._add_rest(records[rest])

    def _add_rest(self, own: Record) -> None:
        readings = np.concatenate([own["angular_velocity"], own["specific_force"]], axis=2).mean(axis=0)
        truth = own["truth"][:, :13].mean(axis=0)
        self._readings = np.append(self._readings, readings[None], axis=0)
        self._truth = np.append(self._truth, truth[None, :7], axis=0)
        measured = truth[7:] + self._random.normal(0.0, _LENGTH_NOISE, LEGS)
        self._lengths = np.append(self._lengths, measured[None], axis=0)

    @property
    def rests(self) -> Rests:
        """The rests, for the calibration.

        Raises:
            CalibrationError: they are too few or too alike, or there are no lengths.
        """
        if self._knowledge.lengths and not np.isfinite(self._lengths).all():
            raise CalibrationError("there are no measured lengths in the recording: leave out --lengths")
        if len(self._readings) >= LEAST_POSES:
            check_spread(self._readings[:, :, 3:])
        changes = self._lengths - self._lengths[:1] if self._knowledge.lengths else None
        return Rests(self._readings, self._knowledge.home, changes)

    def mounting(self, *runs: Record) -> Calibration:
        """The mounting and the accelerometers' bias alone, from the planned poses at rest: the paper's section 7, "by comparing
        the target orientations with the measured orientations for several predefined poses".
        """
        forces, lengths = [], []
        for records in runs:
            for rest in self._rests_in(records):
                forces.append(records["specific_force"][rest].mean(axis=0))
                lengths.append(records["reference"][rest, :, 0].mean(axis=0))
        if not forces:
            raise CalibrationError("no rest was found: at known poses the rig must rest for a second or longer")
        geometry = sensor_geometry(self.mechanism)
        planned = zip(*self._planned(np.array(lengths)), strict=True)
        expected = np.array([expected_forces(geometry, position, rotation) for position, rotation in planned])
        sigmas = self._knowledge.prior.error_sigmas().reshape(IMU_COUNT, ERRORS)
        errors, covariance = np.zeros((IMU_COUNT, ERRORS)), np.diag(sigmas.ravel() ** 2)
        sought = [*range(ACCELEROMETER_BIAS, ACCELEROMETER_BIAS + 3), *range(ALIGNMENT, ALIGNMENT + 3)]
        weight = 1.0 / (_POSE_SIGMA * STANDARD_GRAVITY) ** 2
        for imu in range(IMU_COUNT):
            # R(-alignment) f is about f + f x alignment.
            rows = np.concatenate(
                [np.concatenate([np.eye(3), np.cross(force, np.eye(3)).T], axis=1) for force in expected[:, imu]]
            )
            left = (np.array(forces) - expected)[:, imu].ravel()
            inverse = np.linalg.inv(weight * rows.T @ rows + np.diag(1.0 / sigmas[imu, sought] ** 2))
            errors[imu, sought] = weight * inverse @ rows.T @ left
            places = ERRORS * imu + np.array(sought)
            covariance[np.ix_(places, places)] = inverse
        errors[:, GYROSCOPE_BIAS : GYROSCOPE_BIAS + 3] = self.zero
        return Calibration().then(*undo(errors), covariance=covariance)

    def evaluate(self, found: Found, runs: Sequence[Record], validate: bool = True) -> RigCalibration:
        """Calibrate in the longest motion of some runs, and say what has been found, and how well."""
        samples, start = self._motion(runs, found)
        calibration, covariance = self._in_motion(found, samples, start)
        before = np.diag(self._knowledge.prior.sigmas() ** 2)
        by_known_poses = before.copy()
        if self.known.covariance is not None:
            by_known_poses[:ALL_ERRORS, :ALL_ERRORS] = self.known.covariance
        cases = {
            "before": (Calibration(), before),
            "known": (self.known, by_known_poses),
            "rests": (found.calibration(), found.covariance),
            "motion": (calibration, covariance),
        }
        if not self._knowledge.known_poses:
            del cases["known"]
        summary = self._summary(cases) | {
            "positions": found.positions.tolist(),
            "validated": self._validate(calibration, samples, start) if validate else {},
        }
        summary |= self._constants(calibration)
        about = {
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "version": version("gough"),
            "mechanism": self.mechanism.name,
            **{f"residual_{name}_mg": round(value, 4) for name, value in summary["residual_mg"].items()},
        }
        chosen = self.known if self._knowledge.known_poses else calibration
        return RigCalibration(self.mechanism, replace(chosen, about=about), found, summary)

    def _motion(self, runs: Sequence[Record], found: Found) -> tuple[Array, tuple[Pose, Array]]:
        """The samples of the longest motion from the end of the rest before it, with the pose and twist there."""
        motions: list[tuple[int, int, slice]] = []
        for number, records in enumerate(runs):
            rests = find_rests(raw_samples(records), self.zero, self._rate)
            ends = [*(rest.start for rest in rests[1:]), len(records)]
            motions += [(end - rest.stop, number, slice(rest.start, end)) for rest, end in zip(rests, ends, strict=True)]
        length, number, whole = max(motions, default=(0, 0, slice(0, 0)), key=lambda motion: motion[0])
        if length < _SHORTEST_MOTION_S * self._rate:
            raise CalibrationError(
                f"the longest motion that begins at rest lasts {length / self._rate:.3g} s; at least {_SHORTEST_MOTION_S:g} s "
                "are needed: record 'shaking' for 40 s"
            )
        samples = raw_samples(runs[number][whole])
        check_all_along(samples, self._rate)
        last = max(len(samples) - length - round(_MEAN_S * self._rate), 1)
        check_motion(samples[last:, GYROSCOPE] - self.zero)
        first = max(last - round(_SETTLED_S * self._rate), 0)
        mean = found.calibration().apply(samples[first:last].mean(axis=0))
        pose = Pose(*fit_pose(self._geometry(found.calibration()), mean[ACCELEROMETER], self.mechanism.require_home()))
        return samples[last:], (pose, np.zeros(6))

    def _geometry(self, calibration: Calibration) -> Record:
        return sensor_geometry(self.mechanism.moved_joints(calibration.joints), calibration.tilt)

    def _in_motion(self, found: Found, samples: Array, start: tuple[Pose, Array]) -> tuple[Calibration, Array]:
        return calibrate_in_motion(self.mechanism, found, samples, self._rate, start, self._fusion)

    def _summary(self, cases: dict[str, tuple[Calibration, Array]]) -> dict[str, Any]:
        """Residuals of the forces at rest, and how well poses at rest are known, as predicted and, where the truth is known, in
        fact, with each calibration and the covariance (185, 185) of what it leaves.
        """
        figures: dict[str, Any] = {"rests": len(self._readings), "residual_mg": {}, "residual_by_imu_mg": {}}
        figures |= {"predicted": {}, "true": {}}
        for name, (calibration, covariance) in cases.items():
            poses, left = self._fit(calibration, np.arange(len(self._readings)))
            figures["residual_mg"][name] = float(np.sqrt(np.mean(left**2))) / MILLI_G
            figures["residual_by_imu_mg"][name] = (np.sqrt(np.mean(left**2, axis=(0, 2))) / MILLI_G).tolist()
            mechanism = self.mechanism.moved_joints(calibration.joints)
            of_poses = np.mean([pose_covariance(mechanism, calibration.tilt, pose, covariance) for pose in poses], axis=0)
            figures["predicted"][name] = _rms_of(of_poses)
            figures["weakest"] = weakest_direction(of_poses, self.mechanism)
            figures["tilt"] = calibration.tilt.tolist()
            if np.isfinite(self._truth).all():
                true = self._truth[:, :3], rotations_from_quaternions(np.ascontiguousarray(self._truth[:, 3:]))
                figures["true"][name] = _differences(poses, list(zip(*true, strict=True)))
        return figures

    def _fit(self, calibration: Calibration, kept: NDArray[np.int64]) -> tuple[list[tuple[Array, Array]], Array]:
        """Poses of some rests, and what they leave of the forces (n, 7, 3), as one component in twenty-one would have it if six
        had not gone into the pose.
        """
        raw = np.zeros((len(kept), 3, IMU_COUNT, 3))
        raw[:, ACCELEROMETER] = self._readings[kept, :, 3:]
        forces = calibration.apply(raw)[:, ACCELEROMETER]
        geometry = self._geometry(calibration)
        poses = [fit_pose(geometry, each, self.mechanism.require_home()) for each in forces]
        left = [each - expected_forces(geometry, *pose) for each, pose in zip(forces, poses, strict=True)]
        return poses, np.array(left) * np.sqrt(21.0 / 15.0)

    def _part_of(self, kept: NDArray[np.int64]) -> Found:
        """What some of the rests alone tell."""
        rests = self.rests
        changes = None if rests.length_changes is None else rests.length_changes[kept] - rests.length_changes[kept[0]]
        part = Rests(rests.readings[kept], rests.home and kept[0] == 0, changes)
        return calibrate_at_rest(self.mechanism, part, self._knowledge.prior)

    def _validate(self, calibration: Calibration, samples: Array, start: tuple[Pose, Array]) -> dict[str, dict[str, float]]:
        """What can be told of the accuracy without the truth: residuals at rests that were left out of the calibration, in five
        parts, and by how much the poses differ that calibrations by disjoint halves of the data give; none for too few rests.
        """
        everything = np.arange(len(self._readings))
        if len(everything) < 2 * LEAST_POSES:
            return {}
        left = []
        for fold in range(_FOLDS):
            part = self._part_of(everything[everything % _FOLDS != fold])
            left.append(self._fit(part.calibration(), everything[everything % _FOLDS == fold])[1])
        halves = [self._part_of(everything[first::2]) for first in range(2)]
        # The second half of the motion begins where the filter was over the whole.
        middle = len(samples) // 2
        geometry = self._geometry(calibration)
        parameters = filter_parameters(self._fusion, self._rate, "axes", calibration.covariance)
        used = np.ones((middle + 1, IMU_COUNT), np.int64)
        way = track(
            parameters, geometry, calibration.apply(samples[: middle + 1]), used, self._rate, self._fusion.sensor_delay, start
        )
        there = Pose(way.positions[-1], way.rotations[-1]), way.motions[-1, [VELOCITY, RATE]].ravel()
        moved = [self._in_motion(halves[0], samples[:middle], start)[0], self._in_motion(halves[1], samples[middle:], there)[0]]
        differences = {}
        for name, calibrations in (("rests", [half.calibration() for half in halves]), ("motion", moved)):
            first, second = (self._fit(each, everything)[0] for each in calibrations)
            differences[name] = _differences(first, second)
        differences["rests"]["left_out_mg"] = float(np.sqrt(np.mean(np.concatenate(left) ** 2))) / MILLI_G
        return differences

    def _constants(self, calibration: Calibration) -> dict[str, Any]:
        """The constants of each IMU by name, with their standard deviations, and those that the data hardly told."""
        covariance, before = calibration.covariance, self._knowledge.prior.error_sigmas().reshape(IMU_COUNT, -1, 3)
        sigmas = np.sqrt(np.diag(covariance)).reshape(IMU_COUNT, -1, 3) if covariance is not None else before
        values = np.empty((IMU_COUNT, len(ERROR_NAMES), 3))
        for imu in range(IMU_COUNT):
            parts = [split_gain(calibration.gain[sensor, imu]) for sensor in range(2)]
            biases = [np.linalg.solve(calibration.gain[sensor, imu], calibration.offset[sensor, imu]) for sensor in range(2)]
            (gyroscope_scale, gyroscope_axes, _), (scale, axes, mounting) = parts
            values[imu] = [*biases, scale - 1.0, gyroscope_scale - 1.0, mounting, axes, gyroscope_axes]
        shares, untold = sigmas / before, dict[str, list[int]]()
        for imu, kind, axis in np.argwhere(shares > UNTOLD).tolist():
            untold.setdefault(_constant(kind, axis), []).append(imu)
        imu, kind, axis = (int(i) for i in np.unravel_index(shares.argmax(), shares.shape))
        return {
            "constants": {
                name: {"values": values[:, i].tolist(), "sigmas": sigmas[:, i].tolist()} for i, name in enumerate(ERROR_NAMES)
            },
            "untold": untold,
            "least_told": {"name": _constant(kind, axis), "imu": imu, "share": float(shares.max())},
        }


def _constant(kind: int, axis: int) -> str:
    name = ERROR_NAMES[kind]
    return f"{name} {(('xy', 'xz', 'yz') if name.endswith('axes') else 'xyz')[axis]}"


def weak_words(summary: dict[str, Any]) -> list[str]:
    """What a calibration knows least, in plain words, from its summary."""
    least = summary["least_told"]
    return [
        f"the pose is known least {summary['weakest']}",
        *(
            f"the data hardly told {name} of IMU {', '.join(map(str, imus))}: more than {UNTOLD:g} of its sigma before is left"
            for name, imus in summary["untold"].items()
        ),
        f"the constant known least is {least['name']} of IMU {least['imu']}: {least['share']:.2g} of its sigma before is left",
    ]


def _differences(first: Sequence[tuple[Array, Array]], second: Sequence[tuple[Array, Array]]) -> dict[str, float]:
    distances = np.linalg.norm([a[0] - b[0] for a, b in zip(first, second, strict=True)], axis=1)
    angles = rotation_angle(np.array([each[1] for each in first]), np.array([each[1] for each in second]))
    return {"position_rms": float(np.sqrt(np.mean(distances**2))), "rotation_rms": float(np.sqrt(np.mean(angles**2)))}


def _rms_of(covariance: Array) -> dict[str, float]:
    return {
        "position_rms": float(np.sqrt(np.trace(covariance[:3, :3]))),
        "rotation_rms": float(np.sqrt(np.trace(covariance[3:, 3:]))),
    }


def weakest_direction(covariance: Array, mechanism: Mechanism) -> str:
    """Along or about what the pose is known least, in plain words; rotations count at the platform's joints."""
    arm = float(np.linalg.norm(mechanism.platform_joints, axis=1).mean())
    scale = np.repeat([1.0, arm], 3)
    values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    main = int(np.abs(vectors[:, -1]).argmax())
    words = ("along x", "along y", "along z", "about x", "about y", "about z")[main]
    return f"mostly {words}: {1e3 * float(np.sqrt(values[-1])):.2g} mm at the platform's joints"
