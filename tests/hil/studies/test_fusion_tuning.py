"""Tuning by consistency: the NEES of made-up errors, the search on made-up estimators, and a short run on a hexapod."""

import json
from importlib import resources

import numpy as np
import pytest

from controller.settings import fusion_settings
from hil.command_line import main
from hil.studies.fused_track import FUSED, REFINED, WHOLE, PoseTrack
from hil.studies.fusion_tuning import ESTIMATORS, Consistency, _seek_consistency, _seek_least_errors, tuned_text
from plant.mechanism import load_mechanism
from plant.pose import rotation_from_vector

HEXAPOD = (resources.files("plant.mechanism") / "presets" / "hexapod.toml").read_text()
SHORT = ("--seeds", "0,1", "--rate", "250", "--workers", "1")
NAMES = [
    "leg_accelerometer_noise", "platform_accelerometer_noise", "tilt_sigma", "leg_sigma", "noise_inflation",
]  # fmt: skip


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tuning")
    mechanism, figures = folder / "tuned.toml", folder / "tuned.json"
    assert main(["tune-fusion", str(mechanism), *SHORT, "--json", str(figures)]) == 0
    return mechanism, json.loads(figures.read_text())


@pytest.mark.endurance
def test_the_tuned_file_is_the_mechanism_with_what_was_found(tuned):
    path, figures = tuned
    found = {name: values["after"] for name, values in figures["settings"].items()}
    assert list(found) == NAMES
    settings = fusion_settings(load_mechanism(path))
    assert {name: getattr(settings, name) for name in NAMES} == found
    assert any(values["before"] != values["after"] for values in figures["settings"].values())
    assert path.read_text().startswith(HEXAPOD)


@pytest.mark.slow
def test_the_estimators_are_more_consistent_and_no_worse(tuned):
    for name, figures in tuned[1]["estimators"].items():
        off = [abs(np.log(figures[when]["nees"] / figures["consistent"])) for when in ("before", "after")]
        assert off[1] <= max(off[0], 0.03), name
        assert (np.array(figures["after"]["rms"]) <= 1.05 * np.array(figures["before"]["rms"])).all(), name
        low, high = figures["bounds"]
        assert low < figures["consistent"] < high
    assert tuned[1]["estimators"]["refined pose"]["after"]["nees"] == pytest.approx(6.0, rel=0.05)


def about(random, angle_sigma):
    return rotation_from_vector(random.normal(scale=angle_sigma, size=3))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_errors_drawn_from_a_covariance_have_as_much_nees_as_components(hexapod, name):
    """Every sample is perturbed by noise of a covariance of its own, which the estimator states, or states half of."""
    random, count, estimator = np.random.default_rng(7), 400, ESTIMATORS[name]
    n = estimator.components
    roots = 1e-4 * random.normal(size=(count, estimator.series, n, n))
    noise = (roots @ random.normal(size=(count, estimator.series, n, 1)))[..., 0]
    covariances = roots @ np.swapaxes(roots, 2, 3)
    positions = hexapod.home.position + random.normal(scale=0.02, size=(count, 3))
    rotations = np.array([about(random, 0.1) for _ in range(count)])
    fused = np.zeros(count, FUSED)
    for i in range(count):
        if name == "leg filters":
            vectors = positions[i] + hexapod.platform_joints @ rotations[i].T - hexapod.base_joints
            for k, (vector, joint) in enumerate(zip(vectors, hexapod.joint_rotations, strict=True)):
                x, y, z = joint.T @ vector / np.linalg.norm(vector)
                b = np.arcsin(x) + noise[i, k, 1]
                a = np.arctan2(-y, z) + noise[i, k, 0]
                fused["directions"][i, k] = joint @ [np.sin(b), -np.sin(a) * np.cos(b), np.cos(a) * np.cos(b)]
        elif name == "platform filter":
            vertical = rotations[i].T @ hexapod.up_in_base
            across = np.linalg.qr(np.column_stack([vertical, np.eye(3)[:, :2]]))[0][:, 1:]
            fused["vertical"][i] = vertical + across @ noise[i, 0]
            fused["vertical_covariance"][i] = across @ covariances[i, 0] @ across.T
        else:
            step = REFINED if name == "refined pose" else WHOLE
            fused["positions"][i, step] = positions[i] + noise[i, 0, :3]
            fused["rotations"][i, step] = rotation_from_vector(noise[i, 0, 3:]) @ rotations[i]
    fused["leg_covariances"] = covariances if name == "leg filters" else 0.0
    if n == 6:
        fused["information"], fused["covariance"] = np.linalg.inv(covariances[:, 0]), covariances[:, 0]
    truth = PoseTrack(positions, rotations)
    nees, squares = estimator.judge(hexapod, fused, truth)
    low, high = estimator.bounds(count)
    assert low < n < high
    assert nees == pytest.approx(np.mean(np.sum(np.linalg.solve(roots, noise[..., None]) ** 2, axis=(2, 3))), rel=2e-3)
    assert nees == pytest.approx(n, rel=0.15)
    expected = np.mean(np.sum(noise.reshape(count, estimator.series, estimator.parts, -1) ** 2, axis=3), axis=(0, 1))
    np.testing.assert_allclose(squares, expected, rtol=2e-3)


@pytest.mark.parametrize(
    ("nees", "rms", "found"),
    [
        (lambda x: 8.0 * np.exp(-2.0 * x), lambda x: 1.0, np.log(2.0)),
        (lambda x: 0.5 * np.exp(-2.0 * x), lambda x: 1.0, -np.log(2.0)),
        (lambda x: 8.0 * np.exp(-2.0 * x), lambda x: np.exp(0.1 * x), 10.0 * np.log(1.02)),
        (lambda x: 800.0 * np.exp(-2.0 * x), lambda x: 1.0, np.log(4.0)),
    ],
)
def test_consistency_is_sought_as_far_as_the_errors_do_not_grow(nees, rms, found):
    def evaluate(change):
        return Consistency(np.array([0.5, 1.5]) * nees(change), np.array([1e-3, 1e-2 * rms(change)]))

    assert _seek_consistency(evaluate, 2) == pytest.approx(found, abs=0.02)


def test_least_errors_are_those_of_both_parts():
    def evaluate(change):
        return Consistency(np.array([6.0]), np.array([1e-4 * np.cosh(change - 0.2), 1e-2 * np.cosh(change - 0.6)]))

    assert _seek_least_errors(evaluate, 6) == pytest.approx(0.4, abs=0.15)


def test_the_rest_of_a_file_stays_as_it_is(tmp_path):
    text = '# My own.\nname = "mine"  # yes\nbased_on = "hexapod"\n\n[fusion]\nleg_jerk = 90.0 # measured\nleg_sigma = 0.002\n'
    path = tmp_path / "mine.toml"
    path.write_text(text)
    assert tuned_text(str(path), {"leg_sigma": 0.001}) == text.replace("0.002", "0.001")
    path.write_text(text[: text.index("[fusion]")])
    assert tuned_text(str(path), {"leg_sigma": 0.001}) == text.replace("leg_jerk = 90.0 # measured\n", "").replace(
        "0.002", "0.001"
    )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--imu", "best"], "no IMU preset 'best'"),
        (
            ["--imu", "mpu9150", "--rate", "50", "--seeds", "0"],
            "and beyond 5 deg no noise accounts for it: tune for calibrated ones",
        ),
        (["--mechanism", "octopod"], "no mechanism 'octopod'"),
        (["--mechanism", "planar-3rpr"], "has three legs in the plane"),
        (["--rate", "10"], "the rate is 10 Hz"),
        (["--seeds", "-1"], "seed"),
    ],
)
def test_bad_input_is_refused_in_a_line(arguments, said, tmp_path, capsys):
    assert main(["tune-fusion", str(tmp_path / "tuned.toml"), "--workers", "1", *arguments]) == 2
    # A first start may say that it compiles.
    (complaint,) = (line for line in capsys.readouterr().err.splitlines() if not line.startswith("compiling"))
    assert said in complaint
    assert not list(tmp_path.iterdir())
