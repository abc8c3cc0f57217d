"""Made-up readings of a hexapod: an imposed motion with the noise that the fault filter assumes, and faults of one's own."""

from dataclasses import dataclass

import numpy as np

from controller.cycle import STATE, cycle_parameters
from controller.estimation.integrity.fault_filter import begin_anew, bridge_gap, step_fault_filter
from controller.settings import control_settings, fusion_settings
from plant.dynamics.imposed_motion import impose
from plant.mechanism import load_spatial
from plant.pose import rotation_from_vector

RATE_HZ = 500.0


@dataclass
class Readings:
    """Samples (N, 3, 7, 3) along a motion (N, 3), (N, 3, 3), and what each leg should do (N, 6, 3)."""

    samples: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray
    legs: np.ndarray


def readings(kind="0.5", duration=3.0, seed=0, noise=1.0, preset="hexapod"):
    """Readings with white noise, times what the filter assumes."""
    mechanism = load_spatial(preset)
    motion = impose(mechanism, kind, duration, RATE_HZ, seed)
    fusion, random = fusion_settings(mechanism), np.random.default_rng([seed, 1])
    samples = np.array(motion.signals)
    for sensor, density in enumerate((fusion.mechanism_gyroscope_noise, fusion.mechanism_accelerometer_noise)):
        samples[:, sensor] += noise * density * np.sqrt(RATE_HZ / 2.0) * random.normal(size=samples[:, sensor].shape)
    arms = np.einsum("nij,kj->nki", motion.rotations, mechanism.platform_joints)
    lengths = np.linalg.norm(motion.positions[:, None] + arms - mechanism.base_joints, axis=2)
    rates = np.gradient(lengths, axis=0) * RATE_HZ
    legs = np.stack([lengths, rates, np.gradient(rates, axis=0) * RATE_HZ], axis=2)
    return mechanism, Readings(samples, motion.positions, motion.rotations, legs)


def constants(mechanism, **changes):
    """Parameters and state of a cycle."""
    parameters = cycle_parameters(
        mechanism, RATE_HZ, control_settings(mechanism), fusion_settings(mechanism, **changes), whole="accelerometers"
    )
    state = np.zeros((), STATE)
    state["imus"]["healthy"] = 1
    return parameters, state


def filtered(mechanism, r, parameters, state, off=(0.0,) * 6, count=None, missed=None, then=lambda: None):
    """Run the fault filter over readings, around poses that are `off` (6,) or (N, 6) the true ones [m, rad]; returns how many
    windows.

    `missed` says by number before which samples how many others are missed; `then` is called after each window.
    """
    p, s = parameters[()], state[()]
    taken = gap = 0
    offs = np.broadcast_to(off, (len(r.samples), 6))
    gaps = missed or {}
    lost = {k for i, n in gaps.items() for k in range(i - n, i)}
    for i in range(len(r.samples) if count is None else count):
        if i in lost:
            gap += 1
            continue
        s["imus"]["sample"] = r.samples[i]
        s["pose"]["position"] = r.positions[i] + offs[i, :3]
        s["pose"]["rotation"] = rotation_from_vector(offs[i, 3:].copy()) @ r.rotations[i]
        place_legs(mechanism, s["pose"])
        s["reference"]["motion"] = r.legs[i]
        f = s["integrity"]["filter"]
        legs = s["reference"]["motion"]
        if gap > 0 and not bridge_gap(p["integrity"]["filter"], f, gap):
            begin_anew(f)
        gap = 0
        took = step_fault_filter(
            p["integrity"]["filter"], f, p["rig"]["sensors"], s["imus"], s["pose"], legs, legs[:, 1].copy()
        )  # fmt: skip
        taken += took
        if took:
            then()
    return taken


def place_legs(mechanism, pose):
    """Write arms, directions and lengths of a pose."""
    arms = mechanism.platform_joints @ pose["rotation"].T
    legs = pose["position"] + arms - mechanism.base_joints
    pose["arms"], pose["lengths"] = arms, np.linalg.norm(legs, axis=1)
    pose["directions"] = legs / pose["lengths"][:, None]
