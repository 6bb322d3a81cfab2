"""A watch names why what arrives is not published, and says nothing of healthy streams."""

import itertools

import pytest
from topic_streams import FAULTY, HEALTHY, LATER, LEAPS, TICK, TopicStream, run, stamped

from mr_damper_ros.data_check.findings import Finding, Kind
from mr_damper_ros.data_check.stream_watch import NewFindings

SAID = 2.0
"""Time [s] within which a cause is said."""

RESUMED = 1.5
"""Longest silence [s] of the samples after a leap, in which the period is estimated anew."""


@pytest.mark.parametrize("name", FAULTY | LATER)
def test_the_cause_is_said_first_and_soon(name: str) -> None:
    stream, kind = (FAULTY | LATER)[name]
    outcome = run(stream, seed=1)
    assert next(iter(outcome.first), None) is kind, outcome.sentences
    assert outcome.first[kind] - stream.since <= SAID


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_stream_is_published_without_a_word(name: str) -> None:
    outcome = run(HEALTHY[name])
    assert outcome.sentences == {}
    assert outcome.blocks


@pytest.mark.parametrize("name", LEAPS)
def test_after_a_leap_the_samples_go_on(name: str) -> None:
    outcome = run(TopicStream(force=LEAPS[name], displacement=LEAPS[name], seconds=7.0))
    left = outcome.left_at
    assert max(b - a for a, b in itertools.pairwise(left)) < RESUMED
    assert left[-1] > 7.0 - TICK
    # The count never goes back, whatever the stamps do.
    ends = [block.sequence + block.sample_count for block in outcome.blocks]
    assert all(a <= block.sequence for a, block in zip(ends, outcome.blocks[1:], strict=False))


@pytest.mark.parametrize("name", LEAPS)
def test_a_leap_is_said_and_nothing_else(name: str) -> None:
    outcome = run(TopicStream(force=LEAPS[name], displacement=LEAPS[name], seconds=7.0))
    expected = Kind.FROZEN_STAMPS if name.startswith("frozen") else Kind.CLOCK_SET
    assert set(outcome.first) == {expected}


def _one() -> Finding:
    return Kind.STOPPED.found("force", topic="/cell/wrench")


def test_a_finding_that_stays_is_new_once() -> None:
    new = NewFindings()
    assert [len(new.of([_one()], time)) for time in (0.0, 1.0, 10.0, 19.0)] == [1, 0, 0, 0]


def test_a_finding_that_comes_back_after_a_while_is_new_again() -> None:
    new = NewFindings()
    assert [len(new.of([_one()], time)) for time in (0.0, 11.0)] == [1, 1]


def test_a_drift_beyond_the_scatter_of_arrivals_is_named() -> None:
    drifting = stamped(lambda stamp: 1.0005 * stamp)
    outcome = run(TopicStream(force=drifting, rate=100.0, seconds=14.0))
    assert list(outcome.first) == [Kind.CLOCKS_DRIFT]
    assert "500 ±" in outcome.sentences[Kind.CLOCKS_DRIFT]
