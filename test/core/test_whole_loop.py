"""Identifier, model and controller together: none of them keeps the others from what they need."""

from __future__ import annotations

from benchmarks.whole_loop import driven


def test_an_identifier_that_starts_from_nothing_leaves_the_controller_its_set() -> None:
    """The controller has a parameter file; the identifier knows the damper at 0 A alone at first.

    If its start, or what it has found at the safe current, took the place of the file, nothing but
    that current would be commanded, and nothing else ever be identified.
    """
    came = driven("C", 0, 8.0, given=False)
    assert came.reversals > 1.0
    assert came.safe == 0.0
