"""``python -m mr_damper_ros PROGRAM ...``: a program whose name means something else in a shell.

``export`` is a word of the shell, and ``watch`` a program of most systems.
"""

from __future__ import annotations

import sys
from importlib.metadata import distribution


def main() -> int:
    """Run the program that the first argument names; returns its exit code."""
    entries = distribution("mr_damper_ros").entry_points
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
