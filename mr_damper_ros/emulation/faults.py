"""Faults of an emulated rig: in the machine, in the instruments and in transmission.

Each kind of fault is a row of :data:`KINDS`, with its stage and the function that applies it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from mr_damper_ros.emulation.motions import ChangedMotion, Excitation
from mr_damper_ros.kinematics.periodic_motion import Kinematics
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock

CHANNELS = ("displacement", "force", "current", "temperature")
"""Names of the measured channels in :class:`RigBlock`."""

_ROUNDING = 1e-9
"""Tolerance [s], so that a fault affects the sample at which the fault begins."""

_CHANGE = 0.1
"""Time [s] in which the machine changes its motion, or a damper its force. Only an instrument
changes within one sample."""


class FaultError(ValueError):
    """An invalid fault; the message says what to change."""


Stage = Literal["motion", "coil", "force", "channel", "block", "delivery", "label"]
"""The stage at which a fault acts. Its function receives the fault and:

- motion: an :class:`Excitation`, the motion of the machine; returns another excitation;
- coil, force: :class:`Samples` of the current [A] in the coil, or of the force [N] between rod and
  load cell; returns other values (n,);
- channel: :class:`Samples` of one instrument; returns the values that it shows (n,);
- block: a :class:`RigBlock`, for faults of several channels; returns another block;
- delivery: a block to be sent; returns the list of blocks to send now;
- label: a block; returns it with the stamp, the period and the number to send.
"""


class Samples(NamedTuple):
    """``values`` (n,) at ``time`` (n,) [s] with sample ``period`` [s].

    ``motion``: the true motion, except for the stage "channel".
    """

    time: Array
    values: Array
    period: float
    motion: Kinematics = Kinematics(*np.empty((3, 0)))


@dataclass(frozen=True)
class Kind:
    """A row of the table of faults, which doc/faults.md describes.

    ``unit`` is the unit of the value: "channel" stands for the unit of the channel, and an empty
    string means that the fault has no value. ``usual`` is the default value and ``least`` the
    smallest valid value. If ``masked``, the result of ``act`` is used only while the fault is
    active; otherwise ``act`` is always used and handles the times itself. A masked fault sets in,
    and ends, within ``transition`` [s].
    """

    stage: Stage
    name: str
    act: Callable[[Fault, Any], Any]
    unit: str = ""
    usual: float = 1.0
    least: float = -math.inf
    masked: bool = True
    transition: float = 0.0


@dataclass(eq=False)
class Fault:
    """A fault that is active from ``begin`` to ``end`` [s] after the start of the rig.

    ``channel`` is the affected channel, if the kind acts on a channel. ``amount`` is in the unit of
    the kind. ``memory`` is the state of the fault's function; each rig uses its own copy of the
    fault.

    Raises FaultError if the amount is not finite or too small, the beginning is negative, or the
    end is not after the beginning.
    """

    kind: Kind
    channel: str
    amount: float
    begin: float = 0.0
    end: float = math.inf
    seed: int = 0

    def __post_init__(self) -> None:
        kind = self.kind
        if not (math.isfinite(self.amount) and self.amount >= kind.least):
            raise FaultError(
                f"the value of the fault '{kind.name}' is {self.amount}: it must be finite"
                + ("" if math.isinf(kind.least) else f" and at least {kind.least:g}")
            )
        if not 0.0 <= self.begin < self.end:
            raise FaultError(
                f"the fault '{kind.name}' is active from {self.begin:g} to {self.end:g} s: it must "
                "not begin before 0, and must end after its beginning"
            )
        self.rng = np.random.default_rng(self.seed)
        self.memory: Any = None

    def active(self, time: Array) -> np.ndarray:
        """Mask (n,): whether the fault is active at each time [s]."""
        return np.asarray((time >= self.begin - _ROUNDING) & (time < self.end - _ROUNDING))

    def share(self, time: Array) -> Array:
        """Part (n,) of the fault that has set in at each time [s], from 0 to 1."""
        lasts = self.kind.transition
        if lasts == 0.0:
            return self.active(time).astype(np.float64)
        # A fault without a beginning is present from the start.
        since = time - self.begin if self.begin > 0.0 else np.full(time.size, lasts)
        return np.minimum(since, self.end + lasts - time).clip(0.0, lasts) / lasts

    def active_in(self, block: RigBlock) -> bool:
        """Whether the fault is active at the first sample of a block.

        The block must still have the sequence number that the rig gave it.
        """
        return bool(self.active(np.array([block.sequence * block.period]))[0])


def moved(faults: Sequence[Fault], excitation: Excitation) -> Excitation:
    """The motion of the machine with these faults."""
    for fault in faults:
        if fault.kind.stage == "motion":
            excitation = fault.kind.act(fault, excitation)
    return excitation


def changed(faults: Sequence[Fault], stage: Stage, samples: Samples) -> Array:
    """The values (n,) of the samples after a stage."""
    for fault in faults:
        if fault.kind.stage == stage:
            values = fault.kind.act(fault, samples)
            if fault.kind.masked:
                share = fault.share(samples.time)
                # Not blended where the fault is whole or absent: its values may be NaN.
                mixed = samples.values + share * (values - samples.values)
                values = np.where(
                    share == 0.0, samples.values, np.where(share == 1.0, values, mixed)
                )
            samples = samples._replace(values=values)
    return samples.values


class Instruments:
    """Instruments of a rig and transmission of their samples, with faults.

    The faults act in the given order.
    """

    def __init__(self, faults: Sequence[Fault] = ()) -> None:
        self._faults = deepcopy(list(faults))

    def read(self, block: RigBlock) -> list[tuple[RigBlock, int]]:
        """The blocks that are sent after the rig has produced a block; there may be none.

        Each comes with the number that the rig gave to its first sample.
        """
        time = (block.sequence + np.arange(block.sample_count, dtype=np.float64)) * block.period
        for fault in self._faults:
            kind = fault.kind
            if kind.stage == "channel":
                samples = Samples(time, getattr(block, fault.channel), block.period)
                shown: dict[str, Any] = {fault.channel: changed([fault], kind.stage, samples)}
                block = replace(block, **shown)
            elif kind.stage == "block" and (fault.active_in(block) or not kind.masked):
                block = kind.act(fault, block)
        blocks = [block]
        for fault in self._faults:
            if fault.kind.stage == "delivery":
                blocks = [sent for made in blocks for sent in fault.kind.act(fault, made)]
        return [(self._labelled(made), made.sequence) for made in blocks]

    def _labelled(self, made: RigBlock) -> RigBlock:
        sent = made
        for fault in self._faults:
            if fault.kind.stage == "label" and fault.active_in(made):
                sent = fault.kind.act(fault, sent)
        return sent


def _end_stop(fault: Fault, samples: Samples) -> Array:
    u = samples.motion.displacement
    return samples.values + 1e6 * (u - np.clip(u, -fault.amount, fault.amount))


def _changed(fault: Fault, motion: Excitation, **changes: float) -> ChangedMotion:
    return ChangedMotion(motion, fault.begin, fault.end, _CHANGE, **changes)


def _backlash(fault: Fault, samples: Samples) -> Array:
    """After each reversal, the rod follows the machine only when the play is used up.

    ``fault.memory`` is the position of the rod [m].
    """
    result, half = samples.values.copy(), 0.5 * fault.amount
    for place in np.flatnonzero(fault.active(samples.time)):
        u = float(samples.motion.displacement[place])
        rod = u if fault.memory is None else min(max(fault.memory, u - half), u + half)
        if rod == fault.memory:
            result[place] = 0.0
        fault.memory = rod
    return result


def _stuck(fault: Fault, samples: Samples) -> Array:
    before = samples.values[samples.time < fault.begin - _ROUNDING]
    if before.size:
        fault.memory = float(before[-1])
    return np.full(samples.values.size, fault.memory or 0.0)


def _outages(fault: Fault, samples: Samples, instead: float) -> Array:
    """Random outages of 20 ms with the value ``instead``.

    ``fault.memory`` is the end of the last outage [s].
    """
    time, values, period, _ = samples
    begins = fault.active(time) & (fault.rng.random(time.size) < fault.amount * period)
    since = np.where(begins, time, -math.inf)
    last = -math.inf if fault.memory is None else fault.memory
    until = np.maximum.accumulate(np.maximum(since + 0.02, last))
    fault.memory = float(until[-1])
    return np.where(time < until, instead, values)


def _spikes(fault: Fault, samples: Samples) -> Array:
    """Five spikes per second on average, of either sign."""
    drawn = fault.rng.random((2, samples.time.size))
    hit = drawn[0] < 5.0 * samples.period
    return samples.values + np.where(hit, fault.amount * np.sign(drawn[1] - 0.5), 0.0)


def _delay(fault: Fault, samples: Samples) -> Array:
    past: Array = np.empty(0) if fault.memory is None else fault.memory
    count = round(fault.amount / samples.period)
    known = np.concatenate([past, samples.values])
    fault.memory = known[max(known.size - count, 0) :]
    return known[np.maximum(np.arange(samples.values.size) + past.size - count, 0)]


def _sluggish(fault: Fault, samples: Samples) -> Array:
    result = samples.values.copy()
    part = samples.period / (fault.amount + samples.period)
    for place in np.flatnonzero(fault.active(samples.time)):
        value = float(samples.values[place])
        before = value if fault.memory is None else fault.memory
        result[place] = fault.memory = before + part * (value - before)
    return result


def _repeated_buffer(fault: Fault, block: RigBlock) -> RigBlock:
    if not fault.active_in(block):
        fault.memory = block
    last: RigBlock | None = fault.memory
    if last is None or last.sample_count != block.sample_count:
        return block
    return replace(block, displacement=last.displacement, force=last.force)


def _chosen(fault: Fault, block: RigBlock) -> bool:
    """Decide at random whether this block has the fault."""
    return bool(fault.rng.random() < fault.amount) and fault.active_in(block)


def _reordered(fault: Fault, block: RigBlock) -> list[RigBlock]:
    if not fault.memory and _chosen(fault, block):
        fault.memory = [block]
        return []
    sent, fault.memory = [block, *(fault.memory or [])], []
    return sent


def _late(fault: Fault, block: RigBlock) -> list[RigBlock]:
    waiting: list[RigBlock] = [*(fault.memory or []), block]
    held = fault.active_in(block) and _since(fault, block) % 1.0 < fault.amount
    fault.memory = waiting if held else []
    return [] if held else waiting


def _since(fault: Fault, block: RigBlock) -> float:
    """Time [s] from the beginning of the fault to the block."""
    return block.sequence * block.period - fault.begin


def _ahead(block: RigBlock, seconds: float) -> RigBlock:
    """The block with its stamp shifted by ``seconds``."""
    shift = round(seconds * NANOSECONDS)
    return replace(block, start_ns=block.start_ns + shift, ahead_ns=block.ahead_ns + shift)


_motion, _coil, _force, _channel, _block, _delivery, _label = (
    partial(Kind, stage) for stage in get_args(Stage)
)
_damper_force, _damper_coil = (partial(kind, transition=_CHANGE) for kind in (_force, _coil))

# In the functions of the table, f is the fault, s the samples, b the block.
KINDS: tuple[Kind, ...] = (
    _damper_force("force_loss", lambda f, s: f.amount * s.values, "1", 0.5),
    _force(
        "wear",
        lambda f, s: np.interp(s.time, (f.begin, f.end), (1.0, f.amount)) * s.values,
        *("1", 0.7),
        masked=False,
    ),
    # The sign of the velocity, smoothed within 1 mm/s.
    _damper_force(
        "friction", lambda f, s: s.values + f.amount * np.tanh(s.motion[1] / 1e-3), "N", 200.0
    ),
    _damper_force("spring", lambda f, s: s.values + f.amount * s.motion[0], "N/m", 1e5),
    _force("end_stop", _end_stop, "m", 0.004, 0.0),
    _force("backlash", _backlash, "m", 0.5e-3, 0.0),
    _damper_coil("coil_factor", lambda f, s: f.amount * s.values, "1", 0.0),
    _damper_coil("coil_offset", lambda f, s: s.values + f.amount, "A", 0.1),
    _motion("amplitude", lambda f, motion: _changed(f, motion, factor=f.amount), "1", 0.1),
    _motion("tempo", lambda f, motion: _changed(f, motion, tempo=f.amount), "1", 0.0, 0.0),
    _channel("gain", lambda f, s: f.amount * s.values, "1", 10.0),
    _channel("offset", lambda f, s: s.values + f.amount, "channel"),
    _channel("creep", lambda f, s: s.values + f.amount * (s.time - f.begin), "channel/s"),
    _channel("stuck", _stuck),
    _channel("dropouts", lambda f, s: _outages(f, s, 0.0), "1/s", 2.0, 0.0, masked=False),
    _channel("nan", lambda f, s: _outages(f, s, math.nan), "1/s", 2.0, 0.0, masked=False),
    _channel("missing", lambda f, s: np.full(s.values.size, math.nan)),
    _channel("spikes", _spikes, "channel"),
    _channel(
        "noise",
        lambda f, s: s.values + f.amount * f.rng.standard_normal(s.time.size),
        "channel",
        least=0.0,
    ),
    _channel("hum", lambda f, s: s.values + f.amount * np.sin(100.0 * np.pi * s.time), "channel"),
    _channel("clip", lambda f, s: np.clip(s.values, -f.amount, f.amount), "channel", least=0.0),
    _channel(
        "coarse", lambda f, s: np.round(s.values / f.amount) * f.amount, "channel", least=1e-12
    ),
    _channel("delay", _delay, "s", 0.05, 0.0),
    _channel("sluggish", _sluggish, "s", 0.05, 0.0),
    _block(
        "swapped", lambda f, b: replace(b, displacement=1e-6 * b.force, force=b.displacement / 1e-6)
    ),
    _block(
        "crosstalk", lambda f, b: replace(b, force=b.force + f.amount * b.current), "N/A", 100.0
    ),
    _block("repeated_buffer", _repeated_buffer, masked=False),
    _delivery("lost_blocks", lambda f, b: [] if _chosen(f, b) else [b], "1", 0.05, 0.0),
    _delivery("doubled_blocks", lambda f, b: [b] * (1 + _chosen(f, b)), "1", 0.1, 0.0),
    _delivery("reordered_blocks", _reordered, "1", 0.1, 0.0),
    _delivery("late_blocks", _late, "s", 0.3, 0.0),
    _label(
        "stamp_jitter",
        lambda f, b: _ahead(b, f.amount * f.rng.uniform(-1.0, 1.0) * b.period),
        *("1", 0.3, 0.0),
    ),
    _label("clock_jump", lambda f, b: _ahead(b, f.amount), "s", 60.0),
    _label("clock_drift", lambda f, b: _ahead(b, f.amount * _since(f, b)), "s/s", 1e-4),
    _label("wrong_period", lambda f, b: replace(b, period=b.period * f.amount), "1", 2.0, 1e-6),
    _label("recount", lambda f, b: replace(b, sequence=b.sequence - round(f.begin / b.period))),
    _label(
        "supply_clock",
        lambda f, b: replace(b, supply_ahead_ns=round(f.amount * NANOSECONDS)),
        "s",
        2.0,
    ),
)
"""All kinds of fault. A new kind is a new row here, with a function if it has a memory."""

FAULTS: dict[str, tuple[Kind, str]] = {
    f"{channel}_{kind.name}" if channel else kind.name: (kind, channel)
    for kind in KINDS
    for channel in (CHANNELS if kind.stage == "channel" else ("",))
}
"""Kind and channel by the name of the fault, such as ``force_gain``."""

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
_TEXT = re.compile(
    rf"(?P<name>[a-z_]+)(?::(?P<value>{_NUMBER}))?"
    rf"(?:@(?P<begin>{_NUMBER})(?:-(?P<end>{_NUMBER}))?)?",
    re.IGNORECASE,
)


def fault_of(text: str, seed: int = 0) -> Fault:
    """Parse a fault from ``name[:value][@begin[-end]]``.

    The times are in seconds after the start of the rig. Without a value, the fault has its default
    value. Without times, it is always active; without an end, it never ends. Raises FaultError if
    the text or the fault is invalid.
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
    amount = kind.usual if match["value"] is None else float(match["value"])
    return Fault(kind, channel, amount, seed=seed, **times)


def faults_of(texts: Sequence[str], seed: int = 0) -> list[Fault]:
    """Parse several faults, each with its own seed; raises FaultError."""
    return [fault_of(text, seed=seed + place) for place, text in enumerate(texts)]
