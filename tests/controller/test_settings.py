"""Settings: defaults, the preset's tables, changes by name, and what is refused."""

from dataclasses import FrozenInstanceError, asdict, fields, replace

import numpy as np
import pytest

from controller.settings import (
    ControlSettings,
    DriveSettings,
    FusionSettings,
    SafetySettings,
    control_settings,
    drive_settings,
    fusion_settings,
    safety_settings,
    sensor_settings,
)
from plant.errors import GoughError, InputError
from plant.imu import ImuModel, SensorErrors, load_imu
from plant.mechanism import Mechanism

KINDS = [
    (ControlSettings, control_settings, "control"),
    (FusionSettings, fusion_settings, "fusion"),
    (SafetySettings, safety_settings, "safety"),
    (DriveSettings, drive_settings, "drives"),
]


def mechanism_with(hexapod, **tables):
    return Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints, settings=tables)


@pytest.mark.parametrize(("kind", "read", "table"), KINDS)
def test_without_a_table_the_defaults_stand(hexapod, kind, read, table):
    assert read(mechanism_with(hexapod)) == kind()
    assert read(mechanism_with(hexapod, **{table: {}})) == kind()


def test_a_preset_and_then_a_change_by_name_take_precedence(hexapod):
    mechanism = mechanism_with(hexapod, control={"proportional": 20.0, "hold": 0.5}, fusion={"leg_sigma": 1e-3})
    assert control_settings(mechanism) == ControlSettings(proportional=20.0, hold=0.5)
    assert control_settings(mechanism, hold=0.3) == ControlSettings(proportional=20.0, hold=0.3)
    assert fusion_settings(mechanism) == FusionSettings(leg_sigma=1e-3)
    assert fusion_settings(mechanism, leg_sigma=2e-3, tilt_sigma=3e-3) == FusionSettings(leg_sigma=2e-3, tilt_sigma=3e-3)
    # A whole number in a file is a number.
    assert control_settings(mechanism_with(hexapod, control={"proportional": 20})).proportional == 20.0


def test_the_hexapods_gains_lie_in_the_range_of_the_design(hexapod):
    control = control_settings(hexapod)
    assert 30.0 <= control.proportional <= 60.0
    assert 60.0 <= control.integral <= 200.0
    assert control.hold >= 0.2


@pytest.mark.parametrize(("kind", "read", "table"), KINDS)
def test_an_unknown_name_in_a_table_is_refused_with_the_known_ones(hexapod, kind, read, table):
    with pytest.raises(InputError, match="nonsense") as caught:
        read(mechanism_with(hexapod, **{table: {"nonsense": 1.0}}))
    first = fields(kind)[0].name
    with pytest.raises(InputError, match=f"did you mean {first!r}"):
        read(mechanism_with(hexapod, **{table: {first[:2] + first[3:]: 1.0}}))
    assert isinstance(caught.value, GoughError)
    for field in fields(kind):
        assert field.name in str(caught.value)


@pytest.mark.parametrize(("kind", "read", "table"), KINDS)
def test_an_unknown_name_among_the_changes_is_refused(hexapod, kind, read, table):
    with pytest.raises(InputError, match="nonsense"):
        read(hexapod, nonsense=1.0)


@pytest.mark.parametrize("value", ["fast", [1.0, 2.0], None, {}])
def test_what_is_no_number_is_refused_in_tables_and_changes(hexapod, value):
    with pytest.raises(InputError, match="proportional"):
        control_settings(mechanism_with(hexapod, control={"proportional": value}))
    with pytest.raises(InputError, match="proportional"):
        control_settings(hexapod, proportional=value)


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("kind", "read", "table"), KINDS)
def test_a_bad_value_of_any_setting_is_refused_by_name(hexapod, kind, read, table, bad):
    for name in asdict(kind()):
        if bad == np.inf and name in (
            "length_deviation",
            "misfit",
            "evidence",
            "protection_position",
            "protection_rotation",
            "oscillation",
            "slack",
        ):
            assert getattr(read(hexapod, **{name: bad}), name) == np.inf
            continue
        with pytest.raises(InputError, match=name):
            read(hexapod, **{name: bad})
        with pytest.raises(InputError, match=name):
            read(mechanism_with(hexapod, **{table: {name: bad}}))


def test_zero_is_allowed_only_where_it_switches_something_off(hexapod):
    off = control_settings(hexapod, integral=0.0, derivative=0.0)
    assert (off.integral, off.derivative) == (0.0, 0.0)
    assert fusion_settings(hexapod, sensor_delay=0.0).sensor_delay == 0.0
    unwatched = safety_settings(hexapod, most_lost_imus=0.0, watch_imus=0.0)
    assert (unwatched.most_lost_imus, unwatched.watch_imus) == (0.0, 0.0)
    known = drive_settings(hexapod, load=0.0, resistance=0.0, friction=0.0)
    assert (known.load, known.resistance, known.friction) == (0.0, 0.0, 0.0)
    switches = {"integral", "derivative", "sensor_delay", "sensor_timing", "most_lost_imus", "watch_imus", "need_platform_imu"}
    switches |= {"load", "resistance", "friction", "position_integral"}
    for kind, read, _ in KINDS:
        for field in fields(kind):
            if field.name not in switches:
                with pytest.raises(InputError, match=field.name):
                    read(hexapod, **{field.name: 0.0})


def test_the_message_tells_whether_zero_is_allowed(hexapod):
    with pytest.raises(InputError, match=r"^\[safety\] most_lost_imus is -1\.0; it must be 0 or positive and finite"):
        safety_settings(hexapod, most_lost_imus=-1.0)
    with pytest.raises(InputError, match=r"carried is 0\.0; it must be positive and finite"):
        safety_settings(hexapod, carried=0.0)
    with pytest.raises(InputError, match=r"evidence is -1\.0; it must be positive; inf is no limit"):
        safety_settings(hexapod, evidence=-1.0)


@pytest.mark.parametrize(("kind", "read", "table"), KINDS)
def test_the_message_names_the_table(hexapod, kind, read, table):
    name = fields(kind)[0].name
    with pytest.raises(InputError, match=rf"^\[{table}\] {name} is -60"):
        read(mechanism_with(hexapod, **{table: {name: -60}}))


@pytest.mark.parametrize("name", ["watch_imus", "need_platform_imu"])
def test_a_switch_is_on_or_off(hexapod, name):
    for value in (0, 1):
        assert getattr(safety_settings(hexapod, **{name: value}), name) == value
    for value in (0.5, 2.0):
        with pytest.raises(InputError, match=rf"\[safety\] {name} is {value}; it must be 0 or 1"):
            safety_settings(hexapod, **{name: value})


@pytest.mark.parametrize(
    ("name", "most", "beyond", "allowed"),
    [
        ("protection_position", 1.0, 5.0, "positive, in m and at most 1; inf is no limit"),
        ("protection_rotation", np.pi, 10.0, "positive, in rad and at most 3.14; inf is no limit"),
    ],
)
def test_a_protection_level_that_can_only_be_meant_in_another_unit_is_refused(hexapod, name, most, beyond, allowed):
    assert getattr(safety_settings(hexapod, **{name: most}), name) == most
    with pytest.raises(InputError, match=rf"\[safety\] {name} is {beyond}; it must be {allowed}"):
        safety_settings(hexapod, **{name: beyond})


def test_settings_do_not_change_once_built():
    with pytest.raises(FrozenInstanceError):
        ControlSettings().proportional = 1.0
    with pytest.raises(FrozenInstanceError):
        FusionSettings().leg_sigma = 1.0


IMU = ImuModel(
    "own", gyroscope=SensorErrors(bandwidth=100.0, reach=5.0), accelerometer=SensorErrors(bandwidth=50.0, reach=30.0),
    magnetometer_rate=25.0, delay=0.003,
)  # fmt: skip


def test_the_imus_tell_their_delay_their_ranges_and_the_magnetometers_rate(hexapod):
    found = sensor_settings(mechanism_with(hexapod, fusion={"leg_sigma": 2e-3}), IMU, 1000.0)
    expected = FusionSettings(
        leg_sigma=2e-3, magnetometer_rate=25.0, gyroscope_range=5.0, accelerometer_range=30.0,
        sensor_delay=0.003 + 0.5 * (1.0 / (2.0 * np.pi * 100.0) + 1.0 / (2.0 * np.pi * 50.0)),
    )  # fmt: skip
    assert found == expected


@pytest.mark.parametrize("name", ["sensor_delay", "magnetometer_rate", "gyroscope_range", "accelerometer_range"])
def test_what_the_mechanisms_file_says_of_its_imus_goes_before_what_they_tell(hexapod, name):
    own, told = sensor_settings(mechanism_with(hexapod, fusion={name: 7.0}), IMU, 1000.0), sensor_settings(hexapod, IMU, 1000.0)
    assert getattr(own, name) == 7.0
    for field in fields(FusionSettings):
        assert field.name == name or getattr(own, field.name) == getattr(told, field.name)


def without_aliases(imu):
    return replace(imu, conversion_rate=0.0, sparing=False)


WANDERING = ("leg_sigma", "tilt_sigma", "accelerometer_bias_sigma")


def test_accelerometers_that_wander_make_directions_and_biases_less_certain(hexapod):
    imu = load_imu("mpu9150-nominal")
    found, usual = (sensor_settings(hexapod, each, 1000.0) for each in (imu, replace(imu, disturbances=())))
    for name, wander in zip(WANDERING, np.array([1.0, 1.0, 9.80665]) * imu.accelerometer_wander / 9.80665, strict=True):
        assert getattr(found, name) ** 2 - getattr(usual, name) ** 2 == pytest.approx(wander**2)
    own = sensor_settings(mechanism_with(hexapod, fusion={"leg_sigma": 2e-3}), imu, 1000.0)
    assert (own.leg_sigma, own.tilt_sigma, own.accelerometer_bias_sigma) == (2e-3, *(getattr(found, n) for n in WANDERING[1:]))


@pytest.mark.parametrize("name", ["ideal", "mpu9150", "mpu9150-calibrated", "icm42688"])
def test_imus_that_do_not_wander_leave_the_standard_deviations_to_the_bit(hexapod, name):
    found = sensor_settings(hexapod, without_aliases(load_imu(name)), 1000.0)
    assert all(getattr(found, each) == getattr(fusion_settings(hexapod), each) for each in WANDERING)


def test_noisier_gyroscopes_count_less_and_make_directions_less_certain(hexapod):
    imu, usual = without_aliases(load_imu("bmi088-calibrated")), fusion_settings(hexapod)
    imu = replace(imu, accelerometer=replace(imu.accelerometer, noise=0.004))
    found = sensor_settings(hexapod, imu, 1000.0)
    assert found.gyroscope_noise == pytest.approx(imu.gyroscope.noise)
    for name, power in (("mechanism_gyroscope_noise", 1.0), ("leg_sigma", 0.5), ("tilt_sigma", 0.5)):
        assert getattr(found, name) / getattr(usual, name) == pytest.approx((0.014 / 0.005) ** power)
    quiet = sensor_settings(hexapod, load_imu("lsm6dso-calibrated"), 1000.0)
    assert quiet.gyroscope_noise == usual.gyroscope_noise and quiet.leg_sigma == usual.leg_sigma


def test_noisier_accelerometers_count_less_and_make_directions_less_certain(hexapod):
    """What their noise is above the usual one adds to what the filters of a leg and of the platform assume."""
    imu, usual = without_aliases(load_imu("mpu9150-calibrated")), fusion_settings(hexapod)
    found = sensor_settings(hexapod, replace(imu, accelerometer=replace(imu.accelerometer, noise=0.02)), 1000.0)
    assert found.mechanism_accelerometer_noise == pytest.approx(0.02)
    for name, sigma in (("leg_accelerometer_noise", "leg_sigma"), ("platform_accelerometer_noise", "tilt_sigma")):
        noise = getattr(found, name)
        assert noise**2 - getattr(usual, name) ** 2 == pytest.approx(0.02**2 - usual.mechanism_accelerometer_noise**2)
        assert getattr(found, sigma) / getattr(usual, sigma) == pytest.approx(np.sqrt(noise / getattr(usual, name)))
    assert found.gyroscope_noise == usual.gyroscope_noise


@pytest.mark.parametrize("rate", [125.0, 250.0, 1000.0])
def test_noise_that_aliases_counts(hexapod, rate):
    """Below the rate of samples, white noise that a low-pass of first order, time constant tau, has filtered has the density
    times the root of x coth(x), x = 1 / (2 rate tau).
    """
    imu, usual = replace(load_imu("mpu9150-calibrated"), conversion_rate=400e3), fusion_settings(hexapod)
    found = sensor_settings(hexapod, imu, rate)
    for width, density, got in (
        (256.0, imu.gyroscope.noise, found.gyroscope_noise),
        (256.0, usual.mechanism_gyroscope_noise, found.mechanism_gyroscope_noise),
        (260.0, imu.accelerometer.noise, found.mechanism_accelerometer_noise),
    ):
        x = np.pi * width / rate
        assert got == pytest.approx(density * np.sqrt(x / np.tanh(x)), rel=2e-3)
    slow = replace(imu, sample_rate=0.5 * rate)
    assert sensor_settings(hexapod, slow, rate).gyroscope_noise == sensor_settings(hexapod, imu, 0.5 * rate).gyroscope_noise


def test_clocks_of_their_own_make_the_times_of_samples_uncertain(hexapod):
    """A sample waits up to its period for the loop, and jitters."""
    imu = load_imu("icm42688-nominal")
    waits = np.random.default_rng(0).uniform(0.0, 1.0 / imu.sample_rate, 20000)
    times = waits + imu.jitter * np.random.default_rng(1).normal(size=waits.size)
    assert sensor_settings(hexapod, imu, 1000.0).sensor_timing == pytest.approx(np.std(times), rel=0.02)
    assert sensor_settings(hexapod, load_imu("mpu9150"), 1000.0).sensor_timing == 0.0


def test_ranges_and_rates_without_an_end_are_finite_settings(hexapod):
    found = sensor_settings(hexapod, load_imu("ideal"), 1000.0)
    assert found.sensor_delay == 0.0
    for value in (found.magnetometer_rate, found.gyroscope_range, found.accelerometer_range):
        assert 1e12 < value < np.inf


@pytest.mark.parametrize(("own", "all_imus", "few_imus"), [({}, 0.008, 0.03), ({"slack": 0.004}, 0.004, 0.004)])
def test_few_imus_have_a_wider_slack_unless_the_file_has_its_own(hexapod, own, all_imus, few_imus):
    mechanism = mechanism_with(hexapod, drives=own)
    assert (drive_settings(mechanism).slack, drive_settings(mechanism, few_imus=True).slack) == (all_imus, few_imus)


def test_for_raw_imus_the_distances_are_5_cm_at_least_and_no_imu_is_watched():
    usual = SafetySettings(following=0.02, velocity_margin=3.0, saturation=0.4)
    raw = usual.for_raw_imus()
    distances = "stroke_margin", "following", "arming_distance", "arming_drift", "length_deviation"
    changed = dict.fromkeys(distances, 0.05) | {"watch_imus": 0.0}
    assert asdict(raw) == asdict(usual) | changed
    wide = SafetySettings(stroke_margin=0.06, following=0.07, arming_distance=0.08).for_raw_imus()
    assert (wide.stroke_margin, wide.following, wide.arming_distance) == (0.06, 0.07, 0.08)
    assert (DriveSettings().for_raw_imus().slack, DriveSettings(slack=0.07).for_raw_imus().slack) == (0.05, 0.07)
