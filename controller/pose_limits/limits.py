"""Everything that limits a pose: the limits by name, and what the kernels read of a mechanism and of what is asked of it."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from controller import load_feed_forward
from controller.direct_kinematics.geometry import geometry_of
from controller.inverse_kinematics import inverse_kinematics
from controller.load_feed_forward import load_parameters
from controller.safety.causes import Cause
from controller.settings import safety_settings
from plant.compiled import Record, filled, record_dtype
from plant.dynamics.variables import TINY
from plant.errors import InputError
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import LEGS, Mechanism, Plate, six_rows
from plant.mechanism.checks import SAME_JOINT_M
from plant.mechanism.loads import force_constant, moving_axes
from plant.pose import Array, checked_array

KINDS = (
    "stroke", "base swing", "platform swing", "legs", "base plate", "platform plate", "speed", "force", "Jacobian",
    "direct kinematics",
)  # fmt: skip
"""What may limit a pose."""
UNITS = ("m", "rad", "rad", "m", "m", "m", "m/s", "N", "1", "1")
"""The unit of a margin, by kind."""

LEAST_JACOBIAN = 1e-3
"""Least conditioning of the Jacobian that counts as reachable."""

PAIRS = tuple((i, j) for i in range(LEGS) for j in range(i + 1, LEGS))

STROKE, BASE_SWING, PLATFORM_SWING, BETWEEN = 0, LEGS, 2 * LEGS, 3 * LEGS
BASE_PLATE = BETWEEN + len(PAIRS)
PLATFORM_PLATE, SPEED, FORCE, JACOBIAN = BASE_PLATE + LEGS, BASE_PLATE + 2 * LEGS, BASE_PLATE + 3 * LEGS, BASE_PLATE + 4 * LEGS
DIRECT_KINEMATICS = JACOBIAN + 1
COUNT = DIRECT_KINEMATICS + 1
"""Where the margins of each kind begin in a row of all, and how many there are."""


@dataclass(frozen=True)
class Limit:
    """One limit: its kind, one of `KINDS`, the leg or the two legs that it is of, if any, and the unit of its margin."""

    kind: str
    legs: tuple[int, ...]
    unit: str

    @property
    def text(self) -> str:
        """The limit in words, such as "stroke of leg 3"."""
        if self.kind == "legs":
            return f"legs {self.legs[0]} and {self.legs[1]}"
        if self.kind.endswith("plate"):
            return f"leg {self.legs[0]} at the {self.kind}"
        if self.legs:
            return f"{self.kind} of leg {self.legs[0]}"
        return "conditioning of " + ("the Jacobian" if self.kind == "Jacobian" else self.kind)


def _all_limits() -> tuple[Limit, ...]:
    alone, found = [(leg,) for leg in range(LEGS)], []
    for kind, unit in zip(KINDS, UNITS, strict=True):
        of_kind = PAIRS if kind == "legs" else [()] if kind in KINDS[-2:] else alone
        found += [Limit(kind, legs, unit) for legs in of_kind]
    return tuple(found)


LIMITS = _all_limits()
"""The limits in the order of the margins of a pose."""

BEYOND: Mapping[str, Cause] = {
    "stroke": Cause.BEYOND_STROKE,
    "base swing": Cause.BASE_SWING,
    "platform swing": Cause.PLATFORM_SWING,
    "legs": Cause.TOO_CLOSE,
    "base plate": Cause.TOO_CLOSE,
    "platform plate": Cause.TOO_CLOSE,
    "speed": Cause.TOO_FAST,
    "force": Cause.TOO_HEAVY,
    "Jacobian": Cause.SINGULAR,
    "direct kinematics": Cause.ILL_CONDITIONED,
}
"""Why a streamed target that exceeds a limit of each kind is refused."""


@dataclass(frozen=True, eq=False)
class Demands:
    """What is asked of a pose, besides that the legs reach it.

    Attributes:
        twist: (6,), the velocity [m/s] of the origin of {2} and the angular velocity [rad/s], in {1}, that the legs must make;
            None asks for no speed.
        load: (6,), the force [N] and moment [Nm], in {1}, that act on the origin of {2} besides all weights.
        forces: whether the motors must hold the weights and the load; only where the mechanism has the parameters of a plant.
        conditioning: whether Jacobian and direct kinematics must be well conditioned.
        imus, magnetometer, section_5: the sensors of direct kinematics, as for `controller.imu_set.conditionings`; with None in
            place of IMUs the pose comes from elsewhere, and that conditioning does not count.
    """

    twist: Array | None = None
    load: Array = field(default_factory=lambda: np.zeros(6))
    forces: bool = True
    conditioning: bool = True
    imus: Collection[int] | None = ALL_IMUS
    magnetometer: bool = False
    section_5: bool = False

    def __post_init__(self) -> None:
        if self.twist is not None:
            object.__setattr__(self, "twist", checked_array(self.twist, (6,), "twist"))
        object.__setattr__(self, "load", checked_array(self.load, (6,), "load"))


USUAL = Demands()
"""That motors hold the weights, and good conditioning with all IMUs."""

GEOMETRY_ALONE = Demands(forces=False, conditioning=False)
"""Strokes, swings and clearances."""

PLATE = record_dtype(
    there=np.int64,
    center=(np.float64, 3),
    normal=(np.float64, 3),
    radius=np.float64,
    gap=np.float64,  # least distance of a leg's axis without the leg's radius
)

SPACE = record_dtype(
    legs=np.int64,
    planar=np.int64,
    base_joints=(np.float64, (LEGS, 3)),
    platform_joints=(np.float64, (LEGS, 3)),
    stroke=(np.float64, (LEGS, 2)),
    swinging=np.int64,  # whether any joint's swing is limited
    base_swing=(np.float64, LEGS),
    platform_swing=(np.float64, LEGS),
    base_axes=(np.float64, (LEGS, 3)),
    platform_axes=(np.float64, (LEGS, 3)),
    thick=np.int64,  # whether legs have a diameter
    radii=(np.float64, LEGS),
    ends=(np.float64, 2),
    clearance=np.float64,
    compared=(np.int64, len(PAIRS)),  # whether two legs may touch at all
    base_plate=PLATE,
    platform_plate=PLATE,
    moving=np.int64,  # whether a twist is asked for
    twist=(np.float64, 6),
    velocity=np.float64,
    loaded=np.int64,  # whether forces are limited
    load=(np.float64, 6),
    weights=load_feed_forward.PARAMETERS,
    up=(np.float64, 3),
    gravity=np.float64,
    force=np.float64,
    conditioned=np.int64,
    spread=np.float64,  # of the platform's joints, at which turns count [m]
    side=np.float64,  # sign of the Jacobian's determinant at home
    axes=(np.int64, 6),  # the components of a twist that the platform has
)
"""What the kernels read of a mechanism and of the demands."""


@lru_cache(maxsize=256)
def space_of(mechanism: Mechanism, demands: Demands) -> Record:
    """What the kernels read (dtype `SPACE`), not to be changed.

    Raises:
        InputError: no home, no stroke, or leg ends that leave nothing of a leg.
    """
    home, limits, n = mechanism.require_home(), mechanism.require_limits(), mechanism.legs
    geometry = geometry_of(mechanism)
    space = filled(
        SPACE, legs=n, planar=mechanism.planar, base_joints=geometry["base_joints"],
        platform_joints=geometry["platform_joints"],
        stroke=six_rows(limits.stroke), base_swing=np.inf, platform_swing=np.inf, velocity=limits.velocity,
        moving=demands.twist is not None, twist=np.zeros(6) if demands.twist is None else demands.twist, load=demands.load,
        up=mechanism.up_in_base, conditioned=demands.conditioning, spread=spread_of(mechanism),
    )  # fmt: skip
    if mechanism.joints is not None:
        space["swinging"] = True
        for name in ("base_swing", "platform_swing", "base_axes", "platform_axes"):
            space[name][:n] = getattr(mechanism.joints, name)
    if mechanism.bodies is not None:
        _add_bodies(space, mechanism)
    if demands.forces and mechanism.plant_is_complete:
        plant = mechanism.plant_parameters()
        space["loaded"], space["weights"] = True, load_parameters(mechanism, 0.0)
        space["gravity"] = float(np.linalg.norm(plant["gravity"]))
        space["force"] = force_constant(mechanism) * float(plant["drive.current_limit"])
    moving = moving_axes(mechanism)
    space["axes"][: len(moving)] = moving
    space["side"] = np.sign(np.linalg.det(inverse_kinematics(mechanism, home).jacobian[:, moving]))
    return space


def spread_of(mechanism: Mechanism) -> float:
    """The greatest distance of a platform joint from their centre [m], at which turns count in conditionings."""
    joints = mechanism.platform_joints
    return max(float(np.linalg.norm(joints - joints.mean(axis=0), axis=1).max()), TINY)


def _add_bodies(space: Record, mechanism: Mechanism) -> None:
    bodies = mechanism.bodies
    assert bodies is not None
    shortest = float(mechanism.require_limits().stroke[:, 0].min())
    if bodies.leg_ends.sum() >= shortest:
        raise InputError(
            f"leg_ends of {bodies.leg_ends[0]:g} and {bodies.leg_ends[1]:g} m leave nothing of a leg of {shortest:g} m: "
            "shorten them"
        )
    space["thick"], space["radii"][: mechanism.legs] = True, 0.5 * bodies.leg_diameter
    space["ends"], space["clearance"] = bodies.leg_ends, bodies.clearance
    sides = zip((mechanism.base_joints, mechanism.platform_joints), bodies.leg_ends, strict=True)
    sharing = [joints for joints, end in sides if end == 0.0]
    for number, (i, j) in enumerate(PAIRS):
        meet = j < mechanism.legs and any(np.linalg.norm(joints[i] - joints[j]) < SAME_JOINT_M for joints in sharing)
        space["compared"][number] = j < mechanism.legs and not meet
    for name, plate in (("base_plate", bodies.base_plate), ("platform_plate", bodies.platform_plate)):
        if plate is not None:
            space[name] = _plate(plate, bodies.clearance)


def _plate(plate: Plate, clearance: float) -> Record:
    gap = 0.5 * plate.thickness + clearance
    return filled(PLATE, there=True, center=plate.center, normal=plate.normal, radius=plate.radius, gap=gap)


def scales_of(space: Record) -> Array:
    """The margin (COUNT,) that each limit has where it is farthest away, by which margins of different units compare."""
    scales = np.ones(COUNT)
    with np.errstate(invalid="ignore"):
        scales[STROKE:BASE_SWING] = 0.5 * np.maximum(np.diff(space["stroke"])[:, 0], TINY)
        scales[BASE_SWING:PLATFORM_SWING] = space["base_swing"]
        scales[PLATFORM_SWING:BETWEEN] = space["platform_swing"]
    scales[BETWEEN:BASE_PLATE] = [space["radii"][i] + space["radii"][j] + space["clearance"] for i, j in PAIRS]
    scales[BASE_PLATE:PLATFORM_PLATE] = space["radii"] + space["base_plate"]["gap"]
    scales[PLATFORM_PLATE:SPEED] = space["radii"] + space["platform_plate"]["gap"]
    scales[SPEED:FORCE], scales[FORCE:JACOBIAN] = space["velocity"], space["force"]
    return np.where(np.isfinite(scales) & (scales > 0.0), scales, 1.0)


def least_conditioning(mechanism: Mechanism) -> float:
    """The least conditioning of direct kinematics with which a run goes on."""
    return safety_settings(mechanism).conditioning
