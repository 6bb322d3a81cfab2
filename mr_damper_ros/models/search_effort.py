"""How far the problem of a window is searched."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchEffort:
    """How far a window of the model is searched.

    ``tolerance``: relative gain of the sum of squares at which a search ends; ``most_steps`` of it.
    Starts read off the record, where the given one is poor: the ``polished_starts`` best are
    polished to ``rough_tolerance`` in ``rough_steps``, and the best of those is taken.
    """

    tolerance: float = 1e-6
    most_steps: int = 40
    polished_starts: int = 4
    rough_tolerance: float = 1e-3
    rough_steps: int = 40
