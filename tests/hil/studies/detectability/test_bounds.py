"""Power, false alarms and errors by draws from the linear model; rows against what is known of them."""

from math import sqrt

import numpy as np
import pytest
from scipy.stats import chi2, kstest, norm

from hil.runs.config import SimulationConfig
from hil.studies.detectability.bounds import Disturbed, find_bounds, least_level, quantile_of_size
from hil.studies.detectability.likelihood_ratio import RAISED, needed_noncentrality, probability_of_silence, threshold
from hil.studies.detectability.model import DATA, whitened
from hil.studies.detectability.signatures import NoSignatureError
from hil.studies.detectability.uncertainty import Uncertainty
from plant.errors import UnknownNameError

from .conftest import STEP_S, draw


def three_axes():
    """A ramp of all accelerometers along each of their axes, as three signatures (60, 48, 3) of 1 m/s2."""
    signatures = np.zeros((60, DATA, 3))
    for k in range(7):
        for axis in range(3):
            signatures[:, 6 * k + 3 + axis, axis] = np.clip(STEP_S * (np.arange(60) - 20), 0.0, 1.0)
    return signatures


def statistics(model, signatures, data):
    """The generalised likelihood ratio of a fault in the span of the signatures, by least squares on whitened data."""
    found = whitened(model, np.concatenate([signatures, data], axis=2)).innovations
    found = found.reshape(-1, found.shape[2])
    directions, drawn = np.linalg.qr(found[:, : signatures.shape[2]])[0], found[:, signatures.shape[2] :]
    return np.sum((directions.T @ drawn) ** 2, axis=0)


@pytest.mark.slow
def test_a_fault_of_the_computed_size_is_told_with_the_power_and_nothing_without_one(short_model):
    signatures, along = three_axes(), np.array([0.0, 0.89, -0.46])
    one = (signatures @ along)[:, :, None]
    noncentrality = np.sum(whitened(short_model, one).innovations ** 2)
    size = sqrt(needed_noncentrality(3) / noncentrality)
    data, _ = draw(short_model, 4000, 5)
    sound = statistics(short_model, signatures, data)
    assert kstest(sound, chi2(3).cdf).pvalue > 1e-3 and sound.max() < threshold(3)
    told = statistics(short_model, signatures, data + size * one)
    # 4 of 4,000 are missed on average; 13 or more happen once in 4,000 times.
    assert 0 < np.sum(told < threshold(3)) < 13


def test_the_estimate_errs_by_what_a_fault_does_to_it(short_model):
    one = (three_axes() @ [0.0, 0.0, 1.0])[:, :, None]
    expected = whitened(short_model, one).estimates[-1, :, 0]
    data, poses = draw(short_model, 2000, 6)
    found = whitened(short_model, data + one)
    errors = found.estimates[-1] - poses[-1]
    spread = np.sqrt(np.diagonal(found.covariances[-1]) / 2000)
    assert np.all(np.abs(errors.mean(axis=1) - expected) < 4.0 * spread)
    size = quantile_of_size(expected[None, :3], found.covariances[-1:, :3, :3])
    beyond = np.sum(np.linalg.norm(errors[:3], axis=0) > size)
    assert beyond < 10


@pytest.mark.parametrize("mean", [0.0, 1.0, 5.0])
def test_the_quantile_of_a_size_is_that_of_draws(mean):
    random = np.random.default_rng(7)
    root = random.standard_normal((3, 3))
    center = mean * random.standard_normal(3)
    drawn = np.linalg.norm(center + random.standard_normal((400_000, 3)) @ root.T, axis=1)
    found = quantile_of_size(center[None], (root @ root.T)[None])
    assert found[0] == pytest.approx(np.quantile(drawn, 0.999), rel=0.06)


@pytest.mark.slow
def test_a_level_of_the_least_size_covers_all_but_a_thousandth_with_the_best_test(short_model):
    one = 0.35 * (three_axes() @ [0.0, 0.89, -0.46])[:, :, None]
    found = whitened(short_model, one)
    direction, estimates = found.innovations[:, :, 0], found.estimates[:, :3, 0]
    noncentrality = np.cumsum(np.sum(direction**2, axis=1))
    silence = probability_of_silence(noncentrality)
    size = least_level(estimates, found.covariances[:, :3, :3], silence)
    sound, _ = draw(short_model, 4000, 8)
    data, poses = draw(short_model, 4000, 9)
    told = whitened(short_model, data + one)
    scale = np.sqrt(np.maximum(noncentrality, 1e-300))[:, None]
    statistics = [
        np.cumsum(np.einsum("ni,nic->nc", direction, each), axis=0) / scale
        for each in (whitened(short_model, sound).innovations, told.innovations)
    ]
    there = noncentrality > 0.0
    assert np.mean(statistics[0][there] > norm.isf(RAISED)) == pytest.approx(RAISED, rel=0.3)
    silent = statistics[1] <= norm.isf(RAISED)
    assert silent[there].mean(axis=1) == pytest.approx(silence[there], abs=0.025)
    errors = np.linalg.norm(told.estimates[:, :3] - poses[:, :3], axis=1)
    silent[~there] = np.random.default_rng(1).random(silent[~there].shape) > RAISED
    assert np.mean(silent & (errors > size)) == pytest.approx(1e-3, rel=0.3)
    assert np.mean(silent & (errors > 0.8 * size)) > 2e-3


def bounds_of(*texts, begin=1.5, **changes):
    config = SimulationConfig(target="sines", duration=6.0, **changes)
    return find_bounds([Disturbed(config, texts, begin)], Uncertainty())[0]


def test_a_larger_fault_is_told_sooner_and_the_least_scales_with_it():
    small, large = (bounds_of(f"imu-offset:all,axis=y,size_m_per_s2={size},ramp_s=4,at=1.5") for size in (0.2, 0.8))
    assert large.told_after < small.told_after
    assert large.least == pytest.approx(small.least / 4.0, rel=1e-6)
    assert large.least_position == pytest.approx(small.least_position, rel=1e-6)


@pytest.mark.parametrize("rate", [333.0, 130.0])
def test_a_loop_of_which_20_ms_are_no_whole_number_of_cycles_has_about_the_same_bounds(rate):
    text = "imu-offset:2,axis=y,size_m_per_s2=0.5,ramp_s=3,at=1.5"
    there, beside = bounds_of(text, rate=rate), bounds_of(text, rate=50.0 * round(rate / 50.0))
    assert there.told_after == pytest.approx(beside.told_after, abs=0.06)
    assert there.least_position == pytest.approx(beside.least_position, rel=0.1)
    assert there.sound_rotation == pytest.approx(beside.sound_rotation, rel=0.1)


def test_a_fault_of_the_least_size_is_told_at_the_end_and_none_below():
    least = bounds_of("imu-offset:2,axis=x,size_m_per_s2=1,ramp_s=3,at=1.5").least
    for share, told in ((1.001, True), (0.999, False)):
        found = bounds_of(f"imu-offset:2,axis=x,size_m_per_s2={share * least},ramp_s=3,at=1.5")
        assert (found.told_after is not None) == told
        assert found.fault_position <= found.position


def test_what_seven_imus_share_is_told_later_than_what_one_has_and_bends_the_pose_more():
    one, shared = (bounds_of(f"imu-offset:{imus},axis=y,size_m_per_s2=0.5,ramp_s=4,at=1.5") for imus in ("6", "legs"))
    assert shared.least_position > 2.0 * one.least_position


def test_a_joint_that_is_off_from_the_start_counts_from_the_start():
    found = find_bounds([Disturbed(SimulationConfig(target="sines", duration=6.0, joint_error=1e-3), (), 0.0)], Uncertainty())
    assert found[0].told_after >= 0.0 and found[0].share > 0.5
    # It is told while the platform still stands, so that no level is needed in motion.
    assert found[0].level_position == found[0].level_rotation == 0.0


def test_joints_that_are_off_a_little_need_a_higher_level_than_nothing_at_all():
    none, off = (
        find_bounds([Disturbed(SimulationConfig(target="sines", duration=6.0, joint_error=size), (), 0.0)], Uncertainty())[0]
        for size in (1e-9, 2e-4)
    )
    assert off.level_position > 1.05 * none.level_position and off.level_rotation > 1.01 * none.level_rotation
    assert 1e-4 < none.sound_position == off.sound_position < 1e-3 < none.sound_rotation < 3e-3
    assert 2.5 < none.level_position / none.sound_position < 5.0
    assert 2.5 < none.level_rotation / none.sound_rotation < 5.0


def test_what_has_no_signature_is_refused():
    with pytest.raises(NoSignatureError):
        bounds_of("imu-noise:all,axis=all,size_g=0.1,at=1.5")
    with pytest.raises(NoSignatureError):
        find_bounds([Disturbed(SimulationConfig(target="hold"), ("imu-stuck:6,sensor=gyroscope,axis=x",), 1.0)], Uncertainty())
    with pytest.raises(UnknownNameError):
        find_bounds([Disturbed(SimulationConfig(imu="ideall"), ("base-tilt,axis=x,size_deg=1",), 0.0)], Uncertainty())
