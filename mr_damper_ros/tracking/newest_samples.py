"""The newest judged samples of a stream, as many as are asked for, in pieces."""

from __future__ import annotations

from collections import deque

from mr_damper_ros.tracking.judged_samples import JudgedSamples

_MOST_KEPT = 40_000
_MOST_TRIED = 2000
"""Samples that are kept, and that are tried out."""

_TOGETHER = 64
"""Samples that are kept in one piece."""


class NewestSamples:
    """Keeps the newest samples; ``count`` of those in whole pieces."""

    def __init__(self) -> None:
        self.count = 0
        self._pieces: deque[JudgedSamples] = deque()
        self._loose: list[JudgedSamples] = []
        self._loose_count = 0

    def __bool__(self) -> bool:
        return self.count + self._loose_count > 0

    def clear(self) -> None:
        """Others do not go on from them."""
        self._pieces.clear()
        self._loose.clear()
        self.count = self._loose_count = 0

    def add(self, samples: JudgedSamples, most: float) -> None:
        """Keep these samples, and about so many in all."""
        self._loose.append(samples)
        self._loose_count += samples.measured.size
        if self._loose_count < _TOGETHER:
            return
        self._pieces.append(JudgedSamples.joined(self._loose))
        self._loose.clear()
        self.count += self._loose_count
        self._loose_count = 0
        while self.count - self._pieces[0].measured.size >= min(most, _MOST_KEPT):
            self.count -= self._pieces.popleft().measured.size

    def last(self, count: float) -> JudgedSamples:
        """The last so many, as far as they are kept; of too many to be tried out, some."""
        parts = self._parts(count)
        whole = sum(part.measured.size for part in parts)
        return JudgedSamples.joined(parts, whole // _MOST_TRIED + 1)

    def every_one_of_the_last(self, count: float) -> JudgedSamples:
        """The last so many, as far as they are kept."""
        return JudgedSamples.joined(self._parts(count))

    def _parts(self, count: float) -> list[JudgedSamples]:
        parts: list[JudgedSamples] = []
        taken = 0
        for part in reversed([*self._pieces, *self._loose]):
            if taken >= count:
                break
            parts.append(part)
            taken += part.measured.size
        return parts[::-1]
