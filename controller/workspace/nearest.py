"""The reachable pose that is nearest to one that is not."""

from dataclasses import dataclass

import numpy as np

from controller.pose_limits.limits import USUAL, Demands, spread_of
from controller.pose_limits.margins import checked_poses, margins
from plant.errors import UnreachableError
from plant.extras import check_installed
from plant.mechanism import Mechanism
from plant.mechanism.loads import moving_axes
from plant.pose import Array, Pose, rotation_from_vector, vector_from_rotation

_STEPS = 40
_DIFFERENCE = 1e-6
"""Step of the derivatives, as a move of the platform's joints [m]."""

_ROOM = 1e-6
"""Share of a limit that is kept, so that the pose is reachable in spite of rounding."""

_SETTLED_M = 1e-9
_HALVINGS, _LOOKS, _BISECTIONS = 12, 101, 30


@dataclass(frozen=True, eq=False)
class Nearest:
    """A reachable pose.

    Attributes:
        pose: it is within all limits.
        distance: of its origin from that of the pose that was asked for [m].
        angle: of the turn between the two [rad].
    """

    pose: Pose
    distance: float
    angle: float


def nearest_reachable(mechanism: Mechanism, pose: Pose, demands: Demands | None = None, start: Pose | None = None) -> Nearest:
    """The reachable pose nearest to another, with turns at the greatest distance of a platform joint from their centre.

    Of the limits, linearised where the search is, the nearest point within all is found by least squares under inequalities
    (Lawson and Hanson 1974, ch. 23), again and again. It begins at the pose itself, and where a straight move there ends. What
    is found is reachable, and nearest in its neighbourhood; a search of all poses might find another one.

    Args:
        mechanism: as for `margins`.
        pose: that should be reached.
        demands: as for `margins`.
        start: a reachable pose from which a straight move begins; by default home.

    Raises:
        UnreachableError: none is found, as not even the start is reachable.
        InputError: as for `margins`.
        MissingPackageError: scipy is not installed.
    """
    check_installed("scipy")
    demands, start = demands or USUAL, start or mechanism.require_home()
    checked_poses(mechanism, pose.position[None], pose.rotation[None])
    search = _Search(mechanism, pose, demands)
    if (search.margins(np.zeros((1, 6))) >= 0.0).all():
        return Nearest(pose, 0.0, 0.0)
    ended = search.last_towards(search.place_of(start))
    tried = [search.improved(np.zeros(6)), *([] if ended is None else [search.improved(ended), ended])]
    found = [each for each in tried if each is not None]
    if not found:
        raise UnreachableError(
            f"no pose of {mechanism.name!r} near {pose.position.tolist()} m is reachable, nor is that from which a move would "
            "begin: begin at another pose"
        )
    best = min(found, key=lambda place: float(np.linalg.norm(place)))
    reached = Pose(*(part[0] for part in search.poses(best[None])))
    return Nearest(reached, float(np.linalg.norm(best[:3])), float(np.linalg.norm(best[3:])) / search.spread)


class _Search:
    """Places (6,) about a pose: a displacement and a rotation vector times the spread of the joints [m]."""

    def __init__(self, mechanism: Mechanism, pose: Pose, demands: Demands) -> None:
        self._mechanism, self._pose, self._demands = mechanism, pose, demands
        self.spread = spread_of(mechanism)
        self._free = np.eye(6)[list(moving_axes(mechanism))]

    def place_of(self, pose: Pose) -> Array:
        turn = vector_from_rotation(pose.rotation @ self._pose.rotation.T)
        return np.concatenate([pose.position - self._pose.position, self.spread * turn])

    def poses(self, places: Array) -> tuple[Array, Array]:
        rotations = [rotation_from_vector(place[3:] / self.spread) @ self._pose.rotation for place in places]
        return self._pose.position + places[:, :3], np.array(rotations)

    def margins(self, places: Array) -> Array:
        """Margins (N, m) over their scales."""
        found = margins(self._mechanism, *self.poses(places), self._demands, workers=1)
        shares: Array = np.nan_to_num(found.values / found.scales, nan=-np.inf, posinf=np.inf)
        return shares

    def last_towards(self, start: Array) -> Array | None:
        """The last reachable place on the way from a start to the pose itself; None if the start is not reachable."""
        shares = np.linspace(1.0, 0.0, _LOOKS)
        out = np.flatnonzero(~(self.margins(shares[:, None] * start) >= 0.0).all(axis=1))
        if not len(out) or out[0] == 0:
            return None
        high, low = shares[out[0] - 1], shares[out[0]]
        for _ in range(_BISECTIONS):
            middle = 0.5 * (high + low)
            high, low = (middle, low) if (self.margins(middle * start[None]) >= 0.0).all() else (high, middle)
        last: Array = high * start
        return last

    def improved(self, place: Array) -> Array | None:
        """The nearest reachable place that a search from this one finds; None if it finds none."""
        best: Array | None = None
        for _ in range(_STEPS):
            steps = _DIFFERENCE * self._free
            shares = self.margins(np.vstack([place, place + steps, place - steps]))
            limited = np.isfinite(shares).all(axis=0) & (shares[0] < 1.0 - _ROOM)
            here, count = shares[0, limited], len(steps)
            slopes = (shares[1 : 1 + count, limited] - shares[1 + count :, limited]).T / (2.0 * _DIFFERENCE)
            aim = _least_distance(slopes, slopes @ (self._free @ place) - here + _ROOM)
            if aim is None:
                return best
            aimed = self._free.T @ aim
            # As far towards it as the worst limit improves, or, within all, as the distance does.
            worst, moved = min(float(here.min(initial=np.inf)), 0.0), False
            for halving in range(_HALVINGS):
                tried = place + 0.5**halving * (aimed - place)
                left = min(float(self.margins(tried[None]).min()), 0.0)
                if left > worst or (left == 0.0 and np.linalg.norm(tried) < np.linalg.norm(place)):
                    moved = float(np.linalg.norm(tried - place)) > _SETTLED_M
                    place = tried
                    break
            if (self.margins(place[None]) >= 0.0).all() and (best is None or np.linalg.norm(place) < np.linalg.norm(best)):
                best = place
            if not moved:
                break
        return best


def _least_distance(slopes: Array, least: Array) -> Array | None:
    """The shortest vector x (n,) with slopes (m, n) @ x >= least (m,); None if there is none."""
    # Only a target that is refused needs it, and no loop runs then.
    from scipy.optimize import nnls

    steepness = np.linalg.norm(slopes, axis=1)
    kept = steepness > 0.0
    slopes, least = slopes[kept] / steepness[kept, None], least[kept] / steepness[kept]
    unit = np.append(np.zeros(slopes.shape[1]), 1.0)
    # In units in which the farthest limit is one away, so that the residual is no rounding.
    size = max(float(np.abs(least).max(initial=0.0)), _SETTLED_M)
    dual, _ = nnls(np.vstack([slopes.T, least / size]), unit)
    residual = np.append(slopes.T @ dual, least @ dual / size) - unit
    if abs(residual[-1]) < 1e-9:
        return None
    found: Array = -size * residual[:-1] / residual[-1]
    return found
