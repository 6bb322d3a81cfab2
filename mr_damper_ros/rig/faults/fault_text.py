"""Faults by name, and as text: ``force_gain:10@20-30``."""

from __future__ import annotations

import re
from collections.abc import Sequence

from mr_damper_ros.rig.faults.fault import Fault, FaultError
from mr_damper_ros.rig.faults.machine_faults import (
    Amplitude,
    Backlash,
    CoilFactor,
    CoilOffset,
    EndStop,
    ForceLoss,
    Friction,
    Spring,
    Tempo,
    Wear,
)
from mr_damper_ros.rig.faults.sensor_faults import (
    Clip,
    Coarse,
    Creep,
    Crosstalk,
    Delay,
    Dropouts,
    Gain,
    Hum,
    Missing,
    Noise,
    NotNumbers,
    Offset,
    Sluggish,
    Spikes,
    Stuck,
    Swapped,
)
from mr_damper_ros.rig.faults.stream_faults import (
    ClockDrift,
    ClockJump,
    DoubledBlocks,
    LateBlocks,
    LostBlocks,
    RecountedBlocks,
    ReorderedBlocks,
    RepeatedBuffer,
    StampJitter,
    SupplyClock,
    WrongPeriod,
)

KINDS: tuple[type[Fault], ...] = (
    *(ForceLoss, Wear, Friction, Spring, EndStop, Backlash, CoilFactor, CoilOffset),
    *(Amplitude, Tempo),
    *(Gain, Offset, Creep, Stuck, Dropouts, NotNumbers, Missing, Spikes, Noise, Hum, Clip, Coarse),
    *(Delay, Sluggish, Swapped, Crosstalk),
    *(LostBlocks, DoubledBlocks, ReorderedBlocks, LateBlocks, RepeatedBuffer),
    *(StampJitter, ClockJump, ClockDrift, WrongPeriod, RecountedBlocks, SupplyClock),
)
"""Every kind of fault: a new one is a class and an entry here."""

FAULTS: dict[str, tuple[type[Fault], str]] = {
    f"{channel}_{kind.name}" if channel else kind.name: (kind, channel)
    for kind in KINDS
    for channel in kind.channels or ("",)
}
"""Kind and channel by the name in a text, such as ``force_gain``."""

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
_TEXT = re.compile(
    rf"(?P<name>[a-z_]+)(?::(?P<value>{_NUMBER}))?"
    rf"(?:@(?P<begin>{_NUMBER})(?:-(?P<end>{_NUMBER}))?)?",
    re.IGNORECASE,
)


def fault_of(text: str, seed: int = 0) -> Fault:
    """The fault of a text ``name[:value][@begin[-end]]``; times in seconds since the start.

    Without a value it has its usual one; without times it is there all the time, without an end
    for ever. Raises FaultError, with one sentence.
    """
    match = _TEXT.fullmatch(text.strip())
    if match is None:
        raise FaultError(
            f"the fault '{text}' cannot be read: give name[:value][@begin[-end]], such as "
            "force_gain:10@20-30"
        )
    name = match["name"].lower()
    if name not in FAULTS:
        raise FaultError(f"the fault '{name}' is unknown: the faults are {', '.join(FAULTS)}")
    kind, channel = FAULTS[name]
    if match["value"] is not None and not kind.unit:
        raise FaultError(f"the fault '{name}' takes no value: remove ':{match['value']}'")
    times = {key: float(match[key]) for key in ("begin", "end") if match[key] is not None}
    value = None if match["value"] is None else float(match["value"])
    return kind(value, channel=channel, seed=seed, **times)


def faults_of(texts: Sequence[str], seed: int = 0) -> list[Fault]:
    """The faults of several texts, each with a seed of its own; raises FaultError."""
    return [fault_of(text, seed=seed + place) for place, text in enumerate(texts)]
