"""A short linear model, and data drawn from it."""

import numpy as np
import pytest

from controller.planning.target import load_target
from hil.studies.detectability.kinematics import motion_along
from hil.studies.detectability.model import DATA, STATES, linear_model
from hil.studies.detectability.uncertainty import Uncertainty
from plant.imu import load_imu
from plant.mechanism import load_spatial

STEP_S = 0.02


@pytest.fixture(scope="session")
def hexapod():
    return load_spatial("hexapod")


@pytest.fixture(scope="session")
def short_model(hexapod):
    """Of 60 steps along `sines`, from its rest on."""
    target = load_target("sines", hexapod, 2.0)
    motion = motion_along(target, hexapod, STEP_S * (np.arange(60) + 0.5) - 0.2)
    return linear_model(hexapod, motion, load_imu("mpu9150-calibrated"), 1000.0, Uncertainty(), STEP_S)


def draw(model, columns, seed):
    """Data (M, 48, C) as the model says that they come about, and the pose's errors (M, 6, C)."""
    random = np.random.default_rng(seed)
    # The driving noise has one cause for three states of each axis of the pose.
    values, vectors = np.linalg.eigh(model.driving)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    state = np.sqrt(model.prior)[:, None] * random.standard_normal((STATES, columns))
    data, poses = np.empty((len(model.sensitivity), DATA, columns)), np.empty((len(model.sensitivity), 6, columns))
    for n, seen in enumerate(model.sensitivity):
        data[n] = seen @ state + np.sqrt(model.noise)[:, None] * random.standard_normal((DATA, columns))
        poses[n] = state[:6]
        state = model.transition @ state + root @ random.standard_normal((STATES, columns))
    return data, poses
