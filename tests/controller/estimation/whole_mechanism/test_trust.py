"""The trust in the whole-mechanism filter: no change of the pose's source is a step of the pose."""

import numpy as np
import pytest

from controller.cycle import STATE, CycleStage, cycle_parameters
from controller.estimation.whole_mechanism.filter import extrapolate_covariance
from controller.estimation.whole_mechanism.trust import find_covariance
from controller.imu_set import pose_share
from controller.inverse_kinematics import leg_lengths
from controller.safety.causes import Cause, Mode
from controller.settings import SafetySettings, control_settings, fusion_settings
from plant.encoders import load_encoder
from plant.imu_wiring import ALL_IMUS
from plant.pose import pose_errors, rotation_from_vector
from tests.controller.cycles import cycle, run_stages
from tests.controller.leg_geometry import leg_directions, rotation_of, static_signals

RATE_HZ = 500.0
BLENDING_S = 0.03
MOVE = np.array([2e-3, -1e-3, 3e-3])
TURN = np.array([0.01, 0.02, -0.015])


class Rest:
    """A platform at rest, whose filter is off by as much as a test has moved it."""

    def __init__(self, mechanism):
        home = mechanism.home
        safety = SafetySettings(watch_imus=0.0, following=1e3, drive_deviation=1e3, arming_distance=1e3)
        settings = control_settings(mechanism), fusion_settings(mechanism)
        self.parameters = cycle_parameters(mechanism, RATE_HZ, *settings, whole="gyroscopes", safety=safety)
        self.parameters["safety"]["drives"]["slack"] = np.inf
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


def blended(steps, errors, trusted=True):
    """How a low-pass of second order, without lag for steady growth, follows steps (n, 6); or how they fade from the first."""
    share, found, growth, followed = 1.0 / (BLENDING_S * RATE_HZ), errors.copy(), np.zeros(6), []
    for step in steps:
        left = step - found
        growth = growth + share * left if trusted else growth
        found = found + share * (left + growth)
        followed.append(found)
    return np.array(followed)


def test_when_the_filter_is_no_longer_trusted_the_pose_fades_to_the_closed_form(hexapod):
    rest = Rest(hexapod)
    rest.step_until(trusted=1)
    for _ in range(300):
        at_rest = rest.step()
    np.testing.assert_allclose(at_rest, 0.0, atol=1e-6)
    # No reading changes the filter any more, so that it stays where it has been moved.
    rest.parameters["mechanism"]["filter"]["variance"] = 1e30
    rest.parameters["mechanism"]["disagreement"] = 3e-5
    rest.move_filter()
    errors = rest.step_until(trusted=0)
    assert len(errors) > 5
    np.testing.assert_allclose(errors[:-1], blended(np.tile(AWAY, (len(errors) - 1, 1)), np.zeros(6)), atol=2e-5)
    # Beyond the restart of the filter, too.
    errors = np.array([errors[-1], *(rest.step() for _ in range(200))])
    np.testing.assert_allclose(errors[1:], blended(np.zeros((200, 6)), errors[0], trusted=False), rtol=0.0, atol=2e-5)
    assert rest.trust["filter"]["running"] == 1


def test_when_the_filter_is_trusted_the_pose_goes_to_the_filters(hexapod):
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
    moved = errors[np.abs(errors).max(axis=1) > 1e-6]
    np.testing.assert_allclose(moved, blended(np.tile(AWAY, (len(moved), 1)), np.zeros(6)), rtol=0.0, atol=2e-5)
    np.testing.assert_allclose(moved[-1], AWAY, atol=0.05 * np.abs(AWAY).max())


def test_the_pose_takes_what_is_slow_from_the_filter_and_what_is_fast_from_the_closed_form(hexapod):
    """A closed form that swings about a filter that stands still: by how much the pose swings, beside the transfer function."""
    stage = Stage(hexapod, disagreement=1.0).trusted()
    stage.parameters["mechanism"]["filter"]["variance"] = 1e30
    home = stage.home.position
    for hertz in (1.0, 5.0, 28.0):
        found = []
        for n in range(round(3.0 * RATE_HZ)):
            closed = home + [1e-3 * np.sin(2.0 * np.pi * hertz * n / RATE_HZ), 0.0, 0.0]
            stage.step(closed=closed)
            found.append(stage.pose["position"][0] - home[0])
        swing = np.ptp(found[-round(2.0 * RATE_HZ) :]) / 2e-3
        s = 2j * np.pi * hertz * BLENDING_S
        assert swing == pytest.approx(abs(s**2 / (s**2 + s + 1.0)), rel=0.1, abs=0.005)


# ------------------------------------------------------------------------------------------------------ its stage alone


FIRST, SETTLING, SETTLING_AGAIN, PATIENCE = 50, 150, 500, 25
"""Cycles before few IMUs' first start, of settling or of waiting for a new start, and the time constant of the leg filters'
disagreement.
"""


class Stage:
    """The stage of the filter alone, at rest at home, with a pose in closed form and leg filters as a test has them."""

    def __init__(self, mechanism, magnetometer=False, imus=ALL_IMUS, **fusion):
        settings = control_settings(mechanism), fusion_settings(mechanism, **fusion), imus
        self.parameters = cycle_parameters(mechanism, RATE_HZ, *settings, whole="gyroscopes", magnetometer=magnetometer)
        self.state = np.zeros((), STATE)
        self.home = mechanism.home
        self.directions = leg_directions(mechanism, self.home.position, self.home.rotation)
        self.state["imus"]["used"] = 1
        self.state["imus"]["sample"] = static_signals(mechanism, self.home.position, self.home.rotation)
        self.state["legs"]["used"], self.state["legs"]["directions"] = 1.0, self.directions
        self.trust, self.pose, self.time = self.state["mechanism"], self.state["pose"], self.state["time"]

    def step(self, found=True, missed=0, closed=None):
        """A cycle; whether there is a pose."""
        self.time["missed"] = missed
        self.time["cycle"] += missed
        self.pose["found"] = found
        self.pose["position"] = self.home.position if closed is None else closed
        self.pose["rotation"] = self.home.rotation
        self.pose["twist"], self.pose["acceleration"] = 7.0, 8.0
        run_stages(self.parameters, self.state, self.state["imus"]["sample"].copy(), CycleStage.MECHANISM)
        self.time["cycle"] += 1
        return bool(self.pose["found"])

    @property
    def stands(self):
        """Whether the filter runs, and whether it is trusted."""
        return bool(self.trust["filter"]["running"]), bool(self.trust["trusted"])

    def trusted(self):
        """Once it is."""
        self.pose["twist"] = 0.0
        while not self.trust["trusted"]:
            self.step()
            # The start took the twist of the pose.
            self.trust["filter"]["motion"] = self.trust["filter"]["published_motion"] = 0.0
            self.trust["filter"]["low_passed"] = self.trust["filter"]["smooth_motion"] = 0.0
        return self


def test_the_filter_starts_with_the_first_pose_and_is_trusted_when_it_has_settled(hexapod):
    stage = Stage(hexapod)
    assert not stage.step(found=False)
    assert stage.stands == (False, False)
    stage.step()
    # Started in cycle 1, at the pose and twist of that cycle, which go on unchanged.
    assert stage.stands == (True, False)
    assert (stage.trust["due"], stage.trust["filter"]["time"]) == (1 + SETTLING, 1.0 / RATE_HZ)
    np.testing.assert_array_equal(stage.trust["filter"]["position"], stage.home.position)
    np.testing.assert_array_equal(stage.trust["filter"]["motion"][:2], 7.0)
    stage.trust["filter"]["motion"] = stage.trust["filter"]["published_motion"] = 0.0
    stage.trust["filter"]["low_passed"] = stage.trust["filter"]["smooth_motion"] = 0.0
    while stage.time["cycle"] < 1 + SETTLING:
        assert stage.step()
        assert stage.stands == (True, False)
        np.testing.assert_array_equal(stage.pose["twist"], 7.0)
        np.testing.assert_allclose(stage.pose["position"], stage.home.position, rtol=0.0, atol=1e-15)
    assert stage.step()
    assert stage.stands == (True, True)
    np.testing.assert_array_equal(stage.pose["twist"], stage.trust["twist"])
    np.testing.assert_allclose(stage.pose["twist"], 0.0, atol=1e-3)


def test_with_fewer_imus_it_starts_when_the_leg_filters_have_settled_and_knows_less(hexapod):
    imus = 1, 2, 3, 4
    stage, share = Stage(hexapod, imus=imus), pose_share(hexapod, fusion_settings(hexapod), imus)
    stage.pose["twist"] = 0.0
    for _ in range(FIRST + 1):
        assert stage.stands == (False, False)
        stage.step()
    assert stage.stands == (True, False)
    sigmas = np.sqrt(np.diag(stage.trust["filter"]["published_covariance"]))
    np.testing.assert_allclose(sigmas[:9], np.repeat([share * 0.01, share * 0.05, 0.1], 3), rtol=1e-12)
    assert share > 5.0


@pytest.mark.parametrize(
    ("imus", "mode", "armed", "standing"),
    [
        ((1, 2, 3, 4), Mode.IDLE, 1, 1),
        ((1, 2, 3, 4), Mode.RUNNING, 1, 0),
        ((1, 2, 3, 4), Mode.IDLE, 0, 0),
        (ALL_IMUS, Mode.IDLE, 1, 0),
    ],
)
def test_with_fewer_imus_it_knows_that_the_brakes_hold_if_they_are_the_loops_to_open(hexapod, imus, mode, armed, standing):
    stage = Stage(hexapod, imus=imus)
    stage.parameters["mechanism"]["first_cycle"] = 0
    stage.parameters["safety"]["arming"]["active"], stage.state["safety"]["mode"] = armed, mode
    stage.step()
    stage.step()
    assert stage.trust["filter"]["standing"] == standing


@pytest.mark.parametrize(
    ("imus", "lengths", "share"),
    [((1, 2, 3, 4), "incremental", 0.1), ((1, 2, 3, 4), "none", 1.0), ((0, 4, 5, 6), "incremental", 1.0)],
)
def test_beside_encoders_a_filter_of_imus_that_hardly_determine_the_pose_must_know_its_rotation_better(
    hexapod, imus, lengths, share
):
    fusion = fusion_settings(hexapod)
    found = cycle_parameters(
        hexapod, RATE_HZ, control_settings(hexapod), fusion, imus, whole="gyroscopes", encoder=load_encoder(lengths)
    )  # fmt: skip
    assert found["mechanism"]["known"] == pytest.approx((share * fusion.disagreement) ** 2, rel=1e-12)


@pytest.mark.parametrize("trusted", [False, True])
def test_the_legs_are_those_of_the_pose_that_is_used(hexapod, trusted):
    stage = Stage(hexapod, disagreement=1.0)
    stage.step()
    if trusted:
        stage.trusted()
    f = stage.trust["filter"]
    f["position"] += MOVE
    f["published_position"] += MOVE
    stage.step()
    assert stage.stands == (True, trusted)
    away = np.linalg.norm(stage.pose["position"] - stage.home.position)
    assert 0.01 * np.linalg.norm(MOVE) < away < np.linalg.norm(MOVE) if trusted else away < 1e-12
    lengths = leg_lengths(hexapod, stage.pose["position"], stage.pose["rotation"])
    np.testing.assert_allclose(stage.pose["lengths"], lengths, rtol=0.0, atol=1e-12)


def test_a_filter_that_hardly_knows_its_rotation_is_not_trusted_and_once_trusted_it_stays(hexapod):
    stage = Stage(hexapod)
    limit = fusion_settings(hexapod).disagreement
    stage.parameters["mechanism"]["filter"]["variance"] = 1e30
    stage.step()
    f = stage.trust["filter"]
    for sigma, trusted in ((1.001, False), (0.999, True), (2.0, True)):
        for _ in range(2 * SETTLING):
            f["motion"] = f["published_motion"] = f["low_passed"] = f["smooth_motion"] = 0.0
            f["covariance"] = f["published_covariance"] = 0.0
            f["published_covariance"][3:6, 3:6] = np.diag([0.5, 0.3, 0.2]) * (sigma * limit) ** 2
            f["collected"] = 0
            assert stage.step()
        assert stage.stands == (True, trusted)


@pytest.mark.parametrize("missed", [0, 3, 25])
def test_leg_filters_that_disagree_on_average_stop_the_filter_missed_periods_counted(hexapod, missed):
    stage = Stage(hexapod).trusted()
    stage.state["legs"]["directions"] = stage.directions @ rotation_of([0.0, 0.02, 0.0]).T
    # Legs across the axis of the turn show all of it.
    seen = np.mean(np.sum((stage.state["legs"]["directions"] - stage.directions) ** 2, axis=1))
    share, limit, mean = min(1.0, (1 + missed) / PATIENCE), fusion_settings(hexapod).disagreement ** 2, 0.0
    while stage.stands == (True, True):
        stage.step(missed=missed)
        mean += share * (seen - mean)
        assert stage.trust["disagreement"] == pytest.approx(mean, rel=1e-3, abs=1e-9)
        assert stage.stands == ((True, True) if mean <= limit else (False, False))
    due = int(stage.time["cycle"]) - 1 + SETTLING
    assert stage.trust["due"] == due
    stage.state["legs"]["directions"] = stage.directions
    while stage.time["cycle"] <= due:
        assert stage.stands == (False, False)
        assert stage.step()
    assert stage.stands == (True, False) and stage.trust["disagreement"] == 0.0
    assert stage.trust["due"] == due + SETTLING_AGAIN


def test_a_short_lapse_of_the_leg_filters_stops_nothing(hexapod):
    stage = Stage(hexapod).trusted()
    away = stage.directions @ rotation_of([0.0, 0.02, 0.0]).T
    for _ in range(20):
        stage.state["legs"]["directions"] = away
        assert stage.step() and stage.step() and stage.stands == (True, True)
        stage.state["legs"]["directions"] = stage.directions
        for _ in range(2 * PATIENCE):
            assert stage.step() and stage.stands == (True, True)


def test_a_filter_with_which_they_disagree_is_told_and_starts_later_each_time(hexapod):
    stage, waits = Stage(hexapod), []
    for _ in range(4):
        stage.trusted()
        stage.state["safety"]["events"]["count"] = 0
        stage.state["legs"]["directions"] = stage.directions @ rotation_of([0.0, 0.05, 0.0]).T
        while stage.trust["trusted"]:
            stage.step()
        events = stage.state["safety"]["events"]
        assert (events["count"], events["cause"][0]) == (1, Cause.FILTER_DISAGREES)
        assert events["value"][0] > events["limit"][0] == pytest.approx(fusion_settings(hexapod).disagreement)
        waits.append(int(stage.trust["due"]) - int(stage.time["cycle"]) + 1)
        stage.state["legs"]["directions"] = stage.directions
    assert waits == [SETTLING, 2 * SETTLING, 4 * SETTLING, 8 * SETTLING]
    # One that has not been trusted yet waits no longer.
    while not stage.trust["filter"]["running"]:
        stage.step()
    stage.state["legs"]["directions"] = stage.directions @ rotation_of([0.0, 0.05, 0.0]).T
    stage.state["safety"]["events"]["count"] = 0
    while stage.trust["filter"]["running"]:
        stage.step()
    assert (stage.trust["stops"], stage.state["safety"]["events"]["count"]) == (4, 0)


def test_the_disagreement_is_the_mean_square_over_the_legs_that_are_used(hexapod):
    stage = Stage(hexapod, disagreement=0.5).trusted()

    def disagreement(chords):
        """With leg directions moved by so much across themselves, without a change of their state."""
        across = np.cross(stage.directions, [0.0, 0.0, 1.0])
        across *= (np.asarray(chords) / np.linalg.norm(across, axis=1))[:, None]
        stage.state["legs"]["directions"] = stage.directions + across
        stage.trust["disagreement"] = 0.0
        stage.step()
        stage.state["legs"]["directions"] = stage.directions
        return float(stage.trust["disagreement"]) * PATIENCE

    for chords in (np.full(6, 0.02), np.full(6, -0.03), 0.01 * np.arange(6)):
        assert disagreement(chords) == pytest.approx(np.mean(np.square(chords)), rel=1e-3)
    # Of five legs, one counts more; and a leg that is not used, not at all.
    alone = np.zeros(6)
    alone[5] = 0.02
    stage.state["legs"]["used"][3] = 0.0
    assert disagreement(alone) == pytest.approx(0.02**2 / 5.0, rel=1e-3)
    stage.state["legs"]["used"][[5, 3]] = 0.0, 1.0
    assert disagreement(100.0 * alone) == pytest.approx(0.0, abs=1e-9)


def test_without_a_pose_in_closed_form_the_trusted_filters_pose_goes_on_and_another_does_not(hexapod):
    stage = Stage(hexapod)
    stage.step()
    assert not stage.step(found=False, closed=np.nan)
    stage = Stage(hexapod).trusted()
    for _ in range(2 * PATIENCE):
        assert stage.step(found=False, closed=np.nan)
        assert stage.stands == (True, True)
        np.testing.assert_allclose(stage.pose["position"], stage.home.position, rtol=0.0, atol=1e-6)
    # Once there is one again, the pose goes on from the filter's, even if it is 5 standard deviations away.
    stage.pose["information"] = 1.5e8 * np.eye(6)
    assert stage.step(closed=stage.home.position + [1e-3, 0.0, 0.0])
    np.testing.assert_allclose(stage.pose["position"], stage.home.position, rtol=0.0, atol=1e-6)
    # A filter that is no longer finite is not trusted either, and what is not finite does not stay in the pose.
    stage.trust["filter"]["published_position"] = np.nan
    stage.trust["filter"]["position"] = np.nan
    for _ in range(PATIENCE + 1):
        stage.step()
    assert stage.stands == (False, False)
    for _ in range(10 * round(BLENDING_S * RATE_HZ)):
        assert stage.step()
    np.testing.assert_allclose(stage.pose["position"], stage.home.position, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize(("missed", "left"), [(0, 14 / 15), (4, 10 / 15), (14, 0.0), (300, 0.0)])
def test_what_is_left_of_a_step_fades_over_missed_periods_too(hexapod, missed, left):
    stage, step = Stage(hexapod), np.array([1e-3, -2e-3, 3e-3, 0.01, -0.02, 0.03])
    stage.step()
    stage.trust["correction"] = step
    stage.step(missed=missed)
    np.testing.assert_allclose(stage.trust["correction"], left * step, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(stage.pose["position"], stage.home.position + left * step[:3], rtol=0.0, atol=1e-15)
    turned = rotation_of(left * step[3:]) @ stage.home.rotation
    np.testing.assert_allclose(stage.pose["rotation"], turned, rtol=0.0, atol=1e-12)


def test_the_covariance_is_the_filters_with_what_is_fast_in_the_closed_forms(hexapod):
    stage = Stage(hexapod).trusted()
    p = stage.parameters[()]
    stage.pose["information"] = np.diag(1.0 / np.array([1e-6, 2e-6, 3e-6, 4e-4, 5e-4, 6e-4]))
    factor, found, own = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    extrapolate_covariance(p["mechanism"]["filter"], stage.trust["filter"][()], stage.time["cycle"] / RATE_HZ, own)
    find_covariance(p["mechanism"], stage.trust[()], p["rig"], stage.time[()], stage.pose[()], factor, found)
    np.testing.assert_allclose(found, own + 0.01 * np.diag([1e-6, 2e-6, 3e-6, 4e-4, 5e-4, 6e-4]), rtol=1e-9, atol=1e-18)
    # Without a pose in closed form, the filter's alone; without the filter, that of the closed form, or none.
    stage.pose["information"] = 0.0
    find_covariance(p["mechanism"], stage.trust[()], p["rig"], stage.time[()], stage.pose[()], factor, found)
    np.testing.assert_allclose(found, own, rtol=1e-9)
    stage.trust["trusted"] = 0
    find_covariance(p["mechanism"], stage.trust[()], p["rig"], stage.time[()], stage.pose[()], factor, found)
    assert np.isnan(found).all()


@pytest.mark.parametrize(("sigmas", "kept"), [(0.5, 1.0), (2.4, 1.0), (5.0, 0.5), (50.0, 0.05)])
def test_the_pose_takes_no_more_of_the_step_to_the_filters_than_the_closed_forms_covariance_explains(hexapod, sigmas, kept):
    stage = Stage(hexapod, disagreement=1.0).trusted()
    stage.parameters["mechanism"]["filter"]["variance"] = 1e30
    random = np.random.default_rng(round(10 * sigmas))
    root = np.diag([3e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-4]) @ (np.eye(6) + 0.3 * random.standard_normal((6, 6)))
    direction = random.standard_normal(6)
    off = sigmas * np.sqrt(6.0) * root @ (direction / np.linalg.norm(direction))
    # Its upper triangle does not count.
    stage.pose["information"] = np.tril(np.linalg.inv(root @ root.T)) + np.triu(np.full((6, 6), np.nan), 1)
    f = stage.trust["filter"]
    for position, rotation in (("position", "rotation"), ("published_position", "published_rotation")):
        f[position] += off[:3]
        f[rotation] = rotation_from_vector(off[3:]) @ f[rotation]
    for _ in range(round(0.5 * RATE_HZ)):
        stage.step()
    found = pose_errors(stage.pose["position"], stage.pose["rotation"], stage.home.position, stage.home.rotation)
    assert stage.trust["trusted"]
    np.testing.assert_allclose(found, kept * off, rtol=0.02, atol=2e-3 * np.abs(off).max())
    p, factor, covariance, own = stage.parameters, np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    extrapolate_covariance(p["mechanism"]["filter"], f[()], stage.time["cycle"] / RATE_HZ, own)
    find_covariance(p["mechanism"], stage.trust[()], p["rig"], stage.time[()], stage.pose[()], factor, covariance)
    expected = np.tril((0.1**2 + (1.0 - kept) ** 2) * root @ root.T)
    np.testing.assert_allclose(np.tril(covariance - own), expected, rtol=0.03, atol=1e-3 * np.abs(expected).max())
    # The level counts how far apart the two estimates are.
    np.testing.assert_allclose(stage.pose["apart"], np.linalg.norm(off.reshape(2, 3), axis=1), rtol=0.01)


def test_the_closed_form_bounds_nothing_where_its_covariance_is_too_small(hexapod):
    def limit(imus=ALL_IMUS, encoder=None, whole="accelerometers", **safety):
        settings = control_settings(hexapod), fusion_settings(hexapod), imus, whole
        parameters = cycle_parameters(hexapod, RATE_HZ, *settings, safety=SafetySettings(**safety), encoder=encoder)
        return float(parameters["mechanism"]["farthest"])

    assert limit() == limit(whole="gyroscopes") == limit(ALL_IMUS[1:]) == pytest.approx(6.0 * 2.5**2)
    assert limit((1, 2, 3, 4)) == limit(encoder=load_encoder("incremental")) == limit(whole="alignments") == np.inf
    assert limit(watch_imus=0.0) == np.inf


@pytest.mark.parametrize("delay", [0.0, 0.007])
def test_samples_and_field_are_older_than_the_cycle_by_the_sensors_delay(hexapod, delay):
    stage = Stage(hexapod, magnetometer=True, sensor_delay=delay, disagreement=10.0)
    heading, f = stage.state["heading"], stage.trust["filter"]
    window = int(stage.parameters["mechanism"]["filter"]["window"])
    stage.step()
    for used, fresh in ((0, 1), (1, 0), (1, 1)):
        heading["used"], heading["fresh"], heading["field"] = used, fresh, [3.0, 4.0, 5.0]
        f["field"], f["field_time"], f["collected"] = 0.0, -1.0, 0
        stage.step()
        now = (stage.time["cycle"] - 1) / RATE_HZ
        taken = bool(used and fresh)
        np.testing.assert_array_equal(f["field"], [3.0, 4.0, 5.0] if taken else 0.0)
        assert f["field_time"] == pytest.approx(now - delay if taken else -1.0, abs=1e-12)
        assert f["sum_time"] == pytest.approx(now - delay, abs=1e-12)
    heading["used"] = 0
    f["collected"] = f["field_used"] = 0
    first = int(stage.time["cycle"])
    for _ in range(window):
        stage.step()
    # The mean of the window.
    assert f["time"] == pytest.approx((first + (window - 1) / 2.0) / RATE_HZ - delay, abs=1e-12)
