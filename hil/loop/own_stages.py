"""Stages of the user's own in a cycle, as functions in Python, and what these see of it.

    leg filters -> directions(cycle) -> pose estimate -> pose(cycle) -> reference, PID -> command(cycle) -> checks

The compiled stages run as ever. What a function returns then replaces what its stage has found. So gough's own estimate is
there beside the user's, the IMUs are watched as without it, and every check of a pose or a command sees the user's.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.cycle import CycleStage
from controller.safety.causes import Mode, Request
from plant.compiled import Record
from plant.imu import ACCELEROMETER, GYROSCOPE, MAGNETOMETER
from plant.pose import Array, Pose, checked_array, checked_rotation, checked_unit
from plant.truth import TRUTH_LENGTHS, TRUTH_POSITION, TRUTH_QUATERNION


class Cycle:
    """What the loop knows in the present cycle, in SI units: read-only arrays that change with it.

    L is the number of legs; IMUs 0 to 5 are on the legs, 6 is on the platform. What a stage finds is that of the last cycle
    until the stage has run.

    Attributes:
        period: time from one cycle to the next [s].
        angular_velocity, specific_force, magnetic_field: (7, 3) each [rad/s, m/s^2, uT], calibrated readings of the IMUs, each
            in its own axes.
        vertical: (3,), unit, seen in {2}.
        position, rotation: (3,) [m] and (3, 3), the estimated pose of {2} in {1}.
        twist: (6,), velocity and angular velocity of {2} in {1} [m/s, rad/s].
        lengths: (L,) [m], of the legs at the estimated pose.
        reference: (L, 3), length, rate and acceleration of each leg [m, m/s, m/s^2].
        deviation: (L,) [m], reference less length.
        feed_forward: (L,) [m/s], the reference's rate, and what load, friction and delay need beside it.
        command: (L,) [m/s], velocity of each drive.
        measured_lengths: (L,) [m], by encoders; NaN without them.
        true_position, true_quaternion, true_lengths: (3,) [m], (4,) w first, (L,) [m]; NaN if the plant does not tell them.
    """

    def __init__(self, parameters: Record, state: Record, feedback: Record) -> None:
        p, s = parameters[()], state[()]
        legs = int(p["rig"]["legs"])
        self._rig, self._state = p["rig"], s
        self.period = float(p["rig"]["period"])
        sample, pose = s["imus"]["sample"], s["pose"]
        self.angular_velocity = _seen(sample[GYROSCOPE])
        self.specific_force = _seen(sample[ACCELEROMETER])
        self.magnetic_field = _seen(sample[MAGNETOMETER])
        self._directions, self._used = s["legs"]["directions"][:legs], s["legs"]["used"][:legs]
        self.vertical = _seen(s["platform"]["vertical"])
        self.position, self.rotation, self.twist = (_seen(pose[name]) for name in ("position", "rotation", "twist"))
        self.lengths = _seen(pose["lengths"][:legs])
        self.reference = _seen(s["reference"]["motion"][:legs])
        self.deviation = _seen(s["pid"]["error"][:legs])
        self.feed_forward = _seen(s["load"]["feed_forward"][:legs])
        self.command = _seen(s["pid"]["command"][:legs])
        self.measured_lengths = _seen(feedback["length"][:legs])
        truth = feedback["truth"]
        self.true_position, self.true_quaternion = _seen(truth[TRUTH_POSITION]), _seen(truth[TRUTH_QUATERNION])
        self.true_lengths = _seen(truth[TRUTH_LENGTHS][:legs])

    @property
    def number(self) -> int:
        """Periods since the first cycle."""
        return int(self._state["time"]["cycle"])

    @property
    def time(self) -> float:
        """Time of the motion [s]; negative while the brakes hold, and on the way to its start."""
        begin = int(self._rig["hold_cycles"]) + int(self._state["safety"]["arming"]["delay"])
        return (self.number - begin) * self.period

    @property
    def missed(self) -> int:
        """Periods that were missed before this cycle."""
        return int(self._state["time"]["missed"])

    @property
    def mode(self) -> Mode:
        """The state of the run."""
        return Mode(int(self._state["safety"]["mode"]))

    @property
    def driving(self) -> bool:
        """Whether the drives follow the commands of the motion; else they are braked, or the run stops."""
        return bool(self._state["safety"]["request"] == Request.ENABLED and self.mode == Mode.RUNNING)

    @property
    def directions(self) -> Array:
        """(L, 3), unit, of the legs in {1}, from base to platform joint; NaN for a leg whose direction is not used."""
        found: Array = np.where(self._used[:, None] != 0.0, self._directions, np.nan)
        return found

    @property
    def imus_used(self) -> NDArray[np.bool_]:
        """(7,), which IMUs the filters use."""
        used: NDArray[np.bool_] = self._state["imus"]["used"] != 0
        return used


def _seen(values: Array) -> Array:
    view = values.view()
    view.flags.writeable = False
    return view


@dataclass(frozen=True, eq=False)
class Stages:
    """Functions in place of stages of the cycle. Each takes the `Cycle`; those that are None stay gough's.

    Attributes:
        directions: the legs' directions (L, 3) in {1}, in place of the leg filters'; NaN for a leg without one. The rates stay
            those of the leg filters.
        pose: the pose of {2} in {1}, in place of direct kinematics, refinement and whole-mechanism filter; None if there is
            none, which ends the run by a quick stop. Twist, covariance and protection level stay those of gough's own estimate,
            but a pose that moves otherwise than commanded raises the level.
        command: the velocity of each drive (L,) [m/s], in place of feed-forward and PID; it is cut off at the largest command.
            It is asked for while the platform follows the motion. A controlled stop is gough's.
    """

    directions: Callable[[Cycle], ArrayLike] | None = None
    pose: Callable[[Cycle], Pose | None] | None = None
    command: Callable[[Cycle], ArrayLike] | None = None

    @property
    def names(self) -> dict[str, str]:
        """The module and name of each function, by stage."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        return {
            name: f"{getattr(each, '__module__', '')}.{getattr(each, '__qualname__', type(each).__name__)}"
            for name, each in given.items()
            if each is not None
        }


class Replacement(NamedTuple):
    """A function that runs before a stage of the compiled cycle. Its time counts as that of the stage `of`; where both are the
    same, it runs in place of that stage.
    """

    before: CycleStage
    of: CycleStage
    run: Callable[[], None]

    @property
    def then(self) -> CycleStage:
        """The stage with which the compiled cycle goes on."""
        return CycleStage(self.before + (self.of == self.before))


def replacements_of(stages: Stages, cycle: Cycle, parameters: Record, state: Record) -> list[Replacement]:
    """What a loop does for these stages."""
    p, s = parameters[()], state[()]
    legs, weight, made = int(p["rig"]["legs"]), float(p["legs"]["weight"]), []
    if (directions := stages.directions) is not None:

        def replace_directions() -> None:
            kept, own = s["legs"], checked_array(directions(cycle), (legs, 3), "what directions returns", allow_nan=True)
            for k, each in enumerate(own):
                known = not np.isnan(each).any()
                kept["used"][k], kept["weights"][k] = float(known), weight * known
                if known:
                    kept["directions"][k] = checked_unit(each, 3, f"the direction of leg {k}")

        made.append(Replacement(CycleStage.PLATFORM, CycleStage.LEGS, replace_directions))
    if (pose := stages.pose) is not None:

        def replace_pose() -> None:
            own, kept = pose(cycle), s["pose"]
            if own is not None:
                position = checked_array(own.position, (3,), "the position that pose returns")
                rotation = checked_rotation(own.rotation, "the rotation that pose returns")
                kept["position"], kept["rotation"] = position, rotation
            kept["found"] = own is not None

        made.append(Replacement(CycleStage.CONTROL, CycleStage.POSE, replace_pose))
    if (command := stages.command) is not None:

        def ask_for_command() -> None:
            if cycle.driving and s["pose"]["found"]:
                replace_command(parameters, state, cycle, command(cycle))

        made.append(Replacement(CycleStage.WATCH, CycleStage.CONTROL, ask_for_command))
    return made


def ordered(replacements: Iterable[Replacement]) -> list[Replacement]:
    """In the order in which they run."""
    return sorted(replacements, key=lambda each: (each.before, each.then))


def replace_command(parameters: Record, state: Record, cycle: Cycle, command: ArrayLike) -> None:
    """Put commands (L,) [m/s] in place of those of this cycle, if the platform follows the motion.

    Of other commands than its own the PID integrates nothing, as a stop would begin with it.

    Raises:
        InputError: their number is not that of the legs, or they are not finite.
    """
    legs, limit = int(parameters["rig"]["legs"]), float(parameters["pid"]["limit"])
    own = checked_array(command, (legs,), "the command")
    if cycle.driving and not np.array_equal(own, cycle.command):
        state["pid"]["command"][:legs] = np.clip(own, -limit, limit)
        state["pid"]["integral"] = 0.0
