"""Which sets of IMUs and encoders can be used: whether they determine the pose everywhere in the workspace, and check each
other.
"""

from collections.abc import Collection
from typing import Any

import numpy as np

from controller.direct_kinematics.geometry import geometry_of
from controller.direct_kinematics.requirements import length_conditionings
from controller.estimation.pose_estimator import PARAMETERS, STATE, WORST_CONDITIONING, find_pose
from controller.inverse_kinematics import inverse_kinematics, legs_at, sample_workspace
from controller.rig import RIG, field_of
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, load_kernels
from plant.dynamics.variables import TINY
from plant.encoders import EncoderModel
from plant.errors import InputError
from plant.imu_wiring import ALL_IMUS, PLATFORM_IMU
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array
from plant.threads import in_threads
from plant.vectors import rotate_back, vector

_LEAST_FIELD = 5.0
"""Least horizontal magnetic field from which a heading can be taken [uT]."""

_LEAST_OBSERVABILITY = 0.2
"""Least component of the vertical across both axes of a universal joint, anywhere in the workspace; with less, gravity does not
show the joint's angles, and where it vanishes the two solutions for them meet."""

_MOST_ALONG = 0.99
"""Greatest component of a leg along the first axis of its joint, which is singular where the two are parallel."""

_LEAST_LEVEL = 1e-6
"""Least level component of a leg that counts as one."""

_POSES = 50
"""Of the workspace, at which a set is tried."""

_LEAST_JUDGED = 5
"""Of fewer IMUs in space, evidence judges none."""

_LEAST_SHARE = 0.08
"""How much of an IMU's error must show in what the pose leaves over."""

_CHUNK = 1024
"""Poses that a thread takes at once."""

_SINGULAR = 1e-12
"""Directions with a smaller share of the information are those in which a planar mechanism cannot move."""


def imus_of(mechanism: Mechanism, imus: Collection[int] = ALL_IMUS) -> tuple[int, ...]:
    """Those of `imus` that the legs of a mechanism and its platform can have."""
    return tuple(imu for imu in ALL_IMUS if imu in imus and (imu < mechanism.legs or imu == PLATFORM_IMU))


def are_few(mechanism: Mechanism, imus: Collection[int]) -> bool:
    """Whether so few IMUs in space contradict each other too little for evidence to judge them."""
    return not mechanism.planar and len(imus_of(mechanism, imus)) < _LEAST_JUDGED


def check_imus(
    mechanism: Mechanism,
    imus: Collection[int],
    magnetometer: bool = False,
    section_5: bool = False,
    encoder: EncoderModel | None = None,
) -> float:
    """Check that these IMUs, the platform's magnetometer and encoders of all legs determine the pose, at home and over the
    workspace; returns the worst conditioning there, of the IMUs if they suffice, else of the lengths.

    Incremental encoders tell no pose at power-on, so that the IMUs must.

    Raises:
        InputError: an IMU outside 0 to 6, no field for the magnetometer, or the set does not determine the pose.
    """
    for imu in imus:
        if imu not in ALL_IMUS:
            raise InputError(f"there is no IMU {imu}; 0 to 5 sit on the legs, 6 on the platform")
    field = field_of(mechanism)
    if mechanism.planar and (magnetometer or section_5):
        raise InputError(f"{mechanism.name!r} is planar and has no heading: do without magnetometer and section 5")
    if magnetometer and PLATFORM_IMU not in imus:
        raise InputError("the magnetometer is part of the platform's IMU, which is not there: add IMU 6")
    if magnetometer and field.horizontal < _LEAST_FIELD:
        raise InputError(
            f"the horizontal magnetic field is {field.horizontal:.3g} uT; a heading needs at least {_LEAST_FIELD:g}: do "
            "without the magnetometer, or set the plant's magnetic_field"
        )
    if section_5 and not magnetometer:
        raise InputError("the paper's section 5 needs the platform's heading: add its magnetometer (--magnetometer)")
    # Of the one axis of a planar joint, gravity tells the angle wherever the leg points.
    in_plane = float(np.linalg.norm(mechanism.up_in_base[:2]))
    if mechanism.planar and in_plane < _LEAST_OBSERVABILITY:
        raise InputError(
            f"gravity hardly tells the angles in the plane of {mechanism.name!r}: of the vertical only {in_plane:.2g} lies in "
            f"it, and {_LEAST_OBSERVABILITY:g} is needed: set the plant's gravity"
        )
    positions, rotations = sample_workspace(mechanism, _POSES, seed=0)
    if not mechanism.planar:
        _check_joints(mechanism, positions, rotations, imus)
    _load_conditionings()
    worst = float(conditionings(mechanism, positions, rotations, imus, magnetometer, section_5).min())
    if worst >= WORST_CONDITIONING:
        return worst
    if encoder is not None and encoder.absolute:
        worst = float(length_conditionings(mechanism, positions, rotations).min())
        if worst >= WORST_CONDITIONING:
            return worst
    names, powerless = ", ".join(str(imu) for imu in imus_of(mechanism, imus)) or "none", ""
    if encoder is not None and not encoder.absolute:
        powerless = ", and incremental encoders tell none at power-on"
    if mechanism.planar and PLATFORM_IMU not in imus:
        raise InputError(
            f"the IMUs {names} determine the pose of {mechanism.name!r} up to its two assembly modes at best, which the loop "
            f"cannot tell apart{powerless}: add the platform's IMU (6), whose roll does, or absolute encoders (--lengths "
            "absolute)"
        )
    remedies = ["legs"]
    if PLATFORM_IMU not in imus:
        remedies.append("the platform's IMU (6)")
    if not (magnetometer or mechanism.planar):
        remedies.append("its magnetometer (--magnetometer)")
    if not section_5:
        remedies.append("absolute encoders (--lengths absolute)")
    raise InputError(
        f"the IMUs {names} do not determine the pose of {mechanism.name!r} everywhere in its workspace (conditioning "
        f"{worst:.1e}; at least {WORST_CONDITIONING:g} is needed){powerless}: add {', or '.join(remedies)}"
    )


def lengths_lead(
    mechanism: Mechanism, imus: Collection[int], magnetometer: bool = False, encoder: EncoderModel | None = None
) -> bool:
    """Whether the pose must be that of absolute encoders, as the IMUs of a set that `check_imus` allows do not determine it."""
    if encoder is None or not encoder.absolute:
        return False
    return bool(
        conditionings(mechanism, *sample_workspace(mechanism, _POSES, seed=0), imus, magnetometer).min() < WORST_CONDITIONING
    )


def length_share(mechanism: Mechanism, fusion: FusionSettings, imus: Collection[int], magnetometer: bool = False) -> float:
    """How much less well these IMUs know the lengths of the legs at home than all IMUs do: 1 or more, of the worst leg."""
    along = inverse_kinematics(mechanism, mechanism.require_home()).jacobian

    def worst(*chosen: Any) -> float:
        covariance = _pose_covariance(mechanism, fusion, *chosen)
        return float(np.sqrt(np.einsum("ki,ij,kj->k", along, covariance, along).max()))

    return max(1.0, worst(imus, magnetometer) / worst())


def pose_share(mechanism: Mechanism, fusion: FusionSettings, imus: Collection[int], magnetometer: bool = False) -> float:
    """How much less well these IMUs know the pose at home than all IMUs do: 1 or more, of position or rotation."""

    def variances(*chosen: Any) -> Array:
        found: Array = np.diag(_pose_covariance(mechanism, fusion, *chosen)).reshape(2, 3).sum(axis=1)
        return found

    return max(1.0, float(np.sqrt((variances(imus, magnetometer) / variances()).max())))


def _pose_covariance(mechanism: Mechanism, fusion: FusionSettings, *chosen: Any) -> Array:
    """The covariance (6, 6) of the pose at home by least squares, of IMUs chosen as for `measured_rows`."""
    rows = np.vstack([rows for rows, _ in measured_rows(mechanism, fusion, *chosen).values()])
    covariance: Array = np.linalg.pinv(rows.T @ rows, rcond=_SINGULAR, hermitian=True)
    return covariance


def encoder_remark(lead: bool) -> str:
    """What a user should know where the encoders lead, in a line; "" where the IMUs determine the pose."""
    if not lead:
        return ""
    return (
        "the IMUs do not determine the pose: it is that of the encoders, by iteration from home, so that the platform must be "
        "nearer to home than to another pose with the same lengths, and nothing tells an encoder that has lost counts: add IMUs"
    )


def _check_joints(mechanism: Mechanism, positions: Array, rotations: Array, imus: Collection[int]) -> None:
    """Check that gravity tells the angles of every universal joint whose leg has an IMU, at home and at the N poses."""
    home, up = mechanism.require_home(), mechanism.up_in_base
    poses = zip([home.position, *positions], [home.rotation, *rotations], strict=True)
    directions = np.array([_directions(mechanism, *pose) for pose in poses])
    for leg in (leg for leg in range(mechanism.legs) if leg in imus):
        least, most = _joint_shares(directions[:, leg], mechanism.base_joint_axes[leg], up)
        if least >= _LEAST_OBSERVABILITY and most <= _MOST_ALONG:
            continue
        remedy, better = "", _better_axis(directions[:, leg], up)
        if better is not None:
            remedy = f"turn base_joint_axes[{leg}], such as to [{', '.join(f'{part:.2f}' for part in better)}], or "
        if most > _MOST_ALONG:
            near, needed = np.degrees(np.arccos([most, _MOST_ALONG]))
            raise InputError(
                f"within its workspace leg {leg} comes to within {near:.2g} deg of the first axis of its joint, where that is "
                f"singular; {needed:.2g} deg are needed: {remedy}leave its IMU out"
            )
        raise InputError(
            f"gravity hardly tells the angles of leg {leg}: of the vertical only {least:.2g} lies across the axes of its joint "
            f"somewhere in its workspace, and {_LEAST_OBSERVABILITY:g} is needed: {remedy}leave its IMU out"
        )


def _joint_shares(directions: Array, axis: Array, up: Array) -> tuple[float, float]:
    """Of a leg with directions (N, 3), the first one at home: the least component of the vertical across both axes of its
    joint, counted positive where it has the sign that it has at home, and the leg's greatest component along the first axis.
    """
    along = directions @ axis
    # Across both axes is what of the leg is across the first one.
    across = (directions - along[:, None] * axis) @ up / np.sqrt(np.maximum(1.0 - along**2, TINY))
    return float((across * np.sign(across[0])).min()), float(np.abs(along).max())


def _better_axis(directions: Array, up: Array) -> Array | None:
    """A first axis with which gravity tells the angles of a leg with directions (N, 3); None if there is none.

    It lies in the vertical plane of the leg at home. Level, it would be best for a leg that swings little across that plane;
    across the leg, for one that swings much.
    """
    home = directions[0]
    level = home - home @ up * up
    level = level if np.linalg.norm(level) > _LEAST_LEVEL else np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    level = level / np.linalg.norm(level)
    elevations = np.arctan2(home @ up, home @ level) + np.radians(np.arange(30.0, 151.0, 15.0))
    axes = np.round(np.outer(np.cos(elevations), level) + np.outer(np.sin(elevations), up), 2)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    shares = np.array([_joint_shares(directions, axis, up) for axis in axes])
    best = int(np.argmax(np.where(shares[:, 1] <= _MOST_ALONG, shares[:, 0], 0.0)))
    return axes[best] if shares[best, 0] >= _LEAST_OBSERVABILITY else None


def _directions(mechanism: Mechanism, position: Array, rotation: Array) -> Array:
    """The directions (n, 3) of the legs at a pose."""
    legs = position + mechanism.platform_joints @ rotation.T - mechanism.base_joints
    directions: Array = legs / np.linalg.norm(legs, axis=1, keepdims=True)
    return directions


def integrity_remark(
    mechanism: Mechanism, fusion: FusionSettings, imus: Collection[int] = ALL_IMUS, magnetometer: bool = False
) -> str:
    """What a user should know of IMUs that hardly check each other, in a line; "" of those that do.

    The error of an IMU has two components, in a planar mechanism one. As many numbers beyond those that the pose needs tell
    that there is an error, and twice as many whose it is. How an error moves the pose is that of least squares at home.
    """
    measured = measured_rows(mechanism, fusion, imus, magnetometer)
    whole = np.vstack([rows for rows, _ in measured.values()])
    covariance = np.linalg.pinv(whole.T @ whole, rcond=_SINGULAR, hermitian=True)
    components, needed = (1, 3) if mechanism.planar else (2, 6)
    spare = len(whole) - needed
    shares = {imu: np.linalg.eigvalsh(np.eye(len(rows)) - rows @ covariance @ rows.T)[0] for imu, (rows, _) in measured.items()}
    blind = [imu for imu, share in shares.items() if share < _LEAST_SHARE]
    if spare >= 2 * components and not blind:
        return ""
    shifts = {imu: np.radians(1.0) * (covariance @ rows.T) / sigmas for imu, (rows, sigmas) in measured.items()}
    moved, turned = ({imu: np.linalg.norm(shift[part], 2) for imu, shift in shifts.items()} for part in (slice(3), slice(3, 6)))
    suspects = blind or [*measured]
    far, names = max(suspects, key=lambda imu: moved[imu]), ", ".join(map(str, measured))
    complete = len(measured) == len(imus_of(mechanism))
    which = f"the IMUs {names} hardly check each other: an error of one of them"
    if len(suspects) < len(measured):
        which = f"the others hardly check IMU {', '.join(map(str, suspects))}: an error there"
    told = "is told, but not whose it is" if spare >= components and not blind else "is not told"
    remedy = "docs/sensor_sets.md has sensors that would tell more" if complete else "add IMUs"
    moves = f"{1e3 * moved[far]:.1f} mm and {np.degrees(turned[far]):.1f} deg"
    return f"{which} {told}, and 1 deg of IMU {far} moves the pose by {moves}: {remedy}"


def measured_rows(
    mechanism: Mechanism, fusion: FusionSettings, imus: Collection[int] = ALL_IMUS, magnetometer: bool = False
) -> dict[int, tuple[Array, Array]]:
    """By IMU, how its direction changes across itself with a small move (6,) of the platform at home, over its standard
    deviations, and these [rad].
    """
    home = mechanism.require_home()
    arms = mechanism.platform_joints @ home.rotation.T
    legs = home.position + arms - mechanism.base_joints
    rows: dict[int, tuple[Array, Array]] = {}
    for imu in imus_of(mechanism, imus):
        if imu == PLATFORM_IMU:
            turns = [np.cross(mechanism.up_in_base, t) for t in across(mechanism, mechanism.up_in_base)]
            sigmas = [fusion.tilt_sigma] * len(turns)
            if magnetometer:
                turns.append(mechanism.up_in_base)
                sigmas.append(fusion.heading_sigma)
            jacobian = np.hstack([np.zeros((len(turns), 3)), turns])
        else:
            length = np.linalg.norm(legs[imu])
            sideways = across(mechanism, legs[imu] / length)
            jacobian = np.hstack([sideways, np.cross(arms[imu], sideways)]) / length
            sigmas = [fusion.leg_sigma] * len(jacobian)
        if mechanism.planar:
            jacobian[:, 2:5] = 0.0
        rows[imu] = jacobian / np.array(sigmas)[:, None], np.array(sigmas)
    return rows


def across(mechanism: Mechanism, direction: Array) -> Array:
    """The unit vectors (2, 3) across a direction (3,); of a planar mechanism the one in its plane (1, 3)."""
    if mechanism.planar:
        t = np.cross([0.0, 0.0, 1.0], direction)
        return np.array([t / np.linalg.norm(t)])
    found: Array = np.linalg.svd(direction[None])[2][1:]
    return found


def conditionings(
    mechanism: Mechanism,
    positions: Array,
    rotations: Array,
    imus: Collection[int] = ALL_IMUS,
    magnetometer: bool = False,
    section_5: bool = False,
    workers: int | None = 1,
) -> Array:
    """The conditioning (N,) of direct kinematics with these IMUs at positions (N, 3) [m] and rotations (N, 3, 3); unchecked.

    `workers` are threads; None is one for each core.
    """
    field = field_of(mechanism)
    rig = filled(RIG, geometry=geometry_of(mechanism), vectors_in_base=field.vectors, planar=mechanism.planar)
    parameters = filled(PARAMETERS, section_5=section_5)
    leg_used = np.array([float(leg in imus_of(mechanism, imus)) for leg in range(LEGS)])
    used = (int(PLATFORM_IMU in imus), int(magnetometer))
    positions, rotations = np.ascontiguousarray(positions, np.float64), np.ascontiguousarray(rotations, np.float64)
    found = np.empty(len(positions))

    def find(start: int, stop: int) -> None:
        pose = np.zeros((), STATE)
        find_conditionings(parameters, pose, rig, positions, rotations, leg_used, *used, found, start, stop)

    in_threads(find, len(positions), _CHUNK, workers)
    return found


def _load_conditionings() -> None:
    """Load the machine code of `conditionings`, or compile it in several processes."""
    records, poses = (np.zeros((), dtype) for dtype in (PARAMETERS, STATE, RIG)), (np.zeros((1, 3)), np.zeros((1, 3, 3)))
    load_kernels((find_conditionings, *records, *poses, np.zeros(LEGS), 0, 0, np.zeros(1), 0, 1))


@kernel
def find_conditionings(
    parameters: Record, pose: Record, rig: Record, positions: Array, rotations: Array, leg_used: Array, platform_used: int,
    heading_used: int, found: Array, start: int, stop: int,
) -> None:  # fmt: skip
    """Write the conditioning of direct kinematics at the rows from `start` to `stop`."""
    p, s, r = parameters[()], pose[()], rig[()]
    arms, directions, lengths = np.empty((LEGS, 3)), np.empty((LEGS, 3)), np.empty(LEGS)
    for row in range(start, stop):
        rotation = rotations[row]
        legs_at(r.geometry.base_joints, r.geometry.platform_joints, positions[row], rotation, arms, directions, lengths)
        for i in range(2):
            s.vectors[i, 0], s.vectors[i, 1], s.vectors[i, 2] = rotate_back(rotation, vector(r.vectors_in_base[i]))
        found[row] = find_pose(p, s, r, directions, leg_used, platform_used, heading_used)
