"""The stages around the filters of legs, platform and heading: their constants, delay, missed periods, and starting again."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.cycle import STATE, CycleStage, cycle_parameters
from controller.estimation.filterpy_filters import FilterpyFilters
from controller.estimation.heading_filter import heading_parameters
from controller.estimation.leg_filter import STATES, leg_direction, leg_parameters, start_leg
from controller.estimation.platform_filter import platform_parameters
from controller.estimation.pose_estimator import follow_plan, follow_twist, pose_parameters
from controller.inverse_kinematics import leg_lengths, legs_at
from controller.rig import MagneticField, field_of
from controller.settings import FusionSettings, control_settings, fusion_settings
from plant.dynamics.variables import PLATFORM_IMU
from plant.imu import ACCELEROMETER, GYROSCOPE, MAGNETOMETER
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import Mechanism, load_in_space
from tests.controller.cycles import run_stages
from tests.controller.leg_geometry import rotation_of, static_signals, unit
from tests.controller.leg_motion import joint_to_leg

RATE_HZ, PERIOD_S = 500.0, 2e-3
SETTLING = 50
"""How many cycles a filter that has started again is not relied upon."""


@pytest.fixture(scope="module")
def inclined(hexapod):
    """The hexapod with an inclined base, a field from another side, and its IMUs off the axes."""
    up = unit([0.1, -0.15, 1.0])
    return Mechanism.from_legs(
        hexapod.base_joints,
        hexapod.platform_joints,
        up_in_base=up,
        home=hexapod.home,
        limits={"stroke": hexapod.limits.stroke},
        plant={
            **hexapod.plant,
            "gravity": -9.7 * up,
            "magnetic_field": np.array([12.0, 15.0, -40.0]),
            "platform_imu_position": np.array([0.10, -0.15, 0.12]),
            "leg_imu_position": hexapod.plant["leg_imu_position"] + np.linspace(-0.02, 0.02, 18).reshape(6, 3),
        },
    )


def stages(mechanism, magnetometer=True, rate=RATE_HZ, **fusion):
    """Parameters, and a state at rest at home in which every filter has run for long."""
    settings = control_settings(mechanism), fusion_settings(mechanism, **fusion)
    parameters = cycle_parameters(mechanism, rate, *settings, ALL_IMUS, magnetometer=magnetometer)
    state = np.zeros((), STATE)
    state["imus"]["used"], state["imus"]["unchanged"] = 1, 0
    if not mechanism.planar:
        state["imus"]["sample"] = static_signals(mechanism, mechanism.home.position, mechanism.home.rotation)
    state["pose"]["rotation"] = mechanism.home.rotation
    return parameters, state


def step(parameters, state, missed=0, first=CycleStage.LEGS, last=CycleStage.POSE):
    time = state["time"]
    time["missed"] = missed
    time["cycle"] += missed
    run_stages(parameters, state, state["imus"]["sample"].copy(), first, last)
    time["cycle"] += 1


# ---------------------------------------------------------------------------------------------------------- the constants


def test_the_constants_of_the_filters_are_those_of_the_settings_in_cycles_of_the_rate(hexapod):
    fusion = FusionSettings(
        leg_jerk=7.0, bias_walk=2e-4, bias_sigma=0.03, gyroscope_noise=2e-3, leg_accelerometer_noise=0.05, leg_sigma=4e-3,
        platform_accelerometer_noise=0.02, tilt_sigma=5e-3, sensor_delay=0.004, acceleration_time=0.025, heading_sigma=0.02,
        magnetometer_noise=0.3, magnetometer_rate=50.0,
    )  # fmt: skip
    legs = leg_parameters(fusion, 800.0)
    # White noise of density d over samples at a rate f has the variance d^2 f / 2.
    expected = {
        "jerk": 49.0, "bias_walk": 4e-8, "bias_sigma": 0.03, "rate_variance": 4e-6 * 400.0, "force_variance": 2.5e-3 * 400.0,
        "weight": 62500.0, "delay": 0.004, "settling_cycles": 80,
    }  # fmt: skip
    platform = platform_parameters(fusion, 800.0, 60.0)
    assert float(platform_parameters(fusion, 800.0)["acceleration_variance"]) == 4.0
    of_platform = {
        "rate_density": 4e-6, "bias_walk": 4e-8, "bias_sigma": 0.03, "force_variance": 4e-4 * 400.0,
        "weight": 40000.0, "delay": 0.004, "settling_cycles": 80, "acceleration_variance": (2.0 * 60.0 * 0.025) ** 2,
    }  # fmt: skip
    heading = heading_parameters(fusion, 800.0, MagneticField(np.eye(3)[:2], 15.0, -36.0), True)
    of_heading = {
        "active": 1, "strength": 39.0, "sample_cycles": 16, "variance": 0.09 * 25.0 / 225.0, "floor": 4e-4,
        "rate_density": 4e-6, "bias_walk": 4e-8, "bias_sigma": 0.03, "delay": 0.004, "settling_cycles": 80,
    }  # fmt: skip
    for found, values in ((legs, expected), (platform, of_platform), (heading, of_heading)):
        assert set(values) == set(found.dtype.names)
        for name, value in values.items():
            assert float(found[name]) == pytest.approx(value, rel=1e-12), name
    for section_5 in (False, True):
        pose = pose_parameters(fusion, section_5)
        assert (bool(pose["section_5"]), float(pose["acceleration_rate"])) == (section_5, pytest.approx(40.0))
    # In cycles slower than the magnetometer each has a sample of its own, less noisy.
    slow = heading_parameters(fusion, 40.0, field_of(hexapod), False)
    assert (int(slow["active"]), int(slow["sample_cycles"])) == (0, 1)
    assert float(slow["variance"]) == pytest.approx(0.09 * 20.0 / 18.0**2)


def test_the_leg_filter_starts_as_unsure_as_it_says():
    x, covariance = np.zeros(STATES), np.full((STATES, STATES), np.nan)
    start_leg(x, covariance, np.zeros(3), np.array([0.0, 0.0, 9.81]), unit([0.0, 0.45, 0.9]), 0.02)
    sigmas = np.repeat([0.15, 0.05, 40.0, 0.02], [2, 2, 2, 3])
    np.testing.assert_allclose(covariance, np.diag(sigmas**2), rtol=1e-14)


# -------------------------------------------------------------------------------------------------------------- the delay


@pytest.mark.parametrize("delay", [0.003, 0.02])
def test_a_leg_is_where_its_motion_has_led_during_the_sensors_delay(delay):
    random = np.random.default_rng(3)
    joint, x = rotation_of(random.normal(size=3)), np.concatenate([random.uniform(-3.0, 3.0, 6), np.ones(3)])
    x[4:6] *= 20.0

    def at(t):
        return joint @ joint_to_leg(x[:2] + t * x[2:4] + t**2 / 2.0 * x[4:6])[:, 2]

    direction, rate = np.zeros(3), np.zeros(3)
    leg_direction(x, joint, delay, direction, rate)
    np.testing.assert_allclose(direction, at(delay), rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(rate, (at(delay + 1e-6) - at(delay - 1e-6)) / 2e-6, rtol=0.0, atol=1e-7)


def test_the_delay_reaches_all_three_filters(inclined):
    """The samples of a turning platform are old by the delay: directions, vertical and north are carried on."""
    delay, rate = 0.005, np.array([0.4, -0.7, 0.5])
    parameters, state = stages(inclined, sensor_delay=delay)
    for _ in range(3):
        step(parameters, state)
    # The filters keep what they know.
    for stage, names in (("legs", ("rate_variance", "force_variance")), ("platform", ("force_variance",))):
        for name in names:
            parameters[stage][name] = 1e30
    state["legs"]["x"][:, 2:4] = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 2))
    state["platform"]["x"][3:6] = 0.03, -0.02, 0.01
    state["imus"]["sample"][GYROSCOPE, PLATFORM_IMU] = rate + state["platform"]["x"][3:6]
    step(parameters, state)
    platform, heading = state["platform"], state["heading"]
    np.testing.assert_allclose(platform["rate"], rate, rtol=0.0, atol=1e-9)
    # What is fixed in {1} turns against the rate in {2}; the second order is left out.
    back = rotation_of(-delay * rate)
    np.testing.assert_allclose(platform["vertical"], back @ platform["x"][:3], rtol=0.0, atol=(delay * 1.0) ** 2)
    np.testing.assert_allclose(heading["north"], back @ heading["x"][:3], rtol=0.0, atol=(delay * 1.0) ** 2)
    assert np.linalg.norm(platform["vertical"] - platform["x"][:3]) > 0.5 * delay * 0.6
    for leg in range(6):
        direction, unused = np.zeros(3), np.zeros(3)
        leg_direction(state["legs"]["x"][leg], inclined.joint_rotations[leg], delay, direction, unused)
        np.testing.assert_allclose(state["legs"]["directions"][leg], direction, rtol=0.0, atol=1e-14)


# ------------------------------------------------------------------------------------------------------- missed periods


@pytest.mark.parametrize("missed", [0, 1, 4, 15])
def test_the_platforms_vertical_and_heading_are_carried_over_missed_periods(inclined, missed):
    """By the turn of the whole gap; samples so uncertain that they change nothing. The doubt grows by the gap, too."""
    parameters, state = stages(inclined)
    # At rest, the field may stand still.
    state["imus"]["unchanged"] = 1
    for _ in range(60):
        step(parameters, state)
    rate = np.array([0.4, -0.7, 0.5])
    state["imus"]["sample"][GYROSCOPE, PLATFORM_IMU] = rate
    parameters["platform"]["force_variance"] = parameters["heading"]["variance"] = 1e30
    state["platform"]["x"][3:6], state["heading"]["x"][3] = 0.0, 0.0
    state["platform"]["covariance"], state["heading"]["covariance"] = 1e-6 * np.eye(7), 1e-6 * np.eye(2)
    parameters["platform"]["rate_density"], parameters["platform"]["bias_walk"] = 3e-5, 7e-5
    parameters["heading"]["rate_density"], parameters["heading"]["bias_walk"] = 2e-5, 5e-5
    vertical, north = state["platform"]["x"][:3].copy(), state["heading"]["x"][:3].copy()
    step(parameters, state, missed=missed)
    time = (1 + missed) * PERIOD_S
    back = rotation_of(-time * rate)
    np.testing.assert_allclose(state["platform"]["x"][:3], back @ vertical, rtol=0.0, atol=0.3 * time**3)
    np.testing.assert_allclose(state["heading"]["x"][:3], back @ north, rtol=0.0, atol=0.6 * time**3)
    found = np.diag(state["platform"]["covariance"])
    np.testing.assert_allclose(found[4:], 1e-6 + 7e-5 * time, rtol=1e-12)
    np.testing.assert_allclose(found[:2], 1e-6 + 3e-5 * time, rtol=0.01)
    spread = state["heading"]["covariance"]
    np.testing.assert_allclose(
        spread, [[1e-6 * (1.0 + time**2) + 2e-5 * time, 1e-6 * time], [1e-6 * time, 1e-6 + 5e-5 * time]], rtol=1e-12
    )


@pytest.mark.parametrize("missed", [0, 3, 25, 200])
def test_a_filter_that_starts_again_is_used_when_it_has_settled_missed_periods_counted(inclined, missed):
    parameters, state = stages(inclined)
    # At rest, the field may stand still.
    state["imus"]["unchanged"] = 1
    weights = float(parameters["legs"]["weight"]), float(parameters["platform"]["weight"])
    legs, platform, heading = state["legs"], state["platform"], state["heading"]

    def in_use():
        # What is used has its weight, and what is not has none.
        np.testing.assert_array_equal(legs["weights"], weights[0] * legs["used"])
        assert platform["weight"] == weights[1] * platform["used"]
        assert (heading["weight"] > 0.0) == bool(heading["used"])
        return legs["used"].tolist(), bool(platform["used"]), bool(heading["used"])

    # Those that start with the first cycle need not settle.
    step(parameters, state)
    assert in_use() == ([1.0] * 6, True, True)
    for _ in range(100):
        step(parameters, state)
    state["imus"]["used"][[1, PLATFORM_IMU]] = 0
    before = legs["x"][1].copy(), platform["x"].copy()
    step(parameters, state)
    assert in_use() == ([1.0, 0.0, 1.0, 1.0, 1.0, 1.0], False, False)
    assert (legs["age"][1], platform["age"], heading["age"]) == (0, 0, 0)
    np.testing.assert_array_equal(legs["x"][1], before[0])
    np.testing.assert_array_equal(platform["x"], before[1])
    state["imus"]["used"] = 1
    # It starts with what is read then, not with what it knew.
    legs["x"][1], platform["x"][:6] = 0.3, [0.0, 0.6, 0.8, 0.1, 0.1, 0.1]
    step(parameters, state)
    sample = state["imus"]["sample"]
    np.testing.assert_allclose(platform["x"][:6], [*unit(sample[ACCELEROMETER, PLATFORM_IMU]), 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(legs["x"][1, 6:], 0.0, atol=1e-9)
    age = 1
    while not platform["used"]:
        assert in_use() == ([1.0, 0.0, 1.0, 1.0, 1.0, 1.0], False, False)
        step(parameters, state, missed=missed)
        age += 1 + missed
        assert (legs["age"][1], platform["age"], heading["age"]) == (age, age, age)
        assert in_use() == ([1.0, float(age > SETTLING)] + [1.0] * 4, age > SETTLING, age > SETTLING)


def test_a_planar_leg_knows_no_second_angle():
    rig = load_in_space("planar-3rpr")
    parameters, state = stages(rig, magnetometer=False)
    state["imus"]["sample"][ACCELEROMETER] = [7.0, 0.5, 7.0]
    step(parameters, state)
    state["legs"]["x"][:3] += 0.1
    state["legs"]["covariance"][:3] += 0.5 * np.eye(STATES)
    step(parameters, state)
    np.testing.assert_array_equal(state["legs"]["x"][:3, 1:6:2], 0.0)
    np.testing.assert_array_equal(state["legs"]["covariance"][:3, 1:6:2], 0.0)
    np.testing.assert_array_equal(state["legs"]["covariance"][:3, :, 1:6:2], 0.0)
    assert (np.abs(state["legs"]["x"][:3, 0:6:2]) > 0.0).all()
    np.testing.assert_array_equal(state["legs"]["directions"][:3, 2], 0.0)


# ---------------------------------------------------------------------------------------- the platform's own acceleration


def test_the_acceleration_of_the_platforms_imu_is_that_of_its_place_on_the_platform(inclined):
    """Against second differences of the place, on a platform that accelerates and turns, its gyroscope biased."""
    random = np.random.default_rng(4)
    parameters, state = stages(inclined)
    step(parameters, state)
    rotation, acceleration = rotation_of(random.normal(size=3)), random.uniform(-2.0, 2.0, 3)
    turn, turning = random.uniform(-2.0, 2.0, 3), random.uniform(-9.0, 9.0, 3)
    bias, place = np.array([0.03, -0.02, 0.05]), np.array([0.10, -0.15, 0.12])
    state["pose"]["rotation"], state["pose"]["unplanned"] = rotation, [*acceleration, *turning]
    state["platform"]["x"][3:6] = bias
    state["imus"]["sample"][GYROSCOPE, PLATFORM_IMU] = rotation.T @ turn + bias
    step(parameters, state, first=CycleStage.PLATFORM, last=CycleStage.HEADING)

    def at(t):
        # Rotation vectors from the present one have rate and acceleration as derivatives.
        return t**2 / 2.0 * acceleration + rotation_of(t * turn + t**2 / 2.0 * turning) @ rotation @ place

    h = 1e-3
    expected = rotation.T @ (at(h) - 2.0 * at(0.0) + at(-h)) / h**2
    np.testing.assert_allclose(state["platform"]["imu_acceleration"], expected, rtol=0.0, atol=1e-4)


# ------------------------------------------------------------------------------------------------------------ the heading


@pytest.mark.parametrize("share", [0.69, 0.71, 1.29, 1.31])
def test_a_field_that_is_not_the_earths_is_left_out(inclined, share):
    parameters, state = stages(inclined)
    field = state["imus"]["sample"][MAGNETOMETER, PLATFORM_IMU]
    field *= share
    step(parameters, state)
    healthy = abs(share - 1.0) < 0.3
    assert (bool(state["heading"]["used"]), state["heading"]["age"]) == (healthy, int(healthy))
    assert (state["heading"]["weight"] > 0.0) == healthy


def test_each_sample_of_the_magnetometer_is_taken_once_and_one_that_stands_ten_times_as_long_is_frozen(inclined):
    parameters, state = stages(inclined, magnetometer_rate=100.0)
    heading, field = state["heading"], state["imus"]["sample"][MAGNETOMETER, PLATFORM_IMU]
    fresh = []
    for k in range(20):
        if k % 5 == 0:
            field[0] += 1e-3
        step(parameters, state)
        fresh.append(int(heading["fresh"]))
    assert fresh == [1, 0, 0, 0, 0] * 4
    # An unchanged sample after its time is a new one that says the same, and doubt grows smaller.
    used = []
    for k in range(1, 61):
        before = heading["covariance"][0, 0]
        step(parameters, state)
        # The last change was in cycle 15, and the sample has stood for four cycles when this begins.
        assert heading["fresh"] == (k % 5 == 1 and k + 4 < 50)
        assert (heading["covariance"][0, 0] < before) == bool(heading["fresh"])
        used.append(bool(heading["used"]))
    assert used == [k + 4 < 50 for k in range(1, 61)]
    # A new sample ends that, and the filter begins anew.
    field[1] += 1e-3
    step(parameters, state)
    assert (heading["age"], heading["used"], heading["fresh"]) == (1, 0, 1)


def test_a_field_that_stands_with_the_rest_of_its_imu_is_not_frozen(inclined):
    parameters, state = stages(inclined)
    step(parameters, state)
    state["imus"]["unchanged"] = 1
    for _ in range(100):
        step(parameters, state)
        assert state["heading"]["used"] == 1
        assert state["heading"]["frozen_for"] == 0


def test_the_heading_weighs_by_its_variance_and_what_its_calibration_leaves(inclined):
    parameters, state = stages(inclined, heading_sigma=0.03)
    for _ in range(10):
        step(parameters, state)
    assert state["heading"]["weight"] == pytest.approx(1.0 / (state["heading"]["covariance"][0, 0] + 9e-4), rel=1e-12)
    # The north is the field's direction across the vertical.
    north = inclined.home.rotation.T @ field_of(inclined).vectors[1]
    np.testing.assert_allclose(state["heading"]["north"], north, rtol=0.0, atol=1e-9)
    up, field = inclined.up_in_base, inclined.plant["magnetic_field"]
    np.testing.assert_allclose(field_of(inclined).vectors[1], unit(field - up * (up @ field)), atol=1e-12)


def test_without_a_magnetometer_the_heading_is_left_alone(inclined):
    parameters, state = stages(inclined, magnetometer=False)
    before = state["heading"].copy()
    for _ in range(3):
        step(parameters, state)
    assert state["heading"].tobytes() == before.tobytes()


# ---------------------------------------------------------------------------------------------------- filters on filterpy


def test_the_stages_on_filterpy_do_the_same_over_failures_and_new_starts(inclined):
    random = np.random.default_rng(5)
    parameters, compiled = stages(inclined, magnetometer=False, sensor_delay=0.004)
    twin, filters = compiled.copy(), FilterpyFilters(parameters)
    still = compiled["imus"]["sample"].copy()
    for k in range(150):
        used = np.ones(7, np.int64)
        used[2], used[PLATFORM_IMU] = not 20 <= k < 40, not 30 <= k < 60
        sample = still + random.normal(size=still.shape) * np.array([2e-3, 0.2, 0.0])[:, None, None]
        # A shock on each IMU in turn, and readings that are clipped.
        sample[ACCELEROMETER, k % 7] += (k % 5 == 0) * random.normal(scale=30.0, size=3)
        clipped = random.random((2, 7)) < 0.05
        for state in (compiled, twin):
            state["imus"]["used"], state["imus"]["sample"], state["imus"]["shaking"]["clipped"] = used, sample, clipped
            if k % 50 == 25:
                state["imus"]["shaking"]["passed"] = np.linspace(0.1, 30.0, 7)
            state["pose"]["twist"] = 0.1
            state["pose"]["unplanned"] = random.normal(size=6) if state is compiled else compiled["pose"]["unplanned"]
        step(parameters, compiled, last=CycleStage.HEADING)
        filters.step_legs(twin)
        filters.step_platform(twin)
        twin["time"]["cycle"] += 1
        for stage, names in (
            ("imus", ("shaking",)),
            ("legs", ("x", "age", "used", "weights", "directions", "rates")),
            ("platform", ("x", "unknown", "noise", "running", "age", "used", "weight", "vertical", "rate", "imu_acceleration")),
        ):
            for name in names:
                pair = [state[stage][name] if name != "shaking" else state[stage][name]["excess"] for state in (twin, compiled)]
                np.testing.assert_allclose(*pair, rtol=1e-9, atol=1e-9, err_msg=f"{name} {k}")
        # Where the platform's velocity is known to be zero, it has no variance but rounding's of that of a clipped reading.
        for stage, least in (("legs", 1e-300), ("platform", 1e-3)):
            variances = np.diagonal(compiled[stage]["covariance"], axis1=-2, axis2=-1)
            scale = np.sqrt(np.maximum(variances, 0.0)) + least
            off = (twin[stage]["covariance"] - compiled[stage]["covariance"]) / scale[..., :, None] / scale[..., None, :]
            assert np.abs(off).max() < 1e-9


# -------------------------------------------------------------------------------------------------------- the pose's parts


@pytest.mark.parametrize(("missed", "share"), [(0, 0.08), (4, 0.4), (20, 1.0)])
def test_the_acceleration_follows_the_twist_over_missed_periods_by_no_more_than_the_whole_step(inclined, missed, share):
    parameters, state = stages(inclined, acceleration_time=0.025)
    for _ in range(3):
        step(parameters, state, last=CycleStage.MECHANISM)
    smooth = np.arange(1.0, 7.0)
    state["pose"]["smooth_twist"] = smooth
    step(parameters, state, missed=missed, last=CycleStage.MECHANISM)
    pose = state["pose"]
    time = max(0.025, (1 + missed) * PERIOD_S)
    np.testing.assert_allclose(pose["unplanned"], (pose["twist"] - smooth) / time, rtol=1e-12)
    np.testing.assert_allclose(pose["smooth_twist"], smooth + share * (pose["twist"] - smooth), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["hexapod", "planar-3rpr"])
def test_a_planned_acceleration_is_known_at_once(name):
    """The legs are planned to go as on a path of the platform, whose second differences are the acceleration."""
    mechanism, h = load_in_space(name), 1e-4
    parameters, state = stages(mechanism, magnetometer=False)
    velocity, acceleration = np.array([0.1, 0.2, 0.0]), np.array([1.0, -2.0, 0.0, 0.0, 0.0, 3.0])
    turn = np.array([0.0, 0.0, 0.6])
    if name == "hexapod":
        velocity, acceleration = np.array([0.1, -0.05, 0.2]), np.array([0.5, 1.0, -2.0, 3.0, -2.0, 1.0])
        turn = np.array([0.6, -0.4, 0.3])

    def at(t):
        position = mechanism.home.position + t * velocity + 0.5 * t**2 * acceleration[:3]
        return position, rotation_of(t * turn + 0.5 * t**2 * acceleration[3:]) @ mechanism.home.rotation

    lengths = np.array([leg_lengths(mechanism, *at(t)) for t in (-h, 0.0, h)])
    legs, pose = np.zeros((6, 3)), state["pose"]
    legs[: mechanism.legs] = np.stack(
        [lengths[1], (lengths[2] - lengths[0]) / (2.0 * h), np.diff(lengths, 2, axis=0)[0] / h**2]
    ).T
    geometry = parameters["rig"]["geometry"]
    legs_at(
        geometry["base_joints"], geometry["platform_joints"], *at(0.0), pose["arms"], pose["directions"], pose["lengths"]
    )  # fmt: skip
    pose["unplanned"] = unplanned = 0.1 * acceleration
    follow_plan(pose[()], parameters["rig"][()], legs)
    np.testing.assert_allclose(pose["planned"], [[*velocity, *turn], acceleration], rtol=0.0, atol=2e-5)
    np.testing.assert_allclose(pose["acceleration"], acceleration + unplanned, rtol=0.0, atol=2e-5)


def test_what_goes_as_planned_leaves_no_acceleration_unplanned(inclined):
    """The twist grows as planned, and its low-pass with it, without a delay."""
    parameters, state = stages(inclined)
    pose, planned = state["pose"], np.array([0.5, -0.3, 0.2, 1.0, 2.0, -3.0])
    for k in range(50):
        pose["twist"] = k * PERIOD_S * planned
        pose["planned"][1] = planned if k else 0.0
        follow_twist(parameters["pose"][()], pose[()], parameters["rig"][()], state["time"][()])
        np.testing.assert_allclose(pose["unplanned"], 0.0, atol=1e-12)
        state["time"]["cycle"] += 1


def test_in_the_first_cycle_there_is_no_acceleration(inclined):
    parameters, state = stages(inclined)
    turning = np.array([0.2, -0.1, 0.3])
    state["imus"]["sample"][GYROSCOPE, PLATFORM_IMU] = turning
    step(parameters, state, last=CycleStage.MECHANISM)
    assert np.abs(state["pose"]["twist"]).max() > 0.01
    np.testing.assert_array_equal(state["pose"]["acceleration"], 0.0)
    np.testing.assert_array_equal(state["pose"]["smooth_twist"], state["pose"]["twist"])


def test_the_pose_takes_vertical_and_north_with_their_weights_from_their_filters(inclined):
    parameters, state = stages(inclined)
    for _ in range(3):
        step(parameters, state, last=CycleStage.MECHANISM)
    np.testing.assert_array_equal(state["pose"]["vectors"], [state["platform"]["vertical"], state["heading"]["north"]])
    weights = state["platform"]["weight"], state["heading"]["weight"]
    np.testing.assert_array_equal(state["pose"]["vector_weights"], weights)
    assert weights[0] != weights[1] and min(weights) > 0.0
    aligned, _ = Rotation.align_vectors(field_of(inclined).vectors, state["pose"]["vectors"])
    np.testing.assert_allclose(state["pose"]["rotation"], aligned.as_matrix(), atol=1e-9)
