"""The ablation: what it switches off exists, and a change is told from scatter."""

import pytest

from benchmarks.ablation import MECHANISMS, Mechanism, changes


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda each: each.name)
def test_a_mechanism_replaces_what_exists(
    mechanism: Mechanism, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert mechanism.off
    for place in (*mechanism.constants, *(name for name, _ in mechanism.off)):
        module, _, path = place.partition(":")
        monkeypatch.setattr(f"mr_damper_ros.{module}.{path}", None)  # fails if there is none


def test_a_change_is_told_from_the_scatter_of_the_cases() -> None:
    before = [{"wrong": float(k), "refused": 0.0} for k in range(10)]
    after = [{"wrong": k + 0.5, "refused": (-1.0) ** k} for k in range(10)]
    refused, wrong = changes(before, after)
    assert (wrong.figure, wrong.mean, wrong.change, wrong.error) == ("wrong", 4.5, 0.5, 0.0)
    assert wrong.counts
    assert not refused.counts


def test_a_case_that_fails_without_the_mechanism_is_counted() -> None:
    (failed, wrong) = changes([{"wrong": 1.0}] * 2, [{"wrong": 1.0}, {"cases that fail": 1.0}])
    assert (failed.figure, failed.change) == ("cases that fail", 0.5)
    assert (wrong.figure, wrong.cases) == ("wrong", 1)
