"""What is told of a run while it goes on, or from its recording: the machine, and its state in a cycle, in SI units.

Both are mappings that `hil.runs.operator_messages` can send. docs/operating.md lists them.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.direct_kinematics import poses_from_lengths
from controller.frames import BASE, ActiveFrames
from controller.safety.causes import Cause, Mode
from controller.workspace import Demands, closest_limits
from hil.loop.records import COMPUTED
from hil.runs.operator_messages import pose_message
from plant.compiled import Record
from plant.imu_wiring import IMU_COUNT
from plant.mechanism import Mechanism
from plant.pose import Pose, rotations_from_quaternions
from plant.truth import TRUTH_POSITION, TRUTH_QUATERNION, pose_known


def machine_message(mechanism: Mechanism) -> dict[str, Any]:
    """What a picture of a mechanism with limits needs: joints (n, 3) [m], strokes (n, 2) [m], speed of a leg [m/s]."""
    limits, legs = mechanism.require_limits(), mechanism.legs
    return {
        "name": mechanism.name,
        "planar": mechanism.planar,
        "base_joints": mechanism.base_joints[:legs],
        "platform_joints": mechanism.platform_joints[:legs],
        "stroke": limits.stroke,
        "velocity": limits.velocity,
        "up": mechanism.up_in_base,
        "home": pose_message(mechanism.require_home()),
    }


def state_message(record: Record, frames: ActiveFrames) -> dict[str, Any]:
    """The state after a cycle (dtype `RECORD`); `pose` and `tool` are missing where there is no
    estimate, and `truth` where it is not known.
    """
    pose, stop = estimated_pose(record), Cause(int(record["stop"]))
    told: dict[str, Any] = {
        "mode": Mode(int(record["mode"])).name.lower(),
        "stop": None if stop == Cause.NONE else stop.short,
        "cycle": int(record["cycle"]),
        "lengths": record["lengths"],
        "rates": record["reference"][:, 1],
        "imus": [imu for imu in range(IMU_COUNT) if int(record["imus"]) >> imu & 1],
        "conditioning": float(record["conditioning"]),
        "protection": record["protection"].astype(float),
        "silent": int(record["silent"]),
    }
    if pose is not None:
        told |= {"pose": pose_message(pose), **_tool_message(frames, pose)}
    truth = record["truth"]
    if pose_known(truth):
        true = Pose(truth[TRUTH_POSITION], rotations_from_quaternions(truth[None, TRUTH_QUATERNION])[0])
        told["truth"] = pose_message(true)
    return told


def frames_message(frames: ActiveFrames) -> dict[str, Any]:
    """The enabled pair of frames, the names of all, and the TOML text that defines them."""
    return {**frames.described(), "names": list(frames.frames), "definitions": frames.frames.text()}


def margins_message(mechanism: Mechanism, pose: Pose, demands: Demands) -> list[dict[str, Any]]:
    """How a pose stands to everything that limits it: of each kind the limit that is closest, the closest kind first.

    Each has its `limit` in words, `kind` and `unit`, the `value` and the `bound`, and the margin's `share` of that with which
    it is farthest away: 0 at the limit, and negative beyond it.
    """
    told = []
    for share, excess in closest_limits(mechanism, pose, demands):
        plain = excess.plain()
        told.append({"share": share, **{name: plain[name] for name in ("limit", "kind", "unit", "value", "bound")}})
    return told


def estimated_pose(record: Record) -> Pose | None:
    """The pose that a cycle has estimated, if it has."""
    known = record["status"] == 0 and np.isfinite(record["position"]).all() and np.isfinite(record["rotation"]).all()
    return Pose(record["position"], record["rotation"]) if known else None


def reference_pose(record: Record, mechanism: Mechanism) -> Pose | None:
    """The pose at which the legs have the lengths of the reference in a cycle; None if it is not found."""
    near = estimated_pose(record) or mechanism.require_home()
    lengths = record["reference"][None, : mechanism.legs, 0]
    if not np.isfinite(lengths).all():
        return None
    positions, rotations = poses_from_lengths(mechanism, lengths, near, partial=True)
    return Pose(positions[0], rotations[0]) if np.isfinite(positions[0]).all() else None


def timing_message(records: Record, at: NDArray[np.intp], period: float) -> Mapping[str, float]:
    """How long the cycles at these places of `records` took, and how late they began, over their period [s]; {} for none."""
    if not len(at):
        return {}
    computed, late = 1e-9 * records["stage_ns"][at][:, COMPUTED].sum(axis=1), 1e-9 * records["late_ns"][at]
    return {
        "period": period,
        "compute": float(np.median(computed)),
        "compute_p99": float(np.quantile(computed, 0.99)),
        "late": float(np.median(late)),
        "late_p99": float(np.quantile(late, 0.99)),
        "missed": int(records["missed"][at].sum()),
    }


def _tool_message(frames: ActiveFrames, pose: Pose) -> dict[str, Any]:
    """The tool's pose in the work frame, if that stands on {1}."""
    return {"tool": pose_message(frames.read(pose))} if frames.root == BASE else {}
