"""Emulated sources that obey commands: a test rig, and a quarter car with a damper."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from mr_damper_ros.control.linear_plant import ROUGHNESS, Bump, IsoRoad, QuarterCar
from mr_damper_ros.emulation import emulator, motions
from mr_damper_ros.emulation.emulator import HOT_FORCE, PlantRig, Surroundings, invented_damper
from mr_damper_ros.emulation.faults import FaultError, Instruments, faults_of
from mr_damper_ros.kinematics.periodic_motion import MOST_CYCLES, MotionKind, PeriodicMotion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS, THESIS_71_CELSIUS, find, parameters
from mr_damper_ros.rig.commander import CommandSettings, CurrentCommander, MotionCommander, Origin
from mr_damper_ros.rig.sources.source import Source
from mr_damper_ros.settings.option_table import ParameterTable, group, option, with_default
from mr_damper_ros.signals.blocks import RigBlock, SuspensionState

MOST_CURRENT = 10.0
"""Largest magnitude of the current [A] of an emulated supply."""

_THESIS_TEMPERATURES = "thesis_temperatures"


@dataclass(frozen=True)
class _RigOptions(ParameterTable):
    """Options common to the emulated rig and the emulated quarter car."""

    hot_force: float = option(
        1.0,
        "Factor on the force at 71 °C, below 1 for a damper that weakens as it heats up; the "
        "force changes linearly from 28 °C to 71 °C. The force of the damper in the thesis falls "
        "to 0.74, which thesis_temperatures already includes.",
        within=(0.0, 10.0),
    )
    current: float = option(
        1.5,
        "Manual setpoint of the supply current [A]. It can be set while the rig runs: `ros2 "
        "param set /bridge emulated.current 0.5`. It holds until a command arrives on "
        "supply/current_command.",
        within=(-MOST_CURRENT, MOST_CURRENT),
        read_only=False,
    )
    command_timeout: float = with_default(CommandSettings, "command_timeout", 0.5)
    coil_time_constant: float = option(
        0.0,
        "Time constant [s] with which the coil current, and so the force, follows the supply "
        "current.",
        within=(0.0, 1.0),
    )
    rig: emulator.RigSettings = group(emulator.RigSettings, flat=True)
    seed: int = option(
        0, "Seed of noise and road; the same seed gives the same samples.", within=(0, 2**31 - 1)
    )


@dataclass(frozen=True)
class EmulatedOptions(_RigOptions):
    """The emulated rig of ``source: emulated``."""

    damper: str = option(
        _THESIS_TEMPERATURES,
        f"The damper in the machine: {_THESIS_TEMPERATURES} (the damper of the thesis at 28 °C and "
        "71 °C, with its force interpolated by the emulated temperature), a condition of the "
        "thesis such as 5.0mm_1Hz_1.5A, or the path of a parameter file (YAML) of any model.",
    )
    excitation: str = option(
        "sine",
        "Motion of the machine until commands arrive: sine; chirp (a sine whose frequency "
        "rises to the highest one and falls back within sweep_time); steps (four frequencies "
        "within sweep_time); random (between both frequencies); recorded (the displacement of "
        "motion_file, once; then the machine rests).",
        choices=("sine", "chirp", "steps", "random", "recorded"),
    )
    amplitude: float = option(
        0.005, "Amplitude of the motion [m], also of random motion.", within=(1e-6, 0.5)
    )
    frequency: float = option(
        1.0, "Frequency of the sine, or the lowest frequency [Hz].", within=(1e-3, 100.0)
    )
    highest_frequency: float = option(
        3.0, "Highest frequency [Hz] of chirp, steps and random motion.", within=(1e-3, 100.0)
    )
    sweep_time: float = option(
        30.0,
        "Duration [s] of a chirp, of four steps or of random motion, which then repeat.",
        within=(1.0, 86400.0),
    )
    motion_file: str = option("", "Path of the text, CSV or MAT file of a recorded motion.")
    motion_columns: str = option(
        "", "Columns of the file, as for source: record, such as time:s,displacement:mm,..."
    )
    largest_amplitude: float = option(
        0.05,
        "Largest amplitude [m] of a commanded motion; larger commands are rejected.",
        within=(1e-6, 0.5),
    )
    largest_velocity: float = option(
        1.0,
        "Largest peak velocity [m/s] of a commanded motion; larger commands are rejected.",
        within=(1e-6, 10.0),
    )
    thermal: emulator.ThermalModel = group(emulator.ThermalModel, flat=True)
    faults: str = option(
        "",
        "Faults, as name[:value][@begin[-end]] with times in seconds since the start, "
        "separated by blanks: force_gain:10@20-30 displacement_stuck@60. The names are in "
        "doc/faults.md.",
    )

    def objection(self) -> str:
        """Return the reason if an option is invalid, or an empty string."""
        try:
            faults_of(self.faults.split())
        except FaultError as error:
            return f"emulated.faults: {error}"
        if self.excitation == "recorded" and not (self.motion_file and self.motion_columns):
            return (
                "emulated.excitation is recorded, but emulated.motion_file or "
                "emulated.motion_columns is empty"
            )
        if self.excitation in ("chirp", "steps", "random") and not (
            self.highest_frequency > self.frequency
        ):
            return (
                f"emulated.highest_frequency is {self.highest_frequency:g} Hz: it must be above "
                f"emulated.frequency, {self.frequency:g} Hz"
            )
        return ""


class _EmulatedSupply(Source):
    """Base class of both sources: a supply whose current is commanded or set by hand."""

    _damper: Any
    """The damper of the open source."""

    def _supply(self) -> CurrentCommander:
        given = self.settings
        limits = CommandSettings(
            largest_current=MOST_CURRENT,
            smallest_current=-MOST_CURRENT,
            command_timeout=given.command_timeout,
        )
        return CurrentCommander(limits, given.current)

    def _rig(self, start_ns: int) -> emulator.RigSettings:
        return replace(self.settings.rig, seed=self.settings.seed, start_ns=start_ns)

    def close(self) -> None:
        """Discard the commanders."""
        self.commander = self.mover = None


class EmulatedSource(_EmulatedSupply):
    """An endless emulated rig; its supply and its motion take commands."""

    options = EmulatedOptions
    prefix = "emulated."

    def open(self) -> list[str]:
        """Read the parameters of the damper."""
        given = self.settings
        self._damper = _damper(given)
        self._excitation = _excitation(given)
        self.commander = self._supply()
        self.mover = MotionCommander(
            given.largest_amplitude, given.largest_velocity, given.command_timeout
        )
        return []

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """Yield the samples of a rig that starts now."""
        assert self.commander is not None
        assert self.mover is not None
        given, commander, mover = self.settings, self.commander, self.mover
        settings = self._rig(start_ns)
        faults = faults_of(given.faults.split(), given.seed)
        instruments = Instruments(faults)
        supply = emulator.SupplySetpoint(commander.step(time.monotonic()))
        rig = emulator.EmulatedRig(
            self._damper,
            self._excitation,
            supply,
            settings=settings,
            faults=faults,
            thermal=given.thermal,
            coil_time_constant=given.coil_time_constant,
        )
        motion: motions.CommandedMotion | None = None
        taken = 0
        while True:
            now = time.monotonic()
            supply.set(taken * settings.period, commander.step(now))
            rig.set_ambient(self.settings.thermal.ambient_temperature)
            rig.live = commander.origin(now) is not Origin.HAND or mover.commanded
            if mover.commanded:
                # Up to one chunk of samples may already have been computed ahead.
                begin = (taken + emulator.CHUNK) * settings.period
                if motion is None:
                    motion = motions.CommandedMotion(self._excitation, begin)
                    rig.move(motion)
                motion.command(mover.motion(now), begin)
            made = rig.next_block(self.stream.block_size)
            deliveries = instruments.read(made)
            yield from (block for block, _ in deliveries)
            if not deliveries:
                yield made.without_samples()
            taken += self.stream.block_size


def _excitation(rig: EmulatedOptions) -> motions.Excitation:
    """The motion that the options describe; raises ValueError or OSError."""
    low, high = rig.frequency, rig.highest_frequency
    if rig.excitation == "chirp":
        return PeriodicMotion(MotionKind.SWEEP, rig.amplitude, low, high, rig.sweep_time)
    if rig.excitation == "steps":
        return motions.SteppedSine(rig.amplitude, low, high, rig.sweep_time)
    if rig.excitation == "random":
        seed = rig.seed % MOST_CYCLES  # the number of different random motions
        return PeriodicMotion(MotionKind.RANDOM, rig.amplitude, low, high, rig.sweep_time, seed)
    if rig.excitation == "recorded":
        from mr_damper_ros.io.records import read_record

        # Only the displacement is used, so any current is valid.
        record = read_record(rig.motion_file, rig.motion_columns, current=0.0)
        return motions.SampledMotion(record.displacement, record.period)
    return motions.SineMotion(rig.amplitude, low)


def _damper(rig: EmulatedOptions) -> emulator.Damper:
    """The damper that the options describe; raises ValueError or OSError."""
    if rig.damper == _THESIS_TEMPERATURES:
        return emulator.EmulatedDamper(
            THESIS_28_CELSIUS, emulator.scaled(THESIS_71_CELSIUS, rig.hot_force)
        )
    is_file = rig.damper.endswith((".yaml", ".yml"))
    known = ParameterSet.load(rig.damper) if is_file else parameters(find(rig.damper))
    return emulator.EmulatedDamper(known, rig.hot_force)


_BUMP = "bump"
_INVENTED = "invented"


@dataclass(frozen=True)
class _Vehicle(QuarterCar):
    """A wheel of a loaded lorry: the forces of the invented damper matter, as in no light car."""

    body: float = with_default(QuarterCar, "body", 4000.0)
    wheel: float = with_default(QuarterCar, "wheel", 600.0)
    spring: float = with_default(QuarterCar, "spring", 160e3)
    tyre: float = with_default(QuarterCar, "tyre", 800e3)


@dataclass(frozen=True)
class _CarSettings(emulator.RigSettings):
    displacement_noise: float = with_default(emulator.RigSettings, "displacement_noise", 1e-6)
    sample_rate: float = option(1000.0, "Samples per second [Hz].", within=(200.0, 10_000.0))


@dataclass(frozen=True)
class QuarterCarOptions(_RigOptions):
    """The emulated quarter car of ``source: quarter_car``."""

    damper: str = option(
        _INVENTED,
        f"The damper in the car: {_INVENTED} (see config/invented_damper.yaml), or the path of a "
        "parameter file (YAML) of any model.",
    )
    road: str = option(
        "C",
        f"Road class of ISO 8608, or {_BUMP}: a bump of 60 mm by 3 m, three seconds after the "
        "start.",
        choices=(*ROUGHNESS, _BUMP),
    )
    speed: float = option(8.0, "Speed of the car [m/s].", within=(0.1, 100.0))
    car: _Vehicle = group(_Vehicle, flat=True)
    hot_force: float = with_default(_RigOptions, "hot_force", HOT_FORCE)
    current: float = with_default(_RigOptions, "current", 0.0)
    coil_time_constant: float = with_default(_RigOptions, "coil_time_constant", 0.01)
    rig: _CarSettings = group(_CarSettings, flat=True)
    initial_temperature: float = with_default(emulator.ThermalModel, "initial_temperature", 28.0)
    heat_capacity: float = with_default(emulator.ThermalModel, "heat_capacity", 430.0)


class QuarterCarSource(_EmulatedSupply):
    """An endless drive of a car on its road; its supply takes commands."""

    options = QuarterCarOptions
    prefix = "quarter_car."
    suspended = True

    def open(self) -> list[str]:
        """Read the parameters of the damper."""
        given = self.settings
        invented = given.damper == _INVENTED
        known = invented_damper(0.0) if invented else ParameterSet.load(given.damper)
        self._damper = emulator.EmulatedDamper(known, given.hot_force, built_in=True)
        self.commander = self._supply()
        return []

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """Yield the samples of a car that starts now."""
        assert self.commander is not None
        given = self.settings
        road: Surroundings = (
            Bump(height=0.06, length=3.0, speed=given.speed, start=3.0)
            if given.road == _BUMP
            else IsoRoad(given.road, given.speed, given.seed)
        )
        supply = emulator.SupplySetpoint(self.commander.step(time.monotonic()))
        rig = PlantRig(
            self._damper,
            given.car.plant,
            road,
            supply,
            settings=self._rig(start_ns),
            thermal=emulator.ThermalModel(
                initial_temperature=given.initial_temperature, heat_capacity=given.heat_capacity
            ),
            coil_time_constant=given.coil_time_constant,
            substeps=2,
        )
        taken = 0
        while True:
            supply.set(taken * rig.settings.period, self.commander.step(time.monotonic()))
            made = rig.next_block(self.stream.block_size)
            taken += self.stream.block_size
            yield replace(made, suspension=suspension_state_of(rig))


def suspension_state_of(rig: PlantRig) -> SuspensionState:
    """The present suspension state of a car, as input of the suspension controllers."""
    stroke, body, tyre, wheel = rig.plant.state.tolist()
    return SuspensionState(body, wheel, float(rig.plant.rates[1]), stroke, tyre)
