"""Make the ROS 2 wheels in this environment usable for building (run once after the install).

The ``.cmake`` files in them name the include folders of the machine that built the wheels; they
get those of this interpreter and of its NumPy instead.
"""

from __future__ import annotations

import re
import sys
import sysconfig
from pathlib import Path

import numpy

FOREIGN = re.compile(
    r"/opt/python/cp3\d+-cp3\d+/(?P<numpy>lib/python3\.\d+/site-packages/numpy/"
    r"(?:_core|core)/include)|/opt/python/cp3\d+-cp3\d+/include/python3\.\d+"
)


def repair(text: str) -> str:
    """Return the CMake code with this environment's include folders."""
    return FOREIGN.sub(
        lambda match: numpy.get_include() if match["numpy"] else sysconfig.get_path("include"), text
    )


def main() -> None:
    """Repair every file below the environment's ``share``."""
    for path in sorted(Path(sys.prefix, "share").rglob("*.cmake")):
        text = path.read_text(encoding="utf-8")
        repaired = repair(text)
        if repaired != text:
            path.write_text(repaired, encoding="utf-8")


if __name__ == "__main__":
    main()
