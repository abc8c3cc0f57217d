"""Preparation of a run: check everything, load the plant or make the rig, plan the motion, load the machine code."""

import pickle
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from controller.calibration.file import Calibration, calibration_for
from controller.cycle import STATE, cycle_parameters, evidence_remark
from controller.frames import ActiveFrames
from controller.imu_set import are_few, encoder_remark, imus_of, integrity_remark, lengths_lead
from controller.inverse_kinematics import leg_lengths
from controller.loop_margins import margin_remark
from controller.planning.offline_planner import Reference, plan
from controller.planning.plan_handover import rest
from controller.planning.target import Target, load_target
from controller.safety import watch_drives_alone
from controller.safety.arming import longest_delay
from controller.safety.causes import Cause
from controller.safety.stop import describe_end
from controller.settings import control_settings, drive_settings, safety_settings, sensor_settings, tables_with
from controller.workspace import Demands, TargetCheck, check_against_limits, load_check
from hil.loop.driver import Loop
from hil.loop.records import RECORD
from hil.recording.replay_rig import ReplayRig
from hil.rigs import Rig
from hil.rigs.by_name import check_legs, python_rig
from hil.rigs.position_loops import close_loops
from hil.rigs.udp.link import DEFAULT_ADDRESS
from hil.rigs.udp.rig import UdpRig
from hil.runs.config import FUSIONS, POSITION_DRIVES, PYTHON_RIG, SimulationConfig
from hil.runs.names import check_names
from hil.runs.plant_start import check_start
from plant.compiled import Record
from plant.dynamics.base_course import placed
from plant.dynamics.variables import PLATFORM_IMU
from plant.encoder_readings import encoder_state
from plant.encoders import NO_LENGTHS, load_encoder
from plant.errors import GoughError, InputError, UnknownNameError
from plant.extras import missing_extras_named
from plant.fmu.binding import OWN_BINDING, bind, load_binding
from plant.fmu.build import building_default_fmu, default_fmu, model_of
from plant.fmu.calls import FMU_HANDLE
from plant.fmu.description_reader import FmuDescription
from plant.fmu.plant import FmuPlant, check_number_of_legs, takes_parameters
from plant.imu import add_disturbances, aliasing_remark, imu_state, load_imu
from plant.mechanism import Mechanism, load_in_space
from plant.pose import Pose

if TYPE_CHECKING:
    from hil.rigs.canopen.settings import CanopenSettings

HOLD_RANGE_S = (0.2, 10.0)
MOST_RECORD_BYTES = 4 * 2**30
"""The most memory that the records of a run may take."""


@dataclass(eq=False, kw_only=True)
class PreparedLoop(Loop):
    """A loop that is ready to run, with what it was prepared from."""

    plant: FmuPlant | None  # the FMU that the loop calls; None on a rig
    mechanism: Mechanism
    target: Target
    reference: Reference
    end: int  # the cycle after the last of the motion, if that begins with the end of the hold
    planning_time: float  # [s]
    remarks: tuple[str, ...]  # what a user should know before it runs, a line each
    frames: ActiveFrames | None = None  # of the target and of read-outs

    @property
    def simulated(self) -> FmuPlant:
        """The FMU of a simulation."""
        if self.plant is None:
            raise InputError("this loop has no FMU")
        return self.plant

    @property
    def delay(self) -> int:
        """By how many cycles the motion begins later than the hold ends, as far as that is known."""
        return int(self.state["safety"]["arming"]["delay"])

    def cycle_at(self, time: float) -> int:
        """The cycle at a time of the motion [s], as far as it is known when the motion begins."""
        rig = self.parameters["rig"]
        return int(rig["hold_cycles"]) + self.delay + round(time / float(rig["period"]))

    def reason(self) -> str:
        """Why the run has ended, in words; if the plant has failed, its failure."""
        if self.plant is not None and self.plant.handle["status"] != Cause.NONE:
            return str(self.plant.failure())
        return describe_end(self.state)


@contextmanager
def prepared_loop(config: SimulationConfig, records: Record | None = None, in_python: bool = False) -> Iterator[PreparedLoop]:
    """Check everything, load the plant, plan the motion, and load the machine code, or that of a loop that runs `in_python`.

    The loop records into `records`, a ring buffer; by default there is room for every cycle.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    check_names(config)
    nominal, period = load_in_space(config.mechanism), 1.0 / config.rate
    with ExitStack() as stack:
        fmu = None
        if config.rig == "fmu" and config.plant is None:
            # The FMU is built while kernels compile.
            fmu = stack.enter_context(building_default_fmu(model_of(nominal)))
        calibration = Calibration() if config.calibration is None else calibration_for(config.calibration, nominal, config.imu)
        if nominal.planar:
            check_legs(config.rig, nominal)
            _check_planar(config, calibration)
        mechanism = nominal.moved_joints(calibration.joints[:, : nominal.legs])
        frames = config.active_frames
        target = load_target(
            "hold" if config.streamed else config.target, mechanism, config.duration, frames, config.time_scale
        )
        model = load_imu(config.imu)
        imu = imu_state(model, config.seed, period, config.wiring, config.base_imu)
        encoder = load_encoder(config.lengths)
        control = control_settings(mechanism)
        least, most = HOLD_RANGE_S
        given = control.hold if config.hold is None else config.hold
        if not least <= given <= most:
            raise InputError(f"hold is {given:g} s; it must be {least:g} to {most:g} s")
        control = replace(control, hold=config.hold_of(control))
        position = closes_position(config)
        if position:
            control = control.for_position_drives()
        add_disturbances(imu, (each.later(control.hold) for each in config.disturbances))
        encoder_faults = [each.later(control.hold) for each in config.encoder_faults]
        fusion, safety = sensor_settings(mechanism, model, config.rate, encoder), safety_settings(mechanism)
        drives = drive_settings(mechanism, are_few(mechanism, config.imus))
        if config.raw_imus:
            safety, drives = safety.for_raw_imus(), drives.for_raw_imus()
        parameters = cycle_parameters(
            mechanism, config.rate, control, fusion, config.imus, FUSIONS[config.fusion], calibration, config.magnetometer,
            config.fusion == "section-5", safety, drives, 0.0 if config.rig == "fmu" else period,
            config.arm, encoder, config.base_imu, config.levelled, position, config.heave_period,
        )  # fmt: skip
        lead = bool(parameters["encoders"]["lead"])
        remarks = [
            calibration.remark,
            # Lengths need no IMU to close the loop.
            margin_remark(mechanism, control, fusion, config.rate, () if lead else config.imus, config.magnetometer),
            encoder_remark(lead) or integrity_remark(mechanism, fusion, config.imus, config.magnetometer),
            evidence_remark(mechanism, config.rate, config.fusion == "section-5"),
            aliasing_remark(model, config.rate),
            *target.remarks,
        ]
        count = int(parameters["rig"]["hold_cycles"]) + round(config.duration * config.rate)
        most = count + longest_delay(parameters)
        if records is None:
            _check_memory(config, most)
        if config.open_loop:
            parameters["pid"]["gains"] = 0.0
            watch_drives_alone(parameters)
        if not config.streamed:
            load_check(mechanism)
        # Loads the planner, so that the planning time is that of the plan alone.
        plan(mechanism, load_target("hold", mechanism, 0.1), 0.1)
        planning_time = 0.0
        if config.streamed:
            lengths = leg_lengths(mechanism, target.start.position, target.start.rotation)
            reference = Reference(rest(lengths), 0)
        else:
            question = pickle.dumps((mechanism, target, config.duration, demands_of(config, mechanism)))
            checked, planning_time = _checked(question)
            reference = checked.require_reachable(frames)
            reference = replace(reference, segments=reference.segments.copy())
            remarks.append(checked.remark)
        # A plant can be started only at a pose that the plan has found within the strokes.
        plant = stack.enter_context(simulated_plant(config, nominal, target.start, fmu)) if config.rig == "fmu" else None
        loop = PreparedLoop(
            fmu=np.zeros((), FMU_HANDLE) if plant is None else plant.handle,
            imu=imu,
            encoders=encoder_state(encoder, config.seed, period, encoder_faults, mechanism.legs),
            parameters=parameters,
            state=np.zeros((), STATE),
            segments=reference.segments,
            records=np.zeros(most, RECORD) if records is None else records,
            end=count,
            plant=plant,
            mechanism=mechanism,
            target=target,
            reference=reference,
            planning_time=planning_time,
            remarks=tuple(filter(None, remarks)),
            frames=frames,
        )
        close_loops(loop.loops, position)
        loop.load(in_python)
        yield loop


@lru_cache(maxsize=2)
def _checked(question: bytes) -> tuple[TargetCheck, float]:
    """The check of a pickled mechanism, target, duration and demands, which runs of a study share, and what it took [s]."""
    began = time.perf_counter()
    return check_against_limits(*pickle.loads(question)), time.perf_counter() - began


def demands_of(config: SimulationConfig, mechanism: Mechanism) -> Demands:
    """What a run asks of every pose besides that the legs reach it."""
    imus: tuple[int, ...] | None = imus_of(mechanism, config.imus)
    if lengths_lead(mechanism, config.imus, config.magnetometer, load_encoder(config.lengths)):
        imus = None
    return Demands(imus=imus, magnetometer=config.magnetometer, section_5=config.fusion == "section-5")


def _check_memory(config: SimulationConfig, count: int) -> None:
    if count * RECORD.itemsize > MOST_RECORD_BYTES:
        raise InputError(
            f"{config.duration:g} s at {config.rate:g} Hz would record {count * RECORD.itemsize / 2**30:.3g} GiB, more than "
            f"{MOST_RECORD_BYTES / 2**30:g} GiB: choose a shorter duration or a lower rate, or 'gough run', which keeps seconds"
        )


def _check_planar(config: SimulationConfig, calibration: Calibration) -> None:
    if config.fusion != "compiled":
        raise InputError(f"fusion {config.fusion!r} is for six legs; for {config.mechanism}, which is planar, take 'compiled'")
    if config.streamed and not config.operated:
        raise InputError(
            f"a target can be streamed to six legs alone; {config.mechanism} is planar: give a motion or a file, or move it "
            "with --target operator"
        )
    if config.frames is not None:
        raise InputError(f"frames are for six legs; {config.mechanism} is planar: leave --frames out")
    if calibration.joints.any():
        raise InputError(f"{config.calibration} moves the joints of six legs, and {config.mechanism} has three: leave them out")


def simulated_plant(
    config: SimulationConfig, nominal: Mechanism, start: Pose, built_fmu: Callable[[], Path] | None = None
) -> FmuPlant:
    """The plant of a configuration, at rest at `start`; one with parameters of its own starts where these say.

    `nominal` is the mechanism as it was designed. `built_fmu` waits for gough's own FMU and returns its path; without it, that
    is built now.

    Raises:
        GoughError: the FMU, its binding, a setting or the joint error cannot be used.
    """
    if config.plant is not None:
        fmu = Path(config.plant)
    else:
        fmu = default_fmu(model_of(nominal)) if built_fmu is None else built_fmu()
    binding = OWN_BINDING if config.binding is None else load_binding(config.binding)
    built = nominal.built(config.joint_error, config.seed)
    hold = config.hold_of(control_settings(nominal))
    settings = [each if each.at is None else replace(each, at=each.at + hold) for each in config.settings]
    late = [each for each in config.settings if each.at is not None and each.at >= config.duration]
    if late:
        raise InputError(f"{late[0].name} is set at {late[0].at:g} s, when the motion of {config.duration:g} s is over")
    parameters = built.plant_parameters(start) if binding.native else {}
    if config.plant is not None and binding.native:
        description = FmuDescription(fmu)
        check_number_of_legs(fmu, bind(binding, description), nominal.legs)
        if not takes_parameters(description, [*parameters]):
            parameters = {}
    if config.joint_error and not parameters:
        binds = f"{binding.source} binds" if binding.source else f"{fmu} is"
        raise InputError(f"{binds} an FMU with joints of its own, which have no joint error: leave it out")
    try:
        plant = FmuPlant(fmu, parameters, 1.0 / config.rate, binding, settings, nominal.legs)
    except UnknownNameError:
        _check_settings(config, FmuDescription(fmu))
        raise
    try:
        plant.move_base([placed(each, hold) for each in config.base_motions])
        _check_plant(config, plant, nominal)
        if not parameters:
            check_start(plant, nominal, start)
    except GoughError:
        plant.close()
        raise
    return plant


def _check_settings(config: SimulationConfig, description: FmuDescription) -> None:
    """Say where a setting of the controller belongs that was given as one of the plant."""
    for each in config.settings:
        of, _, name = each.name.rpartition(".")
        tables = " or ".join(f"[{table}]" for table in tables_with(name) if of in ("", table))
        if tables and each.name not in description:
            line = replace(each, name=name, at=None).text.replace("=", " = ")
            if config.mechanism.endswith(".toml"):
                remedy = f"Write {line} into that table of {config.mechanism}"
            else:
                lines = f'based_on = "{config.mechanism}", {tables} and {line}'
                remedy = f"Write a file with the lines {lines}, and name it by --mechanism FILE.toml"
            raise InputError(
                f"{each.name} is no variable of {description.path.name}. It is a setting of the controller, in the table "
                f"{tables} of the mechanism's file. {remedy}"
            )


def _check_plant(config: SimulationConfig, plant: FmuPlant, nominal: Mechanism) -> None:
    name, bound = plant.path.name, plant.bound
    absent = set(imus_of(nominal, config.imus)) - set(bound.imus)
    if absent:
        there = ",".join(map(str, bound.imus))
        raise InputError(f"{name} has no IMU {', '.join(map(str, sorted(absent)))}: leave it out with --imus {there}")
    if config.base_imu and bound.base_sensed.places.size == 0:
        raise InputError(
            f"{name} has no IMU on its base: bind base_imu_angular_velocity and base_imu_specific_force (docs/fmu.md), or "
            "leave out --base-imu"
        )
    if config.magnetometer and PLATFORM_IMU not in bound.magnetometers:
        raise InputError(f"{name} has no magnetometer on the platform: bind imu_magnetic_field, or leave out --magnetometer")


def closes_position(config: SimulationConfig) -> bool:
    """Whether the drives of a configuration close position loops; on CANopen, the settings of the bus say so.

    Raises:
        InputError: both say so, and differ, or those settings cannot be used.
    """
    if config.rig != "canopen":
        return config.drives == POSITION_DRIVES
    mode = _bus_settings(config).drives.mode
    if config.drives == POSITION_DRIVES != mode:
        raise InputError(
            f"--drives is {config.drives}, and on canopen the settings of the bus set the mode {mode}: leave --drives out, or "
            f'write mode = "{config.drives}" into the table [drives] of --rig-at FILE.toml'
        )
    return mode == POSITION_DRIVES


def _bus_settings(config: SimulationConfig) -> "CanopenSettings":
    with missing_extras_named():
        from hil.rigs.canopen.settings import DEFAULT_FILE, canopen_settings

    return canopen_settings(config.rig_at or DEFAULT_FILE, config.base_imu)


def rig_of(config: SimulationConfig) -> Rig | None:
    """The rig that a configuration names; None for the plant's FMU.

    Raises:
        GoughError: the rig cannot be made, or its number of legs is not the mechanism's.
    """
    mechanism, period = load_in_space(config.mechanism), 1.0 / config.rate
    check_legs(config.rig, mechanism)
    if config.rig == "udp":
        return UdpRig(config.rig_at or DEFAULT_ADDRESS, period, lengths=config.lengths != NO_LENGTHS, base_imu=config.base_imu)
    if config.rig == "canopen":
        with missing_extras_named():
            from hil.rigs.canopen.rig import CanopenRig

        return CanopenRig(_bus_settings(config), period, lengths=config.lengths != NO_LENGTHS)
    if config.rig == "replay":
        if not config.rig_at:
            raise InputError("a replay needs its recording: name it with --rig-at FILE.mcap")
        return ReplayRig(config.rig_at.split(","), period, mechanism)
    if config.rig.startswith(PYTHON_RIG):
        return python_rig(config.rig.removeprefix(PYTHON_RIG), mechanism, period, config.rig_at)
    return None
