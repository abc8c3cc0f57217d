"""Where a mechanism can go, and what limits it where: what `gough workspace` prints and draws."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from controller.workspace import (
    AXES,
    KINDS,
    LIMITS,
    Demands,
    Margins,
    Reach,
    Region,
    Slice,
    Travel,
    largest_box,
    largest_ellipsoid,
    margins,
    poses_about,
    reach_from,
    slice_about,
    travel,
)
from plant.dynamics.variables import TINY
from plant.errors import InputError
from plant.mechanism import Mechanism, PlanarMechanism
from plant.mechanism.documents import mechanism_document, mechanism_from_document, mechanism_text, set_entry
from plant.mechanism.joint_circles import ENTRIES, reshaped_entries
from plant.mechanism.loads import moving_axes
from plant.pose import Array, Pose

_PLANES = (("x", "y"), ("x", "z"), ("y", "z"), ("rx", "ry"))


@dataclass(frozen=True, eq=False)
class Workspace:
    """Where a mechanism can go from a pose.

    Attributes:
        label: "as it is", or the changes.
        margins: at the pose.
        travels: by direction, such as "+x" or "-rz".
        reach, turns: what straight moves, and turns in place, reach.
        box, ellipsoid: the largest ones of a shape.
        slices: through the pose.
    """

    label: str
    mechanism: Mechanism
    pose: Pose
    margins: Margins
    travels: Mapping[str, Travel]
    reach: Reach
    turns: Reach
    box: Region
    ellipsoid: Region
    slices: Sequence[Slice]

    def least(self, kind: str) -> tuple[float, str]:
        """The least margin of a kind at the pose, and whose it is; infinite and "" without such a limit."""
        chosen = [number for number, limit in enumerate(LIMITS) if limit.kind == kind]
        least = min(chosen, key=lambda number: float(self.margins.values[0, number]))
        value = float(self.margins.values[0, least])
        return value, LIMITS[least].text if value < np.inf else ""

    def summary(self) -> dict[str, Any]:
        """All figures in SI units."""
        at_pose = self.margins.values[0]
        return {
            "label": self.label,
            "mechanism": self.mechanism.name,
            "position": self.pose.position,
            "rotation": self.pose.rotation,
            "margins": {limit.text: float(value) for limit, value in zip(LIMITS, at_pose, strict=True) if value < np.inf},
            "travels": {
                name: {"distance": each.distance, "angle": each.angle, "limit": each.limit.text if each.limit else None}
                for name, each in self.travels.items()
            },
            "reach": _of_reach(self.reach),
            "turns": _of_reach(self.turns),
            "box": _of_region(self.box),
            "ellipsoid": _of_region(self.ellipsoid),
            "slices": [
                {
                    "axes": each.axes,
                    "columns": each.columns,
                    "rows": each.rows,
                    "reachable": each.reachable,
                    "binding": [[LIMITS[number].text for number in row] for row in each.binding],
                }
                for each in self.slices
            ],
        }


def changed_mechanism(name: str, changes: Sequence[str]) -> Mechanism:
    """A mechanism, seen in space, with other entries of its file, each a text such as "limits.stroke=[-0.05,0.05]".

    `geometry.base_radius` and the other numbers of `plant.mechanism.joint_circles` move whole rings of joints.

    Raises:
        GoughError: a text without a TOML value, or no such mechanism.
    """
    document = mechanism_document(mechanism_text(name), name)
    numbers: dict[str, Any] = {}
    for text in changes:
        entry, equals, value = text.partition("=")
        try:
            parsed = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            equals = ""
        if not (entry and equals):
            raise InputError(f"--set {text!r} is no ENTRY=VALUE such as limits.stroke=[-0.05,0.05] or joints.base_swing=0.6")
        table, _, number = entry.partition(".")
        if table == "geometry" and number in ENTRIES:
            numbers[number] = parsed
        else:
            set_entry(document, entry, parsed)
    if numbers:
        for entry, joints in reshaped_entries(mechanism_from_document(document), numbers).items():
            set_entry(document, entry, joints)
    mechanism = mechanism_from_document(document)
    return Mechanism.from_planar(mechanism) if isinstance(mechanism, PlanarMechanism) else mechanism


def explore(
    mechanism: Mechanism, label: str, move: Array, shape: Array, demands: Demands, points: int, absolute: Array | None = None
) -> Workspace:
    """Find where a mechanism can go.

    Args:
        mechanism: with home and stroke.
        label: what the results are called.
        move: (6,), from home to the pose about which is looked, along `AXES` [m, rad].
        shape: (6,), of box and ellipsoid.
        demands: as for `margins`.
        points: of a slice, along an edge.
        absolute: (3,), the position in {1} instead of the move's [m].

    Raises:
        InputError: as `travel`, or the pose is out of the plane.
        UnreachableError: the pose exceeds a limit.
    """
    positions, rotations = poses_about(mechanism.require_home(), move[None])
    if absolute is not None:
        positions = absolute[None]
    pose, moving = Pose(positions[0], rotations[0]), moving_axes(mechanism)
    at_pose = margins(mechanism, positions, rotations, demands)
    travels = {}
    for axis in moving:
        for name, sign in (("+", 1.0), ("-", -1.0)):
            travels[name + AXES[axis]] = travel(mechanism, pose, sign * np.eye(6)[axis], demands)
    known = {AXES[axis] for axis in moving}
    planes = [plane for plane in _PLANES if {*plane} <= known]
    return Workspace(
        label,
        mechanism,
        pose,
        at_pose,
        travels,
        reach_from(mechanism, pose, demands),
        reach_from(mechanism, pose, demands, turning=True),
        largest_box(mechanism, pose, shape, demands),
        largest_ellipsoid(mechanism, pose, shape, demands),
        [slice_about(mechanism, pose, plane, demands, points) for plane in planes],
    )


def by_kind(shares: Mapping[Any, float]) -> dict[str, float]:
    """Shares of directions by the kind of the limit that ends them, the largest first."""
    found = {kind: sum(share for limit, share in shares.items() if limit.kind == kind) for kind in KINDS}
    return dict(sorted(((kind, share) for kind, share in found.items() if share > 0.0), key=lambda each: -each[1]))


def summary(found: Sequence[Workspace], demands: Demands) -> dict[str, Any]:
    """All figures in SI units."""
    asked = {"twist": demands.twist, "load": demands.load, "forces": demands.forces, "conditioning": demands.conditioning}
    return {"version": version("gough"), "demands": asked, "workspaces": [each.summary() for each in found]}


def _of_reach(reach: Reach) -> dict[str, Any]:
    return {"volume": reach.volume, "shares": {limit.text: share for limit, share in reach.shares.items()}}


def _of_region(region: Region) -> dict[str, Any]:
    limit = region.limit.text if region.limit else None
    return {"half_sizes": region.half_sizes, "limit": limit, "position": region.pose.position, "rotation": region.pose.rotation}


def shape_from(numbers: Sequence[float]) -> Array:
    """The shape of a region from numbers in mm and deg; a side of 0 is left out."""
    shape = np.array(numbers, np.float64) * np.repeat([1e-3, np.radians(1.0)], 3)
    found: Array = np.where(shape < TINY, np.minimum(shape, 0.0), shape)
    return found
