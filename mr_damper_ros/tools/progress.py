"""Progress of a long search on the terminal, and Ctrl-C that stops it with the best so far."""

from __future__ import annotations

import signal
import sys
from types import FrameType, TracebackType

from mr_damper_ros.estimation.differential_evolution import GlobalProgress


class ProgressLine:
    """A context in which Ctrl-C asks the search to stop; a second one ends the program.

    Called with the progress of a search, it rewrites one line on the terminal (nothing where
    standard error is no terminal) and returns whether to go on.
    """

    def __init__(self) -> None:
        self.stopped = False
        self._shown = False

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
        sys.stderr.write("\nstopping with the best so far (Ctrl-C again ends at once)\n")

    def __call__(self, progress: GlobalProgress) -> bool:
        """Show how far the search is; False once Ctrl-C was pressed."""
        if sys.stderr.isatty():
            self._shown = True
            sys.stderr.write(
                f"\r{progress.stage}: generation {progress.generation} of at most "
                f"{progress.generations}, best cost {progress.best_cost:.5g}, "
                f"about {progress.time_left:.0f} s left\033[K"
            )
            sys.stderr.flush()
        return not self.stopped
