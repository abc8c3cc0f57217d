"""The trust in the whole-mechanism filter: no change of the pose's source is a step of the pose."""

import numpy as np

from controller.cycle import STATE, cycle_parameters
from controller.inverse_kinematics import leg_lengths
from controller.safety.causes import Cause
from controller.settings import SafetySettings, control_settings, fusion_settings
from plant.pose import pose_errors
from tests.controller.cycles import cycle
from tests.controller.leg_geometry import rotation_of, static_signals

RATE_HZ = 500.0
FADING_S = 0.1
MOVE = np.array([2e-3, -1e-3, 3e-3])
TURN = np.array([0.01, 0.02, -0.015])


class Rest:
    """A platform at rest, whose filter is off by as much as a test has moved it."""

    def __init__(self, mechanism):
        home = mechanism.home
        safety = SafetySettings(watch_imus=0.0, following=1e3, drive_deviation=1e3, arming_distance=1e3)
        settings = control_settings(mechanism), fusion_settings(mechanism)
        self.parameters = cycle_parameters(mechanism, RATE_HZ, *settings, whole="gyroscopes", safety=safety)
        self.state = np.zeros((), STATE)
        self.home = home.position, home.rotation
        self.signals = static_signals(mechanism, *self.home)
        self.segments = np.zeros((6, 1, 5))
        self.segments[:, 0, 1] = leg_lengths(mechanism, *self.home)
        self.trust = self.state["mechanism"]

    def step(self):
        """A cycle; how far its pose is from the true one (6,)."""
        assert cycle(self.parameters, self.state, self.signals, self.segments) == Cause.NONE
        pose = self.state["pose"]
        return pose_errors(pose["position"], pose["rotation"], *self.home)

    def step_until(self, trusted):
        """Cycles until the source of the pose has changed; the pose errors (n, 6) of these cycles."""
        found = []
        while self.trust["trusted"] != trusted:
            found.append(self.step())
            assert len(found) < 1000
        return np.array(found)

    def move_filter(self):
        """Move the filter away from the truth, by the same in what it is working on and in what it has published."""
        f = self.trust["filter"]
        for position, rotation in (("position", "rotation"), ("published_position", "published_rotation")):
            f[position] += MOVE
            f[rotation] = rotation_of(TURN) @ f[rotation]


AWAY = np.concatenate([MOVE, TURN])


def fades(errors, first, last):
    """Whether pose errors (n, 6) go from one to the other within `FADING_S`, by no more than a share of it in each cycle."""
    left = (1.0 - 1.0 / (FADING_S * RATE_HZ)) ** np.arange(1, len(errors) + 1)
    np.testing.assert_allclose(errors, last + left[:, None] * (first - last), rtol=0.0, atol=0.02 * np.abs(AWAY).max())


def test_when_the_filter_is_no_longer_trusted_the_pose_goes_on_from_where_it_was(hexapod):
    rest = Rest(hexapod)
    rest.step_until(trusted=1)
    for _ in range(300):
        at_rest = rest.step()
    np.testing.assert_allclose(at_rest, 0.0, atol=1e-6)
    # No reading changes the filter any more, so that it stays where it has been moved.
    rest.parameters["mechanism"]["filter"]["variance"] = 1e30
    rest.parameters["mechanism"]["disagreement"] = 1e-3
    rest.move_filter()
    errors = rest.step_until(trusted=0)
    np.testing.assert_allclose(errors[:-1], np.broadcast_to(AWAY, errors[:-1].shape), rtol=0.0, atol=1e-4)
    fades(errors[-1:], AWAY, 0.0)


def test_when_the_filter_is_trusted_the_pose_fades_to_the_filters(hexapod):
    rest = Rest(hexapod)
    # The leg filters agree, whatever the filter says.
    rest.parameters["mechanism"]["disagreement"] = 1.0
    while rest.state["time"]["cycle"] < rest.trust["due"] - 1 or not rest.trust["filter"]["running"]:
        rest.step()
    rest.parameters["mechanism"]["filter"]["variance"] = 1e30
    rest.move_filter()
    assert rest.trust["trusted"] == 0
    errors = np.array([rest.step() for _ in range(100)])
    assert rest.trust["trusted"] == 1
    fades(errors[np.abs(errors).max(axis=1) > 1e-6], 0.0, AWAY)
