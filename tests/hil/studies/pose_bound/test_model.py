"""The linear model against the IMU layer that it describes, and its bound against independent algebra."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import block_diag

from controller.calibration.file import Calibration
from controller.planning.target import load_target
from hil.studies.detectability.kinematics import base_motion_along, motion_along, sensitivity, signals
from hil.studies.pose_bound import model as model_module
from hil.studies.pose_bound.bound import pose_covariances
from hil.studies.pose_bound.model import ERRORS, STEP_S, LinearModel, Setup
from plant.dynamics.base_course import base_motion_of_text
from plant.encoders import EncoderModel, load_encoder
from plant.imu import MILLI_G, ImuModel, SensorErrors, imu_state, load_imu
from plant.imu_wiring import ALL_IMUS, BASE_IMU
from plant.mechanism import load_in_space

CALIBRATED, INCREMENTAL = load_imu("mpu9150-calibrated"), load_encoder("incremental")


@pytest.fixture(scope="module")
def hexapod():
    return load_in_space("hexapod")


def motion_of(mechanism, steps, target="hold", step=STEP_S, first=0.0):
    times = first + step * (np.arange(steps) + 0.5)
    return motion_along(load_target(target, mechanism, 10.0), mechanism, times)


SEA = "base-tilt,axis=x,size_deg=3,sine_hz=0.125", "base-acceleration,axis=z,size_m_per_s2=0.1,sine_hz=0.159"
ON_BASE = (*ALL_IMUS, BASE_IMU)


def on_base(mechanism, motion, *texts):
    """The same motion on a base that moves, by default one that rests."""
    times = STEP_S * (np.arange(len(motion.position)) + 0.5)
    return replace(motion, base=base_motion_along([base_motion_of_text(f"{text},at=0") for text in texts], mechanism, times))


def last(setup, steps=20, **motion):
    """The pose's covariance after so many steps."""
    return pose_covariances(LinearModel(setup), motion_of(setup.mechanism, steps, **motion))[-1]


def sizes(covariance):
    """RMS of position [mm] and rotation [deg]."""
    position, rotation = np.sqrt(np.diag(covariance).reshape(2, 3).sum(axis=1))
    return 1e3 * position, np.degrees(rotation)


def test_the_recursion_is_the_algebra_of_all_data_at_once(hexapod):
    """The covariance of the last pose given all data, from the covariance of the whole batch."""
    model = LinearModel(Setup(hexapod, (0, 4, 5, 6), CALIBRATED, magnetometer=True, encoder=INCREMENTAL))
    motion = motion_of(hexapod, 6, "sines", first=2.0)
    seen, steps = model.seen(motion), 6
    covariances = [model.prior]
    whole_steps = [model.transition @ np.diag(np.r_[np.ones(len(model.prior) - 6), kept]) for kept in model.kept(motion)]
    for step, kept in zip(whole_steps, model.kept(motion), strict=True):
        renewed = np.diag(np.r_[np.zeros(len(model.prior) - 6), (1.0 - kept**2) * np.diag(model.prior)[-6:]])
        covariances.append(step @ covariances[-1] @ step.T + model.driving + renewed)

    def reach(j, i):
        """From step j to step i."""
        return np.linalg.multi_dot([np.eye(len(model.prior)), *whole_steps[j:i][::-1], np.eye(len(model.prior))])

    blocks = [[seen[i] @ reach(j, i) @ covariances[j] @ seen[j].T for j in range(i + 1)] for i in range(steps)]
    whole = np.block([[blocks[i][j] if j <= i else blocks[j][i].T for j in range(steps)] for i in range(steps)])
    whole += np.diag(np.tile(model.noise, steps))
    across = np.concatenate([reach(i, steps - 1) @ covariances[i] @ seen[i].T for i in range(steps)], axis=1)
    expected = covariances[steps - 1] - across @ np.linalg.solve(whole, across.T)
    np.testing.assert_allclose(pose_covariances(model, motion)[-1], expected[:6, :6], rtol=1e-4, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("imu", ["mpu9150", "mpu9150-calibrated", "icm42688"])
def test_the_errors_of_imus_are_as_large_as_the_imu_layer_draws_them(hexapod, imu):
    """The second moments of constant errors, over 400 seeds of seven IMUs, at a pose and in a motion."""
    kind = load_imu(imu)
    motion = motion_of(hexapod, 1, "sines", first=3.0)
    model, ideal = LinearModel(Setup(hexapod, ALL_IMUS, kind)), signals(hexapod, motion)
    seen = model.seen(motion)[0]
    seen[:, : model_module.JET] = 0.0
    expected = np.diag(seen @ model.prior @ seen.T)
    exact = np.stack([ideal.angular_velocity[0], ideal.specific_force[0]])
    squares = np.zeros((2, 7, 3))
    for seed in range(400):
        state = imu_state(kind, seed, 1e-3)
        read = np.einsum("skij,skj->ski", state["gain"][:2, :7], exact) + state["offset"][:2, :7]
        squares += (read - exact) ** 2 / 400
    found = np.moveaxis(squares, 0, 1).reshape(-1)
    # Over IMUs and axes, as a mean square of 400 draws has an error of some percent.
    for sensor in range(2):
        rows = np.arange(42).reshape(7, 2, 3)[:, sensor].ravel()
        assert found[rows].sum() == pytest.approx(expected[rows].sum(), rel=0.05)
        np.testing.assert_allclose(found[rows], expected[rows], rtol=0.35)


def test_noise_that_aliases_counts(hexapod):
    """In slow loops, as in `tests/controller/test_settings.py`."""
    own = ImuModel(
        "own", SensorErrors(noise=1e-3, bandwidth=256.0), SensorErrors(noise=5e-3, bandwidth=260.0), conversion_rate=400e3
    )
    noise = LinearModel(Setup(hexapod, (6,), own, rate=250.0)).noise
    x = np.pi * np.array([256.0, 260.0]) / 250.0
    densities = np.array([1e-3, 5e-3]) * np.sqrt(x / np.tanh(x))
    np.testing.assert_allclose(noise, np.repeat(densities**2 / (2.0 * STEP_S), 3), rtol=5e-3)


def test_at_rest_only_biases_of_accelerometers_are_left_in_the_end(hexapod):
    """Then the bound is that of least squares of 21 forces, each with the variance of a bias."""
    kind = ImuModel("biased", SensorErrors(noise=1e-6), SensorErrors(noise=1e-5, bias=(MILLI_G, MILLI_G)))
    jacobian = sensitivity(hexapod, motion_of(hexapod, 1), lambda ideal: ideal.specific_force.reshape(1, -1))[0, :, :6]
    expected = MILLI_G**2 / 3.0 * np.linalg.inv(jacobian.T @ jacobian)
    found = last(Setup(hexapod, ALL_IMUS, kind), 200)
    np.testing.assert_allclose(found, expected, rtol=3e-2, atol=1e-2 * expected.max())
    np.testing.assert_allclose(sizes(found), sizes(expected), rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-4, 1.0, 1e3])
def test_an_imu_on_the_base_tells_its_force_as_well_as_its_bias_allows(hexapod, size):
    """Biases alone leave those of least squares of 24 forces, three of which are the base's, by pose and the base's force. With
    the base's known, this is the bound of a base at rest; with a huge bias, that of a base of which nothing is known.
    """
    kind = ImuModel("biased", SensorErrors(noise=1e-6), SensorErrors(noise=1e-5, bias=(MILLI_G, MILLI_G)))
    still = motion_of(hexapod, 1)
    by_pose = sensitivity(hexapod, still, lambda ideal: ideal.specific_force.reshape(1, -1))[0, :, :6]
    by_force = np.swapaxes(signals(hexapod, still).axes[0], 1, 2).reshape(21, 3)
    jacobian = np.block([[by_pose, by_force], [np.zeros((3, 6)), np.eye(3) / size]])
    model = LinearModel(Setup(hexapod, ON_BASE, kind))
    model.prior[-3:, -3:] *= size**2
    found = pose_covariances(model, on_base(hexapod, motion_of(hexapod, 300)))[-1]
    expected = MILLI_G**2 / 3.0 * np.linalg.inv(jacobian.T @ jacobian)[:6, :6]
    np.testing.assert_allclose(sizes(found), sizes(expected), rtol=0.03)
    known = MILLI_G**2 / 3.0 * np.linalg.inv(by_pose.T @ by_pose)
    assert (size < 0.1) == np.allclose(sizes(expected), sizes(known), rtol=1e-3)


def test_with_an_ideal_imu_on_the_base_the_bound_is_that_of_a_base_at_rest(hexapod):
    """In motion, with the others as they are, if the base turns steadily; and a base that moves is then like one at rest."""
    still = sizes(last(Setup(hexapod, ALL_IMUS, CALIBRATED), 150, target="sines"))
    for texts in ((), SEA):
        model = LinearModel(Setup(hexapod, ON_BASE, CALIBRATED))
        own = len(model.prior) - (len(model.prior) - 27) // 8
        model.prior[own:, own:] *= 1e-8
        model.noise[-6:] *= 1e-4
        model.driving[18:24, 18:24] *= 1e-6
        found = pose_covariances(model, on_base(hexapod, motion_of(hexapod, 150, "sines"), *texts))[-1]
        np.testing.assert_allclose(sizes(found), still, rtol=0.01)


def test_an_imu_on_the_base_costs_something_and_is_worth_something(hexapod):
    """Between a base at rest, and one that the other seven alone know: they feel more than pose and base have unknowns."""
    still = last(Setup(hexapod, ALL_IMUS, CALIBRATED), 100, target="sines")
    models = [LinearModel(Setup(hexapod, ON_BASE, CALIBRATED)) for _ in range(2)]
    models[1].noise[-6:] *= 1e8
    known, unknown = (pose_covariances(model, on_base(hexapod, motion_of(hexapod, 100, "sines"), *SEA))[-1] for model in models)
    assert (1.1 * np.array(sizes(still)) < sizes(known)).all() and (1.05 * np.array(sizes(known)) < sizes(unknown)).all()


def test_absolute_encoders_alone_leave_their_zeros_and_steps(hexapod):
    encoder = EncoderModel("absolute", absolute=True, resolution=0.0, backlash=0.0, zero=5e-6)
    jacobian = sensitivity(hexapod, motion_of(hexapod, 1), lambda ideal: ideal.lengths)[0, :, :6]
    expected = 25e-12 * np.linalg.inv(jacobian.T @ jacobian)
    found = last(Setup(hexapod, (), CALIBRATED, encoder=encoder))
    np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-3 * expected.max())
    # Five of them leave a direction open.
    assert sizes(last(Setup(hexapod, (), CALIBRATED, encoder=encoder, encoders=(0, 1, 2, 3, 4))))[0] > 10.0


def test_more_sensors_never_make_it_worse(hexapod):
    few = Setup(hexapod, (0, 4, 5, 6), CALIBRATED)
    sets = [few, *(replace(few, imus=imus) for imus in ((0, 1, 4, 5, 6), ALL_IMUS))]
    sets.append(replace(sets[-1], magnetometer=True))
    sets += [replace(sets[-1], encoder=INCREMENTAL), replace(sets[-1], encoder=load_encoder("absolute"))]
    found = [last(each, 40, target="sines", first=2.0) for each in sets]
    for worse, better in pairwise(found):
        assert np.linalg.eigvalsh(worse - better).min() > -1e-3 * np.linalg.eigvalsh(better).max()
        assert np.trace(better) < np.trace(worse)


def test_incremental_encoders_tell_nothing_at_power_on_and_much_in_motion(hexapod):
    without, beside = Setup(hexapod, ALL_IMUS, CALIBRATED), Setup(hexapod, ALL_IMUS, CALIBRATED, encoder=INCREMENTAL)
    alone = replace(beside, imus=(6,))
    assert sizes(last(beside, 1))[0] == pytest.approx(sizes(last(without, 1))[0], rel=5e-3)
    moved = {"steps": 300, "target": "sines"}
    assert sizes(last(beside, **moved))[0] < 0.7 * sizes(last(without, **moved))[0]
    assert sizes(last(alone, 1))[0] > 50.0


@pytest.mark.slow
@pytest.mark.parametrize(("imus", "most"), [(ALL_IMUS, 1.06), (ON_BASE, 1.09)])
def test_steps_of_20_ms_lose_little_of_a_motion_that_is_as_free_as_the_filters_take_it(hexapod, monkeypatch, imus, most):
    setup = Setup(hexapod, imus, CALIBRATED)

    def found(steps, **step):
        motion = motion_of(hexapod, steps, **step)
        return sizes(pose_covariances(LinearModel(setup), on_base(hexapod, motion) if setup.base_moves else motion)[-1])

    coarse = found(25)
    monkeypatch.setattr(model_module, "STEP_S", 1e-3)
    monkeypatch.setattr(model_module, "JERK", 6.0)
    monkeypatch.setattr(model_module, "ANGULAR_JERK", 35.0)
    fine = found(500, step=1e-3)
    assert coarse[0] < fine[0] < 1.03 * coarse[0]
    assert coarse[1] < fine[1] < most * coarse[1]


def test_joints_that_are_not_exact_cost_what_their_leverage_says(hexapod):
    """Lengths alone then know the pose as well as the joints along each leg."""
    encoder = EncoderModel("absolute", absolute=True, resolution=0.0, backlash=0.0, zero=1e-7)
    jacobian = sensitivity(hexapod, motion_of(hexapod, 1), lambda ideal: ideal.lengths)[0, :, :6]
    expected = 2.0 * 1e-8 * np.linalg.inv(jacobian.T @ jacobian)
    found = last(Setup(hexapod, (), CALIBRATED, encoder=encoder, joint_error=1e-4))
    np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-3 * expected.max())


def test_a_joint_that_legs_share_is_wrong_for_all_of_them():
    """Both joints of each pair of legs are one: their errors are the same, and one coordinate is counted once."""
    mechanism = load_in_space("6-3-I")
    setup = Setup(mechanism, (), CALIBRATED, encoder=load_encoder("absolute"), joint_error=1e-4)
    joints = LinearModel(setup).prior[model_module.JET : -18, model_module.JET : -18]
    assert joints.shape == (36, 36)
    assert np.linalg.matrix_rank(joints) == 3 * sum(len(set(side)) for side in mechanism.distinct_joints().tolist())


def test_a_calibration_tells_the_errors_instead_of_the_kind(hexapod):
    """With the covariance that the kind has, nothing changes; with joints and tilt the bound is worse."""
    setup = Setup(hexapod, (0, 2, 4, 6), CALIBRATED, encoder=INCREMENTAL)
    variances = np.zeros(ERRORS)
    variances[:6] = np.repeat([np.radians(0.2) ** 2 / 3.0, MILLI_G**2 / 3.0], 3)
    variances[6:9] = 1e-6 / 3.0
    known = np.diag(np.tile(variances, 7))
    same = replace(setup, calibration=Calibration(covariance=known))
    np.testing.assert_allclose(last(same), last(setup), rtol=1e-9)
    rig = block_diag(known, 1e-8 * np.eye(36), 1e-6 * np.eye(2))
    worse = replace(setup, calibration=Calibration(covariance=rig))
    # The tilt of 1 mrad alone turns the pose by as much.
    assert sizes(last(worse))[1] > sizes(last(setup))[1] + 0.01


def test_a_planar_pose_has_no_error_across_its_plane():
    mechanism = load_in_space("planar-3rpr")
    for encoder in (None, INCREMENTAL, load_encoder("absolute")):
        covariance = last(Setup(mechanism, (0, 1, 2, 6), CALIBRATED, encoder=encoder))
        assert not covariance[2:5].any() and (np.diag(covariance)[[0, 1, 5]] > 0.0).all()
        assert sizes(covariance)[0] < 1.0


@pytest.mark.parametrize("imu", ["ideal", "mpu9150-nominal", "icm42688-nominal"])
def test_every_kind_of_imu_has_a_bound(hexapod, imu):
    position, rotation = sizes(last(Setup(hexapod, ALL_IMUS, load_imu(imu), magnetometer=True)))
    assert 0.0 < position < (0.01 if imu == "ideal" else 1.0) and 0.0 < rotation < 0.3
