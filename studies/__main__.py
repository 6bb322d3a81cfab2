"""``python -m studies NAME ...`` runs the study of this name; ``--help`` lists its options."""

from __future__ import annotations

import sys
from importlib import import_module

STUDIES = {
    "thesis": "studies.thesis.sections",
    "control": "studies.control.report",
    "truth": "studies.truth.report",
    "bags": "studies.thesis.bags",
}
"""The module of each study; its ``main`` takes the arguments and returns the exit code."""


def main(arguments: list[str]) -> int:
    """Run the study named by the first argument; returns its exit code."""
    name = arguments[0] if arguments else ""
    if name not in STUDIES:
        print(f"studies: the studies are {', '.join(STUDIES)}", file=sys.stderr)
        return 2
    code: int = import_module(STUDIES[name]).main(arguments[1:])
    return code


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:  # while modules are loaded; the studies catch their own
        sys.exit(130)
