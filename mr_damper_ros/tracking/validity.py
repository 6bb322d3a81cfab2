"""The validity rules: the reason codes of an invalid force, and the objections that give them.

The predictor collects every :class:`Objection` to the force of a block; the first one that applies
to a sample gives its reason. Those that compare with the measured force come from
:mod:`mr_damper_ros.tracking.residual_monitor`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import CURRENT_READING, GOOD_NRMSE
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array, Mask, span_of
from mr_damper_ros.signals.blocks import NANOSECONDS, ZeroOrderHold
from mr_damper_ros.tracking.acceptance import Verdict

Codes = NDArray[np.uint8]
"""A :class:`DoubtKind` for each sample."""


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
    FROZEN = 13
    """The displacement has stopped within a sample."""
    INSTRUMENT = 14
    """The measured force changed by a factor or an offset within one sample."""

    @property
    def grave(self) -> bool:
        """Whether the code indicates a fault of the rig or the parameters, not missing data."""
        return self is DoubtKind.NOT_FINITE or self >= DoubtKind.TOO_LARGE


@dataclass(frozen=True)
class Doubt:
    """Why a force is invalid: the reason code, and a sentence with figures."""

    kind: DoubtKind = DoubtKind.NONE
    sentence: str = ""

    def __bool__(self) -> bool:
        """Whether the force is invalid."""
        return self.kind is not DoubtKind.NONE


NO_DOUBT = Doubt()


class Objection(NamedTuple):
    """A reason why the force of all samples is invalid, or of some: a mask (m,) of the last m."""

    kind: DoubtKind
    sentence: str
    where: Literal[True] | Mask = True


def judge_samples(count: int, objections: Sequence[Objection]) -> tuple[Codes, Doubt]:
    """The reason code of each sample (n,), and the doubt of the newest invalid sample.

    If several objections apply to a sample, the first one counts.
    """
    codes = np.zeros(count, dtype=np.uint8)
    newest, doubt = -1, NO_DOUBT
    for kind, sentence, where in objections:
        first = 0 if where is True else count - where.size
        places = first + np.flatnonzero((codes[first:] == DoubtKind.NONE) & where)
        codes[places] = kind
        if places.size and places[-1] > newest:
            newest, doubt = int(places[-1]), Doubt(kind, sentence)
    return codes, doubt


@dataclass(frozen=True)
class ErrorLimit:
    """Largest error of a right force: relative to the size of the force, and in newtons.

    With a ``relative`` limit of 0, no force is measured.
    """

    relative: float
    absolute: float = math.inf

    def at(self, size: float) -> float:
        """Largest error [N] of a force of this size [N]."""
        return min(self.relative * size, self.absolute)

    def part_of(self, size: float) -> float:
        """Largest error of a force of this size [N], relative to it."""
        return self.at(size) / size if size > 0.0 else self.relative


@dataclass(frozen=True)
class ValiditySettings(CheckedSettings):
    """Limits of the validity of a predicted force."""

    max_age: float = option(
        0.5,
        "Age of samples [s], by the clock of this computer, after which their force is "
        "invalid: the computer is overloaded, or the clocks differ. It is checked only if the "
        "stamps are within a minute of the clock, and not in simulated time, so not for a played "
        "recording. 0: no limit, for example to replay a very recent recording at another rate.",
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
        "limits the error of each sample; while the root mean square error over a half-cycle "
        "exceeds it, noise excuses no error. 0: the measured force is ignored, for a rig without a "
        "load cell.",
        within=(0.0, 100.0),
    )
    largest_error: float = option(
        0.0,
        "Largest error of a valid force [N], beside maximum_error: the smaller limit counts. Set "
        "maximum_error to 100 to have this limit alone. 0: no such limit.",
        within=(0.0, 1e9),
    )

    @property
    def error_limit(self) -> ErrorLimit:
        """Limit of the error of a valid force."""
        return ErrorLimit(self.maximum_error, self.largest_error or math.inf)


def current_allowance(current_range: tuple[float, float], margin: float) -> float:
    """Margin [A] of the current beyond the identified range [A], ``margin`` times its width.

    It is at least :data:`CURRENT_READING`, so that a set for a single current has a margin.
    """
    low, high = current_range
    return max(margin * (high - low), CURRENT_READING)


def lack_of_input(parameters: ParameterSet | None, current: ZeroOrderHold, start_ns: int) -> str:
    """Why there are no parameters or no current for samples from a stamp on, or an empty text."""
    last = current.last_stamp_ns
    if parameters is None:
        return "no parameters yet: start the identifier or give parameter_file"
    if current.known_from(start_ns):
        return ""
    if last is None:
        return "no supply current yet: is it published on supply/current?"
    return (
        "no supply current for these samples yet: the newest one is stamped "
        f"{(last - start_ns) / NANOSECONDS:.3g} s after the first sample; are currents and "
        "samples stamped by the same clock?"
    )


def objections_to_age(
    current: ZeroOrderHold,
    confirmed_ns: int | None,
    end_ns: int,
    settings: ValiditySettings,
    *,
    live: bool,
) -> Iterator[Objection]:
    """Whether current or parameters are outdated at the end of a block, or stamped after it.

    ``confirmed_ns`` is the stamp of the last window that confirmed the parameters; None for
    parameters that do not age. The current of a recording may arrive far ahead of the samples, and
    its samples may be older than the parameters; neither is possible on a running machine
    (``live``).
    """
    timeout, limit = settings.current_timeout, settings.parameters_timeout or math.inf
    held, following = current.around(end_ns)
    age = (end_ns - held) / NANOSECONDS
    ahead = ((current.last_stamp_ns or held) - end_ns) / NANOSECONDS
    if age > timeout:
        yield Objection(
            DoubtKind.OUTDATED,
            f"the supply current is {age:.1f} s old: is it still published, with stamps on the "
            "clock of the samples?",
        )
    jumped = following is not None and following - held > timeout * NANOSECONDS
    if jumped or (live and ahead > timeout):
        yield Objection(
            DoubtKind.OUTDATED,
            f"the supply current is stamped {ahead:.1f} s after the samples: are both stamped by "
            "the same clock?",
        )
    if confirmed_ns is None or limit == math.inf:
        return
    since = (end_ns - confirmed_ns) / NANOSECONDS
    if since > limit:
        yield Objection(
            DoubtKind.OUTDATED,
            f"no window has confirmed the parameters for {since:.0f} s: is the identifier "
            "running, and does the damper move?",
        )
    if live and -since > timeout:
        yield Objection(
            DoubtKind.OUTDATED,
            f"the parameters are stamped {-since:.1f} s after the samples, so their age is "
            "unknown: was the clock set back?",
        )


def objections_to_current(
    parameters: ParameterSet, margin: float, current: Array, tried: float = -math.inf
) -> Iterator[Objection]:
    """Whether currents (n,) [A] are outside the range of a set, widened by ``margin``.

    ``tried`` [A] is the highest current under trial; currents up to it are allowed.
    """
    low, high = parameters.current_range
    allowed = current_allowance(parameters.current_range, margin)
    lowest, highest = span_of(current)
    if not (low - allowed <= lowest and highest <= max(high, tried) + allowed):
        yield Objection(
            DoubtKind.OUT_OF_RANGE,
            f"the current of {middle(current):.2f} A is outside the identified range of "
            f"{low:.2f} to {high:.2f} A",
        )


def objections_to_motion(
    parameters: ParameterSet, settings: ValiditySettings, speed: float, force: Array
) -> Iterator[Objection]:
    """Whether force (n,) [N] or peak velocity [m/s] are larger than the set knows them."""
    slow, fast = parameters.peak_velocity_range
    margin, largest = settings.velocity_margin, parameters.largest_force
    size = np.abs(force)
    too_large = size > (1.0 + settings.force_margin) * largest  # False if it is unknown (NaN)
    if too_large.any():
        yield Objection(
            DoubtKind.TOO_LARGE,
            f"the predicted force reaches {size.max():.4g} N, but the largest measured force of "
            f"this damper is {largest:.4g} N: do the parameters belong to it?",
            too_large,
        )
    if not slow * (1.0 - margin) <= speed <= fast * (1.0 + margin):
        yield Objection(
            DoubtKind.OUT_OF_RANGE,
            f"the peak velocity of {speed:.3g} m/s is outside the identified range of {slow:.3g} "
            f"to {fast:.3g} m/s",
        )


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
    until it restarts, so that it also counts as live on an overloaded computer.

    ``max_age`` [s] is the limit; with 0 there is no limit and no stream counts as live. ``age`` [s]
    is the age of the last samples, NaN if they are not live. The clock must not be set: a leap is
    then one of the stamps.
    """

    def __init__(self, max_age: float) -> None:
        self.max_age = max_age
        self.restart()

    def restart(self) -> None:
        """Decide again whether the stream is live, because the stamps have jumped back."""
        self.live = False
        self.age = math.nan
        # Time by which the stamps have leapt since the stream became live.
        self._ahead_ns = 0

    def follow_leap(self, leap_ns: int, stamp_ns: int, now_ns: int | None) -> bool:
        """Whether the clock of the stamps leapt; then the age of the samples continues.

        ``leap_ns`` is the time by which the samples up to the stamp, or earlier ones, are stamped
        later than their count says. If it is positive, the source may have paused instead: then the
        samples are not too new.
        """
        if self.live and now_ns is not None:
            age_ns = now_ns - stamp_ns + self._ahead_ns
            too_old = abs(age_ns) > self.max_age * NANOSECONDS
            if too_old and abs(age_ns + leap_ns) < abs(age_ns):
                self._ahead_ns += leap_ns
                return True
        return leap_ns < 0

    def are_older(self, stamp_ns: int, now_ns: int | None, limit: float) -> bool:
        """Whether live samples up to the stamp are older than the limit [s]."""
        if not self.live or now_ns is None:
            return False
        return (now_ns - stamp_ns + self._ahead_ns) / NANOSECONDS > limit

    def judge(self, stamp_ns: int, now_ns: int | None) -> str:
        """Why samples up to the stamp are too old or in the future; empty if they are neither.

        ``now_ns`` is the time by the clock; None without a clock.
        """
        if now_ns is None or self.max_age == 0.0:
            return ""
        age = (now_ns - stamp_ns + self._ahead_ns) / NANOSECONDS
        self.live = self.live or abs(age) <= _LIVE
        if not self.live:
            return ""
        self.age = age
        if abs(age) <= self.max_age:
            return ""
        return (
            f"the samples are {age:.2f} s old, and max_age is {self.max_age:g} s: is the "
            "computer overloaded, or does its clock differ from the clock of the samples?"
            if age > 0.0
            else f"the samples are stamped {-age:.2f} s in the future: are the clocks of the "
            "computers synchronised? for a replay set max_age to 0"
        )


_DISTRUST = {
    Verdict.FAULT_OF_DATA: "the samples cannot be used",
    Verdict.POOR_FIT: "no parameters fit the samples",
    Verdict.DISTURBED: "the residual is far above the residual baseline",
    Verdict.UNCONFIRMED: "the force has changed too much at once",
    Verdict.BEYOND_LIMITS: "the force differs too much from the first accepted force",
}
"""Verdicts that count as rejections of a window, in words."""

_SAYS_NOTHING = (
    *(Verdict.UNKNOWN, Verdict.FAULT_OF_DATA, Verdict.FAILED, Verdict.TOO_LITTLE_MOTION),
)
"""Verdicts after which a change of the load cell is as before."""

_IN_A_ROW = 2
"""This many windows rejected in a row make the force invalid; a short fault spoils only one window.
"""


class RefusedWindows:
    """Counts the windows rejected in a row by the identifier; two make the force invalid.

    A rejection does not count if the set in use is good in the window.
    """

    def __init__(self) -> None:
        self._refused = 0
        self._cause = ""
        self.of_instrument = ""
        """How the load cell has changed, by the identifier; empty if it has not."""

    @property
    def sentence(self) -> str:
        """Why the newest windows make the force invalid; empty if they do not."""
        if self._refused < _IN_A_ROW:
            return ""
        return (
            f"the identifier has rejected {self._refused} windows in a row: {self._cause}; see its "
            "reports on damper/fit_report"
        )

    def follow(self, verdict: int, nrmse_before: float, reason: str, *, confirms: bool) -> None:
        """Process a report: its verdict and reason, and the NRMSE of the set in use.

        The NRMSE is NaN if it is unknown.
        """
        if verdict not in _SAYS_NOTHING:
            self.of_instrument = reason if verdict == Verdict.INSTRUMENT else ""
        if confirms or nrmse_before < GOOD_NRMSE:
            self.forget()
        elif verdict in _DISTRUST:
            self._refused += 1
            self._cause = _DISTRUST[Verdict(verdict)]

    def forget(self) -> None:
        """Restart the count, after new parameters or a confirmation."""
        self._refused = 0
