"""Switching a supply off: each means in its time, and a verdict only from measured current."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import known
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.rig.supplies.off_sequence import FallingCurrent, OffSequence, Verdict

TOLERANCE, HALVING, WATCHDOG = 0.05, 0.3, 1.0

LATENCY = 0.01
"""Time [s] that a line takes."""


@dataclass
class Simulated:
    """An instrument on simulated time, and the time at which each kind of line was sent."""

    zero: bool = True
    output_off: bool = True
    watchdog: float = math.nan
    time_constant: float = 0.02
    reachable: Callable[[float], bool] = lambda now: True
    measures: Callable[[float], bool] = lambda now: True
    now: float = 0.0
    target: float = 1.0
    coil: float = 1.0
    sent: dict[str, list[float]] = field(default_factory=lambda: {"zero": [], "off": [], "any": []})

    def advance(self, duration: float) -> None:
        last = max(self.sent["any"], default=0.0)
        end = self.now + duration
        if end - last > self.watchdog:
            self._advance(max(last + self.watchdog, self.now))
            self.target = 0.0
        self._advance(end)

    def _advance(self, end: float) -> None:
        decay = math.exp(-(end - self.now) / self.time_constant)
        self.coil = self.target + (self.coil - self.target) * decay
        self.now = end

    def send(self, kind: str, obeyed: bool) -> None:
        self.advance(LATENCY)
        self.sent[kind].append(self.now)
        self.sent["any"].append(self.now)
        if obeyed:
            self.target = 0.0

    def attempt(self, off: OffSequence) -> None:
        made = off.next(self.now)
        self.advance(made.wait)
        if not self.reachable(self.now):
            self.advance(made.timeout)
            off.missed(self.now, "it is unreachable", sent=False)
            return
        if made.zero:
            self.send("zero", self.zero)
        if made.output_off:
            self.advance(max(max(self.sent["any"], default=-1.0) + made.pause - self.now, 0.0))
            self.send("off", self.output_off)
        self.send("any", False)
        if self.measures(self.now):
            off.measured(self.now, self.coil)
        else:
            self.advance(made.timeout)
            off.missed(self.now, "it does not measure", sent=True)

    def run(self, *, at_once: bool = False, duration: float = 10.0) -> OffSequence:
        off = OffSequence(
            self.now,
            tolerance=TOLERANCE,
            halving=HALVING,
            watchdog=self.watchdog,
            current=self.coil,
            at_once=at_once,
        )
        while not off.decided and self.now < duration:
            self.attempt(off)
        return off


def test_zero_comes_first_and_the_output_goes_off_without_current() -> None:
    tried = Simulated()
    assert tried.run().verdict is Verdict.OFF
    assert tried.sent["zero"][0] < tried.sent["off"][0]
    assert tried.now < 0.5


def test_a_refused_zero_is_followed_by_the_output() -> None:
    tried = Simulated(zero=False)
    assert tried.run().verdict is Verdict.OFF
    assert HALVING <= tried.sent["off"][0] < HALVING + 0.5


def test_a_slow_coil_is_given_the_time_that_it_needs() -> None:
    tried = Simulated(time_constant=0.3)
    assert tried.run().verdict is Verdict.OFF
    assert tried.coil < TOLERANCE
    assert tried.sent["off"][0] > 2.0 * HALVING


def test_both_lines_are_sent_at_once_over_a_new_link() -> None:
    tried = Simulated()
    assert tried.run(at_once=True).verdict is Verdict.OFF
    assert tried.sent["off"][0] < 3.0 * LATENCY


def test_a_current_that_stays_is_not_confirmed_and_attempts_go_on() -> None:
    tried = Simulated(zero=False, output_off=False)
    off = tried.run()
    assert off.verdict is Verdict.NOT_CONFIRMED
    assert "not confirmed: the coil may still carry 1.0 A" in off.sentence
    assert tried.now < 1.5
    tried.output_off = True
    for _ in range(3):
        tried.attempt(off)
    assert off.verdict is Verdict.OFF
    assert off.sentence == "it is measured to be off (0.000 A)"


def test_silence_lets_the_watchdog_act() -> None:
    tried = Simulated(zero=False, output_off=False, watchdog=WATCHDOG)
    off = tried.run()
    assert off.verdict is Verdict.OFF
    assert max(b - a for a, b in pairwise(tried.sent["any"])) > WATCHDOG
    assert tried.now < WATCHDOG + 1.0


def test_attempts_after_a_watchdog_that_failed_leave_it_time() -> None:
    tried = Simulated(zero=False, output_off=False, watchdog=WATCHDOG)
    tried.watchdog, off = (
        math.nan,
        OffSequence(0.0, tolerance=TOLERANCE, halving=HALVING, watchdog=WATCHDOG),
    )
    while not off.decided:
        tried.attempt(off)
    assert off.verdict is Verdict.NOT_CONFIRMED
    assert off.next(tried.now).wait == pytest.approx(2.0 * WATCHDOG)


def test_without_a_measurement_off_is_commanded_only() -> None:
    off = Simulated(measures=lambda now: False).run()
    assert off.verdict is Verdict.NOT_MEASURED
    assert "commanded off, not measured: the coil may still carry 1.0 A" in off.sentence


def test_an_instrument_that_was_never_reached_is_not_even_commanded() -> None:
    off = Simulated(reachable=lambda now: False).run()
    assert off.verdict is Verdict.NOT_CONFIRMED
    assert "not confirmed: the coil may still carry 1.0 A (it is unreachable)" in off.sentence


def test_an_instrument_that_comes_back_is_switched_off_soon_in_spite_of_a_long_watchdog() -> None:
    tried = Simulated(watchdog=60.0, reachable=lambda now: now > 1.0)
    assert tried.run().verdict is Verdict.OFF
    assert tried.now < 3.0


def test_one_measured_zero_is_not_enough() -> None:
    off = OffSequence(0.0, tolerance=TOLERANCE, halving=HALVING, at_once=True)
    off.measured(0.1, 0.0)
    assert not off.decided
    off.measured(0.2, 1.0)
    off.measured(0.3, 0.0)
    assert not off.decided
    off.measured(0.4, 0.0)
    assert off.verdict is Verdict.OFF


def test_answers_that_are_late_are_given_more_time() -> None:
    off = OffSequence(0.0, tolerance=TOLERANCE, halving=HALVING, at_once=True)
    first = off.next(0.0).timeout
    off.missed(0.3, "late", sent=True)
    assert off.next(0.3).timeout == 2.0 * first


@known.fixed(200)
@given(
    zero=st.booleans(),
    output_off=st.booleans(),
    watchdog=st.sampled_from([math.nan, 0.5, 2.0]),
    time_constant=st.floats(1e-3, 0.2),
    unreachable=st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 1.0)),
    blind_times=st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 1.0)),
    at_once=st.booleans(),
)
def test_off_is_said_of_a_coil_without_current_only_and_of_each_that_obeys(
    zero: bool,
    output_off: bool,
    watchdog: float,
    time_constant: float,
    unreachable: tuple[float, float],
    blind_times: tuple[float, float],
    at_once: bool,
) -> None:
    def outside(span: tuple[float, float]) -> Callable[[float], bool]:
        return lambda now: not span[0] <= now < sum(span)

    tried = Simulated(
        zero=zero,
        output_off=output_off,
        watchdog=watchdog,
        time_constant=time_constant,
        reachable=outside(unreachable),
        measures=outside(blind_times),
    )
    off = tried.run(at_once=at_once)
    while off.verdict is not Verdict.OFF and tried.now < 20.0:
        tried.attempt(off)
    obeys = zero or output_off or not math.isnan(watchdog)
    assert (off.verdict is Verdict.OFF) == obeys
    if off.verdict is Verdict.OFF:
        assert tried.coil <= TOLERANCE


def test_an_instrument_with_a_long_time_limit_for_answers_is_given_this_time() -> None:
    off = OffSequence(0.0, tolerance=TOLERANCE, halving=HALVING, timeout=1.5)
    assert off.next(0.0).timeout == 1.5
    off.missed(1.5, "late", sent=True)
    off.missed(3.5, "late", sent=True)
    assert not off.decided


def test_a_current_that_halves_in_time_falls() -> None:
    falling = FallingCurrent(0.0, TOLERANCE, HALVING)
    assert [falling.falls(0.2 * n, 2.0 * 0.5**n) for n in range(10)] == [True] * 10


def test_a_current_that_returns_does_not_fall() -> None:
    falling = FallingCurrent(0.0, TOLERANCE, HALVING)
    assert falling.falls(1.0, 0.0)
    assert falling.falls(2.0, 1.0)
    assert not falling.falls(2.01 + HALVING, 1.0)
