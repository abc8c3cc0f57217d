"""Signs and units of commands, gyroscopes and accelerometers, found by small motions; on a virtual clock."""

import numpy as np
import pytest

from hil.rigs import ENABLED
from hil.rigs.contract import LEG_SPEED, LEG_STROKE_S, examine_rig
from hil.rigs.template import TemplateRig
from plant.imu import imu_state, load_imu, measure
from plant.imu.presets import imu_of_table
from plant.mechanism import load_spatial

PERIOD = 0.005
HEXAPOD = load_spatial("hexapod")
pytestmark = pytest.mark.usefixtures("virtual_time")
GYROSCOPE, ACCELEROMETER = 0, 1
# The widest low-pass below half of this rate.
NARROW = imu_of_table({"based_on": "mpu9150-calibrated", "low_pass": 2}, "narrow", "narrow.toml")


class Miswired(TemplateRig):
    """The template with IMUs as they are sold, and with factors on commands and readings; like hardware, it knows no truth."""

    def __init__(self, command=1.0, gyroscope=1.0, accelerometer=1.0, seed=3, imu=NARROW, start=0.0, encoder=1.0):
        super().__init__(HEXAPOD, PERIOD, None)
        self.factors, self.start, self.moved, self.encoder = (command, gyroscope, accelerometer), start, np.zeros(6), encoder
        self.imu, self.read = imu_state(imu, seed, PERIOD), np.zeros((3, 7, 3))

    def open(self):
        super().open()
        self._hardware.lengths = self._hardware.lengths + self.start
        self.home = self._hardware.lengths

    def exchange(self, command, request, feedback):
        by, turned, tilted = self.factors
        # As a drive of another scale: what is sent is reported in its own unit.
        status = super().exchange(by * command, request, feedback)
        feedback["sent"] = command if request == ENABLED else 0.0
        self.moved = np.maximum(self.moved, abs(self._hardware.lengths - self.home))
        measure(self.imu, self._hardware.signals, self.read)
        feedback["measurement"] = self.read
        feedback["measurement"][GYROSCOPE] *= turned
        feedback["measurement"][ACCELEROMETER] *= tilted
        feedback["length"] *= self.encoder
        feedback["truth"] = np.nan
        return status


def examined(**wrong):
    rigs = []

    def make():
        rigs.append(Miswired(**wrong))
        return rigs[-1]

    return examine_rig(make, PERIOD, mechanism=HEXAPOD).findings, rigs[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "rig",
    [
        {"imu": load_imu("mpu9150"), "seed": 1},
        *(
            pytest.param(each, marks=pytest.mark.slow)
            for each in (
                {},
                {"imu": load_imu("ideal")},
                {"imu": load_imu("mpu9150-calibrated")},
                {"start": np.array([5, -5, 8, -8, 5, -5]) * 1e-3},
                {"command": 1.3},
            )
        ),
    ],
)
def test_a_sound_rig_has_no_findings(rig):
    found, made = examined(**rig)
    assert [text for each in found.values() for text in each] == []
    assert {"gravity", "commands", "gyroscopes", "accelerometers"} <= set(found)
    assert (made.moved < 1.5 * LEG_SPEED * LEG_STROKE_S + 0.5e-3).all()


def only(count, *where, value):
    factors = np.ones(count)
    factors[where] = value
    return factors


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong, clause, count, text",
    [
        ({"command": -1.0}, "commands", 6, "Leg 0 moved by -"),
        ({"command": only(6, 4, value=-1.0)}, "commands", 1, "Leg 4 moved by -"),
        ({"command": only(6, 2, value=0.3)}, "commands", 1, "Leg 2 moved by 0."),
        ({"gyroscope": np.degrees(1.0)}, "gyroscopes", 6, "The gyroscope of IMU 0 reads other turns"),
        ({"gyroscope": -1.0}, "gyroscopes", 7, "The gyroscope of IMU 0 reads other turns than the motion makes, -1"),
        ({"gyroscope": only((7, 3), 3, slice(None), value=-1.0)}, "gyroscopes", 1, "The gyroscope of IMU 3 reads"),
        ({"gyroscope": only((7, 3), 6, 0, value=-1.0)}, "gyroscopes", 1, "times about x: check"),
        ({"accelerometer": -1.0}, "gravity", 7, "The specific force of IMU 0 points 180 deg away"),
        ({"accelerometer": only((7, 3), 6, 1, value=-1.0)}, "accelerometers", 1, "times along y: check"),
    ],
)
def test_a_wrong_sign_or_unit_is_told_where_it_is(wrong, clause, count, text):
    found, rig = examined(**wrong)
    told = {name: texts for name, texts in found.items() if texts and not texts[0].startswith("The motion was stopped")}
    assert list(told) == [clause]
    assert len([each for each in told[clause] if not each.startswith("The motion was stopped")]) == count
    assert any(text in each for each in told[clause])
    assert (rig.moved < 3e-3).all()


def test_commands_in_another_unit_are_stopped_at_once_and_told():
    found, rig = examined(command=1e3)
    assert any("The motion was stopped: IMU" in text for text in found["commands"])
    assert any("All legs moved by" in text for text in found["commands"])
    # A drive's own limit is 0.35 m/s; 0.2 s of it would be 70 mm.
    assert (rig.moved < 20e-3).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factors", "texts"),
    [
        (np.array([1, 1, -1, 1, 1, 1]), ["The encoder of leg 2 reads -"]),
        (np.full(6, 1e3), [f"The encoder of leg {k} reads " for k in range(6)]),
        (np.array([1, np.nan, np.nan, np.nan, 1, 0.1]), ["The encoder of leg 5 reads 0."]),
        (np.full(6, np.nan), []),
    ],
)
def test_an_encoder_with_a_wrong_sign_or_unit_is_named(factors, texts):
    found, _ = examined(encoder=factors)
    assert {clause for clause, each in found.items() if each} == ({"encoders"} if texts else set())
    for text, told in zip(texts, found.get("encoders", []), strict=True):
        assert told.startswith(text) and told.endswith("check its sign and its unit.")
