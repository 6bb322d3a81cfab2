"""Scenarios of trouble: what goes wrong, in which stream, and what cannot be known of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from benchmarks.other_dampers import random_motion
from mr_damper_ros.emulation.emulator import CurrentSchedule
from mr_damper_ros.emulation.faults import Fault, faults_of
from mr_damper_ros.emulation.motions import Excitation, SineMotion

BEGIN, END = 10.0, 14.0
"""When a fault begins and when it is repaired [s] since the start of the stream."""


@dataclass(frozen=True)
class UsualStream:
    """What goes on before anything goes wrong: a motion, and a constant current [A]."""

    motion: Callable[[], Excitation]
    current: float


STREAMS = {
    "sine": UsualStream(partial(SineMotion, 0.005, 1.0), 1.5),
    "weak": UsualStream(partial(SineMotion, 0.005, 1.0), 0.2),
    "off": UsualStream(partial(SineMotion, 0.005, 1.0), 0.0),
    "random": UsualStream(partial(random_motion, 0.003, 0.2, 3.0, 60.0, seed=3), 1.0),
}


@dataclass(frozen=True)
class Scenario:
    """Faults, as text without times, in a stream.

    ``lasts``: it is not repaired. ``current``: what the supply goes to [A] at the beginning, to go
    back at the end. ``unknowable``: why the signals cannot tell; empty where they can.
    ``other_damper``: why a set that is found meanwhile cannot be told from that of another damper,
    though it shows that something has happened; empty where it can.
    """

    faults: str = ""
    stream: str = "sine"
    lasts: bool = False
    current: float | None = None
    unknowable: str = ""
    other_damper: str = ""
    begin: float = BEGIN
    end: float = END

    @property
    def name(self) -> str:
        """What goes wrong, in which stream."""
        moved = "" if self.current is None else f"current to {self.current:g} A"
        return f"{' '.join(filter(None, (moved, self.faults)))} ({self.stream})"

    def made(self, seed: int) -> list[Fault]:
        """The faults with their times."""
        times = f"@{self.begin:g}" + ("" if self.lasts else f"-{self.end:g}")
        return faults_of([text + times for text in self.faults.split()], seed)

    @property
    def schedule(self) -> CurrentSchedule | None:
        """The current's schedule; None where it stays."""
        if self.current is None:
            return None
        usual = STREAMS[self.stream].current
        if self.lasts:
            return CurrentSchedule((0.0, self.begin), (usual, self.current))
        return CurrentSchedule((0.0, self.begin, self.end), (usual, self.current, usual))


_ANOTHER_DAMPER = (
    "a damper that has become so much stronger or weaker gives the same signals, as a change of "
    "temperature or a loss of oil does"
)
_ANOTHER_ZERO = "a gas pressure that has changed gives the same signals"
_ANOTHER_LAG = "a mount or a fluid that has become compressible gives the same signals"

_ANOTHER_MOTION = "a damper that gives this force in a motion of this size gives the same signals"
_ANOTHER_SPRING = "a spring beside the damper makes the force lead as much"


def _all(*faults: str, stream: str = "sine", lasts: bool = False) -> list[Scenario]:
    return [Scenario(text, stream, lasts) for text in faults]


SCENARIOS: tuple[Scenario, ...] = (
    # The load cell.
    *_all("force_gain:1000", "force_gain:0.001", "force_gain:10", "force_gain:0.1"),
    *_all("force_gain:-1", "force_gain:0", "force_stuck", "force_missing", "force_dropouts:5"),
    *_all("force_nan:2", "force_spikes:500", "force_noise:100", "force_clip:200"),
    *_all("force_coarse:200", "force_hum:200"),
    *_all("force_gain:1000", "force_gain:0.001", "force_gain:-1", lasts=True),
    # The displacement.
    *_all("displacement_gain:1000", "displacement_gain:0.001", "displacement_gain:-1"),
    *_all("displacement_gain:0"),
    Scenario("displacement_gain:10", other_damper=_ANOTHER_MOTION),
    Scenario("displacement_gain:0.1", other_damper=_ANOTHER_MOTION),
    *_all("displacement_stuck", "displacement_missing", "displacement_dropouts:5"),
    *_all("displacement_nan:2", "displacement_spikes:0.002", "displacement_noise:1e-4"),
    *_all("displacement_offset:0.01", "displacement_creep:0.001", "displacement_clip:0.003"),
    *_all("displacement_coarse:0.001", "displacement_hum:5e-5"),
    Scenario("displacement_delay:0.1", other_damper=_ANOTHER_SPRING),
    Scenario("displacement_sluggish:0.1", other_damper=_ANOTHER_SPRING),
    *_all("displacement_gain:-1", "displacement_stuck", lasts=True),
    # The current and its supply.
    *_all("current_gain:1000", "current_gain:0.001", "current_gain:-1", "current_missing"),
    *_all("current_nan:2", "current_spikes:1", "current_noise:0.2", "current_offset:0.5"),
    *_all("supply_clock:2", "supply_clock:-2", "supply_clock:3600"),
    *_all("coil_factor:0", "coil_factor:0.5", "coil_offset:-0.5"),
    Scenario("supply_clock:2", current=0.5),
    Scenario("supply_clock:-2", current=0.5),
    Scenario("current_stuck", current=0.5),
    Scenario("current_delay:1", current=0.5),
    Scenario(current=0.5),
    Scenario(current=1.42),
    Scenario(current=0.095, stream="off"),
    Scenario(current=0.29, stream="weak"),
    Scenario(current=1.5, stream="weak"),
    Scenario("current_stuck", current=1.5, stream="off"),
    # The thermometer.
    *_all("temperature_gain:10", "temperature_missing"),
    # Machine and damper.
    *_all("force_loss:0.5", "force_loss:0.1", "friction:200", "spring:5e4", "backlash:0.001"),
    *_all("end_stop:0.0045", "wear:0.6"),
    *_all("force_loss:0.5", "force_loss:0.2", lasts=True),
    *_all("amplitude:0.1", "amplitude:2", "tempo:0", "tempo:3", "tempo:0.1"),
    *_all("amplitude:0.1", "amplitude:10", "tempo:0.05", lasts=True),
    # The way.
    *_all("lost_blocks:0.05", "lost_blocks:1", "doubled_blocks:0.2", "reordered_blocks:0.2"),
    *_all("late_blocks:0.3", "repeated_buffer", "stamp_jitter:0.4", "clock_jump:60"),
    *_all("clock_jump:-60", "clock_jump:1e6", "clock_drift:0.001", "wrong_period:2"),
    *_all("wrong_period:0.5", "wrong_period:1e6", "recount", "swapped"),
    # In random motion.
    *_all("force_gain:10", "force_gain:0.1", "force_gain:-1", "force_stuck", stream="random"),
    *_all("displacement_gain:-1", "displacement_stuck", stream="random"),
    Scenario("displacement_gain:10", stream="random", other_damper=_ANOTHER_MOTION),
    *_all("coil_factor:0", "force_loss:0.4", "tempo:0", "lost_blocks:0.05", stream="random"),
    # What nobody can know.
    Scenario("force_gain:0.5", unknowable=_ANOTHER_DAMPER, lasts=True),
    Scenario("force_gain:1.5", unknowable=_ANOTHER_DAMPER, lasts=True),
    Scenario("force_creep:60", unknowable=_ANOTHER_ZERO, lasts=True),
    Scenario("force_offset:300", unknowable=_ANOTHER_ZERO),
    Scenario("crosstalk:200", unknowable=_ANOTHER_ZERO),
    Scenario("force_delay:0.1", unknowable=_ANOTHER_LAG),
    Scenario("force_sluggish:0.1", unknowable=_ANOTHER_LAG),
)
"""All of them."""
