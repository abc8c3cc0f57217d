"""The multisine: as large as the limits let it be, and never larger."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.direct_kinematics import poses_from_lengths
from controller.planning.motions import motion_from_text, text_of_motion
from controller.planning.motions.splines import curve_at
from controller.pose_limits.limits import GEOMETRY_ALONE
from controller.pose_limits.margins import margins
from hil.identification.excitation import multisine
from plant.errors import InputError, UnreachableError
from plant.mechanism import load_in_space

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(("name", "rate"), [("hexapod", 500.0), ("6-3-I", 250.0), ("planar-3rpr", 250.0)])
def test_the_legs_keep_to_the_share_of_every_limit(name, rate):
    mechanism = load_in_space(name)
    made = multisine(mechanism, rate, 6.0, 0.7)
    limits, end = mechanism.require_limits(), made.planned.duration
    times = np.linspace(0.0, end, 40_000)
    lengths, rates, accelerations, jerks = curve_at(made.planned.segments, times)
    half = 0.5 * (limits.stroke[:, 1] - limits.stroke[:, 0])
    uses = {
        "stroke": np.abs(lengths - limits.stroke.mean(axis=1)).max(axis=0) / half,
        "velocity": np.abs(rates) / limits.velocity,
        "acceleration": np.abs(accelerations) / limits.acceleration,
        "jerk": np.abs(jerks) / limits.jerk,
    }
    for kind, use in uses.items():
        assert use.max() == pytest.approx(made.uses[kind], rel=0.02)
    assert 0.65 < max(made.uses.values()) <= 0.7
    assert made.lines[-1] <= rate / 10.0 and made.lines[0] >= 0.25 and len(made.lines) >= 15
    # It begins and ends at rest at home.
    home = mechanism.require_home()
    for at in (0, -1):
        assert np.abs(rates[at]).max() < 1e-9
        positions, _ = poses_from_lengths(mechanism, lengths[[at]], home)
        np.testing.assert_allclose(positions[0], home.position, atol=1e-9)


def test_all_lines_are_in_the_motion_of_the_legs():
    made = multisine(load_in_space("hexapod"), 500.0, 10.0)
    times = np.arange(2.0, 8.0, 0.002)
    accelerations = curve_at(made.planned.segments, times)[2]
    power = np.abs(np.fft.rfft(accelerations * np.hanning(len(times))[:, None], axis=0)).mean(axis=1)
    frequencies = np.fft.rfftfreq(len(times), 0.002)
    quiet = np.median(power)
    for line in made.lines[made.lines > 2.0]:
        assert power[np.abs(frequencies - line) < 0.4].max() > 3.0 * quiet, line


def test_the_motion_is_one_of_a_file():
    made = multisine(load_in_space("hexapod"), 250.0, 5.0)
    assert motion_from_text(text_of_motion(made.motion), "multisine") == made.motion


def test_joints_and_bodies_are_kept_free():
    limited = load_in_space(str(ROOT / "docs" / "limited_hexapod.toml"))
    planned = multisine(limited, 250.0, 5.0, 0.5).planned
    assert margins(limited, planned.positions[::10], planned.rotations[::10], GEOMETRY_ALONE).reachable.all()
    tight = replace(limited, joints=replace(limited.joints, base_swing=np.full(6, 0.02), platform_swing=np.full(6, 0.02)))
    with pytest.raises(UnreachableError, match=r"the multisine exceeds .* swing of leg .* smaller --share"):
        multisine(tight, 250.0, 5.0, 0.5)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ((1000.0, 4.0, 0.8), "duration is 4 s; it must be 5 to 60 s"),
        ((1000.0, 10.0, 1.0), "share of the limits is 1; it must be 0.01 to 0.95"),
        ((10.0, 10.0, 0.8), "rate"),
    ],
)
def test_what_cannot_be_is_refused(values, said):
    with pytest.raises(InputError, match=said):
        multisine(load_in_space("hexapod"), *values)
