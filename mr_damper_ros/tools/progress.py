"""Progress of a long search on the terminal, and Ctrl-C that stops it with the best so far."""

from __future__ import annotations

import math
import os
import signal
import sys
import time
from types import FrameType, TracebackType

from mr_damper_ros.estimation.differential_evolution import GlobalProgress

_LATE = 0.5
"""Part of the time estimated below which the time left that was told is no longer true."""


class ProgressLine:
    """A context in which Ctrl-C asks the search to stop; a second one ends the program.

    Called with the progress of a search, it rewrites one line on the terminal (nothing where
    standard error is no terminal) and returns whether to go on.
    """

    def __init__(self) -> None:
        self.stopped = False
        self._shown = False
        self._end = math.inf

    def __enter__(self) -> ProgressLine:
        self._previous = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        signal.signal(signal.SIGINT, self._previous)
        if self._shown:
            sys.stderr.write("\n")

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.stopped:
            raise KeyboardInterrupt
        self.stopped = True
        # Not through sys.stderr: the signal may have come while something is written there.
        os.write(2, b"\nstopping with the best so far (Ctrl-C again ends at once)\n")

    def __call__(self, progress: GlobalProgress) -> bool:
        """Show how far the search is; False once Ctrl-C was pressed."""
        if sys.stderr.isatty():
            self._shown = True
            sys.stderr.write(f"\r{self._told(progress)}\033[K")
            sys.stderr.flush()
        return not self.stopped

    def _told(self, progress: GlobalProgress) -> str:
        """What is known of the progress, in words."""
        parts = []
        if progress.generation > 0:
            parts.append(f"generation {progress.generation} of at most {progress.generations}")
        if math.isfinite(progress.best_cost):
            parts.append(f"misfit so far {math.sqrt(progress.best_cost):.5g}")
        if math.isfinite(progress.time_left):
            now = time.monotonic()
            # An estimate that grew would count upward.
            self._end = min(self._end, now + progress.time_left)
            left = self._end - now
            late = left < _LATE * progress.time_left
            parts.append("longer than expected" if late else f"at most {left:.0f} s left")
        return f"{progress.stage}: {', '.join(parts)}" if parts else progress.stage
