"""The report of a calibration: its table, plots and bars have each figure in the unit that they name."""

import re

import numpy as np
import pytest

from hil.reports.calibration import _CONSTANTS, _constants, _residuals, _table
from hil.reports.calibration_picture import accuracy_svg
from plant.imu import STANDARD_GRAVITY

UNITS = {
    "gyroscope bias": np.degrees(1.0),
    "accelerometer bias": 1e3 / STANDARD_GRAVITY,
    "accelerometer scale": 100.0,
    "gyroscope scale": 100.0,
    "alignment": np.degrees(1.0),
    "accelerometer axes": 100.0,
    "gyroscope axes": 100.0,
}


def errors(number):
    return {"position_rms": 1e-3 * number, "rotation_rms": np.radians(3.0 * number)}


@pytest.fixture
def summary():
    drawn = np.random.default_rng(2).uniform(0.1, 1.0, (2, len(UNITS), 7, 3))
    return {
        "residual_mg": {"before": 9.0, "motion": 0.25},
        "residual_by_imu_mg": {"before": [*range(1, 8)], "motion": [0.1] * 7},
        "validated": {"motion": {"left_out_mg": 0.5} | errors(1.0)},
        "predicted": {"before": errors(10.0), "motion": errors(0.5)},
        "true": {"motion": errors(0.1)},
        "constants": {
            name: {"values": values.tolist(), "sigmas": sigmas.tolist()}
            for name, values, sigmas in zip(UNITS, *drawn, strict=True)
        },
    }


def test_the_table_has_each_stage_in_mg_mm_and_deg(summary):
    table = _table(summary)
    assert [name for _, name in table.headings] == [
        "", "residual [mg]", "at rests left out [mg]", "predicted [mm]", "halves of the data differ by [mm]", "true [mm]",
    ]  # fmt: skip
    assert [[(cell.text, cell.note) for cell in row[1:]] for row in table.rows] == [
        [("9.000", ""), ("", ""), ("10.000", "30.000 deg"), ("", ""), ("", "")],
        [("0.250", ""), ("0.500", ""), ("0.500", "1.500 deg"), ("1.000", "3.000 deg"), ("0.100", "0.300 deg")],
    ]
    assert [row[0].text for row in table.rows] == ["as they are", "and in motion"]


def test_every_constant_is_drawn_with_three_sigmas_in_its_unit(summary):
    assert {name: scale for name, (_, scale) in _CONSTANTS.items()} == pytest.approx(UNITS)
    assert [unit for unit, _ in _CONSTANTS.values()] == ["deg/s", "mg", "%", "%", "deg", "%", "%"]
    traces = _constants(summary).data
    assert len(traces) == 3 * len(UNITS)
    for number, (name, scale) in enumerate(UNITS.items()):
        found = summary["constants"][name]
        for axis, trace in enumerate(traces[3 * number : 3 * number + 3]):
            np.testing.assert_allclose(trace.y, scale * np.array(found["values"])[:, axis])
            np.testing.assert_allclose(trace.error_y.array, 3.0 * scale * np.array(found["sigmas"])[:, axis])
            np.testing.assert_allclose(trace.customdata, scale * np.array(found["sigmas"])[:, axis])
            np.testing.assert_array_equal(np.round(trace.x), range(7))
            shown = ("xy", "xz", "yz")[axis] if name.endswith("axes") else "xyz"[axis]
            assert trace.hovertemplate.startswith(f"{shown}: ")


def test_residuals_are_drawn_by_imu_and_stage(summary):
    before, motion = _residuals(summary).data
    assert (before.name, list(before.x), list(before.y)) == ("as they are", [*"0123456"], [1, 2, 3, 4, 5, 6, 7])
    assert (motion.name, list(motion.y)) == ("and in motion", [0.1] * 7)


@pytest.mark.parametrize(
    ("error", "unit", "scale", "factor"), [("position_rms", "mm", 1e3, 1.0), ("rotation_rms", "deg", 57.29578, 3.0)]
)
def test_bars_are_as_long_as_the_logarithm_of_the_error(summary, error, unit, scale, factor):
    svg = accuracy_svg(summary, error, unit, scale)
    ends = [float(end) for end in re.findall(r"H([\d.]+)V[\d.]+H150Z", svg)]
    sizes = factor * np.array([10.0, 0.5, 1.0, 0.1])
    first, last = np.floor(np.log10(sizes.min())), np.ceil(np.log10(sizes.max()))
    expected = 150.0 + 500.0 * (np.log10(sizes) - first) / (last - first)
    np.testing.assert_allclose(ends, expected, atol=0.051)
    texts = re.findall(r">([^<]+)</text>", svg)
    assert f"1 {unit}" in texts
    assert {f"{size:.3g}" for size in sizes} < set(texts)
