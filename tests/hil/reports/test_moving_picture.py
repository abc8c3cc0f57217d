"""The moving picture of a simulation: its keyframes are the poses of the run, in a projection of the tests and in a browser."""

import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.look import leg_colors
from hil.reports.moving_picture import picture_svg, write_picture
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from plant.errors import InputError
from tests.hil.commands import gough
from tests.hil.pages import dumped

SVG = "{http://www.w3.org/2000/svg}"
MOST_BYTES = 300_000
KINDS = ["hexapod", "planar-3rpr"]


@pytest.fixture(scope="module")
def results():
    return {kind: simulate(SimulationConfig(mechanism=kind, target="sines", duration=1.5)) for kind in KINDS}


@pytest.fixture(scope="module")
def pictures(results):
    return {kind: picture_svg(result) for kind, result in results.items()}


def numbers(text):
    """The points (n, 2) of a text."""
    return np.array([[float(value) for value in point.split(",")] for point in text.split()])


def course(element, attribute="points"):
    """Shares of the time (m,), and values (m, ...) of an attribute that moves."""
    (found,) = [each for each in element.findall(f"{SVG}animate") if each.get("attributeName") == attribute]
    values = found.get("values").split(";")
    assert found.get("repeatCount") == "indefinite" and values[0] == element.get(attribute)
    if attribute == "points":
        values = np.array([numbers(value) for value in values])
    return np.array([float(share) for share in found.get("keyTimes").split(";")]), values


def seen(mechanism, points):
    """Points (..., 3) as the eye sees them, up to scale and place: from the corner of a cube, or along the axis of a plane."""
    if mechanism.planar:
        return np.stack([points[..., 0], -points[..., 1]], axis=-1)
    eye = np.array([1.15, -1.4, 0.0]) / np.hypot(1.15, 1.4) * np.sqrt(2.0 / 3.0) + np.array([0.0, 0.0, np.sqrt(1.0 / 3.0)])
    right = np.array([1.4, 1.15, 0.0]) / np.hypot(1.15, 1.4)
    up = np.array([0.0, 0.0, 1.0]) - eye * eye[2]
    return np.stack([points @ right, -(points @ up) / np.linalg.norm(up)], axis=-1)


def pixels(mechanism, picture, points):
    """Points (..., 3) [m] in the picture, by the scale and the place at which it has the base."""
    (base,) = [each for each in picture.findall(f"{SVG}polygon") if not len(each)]
    drawn, own = numbers(base.get("points")), seen(mechanism, mechanism.base_joints)
    scale = np.ptp(drawn[:, 0]) / np.ptp(own[:, 0])
    offset = drawn.min(axis=0) - scale * own.min(axis=0)
    assert all(np.abs(drawn - offset - scale * each).sum(axis=1).min() < 0.2 for each in own)
    return offset + scale * seen(mechanism, points)


def joints_of(result, rows, kind="estimate"):
    poses = {
        "estimate": (result.records["position"], result.records["rotation"]),
        "reference": (result.reference_positions, result.reference_rotations),
    }
    position, rotation = poses[kind]
    return position[rows][:, None] + np.einsum("nij,kj->nki", rotation[rows], result.mechanism.platform_joints)


def rows_at(result, shares):
    return np.searchsorted(result.times, shares * result.times[-1] - 1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("drawn", "dashed"), [("estimate", False), ("reference", True)])
def test_the_platform_and_its_ghost_have_the_poses_of_the_run(results, pictures, kind, drawn, dashed):
    result, picture = results[kind], ET.fromstring(pictures[kind])
    (plate,) = [
        each for each in picture.findall(f"{SVG}polygon") if len(each) and (each.get("stroke-dasharray") is not None) == dashed
    ]
    shares, corners = course(plate)
    assert (shares[0], shares[-1]) == (0.0, 1.0) and 5 < len(shares) < 80
    expected = pixels(result.mechanism, picture, joints_of(result, rows_at(result, shares), drawn))
    for corner in corners.swapaxes(0, 1):
        assert min(np.abs(corner - joint).max() for joint in expected.swapaxes(0, 1)) < 0.2
    # And in between.
    times = np.linspace(0.0, 1.0, 200)
    expected = pixels(result.mechanism, picture, joints_of(result, rows_at(result, times), drawn))
    for corner in corners.swapaxes(0, 1):
        moved = np.stack([np.interp(times, shares, values) for values in corner.T], axis=1)
        assert min(np.abs(moved - joint).max() for joint in expected.swapaxes(0, 1)) < 0.7


@pytest.mark.parametrize("kind", KINDS)
def test_the_legs_join_base_and_platform_and_have_the_colours_of_their_stroke(results, pictures, kind):
    result, picture = results[kind], ET.fromstring(pictures[kind])
    lines = [each for each in picture.findall(f"{SVG}polyline") if len(each)]
    rods, tubes = lines[0::2], lines[1::2]
    assert len(rods) == len(tubes) == result.mechanism.legs
    rows = rows_at(result, course(rods[0])[0])
    joints = joints_of(result, rows)
    base = pixels(result.mechanism, picture, result.mechanism.base_joints)
    ends = pixels(result.mechanism, picture, joints)
    lengths = np.linalg.norm(joints - result.mechanism.base_joints, axis=2)
    least, most = result.mechanism.require_limits().stroke.T
    expected = leg_colors(np.abs(2.0 * (lengths - least) / (most - least) - 1.0)).astype(int)
    found = set()
    for rod, tube in zip(rods, tubes, strict=True):
        upper, lower = course(rod)[1], course(tube)[1]
        leg = int(np.argmin(np.abs(ends - upper[:, None, 1]).sum(axis=(0, 2))))
        found.add(leg)
        np.testing.assert_allclose(upper[:, 1], ends[:, leg], atol=0.2)
        np.testing.assert_allclose(lower[:, 0], np.broadcast_to(base[leg], (len(rows), 2)), atol=0.2)
        np.testing.assert_array_equal(lower[:, 1], upper[:, 0])
        colors = np.array([list(bytes.fromhex(color[1:])) for color in course(tube, "stroke")[1]])
        assert np.abs(colors - expected[:, leg]).max() <= 1
        assert len(np.unique(colors, axis=0)) > 3
    assert found == {*range(result.mechanism.legs)}


@pytest.mark.parametrize("kind", KINDS)
def test_one_caption_at_a_time_has_the_time_and_the_error(results, pictures, kind):
    result = results[kind]
    off = 1e3 * np.linalg.norm(result.records["position"] - result.true_positions, axis=1)
    ends = [0.0]
    for group in ET.fromstring(pictures[kind]).findall(f"{SVG}g"):
        seconds, error = re.fullmatch(r"([\d.]+) s, estimate - truth ([\d.]+) mm", group.find(f"{SVG}text").text).groups()
        change = group.find(f"{SVG}animate")
        times = [float(share) for share in change.get("keyTimes").split(";")]
        visible = change.get("values").split(";").index("visible")
        begin, end = times[visible], [*times, 1.0][visible + 1]
        assert begin == ends[-1] and change.get("calcMode") == "discrete"
        ends.append(end)
        assert float(seconds) == pytest.approx(begin * result.times[-1], abs=0.051)
        near = np.abs(result.times - begin * result.times[-1]) < 0.021
        assert np.abs(off[near] - float(error)).min() < 0.006
    assert ends[-1] == 1.0 and len(ends) == 7


def test_it_needs_no_script_and_nothing_from_outside(pictures):
    for picture in pictures.values():
        assert not re.search(r"<script|href|url\(|@import|on\w+=", picture)
        assert len(picture.encode()) < MOST_BYTES


_TELL = """<!DOCTYPE html><body>{}<script>
const svg = document.querySelector("svg");
const plate = svg.querySelectorAll("polygon")[1], tube = svg.querySelectorAll("polyline")[2];
const passed = milliseconds => new Promise(done => setTimeout(done, milliseconds));
addEventListener("load", async () => {{
  const told = [];
  svg.pauseAnimations();
  for (const time of [0.0, 0.5, 1.0, 1.4]) {{
    svg.setCurrentTime(time);
    await passed(200);
    const shown = [...svg.querySelectorAll("g")].filter(group => getComputedStyle(group).visibility == "visible");
    const corners = [...plate.animatedPoints].map(point => [point.x, point.y]);
    told.push([time, corners, getComputedStyle(tube).stroke, shown.map(group => group.textContent)]);
  }}
  document.body.dataset.told = JSON.stringify(told);
}});</script></body>"""


def test_a_browser_moves_it(results, pictures, tmp_path):
    result, page = results["hexapod"], tmp_path / "page.html"
    page.write_text(_TELL.format(pictures["hexapod"]), encoding="utf-8")
    drawn, errors = dumped(page, tmp_path / "profile")
    found = re.search(r'data-told="([^"]*)"', drawn)
    assert found, errors[-2000:]
    told = json.loads(found[1].replace("&quot;", '"'))
    picture = ET.fromstring(pictures["hexapod"])
    for time, corners, _, captions in told:
        (row,) = rows_at(result, np.array([time / result.times[-1]]))
        expected = pixels(result.mechanism, picture, joints_of(result, np.array([row])))[0]
        assert all(np.abs(np.array(corner) - expected).max(axis=1).min() < 0.7 for corner in corners)
        number = int(6.0 * (time + 1e-3) / result.times[-1])
        assert [caption[:5] for caption in captions] == [f"{number * result.times[-1] / 6.0:.1f} s"]
    assert len({color for _, _, color, _ in told}) > 1


def test_where_the_truth_is_not_known_the_error_is_from_the_reference(results):
    records = results["hexapod"].records.copy()
    records["truth"] = np.nan
    text = picture_svg(replace(results["hexapod"], records=records))
    assert "estimate - reference" in text and "estimate - truth" not in text


def test_a_run_without_poses_is_refused(results):
    records = results["hexapod"].records.copy()
    records["position"] = np.nan
    with pytest.raises(InputError, match="needs poses, and this run has none after its hold: leave --picture out"):
        picture_svg(replace(results["hexapod"], records=records))


def test_a_file_that_cannot_be_written_is_refused(results, tmp_path):
    with pytest.raises(InputError, match="missing"):
        write_picture(results["hexapod"], tmp_path / "missing" / "picture.svg")


@pytest.mark.slow
def test_a_long_run_has_a_small_picture_too():
    result = simulate(SimulationConfig(target="sines", duration=90.0, rate=250.0))
    assert len(picture_svg(result).encode()) < MOST_BYTES


def test_the_command_of_the_picture_in_the_readme_makes_it(tmp_path):
    root = Path(__file__).parents[3]
    (command,) = re.findall(r"`gough (simulate .*--picture docs/demo\.svg)`", (root / "README.md").read_text())
    arguments = command.replace("docs/demo.svg", str(tmp_path / "demo.svg")).split()
    finished = gough(*arguments, cwd=root)
    assert finished.returncode == 0, finished.stderr
    made, shown = (ET.fromstring(path.read_text()) for path in (tmp_path / "demo.svg", root / "docs" / "demo.svg"))
    assert [each.tag for each in made.iter()] == [each.tag for each in shown.iter()]
    for each, other in zip(made.findall(f"{SVG}polygon"), shown.findall(f"{SVG}polygon"), strict=True):
        np.testing.assert_allclose(numbers(each.get("points")), numbers(other.get("points")), atol=0.3)
    assert (root / "docs" / "demo.svg").stat().st_size < MOST_BYTES
