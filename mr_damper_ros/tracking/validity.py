"""The validity rules: the reason codes of an invalid force, and the test for each of them.

Every rule is a function or a small class that returns a :class:`Doubt`. The predictor applies all
rules. The comparison with the measured force is in :mod:`mr_damper_ros.tracking.residual_monitor`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from mr_damper_ros.kinematics.motion_follower import MotionFollower
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array, Mask, span_of
from mr_damper_ros.signals.blocks import NANOSECONDS, ZeroOrderHold
from mr_damper_ros.tracking.acceptance import GOOD_NRMSE, Verdict

Codes = NDArray[np.uint8]
"""A :class:`DoubtKind` for each sample."""

CURRENT_READING = 0.02
"""Variation [A] of a supply's reading while its current is constant."""


class DoubtKind(IntEnum):
    """Reason code of an invalid force; the numbers are constants of the message PredictedForce."""

    NONE = 0
    """The force is valid."""
    MISSING = 1
    """There are no parameters, or no current for this sample."""
    NOT_FINITE = 2
    """The force is NaN or infinite."""
    REPEATED = 3
    """The block was repeated or arrived too late."""
    SETTLING = 4
    """The motion, or the state of a law with memory, has not settled yet."""
    AT_REST = 5
    """The damper is at rest; its force depends on how it came to rest."""
    OUTDATED = 6
    """The samples, the current or the parameters are too old, or stamped in the future."""
    OUT_OF_RANGE = 7
    """Peak velocity or current is outside the identified range."""
    TOO_LARGE = 8
    """The force exceeds the largest force measured on this damper."""
    SENSOR = 9
    """No damper gives the measured force in this motion."""
    DRIVING = 10
    """The predicted force is not dissipative."""
    WRONG = 11
    """The predicted force differs too much from the measured force."""
    REFUSED = 12
    """The identifier has rejected the newest windows."""

    @property
    def grave(self) -> bool:
        """Whether the code indicates a fault of the rig or the parameters, not missing data."""
        kinds = DoubtKind
        return self in (kinds.NOT_FINITE, kinds.TOO_LARGE, kinds.SENSOR) or (
            self in (kinds.DRIVING, kinds.WRONG, kinds.REFUSED)
        )


@dataclass(frozen=True)
class Doubt:
    """Why a force is invalid: the reason code, and a sentence with figures.

    ``at`` is a mask (n,) of the samples concerned; None means all samples.
    """

    kind: DoubtKind = DoubtKind.NONE
    sentence: str = ""
    at: Mask | None = field(default=None, compare=False)

    def __bool__(self) -> bool:
        """Whether the force is invalid."""
        return self.kind is not DoubtKind.NONE

    def after(self, count: int) -> Doubt:
        """Return the doubt with its mask preceded by ``count`` unaffected samples."""
        if self.at is None or count == 0:
            return self
        return replace(self, at=np.concatenate([np.zeros(count, dtype=bool), self.at]))


NO_DOUBT = Doubt()


def doubts_of_samples(count: int, doubts: Sequence[Doubt]) -> tuple[Codes, Doubt]:
    """The reason code of each sample (n,), and the doubt of the newest invalid sample.

    If several doubts apply to a sample, the first one counts.
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
    """Limits of the validity of a predicted force."""

    max_age: float = option(
        0.5,
        "Age of samples [s], by the clock of this computer, after which their force is "
        "invalid: the computer is overloaded, or the clocks differ. It is checked only if the "
        "stamps are within a minute of the clock, so not for a played recording. 0: no limit, "
        "for example to replay a very recent recording at another rate.",
        within=(0.0, 3600.0),
    )
    current_timeout: float = option(
        1.0,
        "Age of the supply current [s] after which the force is invalid; also the longest time "
        "by which the stamp of a current may be ahead of the samples. Set it to a few periods of "
        "the topic of the current.",
        within=(0.0, 3600.0),
    )
    parameters_timeout: float = option(
        600.0,
        "Time [s] without a confirming window, by the stamps of the data, after which the "
        "force is invalid, because the identifier has ended or rejects its input. The damper of "
        "the thesis loses a quarter of its force in ten minutes as it heats up. 0: no limit. "
        "Parameters from parameter_file have no limit.",
        within=(0.0, 1e9),
    )
    velocity_margin: float = option(
        0.25,
        "Margin by which the peak velocity may leave the identified range before the force is "
        "invalid, relative to the end of the range: 0.25 is 25 %.",
        within=(0.0, 100.0),
    )
    current_margin: float = option(
        0.1,
        "Margin by which the current may leave the identified range before the force is invalid, "
        f"as a fraction of the width of the range; {CURRENT_READING} A are always allowed.",
        within=(0.0, 100.0),
    )
    force_margin: float = option(
        0.3,
        "Margin by which the force may exceed the largest measured force of this damper before "
        "it is invalid, relative to that force.",
        within=(0.0, 1e6),
    )
    maximum_error: float = option(
        0.2,
        "Largest error of a valid force, relative to the recent peak of the measured force. It "
        "limits the error of each sample and the root mean square error over a half-cycle. 0: the "
        "measured force is ignored, for a rig without a load cell.",
        within=(0.0, 100.0),
    )


def current_allowance(current_range: tuple[float, float], margin: float) -> float:
    """Margin [A] of the current beyond the identified range [A], ``margin`` times its width.

    It is at least :data:`CURRENT_READING`, so that a set for a single current has a margin.
    """
    low, high = current_range
    return max(margin * (high - low), CURRENT_READING)


def doubt_of_missing(
    parameters: ParameterSet | None, current: ZeroOrderHold, start_ns: int
) -> Doubt:
    """Whether parameters or current are missing for samples from a stamp on."""
    last = current.last_stamp_ns
    if parameters is None:
        sentence = "no parameters yet: start the identifier or give parameter_file"
    elif current.known_from(start_ns):
        return NO_DOUBT
    elif last is None:
        sentence = "no supply current yet: is it published on supply/current?"
    else:
        sentence = (
            "no supply current for these samples yet: the newest one is stamped "
            f"{(last - start_ns) / NANOSECONDS:.3g} s after the first sample; are currents and "
            "samples stamped by the same clock?"
        )
    return Doubt(DoubtKind.MISSING, sentence)


def doubt_of_motion(motion: MotionFollower) -> Doubt:
    """Whether the damper is at rest, or its velocity has not settled."""
    if motion.unsettled:
        return Doubt(DoubtKind.SETTLING, motion.unsettled)
    if not motion.doubt and motion.resting:
        return Doubt(
            DoubtKind.AT_REST,
            "the damper is at rest: its force depends on how it came to rest",
        )
    return NO_DOUBT


def doubt_of_past(motion: MotionFollower, *, begun: bool) -> Doubt:
    """Whether the past of the motion, or the state of the law, is still unknown.

    ``begun``: the law has memory, and the motion has not reversed since its state was set.
    """
    state = "the state of the model is unknown until the motion has reversed" if begun else ""
    sentence = motion.doubt or state
    return Doubt(DoubtKind.SETTLING, sentence) if sentence else NO_DOUBT


def doubts_of_age(
    current: ZeroOrderHold,
    confirmed_ns: int | None,
    end_ns: int,
    settings: ValiditySettings,
    *,
    live: bool,
) -> Iterator[Doubt]:
    """Whether current or parameters are outdated at the end of a block, or stamped after it.

    ``confirmed_ns`` is the stamp of the last window that confirmed the parameters; None for
    parameters that do not age. The current of a recording may arrive far ahead of the samples, and
    its samples may be older than the parameters; neither is possible on a running machine
    (``live``).
    """
    timeout = settings.current_timeout
    held, following = current.around(end_ns)
    age = (end_ns - held) / NANOSECONDS
    ahead = ((current.last_stamp_ns or held) - end_ns) / NANOSECONDS
    jumped = following is not None and following - held > timeout * NANOSECONDS
    if age > timeout:
        yield Doubt(
            DoubtKind.OUTDATED,
            f"the supply current is {age:.1f} s old: is it still published, with stamps on the "
            "clock of the samples?",
        )
    elif jumped or (live and ahead > timeout):
        yield Doubt(
            DoubtKind.OUTDATED,
            f"the supply current is stamped {ahead:.1f} s after the samples: are both stamped by "
            "the same clock?",
        )
    if confirmed_ns is None or settings.parameters_timeout == 0.0:
        return
    age = (end_ns - confirmed_ns) / NANOSECONDS
    if age > settings.parameters_timeout:
        yield Doubt(
            DoubtKind.OUTDATED,
            f"no window has confirmed the parameters for {age:.0f} s: "
            "is the identifier running, and does the damper move?",
        )
    elif live and -age > timeout:
        yield Doubt(
            DoubtKind.OUTDATED,
            f"the parameters are stamped {-age:.1f} s after the samples, so their age is unknown: "
            "was the clock set back?",
        )


def doubts_of_range(
    parameters: ParameterSet,
    settings: ValiditySettings,
    current: Array,
    speed: float,
    force: Array,
    *,
    tried: float = -math.inf,
) -> tuple[Doubt, Doubt, Doubt]:
    """Whether currents [A], force [N] or peak velocity [m/s] are outside the range of a set.

    ``current`` and ``force`` have shape (n,). ``tried`` [A] is the highest current under trial;
    currents up to it are allowed. The largest force was measured on this damper.
    """
    of_current = of_force = of_speed = NO_DOUBT
    low, high = parameters.current_range
    allowed = current_allowance(parameters.current_range, settings.current_margin)
    lowest, highest = span_of(current)
    if not (low - allowed <= lowest and highest <= max(high, tried) + allowed):
        of_current = Doubt(
            DoubtKind.OUT_OF_RANGE,
            f"the current of {middle(current):.2f} A is outside the identified range of {low:.2f} "
            f"to {high:.2f} A",
        )
    lowest, highest = span_of(force)
    limit = (1.0 + settings.force_margin) * parameters.largest_force
    if max(highest, -lowest) > limit:  # False if the largest force is unknown (NaN)
        of_force = Doubt(
            DoubtKind.TOO_LARGE,
            f"the predicted force reaches {max(highest, -lowest):.4g} N, but the largest measured "
            f"force of this damper is {parameters.largest_force:.4g} N: do the parameters belong "
            "to it?",
            np.abs(force) > limit,
        )
    low, high = parameters.peak_velocity_range
    margin = settings.velocity_margin
    if not low * (1.0 - margin) <= speed <= high * (1.0 + margin):
        of_speed = Doubt(
            DoubtKind.OUT_OF_RANGE,
            f"the peak velocity of {speed:.3g} m/s is outside the identified range of {low:.3g} "
            f"to {high:.3g} m/s",
        )
    return of_current, of_force, of_speed


def middle(values: Array) -> float:
    """Upper median; for a few values it takes a tenth of the time of NumPy's median."""
    if values.size == 1:
        return float(values[0])
    half = values.size // 2
    return float(np.partition(values, half)[half])


_LIVE = 60.0
"""If stamps are within this many seconds of the clock, the samples come from a running machine."""


class Freshness:
    """Monitors the age of the samples of a stream from a running machine.

    A played recording has the stamps of the original measurement, which give no age. A stream
    therefore counts as live once its stamps have been within a minute of the clock. It stays live
    until the stamps jump back, so that it also counts as live on an overloaded computer.

    ``max_age`` [s] is the limit; with 0 there is no limit and no stream counts as live. ``age`` [s]
    is the age of the last samples, NaN if they are not live.
    """

    def __init__(self, max_age: float) -> None:
        self._max_age = max_age
        self.live = False
        self.age = math.nan

    def restart(self) -> None:
        """Decide again whether the stream is live, because the stamps have jumped back."""
        self.live = False
        self.age = math.nan

    def are_older(self, stamp_ns: int, now_ns: int, limit: float) -> bool:
        """Whether live samples up to the stamp are older than the limit [s]."""
        return self.live and (now_ns - stamp_ns) / NANOSECONDS > limit

    def judge(self, stamp_ns: int, now_ns: int | None) -> Doubt:
        """Whether samples up to the stamp are too old, or in the future, by the clock.

        ``now_ns`` is the time by the clock; None without a clock.
        """
        if now_ns is None or self._max_age == 0.0:
            return NO_DOUBT
        age = (now_ns - stamp_ns) / NANOSECONDS
        self.live = self.live or abs(age) <= _LIVE
        if not self.live:
            return NO_DOUBT
        self.age = age
        if abs(age) <= self._max_age:
            return NO_DOUBT
        return Doubt(
            DoubtKind.OUTDATED,
            f"the samples are {age:.2f} s old, and max_age is {self._max_age:g} s: is the "
            "computer overloaded, or does its clock differ from the clock of the samples?"
            if age > 0.0
            else f"the samples are stamped {-age:.2f} s in the future: are the clocks of the "
            "computers synchronised? for a replay set max_age to 0",
        )


_DISTRUST = {
    Verdict.FAULT_OF_DATA: "the samples cannot be used",
    Verdict.POOR_FIT: "no parameters fit the samples",
    Verdict.DISTURBED: "the residual is far above the residual baseline",
    Verdict.UNCONFIRMED: "the force has changed too much at once",
    Verdict.BEYOND_LIMITS: "the force differs too much from the first accepted force",
}
"""Verdicts that count as rejections of a window, in words."""

_IN_A_ROW = 2
"""This many windows rejected in a row make the force invalid; a short fault spoils only one window.
"""


class RefusedWindows:
    """Counts the windows rejected in a row by the identifier; two make the force invalid.

    A rejection does not count if the set in use is good in the window.
    """

    def __init__(self) -> None:
        self._refused = 0
        self._doubt = NO_DOUBT

    @property
    def doubt(self) -> Doubt:
        """Why the newest windows make the force invalid."""
        return self._doubt if self._refused >= _IN_A_ROW else NO_DOUBT

    def follow(self, verdict: int, nrmse_before: float, *, confirms: bool) -> None:
        """Process a report: its verdict, and the NRMSE of the set in use (NaN if unknown)."""
        if confirms or nrmse_before < GOOD_NRMSE:
            self.forget()
        elif verdict in _DISTRUST:
            self._refused += 1
            self._doubt = Doubt(
                DoubtKind.REFUSED,
                f"the identifier has rejected {self._refused} windows in a row: "
                f"{_DISTRUST[Verdict(verdict)]}; see its reports on damper/fit_report",
            )

    def forget(self) -> None:
        """Restart the count, after new parameters or a confirmation."""
        self._refused = 0
