"""Why a predicted force should not be relied on: the kinds of doubt, and what each is judged by.

Every kind of evidence is a function or a small class that returns a :class:`Doubt`; the predictor
asks them all. The evidence of the measured force is in :mod:`mr_damper_ros.tracking.force_watch`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from mr_damper_ros.kinematics.motion_follower import MotionFollower
from mr_damper_ros.models.force_model import ForceStream
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array, Mask, span_of
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.zero_order_hold import ZeroOrderHold

Codes = NDArray[np.uint8]
"""A :class:`DoubtKind` for each sample."""

CURRENT_READING = 0.02
"""A supply's reading of a constant current moves by so much [A]."""


class DoubtKind(IntEnum):
    """Why a force is not valid; the numbers are those of PredictedForce."""

    NONE = 0
    """It is valid."""
    MISSING = 1
    """There are no parameters, or no current, to predict with."""
    NOT_FINITE = 2
    """The parameters give no finite force."""
    REPEATED = 3
    """The block came twice or too late."""
    SETTLING = 4
    """The motion, or what the law remembers of it, is not known well enough yet."""
    AT_REST = 5
    """The damper does not move: its force then depends on how it came to rest."""
    OUTDATED = 6
    """The samples, the current or the parameters are too old, or stamped in the future."""
    OUT_OF_RANGE = 7
    """Motion or current are outside of what the parameters were identified from."""
    TOO_LARGE = 8
    """The force is larger than this damper has been measured to give."""
    SENSOR = 9
    """The measured force cannot be that of a damper in this motion."""
    DRIVING = 10
    """The predicted force drives the motion, which no damper does."""
    WRONG = 11
    """The predicted force is far from the measured one."""
    REFUSED = 12
    """The identifier says that the samples or the parameters cannot be trusted."""

    @property
    def grave(self) -> bool:
        """Whether something is wrong with the rig or the parameters, rather than not yet known."""
        return self in _GRAVE


_GRAVE = frozenset(
    {
        *(DoubtKind.NOT_FINITE, DoubtKind.TOO_LARGE, DoubtKind.SENSOR),
        *(DoubtKind.DRIVING, DoubtKind.WRONG, DoubtKind.REFUSED),
    }
)


@dataclass(frozen=True)
class Doubt:
    """A reason not to rely on a force: its kind, and a sentence with figures for people.

    ``at``: mask (n,) of the samples that it holds for; None: all of them.
    """

    kind: DoubtKind = DoubtKind.NONE
    sentence: str = ""
    at: Mask | None = field(default=None, compare=False)

    def __bool__(self) -> bool:
        """Whether there is any doubt."""
        return self.kind is not DoubtKind.NONE

    def part(self, chosen: slice) -> Doubt:
        """That of the chosen samples."""
        if self.at is None:
            return self
        at = self.at[chosen]
        return replace(self, at=at) if at.any() else NO_DOUBT

    def after(self, count: int) -> Doubt:
        """The same where so many samples without doubt come before."""
        if self.at is None or count == 0:
            return self
        return replace(self, at=np.concatenate([np.zeros(count, dtype=bool), self.at]))


NO_DOUBT = Doubt()


def doubts_of_samples(count: int, doubts: Sequence[Doubt]) -> tuple[Codes, Doubt]:
    """The kind of doubt of each sample (n,), and the doubt of the newest that is not valid.

    Of several that hold for a sample the first one counts.
    """
    codes = np.zeros(count, dtype=np.uint8)
    if not doubts:
        return codes, NO_DOUBT
    for doubt in reversed(doubts):
        codes[... if doubt.at is None else doubt.at] = doubt.kind
    doubted = np.flatnonzero(codes)
    if not doubted.size:
        return codes, NO_DOUBT
    newest = doubted[-1]
    return codes, next(doubt for doubt in doubts if doubt.at is None or doubt.at[newest])


@dataclass(frozen=True)
class ValiditySettings(CheckedSettings):
    """When a predicted force is no longer valid."""

    max_age: float = option(
        0.5,
        "A force for samples older than this [s], by the clock of this computer, is marked "
        "invalid: the computer is overloaded, or the clocks differ. It counts where the "
        "stamps are within a minute of the clock, so not for a recording that is played. 0 for no "
        "limit, for example for the replay at another rate of what was recorded just now.",
        minimum=0.0,
        maximum=3600.0,
    )
    current_timeout: float = option(
        1.0,
        "A force whose supply current is older than this [s] is marked invalid, and one whose "
        "current is stamped so far ahead of the samples. Set it to a few periods of the current's "
        "topic.",
        minimum=0.0,
        maximum=3600.0,
    )
    parameters_timeout: float = option(
        600.0,
        "A force is also marked invalid once no window has confirmed the parameters for this long "
        "[s], by the data's stamps: the identifier has ended, or refuses what it gets. The thesis' "
        "damper loses a quarter of its force in ten minutes as it heats. 0 for no limit; "
        "parameters from parameter_file have none.",
        minimum=0.0,
        maximum=1e9,
    )
    velocity_margin: float = option(
        0.25,
        "How far the peak velocity may leave the range in which the parameters were identified "
        "before the force is marked invalid, relative: 0.25 is 25 %.",
        minimum=0.0,
        maximum=100.0,
    )
    current_margin: float = option(
        0.1,
        "Part of the width of the identified range by which the current may leave it before the "
        f"force is marked invalid; {CURRENT_READING} A are always allowed.",
        minimum=0.0,
        maximum=100.0,
    )
    force_margin: float = option(
        0.3,
        "Part by which the force may exceed the largest that the damper has been measured to give "
        "before it is marked invalid.",
        minimum=0.0,
        maximum=1e6,
    )
    maximum_error: float = option(
        0.2,
        "Error of the predicted force against the measured one, as a part of the latter's recent "
        "peak, beyond which the force is marked invalid: that of a sample, and the root mean "
        "square over a half-cycle. 0: the measured force is not looked at, for a rig that has no "
        "load cell.",
        minimum=0.0,
        maximum=100.0,
    )


def current_allowance(current_range: tuple[float, float], margin: float) -> float:
    """How far [A] the current may leave the identified range [A]: in proportion to its width.

    Of a set for a single current nothing is known of any other.
    """
    low, high = current_range
    return max(margin * (high - low), CURRENT_READING)


def doubt_of_current_range(
    current: Array, parameters: ParameterSet, margin: float, tried: float = -math.inf
) -> Doubt:
    """Whether the parameters hold for currents (n,) [A], or are tried out up to them."""
    low, high = parameters.current_range
    allowed = current_allowance(parameters.current_range, margin)
    lowest, highest = span_of(current)
    if low - allowed <= lowest and highest <= max(high, tried) + allowed:
        return NO_DOUBT
    return Doubt(
        DoubtKind.OUT_OF_RANGE,
        f"the current of {middle(current):.2f} A is outside of the identified "
        f"{low:.2f} to {high:.2f} A",
    )


def doubt_of_speed(speed: float, parameters: ParameterSet, margin: float) -> Doubt:
    """Whether the parameters hold for a peak velocity [m/s]."""
    low, high = parameters.peak_velocity_range
    if low * (1.0 - margin) <= speed <= high * (1.0 + margin):
        return NO_DOUBT
    return Doubt(
        DoubtKind.OUT_OF_RANGE,
        f"the peak velocity of {speed:.3g} m/s is outside of the identified "
        f"{low:.3g} to {high:.3g} m/s",
    )


def doubt_of_size(force: Array, parameters: ParameterSet, margin: float) -> Doubt:
    """Whether a force (n,) [N] is one that this damper has been measured to give."""
    largest = parameters.largest_force
    if math.isnan(largest):
        return NO_DOUBT
    lowest, highest = span_of(force)
    reached = max(highest, -lowest)
    if reached <= (1.0 + margin) * largest:
        return NO_DOUBT
    return Doubt(
        DoubtKind.TOO_LARGE,
        f"a force of {reached:.4g} N is predicted, and the damper has been measured to give "
        f"{largest:.4g} N at most: are the parameters those of this damper?",
        np.abs(force) > (1.0 + margin) * largest,
    )


def doubt_of_missing(
    parameters: ParameterSet | None, current: ZeroOrderHold, start_ns: int
) -> Doubt:
    """What the prediction for samples from a stamp on lacks."""
    if parameters is None:
        return Doubt(
            DoubtKind.MISSING,
            "no parameters yet: start the identifier or give parameter_file",
        )
    if current.known_from(start_ns):
        return NO_DOUBT
    last = current.last_stamp_ns
    if last is None:
        return Doubt(
            DoubtKind.MISSING,
            "no supply current yet: is it published on supply/current?",
        )
    ahead = (last - start_ns) / NANOSECONDS
    return Doubt(
        DoubtKind.MISSING,
        "no supply current yet that holds for these samples: the newest is stamped "
        f"{ahead:.3g} s after their begin; are both stamped by one clock?",
    )


def doubt_of_motion(motion: MotionFollower) -> Doubt:
    """Whether the damper moves, and its velocity is known."""
    if motion.unsettled:
        return Doubt(DoubtKind.SETTLING, motion.unsettled)
    if not motion.doubt and motion.resting:
        return Doubt(
            DoubtKind.AT_REST,
            "the damper is at rest: its force then depends on how it came to rest",
        )
    return NO_DOUBT


def doubt_of_past(motion: MotionFollower, stream: ForceStream, begun_at: int) -> Doubt:
    """Whether enough of the motion is known, and of what a model remembers of it.

    ``begun_at``: reversals of the motion when the stream began.
    """
    if motion.doubt:
        return Doubt(DoubtKind.SETTLING, motion.doubt)
    if stream.remembers and motion.reversals == begun_at:
        return Doubt(
            DoubtKind.SETTLING,
            "the model does not know its past before the motion has reversed",
        )
    return NO_DOUBT


def doubt_of_current_age(
    current: ZeroOrderHold, end_ns: int, timeout: float, *, live: bool
) -> Doubt:
    """Whether the current is known up to the stamp of the end of a block.

    The current of a recording may come far ahead of the samples; that of a running machine
    (``live``) cannot.
    """
    held, following = current.around(end_ns)
    age = (end_ns - held) / NANOSECONDS
    if age > timeout:
        return Doubt(
            DoubtKind.OUTDATED,
            f"the supply current is {age:.1f} s old: is it still published, with stamps on the "
            "clock of the samples?",
        )
    newest = current.last_stamp_ns or held
    ahead = (newest - end_ns) / NANOSECONDS
    jumped = following is not None and following - held > timeout * NANOSECONDS
    if jumped or (live and ahead > timeout):
        return Doubt(
            DoubtKind.OUTDATED,
            f"the supply current is stamped {ahead:.1f} s after the samples: are both stamped by "
            "one clock?",
        )
    return NO_DOUBT


def doubt_of_parameters_age(
    confirmed_ns: int | None, end_ns: int, settings: ValiditySettings, *, live: bool
) -> Doubt:
    """Whether a window has confirmed the parameters lately; None for parameters that do not age.

    A recording may be older than the parameters it is predicted with, a running machine not.
    """
    if confirmed_ns is None or settings.parameters_timeout == 0.0:
        return NO_DOUBT
    age = (end_ns - confirmed_ns) / NANOSECONDS
    if age > settings.parameters_timeout:
        return Doubt(
            DoubtKind.OUTDATED,
            f"no window has confirmed the parameters for {age:.0f} s: "
            "is the identifier running, and does the damper move?",
        )
    if live and -age > settings.current_timeout:
        return Doubt(
            DoubtKind.OUTDATED,
            f"the parameters are stamped {-age:.1f} s after the samples, so that their age is not "
            "known: was the clock set back?",
        )
    return NO_DOUBT


def middle(values: Array) -> float:
    """Upper median: of a few values in a tenth of the time that NumPy's median takes."""
    if values.size == 1:
        return float(values[0])
    half = values.size // 2
    return float(np.partition(values, half)[half])
