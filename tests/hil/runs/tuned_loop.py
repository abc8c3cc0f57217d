"""A closed loop on the FMU whose commands a test changes on their way: raised, delayed, disturbed."""

from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from controller.planning.target import Target
from hil.runs.config import POSITION_DRIVES, SimulationConfig
from hil.runs.prepare import PreparedLoop, prepared_loop
from plant.fmu.settings import Setting

CALM = {
    "following": 1.0, "velocity_margin": 1e6, "saturation": 1e6, "drive_deviation": 1e6, "oscillation": 1e6,
    "stroke_margin": 1.0, "patience": 1e6, "watch_imus": 0.0, "misfit": 1e6, "length_deviation": 1.0, "vibration": 1e6,
}  # fmt: skip
"""Limits that let an unstable loop go on."""

KICK, MULTISINE, RUNAWAY = 1e-7, 1e-5, 0.02
"""Of the commands [m/s]: the first two are small enough for the loop to be linear."""

ROUNDING = 1e-4
"""Below this share of its start a kick has died down."""

SETTLED_S, CLOSED_S = 7.0, 2.0
"""How long the filters settle on the brakes, as in the design, and the feedback after that."""


@dataclass
class TunedLoop:
    """A loop that stands at a pose, and can go back to that time."""

    loop: PreparedLoop
    legs: int
    rate: float

    def __post_init__(self):
        self.now = int(self.loop.state["time"]["cycle"])
        self.memory = {name: array.copy() for name, array in self.loop.memory().items()}
        self.plant = self.loop.plant.state()

    def back(self):
        """Go back to when the loop stood."""
        for name, array in self.loop.memory().items():
            array[...] = self.memory[name]
        self.loop.plant.restore(self.plant)

    def run(self, duration, change):
        """Run for a time [s], from when the loop stood.

        `change(k, feedback)` makes of the feedback (n,) of cycle k what goes to the drives. A loop that runs away is left
        alone early. Returns the feedback, what went to
        the drives, and the estimated lengths, (N, n) each.
        """
        self.back()
        state, found = self.loop.state, []
        for k in range(round(duration * self.rate)):
            assert self.loop.run(self.now + k + 1) == 0, self.loop.reason()
            command, ahead = state["pid"]["command"], state["load"]["feed_forward"][: self.legs]
            feedback = command[: self.legs] - ahead
            sent = change(k, feedback.copy())
            command[: self.legs] = ahead + sent
            found.append((feedback.copy(), sent, state["pose"]["lengths"][: self.legs].copy()))
            if not np.abs(sent).max() < RUNAWAY:
                break
        return [np.array(each) for each in zip(*found, strict=True)]

    def later(self, time):
        """The loop when so much of the motion is over [s]."""
        self.back()
        assert self.loop.run(self.loop.cycle_at(time)) == 0, self.loop.reason()
        return TunedLoop(self.loop, self.legs, self.rate)

    def grows(self, gain=1.0, delay=0, leg=None, duration=2.0):
        """Whether a kick grows when the feedback of a leg, or of all, is this times as strong, and so many cycles late."""
        rest = self.run(1.0 / self.rate, lambda k, feedback: feedback)[0][0]
        gains = np.full(self.legs, gain) if leg is None else np.where(np.arange(self.legs) == leg, gain, 1.0)
        waiting = [rest] * (delay + 1)
        kick = KICK * np.random.default_rng(0).standard_normal(self.legs)

        def change(k, feedback):
            waiting.append(rest + gains * (feedback - rest))
            return waiting[-1 - delay] + (kick if k == 0 else 0.0)

        _, _, lengths = self.run(duration, change)
        if len(lengths) < round(duration * self.rate):
            return True
        steps = np.linalg.norm(np.diff(lengths, n=2, axis=0), axis=1)
        first, *later = (np.sqrt(np.mean(part**2)) for part in np.split(steps, np.arange(1, 20) * len(steps) // 20))
        # What has died down is rounding; what shakes so much that the filters trust the IMUs less grows no further.
        return later[-1] > max(later[4], ROUNDING * first) or max(later[1:]) > first

    def crossover(self, leg, near):
        """The frequency at which the loop gain of a leg is one, the others closed, from a multisine on its command [Hz]."""
        duration = float(np.ceil(max(2.0, 12.0 / near)))
        frequencies = np.unique(np.round(duration * near * np.geomspace(0.7, 1.4, 9))) / duration
        phases = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(frequencies))
        count = round(duration * self.rate)

        def wave(k):
            return MULTISINE * np.cos(2.0 * np.pi * frequencies * k / self.rate + phases).sum()

        def change(k, feedback):
            feedback[leg] += wave(k)
            return feedback

        # Periods: the first ones let what begins die down.
        still, _, _ = self.run(2.0 * duration, lambda k, feedback: feedback)
        moved, sent, _ = self.run(2.0 * duration, change)
        spectra = [np.fft.rfft((each - still)[-count:, leg]) for each in (moved, sent)]
        lines = np.round(frequencies * duration).astype(int)
        gain = np.abs(spectra[0][lines] / spectra[1][lines])
        at = np.flatnonzero((gain[:-1] > 1.0) & (gain[1:] <= 1.0))[-1]
        return np.exp(np.interp(0.0, -np.log(gain[at : at + 2]), np.log(frequencies[at : at + 2])))


@contextmanager
def standing_loop(mechanism, gains, pose, rate, position=False, settled=SETTLED_S, closed=CLOSED_S):
    """The loop of a mechanism with these gains, which stands at a pose."""
    prefix = "position_" if position else ""
    control = {prefix + name: getattr(gains, name) for name in ("proportional", "integral")}
    control |= {"command_reserve": 100.0}
    settings = {**mechanism.settings, "control": control, "safety": CALM, "drives": {"slack": np.inf}}
    target = Target("pose", np.array([0.0, 1.0]), np.tile(pose.position, (2, 1)), np.tile(pose.rotation, (2, 1, 1)))
    config = SimulationConfig(
        mechanism=replace(mechanism, settings=settings), target=target, duration=40.0, rate=rate, imu="ideal", hold=settled,
        settings=(Setting("friction.coulomb", 0.0),), drives=POSITION_DRIVES if position else "velocity",
    )  # fmt: skip
    with prepared_loop(config) as loop:
        assert loop.run(loop.cycle_at(closed)) == 0, loop.reason()
        # The jerk of the brakes is no small signal: for seconds after it, the filter would take less of the accelerometer.
        loop.state["platform"]["unknown"] = 0.0
        yield TunedLoop(loop, mechanism.legs, rate)
