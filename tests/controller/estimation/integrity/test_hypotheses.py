"""The hypotheses: their directions beside the errors that they stand for, and which of them explains what."""

import numpy as np
import pytest

from controller.estimation.integrity import hypotheses
from controller.estimation.integrity.hypotheses import (
    FAULTS,
    HYPOTHESES,
    OF_ONE_IMU,
    Kind,
    directions_of,
    evidence_for,
    imu_of,
    kind_of,
)
from controller.estimation.integrity.stage import STEPS, step_integrity
from controller.estimation.whole_mechanism.readings import find_frames
from plant.pose import rotation_from_vector
from tests.controller.estimation.integrity.made_up import constants, place_legs, readings

NATURAL = np.arange(7)


def number_of(kind, imu=None):
    return 7 * kind + imu if kind < OF_ONE_IMU else 7 * OF_ONE_IMU + kind - OF_ONE_IMU


def test_every_number_is_one_kind_and_perhaps_one_imu():
    seen = {(Kind(kind_of(h)), imu_of(h)) for h in range(HYPOTHESES)}
    of_one = {(kind, k) for kind in list(Kind)[:OF_ONE_IMU] for k in range(7)}
    assert seen == of_one | {(kind, -1) for kind in list(Kind)[OF_ONE_IMU:]}
    assert all(number_of(*pair) == h for h in range(HYPOTHESES) for pair in [(kind_of(h), imu_of(h))])


def scratch_at(mechanism, position, rotation):
    parameters, state = constants(mechanism)
    s = state["integrity"]
    s["filter"]["path"]["position"], s["filter"]["path"]["rotation"] = position, rotation
    find_frames(parameters["rig"]["sensors"][()], position, rotation, s["hypotheses"]["frames"])
    return s


def test_a_turned_mounting_turns_what_is_read():
    mechanism, r = readings("0.5", 1.0, 0, noise=0.0)
    s = scratch_at(mechanism, r.positions[-1], r.rotations[-1])
    s["filter"]["predicted"] = np.concatenate([r.samples[-1, 0], r.samples[-1, 1]], axis=1)
    angle = 1e-5 * np.array([0.3, -0.7, 0.5])
    for k in range(7):
        d = s["hypotheses"]["directions"]
        assert directions_of(number_of(Kind.MOUNTING, k), s["hypotheses"]["frames"], s["filter"]["predicted"], NATURAL, d) == 3
        turned = np.concatenate([rotation_from_vector(-angle) @ r.samples[-1, sensor, k] for sensor in range(2)])
        expected = np.zeros(FAULTS)
        expected[6 * k : 6 * k + 6] = turned - s["filter"]["predicted"][k]
        np.testing.assert_allclose(angle @ d[:3], expected, atol=1e-8)


def test_a_base_that_accelerates_adds_one_vector_of_its_frame_to_all():
    """Seen by IMUs that read nothing but gravity: turning gravity in {1} changes all of them by the frames."""
    mechanism, r = readings("static", 0.2, 3, noise=0.0)
    s = scratch_at(mechanism, r.positions[0], r.rotations[0])
    frames, d = s["hypotheses"]["frames"], s["hypotheses"]["directions"]
    for k in range(7):
        np.testing.assert_allclose(frames[k] @ frames[k].T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(frames[k] @ [0.0, 0.0, 9.81], r.samples[0, 1, k], atol=1e-6)
    directions_of(number_of(Kind.BASE_FORCE), frames, s["filter"]["predicted"], NATURAL, d)
    force = np.array([0.2, -0.1, 0.4])
    found = (force @ d[:3]).reshape(7, 2, 3)
    np.testing.assert_allclose(found[:, 1], frames @ force, atol=1e-12)
    assert not found[:, 0].any()


@pytest.mark.parametrize("rank", [6, 3])
def test_the_evidence_is_the_greatest_of_the_likelihood(rank):
    random = np.random.default_rng(rank)
    root = random.normal(size=(FAULTS, FAULTS))
    weight, vector = root @ root.T, random.normal(size=FAULTS)
    t = np.zeros((), hypotheses.SCRATCH)
    chosen = random.normal(size=(rank, FAULTS))
    t["directions"] = (random.normal(size=(6, rank)) @ chosen) if rank < 6 else chosen
    d = t["directions"]
    expected = (d @ vector) @ np.linalg.pinv(d @ weight @ d.T, rcond=1e-10) @ (d @ vector)
    assert evidence_for(6, 0, 42, weight, vector, t[()]) == pytest.approx(expected, rel=1e-6)
    assert evidence_for(6, 0, 42, 0.0 * weight, 0.0 * vector, t[()]) == 0.0


def all_steps(mechanism, r, parameters, state):
    """The whole stage over readings; returns the best hypothesis of the last evaluation."""
    p, s = parameters[()], state[()]
    for i in range(len(r.samples)):
        s["imus"]["sample"] = r.samples[i]
        s["pose"]["position"], s["pose"]["rotation"] = r.positions[i], r.rotations[i]
        place_legs(mechanism, s["pose"])
        s["reference"]["motion"] = r.legs[i]
        legs = s["reference"]["motion"]
        step_integrity(
            p["integrity"], s["integrity"], p["rig"], s["time"], s["imus"], s["pose"], legs, legs[:, 1].copy()
        )  # fmt: skip
        s["time"]["cycle"] += 1
    return s["integrity"]


FAULTY = {
    "gyroscope 1": (number_of(Kind.GYROSCOPE, 1), lambda x: np.add.at(x, np.s_[:, 0, 1, 2], 0.05)),
    "accelerometer 4": (number_of(Kind.ACCELEROMETER, 4), lambda x: np.add.at(x, np.s_[:, 1, 4, 0], 0.5)),
    "all gyroscopes": (number_of(Kind.ALL_GYROSCOPES), lambda x: np.add.at(x, np.s_[:, 0, :, 0], 0.02)),
    "all accelerometers": (number_of(Kind.ALL_ACCELEROMETERS), lambda x: np.add.at(x, np.s_[:, 1, :, 1], 0.5)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTY)
def test_what_comes_up_is_explained_by_its_own_hypothesis(name):
    expected, spoil = FAULTY[name]
    mechanism, r = readings("0.5", 4.0, 7)
    spoil(r.samples[1750:])
    parameters, state = constants(mechanism)
    found = all_steps(mechanism, r, parameters, state)
    assert found["evaluations"] > 30
    if expected < 7 * OF_ONE_IMU:
        assert imu_of(int(found["best"])) == imu_of(expected)
        assert found["found"][expected] > 0.9 * found["best_evidence"]
    else:
        assert found["best"] == expected
    assert found["best_evidence"] > 100.0
    assert found["rival_evidence"] < 0.7 * found["best_evidence"]
    assert found["all_evidence"] >= found["best_evidence"]


@pytest.mark.slow
def test_sound_readings_are_no_evidence():
    worst = 0.0
    for seed, kind in enumerate(("static", "0.2", "1", "mixed")):
        mechanism, r = readings(kind, 4.0, seed)
        parameters, state = constants(mechanism)
        worst = max(worst, float(all_steps(mechanism, r, parameters, state)["best_evidence"]))
    assert 0.0 < worst < 30.0


def test_an_evaluation_is_spread_over_its_cycles():
    mechanism, r = readings("0.5", 1.0, 8)
    parameters, state = constants(mechanism)
    p, s = parameters[()], state[()]
    steps = []
    for i in range(len(r.samples)):
        before = int(s["integrity"]["step"])
        part = type(r)(*(each[i : i + 1] for each in vars(r).values()))
        all_steps(mechanism, part, parameters, state)
        steps.append((int(s["integrity"]["step"]) - before) % STEPS)
    assert max(steps) <= -(-STEPS // (int(p["integrity"]["cycles"]) - int(p["integrity"]["filter"]["window"]))) + 1
