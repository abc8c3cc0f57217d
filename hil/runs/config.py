"""Configurations of a simulation, of a run and of an emulator, checked when they are made; quick to load."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from controller.planning import OPERATOR_TARGET, STREAM_TARGET
from hil.option import Named, NamedOrNone, integers, named, option
from hil.runs.names import name_objects
from plant.checks import check_duration, check_rate, check_time_scale, checked_seed, nearest
from plant.encoders import NO_LENGTHS, EncoderFault, encoder_fault
from plant.encoders import PREFIX as ENCODER_PREFIX
from plant.errors import InputError, UnknownNameError
from plant.fmu.settings import Setting
from plant.imu_disturbances import BASE_PREFIX, Disturbance, disturbance_of_text, times_in, words_of_text
from plant.imu_wiring import ALL_IMUS, RIGHT_WIRING, Wiring, require_imus

if TYPE_CHECKING:
    from typing import Never

    from controller.calibration.file import Calibration
    from controller.frames import ActiveFrames, Frames
    from controller.planning.motions import Motion
    from controller.planning.target import Target, TargetFunction
    from controller.settings import ControlSettings
    from hil.rigs import Rig
    from plant.compiled import Record
    from plant.encoders import EncoderModel
    from plant.fmu.binding import Binding
    from plant.imu import ImuModel
    from plant.mechanism import Mechanism, PlanarMechanism

FUSIONS = {
    "compiled": None,
    "filterpy": None,
    "section-5": None,
    "whole-gyroscopes": "gyroscopes",
    "whole": "accelerometers",
    "whole-alignments": "alignments",
}
"""Ways to fuse the IMUs, with the errors of the IMUs that the whole-mechanism filter estimates; None without that filter."""

FUSIONS_ON_A_MOVING_BASE = tuple(name for name in FUSIONS if name not in ("filterpy", "section-5"))

FRAMES = BASE, LEVEL = "base", "level"
"""The frames of a target that need no file: {1}, or one that stays level."""

_HEAVE_PERIODS_S = (2.0, 30.0)

RIGS = ("fmu", "udp", "canopen", "replay")
DRIVES = VELOCITY_DRIVES, POSITION_DRIVES = "velocity", "position"
"""What the drives close a loop of: nothing, as they turn a velocity into a voltage, or their position."""

OF_RUNS = ("rig", "rig_at", "arm", "channel", "points", "token_file")
"""Fields that say something to a run on the clock alone, and nothing to a simulation."""

OPERATOR_CHANNEL = "127.0.0.1:47300"
"""Where a run listens for operators and observers, if nothing names another address."""

NO_CHANNEL = "none"

PYTHON_RIG = "python:"
"""The prefix of a rig in the user's own Python class, such as python:my_rig:MyRig (module and class)."""

MECHANISM = "preset, or a TOML file"
IMU = (
    "ideal; mpu9150, icm20948, bmi088 or lsm6dso, raw, or followed by -calibrated, or by -nominal, which has all that real "
    "ones do; icm42688, which is calibrated, or icm42688-nominal; or a TOML file, as of a data sheet (docs/imus.md)"
)
CALIBRATION = "the IMUs' constants, as 'gough calibrate' writes them; without it the readings are used as they are"
"""Help of options that several configurations have."""

_NAMED_IMUS = {"all": ALL_IMUS, "legs": ALL_IMUS[:-1]}


def imus_from_text(text: str) -> tuple[int, ...]:
    """The numbers of the IMUs that a text such as all, legs or 0,2,4,6 names.

    Raises:
        InputError: it names none.
    """
    if text in _NAMED_IMUS:
        return _NAMED_IMUS[text]
    try:
        imus = sorted(integers(text))
    except InputError:
        raise InputError(f"{text!r} is neither all, legs, nor a list of numbers such as 0,2,4,6") from None
    for before, imu in pairwise(imus):
        if imu == before:
            raise InputError(f"{text!r} names IMU {imu} twice: name each IMU once")
    return tuple(imus)


@dataclass(frozen=True)
class SimulationConfig:
    """What to simulate, or to run on the clock.

    Where a mechanism, target, IMU, encoder, frames, calibration or binding is named, the object itself will do, too; the field
    then names a preset, or a file in gough's cache that holds it. A target may be a function of time, too
    (`controller.planning.target.TargetFunction`). Fields that are options say below what they mean; the others:

    Attributes:
        hold: how long the brakes hold first [s]; None for the time in the mechanism's settings, below 250 Hz
            at least 1 s.
        wiring: how the IMUs are mounted and wired.
        raw_imus: whether the IMUs are known to be uncalibrated, so that disagreement between them says nothing.
        open_loop: whether the drives follow the planned speeds, and IMUs only show a drive that does not: before a calibration.
    """

    mechanism: Named["Mechanism | PlanarMechanism"] = named("hexapod", MECHANISM)
    target: Named["Target | Motion | TargetFunction"] = named(
        "circle",
        "hold, circle, sines, steps, near-rests, rests, shaking, probing, a motion file (docs/motions.md), or a CSV file of "
        "displacements from home (time_s,x_m,y_m,z_m,qw,qx,qy,qz); for 'gough run' also stream or stream:HOST:PORT, as "
        "'gough stream-target' sends, and operator or operator:HOST:PORT, which 'gough move' and 'gough jog' move",
    )
    duration: float = option(10.0, "duration of the motion, after the hold on the brakes", unit="s")
    rate: float = option(1000.0, "cycles per second, 50 to 4000", unit="Hz")
    imu: Named["ImuModel"] = named("mpu9150-calibrated", IMU)
    seed: int = option(0, "seed of the IMUs' imperfections")
    fusion: str = option(
        "compiled",
        "compiled: leg and platform filters; whole, whole-gyroscopes, whole-alignments: all IMUs together, with biases "
        "of both sensors, of the gyroscopes, or with scales and alignments; section-5: the paper's, the orientation from the "
        "platform's IMU with --magnetometer, the position from the legs; filterpy: as compiled, but on filterpy (slow)",
    )
    calibration: NamedOrNone["Calibration"] = named(None, CALIBRATION, metavar="FILE.toml")
    hold: float | None = None
    plant: NamedOrNone["Never"] = named(None, "Co-Simulation FMU (FMI 2.0 or 3.0) instead of the built one", metavar="FILE.fmu")
    binding: NamedOrNone["Binding"] = named(
        None, "which of the FMU's variables are which, if they have other names (docs/fmu.md)", metavar="FILE.toml"
    )
    settings: tuple[Setting, ...] = option(
        (),
        "a parameter or input of the FMU, from the start or from a time of the motion on, such as payload.mass=12@3.5 or "
        "gravity=0,0,-9.8; can be given several times",
        flag="--set",
        metavar="NAME=VALUE[@SECONDS]",
        parse=Setting.parse,
        several=True,
    )
    imus: tuple[int, ...] = option(
        ALL_IMUS, "which IMUs there are: all, legs, or a list such as 0,2,4,6", parse=imus_from_text, shown="all"
    )
    wiring: Wiring = RIGHT_WIRING
    faults: tuple[str, ...] = option(
        (),
        "simulated: what happens to IMUs, to encoders or to the base, from the start or from a time of the motion on, such as "
        "imu-offset:all,axis=y,size_m_per_s2=0.5,at_s=5,ramp_s=10 or base-tilt,axis=x,size_deg=2,at_s=3,ramp_s=4; "
        "'gough inject --list' lists all; can be given several times",
        flag="--fault",
        metavar="KIND[:IMUS][,WORD=VALUE]",
        parse=str,
        several=True,
    )
    joint_error: float = option(
        0.0, "simulated: standard deviation of each coordinate of the joints from their places", unit="mm"
    )
    lengths: Named["EncoderModel"] = named(
        NO_LENGTHS,
        "encoders of the legs' lengths: none, incremental, absolute, or a TOML file (docs/encoders.md)",
        metavar="KIND",
    )
    drives: str = option(
        VELOCITY_DRIVES,
        "what the drives do with the commanded velocities: velocity, follow them, and fall short under load; position, "
        "integrate them and close a position loop around an encoder of their own (docs/encoders.md)",
        choices=DRIVES,
    )
    base_imu: bool = option(False, "IMU 7 is on the base, which may move then (docs/moving_base.md)")
    frames: NamedOrNone["Frames"] = named(
        None, "frames of your own, in which targets, errors and read-outs are (docs/frames.md)", metavar="FILE.toml"
    )
    frame: str | None = option(
        None,
        "frame of the target: base, level, in which the platform keeps its attitude while the base rolls (needs --base-imu), "
        "or one of --frames, in which its poses are those of the tool",
        metavar="NAME",
        shown="what --frames enables, else base",
    )
    tool: str | None = option(
        None, "what is moved to the target: platform, or a tool of --frames", metavar="NAME", shown="what --frames enables"
    )
    heave_period: float = option(
        0.0,
        "mean period of the base's heave, in which the platform then takes no part; with a target in the level frame; 2 to "
        "30 s, and 0 for a platform that rises and falls with its base [s]",
    )
    time_scale: float = option(
        1.0, "factor on the times of the target: 2 is half as fast, as what is too fast is told to take; 0.01 to 1000"
    )
    channel: str | None = option(
        None,
        "where the run listens for 'gough panel' and other clients, which may watch it and end it, or none (docs/operating.md)",
        metavar="HOST:PORT",
        shown=f"{OPERATOR_CHANNEL} if it is free",
    )
    points: NamedOrNone["Never"] = named(
        None, "with --target operator: named points to go to (docs/operating.md)", metavar="FILE.toml"
    )
    token_file: NamedOrNone["Never"] = named(
        None,
        "the token that clients of the channel must give, which an address beyond this machine needs; also the variable "
        "GOUGH_TOKEN",
        metavar="FILE",
    )
    magnetometer: bool = option(False, "the platform's magnetometer gives its heading")
    rig: Named["type[Rig]"] = named(
        "fmu",
        "what is driven: fmu, the plant; udp or canopen, a rig on a bus; replay, a recording; or python:MODULE:CLASS, a rig "
        "of your own, as hil/rigs/template.py is one",
        metavar="RIG",
    )
    rig_at: str | None = option(
        None,
        "where the rig is: HOST:PORT for udp (default: 127.0.0.1:47100), settings of the bus for canopen, the recording "
        "(files of one run with commas in between) for replay",
        metavar="ADDRESS|FILE",
    )
    arm: bool = option(True, "read everything, and move nothing")
    raw_imus: bool = False
    open_loop: bool = False

    def __post_init__(self) -> None:
        name_objects(self)
        check_rate(self.rate)
        checked_seed(self.seed)
        check_duration(self.duration)
        check_time_scale(self.time_scale)
        cycles = self.duration * self.rate
        if round(cycles) < 1:
            raise InputError(f"the duration is {self.duration:g} s, less than one cycle of {1.0 / self.rate:g} s")
        if self.fusion not in FUSIONS:
            raise UnknownNameError(f"no fusion {self.fusion!r}; there are {', '.join(FUSIONS)}{nearest(self.fusion, FUSIONS)}")
        if self.rig not in RIGS and not self.rig.startswith(PYTHON_RIG):
            names = f"{', '.join(RIGS)} and {PYTHON_RIG}MODULE:CLASS"
            raise UnknownNameError(f"no rig {self.rig!r}; there are {names}{nearest(self.rig, (*RIGS, PYTHON_RIG))}")
        if self.rig_at is not None and self.rig == "fmu":
            raise InputError(
                f"--rig-at {self.rig_at} says where a rig is, but not which: name it with --rig, such as --rig udp"
            )
        if self.binding is not None and self.plant is None:
            raise InputError(f"{self.binding} binds an FMU, and none is given: name it with --plant FILE.fmu")
        if self.settings and self.rig != "fmu":
            raise InputError(f"--set is for the plant's FMU, not for the rig {self.rig}: leave it out")
        if self.faults and self.rig != "fmu":
            raise InputError(
                f"--fault is for a simulated plant, not for the rig {self.rig}: tell it to 'gough emulate' or 'inject'"
            )
        if not self.operated and self.points is not None:
            raise InputError("--points is for a run that an operator moves: add --target operator, or leave it out")
        if self.channel == NO_CHANNEL and (self.operated or self.token_file is not None):
            what = "an operator moves the platform" if self.operated else "--token-file gives its token"
            raise InputError(f"--channel is {NO_CHANNEL}, but {what} over the channel: leave one of them out")
        if self.operated and ":" in self.target and self.channel is not None:
            raise InputError(
                f"--target {self.target} and --channel {self.channel} both say where the channel is: leave one out"
            )
        # Refuses words that none understands.
        self.base_motions  # noqa: B018
        for each in self.disturbances:
            require_imus(each.imus, self.base_imu, f"--fault {each.kind.label}")
        _check_encoders(self.faults, self.lengths)
        for text in self.faults:
            begin, _ = times_in(words_of_text(text)[2], f"the fault {text!r}")
            if begin >= self.duration:
                raise InputError(
                    f"--fault {text} begins at {begin:g} s, when the motion of {self.duration:g} s is over: let it begin "
                    "earlier, or make --duration longer"
                )
        if self.base_imu and self.fusion not in FUSIONS_ON_A_MOVING_BASE:
            raise InputError(
                f"with --base-imu the fusion is one of {', '.join(FUSIONS_ON_A_MOVING_BASE)}, not {self.fusion}: choose one of "
                "them, or leave --base-imu out"
            )
        if self.frames is None:
            if self.tool is not None:
                raise InputError(f"the tool {self.tool!r} stands in a file of frames: name that with --frames FILE.toml")
            if self.frame is not None and self.frame not in FRAMES:
                raise UnknownNameError(
                    f"no frame {self.frame!r}; there are {', '.join(FRAMES)}{nearest(self.frame, FRAMES)}; others stand in "
                    "a file: name that with --frames FILE.toml"
                )
        if self.levelled and not self.base_imu:
            raise InputError("a target in the level frame needs an IMU on the base: add --base-imu")
        if self.heave_period != 0.0 and not self.levelled:
            raise InputError("heave_period is of a target in the level frame: add --frame level, or leave it out")
        if self.heave_period != 0.0 and not _HEAVE_PERIODS_S[0] <= self.heave_period <= _HEAVE_PERIODS_S[1]:
            least, most = _HEAVE_PERIODS_S
            raise InputError(f"heave_period is {self.heave_period:g} s; it must be {least:g} to {most:g} s, or 0 for none")
        if self.drives not in DRIVES:
            raise UnknownNameError(f"no drives {self.drives!r}; there are {', '.join(DRIVES)}{nearest(self.drives, DRIVES)}")
        if self.lengths != NO_LENGTHS and self.fusion == "section-5":
            raise InputError("the paper's section 5 takes no lengths: leave --lengths out, or take another --fusion")

    def hold_of(self, control: "ControlSettings") -> float:
        """How long the brakes hold before the motion, with these settings of the mechanism [s]."""
        return control.hold_at(self.rate) if self.hold is None else self.hold

    @property
    def active_frames(self) -> "ActiveFrames | None":
        """The frames of target and read-outs; None without a file of frames.

        Raises:
            GoughError: the file cannot be used, or does not have the frame or the tool.
        """
        if self.frames is None:
            return None
        # It compiles.
        from controller.frames import load_frames

        return load_frames(self.frames).active(self.frame, self.tool)

    @property
    def levelled(self) -> bool:
        """Whether the target is in a frame that stays level."""
        active = self.active_frames
        return (self.frame if active is None else active.root) == LEVEL

    @property
    def disturbances(self) -> list[Disturbance]:
        """What happens to IMUs."""
        return [disturbance_of_text(text) for text in self.faults if not text.startswith((BASE_PREFIX, ENCODER_PREFIX))]

    @property
    def encoder_faults(self) -> list[EncoderFault]:
        """What happens to encoders."""
        return _encoder_faults(self.faults)

    @property
    def base_motions(self) -> "list[Record]":
        """How the base moves (dtype `plant.dynamics.base_course.BASE_MOTION`)."""
        moved = [text for text in self.faults if text.startswith(BASE_PREFIX)]
        if not moved:
            return []
        # It compiles.
        from plant.dynamics.base_course import base_motion_of_text

        return [base_motion_of_text(text) for text in moved]

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> "SimulationConfig":
        """The configuration that `dataclasses.asdict` has made these values from; lists may stand for tuples.

        Raises:
            InputError: the values are not those of a configuration.
        """

        def tuples(value: Any) -> Any:
            return tuple(map(tuples, value)) if isinstance(value, list | tuple) else value

        try:
            plain = {name: tuples(value) for name, value in values.items()}
            plain["wiring"] = Wiring(**{name: tuples(value) for name, value in values["wiring"].items()})
            plain["settings"] = tuple(Setting(**each | {"value": tuples(each["value"])}) for each in values["settings"])
            return cls(**plain)
        except (TypeError, KeyError, AttributeError) as error:
            raise InputError(f"these values are no configuration of a simulation: {error}") from None

    @property
    def operated(self) -> bool:
        """Whether an operator moves the platform while the loop runs."""
        return self.target == OPERATOR_TARGET or self.target.startswith(f"{OPERATOR_TARGET}:")

    @property
    def channel_address(self) -> str | None:
        """Where the run listens for clients; None for no channel."""
        if self.channel == NO_CHANNEL:
            return None
        named = self.target.partition(":")[2] if self.operated else ""
        return named or self.channel or OPERATOR_CHANNEL

    @property
    def streamed(self) -> bool:
        """Whether the target comes while the loop runs, from a stream or an operator."""
        return self.operated or self.target == STREAM_TARGET or self.target.startswith(f"{STREAM_TARGET}:")


def _encoder_faults(faults: Iterable[str]) -> list[EncoderFault]:
    """Those of the texts of faults that are of encoders."""
    return [encoder_fault(text) for text in faults if text.startswith(ENCODER_PREFIX)]


def _check_encoders(faults: Iterable[str], lengths: str) -> None:
    """Check that there are encoders if one has a fault, or raise an `InputError`."""
    if _encoder_faults(faults) and lengths == NO_LENGTHS:
        raise InputError("--fault breaks an encoder, and there is none: add --lengths incremental, or leave the fault out")


@dataclass(frozen=True)
class EmulatorConfig:
    """What to emulate; the platform starts at the first pose of the simulated target."""

    simulated: SimulationConfig = field(default_factory=SimulationConfig)
    bus: str = option("udp", "the bus that the rig speaks", choices=("udp", "canopen"))
    at: str | None = option(None, "where the rig is, as for --rig-at of 'gough run'", metavar="ADDRESS|FILE.toml")
    control: str = option("127.0.0.1:47101", "address of the control channel, which takes faults", metavar="HOST:PORT")
    faults: tuple[str, ...] = option(
        (),
        "a fault from the start, or at a time after the drives were first enabled [s]; 'gough inject --list' lists them",
        flag="--fault",
        metavar="KIND[:N][,at=S][,for=S][,size=X]",
        parse=str,
        several=True,
    )
    watchdog: float = option(0.03, "on udp: the drives stop after this time without a command", unit="ms")

    def __post_init__(self) -> None:
        if not 0.0 < self.watchdog < 60.0:
            raise InputError(f"the watchdog is {1e3 * self.watchdog:g} ms; it must be more than 0 and less than a minute")
        _check_encoders(self.faults, self.simulated.lengths)
        if self.bus == "canopen" and self.simulated.drives == POSITION_DRIVES:
            raise InputError(
                "on canopen the controller sets the drives' mode, as [drives] mode of its settings says: leave --drives out"
            )

    def watchdog_for(self, period_us: int) -> float:
        """The watchdog of a session with this period [us]: three periods at least [s]."""
        return max(self.watchdog, 3e-6 * period_us)
