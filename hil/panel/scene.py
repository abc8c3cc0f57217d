"""The mechanism in 3-D: plates, legs with colours, and ghosts of where the platform should be and of where it is in truth."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from hil.look import (
    BASE_COLOR,
    COLORINGS,
    NEUTRAL,
    PLATFORM_COLOR,
    REFERENCE_COLOR,
    TRUTH_COLOR,
    imu_shares,
    leg_colors,
    rgb,
    ring,
    room,
    speed_shares,
    stroke_shares,
)  # fmt: skip
from hil.runs.operator_messages import pose_in
from plant.pose import Array, Pose, quaternion_from_rotation

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
        return room(self.lengths(state), self.stroke)

    def shares(self, state: Mapping[str, Any], coloring: str) -> Array:
        """What the colours of the legs (n,) show: 0 is good, and 1 at a limit, or without an IMU."""
        if coloring == "IMUs":
            return imu_shares(np.isin(np.arange(self.legs), state["imus"]))
        if coloring == "speed":
            return speed_shares(np.array(state["rates"], float)[: self.legs], self.velocity)
        return stroke_shares(self.lengths(state), self.stroke)


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
        _plate(server, "/base/plate", machine.base_joints, BASE_COLOR, 0.5)
        self._platform = add.add_frame("/platform", axes_length=0.25 * radius, axes_radius=0.006 * radius)
        _plate(server, "/platform/plate", machine.platform_joints, PLATFORM_COLOR, 0.7)
        self._ghosts = {
            name: _outline(server, f"/{name}", machine.platform_joints, color, 0.008 * radius)
            for name, color in (("commanded", REFERENCE_COLOR), ("truth", TRUTH_COLOR))
        }
        self._legs = add.add_line_segments(
            "/legs", np.zeros((machine.legs, 2, 3), np.float32), rgb(NEUTRAL), thickness=_LEG_SHARE * radius
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
        with self._server.atomic():
            for name, ghost in self._ghosts.items():
                ghost.visible = state.get(name) is not None
                if state.get(name) is not None:
                    _place(ghost, pose_in(state[name]))
            if known is None:
                return
            pose = pose_in(known)
            _place(self._platform, pose)
            ends = pose.position + machine.platform_joints @ pose.rotation.T
            self._legs.points = np.stack([machine.base_joints, ends], axis=1).astype(np.float32)
            if "lengths" in state:
                colors = leg_colors(machine.shares(state, self.coloring))
                self._legs.colors = np.repeat(colors[:, None], 2, axis=1)


def _look(state: Mapping[str, Any], coloring: str) -> tuple[Any, ...]:
    """What is the same for states that look the same: a browser need not draw them again."""
    poses = [state.get(name) for name in ("pose", "commanded", "truth")]
    numbers = [value for pose in poses if pose for value in (*pose["position"], *pose["rotation"])]
    numbers += [0.01 * (value or 0.0) for value in state.get("rates", ())]
    return coloring, [pose is None for pose in poses], state.get("imus"), np.round(numbers, 5).tolist()


def _place(handle: Any, pose: Pose) -> None:
    handle.position, handle.wxyz = tuple(pose.position), tuple(quaternion_from_rotation(pose.rotation))


def _plate(server: viser.ViserServer, name: str, joints: Array, color: str, opacity: float) -> None:
    rim = joints[ring(joints)[:-1]]
    fan = np.arange(1, len(rim) - 1)
    faces = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
    server.scene.add_mesh_simple(name, rim, faces, color=rgb(color), opacity=opacity, flat_shading=True, side="double")


def _outline(server: viser.ViserServer, name: str, joints: Array, color: str, thickness: float) -> Any:
    rim = joints[ring(joints)]
    edges = np.stack([rim[:-1], rim[1:]], axis=1).astype(np.float32)
    return server.scene.add_line_segments(name, edges, rgb(color), thickness=thickness)
