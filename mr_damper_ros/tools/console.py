"""What command-line programs share: errors as sentences, Ctrl-C, files written whole."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

FAILED = 2
"""Exit code where the input or the options cannot be used."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


def run_tool(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], int],
    arguments: Sequence[str] | None = None,
) -> int:
    """Parse the arguments (those of the process where None) and return the exit code of ``run``.

    What a user can mend (ValueError and its kinds in this package, OSError) becomes one sentence
    on standard error and exit code 2; anything else is a fault of the program and keeps its
    traceback.
    """
    options = parser.parse_args(arguments)
    try:
        code = run(options)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        sys.stderr.write(f"\n{parser.prog}: stopped by Ctrl-C\n")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of a pipe has seen enough; Python would complain again when it flushes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(parser, f"{where}{error.strerror or error}")
    except ValueError as error:
        return _fail(parser, str(error))


def _fail(parser: argparse.ArgumentParser, sentence: str) -> int:
    sys.stderr.write(f"{parser.prog}: {sentence}\n")
    return FAILED


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all; missing folders are made. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        fresh.write_text(text, encoding="utf-8")
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)
