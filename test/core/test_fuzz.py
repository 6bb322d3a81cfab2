"""Hostile input ends in the documented errors; ``make soak`` tries a hundred thousand cases."""

from __future__ import annotations

import pytest

from benchmarks import fuzz
from mr_damper_ros.tracking import predictor

CASES = {"blocks": 60, "text": 300, "yaml": 300, "state": 300, "mat": 12, "bag": 30}


@pytest.mark.parametrize("kind", CASES)
def test_hostile_input_does_no_harm(kind: str) -> None:
    tried, faults = fuzz.campaign(CASES[kind], seed=1, kinds=(kind,))
    assert faults == []
    assert tried[kind] == CASES[kind]


def test_the_kinds_do_not_disturb_one_another() -> None:
    assert fuzz.campaign(200, seed=3)[1] == []


def test_a_wrong_force_would_be_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predictor.ZeroOrderHold, "at", lambda self, start, period, n: [1.0] * n)
    _, faults = fuzz.campaign(40, seed=1, kinds=("blocks",))
    assert faults
