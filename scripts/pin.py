#!/usr/bin/env python3
"""Write the pinned files of requirements/ from the ``*.in`` files (for maintainers).

Resolves the requirements with every Python given, and merges the results: one line per package
and version, with an environment marker where the versions differ between Pythons.

    scripts/pin.py PYTHON3.10 PYTHON3.11 PYTHON3.12 PYTHON3.13

With ``--new`` before the Pythons, existing pins stay, and only packages in the ``*.in`` files
without a pin are resolved. This takes minutes instead of an hour.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / "requirements"
PYTHONS = {
    "constraints.txt": ("3.10", "3.11", "3.12", "3.13"),
    "dev.txt": ("3.10", "3.11", "3.12", "3.13"),
    "noble.txt": ("3.10", "3.11", "3.12"),  # NumPy 1.26 ends at 3.12
    "doc.txt": ("3.10", "3.11", "3.12", "3.13"),
}
"""Python versions by file."""
SOURCES = {
    "constraints.txt": ["build", "ros", "core"],
    "dev.txt": ["dev", "devices"],
    "noble.txt": ["noble", "dev"],
    "doc.txt": ["core", "doc"],
}
"""The ``*.in`` files from which each file is made."""
ADDED_TO = {"dev.txt": "constraints.txt"}
"""Files that list only what another one lacks; the two are resolved together."""
NO_WHEEL = ("empy", "uldaq")
"""Packages without a wheel; their hash is that of the source."""
HEADER = "# Written by scripts/pin.py from {sources}; do not edit by hand.\n"


def version_of(python: str) -> str:
    """Return the version ("3.11") of an interpreter."""
    code = "import sys; print('%d.%d' % sys.version_info[:2])"
    found = subprocess.run([python, "-c", code], check=True, capture_output=True, text=True)
    return found.stdout.strip()


def resolve(python: str, files: list[Path], *more: str) -> dict[str, str]:
    """Return the version of every package that pip selects, with ``more`` options."""
    with tempfile.TemporaryDirectory() as folder:
        venv, report = Path(folder, "venv"), Path(folder, "report.json")
        subprocess.run([python, "-m", "venv", str(venv)], check=True)
        command = [str(venv / "bin/python"), "-m", "pip", "install", "--quiet", "--dry-run"]
        command += ["--ignore-installed", "--report", str(report)]
        for file in files:
            command += ["-r", str(file)]
        subprocess.run([*command, *more], check=True)
        content = json.loads(report.read_text())
    packages = (item["metadata"] for item in content["install"])
    return {canonical(item["name"]): item["version"] for item in packages}


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


def pinned(lines: list[str], python: str) -> list[str]:
    """Return the pins in the lines for a Python ("3.11"), as ``name==version``."""
    parts = (line.partition(" ; ") for line in lines)
    return [spec for spec, _, marker in parts if not marker or f'"{python}"' in marker]


def hashes(pins: list[str], python: str) -> dict[str, str]:
    """Return the SHA-256 of the file that pip selects for each pin with a Python ("3.11")."""
    tag = "cp" + python.replace(".", "")
    abis = [part for abi in (tag, "abi3", "none") for part in ("--abi", abi)]
    platforms = [f"manylinux_2_{minor}_x86_64" for minor in range(40, 4, -1)]
    platforms += ["manylinux2014_x86_64", "manylinux2010_x86_64", "manylinux1_x86_64"]
    with tempfile.TemporaryDirectory() as folder:
        listed, report = Path(folder, "pins.txt"), Path(folder, "report.json")
        listed.write_text("\n".join(pins) + "\n")
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--no-deps"]
        command += ["--ignore-installed", "--ignore-requires-python", "--target", folder]
        command += ["--only-binary", ":all:", "--no-binary", ",".join(NO_WHEEL)]
        command += ["--implementation", "cp", "--python-version", python, *abis]
        command += [part for name in platforms for part in ("--platform", name)]
        command += ["--report", str(report), "-r", str(listed)]
        subprocess.run(command, check=True)
        content = json.loads(report.read_text())
    return {
        canonical(item["metadata"]["name"]): item["download_info"]["archive_info"]["hashes"][
            "sha256"
        ]
        for item in content["install"]
    }


def canonical(name: str) -> str:
    """Return the name as the files here write it."""
    return name.lower().replace("_", "-")


def with_hashes(lines: list[str], pythons: tuple[str, ...]) -> list[str]:
    """Return the lines, each followed by the hashes of all files that pip may select for it."""
    found: dict[str, list[str]] = {line: [] for line in lines}
    for python in pythons:
        pins = pinned(lines, python)
        of_package = hashes(pins, python)
        for line in lines:
            name = canonical(line.partition("==")[0])
            if line.partition(" ; ")[0] in pins and of_package[name] not in found[line]:
                found[line].append(of_package[name])
    return [
        " \\\n    ".join([line, *(f"--hash=sha256:{value}" for value in values)])
        for line, values in found.items()
    ]


def add_hashes(target: str) -> None:
    """Replace the hashes in a file by those of its pins."""
    path = FOLDER / target
    head, *lines = path.read_text().splitlines()
    pins = [line.removesuffix(" \\") for line in lines if "--hash" not in line]
    path.write_text("\n".join([head, *with_hashes(pins, PYTHONS[target])]) + "\n")
    print(f"{target}: hashes")


def entries(target: str) -> list[str]:
    """Return the first line of a file and its pins, each with its hashes."""
    return re.split(r"\n(?=\S)", (FOLDER / target).read_text().rstrip("\n"))


def pin_of(entry: str) -> str:
    """Return the pin of an entry, with its marker."""
    return entry.partition(" \\")[0]


def add_new(target: str, names: list[str], pythons: dict[str, str]) -> None:
    """Pin the packages that the ``*.in`` files ``names`` have and ``target`` lacks."""
    head, *pins = entries(target)
    base = ADDED_TO.get(target)
    added = [name for name, other in ADDED_TO.items() if other == target]
    lines = [pin_of(entry) for entry in [*pins, *(entries(base)[1:] if base else [])]]
    beside = [pin_of(entry) for name in added for entry in entries(name)[1:]]
    known = {line.partition("==")[0] for line in lines}
    wanted = [
        line
        for name in names
        for line in (FOLDER / f"{name}.in").read_text().splitlines()
        if line.strip()
        and not line.startswith("#")
        and canonical(re.split(r"[^\w.-]", line)[0]) not in known
    ]
    if not wanted:
        return
    found: dict[str, dict[str, str]] = {}
    for version in PYTHONS[target]:
        present = pinned(lines, version)
        fixed = [*present, *pinned(beside, version)]
        with tempfile.TemporaryDirectory() as folder:
            constraints, needed = Path(folder, "present.txt"), Path(folder, "new.in")
            constraints.write_text("\n".join(fixed) + "\n")
            needed.write_text("\n".join(wanted) + "\n")
            taken = resolve(pythons[version], [needed], "--constraint", str(constraints))
        found[version] = {
            name: value for name, value in taken.items() if f"{name}=={value}" not in present
        }
    pins += with_hashes(merge(found), PYTHONS[target])
    path = FOLDER / target
    path.write_text("\n".join([head, *sorted(pins, key=lambda pin: pin.partition("==")[0])]) + "\n")
    print(f"{target}: {', '.join(sorted({name for new in found.values() for name in new}))}")


def write(target: str, pythons: list[str]) -> None:
    """Resolve the ``*.in`` files of ``target``, and write it and the file that adds to it."""
    added = next((name for name, base in ADDED_TO.items() if base == target), "")
    own, all_names = SOURCES[target], [*SOURCES[target], *SOURCES.get(added, [])]
    found: dict[str, dict[str, dict[str, str]]] = {target: {}}
    for python in pythons:
        version = version_of(python)
        found[target][version] = packages = resolve(python, listed(all_names))
        if added:
            with tempfile.NamedTemporaryFile("w") as file:
                file.writelines(f"{name}=={value}\n" for name, value in packages.items())
                file.flush()
                needed = resolve(python, listed(own), "--constraint", file.name)
            found[target][version] = needed
            more = {name: value for name, value in packages.items() if name not in needed}
            found.setdefault(added, {})[version] = more
    for name, resolved in found.items():
        sources = ", ".join(file.name for file in listed(SOURCES[name]))
        text = HEADER.format(sources=sources) + "\n".join(merge(resolved)) + "\n"
        (FOLDER / name).write_text(text)
        print(f"{name}: {', '.join(resolved)}")
        add_hashes(name)


def listed(names: list[str]) -> list[Path]:
    """Return the ``*.in`` files with the names."""
    return [FOLDER / f"{name}.in" for name in names]


def main() -> None:
    """Pin all packages, or only new ones."""
    pythons = sys.argv[1:]
    if pythons == ["--hashes-only"]:
        for target in PYTHONS:
            add_hashes(target)
        return
    if pythons[:1] == ["--new"]:
        by_version = {version_of(python): python for python in pythons[1:]}
        for target, names in SOURCES.items():
            add_new(target, names, by_version)
        return
    if not pythons:
        sys.exit("Give the Python interpreters to resolve for: scripts/pin.py python3.10 …")
    for target in SOURCES.keys() - ADDED_TO.keys():
        write(target, [p for p in pythons if version_of(p) in PYTHONS[target]])


if __name__ == "__main__":
    main()
