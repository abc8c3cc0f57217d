"""Data for a calibration on the rig: the rests and the motion in the records of its runs."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from controller.calibration.at_rest import (
    LEAST_POSES,
    MeasuredLengths,
    Prior,
    RestCalibration,
    Rests,
    calibrate_at_rest,
    errors_of_base_imu,
    fit_pose,
    undo_one,
)
from controller.calibration.file import Calibration
from controller.calibration.in_motion import Motion
from controller.calibration.mounting_checks import check_alive, check_all_along, check_motion, check_places, check_spread
from controller.direct_kinematics import poses_from_lengths
from controller.estimation.whole_mechanism.readings import readings_along
from controller.inverse_kinematics import inverse_kinematics
from controller.rig import sensor_geometry
from controller.settings import FusionSettings, sensor_settings
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.encoders import EncoderModel
from plant.errors import CalibrationError
from plant.imu import ACCELEROMETER, GYROSCOPE, STANDARD_GRAVITY, load_imu
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose
from plant.truth import TRUTH_LENGTHS

_SETTLED_S = 0.5
"""A rest counts after this time [s]."""
_SHORTEST_REST_S, _SHORTEST_MOTION_S = 0.4, 10.0
_MEAN_S, _CHECKED_S = 0.1, 0.04
_MOST_RATE = np.radians(0.5)
"""Greatest rate of a rest, in means over `_MEAN_S` [rad/s]."""
_BASE_TURNS, _BASE_TILTS = np.radians(0.2), np.radians(0.2)
"""Greatest rate [rad/s] and tilt [rad] from rest to rest of a base that stands, by its IMU."""
TO_50_UM = EncoderModel("to 50 um", resolution=0.0, backlash=0.0, noise=5e-5)
"""What a simulated rig without encoders measures its lengths with, if it is to."""


@dataclass(frozen=True)
class Knowledge:
    """What is known besides the IMUs' samples.

    Attributes:
        prior: standard deviations of the IMUs' errors and of the base's tilt.
        home: whether the rig's first pose is home exactly.
        encoder: with which the rig measures its lengths; None if it does not. A simulation without encoders measures with the
            encoder's noise at every rest.
        known_poses: whether to seek the mounting alone, from planned poses (the paper's section 7).
    """

    prior: Prior = field(default_factory=Prior)
    home: bool = False
    encoder: EncoderModel | None = None
    known_poses: bool = False


def raw_samples(records: Record) -> Array:
    """The raw samples (N, 3, 7, 3) of records."""
    return np.stack([records["angular_velocity"], records["specific_force"], records["magnetic_field"]], axis=1)


def was_read(records: Record) -> NDArray[np.bool_]:
    """Where records (N,) of every cycle have readings of their own: the period was not missed, and the rig answered in time."""
    read: NDArray[np.bool_] = (np.diff(records["cycle"], prepend=-1) != 0) & (records["silent"] == 0)
    return read


def _means(values: Array, length: int) -> Array:
    """The means (N // length, ...) of values (N, ...) over so many samples each."""
    whole = values[: len(values) // length * length]
    return np.asarray(whole.reshape(-1, length, *values.shape[1:]).mean(axis=1))


def find_rests(samples: Array, zero: Array, rate: float) -> list[slice]:
    """Where no gyroscope turns in raw samples (N, 3, 7, 3), less its `zero` (7, 3) [rad/s]."""
    length = max(1, round(_MEAN_S * rate))
    still = np.abs(_means(samples[:, GYROSCOPE] - zero, length)).max(axis=(1, 2)) < _MOST_RATE
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    return [slice(first * length, last * length) for first, last in edges.reshape(-1, 2)]


def is_long(rest: slice, rate: float) -> bool:
    """Whether a rest is long enough without its beginning."""
    return int(rest.stop) - int(rest.start) >= (_SETTLED_S + _SHORTEST_REST_S) * rate


def measured_lengths(values: Array, runs: Array, fusion: FusionSettings) -> MeasuredLengths:
    """Lengths (N, 6) [m] with their covariance, by encoders whose zeros are anew in each of the runs (N,)."""
    zeros = fusion.length_zero**2 * (runs[:, None] == runs)
    return MeasuredLengths(values, zeros + (fusion.length_noise**2 + fusion.length_play**2) * np.eye(len(runs)))


class CalibrationData:
    """The rests of all runs so far.

    Attributes:
        imu: the kind of IMU, a preset's name.
        fusion: settings of the sensors, the encoders among them.
        zero: (7, 3) [rad/s], the gyroscopes' offsets.
        readings: (R, 7, 6), mean rates and forces of each rest.
        base_readings: (R, 6), the same of an IMU on the base; NaN without one.
        truth: (R, 7), true position and quaternion of each rest; NaN where they are not known.
    """

    def __init__(self, mechanism: Mechanism, imu: str, rate: float, knowledge: Knowledge, seed: int) -> None:
        """Start without a rest; `rate` is in Hz, and `seed` that of the noise of measured lengths."""
        self.mechanism, self.imu, self.rate, self.knowledge = mechanism, imu, rate, knowledge
        self.fusion = sensor_settings(mechanism, load_imu(imu), rate, knowledge.encoder)
        self.zero = np.zeros((IMU_COUNT, 3))
        self.readings, self.base_readings = np.zeros((0, IMU_COUNT, 6)), np.zeros((0, 6))
        self.truth, self._lengths, self._runs = np.zeros((0, 7)), np.zeros((0, LEGS)), np.zeros(0)
        self._random = np.random.default_rng([seed, LEGS])

    def begin(self, records: Record, hold: int) -> None:
        """Check that every IMU works and zero the gyroscopes in the first `hold` cycles, while the brakes hold.

        At home the rig rests only now: a loop that closes over raw IMUs leaves it.
        """
        self._hear_base(records[:hold])
        samples = raw_samples(records[:hold])
        check_alive(samples)
        self.zero = samples[:, GYROSCOPE].mean(axis=0)
        if self.knowledge.home:
            self._add(records, [slice(hold)])

    def check_places(self, records: Record) -> None:
        """Check that each IMU reads the planned motion of its place."""
        length = max(1, round(_CHECKED_S * self.rate))
        positions, rotations = self.planned_poses(_means(records["reference"][:, :, 0], length))
        expected = readings_along(sensor_geometry(self.mechanism), positions, rotations, self.rate / length)
        rates, forces = (_means(records[name], length) for name in ("angular_velocity", "specific_force"))
        check_places(np.concatenate([rates - self.zero, forces], axis=2), expected)

    def planned_poses(self, lengths: Array) -> tuple[Array, Array]:
        """Positions (N, 3) [m] and rotations (N, 3, 3) for planned lengths (N, 6) [m]."""
        return poses_from_lengths(self.mechanism, lengths, self.mechanism.require_home())

    def rests_in(self, records: Record) -> list[slice]:
        """The rests in records, without their beginnings."""
        rests = find_rests(raw_samples(records), self.zero, self.rate)
        settled = round(_SETTLED_S * self.rate)
        return [slice(rest.start + settled, rest.stop) for rest in rests if is_long(rest, self.rate)]

    def add_rests(self, records: Record) -> None:
        """Add the rests in the records of a run."""
        check_all_along(raw_samples(records), self.rate)
        self._add(records, self.rests_in(records))

    def _add(self, records: Record, rests: Sequence[slice]) -> None:
        lengths, encoder = self._lengths_in(records), self.knowledge.encoder
        run = 0.0 if encoder is None or encoder.absolute else self._runs.max(initial=0.0) + 1.0
        for rest in rests:
            during = records[rest]
            self._hear_base(during)
            readings = np.concatenate([during["angular_velocity"], during["specific_force"]], axis=2).mean(axis=0)
            truth = during["truth"].mean(axis=0)
            measured = np.full(LEGS, np.nan)
            if lengths is not None:
                measured = np.nanmean(lengths[rest], axis=0)
            elif encoder is not None:
                measured = truth[TRUTH_LENGTHS] + self._random.normal(0.0, encoder.noise, LEGS)
            self.readings = np.append(self.readings, readings[None], axis=0)
            self.truth = np.append(self.truth, truth[None, :7], axis=0)
            self._lengths = np.append(self._lengths, measured[None], axis=0)
            self._runs = np.append(self._runs, run)

    def _lengths_in(self, records: Record) -> Array | None:
        """The lengths (N, 6) [m] by encoders in the records of a run, as if it had begun at home if their zeros are not known;
        None without encoders.
        """
        lengths, encoder = np.asarray(records["length"], float), self.knowledge.encoder
        read = np.isfinite(lengths).all(axis=1)
        if encoder is None or not read.any():
            return None
        if not encoder.absolute:
            lengths = (
                lengths + inverse_kinematics(self.mechanism, self.mechanism.require_home()).lengths - lengths[read.argmax()]
            )
        return lengths

    def _hear_base(self, records: Record) -> None:
        """Take what an IMU on the base reads while the platform rests.

        Raises:
            CalibrationError: the base moves.
        """
        if not np.isfinite(records["base_imu"]).any():
            return
        reading = np.nanmean(records["base_imu"], axis=0).reshape(1, 6)
        self.base_readings = np.append(self.base_readings, reading, axis=0)
        off = self.base_readings - self.base_readings[0]
        turns, tilts = np.linalg.norm(off[:, :3], axis=1).max(), np.linalg.norm(off[:, 3:], axis=1).max() / STANDARD_GRAVITY
        if turns > _BASE_TURNS or tilts > _BASE_TILTS:
            raise CalibrationError(
                f"the base moves: from one rest to another its IMU differs by {np.degrees(turns):.2f} deg/s and "
                f"{np.degrees(tilts):.2f} deg of tilt; at most {np.degrees(_BASE_TURNS):g} deg/s and "
                f"{np.degrees(_BASE_TILTS):g} deg are allowed: calibrate while it stands"
            )

    def with_base(self, calibration: Calibration) -> Calibration:
        """A calibration with the constants of the base's IMU, if there is one."""
        if not len(self.base_readings):
            return calibration
        prior = self.knowledge.prior
        errors = errors_of_base_imu(self.mechanism, calibration.tilt, self.base_readings.mean(axis=0), prior)
        gain, offset = undo_one(errors)
        return replace(calibration, base_gain=gain, base_offset=offset)

    def zeroed(self) -> Calibration:
        """What is known after `begin`: the zeros of the gyroscopes, and the base's IMU."""
        calibration = Calibration()
        calibration.offset[GYROSCOPE] = -self.zero
        return self.with_base(calibration)

    @property
    def rests(self) -> Rests:
        """The rests, for the calibration.

        Raises:
            CalibrationError: they are too few or too alike, or there are no lengths.
        """
        measured = self.knowledge.encoder is not None
        if measured and not np.isfinite(self._lengths).all():
            raise CalibrationError("there are no measured lengths in the recording: leave out --length-changes and --encoders")
        if len(self.readings) >= LEAST_POSES:
            check_spread(self.readings[:, :, 3:])
        lengths = measured_lengths(self._lengths, self._runs, self.fusion) if measured else None
        return Rests(self.readings, self.knowledge.home, lengths)

    def at_rest(self, kept: NDArray[np.int64] | None = None) -> RestCalibration:
        """Calibrate by all rests, or by some of them alone."""
        rests = self.rests if kept is None else self.rests.part(kept)
        return calibrate_at_rest(self.mechanism, rests, self.knowledge.prior)

    def longest_motion(self, runs: Sequence[Record], at_rest: RestCalibration) -> Motion:
        """The longest motion that begins at rest.

        Raises:
            CalibrationError: it is too short.
        """
        motions = [(0, slice(0), 0)]
        for number, records in enumerate(runs):
            rests = find_rests(raw_samples(records), self.zero, self.rate)
            ends = [*(rest.start for rest in rests[1:]), len(records)]
            motions += [(end - rest.stop, slice(rest.start, end), number) for rest, end in zip(rests, ends, strict=True)]
        length, whole, number = max(motions, key=itemgetter(0))
        if length < _SHORTEST_MOTION_S * self.rate:
            raise CalibrationError(
                f"the longest motion that begins at rest lasts {length / self.rate:.3g} s; at least {_SHORTEST_MOTION_S:g} s "
                "are needed: record 'shaking' for 40 s"
            )
        samples = raw_samples(runs[number][whole])
        check_all_along(samples, self.rate)
        last = max(len(samples) - length - round(_MEAN_S * self.rate), 1)
        check_motion(samples[last:, GYROSCOPE] - self.zero)
        first = max(last - round(_SETTLED_S * self.rate), 0)
        calibration = at_rest.calibration()
        mean = calibration.apply(samples[first:last].mean(axis=0))
        pose = fit_pose(self.geometry(calibration), mean[ACCELEROMETER], self.mechanism.require_home())
        lengths, read = self._lengths_in(runs[number]), was_read(runs[number])[whole][last:]
        if lengths is not None:
            lengths = np.where(read[:, None], lengths[whole][last:], np.nan)
        return Motion(samples[last:], (Pose(*pose), np.zeros(6)), lengths, read)

    def geometry(self, calibration: Calibration) -> Record:
        """Places of the sensors for the joints and the tilt of a calibration."""
        return sensor_geometry(self.mechanism.moved_joints(calibration.joints), calibration.tilt)
