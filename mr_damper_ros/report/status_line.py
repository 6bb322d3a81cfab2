"""A line on the terminal that shows the progress of a computation."""

from __future__ import annotations

import sys
from typing import TypeVar

Self = TypeVar("Self", bound="StatusLine")


class StatusLine:
    """A context with one line that is updated in place, if the output is a terminal."""

    _shown = False

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            sys.stderr.write("\n")

    def show(self, text: str) -> None:
        """Replace the text of the line."""
        if sys.stderr.isatty():
            self._shown = True
            sys.stderr.write(f"\r{text}\033[K")
            sys.stderr.flush()
