"""The law as an FMI 2.0 co-simulation FMU, compiled with the C compiler of this machine."""

from __future__ import annotations

import hashlib
import io
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from xml.sax.saxutils import quoteattr

from mr_damper_ros.control.export.exported_law import ExportedLaw, number
from mr_damper_ros.control.export.source_code import filled, header, template

WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-pedantic")
"""Warning options; the code compiles without warnings."""


def compiler() -> str | None:
    """Path of the C compiler, preferably of the variable CC; None without a compiler."""
    chosen = os.environ.get("CC")
    found = (shutil.which(name) for name in ((chosen,) if chosen else ("cc", "gcc", "clang")))
    return next((path for path in found if path), None)


def compile_library(source: Path, library: Path, *options: str) -> str:
    """Compile a shared library; returns the compiler output. Raises ValueError on failure."""
    found = compiler()
    if found is None:
        raise ValueError(
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
        raise ValueError(f"the C compiler has failed: {done.stderr.strip()[:500]}")
    return done.stderr


_MEMORY = 1.0
"""Time [s] over which the error of the predicted displacement is averaged."""

_LARGEST_ERROR = 0.1
"""Largest error of the predicted displacement, relative to its change in a communication step.

With a larger one, the FMU warns.
"""

_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Fixed time stamp in the archive, so that the same set gives the same bytes."""


def fmu(law: ExportedLaw, name: str) -> bytes:
    """The content of the FMU. Raises ValueError if there is no compiler or it fails; OSError."""
    code = header(law, name)
    guid = hashlib.sha256(code.encode()).hexdigest()[:32]
    values = {
        "GUARD": name.upper(),
        "NAME": name,
        "GUID": guid,
        "PROVENANCE": quoteattr(law.provenance),
        "PERIOD": number(law.settings.period),
        "MEMORY": number(_MEMORY),
        "LARGEST_ERROR": number(_LARGEST_ERROR),
    }
    source, description = (filled(template(f"fmu.{kind}.in"), values) for kind in ("c", "xml"))
    # The platform's folder of binaries in FMI 2.0, and the suffix of a library.
    system, suffix = {"darwin": ("darwin", ".dylib"), "win32": ("win", ".dll")}.get(
        sys.platform, (sys.platform, ".so")
    )
    bits = platform.architecture()[0].removesuffix("bit")
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / f"{name}.h").write_text(code, encoding="utf-8")
        (place / "fmu.c").write_text(source, encoding="utf-8")
        library = place / f"{name}{suffix}"
        compile_library(place / "fmu.c", library, "-fvisibility=hidden")
        entries = {
            "modelDescription.xml": description.encode(),
            f"sources/{name}.h": code.encode(),
            "sources/fmu.c": source.encode(),
            f"binaries/{system}{bits}/{library.name}": library.read_bytes(),
        }
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry, content in entries.items():
            archive.writestr(zipfile.ZipInfo(entry, _EPOCH), content, zipfile.ZIP_DEFLATED)
    return packed.getvalue()
