"""The whole-mechanism filter: against its dense twin, and on imposed motion."""

import numpy as np
import pytest
from numba import njit
from scipy.spatial.transform import Rotation

from controller.estimation.whole_mechanism.filter import (
    _update_rows,
    accumulate_lengths,
    accumulate_sample,
    accumulate_switch,
    extrapolate,
    extrapolate_covariance,
    start_filter,
    start_lengths,
    step_filter,
)
from controller.estimation.whole_mechanism.imu_errors import ERRORS, distort, error_gradient
from controller.estimation.whole_mechanism.parameters import ALL_ERRORS, BLOCKS, FILTER_STATE, MOTION_STATES, filter_parameters
from controller.estimation.whole_mechanism.readings import (
    ACCELERATION,
    JOINTS,
    READINGS_SCRATCH,
    RIG_ERRORS,
    TILT,
    find_frames,
    predict_readings,
)
from controller.inverse_kinematics import leg_lengths
from controller.rig import field_of, sensor_geometry
from controller.settings import FusionSettings, fusion_settings
from plant.dynamics.imposed_motion import impose
from plant.errors import UnknownNameError
from plant.imu import imu_state, load_imu, measure
from plant.mechanism import Mechanism
from plant.pose import rotation_angle, skew
from tests.controller.leg_geometry import rotation_of

RATE_HZ = 1000.0


@njit
def weights_of(used):
    """Weights (2, 7) of both sensors of the IMUs that are `used` (7,)."""
    return np.stack((used, used)).astype(np.float64)


@njit
def follow(parameters, geometry, state, imu, signals, used, delay, start, position, rotation, twist, positions, rotations):
    """Run the filter over signals (N, 3, 7, 3), from a pose and twist; `used` (N, 7)."""
    measurement, rate, acceleration = np.zeros((3, 7, 3)), np.zeros(6), np.zeros(6)
    for i in range(signals.shape[0]):
        measure(imu, signals[i], measurement)
        time = i / RATE_HZ
        if i == start:
            start_filter(parameters, state, time, position, rotation, twist)
        if i > start:
            accumulate_sample(state, measurement, weights_of(used[i]), time - delay)
            step_filter(parameters, geometry, state)
        extrapolate(state, time, positions[i], rotations[i], rate, acceleration)


class Run:
    """The filter on an imposed motion: its poses (N, 3), (N, 3, 3), errors, state."""

    def __init__(self, mechanism, kind, errors, seconds=6.0, seed=0, used=None, imu="mpu9150-calibrated", **settings):
        self.motion = impose(mechanism, kind, seconds, RATE_HZ, seed)
        count = len(self.motion.times)
        model = load_imu(imu)
        self.parameters = filter_parameters(fusion_settings(mechanism, **settings), RATE_HZ, errors, None)
        self.state = np.zeros((), FILTER_STATE)
        self.positions, self.rotations = np.zeros((count, 3)), np.zeros((count, 3, 3))
        used = np.ones((count, 7), np.int64) if used is None else used
        turn = (self.motion.rotations[1] @ self.motion.rotations[0].T - np.eye(3)) * RATE_HZ
        twist = [*(self.motion.positions[1] - self.motion.positions[0]) * RATE_HZ, turn[2, 1], turn[0, 2], turn[1, 0]]
        follow(
            self.parameters[()], sensor_geometry(mechanism)[()], self.state[()], imu_state(model, seed, 1.0 / RATE_HZ),
            self.motion.signals, used, model.latency, 0, self.motion.positions[0] + 2e-3, self.motion.rotations[0],
            np.array(twist), self.positions, self.rotations,
        )  # fmt: skip

    def rms(self, first=0.5):
        """Position [mm] and rotation [deg] from this share of the run on."""
        late = slice(round(first * len(self.positions)), None)
        distance = np.linalg.norm(self.positions - self.motion.positions, axis=1)[late]
        angle = rotation_angle(self.rotations, self.motion.rotations)[late]
        return 1e3 * np.sqrt(np.mean(distance**2)), np.degrees(np.sqrt(np.mean(angle**2)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "errors", [*(pytest.param(each, marks=pytest.mark.slow) for each in ("gyroscopes", "accelerometers")), "alignments"]
)
@pytest.mark.parametrize(
    ("kind", "limits"),
    [
        pytest.param("0.5", (0.2, 0.03), marks=pytest.mark.slow),
        ("1", (0.15, 0.03)),
        pytest.param("2", (0.1, 0.03), marks=pytest.mark.slow),
        ("mixed", (0.5, 0.1)),
    ],
)
def test_a_motion_is_followed_to_a_tenth_of_a_millimetre(hexapod, errors, kind, limits):
    position, rotation = Run(hexapod, kind, errors, seconds=20.0).rms()
    assert position < limits[0]
    assert rotation < limits[1]


def test_ideal_imus_give_the_motion_itself(hexapod):
    position, rotation = Run(hexapod, "1", "accelerometers", seconds=4.0, imu="ideal").rms()
    assert position < 5e-3
    assert rotation < 2e-3


def test_the_biases_of_the_gyroscopes_are_found(hexapod):
    run = Run(hexapod, "1", "accelerometers", seconds=20.0)
    true = imu_state(load_imu("mpu9150-calibrated"), 0, 1.0 / RATE_HZ)["offset"][0, :7]
    assert np.degrees(np.abs(run.state["errors"][:, :3] - true)).max() < 0.01


@pytest.mark.slow
def test_at_rest_it_does_not_drift(hexapod):
    run = Run(hexapod, "static", "accelerometers", seconds=40.0)
    distance = 1e3 * np.linalg.norm(run.positions - run.motion.positions, axis=1)
    assert distance[-5000:].max() < 0.6
    assert distance[-5000:].mean() < 1.5 * distance[10_000:15_000].mean() + 0.1


@pytest.mark.parametrize(("standing", "least", "most"), [(1, 0.0, 0.02), (0, 0.1, 1.0)])
def test_a_platform_that_stands_tells_the_biases_of_the_gyroscopes_at_once(hexapod, standing, least, most):
    """Within 0.2 s, where four legs alone tell some motions by biases of a few hundredths of a degree per second."""
    motion, state = impose(hexapod, "static", 0.2, RATE_HZ, 0), np.zeros((), FILTER_STATE)
    parameters, geometry = filter_parameters(FusionSettings(), RATE_HZ, "accelerometers", None), sensor_geometry(hexapod)
    biases, used = np.radians(np.random.default_rng(6).normal(0.0, 0.2, (7, 3))), np.isin(np.arange(7), (1, 2, 3, 4))
    start_filter(parameters[()], state[()], 0.0, motion.positions[0], motion.rotations[0], np.zeros(6))
    state["standing"] = standing
    for i, signal in enumerate(motion.signals[1:], start=1):
        sample = signal.copy()
        sample[0, :7] += biases
        accumulate_sample(state[()], sample, weights_of(used), i / RATE_HZ)
        step_filter(parameters[()], geometry[()], state[()])
    left = np.degrees(np.abs(state["errors"][used, :3] - biases[used])).max()
    assert least <= left < most


# -------------------------------------------------------------------------------------------------------- the slow clear twin


class Twin:
    """The same filter with dense matrices and one joint update.

    In place of an encoder's zero it has what the encoder would read at the pose without play: a reading is linear in that. The
    noise of the base's IMU makes the noise of all readings one full matrix.
    """

    def __init__(self, parameters, mechanism, errors, position, rotation, twist):
        self.p, self.mechanism, self.n = parameters, mechanism, BLOCKS[errors]
        self.geometry, self.rig = sensor_geometry(mechanism)[()], np.zeros(int(parameters["rig"]))
        self.position, self.rotation = position.copy(), rotation.copy()
        self.motion = np.array([twist[:3], twist[3:], np.zeros(3), np.zeros(3)])
        self.low_passed = [self.motion.copy(), self.motion.copy()]
        self.smooth = self.motion.copy()
        self.errors, self.time = np.zeros((7, ERRORS)), 0.0
        kept = [*(k * ERRORS + i for k in range(7) for i in range(self.n)), *range(ALL_ERRORS, ALL_ERRORS + len(self.rig))]
        self.encoders, self.play = 6 * int(parameters["lengths"] > 0), np.zeros(6)
        self.base, self.base_errors = int(parameters["base"]), np.zeros(6)
        self.covariance = np.zeros((18 + len(kept) + 2 * self.encoders + self.base,) * 2)
        self.covariance[:18, :18] = np.diag(np.repeat(np.square([0.01, 0.05, 0.1, 0.5, 5.0, 50.0]), 3))
        self.covariance[18 : 18 + len(kept), 18 : 18 + len(kept)] = parameters["prior"][np.ix_(kept, kept)]
        if self.encoders:
            self.first = 18 + len(kept)
            self.covariance[self.first :, self.first :] = np.diag(np.repeat(parameters["length_prior"], 6))
            self.read, gradient = self.lengths()
            self.shift_readings(gradient)
        if self.base:
            self.covariance[-6:, -6:] = np.diag(np.repeat(parameters["base_prior"], 3))

    def lengths(self):
        """The legs' lengths (6,) at the pose, and their gradients (6, 6) by central differences."""

        def at(step):
            moved = rotation_of(step[3:]) @ self.rotation
            legs = self.position + step[:3] + self.mechanism.platform_joints @ moved.T - self.mechanism.base_joints
            return np.linalg.norm(legs, axis=1)

        steps = 1e-5 * np.eye(6)
        return at(np.zeros(6)), np.stack([(at(step) - at(-step)) / 2e-5 for step in steps], axis=1)

    def shift_readings(self, gradient):
        """Add the lengths' errors by a gradient (6, 6) to those of the readings."""
        shift = np.eye(len(self.covariance))
        shift[self.first : self.first + 6, :6] = gradient
        self.covariance = shift @ self.covariance @ shift.T

    def zeros(self):
        """The encoders' zeros (6,), and the covariance with them in place of the readings."""
        lengths, gradient = self.lengths()
        shift = np.eye(len(self.covariance))
        shift[self.first : self.first + 6, :6] = -gradient
        return self.read - lengths, shift @ self.covariance @ shift.T

    def matrices(self, errors):
        """Of gyroscope and accelerometer: I + diag(scale) + U(axes); and the alignment, turned back, to second order."""
        found = []
        for scale, axes in ((9, 18), (6, 15)):
            matrix = np.eye(3) + np.diag(errors[scale : scale + 3])
            matrix[[0, 0, 1], [1, 2, 2]] += errors[axes : axes + 3]
            found.append(matrix)
        back = -skew(errors[12:15])
        return found, np.eye(3) + back + back @ back / 2.0

    def predict(self, t):
        v, w, a, e = self.motion
        uncertain = np.diag(self.covariance)[6:18].reshape(4, 3).sum(axis=1)
        turn = w * t + e * t * t / 2.0
        transition = np.eye(len(self.covariance))
        for i in range(3):
            for block in (0, 3):
                transition[block + i, 6 + block + i] = t
                transition[block + i, 12 + block + i] = t * t / 2.0
                transition[6 + block + i, 12 + block + i] = t
        transition[3:6, 3:6] += skew(turn)
        noise = np.zeros_like(transition)
        shape = np.array([[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]])
        for block, jerk in zip((0, 3), self.p["jerk"], strict=True):
            for i in range(3):
                at = [block + i, 6 + block + i, 12 + block + i]
                noise[np.ix_(at, at)] = jerk * shape
        for k in range(7):
            for i in range(min(self.n, 6)):
                noise[18 + k * self.n + i, 18 + k * self.n + i] = self.p["bias_walk"][i // 3] * t
        if self.encoders:
            before, gradient = self.lengths()
            self.shift_readings(-gradient)
            left = np.exp(-t / 0.5)
            self.play = self.play * left
            for i in range(self.first + 6, self.first + 12):
                transition[i, i], noise[i, i] = left, self.p["length_prior"][1] * (1.0 - left**2)
        if self.base:
            noise[-6:, -6:] = np.diag(np.repeat(self.p["bias_walk"], 3)) * t
        self.covariance = transition @ self.covariance @ transition.T + noise
        self.position = self.position + v * t + a * t * t / 2.0
        self.rotation = rotation_of(turn) @ self.rotation
        self.motion = np.array([v + a * t, w + e * t, a, e])
        if self.encoders:
            after, gradient = self.lengths()
            self.read = self.read + after - before
            self.shift_readings(gradient)
        first, second = self.low_passed
        first = first + t / (t + 0.03) * (self.motion - first)
        second = second + t / (t + 0.03) * (first - second)
        self.low_passed, self.smooth = [first, second], 2.0 * first - second
        if (np.square(self.smooth).sum(axis=1) <= 9.0 * uncertain).all():
            self.smooth = np.zeros((4, 3))

    def by_rig(self):
        """Derivatives (7, 6, 38) of ideal readings by joints and tilt, by differences."""

        def ideal(rig):
            readings, scratch = np.zeros((7, 6)), np.zeros((), READINGS_SCRATCH)
            geometry = sensor_geometry(self.mechanism.moved_joints(rig[:36].reshape(2, 6, 3)), rig[36:])
            args = (self.position, self.rotation, self.smooth, False, readings, np.zeros((7, 6, MOTION_STATES)), scratch[()])
            predict_readings(geometry[()], *args)
            return readings

        steps = 1e-6 * np.eye(len(self.rig))
        return np.stack([(ideal(step) - ideal(-step)) / 2e-6 for step in steps], axis=2) if len(steps) else np.zeros((7, 6, 0))

    def update(self, samples, count, time, readings=(), read=(), later=()):
        """Take mean samples (7, 6) of `count` (7,), and mean `readings` (6,) of `read` (6,) that are `later` (6,) [s]."""
        self.predict(time - self.time)
        self.time = time
        scratch, ideal, at_smooth = np.zeros((), READINGS_SCRATCH), np.zeros((7, 6)), np.zeros((7, 6, MOTION_STATES))
        smooth = np.zeros((7, 6))
        predict_readings(self.geometry, self.position, self.rotation, self.smooth, True, smooth, at_smooth, scratch[()])
        predict_readings(self.geometry, self.position, self.rotation, self.motion, False, ideal, at_smooth.copy(), scratch[()])
        by_rig, frames = self.by_rig(), np.zeros((7, 3, 3))
        find_frames(self.geometry, self.position, self.rotation, frames)
        rows, innovations, variances = [], [], []
        for k in np.flatnonzero(count):
            matrices, back = self.matrices(self.errors[k])
            for sensor, matrix in enumerate(matrices):
                part = slice(3 * sensor, 3 * sensor + 3)
                x, y = back @ ideal[k, part], back @ smooth[k, part]
                by_errors = np.zeros((3, ERRORS))
                by_errors[:, part] = np.eye(3)
                by_errors[:, (9, 6)[sensor] : (9, 6)[sensor] + 3] = np.diag(y)
                by_errors[:, 12:15] = matrix @ skew(y)
                by_errors[:, (18, 15)[sensor] : (18, 15)[sensor] + 3] = [[y[1], y[2], 0.0], [0.0, 0.0, y[2]], [0.0, 0.0, 0.0]]
                row = np.zeros((3, len(self.covariance)))
                row[:, :18] = matrix @ back @ at_smooth[k, part]
                row[:, 18 + k * self.n : 18 + (k + 1) * self.n] = by_errors[:, : self.n]
                row[:, 18 + 7 * self.n : 18 + 7 * self.n + len(self.rig)] = matrix @ back @ by_rig[k, part]
                rows.append(row)
                rest = matrix @ back @ by_rig[k, part] @ self.rig
                if self.base:
                    of_base = np.zeros((3, 6))
                    of_base[:, part] = -frames[k]
                    row[:, -6:] = of_base
                    rest = rest + of_base @ self.base_errors
                innovations.append(samples[k, part] - matrix @ x - self.errors[k, part] - rest)
                ripple = self.p["ripple"] * self.smooth[ACCELERATION] @ self.smooth[ACCELERATION] if sensor == 1 else 0.0
                variances += [self.p["variance"][sensor] / count[k] + ripple] * 3
        for k in np.flatnonzero(read):
            gradient = self.lengths()[1][k]
            row = np.zeros((1, len(self.covariance)))
            of_rig = 0.0
            if len(self.rig):
                by_joints = np.zeros((2, 6, 3))
                by_joints[:, k] = -gradient[:3], gradient[:3] @ self.rotation
                row[0, 18 + 7 * self.n : 54 + 7 * self.n] = by_joints.ravel()
                of_rig = by_joints.ravel() @ self.rig[:36]
            row[0, [self.first + k, self.first + 6 + k]] = 1.0
            row[0, 6:12] = later[k] * gradient
            rows.append(row)
            at_mean = later[k] * gradient @ self.motion[:2].ravel()
            innovations.append([readings[k] - self.read[k] - self.play[k] - at_mean - of_rig])
            variances.append(self.p["length_variance"] / read[k])
        h, innovation = np.vstack(rows), np.concatenate(innovations)
        noise = np.diag(variances)
        if self.base:
            noise += h[:, -6:] @ np.diag(np.repeat(self.p["base_variance"], 3) / self.p["window"]) @ h[:, -6:].T
        gain = np.linalg.solve(h @ self.covariance @ h.T + noise, h @ self.covariance).T
        change = gain @ innovation
        self.covariance = self.covariance - gain @ h @ self.covariance
        self.covariance = (self.covariance + self.covariance.T) / 2.0
        self.position = self.position + change[:3]
        self.rotation = rotation_of(change[3:6]) @ self.rotation
        self.motion = self.motion + change[6:18].reshape(4, 3)
        self.errors[:, : self.n] += change[18 : 18 + 7 * self.n].reshape(7, self.n)
        self.rig = self.rig + change[18 + 7 * self.n : 18 + 7 * self.n + len(self.rig)]
        if self.encoders:
            self.read = self.read + change[self.first : self.first + 6]
            self.play = self.play + change[self.first + 6 :]
        if self.base:
            self.base_errors = self.base_errors + change[-6:]


@pytest.mark.parametrize(
    ("errors", "rig", "base", "tolerance"),
    [
        ("gyroscopes", False, False, 1.0),
        ("gyroscopes", False, True, 1.0),
        *(pytest.param(name, False, False, 1.0, marks=pytest.mark.slow) for name in list(BLOCKS)[1:]),
        pytest.param("accelerometers", False, True, 1.0, marks=pytest.mark.slow),
        pytest.param("axes", True, False, 300.0, marks=pytest.mark.slow),
    ],
)
def test_taken_bit_by_bit_it_equals_its_dense_twin(hexapod, errors, rig, base, tolerance):
    motion = impose(hexapod, "1", 0.5, RATE_HZ, 4)
    random = np.random.default_rng(4)
    samples = motion.signals + random.normal(0.0, 1.0, motion.signals.shape) * np.array([0.002, 0.02, 0.0])[:, None, None]
    used = np.ones((len(samples), 7), np.int64)
    used[103:202, 2] = used[151:251, 6] = 0
    settings = FusionSettings(accelerometer_bias_sigma=0.1, scale_sigma=0.02, alignment_sigma=0.02, axes_sigma=0.02)
    parameters = filter_parameters(settings, RATE_HZ, errors, None, base=base)
    if rig:
        # Correlated, as rests leave it; the twin's derivatives are differences.
        prior, mixed = (
            parameters["prior"][:ALL_ERRORS, :ALL_ERRORS],
            random.normal(size=(ALL_ERRORS + RIG_ERRORS, ALL_ERRORS + RIG_ERRORS)),
        )
        spread = np.diag(np.sqrt(np.concatenate([np.diag(prior), np.full(JOINTS, 1e-8), np.full(TILT, 1e-6)])))
        covariance = spread @ (np.eye(len(mixed)) + mixed @ mixed.T / len(mixed)) @ spread
        parameters = filter_parameters(settings, RATE_HZ, errors, covariance)
    parameters["ripple"] = 0.04
    geometry, state = sensor_geometry(hexapod)[()], np.zeros((), FILTER_STATE)
    turn = (motion.rotations[1] @ motion.rotations[0].T - np.eye(3)) * RATE_HZ
    velocity = (motion.positions[1] - motion.positions[0]) * RATE_HZ
    twist = np.array([*velocity, turn[2, 1], turn[0, 2], turn[1, 0]])
    start = motion.positions[0] + 1e-3, rotation_of([0.003, -0.002, 0.004]) @ motion.rotations[0], twist
    twin = Twin(parameters, hexapod, errors, *start)
    start_filter(parameters[()], state[()], 0.0, *start)
    window = 5
    for i in range(1, len(samples)):
        accumulate_sample(state[()], samples[i], weights_of(used[i]), i / RATE_HZ)
        step_filter(parameters[()], geometry, state[()])
        if i % window == 0:
            taken, block = used[i - window + 1 : i + 1], samples[i - window + 1 : i + 1]
            count = taken.sum(axis=0)
            mean = np.einsum("nk,nski->ksi", taken, block[:, :2]).reshape(7, 6) / np.maximum(count, 1)[:, None]
            twin.update(mean, count, (i - (window - 1) / 2.0) / RATE_HZ)
        if i % window == window - 1 and i > window:
            # The update that began four cycles ago is complete.
            assert state["row"] == -1
            np.testing.assert_allclose(state["position"], twin.position, rtol=0.0, atol=1e-9 * tolerance)
            np.testing.assert_allclose(state["rotation"], twin.rotation, rtol=0.0, atol=1e-9 * tolerance)
            np.testing.assert_allclose(state["motion"], twin.motion, rtol=1e-8, atol=1e-7 * tolerance)
            np.testing.assert_allclose(state["errors"], twin.errors, rtol=0.0, atol=1e-9 * tolerance)
            np.testing.assert_allclose(state["rig"][: len(twin.rig)], twin.rig, rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(state["base_errors"], twin.base_errors, rtol=0.0, atol=1e-9)
            n = len(twin.covariance)
            scale = np.sqrt(np.diag(twin.covariance))
            difference = (state["covariance"][:n, :n] - twin.covariance) / np.outer(scale, scale)
            assert np.abs(difference).max() < 1e-6 * tolerance


@pytest.mark.parametrize(
    ("errors", "rig"),
    [
        ("gyroscopes", False),
        pytest.param("axes", False, marks=pytest.mark.endurance),
        pytest.param("axes", True, marks=pytest.mark.slow),
    ],
)
def test_with_encoders_it_equals_its_twin_whose_states_are_their_readings(hexapod, errors, rig):
    """From a pose that is 5 mm and 0.6 deg off, with one encoder that reads nothing for a while, and one that never does.

    It has run before, and was stopped in the middle of a window.
    """
    motion, window, delay = impose(hexapod, "1", 0.5, RATE_HZ, 4), 5, 2e-3
    random = np.random.default_rng(5)
    samples = motion.signals + random.normal(0.0, 1.0, motion.signals.shape) * np.array([0.002, 0.02, 0.0])[:, None, None]
    zeros, count = random.normal(0.0, 0.03, 6), len(samples)
    readings = leg_lengths(hexapod, motion.positions, motion.rotations) + zeros + random.normal(0.0, 3e-6, (count, 6))
    used = np.ones((count, 6))
    used[103:202, 2] = used[:, 4] = 0.0
    settings = FusionSettings(length_noise=3e-6)
    parameters = filter_parameters(settings, RATE_HZ, errors, None, lengths=True)
    if rig:
        of_imus = np.diag(parameters["prior"])[:ALL_ERRORS]
        covariance = np.diag(np.concatenate([of_imus, np.full(JOINTS, 1e-8), np.full(TILT, 1e-6)]))
        parameters = filter_parameters(settings, RATE_HZ, errors, covariance, inflation=settings.noise_inflation, lengths=True)
    geometry, state = sensor_geometry(hexapod)[()], np.zeros((), FILTER_STATE)
    turn = (motion.rotations[1] @ motion.rotations[0].T - np.eye(3)) * RATE_HZ
    velocity = (motion.positions[1] - motion.positions[0]) * RATE_HZ
    twist = np.array([*velocity, turn[2, 1], turn[0, 2], turn[1, 0]])
    start = motion.positions[0] + 3e-3, rotation_of([0.006, -0.006, 0.006]) @ motion.rotations[0], twist
    twin = Twin(parameters, hexapod, errors, *start)
    start_filter(parameters[()], state[()], -7.0, *start)
    accumulate_lengths(state[()], readings[0], np.ones(6), -7.0)
    start_filter(parameters[()], state[()], 0.0, *start)
    start_lengths(state[()], zeros)
    twin.read = twin.read + zeros
    for i in range(1, count):
        accumulate_sample(state[()], samples[i], np.ones((2, 7)), i / RATE_HZ - delay)
        accumulate_lengths(state[()], readings[i], used[i], i / RATE_HZ)
        step_filter(parameters[()], geometry, state[()])
        if i % window == 0:
            rows = slice(i - window + 1, i + 1)
            mean, read = samples[rows, :2].mean(axis=0).transpose(1, 0, 2).reshape(7, 6), used[rows].sum(axis=0)
            of_lengths = (readings[rows] * used[rows]).sum(axis=0) / np.maximum(read, 1.0)
            times = (np.arange(i - window + 1, i + 1)[:, None] * used[rows]).sum(axis=0) / np.maximum(read, 1.0) / RATE_HZ
            time = (i - (window - 1) / 2.0) / RATE_HZ - delay
            twin.update(mean, np.full(7, window), time, of_lengths, read, times - time)
        if i % window == window - 1 and i > window:
            found, covariance = twin.zeros()
            np.testing.assert_allclose(state["position"], twin.position, rtol=0.0, atol=3e-9)
            np.testing.assert_allclose(state["rotation"], twin.rotation, rtol=0.0, atol=3e-9)
            np.testing.assert_allclose(state["length_errors"], [found, twin.play], rtol=0.0, atol=3e-9)
            np.testing.assert_allclose(state["rig"][: len(twin.rig)], twin.rig, rtol=0.0, atol=3e-9)
            scale = np.sqrt(np.diag(covariance))
            difference = (state["covariance"][: len(scale), : len(scale)] - covariance) / np.outer(scale, scale)
            assert np.abs(difference).max() < 1e-4
    assert np.linalg.norm(twin.position - motion.positions[i - window]) < 2e-3


def test_a_home_switch_tells_where_the_platform_is(hexapod):
    """From a pose that is 3 mm and 0.3 deg off; one that is 20 mm from where it is said to be is not believed."""
    motion, random = impose(hexapod, "1", 0.5, RATE_HZ, 4), np.random.default_rng(5)
    samples = motion.signals + random.normal(0.0, 1.0, motion.signals.shape) * np.array([0.002, 0.02, 0.0])[:, None, None]
    zeros = random.normal(0.0, 0.03, 6)
    readings = leg_lengths(hexapod, motion.positions, motion.rotations) + zeros
    parameters = filter_parameters(FusionSettings(length_noise=3e-6), RATE_HZ, "gyroscopes", None, lengths=True)
    turn = (motion.rotations[1] @ motion.rotations[0].T - np.eye(3)) * RATE_HZ
    velocity = (motion.positions[1] - motion.positions[0]) * RATE_HZ
    twist = np.array([*velocity, turn[2, 1], turn[0, 2], turn[1, 0]])
    off, geometry = [], sensor_geometry(hexapod)[()]
    for told in (None, zeros, zeros + 0.02):
        state, position, rotation = np.zeros((), FILTER_STATE), np.zeros(3), np.zeros((3, 3))
        start = motion.positions[0] + 3e-3, rotation_of([0.003, -0.003, 0.003]) @ motion.rotations[0], twist
        start_filter(parameters[()], state[()], 0.0, *start)
        start_lengths(state[()], readings[0] - leg_lengths(hexapod, *(each[None] for each in start[:2]))[0])
        for i in range(1, len(samples)):
            accumulate_sample(state[()], samples[i], np.ones((2, 7)), i / RATE_HZ)
            accumulate_lengths(state[()], readings[i], np.ones(6), i / RATE_HZ)
            for k in range(6 if i == 200 and told is not None else 0):
                accumulate_switch(state[()], k, told[k], 3e-5)
            step_filter(parameters[()], geometry, state[()])
        extrapolate(state[()], i / RATE_HZ, position, rotation, np.zeros(6), np.zeros(6))
        off.append(np.linalg.norm(position - motion.positions[i]))
    without, switched, refused = off
    assert switched < 3e-5 < 0.5 * without
    assert refused == without and not state["length_passed"].any()


def test_what_is_known_grows_less_sure_on_the_way_to_the_present(hexapod):
    random, time = np.random.default_rng(6), 0.0117
    parameters, state = (
        filter_parameters(FusionSettings(), RATE_HZ, "axes", None, np.array([3e-4, 6e-4])),
        np.zeros((), FILTER_STATE),
    )
    mixed, found = random.normal(0.0, 1e-3, (18, 18)), np.zeros((6, 6))
    state["published_covariance"] = mixed @ mixed.T
    extrapolate_covariance(parameters[()], state[()], time, found)
    carried = np.hstack([np.eye(6), time * np.eye(6), time**2 / 2.0 * np.eye(6)])
    jerk = np.repeat(parameters["jerk"], 3) * time**5 / 20.0
    floor = np.repeat([3e-8, 12e-8], 3)
    np.testing.assert_allclose(found, carried @ mixed @ mixed.T @ carried.T + np.diag(jerk + floor), rtol=1e-12, atol=1e-20)


def test_the_gradient_of_the_errors_is_that_of_the_reading():
    random = np.random.default_rng(5)
    errors, ideal = random.normal(0.0, 0.02, ERRORS), random.normal(0.0, 5.0, 6)

    def read(errors):
        sensors = ((sensor, slice(3 * sensor, 3 * sensor + 3)) for sensor in range(2))
        return np.concatenate(
            [np.array(distort(errors, sensor, tuple(ideal[part]))) + errors[part] for sensor, part in sensors]
        )

    for m in range(6):
        gradient = np.zeros(ERRORS)
        error_gradient(errors, ideal, m, gradient)
        for i in range(ERRORS):
            change = np.zeros(ERRORS)
            change[i] = 1e-6
            # That of the alignment is to first order in it.
            tolerance = 0.02 * np.linalg.norm(ideal) if 12 <= i < 15 else 1e-8
            assert gradient[i] == pytest.approx((read(errors + change)[m] - read(errors - change)[m]) / 2e-6, abs=tolerance)


@pytest.mark.slow
def test_a_dead_imu_costs_little_in_motion(hexapod):
    count = 10_000
    used = np.ones((count, 7), np.int64)
    whole = Run(hexapod, "1", "accelerometers", seconds=10.0).rms()[0]
    for dead in (0, 4):
        used[:] = 1
        used[2000:, dead] = 0
        assert Run(hexapod, "1", "accelerometers", seconds=10.0, used=used).rms()[0] < 1.5 * whole + 0.02


def test_every_cycle_of_a_window_takes_its_share(hexapod):
    parameters = filter_parameters(FusionSettings(), RATE_HZ, "accelerometers", None)
    geometry, state = sensor_geometry(hexapod)[()], np.zeros((), FILTER_STATE)
    start_filter(parameters[()], state[()], 0.0, hexapod.home.position, np.eye(3), np.zeros(6))
    signals = impose(hexapod, "static", 0.1, RATE_HZ, 0).signals[0]
    rows = []
    for i in range(1, 21):
        accumulate_sample(state[()], signals, np.ones((2, 7)), i / RATE_HZ)
        step_filter(parameters[()], geometry, state[()])
        rows.append(int(state["row"]))
    assert rows[4:9] == [0, 9, 20, 31, -1]
    assert rows[9:14] == rows[4:9]


@pytest.mark.parametrize("off", [0.02, -0.02, 2.0, -2.0])
def test_the_heading_is_taken_as_a_kalman_filter_takes_it(hexapod, off):
    """On an inclined base, while the platform turns; against a dense update with a Jacobian of differences."""
    random, up, magnetic = np.random.default_rng(8), np.array([0.2, -0.1, 0.9]) / np.sqrt(0.86), np.array([12.0, 15.0, -40.0])
    mechanism = Mechanism.from_legs(
        hexapod.base_joints, hexapod.platform_joints, up_in_base=up, home=hexapod.home, limits={"stroke": (-0.06, 0.06)},
        plant={**hexapod.plant, "gravity": -9.81 * up, "magnetic_field": magnetic},
    )  # fmt: skip
    parameters = filter_parameters(fusion_settings(mechanism), RATE_HZ, "gyroscopes", None, field=field_of(mechanism))
    parameters["heading_variance"], n = 1e-4, int(parameters["states"])
    state, rotation = np.zeros((), FILTER_STATE), rotation_of([0.2, -0.1, 0.3])
    start_filter(parameters[()], state[()], 0.0, mechanism.home.position, rotation, np.array([0.1, -0.2, 0.3, 1.0, -2.0, 1.5]))
    geometry, mixed = sensor_geometry(mechanism)[()], random.normal(size=(n, n))
    state["covariance"][:n, :n] = 1e-4 * mixed @ mixed.T / n
    state["heading_offset"], offset_variance = 0.015, state["covariance"][n - 1, n - 1]
    state["field"], state["field_time"], state["field_used"] = rotation.T @ rotation_of(off * up) @ magnetic, 0.005, 1
    without = state.copy()
    without["field_used"] = 0
    for each in (state, without):
        for i in range(1, 10):
            # No IMU is used, so that nothing but the field is taken.
            accumulate_sample(each[()], np.zeros((3, 7, 3)), np.zeros((2, 7)), i / RATE_HZ)
            step_filter(parameters[()], geometry, each[()])
    assert state["row"] == without["row"] == -1 and state["field_used"] == 0
    predicted, spread = without["rotation"], without["covariance"][:n, :n]
    # What the offset is grows less sure, by as much as at the start in 100 s.
    growth = float(parameters["offset_variance"]) * without["time"] / 100.0
    assert spread[n - 1, n - 1] == pytest.approx(offset_variance + growth, rel=1e-12)

    north, east = field_of(mechanism).vectors[1], np.cross(up, field_of(mechanism).vectors[1])
    ahead = rotation_of(-(state["field_time"] - without["time"]) * without["motion"][1])

    def heading(error):
        seen = rotation_of(-error[:3]) @ ahead @ rotation_of(error[3] * up) @ magnetic
        return np.arctan2(east @ seen, north @ seen)

    at = np.array([0.0, 0.0, 0.0, 0.015])
    row = np.zeros(n)
    row[[3, 4, 5, n - 1]] = [(heading(at + h) - heading(at - h)) / 2e-6 for h in 1e-6 * np.eye(4)]
    seen = predicted @ state["field"]
    innovation, variance = np.arctan2(east @ seen, north @ seen) - heading(at), row @ spread @ row + 1e-4
    innovation = np.clip(innovation, -3.0 * np.sqrt(variance), 3.0 * np.sqrt(variance))
    assert (abs(innovation) == 3.0 * np.sqrt(variance)) == (abs(off) > 1.0)
    gain = spread @ row / variance
    change = gain * innovation
    found = [
        state["position"] - without["position"], Rotation.from_matrix(state["rotation"] @ predicted.T).as_rotvec(),
        (state["motion"] - without["motion"]).ravel(), (state["errors"] - without["errors"])[:, :3].ravel(),
        [state["heading_offset"] - 0.015],
    ]  # fmt: skip
    np.testing.assert_allclose(np.concatenate(found), change, rtol=0.0, atol=0.02 * np.abs(change).max())
    left = spread - np.outer(gain, row @ spread)
    np.testing.assert_allclose(state["covariance"][:n, :n], left, rtol=0.0, atol=0.02 * np.abs(spread).max())


def test_what_is_published_is_carried_to_the_present_by_its_motion():
    random, state = np.random.default_rng(9), np.zeros((), FILTER_STATE)
    state["published_time"], state["published_rotation"] = 2.0, rotation_of([0.3, -0.2, 0.5])
    state["published_position"], motion = random.normal(size=3), random.normal(size=(4, 3))
    state["published_motion"] = motion

    def at(time):
        pose = np.zeros(3), np.zeros((3, 3)), np.zeros(6), np.zeros(6)
        extrapolate(state[()], time, *pose)
        return pose

    position, rotation, twist, acceleration = at(2.3)
    np.testing.assert_allclose(position, state["published_position"] + 0.3 * motion[0] + 0.045 * motion[2], atol=1e-14)
    turned = rotation_of(0.3 * motion[1] + 0.045 * motion[3]) @ state["published_rotation"]
    np.testing.assert_allclose(rotation, turned, atol=1e-12)
    np.testing.assert_allclose(twist, np.concatenate([motion[0] + 0.3 * motion[2], motion[1] + 0.3 * motion[3]]), atol=1e-14)
    np.testing.assert_allclose(acceleration, motion[2:].ravel(), atol=1e-14)


def test_a_window_is_the_weighted_mean_of_the_samples_of_each_sensor(hexapod):
    random, parameters = np.random.default_rng(10), filter_parameters(FusionSettings(), RATE_HZ, "accelerometers", None)
    state, geometry = np.zeros((), FILTER_STATE), sensor_geometry(hexapod)[()]
    start_filter(parameters[()], state[()], 0.0, hexapod.home.position, np.eye(3), np.zeros(6))
    for window in range(2):
        samples, weights = (
            random.normal(size=(5, 3, 7, 3)),
            random.integers(0, 2, (5, 2, 7)) * random.uniform(1e-4, 1.0, (5, 2, 7)),
        )
        weights[:, :, 0], weights[:, :, 6] = 0.0, 1.0
        for i in range(5):
            accumulate_sample(state[()], samples[i], weights[i], (5 * window + i) / RATE_HZ)
            step_filter(parameters[()], geometry, state[()])
        np.testing.assert_allclose(state["sample_weight"], weights.sum(axis=0), rtol=1e-14)
        for sensor in range(2):
            for imu in range(1, 7):
                if weights[:, sensor, imu].any():
                    mean = np.average(samples[:, sensor, imu], axis=0, weights=weights[:, sensor, imu])
                    found = state["sample"][imu, 3 * sensor : 3 * sensor + 3]
                    np.testing.assert_allclose(found, mean, rtol=0.0, atol=1e-13)
        assert state["time"] == pytest.approx((5 * window + 2) / RATE_HZ)


def test_a_reading_counts_in_the_update_by_its_weight(hexapod):
    """A thousandth of the weight is a thousand times the variance: the same as a filter with that noise."""
    random, home = np.random.default_rng(3), hexapod.home
    samples = random.normal(size=(5, 3, 7, 3))
    found = []
    for weight, inflation in ((1e-3, 1.0), (1.0, 1e3)):
        parameters = filter_parameters(FusionSettings(), RATE_HZ, "accelerometers", None)
        parameters["variance"] *= inflation
        state = np.zeros((), FILTER_STATE)
        start_filter(parameters[()], state[()], 0.0, home.position, np.eye(3), np.zeros(6))
        for i in range(10):
            accumulate_sample(state[()], samples[i % 5], np.full((2, 7), weight), i / RATE_HZ)
            step_filter(parameters[()], sensor_geometry(hexapod)[()], state[()])
        found.append(state)
    np.testing.assert_allclose(found[0]["covariance"], found[1]["covariance"], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(found[0]["published_position"], found[1]["published_position"], rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("kind", ["1", "2"])
def test_how_fast_readings_change_is_their_derivative_where_times_are_uncertain(hexapod, kind):
    run = Run(hexapod, kind, "accelerometers", seconds=3.0, sensor_timing=3e-4)
    signals = np.concatenate([run.motion.signals[:, 0], run.motion.signals[:, 1]], axis=2)
    at = round(run.state["predicted_time"] * RATE_HZ)
    true = (signals[at] - signals[at - 5]) * RATE_HZ / 5
    found = run.state["change_per_second"]
    for part in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(found[:, part], true[:, part], atol=0.2 * np.abs(true[:, part]).max())
    assert not Run(hexapod, kind, "accelerometers", seconds=0.5).state["change_per_second"].any()


def test_a_reading_that_changes_counts_less_where_times_are_uncertain(hexapod):
    """As much as with the noise that the change makes of the uncertain time, for all samples of a window alike."""
    found, late = [], 2e-3
    for timing, noise in ((late, 0.0), (0.0, late)):
        parameters = filter_parameters(FusionSettings(), RATE_HZ, "accelerometers", None)
        state = np.zeros((), FILTER_STATE)
        start_filter(parameters[()], state[()], 0.0, hexapod.home.position, np.eye(3), np.zeros(6))
        state["change_per_second"] = 0.4
        parameters["timing_variance"] = timing**2
        parameters["variance"] += 5 * (noise * 0.4) ** 2
        state["sample_weight"], state["row"] = 5.0, 0
        _update_rows(parameters[()], sensor_geometry(hexapod)[()], state[()], 42)
        found.append(state["covariance"].copy())
    np.testing.assert_allclose(*found, rtol=1e-12, atol=1e-18)


def test_a_force_counts_less_while_steps_of_the_commands_make_it_ripple(hexapod):
    """As much as with the noise of that ripple, for all samples of a window alike; angular velocities do not ripple."""
    found, share, acceleration = [], 0.3, np.array([1.0, -2.0, 2.0])
    for ripple, noise in ((share, 0.0), (0.0, 3.0 * share)):
        parameters = filter_parameters(FusionSettings(), RATE_HZ, "accelerometers", None)
        state = np.zeros((), FILTER_STATE)
        start_filter(parameters[()], state[()], 0.0, hexapod.home.position, np.eye(3), np.zeros(6))
        state["smooth_motion"][ACCELERATION] = acceleration
        parameters["ripple"] = ripple**2
        parameters["variance"][1] += 5 * noise**2
        state["sample_weight"], state["row"] = 5.0, 0
        _update_rows(parameters[()], sensor_geometry(hexapod)[()], state[()], 42)
        found.append(state["covariance"].copy())
    np.testing.assert_allclose(*found, rtol=1e-12, atol=1e-18)


def test_an_unknown_block_of_errors_is_refused():
    with pytest.raises(
        UnknownNameError, match="no block of errors 'all'; there are gyroscopes, accelerometers, alignments, axes"
    ):
        filter_parameters(FusionSettings(), RATE_HZ, "all", None)
