"""What a fault adds to the data: its signature, from the words that `gough simulate --fault` takes.

A fault is played on the exact signals of a motion, at every cycle of the loop, as its words say: readings turn, grow, stand
still, are shaken and clipped; a base tilts or is accelerated under all IMUs; joints are not where they were drawn. The
difference from the readings without it, averaged over each step of the model, is the signature.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf, pi

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from hil.studies.detectability.kinematics import Motion, signals
from hil.studies.detectability.model import DATA
from plant.compiled import Record
from plant.dynamics.base_course import BaseMotionKind, base_motion_of_text
from plant.errors import InputError
from plant.imu import ImuModel, imu_state
from plant.imu.model import SensorErrors
from plant.imu_disturbances import BASE_PREFIX, Course, Disturbance, DisturbanceKind, disturbance_of_text
from plant.imu_wiring import IMU_COUNT
from plant.mechanism import Mechanism
from plant.pose import Array

GYROSCOPE, ACCELEROMETER = range(2)
TOLD_BY = {kind.label for kind in DisturbanceKind} - {"imu-noise", "imu-clock", "imu-jitter"}
"""Disturbances of IMUs that have a signature; the others do not change what an IMU reads on average."""


_NOTHING = 1e-9
"""Less is rounding [rad/s, m/s^2, m/s]."""

_OF_BOTH_SENSORS = ("imu-temperature", "imu-supply")


class NoSignatureError(InputError):
    """A fault adds nothing to the data that a linear test could find."""


@dataclass(frozen=True)
class Stage:
    """Where faults are played.

    Attributes:
        mechanism: as drawn; the one of which the data are compared with each other.
        built: as it is.
        imu: the kind of IMUs.
        seed: of their imperfections.
        motion: of the platform at the loop's cycles.
        times: (N,) [s], of these, evenly spaced; faults count from 0, and those from the start are there before.
    """

    mechanism: Mechanism
    built: Mechanism
    imu: ImuModel
    seed: int
    motion: Motion
    times: Array

    @property
    def period(self) -> float:
        """Time between two cycles [s]."""
        return float(self.times[1] - self.times[0])

    @property
    def models(self) -> tuple[SensorErrors, SensorErrors]:
        """Of gyroscopes and accelerometers."""
        return self.imu.gyroscope, self.imu.accelerometer


def signature(stage: Stage, texts: Sequence[str], cycles: int) -> Array:
    """The signature (M, 48) of faults that happen together, averaged over steps of so many cycles.

    Raises:
        NoSignatureError: neither faults nor the joints add anything to the data, as noise does not, nor a gyroscope that is
            stuck while nothing turns.
        GoughError: there is no such fault, or its words are wrong.
    """
    real = signals(stage.built, stage.motion)
    ideal = real if stage.built is stage.mechanism else signals(stage.mechanism, stage.motion)
    readings = np.stack([real.angular_velocity, real.specific_force])
    told = [text for text in texts if text.startswith(BASE_PREFIX) or text.partition(":")[0] in TOLD_BY]
    # IMUs are bent and shaken after the base has moved them.
    for text in sorted(told, key=lambda text: not text.startswith(BASE_PREFIX)):
        if text.startswith(BASE_PREFIX):
            _move_base(stage, readings, base_motion_of_text(text))
        else:
            _disturb(stage, readings, disturbance_of_text(text))
    added = real._replace(angular_velocity=readings[0], specific_force=readings[1]).data() - ideal.data()
    steps = len(added) // cycles
    averages: Array = added[: steps * cycles].reshape(steps, cycles, DATA).mean(axis=1)
    if np.abs(averages).max() < _NOTHING:
        raise NoSignatureError("no sensor reads anything else on average")
    return averages


def directions_of(texts: Sequence[str]) -> int:
    """The number of unknown directions of faults: the axes of a sensor, a mounting, a base or a joint, for each of them."""
    return max(3, sum(6 if text.startswith(_OF_BOTH_SENSORS) else 3 for text in texts))


def _disturb(stage: Stage, readings: Array, d: Disturbance) -> None:
    """Change the readings (2, N, 7, 3) of the IMUs as a disturbance does."""
    imus, axis = [imu for imu in d.imus if imu < IMU_COUNT], np.array(d.axis)
    begin = d.begin if d.begin >= 0.0 else stage.times[0]
    end = begin + d.duration
    there = (stage.times >= begin) & (stage.times < end)
    level = _level(d.size, d.course, d.span, d.every)

    def size(at: Array) -> Array:
        return np.where((at >= begin) & (at < end), level(at - begin), 0.0)

    sizes = size(stage.times)[:, None, None]
    if d.kind == DisturbanceKind.TURN:
        turns = Rotation.from_rotvec(-sizes[:, 0] * axis)
        for own in readings:
            for k in imus:
                own[:, k] = turns.apply(own[:, k])
    elif d.kind in (DisturbanceKind.TEMPERATURE, DisturbanceKind.SUPPLY):
        state = imu_state(stage.imu, stage.seed, stage.period)
        warmer = d.kind == DisturbanceKind.TEMPERATURE
        for sensor, own in enumerate(readings):
            if warmer:
                own[:, imus] *= 1.0 + sizes * state["scale_per_kelvin"][sensor, imus]
            own[:, imus] += sizes * state["bias_per_kelvin" if warmer else "bias_per_volt"][sensor, imus]
    elif d.sensor > ACCELEROMETER:
        raise NoSignatureError("magnetometers take no part in the test")
    else:
        own, model = readings[d.sensor], stage.models[d.sensor]
        if d.kind == DisturbanceKind.OFFSET:
            own[:, imus] += sizes * axis
        elif d.kind == DisturbanceKind.SCALE:
            own[:, imus] *= 1.0 + sizes * axis
        elif d.kind == DisturbanceKind.RANGE:
            own[:, imus] = np.where(there[:, None, None], np.clip(own[:, imus], -sizes, sizes), own[:, imus])
        elif d.kind == DisturbanceKind.STUCK:
            held = own[int(np.argmax(there)), imus]
            own[:, imus] = np.where(there[:, None, None] & (axis != 0.0), held, own[:, imus])
        else:
            shaken, squared = (_sampled(stage, model, each)[:, None, None] for each in (size, lambda at: size(at) ** 2))
            rectified = model.rectification * (2.0 * own[:, imus] * shaken * axis + squared * axis**2)
            own[:, imus] = np.clip(own[:, imus] + shaken * axis + rectified, -model.reach, model.reach)


def _level(size: float, course: int, span: float, every: float) -> Callable[[Array], Array]:
    """A size over the time since its begin."""

    def pulse(t: Array) -> Array:
        phase = np.mod(np.maximum(t, 0.0), every)
        return np.where(phase < span, np.sin(pi * phase / span), 0.0)

    courses: dict[int, Callable[[Array], Array]] = {
        Course.STEP: np.ones_like,
        Course.RAMP: lambda t: np.clip(t / span, 0.0, 1.0),
        Course.SETTLE: lambda t: -np.expm1(-np.maximum(t, 0.0) / span),
        Course.SINE: lambda t: np.sin(2.0 * pi * t / span),
        Course.PULSES: pulse,
    }
    return lambda t: size * courses[course](t)


def _sampled(stage: Stage, sensor: SensorErrors, signal: Callable[[Array], Array]) -> Array:
    """A signal (N,) as an IMU samples it: converted as often as it does, and low-passed. What is faster aliases."""
    conversions = max(1, round(stage.imu.conversion_rate * stage.period))
    step = stage.period / conversions
    values = signal(stage.times[0] + step * np.arange(1 - conversions, conversions * (len(stage.times) - 1) + 1))
    if sensor.section_bandwidth < inf:
        # Exact for a signal that is linear between conversions.
        ratio = 2.0 * pi * sensor.section_bandwidth * step
        keep, share = np.exp(-ratio), -np.expm1(-ratio) / ratio
        for _ in range(sensor.order):
            values = lfilter([1.0 - share, share - keep], [1.0, -keep], values)
    sampled: Array = values[conversions - 1 :: conversions]
    return sampled


def _move_base(stage: Stage, readings: Array, m: Record) -> None:
    """Tilt or accelerate the base: all IMUs see it, and the pose in {1} stays as it is. To first order in the tilt phi,

        angular velocity + phi',   specific force + phi x g + phi'' x r + 2 phi' x v,

    seen in {1}, where r and v are the IMU's place and velocity.
    """
    axis, exact, size = np.array(m["axis"]), signals(stage.built, stage.motion), partial(_base_course, m)
    t, h = stage.times, 1e-4
    now, before, after = ((size(at))[:, None, None] for at in (t, t - h, t + h))
    if m["kind"] == BaseMotionKind.ACCELERATION:
        force = np.broadcast_to(now * axis, exact.places.shape)
    else:
        rate, hurry = (after - before) / (2.0 * h), (after - 2.0 * now + before) / h**2
        force = now * np.cross(axis, stage.built.plant["gravity"]) + hurry * np.cross(axis, exact.places)
        force = force + 2.0 * rate * np.cross(axis, exact.velocities)
        readings[GYROSCOPE] += rate * np.einsum("nkji,j->nki", exact.axes, axis)
    readings[ACCELEROMETER] += np.einsum("nkji,nkj->nki", exact.axes, force)


def _base_course(m: Record, times: Array) -> Array:
    """The size of a base's motion at times; it comes and goes gently within its rise, and a step from the start is there."""
    rise, size = float(m["rise"]), float(m["size"])
    begin = float(m["begin"])
    if begin < 0.0:
        begin = times[0] - rise if m["course"] == Course.STEP else times[0]

    def window(t: Array) -> Array:
        x = np.clip(t / rise, 0.0, 1.0) if rise else np.where(t >= 0.0, 1.0, 0.0)
        window: Array = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
        return window

    present = window(times - begin) - window(times - float(m["end"]))
    if m["course"] in (Course.STEP, Course.RAMP):
        return size * present
    return present * _level(size, int(m["course"]), float(m["span"]), float(m["every"]))(times - begin)
