#!/usr/bin/env python3
"""Write the pinned files of requirements/ from the ``*.in`` files (for maintainers).

Resolves the requirements with every Python given, and merges the results: one line per package
and version, with an environment marker where the versions differ between Pythons.

    scripts/pin.py PYTHON3.10 PYTHON3.11 PYTHON3.12 PYTHON3.13
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / "requirements"
HEADER = "# Written by scripts/pin.py from {sources}; do not edit by hand.\n"


def resolve(python: str, files: list[Path]) -> tuple[str, dict[str, str]]:
    """Return the Python version ("3.11") and the version of every package that pip would take."""
    version = subprocess.run(
        [python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    with tempfile.TemporaryDirectory() as folder:
        venv, report = Path(folder, "venv"), Path(folder, "report.json")
        subprocess.run([python, "-m", "venv", str(venv)], check=True)
        command = [str(venv / "bin/python"), "-m", "pip", "install", "--quiet", "--dry-run"]
        command += ["--ignore-installed", "--report", str(report)]
        for file in files:
            command += ["-r", str(file)]
        subprocess.run(command, check=True)
        content = json.loads(report.read_text())
    packages = (item["metadata"] for item in content["install"])
    return version, {item["name"].lower().replace("_", "-"): item["version"] for item in packages}


def merge(resolved: dict[str, dict[str, str]]) -> list[str]:
    """Return requirement lines that give every Python the versions resolved for it."""
    lines = []
    for name in sorted({name for packages in resolved.values() for name in packages}):
        by_version: dict[str, list[str]] = {}
        for python, packages in resolved.items():
            if name in packages:
                by_version.setdefault(packages[name], []).append(python)
        for version, pythons in by_version.items():
            line = f"{name}=={version}"
            if len(pythons) < len(resolved):
                line += " ; " + " or ".join(f'python_version == "{item}"' for item in pythons)
            lines.append(line)
    return lines


def write(target: str, names: list[str], pythons: list[str]) -> None:
    """Resolve the ``*.in`` files called ``names`` and write ``target``."""
    files = [FOLDER / f"{name}.in" for name in names]
    resolved = dict(resolve(python, files) for python in pythons)
    sources = ", ".join(file.name for file in files)
    text = HEADER.format(sources=sources) + "\n".join(merge(resolved)) + "\n"
    (FOLDER / target).write_text(text)
    print(f"{target}: {', '.join(resolved)}")


def main() -> None:
    """Pin everything."""
    pythons = sys.argv[1:]
    if not pythons:
        sys.exit("Give the Python interpreters to resolve for: scripts/pin.py python3.10 …")
    write("constraints.txt", ["build", "ros", "core", "dev"], pythons)
    noble = [python for python in pythons if "3.13" not in python]  # NumPy 1.26 ends at 3.12
    write("noble.txt", ["noble", "dev"], noble)
    write("doc.txt", ["core", "doc"], pythons)


if __name__ == "__main__":
    main()
