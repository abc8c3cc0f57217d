"""Calibration of the IMUs: the paper's (37), `a_cal = T S (a_u + b)`, for every sensor, and the file that keeps it.

One matrix, the gain, holds `T S` and the mounting, and the offset holds `T S b`: a calibrated reading is gain @ raw + offset.
A file gives bias, scale, axes and mounting of each sensor of each IMU:

    gain = R(mounting) T(axes) diag(scale),  T = I + upper triangle (xy, xz, yz),  R that of a rotation vector

A file that gough writes begins with a digest of all that follows, except comments and layout: a cut or a change shows. What a
file written by hand leaves out counts as free of errors, which `Calibration.remark` says.
"""

import hashlib
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from controller.estimation.whole_mechanism.imu_errors import ERRORS
from plant.dynamics.variables import IMU_COUNT
from plant.errors import InputError
from plant.files import check_entries, read_toml, toml_entries, write_whole
from plant.imu import MAGNETOMETER, PRESETS, load_imu
from plant.imu_wiring import BASE_IMU, SLOTS
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, checked_array, rotation_from_vector, vector_from_rotation

SENSORS = ("gyroscope", "accelerometer", "magnetometer")
UNITS = ("rad/s", "m/s2", "uT")
_FIELDS = {"bias": np.zeros(3), "scale": np.ones(3), "axes": np.zeros(3), "mounting": np.zeros(3)}
_SIDES = ("base", "platform")
_LEAST_MOVE_M = 1e-9
_MOST_TILT = 0.8
_MOST_LISTED = 4
_DIGEST_SIZE = 32


@dataclass(frozen=True, eq=False)
class Calibration:
    """Constants of the seven IMUs.

    Attributes:
        gain: (3, 7, 3, 3), by sensor (gyroscope, accelerometer, magnetometer) and IMU.
        offset: (3, 7, 3) [rad/s, m/s^2, uT].
        tilt: (2,) [rad], turns of the vertical about the axes x and y of {1}.
        joints: (2, 6, 3) [m], corrections of the mechanism's base and platform joints.
        floor: (2,) [m, rad], standard deviations of position and rotation that tilt and joints leave.
        base_gain, base_offset: (2, 3, 3) and (2, 3), the same of the gyroscope and the accelerometer of an IMU on the base.
        covariance: (147, 147), of the remaining errors, in the order of `imu_errors.ERROR_NAMES` for each IMU, if it is known.
        about: further facts: the rig (`calibrated_rig`), date, residuals.
        remark: what its file does not tell, in a line; "" if it tells all.
    """

    gain: Array = field(default_factory=lambda: np.tile(np.eye(3), (3, IMU_COUNT, 1, 1)))
    offset: Array = field(default_factory=lambda: np.zeros((3, IMU_COUNT, 3)))
    tilt: Array = field(default_factory=lambda: np.zeros(2))
    joints: Array = field(default_factory=lambda: np.zeros((2, LEGS, 3)))
    floor: Array = field(default_factory=lambda: np.zeros(2))
    base_gain: Array = field(default_factory=lambda: np.tile(np.eye(3), (2, 1, 1)))
    base_offset: Array = field(default_factory=lambda: np.zeros((2, 3)))
    covariance: Array | None = None
    about: dict[str, Any] = field(default_factory=dict)
    remark: str = ""

    def put(self, imu: int, sensor: int, gain: Array, offset: Array) -> None:
        """Take the gain (3, 3) and the offset (3,) of a sensor of an IMU, 0 to 7, in place."""
        gains, offsets = (self.base_gain, self.base_offset) if imu == BASE_IMU else (self.gain[:, imu], self.offset[:, imu])
        gains[sensor], offsets[sensor] = gain, offset

    def apply(self, measurements: Array) -> Array:
        """Calibrated measurements (..., 3, 7, 3) of raw ones."""
        calibrated: Array = (self.gain @ measurements[..., None])[..., 0] + self.offset
        return calibrated

    def then(self, gain: Array, offset: Array, **changes: Any) -> "Calibration":
        """This calibration followed by another."""
        whole = (gain @ self.offset[..., None])[..., 0] + offset
        return replace(self, gain=gain @ self.gain, offset=whole, **changes)


def split_gain(gain: Array) -> tuple[Array, Array, Array]:
    """The scale (3,), axes (3,) and mounting (3,) [rad] of a gain (3, 3).

    Raises:
        InputError: the gain is singular, or mirrors the axes.
    """
    if not (np.isfinite(gain).all() and np.linalg.det(gain) > 0.0):
        raise InputError("the gain of a sensor is singular or mirrors its axes, which no mounting does")
    rotation, triangle = np.linalg.qr(gain)
    signs = np.sign(np.diag(triangle))
    rotation, triangle = rotation * signs, triangle * signs[:, None]
    scale = np.diag(triangle).copy()
    axes = (triangle / scale)[[0, 0, 1], [1, 2, 2]]
    return scale, axes, vector_from_rotation(rotation)


def join_gain(scale: Array, axes: Array, mounting: Array) -> Array:
    """The gain (3, 3) of scale (3,), axes (3,) and mounting (3,) [rad]."""
    triangle = np.eye(3)
    triangle[[0, 0, 1], [1, 2, 2]] = axes
    gain: Array = rotation_from_vector(mounting) @ triangle @ np.diag(scale)
    return gain


def calibrated_rig(mechanism: Mechanism, imu: str) -> dict[str, str]:
    """What a file tells in `about` of the rig that it is of: the mechanism, its geometry as a digest, and the kind of IMU.

    A kind that a TOML file describes has a digest of its figures beside its name, wherever the file lies.
    """
    arrays = [mechanism.base_joints, mechanism.platform_joints, mechanism.base_joint_axes]
    arrays += [mechanism.plant[name] for name in ("leg_imu_position", "platform_imu_position") if name in mechanism.plant]
    geometry = _hash(json.dumps([(np.round(array, 9) + 0.0).tolist() for array in arrays]))
    if imu not in PRESETS:
        model = load_imu(imu)
        imu = f"{model.name} {_hash(repr(model))[:8]}"
    return {"mechanism": mechanism.name, "geometry": geometry, "imu": imu}


def calibration_for(path: Path | str, mechanism: Mechanism, imu: str) -> Calibration:
    """Read a calibration file for a mechanism with IMUs of this kind, a preset or a file.

    Raises:
        InputError: as `load_calibration`, or the file is of another mechanism, geometry or kind of IMU.
    """
    calibration = load_calibration(path)
    compared = {
        "mechanism": ("mechanism", "give that with --mechanism"),
        "geometry": ("geometry", f"joints, axes or places of the IMUs of {mechanism.name!r} have changed since"),
        "imu": ("kind of IMU", "give that with --imu"),
    }
    for name, used in calibrated_rig(mechanism, imu).items():
        what, remedy = compared[name]
        if (of := calibration.about.get(name, used)) != used:
            raise InputError(
                f"{path} is a calibration of the {what} {of!r}, and this run has {used!r}: {remedy}, or calibrate this "
                "rig with 'gough calibrate rig'"
            )
    return calibration


def load_calibration(path: Path | str) -> Calibration:
    """Read a calibration file.

    Raises:
        InputError: there is no such file, it is malformed, or it was cut off or changed; the message names the entry.
    """
    document = read_toml(path)
    for name, table in document.items():
        if not isinstance(table, dict):
            raise InputError(f"{path}: {name} must be a table, got {table!r}")
    remark = _check_whole(document, path)
    about, base, joints = (document.pop(name, {}) for name in ("about", "base", "joints"))
    remaining = document.pop("covariance", None)
    calibration = Calibration(about=about)
    for name, table in document.items():
        imu = name.removeprefix("imu_")
        if not (name.startswith("imu_") and imu in map(str, range(SLOTS))):
            raise InputError(
                f"{path}: no table {name!r} belongs in a calibration; imu_0 to imu_7, about, base, joints, covariance do"
            )
        known = SENSORS if int(imu) < BASE_IMU else SENSORS[:MAGNETOMETER]
        for sensor, entries in table.items():
            if sensor not in known:
                raise InputError(f"{path}: {name} has no sensor {sensor!r}; it has {', '.join(known)}")
            gain, offset = _read_sensor(entries, f"{path}: {name}.{sensor}")
            calibration.put(int(imu), SENSORS.index(sensor), gain, offset)
    check_entries(base, ("tilt", "floor"), f"{path}: base")
    check_entries(joints, _SIDES, f"{path}: joints")
    tilt, floor = (checked_array(base.get(name, (0.0, 0.0)), (2,), f"{path}: base.{name}") for name in ("tilt", "floor"))
    if np.abs(tilt).max() > _MOST_TILT or (floor < 0.0).any():
        raise InputError(f"{path}: base.tilt must be within {_MOST_TILT:g} rad of level, and base.floor not negative")
    moves = [checked_array(joints.get(side, np.zeros((LEGS, 3))), (LEGS, 3), f"{path}: joints.{side}") for side in _SIDES]
    covariance = None if remaining is None else _read_covariance(remaining, path)
    return replace(calibration, tilt=tilt, floor=floor, joints=np.stack(moves), covariance=covariance, remark=remark)


def _check_whole(document: dict[str, Any], path: Path | str) -> str:
    """Check the digest of a file, which is then removed; returns what the file does not tell, or "".

    Raises:
        InputError: the file was cut off or changed, or holds no constants.
    """
    about = document.get("about", {})
    written, lacking = about.pop("digest", None), _lacking(document)
    what = f"it lacks {_listed(lacking)}" if lacking else "nothing is missing"
    if written is not None and written != _digest(document):
        raise InputError(
            f"{path} was cut off or changed after it was written, as its digest shows ({what}): calibrate again; if you have "
            "changed it on purpose, remove its digest"
        )
    if not document.keys() - {"about"}:
        raise InputError(f"{path} holds no constants: it is empty or was cut off; calibrate again")
    if written is None and lacking and "version" in about:
        raise InputError(f"{path} was cut off, as gough {about['version']} writes all constants and {what}: calibrate again")
    untold = [] if written else ["no digest, which would show a cut or a change"]
    untold += [f"no {name}" for name in ("mechanism", "imu") if name not in about]
    untold += [f"nothing of {_listed(lacking)}, taken as free of errors"] if lacking else []
    return f"{path} has {'; '.join(untold)}" if untold else ""


def _lacking(document: Mapping[str, Any]) -> list[str]:
    """The sensors of which a file lacks a constant, and the tables that gough always writes."""
    names = [f"imu_{imu}.{sensor}" for imu, sensor in product(range(IMU_COUNT), SENSORS)]
    found = {f"{name}.{sensor}": entries for name, table in document.items() for sensor, entries in table.items()}
    lacking = [name for name in names if not (isinstance(found.get(name), dict) and found[name].keys() >= _FIELDS.keys())]
    return lacking if "base" in document else [*lacking, "base"]


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _MOST_LISTED
    return ", ".join(names[:_MOST_LISTED]) + (f" and {more} more" if more > 0 else "")


def _digest(document: Mapping[str, Any]) -> str:
    """Of what a file says, whatever its comments, layout and order of entries."""
    return _hash(json.dumps(document, sort_keys=True, default=str))


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGEST_SIZE]


def _read_sensor(entries: Any, where: str) -> tuple[Array, Array]:
    """The gain (3, 3) and the offset (3,) of a sensor."""
    if not isinstance(entries, dict) or set(entries) - set(_FIELDS):
        raise InputError(f"{where} must be a table of {', '.join(_FIELDS)}")
    values = {entry: checked_array(entries.get(entry, usual), (3,), f"{where}.{entry}") for entry, usual in _FIELDS.items()}
    if (values["scale"] <= 0.0).any():
        raise InputError(f"{where}.scale is {values['scale'].tolist()}; it must be positive")
    if np.abs(values["axes"]).max() > 1.0:
        raise InputError(f"{where}.axes is {values['axes'].tolist()}; an axis is at most 1 off a right angle")
    gain = join_gain(values["scale"], values["axes"], values["mounting"])
    return gain, gain @ values["bias"]


def _read_covariance(table: dict[str, ArrayLike], path: Path | str) -> Array:
    check_entries(table, ("sigmas", "factor"), f"{path}: covariance")
    size = IMU_COUNT * ERRORS
    sigmas = checked_array(table.get("sigmas", ()), (size,), f"{path}: covariance.sigmas")
    rows = table.get("factor", ())
    factor = np.zeros((size, size))
    if not isinstance(rows, list) or len(rows) != size:
        raise InputError(f"{path}: covariance.factor must have {size} rows")
    for i, row in enumerate(rows):
        factor[i, : i + 1] = checked_array(row, (i + 1,), f"{path}: covariance.factor[{i}]")
    scaled = sigmas[:, None] * factor
    covariance: Array = scaled @ scaled.T
    return covariance


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file, with a digest of its content.

    Raises:
        InputError: a gain that no sensor has.
        OSError: it cannot be written.
    """
    head = [
        "# Calibration of the IMUs: 0 to 5 on the legs, 6 on the platform, 7 on the base where there is one.",
        "# calibrated = R(mounting) T(axes) S(scale) (raw + bias)",
        "# Whoever changes a number removes the digest.",
        "",
        "[about]",
    ]
    lines = [
        *toml_entries(calibration.about),
        "",
        "# By which the vertical is turned about x and y, in rad; what tilt and joints leave of the pose, in m and rad.",
        "[base]",
        *toml_entries({"tilt": calibration.tilt, "floor": calibration.floor}),
    ]
    if np.abs(calibration.joints).max() >= _LEAST_MOVE_M:
        moves = dict(zip(_SIDES, calibration.joints, strict=True))
        lines += ["", "[joints]  # what must be added to their places, in m", *toml_entries(moves)]
    constants = [
        (f"imu_{imu}.{name}", UNITS[sensor], calibration.gain[sensor, imu], calibration.offset[sensor, imu])
        for imu, (sensor, name) in product(range(IMU_COUNT), enumerate(SENSORS))
    ]
    if not (np.array_equal(calibration.base_gain, Calibration().base_gain) and not calibration.base_offset.any()):
        of_base = zip(SENSORS, UNITS, calibration.base_gain, calibration.base_offset, strict=False)
        constants += [(f"imu_{BASE_IMU}.{name}", unit, gain, offset) for name, unit, gain, offset in of_base]
    for title, unit, gain, offset in constants:
        scale, axes, mounting = split_gain(gain)
        values = {"bias": np.linalg.solve(gain, offset), "scale": scale, "axes": axes, "mounting": mounting}
        lines += ["", f"[{title}]  # bias in {unit}, mounting in rad", *toml_entries(values)]
    if calibration.covariance is not None:
        sigmas = np.sqrt(np.diag(calibration.covariance))
        # Positive definite whatever rounding has done to the correlation.
        factor = np.linalg.cholesky(calibration.covariance / np.outer(sigmas, sigmas) + 1e-9 * np.eye(len(sigmas)))
        lines += [
            "",
            "# Of the errors that are left: standard deviations, and the Cholesky factor of their correlation.",
            "[covariance]",
            *toml_entries({"sigmas": sigmas}),
            "factor = [",
            *(f"    [{', '.join(f'{value:.6g}' for value in row[: i + 1])}]," for i, row in enumerate(factor)),
            "]",
        ]
    digest = _digest(tomllib.loads("\n".join(["[about]", *lines])))
    write_whole(path, ("\n".join([*head, *toml_entries({"digest": digest}), *lines]) + "\n").encode())
