"""``control_study``: controllers of the damper side by side on emulated plants, in one report."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from mr_damper_ros.study.control_report import FULL, PARTS, QUICK, build_report
from mr_damper_ros.tools.console import run_tool
from mr_damper_ros.tools.study_program import study_parser, write_page


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _study, arguments)


def _parser() -> argparse.ArgumentParser:
    return study_parser(
        "control_study",
        "Simulate a quarter car on roads of ISO 8608 and buildings in earthquakes, "
        "with an emulated MR damper under several controllers, and write one report.",
        PARTS,
        "drives and earthquakes cut short",
        "build/control",
    )


def _study(options: argparse.Namespace) -> int:
    extent = QUICK if options.quick else FULL
    return write_page(
        lambda say: build_report(options.output, options.only, options.workers, extent, say)
    )
