"""Hostile blocks: a good stream with bad blocks in between."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np

from benchmarks.hostile_input import CURRENT, NUMBERS, PERIOD, T0, motion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.signals.blocks import NANOSECONDS, BlockError, SampleBlock
from mr_damper_ros.tracking.predictor import ForcePredictor, PredictorSettings
from mr_damper_ros.tracking.window_assembler import WindowAssembler

_BLOCK = 20

_RIGHT = 0.03
"""Part of the peak force by which a valid block may differ from the law's force (RMS)."""

_SETTLED = 2.0
"""Seconds of good samples after which the motion must be followed that well."""

_FOLLOWING, _LONG, _NEW_STREAM = 2, 0.02, 0.2
"""Good blocks after a bad one; part of the cases in which they go on until all has settled, and
in which the stream is a new one."""

_BLIND = 0.25
"""Seconds after a new start in which nothing can be known of the motion: half a cycle."""

_PEAK = float(
    np.max(
        np.abs(
            sine_force(
                THESIS_28_CELSIUS, *motion(np.linspace(0.0, 0.5, 500)), np.full(500, CURRENT)
            )
        )
    )
)


class HostileStream:
    """A good stream with bad blocks in between, predicted with the right parameters."""

    def __init__(self, chance: random.Random) -> None:
        self._chance = chance
        self._begin()

    def _begin(self) -> None:
        self._predictor = ForcePredictor(PredictorSettings())
        self._predictor.set_parameters(
            ParameterSet(
                THESIS_28_CELSIUS,
                peak_velocity_range=(0.05, 0.08),
                current_range=(CURRENT, CURRENT),
            )
        )
        self._assembler = WindowAssembler(0.5, 0.25, 1)
        self._sample = 0
        self._good = 0

    def try_block(self) -> str:
        """One spoilt block, after which the stream is good again, for a while or for longer."""
        if self._chance.random() < _NEW_STREAM:
            self._begin()
        long = self._chance.random() < _LONG
        following = round(2.0 * _SETTLED / PERIOD / _BLOCK) if long else _FOLLOWING
        for number in range(1 + following):
            fault = self._follow(spoil=number == 0)
            if fault:
                return fault
        return ""

    def _follow(self, *, spoil: bool) -> str:
        values = self._next()
        if spoil:
            self._spoil(values)
        try:
            block = SampleBlock(**values)
        except BlockError:
            self._good = 0
            return ""
        prediction = self._predictor.predict(block)
        self._predictor.catch_up()
        for window in self._assembler.add_block(block):
            if window.force.size != window.current.size:
                return "a window of unequal lengths"
        self._assembler.take_events()
        if prediction.force.size != block.sample_count:
            return "a prediction of another length"
        if prediction.valid == bool(prediction.reason):
            return "not valid without a reason, or valid with one"
        self._good = 0 if spoil else self._good + block.sample_count
        return self._judge(block, prediction.force) if prediction.valid else ""

    def _judge(self, block: SampleBlock, predicted: np.ndarray) -> str:
        if not np.isfinite(predicted).all():
            return "a force that is not finite is valid"
        good = self._good * PERIOD
        if good < _BLIND and self._sample * PERIOD < _BLIND:
            return "valid before anything can be known"
        if good < _SETTLED:
            return ""
        time_ = (block.sequence + np.arange(block.sample_count)) * PERIOD
        u, v, a = motion(time_)
        truth = sine_force(THESIS_28_CELSIUS, u, v, a, np.full(time_.size, CURRENT))
        error = math.sqrt(float(np.mean((predicted - truth) ** 2)))
        return f"a force that is wrong by {error:.0f} N is valid" if error > _RIGHT * _PEAK else ""

    def _next(self) -> dict[str, Any]:
        """The next block as it should be, and its current."""
        first = self._sample
        self._sample += _BLOCK
        stamp = T0 + round(first * PERIOD * NANOSECONDS)
        self._predictor.add_current(stamp, CURRENT)
        self._assembler.add_current(stamp, CURRENT)
        time_ = (first + np.arange(_BLOCK)) * PERIOD
        u, _, _ = motion(time_)
        return {
            "start_ns": stamp,
            "sequence": first,
            "period": PERIOD,
            "displacement": u,
            "force": 1e4 * u,
        }

    def _spoil(self, values: dict[str, Any]) -> None:
        chance = self._chance
        number = chance.choice(NUMBERS)
        what = chance.randrange(9)
        if what == 0:
            name = chance.choice(("displacement", "force"))
            array = np.array(values[name])
            array[chance.randrange(array.size)] = number
            values[name] = array
        elif what == 1:
            values["displacement"] = np.full(_BLOCK, number)
        elif what == 2:
            values["force"] = np.zeros(chance.choice((0, 1, 1000)))
        elif what == 3:
            values["period"] = number
        elif what == 4:
            shift = chance.choice((-(10**18), -(10**8), -1, 1, 10**8, 10**18, 2**62))
            values["start_ns"] = int(values["start_ns"]) + shift
        elif what == 5:
            values["sequence"] = chance.choice((0, -1, 2**63, 2**64 - 1))
        elif what == 6:
            count = chance.choice((0, 1, 5000))
            values["displacement"] = values["force"] = np.zeros(count)
        elif what == 7:
            stamp = int(values["start_ns"]) + chance.choice((-(10**12), 10**12, 0))
            current = number if math.isfinite(number) else 1.0
            self._predictor.add_current(stamp, current)
            self._assembler.add_current(stamp, current)
        else:
            values["displacement"] = 1e3 * np.asarray(values["displacement"])
