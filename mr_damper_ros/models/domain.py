"""Where a parameter set comes from, and for which speeds and currents it holds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from mr_damper_ros.models.quantities import SAME_CURRENT

Span = tuple[float, float]
"""The lowest and the highest value of a range."""


class Origin(IntEnum):
    """Origin of a parameter set; the numbers are constants of the message DamperParameters."""

    START = 0
    """The start values of a law."""
    LITERATURE = 1
    """A published set, of another damper."""
    USER = 2
    """A file or a program of a user."""
    WINDOW = 3
    """The fit of a window, which scales the law."""
    EARLY = 4
    """The fit of the force scale after a sudden change."""
    GLOBAL = 5
    """A search in all operating points."""

    @property
    def is_evidence(self) -> bool:
        """Whether samples or a user support the set; a start set has no support."""
        return self >= Origin.USER

    @property
    def is_identified(self) -> bool:
        """Whether the set comes from the samples of the running identification, so that it ages."""
        return self > Origin.USER


@dataclass(frozen=True)
class Domain:
    """The ``speeds`` [m/s] and ``currents`` [A] for which a set holds, both ends included.

    ``confirmed_ns`` is the stamp of the last sample that is known to fit the set; None for a set
    that does not age.
    """

    speeds: Span = (0.0, math.inf)
    currents: Span = (-math.inf, math.inf)
    confirmed_ns: int | None = None

    def contains_speed(self, speed: float, margin: float) -> bool:
        """Whether a peak velocity [m/s] is in the range, widened by a relative ``margin``."""
        slow, fast = self.speeds
        return slow * (1.0 - margin) <= speed <= fast * (1.0 + margin)

    def contains(self, current: float, allowed: float = SAME_CURRENT) -> bool:
        """Whether a current [A] is in the range, widened by ``allowed`` [A]."""
        low, high = self.currents
        return low - allowed <= current <= high + allowed

    def covers(self, other: Domain) -> bool:
        """Whether the current range includes the finite ends of that of the ``other`` domain."""
        return all(self.contains(end) for end in other.currents if math.isfinite(end))

    def covers_speeds(self, other: Domain, factor: float) -> bool:
        """Whether the speeds, widened by a ``factor``, include those of the ``other`` domain."""
        (slow, fast), (slowest, fastest) = self.speeds, other.speeds
        return slow / factor <= slowest and fastest <= fast * factor

    def joined(self, other: Domain) -> Domain:
        """The smallest domain that covers both; confirmed at the later stamp."""
        (slow, fast), (low, high) = self.speeds, self.currents
        (slowest, fastest), (lowest, highest) = other.speeds, other.currents
        stamps = [each for each in (self.confirmed_ns, other.confirmed_ns) if each is not None]
        return Domain(
            (min(slow, slowest), max(fast, fastest)),
            (min(low, lowest), max(high, highest)),
            max(stamps, default=None),
        )
