"""The motions that are fitted to the limits of a mechanism keep within all of them, and those of presets stay as they were."""

import numpy as np
import pytest

from controller.planning.motions import named_motion
from controller.planning.target import load_target
from controller.workspace import check_against_limits
from plant.errors import InputError
from plant.mechanism import load_in_space, load_mechanism

DURATIONS = {"probing": 4.0, "near-rests": 20.0, "rests": 50.0, "shaking": 40.0}

BEFORE = {
    "hexapod": (1.0092643216901314, 3.265170938251823, 7.144495118957021, 3.5600215300753932),
    "6-3-I": (1.099826858128444, 3.066037492908146, 6.566452741404602, 3.938642138170868),
    "6-3-II": (0.9796905713160032, 3.649732822280165, 8.064531271388212, 3.3760400781014255),
    "6-4-I": (1.0270866347300902, 3.7759954910754554, 7.638785082121327, 3.4843539028699246),
    "6-4-II": (1.2305483316054553, 5.031984311200509, 10.548075266336145, 4.428379284039938),
    "6-5": (1.0085918584199158, 3.788019271402723, 7.406261431576999, 3.635078511134785),
    "genhexkins": (0.7429601724180327, 3.435165831065058, 7.119696736034084, 2.2957902466446103),
    "planar-3rpr": (0.3850573886856744, 1.5791295595513635, 3.9434478175906973, 1.0710313414758525),
}
"""Deviations of the motions of `DURATIONS`, weighted and summed, when they kept within the strokes alone."""


@pytest.mark.parametrize(
    "preset",
    [
        "planar-3rpr",
        pytest.param("hexapod", marks=pytest.mark.slow),
        *(pytest.param(name, marks=pytest.mark.endurance) for name in BEFORE if name not in ("hexapod", "planar-3rpr")),
    ],
)
def test_the_motions_of_presets_are_what_they_were(preset: str) -> None:
    mechanism = load_in_space(preset)
    for (name, duration), before in zip(DURATIONS.items(), BEFORE[preset], strict=True):
        _, positions, rotations = named_motion(name, mechanism, duration)
        now = np.hstack([positions, rotations.reshape(-1, 9)]).std(axis=0) @ np.arange(1.0, 13.0)
        assert now == pytest.approx(before, rel=1e-12), name


@pytest.mark.slow
@pytest.mark.parametrize("swing", [0.3, 0.15, 0.08])
def test_motions_keep_within_the_swings_and_the_ways_between_their_poses_do(swing: float) -> None:
    mechanism = load_mechanism("6-3-II", {"joints.platform_swing": swing, "bodies.leg_diameter": 0.03})
    for name, duration in DURATIONS.items():
        checked = check_against_limits(mechanism, load_target(name, mechanism, duration), duration)
        assert checked.passes, f"{name}: {checked.refusal()}"


def test_a_home_at_the_edge_of_a_limit_leaves_no_motion() -> None:
    edge = load_mechanism("hexapod", {"joints.platform_swing": 1e-9})
    with pytest.raises(InputError, match="has no room to shake about home"):
        named_motion("shaking", edge, 4.0)
    with pytest.raises(InputError, match="no poses to rest at"):
        named_motion("rests", edge, 4.0)
