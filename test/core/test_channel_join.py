"""Separately stamped channels: counted, sorted, joined; lost samples are never invented."""

import heapq
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mr_damper_ros.signals.stamped_channel import ChannelJoin, JoinedRun, StampedChannel

START = 1_700_000_000_000_000_000
RATE = 1000.0
DURATION = 8.0
PAIRED = 1e-4
"""Largest difference [s] between the sampling times of two joined samples."""


@dataclass(frozen=True)
class Sent:
    """Data of a device: sampling time [s], stamp [ns] and arrival [ns] of each sample."""

    taken: np.ndarray
    stamps: np.ndarray
    arrivals: np.ndarray


def sent(
    seed: int, ppm: float = 0.0, *, jitter: float = 0.5, loss: float = 0.01, own_clock: bool = False
) -> Sent:
    """Some seconds of samples; either the device's clock or its rate is wrong."""
    rng = np.random.default_rng(seed)
    count = round(DURATION * RATE)
    taken = (np.arange(count) + rng.random()) / RATE
    wrong = 1.0 + 1e-6 * ppm
    if not own_clock:
        taken = taken * wrong
    stamps = taken * (wrong if own_clock else 1.0)
    stamps = stamps + jitter * (2.0 * rng.random(count) - 1.0) / RATE
    arrivals = np.maximum.accumulate(taken + (jitter + 0.2) / RATE + rng.exponential(3e-4, count))
    kept = rng.random(count) >= loss
    return Sent(taken[kept], nanoseconds(stamps[kept]), nanoseconds(arrivals[kept]))


def nanoseconds(seconds: np.ndarray) -> np.ndarray:
    return np.round(1e9 * seconds).astype(np.int64) + START


def joined(leader: Sent, follower: Sent, **how: bool) -> tuple[ChannelJoin, list[JoinedRun]]:
    """The joined channels; the value of each sample is its sampling time."""
    join = ChannelJoin(StampedChannel(0.0), StampedChannel(0.0), **how)
    events = heapq.merge(
        *(
            [
                (int(a), which, int(s), float(t))
                for a, s, t in zip(x.arrivals, x.stamps, x.taken, strict=True)
            ]
            for which, x in enumerate((leader, follower))
        )
    )
    runs: list[JoinedRun] = []
    for place, (arrival, which, stamp, value) in enumerate(events):
        (join.follow if which else join.lead)(stamp, arrival, value)
        if place % 40 == 0:
            runs += join.take()
    return join, runs


@pytest.mark.parametrize("own_clocks", [False, True])
@pytest.mark.parametrize("jitter", [0.0, 0.5])
def test_two_clocks_that_drift_jitter_and_lose_are_paired(own_clocks: bool, jitter: float) -> None:
    leader = sent(1, 50.0, jitter=jitter, own_clock=own_clocks)
    follower = sent(2, -50.0, jitter=jitter, own_clock=own_clocks)
    _, runs = joined(leader, follower, own_clocks=own_clocks)
    taken = np.concatenate([run.leading for run in runs])
    apart = np.concatenate([run.following for run in runs]) - taken
    # The offset of the clock is estimated within the first second; the rate of a device's own
    # clock, estimated from the earliest arrivals, takes some seconds longer.
    assert np.abs(apart[taken > (6.0 if own_clocks else 1.0)]).max() < PAIRED
    # Each channel loses 1 % of its samples, and a loss in either channel costs a joined sample.
    assert apart.size > 0.95 * leader.taken.size


def test_the_lost_are_counted_and_none_is_invented() -> None:
    leader, follower = sent(3), sent(4, loss=0.0)
    join, runs = joined(leader, follower)
    count = round(DURATION * RATE)
    # Losses at the very beginning and end are not counted.
    assert abs(join.leader.counts["lost"] - (count - leader.taken.size)) <= 3
    assert join.follower.counts["lost"] == 0
    forces = np.concatenate([run.leading for run in runs])
    assert np.isin(forces, leader.taken).all()
    assert np.unique(forces).size == forces.size
    numbers = np.concatenate([run.index + np.arange(run.leading.size) for run in runs])
    np.testing.assert_array_equal(numbers - numbers[0], np.round((forces - forces[0]) * RATE))
    late = [(run.start_ns - START) * 1e-9 - run.leading[0] for run in runs]
    assert np.abs(late).max() < PAIRED


def test_what_was_sampled_at_its_stamp_is_brought_to_even_times() -> None:
    rng = np.random.default_rng(10)
    count = 6000
    taken = (np.arange(count) + 0.8 * (rng.random(count) - 0.5)) / RATE
    device = Sent(taken, nanoseconds(taken), nanoseconds(taken + 1e-3))
    _, runs = joined(device, device, sampled_at_stamps=True)
    for run in runs:
        even = (run.start_ns - START) * 1e-9 + np.arange(run.leading.size) / RATE
        # Interpolation is exact, because each value is its own sampling time.
        np.testing.assert_allclose(run.leading, even, atol=PAIRED)
        np.testing.assert_allclose(run.following, run.leading, atol=1e-9)


def test_a_follower_that_stops_costs_its_samples_and_nothing_waits_for_ever() -> None:
    leader, follower = sent(11, loss=0.0, jitter=0.0), sent(12, loss=0.0, jitter=0.0)
    stopped = Sent(*(part[:4000] for part in (follower.taken, follower.stamps, follower.arrivals)))
    join, runs = joined(leader, stopped)
    assert max(run.leading[-1] for run in runs) == pytest.approx(4.0, abs=0.01)
    assert join.without_partner > 3500


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_repeats_and_messages_that_overtake_change_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = START + np.arange(500) * 1_000_000 + rng.integers(-200_000, 200_000, 500)
    calm, wild = StampedChannel(0.02), StampedChannel(0.02)
    expected = [s for t in stamps.tolist() for s in calm.add(t, t, float(t))]
    order = np.argsort(np.arange(500) + rng.uniform(0.0, 8.0, 500), kind="stable")
    found = []
    for stamp in stamps[order].tolist():
        for _ in range(1 + int(rng.random() < 0.1)):
            found += wild.add(stamp, stamp, float(stamp))
    shared = min(len(expected), len(found))
    assert shared > 400
    assert [s.index for s in found[:shared]] == [s.index for s in expected[:shared]]
    assert [s.value for s in found[:shared]] == [s.value for s in expected[:shared]]
    assert wild.counts["lost"] == 0


def test_what_comes_too_late_is_left_out_and_counted() -> None:
    channel = StampedChannel(0.005)
    for k in [*range(300), *range(301, 320), 300, *range(320, 400)]:
        channel.add(START + k * 1_000_000, 0, float(k))
    assert channel.counts["late"] == 1
    assert channel.counts["lost"] == 1


def test_a_jump_back_begins_anew() -> None:
    channel = StampedChannel(0.0)
    found = []
    for start in (START + 10**12, START):
        for k in range(600):
            found += channel.add(start + k * 1_000_000, 0, float(k))
    assert channel.counts["jumps"] == 1
    assert {s.time_ns // 10**12 for s in found} == {START // 10**12, START // 10**12 + 1}
    assert len({s.index for s in found}) == len(found)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_value_that_is_not_finite_is_left_out(value: float) -> None:
    channel = StampedChannel(0.0)
    assert channel.add(START, 0, value) == []
    assert channel.counts["not_finite"] == 1
