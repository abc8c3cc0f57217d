"""The mechanism in 3-D: plates, legs with colours, and ghosts of where the platform should be and of where it is in truth."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from hil.runs.operator_messages import pose_in
from plant.pose import Array, Pose, quaternion_from_rotation

COLORINGS = ("stroke", "speed", "IMUs")
"""What the colours of the legs may show."""

_GOOD, _WARM, _BAD = np.array([[0, 120, 60], [214, 110, 0], [190, 20, 40]], float)
_BASE, _PLATFORM, _REFERENCE, _TRUTH = (92, 104, 115), (109, 135, 163), (47, 111, 181), (209, 73, 91)
_LEG_SHARE = 0.025
"""Thickness of a leg, as a share of the radius of the base's joints."""


@dataclass(frozen=True, eq=False)
class Machine:
    """What is drawn of a mechanism, with n legs.

    Attributes:
        base_joints, platform_joints: (n, 3) [m].
        stroke: (n, 2) [m]; velocity: of a leg at most [m/s].
        up: (3,), the vertical in {1}.
        home: the pose of the platform.
    """

    name: str
    planar: bool
    base_joints: Array
    platform_joints: Array
    stroke: Array
    velocity: float
    up: Array
    home: Pose

    @classmethod
    def of_message(cls, message: Mapping[str, Any]) -> "Machine":
        """From `machine_message`."""
        arrays = {name: np.array(message[name], float) for name in ("base_joints", "platform_joints", "stroke", "up")}
        return cls(
            str(message["name"]), bool(message["planar"]), velocity=float(message["velocity"]),
            home=pose_in(message["home"]), **arrays,
        )  # fmt: skip

    @property
    def legs(self) -> int:
        """How many there are."""
        return len(self.base_joints)

    def lengths(self, state: Mapping[str, Any]) -> Array:
        """The lengths (n,) of a state [m]."""
        return np.array(state["lengths"], float)[: self.legs]

    def room(self, state: Mapping[str, Any]) -> Array:
        """How far each leg (n,) is from the nearer end of its stroke [m]."""
        lengths = self.lengths(state)
        room: Array = np.minimum(lengths - self.stroke[:, 0], self.stroke[:, 1] - lengths)
        return room

    def shares(self, state: Mapping[str, Any], coloring: str) -> Array:
        """What the colours of the legs (n,) show: 0 is good, and 1 at a limit, or without an IMU."""
        if coloring == "IMUs":
            return np.array([0.0 if leg in state["imus"] else 1.0 for leg in range(self.legs)])
        if coloring == "speed":
            speeds: Array = np.abs(np.array(state["rates"], float)[: self.legs]) / self.velocity
            return speeds
        shares: Array = 1.0 - 2.0 * self.room(state) / np.ptp(self.stroke, axis=1)
        return shares


class Scene:
    """The picture on a server's pages."""

    def __init__(self, server: viser.ViserServer, machine: Machine) -> None:
        self._server, self._machine, self.coloring = server, machine, COLORINGS[0]
        self._shown: tuple[Any, ...] = ()
        radius = float(np.linalg.norm(machine.base_joints - machine.base_joints.mean(axis=0), axis=1).max())
        add = server.scene
        up = machine.up if not machine.planar else np.array([0.0, 0.0, 1.0])
        add.set_up_direction(tuple(up))
        add.add_frame("/base/axes", axes_length=0.3 * radius, axes_radius=0.006 * radius)
        _plate(server, "/base/plate", machine.base_joints, _BASE, 0.5)
        self._placed = {
            "platform": add.add_frame("/platform", axes_length=0.25 * radius, axes_radius=0.006 * radius),
            "commanded": _outline(server, "/commanded", machine.platform_joints, _REFERENCE, 0.008 * radius),
            "truth": _outline(server, "/truth", machine.platform_joints, _TRUTH, 0.008 * radius),
        }
        _plate(server, "/platform/plate", machine.platform_joints, _PLATFORM, 0.7)
        self._legs = add.add_line_segments(
            "/legs", np.zeros((machine.legs, 2, 3), np.float32), (90, 90, 90), thickness=_LEG_SHARE * radius
        )
        self._labels = [
            add.add_label(f"/label {leg}", str(leg), position=tuple(1.08 * joint))
            for leg, joint in enumerate(machine.base_joints)
        ]
        center, aside = 0.5 * machine.home.position, np.array([1.6, -2.0, 1.1]) * radius
        if machine.planar:
            center, aside = machine.home.position, np.array([0.0, -0.01, 3.2]) * radius
        server.initial_camera.position = tuple(center + aside)
        server.initial_camera.look_at = tuple(center)
        self.show({"commanded": {"position": machine.home.position, "rotation": np.zeros(3)}})

    def show(self, state: Mapping[str, Any]) -> None:
        """Draw a state as `state_message` has it; `commanded` and `truth` are ghosts, if they are there."""
        machine = self._machine
        known = state.get("pose") or state.get("commanded")
        look = _look(state, self.coloring)
        if look == self._shown:
            return
        self._shown = look
        told = {"platform": known, "commanded": state.get("commanded"), "truth": state.get("truth")}
        poses = {name: pose_in(pose) for name, pose in told.items() if pose}
        with self._server.atomic():
            for name in ("commanded", "truth"):
                self._placed[name].visible = name in poses
            self._place(poses)
            if known is None:
                return
            pose = poses["platform"]
            ends = pose.position + machine.platform_joints @ pose.rotation.T
            self._legs.points = np.stack([machine.base_joints, ends], axis=1).astype(np.float32)
            if "lengths" in state:
                colors = leg_colors(machine.shares(state, self.coloring))
                self._legs.colors = np.repeat(colors[:, None], 2, axis=1)

    def _place(self, poses: Mapping[str, Pose]) -> None:
        quaternions = quaternion_from_rotation(np.reshape([pose.rotation for pose in poses.values()], (-1, 3, 3)))
        for (name, pose), quaternion in zip(poses.items(), quaternions, strict=True):
            self._placed[name].position, self._placed[name].wxyz = tuple(pose.position), tuple(quaternion)


def _look(state: Mapping[str, Any], coloring: str) -> tuple[Any, ...]:
    """What is the same for states that look the same: a browser need not draw them again."""
    poses = [state.get(name) for name in ("pose", "commanded", "truth")]
    numbers = [value for pose in poses if pose for value in (*pose["position"], *pose["rotation"])]
    numbers += [0.01 * (value or 0.0) for value in state.get("rates", ())]
    return coloring, [pose is None for pose in poses], state.get("imus"), np.round(numbers, 5).tolist()


def leg_colors(shares: Array) -> NDArray[np.uint8]:
    """Colours (n, 3) from good at 0 over a warning at 0.7 to bad at 1."""
    shares = np.clip(np.nan_to_num(shares, nan=1.0), 0.0, 1.0)[:, None]
    warm, hot = np.clip(shares / 0.7, 0.0, 1.0), np.clip((shares - 0.7) / 0.3, 0.0, 1.0)
    colors: NDArray[np.uint8] = np.round(_GOOD + warm * (_WARM - _GOOD) + hot * (_BAD - _WARM)).astype(np.uint8)
    return colors


def _rim(joints: Array) -> Array:
    """The joints (n, 3) in their order round the centre."""
    centered = joints - joints.mean(axis=0)
    plane = np.linalg.svd(centered)[2][:2]
    x, y = plane @ centered.T
    return joints[np.argsort(np.arctan2(y, x))]


def _plate(server: viser.ViserServer, name: str, joints: Array, color: tuple[int, int, int], opacity: float) -> None:
    rim = _rim(joints)
    fan = np.arange(1, len(rim) - 1)
    faces = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
    server.scene.add_mesh_simple(name, rim, faces, color=color, opacity=opacity, flat_shading=True, side="double")


def _outline(server: viser.ViserServer, name: str, joints: Array, color: tuple[int, int, int], thickness: float) -> Any:
    rim = _rim(joints)
    edges = np.stack([rim, np.roll(rim, -1, axis=0)], axis=1).astype(np.float32)
    return server.scene.add_line_segments(name, edges, color, thickness=thickness)
