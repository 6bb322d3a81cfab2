"""The validity rules: the reason codes of a force that is not valid, and what each is judged by.

Every rule is a function or a small class that returns a :class:`Doubt`; the predictor asks them
all. What the measured force says is in :mod:`mr_damper_ros.tracking.residual_monitor`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from mr_damper_ros.kinematics.motion_follower import MotionFollower
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array, Mask, span_of
from mr_damper_ros.signals.blocks import NANOSECONDS, ZeroOrderHold
from mr_damper_ros.tracking.acceptance import Verdict

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
        "Age of samples [s], by the clock of this computer, after which their force is "
        "invalid: the computer is overloaded, or the clocks differ. It is checked only if the "
        "stamps are within a minute of the clock, so not for a played recording. 0: no limit, "
        "for example to replay a very recent recording at another rate.",
        minimum=0.0,
        maximum=3600.0,
    )
    current_timeout: float = option(
        1.0,
        "Age of the supply current [s] after which the force is invalid; also the largest "
        "time by which its stamp may be ahead of the samples. Set it to a few periods of the "
        "current's topic.",
        minimum=0.0,
        maximum=3600.0,
    )
    parameters_timeout: float = option(
        600.0,
        "Time [s] without a confirming window, by the stamps of the data, after which the "
        "force is invalid: the identifier has ended, or rejects its input. The thesis' damper "
        "loses a quarter of its force in ten minutes as it heats up. 0: no limit; parameters "
        "from parameter_file have none.",
        minimum=0.0,
        maximum=1e9,
    )
    velocity_margin: float = option(
        0.25,
        "Relative margin of the peak velocity beyond the identified range, outside which the "
        "force is invalid: 0.25 is 25 %.",
        minimum=0.0,
        maximum=100.0,
    )
    current_margin: float = option(
        0.1,
        "Margin of the current beyond the identified range, as a fraction of its width, "
        f"outside which the force is invalid; {CURRENT_READING} A are always allowed.",
        minimum=0.0,
        maximum=100.0,
    )
    force_margin: float = option(
        0.3,
        "Relative margin beyond the largest measured force of this damper, above which the "
        "force is invalid.",
        minimum=0.0,
        maximum=1e6,
    )
    maximum_error: float = option(
        0.2,
        "Error of the predicted force relative to the recent peak of the measured force, "
        "above which the force is invalid: of a sample, and the root mean square over a "
        "half-cycle. 0: the measured force is ignored, for a rig without a load cell.",
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
        f"the current of {middle(current):.2f} A is outside the identified range of {low:.2f} to "
        f"{high:.2f} A",
    )


def doubt_of_speed(speed: float, parameters: ParameterSet, margin: float) -> Doubt:
    """Whether the parameters hold for a peak velocity [m/s]."""
    low, high = parameters.peak_velocity_range
    if low * (1.0 - margin) <= speed <= high * (1.0 + margin):
        return NO_DOUBT
    return Doubt(
        DoubtKind.OUT_OF_RANGE,
        f"the peak velocity of {speed:.3g} m/s is outside the identified range of {low:.3g} to "
        f"{high:.3g} m/s",
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
        f"the predicted force reaches {reached:.4g} N, but the largest measured force of this "
        f"damper is {largest:.4g} N: do the parameters belong to it?",
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
        f"no supply current for these samples yet: the newest is stamped {ahead:.3g} s after "
        "their start; are both stamped by one clock?",
    )


def doubt_of_motion(motion: MotionFollower) -> Doubt:
    """Whether the damper moves, and its velocity is known."""
    if motion.unsettled:
        return Doubt(DoubtKind.SETTLING, motion.unsettled)
    if not motion.doubt and motion.resting:
        return Doubt(
            DoubtKind.AT_REST,
            "the damper is at rest: its force depends on how it came to rest",
        )
    return NO_DOUBT


def doubt_of_past(motion: MotionFollower, *, begun: bool) -> Doubt:
    """Whether enough of the motion is known, and of what a law remembers of it.

    ``begun``: the law remembers, and the motion has not reversed since it began to follow it.
    """
    if motion.doubt:
        return Doubt(DoubtKind.SETTLING, motion.doubt)
    if begun:
        return Doubt(
            DoubtKind.SETTLING,
            "the state of the model is unknown until the motion has reversed",
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


_LIVE = 60.0
"""Stamps within so many seconds of the clock are those of a running machine."""


class Freshness:
    """Follows the age of the samples of a stream, where they come from a running machine.

    The stamps of a recording that is played tell when it was recorded, and nothing of how late the
    samples come. So a stream counts as live once its stamps have been within a minute of the clock,
    and stays so until they jump back: an overloaded computer does not turn it into a recording.

    ``max_age`` [s] is the limit; 0: none, nothing is taken for live. ``age`` [s] is that of the
    last samples, NaN where they are not live.
    """

    def __init__(self, max_age: float) -> None:
        self._max_age = max_age
        self.live = False
        self.age = math.nan

    def restart(self) -> None:
        """The stamps have jumped back: whether they are live shows again."""
        self.live = False
        self.age = math.nan

    def are_older(self, stamp_ns: int, now_ns: int, limit: float) -> bool:
        """Whether live samples up to the stamp are older than the limit [s]."""
        return self.live and (now_ns - stamp_ns) / NANOSECONDS > limit

    def judge(self, stamp_ns: int, now_ns: int | None) -> Doubt:
        """Whether samples up to the stamp are too old by the clock; None: there is no clock."""
        if now_ns is None or self._max_age == 0.0:
            return NO_DOUBT
        age = (now_ns - stamp_ns) / NANOSECONDS
        self.live = self.live or abs(age) <= _LIVE
        if not self.live:
            return NO_DOUBT
        self.age = age
        if abs(age) <= self._max_age:
            return NO_DOUBT
        if age > 0.0:
            sentence = (
                f"the samples are {age:.2f} s old, and max_age is {self._max_age:g} s: is the "
                "computer overloaded, or its clock not that of the samples?"
            )
        else:
            sentence = (
                f"the samples are stamped {-age:.2f} s in the future: are the clocks of the "
                "computers set alike? for a replay set max_age to 0"
            )
        return Doubt(DoubtKind.OUTDATED, sentence)


_DISTRUST = {
    Verdict.FAULT_OF_DATA: "the samples cannot be used",
    Verdict.POOR_FIT: "no parameters fit the samples",
    Verdict.DISTURBED: "the residual is far above the residual baseline",
    Verdict.UNCONFIRMED: "the force has changed too much at once",
    Verdict.BEYOND_LIMITS: "the force differs too much from the first one",
}
"""Verdicts that speak against the samples or the parameters, in words."""

_IN_A_ROW = 2
"""One window may be spoilt by a passing fault: the force is doubted from the second on."""

_FITS = 0.3
"""Where the running parameters leave less than this NRMSE of a window they are trusted."""


class RefusedWindows:
    """Follows the identifier's verdicts on windows: several refused in a row raise a doubt."""

    def __init__(self) -> None:
        self._refused = 0
        self._doubt = NO_DOUBT

    @property
    def doubt(self) -> Doubt:
        """Why the newest windows speak against the force."""
        return self._doubt if self._refused >= _IN_A_ROW else NO_DOUBT

    def follow(self, verdict: int, nrmse_before: float, *, confirms: bool) -> None:
        """Follow a report: its verdict, and the NRMSE of the parameters in use (NaN: unknown)."""
        if confirms or nrmse_before < _FITS:
            self.forget()
        elif verdict in _DISTRUST:
            self._refused += 1
            self._doubt = Doubt(
                DoubtKind.REFUSED,
                f"the identifier has refused {self._refused} windows in a row: "
                f"{_DISTRUST[Verdict(verdict)]}; its reports on damper/fit_report say more",
            )

    def forget(self) -> None:
        """The parameters are others now, or have been confirmed."""
        self._refused = 0
