"""Rigs: what a loop reads and drives, behind one small interface.

A rig is a simulated plant, an emulated rig in another process, a recording, or hardware. Once per cycle the loop *exchanges*
data with it: the commands of the previous cycle go out and take effect at once, and the sensors' present readings come in. On
a CANopen bus an exchange is a SYNC, on UDP it is one datagram in each direction. `hil.rigs.template` is a rig to start from,
and `hil.rigs.contract` checks any rig.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from controller.safety.causes import DriveState, Request
from plant.checks import printable
from plant.compiled import Record, record_dtype
from plant.dynamics.variables import IMU_COUNT
from plant.errors import GoughError
from plant.mechanism import LEGS
from plant.pose import Array
from plant.truth import TRUTH_SIZE

__all__ = [
    "ANSWERED", "BRAKED", "ENABLED", "FAULTY", "FEEDBACK", "FOLLOWING", "OFF", "QUICK_STOP", "QUICK_STOPPING", "READY",
    "SILENT", "DriveState", "Identity", "Request", "Rig", "RigError", "new_feedback",
]  # fmt: skip

BRAKED, ENABLED, QUICK_STOP = Request
FOLLOWING, READY, OFF, QUICK_STOPPING, FAULTY = DriveState
"""The requests to the drives and the states of a drive, as a rig of the user's own may name them."""

ANSWERED, SILENT = 0, 1
"""Statuses of an exchange. `ANSWERED`: the feedback is new. `SILENT`: no valid sample has arrived in time, and the feedback
still holds the last one, although the drives' states may be new. Any other status is a failure of the rig; it ends the run on
the brakes.
"""

FEEDBACK = record_dtype(
    measurement=(np.float64, (3, IMU_COUNT, 3)),  # raw [rad/s, m/s^2, uT]; NaN without an IMU
    sample_ns=(np.int64, IMU_COUNT),  # on the rig's own clock
    sequence=(np.int64, IMU_COUNT),  # number of the sample; stays the same when a sample is repeated
    drive=(np.int64, LEGS),  # DriveState
    drive_code=(np.int64, LEGS),  # fault code
    sent=(np.float64, LEGS),  # velocities after rounding and limits [m/s]
    length=(np.float64, LEGS),  # that each encoder reads [m]; NaN without one
    length_rate=(np.float64, LEGS),  # its rate [m/s]; NaN without one
    home=(np.int64, LEGS),  # 1 beyond the home switch, 0 before it, -1 without one
    base_imu=(np.float64, (2, 3)),  # raw, of an IMU on the base [rad/s, m/s^2]; NaN without one
    base_imu_ns=np.int64,  # on the rig's own clock
    base_imu_sequence=np.int64,  # number of the sample
    truth=(np.float64, TRUTH_SIZE),  # as the plant's buffer; NaN unless the rig is emulated
    round_trip_ns=np.int64,  # from the request to the answer
    refused=np.int64,  # frames or packets since the rig was opened
)
"""The result of an exchange: angular velocity, specific force and magnetic field of the seven IMUs, and the drives' states."""


def new_feedback() -> Record:
    """Feedback (dtype `FEEDBACK`) of a rig that has sent nothing yet."""
    feedback: Record = np.zeros((), FEEDBACK)
    feedback["measurement"], feedback["truth"], feedback["sequence"] = np.nan, np.nan, -1
    feedback["length"], feedback["length_rate"], feedback["home"] = np.nan, np.nan, -1
    feedback["base_imu"], feedback["base_imu_sequence"] = np.nan, -1
    return feedback


class RigError(GoughError, RuntimeError):
    """A rig cannot be opened, differs from its configuration, or cannot be armed; nothing has moved then."""


@dataclass(frozen=True)
class Identity:
    """What a rig is.

    Attributes:
        name: of the rig, for messages.
        parts: its parts, such as drives and IMUs with their versions, for the recording.
    """

    name: str
    parts: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Devices name themselves.
        object.__setattr__(self, "name", printable(self.name))
        object.__setattr__(self, "parts", {printable(name): printable(part) for name, part in self.parts.items()})


class Rig(Protocol):
    """A rig. The order of calls is `open`, `identify`, `arm`, then `exchange` once per cycle, `quick_stop`, `close`.

    Attributes:
        command_delay: time from the exchange that takes a sample to the exchange at which the command computed from it takes
            effect [s]; on a bus, one period.

    A rig may also have an attribute `failure`: a text that says why an exchange has failed.
    """

    command_delay: float

    def open(self) -> None:
        """Open the bus and prepare the nodes. Nothing moves and no brake opens.

        Raises:
            RigError: the rig cannot be reached.
        """

    def identify(self) -> Identity:
        """Ask every part for its identity.

        Raises:
            RigError: a part is missing, or differs from the configuration.
        """

    def arm(self) -> None:
        """Make the drives ready to be enabled by an exchange. They stay on their brakes.

        Raises:
            RigError: a drive cannot be made ready; the message gives the drive's own reason.
        """

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """Send the commands (6,) [m/s] and the `Request` to the drives, and fill in the `feedback` (dtype `FEEDBACK`).

        Returns `ANSWERED`, `SILENT`, or a failure. It must return within the period, and should allocate little memory.
        """

    def quick_stop(self) -> None:
        """Stop all drives and let them hold. It must not raise, and may be called at any time and repeatedly."""

    def close(self) -> None:
        """Leave the drives on their brakes, and release the bus. It must not raise, and may be called twice."""


def missing_members(rig: object) -> list[str]:
    """The methods and attributes of `Rig` that an object lacks; of a class, the methods."""
    methods = ("open", "identify", "arm", "exchange", "quick_stop", "close")
    missing = [name for name in methods if not callable(getattr(rig, name, None))]
    return missing if isinstance(rig, type) or hasattr(rig, "command_delay") else [*missing, "command_delay"]
