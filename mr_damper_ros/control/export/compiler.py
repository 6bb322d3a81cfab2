"""The C compiler of this machine."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

from mr_damper_ros.control.export.exported_law import ExportError

WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-pedantic")
"""The code gives no warning with these."""


def compiler() -> str | None:
    """Path of the compiler, that of the variable CC first; None where there is none."""
    chosen = os.environ.get("CC")
    found = (shutil.which(name) for name in ((chosen,) if chosen else ("cc", "gcc", "clang")))
    return next((path for path in found if path), None)


def compile_library(source: Path, library: Path, *options: str) -> str:
    """Make a shared library; returns what the compiler said. Raises ExportError where it fails."""
    found = compiler()
    if found is None:
        raise ExportError(
            "there is no C compiler on this machine: install gcc or clang, or choose another format"
        )
    command = [found, *WARNINGS, "-O2", "-fPIC", "-shared", "-s", *options]
    done = subprocess.run(
        [*command, "-o", str(library), str(source), "-lm"],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise ExportError(f"the C compiler has failed: {done.stderr.strip()[:500]}")
    return done.stderr
