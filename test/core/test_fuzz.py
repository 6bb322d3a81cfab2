"""Hostile input ends in the documented errors; ``make soak`` tries a hundred thousand cases."""

from __future__ import annotations

import pytest

from benchmarks import fuzz, hostile_recordings

CASES = {"blocks": 60, "text": 300, "yaml": 300, "names": 300, "mat": 12, "bag": 30}


@pytest.mark.parametrize("kind", CASES)
def test_hostile_input_does_no_harm(kind: str) -> None:
    tried, faults = fuzz.campaign(CASES[kind], seed=1, kinds=(kind,))
    assert faults == []
    assert tried[kind] == CASES[kind]


def test_a_recording_that_says_little_ends_in_a_set_or_a_sentence() -> None:
    ends, failures = hostile_recordings.campaign(2, seed=2)
    assert failures == []
    assert set(ends) == {"a set", "a sentence"}
