"""Hostile input causes only documented errors; ``make soak`` tries a hundred thousand cases."""

import pytest

from benchmarks import hostile

CASES = {"blocks": 40, "text": 200, "yaml": 150, "mat": 8, "bag": 30, "recording": 2}


@pytest.mark.parametrize("kind", CASES)
def test_hostile_input_does_no_harm(kind: str) -> None:
    assert hostile.campaign([kind] * CASES[kind], seed=2) == []
