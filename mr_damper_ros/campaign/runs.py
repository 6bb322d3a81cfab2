"""One run on a machine: driven, played from a file, or cut out of a recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mr_damper_ros.estimation.experiment_design import MachineLimits, PlannedRun
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion, RepeatedMatch, ramp
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.processes.files import write_text
from mr_damper_ros.report.document import csv_text
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock, ZeroOrderHold
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.signals.uniform_grid import Placed


@dataclass(frozen=True)
class DriveSettings(CheckedSettings):
    """Criteria for whether a machine follows the commanded run."""

    settle_timeout: float = option(
        60.0,
        "Time limit [s] for the machine to reach the commanded steady motion, in addition to ten "
        "cycles of a sine or ten times the length of another motion. After it, the campaign ends "
        "and reports the reason. A manual press has no time limit.",
        within=(1.0, 3600.0),
    )
    amplitude_tolerance: float = option(
        0.1,
        "Largest relative deviation of amplitude and frequency from the command. The "
        "identification uses the motion as measured.",
        within=(0.001, 0.3),
    )
    current_tolerance: float = option(
        0.05,
        "Largest deviation of the measured current from the command [A].",
        within=(0.001, 10.0),
    )


class MachineCommand(NamedTuple):
    """A motion (None: rest) at a ``current`` [A]."""

    motion: PeriodicMotion | None
    current: float


REST = MachineCommand(None, 0.0)


class RunDriver:
    """Conducts one run: receives all measurements and provides the ``command`` for the machine.

    ``state`` says in words what the run is waiting for, ``recording_begun`` whether the motion has
    settled. At the end there is a ``recording``, or a ``fault`` in words. ``current`` [A] and
    ``celsius`` hold the readings.
    """

    def __init__(
        self,
        run: PlannedRun,
        limits: MachineLimits,
        settings: DriveSettings,
        *,
        by_hand: bool = False,
    ) -> None:
        self.run = run
        self.state = "the motion grows"
        self.recording_begun = False
        self.recording: Recording | None = None
        self.fault = ""
        self.current = ZeroOrderHold(60.0 + 2.0 * run.duration)
        self.celsius = ZeroOrderHold(60.0 + 2.0 * run.duration)
        self._limits = limits
        self._settings = settings
        self._motion = run.motion
        patience = settings.settle_timeout + 10.0 * self._motion.length
        self._patience = math.inf if by_hand else patience
        self._blocks: list[SampleBlock] = []
        self._passed = 0.0  # recorded time [s]
        self._since_ns: int | None = None
        self._next_check_ns = 0

    @property
    def over(self) -> bool:
        """Whether the run has been made, or cannot be made."""
        return self.recording is not None or bool(self.fault)

    @property
    def command(self) -> MachineCommand:
        """The present command for the machine."""
        if self.over:
            return REST
        return MachineCommand(self._motion, float(self.run.current_at(np.array([self._passed]))[0]))

    def add_block(self, placed: Placed) -> None:
        """Add samples on the uniform grid."""
        if placed.restarts:
            self._blocks = []
            if self.recording_begun and not self.over:
                self.recording_begun, self._passed = False, 0.0
                self.state = "samples were lost: the run restarts"
        if placed.kind == "jump_back":
            self.current.follow_jump()
            self.celsius.follow_jump()
        if self.over or placed.kind == "repeat":
            return
        block = placed.block
        force = float(np.max(np.abs(block.force)))
        if force > self._limits.force:
            self.fault = f"the force reached {force:.4g} N, above {self._limits.force:.4g} N"
            return
        if self._since_ns is None:
            self._since_ns = self._next_check_ns = block.start_ns
        self._blocks.append(block)
        if self.recording_begun:
            self._passed += block.sample_count * block.period
            self._finish()
        elif block.end_ns >= self._next_check_ns:
            self._next_check_ns = block.end_ns + round(0.25 * NANOSECONDS / self.run.frequency)
            self._settle(block, (block.end_ns - self._since_ns) / NANOSECONDS)

    def _settle(self, block: SampleBlock, waited: float) -> None:
        """Start the recording if the machine follows the command; ``waited`` [s] so far."""
        # Only the samples needed for the checks are kept.
        held = np.cumsum([one.sample_count * one.period for one in self._blocks[::-1]])
        needed = int(np.searchsorted(held, 2.0 * self._motion.length, side="right")) + 1
        self._blocks = self._blocks[-needed:]
        displacement = np.concatenate([one.displacement for one in self._blocks])
        span = 0.5 * float(np.ptp(displacement))
        # Noise may exceed the limit of the machine by 5 %.
        if span > 1.05 * self._limits.amplitude:
            most = 1e3 * self._limits.amplitude
            self.fault = f"the amplitude reached {1e3 * span:.3g} mm, above {most:.3g} mm"
            return
        unsettled = self._off_motion(displacement, block.period) or self._off_current(block)
        if not unsettled:
            self._blocks = []
            self.recording_begun, self.state = True, "the run is recorded"
        elif waited > self._patience:
            self.fault = f"the machine does not follow the command: {unsettled}"
        else:
            self.state = unsettled

    def _off_motion(self, displacement: Array, period: float) -> str:
        """Deviation of the motion from the command, in words, or empty."""
        tolerance, cycle = self._settings.amplitude_tolerance, self._motion.length
        count, sine = round(cycle / period), self.run.kind is MotionKind.SINE
        if displacement.size < (2 * count if sine else count + 1):
            return "the motion grows"
        if not sine:
            match = RepeatedMatch(self._motion, period)
            left = match.left_of(displacement[-match.count :])
            if left <= tolerance:
                return ""
            return f"the motion deviates by {left:.0%} from {self.run.kind.description} as planned"
        wanted = self.run.amplitude
        cycles = displacement[-2 * count :].reshape(2, count)
        centred = cycles - cycles.mean(axis=1, keepdims=True)
        wave = np.exp(2j * math.pi * np.arange(count) / count)
        # The sine fitted to a cycle is the real part of the phasor times the wave.
        phasors = 2.0 * np.mean(centred * np.conj(wave), axis=1)
        before, size = np.abs(phasors).tolist()
        rest = float(np.std(centred[1] - (phasors[1] * wave).real))
        if abs(size - wanted) > tolerance * wanted:
            return f"the amplitude is {1e3 * size:.3g} mm, not {1e3 * wanted:.3g} mm"
        off = float(np.angle(phasors[1] * np.conj(phasors[0]))) / (2.0 * math.pi)
        if abs(off) > tolerance:
            return f"the frequency is {(1.0 + off) / cycle:.3g} Hz, not {1.0 / cycle:.3g} Hz"
        # Two cycles of a steady sine differ by 2 % at most, and deviate from it by 10 % RMS.
        if abs(size - before) > 0.02 * size or rest > 0.1 * size:
            return "the motion is not steady yet"
        return ""

    def _off_current(self, block: SampleBlock) -> str:
        """Deviation of the current from the command, in words, or empty."""
        if not self.current.known_from(block.start_ns):
            return "no current has been received"
        current = float(self.current.at(block.end_ns, block.period, 1)[0])
        wanted = self.run.currents[0]
        if abs(current - wanted) > self._settings.current_tolerance:
            return f"the current is {current:.3g} A, not {wanted:.3g} A"
        return ""

    def _finish(self) -> None:
        """Make the recording once all samples and their currents have arrived."""
        first, last = self._blocks[0], self._blocks[-1]
        count = round(self.run.duration / first.period)
        if self._passed < (count - 0.5) * first.period:
            return
        known = self.current.last_stamp_ns
        needed_ns = first.start_ns + round(count * first.period * NANOSECONDS)
        # Readings of the current may arrive one second after the samples.
        last_ns = needed_ns + NANOSECONDS
        if (known is None or known < needed_ns) and last.end_ns < last_ns:
            return
        moved, force = (
            np.concatenate([getattr(block, name) for block in self._blocks])[:count]
            for name in ("displacement", "force")
        )
        start, period = first.start_ns, first.period
        current = self.current.at(start, period, count)
        is_measured = self.celsius.known_from(last.end_ns)
        celsius = self.celsius.at(start, period, count) if is_measured else None
        self.recording = Recording("run", start, period, moved, force, current, celsius)


def signal(run: PlannedRun, sample_rate: float) -> tuple[Array, Array, Array]:
    """Time [s], displacement [m] and current [A] of a run, each of shape (n,).

    The run starts and ends at rest. At the first current the motion grows smoothly, within two
    cycles of a sine or one period of another motion. After the run, it fades in the same way.
    """
    motion = run.motion
    grow = motion.growth
    count = round((run.duration + 2.0 * grow) * sample_rate) + 1
    time = np.arange(count) / sample_rate
    envelope = ramp(np.minimum(time, run.duration + 2.0 * grow - time), 0.0, grow)[0]
    displacement, _, _ = motion.at(time - grow)
    return time, envelope * displacement, run.current_at(time - grow)


def write_signal(run: PlannedRun, path: Path, sample_rate: float = 1000.0) -> None:
    """Write the samples of a run as CSV, in the format of ``mr-damper import``. Raises OSError."""
    columns = ("time:s", "displacement:m", "current:A")
    rows = zip(*signal(run, sample_rate), strict=True)
    write_text(path, csv_text(columns, ([f"{value:.9g}" for value in row] for row in rows)))


class RunNotFoundError(ValueError):
    """A recording does not contain the run; the message gives the reason."""


def cut_run(run: PlannedRun, recording: Recording) -> Recording:
    """The part of a recording that contains a run.

    If the current is stepped, its first step locates the run; if not, the part with the smallest
    deviation from the planned motion is used. Raises RunNotFoundError.
    """
    period, displacement = recording.period, recording.displacement
    match = RepeatedMatch(run.motion, period)
    count = max(round(run.duration / period), match.count)
    stepped = len(run.currents) > 1
    if stepped:
        first, second = run.currents[:2]
        beyond = (recording.current - 0.5 * (first + second)) * np.sign(second - first) > 0.0
        steps = np.flatnonzero(np.diff(beyond.astype(np.int8)) > 0) + 1
        begins = steps - round(run.stretch / period)
    else:
        # Eight starting points per shortest cycle, and about 2000 at most.
        highest = max(run.frequency, run.highest_frequency)
        stride = max(round(1.0 / (8 * highest * period)), displacement.size // 2000, 1)
        begins = np.arange(0, displacement.size, stride)
    best, nearest = None, math.inf
    for begin in begins[(begins >= 0) & (begins + count <= displacement.size)].tolist():
        # The phase of a sine may drift relative to the command, so only its ends are compared.
        length = match.count if run.kind is MotionKind.SINE else count
        ends = displacement[begin : begin + length], displacement[begin + count - length :][:length]
        left = max(map(match.left_of, ends))
        current = float(np.median(recording.current[begin : begin + count]))
        wrong = 0.0 if stepped else abs(current - run.currents[0])
        if wrong <= DriveSettings.current_tolerance and left < nearest:
            best, nearest = begin, left
    if best is None or not (stepped or nearest <= DriveSettings.amplitude_tolerance):
        amperes = " to ".join(f"{current:g}" for current in run.currents[:2])
        off = "" if best is None else f", and deviates by {nearest:.0%} at least"
        raise RunNotFoundError(
            f"{recording.name} does not contain the run, {run.duration:.3g} s of "
            f"{run.kind.description} ({run.motion.sentence}) at {amperes} A; its amplitude is "
            f"{500.0 * np.ptp(displacement):.3g} mm, its duration {recording.duration:.3g} s, and "
            f"its current {np.median(recording.current):.3g} A{off}"
        )
    return recording.part(slice(best, best + count))


def run_as_made(recording: Recording) -> PlannedRun:
    """The unplanned run of a recording: a steady sine at one current.

    Raises RunNotFoundError if the recording is not such a run.
    """
    sine = Window.from_samples(
        recording.displacement, recording.force, recording.current, recording.period
    ).motion.sine
    current = float(np.median(recording.current))
    if sine is None or np.ptp(recording.current) > 2.0 * DriveSettings.current_tolerance:
        raise RunNotFoundError(f"{recording.name} is not a steady sine at one current")
    cycles = math.floor(recording.duration * sine.frequency)
    return PlannedRun(sine.amplitude, sine.frequency, (current,), cycles / sine.frequency)
