"""The planar rig: its real measurements against an independent solver, made-up ones against what went in, and the report."""

import base64
import json
import re
import shutil
import subprocess
import tomllib
from importlib import resources

import numpy as np
import pytest
from scipy.optimize import least_squares

from hil.reports.planar_rig import write_report
from hil.studies.planar_rig import COLUMNS, SOURCES, evaluate
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism.documents import mechanism_from_document
from tests.conftest import SHARED_DATA

FIRST = "# true pose by image processing: x 107 mm, y 192 mm, gamma -5.5 deg"
BASE, PLATFORM = np.array([[0.0, 0.0], [170.0, 0.0], [280.0, 0.0]]), np.array([[0.0, 0.0], [70.0, 0.0], [100.0, 0.0]])
TEN_POSES = {"raw": (1.41, 3.35, 2.04), "kalman": (1.26, 2.85, 2.07), "complementary": (1.23, 2.95, 2.33)}
"""RMS of the mean errors [mm, mm, deg] that come with the data, over these poses and three more."""


@pytest.fixture(scope="session")
def rig():
    text = (resources.files("plant.mechanism") / "presets" / "planar-3rpr.toml").read_text()
    return mechanism_from_document(tomllib.loads(text))


@pytest.fixture(scope="session")
def measured(rig):
    """Real measurements, which lie beside the project and are not part of it."""
    folder = SHARED_DATA / "planar_3rpr"
    if not folder.exists():
        pytest.skip("the measurements of the planar rig are not here")
    return evaluate(folder, rig)


def joints_at(pose):
    """The platform joints [mm] at x, y [mm] and angle [deg]."""
    x, y, angle = pose
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[x + c * a - s * b, y + s * a + c * b] for a, b in PLATFORM])


def leg_degrees(pose):
    x, y = (joints_at(pose) - BASE).T
    return np.degrees(np.arctan2(y, x))


def write_pose(folder, number, pose, angles):
    """A file with samples (N, 9) of leg angles [deg]."""
    x, y, gamma = pose
    rows = [",".join(map(repr, row)) for row in np.asarray(angles).tolist()]
    text = [f"# true pose by image processing: x {x} mm, y {y} mm, gamma {gamma} deg", ",".join(COLUMNS), *rows]
    (folder / f"pose_{number:02}.csv").write_text("\n".join(text) + "\n")


@pytest.fixture
def made_up(tmp_path):
    """Two poses: legs without error as the raw ones, those of a pose near by as Kalman's, noise as the complementary ones."""
    poses, offset = ((107.0, 192.0, -5.0), (84.0, 217.0, -20.0)), np.array([2.0, -3.0, 4.0])
    noise = np.random.default_rng(1).normal(0.0, 0.01, (40, 3))
    for number, pose in enumerate(poses, start=1):
        true, near = leg_degrees(pose), leg_degrees(pose + offset)
        write_pose(tmp_path, number, pose, [[*true, *near, *(true + sample)] for sample in noise])
    return tmp_path, noise


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


# --------------------------------------------------------------------------------------------------------- the report


@pytest.fixture
def report(rig, made_up, tmp_path):
    path = tmp_path / "report" / "report.html"
    path.parent.mkdir()
    write_report(evaluate(made_up[0], rig), path)
    return path


def traces_of(page, name):
    start = f'"{name}",'
    return json.JSONDecoder().raw_decode(page[page.rindex(start) + len(start) :].lstrip())[0]


def numbers(packed):
    return np.frombuffer(base64.b64decode(packed["bdata"]), packed["dtype"]).astype(float)


def test_the_report_is_complete_in_itself_and_has_the_figures(report, rig, made_up):
    page = report.read_text(encoding="utf-8")
    assert page.count("* plotly.js v") == 1
    markup = re.sub(r"(<script\b[^>]*>).*?</script>", r"\1", page, flags=re.DOTALL)
    assert not re.search(r"<link\b|\b(src|href)\s*=|url\(|@import", markup)
    assert list(report.parent.iterdir()) == [report]
    assert re.findall(r'<div id="(\w+)" class="plotly-graph-div"', page) == ["errors", "modes"]
    assert "gough: planar-3rpr at 2 known poses" in page and "80 samples of each source" in page

    summary = evaluate(made_up[0], rig).summary()
    cells = re.findall(r"<td>(.*?)</td>", page[page.index("<tbody>") : page.index("</tbody>")])
    for row, figures in zip(np.reshape(cells, (3, 7)), summary["sources"].values(), strict=True):
        x, y, angle = figures["rms"].values()
        shown = [1e3 * x, 1e3 * y, *np.degrees([angle, *figures["leg_angles"].values()])]
        np.testing.assert_allclose(row[:5].astype(float), shown, atol=0.00501)
        assert row[5:].tolist() == ["2 of 2", "100.0 %"]


def test_the_report_draws_the_errors_and_both_modes(report, rig, made_up):
    page = report.read_text(encoding="utf-8")
    errors = traces_of(page, "errors")
    assert [trace["name"] for trace in errors] == 3 * list(SOURCES)
    kalman, complementary = ([numbers(trace["y"]) for trace in errors if trace["name"] == name] for name in SOURCES[1:])
    np.testing.assert_allclose(kalman, [[2.0, 2.0], [-3.0, -3.0], [4.0, 4.0]], atol=1e-9)
    bars = [numbers(trace["error_y"]["array"]) for trace in errors if trace["name"] == "complementary"]
    deviations = [
        [figures["standard_deviation"][name] for name in ("x", "y", "angle")]
        for figures in evaluate(made_up[0], rig).summary()["sources"]["complementary"]["poses"].values()
    ]
    np.testing.assert_allclose(np.transpose(bars), deviations * np.array([1e3, 1e3, np.degrees(1.0)]), rtol=1e-6)
    assert np.shape(complementary) == (3, 2)

    modes = traces_of(page, "modes")
    assert [trace["name"] for trace in modes] == 2 * ["true pose", "mode nearest to it", "other mode"]
    for k, pose in enumerate(np.array([(107.0, 192.0, -5.0), (84.0, 217.0, -20.0)])):
        true, nearest, other = (
            np.column_stack([numbers(trace["x"]), numbers(trace["y"])]) for trace in modes[3 * k : 3 * k + 3]
        )
        for drawn, at in ((true, pose), (nearest, pose + [2.0, -3.0, 4.0])):
            np.testing.assert_allclose(drawn[[0, 3, 6]], BASE, atol=1e-9)
            np.testing.assert_allclose(drawn[[1, 4, 7]], joints_at(at), atol=1e-6)
            np.testing.assert_allclose(drawn[9:], joints_at(at)[[0, 1, 2, 0]], atol=1e-6)
        legs = other[[1, 4, 7]] - BASE
        np.testing.assert_allclose(np.degrees(np.arctan2(*legs.T[::-1])), leg_degrees(pose + [2.0, -3.0, 4.0]), atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(np.diff(other[9:], axis=0), axis=1), [70.0, 30.0, 100.0], atol=1e-6)
        assert np.linalg.norm(other[1] - nearest[1]) > 10.0


def test_a_browser_draws_the_report_without_an_error(report):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if not browser:
        pytest.skip("no browser here")
    flags = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-component-update"
    run = subprocess.run(
        [browser, *flags.split(), "--virtual-time-budget=10000", f"--user-data-dir={report.parent.parent / 'profile'}",
         "--dump-dom", f"file://{report}"], capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert len(re.findall(r'class="[^"]*js-plotly-plot', run.stdout)) >= 2, run.stderr[-2000:]
    assert "Uncaught" not in run.stderr


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


def test_a_report_that_cannot_be_written_is_refused(rig, made_up, tmp_path):
    path = tmp_path / "missing" / "report.html"
    with pytest.raises(InputError, match=re.escape(str(path))):
        write_report(evaluate(made_up[0], rig), path)
