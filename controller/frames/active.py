"""The enabled work frame and tool: poses, velocities and covariances in them, and moves along them.

The platform's pose is that of {2} in the *root* of the work frame: {1}, or the level frame if the work frame stands on that
(`level_from_base` leads there). The tool's pose is that in the work frame. Poses may be many, as in `controller.frames.rigid`.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from controller.frames.rigid import compose, inverse, transfer, transposed, turned
from controller.frames.tree import PLATFORM, ROOTS, Frames, Pivot
from plant.errors import InputError
from plant.pose import Array, Pose, checked_array, rotation_from_vector, vector_from_rotation


@dataclass(frozen=True, eq=False)
class Move:
    """A move from where the platform is: the pivot is shifted, and the platform turns about it.

    Attributes:
        translation: (3,), of the pivot [m].
        rotation_vector: (3,), the turn about the pivot [rad].
        axes: the frame along whose axes both are, as these are where the move begins; None for the work frame.
    """

    translation: ArrayLike = (0.0, 0.0, 0.0)
    rotation_vector: ArrayLike = (0.0, 0.0, 0.0)
    axes: str | None = None


@dataclass(frozen=True, eq=False)
class ActiveFrames:
    """The enabled pair of `Frames`.

    Raises:
        InputError: the pivot stands on a root that is neither the platform nor that of the work frame.
    """

    frames: Frames

    def __post_init__(self) -> None:
        if self.frames.pivot is not None:
            self._check_root(self.frames.pivot.parent, "the pivot")

    @cached_property
    def root(self) -> str:
        """What the work frame stands on in the end: `base` or `level`."""
        return self.frames.root(self.frames.work)

    @property
    def absolute(self) -> bool:
        """Whether a target is the pose of the tool in the work frame; in `base` and `level` it is a displacement from home."""
        return self.frames.work not in ROOTS

    @property
    def text(self) -> str:
        """The pair in words."""
        return f"{self.frames.tool} in {self.frames.work}"

    def described(self) -> dict[str, str]:
        """The names of the pair and of the work frame's root, for figures."""
        return {"work": self.frames.work, "tool": self.frames.tool, "root": self.root}

    @cached_property
    def work(self) -> Pose:
        """The work frame in its root."""
        return self.frames.place(self.frames.work)

    @cached_property
    def tool(self) -> Pose:
        """The tool in the platform."""
        return self.frames.place(self.frames.tool)

    def read(self, platform: Pose) -> Pose:
        """The pose of the tool in the work frame."""
        return compose(inverse(self.work), compose(platform, self.tool))

    def platform(self, tool: Pose) -> Pose:
        """The pose of the platform at which the tool has this pose in the work frame."""
        return compose(self.work, compose(tool, inverse(self.tool)))

    def read_twist(self, platform: Pose, twist: Array) -> Array:
        """The twist (..., 6) of the tool in the work frame, from that of the platform in the root."""
        return turned(self._jacobian(platform), twist)

    def platform_twist(self, platform: Pose, twist: Array) -> Array:
        """The twist (..., 6) of the platform in the root, from that of the tool in the work frame."""
        return turned(self._inverse_jacobian(platform), twist)

    def read_covariance(self, platform: Pose, covariance: Array) -> Array:
        """The covariance (..., 6, 6) of the tool's pose in the work frame, from that of the platform's; both are of small
        translations [m] and rotation vectors [rad] in the axes of their frames.
        """
        return _propagated(self._jacobian(platform), covariance)

    def platform_covariance(self, platform: Pose, covariance: Array) -> Array:
        """The covariance (..., 6, 6) of the platform's pose, from that of the tool's in the work frame."""
        return _propagated(self._inverse_jacobian(platform), covariance)

    def _jacobian(self, platform: Pose) -> Array:
        return transfer(self.work.rotation, turned(platform.rotation, self.tool.position))

    def _inverse_jacobian(self, platform: Pose) -> Array:
        arm = turned(transposed(self.work.rotation) @ platform.rotation, self.tool.position)
        return transfer(transposed(self.work.rotation), -arm)

    def pivot(self, platform: Pose) -> Array:
        """Where the centre of rotation (..., 3) is in the root [m]: the pivot, or else the tool's origin."""
        pivot = self.frames.pivot or Pivot(self.frames.tool)
        point = compose(self.frames.place(pivot.parent), Pose(pivot.position, np.eye(3))).position
        if self.frames.root(pivot.parent) == PLATFORM:
            return platform.position + turned(platform.rotation, point)
        return point

    def axes(self, platform: Pose, name: str | None = None) -> Array:
        """The rotation (..., 3, 3) that maps the axes of a frame, by default the work frame, to those of the root.

        Raises:
            UnknownNameError: there is no such frame.
            InputError: it stands on another root.
        """
        name = self.frames.work if name is None else name
        self._check_root(name, name)
        rotation = self.frames.place(name).rotation
        return platform.rotation @ rotation if self.frames.root(name) == PLATFORM else rotation

    def moved(self, platform: Pose, move: Move, share: ArrayLike = 1.0) -> Pose:
        """The pose of the platform after a move, or after shares (...) of it: the pivot goes straight, at a constant rate of
        turn.

        Raises:
            UnknownNameError, InputError: the move's axes cannot be used, or it is not finite.
        """
        translation = checked_array(move.translation, (3,), "translation")
        vector = checked_array(move.rotation_vector, (3,), "rotation_vector")
        axes, shares = self.axes(platform, move.axes), np.asarray(share, float)[..., None]
        turns = np.array([rotation_from_vector(each) for each in (shares * vector).reshape(-1, 3)]).reshape(
            *shares.shape[:-1], 3, 3
        )
        return self._displaced(platform, axes, shares * translation, turns)

    def rate(self, platform: Pose, move: Move) -> Array:
        """The twist (6,) of the platform while it makes a move in each second, as when it is jogged: [m/s, rad/s] in the root.

        Raises:
            UnknownNameError, InputError: the move's axes cannot be used, or it is not finite.
        """
        axes = self.axes(platform, move.axes)
        angular = axes @ checked_array(move.rotation_vector, (3,), "rotation_vector")
        velocity = axes @ checked_array(move.translation, (3,), "translation")
        return np.concatenate([velocity + np.cross(angular, platform.position - self.pivot(platform)), angular])

    def move_between(self, first: Pose, last: Pose, axes: str | None = None) -> Move:
        """The move from one pose of the platform to another, along the axes of a frame; the turn is at most half a turn.

        Raises:
            UnknownNameError, InputError: the axes cannot be used.
        """
        rotation = self.axes(first, axes)
        translation, turn = self._displacement(first, last, rotation)
        return Move(translation, vector_from_rotation(turn), axes)

    def displaced(self, home: Pose, translations: Array, turns: Array) -> Pose:
        """The poses of the platform that are displaced from home by translations (..., 3) [m] of the pivot, and by turns
        (..., 3, 3) about it, along the axes of the work frame.
        """
        return self._displaced(home, self.work.rotation, translations, turns)

    def displacement(self, home: Pose, platform: Pose) -> tuple[Array, Array]:
        """The translations (..., 3) [m] and turns (..., 3, 3) from home to poses of the platform, as for `displaced`."""
        return self._displacement(home, platform, self.work.rotation)

    def from_target(self, home: Pose, positions: Array, rotations: Array) -> Pose:
        """The poses of the platform that a target means: poses of the tool in the work frame if that is `absolute`, else
        displacements from home.
        """
        return self.platform(Pose(positions, rotations)) if self.absolute else self.displaced(home, positions, rotations)

    def to_target(self, home: Pose, platform: Pose) -> tuple[Array, Array]:
        """The positions (..., 3) and rotations (..., 3, 3) by which a target means these poses."""
        if not self.absolute:
            return self.displacement(home, platform)
        tool = self.read(platform)
        return tool.position, tool.rotation

    def _displaced(self, start: Pose, axes: Array, translations: Array, turns: Array) -> Pose:
        pivot = self.pivot(start)
        turn = axes @ turns @ transposed(axes)
        position = pivot + turned(turn, start.position - pivot) + turned(axes, translations)
        return Pose(position, turn @ start.rotation)

    def _displacement(self, start: Pose, end: Pose, axes: Array) -> tuple[Array, Array]:
        pivot = self.pivot(start)
        turn = end.rotation @ transposed(start.rotation)
        shift = end.position - pivot - turned(turn, start.position - pivot)
        return turned(transposed(axes), shift), transposed(axes) @ turn @ axes

    def _check_root(self, name: str, what: str) -> None:
        root = self.frames.root(name)
        if root not in (PLATFORM, self.root):
            raise InputError(
                f"{what} stands on {root}, and the work frame {self.frames.work!r} on {self.root}, which move against "
                f"each other: let it stand on {self.root} or platform"
            )


def _propagated(matrix: Array, covariance: Array) -> Array:
    propagated: Array = matrix @ covariance @ transposed(matrix)
    return propagated
