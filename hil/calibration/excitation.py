"""The motions of a calibration within all limits of the mechanism, and limits that a user sets: how far from home, how fast,
and with which force.

They begin and end at home. What they are worth is known before anything moves: by ideal readings at the poses to rest at.
"""

from dataclasses import dataclass, replace
from math import inf

import numpy as np

from controller.calibration.at_rest import Rests, calibrate_at_rest, pose_covariance
from controller.calibration.mounting_checks import LEAST_RATE, LEAST_SPREAD, spreads_of
from controller.direct_kinematics import poses_from_lengths
from controller.inverse_kinematics import leg_lengths
from controller.planning.motions import EVERYWHERE, REST_S, Box, Poses, rests, shaking
from controller.planning.target import Target
from controller.settings import sensor_settings
from controller.workspace import LIMITS, Demands, check_against_limits, margins
from hil.calibration.data import Knowledge, measured_lengths
from hil.calibration.drives import within_drives
from hil.rigs.contract import LEG_SPEED, LEG_STROKE_S
from hil.rigs.kinematic import ideal_signals
from plant.errors import InputError
from plant.imu import load_imu
from plant.mechanism import Mechanism
from plant.pose import Array, Pose, vector_from_rotation

PROBING_S, SHAKING_S = 4.0, 40.0
NEAR_RESTS, WIDE_RESTS = 8, 20
_AT_REST_S, _WAY = 1.5, 1.4
"""Least time at a pose to rest at [s], and the time of the way to it over that at the limit of speed."""
_USED = 0.9
"""Share of the box to which the motions lead unless something else ends them."""
_PROBING_SHARE, _PROBING_RATE = 0.3, np.radians(2.0)
"""Of the shaking, as far as some IMU turns at this rate (RMS) [rad/s]."""


@dataclass(frozen=True)
class MotionLimits:
    """What a calibration may do: the platform's way from home, a leg's speed [m/s] and its force [N]."""

    box: Box = EVERYWHERE
    speed: float = inf
    force: float = inf

    def __post_init__(self) -> None:
        given = (
            ("--box", 1e3 * self.box[0], "mm"), ("--box", np.degrees(self.box[1]), "deg"),
            ("--speed", 1e3 * self.speed, "mm/s"), ("--force", self.force, "N"),
        )  # fmt: skip
        for name, value, unit in given:
            if not value > 0.0:
                raise InputError(f"{name} is {value:g} {unit}; it must be positive")


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Expected standard deviations of the pose after the rests, over the whole workspace [m, rad]."""

    position: float
    rotation: float


def gentle_mechanism(mechanism: Mechanism, limits: MotionLimits) -> Mechanism:
    """The mechanism with limits of speed and acceleration that keep to what a user and the drives allow; itself if its own do.

    Raises:
        InputError: the drives, or the limits, leave nothing for a motion.
    """
    own = mechanism.require_limits()
    slow = mechanism if limits.speed >= own.velocity else replace(mechanism, limits=replace(own, velocity=limits.speed))
    return within_drives(slow, limits.force)


def calibration_targets(mechanism: Mechanism, box: Box) -> dict[str, Target]:
    """The motions of a calibration within the mechanism's limits and a box, by name; each begins and ends at home."""
    shaken = Target("shaking", *shaking(mechanism, SHAKING_S, box=box, back=True))
    share = min(max(_PROBING_SHARE, _PROBING_RATE / _rate(mechanism, shaken)), 1.0)
    return {
        "probing": Target("probing", *shaking(mechanism, PROBING_S, share, box, back=True)),
        "near-rests": _resting(mechanism, "near-rests", rests(mechanism, NEAR_RESTS * REST_S, 0.4, 0.5, box)),
        "rests": _resting(mechanism, "rests", rests(mechanism, WIDE_RESTS * REST_S, box=box)),
        "shaking": shaken,
    }


def _resting(mechanism: Mechanism, name: str, poses: Poses) -> Target:
    """Poses to rest at, and then at the first again; slow legs take longer from one to the next."""
    _, positions, rotations = poses
    homes = (np.repeat(each[:1], 2, axis=0) for each in (positions, rotations))
    positions, rotations = (np.concatenate(each) for each in zip((positions, rotations), homes, strict=True))
    longest = np.abs(np.diff(leg_lengths(mechanism, positions, rotations), axis=0)).max()
    each = max(REST_S, _AT_REST_S + _WAY * longest / mechanism.require_limits().velocity)
    return Target(name, each * np.arange(len(positions)), positions, rotations, held=True)


def extent(target: Target) -> tuple[float, float]:
    """How far a motion leads from its first pose [m, rad]."""
    moved = np.linalg.norm(target.positions - target.start.position, axis=1)
    turned = np.linalg.norm(vector_from_rotation(target.rotations @ target.start.rotation.T), axis=1)
    return float(moved.max()), float(turned.max())


def cut_of_box(mechanism: Mechanism, targets: dict[str, Target], box: Box) -> str:
    """To what limits of the mechanism cut the box, and which one, in words; "" if the motions lead to its edge."""
    moved, turned = (max(each) for each in zip(*map(extent, targets.values()), strict=True))
    if moved >= _USED * box.position and turned >= _USED * box.rotation:
        return ""
    home = mechanism.require_home()
    positions = np.concatenate([home.position[None], *(each.positions for each in targets.values())])
    rotations = np.concatenate([home.rotation[None], *(each.rotations for each in targets.values())])
    at_home, *away = margins(mechanism, positions, rotations).values
    # Of what home leaves of each limit, the part that is left.
    shares = np.divide(np.min(away, axis=0), at_home, out=np.full(len(LIMITS), inf), where=np.isfinite(at_home))
    closest = LIMITS[int(shares.argmin())].text
    return f"{1e3 * moved:.3g} mm and {np.degrees(turned):.2g} deg, mainly by the limit of the {closest}"


def check_within(mechanism: Mechanism, targets: dict[str, Target], demands: Demands) -> None:
    """Check that the trial of the legs, and what is planned for each motion, stay within all limits of the mechanism.

    Raises:
        InputError: one does not; the message says which, where, and what to do.
    """
    home, tried = mechanism.require_home(), LEG_SPEED * LEG_STROKE_S
    lengths = leg_lengths(mechanism, home.position, home.rotation) + tried * np.eye(mechanism.legs)
    found = margins(mechanism, *poses_from_lengths(mechanism, lengths, home), demands)
    if not found.reachable.all():
        leg = int(found.reachable.argmin())
        raise InputError(
            f"home of {mechanism.name!r} is too close to a limit for the trial of leg {leg}, which extends by "
            f"{1e3 * tried:g} mm: the limit of the {LIMITS[int(found.binding[leg])].text} does not allow it: move home "
            "away from it, or widen it"
        )
    for name, target in targets.items():
        if (excess := check_against_limits(mechanism, target, float(target.times[-1]), demands).first) is not None:
            moved, turned = extent(target)
            remedy = "give a smaller --box" if excess.time > 0.0 else "move home away from this limit, or widen it"
            raise InputError(
                f"{name}, up to {1e3 * moved:.3g} mm and {np.degrees(turned):.2g} deg from home, cannot be planned within the "
                f"limits of {mechanism.name!r}: {excess.text}: {remedy}"
            )


def check_useful(mechanism: Mechanism, targets: dict[str, Target], box: Box) -> None:
    """Check that the motions move the IMUs enough for a calibration.

    Raises:
        InputError: the limits are too narrow; the message says by which factor, or which limit of the mechanism it is.
    """
    for name in ("near-rests", "rests"):
        spread = float(spreads_of(_readings(mechanism, targets[name])[:, :, 3:]).max())
        if spread < 1.2 * LEAST_SPREAD:
            few = f"between any two poses of {name}, no IMU would turn by more than {np.degrees(spread):.2g} deg, and "
            few += f"{1.2 * np.degrees(LEAST_SPREAD):.2g} are needed"
            if cut := cut_of_box(mechanism, targets, box):
                raise InputError(
                    f"{mechanism.name!r} has too little room for a calibration: {few}; its limits cut the --box to {cut}: move "
                    "home away from that limit, or widen it"
                )
            raise InputError(f"--box is too small: {few}: make it about {1.2 * LEAST_SPREAD / spread:.2g} times as large")
    least = min(_rate(mechanism, targets[name]) for name in ("probing", "shaking"))
    if least < 1.2 * LEAST_RATE:
        raise InputError(
            f"--box or --speed is too small: the IMUs would turn at {np.degrees(least):.2g} deg/s RMS, and "
            f"{1.2 * np.degrees(LEAST_RATE):.2g} are needed to tell them from their noise: make it about "
            f"{1.2 * LEAST_RATE / least:.2g} times as large"
        )


def _readings(mechanism: Mechanism, target: Target) -> Array:
    """Ideal readings (N, 7, 6) at rest at each pose of a target."""
    signals, still = ideal_signals(mechanism), np.zeros(6)
    poses = zip(target.positions, target.rotations, strict=True)
    return np.array([np.concatenate(signals(Pose(*pose), still, still)[:2], axis=1) for pose in poses])


def _rate(mechanism: Mechanism, target: Target) -> float:
    """The RMS rate of the IMU that turns most [rad/s]."""
    signals, still = ideal_signals(mechanism), np.zeros(6)
    turns = vector_from_rotation(target.rotations @ target.start.rotation.T)
    twists = np.gradient(np.hstack([target.positions, turns]), target.times, axis=0)
    poses = zip(target.positions, target.rotations, twists, strict=True)
    rates = np.array([signals(Pose(position, rotation), twist, still)[0] for position, rotation, twist in poses])
    return float(np.sqrt((rates**2).sum(axis=2).mean(axis=0)).max())


def expected_accuracy(mechanism: Mechanism, resting: Target, knowledge: Knowledge) -> Accuracy:
    """What the poses of `resting` would be worth: the accuracy of poses in the whole workspace after a calibration at them."""
    lengths = None
    if knowledge.encoder is not None:
        exact = leg_lengths(mechanism, resting.positions, resting.rotations)
        fusion = sensor_settings(mechanism, load_imu("ideal"), 1.0 / REST_S, knowledge.encoder)
        lengths = measured_lengths(exact, np.zeros(len(exact)), fusion)
    found = calibrate_at_rest(mechanism, Rests(_readings(mechanism, resting), knowledge.home, lengths), knowledge.prior)
    _, positions, rotations = rests(mechanism, WIDE_RESTS * REST_S)
    poses = zip(positions, rotations, strict=True)
    covariance = np.mean([pose_covariance(mechanism, found.tilt, pose, found.covariance) for pose in poses], axis=0)
    return Accuracy(*(float(np.sqrt(np.trace(part))) for part in (covariance[:3, :3], covariance[3:, 3:])))
