"""A closed-loop simulation: a mechanism follows a target on its FMU plant, as fast as it goes."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from controller.calibration.file import Calibration, load_calibration
from controller.cycle import ALL_IMUS, OK, STATE, check_rate, cycle_parameters, imus_of
from controller.direct_kinematics import poses_from_lengths
from controller.estimation.fusion import find_vertical, fuse_heading, point_legs, prepare_platform
from controller.estimation.leg_filter import start_leg
from controller.inverse_kinematics import leg_lengths
from controller.planning.planner import Reference, plan
from controller.planning.stream import rest
from controller.planning.target import Target, check_duration, load_target
from controller.safety.watch import describe_end
from controller.settings import control_settings, safety_settings, sensor_settings
from hil.loop.driver import Loop, PythonFilters
from hil.loop.records import COMPUTED, RECORD
from hil.rigs.by_name import check_legs
from hil.runs.snapshot import Snapshot, resume_snapshot, take_snapshot
from plant.compiled import Record
from plant.dynamics.variables import PLATFORM_IMU
from plant.errors import GoughError, InputError, UnknownNameError
from plant.fmu.binding import OWN_BINDING, Setting, load_binding
from plant.fmu.build import default_fmu, model_of
from plant.fmu.plant import FMU_HANDLE, FmuPlant
from plant.imu import ACCELEROMETER, GYROSCOPE, RIGHT_WIRING, Wiring, imu_state, load_imu
from plant.mechanism import LEGS, Mechanism, load_in_space
from plant.pose import Array, Pose, checked_seed, rotation_angle, rotations_from_quaternions
from plant.truth import TRUTH_POSITION, TRUTH_QUATERNION

FUSIONS = {
    "compiled": None,
    "filterpy": None,
    "section-5": None,
    "whole-gyroscopes": "gyroscopes",
    "whole": "accelerometers",
    "whole-alignments": "alignments",
}
"""Ways to fuse the IMUs: by leg and platform filters, in compiled code or filterpy's, unrefined as in the paper's section 5; or
all together in the whole-mechanism filter, with the errors of the IMUs that it estimates."""

RIGS = ("fmu", "udp", "canopen", "replay")
PYTHON_RIG = "python:"
"""Begins the name of a rig of one's own, such as python:my_rig:MyRig: module and class."""

STREAM_TARGET = "stream"
"""A target that is streamed, alone or with the address to listen at, such as stream:127.0.0.1:47200."""

HOLD_RANGE_S = (0.2, 10.0)
_CHUNK_S = 0.25
MOST_RECORD_BYTES = 4 * 2**30
"""The longest run that is kept in memory."""


@dataclass(frozen=True)
class SimulationConfig:
    """What to simulate.

    Attributes:
        mechanism: preset or TOML file.
        target: motion or CSV file.
        duration: of the motion, after the hold on the brakes [s].
        rate: cycles per second [Hz].
        imu: preset of the imperfections.
        seed: of the imperfections.
        fusion: a key of `FUSIONS`.
        calibration: file with the IMUs' constants; without one their readings are taken as they are.
        hold: how long the brakes hold first [s]; None for what the mechanism's settings say.
        plant: an FMU to use instead of the one that gough builds.
        binding: a TOML file that says which of its variables are which (docs/fmu.md).
        settings: values for the FMU's parameters and inputs, from the start or from a time of the motion on.
        imus: which IMUs there are, 0-5 on the legs and 6 on the platform.
        wiring: how they are mounted and wired.
        joint_error: of each coordinate of the plant's joints, which the controller does not know: standard deviation [m].
        magnetometer: whether the platform's magnetometer gives its heading.
        rig: what is driven: the plant's FMU ("fmu"), a rig on a bus ("udp", "canopen"), a recording ("replay"), or a class in
            Python, such as "python:my_rig:MyRig" (see `hil.rigs.by_name.python_rig`).
        rig_at: its address, its settings' file, or the recording's files with commas in between; None for its default.
        arm: whether the drives are asked for; else everything is read and nothing moves.
        raw_imus: whether the IMUs are known to be uncalibrated, so that their disagreement says nothing.
    """

    mechanism: str = "hexapod"
    target: str = "circle"
    duration: float = 10.0
    rate: float = 1000.0
    imu: str = "mpu9150-calibrated"
    seed: int = 0
    fusion: str = "compiled"
    calibration: str | None = None
    hold: float | None = None
    plant: str | None = None
    binding: str | None = None
    settings: tuple[Setting, ...] = ()
    imus: tuple[int, ...] = ALL_IMUS
    wiring: Wiring = RIGHT_WIRING
    joint_error: float = 0.0
    magnetometer: bool = False
    rig: str = "fmu"
    rig_at: str | None = None
    arm: bool = True
    raw_imus: bool = False

    def __post_init__(self) -> None:
        check_rate(self.rate)
        checked_seed(self.seed)
        check_duration(self.duration)
        cycles = self.duration * self.rate
        if round(cycles) < 1:
            raise InputError(f"the duration is {self.duration:g} s, less than one cycle of {1.0 / self.rate:g} s")
        if self.fusion not in FUSIONS:
            raise UnknownNameError(f"no fusion {self.fusion!r}; there are {', '.join(FUSIONS)}")
        if self.rig not in RIGS and not self.rig.startswith(PYTHON_RIG):
            raise UnknownNameError(f"no rig {self.rig!r}; there are {', '.join(RIGS)} and {PYTHON_RIG}MODULE:CLASS")
        if self.binding is not None and self.plant is None:
            raise InputError(f"{self.binding} binds an FMU, and none is given: name it with --plant FILE.fmu")
        if self.settings and self.rig != "fmu":
            raise InputError(f"--set is for the plant's FMU, not for the rig {self.rig}: leave it out")

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> "SimulationConfig":
        """The configuration of which `dataclasses.asdict` has made these values, perhaps with lists for tuples.

        Raises:
            InputError: it has made no such values.
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
    def streamed(self) -> bool:
        """Whether the target is streamed while the loop runs."""
        return self.target == STREAM_TARGET or self.target.startswith(f"{STREAM_TARGET}:")


class SimulationStoppedError(GoughError, RuntimeError):
    """The loop ended before its time; the message has the cause and the cycle, `result` what was recorded until then."""

    exit_status = 1

    def __init__(self, message: str, result: "SimulationResult") -> None:
        super().__init__(message)
        self.result = result


@dataclass(frozen=True, eq=False)
class SimulationResult:
    """What a simulation found.

    Attributes:
        config: what was simulated.
        mechanism, target, reference: what it was simulated with.
        times: (N,) [s]; 0 is the end of the hold.
        records: (N,), dtype `hil.loop.records.RECORD`.
        reference_positions, reference_rotations: (N, 3) [m] and (N, 3, 3), the planned pose.
        target_positions, target_rotations: (N, 3) [m] and (N, 3, 3), the raw target.
        real_time_factor: simulated time over the time that planning and loop took.
        snapshot: if one was asked for.
    """

    config: SimulationConfig
    mechanism: Mechanism
    target: Target
    reference: Reference
    times: Array
    records: Record
    reference_positions: Array
    reference_rotations: Array
    target_positions: Array
    target_rotations: Array
    real_time_factor: float
    snapshot: Snapshot | None

    @property
    def moved(self) -> bool:
        """Whether the run went beyond the hold on the brakes, so that there is something to sum up."""
        return bool(len(self.times)) and bool(self.times[-1] >= 0.0)

    @property
    def truth_known(self) -> bool:
        """Whether the plant tells its true pose."""
        return bool(np.isfinite(self.records["truth"][:1, :7]).all())

    @property
    def true_positions(self) -> Array:
        """(N, 3) [m]; NaN if the truth is not known."""
        positions: Array = self.records["truth"][:, TRUTH_POSITION]
        return positions

    @property
    def true_rotations(self) -> Array:
        """(N, 3, 3); NaN if the truth is not known."""
        return rotations_from_quaternions(np.ascontiguousarray(self.records["truth"][:, TRUTH_QUATERNION]))

    def summary(self) -> dict[str, Any]:
        """The figures, in SI units, over the time after the hold; None for those that need the truth where it is not known."""
        moving = self.times >= 0.0
        estimate = (self.records["position"][moving], self.records["rotation"][moving])
        reference = (self.reference_positions[moving], self.reference_rotations[moving])
        target = (self.target_positions[moving], self.target_rotations[moving])
        truth = (self.true_positions[moving], self.true_rotations[moving]) if self.truth_known else None
        cycle_us = self.records["stage_ns"][:, COMPUTED].sum(axis=1) / 1e3
        return {
            "truth_known": self.truth_known,
            "estimation": None if truth is None else _errors(estimate, truth),
            "tracking": None if truth is None else _errors(truth, reference),
            "estimated_tracking": _errors(estimate, reference),
            "target": ({} if truth is None else _errors(truth, target))
            | {f"reference_{key}": value for key, value in _errors(reference, target).items()},
            "limits": {"violations": self.reference.violations},
            "real_time_factor": self.real_time_factor,
            "cycle_us": {
                name: float(np.percentile(cycle_us, percent)) for name, percent in (("p50", 50), ("p99", 99), ("p999", 99.9))
            },
            "config": asdict(self.config),
            "version": version("gough"),
        }


def simulate(
    config: SimulationConfig,
    progress: Callable[[float], None] = lambda share: None,
    resumed: Snapshot | None = None,
    save_at: float | None = None,
) -> SimulationResult:
    """Run a simulation.

    Args:
        config: what to simulate.
        progress: called now and then with the share of the run that is done.
        resumed: where to go on; then the result is of the rest.
        save_at: when to take a snapshot [s] of the motion, its duration for the end; None for never.

    Raises:
        GoughError: something in the configuration cannot be used; nothing has run then.
        SimulationStoppedError: the loop ended before its time.
    """
    if config.streamed or config.rig != "fmu":
        raise InputError("a streamed target, and any rig but the FMU, has a clock of its own: use 'gough run'")
    if config.fusion == "filterpy" and (resumed is not None or save_at is not None):
        raise InputError("filters on filterpy cannot be saved: choose another fusion")
    with prepared_loop(config) as loop:
        count = len(loop.records)
        if resumed is not None:
            resume_snapshot(resumed, loop, loop.simulated)
        first = int(loop.state["cycle"])
        saved = None if save_at is None else _cycle_at(save_at, loop, first)
        snapshot = None
        filters = filterpy_filters(loop.parameters) if config.fusion == "filterpy" else None
        cause, took = OK, loop.planning_time
        chunk = max(1, round(_CHUNK_S * config.rate))
        for last in sorted({*range(first + chunk, count, chunk), count, *([] if saved is None else [saved])}):
            began = time.perf_counter()
            cause = loop.run(last, filters)
            took += time.perf_counter() - began
            if cause != OK:
                break
            if last == saved and loop.state["stopping"] == OK:
                snapshot = take_snapshot(asdict(config), loop, loop.simulated)
            progress((last - first) / (count - first))
        result = _result(config, loop, first, snapshot, took)
        if loop.state["stopping"] != OK:
            at, held = (
                int(loop.state["stop_cycle"]),
                "stopped on the brakes" if cause != OK else "still stopping at the end, from",
            )
            raise SimulationStoppedError(f"{held} at cycle {at} of {count}: {loop.reason()}", result)
    return result


@dataclass(eq=False, kw_only=True)
class PreparedLoop(Loop):
    """A loop that is ready to run, with what it was prepared from.

    Attributes:
        plant: the FMU behind `fmu`.
        mechanism, target, reference: as in `SimulationResult`.
        end: the cycle after the last of the motion.
        planning_time: what planning took [s].
    """

    plant: FmuPlant | None
    mechanism: Mechanism
    target: Target
    reference: Reference
    end: int
    planning_time: float

    @property
    def simulated(self) -> FmuPlant:
        """The FMU of a simulation."""
        if self.plant is None:
            raise InputError("this loop has no FMU")
        return self.plant

    def reason(self) -> str:
        """Why the run has ended, in words; a plant that failed has its own."""
        if self.plant is not None and self.plant.handle["status"] != OK:
            return str(self.plant.failure())
        return describe_end(self.state)


@contextmanager
def prepared_loop(config: SimulationConfig, records: Record | None = None) -> Iterator[PreparedLoop]:
    """Check everything, load the plant, plan the motion, and load the machine code.

    Args:
        config: what to run.
        records: where to record, round and round; by default there is room for every cycle.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    nominal = load_in_space(config.mechanism)
    calibration = Calibration() if config.calibration is None else load_calibration(config.calibration)
    if nominal.planar:
        check_legs(config.rig, nominal)
        _check_planar(config, calibration)
    mechanism = nominal.moved_joints(calibration.joints[:, : nominal.legs])
    target = load_target("hold" if config.streamed else config.target, mechanism, config.duration)
    period = 1.0 / config.rate
    model = load_imu(config.imu)
    imu = imu_state(model, config.seed, period, config.wiring)
    control = control_settings(mechanism, **({} if config.hold is None else {"hold": config.hold}))
    if not HOLD_RANGE_S[0] <= control.hold <= HOLD_RANGE_S[1]:
        raise InputError(f"hold is {control.hold:g} s; the estimate settles in {HOLD_RANGE_S[0]:g} to {HOLD_RANGE_S[1]:g} s")
    fusion, safety = sensor_settings(mechanism, model), safety_settings(mechanism)
    parameters = cycle_parameters(
        mechanism, config.rate, control, fusion, config.imus, FUSIONS[config.fusion], calibration, config.magnetometer,
        config.fusion == "section-5", safety.for_raw_imus() if config.raw_imus else safety,
        0.0 if config.rig == "fmu" else period, config.arm,
    )  # fmt: skip
    count = int(parameters["hold_cycles"]) + round(config.duration * config.rate)
    if records is None and count * RECORD.itemsize > MOST_RECORD_BYTES:
        raise InputError(
            f"{config.duration:g} s at {config.rate:g} Hz would record {count * RECORD.itemsize / 2**30:.3g} GiB, more than "
            f"{MOST_RECORD_BYTES / 2**30:g} GiB: choose a shorter duration or a lower rate, or 'gough run', which keeps seconds"
        )
    plan(mechanism, load_target("hold", mechanism, 0.1), 0.1)
    with simulated_plant(config, nominal, target.start) if config.rig == "fmu" else nullcontext() as plant:
        began = time.perf_counter()
        if config.streamed:
            lengths = leg_lengths(mechanism, target.start.position, target.start.rotation)
            reference = Reference(rest(lengths), 0)
        else:
            reference = plan(mechanism, target, config.duration)
        loop = PreparedLoop(
            fmu=np.zeros((), FMU_HANDLE) if plant is None else plant.handle,
            imu=imu,
            parameters=parameters,
            state=np.zeros((), STATE),
            segments=reference.segments,
            records=np.zeros(count, RECORD) if records is None else records,
            end=count,
            plant=plant,
            mechanism=mechanism,
            target=target,
            reference=reference,
            planning_time=time.perf_counter() - began,
        )
        loop.load(python=config.fusion == "filterpy")
        yield loop


def _check_planar(config: SimulationConfig, calibration: Calibration) -> None:
    """Check that nothing is asked for that a planar mechanism cannot do."""
    if config.fusion != "compiled":
        raise InputError(f"fusion {config.fusion!r} is for six legs; for {config.mechanism}, which is planar, take 'compiled'")
    if config.streamed:
        raise InputError(f"a target can be streamed to six legs alone; {config.mechanism} is planar: give a motion or a file")
    if calibration.joints.any():
        raise InputError(f"{config.calibration} moves the joints of six legs, and {config.mechanism} has three: leave them out")


def simulated_plant(config: SimulationConfig, nominal: Mechanism, start: Pose) -> FmuPlant:
    """The plant that a configuration describes, at rest at its start; one with a binding starts where it says.

    Raises:
        GoughError: the FMU, its binding, a setting or the joint error cannot be used.
    """
    fmu = default_fmu(model_of(nominal)) if config.plant is None else Path(config.plant)
    binding = OWN_BINDING if config.binding is None else load_binding(config.binding)
    if config.joint_error and not binding.native:
        raise InputError(f"{binding.source} binds an FMU with joints of its own, which have no joint error: leave it out")
    built = nominal.built(config.joint_error, config.seed)
    hold = control_settings(nominal).hold if config.hold is None else config.hold
    settings = [each if each.at is None else replace(each, at=each.at + hold) for each in config.settings]
    late = [each for each in config.settings if each.at is not None and each.at >= config.duration]
    if late:
        raise InputError(f"{late[0].name} is set at {late[0].at:g} s, when the motion of {config.duration:g} s is over")
    parameters = built.plant_parameters(start) if binding.native else {}
    plant = FmuPlant(fmu, parameters, 1.0 / config.rate, binding, settings, nominal.legs)
    try:
        _check_plant(config, plant, nominal)
    except GoughError:
        plant.close()
        raise
    return plant


def _check_plant(config: SimulationConfig, plant: FmuPlant, nominal: Mechanism) -> None:
    """Check that a plant has what the loop is to drive and to read."""
    name, bound = plant.path.name, plant.bound
    absent = set(imus_of(nominal, config.imus)) - set(bound.imus)
    if absent:
        there = ",".join(map(str, bound.imus))
        raise InputError(f"{name} has no IMU {', '.join(map(str, sorted(absent)))}: leave it out with --imus {there}")
    if config.magnetometer and PLATFORM_IMU not in bound.magnetometers:
        raise InputError(f"{name} has no magnetometer on the platform: bind imu_magnetic_field, or leave out --magnetometer")


def _cycle_at(at: float, loop: PreparedLoop, first: int) -> int:
    """The cycle of a time [s] of the motion at which a snapshot is to be taken."""
    period, hold = float(loop.parameters["period"]), int(loop.parameters["hold_cycles"])
    cycle = hold + round(at / period) if np.isfinite(at) else -1
    if not first < cycle <= len(loop.records):
        least, most = ((cycle - hold) * period for cycle in (first, len(loop.records)))
        raise InputError(f"a snapshot at {at:g} s is not within the motion: choose more than {least:g}, and at most {most:g} s")
    return cycle


def _result(
    config: SimulationConfig, loop: PreparedLoop, first: int, snapshot: Snapshot | None, took: float
) -> SimulationResult:
    """What has been found from a cycle on."""
    done = int(loop.state["cycle"])
    records = loop.records[first:done]
    times = (np.arange(first, done) - int(loop.parameters["hold_cycles"])) / config.rate
    positions, rotations = poses_from_lengths(
        loop.mechanism, records["reference"][:, : loop.mechanism.legs, 0], loop.target.start
    )
    target_positions, target_rotations = loop.target.at(times)
    return SimulationResult(
        config, loop.mechanism, loop.target, loop.reference, times, records, positions, rotations, target_positions,
        target_rotations, (done - first) / config.rate / took, snapshot,
    )  # fmt: skip


def filterpy_filters(parameters: Record) -> PythonFilters:
    """The filters of legs and platform on filterpy, in the place of the compiled ones."""
    from controller.estimation.filterpy_filters import FilterpyLeg, FilterpyPlatform

    legs = [
        FilterpyLeg(
            up_in_joint=parameters["sensors"]["up_in_joint"][k],
            imu_position=parameters["sensors"]["leg_imu_position"][k],
            gravity=float(parameters["sensors"]["gravity"]),
            period=float(parameters["period"]),
            jerk=float(parameters["leg_jerk"]),
            bias_walk=float(parameters["bias_walk"]),
            rate_variance=float(parameters["gyroscope_variance"]),
            force_variance=float(parameters["leg_force_variance"]),
        )
        for k in range(LEGS)
    ]
    platform = FilterpyPlatform(
        gravity=float(parameters["sensors"]["gravity"]),
        period=float(parameters["period"]),
        rate_density=float(parameters["gyroscope_density"]),
        bias_walk=float(parameters["bias_walk"]),
        vertical_variance=float(parameters["vertical_variance"]),
    )

    def fuse_legs(state: Record) -> None:
        for k, leg in enumerate(legs):
            if not state["imu_used"][k]:
                continue
            rate, force = state["sample"][GYROSCOPE, k], state["sample"][ACCELEROMETER, k]
            if state["age"][k] == 0:
                start_leg(
                    state["leg_x"][k], state["leg_covariance"][k], rate, force, leg.up_in_joint, float(parameters["bias_sigma"])
                )
                leg.start(state["leg_x"][k], state["leg_covariance"][k])
                leg.update(rate, force)
            else:
                leg.step(rate, force)
            state["leg_x"][k], state["leg_covariance"][k] = leg.state, leg.covariance
        point_legs(parameters, state)

    def fuse_platform(state: Record) -> None:
        if prepare_platform(parameters, state):
            platform.start(state["platform_x"], state["platform_covariance"])
            rate, force = state["sample"][GYROSCOPE, PLATFORM_IMU], state["sample"][ACCELEROMETER, PLATFORM_IMU]
            platform.step(rate, force, state["imu_acceleration"])
            state["platform_x"], state["platform_covariance"] = platform.state, platform.covariance
            find_vertical(parameters, state)
        fuse_heading(parameters, state)

    return PythonFilters(fuse_legs, fuse_platform)


def _errors(first: tuple[Array, Array], second: tuple[Array, Array]) -> dict[str, float]:
    distances = np.linalg.norm(first[0] - second[0], axis=1)
    angles = rotation_angle(first[1], second[1])
    return {
        "position_rms": float(np.sqrt(np.mean(distances**2))),
        "rotation_rms": float(np.sqrt(np.mean(angles**2))),
        "position_max": float(distances.max()),
        "rotation_max": float(angles.max()),
    }
