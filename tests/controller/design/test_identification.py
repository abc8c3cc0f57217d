"""The fit of actuators: readings that a machine with other actuators would give, with noise, give these actuators back."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from controller.design import identification
from controller.design.identification import DELAY, QUANTILE, USUAL, Doubts, Measured, Value, identify_actuators
from controller.design.predicted_readings import Commands, Prediction, Readings, without_errors
from plant.dynamics.variables import VELOCITY
from plant.errors import CalibrationError, InputError, UnknownNameError
from plant.fmu.build import SPATIAL_MODEL, default_fmu
from plant.fmu.plant import FmuPlant
from plant.imu import load_imu
from plant.mechanism import load_in_space
from plant.mechanism.loads import force_constant, home_loads

RATE_HZ, DURATION_S = 250.0, 3.0
PERIOD_S = 1.0 / RATE_HZ
IMU = load_imu("mpu9150-calibrated")
NOISES = (np.radians(0.08), 0.06)
"""Of a gyroscope's [rad/s] and an accelerometer's [m/s^2] samples."""

DELAY_S = 0.0013


@pytest.fixture(scope="module")
def hexapod():
    return load_in_space("hexapod")


@pytest.fixture(scope="module")
def true(hexapod):
    """Other actuators than the preset's."""
    random, plant = np.random.default_rng(5), hexapod.plant_parameters()
    return {
        "drive.gain": random.uniform(0.95, 1.05, 6),
        "motor.resistance": plant["motor.resistance"] * random.uniform(0.85, 1.2, 6),
        "friction.coulomb": plant["friction.coulomb"] * random.uniform(0.7, 1.3, 6),
        "motor.inductance": 1.3 * plant["motor.inductance"],
        "motor.rotor_inertia": 0.85 * plant["motor.rotor_inertia"],
    }


@pytest.fixture(scope="module")
def commands(hexapod):
    """Sines of another frequency for each leg, slow and quick, about what holds the load."""
    times = np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
    plant, loads = hexapod.plant_parameters(), home_loads(hexapod)
    droop = (plant["motor.resistance"] - 0.3) / force_constant(hexapod) ** 2
    legs = np.arange(6.0)
    slow = 0.05 * np.sin(2.0 * np.pi * (0.7 + 0.11 * legs) * times[:, None] + legs)
    quick = sum(0.006 * np.sin(2.0 * np.pi * (f + 0.3 * legs) * times[:, None] + f * legs) for f in (9.0, 17.0, 24.0))
    return Commands(times, droop * loads.forces + slow + quick)


@pytest.fixture(scope="module")
def ideal(hexapod, commands, true):
    with Prediction(hexapod, IMU, PERIOD_S) as prediction:
        return prediction.readings(commands, true, hexapod.require_home(), DELAY_S)


def measured(commands, ideal, seed, correlation=0.0, **changes):
    """With noise, whose samples are correlated, and offsets of all sensors."""
    random, count = np.random.default_rng(seed), len(commands.times)
    white = random.normal(size=ideal.imus.shape) * np.array(NOISES)[None, :, None, None]
    noise = lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation], white, axis=0)
    offsets = np.array([np.radians(0.1), 0.005])[:, None, None] * random.normal(size=ideal.imus.shape[1:])
    readings = Readings(ideal.imus + noise + offsets, np.full((count, 6), np.nan))
    return replace(Measured(commands, readings, np.ones((count, 7), bool), np.zeros((count, 7)), PERIOD_S), **changes)


def known(hexapod, true, *names):
    """The mechanism with its true actuators, except those that are to be fitted."""
    return replace(hexapod, plant={**hexapod.plant, **{name: np.asarray(true[name]) for name in true if name not in names}})


def worst(found, true):
    """The greatest error in standard deviations."""
    return max(abs(each.value - true_value(true, each)) / each.sigma for each in found.values)


def true_value(true, value):
    if value.name == DELAY:
        return DELAY_S
    return float(true[value.name] if value.leg is None else true[value.name][value.leg])


@pytest.fixture(scope="module")
def found(hexapod, commands, ideal):
    return identify_actuators(hexapod, IMU, measured(commands, ideal, 1))


def test_other_actuators_are_recovered(found, true):
    errors = {each.label: (each.value - true_value(true, each)) / each.sigma for each in found.values}
    assert len(errors) == 21 and max(map(abs, errors.values())) < 4.0, errors
    assert 0.5 < np.sqrt(np.mean(np.square([*errors.values()]))) < 1.6
    for each in found.values:
        scale = 1.0 / RATE_HZ if each.name == DELAY else true_value(true, each)
        assert abs(each.value - true_value(true, each)) < 0.05 * scale, each.label
    assert found.remarks == () and found.delay == pytest.approx(DELAY_S, abs=2e-4)


def test_droop_and_lag_follow_from_the_physics(found, hexapod):
    """Droop is resistance over squared force constant, lag that times the mass that a leg moves; the widths by sampling."""
    parameters = found.parameters()
    constant = 2.0 * np.pi / 0.005 * 0.05
    figures = {(each.name, each.leg): each for each in found.figures}
    for leg, resistance in enumerate(parameters["motor.resistance"]):
        droop = (resistance - 0.5 * 0.6) / constant**2
        assert figures["droop", leg].value == pytest.approx(droop, rel=1e-9)
        rotor = hexapod.plant_parameters()["motor.rotor_inertia"]
        rest = np.diag(home_loads(hexapod).masses)[leg] - rotor * (2.0 * np.pi / 0.005) ** 2
        mass = rest + parameters["motor.rotor_inertia"] * (2.0 * np.pi / 0.005) ** 2
        assert figures["lag", leg].value == pytest.approx(droop * mass, rel=1e-9)
    random = np.random.default_rng(0)
    names = [(each.name, each.leg) for each in found.values]
    drawn = random.multivariate_normal([each.value for each in found.values], found.covariance, 4000)
    droops = (drawn[:, names.index(("motor.resistance", 2))] - 0.3) / constant**2
    masses = rest + drawn[:, names.index(("motor.rotor_inertia", None))] * (2.0 * np.pi / 0.005) ** 2
    assert figures["droop", 2].sigma == pytest.approx(droops.std(), rel=0.05)
    assert figures["lag", 2].sigma == pytest.approx((droops * masses).std(), rel=0.05)


@pytest.mark.slow
def test_intervals_hold_with_noise_that_is_correlated(hexapod, commands, ideal, true):
    names = ("motor.resistance", "friction.coulomb", DELAY)
    found = identify_actuators(known(hexapod, true, *names), IMU, measured(commands, ideal, 2, correlation=0.95), names)
    errors = [(each.value - true_value(true, each)) / each.sigma for each in found.values]
    assert worst(found, true) < 4.0 and 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.6


@pytest.mark.slow
def test_viscous_friction_goes_with_the_gain(hexapod, commands, ideal, true):
    names = ("drive.gain", "friction.viscous")
    mechanism = known(hexapod, true, *names)
    found = identify_actuators(mechanism, IMU, measured(commands, ideal, 3), names)
    (line,) = found.remarks
    assert line.startswith("friction.viscous, leg") and "as drive.gain, leg" in line and "data sheet" in line


@pytest.mark.slow
def test_lost_stale_and_absent_sensors_are_left_out(hexapod, commands, ideal, true):
    given = measured(commands, ideal, 4)
    given.readings.imus[:, :, 3] = np.nan
    given.readings.imus[100:140, 1, 6] = np.nan
    given.readings.imus[200:300, :, 5] = 1e3
    given.fresh[200:300, 5] = False
    names = ("motor.resistance", "friction.coulomb", DELAY)
    assert worst(identify_actuators(known(hexapod, true, *names), IMU, given, names), true) < 4.0


@pytest.mark.slow
def test_encoders_count_beside_the_imus(hexapod, commands, ideal, true):
    given = measured(commands, ideal, 6)
    lengths = ideal.lengths + 0.17 + np.random.default_rng(6).normal(0.0, 2e-6, ideal.lengths.shape)
    names = ("drive.gain", "motor.resistance", DELAY)
    fixed = known(hexapod, true, *names)
    alone = identify_actuators(fixed, IMU, given, names)
    both = identify_actuators(fixed, IMU, replace(given, readings=replace(given.readings, lengths=lengths)), names)
    assert worst(both, true) < 4.0
    assert both.values[-1].name == DELAY and both.values[-1].sigma < 0.5 * alone.values[-1].sigma


def test_samples_are_compared_at_their_own_times(hexapod, commands, ideal):
    """Of IMUs with clocks of their own: the readings are those of a plant that is read there, and exchanges are no other."""
    part = commands.until(0.4)
    ages = np.tile(np.linspace(0.0, 0.9 * PERIOD_S, 7), (len(part.times), 1))
    given = replace(measured(commands, ideal, 0), ages=ages)
    with Prediction(hexapod, load_imu("ideal"), PERIOD_S) as prediction:
        fit = identification._Fit(prediction, given, USUAL, Doubts())
        found = fit._model(fit._at, part).imus
        fine = np.sort(np.concatenate([part.times, (part.times - ages[:, 4])[1:]]))
        read = prediction.readings(part, {}, hexapod.require_home(), 0.0, fine).imus
    for imu, exact in ((0, read[::2]), (4, read[1::2])):
        error, size = (each[10:, :, imu].std(axis=(0, 2)) for each in (found[-len(exact) :] - exact, exact))
        assert (error < 0.01 * size).all()


def test_the_prediction_is_that_of_the_fmu_step_by_step(hexapod):
    """With a delay that is no multiple of the period, against an FMU that is called from Python."""
    times = np.cumsum([0.0, 0.004, 0.004, 0.005, 0.003, 0.009, 0.004])
    velocities = np.random.default_rng(0).normal(0.0, 0.02, (7, 6))
    prediction = Prediction(hexapod, load_imu("ideal"), 0.004)
    home, changed = hexapod.require_home(), {"motor.inductance": 8e-4, "drive.gain": np.linspace(0.9, 1.1, 6)}
    found = prediction.readings(Commands(times, velocities), changed, home, 0.0055)
    prediction.close()
    plant = FmuPlant(default_fmu(SPATIAL_MODEL), {**hexapod.plant_parameters(home), **changed}, 0.004)
    try:
        plant.set("drive_mode", np.full(6, VELOCITY))
        now = 0.0
        moments = sorted({*times, *(times + 0.0055)})
        for at in moments:
            if at > times[-1]:
                break
            if at > now:
                plant.step(at - now)
                now = at
            if at == 0.0:
                plant.set("velocity_command", velocities[0])
            for number in np.flatnonzero(np.abs(times + 0.0055 - at) < 1e-12):
                plant.set("velocity_command", velocities[number])
            for number in np.flatnonzero(times == at):
                np.testing.assert_allclose(found.imus[number, 0], plant.get("imu_angular_velocity"), rtol=0.0, atol=1e-9)
                np.testing.assert_allclose(found.imus[number, 1], plant.get("imu_specific_force"), rtol=0.0, atol=1e-7)
                np.testing.assert_allclose(found.lengths[number], plant.get("motor_length"), rtol=0.0, atol=1e-12)
    finally:
        plant.close()


def test_a_model_without_errors_keeps_the_low_passes():
    clean = without_errors(load_imu("mpu9150-nominal"))
    assert clean.gyroscope.bandwidth == 256.0 and clean.accelerometer.reach == load_imu("mpu9150").accelerometer.reach
    assert (clean.gyroscope.noise, clean.accelerometer.bias, clean.sample_rate, clean.jitter) == (0.0, (0.0, 0.0), 0.0, 0.0)
    assert clean.disturbances == () and clean.misalignment == 0.0


def test_an_autoregression_leaves_what_is_new():
    white = np.random.default_rng(0).normal(0.0, 0.3, 40_000)
    series = lfilter([1.0], [1.0, -1.2, 0.5], white)
    taken, sigma = identification._autoregression(series, 1e-9)
    assert taken[:4] == pytest.approx([1.0, -1.2, 0.5, 0.0], abs=0.02) and sigma == pytest.approx(0.3, rel=0.02)


def test_an_interval_is_of_95_percent():
    value = Value("drive.gain", 1, 1.0, 0.01)
    drawn = np.random.default_rng(0).normal(1.0, 0.01, 20_000)
    assert np.mean([value.holds(each) for each in drawn]) == pytest.approx(0.95, abs=0.005)
    assert value.half == pytest.approx(0.0196, rel=1e-3) and abs(QUANTILE - 1.96) < 1e-3


@pytest.mark.parametrize(
    ("names", "error", "said"),
    [
        ((), InputError, "fit are none"),
        ((DELAY, DELAY), InputError, "name each once"),
        (("motor.resistence",), UnknownNameError, "did you mean 'motor.resistance'"),
    ],
)
def test_names_that_cannot_be_fitted_are_refused(hexapod, commands, ideal, names, error, said):
    with pytest.raises(error, match=said):
        identify_actuators(hexapod, IMU, measured(commands, ideal, 0), names)


def test_first_values_and_data_are_checked(hexapod, commands, ideal):
    frictionless = replace(hexapod, plant={**hexapod.plant, "friction.coulomb": np.zeros(6)})
    with pytest.raises(InputError, match=r"friction.coulomb is 0 in the mechanism's file: give a first value"):
        identify_actuators(frictionless, IMU, measured(commands, ideal, 0))
    given = measured(commands, ideal, 0)
    given.fresh[:] = False
    with pytest.raises(CalibrationError, match="no sensor has 200 readings"):
        identify_actuators(hexapod, IMU, given)


@pytest.mark.slow
def test_a_machine_unlike_its_model_is_told(hexapod, commands, ideal, true):
    """What remains is held against the noise at rest; here all joints are a centimetre off."""
    rest = np.tile(np.array(NOISES)[:, None, None], (1, 7, 3))
    moved = known(hexapod, true).moved_joints(np.random.default_rng(0).normal(0.0, 0.01, (2, 6, 3)))
    right, wrong = (
        identify_actuators(each, IMU, measured(commands, ideal, 7, rest=rest), (DELAY,))
        for each in (known(hexapod, true), moved)
    )
    assert right.unexplained == pytest.approx(1.0, abs=0.05) and right.remarks == ()
    assert wrong.unexplained > 1.5 and "times the noise at rest" in wrong.remarks[-1]
