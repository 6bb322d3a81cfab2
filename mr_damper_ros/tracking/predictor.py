"""Predicts the damper's force from a stream of displacement and current, from the past alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_follower import MotionFollower
from mr_damper_ros.models.force_stream import ForceStream
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, BlockSequence, SampleBlock
from mr_damper_ros.signals.zero_order_hold import KEEP_CURRENT, ZeroOrderHold


@dataclass(frozen=True)
class PredictorSettings(CheckedSettings):
    """How the prediction follows the stream, and when it is no longer valid."""

    bandwidth: float = option(
        0.0,
        "Bandwidth [Hz] of the observer of velocity and acceleration: wider follows faster "
        "motion, narrower passes less noise. 0: it follows the motion and the noise by itself.",
        minimum=0.0,
        maximum=10_000.0,
    )
    centre_memory: float = option(
        10.0,
        "Time [s] over which the centre of the motion is taken; a whole cycle must fit in.",
        minimum=0.01,
        maximum=3600.0,
    )
    current_timeout: float = option(
        1.0,
        "Age [s] of the supply current beyond which the force is marked invalid.",
        minimum=0.0,
        maximum=3600.0,
    )
    parameters_timeout: float = option(
        600.0,
        "Time [s] for which no window has confirmed the parameters, beyond which the force is "
        "marked invalid: a damper that heats may change by a quarter in ten minutes. 0: no limit. "
        "Those of parameter_file have none either.",
        minimum=0.0,
        maximum=1e9,
    )
    velocity_margin: float = option(
        0.25,
        "Part by which the peak velocity may leave the identified range before the force is "
        "marked invalid (0.25 = 25 %).",
        minimum=0.0,
        maximum=100.0,
    )
    current_margin: float = option(
        0.1,
        "How far [A] the current may leave the identified range before the force is marked "
        "invalid.",
        minimum=0.0,
        maximum=100.0,
    )


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted force [N], shape (n,), of the block's samples; ``reason`` tells why not valid."""

    start_ns: int
    sequence: int
    period: float
    force: Array
    set_id: str
    valid: bool
    reason: str
    continuity: str


@dataclass(frozen=True, eq=False)
class _Reckoned:
    """Force [N] of a motion at a current, whether it is finite, and why to doubt it."""

    force: Array
    finite: bool
    doubt: str


@dataclass(frozen=True, eq=False)
class _Foreseen:
    """What was reckoned for the next block if the sine goes on and the current [A] stays."""

    current: float
    reckoned: _Reckoned


class ForcePredictor:
    """Predicts the force of each block as it arrives."""

    def __init__(self, settings: PredictorSettings) -> None:
        self._settings = settings
        self._parameters: ParameterSet | None = None
        self._confirmed_ns: int | None = None
        self._current = ZeroOrderHold(keep=KEEP_CURRENT)
        self._sequence = BlockSequence()
        self._motion: MotionFollower | None = None
        self._stream: ForceStream | None = None
        self._foreseen: _Foreseen | None = None
        # Reversals of the motion when the model began to follow it.
        self._begun_at = 0

    @property
    def sequence(self) -> BlockSequence:
        """How the blocks have followed each other so far."""
        return self._sequence

    @property
    def parameters(self) -> ParameterSet | None:
        """The set in use; None before the first."""
        return self._parameters

    def set_parameters(self, parameters: ParameterSet, confirmed_ns: int | None = None) -> None:
        """Predict with this set from the next block on.

        ``confirmed_ns`` is the stamp of the last sample that it is known to fit; None for a set
        that does not age, such as one that a user gave. What the model remembers of the motion
        is found anew with this set; one of another model begins without.
        """
        if self._stream is not None and self._stream.model.name != parameters.model:
            self._stream = None
        if self._stream is not None:
            self._stream.retrace(parameters.values)
        self._foreseen = None
        self._parameters = parameters
        self._confirmed_ns = confirmed_ns

    def confirm(self, set_id: str, stamp_ns: int) -> None:
        """Take note that the set of this name fits the samples up to the stamp."""
        if self._parameters is not None and self._parameters.set_id == set_id:
            self._confirmed_ns = stamp_ns

    def add_current(self, stamp_ns: int, current: float) -> None:
        """Add a value of the supply current [A]; raises CurrentError for one that is not finite."""
        self._current.add(stamp_ns, current)

    def catch_up(self) -> None:
        """Learn from the last block what only the predictions after it need.

        It takes longer than a prediction, so call it once that is on its way. Without it the next
        :meth:`predict` does what it must itself, with the same results.
        """
        if self._motion is not None:
            self._motion.catch_up()
            self._foreseen = self._foresee(self._motion.foreseen)

    def _foresee(self, motion: Motion | None) -> _Foreseen | None:
        """Force of the next block, as far as it can be known already."""
        last, parameters, stream = self._sequence.last, self._parameters, self._stream
        if motion is None or last is None or parameters is None:
            return None
        if stream is None or stream.remembers or not self._current.known_from(last.end_ns):
            return None
        current = self._current.constant(last.end_ns, last.period, last.sample_count)
        if current is None:
            return None
        amperes = np.full(last.sample_count, current)
        return _Foreseen(current, self._reckon(motion, True, amperes, parameters, stream))

    def _came(self, foreseen: _Foreseen, block: SampleBlock) -> bool:
        """Whether a block came as foreseen."""
        if self._motion is None or not self._motion.steady:
            return False
        if foreseen.reckoned.force.size != block.sample_count:
            return False
        current = self._current.constant(block.start_ns, block.period, block.sample_count)
        return current == foreseen.current

    def _reckon(
        self,
        motion: Motion,
        steady: bool,
        current: Array,
        parameters: ParameterSet,
        stream: ForceStream,
    ) -> _Reckoned:
        held = motion.held_within(*parameters.peak_velocity_range)
        force = stream.follow(parameters.values, held, current)
        doubt = self._doubt_of_range(motion, steady, current, parameters)
        return _Reckoned(force, bool(np.isfinite(force).all()), doubt)

    def predict(self, block: SampleBlock) -> Prediction:
        """Force at the samples of a block; NaN, and not valid, where it cannot be computed."""
        verdict = self._sequence.follow(block)
        if verdict.kind == "repeat":
            return self._invalid(block, verdict.sentence, verdict.sentence)
        if verdict.kind == "jump_back":
            self._current.follow_jump()
        if self._motion is None or verdict.restarts:
            self._motion = MotionFollower(
                block.period, self._settings.bandwidth, self._settings.centre_memory
            )
            self._stream = None
            self._foreseen = None
        motion = self._motion.follow(block.displacement)
        # It was for this block, whatever becomes of it.
        foreseen, self._foreseen = self._foreseen, None
        if foreseen is not None and self._came(foreseen, block):
            reckoned = foreseen.reckoned
        else:
            missing = self._missing(block)
            if missing:
                return self._invalid(block, missing, verdict.sentence)
            reckoned = self._reckon_block(motion, block)
        assert self._parameters is not None
        if not reckoned.finite:
            self._stream = None
            reason = f"the force of {self._parameters.set_id} is beyond what a number can hold"
            return self._invalid(block, reason, verdict.sentence)
        reason = (
            self._motion.doubt
            or self._doubt_of_memory()
            or self._doubt_of_age(block)
            or reckoned.doubt
        )
        return Prediction(
            start_ns=block.start_ns,
            sequence=block.sequence,
            period=block.period,
            force=reckoned.force,
            set_id=self._parameters.set_id,
            valid=not reason,
            reason=reason,
            continuity=verdict.sentence,
        )

    def _reckon_block(self, motion: Motion, block: SampleBlock) -> _Reckoned:
        assert self._parameters is not None
        assert self._motion is not None
        if self._stream is None:
            self._stream = self._parameters.law.stream(block.period)
            self._begun_at = self._motion.reversals
        current = self._current.at(block.start_ns, block.period, block.sample_count)
        return self._reckon(motion, self._motion.steady, current, self._parameters, self._stream)

    def _missing(self, block: SampleBlock) -> str:
        """What a prediction for a block lacks, in a sentence; empty for nothing."""
        if self._parameters is None:
            return "no parameters yet: start the identifier or give parameter_file"
        if self._current.known_from(block.start_ns):
            return ""
        last = self._current.last_stamp_ns
        if last is None:
            return "no supply current yet: is it published on supply/current?"
        ahead = (last - block.start_ns) / NANOSECONDS
        return (
            f"no supply current yet that holds for these samples: the newest is stamped {ahead:.3g}"
            " s after their begin; are both stamped by one clock?"
        )

    def _doubt_of_memory(self) -> str:
        """Why the model does not know its past yet; empty where it does, or needs none."""
        assert self._stream is not None
        assert self._motion is not None
        if self._stream.remembers and self._motion.reversals == self._begun_at:
            return "the model does not know its past before the motion has reversed"
        return ""

    def _doubt_of_age(self, block: SampleBlock) -> str:
        """Why current or parameters are too old for this block; empty where they are not."""
        last = self._current.last_stamp_ns
        assert last is not None
        age = (block.end_ns - last) / NANOSECONDS
        if age > self._settings.current_timeout:
            return (
                f"the supply current is {age:.1f} s old: is it still published, with stamps on the "
                "clock of the samples?"
            )
        limit = self._settings.parameters_timeout
        if limit > 0.0 and self._confirmed_ns is not None:
            age = (block.end_ns - self._confirmed_ns) / NANOSECONDS
            if age > limit:
                return (
                    f"no window has confirmed the parameters for {age:.0f} s: "
                    "is the identifier running, and does the damper move?"
                )
        return ""

    def _doubt_of_range(
        self, motion: Motion, steady: bool, current: Array, parameters: ParameterSet
    ) -> str:
        """Why the parameters do not hold for this motion and current; empty where they do."""
        low, high = parameters.current_range
        margin = self._settings.current_margin
        if current.min() < low - margin or current.max() > high + margin:
            return (
                f"the current of {_middle(current):.2f} A is outside of the identified "
                f"{low:.2f} to {high:.2f} A"
            )
        low, high = parameters.peak_velocity_range
        margin = self._settings.velocity_margin
        speed = _middle(motion.peak_velocity)
        if self._motion is not None and not steady:
            # A motion that is no sine passes through low values without being small.
            speed = max(speed, self._motion.usual_peak_velocity)
        if not low * (1.0 - margin) <= speed <= high * (1.0 + margin):
            return (
                f"the peak velocity of {speed:.3g} m/s is outside of the identified "
                f"{low:.3g} to {high:.3g} m/s"
            )
        return ""

    def _invalid(self, block: SampleBlock, reason: str, continuity: str) -> Prediction:
        return Prediction(
            start_ns=block.start_ns,
            sequence=block.sequence,
            period=block.period,
            force=np.full(block.sample_count, np.nan),
            set_id=self._parameters.set_id if self._parameters else "",
            valid=False,
            reason=reason,
            continuity=continuity,
        )


def _middle(values: Array) -> float:
    """Upper median: of a few values in a tenth of the time that NumPy's median takes."""
    half = values.size // 2
    return float(np.partition(values, half)[half])
