"""Rigs: what a loop reads and drives, behind one small interface.

A rig is a simulated plant, an emulated rig in another process, a recording, or hardware. Once per cycle the loop *exchanges*:
the commands of the cycle before go out, to take effect now, and what the sensors read now comes in. That is a SYNC on a CANopen
bus, and one datagram in each direction on UDP. `hil.rigs.template` is a rig to start from, and `hil.rigs.contract` checks any
rig.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from controller.safety.watch import BRAKED, ENABLED, FAULTY, FOLLOWING, OFF, QUICK_STOP, QUICK_STOPPING, READY
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.errors import GoughError
from plant.fmu.plant import CALLS
from plant.mechanism import LEGS
from plant.pose import Array

__all__ = [
    "ANSWERED", "BRAKED", "ENABLED", "FAULTY", "FEEDBACK", "FOLLOWING", "OFF", "QUICK_STOP", "QUICK_STOPPING", "READY",
    "SILENT", "Identity", "Rig", "RigError", "new_feedback",
]  # fmt: skip

ANSWERED, SILENT = 0, 1
"""Statuses of an exchange: the feedback is of now; no sound sample has come in time, and the feedback is the last one, but for
what drives may have said. Any other is a failure of the rig's own that ends the run on the brakes.
"""

FEEDBACK = np.dtype(
    [
        ("measurement", np.float64, (3, IMU_COUNT, 3)),
        ("sample_ns", np.int64, IMU_COUNT),
        ("sequence", np.int64, IMU_COUNT),
        ("drive", np.int64, LEGS),
        ("drive_code", np.int64, LEGS),
        ("sent", np.float64, LEGS),
        ("truth", np.float64, CALLS["truth"].shape),
        ("round_trip_ns", np.int64),
        ("refused", np.int64),
    ],
    align=True,
)
"""What an exchange brings.

Raw IMU data as everywhere: angular velocity [rad/s], specific force [m/s^2], magnetic field [uT] of the seven IMUs, NaN where
there is none; the time of each IMU's sample on the rig's own clock [ns], and its number, which stands when a sample is
repeated; what each drive says (`OFF`, `READY`, `FOLLOWING`, `QUICK_STOPPING`, `FAULTY`) and its own fault code; the velocities
that were really sent, after rounding and limits [m/s]; the truth as the plant's `truth` buffer has it, NaN unless the rig is
emulated; from the request to the answer [ns]; and how many frames or packets have been refused since the rig was opened.
"""


def new_feedback() -> Record:
    """Feedback (dtype `FEEDBACK`) of a rig that has not said anything."""
    feedback: Record = np.zeros((), FEEDBACK)
    feedback["measurement"], feedback["truth"], feedback["sequence"] = np.nan, np.nan, -1
    return feedback


class RigError(GoughError, RuntimeError):
    """A rig cannot be opened, is not what the configuration says, or cannot be armed; nothing has moved then."""


@dataclass(frozen=True)
class Identity:
    """What a rig is.

    Attributes:
        name: of the rig, for messages.
        parts: its parts, such as drives and IMUs with their versions, for the record.
    """

    name: str
    parts: dict[str, str] = field(default_factory=dict)


class Rig(Protocol):
    """A rig. The order of calls is `open`, `identify`, `arm`, then `exchange` once per cycle, `quick_stop`, `close`.

    Attributes:
        command_delay: from an exchange in which a sample is taken to the one by which the command computed from it takes effect
            [s]: one period, on a bus.

    A rig may also have `failure`, a text that tells why an exchange has failed.
    """

    command_delay: float

    def open(self) -> None:
        """Take hold of the bus and prepare the nodes; nothing moves and no brake opens.

        Raises:
            RigError: it cannot be reached.
        """

    def identify(self) -> Identity:
        """Ask every part who it is.

        Raises:
            RigError: a part is missing, or another than the configuration says.
        """

    def arm(self) -> None:
        """Make the drives ready to be asked for by an exchange; they stay on their brakes.

        Raises:
            RigError: a drive cannot be made ready, its own reason in the message.
        """

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """Send the commands (6,) [m/s] and what is asked of the drives (`BRAKED`, `ENABLED`, `QUICK_STOP`), and fill in the
        `feedback` (dtype `FEEDBACK`); returns `ANSWERED`, `SILENT`, or a failure. It must return within the period, and
        allocate as little as it can.
        """

    def quick_stop(self) -> None:
        """Stop all drives and let them hold, whatever has happened. It cannot raise, and may be called at any time, twice
        too.
        """

    def close(self) -> None:
        """Let go of the bus, the drives on their brakes. It cannot raise, and may be called twice."""
