"""Exit codes of programs, and how a program ends that cannot continue."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

from mr_damper_ros.processes.dependencies import missing_dependency

DOUBTFUL = 1
"""Exit code if the result is written, but the check of the data warns of it."""

FAILED = 2
"""Exit code if the input, the options or the installation are invalid."""

INTERRUPTED, UNREAD, TERMINATED = 130, 141, 143
"""Exit codes after Ctrl-C, a closed output (SIGPIPE) and SIGTERM, as in shells."""


def exit_code(name: str, run: Callable[[], int], interrupted: int = INTERRUPTED) -> int:
    """Call the function of a program, and return its exit code.

    Ctrl-C gives the code ``interrupted``, with a message if this is no success. If the reader of
    the output closes it before the end, the code is :data:`UNREAD`, or 0 if ``interrupted`` is 0. A
    missing dependency gives one sentence and the code :data:`FAILED`.
    """
    code = None
    try:
        code = run()
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        if interrupted:
            sys.stderr.write(f"\n{name}: stopped by Ctrl-C\n")
        return interrupted
    except BrokenPipeError:
        # The reader has closed the pipe; without this, Python would fail in its final flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if code is None:  # files that follow the output are missing
            return UNREAD if interrupted else 0
        return code
    except ModuleNotFoundError as error:
        sentence = missing_dependency(error)
        if not sentence:
            raise
        sys.stderr.write(f"{name}: {sentence}\n")
        return FAILED
