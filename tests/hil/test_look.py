"""What reports, pictures and the panel share: one palette, legible on white and on dark ground."""

import re
from pathlib import Path

import numpy as np
import pytest

from hil import look

ROOT = Path(look.__file__).parent


def luminance(color):
    """The relative luminance of WCAG 2."""
    shares = np.array(look.rgb(color)) / 255.0
    linear = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def contrast(color, ground):
    darker, lighter = sorted((luminance(color), luminance(ground)))
    return (lighter + 0.05) / (darker + 0.05)


@pytest.mark.parametrize("theme", [look.LIGHT, look.DARK])
def test_text_and_marks_stand_out_from_the_ground_of_light_and_of_dark_pages(theme):
    assert contrast(theme["ink"], theme["ground"]) > 12.0
    assert min(contrast(color, theme["ground"]) for color in (theme["faint"], look.NEUTRAL)) > 4.0
    for color in (theme["accent"], look.GOOD, look.WARM, look.BAD, look.REFERENCE_COLOR, look.TRUTH_COLOR):
        assert contrast(color, theme["ground"]) > 3.0


def test_legs_turn_from_green_over_amber_to_red():
    colors = look.leg_colors(np.array([-1.0, 0.0, 0.35, 0.7, 1.0, 2.0, np.nan]))
    good, warm, bad = (look.rgb(color) for color in (look.GOOD, look.WARM, look.BAD))
    middle = np.round((np.array(good) + warm) / 2.0)
    np.testing.assert_allclose(colors, [good, good, middle, warm, bad, bad, bad], atol=1)


def test_the_shares_are_of_stroke_speed_and_imu():
    stroke = np.array([[0.2, 0.4], [0.3, 0.5]])
    np.testing.assert_allclose(look.room(np.array([[0.3, 0.45]]), stroke), [[0.1, 0.05]])
    np.testing.assert_allclose(
        look.stroke_shares(np.array([[0.3, 0.45], [0.2, 0.55]]), stroke), [[0.0, 0.5], [1.0, 1.5]], atol=1e-12
    )
    np.testing.assert_allclose(look.speed_shares(np.array([-0.1, 0.2]), 0.4), [0.25, 0.5])
    np.testing.assert_allclose(look.imu_shares(np.array([True, False])), [0.0, 1.0])


def test_the_ring_goes_round(hexapod):
    rim = hexapod.base_joints[look.ring(hexapod.base_joints)]
    np.testing.assert_array_equal(rim[0], rim[-1])
    sides = np.diff(rim, axis=0)
    turns = np.cross(sides, np.roll(sides, -1, axis=0))[:, 2]
    assert len({*map(tuple, rim)}) == 6 and (np.sign(turns) == np.sign(turns[0])).all()


@pytest.mark.parametrize("room", ["reports", "panel"])
def test_no_room_has_colours_of_its_own(room):
    for path in (ROOT / room).glob("*.py"):
        assert not re.findall(r"#[0-9a-fA-F]{6}\b", path.read_text()), path
