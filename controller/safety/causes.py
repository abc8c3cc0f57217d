"""The states of a run, what is asked of the drives, and every cause that ends or degrades a run.

    idle --checks pass, drives are enabled--> armed --all drives follow--> running
    running --> stopping --> stopped            a controlled stop, within the limits of the actuators
    any --> fault                               a quick stop without the estimate, or the brakes at once

No command is sent before `Mode.RUNNING`. Every cause is reported as an event, with the leg or IMU, the value and its limit.
"""

from enum import IntEnum

import numpy as np

from plant.compiled import Record, kernel, record_dtype


class Mode(IntEnum):
    """The state of a run."""

    IDLE, ARMED, RUNNING, STOPPING, STOPPED, FAULT = range(6)


class Request(IntEnum):
    """What the controller asks of the drives.

    BRAKED: hold on the brakes. ENABLED: follow the commands. QUICK_STOP: stop by yourselves, then hold.
    """

    BRAKED, ENABLED, QUICK_STOP = range(3)


class DriveState(IntEnum):
    """What a drive reports of itself.

    FOLLOWING: it follows the commands; a drive without states of its own always does. READY: it holds and can be enabled.
    NOT_READY: it has no power or is not ready. QUICK_STOPPING: it stops by itself. FAULTY: it has a fault.
    """

    FOLLOWING, READY, NOT_READY, QUICK_STOPPING, FAULTY = range(5)


class Reaction(IntEnum):
    """What a cause leads to; the larger the number, the more severe."""

    GO_ON, STOP, QUICK_STOP, BRAKE = range(4)

    @property
    def text(self) -> str:
        """In words."""
        return ("goes on", "controlled stop", "quick stop", "brakes at once")[self]


_WORST = ", the worst is IMU {}"


class Cause(IntEnum):
    """Why something happened. A cause whose reaction is `GO_ON` is reported and ends nothing.

    Attributes:
        text: the cause in words; {} is the number of the leg or IMU.
        reaction: what the cause leads to.
        unit: of its value and limit.
    """

    def __new__(cls, number: int, *_: object) -> "Cause":
        """A member whose value is its number."""
        member = int.__new__(cls, number)
        member._value_ = number
        return member

    def __init__(self, number: int, text: str = "", reaction: Reaction = Reaction.GO_ON, unit: str = "") -> None:
        self.text, self.reaction, self.unit = text, reaction, unit  # type: ignore[misc]

    NONE = 0, "none", Reaction.GO_ON
    END_OF_MOTION = 1, "end of the motion", Reaction.STOP
    STOP_REQUESTED = 2, "asked for", Reaction.STOP
    MISSED_PERIODS = 3, "too many periods missed in a row", Reaction.STOP, "periods"
    SUPERVISOR_GONE = 4, "the supervising process has gone", Reaction.STOP
    EMERGENCY_STOP = 5, "emergency stop", Reaction.QUICK_STOP
    CLOCK_FAILED = 6, "this machine's clock refuses to wake the loop", Reaction.BRAKE
    RIG_FAILED = 7, "the rig reports failure", Reaction.BRAKE
    IMU_STALE = 8, "IMU {} is left out: its samples are stale", Reaction.GO_ON, "cycles"
    IMU_FROZEN = 9, "IMU {} is left out: it is frozen", Reaction.GO_ON, "cycles"
    IMU_NOT_FINITE = 10, "IMU {} is left out: its readings are not finite", Reaction.GO_ON
    IMU_OUT_OF_RANGE = 11, "IMU {} is left out: it is at the end of its range", Reaction.GO_ON, "of the range"
    IMU_NOISY = 12, "IMU {} is left out: it is noisy", Reaction.GO_ON, "of the limit"
    IMU_DISAGREES = 13, "IMU {} is left out: it disagrees with the others", Reaction.GO_ON, "rad"
    IMU_BACK = 14, "IMU {} is used again", Reaction.GO_ON
    IMUS_LOST = 15, "too many IMUs are lost", Reaction.STOP, "IMUs"
    IMUS_DISAGREE = 16, f"the IMUs contradict each other{_WORST}", Reaction.STOP, "rad"
    POSE_LOST = 17, "the IMUs that can be used no longer determine the pose", Reaction.QUICK_STOP
    NOT_FINITE = 18, "an estimate or a command is no longer finite", Reaction.QUICK_STOP
    IMPLAUSIBLE = (
        19,
        "the estimated pose needs leg {} far outside its stroke: the IMUs' errors are larger than the filters assume (raw ones "
        "need a calibration)",
        Reaction.QUICK_STOP,
        "m",
    )
    ILL_CONDITIONED = 20, "the pose is badly determined", Reaction.STOP
    BEYOND_STROKE = 21, "leg {} is beyond its stroke", Reaction.STOP, "m"
    TOO_FAST = 22, "leg {} is too fast", Reaction.STOP, "m/s"
    FOLLOWING_ERROR = 23, "leg {} does not follow its reference", Reaction.STOP, "m"
    SATURATED = 24, "the command of leg {} stays at its limit", Reaction.STOP, "s"
    ANSWER_LATE = 25, "an exchange with the rig was late or its answer was refused", Reaction.GO_ON
    BUS_LOST = 26, "the bus is lost: the rig does not answer", Reaction.QUICK_STOP, "cycles"
    DRIVE_FAULT = 27, "drive {} reports a fault", Reaction.QUICK_STOP, "code"
    DRIVE_OFF = 28, "drive {} has left its operation", Reaction.QUICK_STOP
    DRIVE_DEVIATES = 29, "drive {} does not do what it is told", Reaction.BRAKE, "m/s"
    ARMED = 30, "armed", Reaction.GO_ON
    NO_SENSORS = (
        31,
        "not armed: IMU {} is not plausible: calibrate it if it is raw, else check where it is mounted",
        Reaction.STOP,
        "sigma",
    )
    NO_AGREEMENT = 32, "not armed: leg {} is not where the target begins", Reaction.STOP, "m"
    NO_WORKSPACE = 33, "not armed: leg {} is outside its stroke", Reaction.STOP, "m"
    NO_DRIVES = 34, "not armed: drive {} is not ready", Reaction.STOP
    TARGET_LOST = 35, "the target's stream has stopped", Reaction.STOP, "s"
    TARGET_JUMPS = 36, "the target jumps for leg {}", Reaction.STOP, "m"
    TARGET_NOT_FINITE = 37, "the target is not finite, or its quaternion is none", Reaction.STOP
    GYROSCOPES_SHARE = 38, "all gyroscopes share an error", Reaction.QUICK_STOP, "sigma"
    ACCELEROMETERS_SHARE = 39, "all accelerometers share an error", Reaction.QUICK_STOP, "sigma"
    BASE_TURNS = 40, "the base turns", Reaction.QUICK_STOP, "sigma"
    BASE_MOVES = 41, "the base tilts or accelerates", Reaction.QUICK_STOP, "sigma"
    RIVAL_IMU = 42, "it may as well be IMU {}", Reaction.GO_ON, "sigma"
    RIVAL_GYROSCOPES = 43, "it may as well be all gyroscopes", Reaction.GO_ON, "sigma"
    RIVAL_ACCELEROMETERS = 44, "it may as well be all accelerometers", Reaction.GO_ON, "sigma"
    RIVAL_BASE_TURNS = 45, "it may as well be a base that turns", Reaction.GO_ON, "sigma"
    RIVAL_BASE_MOVES = 46, "it may as well be a base that tilts or accelerates", Reaction.GO_ON, "sigma"
    IMU_CONTRADICTED = 47, "IMU {} is left out: the others contradict it", Reaction.GO_ON, "sigma"
    IMUS_CONTRADICT = 48, f"the IMUs contradict each other{_WORST}", Reaction.QUICK_STOP, "sigma"
    NO_TRUST = (
        49,
        "not armed: the IMUs share an error, or the base is not at rest: raw IMUs need a calibration",
        Reaction.STOP,
        "sigma",
    )
    NOT_STILL = (
        50,
        "not armed: the estimate of leg {} changes too much within 50 ms on closed brakes",
        Reaction.STOP,
        "m",
    )
    SHAKEN = 51, "the IMUs are shaken, the worst is IMU {}: accelerometers count less", Reaction.GO_ON, "m/s^2 RMS"
    BRIDGED = 52, "readings of IMU {} at the end of their range are bridged by the other sensors", Reaction.GO_ON
    CALM = 53, "the IMUs are no longer shaken", Reaction.GO_ON
    NOT_CARRIED = (
        54,
        "the accelerometers have been shaken for too long for gyroscopes to carry the pose",
        Reaction.STOP,
        "rad of uncertainty",
    )
    FILTER_DISAGREES = (
        55,
        "the whole-mechanism filter disagrees with the leg filters, which give the pose for a while",
        Reaction.GO_ON,
        "rad RMS",
    )
    GYROSCOPE_OFF = 58, "IMU {} is left out: its gyroscope contradicts the others", Reaction.GO_ON, "rad/s"
    GYROSCOPES_CONTRADICT = 59, f"the gyroscopes contradict each other{_WORST}", Reaction.QUICK_STOP, "rad/s"
    POSITION_UNSURE = 60, "the position may be off by more than the limit", Reaction.STOP, "m"
    ROTATION_UNSURE = 61, "the rotation may be off by more than the limit", Reaction.STOP, "rad"
    PLATFORM_IMU_LOST = (
        62,
        "without IMU {} nothing shows an error that the legs' IMUs share: need_platform_imu = 0 in [safety] goes on without it",
        Reaction.STOP,
        "s",
    )
    MOVED_OTHERWISE = (
        63,
        "the estimate of leg {} has moved otherwise than its drive was told to: the IMUs or the drive are wrong",
        Reaction.BRAKE,
        "m",
    )
    FORCES_SHARE = (
        64,
        "all accelerometers read a force that is no motion: they share an error, or the base tilts or accelerates",
        Reaction.QUICK_STOP,
        "m/s^2",
    )

    OSCILLATES = (
        65,
        "the commands oscillate, most of all that of leg {}: the mechanism has play, or the gains are too high",
        Reaction.STOP,
        "m/s RMS",
    )
    GAINS_HALVED = (
        85,
        "the gains are halved, as the commands oscillate, most of all that of leg {}: legs have play, or gains are too high",
        Reaction.GO_ON,
        "m/s RMS",
    )

    ENCODER_SILENT = 67, "the encoder of leg {} reads nothing", Reaction.GO_ON
    ENCODER_CONTRADICTED = 68, "the encoder of leg {} is left out: IMUs and other encoders contradict it", Reaction.GO_ON, "m"
    ENCODER_BACK = 69, "the encoder of leg {} is used again", Reaction.GO_ON
    ENCODERS_CONTRADICT = (
        70,
        "encoders and IMUs contradict each other, most of all on leg {}",
        Reaction.STOP,
        "m",
    )

    UNJUDGED = (
        71,
        "nothing judges the IMUs, and the protection level is not known: periods are missed too often",
        Reaction.GO_ON,
        "s",
    )

    BASE_IMU_LOST = 72, "the IMU on the base has no readings that can be used", Reaction.STOP, "s"

    LEVEL_BEYOND = (
        73,
        "leg {} cannot follow the target in the level frame: stroke or drive are at their limit",
        Reaction.GO_ON,
        "m",
    )

    TWO_FORCES = 74, "two IMUs or more read a force that is no motion", Reaction.QUICK_STOP, "m/s^2"
    MOVES_AT_REST = (
        83,
        "commands and gyroscopes show a motion at rest, and the estimate does not: IMUs may share an error",
        Reaction.QUICK_STOP,
        "m RMS of the legs",
    )
    DRIFTS = 84, "the pose drifts from the one that gravity shows: IMUs may share an error", Reaction.QUICK_STOP, "sigma"
    BASE_SWING = 75, "the base joint of leg {} would swing too far for the target", Reaction.STOP, "rad"
    PLATFORM_SWING = 76, "the platform joint of leg {} would swing too far for the target", Reaction.STOP, "rad"
    TOO_CLOSE = 77, "the target would bring leg {} too close to another leg or a plate", Reaction.STOP, "m"
    TOO_HEAVY = 78, "leg {} has too little force to hold the target", Reaction.STOP, "N"
    SINGULAR = 79, "the target is too near to a singularity", Reaction.STOP
    OPERATOR_LOST = 80, "the operator has gone while the platform was jogged", Reaction.STOP, "s"
    NOT_JUDGED = 82, "not armed: nothing has judged the IMUs yet, as periods are missed too often", Reaction.STOP
    STAGE_FAILED = 81, "a stage in Python has failed", Reaction.QUICK_STOP
    NO_POSE_FITS = 66, "no pose fits the IMUs, even without the worst of them", Reaction.QUICK_STOP, "sigma RMS"

    @property
    def short(self) -> str:
        """The text without the number of a leg or an IMU."""
        return self.text.replace(_WORST, "").replace(" {}", "")

    def describe(self, index: int, value: float, limit: float) -> str:
        """An event with this cause, in words.

        Args:
            index: the number of the leg or IMU; -1 if none is named.
            value, limit: in the unit of the cause; NaN if there is none.
        """
        text = (self.text if index >= 0 else self.text.replace(_WORST, "")).format(index)
        if np.isnan(value):
            return text
        if self.unit == "code":
            return f"{text} (code {int(value):#06x})"
        unit = f" {self.unit}" if self.unit else ""
        limited = "" if np.isnan(limit) else f", the limit is {limit:.4g}{unit}"
        return f"{text} ({value:.4g}{unit}{limited})"


REACTION = np.zeros(max(Cause) + 1, dtype=np.int64)
REACTION[list(Cause)] = [cause.reaction.value for cause in Cause]
"""The reaction to each cause, by number."""

EVENT_SLOTS = 8

EVENTS = record_dtype(
    count=np.int64,
    cause=(np.int32, EVENT_SLOTS),
    index=(np.int32, EVENT_SLOTS),
    value=(np.float64, EVENT_SLOTS),
    limit=(np.float64, EVENT_SLOTS),
)
"""The events of one cycle. `count` also counts events for which there was no slot."""


@kernel
def report_event(events: Record, cause: int, index: int, value: float, limit: float) -> None:
    """Add an event (dtype `EVENTS`)."""
    if events.count < EVENT_SLOTS:
        events.cause[events.count] = cause
        events.index[events.count] = index
        events.value[events.count] = value
        events.limit[events.count] = limit
    events.count += 1
