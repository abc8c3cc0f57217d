"""The planar rig: its real measurements against an independent solver, and made-up ones against what went in."""

import json
import re

import numpy as np
import pytest
from scipy.optimize import least_squares

from hil.studies.planar_rig import COLUMNS, SOURCES, evaluate
from plant.errors import InputError, SingularConfigurationError
from tests.conftest import SHARED_DATA
from tests.hil.planar_rig import BASE, joints_at, leg_degrees, load_rig, write_pose, write_two_poses

FIRST = "# true pose by image processing: x 107 mm, y 192 mm, gamma -5.5 deg"
TEN_POSES = {"raw": (1.41, 3.35, 2.04), "kalman": (1.26, 2.85, 2.07), "complementary": (1.23, 2.95, 2.33)}
"""RMS of the mean errors [mm, mm, deg] that come with the data, over these poses and three more."""


@pytest.fixture(scope="session")
def rig():
    return load_rig()


@pytest.fixture(scope="session")
def measured(rig):
    """Real measurements, which lie beside the project and are not part of it."""
    folder = SHARED_DATA / "planar_3rpr"
    if not folder.exists():
        pytest.skip("the measurements of the planar rig are not here")
    return evaluate(folder, rig)


@pytest.fixture
def made_up(tmp_path):
    return tmp_path, write_two_poses(tmp_path)


def test_made_up_measurements_give_back_what_went_in(rig, made_up):
    folder, noise = made_up
    summary = evaluate(folder, rig).summary()
    assert list(summary["true_poses"]) == ["pose_01", "pose_02"]
    assert list(summary["true_poses"]["pose_02"].values()) == pytest.approx([0.084, 0.217, np.radians(-20.0)])
    assert list(summary["sources"]) == list(SOURCES)
    raw, kalman, complementary = summary["sources"].values()
    assert list(raw["rms"].values()) == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    assert raw["leg_angles"] == pytest.approx({"constant_error": 0.0, "noise": 0.0}, abs=1e-12)
    assert list(kalman["rms"].values()) == pytest.approx([0.002, 0.003, np.radians(4.0)])
    for figures in kalman["poses"].values():
        assert list(figures["mean_error"].values()) == pytest.approx([0.002, -0.003, np.radians(4.0)])
        assert list(figures["standard_deviation"].values()) == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    shifts = [leg_degrees(pose + np.array([2, -3, 4])) - leg_degrees(pose) for pose in ((107, 192, -5.0), (84, 217, -20.0))]
    assert kalman["leg_angles"]["constant_error"] == pytest.approx(np.radians(np.sqrt(np.mean(np.square(shifts)))))
    assert complementary["leg_angles"]["noise"] == pytest.approx(np.radians(np.sqrt(np.mean(noise.std(axis=0) ** 2))))
    assert all(figures["true_mode"] == {"samples": 1.0, "poses": 2} for figures in (raw, kalman, complementary))
    assert json.loads(json.dumps(summary)) == summary


@pytest.mark.parametrize(
    ("offset", "samples"), [((9.0, 0.0, 0.0), 1.0), ((8.0, 8.0, 0.0), 0.0), ((0.0, 0.0, 7.5), 1.0), ((0.0, 0.0, -8.5), 0.0)]
)
def test_a_mode_is_the_true_pose_within_10_mm_and_8_deg(rig, tmp_path, offset, samples):
    pose = np.array([107.0, 192.0, -5.0])
    write_pose(tmp_path, 1, pose, [np.tile(leg_degrees(pose + offset), 3)])
    figures = evaluate(tmp_path, rig).summary()["sources"]["raw"]
    assert figures["true_mode"] == {"samples": samples, "poses": int(samples)}


def test_angles_on_either_side_of_180_deg_are_near_each_other(rig, tmp_path):
    pose = np.array([-200.0, 0.5, 178.0])
    angles = np.tile(leg_degrees(pose) + [[0.3], [-0.3]], 3)
    assert np.ptp(angles[:, 0]) == pytest.approx(0.6)
    angles[:, 3:6] = leg_degrees(pose + [0.0, 0.0, 4.0])
    write_pose(tmp_path, 1, pose, (angles + 180.0) % 360.0 - 180.0)
    raw, kalman, _ = evaluate(tmp_path, rig).summary()["sources"].values()
    assert kalman["rms"]["angle"] == pytest.approx(np.radians(4.0))
    assert raw["leg_angles"] == pytest.approx({"constant_error": 0.0, "noise": np.radians(0.3)}, abs=1e-12)


# ------------------------------------------------------------------------------------------------------- the real rig


def test_an_independent_solver_finds_the_same_errors_of_every_sample(measured):
    for pose in measured.poses:
        for i in range(len(SOURCES)):
            for sample in range(0, pose.errors.shape[1], 50):
                angles = pose.true_leg_angles + pose.leg_errors[i, sample]
                true = pose.true_pose * [1e3, 1e3, np.degrees(1.0)]

                def misses(found, angles=angles):
                    x, y = (joints_at(found) - BASE).T
                    return x * np.sin(angles) - y * np.cos(angles)

                found = least_squares(misses, true, xtol=1e-14, ftol=1e-14, gtol=1e-14)
                assert found.cost < 1e-16
                errors = pose.errors[i, sample] * [1e3, 1e3, np.degrees(1.0)]
                np.testing.assert_allclose(errors, found.x - true, atol=1e-5)


def test_the_files_are_read_as_they_are(measured):
    assert [pose.name for pose in measured.poses] == [f"pose_{number:02}" for number in (1, 2, 3, 4, 5, 7, 8)]
    for pose in measured.poses:
        table = np.loadtxt(SHARED_DATA / "planar_3rpr" / f"{pose.name}.csv", delimiter=",", skiprows=2)
        angles = np.degrees(pose.true_leg_angles + pose.leg_errors)
        np.testing.assert_allclose(np.concatenate(angles, axis=1), table, atol=1e-9)
        true = pose.true_pose * [1e3, 1e3, np.degrees(1.0)]
        np.testing.assert_allclose(np.degrees(pose.true_leg_angles), leg_degrees(true), atol=1e-9)


def test_the_figures_agree_with_those_that_come_with_the_data(measured):
    for source, ten in TEN_POSES.items():
        figures = measured.summary()["sources"][source]
        seven = np.array(list(figures["rms"].values())) * [1e3, 1e3, np.degrees(1.0)]
        # Seven of ten poses cannot have more than all the squares; 1 % for the figures' rounding and what a mean is.
        assert (seven < 1.01 * np.sqrt(10 / 7) * np.array(ten)).all()
        assert (seven > 0.9 * np.array(ten)).all()
        assert np.degrees(figures["leg_angles"]["constant_error"]) == pytest.approx(0.34, abs=0.09)
        assert figures["true_mode"]["poses"] == 7
    for source, noise, share in (("raw", 0.25, 0.8), ("kalman", 0.04, 0.98)):
        figures = measured.summary()["sources"][source]
        assert np.degrees(figures["leg_angles"]["noise"]) == pytest.approx(noise, abs=0.01)
        assert share < figures["true_mode"]["samples"] < 1.0


# ---------------------------------------------------------------------------------------------------- what is refused


ROW = ",".join(map(str, np.tile(leg_degrees((107.0, 192.0, -5.5)), 3)))


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([], "pose_01.csv, line 1: '' gives no true pose in finite numbers: write '# true pose"),
        (["# x 1, y 2", ",".join(COLUMNS), ROW], "line 1: '# x 1, y 2' gives no true pose"),
        ([FIRST.replace("192", "high"), ",".join(COLUMNS), ROW], "line 1: '# true pose by image processing: x 107 mm, y high"),
        ([FIRST.replace("192", "inf"), ",".join(COLUMNS), ROW], "line 1: '# true pose"),
        ([FIRST], "line 2: the header must be leg1_raw_deg,leg2_raw_deg"),
        ([FIRST, ",".join(COLUMNS[::-1]), ROW], "line 2: the header must be leg1_raw_deg"),
        ([FIRST, ",".join(COLUMNS), "", ""], "pose_01.csv ends without a sample: it needs at least 1"),
        ([FIRST, ",".join(COLUMNS), ROW, "1,2,3"], "line 4: '1,2,3' is not a row of 9 finite numbers"),
        ([FIRST, ",".join(COLUMNS), ROW, "", ROW.replace("6", "x")], "line 5: 'x"),
        ([FIRST, ",".join(COLUMNS), "nan" + ROW[ROW.index(",") :]], "line 3: 'nan,"),
        ([FIRST, ",".join(COLUMNS), ROW + ",1.0"], "is not a row of 9 finite numbers"),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(rig, tmp_path, lines, said):
    (tmp_path / "pose_01.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match=re.escape(said)) as refused:
        evaluate(tmp_path, rig)
    assert str(tmp_path / "pose_01.csv") in str(refused.value)


def test_a_folder_without_poses_is_refused(rig, tmp_path):
    for folder in (tmp_path, tmp_path / "missing"):
        with pytest.raises(InputError, match=re.escape(f"{folder} is no folder with files pose_*.csv")):
            evaluate(folder, rig)
    (tmp_path / "pose_01.csv").mkdir()
    with pytest.raises(InputError, match=r"cannot read .*pose_01.csv"):
        evaluate(tmp_path, rig)


def test_samples_with_parallel_legs_are_refused_with_their_file(rig, tmp_path):
    write_pose(tmp_path, 1, (107.0, 192.0, -5.5), [[*leg_degrees((107.0, 192.0, -5.5)), 60.0, 60.0, 60.0, 60.0, 80.0, 100.0]])
    with pytest.raises(SingularConfigurationError, match=r"pose_01.csv: legs at 60, 60, 60 deg leave the angle"):
        evaluate(tmp_path, rig)
