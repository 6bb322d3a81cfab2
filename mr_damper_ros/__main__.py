"""Run any program of the package as ``python -m mr_damper_ros PROGRAM ...``.

Two program names, ``export`` and ``watch``, have another meaning in a shell.
"""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError, distribution


def main() -> int:
    """Run the program that the first argument names; returns its exit code."""
    try:
        entries = distribution("mr_damper_ros").entry_points
    except PackageNotFoundError:
        print("mr_damper_ros is not installed: run pip install . in its clone", file=sys.stderr)
        return 2
    programs = {entry.name: entry for entry in entries if entry.group == "console_scripts"}
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in programs:
        print(f"mr_damper_ros: the programs are {', '.join(sorted(programs))}", file=sys.stderr)
        return 2
    del sys.argv[0]
    code: int = programs[name].load()()
    return code


if __name__ == "__main__":
    sys.exit(main())
