"""An emulated quarter car with a damper in it as a source: what is commanded moves the car."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from mr_damper_ros.control.linear_plant import ROUGHNESS, Bump, IsoRoad, QuarterCar
from mr_damper_ros.emulation.emulator import RigSettings, SupplyKnob, ThermalModel
from mr_damper_ros.emulation.plant_rig import (
    HOT_FORCE,
    BuiltInDamper,
    PlantRig,
    Surroundings,
    invented_damper,
)
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.rig.sources.source import MOST_CURRENT, Source, StreamSettings, emulated_supply
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.blocks import Moment, RigBlock

_BUMP = "bump"
_INVENTED = "invented"
_CAR = QuarterCar()


@dataclass(frozen=True)
class QuarterCarOptions(ParameterTable):
    """The emulated quarter car of ``source: quarter_car``."""

    damper: str = option(
        _INVENTED,
        f"The damper in the car: {_INVENTED} (see config/invented_damper.yaml), or the path of a "
        "parameter file (YAML) of any model.",
    )
    hot_force: float = option(
        HOT_FORCE,
        "Factor on its force at 71 °C, relative to 28 °C; in between the force changes linearly.",
        minimum=0.0,
        maximum=10.0,
    )
    road: str = option(
        "C",
        f"Road of an ISO 8608 class, or {_BUMP}: one of 60 mm by 3 m, three seconds after the "
        "start.",
        choices=(*ROUGHNESS, _BUMP),
    )
    speed: float = option(20.0, "Speed of the car [m/s].", minimum=0.1, maximum=100.0)
    current: float = option(
        0.0,
        "Supply current [A]. It may be changed while the car drives: this is the knob of the "
        "supply, which holds until a command comes.",
        minimum=-MOST_CURRENT,
        maximum=MOST_CURRENT,
        read_only=False,
    )
    command_timeout: float = option(
        0.5,
        "Time [s] that a command of the current holds; after that the current is zero.",
        minimum=0.01,
        maximum=3600.0,
    )
    coil_time_constant: float = option(
        0.01,
        "Time constant [s] with which the current in the coil, and so the force, follows the "
        "supply's.",
        minimum=0.0,
        maximum=1.0,
    )
    force_noise: float = option(
        5.53,
        "Standard deviation of the noise of the force [N]; 5.53 is the thesis' remaining error.",
        minimum=0.0,
        maximum=1e6,
    )
    displacement_noise: float = option(
        1e-6, "Standard deviation [m] of the noise of the displacement.", minimum=0.0, maximum=0.1
    )
    sample_rate: float = option(1000.0, "Samples per second [Hz].", minimum=200.0, maximum=10_000.0)
    initial_temperature: float = option(
        28.0, "Temperature of the damper at the start [°C].", minimum=-50.0, maximum=200.0
    )
    heat_capacity: float = option(
        430.0,
        "Heat capacity of the damper [J/K]. It takes up the power that the damper dissipates: with "
        "a smaller one it drifts faster.",
        minimum=0.1,
        maximum=1e6,
    )
    seed: int = option(0, "Seed of road and noise.", minimum=0, maximum=2**31 - 1)


class QuarterCarSource(Source):
    """A car on its road, for ever; its supply has a knob, and takes commands."""

    options = QuarterCarOptions
    prefix = "quarter_car."
    suspended = True

    def __init__(self, settings: QuarterCarOptions, stream: StreamSettings) -> None:
        super().__init__(settings, stream)
        self._damper: BuiltInDamper | None = None

    def open(self) -> list[str]:
        """Read the parameters of the damper."""
        given = self.settings
        known = (
            invented_damper(0.0)
            if given.damper == _INVENTED
            else ParameterSet.from_yaml(Path(given.damper).read_text(encoding="utf-8"))
        )
        self._damper = BuiltInDamper(known, given.hot_force)
        self.commander = emulated_supply(given.current, given.command_timeout)
        return []

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """The samples of a car that starts now."""
        assert self._damper is not None
        assert self.commander is not None
        given = self.settings
        knob = SupplyKnob(self.commander.step(time.monotonic()))
        rig = PlantRig(
            self._damper,
            _CAR.plant,
            _road(given),
            knob.schedule,
            settings=RigSettings(
                sample_rate=given.sample_rate,
                force_noise=given.force_noise,
                displacement_noise=given.displacement_noise,
                seed=given.seed,
                start_ns=start_ns,
            ),
            thermal=ThermalModel(initial=given.initial_temperature, capacity=given.heat_capacity),
            coil_time_constant=given.coil_time_constant,
            substeps=2,
        )
        taken = 0
        while True:
            knob.turn(taken / given.sample_rate, self.commander.step(time.monotonic()))
            made = rig.next_block(self.stream.block_size)
            taken += self.stream.block_size
            yield replace(made, suspension=moment_of(rig))

    def close(self) -> None:
        """Take the damper out."""
        self._damper = self.commander = None


def moment_of(rig: PlantRig) -> Moment:
    """What the controllers of a suspension see of a car now."""
    apart, body, tyre, wheel = rig.plant.state.tolist()
    return Moment(body, wheel, float(rig.plant.rates[1]), apart, tyre)


def _road(given: QuarterCarOptions) -> Surroundings:
    if given.road == _BUMP:
        return Bump(height=0.06, length=3.0, speed=given.speed, start=3.0)
    return IsoRoad(given.road, given.speed, given.seed)
